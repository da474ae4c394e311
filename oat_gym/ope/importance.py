"""Importance sampling: logged returns, weighted by how much likelier the target policy made them."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import ClassVar, Literal, get_args

import numpy as np
import numpy.typing as npt

from oat_gym.errors import ConfigurationError, EstimationWarning
from oat_gym.ope._normalised import Spans, discounts, normalised_means, normalised_sums
from oat_gym.ope._weights import Clip, ImportanceWeights, importance_weights
from oat_gym.ope.estimator import Diagnostics, Estimates, Estimator
from oat_gym.ope.problem import Problem

FloatArray = npt.NDArray[np.float64]
Kind = Literal["trajectory", "per-decision"]
MIN_EFFECTIVE = 10.0
"""Effective sample sizes under this are warned of."""
UNSEEN = 0.01
"""Shares of the discounted steps that truncation hides are warned of beyond this."""


@dataclass(frozen=True)
class ImportanceSampling(Estimator):
    """Importance sampling, trajectory-wise or per decision, ordinary or self-normalised.

    The weight of step t is w_t = prod_{k <= t} pi(a_k|s_k) / beta(a_k|s_k), computed in log space.

    - trajectory: mean of w_T G, G the discounted return of an episode of T steps;
    - per-decision: mean of sum_t gamma^t w_t r_t (Precup, Sutton and Singh, 2000): less variance, same mean;
    - `weighted`: the weights of all episodes sum to one (at each step, in the per-decision form). Biased for few
      episodes, consistent, and of much less variance.

    An ended episode keeps its last weight and earns nothing more; steps that never happened are not counted. On policy
    all four forms give the mean return, whatever the lengths. Rewards beyond the horizon do not count. Rewards after a
    truncation are unknown and missing: the share of discounted steps hidden that way is reported and warned of. The
    initial states are those of the logged episodes, whatever `initial_states` says (warned of).

    Intervals are of the weights as they are: with a cloned behaviour policy resamples hold the clone fixed, and
    `evaluate` sets the diagnostic `interval_covers_training` to 0.

    Args:
        kind: "per-decision" or "trajectory".
        weighted: self-normalise.
        clip: (least, greatest) log ratio of a step. None, the default, leaves the ratios as they are, which alone is
            unbiased; DOPE clips to (-6, 2), which bounds the variance of continuous actions and biases the estimate
            towards the value of the behaviour policy. The share of clipped ratios is reported.

    Diagnostics: `effective_sample_size` (Kish: (sum w)^2 / sum w^2 of the real episodes' weights; under 10 an
    `EstimationWarning` says so, also where there are fewer than 10 episodes at all), `largest_weight` (share of
    one episode), `mean_weight` (near 1 where the behaviour policy is right), `share_clipped`,
    `truncated_before_horizon` (share of the episodes) and `unseen_discount` (share of discounted steps, averaged over
    the episodes).

    >>> ImportanceSampling().name, ImportanceSampling(kind="trajectory", weighted=False).name
    ('IS per-decision weighted', 'IS trajectory')
    """

    kind: Kind = "per-decision"
    weighted: bool = True
    clip: Clip | None = None
    family: ClassVar[str] = "IS"

    def __post_init__(self) -> None:
        if self.kind not in get_args(Kind):
            raise ConfigurationError(f"kind must be one of {', '.join(get_args(Kind))}, got {self.kind!r}.")
        if not isinstance(self.weighted, bool):
            raise ConfigurationError(f"weighted must be True or False, got {self.weighted!r}.")
        check_clip(self.clip)

    @classmethod
    def preset(cls, name: Literal["dope"]) -> ImportanceSampling:
        """Return the settings of the DOPE benchmark: per-decision, self-normalised, log ratios clipped to (-6, 2).

        DOPE's own code also counts padded steps in its normaliser, which is wrong for unequal lengths; this does not.
        """
        if name != "dope":
            raise ConfigurationError(f"ImportanceSampling has the preset 'dope', got {name!r}.")
        return cls(clip=(-6.0, 2.0))

    @property
    def name(self) -> str:
        """Kind, "weighted" where it is, and the clip where there is one."""
        parts = ["IS", self.kind]
        parts += ["weighted"] if self.weighted else []
        parts += [f"clip({self.clip[0]:g},{self.clip[1]:g})"] if self.clip is not None else []
        return " ".join(parts)

    def estimate(self, problem: Problem, *, seeds: tuple[int, ...]) -> tuple[Estimates, ...]:
        """Return the estimates for each seed (which only a cloned behaviour policy depends on)."""
        results: list[Estimates] = []
        for number, seed in enumerate(seeds):
            problem.progress(self.name, number, len(seeds))
            results.append(self._estimate(problem, seed))
        problem.progress(self.name, len(seeds), len(seeds))
        return tuple(results)

    def weighted_returns(self, problem: Problem, *, seed: int) -> FloatArray:
        """Return (P, E) the return of each episode times its weights, not normalised.

        Their mean is the ordinary estimate: the t, Hoeffding and empirical Bernstein intervals (`ope.intervals`) apply
        to them.
        """
        spans, weights = Spans.of(problem), importance_weights(problem, seed, log_ratio_clip=self.clip)
        return np.stack([self._returns(problem, spans, weights, p) for p in range(len(problem.policies))])

    def _estimate(self, problem: Problem, seed: int) -> Estimates:
        spans, weights = Spans.of(problem), importance_weights(problem, seed, log_ratio_clip=self.clip)
        counts = spans.counts(problem.resamples)
        n_policies = len(problem.policies)
        values, replicates = np.empty(n_policies), np.empty((n_policies, len(counts)))
        for p in range(n_policies):
            values[p], replicates[p] = self._one_policy(problem, spans, weights, p, counts)
        diagnostics = weight_diagnostics(problem, spans, weights)
        warn_of_weights(problem, self.name, diagnostics)
        return Estimates(values, replicates, diagnostics)

    def _one_policy(
        self, problem: Problem, spans: Spans, weights: ImportanceWeights, p: int, counts: FloatArray
    ) -> tuple[float, FloatArray]:
        final = weights.log_final[p, spans.number]
        if not self.weighted:
            returns = self._returns(problem, spans, weights, p)
            return float(returns.mean()), counts @ returns / counts.sum(axis=1)
        if self.kind == "trajectory":
            return normalised_means(final, discounted_returns(problem, spans), counts)
        rewards = problem.data.steps.rewards.astype(np.float64)
        return normalised_sums(weights.log_cumulative[p], rewards, final, spans, gamma=problem.gamma, counts=counts)

    def _returns(self, problem: Problem, spans: Spans, weights: ImportanceWeights, p: int) -> FloatArray:
        with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is warned of by `evaluate`
            if self.kind == "trajectory":
                return np.exp(weights.log_final[p, spans.number]) * discounted_returns(problem, spans)
            return discounted_returns(problem, spans, np.exp(weights.log_cumulative[p]))


def discounted_returns(problem: Problem, spans: Spans, factor: FloatArray | None = None) -> FloatArray:
    """Return (E,) sum over the counted steps of gamma^t r_t, each times its `factor` (n,) where one is given."""
    steps = problem.data.steps
    parts = steps.rewards * discounts(problem.gamma, int(problem.data.lengths.max()))[steps.step]
    if problem.horizon is not None:
        parts = np.where(steps.step < problem.horizon, parts, 0.0)
    if factor is not None:
        parts = np.where(parts == 0.0, 0.0, parts * factor)
    return np.add.reduceat(parts, problem.data.offsets[:-1])[spans.number]


def check_clip(clip: Clip | None) -> None:
    """Raise `ConfigurationError` unless `clip` is None or (least, greatest) log ratio around 0."""
    if clip is None:
        return
    if not isinstance(clip, tuple) or len(clip) != 2 or not clip[0] <= 0.0 <= clip[1] or clip[0] == clip[1]:
        raise ConfigurationError(
            f"clip must be None or (least, greatest) log ratio of a step, with least <= 0 <= greatest, got {clip!r}."
        )


def weight_diagnostics(problem: Problem, spans: Spans, weights: ImportanceWeights) -> tuple[Diagnostics, ...]:
    """Return for each policy how far the weights of its episodes can be trusted (see `ImportanceSampling`)."""
    cut, unseen = truncation(problem, spans)
    results: list[Diagnostics] = []
    for p in range(len(problem.policies)):
        logs = weights.log_final[p, spans.number]
        highest = float(logs.max())
        by_unit = np.bincount(spans.unit, np.exp(logs - highest)) if np.isfinite(highest) else np.zeros(1)
        total = float(by_unit.sum())
        with np.errstate(over="ignore"):
            mean = float(np.exp(highest) * (total / len(logs)))
        results.append(
            {
                "effective_sample_size": total**2 / float(np.square(by_unit).sum()) if total else 0.0,
                "largest_weight": float(by_unit.max()) / total if total else float("nan"),
                "mean_weight": mean,
                "share_clipped": float(weights.share_clipped[p]),
                "truncated_before_horizon": cut,
                "unseen_discount": unseen,
            }
        )
    return tuple(results)


def truncation(problem: Problem, spans: Spans) -> tuple[float, float]:
    """Return the share of episodes cut before the horizon without a terminal state, and of discounted steps so hidden.

    Without a horizon an episode cut after T steps hides gamma^T of the discounted steps.
    """
    ended = problem.data.steps.terminated[problem.data.offsets[1:] - 1][spans.number]
    horizon, gamma = problem.horizon, problem.gamma
    cut = ~ended if horizon is None else ~ended & (spans.length < horizon)
    length = spans.length.astype(np.float64)
    if horizon is None:
        hidden = np.power(gamma, length)
    elif gamma == 1.0:
        hidden = 1.0 - length / horizon
    else:
        hidden = (np.power(gamma, length) - gamma**horizon) / (1.0 - gamma**horizon)
    return float(cut.mean()), float((hidden * cut).mean())


def warn_of_weights(problem: Problem, name: str, diagnostics: tuple[Diagnostics, ...]) -> None:
    """Warn (`EstimationWarning`) of small effective sample sizes, of truncation, and of initial states not used."""
    sizes = {n: d["effective_sample_size"] for n, d in zip(problem.policies.names, diagnostics, strict=True)}
    small = sorted((size, policy) for policy, size in sizes.items() if size < MIN_EFFECTIVE)
    if small:
        warnings.warn(
            f"{name}: the effective sample size of {len(small)} of {len(sizes)} policies is under {MIN_EFFECTIVE:g} "
            f"(least: {small[0][0]:.2f} of {problem.data.n_units} real episodes, policy {small[0][1]!r}): few episodes "
            "carry these estimates. Compare with estimators that use no weights over whole episodes.",
            EstimationWarning,
            stacklevel=4,
        )
    unseen = diagnostics[0]["unseen_discount"]
    if unseen > UNSEEN:
        missing = "the end" if problem.horizon is None else f"the horizon of {problem.horizon} steps"
        warnings.warn(
            f"{name}: {diagnostics[0]['truncated_before_horizon']:.0%} of the episodes are truncated before {missing}, "
            f"which hides {unseen:.1%} of the discounted steps: their rewards are missing from the value. Give a "
            "horizon that the episodes reach, or use estimators that bootstrap.",
            EstimationWarning,
            stacklevel=4,
        )
    if problem.initial_unit is None:
        warnings.warn(
            f"{name}: importance sampling weights logged episodes, so that its values are from the initial states of "
            "the data and not from those given as initial_states.",
            EstimationWarning,
            stacklevel=4,
        )
