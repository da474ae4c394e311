"""Train the networks of the tutoring tasks, and write the numbers and pictures of their cards.

    python datasets/build_tutoring.py tutor-sim --policies             # trains its networks again, to the same bytes
    python datasets/build_tutoring.py tutor-sim                        # the card of datasets/tutor-sim
    python datasets/build_tutoring.py tutoring-smartprimer             # needs the log (OAT_GYM_DATA)

The datasets themselves are made in the cache when they are first opened. Training takes about 10 CPU seconds a network.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import minari
import numpy as np

import oat_gym
from oat_gym import domains, ope
from oat_gym.domains import pictures, tutor_sim, tutoring
from oat_gym.domains.dqn import QNetwork
from oat_gym.envs import tutor

START, END = "<!-- numbers: written by datasets/build_tutoring.py -->", "<!-- end of numbers -->"
Row = tuple[str, str]


@dataclass(frozen=True)
class Card:
    """What makes the card of a dataset.

    Attributes:
        actions: what the actions mean.
        features: names of the observation's columns.
        shown: those in the picture.
        mined: OAT as the card recommends it for this dataset.
        networks: () -> the networks by file name.
        values: dataset -> lines on the values of the target policies.
    """

    actions: tuple[str, ...]
    features: tuple[str, ...]
    shown: tuple[str, ...]
    mined: oat_gym.OAT
    networks: Callable[[], dict[str, QNetwork]]
    values: Callable[[minari.MinariDataset], list[str]]


def table(header: Row, rows: list[Row]) -> list[str]:
    """Return the lines of a table with two columns."""
    return [f"| {header[0]} | {header[1]} |", "|---|---|", *(f"| {name} | {value} |" for name, value in rows)]


def statistics(dataset: minari.MinariDataset, actions: tuple[str, ...]) -> list[str]:
    """Return the table of a dataset's sizes, ends, rewards and actions."""
    episodes = list(dataset)
    lengths = np.array([len(episode) for episode in episodes])
    returns = np.array([episode.rewards.sum() for episode in episodes])
    taken = np.bincount(np.concatenate([episode.actions for episode in episodes]), minlength=len(actions))
    shares = ", ".join(f"{name} {100 * n / taken.sum():.1f}%" for name, n in zip(actions, taken, strict=True))
    rows = [
        ("students (episodes), decisions (steps)", f"{len(episodes):,}, {dataset.total_steps:,}"),
        ("steps a student", f"{lengths.min()} to {lengths.max()}; quartiles {quartiles(lengths, 0)}"),
        ("ends", f"{sum(bool(episode.terminations[-1]) for episode in episodes):,} terminated, the others truncated"),
        ("return, undiscounted", _mean(returns) + f"; {returns.min():.2f} to {returns.max():.2f}"),
        ("actions", shares),
    ]
    return table(("", ""), rows)


def quartiles(values: np.ndarray, digits: int) -> str:
    """Return the quartiles as text."""
    return ", ".join(f"{value:.{digits}f}" for value in np.quantile(values, [0.25, 0.5, 0.75]))


def _mean(values: np.ndarray) -> str:
    mean, error = tutoring.mean_and_error(values)
    return f"mean {mean:.3f} (standard error {error:.3f})"


def simulated_values(dataset: minari.MinariDataset) -> list[str]:
    """Return the true values of the target policies of tutor-sim, and the on-policy estimate of the expert's."""
    truth, whole = domains.truth("tutor-sim"), domains.truth("tutor-sim", gamma=1.0)
    lines = ["| policy | value, gamma 0.9 | standard error | mean learning gain | standard error |", "|---" * 5 + "|"]
    for name, value in truth.values.items():
        error, gain, whole_error = truth.standard_errors[name], whole.values[name], whole.standard_errors[name]
        lines.append(f"| {name} | {value:.4f} | {error:.4f} | {gain:.4f} | {whole_error:.4f} |")
    gains = np.array([episode.rewards.sum() for episode in dataset])
    return [*lines, "", f"In the log itself, which the expert policy made, the gain has {_mean(gains)}."]


def logged_values(dataset: minari.MinariDataset) -> list[str]:
    """Return what students of SmartPrimer achieved, and importance sampling of the target policies."""
    groups = tutoring.outcomes()
    users = [episode.infos["user_id"][0] for episode in dataset]
    returns = np.array([episode.rewards.sum() for episode in dataset])
    logged = groups["rl"].of(users)
    rows = [
        ("the log: rewards summed", returns),
        (f"outcomes of the same {len(logged)} students", logged.returns),
        (f"outcomes of all {len(groups['rl'])} students taught by the learning tutor", groups["rl"].returns),
        (f"outcomes of the {len(groups['control'])} students of the control condition", groups["control"].returns),
    ]
    lines = table(("adjusted learning gain, -8 where not finished", "mean"), [(name, interval(r)) for name, r in rows])
    found = ope.evaluate(
        dataset,
        tutoring.policies(),
        [ope.ImportanceSampling(kind="per-decision", weighted=True)],
        gamma=1.0,
        seeds=1,
        behavior="logged",
    )
    estimates = [(row["policy"], _estimate(row)) for row in found.rows]
    header = ("policy", "per-decision weighted importance sampling (95% interval); effective number of students")
    return [*lines, "", *table(header, estimates)]


