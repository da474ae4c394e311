"""Whether augmentation helped: improvements with intervals, and the words "helps", "no evidence", "hurts".

**Improvement.** m_s(v) is a metric of variant v with seed s: of an estimator, or the average over several estimators.
With means over the seeds, m(v) = (1/S) sum_s m_s(v), the improvement over no augmentation is

    errors (mae):        e = log(m(none) / m(v)), told in percent less error, I = 100 (1 - exp(-e))
    rank correlation:    e = I = m(v) - m(none)
    regrets:             e = I = m(none) - m(v)

so that a positive one is always better. The effect e of several tasks is the mean of theirs: for errors, I is then that
of the geometric mean of the tasks' ratios, to which no task contributes more because its rewards are large.

**Interval.** Four things could have come out differently, and each is resampled on its own, the same resample for both
variants (paired), everything else held at what it was:

    seeds:     S seeds drawn with replacement, both variants with the same ones           variance v1, factor S/(S-1)
    policies:  P target policies drawn with replacement                                   variance v2, factor P/(P-1)
    episodes:  the estimates on a bootstrap resample of the N source episodes             variance v3, factor N/(N-1)
    truth:     true values drawn around the roll-outs' means by their standard errors     variance v4

The factors undo the bootstrap's shrinkage: a resample of n units has (n-1)/n of the variance of a new sample. The
standard error is the root of V = v1 + v2 + v3 + v4, the interval e +- t_nu sqrt(V) with Satterthwaite's degrees of
freedom (1946)

    nu = V^2 / sum_i (v_i^2 / d_i),    d = (S-1, P-1, N-1, infinity),

so that three seeds alone give the wide quantile 4.30 and not 1.96, where seeds are what varies. Seeds and policies are
crossed, and what they do together is counted in both terms: the interval is slightly too wide, never too narrow for
that reason (Owen, 2007, "The pigeonhole bootstrap"). Tasks are independent: variances add, divided by their number
squared. Datasets of one task are not, they share its policies: standard errors add, divided by their number.

**What it covers.** In the experiments of `tests/benchmark/test_improvement.py`, where a method changes nothing, 5 to 8%
of the 95% intervals of errors exclude zero with three seeds, and hardly any of ranks and regrets, whose terms
overlap: "no evidence" is also said of some changes of them that are there.

The episodes' term holds fixed what an estimator trained on them (see `ope.Result`). Values of FQE and of models that
count from given starts do not change with the resample at all: their intervals are of these recorded episodes, and more
seeds, which share the episodes, do not widen them to others. `between_tasks` does, where there are several tasks: how
much their improvements differ holds whatever made each of them uncertain. With one seed the error of training is
not in the interval either: then, whatever the numbers, the verdict is "no evidence".
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from oat_gym._rng import derive
from oat_gym.benchmark.scores import DRAWS, Draws, Metric
from oat_gym.errors import InvalidDataError
from oat_gym.ope.intervals import check_confidence

FloatArray = npt.NDArray[np.float64]
Verdict = Literal["helps", "no evidence", "hurts", "not measured"]


@dataclass(frozen=True)
class Parts:
    """The variance of an improvement by where it comes from; that of `between_tasks` is told as one, `tasks`."""

    seeds: float
    policies: float
    episodes: float
    truth: float
    tasks: float = 0.0

    @property
    def total(self) -> float:
        """Their sum."""
        return math.fsum(float(getattr(self, name)) for name in _PARTS)

    @property
    def main(self) -> str:
        """The name of the largest part; "-" where all are 0, as of what cannot change, or unknown."""
        parts = {name: float(getattr(self, name)) for name in _PARTS}
        largest = max(parts, key=lambda name: -1.0 if math.isnan(parts[name]) else parts[name])
        return largest if parts[largest] > 0 else "-"


_PARTS = ("seeds", "policies", "episodes", "truth", "tasks")


@dataclass(frozen=True)
class Improvement:
    """An improvement over no augmentation, better where positive.

    Attributes:
        metric: what improved.
        value: I, in percent for errors, else in the metric's own unit; NaN where a side was not measured.
        low: lower end of the interval of I.
        high: upper end of it.
        effect: e, of which the standard error and the variances are.
        standard_error: root of the total variance.
        degrees: Satterthwaite's degrees of freedom.
        parts: the variance by where it comes from.
        n_seeds: number of seeds in which both sides are known, for the estimator that has the fewest.
        before: the metric without augmentation.
        after: the metric with it.
    """

    metric: Metric
    value: float
    low: float
    high: float
    effect: float
    standard_error: float
    degrees: float
    parts: Parts
    n_seeds: int
    before: float
    after: float

    @property
    def decides(self) -> bool:
        """Whether the interval could have excluded zero: there are two seeds or more, and something can change."""
        return self.n_seeds > 1 and math.isfinite(self.low) and self.parts.total > 0

    @property
    def verdict(self) -> Verdict:
        """What the interval says: helps or hurts where it excludes zero and there are two seeds or more."""
        if not math.isfinite(self.value):
            return "not measured"
        if self.n_seeds < 2 or not math.isfinite(self.low):
            return "no evidence"
        return "helps" if self.low > 0 else "hurts" if self.high < 0 else "no evidence"


def improve(
    before: Sequence[Draws],
    after: Sequence[Draws],
    metric: Metric,
    *,
    n_policies: int,
    n_episodes: int,
    confidence: float = 0.95,
) -> Improvement:
    """Return the improvement of one dataset, averaged over one or more estimators (the same ones on both sides).

    Seeds in which a metric is undefined on either side, for some estimator, are left out for that estimator on both.

    Args:
        before: draws without augmentation, one for each estimator, all of the same S seeds.
        after: draws with augmentation.
        metric: which metric they are of.
        n_policies: P.
        n_episodes: N, the source episodes.
        confidence: of the interval.

    Raises:
        InvalidDataError: where the two sides do not match.
    """
    check_confidence(confidence)
    shapes = [each.points.shape for each in (*before, *after)]
    if not before or len(before) != len(after) or len(set(shapes)) > 1:
        raise InvalidDataError(f"Both sides need the same estimators and seeds, at least one, got shapes {shapes}.")
    points = _stack(before, after, "points")
    known = np.asarray(np.isfinite(points).all(axis=0))  # (E, S)
    n_seeds = int(known.sum(axis=1).min())
    if not n_seeds:
        return _nothing(metric, 0)
    sides = _means(points[..., None, :], known)[:, 0]
    resampled = {name: _means(_stack(before, after, name), known) for name in ("policies", "episodes", "truth")}
    changes = {name: _change(draws[0], draws[1], metric) for name, draws in resampled.items()}
    parts = Parts(
        seeds=_variance(_seed_draws(points, known, metric), n_seeds),
        policies=_unless_undefined(changes["policies"], _variance(changes["policies"], n_policies)),
        episodes=_variance(changes["episodes"], n_episodes),
        truth=_variance(changes["truth"], math.inf),
    )
    degrees = _satterthwaite(
        (parts.seeds, n_seeds - 1),
        (parts.policies, n_policies - 1),
        (parts.episodes, n_episodes - 1),
        total=parts.total,
    )
    effect = float(_change(sides[0], sides[1], metric))
    return _told(
        metric, effect, parts, degrees, n_seeds=n_seeds, sides=(float(sides[0]), float(sides[1])), confidence=confidence
    )


def over_tasks(improvements: Sequence[Improvement], *, confidence: float = 0.95) -> Improvement:
    """Return the mean of the improvements of different tasks; those that were not measured are left out.

    Raises:
        InvalidDataError: for none, or different metrics.
    """
    members = _members(improvements)
    parts = _sum_of_parts(members, math.fsum)
    terms = [(each.parts.total / len(members) ** 2, each.degrees) for each in members]
    return _mean(improvements[0].metric, members, parts, _satterthwaite(*terms, total=parts.total), confidence)


def over_related(improvements: Sequence[Improvement], *, confidence: float = 0.95) -> Improvement:
    """Return the mean of improvements that share policies or episodes, as those of one task's datasets do.

    It has the widest interval that any correlation of theirs allows: standard errors add up and not variances, and the
    fewest degrees of freedom count.

    Raises:
        InvalidDataError: for none, or different metrics.
    """
    members = _members(improvements)
    parts = _sum_of_parts(members, lambda variances: sum(math.sqrt(each) for each in variances) ** 2)
    degrees = min((each.degrees for each in members), default=math.nan)
    return _mean(improvements[0].metric, members, parts, degrees, confidence)


def between_tasks(improvements: Sequence[Improvement], *, confidence: float = 0.95) -> Improvement:
    """Return the mean of the improvements of different tasks, its interval from how much they differ.

    It says what to expect of another such task, and is a t interval with one degree of freedom less than there are
    tasks; without ends for less than two.

    Raises:
        InvalidDataError: for none, or different metrics.
    """
    members = _members(improvements)
    effects = [each.effect for each in members]
    variance = float(np.var(effects, ddof=1)) / len(effects) if len(effects) > 1 else math.nan
    return _mean(improvements[0].metric, members, Parts(0.0, 0.0, 0.0, 0.0, variance), len(effects) - 1, confidence)


def _members(improvements: Sequence[Improvement]) -> list[Improvement]:
    """Return the improvements that were measured."""
    if len({each.metric for each in improvements}) != 1:
        raise InvalidDataError("A mean needs improvements of one metric, at least one.")
    return [each for each in improvements if math.isfinite(each.value)]


def _sum_of_parts(members: Sequence[Improvement], add: Callable[[Sequence[float]], float]) -> Parts:
    """Return the parts of the variance of a mean, each put together by `add`."""
    size = max(len(members), 1)
    sums = [add([float(getattr(each.parts, name)) for each in members]) / size**2 for name in _PARTS]
    return Parts(*sums)


def _mean(
    metric: Metric, members: Sequence[Improvement], parts: Parts, degrees: float, confidence: float
) -> Improvement:
    check_confidence(confidence)
    if not members:
        return _nothing(metric, 0)
    effect, before, after = (
        float(np.mean([getattr(each, name) for each in members])) for name in ("effect", "before", "after")
    )
    n_seeds = min(each.n_seeds for each in members)
    return _told(metric, effect, parts, degrees, n_seeds=n_seeds, sides=(before, after), confidence=confidence)


def _satterthwaite(*terms: tuple[float, float], total: float) -> float:
    """Return the degrees of freedom of a sum of (variance, degrees of freedom); variances that are known add none."""
    bottom = sum(part**2 / degrees for part, degrees in terms if part > 0 and degrees > 0)
    return total**2 / bottom if 0 < bottom < math.inf else math.inf


def _told(
    metric: Metric,
    effect: float,
    parts: Parts,
    degrees: float,
    *,
    n_seeds: int,
    sides: tuple[float, float],
    confidence: float,
) -> Improvement:
    """Return an improvement in the unit that readers see."""
    error = math.sqrt(parts.total)
    margin = _quantile(confidence, degrees) * error
    value, low, high = (_reader(metric, each) for each in (effect, effect - margin, effect + margin))
    return Improvement(metric, value, low, high, effect, error, degrees, parts, n_seeds, sides[0], sides[1])


def _reader(metric: Metric, effect: float) -> float:
    return 100.0 * -math.expm1(min(-effect, 700.0)) if metric == "mae" else effect


def _stack(before: Sequence[Draws], after: Sequence[Draws], name: str) -> FloatArray:
    """Return (2, E, ..., S)."""
    return np.stack([[getattr(each, name) for each in side] for side in (before, after)])


def _means(draws: FloatArray, known: npt.NDArray[np.bool_]) -> FloatArray:
    """Return the mean over estimators of the mean over their known seeds: (2, E, R, S) to (2, R).

    A draw in which the metric is undefined (all policies of a resample tied) counts by its other seeds.
    """
    usable = np.isfinite(draws).all(axis=0) & known[:, None, :]  # paired: undefined on one side, unused on both
    count = usable.sum(axis=-1)
    sums = np.where(usable, draws, 0.0).sum(axis=-1)
    means = np.where(count > 0, sums / np.maximum(count, 1), math.nan)
    return means.mean(axis=1)


def _seed_draws(points: FloatArray, known: npt.NDArray[np.bool_], metric: Metric) -> FloatArray:
    n_seeds = points.shape[-1]
    if n_seeds < 2:
        return np.zeros(1)
    picks = derive(0, "seeds", n_seeds).integers(0, n_seeds, size=(DRAWS, n_seeds))
    drawn = np.where(known, points, math.nan)[..., picks]  # (2, E, R, S)
    sides = _means(drawn, np.ones_like(known))
    return _change(sides[0], sides[1], metric)


def _change(before: FloatArray, after: FloatArray, metric: Metric) -> FloatArray:
    if metric == "mae":
        positive = (before > 0) & (after > 0)
        return np.log(np.where(positive, before, math.nan) / np.where(positive, after, 1.0))
    return after - before if metric == "rank_correlation" else before - after


def _variance(draws: FloatArray, units: float) -> float:
    """Return the variance of the finite draws, times n / (n - 1); 0 where there is only one unit."""
    kept = draws[np.isfinite(draws)]
    if len(kept) < 2 or units <= 1 or not np.ptp(kept):
        return 0.0
    return float(kept.var(ddof=1)) * (1.0 if math.isinf(units) else units / (units - 1))


def _unless_undefined(draws: FloatArray, variance: float) -> float:
    """Return a variance, without limit where the metric is undefined in most draws: too few policies are left to rank.

    Regret@5 of six policies is defined in less than one of a hundred resamples.
    """
    return variance if np.isfinite(draws).mean() > 0.5 else math.inf


def _quantile(confidence: float, degrees: float) -> float:
    from scipy import stats  # noqa: PLC0415  (slow to import, and needed here only)

    q = 0.5 + confidence / 2
    return float(stats.norm.ppf(q) if math.isinf(degrees) else stats.t.ppf(q, max(degrees, 1.0)))


def _nothing(metric: Metric, n_seeds: int) -> Improvement:
    nan = math.nan
    return Improvement(metric, nan, nan, nan, nan, nan, nan, Parts(nan, nan, nan, nan), n_seeds, nan, nan)
