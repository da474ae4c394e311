"""DTW against tslearn and against all paths."""

import itertools

import numpy as np
import pytest
import tslearn.metrics as peer

from oat_gym.dtw import dtw, dtw_path
from oat_gym.errors import ConfigurationError, InvalidDataError


def pairs(n: int) -> list[tuple[np.ndarray, np.ndarray, int | None]]:
    rng = np.random.default_rng(0)
    found = []
    for _ in range(n):
        rows, others, width = rng.integers(1, 31, 3)
        radius = None if rng.random() < 0.3 else int(rng.integers(0, 12))
        found.append((rng.normal(size=(rows, width)), rng.normal(size=(others, width)), radius))
    return found


def test_distances_and_paths_are_those_of_tslearn() -> None:
    for x, y, radius in pairs(150):
        band = {} if radius is None else {"global_constraint": "sakoe_chiba", "sakoe_chiba_radius": radius}
        expected_path, expected = peer.dtw_path(x, y, **band)
        path, distance = dtw_path(x, y, radius=radius)
        assert distance == pytest.approx(expected, abs=1e-9)
        assert dtw(x, y, radius=radius) == distance
        assert path.tolist() == [list(pair) for pair in expected_path]


def test_the_path_costs_the_distance_and_is_a_path() -> None:
    for x, y, radius in pairs(60):
        path, distance = dtw_path(x, y, radius=radius)
        cost = ((x[path[:, 0]] - y[path[:, 1]]) ** 2).sum()
        assert np.sqrt(cost) == pytest.approx(distance, rel=1e-12)
        assert path[0].tolist() == [0, 0]
        assert path[-1].tolist() == [len(x) - 1, len(y) - 1]
        assert {tuple(step) for step in np.diff(path, axis=0)} <= {(0, 1), (1, 0), (1, 1)}
        if radius is not None:
            gap = (path[:, 0] - path[:, 1]) * (1 if len(x) >= len(y) else -1)
            assert gap.min() >= -radius
            assert gap.max() <= abs(len(x) - len(y)) + radius


def test_it_is_symmetric_and_zero_for_a_series_and_itself() -> None:
    for x, y, radius in pairs(60):
        assert dtw(x, y, radius=radius) == dtw(y, x, radius=radius)
        assert dtw(x, x, radius=radius) == 0.0
        diagonal = [[i, i] for i in range(len(x))]
        assert dtw_path(x, x, radius=radius)[0].tolist() == diagonal
        assert dtw(x, np.repeat(x, 2, axis=0)) == 0.0  # each row held for two steps


def test_no_path_is_better() -> None:
    rng = np.random.default_rng(1)
    x, y = rng.normal(size=(4, 2)), rng.normal(size=(5, 2))
    cost = ((x[:, None] - y[None]) ** 2).sum(axis=2)

    def least(i: int, j: int) -> float:
        if (i, j) == (3, 4):
            return cost[i, j]
        steps = [(i + a, j + b) for a, b in ((0, 1), (1, 0), (1, 1)) if i + a < 4 and j + b < 5]
        return cost[i, j] + min(itertools.starmap(least, steps))

    assert dtw(x, y) ** 2 == pytest.approx(least(0, 0), rel=1e-12)


@pytest.mark.parametrize(
    ("x", "y", "message"),
    [
        (np.zeros((0, 2)), np.zeros((3, 2)), "at least one row"),
        (np.zeros((3, 2)), np.zeros((3, 1)), r"\(3, 2\) and \(3, 1\)"),
        (np.zeros(3), np.zeros(3), r"one feature is \(n, 1\)"),
        (np.full((2, 1), np.nan), np.zeros((2, 1)), "NaN or infinity"),
    ],
)
def test_series_that_cannot_be_aligned_are_refused(x: np.ndarray, y: np.ndarray, message: str) -> None:
    with pytest.raises(InvalidDataError, match=message):
        dtw_path(x, y)


def test_a_bad_radius_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="radius must be"):
        dtw(np.zeros((2, 1)), np.zeros((2, 1)), radius=-1)
    assert dtw(np.full((2, 1), 1e308), np.full((2, 1), 1e308)) == 0.0


def test_a_value_that_is_not_finite_is_found_wherever_it_is() -> None:
    rng = np.random.default_rng(2)
    for bad in (np.nan, np.inf, -np.inf):
        for row in range(5):
            x, y = rng.normal(size=(5, 3)), rng.normal(size=(7, 3))
            x[row, row % 3] = bad
            for pair in ((x, y), (y, x)):
                for call in (dtw, dtw_path):
                    with pytest.raises(InvalidDataError, match="NaN or infinity"):
                        call(*pair, radius=1)
