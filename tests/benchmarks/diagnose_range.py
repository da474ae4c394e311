"""How much of what augmentation changes is left where estimates are kept within what policies can earn at all.

    python tests/benchmarks/diagnose_range.py RESULTS --out FOLDER [--variants oat-paper,oat,jittering,scaling]

Reads the cells of a folder of `oat-gym bench` and computes nothing anew: every estimate, and every bootstrap replicate,
is moved to the nearest value that a policy could have. No estimate of a value inside that range gets worse by it.
Writes `FOLDER/range.csv` and `FOLDER/range.md`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from reread import Row, run, told

from oat_gym import domains
from oat_gym.benchmark.analysis import MEAN, Analysis
from oat_gym.benchmark.grid import format_number
from oat_gym.benchmark.results import read_results
from oat_gym.benchmark.store import CellResult
from oat_gym.benchmark.variants import NONE
from oat_gym.ope.intervals import return_bounds
from oat_gym.source import Source

Range = tuple[float, float]
OUTCOMES: dict[str, Range] = {
    "sepsis-mdp-features": (-1.0, 1.0),
    "icu-sepsis-features": (0.0, 1.0),
    "maze2d-umaze": (0.0, 1.0),
}
"""Datasets whose episodes pay once, at their end: the least and the most that they pay."""
ALL = "all tasks"
CAPTION = (
    "Mean absolute errors as estimated and within what policies can earn, and how much of them methods take off in"
    " percent (95% interval; bold: excludes zero)"
)
FAMILIES = (MEAN, "FQE", "DR", "MB", "IS", "DICE")


def attainable(cell: CellResult) -> Range:
    """Return the least and the greatest value that a policy can have: of outcomes, else of the recorded rewards."""
    if cell.dataset in OUTCOMES:
        return OUTCOMES[cell.dataset]
    rewards = np.concatenate(Source(domains.load(cell.dataset)).rewards())
    gamma, horizon = float(cell.record["gamma"]), cell.record["horizon"]
    return return_bounds(float(rewards.min()), float(rewards.max()), gamma=gamma, horizon=horizon)


def within(cell: CellResult, ranges: dict[str, Range]) -> CellResult:
    """Return a cell whose estimates lie in its dataset's range."""
    if cell.failed or cell.dataset not in ranges:
        return cell
    low, high = ranges[cell.dataset]
    return replace(cell, values=cell.values.clip(low, high), replicates=cell.replicates.clip(low, high))


def rows_of(folder: Path, variants: Sequence[str]) -> list[Row]:
    """Return a row for each dataset with true values and each family, and their mean."""
    (results,) = read_results(folder)
    plain = Analysis(results)
    cells = {cell.dataset: cell for cell in results.cells}
    ranges = {name: attainable(cells[name]) for name in plain.with_truth()}
    inside = Analysis(replace(results, cells=tuple(within(cell, ranges) for cell in results.cells)))
    rows: list[Row] = []
    for name, (low, high) in ranges.items():
        for family in FAMILIES:
            head = {"dataset": name, "range": f"{format_number(low)} to {format_number(high)}", "estimator": family}
            errors = {"error": _error(plain, name, family), "error within": _error(inside, name, family)}
            changes = {
                text: told(analysis.finding(name, variant, family, "mae"))
                for variant in variants
                for text, analysis in ((variant, plain), (f"{variant} within", inside))
            }
            rows.append(head | errors | changes)
    return [*rows, *(_over_all(plain, inside, family, variants) for family in FAMILIES)]


def _over_all(plain: Analysis, inside: Analysis, family: str, variants: Sequence[str]) -> Row:
    """Return the row of the mean over all tasks."""
    head = {"dataset": ALL, "range": "-", "estimator": family, "error": "-", "error within": "-"}
    return head | {
        text: told(analysis.over_all(variant, family, "mae"))
        for variant in variants
        for text, analysis in ((variant, plain), (f"{variant} within", inside))
    }


def _error(analysis: Analysis, dataset: str, family: str) -> str:
    families = analysis.results.families if family == MEAN else (family,)
    seeds = analysis.common_seeds(dataset, NONE, families)
    return format_number(
        float(np.mean([analysis.scores(dataset, NONE, name, "mae", seeds=seeds).mean() for name in families]))
    )


if __name__ == "__main__":
    run(rows_of, name="range", caption=CAPTION, description=__doc__, variants="oat-paper,oat,jittering,scaling")
