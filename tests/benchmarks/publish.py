"""Add folders of results to the published ones, and write the published tables and pictures anew.

    python tests/benchmarks/publish.py [RESULTS ...] --into tests/benchmarks/results/benchmark

Computing all cells takes tens of CPU hours, in parts and on several machines. What is published of them are four files
of numbers: `cells.csv` (metrics of every cell), `improvements.csv` (every improvement with its variances),
`estimates.csv` (of datasets whose true values are not known) and `recorded.csv` (the mean recorded return of each
dataset). All tables but table 1 and the pictures of bars come from these alone, so that nobody needs the cells to check
them, or to add what a new run computed. A row of table 1 is of the run whose cells are published.

A run's rows of a variant on a dataset replace the published ones where these are of fewer seeds or of another
configuration. An improvement is of the run that computed the variant, over the same run's cells without augmentation.
Where these are of another configuration than the published ones (other data, starts, estimators, versions of numpy or
torch), everything published of that dataset is left out first. Of the same configuration, a variant that comes out
otherwise than published, where the cells without augmentation come out as published, is of a method whose code was
changed, and its rows replace the published ones too. A run that computes published variants anew, the same seeds and
configurations, adds improvements over a baseline that they were not compared with by so many seeds, and one of more
seeds that lacks a baseline leaves those over it. Where the true values are not known, a run's cells and estimates
replace the published ones. Only cells of the budget "standard" from reset starts are published. What was taken of each
run is printed.
"""

from __future__ import annotations

import argparse
import base64
import csv
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from oat_gym.benchmark import story
from oat_gym.benchmark.analysis import Analysis, Estimate, Finding
from oat_gym.benchmark.budget import BUDGETS
from oat_gym.benchmark.grid import Table
from oat_gym.benchmark.protocol import SUITES, Question
from oat_gym.benchmark.results import Results, Setting, read_results
from oat_gym.benchmark.scores import METRICS, Metric
from oat_gym.benchmark.store import CellResult
from oat_gym.benchmark.tables import all_tables, method_name, table_1
from oat_gym.benchmark.tidy import Row, cell_rows, improvement_of, improvement_rows, to_csv
from oat_gym.benchmark.variants import NONE, VARIANTS
from oat_gym.cache import write_atomically

SETTING = Setting("standard", Question())
DATASETS = tuple(dict.fromkeys(name for suite in SUITES.values() for name in suite.datasets))
FILES = ("cells", "improvements", "estimates", "recorded")
KEPT = ("dataset-", "estimates-", "helped-mae-", "helped-rank_correlation-", "against-oat-mae-", "overview-", "table-")
"""How the names of the tables that are published begin."""
_EMPTY = np.empty(0)
_Metrics = dict[tuple[str, str], dict[tuple[str, str], tuple[str, ...]]]


@dataclass(frozen=True)
class Numbers:
    """The rows of the four files."""

    cells: tuple[Row, ...]
    improvements: tuple[Row, ...]
    estimates: tuple[Row, ...]
    recorded: tuple[Row, ...]

    @classmethod
    def read(cls, folder: Path) -> Numbers:
        """Return what a folder has; nothing of a file that is not there."""
        return cls(*(_read(folder / f"{name}.csv") for name in FILES))

    @classmethod
    def of(cls, analysis: Analysis) -> Numbers:
        """Return the rows of a run, without cells that failed."""
        recorded: list[Row] = []
        for name in (*analysis.with_truth(), *analysis.without_truth()):
            log = analysis.recorded(name)
            if log is not None:
                mae = analysis.floor(name)
                recorded.append({"dataset": name, "mean": log[0], "standard_error": log[1], "mae": mae})
        estimates = [asdict(each) for name in analysis.without_truth() for each in analysis.estimates(name)]
        cells = [row for row in cell_rows(analysis.results) if not row["reason"]]
        return cls(*(_texts(rows) for rows in (cells, improvement_rows(analysis), estimates, recorded)))

    def write(self, folder: Path) -> None:
        """Write the files; none without rows."""
        for name in reversed(FILES):  # cells last: by them `merged` tells, after an interruption, what is to be taken
            rows, path = _sorted(getattr(self, name)), folder / f"{name}.csv"
            if rows:
                write_atomically(path, to_csv(rows).encode())
            else:
                path.unlink(missing_ok=True)


