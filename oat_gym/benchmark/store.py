"""Finished cells as files: written atomically, sealed with a digest, named by their configuration's fingerprint."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from oat_gym.benchmark.protocol import Cell
from oat_gym.cache import Arrays, read_sealed, write_sealed
from oat_gym.errors import CacheError, InvalidDataError

FloatArray = npt.NDArray[np.float64]
_ARRAYS = ("values", "replicates", "true", "true_errors")
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class CellResult:
    """A finished (or failed) cell.

    Attributes:
        dataset, task, variant, family, seed, budget, initial: what it is of; `family` is the paper's name ("FQE").
        estimator: the estimator's full name.
        policies: names of the P policies.
        values: (P,) estimates, discounted, in environment units; NaN in a failed cell.
        replicates: (P, B) on bootstrap resamples of the source episodes, which all cells of a dataset share.
        true: (P,) true values, NaN where nobody knows them.
        true_errors: (P,) their standard errors.
        reason: why it failed, "" where it did not.
        record: all else: configuration, diagnostics, warnings, costs, versions (plain JSON data).
    """

    dataset: str
    task: str
    variant: str
    family: str
    estimator: str
    seed: int
    budget: str
    initial: str
    policies: tuple[str, ...]
    values: FloatArray
    replicates: FloatArray
    true: FloatArray
    true_errors: FloatArray
    reason: str
    record: Mapping[str, Any]

    @property
    def knows_truth(self) -> bool:
        """Whether every policy has a true value."""
        return bool(len(self.true) and np.isfinite(self.true).all())

    @property
    def failed(self) -> bool:
        """Whether there is no estimate."""
        return bool(self.reason)


def cell_path(folder: Path, cell: Cell) -> Path:
    """Return the file of a cell."""
    return folder / f"{cell.name}.safetensors"


def write_result(path: Path, result: CellResult) -> None:
    """Write a cell's file, atomically.

    Raises:
        OSError: if the disk refuses.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    arrays: Arrays = {name: getattr(result, name) for name in _ARRAYS}
    arrays["replicates"] = result.replicates.astype(np.float32)  # they are random to far fewer digits
    heads = ("dataset", "task", "variant", "family", "estimator", "seed", "budget", "initial", "policies", "reason")
    write_sealed(path, arrays, {name: getattr(result, name) for name in heads} | {"record": dict(result.record)})


def read_result(path: Path) -> CellResult:
    """Return a cell from its file.

    Raises:
        FileNotFoundError: if it is not there.
        CacheError: if it is damaged.
        InvalidDataError: if it is no cell.
    """
    arrays, value = read_sealed(path)
    try:
        fields: dict[str, Any] = dict(value) | {"policies": tuple(value["policies"])}
        fields |= {name: arrays[name].astype(np.float64) for name in _ARRAYS}
        return CellResult(**fields)
    except (AttributeError, KeyError, TypeError) as error:
        raise InvalidDataError(f"{path} is no cell of this benchmark ({error}).") from error


def finished(path: Path) -> CellResult | None:
    """Return the cell of a file; None where it is absent, damaged or failed, so that it is computed (again)."""
    try:
        result = read_result(path)
    except FileNotFoundError:
        return None
    except (CacheError, InvalidDataError) as error:
        _log.warning("%s The cell is computed again.", error)
        return None
    return None if result.failed else result


def read_cells(folder: Path) -> Iterator[CellResult]:
    """Give every readable cell of a folder of results, in the order of the file names; warns of damaged ones."""
    for path in sorted((folder / "cells").rglob("*.safetensors")):
        if path.name.startswith("."):
            continue
        try:
            yield read_result(path)
        except (CacheError, InvalidDataError) as error:
            _log.warning("%s It is left out; run the benchmark again to compute it.", error)


def write_augmented(folder: Path, name: str, arrays: Arrays, value: Mapping[str, Any]) -> None:
    """Write what was mined and generated for a job (`Job.name`), atomically."""
    path = folder / f"{name}.safetensors"
    path.parent.mkdir(parents=True, exist_ok=True)
    write_sealed(path, arrays, dict(value))


def read_augmented(folder: Path, names: Iterable[str]) -> list[tuple[Arrays, dict[str, Any]]]:
    """Return (arrays, value) of those of some jobs (`Job.name`) that are there and readable."""
    found: list[tuple[Arrays, dict[str, Any]]] = []
    for name in names:
        try:
            found.append(read_sealed(folder / f"{name}.safetensors"))
        except FileNotFoundError:
            continue
        except CacheError as error:
            _log.warning("%s It is left out of the report.", error)
    return found