def _estimate(row: Mapping[str, Any]) -> str:
    effective = row["diagnostics"]["effective_sample_size"]
    return f"{row['value']:.2f} ({row['low']:.2f} to {row['high']:.2f}); {effective:.0f}"


def interval(values: np.ndarray) -> str:
    """Return a mean and its 95% interval as text."""
    mean, error = tutoring.mean_and_error(values)
    return f"{mean:.2f} ({mean - 1.96 * error:.2f} to {mean + 1.96 * error:.2f})"


def mined_lines(dataset: minari.MinariDataset, card: Card, picture: Path) -> list[str]:
    """Mine the dataset, draw the windows of the best set, and say how many students hold it."""
    mining, episodes = card.mined.mine(dataset), list(dataset)
    best = mining.sets[0]
    columns = [card.features.index(name) for name in card.shown]
    windows = np.stack([episodes[e].observations[s : s + best.length, columns] for e, s in best.occurrences])
    everything = np.concatenate([episode.observations[:-1, columns] for episode in episodes])
    pictures.windows(windows.astype(np.float64), everything.astype(np.float64), names=card.shown, path=picture)
    lines = table(
        ("set of windows", "students that hold it"),
        [
            (
                f"{number + 1}: {', '.join(map(str, part.labels))}",
                f"{part.support:,} of {len(dataset):,} ({100 * part.support / len(dataset):.0f}%)",
            )
            for number, part in enumerate(mining.sets)
        ],
    )
    held = {int(episode) for part in mining.sets for episode in part.occurrences[:, 0]}
    together = f"Together they reach {len(held):,} students ({100 * len(held) / len(dataset):.0f}%); "
    return [*lines, "", together + f"{mining.n_too_short} have fewer than W = {mining.length} decisions."]


CARDS = {
    "tutor-sim": Card(
        actions=tutor.ACTIONS,
        features=tutor.FEATURES,
        shown=(
            "session_seconds",
            "seconds_per_step_last",
            "difficulty",
            "steps_told",
            "familiar_share",
            "correct_share",
            "correct_share_last",
            "wrong",
            "hints",
            "attempts_each_last",
        ),
        mined=oat_gym.OAT(mining=oat_gym.MiningConfig(n_clusters=5, length=5, switch_penalty=10.0)),
        networks=lambda: {
            f"dqn-{rate}": tutor_sim.train_policy(rate, tutor_sim.tutor_sim(seed=tutor_sim.TRAINING_SEED))
            for rate in tutor_sim.LEARNING_RATES
        },
        values=simulated_values,
    ),
    "tutoring-smartprimer": Card(
        actions=tutoring.ACTIONS,
        features=tutoring.FEATURES,
        shown=tutoring.FEATURES,
        mined=oat_gym.OAT(mining=oat_gym.MiningConfig(n_clusters=4, length=2, top=4)),
        networks=lambda: {"dqn": tutoring.train_policy(tutoring.smartprimer())},
        values=logged_values,
    ),
}


def write_policies(name: str, out: Path) -> None:
    """Train the networks of a task and write them to `out/policies`."""
    (out / "policies").mkdir(parents=True, exist_ok=True)
    for file, network in CARDS[name].networks().items():
        network.save(out / "policies" / f"{file}.safetensors")
        print(f"wrote {out / 'policies' / file}.safetensors")


def write_card(name: str, out: Path) -> None:
    """Write the picture, and the card's numbers between its two marks."""
    dataset, card = domains.load(name), CARDS[name]
    lines = [*statistics(dataset, card.actions), "", *card.values(dataset), ""]
    lines += mined_lines(dataset, card, out / "pst.png")
    path = out / "README.md"
    before, _, rest = (path.read_text() if path.exists() else f"{START}\n{END}\n").partition(START)
    path.write_text("\n".join([before + START, "", *lines, "", END]) + rest.partition(END)[2])
    print(f"wrote {path}")


def main() -> None:
    """Read the command line and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", choices=tuple(CARDS))
    parser.add_argument("--policies", action="store_true", help="train the networks; the default writes the card")
    parser.add_argument("--out", type=Path, help="default: datasets/DATASET")
    options = parser.parse_args()
    out = options.out or Path(__file__).parent / options.dataset
    (write_policies if options.policies else write_card)(options.dataset, out)


if __name__ == "__main__":
    main()