def merged(old: Numbers, new: Numbers) -> Numbers:
    """Return the published numbers with those of a run, by the rules above."""
    before, after = _configurations(old.cells), _configurations(new.cells)
    changed = {pair for pair in before.keys() & after.keys() if _differ(before[pair], after[pair])}
    other = {name for name, variant in changed if variant == NONE}
    changed |= _come_out_otherwise(_metrics(old.cells), _metrics(new.cells))
    more = {pair for pair, keys in after.items() if len(keys) > len(before.get(pair, ()))}
    whole = {pair for pair, keys in after.items() if keys.keys() >= before.get(pair, keys).keys()}
    estimated = {(row["dataset"], row["variant"]) for row in new.estimates} & whole
    taken = {pair for pair in after if pair in changed | more | estimated or pair[0] in other}

    def kept(rows: Sequence[Row]) -> list[Row]:
        return [row for row in rows if row["dataset"] not in other and (row["dataset"], row["variant"]) not in taken]

    def fresh(rows: Sequence[Row]) -> list[Row]:
        return [row for row in rows if (row["dataset"], row["variant"]) in taken]

    same = {pair for pair, keys in after.items() if pair in taken or before.get(pair) == keys}
    measured = {_comparison(row) for row in new.improvements}
    grown = [  # of a run with more seeds, over a baseline that it lacks
        row
        for row in old.improvements
        if row["dataset"] not in other
        and (row["dataset"], row["variant"]) in taken - changed
        and _comparison(row) not in measured
    ]
    standing = [row for row in (*kept(old.improvements), *grown) if (row["dataset"], row["baseline"]) not in changed]
    improvements = {_comparison(row): row for row in (*standing, *fresh(new.improvements))}
    for row in new.improvements:
        both = {(row["dataset"], row["variant"]), (row["dataset"], row["baseline"])}
        known = improvements.get(_comparison(row))
        if both <= same and (known is None or int(row["seeds"]) > int(known["seeds"])):
            improvements[_comparison(row)] = row
    recorded = {row["dataset"]: row for row in (*old.recorded, *new.recorded)}
    return Numbers(
        cells=(*kept(old.cells), *fresh(new.cells)),
        improvements=tuple(improvements.values()),
        estimates=(*kept(old.estimates), *fresh(new.estimates)),
        recorded=tuple(recorded.values()),
    )


def _comparison(row: Row) -> tuple[str, ...]:
    return tuple(row[name] for name in ("dataset", "variant", "family", "metric", "baseline"))


def _configurations(rows: Iterable[Row]) -> dict[tuple[str, str], dict[tuple[str, str], str]]:
    """Return (dataset, variant) -> (family, seed) -> fingerprint."""
    found: dict[tuple[str, str], dict[tuple[str, str], str]] = {}
    for row in rows:
        found.setdefault((row["dataset"], row["variant"]), {})[row["family"], row["seed"]] = row["fingerprint"]
    return found


def _metrics(rows: Iterable[Row]) -> _Metrics:
    """Return (dataset, variant) -> (family, seed) -> metrics, of cells whose true values are known."""
    found: _Metrics = {}
    for row in rows:
        if row["mae"]:
            numbers = found.setdefault((row["dataset"], row["variant"]), {})
            numbers[row["family"], row["seed"]] = tuple(row[metric] for metric in METRICS)
    return found


def _come_out_otherwise(before: _Metrics, after: _Metrics) -> set[tuple[str, str]]:
    """Return the pairs whose metrics differ, of datasets on which those without augmentation do not."""
    none = {name for name, variant in before.keys() & after.keys() if variant == NONE}
    same = {name for name in none if not _differ(before[name, NONE], after[name, NONE])}
    both = {pair for pair in before.keys() & after.keys() if pair[0] in same}
    return {pair for pair in both if _differ(before[pair], after[pair])}


def _differ(parts: Mapping[tuple[str, str], Any], others: Mapping[tuple[str, str], Any]) -> bool:
    return any(parts[place] != others[place] for place in parts.keys() & others.keys())


