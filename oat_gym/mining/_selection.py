"""Choosing the number of clusters, by silhouette or BIC."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from threadpoolctl import threadpool_limits

from oat_gym.errors import ConfigurationError
from oat_gym.mining._em import score_table
from oat_gym.mining._initial import load_scikit_learn
from oat_gym.mining._windows import Rows, join_series, stack_windows
from oat_gym.mining.ticc import TICC, Initialisation

Progress = Callable[[str, int, int], None]

_SILHOUETTE_ROWS = 3000


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
    @property
    def restarts(self) -> int: ...


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
    """Choose the number of clusters and return the best model found for it and `{C: score}` (empty for one candidate).

    TICC finds local optima, and the silhouette of one fit says more about its start than about C. So each candidate
    is fitted from `settings.restarts` k-means starts. Its silhouette is their mean, and of the candidates that are not
    significantly worse than the best the one with the fewest clusters wins. Its BIC is the lowest found.
    """
    seeds = [int(seed) for seed in rng.integers(2**31, size=settings.restarts)]
    report: Progress = progress or _silent

    def fit(count: int, seed: int, init: Initialisation, report: Progress) -> TICC:
        return _fit(series, count, settings, seed=seed, times=times, init=init, progress=report)

    rows = join_series(series)
    if max(candidates) > len(rows.values):
        raise ConfigurationError(
            f"The largest number of clusters to try, {max(candidates)}, is more than the {len(rows.values)} rows of "
            "all series: give smaller candidates, or n_clusters."
        )
    load_scikit_learn()
    if len(candidates) == 1:
        return fit(candidates[0], seeds[0], settings.init, report), {}
    sample = np.sort(rng.permutation(len(rows.values))[:_SILHOUETTE_ROWS])
    models: dict[int, list[TICC]] = {}
    scores: dict[int, list[float]] = {}
    for number, count in enumerate(candidates):
        report("choosing the number of clusters", number, len(candidates))
        models[count] = [fit(count, seed, "kmeans", _silent) for seed in seeds]
        with threadpool_limits(limits=1):
            scores[count] = [
                silhouette(model, rows, sample) if criterion == "silhouette" else bic(model, rows)
                for model in models[count]
            ]
    report("choosing the number of clusters", len(candidates), len(candidates))
    chosen = fewest_not_worse(scores) if criterion == "silhouette" else min(scores, key=lambda c: min(scores[c]))
    final = [] if settings.init == "gmm" else models[chosen]
    if settings.init != "kmeans":
        final = [*final, fit(chosen, seeds[0], "gmm", report)]
    summary = np.mean if criterion == "silhouette" else np.min
    return max(final, key=lambda model: model.objective_), {c: float(summary(scores[c])) for c in candidates}


def fewest_not_worse(scores: Mapping[int, Sequence[float]]) -> int:
    """Return the smallest key whose mean score (higher is better) is not significantly below the best mean.

    Significant is a difference of more than 1.96 of its standard errors, which is estimated from the repeats of all
    keys together; with one score a key it is 0 and the best key wins.

    >>> fewest_not_worse({10: [0.20, 0.22], 11: [0.21, 0.22], 12: [0.10, 0.12]})
    10
    """
    means = {key: float(np.mean(values)) for key, values in scores.items()}
    repeats = min(len(values) for values in scores.values())
    spread = float(np.mean([np.var(values, ddof=1) for values in scores.values()])) if repeats > 1 else 0.0
    allowed = 1.96 * float(np.sqrt(2 * spread / repeats))
    return min(key for key, mean in means.items() if mean >= max(means.values()) - allowed)


def _fit(
    series: Sequence[ArrayLike],
    count: int,
    settings: TICCSettings,
    *,
    seed: int,
    times: Sequence[ArrayLike] | None,
    init: Initialisation,
    progress: Progress,
) -> TICC:
    model = TICC(
        count,
        settings.window,
        settings.sparsity,
        settings.switch_penalty,
        max_iterations=settings.max_iterations,
        seed=seed,
        init=init,
    )
    return model.fit(series, times=times, progress=progress)


def _silent(description: str, done: int, total: int) -> None:
    """Report nothing."""


def silhouette(model: TICC, rows: Rows, sample: NDArray[np.int64]) -> float:
    """Return the mean silhouette of the z-scored rows in `sample`; -1 where only one label, or one a row, occurs."""
    from sklearn.metrics import silhouette_score

    labels = np.concatenate(model.labels_)[sample]
    if not 1 < len(np.unique(labels)) < len(labels):
        return -1.0
    values = (rows.values[sample] - model.center_) / model.scale_
    return float(silhouette_score(values, labels))


def bic(model: TICC, rows: Rows) -> float:
    """Return -2 log-likelihood + (number of non-zero parameters) * log n; lower is better.

    Parameters are the means, and of each precision the distinct entries of its Toeplitz blocks; those of a cluster
    that stayed empty count too, so that it does not come free. The log-likelihood is without the penalties.
    """
    labels = np.concatenate(model.labels_)
    width = rows.values.shape[1]
    standard = Rows((rows.values - model.center_) / model.scale_, rows.lengths)
    scores = score_table(stack_windows(standard, model.window), model.means_, model.precisions_)
    likelihood = float(scores[np.arange(len(labels)), labels].sum())
    first = model.precisions_[:, :width]  # the first block row holds every block once
    diagonal = np.triu(np.ones((width, width), dtype=np.bool_))
    count = int((first[:, :, :width] != 0)[:, diagonal].sum() + (first[:, :, width:] != 0).sum())
    count += int((model.means_ != 0).sum())
    return -2 * likelihood + count * float(np.log(len(labels)))
