"""Support of temporal discrete sub-sequences (TDSS): exact counts, without collisions (the paper, Definition 2.1)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from oat_gym.errors import ConfigurationError, InvalidDataError

Ints = NDArray[np.int64]


@dataclass(frozen=True)
class TDSSTable:
    """Every distinct TDSS of one length, numbered in order of first occurrence.

    With `aligned=True` the same labels at another position of their sequence count as another entry.

    Attributes:
        length: W.
        support: (M,) number of sequences that hold the TDSS.
        occurrences: (M,) number of windows that equal it, overlapping ones included.
        first: (M, 2) sequence and start of its first occurrence.
        ids: (n,) entry of the window that starts at each row of the joined sequences; -1 where none fits.
        lengths: (N,) lengths of the sequences.
    """

    length: int
    support: Ints
    occurrences: Ints
    first: Ints
    ids: Ints
    lengths: Ints

    def windows_of(self, entry: int) -> Ints:
        """Return all (sequence, start) of one entry, (M, 2), in order."""
        return _locate(np.flatnonzero(self.ids == entry), self.lengths)


def count_tdss(labels: Sequence[ArrayLike], length: int, *, aligned: bool = False) -> TDSSTable:
    """Count the support of every TDSS of `length` labels.

    Windows are named by exact renaming of pairs: two windows get the same number exactly when all their labels are
    equal, so no hash collision can change a count. Time O(n log W).

    Args:
        labels: list of (T_i,) integer sequences; lengths may differ.
        length: W >= 1. Sequences shorter than W, empty ones too, hold no window.
        aligned: count sequences that hold the TDSS at the same position, instead of anywhere.

    Raises:
        InvalidDataError: no sequence, no label, or labels that are not integers.
        ConfigurationError: a length below 1.

    >>> table = count_tdss([[0, 0, 1, 2], [5, 0, 1, 1], [0, 1]], 2)
    >>> table.first[table.support.argmax()].tolist(), int(table.support.max())
    ([0, 1], 3)
    """
    flat, lengths = _join(labels)
    return _count(flat, lengths, check_length(length), aligned)


def support_of(tdss: ArrayLike, labels: Sequence[ArrayLike]) -> int:
    """Return the number of sequences that contain `tdss`, anywhere.

    >>> support_of([0, 1], [[0, 0, 1], [1, 0], [0, 1, 0, 1]])
    2
    """
    wanted = np.asarray(tdss)
    _, lengths = _join([wanted])
    joined = count_tdss([wanted, *labels], int(lengths[0]))
    return int(joined.support[joined.ids[0]]) - 1


def support_curve(
    labels: Sequence[ArrayLike], lengths: Iterable[int] | None = None, *, aligned: bool = False
) -> dict[int, int]:
    """Return the best support for each W: `{W: max support}`, W increasing. It never rises with W.

    Args:
        labels: list of (T_i,) integer sequences.
        lengths: the values of W; by default a grid of steps of about 20% (every W up to 6) up to the longest
            sequence, which ends at the first W whose best support is 1.
        aligned: as in `count_tdss`.

    >>> support_curve([[0, 1, 2], [0, 1, 1]])
    {1: 2, 2: 2, 3: 1}
    """
    flat, sizes = _join(labels)
    curve: dict[int, int] = {}
    for length in _grid(int(sizes.max())) if lengths is None else sorted({check_length(w) for w in lengths}):
        curve[length] = _best(flat, sizes, length, aligned)
        if lengths is None and curve[length] <= 1:
            break
    return curve


def longest_length(labels: Sequence[ArrayLike], min_support: int, *, aligned: bool = False) -> int:
    """Return the largest W whose best support is at least `min_support`, or 0 where there is none.

    >>> longest_length([[0, 1, 2], [0, 1, 1], [2, 2]], 2)
    2
    """
    flat, sizes = _join(labels)
    low, high = 0, int(sizes.max())  # the best support never rises with W
    while low < high:
        middle = (low + high + 1) // 2
        if _best(flat, sizes, middle, aligned) >= min_support:
            low = middle
        else:
            high = middle - 1
    return low


def check_length(length: int) -> int:
    """Return a window length as an int, or raise `ConfigurationError` if it is not a positive integer."""
    if isinstance(length, bool) or not isinstance(length, int | np.integer) or length < 1:
        raise ConfigurationError(f"The length W of a TDSS must be a positive integer, got {length!r}.")
    return int(length)


def _best(flat: Ints, lengths: Ints, length: int, aligned: bool) -> int:
    return int(_count(flat, lengths, length, aligned).support.max(initial=0))


def _count(flat: Ints, lengths: Ints, length: int, aligned: bool) -> TDSSTable:
    sequence = np.repeat(np.arange(len(lengths)), lengths)
    position = np.arange(len(flat)) - np.repeat(np.cumsum(lengths) - lengths, lengths)
    fits = position + length <= lengths[sequence]
    ids = _window_ids(flat, length)
    if aligned:
        ids = _rename(ids, position)
    ids = _rename(np.where(fits, ids, -1), np.zeros_like(ids))
    count = int(ids.max(initial=-1)) + 1
    support, occurrences, first = _tally(ids, sequence, count)
    return TDSSTable(length, support, occurrences, _locate(first, lengths), ids, lengths)


def _window_ids(flat: Ints, length: int) -> Ints:
    """Number the windows of `length` rows by content, by doubling; windows that cross a sequence get any number."""
    ids, size = flat, 1
    while size < length:
        step = min(size, length - size)  # two windows of `size` rows cover one of `size + step`
        partner = np.concatenate([ids[step:], np.zeros(step, dtype=np.int64)])[: len(ids)]
        ids, size = _rename(ids, partner), size + step
    return ids


def _rename(left: Ints, right: Ints) -> Ints:
    """Number distinct pairs 0, 1, ... in order of appearance; -1 on the left stays -1."""
    return _rename_keys(left * (int(right.max(initial=0)) + 1) + right, left >= 0)


@njit(nogil=True)
def _rename_keys(keys: Ints, valid: NDArray[np.bool_]) -> Ints:
    size = 16
    while size < 2 * len(keys):
        size *= 2
    table_keys = np.empty(size, dtype=np.int64)
    table_ids = np.full(size, -1, dtype=np.int64)
    ids = np.full(len(keys), -1, dtype=np.int64)
    count = 0
    for t in range(len(keys)):
        if not valid[t]:
            continue
        key = keys[t]
        mixed = (key ^ (key >> 31)) * np.int64(0x7FB5D329728EA185)
        slot = (mixed ^ (mixed >> 27)) & (size - 1)
        while table_ids[slot] >= 0 and table_keys[slot] != key:  # the key itself is compared: exact
            slot = (slot + 1) & (size - 1)
        if table_ids[slot] < 0:
            table_keys[slot] = key
            table_ids[slot] = count
            count += 1
        ids[t] = table_ids[slot]
    return ids


@njit(nogil=True)
def _tally(ids: Ints, sequence: Ints, count: int) -> tuple[Ints, Ints, Ints]:
    support = np.zeros(count, dtype=np.int64)
    occurrences = np.zeros(count, dtype=np.int64)
    first = np.zeros(count, dtype=np.int64)
    last = np.full(count, -1, dtype=np.int64)
    for t in range(len(ids)):
        k = ids[t]
        if k < 0:
            continue
        if occurrences[k] == 0:
            first[k] = t
        occurrences[k] += 1
        if last[k] != sequence[t]:
            last[k] = sequence[t]
            support[k] += 1
    return support, occurrences, first


def _locate(rows: Ints, lengths: Ints) -> Ints:
    """Turn rows of the joined sequences into (sequence, start) pairs, (M, 2)."""
    starts = np.cumsum(lengths) - lengths
    sequence = np.searchsorted(starts, rows, side="right") - 1
    return np.stack([sequence, rows - starts[sequence]], axis=1)


def _join(labels: Sequence[ArrayLike]) -> tuple[Ints, Ints]:
    """Check label sequences; return them joined, numbered from 0, and their lengths."""
    if len(labels) == 0:
        raise InvalidDataError("The list of label sequences is empty; expected at least one (T,) array.")
    arrays = [np.asarray(item) for item in labels]
    for index, array in enumerate(arrays):
        if array.ndim != 1 or array.dtype.kind not in "iu":
            raise InvalidDataError(
                f"Label sequence {index} has shape {array.shape} and type {array.dtype}; expected (T,) integers."
            )
    flat = np.concatenate(arrays).astype(np.int64)
    if len(flat) == 0:
        raise InvalidDataError(f"The {len(arrays)} label sequences hold no label; expected at least one.")
    lengths = np.array([len(array) for array in arrays], dtype=np.int64)
    return np.unique(flat, return_inverse=True)[1].astype(np.int64), lengths


def _grid(longest: int) -> list[int]:
    values, length = [1], 1
    while length < longest:
        length = min(max(length + 1, round(length * 1.2)), longest)
        values.append(length)
    return values
