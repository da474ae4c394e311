"""Coverage and copies on sets made for it."""

import numpy as np
import pytest

from oat_gym.errors import ConfigurationError, InvalidDataError
from oat_gym.metrics import ball_coverage, copies, grid_coverage, nearest
from oat_gym.metrics.neighbors import other_group_copies


def clusters(centers, seed, n=100):
    """n points around each centre, at most 0.5 away in any direction, and their groups, of which each is everywhere."""
    rng = np.random.default_rng(seed)
    points = np.concatenate([np.asarray(center) + rng.uniform(-0.5, 0.5, (n, 3)) for center in centers])
    return points, np.arange(len(points)) % 10


CENTERS = [(0, 0, 0), (10, 0, 0), (0, 10, 0), (0, 0, 10)]


def test_nearest_is_brute_force_without_the_own_group():
    rng = np.random.default_rng(0)
    points, queries = rng.normal(size=(300, 4)), rng.normal(size=(600, 4))
    groups, own = rng.integers(6, size=300), rng.integers(6, size=600)
    distances = np.linalg.norm(queries[:, None] - points, axis=-1)
    np.testing.assert_allclose(nearest(queries, points), distances.min(axis=1), atol=1e-6)
    distances[own[:, None] == groups] = np.inf
    expected = np.sort(distances, axis=1)[:, 2]
    np.testing.assert_allclose(nearest(queries, points, query_groups=own, point_groups=groups, k=3), expected)


def test_nearest_takes_the_farthest_where_other_groups_have_fewer_points():
    points, groups = np.array([[0.0], [1.0], [5.0]]), np.array([0, 0, 1])
    found = nearest(points, points, query_groups=groups, point_groups=groups, k=2)
    np.testing.assert_allclose(found, [5, 4, 5])


def test_nearest_needs_another_group():
    points, groups = np.zeros((3, 1)), np.zeros(3, dtype=int)
    with pytest.raises(InvalidDataError, match="two groups"):
        nearest(points, points, query_groups=groups, point_groups=groups)
    with pytest.raises(ConfigurationError, match="k must be"):
        nearest(points, points, k=0)


def test_balls_half_of_the_real_clusters_are_lost_and_a_third_of_the_new_ones_is_gained():
    real, groups = clusters(CENTERS, seed=0)
    new, _ = clusters([*CENTERS[:2], (50, 50, 50)], seed=1)
    coverage = ball_coverage(new, real, groups=groups, k=10)
    assert coverage.lost == pytest.approx(0.5, abs=0.02)
    assert coverage.gained == pytest.approx(1 / 3, abs=0.05)


def test_balls_of_the_real_points_themselves_lose_and_gain_nothing():
    real, groups = clusters(CENTERS, seed=0)
    assert ball_coverage(real, real, groups=groups) == (0, 0)


def test_balls_reach_other_episodes_not_the_steps_before_and_after():
    """Points of one group are crowded: were they neighbours, the balls would be too small for another draw."""
    rng = np.random.default_rng(0)
    centers = np.linspace(0, 1, 40)[:, None]
    real = (centers + 1e-6 * rng.normal(size=(40, 25))).reshape(-1, 1)
    groups = np.repeat(np.arange(40), 25)
    new = rng.uniform(0.1, 0.9, size=(500, 1))
    assert ball_coverage(new, real, groups=groups).gained < 0.05
    assert ball_coverage(new, real, groups=np.arange(1000)).gained > 0.9


def test_balls_of_discrete_points_have_radius_zero_and_hold_equal_points():
    real = np.eye(3)[[0, 0, 1, 1]] * 7.3 + 1e4
    new = np.eye(3)[[0, 2]] * 7.3 + 1e4
    coverage = ball_coverage(new, real, groups=np.array([0, 1, 0, 1]), k=1)
    assert coverage == (0.5, 0.5)


def test_grid_half_of_the_cells_are_lost():
    ticks = (np.arange(10) + 0.5) / 10
    real = np.stack(np.meshgrid(ticks, ticks), axis=-1).reshape(-1, 2)
    left = real[real[:, 0] < 0.5]
    assert grid_coverage(left, real, bins=10) == (0, pytest.approx(0.5))
    outside = np.concatenate((left, left - np.array([5, 0]), left + np.array([5, 0])))
    assert grid_coverage(outside, real, bins=10) == (pytest.approx(2 / 3), pytest.approx(0.5))


def test_grid_the_largest_real_value_belongs_to_the_last_cell():
    real = np.array([[0.0], [0.9], [1.0]])
    assert grid_coverage(np.array([[0.95]]), real, bins=2) == (0, pytest.approx(0.5))
    assert grid_coverage(real, real) == (0, 0)


def test_grid_of_a_constant_column():
    real = np.stack((np.ones(40), np.linspace(0, 1, 40)), axis=1)
    assert grid_coverage(real, real) == (0, 0)
    assert grid_coverage(real + np.array([3, 0]), real).gained == 1
    with pytest.raises(ConfigurationError, match="bins"):
        grid_coverage(real, real, bins=0)


def test_copies_are_equal_to_the_last_bit():
    real = np.array([[1.0, 0.0], [2.0, 3.0]])
    new = np.array([[1.0, -0.0], [2.0, np.nextafter(3.0, 4.0)], [2.0, 3.0], [0.0, 1.0]])
    assert copies(new, real) == 0.5


def test_steps_found_in_other_episodes():
    points = np.array([[1.0], [1.0], [2.0], [2.0], [3.0]])
    assert other_group_copies(points, np.array([0, 1, 0, 0, 1])) == pytest.approx(0.4)
