"""Dynamic time warping of multivariate series inside a Sakoe-Chiba band: distance and path.

Sakoe and Chiba, "Dynamic programming algorithm optimization for spoken word recognition", IEEE Transactions on
Acoustics, Speech and Signal Processing 26, 1978: symmetric steps (1, 0), (0, 1), (1, 1) of equal weight, whole
series aligned from the first rows to the last ones.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit

from oat_gym.errors import ConfigurationError, InvalidDataError

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]


def dtw(x: npt.NDArray[np.floating[Any]], y: npt.NDArray[np.floating[Any]], *, radius: int | None = None) -> float:
    """Return the DTW distance of two series: the root of the least sum of squared Euclidean distances along a path.

    It is symmetric, and zero for equal series (not only for them: it is no metric).

    Args:
        x: (n, D) rows, finite.
        y: (m, D) rows in the same units, finite; n and m may differ.
        radius: half width of the band in steps. Row i of the longer series may meet row j of the shorter one where
            -radius <= i - j <= |n - m| + radius, so that a path exists for any two lengths. None: no band.

    Raises:
        InvalidDataError: for a series without rows, of another width than the other one, or with NaN or infinity.
        ConfigurationError: for a negative radius.

    >>> dtw(np.array([[0.0], [1.0]]), np.array([[0.0], [0.0], [1.0]]))
    0.0
    """
    rows = _series(x, y)
    total = _accumulate(*rows, _radius(radius, len(x), len(y)), 4)
    return _distance(float(total[len(x) % 4, len(y)]), rows)


def dtw_path(
    x: npt.NDArray[np.floating[Any]], y: npt.NDArray[np.floating[Any]], *, radius: int | None = None
) -> tuple[IntArray, float]:
    """Return the best path, (L, 2) pairs of a row of `x` and a row of `y`, and the distance; see `dtw`.

    The path starts at (0, 0), ends at (n-1, m-1), and moves by at most one row in each series: L is between
    max(n, m) and n + m - 1. Of equally good predecessors the diagonal one is taken, then the step in `x` alone.

    >>> dtw_path(np.array([[0.0], [1.0]]), np.array([[0.0], [0.0], [1.0]]))[0].tolist()
    [[0, 0], [0, 1], [1, 2]]
    """
    rows = _series(x, y)
    total = _accumulate(*rows, _radius(radius, len(x), len(y)), len(x) + 2)
    distance = _distance(float(total[len(x), len(y)]), rows)
    return _trace(total, len(x)), distance


def _series(x: npt.NDArray[np.floating[Any]], y: npt.NDArray[np.floating[Any]]) -> tuple[FloatArray, FloatArray]:
    rows = np.ascontiguousarray(x, dtype=np.float64), np.ascontiguousarray(y, dtype=np.float64)
    shapes = rows[0].shape, rows[1].shape
    if any(len(shape) != 2 or shape[0] < 1 for shape in shapes) or shapes[0][1] != shapes[1][1]:
        raise InvalidDataError(
            f"DTW takes two series of at least one row and of one width, (n, D) and (m, D); got {shapes[0]} and "
            f"{shapes[1]}. A series of one feature is (n, 1)."
        )
    return rows


def _distance(cost: float, rows: tuple[FloatArray, FloatArray]) -> float:
    # Every path meets every row, so a value that is not finite shows in the result, and only then need be looked for.
    if not math.isfinite(cost) and not all(np.isfinite(part).all() for part in rows):
        raise InvalidDataError("DTW takes finite numbers, got NaN or infinity: repair or drop those rows first.")
    return math.sqrt(cost)


def _radius(radius: int | None, n: int, m: int) -> int:
    if radius is None:
        return max(n, m)
    if isinstance(radius, bool) or not isinstance(radius, int | np.integer) or radius < 0:
        raise ConfigurationError(f"radius must be an integer of at least 0 or None (no band), got {radius!r}.")
    return int(radius)


# Compiled when first called; not cached on disk, since packages may lie in read-only folders. Of the fast-math flags
# only "contract" is on (one rounding for a * b + c): sums in another order would make ties, and so paths and lengths,
# depend on the processor.
@njit(nogil=True, fastmath={"contract"})
def _set_costs(  # noqa: PLR0917  (compiled functions take no keywords at no cost)
    x0: FloatArray, x1: FloatArray, columns: FloatArray, low: int, cost0: FloatArray, cost1: FloatArray
) -> None:
    """Write the squared Euclidean distances of two rows (D,) to columns[:, low:low+w] into two arrays (w,).

    Two rows and four features at a time, so that what is read is used eight times while it is in registers.
    """
    cost0[:] = 0.0
    cost1[:] = 0.0
    D, high = len(x0), low + len(cost0)
    for d in range(0, D - D % 4, 4):
        a0, a1, a2, a3 = x0[d], x0[d + 1], x0[d + 2], x0[d + 3]
        b0, b1, b2, b3 = x1[d], x1[d + 1], x1[d + 2], x1[d + 3]
        y0, y1 = columns[d][low:high], columns[d + 1][low:high]
        y2, y3 = columns[d + 2][low:high], columns[d + 3][low:high]
        for j in range(len(cost0)):
            g0, g1, g2, g3 = a0 - y0[j], a1 - y1[j], a2 - y2[j], a3 - y3[j]
            h0, h1, h2, h3 = b0 - y0[j], b1 - y1[j], b2 - y2[j], b3 - y3[j]
            cost0[j] = (((cost0[j] + g0 * g0) + g1 * g1) + g2 * g2) + g3 * g3
            cost1[j] = (((cost1[j] + h0 * h0) + h1 * h1) + h2 * h2) + h3 * h3
    for d in range(D - D % 4, D):
        a0, b0, y0 = x0[d], x1[d], columns[d][low:high]
        for j in range(len(cost0)):
            g0, h0 = a0 - y0[j], b0 - y0[j]
            cost0[j] += g0 * g0
            cost1[j] += h0 * h0


@njit(nogil=True)
def _add_two_rows(
    above: FloatArray, first: FloatArray, second: FloatArray, cost0: FloatArray, cost1: FloatArray
) -> None:
    """Fill two rows of least costs (w+1,) from the row above them and their costs (w,); entry 0 is left as it is.

    The second row runs one column behind the first: two chains of dependent sums at a time hide each other's latency.
    """
    w = len(cost0)
    value0, value1 = first[0], second[0]
    corner = value0
    for j in range(1, w + 2):
        left = value0
        if j <= w:
            best = above[j - 1] if above[j - 1] <= above[j] else above[j]
            value0 = cost0[j - 1] + (best if best <= left else left)
            first[j] = value0
        if j >= 2:
            best = corner if corner <= left else left
            value1 = cost1[j - 2] + (best if best <= value1 else value1)
            second[j - 1] = value1
            corner = left


@njit(nogil=True)
def _accumulate(x: FloatArray, y: FloatArray, radius: int, kept: int) -> FloatArray:
    """Return the least cost of a path to each pair (i, j) as total[(i+1) % kept, j+1]; infinite outside the band.

    Row and column 0 are a border of infinities around the start; an odd n gets one row too many at the end. `kept`
    is the number of rows: n + 2 or more for all of them, or 4 for the last ones.
    """
    n, m = len(x), len(y)
    columns = np.ascontiguousarray(y.T)  # a feature's values side by side, so that the inner loop runs in SIMD lanes
    before, after = radius + max(0, n - m), radius + max(0, m - n)
    total = np.full((kept, m + 1), np.inf)
    total[0, 0] = 0.0
    cost0, cost1 = np.empty(m), np.empty(m)
    for i in range(0, n, 2):
        low, high = max(0, i - before), min(m, i + after + 2)
        w = high - low
        _set_costs(x[i], x[min(i + 1, n - 1)], columns, low, cost0[:w], cost1[:w])
        cost0[min(m, i + after + 1) - low : w] = np.inf  # of the two rows' columns, those outside a row's own band
        cost1[: max(0, i + 1 - before) - low] = np.inf
        above, first, second = total[i % kept], total[(i + 1) % kept], total[(i + 2) % kept]
        if i + 2 >= kept:
            first[:] = np.inf
            second[:] = np.inf
        stop = high + 1
        _add_two_rows(above[low:stop], first[low:stop], second[low:stop], cost0[:w], cost1[:w])
    return total


@njit(nogil=True)
def _trace(total: FloatArray, n: int) -> IntArray:
    """Return the path to the last of n rows that `_accumulate` found, from its end back to its start, in order."""
    i, j = n, total.shape[1] - 1
    path = np.empty((i + j - 1, 2), dtype=np.int64)
    first = len(path) - 1
    path[first, 0], path[first, 1] = i - 1, j - 1
    while i > 1 or j > 1:
        diagonal, up, left = total[i - 1, j - 1], total[i - 1, j], total[i, j - 1]
        if diagonal <= up and diagonal <= left:
            i, j = i - 1, j - 1
        elif up <= left:
            i -= 1
        else:
            j -= 1
        first -= 1
        path[first, 0], path[first, 1] = i - 1, j - 1
    return path[first:].copy()
