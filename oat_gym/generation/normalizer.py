"""Z-scores of the real-valued columns of a flat feature matrix."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from oat_gym.spaces import FloatMatrix, Layout

CONSTANT = 1e-10
"""A column whose spread is below this share of its size is constant up to rounding."""


@dataclass(frozen=True)
class Normalizer:
    """An affine change of units of each column: mean 0 and standard deviation 1 on the data it was fitted to.

    Constant columns get scale 1 (their z-score is 0); one-hot columns keep their values.

    Attributes:
        mean: (width,) mean, 0 for one-hot columns.
        scale: (width,) standard deviation, 1 for one-hot and constant columns.

    >>> normalizer = Normalizer.fit(np.array([[1.0, 5.0], [3.0, 5.0]]), Layout(2, (0, 1), ()))
    >>> normalizer.normalize(np.array([[3.0, 5.0]])).tolist()
    [[1.0, 0.0]]
    """

    mean: npt.NDArray[np.float64]
    scale: npt.NDArray[np.float64]

    @classmethod
    def fit(cls, rows: FloatMatrix, layout: Layout) -> Normalizer:
        """Return the normaliser of an (n, width) matrix."""
        mean, scale = np.zeros(layout.width), np.ones(layout.width)
        columns = list(layout.continuous)
        mean[columns] = rows[:, columns].mean(axis=0)
        spread = rows[:, columns].std(axis=0)
        constant = spread <= CONSTANT * np.abs(rows[:, columns]).max(axis=0)
        scale[columns] = np.where(constant, 1.0, spread)
        return cls(mean, scale)

    def normalize(self, values: npt.NDArray[np.floating[Any]]) -> FloatMatrix:
        """Return the z-scores of (..., width) values."""
        return (np.asarray(values, dtype=np.float64) - self.mean) / self.scale

    def denormalize(self, values: npt.NDArray[np.floating[Any]]) -> FloatMatrix:
        """Return (..., width) z-scores in their original units."""
        return np.asarray(values, dtype=np.float64) * self.scale + self.mean

    def to_arrays(self, prefix: str) -> dict[str, npt.NDArray[Any]]:
        """Return the two arrays under names that start with `prefix`."""
        return {f"{prefix}.mean": self.mean.copy(), f"{prefix}.scale": self.scale.copy()}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, npt.NDArray[Any]], prefix: str) -> Normalizer:
        """Return the normaliser that `to_arrays` wrote."""
        return cls(np.array(arrays[f"{prefix}.mean"]), np.array(arrays[f"{prefix}.scale"]))


def layout_to_arrays(layout: Layout, prefix: str) -> dict[str, npt.NDArray[Any]]:
    """Return a `Layout` as integer arrays, for storage."""
    return {
        f"{prefix}.width": np.array([layout.width], dtype=np.int64),
        f"{prefix}.continuous": np.array(layout.continuous, dtype=np.int64),
        f"{prefix}.categorical": np.array(layout.categorical, dtype=np.int64).reshape(-1, 2),
    }


def layout_from_arrays(arrays: Mapping[str, npt.NDArray[Any]], prefix: str) -> Layout:
    """Return the `Layout` that `layout_to_arrays` wrote."""
    return Layout(
        int(arrays[f"{prefix}.width"][0]),
        tuple(int(column) for column in arrays[f"{prefix}.continuous"]),
        tuple((int(start), int(stop)) for start, stop in arrays[f"{prefix}.categorical"]),
    )
