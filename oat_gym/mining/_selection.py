"""Choosing the number of clusters, by silhouette or BIC."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.metrics import silhouette_score
from threadpoolctl import threadpool_limits

from oat_gym.mining._em import score_table
from oat_gym.mining._windows import Rows, join_series, stack_windows
from oat_gym.mining.ticc import TICC, Initialisation

Progress = Callable[[str, int, int], None]

_SILHOUETTE_ROWS = 5000


class TICCSettings(Protocol):
    """The settings of TICC that do not depend on the number of clusters."""

    @property
    def window(self) -> int: ...
    @property
    def sparsity(self) -> float: ...
    @property
    def switch_penalty(self) -> float: ...
    @property
    def max_iterations(self) -> int: ...
    @property
    def init(self) -> Initialisation: ...


def choose_clusters(
    series: Sequence[ArrayLike],
    *,
    candidates: Sequence[int],
    criterion: str,
    settings: TICCSettings,
    rng: np.random.Generator,
    times: Sequence[ArrayLike] | None = None,
    progress: Progress | None = None,
) -> tuple[TICC, dict[int, float]]:
    """Fit TICC for each candidate and return the best model and `{C: score}` (empty for a single candidate).

    All candidates share the seed and the rows of the silhouette, so that scores differ by C only.
    """
    seed = int(rng.integers(2**31))
    rows = join_series(series)
    sample = np.sort(rng.permutation(len(rows.values))[:_SILHOUETTE_ROWS])
    best: TICC | None = None
    scores: dict[int, float] = {}
    for count in candidates:
        model = TICC(
            count,
            settings.window,
            settings.sparsity,
            settings.switch_penalty,
            max_iterations=settings.max_iterations,
            seed=seed,
            init=settings.init,
        ).fit(series, times=times, progress=progress)
        if len(candidates) == 1:
            return model, {}
        with threadpool_limits(limits=1):
            scores[count] = silhouette(model, rows, sample) if criterion == "silhouette" else bic(model, rows)
        if best is None or _better(scores[count], scores[best.n_clusters], criterion):
            best = model
    if best is None:
        raise ValueError("candidates is empty")
    return best, scores


def _better(new: float, old: float, criterion: str) -> bool:
    return new > old if criterion == "silhouette" else new < old


def silhouette(model: TICC, rows: Rows, sample: NDArray[np.int64]) -> float:
    """Return the mean silhouette of the z-scored rows in `sample`; -1 where only one label, or one a row, occurs."""
    labels = np.concatenate(model.labels_)[sample]
    if not 1 < len(np.unique(labels)) < len(labels):
        return -1.0
    values = (rows.values[sample] - model.center_) / model.scale_
    return float(silhouette_score(values, labels))


def bic(model: TICC, rows: Rows) -> float:
    """Return -2 log-likelihood + (number of non-zero parameters) * log n; lower is better.

    Parameters are the means, and of each precision the distinct entries of its Toeplitz blocks, for the clusters
    that occur. The log-likelihood is without the penalties.
    """
    labels = np.concatenate(model.labels_)
    used = np.unique(labels)
    width = rows.values.shape[1]
    standard = Rows((rows.values - model.center_) / model.scale_, rows.lengths)
    scores = score_table(stack_windows(standard, model.window), model.means_, model.precisions_, 0.0)
    likelihood = float(scores[np.arange(len(labels)), labels].sum())
    first = model.precisions_[used][:, :width]  # the first block row holds every block once
    diagonal = np.triu(np.ones((width, width), dtype=np.bool_))
    count = int((first[:, :, :width] != 0)[:, diagonal].sum() + (first[:, :, width:] != 0).sum())
    count += int((model.means_[used] != 0).sum())
    return -2 * likelihood + count * float(np.log(len(labels)))
