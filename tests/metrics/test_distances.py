"""Distances against closed forms and against scipy."""

import numpy as np
import pytest
from scipy.stats import wasserstein_distance

from oat_gym.errors import ConfigurationError, InvalidDataError
from oat_gym.metrics import marginal_wasserstein, mmd, sliced_wasserstein


def rng(seed=0):
    return np.random.default_rng(seed)


def test_wasserstein_of_each_column_is_scipys_for_unequal_sizes():
    x, y = rng(1).normal(size=(37, 3)), rng(2).exponential(size=(50, 3))
    expected = [wasserstein_distance(x[:, d], y[:, d]) for d in range(3)]
    np.testing.assert_allclose(marginal_wasserstein(x, y), expected, rtol=1e-12)


def test_wasserstein_of_shifted_gaussians_is_the_shift():
    x, y = rng(1).normal(size=(20_000, 2)), rng(2).normal((1.5, -0.7), 1, size=(20_000, 2))
    np.testing.assert_allclose(marginal_wasserstein(x, y), [1.5, 0.7], atol=0.04)


def test_wasserstein_of_scaled_gaussians():
    """W1 of N(0, 1) and N(0, s^2) is (s - 1) E|N(0, 1)|."""
    x, y = rng(1).normal(size=(20_000, 1)), 3 * rng(2).normal(size=(20_000, 1))
    assert marginal_wasserstein(x, y)[0] == pytest.approx(2 * np.sqrt(2 / np.pi), abs=0.05)


def test_distances_of_a_sample_to_itself_in_another_order_are_zero():
    x = rng().normal(size=(200, 4))
    y = rng(5).permutation(x)
    np.testing.assert_array_equal(marginal_wasserstein(x, y), 0)
    assert sliced_wasserstein(x, y, rng=rng()) < 1e-12
    assert mmd(x, y) < 0  # unbiased: the pairs of equal points, left out within, count across


def test_sliced_wasserstein_of_a_shift_is_its_length_over_the_root_of_the_dimension():
    x, shift = rng().normal(size=(500, 6)), np.array([3.0, 0, -4.0, 0, 0, 0])
    found = sliced_wasserstein(x, x + shift, rng=rng(1), n_projections=5000)
    assert found == pytest.approx(5 / np.sqrt(6), rel=0.03)


def test_sliced_wasserstein_of_scaled_isotropic_gaussians():
    """Every projection has W2(N(0, 1), N(0, s^2)) = s - 1."""
    x, y = rng(1).normal(size=(8000, 3)), 2.5 * rng(2).normal(size=(4000, 3))
    assert sliced_wasserstein(x, y, rng=rng(3)) == pytest.approx(1.5, abs=0.06)


def test_mmd_is_unbiased_when_the_distributions_are_one():
    values = np.array([mmd(*rng(seed).normal(size=(2, 40, 2)), bandwidth=1.0) for seed in range(300)])
    standard_error = values.std() / np.sqrt(len(values))
    assert abs(values.mean()) < 3 * standard_error
    assert (values < 0).any()
    biased = values + 2 / 40 * 0.8  # what the biased estimate adds, roughly: the test would see it
    assert abs(biased.mean()) > 3 * standard_error


def test_mmd_of_gaussians_is_the_closed_form():
    """With kernel width h, N(0, I) and N(m, I) in D dimensions: 2 (h^2/(h^2+2))^(D/2) (1 - exp(-|m|^2/(2(h^2+2))))."""
    h, shift, d = 1.3, np.array([0.8, -0.5]), 2
    x, y = rng(1).normal(size=(3000, d)), rng(2).normal(size=(3000, d)) + shift
    expected = 2 * (h**2 / (h**2 + 2)) ** (d / 2) * (1 - np.exp(-(shift @ shift) / (2 * (h**2 + 2))))
    assert mmd(x, y, bandwidth=h) == pytest.approx(expected, rel=0.1)


def test_the_default_bandwidth_is_the_median_distance():
    x, y = rng(1).normal(size=(60, 2)), rng(2).normal(size=(40, 2)) + 1
    pooled = np.concatenate((x, y))
    distances = np.linalg.norm(pooled[:, None] - pooled, axis=-1)[np.triu_indices(100, 1)]
    assert mmd(x, y) == pytest.approx(mmd(x, y, bandwidth=float(np.median(distances))), rel=1e-9)


def test_equal_points_have_distance_zero_and_no_division_by_it():
    assert mmd(np.ones((5, 2)), np.ones((4, 2))) == pytest.approx(0)


def test_wrong_samples_are_refused():
    one, two = np.zeros((3, 1)), np.zeros((3, 2))
    with pytest.raises(InvalidDataError, match=r"shapes \(3, 1\) and \(3, 2\)"):
        marginal_wasserstein(one, two)
    with pytest.raises(InvalidDataError, match="at least 1"):
        sliced_wasserstein(one[:0], one, rng=rng())
    with pytest.raises(InvalidDataError, match="at least 2"):
        mmd(one[:1], one)
    with pytest.raises(ConfigurationError, match="bandwidth must be positive"):
        mmd(one, one, bandwidth=0.0)
    with pytest.raises(ConfigurationError, match="n_projections"):
        sliced_wasserstein(one, one, rng=rng(), n_projections=0)
