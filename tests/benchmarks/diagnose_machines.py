"""How far the same cell differs between two kinds of processor, beside how far it differs between seeds.

    python tests/benchmarks/diagnose_machines.py RESULTS --out FOLDER [--variants none]

Compares the cells of a folder of `oat-gym bench` that was computed on another kind of processor with the published
ones of the same fingerprint (data, settings, seed, versions), and computes nothing anew. Processors round sums
differently in the last digit, and thousands of updates make more of it. Writes `FOLDER/diagnosis-machines.csv`, `.md`.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from reread import Row, run

from oat_gym.benchmark.results import read_results
from oat_gym.benchmark.tidy import cell_rows

PUBLISHED = Path(__file__).parent / "results" / "benchmark" / "cells.csv"
FAMILIES = ("FQE", "MB", "IS", "DR", "DICE")
CAPTION = (
    "How far the mean absolute errors of equal cells (data, settings, seed, versions) are apart on two kinds of"
    " processor, and those of cells that are equal but for the seed on one of them; in percent of their mean"
)
Cells = dict[tuple[str, str, str], dict[int, dict[str, str]]]


def pairs_of(ours: Cells, theirs: Cells) -> dict[tuple[str, str, str], list[tuple[float, float]]]:
    """Return place -> the errors of both machines in each seed whose cells have one fingerprint; not of one cell."""
    found: dict[tuple[str, str, str], list[tuple[float, float]]] = {}
    for place, seeds in ours.items():
        for seed, row in seeds.items():
            other = theirs.get(place, {}).get(seed)
            if other is None or other["fingerprint"] != row["fingerprint"] or row["mae"] == "":
                continue
            if (other["commit"], other["cpu_seconds"]) != (row["commit"], row["cpu_seconds"]):
                found.setdefault(place, []).append((float(row["mae"]), float(other["mae"])))
    return found


def apart(first: float, second: float) -> float:
    """Return the difference in percent of the mean."""
    return 200.0 * abs(first - second) / (first + second)


def between_seeds(errors: Sequence[float]) -> list[float]:
    """Return how far the errors of each two seeds are apart."""
    return [apart(first, second) for number, first in enumerate(errors) for second in errors[:number]]


def rows_of(folder: Path, variants: Sequence[str]) -> list[Row]:
    """Return a row for each family of estimators."""
    ours = _by_place(
        [{k: str(v) for k, v in row.items()} for r in read_results(folder) for row in cell_rows(r)], variants
    )
    with PUBLISHED.open(newline="") as file:
        theirs = _by_place(list(csv.DictReader(file)), variants)
    pairs = pairs_of(ours, theirs)
    rows: list[Row] = []
    for family in FAMILIES:
        own = [members for place, members in pairs.items() if place[2] == family]
        machines = [apart(*pair) for members in own for pair in members]
        seeds = [number for members in own for number in between_seeds([pair[0] for pair in members])]
        if machines and seeds:
            numbers = {
                "two machines, median": np.median(machines),
                "two machines, upper quartile": np.quantile(machines, 0.75),
                "two machines, greatest": np.max(machines),
                "two seeds, median": np.median(seeds),
            }
            row = {"estimator": family, "cells": str(len(machines)), "datasets": str(len(own))}
            rows.append(row | {name: f"{number:.2g}" for name, number in numbers.items()})
    return rows


def _by_place(rows: Sequence[dict[str, str]], variants: Sequence[str]) -> Cells:
    found: Cells = {}
    for row in rows:
        if row["variant"] in variants and row["budget"] == "standard":
            found.setdefault((row["dataset"], row["variant"], row["family"]), {})[int(row["seed"])] = row
    return found


if __name__ == "__main__":
    run(rows_of, name="diagnosis-machines", caption=CAPTION, description=__doc__ or "", variants="none")
