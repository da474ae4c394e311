"""Build the Adroit datasets that this machine can make, and write their cards: datasets/adroit-TASK/README.md.

    python datasets/build_adroit.py --tasks door --augment adroit-door-human adroit-door-cloned-from-expert

The datasets themselves are made in the cache (OAT_GYM_CACHE), by `oat_gym.domains`; a card holds their statistics, what
mining finds in them, a picture, and the true values beside DOPE's published returns. Datasets named in --augment are
also augmented by OAT (default settings, factor 2), for the picture. It needs the files of the data folder
(OAT_GYM_DATA) that the domain's errors name.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path

import minari
import numpy as np
import numpy.typing as npt
from adroit_texts import ABOUT, CARD, CLONES_DOOR, CLONES_OTHER, HUMAN_DOOR, HUMAN_OTHER, REMARKS
from matplotlib.figure import Figure

from oat_gym import OAT, AugmentedDataset, domains, plots
from oat_gym.checks import check_dataset
from oat_gym.domains._data import data_folder
from oat_gym.domains.adroit import ADROIT, LEVELS
from oat_gym.domains.truth import Truth
from oat_gym.errors import DatasetNotFoundError
from oat_gym.mining import MiningResult
from oat_gym.ope.metrics import rank_correlation

FloatArray = npt.NDArray[np.float64]
Span = tuple[int, int, int]
Panel = tuple[list[FloatArray], list[Span]]
"""Observations of episodes, and the (episode, start, stop) of what is drawn in colour."""

GAMMA = 0.995
PAPER_SUPPORT = 0.82  # share of the trajectories that hold the paper's PSTs, at the least
DRAWN: dict[str, tuple[Callable[[FloatArray], FloatArray], str, str]] = {
    "door": (lambda rows: rows[:, [36, 37]], "hand to handle, across (m)", "up (m)"),
    "relocate": (lambda rows: rows[:, [36, 38]], "ball to target, across (m)", "up (m)"),
    "hammer": (lambda rows: (rows[:, 33:36] - rows[:, 36:39])[:, [1, 2]], "hand to hammer, across (m)", "up (m)"),
    "pen": (lambda rows: rows[:, [42, 43]], "direction of the pen minus that wanted, x", "y"),
}
"""Of each task: observations (n, D) -> the two numbers that are drawn (n, 2), and what the axes say."""


def available(task: str) -> dict[str, minari.MinariDataset]:
    """Return the datasets of a task that can be had here, by level; the others are named on the console."""
    found: dict[str, minari.MinariDataset] = {}
    for level in LEVELS:
        try:
            found[level] = domains.load(f"adroit-{task}-{level}")
            check_dataset(found[level])
        except DatasetNotFoundError as error:
            print(f"adroit-{task}-{level}: not built. {error}")
    return found


def statistics(dataset: minari.MinariDataset, mining: MiningResult | None) -> str:
    """Return the columns of a dataset in the card's table."""
    episodes = list(dataset.iterate_episodes())
    lengths, returns = [len(e) for e in episodes], np.array([e.rewards.sum() for e in episodes])
    actions = np.concatenate([e.actions for e in episodes])
    share, support = "not recorded", "not mined"
    if "success" in (episodes[0].infos or {}):
        share = f"{np.mean([e.infos['success'].any() for e in episodes]):.0%}"
    if mining is not None:
        n, best = len(episodes), mining.sets[0].support
        longest = max(length for length, most in mining.support_curve.items() if most >= PAPER_SUPPORT * n)
        support = f"{best} of {n} ({best / n:.0%}), C = {mining.n_clusters}; over 82% up to W = {longest}"
    return " | ".join(
        (
            f"{len(episodes)}, {sum(lengths):,}",
            f"{min(lengths)} to {max(lengths)}",
            f"{returns.mean():,.0f} ({returns.min():,.0f} to {returns.max():,.0f})",
            share,
            f"{np.mean(np.abs(actions) == 1):.0%}",
            support,
        )
    )


def draw(task: str, panels: dict[str, Panel], path: Path) -> None:
    """Draw the trajectories of each panel, spans of the best PST set in colour."""
    project, across, up = DRAWN[task]
    figure = Figure(figsize=(2.4 * len(panels), 2.7), dpi=110, layout="constrained")
    grid = figure.subplots(1, len(panels), squeeze=False, sharex=True, sharey=True)[0]
    for number, (axes, (title, (observations, spans))) in enumerate(zip(grid, panels.items(), strict=True)):
        plots.trajectories(axes, [project(rows) for rows in observations], spans=[spans], line_width=0.5)
        axes.set_title(title, fontsize=8)
        axes.set_xlabel(across, fontsize=7)
        axes.set_ylabel(up if number == 0 else "", fontsize=7)
        axes.tick_params(labelsize=7)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)


