"""Distances between two samples of points: Wasserstein by column, sliced Wasserstein, and MMD. Pure functions."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from oat_gym.errors import ConfigurationError, InvalidDataError
from oat_gym.spaces import FloatMatrix

MEDIAN_PAIRS = 1000
"""Points of each sample between which `median_distance` takes all distances; the median changes little beyond."""


def marginal_wasserstein(x: FloatMatrix, y: FloatMatrix) -> npt.NDArray[np.float64]:
    """Return the 1-Wasserstein distance of each column of `x` (n, D) and `y` (m, D), a (D,) array in their units.

    Raises:
        InvalidDataError: for samples that are empty or of different widths.

    >>> marginal_wasserstein(np.zeros((3, 1)), np.full((5, 1), 2.0)).tolist()
    [2.0]
    """
    check_samples(x, y)
    return _transport(x, y, power=1)


def sliced_wasserstein(x: FloatMatrix, y: FloatMatrix, *, rng: np.random.Generator, n_projections: int = 100) -> float:
    """Return the sliced 2-Wasserstein distance of `x` (n, D) and `y` (m, D), in their units.

    The root of the mean, over random directions, of the squared 2-Wasserstein distance of the projections (Rabin et
    al., "Wasserstein barycenter and its application to texture mixing", 2011; Bonneel et al., 2015). A shift of all
    points by a vector v gives about |v| / sqrt(D).

    Raises:
        InvalidDataError: for samples that are empty or of different widths.
        ConfigurationError: for fewer than one projection.

    >>> x = np.arange(4.0)[:, None]
    >>> round(sliced_wasserstein(x, x + 3, rng=np.random.default_rng(0)), 6)
    3.0
    """
    check_samples(x, y)
    if n_projections < 1:
        raise ConfigurationError(f"n_projections must be at least 1, got {n_projections}.")
    directions = rng.normal(size=(x.shape[1], n_projections))
    directions /= np.linalg.norm(directions, axis=0)
    return float(np.sqrt(_transport(x @ directions, y @ directions, power=2).mean()))


def mmd(x: FloatMatrix, y: FloatMatrix, *, bandwidth: float | None = None) -> float:
    """Return the unbiased estimate of the squared maximum mean discrepancy, with kernel exp(-|x-y|^2 / (2 h^2)).

    Gretton et al., "A kernel two-sample test" (JMLR 2012), Lemma 6. Between 0 (one distribution) and 2; being
    unbiased, it falls below 0 about half the time when the distributions are one.

    Args:
        x: (n, D) points, n >= 2.
        y: (m, D) points, m >= 2.
        bandwidth: h; by default the median distance of points of both samples (`median_distance`).

    Raises:
        InvalidDataError: for samples of fewer than two points or of different widths.
        ConfigurationError: for a bandwidth that is not positive.
    """
    check_samples(x, y, least=2)
    h = median_distance(x, y) if bandwidth is None else bandwidth
    if not h > 0:
        raise ConfigurationError(f"bandwidth must be positive, got {h}.")

    def kernel(a: FloatMatrix, b: FloatMatrix) -> FloatMatrix:
        return np.exp(squared_distances(a, b) / (-2 * h * h))

    n, m = len(x), len(y)
    within_x = (kernel(x, x).sum() - n) / (n * (n - 1))
    within_y = (kernel(y, y).sum() - m) / (m * (m - 1))
    return float(within_x + within_y - 2 * kernel(x, y).mean())


def median_distance(x: FloatMatrix, y: FloatMatrix) -> float:
    """Return the median distance of different points of both samples, the usual bandwidth; 1 where that is 0.

    Of a sample with over `MEDIAN_PAIRS` points, as many are taken at even intervals.
    """
    pooled = np.concatenate([part[:: -(-len(part) // MEDIAN_PAIRS)] for part in (x, y)])
    distances = np.sqrt(squared_distances(pooled, pooled)[np.triu_indices(len(pooled), 1)])
    return float(np.median(distances)) or 1.0


def squared_distances(x: FloatMatrix, y: FloatMatrix) -> FloatMatrix:
    """Return the (n, m) squared Euclidean distances of `x` (n, D) and `y` (m, D), not below 0."""
    squares = (x * x).sum(axis=1)[:, None] + (y * y).sum(axis=1) - 2 * (x @ y.T)
    return np.maximum(squares, 0, out=squares)


def check_samples(x: FloatMatrix, y: FloatMatrix, *, least: int = 1) -> None:
    """Raise `InvalidDataError` unless both are matrices of one width with at least `least` rows."""
    if x.ndim != 2 or y.ndim != 2 or x.shape[1] != y.shape[1] or min(len(x), len(y)) < least:
        raise InvalidDataError(
            f"The samples have shapes {x.shape} and {y.shape}; expected (n, D) and (m, D), n and m at least {least}."
        )


def _transport(x: FloatMatrix, y: FloatMatrix, *, power: int) -> npt.NDArray[np.float64]:
    """Return the mean of |x-y|^power under the optimal coupling of each column, which joins equal quantiles."""
    n, m = len(x), len(y)
    # The quantile functions are steps at i/n and j/m: between neighbouring steps of either both are constant.
    edges = np.unique(np.concatenate((np.arange(1, n + 1) * m, np.arange(1, m + 1) * n)))
    weights = np.diff(edges, prepend=0) / (n * m)
    rows_x, rows_y = (edges - 1) // m, (edges - 1) // n
    gaps = np.abs(np.sort(x, axis=0)[rows_x] - np.sort(y, axis=0)[rows_y])
    return weights @ gaps**power
