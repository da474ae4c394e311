"""Gymnasium spaces as flat feature matrices, and nested batches as trees of arrays.

A *batch* is what Minari stores for n time steps of a space: an array of shape (n, ...) for Box, Discrete,
MultiDiscrete and MultiBinary, a list of n strings for Text, a dict or tuple of batches for Dict and Tuple.
Models see a batch as one (n, width) float matrix: `FlatSpace` turns one into the other. This is the only flattening.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from oat_gym.errors import InvalidDataError, UnsupportedSpaceError

FloatMatrix = npt.NDArray[np.float64]
Batch = Any  # an array, a list of strings, or a dict or tuple of batches

MAX_WIDTH = 1024
"""Widest feature vector that the augmenters model; image-sized spaces are beyond it."""


@dataclass(frozen=True)
class Leaf:
    """One Box, Discrete, MultiDiscrete or MultiBinary inside a space, and the columns it fills.

    `path` holds the Dict keys and Tuple indices that lead to it, `start` is its first column, `sizes` the numbers of
    categories of its discrete parts (empty for a Box, which fills one column for each entry).
    """

    path: tuple[str | int, ...]
    space: spaces.Space[Any]
    start: int
    sizes: tuple[int, ...]

    @property
    def width(self) -> int:
        """Number of columns."""
        return sum(self.sizes) if self.sizes else int(np.prod(_shape(self.space), dtype=int))


@dataclass(frozen=True)
class Layout:
    """What the columns of a flat feature matrix mean.

    `width` is their number; `continuous` the indices of the real-valued columns; `categorical` the (start, stop)
    column ranges of one-hot blocks, one for each discrete variable.
    """

    width: int
    continuous: tuple[int, ...]
    categorical: tuple[tuple[int, int], ...]


@dataclass(frozen=True)
class FlatSpace:
    """The flattening of one space: batches to (n, width) float64 matrices and back.

    Box entries become real columns (row-major), each discrete variable a one-hot block.

    >>> flat = FlatSpace.of(spaces.Dict(speed=spaces.Box(-1, 1, (2,)), gear=spaces.Discrete(3)))
    >>> flat.layout
    Layout(width=5, continuous=(3, 4), categorical=((0, 3),))
    >>> matrix = flat.flatten({"gear": np.array([2]), "speed": np.array([[0.5, -1.0]], dtype=np.float32)})
    >>> matrix.tolist()
    [[0.0, 0.0, 1.0, 0.5, -1.0]]
    >>> flat.unflatten(matrix)["gear"].tolist()
    [2]
    """

    space: spaces.Space[Any]
    leaves: tuple[Leaf, ...]

    @classmethod
    def of(cls, space: spaces.Space[Any], role: str = "space") -> FlatSpace:
        """Return the flattening of `space`.

        Raises:
            UnsupportedSpaceError: for Text and other spaces that no feature matrix holds, and for spaces wider than
                `MAX_WIDTH` columns (images). `role` names the space in the message ("observation space").
        """
        leaves: list[Leaf] = []
        for path, leaf in iter_leaf_spaces(space):
            start = leaves[-1].start + leaves[-1].width if leaves else 0
            leaves.append(Leaf(path, leaf, start, _category_sizes(leaf, role)))
        flat = cls(space, tuple(leaves))
        if not 1 <= flat.layout.width <= MAX_WIDTH:
            raise UnsupportedSpaceError(
                f"The {role} {space} has {flat.layout.width} features; a modelling augmenter takes 1 to {MAX_WIDTH}. "
                "Reduce it (an encoder, a feature wrapper) before augmenting, or wrap the dataset with count=0."
            )
        return flat

    @property
    def layout(self) -> Layout:
        """The meaning of the columns."""
        continuous: list[int] = []
        categorical: list[tuple[int, int]] = []
        for leaf in self.leaves:
            if not leaf.sizes:
                continuous.extend(range(leaf.start, leaf.start + leaf.width))
                continue
            edges = leaf.start + np.cumsum((0, *leaf.sizes))
            categorical.extend((int(a), int(b)) for a, b in pairwise(edges))
        return Layout(sum(leaf.width for leaf in self.leaves), tuple(continuous), tuple(categorical))

    @property
    def bounds(self) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """Lower and upper bound of each column, two arrays of shape (width,); infinite where the Box is unbounded."""
        low, high = np.zeros(self.layout.width), np.ones(self.layout.width)
        for leaf in self.leaves:
            if isinstance(leaf.space, spaces.Box):
                columns = slice(leaf.start, leaf.start + leaf.width)
                low[columns] = leaf.space.low.ravel()
                high[columns] = leaf.space.high.ravel()
        return low, high

    def flatten(self, batch: Batch) -> FloatMatrix:
        """Return the (n, width) matrix of a batch of n steps.

        Raises:
            InvalidDataError: if a discrete value lies outside its space.
        """
        columns = [_leaf_to_columns(leaf, get_leaf(batch, leaf.path)) for leaf in self.leaves]
        return np.concatenate(columns, axis=1)

    def unflatten(self, matrix: npt.NDArray[np.floating[Any]]) -> Batch:
        """Return the batch of an (n, width) matrix, in the dtypes of the space and inside its bounds.

        Box columns are clipped (and rounded where the Box holds integers); one-hot blocks give their largest entry.
        """
        values = {leaf.path: _columns_to_leaf(leaf, matrix) for leaf in self.leaves}
        return _build(self.space, (), values)


def iter_leaf_spaces(
    space: spaces.Space[Any], path: tuple[str | int, ...] = ()
) -> Iterator[tuple[tuple[str | int, ...], spaces.Space[Any]]]:
    """Yield (path, space) of every space inside `space` that is neither Dict nor Tuple, keys in alphabetical order.

    The order of a Dict's keys is no part of it: in memory it may be another than after reading the space from disk.
    """
    if isinstance(space, spaces.Dict):
        for key in sorted(space.spaces):
            yield from iter_leaf_spaces(space.spaces[key], (*path, key))
    elif isinstance(space, spaces.Tuple):
        for index, child in enumerate(space.spaces):
            yield from iter_leaf_spaces(child, (*path, index))
    else:
        yield path, space


def get_leaf(batch: Batch, path: tuple[str | int, ...]) -> Any:
    """Return the part of a nested batch that `path` leads to."""
    for key in path:
        batch = batch[key]
    return batch


def map_tree(function: Callable[..., Any], batch: Batch, *others: Batch) -> Batch:
    """Apply `function` to the matching leaves of trees of one structure; lists of strings are leaves."""
    if isinstance(batch, dict):
        return {key: map_tree(function, batch[key], *(other[key] for other in others)) for key in batch}
    if isinstance(batch, tuple):
        return tuple(map_tree(function, *parts) for parts in zip(batch, *others, strict=True))
    return function(batch, *others)


def in_dtype_of(recorded: npt.NDArray[Any], made: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return a copy of `made` in the dtype of `recorded`; in its own where that would make integers of real numbers."""
    return made.astype(recorded.dtype if np.can_cast(made.dtype, recorded.dtype, "same_kind") else made.dtype)


