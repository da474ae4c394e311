"""Where two episodes differ, and whether they share memory. Exact: dtypes and bits, NaN equal to itself."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
from minari import EpisodeData

from oat_gym.episodes import plain_infos

FIELDS = ("observations", "actions", "rewards", "terminations", "truncations", "infos")


def difference(left: EpisodeData, right: EpisodeData, fields: tuple[str, ...] = FIELDS) -> str | None:
    """Return where the content of two episodes differs first, None where it does not; the ids are not compared."""
    for name in fields:
        found = tree_difference(getattr(left, name), getattr(right, name), name)
        if found:
            return found
    return None


def tree_difference(left: Any, right: Any, where: str) -> str | None:
    """Return where two batches or infos differ first, None where they do not."""
    if isinstance(left, dict) and isinstance(right, dict):
        if left.keys() != right.keys():
            return f"{where} has the keys {sorted(map(str, left))} against {sorted(map(str, right))}"
        return _first_difference((left[key], right[key], f"{where}[{key!r}]") for key in left)
    if _is_sequence(left) and _is_sequence(right):
        if len(left) != len(right):
            return f"{where} has {len(left)} entries against {len(right)}"
        return _first_difference((a, b, f"{where}[{i}]") for i, (a, b) in enumerate(zip(left, right, strict=True)))
    return _leaf_difference(left, right, where)


def saved_infos_difference(got: Any, expected: Any, rows: int | None) -> str | None:
    """Return where infos that were saved differ from what they were, None where they do not.

    Args:
        got: the infos that were read back.
        expected: the infos that were saved.
        rows: the number of rows that may have got a copy of the first one before them (`infos_rows`); None: no such.
    """
    return _saved_difference(plain_infos(got or {}), plain_infos(expected or {}), rows, "infos")


def _saved_difference(got: Any, expected: Any, rows: int | None, where: str) -> str | None:
    if isinstance(got, dict) or isinstance(expected, dict):
        if not isinstance(got, dict) or not isinstance(expected, dict) or got.keys() != expected.keys():
            return f"{where} has other keys"
        parts = (_saved_difference(got[key], expected[key], rows, f"{where}[{key!r}]") for key in expected)
        return next(filter(None, parts), None)
    found, wanted = np.asarray(got), np.asarray(expected)
    if rows is not None and len(wanted) == rows and len(found) == rows + 1:
        wanted = np.concatenate([wanted[:1], wanted])
    return tree_difference(found, wanted, where)


def _first_difference(pairs: Iterable[tuple[Any, Any, str]]) -> str | None:
    return next(filter(None, (tree_difference(*pair) for pair in pairs)), None)


def _leaf_difference(left: Any, right: Any, where: str) -> str | None:
    if isinstance(left, np.ndarray) and isinstance(right, np.ndarray):
        return _array_difference(left, right, where)
    if type(left) is not type(right) or left != right:
        return f"{where} is {left!r} against {right!r}"
    return None


def shared_leaf(left: Any, right: Any, where: str) -> str | None:
    """Return the first place where two batches share memory, None where they do not."""
    others = dict(_mutable_parts(right, where))
    for path, part in _mutable_parts(left, where):
        other = others.get(path)
        if part is other or (
            isinstance(part, np.ndarray) and isinstance(other, np.ndarray) and np.shares_memory(part, other)
        ):
            return path
    return None


def _is_sequence(value: Any) -> bool:
    return isinstance(value, tuple | list) or (isinstance(value, np.ndarray) and value.dtype == object)


def _array_difference(left: np.ndarray[Any, Any], right: np.ndarray[Any, Any], where: str) -> str | None:
    if (left.dtype, left.shape) != (right.dtype, right.shape):
        return f"{where} is {left.dtype}{list(left.shape)} against {right.dtype}{list(right.shape)}"
    if left.tobytes() == right.tobytes():
        return None
    rows = [row for row in range(len(left)) if left[row].tobytes() != right[row].tobytes()] if left.ndim else [()]
    return f"{where} at row {rows[0]} is {left[rows[0]]!r} against {right[rows[0]]!r}"


def _mutable_parts(value: Any, where: str) -> Iterator[tuple[str, Any]]:
    if isinstance(value, dict):
        if value:
            yield where, value
        for key, part in value.items():
            yield from _mutable_parts(part, f"{where}[{key!r}]")
    elif isinstance(value, tuple):
        for index, part in enumerate(value):
            yield from _mutable_parts(part, f"{where}[{index}]")
    elif isinstance(value, np.ndarray | list):
        yield where, value
        if _is_sequence(value) and len(value) and isinstance(value[0], dict):
            yield from _mutable_parts(value[0], f"{where}[0]")
