"""Doubly robust estimators: action values, corrected by importance-weighted temporal-difference errors."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar, Literal, get_args

import numpy as np
import numpy.typing as npt

from oat_gym._rng import derive
from oat_gym.episodes import IntArray
from oat_gym.errors import ConfigurationError, EstimationWarning
from oat_gym.ope._magic import bias_interval, blend_weights, partial_lengths, step_shares
from oat_gym.ope._normalised import Spans, discounts, normalised_sums
from oat_gym.ope._q_function import FittedQ, QFunction, action_choices, expected_q
from oat_gym.ope._weights import Clip, ImportanceWeights, importance_weights
from oat_gym.ope.estimator import Diagnostics, Estimates, Estimator
from oat_gym.ope.fqe import FQE
from oat_gym.ope.importance import MIN_EFFECTIVE, check_clip, weight_diagnostics
from oat_gym.ope.problem import Problem
from oat_gym.spaces import Batch, map_tree

FloatArray = npt.NDArray[np.float64]
Kind = Literal["dr", "wdr", "magic"]


@dataclass(frozen=True)
class DoublyRobust(Estimator):
    """Doubly robust estimation: unbiased where either the importance weights or the action values are right.

    That holds for values from the initial states of the data. Those given as `initial_states` enter by V(s_0) only,
    while the correction stays that of the logged episodes (warned of): the value from them is right only if Q is, or if
    its mean error is the same at both.

    With w_t the cumulative importance weight of step t and delta_t = r_t + gamma V(s_{t+1}) - Q(s_t, a_t), where V is
    0 in terminal states, kept at truncations, and both count the steps that remain before the horizon:

    - "dr": mean of V(s_0) + sum_t gamma^t w_t delta_t, the per-decision form (Jiang and Li, 2016). Unbiased for any Q
      that was fitted to other data, of large variance where weights are.
    - "wdr": the weights of all episodes sum to one at each step (Thomas and Brunskill, 2016); an ended episode keeps
      its last weight. Biased for few episodes, consistent, of much less variance.
    - "magic": blends the partial sums of "wdr" (no step corrected, ..., all of them) by their estimated mean squared
      error (the same paper): trusts Q where the weights say little. The bias of each is measured to the
      90% percentile interval of "wdr", widened to hold "wdr" itself.

    Q is fitted to the same episodes, so that its errors on them, and the correction, are smaller than on new ones.
    Replicates resample episodes with Q (and the blend) held, whatever the fit's own `bootstrap` is: the interval does
    not cover its training (diagnostic `interval_covers_training` is 0), nor that of a `QFunction` that is given, whose
    origin is not known here.

    Args:
        kind: see above.
        q: how the action values are fitted, or a `QFunction` of the problem's policies.
        clip: (least, greatest) log ratio of a step; None leaves them as they are. DOPE clips to (-6, 2).
        action_draws: actions that V(s) averages where probabilities are not known and a policy is stochastic.
        partial_sums: at most how many "magic" blends.

    Diagnostics: those of the weights (see `ImportanceSampling`) and of the fit (see `FQE`), `correction` (the estimate
    less the mean of V(s_0)), and of magic `uncorrected_share` (the weight of V(s_0) alone).

    >>> DoublyRobust().name, DoublyRobust(kind="magic", clip=(-6.0, 2.0)).name
    ('DR weighted (FQE)', 'DR magic clip(-6,2) (FQE)')
    """

    kind: Kind = "wdr"
    q: FQE | QFunction = field(default_factory=FQE)
    clip: Clip | None = None
    action_draws: int = 10
    partial_sums: int = 20
    family: ClassVar[str] = "DR"

    def __post_init__(self) -> None:
        if self.kind not in get_args(Kind):
            raise ConfigurationError(f"kind must be one of {', '.join(get_args(Kind))}, got {self.kind!r}.")
        if not isinstance(self.q, FQE | QFunction):
            raise ConfigurationError(f"q must be an FQE, or have q(states, actions, remaining), got {self.q!r}.")
        if self.action_draws < 1 or self.partial_sums < 2:
            raise ConfigurationError(
                "action_draws must be at least 1 and partial_sums at least 2, got "
                f"{self.action_draws!r} and {self.partial_sums!r}."
            )
        check_clip(self.clip)

    @classmethod
    def preset(cls, name: Literal["dope"]) -> DoublyRobust:
        """Return the settings of the DOPE benchmark: weighted, log ratios clipped to (-6, 2), `FQE.preset("dope")`.

        DOPE's own code keeps the next-state term at terminal states, and counts padded steps in the normaliser.
        """
        if name != "dope":
            raise ConfigurationError(f"DoublyRobust has the preset 'dope', got {name!r}.")
        return cls(kind="wdr", q=FQE.preset("dope"), clip=(-6.0, 2.0))

    @property
    def name(self) -> str:
        """The kind, the clip, and the name of what fits the action values."""
        parts = ["DR", *{"dr": (), "wdr": ("weighted",), "magic": ("magic",)}[self.kind]]
        parts += [f"clip({self.clip[0]:g},{self.clip[1]:g})"] if self.clip is not None else []
        return " ".join([*parts, f"({self.q.name if isinstance(self.q, FQE) else type(self.q).__name__})"])

    def check(self, problem: Problem) -> None:
        """Raise where the action values cannot be fitted."""
        if isinstance(self.q, FQE):
            self.q.check(problem)

    def estimate(self, problem: Problem, *, seeds: tuple[int, ...]) -> tuple[Estimates, ...]:
        """Return the estimates of each seed.

        Raises:
            InvalidDataError: where the behaviour policy gives a logged action the probability 0.
            ConfigurationError: where a policy's log-probability is NaN or plus infinity.
        """
        if problem.initial_unit is None:
            _warn_of_starts(self.name)
        if not isinstance(self.q, FQE):
            own = self.q
            return tuple(self._estimate(problem, own, None, seed) for seed in seeds)
        fits = self.q.fit_q(problem, seeds=seeds)
        return tuple(self._estimate(problem, f.function, f, seed) for f, seed in zip(fits, seeds, strict=True))

    def _estimate(self, problem: Problem, function: QFunction, fit: FittedQ | None, seed: int) -> Estimates:
        spans, weights = Spans.of(problem), importance_weights(problem, seed, log_ratio_clip=self.clip)
        rng = derive(seed, "doubly robust")
        errors = td_errors(problem, function, spans, draws=self.action_draws, rng=rng)
        start = _initial_values(problem, function, draws=self.action_draws, rng=rng)
        at_start = start @ problem.initial_weights().T
        results = [
            self._correction(problem, spans, weights, p, errors=errors[p], start=start[p], at_start=at_start[p])
            for p in range(len(start))
        ]
        diagnostics = weight_diagnostics(problem, spans, weights)
        _warn_of_size(problem, self.name, diagnostics)
        corrections = np.array([value for value, _, _ in results])
        replicates = at_start + np.stack([parts for _, parts, _ in results])
        fitted: Sequence[Diagnostics] = ({},) * len(start) if fit is None else fit.diagnostics
        merged = [
            {**own, "interval_covers_training": 0.0, **of_weights, "correction": value, **more}
            for own, of_weights, (value, _, more) in zip(fitted, diagnostics, results, strict=True)
        ]
        return Estimates(start.mean(axis=1) + corrections, replicates, tuple(merged))

    def _correction(
        self,
        problem: Problem,
        spans: Spans,
        weights: ImportanceWeights,
        p: int,
        *,
        errors: FloatArray,
        start: FloatArray,
        at_start: FloatArray,
    ) -> tuple[float, FloatArray, Diagnostics]:
        """Return the correction of one policy, on each resample, and diagnostics.

        `start` (M,) are V(s_0), `at_start` (B,) their means on the resamples.
        """
        counts, logs = spans.counts(problem.resamples), weights.log_cumulative[p]
        if self.kind == "dr":
            terms = weighted_terms(errors, logs, spans, problem.gamma)
            return float(terms.mean()), counts @ terms / counts.sum(axis=1), {}
        final = weights.log_final[p, spans.number]
        value, replicates = normalised_sums(logs, errors, final, spans, gamma=problem.gamma, counts=counts)
        if self.kind == "wdr":
            return value, replicates, {}
        interval = bias_interval(start.mean() + value, at_start + replicates)
        weighted = normalised_errors(errors, (logs, final), spans)
        weighted *= discounts(problem.gamma, weighted.shape[1])
        first = _by_episode(problem, start, spans)
        shares = magic_shares(weighted, first, interval, count=self.partial_sums)
        kept = errors * shares[np.minimum(problem.data.steps.step, len(shares) - 1)]
        value, replicates = normalised_sums(logs, kept, final, spans, gamma=problem.gamma, counts=counts)
        return value, replicates, {"uncorrected_share": 1.0 - float(shares[0])}


def td_errors(
    problem: Problem, function: QFunction, spans: Spans, *, draws: int, rng: np.random.Generator
) -> FloatArray:
    """Return (P, n): r + gamma V(s') - Q(s, a) of the counted rows, 0 elsewhere; V is 0 where s' is terminal."""
    rows = np.concatenate([np.arange(a, a + n) for a, n in zip(spans.first, spans.length, strict=True)])
    data, steps = problem.data, problem.data.steps
    left = None if problem.horizon is None else problem.horizon - steps.step[rows]
    choices = action_choices(problem, _rows(steps.next_observations, rows), draws=draws, rng=rng)
    after = expected_q(function, data.next_states[rows], choices, None if left is None else left - 1)
    after = np.where(steps.terminated[rows], 0.0, after)
    after = after if left is None else np.where(left > 1, after, 0.0)
    errors = np.zeros((len(problem.policies), len(steps)))
    own = function.q(data.states[rows], data.actions[rows], left)
    errors[:, rows] = steps.rewards[rows] + problem.gamma * after - own
    return errors


def weighted_terms(errors: FloatArray, log_weights: FloatArray, spans: Spans, gamma: float) -> FloatArray:
    """Return (E,) sum_t gamma^t w_t delta_t of each episode; `errors` and `log_weights` are (n,)."""
    with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is warned of by `evaluate`
        scaled = np.where(errors == 0.0, 0.0, np.exp(log_weights) * errors)
    powers = discounts(gamma, int(spans.length.max()))
    return np.array([scaled[a : a + n] @ powers[:n] for a, n in zip(spans.first, spans.length, strict=True)])


def normalised_errors(errors: FloatArray, logs: tuple[FloatArray, FloatArray], spans: Spans) -> FloatArray:
    """Return (E, T) normalised weight times delta of each step, 0 after an episode's end.

    `logs` are the log weights of the rows, (n,), and those that ended episodes keep, (E,).
    """
    log_weights, final = logs
    steps = np.arange(int(spans.length.max()))
    alive = steps < spans.length[:, None]
    index = np.where(alive, spans.first[:, None] + steps, 0)
    padded = np.where(alive, log_weights[index], final[:, None])
    highest = padded.max(axis=0)
    scaled = np.exp(padded - np.where(np.isfinite(highest), highest, 0.0))
    total = scaled.sum(axis=0)
    return np.where(alive, scaled * errors[index] / np.where(total > 0, total, np.nan), 0.0)


def magic_shares(weighted: FloatArray, first: FloatArray, interval: tuple[float, float], *, count: int) -> FloatArray:
    """Return (T,): the share of each step's correction that MAGIC keeps.

    Args:
        weighted: (E, T) what each episode adds to each step's correction, discounted.
        first: (E,) what each adds to the mean of V(s_0).
        interval: confidence interval of the fully corrected estimate.
        count: largest number of partial sums.
    """
    sums = np.concatenate((first[:, None], first[:, None] + weighted.cumsum(axis=1)), axis=1)
    lengths = partial_lengths(weighted.shape[1], count)
    return step_shares(blend_weights(sums[:, lengths], interval), lengths, weighted.shape[1])


def _by_episode(problem: Problem, start: FloatArray, spans: Spans) -> FloatArray:
    """Return (E,) what each episode adds to the mean of V(s_0); alike where initial states are not the episodes'."""
    own = problem.initial_unit is not None and np.array_equal(problem.initial_unit, spans.unit)
    return start / len(start) if own else np.full(len(spans.unit), start.mean() / len(spans.unit))


def _initial_values(problem: Problem, function: QFunction, *, draws: int, rng: np.random.Generator) -> FloatArray:
    """Return V of the initial states, (P, M)."""
    choices = action_choices(problem, problem.initial, draws=draws, rng=rng)
    states = problem.initial_states
    return expected_q(function, states, choices, _full(problem.horizon, len(states)))


def _full(horizon: int | None, n: int) -> IntArray | None:
    return None if horizon is None else np.full(n, horizon)


def _rows(batch: Batch, rows: IntArray) -> Batch:
    return map_tree(lambda leaf: leaf[rows], batch)


def _warn_of_starts(name: str) -> None:
    """Say that the two terms are of different initial states, where the user gave some."""
    warnings.warn(
        f"{name}: the correction weights logged episodes, so that it is that of the initial states of the data and not "
        "of those given as initial_states. From these the values are right only if the action values are, or if their "
        "mean error is the same at both: importance weights do not make up for it.",
        EstimationWarning,
        stacklevel=4,
    )


def _warn_of_size(problem: Problem, name: str, diagnostics: tuple[Diagnostics, ...]) -> None:
    small = [
        policy
        for policy, numbers in zip(problem.policies.names, diagnostics, strict=True)
        if numbers["effective_sample_size"] < MIN_EFFECTIVE
    ]
    if small:
        warnings.warn(
            f"{name}: the effective sample size of {', '.join(small)} is under {MIN_EFFECTIVE:g}: few episodes carry "
            "the correction of the action values.",
            EstimationWarning,
            stacklevel=4,
        )
