"""The two optimisers inside TICC: Viterbi against brute force, ADMM against the optimality conditions."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.covariance import graphical_lasso

from oat_gym.mining._toeplitz import lasso_cost, toeplitz_blocks, toeplitz_graphical_lasso, toeplitz_matrix
from oat_gym.mining._viterbi import path_score, viterbi


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 6), st.integers(1, 3), st.integers(1, 3))
def test_viterbi_equals_brute_force(seed, n, clusters, n_series):
    rng = np.random.default_rng(seed)
    scores, penalties = rng.normal(size=(n, clusters)), rng.exponential(size=n)
    starts = np.unique(np.r_[0, rng.integers(n, size=n_series - 1)])
    labels, best = viterbi(scores, penalties, starts)
    every = [path_score(scores, penalties, starts, np.array(path)) for path in product(range(clusters), repeat=n)]
    assert best == pytest.approx(max(every))
    assert path_score(scores, penalties, starts, labels) == pytest.approx(best)


def test_no_penalty_is_paid_between_series():
    scores = np.array([[5.0, 0.0], [5.0, 0.0], [0.0, 5.0]])
    assert viterbi(scores, np.full(3, 100.0), np.array([0, 2]))[0].tolist() == [0, 0, 1]
    assert viterbi(scores, np.full(3, 100.0), np.array([0]))[0].tolist() == [0, 0, 0]


def covariances(seed: int, size: int, count: int = 3) -> np.ndarray:
    x = np.random.default_rng(seed).normal(size=(count, 4 * size, size))
    x[:, :, 1:] += 0.7 * x[:, :, :-1]
    return np.stack([np.cov(item.T) for item in x])


def test_toeplitz_projection_keeps_toeplitz_matrices_and_is_least_squares():
    s = covariances(0, 6)
    projected = toeplitz_matrix(toeplitz_blocks(s, 3))
    assert np.allclose(toeplitz_matrix(toeplitz_blocks(projected, 3)), projected)
    other = toeplitz_matrix(toeplitz_blocks(covariances(1, 6), 3))
    inner = ((s - projected) * (other - projected)).sum(axis=(1, 2))
    assert inner == pytest.approx(np.zeros(3), abs=1e-9)


@pytest.mark.parametrize("window", [1, 2, 3])
@pytest.mark.parametrize("sparsity", [0.05, 0.3])
def test_admm_meets_the_optimality_conditions(window, sparsity):
    s = covariances(2, 6)
    x, _ = toeplitz_graphical_lasso(s, window=window, sparsity=sparsity, tolerance=1e-9, max_iterations=5000)
    # 0 is in the mean over equal entries of S - X^-1 + sparsity * sign(X)
    gradient = toeplitz_blocks(s - np.linalg.inv(x), window)
    entries = toeplitz_blocks(x, window)
    on = entries != 0
    assert np.allclose(gradient[on], -sparsity * np.sign(entries[on]), atol=1e-6)
    assert np.all(np.abs(gradient[~on]) <= sparsity + 1e-6)
    assert on.mean() < 1.0


def test_window_one_agrees_with_sklearn():
    s = covariances(3, 8)
    sparsity = 0.2
    x, _ = toeplitz_graphical_lasso(s, window=1, sparsity=sparsity, tolerance=1e-9, max_iterations=5000)
    for k in range(3):  # scikit-learn leaves the diagonal unpenalised: add its penalty to the covariance
        _, expected = graphical_lasso(s[k] + sparsity * np.eye(8), sparsity, tol=1e-8, enet_tol=1e-8, max_iter=500)
        assert np.allclose(x[k], expected, atol=1e-4)


def test_stopping_early_still_gives_toeplitz_positive_definite_matrices():
    s = covariances(4, 6)
    s[0] = 0.0
    s[1] = np.outer(np.arange(6.0), np.arange(6.0))
    for steps in (1, 2, 5):
        x, _ = toeplitz_graphical_lasso(s, window=2, sparsity=0.1, max_iterations=steps)
        assert np.linalg.eigvalsh(x).min() > 0
        assert np.array_equal(x[:, :3, :3], x[:, 3:, 3:])


def test_a_warm_start_reaches_the_same_optimum():
    s = covariances(5, 6)
    cold, state = toeplitz_graphical_lasso(s, window=2, sparsity=0.1, tolerance=1e-7, max_iterations=3000)
    warm, _ = toeplitz_graphical_lasso(1.01 * s, window=2, sparsity=0.1, start=state, tolerance=1e-7)
    fresh, _ = toeplitz_graphical_lasso(1.01 * s, window=2, sparsity=0.1, tolerance=1e-7, max_iterations=3000)
    assert lasso_cost(1.01 * s, warm, 0.1) == pytest.approx(lasso_cost(1.01 * s, fresh, 0.1), rel=1e-6)
    assert not np.allclose(cold, fresh, atol=1e-6)