def in_kind_of(space: spaces.Space[Any], batch: Batch) -> Batch:
    """Return a batch without integers that are recorded for a space of real numbers, or booleans for one of integers.

    What is generated for such a space is of its dtype, and storages that keep one column for all need one dtype.
    """
    if isinstance(space, spaces.Dict):
        return {key: in_kind_of(space.spaces[key], part) for key, part in batch.items()}
    if isinstance(space, spaces.Tuple):
        return tuple(in_kind_of(child, part) for child, part in zip(space.spaces, batch, strict=True))
    kinds = {"f": "biu", "i": "b", "u": "b"}.get(np.dtype(space.dtype).kind, "")
    cast = isinstance(batch, np.ndarray) and batch.dtype.kind in kinds
    return batch.astype(space.dtype) if cast else batch


def copy_tree(batch: Batch) -> Batch:
    """Return a copy that shares no memory with `batch`."""
    return map_tree(_copy_leaf, batch)


def slice_tree(batch: Batch, rows: slice) -> Batch:
    """Return the given rows of every leaf (a view, as NumPy slices are)."""
    return map_tree(lambda leaf: leaf[rows], batch)


def concatenate_trees(batches: list[Batch]) -> Batch:
    """Join batches of one structure along time."""
    return map_tree(_concatenate_leaves, batches[0], *batches[1:])


