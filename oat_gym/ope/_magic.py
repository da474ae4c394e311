"""The blend of partial importance sampling estimators of MAGIC (Thomas and Brunskill, 2016)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from oat_gym.episodes import IntArray

FloatArray = npt.NDArray[np.float64]


def blend_weights(partial: FloatArray, interval: tuple[float, float]) -> FloatArray:
    """Return x (J,), not negative and of sum 1, which minimises the estimated mean squared error of sum_j x_j g_j.

    That is x' (Omega + b b') x: Omega the covariance of the partial estimates g_j, b_j the distance of g_j to a
    confidence interval of the last one, which uses no action values beyond its control variates.

    Args:
        partial: (E, J) what each episode adds to each partial estimate; g is the sum over episodes.
        interval: least and greatest value of the last partial estimate.
    """
    estimates, n = partial.sum(axis=0), len(partial)
    centred = partial - partial.mean(axis=0)
    covariance = centred.T @ centred * (n / max(n - 1, 1))
    bias = np.maximum(interval[0] - estimates, 0.0) + np.maximum(estimates - interval[1], 0.0)
    return simplex_minimum(covariance + np.outer(bias, bias))


def bias_interval(value: float, replicates: FloatArray) -> tuple[float, float]:
    """Return the interval that biases are measured to: from the 5% to the 95% quantile of the (B,) replicates.

    It is widened to hold the estimate itself. Replicates that are not finite are left out.
    """
    finite = replicates[np.isfinite(replicates)]
    if not len(finite):
        return value, value
    low, high = np.quantile(finite, (0.05, 0.95))
    return float(min(low, value)), float(max(high, value))


def partial_lengths(n_steps: int, count: int) -> IntArray:
    """Return at most `count` numbers of weighted steps: 0 (action values alone) to all of them, evenly spread."""
    return np.unique(np.rint(np.linspace(0, n_steps, min(count, n_steps + 1))).astype(np.int64))


def step_shares(x: FloatArray, lengths: IntArray, n_steps: int) -> FloatArray:
    """Return (n_steps,): at each step the weight of the partial estimates that count it."""
    return np.array([x[lengths > t].sum() for t in range(n_steps)])


def simplex_minimum(matrix: FloatArray) -> FloatArray:
    """Return the x that minimises x' A x over x >= 0 with sum 1, for a positive semi-definite A (Wolfe, 1976).

    >>> simplex_minimum(np.diag([1.0, 3.0])).round(6).tolist()
    [0.75, 0.25]
    """
    scale = float(np.trace(matrix)) / len(matrix)
    if not scale > 0:
        return np.eye(len(matrix))[-1]
    matrix = matrix / scale + 1e-10 * np.eye(len(matrix))
    x = np.eye(len(matrix))[int(np.diag(matrix).argmin())]
    support = x > 0
    for _ in range(100 * len(matrix)):
        gradient = matrix @ x
        best = int(gradient.argmin())
        if support[best] or gradient[best] >= x @ gradient - 1e-12:
            break
        support[best] = True
        x = _descend(matrix, x, support)
        support = x > 0
    return x


def _descend(matrix: FloatArray, x: FloatArray, support: npt.NDArray[np.bool_]) -> FloatArray:
    """Go to the minimum over the plane of `support`, dropping the members that would become negative."""
    support = support.copy()
    while True:
        aim = np.zeros_like(x)
        aim[support] = np.linalg.solve(matrix[np.ix_(support, support)], np.ones(int(support.sum())))
        aim /= aim.sum()
        falling = support & (aim <= 0)
        if not falling.any():
            return aim
        reach = x[falling] / (x[falling] - aim[falling])
        x = np.where(support, x + reach.min() * (aim - x), 0.0)
        support[np.flatnonzero(falling)[reach.argmin()]] = False
        x[~support] = 0.0
