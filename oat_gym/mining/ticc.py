"""TICC: Toeplitz inverse covariance-based clustering of many time series (the paper, section 2.1 and appendix A.1)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray
from threadpoolctl import threadpool_limits

from oat_gym._rng import check_seed
from oat_gym.errors import ConfigurationError, InvalidDataError
from oat_gym.mining._em import Problem, State, run_em, score_table
from oat_gym.mining._initial import kmeans_labels, load_scikit_learn, mixture_labels
from oat_gym.mining._viterbi import viterbi
from oat_gym.mining._windows import Rows, join_series, stack_windows, standardisation, switch_penalties

Progress = Callable[[str, int, int], None]
Initialisation = Literal["auto", "kmeans", "gmm"]


class TICC:
    """Toeplitz inverse covariance-based clustering, with one path of labels per series (MT-TICC).

    Every row gets one of `n_clusters` labels. A cluster is a Gaussian over windows of `window` rows (a row and the
    rows before it in its series; at a series' beginning its first row is repeated) whose inverse covariance is
    sparse and block-Toeplitz: the relation of two features depends on their lag only. All series share the clusters;
    no window and no penalty crosses from one series to the next.

    **Objective** (the paper's Eq. 2), higher is better. With windows x_t, labels k_t and clusters (mu_c, Theta_c)::

        J = sum_t log N(x_t; mu_{k_t}, Theta_{k_t}^-1) - sum over switches at t of switch_penalty / log(e + dt_t)

    dt is the time since the previous row, 1 where the data has no times. Viterbi gives the labels that maximise J.
    The clusters maximise, each over its own rows, the likelihood less `sparsity / 2 * ||Theta_c||_1` a row: the
    graphical lasso of the original TICC, whose lambda is not divided by the size of the cluster and includes the
    diagonal. That step need not raise J, so an iteration that would lower it is discarded: `objectives_` never falls.

    An empty cluster is given the rows that are explained worst, if that raises J. Otherwise it stays empty: then its
    label does not occur in `labels_`.

    Args:
        n_clusters: number of clusters C.
        window: rows in a window, w.
        sparsity: weight lambda of the absolute entries of the precisions, > 0, for z-scored features.
        switch_penalty: cost beta of a switch, in log-likelihood units (half of the original code's beta).
        initial_labels: where EM starts: a list of (T_i,) integer arrays, as `labels_`. Overrides `init`.
        max_iterations: at most so many EM iterations; reaching it is no error (`converged_` tells).
        seed: seed of the initialisations.
        standardize: z-score each feature over all rows first. A constant feature becomes 0 and has no say.
        init: `"kmeans"` (on moments of 20-row blocks), `"gmm"`, or `"auto"`: both, the better final J wins.

    Attributes:
        labels_: list of (T_i,) int64 arrays.
        objective_: the final J. objectives_: J after each iteration, never falling.
        means_: (C, w D) means of the windows, in standardized units, oldest row first.
        precisions_: (C, w D, w D) exactly block-Toeplitz and symmetric, positive definite.
        center_, scale_: (D,) the standardization: `(x - center_) / scale_`.
        n_iter_: number of iterations. converged_: whether EM ended by itself. init_: the initialisation that won.

    Raises:
        ConfigurationError: a setting that cannot work.

    >>> rng = np.random.default_rng(0)
    >>> series = [np.concatenate([rng.normal(0, 1, (60, 2)), rng.normal(5, 1, (40, 2))]) for _ in range(3)]
    >>> model = TICC(n_clusters=2, switch_penalty=10.0).fit(series)
    >>> [np.flatnonzero(np.diff(labels)).tolist() for labels in model.labels_]
    [[59], [59], [59]]
    """

    labels_: list[NDArray[np.int64]]
    objective_: float
    objectives_: list[float]
    means_: NDArray[np.float64]
    precisions_: NDArray[np.float64]
    center_: NDArray[np.float64]
    scale_: NDArray[np.float64]
    n_iter_: int
    converged_: bool
    init_: str

    def __init__(
        self,
        n_clusters: int = 10,
        window: int = 1,
        sparsity: float = 0.11,
        switch_penalty: float = 100.0,
        initial_labels: Sequence[ArrayLike] | None = None,
        *,
        max_iterations: int = 100,
        seed: int = 0,
        standardize: bool = True,
        init: Initialisation = "auto",
    ) -> None:
        check_settings(
            n_clusters=n_clusters,
            window=window,
            sparsity=sparsity,
            switch_penalty=switch_penalty,
            max_iterations=max_iterations,
            init=init,
        )
        self.n_clusters = n_clusters
        self.window = window
        self.sparsity = sparsity
        self.switch_penalty = switch_penalty
        self.initial_labels = initial_labels
        self.max_iterations = max_iterations
        self.seed = check_seed(seed)
        self.standardize = standardize
        self.init: Initialisation = init

    def __repr__(self) -> str:
        return (
            f"TICC(n_clusters={self.n_clusters}, window={self.window}, sparsity={self.sparsity:g}, "
            f"switch_penalty={self.switch_penalty:g})"
        )

    def fit(
        self,
        series: Sequence[ArrayLike],
        *,
        times: Sequence[ArrayLike] | None = None,
        progress: Progress | None = None,
    ) -> TICC:
        """Learn the clusters and the labels; returns self.

        Args:
            series: list of (T_i, D) arrays; the lengths may differ and may be 1.
            times: list of (T_i,) non-decreasing times, for the MT-TICC switching penalty.
            progress: called as `progress(description, done, total)` before each iteration.

        Raises:
            InvalidDataError: an empty list or series, different D, NaN or infinity, times that do not fit.
            ConfigurationError: more clusters than rows, or initial labels that do not fit the series.
        """
        raw = join_series(series)
        if self.n_clusters > len(raw.values):
            raise ConfigurationError(
                f"n_clusters={self.n_clusters} is more than the {len(raw.values)} rows of all series; use fewer."
            )
        width = raw.values.shape[1]
        self.center_, self.scale_ = (
            standardisation(raw.values) if self.standardize else (np.zeros(width), np.ones(width))
        )
        rows = self._standardised(raw)
        load_scikit_learn()
        with threadpool_limits(limits=1):  # faster for small matrices, and the result does not depend on their number
            problem = self._problem(rows, times)
            runs = {
                name: run_em(
                    problem, labels, max_iterations=self.max_iterations, progress=progress, name=f"TICC ({name})"
                )
                for name, labels in self._initial(rows).items()
            }
        self.init_ = max(runs, key=lambda name: runs[name][0].objective)
        state, self.objectives_, self.converged_ = runs[self.init_]
        self._store(rows, state)
        return self

    def predict(
        self, series: Sequence[ArrayLike], *, times: Sequence[ArrayLike] | None = None
    ) -> list[NDArray[np.int64]]:
        """Return the best labels of (new) series under the learned clusters: a list of (T_i,) int64 arrays.

        Raises:
            InvalidDataError: as `fit`; or D is not what `fit` saw.
            ConfigurationError: `fit` has not been called.
        """
        if not hasattr(self, "means_"):
            raise ConfigurationError("This TICC is not fitted yet; call fit(series) first.")
        raw = join_series(series)
        if raw.values.shape[1] != len(self.center_):
            raise InvalidDataError(f"The series have {raw.values.shape[1]} features; fit saw {len(self.center_)}.")
        rows = self._standardised(raw)
        with threadpool_limits(limits=1):
            problem = self._problem(rows, times)
            scores = score_table(problem.windows, self.means_, self.precisions_)
        labels, _ = viterbi(scores, problem.penalties, problem.starts)
        return rows.split(labels)

    def _standardised(self, raw: Rows) -> Rows:
        return Rows((raw.values - self.center_) / self.scale_, raw.lengths)

    def _problem(self, rows: Rows, times: Sequence[ArrayLike] | None) -> Problem:
        return Problem(
            windows=stack_windows(rows, self.window),
            penalties=switch_penalties(rows, self.switch_penalty, times),
            starts=rows.starts,
            n_clusters=self.n_clusters,
            window=self.window,
            sparsity=self.sparsity,
        )

    def _initial(self, rows: Rows) -> dict[str, NDArray[np.int64]]:
        if self.initial_labels is not None:
            return {"initial_labels": check_labels(self.initial_labels, rows.lengths, self.n_clusters)}
        ways = {"kmeans": kmeans_labels, "gmm": mixture_labels}
        chosen = list(ways) if self.init == "auto" else [self.init]
        return {name: ways[name](rows, n_clusters=self.n_clusters, seed=self.seed) for name in chosen}

    def _store(self, rows: Rows, state: State) -> None:
        self.labels_ = rows.split(state.labels)
        self.objective_ = state.objective
        self.means_, self.precisions_ = state.means, state.precisions
        self.n_iter_ = len(self.objectives_)


def check_settings(
    *, n_clusters: int, window: int, sparsity: float, switch_penalty: float, max_iterations: int, init: str
) -> None:
    """Raise `ConfigurationError` unless the settings of `TICC` can work."""
    counts = {"n_clusters": n_clusters, "window": window, "max_iterations": max_iterations}
    for name, value in counts.items():
        if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 1:
            raise ConfigurationError(f"{name} must be a positive integer, got {value!r}.")
    if not (np.isfinite(sparsity) and sparsity > 0):
        raise ConfigurationError(
            f"sparsity must be a positive number, got {sparsity!r}; without it a cluster of few rows has no optimum. "
            "Use a small value such as 1e-4 for almost dense precisions."
        )
    if not (np.isfinite(switch_penalty) and switch_penalty >= 0):
        raise ConfigurationError(f"switch_penalty must be a number of at least 0, got {switch_penalty!r}.")
    if init not in get_args(Initialisation):
        raise ConfigurationError(f"init must be one of {get_args(Initialisation)}, got {init!r}.")


def check_labels(labels: Sequence[ArrayLike], lengths: NDArray[np.int64], n_clusters: int) -> NDArray[np.int64]:
    """Join initial labels to one (n,) array, or raise `ConfigurationError` where they do not fit the series."""
    arrays = [np.asarray(item) for item in labels]
    if len(arrays) != len(lengths):
        raise ConfigurationError(f"initial_labels holds {len(arrays)} series; the data has {len(lengths)}.")
    for index, (array, length) in enumerate(zip(arrays, lengths, strict=True)):
        if array.shape != (length,) or array.dtype.kind not in "iu":
            raise ConfigurationError(
                f"initial_labels[{index}] must be {length} integers, got shape {array.shape} and type {array.dtype}."
            )
    joined = np.concatenate(arrays).astype(np.int64)
    if joined.min() < 0 or joined.max() >= n_clusters:
        raise ConfigurationError(
            f"initial_labels must lie in 0..{n_clusters - 1}, got values from {joined.min()} to {joined.max()}."
        )
    return joined
