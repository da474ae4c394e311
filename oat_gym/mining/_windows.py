"""Checking series, z-scoring them, and stacking rows into windows that never cross a series."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from oat_gym.errors import InvalidDataError

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class Rows:
    """All rows of all series, one after the other.

    Attributes:
        values: (n, D) the rows, float64.
        lengths: (N,) the number of rows in each series; they sum to n.
    """

    values: Floats
    lengths: Ints

    @property
    def starts(self) -> Ints:
        """(N,) the first row of each series."""
        return np.cumsum(self.lengths) - self.lengths

    def split(self, flat: NDArray[np.int64]) -> list[NDArray[np.int64]]:
        """Cut an (n,) array into one new array a series."""
        return [part.copy() for part in np.split(flat, np.cumsum(self.lengths)[:-1])]


def join_series(series: Sequence[ArrayLike]) -> Rows:
    """Check a list of (T_i, D) arrays and join them; the input is copied, never changed.

    Raises:
        InvalidDataError: an empty list, an empty or wrongly shaped series, different D, NaN or infinity.
    """
    if len(series) == 0:
        raise InvalidDataError("The list of series is empty; expected at least one array of shape (T, D).")
    arrays = [_as_matrix(item, index) for index, item in enumerate(series)]
    width = arrays[0].shape[1]
    for index, array in enumerate(arrays):
        if array.shape[1] != width:
            raise InvalidDataError(
                f"Series {index} has {array.shape[1]} features, but series 0 has {width}; "
                "every series must have the same features."
            )
        finite = np.isfinite(array).all(axis=1)
        if not finite.all():
            row = int(np.argmin(finite))
            raise InvalidDataError(
                f"Series {index} holds NaN or infinity, first in row {row}: {array[row]!r}. "
                "Fill in or drop missing values first."
            )
    return Rows(np.concatenate(arrays), np.array([len(array) for array in arrays], dtype=np.int64))


def _as_matrix(item: ArrayLike, index: int) -> Floats:
    try:
        array = np.asarray(item, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InvalidDataError(
            f"Series {index} is not an array of numbers ({error}); expected shape (T, D)."
        ) from error
    if array.ndim != 2 or 0 in array.shape:
        raise InvalidDataError(
            f"Series {index} has shape {array.shape}; expected (T, D) with at least one row and one feature."
            + (" Use x[:, None] for a single feature." if array.ndim == 1 and array.size else "")
        )
    return array


def standardisation(values: Floats) -> tuple[Floats, Floats]:
    """Return the (D,) means and scales that z-score the rows.

    A feature that is constant up to rounding gets scale 1, so it becomes 0 in every row: it then adds the same
    amount to every cluster's score and has no say in the labels.
    """
    centre = values.mean(axis=0)
    scale = values.std(axis=0)
    constant = scale <= 1e-10 * np.maximum(np.abs(centre), np.abs(values).max(axis=0))
    return centre, np.where(constant, 1.0, scale)


def stack_windows(rows: Rows, window: int) -> Floats:
    """Stack each row on the `window - 1` rows before it, oldest first: (n, window * D).

    Only rows of the same series enter a window. Where a series has too few rows before, its first row is repeated,
    so that every row has a window and with it a label.

    >>> stack_windows(join_series([[[1.0], [2.0], [3.0]], [[9.0]]]), 2).tolist()
    [[1.0, 1.0], [1.0, 2.0], [2.0, 3.0], [9.0, 9.0]]
    """
    first = np.repeat(rows.starts, rows.lengths)
    here = np.arange(len(rows.values))
    parts = [rows.values[np.maximum(here - lag, first)] for lag in range(window - 1, -1, -1)]
    return np.ascontiguousarray(np.concatenate(parts, axis=1))


def switch_penalties(rows: Rows, penalty: float, times: Sequence[ArrayLike] | None) -> Floats:
    """Return the (n,) cost of a switch between each row and the row before it (MT-TICC).

    It is `penalty / log(e + dt)`, dt being the time since the previous row: after a long gap a switch is cheaper.
    Without times dt is 1, the same as times 0, 1, 2, ... The entry of a series' first row is not used.

    Raises:
        InvalidDataError: times that do not match the series, are not finite, or decrease.
    """
    if times is None:
        return np.full(len(rows.values), penalty / np.log(np.e + 1))
    if len(times) != len(rows.lengths):
        raise InvalidDataError(f"Got times for {len(times)} series, but there are {len(rows.lengths)} series.")
    gaps = [_gaps(item, index, int(rows.lengths[index])) for index, item in enumerate(times)]
    return penalty / np.log(np.e + np.concatenate(gaps))


def _gaps(item: ArrayLike, index: int, length: int) -> Floats:
    times = np.asarray(item, dtype=np.float64)
    if times.shape != (length,):
        raise InvalidDataError(f"The times of series {index} have shape {times.shape}; expected ({length},).")
    gaps = np.diff(times, prepend=times[:1])
    if not np.isfinite(times).all() or (gaps < 0).any():
        raise InvalidDataError(f"The times of series {index} must be finite and must never decrease.")
    return gaps
