"""The EM loop of TICC: graphical lasso per cluster, then the best labels, never letting the objective fall."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from oat_gym.mining._toeplitz import Iterates, cold_start, lasso_cost, toeplitz_graphical_lasso
from oat_gym.mining._viterbi import path_score, viterbi

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Progress = Callable[[str, int, int], None]

_RESEED_ROWS = 20
_RESEED_ATTEMPTS = 3
_COARSE, _FINE = 1e-2, 1e-3  # relative residuals of ADMM while labels move, and before the loop may end
_COARSE_STEPS = 10
_MIN_GAIN = 1e-7
_CHUNK = 16_384


@dataclass(frozen=True)
class Problem:
    """The data and settings of one fit: (n, d) windows, (n,) penalties, (N,) first rows, and the numbers."""

    windows: Floats
    penalties: Floats
    starts: Ints
    n_clusters: int
    window: int
    sparsity: float


@dataclass(frozen=True)
class State:
    """Clusters, the labels that are best under them, and their objective.

    Attributes:
        labels: (n,) labels.
        means: (C, d) cluster means.
        precisions: (C, d, d) block-Toeplitz precisions.
        scores: (n, C) log-likelihood of each row under each cluster.
        iterates: where each cluster's ADMM stands.
        fitted: (n,) the labels that the clusters were fitted to (-1: none).
        tolerance: the ADMM tolerance of the last fit.
        objective: the objective of `labels` under these clusters.
    """

    labels: Ints
    means: Floats
    precisions: Floats
    scores: Floats
    iterates: Iterates
    fitted: Ints
    tolerance: float
    objective: float


def row_scores(windows: Floats, mean: Floats, precision: Floats) -> Floats:
    """Return the (n,) Gaussian log-likelihoods of the windows (the first term of the paper's Eq. 2)."""
    root = np.linalg.cholesky(precision)
    shift = mean @ root
    constant = np.log(np.diag(root)).sum() - 0.5 * len(mean) * np.log(2 * np.pi)
    scores = np.empty(len(windows))
    for begin in range(0, len(windows), _CHUNK):  # bounds the memory of the product
        whitened = windows[begin : begin + _CHUNK] @ root - shift
        scores[begin : begin + _CHUNK] = constant - 0.5 * np.einsum("ij,ij->i", whitened, whitened)
    return scores


def score_table(windows: Floats, means: Floats, precisions: Floats) -> Floats:
    """Return the (n, C) scores of every row under every cluster."""
    columns = [row_scores(windows, m, p) for m, p in zip(means, precisions, strict=True)]
    return np.stack(columns, axis=1)


def first_state(problem: Problem, labels: Ints) -> State:
    """Fit clusters to initial labels and take the best labels under them.

    A cluster without a row starts as the Gaussian of all rows.
    """
    x = problem.windows
    covariance = np.cov(x, rowvar=False, bias=True).reshape(1, x.shape[1], x.shape[1])
    everywhere, _ = toeplitz_graphical_lasso(covariance, window=problem.window, sparsity=problem.sparsity)
    n, size, count = len(x), x.shape[1], problem.n_clusters
    begin = cold_start(np.repeat(covariance, count, axis=0), problem.window, problem.sparsity)
    scores = np.repeat(row_scores(x, x.mean(axis=0), everywhere[0])[:, None], count, axis=1)
    blank = State(
        labels=labels,
        means=np.repeat(x.mean(axis=0)[None], count, axis=0),
        precisions=np.broadcast_to(everywhere, (count, size, size)).copy(),
        scores=scores,
        iterates=begin,
        fitted=np.full(n, -1, dtype=np.int64),
        tolerance=np.inf,
        objective=-np.inf,
    )
    return advance(problem, blank, tolerance=_COARSE)


def advance(problem: Problem, state: State, *, tolerance: float) -> State:
    """One EM iteration: refit the clusters whose rows changed, then find the best labels."""
    changed = _clusters_to_fit(state, problem.n_clusters, tolerance)
    fitted = _fit_clusters(problem, state, changed, tolerance)
    labels, objective = viterbi(fitted.scores, problem.penalties, problem.starts)
    return replace(fitted, labels=labels, objective=objective)


def _clusters_to_fit(state: State, n_clusters: int, tolerance: float) -> Ints:
    alive = np.bincount(state.labels, minlength=n_clusters) > 0
    if tolerance < state.tolerance:
        return np.flatnonzero(alive)
    moved = state.labels != state.fitted
    touched = np.zeros(n_clusters, dtype=np.bool_)
    touched[state.labels[moved]] = True
    touched[state.fitted[moved]] = True
    return np.flatnonzero(alive & touched)


def _fit_clusters(problem: Problem, state: State, clusters: Ints, tolerance: float) -> State:
    """The M step. A cluster keeps its precision where ADMM, which is approximate, has found no better one."""
    means, precisions, scores = state.means.copy(), state.precisions.copy(), state.scores.copy()
    z, u, rho = state.iterates.sparse.copy(), state.iterates.dual.copy(), state.iterates.rho.copy()
    if len(clusters):
        members = [problem.windows[state.labels == c] for c in clusters]
        means[clusters] = [rows.mean(axis=0) for rows in members]
        covariances = np.stack([_covariance(rows) for rows in members])
        found, iterates = toeplitz_graphical_lasso(
            covariances,
            window=problem.window,
            sparsity=problem.sparsity,
            start=Iterates(z[clusters], u[clusters], rho[clusters]),
            tolerance=tolerance,
            max_iterations=_COARSE_STEPS if tolerance == _COARSE else 500,
        )
        z[clusters], u[clusters], rho[clusters] = iterates.sparse, iterates.dual, iterates.rho
        before = lasso_cost(covariances, precisions[clusters], problem.sparsity)
        better = lasso_cost(covariances, found, problem.sparsity) < before
        precisions[clusters[better]] = found[better]
    for c in clusters:
        scores[:, c] = row_scores(problem.windows, means[c], precisions[c])
    return replace(
        state,
        means=means,
        precisions=precisions,
        scores=scores,
        iterates=Iterates(z, u, rho),
        fitted=state.labels,
        tolerance=tolerance,
    )


def _covariance(rows: Floats) -> Floats:
    centred = rows - rows.mean(axis=0)
    return centred.T @ centred / len(rows)


def reseed(problem: Problem, state: State, attempt: int) -> Ints:
    """Give each empty cluster a run of up to 20 consecutive rows of one series: those explained worst."""
    n = len(state.labels)
    owner = np.searchsorted(problem.starts, np.arange(n), side="right") - 1
    block = np.cumsum(np.r_[True, (np.diff(owner) != 0) | ((_place(problem, owner)[1:] % _RESEED_ROWS) == 0)]) - 1
    own_scores = state.scores[np.arange(n), state.labels]
    mean_score = np.bincount(block, own_scores) / np.bincount(block)
    worst = np.argsort(mean_score, kind="stable")
    labels = state.labels.copy()
    empty = np.flatnonzero(np.bincount(labels, minlength=problem.n_clusters) == 0)
    for order, cluster in enumerate(empty):
        rank = attempt * len(empty) + order
        if rank < len(worst):
            labels[block == worst[rank]] = cluster
    return labels


def _place(problem: Problem, owner: Ints) -> Ints:
    return np.arange(len(owner)) - problem.starts[owner]


def run_em(
    problem: Problem, labels: Ints, *, max_iterations: int, progress: Progress | None, name: str
) -> tuple[State, list[float], bool]:
    """Iterate from initial labels until nothing improves: final state, objective after each iteration, converged.

    Clusters are fitted coarsely while labels still move, and to full accuracy before the loop may end. An iteration
    that would not raise the objective is discarded, so the recorded objectives never fall.
    """
    state = first_state(problem, labels)
    objectives, attempt, tolerance = [state.objective], 0, _COARSE
    while len(objectives) < max_iterations:
        if progress is not None:
            progress(name, len(objectives), max_iterations)
        candidate = advance(problem, state, tolerance=tolerance)
        if attempt < _RESEED_ATTEMPTS and len(np.unique(candidate.labels)) < problem.n_clusters:
            reseeded = advance(
                problem, replace(candidate, labels=reseed(problem, candidate, attempt)), tolerance=_COARSE
            )
            if reseeded.objective > max(candidate.objective, state.objective):
                candidate = reseeded
            else:
                attempt += 1
        gain = candidate.objective - state.objective
        settled = gain <= _MIN_GAIN * abs(state.objective) or bool((candidate.labels == state.labels).all())
        if gain > 0:
            state = candidate
            objectives.append(state.objective)
        if settled and tolerance == _FINE:
            return state, objectives, True
        tolerance = _FINE if settled else tolerance
    return state, objectives, False


def objective_of(problem: Problem, labels: Ints, means: Floats, precisions: Floats) -> float:
    """Return the objective of any labels under any clusters (the class `TICC` defines it)."""
    scores = score_table(problem.windows, means, precisions)
    return path_score(scores, problem.penalties, problem.starts, labels)