def tree_length(batch: Batch) -> int:
    """Return the number of steps of a batch (of its first leaf)."""
    while isinstance(batch, dict | tuple):
        batch = next(iter(batch.values())) if isinstance(batch, dict) else batch[0]
    return len(batch)


def _copy_leaf(leaf: Any) -> Any:
    return leaf.copy() if isinstance(leaf, np.ndarray | list) else leaf


def _concatenate_leaves(*leaves: Any) -> Any:
    if isinstance(leaves[0], list):
        return [item for leaf in leaves for item in leaf]
    return np.concatenate(leaves)


def _shape(space: spaces.Space[Any]) -> tuple[int, ...]:
    return space.shape or ()


def _category_sizes(space: spaces.Space[Any], role: str) -> tuple[int, ...]:
    if isinstance(space, spaces.Box):
        return ()
    if isinstance(space, spaces.Discrete):
        return (int(space.n),)
    if isinstance(space, spaces.MultiDiscrete):
        return tuple(int(n) for n in space.nvec.ravel())
    if isinstance(space, spaces.MultiBinary):
        return (2,) * int(np.prod(_shape(space)))
    raise UnsupportedSpaceError(
        f"The {role} holds {space}, which is not modelled. Box, Discrete, MultiDiscrete, MultiBinary, and Dict and "
        "Tuple of them are; wrap the dataset with count=0 to carry other spaces unchanged."
    )


def _first_values(space: spaces.Space[Any]) -> npt.NDArray[np.int64]:
    start = getattr(space, "start", 0)
    return np.atleast_1d(np.asarray(start, dtype=np.int64)).ravel()


def _leaf_to_columns(leaf: Leaf, values: Batch) -> FloatMatrix:
    rows = np.asarray(values)
    if not leaf.sizes:
        return rows.reshape(len(rows), -1).astype(np.float64)
    codes = rows.reshape(len(rows), -1).astype(np.int64) - _first_values(leaf.space)
    sizes = np.asarray(leaf.sizes)
    if ((codes < 0) | (codes >= sizes)).any():
        row, part = np.argwhere((codes < 0) | (codes >= sizes))[0]
        raise InvalidDataError(
            f"Step {row} holds the value {rows.reshape(len(rows), -1)[row, part]} in {leaf.space}, which is outside it."
        )
    columns = np.zeros((len(rows), leaf.width))
    offsets = np.cumsum((0, *leaf.sizes[:-1]))
    np.put_along_axis(columns, codes + offsets, 1.0, axis=1)
    return columns


def _columns_to_leaf(leaf: Leaf, matrix: npt.NDArray[np.floating[Any]]) -> npt.NDArray[Any]:
    columns = np.asarray(matrix, dtype=np.float64)[:, leaf.start : leaf.start + leaf.width]
    shape = (len(columns), *_shape(leaf.space))
    if isinstance(leaf.space, spaces.Box):
        return _clip_to_box(columns.reshape(shape), leaf.space)
    edges = np.cumsum((0, *leaf.sizes))
    codes = [columns[:, a:b].argmax(axis=1) for a, b in pairwise(edges)]
    values = np.stack(codes, axis=1) + _first_values(leaf.space)
    return values.reshape(shape).astype(leaf.space.dtype)


def _clip_to_box(values: FloatMatrix, box: spaces.Box) -> npt.NDArray[Any]:
    dtype = box.dtype
    if np.issubdtype(dtype, np.integer):
        values = np.rint(values)
    # The cast may round a value over the bound by half a unit in the last place, so the bound is applied after it.
    return np.clip(np.clip(values, box.low, box.high).astype(dtype), box.low, box.high)


def _build(space: spaces.Space[Any], path: tuple[str | int, ...], values: dict[Any, Any]) -> Batch:
    if isinstance(space, spaces.Dict):
        return {key: _build(child, (*path, key), values) for key, child in space.spaces.items()}
    if isinstance(space, spaces.Tuple):
        return tuple(_build(child, (*path, index), values) for index, child in enumerate(space.spaces))
    return values[path]