def mined_spans(mining: MiningResult) -> list[Span]:
    """Return (episode, start, stop) of the best PST set's occurrences."""
    best = mining.sets[0]
    return [(int(episode), int(start), int(start) + best.length - 1) for episode, start in best.occurrences]


def made_by_oat(data: AugmentedDataset, real: int) -> Panel:
    """Return the observations of the synthetic episodes, those after the first `real`, and their generated spans."""
    numbers = range(real, len(data))
    spans = [(i, s.start, s.stop) for i, number in enumerate(numbers) for s in data.provenance(number).spans]
    return [data[number].observations for number in numbers], spans


def published(task: str) -> dict[str, tuple[float, float]] | None:
    """Return DOPE's published return of each policy and its standard deviation over episodes, where the file is."""
    folder = data_folder()
    file = folder / "robotics" / "dope_policies" / "d4rl_policies.json" if folder else None
    if file is None or not file.is_file():
        return None
    rows = json.loads(file.read_text())
    return {
        Path(row["policy_path"]).stem: (row["return_mean"], row["return_std:"])
        for row in rows
        if row["policy_path"].startswith(f"{task}/")
    }


def truth_table(task: str) -> str:
    """Return the card's table of true values, and how they compare with DOPE's returns."""
    discounted, plain = (domains.truth(f"adroit-{task}", gamma=gamma) for gamma in (GAMMA, 1.0))
    theirs = published(task) or {}
    lines = ["| policy | value at gamma 0.995 | return | DOPE's return | difference |", "|---|---|---|---|---|"]
    for name, value in discounted.values.items():
        ours = f"{plain.values[name]:,.1f} +- {plain.standard_errors[name]:,.1f}"
        there = f"{theirs[name][0]:,.1f} | {_apart(plain, name, theirs[name])}" if name in theirs else " | "
        lines.append(f"| {name} | {value:,.1f} +- {discounted.standard_errors[name]:,.1f} | {ours} | {there} |")
    if theirs:
        names = list(plain.values)
        spearman = rank_correlation(np.array([theirs[n][0] for n in names]), np.array([plain.values[n] for n in names]))
        lines.append(f"\nSpearman correlation of the returns with DOPE's: {float(spearman):.3f}.")
    return "\n".join(lines)


def _apart(plain: Truth, name: str, theirs: tuple[float, float]) -> str:
    """Return how far a return is from DOPE's, in standard errors, as if DOPE's had as many episodes."""
    mean, deviation = theirs
    error = np.hypot(plain.standard_errors[name], deviation / plain.episodes**0.5)
    return f"{(plain.values[name] - mean) / error:+.1f}"


def write_card(task: str, *, augment: list[str], out: Path) -> None:
    """Write the card of a task and its picture."""
    rows: list[str] = []
    panels: dict[str, Panel] = {}
    for level, dataset in available(task).items():
        observations = [episode.observations for episode in dataset.iterate_episodes()]
        panels[level], mining = (observations, []), None
        if f"adroit-{task}-{level}" in augment:
            data = AugmentedDataset(dataset, OAT(), factor=2, seed=0).fit()
            mining = data.mining
            panels[level] = (observations, mined_spans(mining))
            panels[f"{level}, made by OAT"] = made_by_oat(data, len(observations))
            print(f"adroit-{task}-{level}: {mining!r}", flush=True)
        rows.append(f"| {level} | {statistics(dataset, mining)} |")
    folder = out / f"adroit-{task}"
    draw(task, panels, folder / "trajectories.png")
    truth = domains.truth(f"adroit-{task}", gamma=GAMMA)
    text = CARD.format(
        task=task,
        about=ABOUT[task],
        human=(HUMAN_DOOR if task == "door" else HUMAN_OTHER).format(task=task),
        clones=CLONES_DOOR if task == "door" else CLONES_OTHER,
        steps=f"{ADROIT[task].human_steps:,}",
        rows="\n".join(rows),
        drawn=DRAWN[task][1],
        truth=truth_table(task),
        horizon=truth.horizon,
        episodes=truth.episodes,
        versions=", ".join(f"{name} {version}" for name, version in truth.versions.items()),
        command=truth.command,
        note=truth.note,
        remark=REMARKS.get(task, ""),
        arguments=f"--tasks {task}" + (f" --augment {' '.join(augment)}" if augment else ""),
    )
    (folder / "README.md").write_text(text)


def main() -> None:
    """Read the command line and build."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", choices=tuple(ADROIT), default=list(ADROIT))
    parser.add_argument("--augment", nargs="*", default=[], help="datasets to augment for the picture, as their names")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent)
    options = parser.parse_args()
    for task in options.tasks:
        names = domains.task(f"adroit-{task}").datasets
        write_card(task, augment=[name for name in options.augment if name in names], out=options.out)


if __name__ == "__main__":
    main()