class Published(Analysis):
    """Published numbers in the place of cells: what tables and pictures of bars need to know."""

    def __init__(self, numbers: Numbers) -> None:
        self._recorded = {row["dataset"]: row for row in numbers.recorded}
        self._estimates = [estimate_of(row) for row in numbers.estimates]
        super().__init__(_results(numbers.cells))
        found = [improvement_of(row) for row in numbers.improvements]
        self._known = tuple(name for name in self.results.datasets if name in {each.datasets[0] for each in found})
        self._found = {
            (each.datasets[0], each.variant, each.family, each.metric, each.baseline): each for each in found
        }
        self._scores = {(row["dataset"], row["variant"], row["family"], int(row["seed"])): row for row in numbers.cells}

    def finding(
        self, dataset: str, variant: str, family: str, metric: Metric, *, baseline: str = NONE
    ) -> Finding | None:
        """Return a published improvement."""
        return self._found.get((dataset, variant, family, metric, baseline))

    def scores(
        self, dataset: str, variant: str, family: str, metric: Metric, *, seeds: Sequence[int] | None = None
    ) -> np.ndarray:
        """Return a published metric of each seed."""
        there = [cell.seed for cell in super().cells(dataset, variant, family)] if seeds is None else seeds
        texts = [self._scores[dataset, variant, family, seed][metric] for seed in there]
        return np.array([_number(text) for text in texts])

    def floor(self, dataset: str) -> float | None:
        """Return the published error of the mean recorded return."""
        mae = self._recorded.get(dataset, {}).get("mae", "")
        return None if mae == "" else float(mae)

    def recorded(self, dataset: str) -> tuple[float, float] | None:
        """Return the published mean recorded return and its standard error."""
        row = self._recorded.get(dataset, {"mean": ""})
        return None if row["mean"] == "" else (float(row["mean"]), float(row["standard_error"]))

    def without_truth(self) -> tuple[str, ...]:
        """Return the datasets whose estimates are published."""
        there = {each.dataset for each in self._estimates}
        return tuple(name for name in self.results.datasets if name in there)

    def estimates(self, dataset: str) -> tuple[Estimate, ...]:
        """Return the published estimates, by estimator, variant and policy."""
        places = product(self.results.families, self.results.variants)
        own = [each for each in self._estimates if each.dataset == dataset]
        return tuple(each for place in places for each in own if (each.family, each.variant) == place)

    def cells(self, dataset: str, variant: str, family: str) -> tuple[CellResult, ...]:
        """Return nothing: cells are not published."""
        return ()


def estimate_of(row: Row) -> Estimate:
    """Return what a row of estimates says."""
    dataset, variant, family, policy = (row[name] for name in ("dataset", "variant", "family", "policy"))
    numbers = (_number(row[name]) for name in ("value", "low", "high", "deviation", "change"))
    return Estimate(dataset, variant, family, policy, int(row["seeds"]), *numbers)


def _number(text: str) -> float:
    return math.nan if text == "" else float(text)


def _results(rows: Iterable[Row]) -> Results:
    """Return cells that have no estimates, in the order of the suites."""
    heads = ("dataset", "task", "variant", "family", "estimator", "budget", "initial")
    cells = tuple(
        CellResult(
            **{name: row[name] for name in heads}, seed=int(row["seed"]), policies=(), values=_EMPTY, replicates=_EMPTY,
            true=_EMPTY, true_errors=_EMPTY, reason="", record={"fingerprint": row["fingerprint"]},
        )
        for row in rows
    )  # fmt: skip
    manifest: dict[str, Any] = {
        "datasets": DATASETS,
        "jobs_order": tuple(VARIANTS),
        "missing": {},
        "budget_line": BUDGETS[SETTING.budget].describe(),
        "cells": {str(number): cell.record["fingerprint"] for number, cell in enumerate(cells)},
    }
    return Results(SETTING, cells, (manifest,), ())


def tables_of(published: Published, runs: Sequence[Analysis], into: Path) -> list[Table]:
    """Return the tables that are published; table 1 needs the estimates of a run."""
    tables = [table for table in all_tables(published) if table.name.startswith(KEPT)]
    first: dict[str, Table] = {}
    for run, dataset in ((each, name) for each in runs for name in each.results.datasets):
        table = table_1(published_part(run, published), dataset)
        if table is not None:
            path = into / f"{table.name}.md"
            former = first.get(table.name) or (path.read_text() if path.exists() else "")
            text = former.to_markdown() if isinstance(former, Table) else former
            first[table.name] = with_former_rows(table, text)
    return [*tables, *first.values()]


def published_part(run: Analysis, published: Analysis) -> Analysis:
    """Return a run with the cells whose configurations, of all seeds, are the published ones."""
    own, there = (_configurations(_heads(each.results)) for each in (run, published))
    cells = [c for c in run.results.cells if own[c.dataset, c.variant] == there.get((c.dataset, c.variant))]
    return Analysis(replace(run.results, cells=tuple(cells)))


