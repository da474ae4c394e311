"""What lies near what: nearest points, coverage by balls or by a grid, and exact copies. Pure functions."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from oat_gym.episodes import IntArray
from oat_gym.errors import ConfigurationError, InvalidDataError
from oat_gym.metrics.distances import check_samples, squared_distances
from oat_gym.spaces import FloatMatrix

STEPS_PER_CELL = 10
"""Points that a cell of the grid would hold if all cells held as many."""
_CHUNK = 256


class Coverage(NamedTuple):
    """How two samples share the space.

    `gained`: share of the new points that lie in no cell of the real ones. `lost`: share of the real cells without a
    new point.
    """

    gained: float
    lost: float


def nearest(
    queries: FloatMatrix,
    points: FloatMatrix,
    *,
    query_groups: npt.NDArray[np.integer] | None = None,
    point_groups: npt.NDArray[np.integer] | None = None,
    k: int = 1,
) -> npt.NDArray[np.float64]:
    """Return the distance of each query to its k-th nearest point, (n,); of its own group no point counts.

    Args:
        queries: (n, D).
        points: (m, D).
        query_groups: (n,) group of each query, such as its episode; None: every point counts.
        point_groups: (m,) group of each point.
        k: which neighbour. Where other groups hold fewer than k points, the farthest of them is taken.

    Raises:
        InvalidDataError: where no point of another group is left for a query, or shapes do not agree.
        ConfigurationError: for k under 1.
    """
    check_samples(queries, points)
    if k < 1:
        raise ConfigurationError(f"k must be at least 1, got {k}.")
    found = np.empty(len(queries))
    for start in range(0, len(queries), _CHUNK):
        rows = slice(start, start + _CHUNK)
        squares = squared_distances(queries[rows], points)
        if query_groups is not None and point_groups is not None:
            squares[query_groups[rows, None] == point_groups] = np.inf
        usable = np.isfinite(squares).sum(axis=1)
        if not usable.all():
            raise InvalidDataError("All points are of one group; neighbours in other groups need two groups at least.")
        ranks = np.minimum(k, usable) - 1
        smallest = np.sort(np.partition(squares, min(k, squares.shape[1]) - 1, axis=1)[:, :k], axis=1)
        found[rows] = np.sqrt(np.take_along_axis(smallest, ranks[:, None], axis=1)[:, 0])
    return found


def ball_coverage(new: FloatMatrix, real: FloatMatrix, *, groups: npt.NDArray[np.integer], k: int = 5) -> Coverage:
    """Return the coverage where the cell of a real point is the ball that reaches its k-th real neighbour.

    `gained` is 1 - precision of Kynkäänniemi et al., "Improved precision and recall metric for assessing generative
    models" (NeurIPS 2019), `lost` is 1 - coverage of Naeem et al., "Reliable fidelity and diversity metrics for
    generative models" (ICML 2020). The steps of one episode follow closely on each other, so that a ball counts
    neighbours of other episodes only: `groups` (n,) holds the episode of each real point.

    Raises:
        InvalidDataError: for real points of one group only, or shapes that do not agree.
    """
    radii = nearest(real, real, query_groups=groups, point_groups=groups, k=k)
    inside, covered = np.zeros(len(new), dtype=bool), np.zeros(len(real), dtype=bool)
    # Rounding makes the distance of equal points about 1e-8 of their norm, and discrete points have balls of radius 0.
    slack = 1e-6 * (1 + np.sqrt((real * real).sum(axis=1)))
    for start in range(0, len(new), _CHUNK):
        rows = slice(start, start + _CHUNK)
        within = np.sqrt(squared_distances(new[rows], real)) <= radii + slack
        inside[rows] = within.any(axis=1)
        covered |= within.any(axis=0)
    return Coverage(float(1 - inside.mean()), float(1 - covered.mean()))


def grid_coverage(new: FloatMatrix, real: FloatMatrix, *, bins: int | None = None) -> Coverage:
    """Return the coverage where the cells are those of a grid over the range of the real points; for D of 1 or 2.

    `bins` is the number of cells along each axis, by default as many as give `STEPS_PER_CELL` real points a cell.
    The grid goes on beyond the range.

    Raises:
        InvalidDataError: for shapes that do not agree.
        ConfigurationError: for bins under 1.

    >>> real = np.array([[0.0], [1.0], [2.0], [3.0]])
    >>> grid_coverage(real[:2] - 0.1, real, bins=4)
    Coverage(gained=0.5, lost=0.75)
    """
    check_samples(new, real)
    width = real.shape[1]
    if bins is None:
        bins = max(2, int((len(real) / STEPS_PER_CELL) ** (1 / width)))
    if bins < 1:
        raise ConfigurationError(f"bins must be at least 1, got {bins}.")
    low, span = real.min(axis=0), np.ptp(real, axis=0)
    edge = np.where(span > 0, span, 1.0) / bins
    # The largest value belongs to the last cell, not to one of its own.
    cells = [np.floor((part - low) / edge - np.where(part == low + span, 0.5, 0.0)) for part in (real, new)]
    joined, codes = np.unique(np.concatenate(cells), axis=0, return_inverse=True)
    real_codes, new_codes = np.split(codes.reshape(-1), [len(real)])
    is_real, is_new = np.zeros(len(joined), dtype=bool), np.zeros(len(joined), dtype=bool)
    is_real[real_codes], is_new[new_codes] = True, True
    return Coverage(float(1 - is_real[new_codes].mean()), float(1 - is_new[is_real].mean()))


def copies(new: FloatMatrix, real: FloatMatrix) -> float:
    """Return the share of the rows of `new` that are, to the last bit, rows of `real`."""
    check_samples(new, real)
    known = {row.tobytes() for row in real + 0.0}  # + 0.0 makes -0.0 and 0.0 one value
    return float(np.mean([row.tobytes() in known for row in new + 0.0]))


def other_group_copies(points: FloatMatrix, groups: IntArray) -> float:
    """Return the share of the rows of `points` that are, to the last bit, rows of another group."""
    check_samples(points, points)
    seen: dict[bytes, int] = {}
    shared: set[bytes] = set()
    rows = [row.tobytes() for row in points + 0.0]
    for row, group in zip(rows, groups.tolist(), strict=True):
        if seen.setdefault(row, group) != group:
            shared.add(row)
    return float(np.mean([row in shared for row in rows]))
