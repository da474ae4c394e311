"""Results of a folder: its newest cells, tidy tables of them, and CSV and parquet files."""

from __future__ import annotations

import csv
import io
import json
import logging
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from oat_gym.benchmark.plan import read_manifests
from oat_gym.benchmark.protocol import Question
from oat_gym.benchmark.scores import METRICS, score
from oat_gym.benchmark.store import CellResult, read_augmented, read_cells
from oat_gym.benchmark.variants import NONE
from oat_gym.cache import Arrays, write_atomically
from oat_gym.errors import ConfigurationError
from oat_gym.ope.intervals import bootstrap_interval, standard_error

Row = dict[str, Any]
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Setting:
    """What cells must share to stand in one table: the budget's name and the question."""

    budget: str
    question: Question

    @classmethod
    def of(cls, budget: str, question: Mapping[str, Any]) -> Setting:
        """Return the setting of a question as a manifest or a cell holds it."""
        return cls(budget, Question(**{name: value for name, value in question.items() if name != "class"}))

    @property
    def slug(self) -> str:
        """A name for its folder of tables."""
        changed = (f"{name}-{value}" for name, value in self._unusual())
        return "-".join((self.budget, self.question.initial, self.question.behavior, *changed))

    def describe(self) -> str:
        """Return it in words."""
        where = "the environment's first states" if self.question.initial == "reset" else "the data's first states"
        changed = "".join(f", {name} {value}" for name, value in self._unusual())
        if self.question.initial == "data":
            where += " (true values: from the environment's, where the task has one)"
        return f"budget {self.budget!r}, values from {where}, behaviour policy {self.question.behavior!r}{changed}"

    def _unusual(self) -> list[tuple[str, Any]]:
        names = ("gamma", "resets", "resamples")
        pairs = [(name, getattr(self.question, name)) for name in names]
        return [(name, value) for name, value in pairs if value != getattr(Question(), name)]


@dataclass(frozen=True)
class Results:
    """The cells of one setting, with all that was noted beside them.

    Attributes:
        setting: what the cells share.
        cells: one for each dataset, variant, estimator and seed: the newest, of those that can be compared with the
            newest one without augmentation. Their true values are those of the last run.
        manifests: of the runs of this setting, the oldest first.
        augmented: (arrays, value) of what was mined and generated.
    """

    setting: Setting
    cells: tuple[CellResult, ...]
    manifests: tuple[dict[str, Any], ...]
    augmented: tuple[tuple[Arrays, dict[str, Any]], ...]

    @cached_property
    def datasets(self) -> tuple[str, ...]:
        """The datasets that have cells, in the order of the suites."""
        asked = [name for manifest in self.manifests for name in manifest["datasets"]]
        there = {cell.dataset for cell in self.cells}
        return tuple(name for name in dict.fromkeys((*asked, *sorted(there))) if name in there)

    @cached_property
    def variants(self) -> tuple[str, ...]:
        """The variants that have cells, in the order of the runs."""
        asked = [name for manifest in self.manifests for name in manifest["jobs_order"]]
        there = {cell.variant for cell in self.cells}
        return tuple(name for name in dict.fromkeys((*asked, *sorted(there))) if name in there)

    @cached_property
    def families(self) -> tuple[str, ...]:
        """The families of estimators, in the paper's order."""
        order = ("FQE", "MB", "IS", "DR", "DICE")
        there = {cell.family for cell in self.cells}
        return tuple(name for name in order if name in there) + tuple(sorted(there - set(order)))

    @property
    def missing(self) -> dict[str, str]:
        """Dataset -> why it was not at hand, of those that have no cell."""
        told = {name: why for manifest in self.manifests for name, why in manifest["missing"].items()}
        return {name: why for name, why in told.items() if name not in self.datasets}

    @cached_property
    def recorded(self) -> dict[str, tuple[float, float]]:
        """Dataset -> (mean recorded return, standard error), of the last run on the ground that its cells stand on."""
        return {
            name: (float(mean), float(error))
            for manifest in self.manifests
            for name, (mean, error) in manifest.get("recorded", {}).items()
            if _valued(manifest["grounds"][name]) in {_ground(cell) for cell in self.cells if cell.dataset == name}
        }

    @property
    def unfinished(self) -> int:
        """Number of cells that the runs asked for and that are not there, or failed; the last run of a place counts."""
        asked = {place: key for manifest in self.manifests for place, key in manifest["cells"].items()}
        done = {cell.record["fingerprint"] for cell in self.cells if not cell.failed}
        return len(set(asked.values()) - done)


