"""Tidy tables of results: estimates, cells and improvements as rows of numbers, in CSV and parquet files."""

from __future__ import annotations

import csv
import io
import logging
import math
from collections.abc import Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np

from oat_gym.benchmark.analysis import Analysis, Finding
from oat_gym.benchmark.improvement import Improvement, Parts
from oat_gym.benchmark.results import Results
from oat_gym.benchmark.scores import METRICS, score
from oat_gym.benchmark.store import CellResult
from oat_gym.cache import write_atomically
from oat_gym.errors import ConfigurationError
from oat_gym.ope.intervals import bootstrap_interval, standard_error

Row = dict[str, Any]
_PART = "variance_"
_SIDES = ("before", "after", "improvement", "low", "high", "effect", "standard_error", "degrees")
_NUMBERS = (*_SIDES, *(_PART + part.name for part in fields(Parts)))
_log = logging.getLogger(__name__)


def estimate_rows(results: Results) -> list[Row]:
    """Return a row for each dataset, variant, estimator, seed and policy."""
    rows: list[Row] = []
    for cell in results.cells:
        if cell.failed:
            continue
        errors = standard_error(cell.replicates)
        low, high = bootstrap_interval(cell.replicates, n=int(cell.record["n_episodes"]))
        for p, policy in enumerate(cell.policies):
            numbers = {"value": cell.values[p], "standard_error": errors[p], "low": low[p], "high": high[p]}
            numbers |= {"true": cell.true[p], "true_standard_error": cell.true_errors[p]}
            rows.append(_head(cell) | {"policy": policy} | {name: float(value) for name, value in numbers.items()})
    return rows


def cell_rows(results: Results) -> list[Row]:
    """Return a row for each dataset, variant, estimator and seed: metrics, costs, versions, why it failed."""
    return [_head(cell) | _metrics(cell) | _costs(cell) | {"reason": cell.reason} for cell in results.cells]


def _head(cell: CellResult) -> Row:
    names = ("dataset", "task", "variant", "family", "estimator", "seed", "budget", "initial")
    return {name: getattr(cell, name) for name in names}


def _metrics(cell: CellResult) -> Row:
    if cell.failed or not cell.knows_truth:
        return dict.fromkeys(METRICS, math.nan)
    return {name: float(score(cell.values, cell.true, name)) for name in METRICS}


def _costs(cell: CellResult) -> Row:
    cost, made = cell.record.get("cost", {}), cell.record.get("augmentation_cost", {})
    costs = {name: cost.get(name, math.nan) for name in ("cpu_seconds", "wall_seconds", "peak_memory_mb")}
    costs |= {"augment_cpu_seconds": made.get("cpu_seconds", math.nan), "augment_from_cache": made.get("from_cache")}
    return costs | {"fingerprint": cell.record["fingerprint"]} | dict(cell.record["environment"])


def improvement_rows(analysis: Analysis) -> list[Row]:
    """Return a row for each improvement over no augmentation and over the forms of OAT.

    It has all that means over tasks and verdicts are computed from (`improvement_of`): the effect e with its standard
    error, degrees of freedom and variance by where it comes from, and as readers see it the improvement and its ends
    (errors in percent less error, others in their own unit).
    """
    return [_improvement_row(found) for found in analysis.comparisons()]


def _improvement_row(found: Finding) -> Row:
    change = found.improvement
    head = {"dataset": found.datasets[0], "variant": found.variant, "baseline": found.baseline, "family": found.family}
    head |= {"metric": found.metric, "families": " ".join(found.families), "seeds": change.n_seeds}
    sides = {"before": change.before, "after": change.after}
    told = {"improvement": change.value, "low": change.low, "high": change.high, "verdict": change.verdict}
    error = {"effect": change.effect, "standard_error": change.standard_error, "degrees": change.degrees}
    return head | sides | told | error | {_PART + name: part for name, part in asdict(change.parts).items()}


def improvement_of(row: Row) -> Finding:
    """Return what a row of `improvement_rows` says, also one that was read from a CSV file."""
    number = {name: math.nan if row[name] == "" else float(row[name]) for name in _NUMBERS}
    parts = {name.removeprefix(_PART): number.pop(name) for name in _NUMBERS if name.startswith(_PART)}
    value, seeds = number.pop("improvement"), int(row["seeds"])
    change = Improvement(metric=row["metric"], value=value, n_seeds=seeds, parts=Parts(**parts), **number)
    families = tuple(row["families"].split())
    return Finding((row["dataset"],), row["variant"], row["family"], row["metric"], change, families, row["baseline"])


def write_tidy(analysis: Analysis, folder: Path) -> list[Path]:
    """Write `estimates`, `cells` and `improvements` as CSV, and as parquet where pyarrow is; return the paths."""
    folder.mkdir(parents=True, exist_ok=True)
    paths: list[Path] = []
    found, results = improvement_rows(analysis), analysis.results
    for name, rows in (("estimates", estimate_rows(results)), ("cells", cell_rows(results)), ("improvements", found)):
        if not rows:
            continue
        path = folder / f"{name}.csv"
        write_atomically(path, to_csv(rows).encode())
        paths.append(path)
        written = _write_parquet(folder / f"{name}.parquet", rows)
        paths += [written] if written else []
    return paths


def to_csv(rows: Sequence[Row]) -> str:
    """Return rows as CSV; numbers that are not there are empty cells.

    Raises:
        ConfigurationError: without rows, since the columns would be unknown.
    """
    if not rows:
        raise ConfigurationError("There are no rows to write.")
    names = list(dict.fromkeys(name for row in rows for name in row))
    text = io.StringIO()
    writer = csv.DictWriter(text, names, lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: _cell(value) for name, value in row.items()} for row in rows)
    return text.getvalue()


def _cell(value: Any) -> Any:
    if isinstance(value, float | np.floating):
        return "" if math.isnan(value) else float(f"{value:.8g}")
    return "" if value is None else value


def _write_parquet(path: Path, rows: Sequence[Row]) -> Path | None:
    try:
        import pyarrow as pa  # noqa: PLC0415  # pyright: ignore[reportMissingImports]
        import pyarrow.parquet as pq  # noqa: PLC0415  # pyright: ignore[reportMissingImports]
    except ImportError:
        _log.info("pyarrow is not installed: %s is not written; the CSV file holds the same.", path.name)
        return None
    sink: Any = pa.BufferOutputStream()
    pq.write_table(pa.Table.from_pylist(list(rows)), sink)
    write_atomically(path, sink.getvalue().to_pybytes())
    return path
