"""The block-Toeplitz graphical lasso of many clusters at once, by ADMM (Hallac et al. 2017, section 4.2).

For each cluster: minimise `tr(S X) - log det X + sparsity * sum |X_ij|` over symmetric positive definite X whose
block (i, j) depends on i - j only. The diagonal is penalised too, as in the original TICC.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

_RELAXATION = 1.6
_ADAPT_EVERY = 5


@dataclass(frozen=True)
class Iterates:
    """Where ADMM stands, one entry a cluster: the next call can start from here.

    Attributes:
        sparse: (K, d, d) the Toeplitz iterate Z.
        dual: (K, d, d) the scaled dual U.
        rho: (K,) the step sizes.
    """

    sparse: Floats
    dual: Floats
    rho: Floats


def toeplitz_blocks(matrices: Floats, window: int) -> Floats:
    """Average symmetric (K, d, d) matrices along their block diagonals: (K, window, D, D).

    Entry l is the mean of the blocks (i, i + l). This is the least-squares projection on block-Toeplitz matrices.
    """
    count, size = matrices.shape[:2]
    width = size // window
    grid = matrices.reshape(count, window, width, window, width)
    blocks = np.empty((count, window, width, width))
    for lag in range(window):
        blocks[:, lag] = sum(grid[:, i, :, i + lag] for i in range(window - lag)) / (window - lag)
    blocks[:, 0] = (blocks[:, 0] + blocks[:, 0].transpose(0, 2, 1)) / 2
    return blocks


def toeplitz_matrix(blocks: Floats) -> Floats:
    """Build exactly block-Toeplitz, exactly symmetric (K, d, d) matrices from their (K, window, D, D) blocks."""
    count, window, width = blocks.shape[:3]
    grid = np.empty((count, window, width, window, width))
    for i in range(window):
        for j in range(i, window):
            grid[:, i, :, j] = blocks[:, j - i]
            grid[:, j, :, i] = blocks[:, j - i].transpose(0, 2, 1)
    return grid.reshape(count, window * width, window * width)


def lasso_cost(covariances: Floats, precisions: Floats, sparsity: float) -> Floats:
    """Return the (K,) cost that this module minimises; infinity where the precision is not positive definite."""
    return np.array([_cost(s, x, sparsity) for s, x in zip(covariances, precisions, strict=True)])


def _cost(covariance: Floats, precision: Floats, sparsity: float) -> float:
    try:
        root = np.linalg.cholesky(precision)
    except np.linalg.LinAlgError:
        return np.inf
    log_det = 2 * np.log(np.diag(root)).sum()
    return float((covariance * precision).sum() - log_det + sparsity * np.abs(precision).sum())


def cold_start(covariances: Floats, window: int, sparsity: float) -> Iterates:
    """Return the diagonal starting point; it is exact where a cluster's features are uncorrelated."""
    diagonal = np.diagonal(toeplitz_matrix(toeplitz_blocks(covariances, window)), axis1=1, axis2=2)
    sparse = np.zeros_like(covariances)
    index = np.arange(covariances.shape[1])
    sparse[:, index, index] = 1.0 / (diagonal + sparsity)
    return Iterates(sparse, np.zeros_like(covariances), np.ones(len(covariances)))


def toeplitz_graphical_lasso(
    covariances: Floats,
    *,
    window: int,
    sparsity: float,
    start: Iterates | None = None,
    tolerance: float = 1e-4,
    max_iterations: int = 500,
) -> tuple[Floats, Iterates]:
    """Estimate sparse block-Toeplitz precisions of K clusters at once.

    Clusters leave the batch as they converge. The returned matrices are the sparse iterates of ADMM: exactly
    block-Toeplitz, exactly zero where thresholded, and positive definite (a matrix that is not is pulled towards
    its diagonal until it is).

    Args:
        covariances: (K, d, d) empirical covariances, d = window * D.
        window: number of stacked rows.
        sparsity: weight of the absolute values, > 0.
        start: the iterates of an earlier call on similar covariances.
        tolerance: stop when both residuals are below this share of the iterates' norms.
        max_iterations: at most so many steps; the result is valid wherever it stops.

    Returns:
        (K, d, d) precisions, and the iterates to start the next call from.
    """
    begin = cold_start(covariances, window, sparsity) if start is None else start
    z, u, rho = begin.sparse.copy(), begin.dual.copy(), begin.rho.copy()
    active = np.arange(len(covariances))
    for step in range(1, max_iterations + 1):
        z[active], u[active], (primal, dual) = _admm_step(
            covariances[active], z[active], u[active], rho[active], window=window, sparsity=sparsity
        )
        if step % _ADAPT_EVERY == 0:
            factor = np.clip(np.sqrt(primal / np.maximum(dual, 1e-300)), 0.1, 10.0)
            factor = np.where((factor > 2) | (factor < 0.5), factor, 1.0)
            rho[active] *= factor
            u[active] /= factor[:, None, None]
        active = active[np.maximum(primal, dual) > tolerance]
        if len(active) == 0:
            break
    return _positive_definite(z, covariances, window, sparsity), Iterates(z, u, rho)


def _admm_step(
    s: Floats, z: Floats, u: Floats, rho: Floats, *, window: int, sparsity: float
) -> tuple[Floats, Floats, tuple[Floats, Floats]]:
    """One over-relaxed ADMM step; returns Z, U and the relative primal and dual residuals."""
    r = rho[:, None, None]
    d, q = np.linalg.eigh(r * (z - u) - s)
    x = (q * ((d + np.sqrt(d * d + 4 * rho[:, None])) / (2 * rho[:, None]))[:, None, :]) @ q.transpose(0, 2, 1)
    relaxed = _RELAXATION * x + (1 - _RELAXATION) * z
    mean = toeplitz_blocks(relaxed + u, window)
    threshold = (sparsity / rho)[:, None, None, None]
    new_z = toeplitz_matrix(np.sign(mean) * np.maximum(np.abs(mean) - threshold, 0.0))
    new_u = u + relaxed - new_z
    primal = _norm(x - new_z) / np.maximum(np.maximum(_norm(x), _norm(new_z)), 1e-300)
    dual = _norm(new_z - z) / np.maximum(_norm(new_u), 1e-300)
    return new_z, new_u, (primal, dual)


def _norm(matrices: Floats) -> Floats:
    return np.sqrt((matrices * matrices).sum(axis=(1, 2)))


def _positive_definite(z: Floats, covariances: Floats, window: int, sparsity: float) -> Floats:
    """Pull each matrix towards a positive diagonal, in growing steps, until its Cholesky factor exists."""
    result = z.copy()
    diagonal = cold_start(covariances, window, sparsity).sparse
    for k in range(len(z)):
        weight = 1e-4
        while not np.isfinite(_cost(covariances[k], result[k], sparsity)):
            weight = min(weight * 2, 1.0)
            result[k] = (1 - weight) * z[k] + weight * diagonal[k]
    return result
