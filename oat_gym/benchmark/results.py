"""Results of a folder: its newest cells that can be compared, with the true values of the last run."""

from __future__ import annotations

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
from oat_gym.benchmark.store import CellResult, read_augmented, read_cells
from oat_gym.benchmark.variants import NONE
from oat_gym.cache import Arrays

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
    """Give the cells with the true values that the last run on their ground knew: better ones may have been made.

    What is said of other values than the cell's own is the run's too; a run of an older version says nothing.
    """
    known = {
        (name, _valued(manifest["grounds"][name])): (truth, manifest.get("truth_notes", {}).get(name))
        for manifest in manifests
        for name, truth in manifest["truths"].items()
    }
    for cell in cells:
        truth, note = known.get((cell.dataset, _ground(cell)), (None, None))
        if truth is None or cell.failed:
            yield cell
            continue
        unknown = (math.nan, math.nan)
        pairs = np.array([truth.get(name, unknown) for name in cell.policies], dtype=np.float64).reshape(-1, 2)
        changed = note is not None and not np.array_equal(pairs[:, 0], cell.true, equal_nan=True)
        record = {**cell.record, "truth_note": note} if changed else cell.record
        yield replace(cell, true=pairs[:, 0], true_errors=pairs[:, 1], record=record)
