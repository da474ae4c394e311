"""Importance weights pi(a|s) / beta(a|s) of logged steps, cumulated over each episode, in log space."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import njit

from oat_gym.episodes import BoolArray, IntArray
from oat_gym.errors import ConfigurationError, InvalidDataError
from oat_gym.ope.problem import Problem

FloatArray = npt.NDArray[np.float64]
Clip = tuple[float, float]
"""Least and greatest log ratio of one step."""


@dataclass(frozen=True)
class ImportanceWeights:
    """Log weights of the n logged steps under P policies, aligned with the rows of the data.

    Steps at or beyond the horizon have the ratio 1, so that the cumulative weight keeps its value there; so have the
    steps of episodes that the problem keeps from the weights (`use_augmented`).

    Attributes:
        log_ratio: (P, n) log pi(a_t|s_t) - log beta(a_t|s_t), clipped where a clip was given; minus infinity where
            the policy never takes the action.
        log_cumulative: (P, n) sum of `log_ratio` over the steps 0 to t of the episode, step t included.
        counted: (n,) true where the step lies before the horizon, in an episode that is weighted.
        offsets: (E+1,) first row of each episode, and n.
        share_clipped: (P,) share of the counted steps whose ratio was clipped.
    """

    log_ratio: FloatArray
    log_cumulative: FloatArray
    counted: BoolArray
    offsets: IntArray
    share_clipped: FloatArray

    @property
    def log_before(self) -> FloatArray:
        """(P, n): the cumulative log weight before each step, the sum over the steps 0 to t-1; 0 at the first step."""
        before = np.empty_like(self.log_cumulative)
        before[:, 1:] = self.log_cumulative[:, :-1]
        before[:, self.offsets[:-1]] = 0.0
        return before

    @property
    def log_final(self) -> FloatArray:
        """(P, E): log weight of each whole episode (up to the horizon), which an ended episode keeps."""
        return self.log_cumulative[:, self.offsets[1:] - 1]


def importance_weights(problem: Problem, seed: int, *, log_ratio_clip: Clip | None = None) -> ImportanceWeights:
    """Return the importance weights of every logged step under every policy.

    Args:
        problem: data, policies, behaviour and horizon.
        seed: the seed of the behaviour policy, where that is cloned.
        log_ratio_clip: least and greatest log ratio of one step; None: as they are.

    Raises:
        InvalidDataError: where the behaviour policy gives a logged action the probability 0, or NaN.
        ConfigurationError: where a target policy's log-probability is NaN or plus infinity.
    """
    counted = problem.episodes("weights")[problem.data.steps.episode]
    if problem.horizon is not None:
        counted &= problem.data.steps.step < problem.horizon
    behavior = _check_behavior(np.asarray(problem.behavior(seed), dtype=np.float64), counted, problem)
    target = _check_target(problem.target_log_prob(), counted, problem)
    with np.errstate(invalid="ignore"):  # of steps that do not count
        log_ratio = target - behavior
    log_ratio[:, ~counted] = 0.0
    clipped = np.zeros(len(log_ratio))
    if log_ratio_clip is not None:
        low, high = log_ratio_clip
        outside = ((log_ratio < low) | (log_ratio > high)) & counted
        clipped = outside.sum(axis=1) / max(int(counted.sum()), 1)
        # ratios of exactly 1 beyond the horizon stay what they are
        np.clip(log_ratio, low, high, out=log_ratio, where=counted)
    cumulative = np.empty_like(log_ratio)
    for row, out in zip(log_ratio, cumulative, strict=True):
        _cumulate(row, problem.data.offsets, out)
    return ImportanceWeights(log_ratio, cumulative, counted, problem.data.offsets, clipped)


def _check_behavior(log_prob: FloatArray, counted: BoolArray, problem: Problem) -> FloatArray:
    steps = problem.data.steps
    if log_prob.shape != (len(steps),):
        raise InvalidDataError(
            f"The behaviour policy gave log-probabilities of shape {log_prob.shape}, expected one for each of the "
            f"{len(steps)} logged steps."
        )
    bad = ~np.isfinite(log_prob) & counted
    if bad.any():
        row = int(np.flatnonzero(bad)[0])
        raise InvalidDataError(
            f"The behaviour policy gives the logged action at step {steps.step[row]} of episode {steps.episode[row]} "
            f"the log-probability {log_prob[row]}, but the action was taken: {int(bad.sum())} such step(s). Check the "
            "logged propensities or the policy given as behavior=, or clone it with behavior='clone'. (Generated steps "
            "have no logged propensity.)"
        )
    return log_prob


def _check_target(log_prob: FloatArray, counted: BoolArray, problem: Problem) -> FloatArray:
    bad = (np.isnan(log_prob) | (log_prob == np.inf)) & counted
    if bad.any():
        policy, row = (int(index) for index in np.argwhere(bad)[0])
        steps = problem.data.steps
        raise ConfigurationError(
            f"Policy {problem.policies.names[policy]!r} gives the action at step {steps.step[row]} of episode "
            f"{steps.episode[row]} the log-probability {log_prob[policy, row]}. Importance sampling needs the density "
            "of the policy: finite, or minus infinity where it never takes the action."
        )
    return log_prob


# Compiled when first called; a plain difference of cumulative sums would turn minus infinity into NaN.
@njit(nogil=True)
def _cumulate(log_ratio: FloatArray, offsets: IntArray, out: FloatArray) -> None:
    for episode in range(len(offsets) - 1):
        total = 0.0
        for row in range(offsets[episode], offsets[episode + 1]):
            total += log_ratio[row]
            out[row] = total