def read_results(folder: Path) -> tuple[Results, ...]:
    """Return what a folder holds, the settings in the order in which they were first run.

    Raises:
        ConfigurationError: where nothing was run there, or by another version.
    """
    manifests, cells = read_manifests(folder), list(read_cells(folder))
    settings = dict.fromkeys(_manifest_setting(manifest) for manifest in manifests)
    found: list[Results] = []
    for setting in settings:
        own = [manifest for manifest in manifests if _manifest_setting(manifest) == setting]
        members = [cell for cell in cells if _cell_setting(cell) == setting]
        names = {place: name for manifest in own for place, name in manifest["augmented"].items()}
        made = read_augmented(folder, list(names.values()))
        found.append(Results(setting, tuple(with_truth(comparable(members), own)), tuple(own), tuple(made)))
    return tuple(found)


def _manifest_setting(manifest: dict[str, Any]) -> Setting:
    return Setting.of(manifest["budget"]["name"], manifest["question"])


def _cell_setting(cell: CellResult) -> Setting:
    return Setting.of(cell.budget, cell.record["config"]["question"])


def comparable(cells: Iterable[CellResult]) -> list[CellResult]:
    """Return the newest cell of each place in the tables that shares all but the method with its comparison.

    The comparison is the newest finished cell without augmentation, of the dataset and of the dataset and estimator
    (where there is none, the newest of any variant). Cells of other data, policies, horizons, discounts or starts than
    the dataset's are left out, of other versions or settings of the estimator than the estimator's, and those of a
    variant's earlier settings. A warning counts them.
    """
    ordered = sorted(cells, key=lambda cell: (float(cell.record["finished"]), cell.record["fingerprint"]))
    compared = sorted(ordered, key=lambda cell: (not cell.failed, cell.variant == NONE))  # stable: the newest is last
    grounds = {cell.dataset: _ground(cell) for cell in compared}
    standing = [cell for cell in compared if _ground(cell) == grounds[cell.dataset]]
    shared = {(cell.dataset, cell.family): _shared(cell) for cell in standing}
    matching = [cell for cell in ordered if _shared(cell) == shared.get((cell.dataset, cell.family))]
    methods = {(cell.dataset, cell.variant): cell.record["config"]["variant"] for cell in matching}
    kept = {
        (cell.dataset, cell.variant, cell.family, cell.seed): cell
        for cell in matching
        if cell.record["config"]["variant"] == methods[cell.dataset, cell.variant]
    }
    if len(kept) < len(ordered):
        _log.warning("%d cells of older settings or other data are left out of the tables.", len(ordered) - len(kept))
    return [kept[place] for place in sorted(kept)]


def _ground(cell: CellResult) -> str:
    return _valued(cell.record["config"]["ground"])


def _valued(ground: Mapping[str, Any]) -> str:
    """Return what values are of: all of a ground but what computed them."""
    return json.dumps({name: value for name, value in ground.items() if name != "computed"}, sort_keys=True)


def _shared(cell: CellResult) -> str:
    """Return what two cells of an estimator must have in common to be compared."""
    shared = {name: value for name, value in cell.record["config"].items() if name not in ("variant", "seed")}
    return json.dumps(shared, sort_keys=True)


def with_truth(cells: Iterable[CellResult], manifests: Sequence[Mapping[str, Any]]) -> Iterator[CellResult]:
    """Give the cells with the true values that the last run on their ground knew: better ones may have been made."""
    known = {
        (name, _valued(manifest["grounds"][name])): truth
        for manifest in manifests
        for name, truth in manifest["truths"].items()
    }
    for cell in cells:
        truth = known.get((cell.dataset, _ground(cell)))
        if truth is None or cell.failed:
            yield cell
            continue
        unknown = (math.nan, math.nan)
        pairs = np.array([truth.get(name, unknown) for name in cell.policies], dtype=np.float64).reshape(-1, 2)
        yield replace(cell, true=pairs[:, 0], true_errors=pairs[:, 1])


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


def write_tidy(results: Results, folder: Path) -> list[Path]:
    """Write `estimates` and `cells` as CSV, and as parquet where pyarrow is installed; return the paths."""
    folder.mkdir(parents=True, exist_ok=True)
    paths: list[Path] = []
    for name, rows in (("estimates", estimate_rows(results)), ("cells", cell_rows(results))):
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
