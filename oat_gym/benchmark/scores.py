"""The metrics of the paper's tables for many sets of estimates at once, and their bootstrap draws.

`ope.metrics` has the definitions; these are the same numbers over leading axes, in the "raw" convention (as the paper's
equations 10 to 12 are printed), which is what its tables hold: regrets there exceed 1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from oat_gym._rng import derive
from oat_gym.errors import InvalidDataError
from oat_gym.ope import metrics

FloatArray = npt.NDArray[np.float64]
Metric = Literal["mae", "rank_correlation", "regret_at_1", "regret_at_5"]
METRICS: dict[Metric, str] = {
    "mae": "mean absolute error",
    "rank_correlation": "rank correlation",
    "regret_at_1": "regret@1",
    "regret_at_5": "regret@5",
}
"""The metrics and their names for readers."""
DRAWS = 400
"""Bootstrap draws of policies and of true values."""


def score(values: npt.ArrayLike, true: npt.ArrayLike, metric: Metric) -> FloatArray:
    """Return a metric of each row of estimates (..., P) against true values (..., P), which are broadcast.

    NaN where the metric is undefined: an estimate is NaN, ranks of equal estimates, regret@5 of five policies or fewer
    (in a resample: of five different ones or fewer).

    >>> score([[1.0, 2.0], [2.0, 1.0]], [1.0, 2.0], "mae").tolist()
    [0.0, 1.0]
    """
    estimates, truth = np.broadcast_arrays(np.asarray(values, dtype=np.float64), np.asarray(true, dtype=np.float64))
    if not np.isfinite(truth).all():
        raise InvalidDataError("True values must be finite numbers.")
    if metric == "mae":
        return np.abs(estimates - truth).mean(axis=-1)
    if metric == "rank_correlation":
        return _rank_correlation(estimates, truth)
    rows = (np.atleast_2d(estimates), np.atleast_2d(truth), np.ones(np.atleast_2d(truth).shape, dtype=bool))
    return _regret(*rows, k=1 if metric == "regret_at_1" else 5).reshape(truth.shape[:-1])


def resampled_score(values: FloatArray, true: FloatArray, picks: npt.NDArray[np.int64], metric: Metric) -> FloatArray:
    """Return a metric on R resamples of the policies, (R, ...), of estimates (..., P) and true values (P,).

    `picks` (R, P) are the policies of each resample. Errors and ranks count a policy as often as it was drawn (equal
    ones are tied); the regret chooses among the different policies that were drawn, since a policy that is there twice
    would take two of the k places.
    """
    if metric in ("mae", "rank_correlation"):
        return score(np.moveaxis(values[..., picks], -2, 0), _expand(true[picks], values.ndim), metric)
    drawn = np.zeros((len(picks), values.shape[-1]), dtype=bool)
    np.put_along_axis(drawn, picks, True, axis=1)
    shape = (len(picks), *values.shape)
    estimates, present = np.broadcast_to(values, shape), np.broadcast_to(_expand(drawn, values.ndim), shape)
    return _regret(estimates, np.broadcast_to(true, shape), present, k=1 if metric == "regret_at_1" else 5)


def _expand(rows: npt.NDArray[Any], ndim: int) -> npt.NDArray[Any]:
    """Return (R, P) as (R, 1, ..., 1, P), for estimates of `ndim` axes."""
    return rows.reshape(len(rows), *(1,) * (ndim - 1), rows.shape[1])


def _rank_correlation(estimates: FloatArray, truth: FloatArray) -> FloatArray:
    from scipy import stats  # noqa: PLC0415  (slow to import, and needed here only)

    undefined = np.asarray(np.isnan(estimates).any(axis=-1))
    ranks = stats.rankdata(np.where(undefined[..., None], 0.0, estimates), axis=-1)
    others = stats.rankdata(truth, axis=-1)
    ranks, others = (part - part.mean(axis=-1, keepdims=True) for part in (ranks, others))
    sizes = np.sqrt((ranks**2).sum(axis=-1) * (others**2).sum(axis=-1))
    products = (ranks * others).sum(axis=-1)
    return np.where(undefined | (sizes == 0), math.nan, products / np.where(sizes == 0, 1.0, sizes))


def _regret(estimates: FloatArray, truth: FloatArray, present: npt.NDArray[np.bool_], *, k: int) -> FloatArray:
    """Return (best - expected best among the k highest estimates) / |best| over the policies that are present."""
    if k > 1 and estimates.shape[-1] <= k:
        return np.full(estimates.shape[:-1], math.nan)
    undefined = (np.isnan(estimates) & present).any(axis=-1) | ((k > 1) & (present.sum(axis=-1) <= k))
    ranked = np.where(present & ~np.isnan(estimates), estimates, -np.inf)
    best = np.where(present, truth, -np.inf).max(axis=-1)
    threshold = np.sort(ranked, axis=-1)[..., -k]
    above = ranked >= threshold[..., None]
    found = np.where(above & present, truth, -np.inf).max(axis=-1)
    tied = (above & present).sum(axis=-1) > k
    for place in zip(*np.nonzero(tied & ~undefined), strict=True):
        members = present[place]
        left = metrics.regret_at_k(estimates[place][members], truth[place][members], k, convention="raw")
        found[place] = best[place] - left * abs(best[place])
    return np.where(undefined | (best == 0), math.nan, (best - found) / np.where(best == 0, 1.0, np.abs(best)))


@dataclass(frozen=True)
class Draws:
    """A metric of one estimator on one dataset, and how it varies.

    Attributes:
        points: (S,) the metric of each of S seeds.
        policies: (R, S) on resamples of the policies.
        episodes: (B, S) on resamples of the source episodes.
        truth: (R, S) against true values drawn around their estimates by their standard errors.
    """

    points: FloatArray
    policies: FloatArray
    episodes: FloatArray
    truth: FloatArray


def draw_scores(
    values: FloatArray, replicates: FloatArray, true: FloatArray, true_errors: FloatArray, metric: Metric
) -> Draws:
    """Return the draws of a metric from estimates (S, P), replicates (S, P, B), true values and errors (P,).

    The resamples depend on the number of policies alone: two variants are compared on the same ones.
    """
    picks = policy_picks(values.shape[-1])
    noise = derive(0, "truth", len(true)).standard_normal((DRAWS, len(true)))
    around = true + noise * np.where(np.isfinite(true_errors), true_errors, 0.0)
    return Draws(
        points=score(values, true, metric),
        policies=resampled_score(values, true, picks, metric),
        episodes=score(np.moveaxis(replicates, -1, 0), true, metric),
        truth=score(values[None], around[:, None, :], metric),
    )


def policy_picks(n_policies: int) -> npt.NDArray[np.int64]:
    """Return (R, P): bootstrap resamples of P policies, at least two different ones in each where P > 1."""
    rng = derive(0, "policies", n_policies)
    picks = rng.integers(0, n_policies, size=(DRAWS, n_policies))
    if n_policies > 1:
        same = (picks == picks[:, :1]).all(axis=1)
        picks[same, 1] = (picks[same, 0] + 1) % n_policies
    return picks