def _heads(results: Results) -> list[Row]:
    return [
        {"dataset": c.dataset, "variant": c.variant, "family": c.family, "seed": c.seed, **c.record}
        for c in results.cells
        if not c.failed
    ]


def with_former_rows(table: Table, former: str) -> Table:
    """Return a table 1 with those rows of another, in markdown, whose methods it does not have, in the usual order."""
    lines = [line for line in former.splitlines() if line.startswith("| ")]
    if not lines or tuple(lines[0][2:-2].split(" | ")) != table.header:
        return table
    rows = {tuple(cells[:2]): cells for cells in (tuple(line[2:-2].split(" | ")) for line in lines[2:])}
    rows |= {row[:2]: row for row in table.rows}
    order = [method_name(variant) for variant in VARIANTS]
    place = {name: number for number, name in enumerate(order)}
    ordered = sorted(rows.values(), key=lambda row: place.get(row[0], len(order)))  # stable: tests stay as they were
    return replace(table, rows=tuple(ordered))


def pictures_of(published: Published) -> dict[str, bytes]:
    """Return file name -> PNG of the bars of every group of datasets, and of the levels of human involvement."""
    drawn = {
        f"bars-{_slug(group[0])}": story.bars(published, group, level=level)
        for group, level in story.groups_of(published)
    }
    drawn["by-level"] = story.by_level(published)
    return {f"{name}.png": base64.b64decode(picture.data) for name, picture in drawn.items() if picture is not None}


def _slug(title: str) -> str:
    return title.partition(":")[0].lower().replace(" ", "-")


def publish(runs: Sequence[Path], into: Path) -> Numbers:
    """Merge the runs into a folder, write all of its tables and pictures, and return its numbers."""
    analyses = [Analysis(results) for path in runs for results in read_results(path) if results.setting == SETTING]
    numbers = Numbers.read(into)
    for analysis in analyses:
        former, numbers = numbers, merged(numbers, Numbers.of(analysis))
        tell(former, numbers, analysis)
    numbers.write(into)
    published = Published(Numbers.read(into))
    tables = {f"{table.name}.md": table for table in tables_of(published, analyses, into)}
    for name, table in tables.items():
        write_atomically(into / name, table.to_markdown().encode())
    for path in into.glob("*.md"):
        if path.name.startswith(KEPT) and path.name not in tables and not path.name.startswith("table-01"):
            path.unlink()
    pictures = pictures_of(published)
    for name, image in pictures.items():
        write_atomically(into / name, image)
    for path in into.glob("bars-*.png"):
        if path.name not in pictures:
            path.unlink()
    return numbers


def tell(old: Numbers, new: Numbers, run: Analysis) -> None:
    """Print which cells of a run replace published ones or add to them, and which are left out."""
    before, after = ({(row["dataset"], row["variant"], str(row)) for row in each.cells} for each in (old, new))
    taken = {key[:2] for key in after - before}
    there = dict.fromkeys((cell.dataset, cell.variant) for cell in run.results.cells)
    for word, chosen in (("taken", True), ("as published, or of fewer seeds", False)):
        names = [f"{dataset} {variant}" for dataset, variant in there if ((dataset, variant) in taken) == chosen]
        print(f"{word}: {', '.join(names) or '-'}")


def _read(path: Path) -> tuple[Row, ...]:
    if not path.exists():
        return ()
    with path.open(newline="") as file:
        return tuple(csv.DictReader(file))


def _texts(rows: Sequence[Row]) -> tuple[Row, ...]:
    """Return rows as they come back from a CSV file."""
    return tuple(csv.DictReader(to_csv(rows).splitlines())) if rows else ()


def _sorted(rows: Sequence[Row]) -> list[Row]:
    names = ("baseline", "variant", "family", "metric")
    place = {name: number for number, name in enumerate(DATASETS)}
    return sorted(
        rows, key=lambda row: (place[row["dataset"]], *(row.get(name, "") for name in names), row.get("seed"))
    )


def main() -> None:
    """Read the command line and publish."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="*", type=Path, metavar="RESULTS")
    parser.add_argument("--into", type=Path, required=True)
    options = parser.parse_args()
    numbers = publish(options.runs, options.into)
    print(f"{len(numbers.cells)} cells, {len(numbers.improvements)} improvements, {len(numbers.recorded)} datasets")


if __name__ == "__main__":
    main()
