"""Roll-outs of policies in dynamics models: all members, policies and initial states of a step in one batch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from oat_gym._rng import derive
from oat_gym.errors import InvalidDataError
from oat_gym.ope._model_data import Ranges
from oat_gym.ope.policy import streams
from oat_gym.ope.problem import Problem

FloatArray = npt.NDArray[np.float64]
CHUNK = 2**23
"""Most numbers in the states of one batch; more initial states are worked through in parts."""


@runtime_checkable
class DynamicsModel(Protocol):
    """A model that the user gives, on feature matrices (`FlatSpace.flatten` of the dataset's spaces)."""

    def step(
        self, states: FloatArray, actions: FloatArray, *, rng: np.random.Generator
    ) -> tuple[npt.NDArray[Any], npt.NDArray[Any], npt.NDArray[Any]]:
        """Return next states (n, D), rewards (n,), and whether, or how probably, the episode goes on (n,).

        Args:
            states: (n, D) features.
            actions: (n, A) features, clipped to the action space.
            rng: where the model draws from.
        """
        ...


class MemberModel(Protocol):
    """E models that roll-outs run through side by side."""

    @property
    def members(self) -> int:
        """E."""
        ...

    @property
    def ranges(self) -> Ranges:
        """What next states and rewards are clipped to."""
        ...

    def advance(
        self, states: FloatArray, actions: FloatArray, rng: np.random.Generator
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return next states (E, P, n, D), rewards (E, P, n) and probabilities of going on (E, P, n).

        States (E, P, n, D) and actions (E, P, n, A) are those of P policies, for which the same numbers are drawn: a
        policy's roll-outs do not depend on the others, and differences between policies have less noise.
        """
        ...


@dataclass(frozen=True)
class GivenModel:
    """A user's model as an ensemble of one, which nothing is clipped for."""

    model: DynamicsModel
    width: int

    @property
    def members(self) -> int:
        """One."""
        return 1

    @property
    def ranges(self) -> Ranges:
        """None."""
        return Ranges.unlimited(self.width)

    def advance(
        self, states: FloatArray, actions: FloatArray, rng: np.random.Generator
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Take one step of the model."""
        own = streams(rng, states.shape[1])
        found = [self._step(*each) for each in zip(states[0], actions[0], own, strict=True)]
        following, rewards, going = (np.stack(part)[None] for part in zip(*found, strict=True))
        return following, rewards, going

    def _step(self, states: FloatArray, actions: FloatArray, rng: np.random.Generator) -> tuple[FloatArray, ...]:
        found = self.model.step(states, actions, rng=rng)
        parts, n = tuple(np.asarray(part, dtype=np.float64) for part in found), len(states)
        shapes = tuple(part.shape for part in parts)
        if shapes != (states.shape, (n,), (n,)):
            raise InvalidDataError(
                f"model.step must return next states {states.shape}, rewards ({n},) and continuations ({n},), got "
                f"shapes {shapes}."
            )
        return parts


@dataclass(frozen=True)
class Limits:
    """How long roll-outs are, and how many start at an initial state."""

    rollouts: int
    max_steps: int
    tolerance: float


@dataclass(frozen=True)
class RollOuts:
    """What roll-outs gave.

    Attributes:
        values: (E, P, M) discounted return from each initial state, the mean of its roll-outs.
        clipped: (P,) share of the steps in which a state left the data's range.
        unfinished: (P,) discounted probability gamma^T P(alive after T steps) that a roll-out without a horizon was
            cut at its last step; 0 with a horizon.
    """

    values: FloatArray
    clipped: FloatArray
    unfinished: FloatArray


def roll_out(problem: Problem, model: MemberModel, starts: FloatArray, limits: Limits, *, seed: int) -> RollOuts:
    """Follow every policy from the initial states (M, D), in each of the E models.

    An episode that goes on with probability c counts for the fraction c from then on (no end is drawn): the
    expectation over ends is exact. Without a horizon, steps whose discounted probability is below `tolerance` in every
    roll-out, or that come after `max_steps`, are left out.
    """
    width = model.members * len(problem.policies) * limits.rollouts * starts.shape[1]
    size = max(CHUNK // width, 1)
    parts: list[RollOuts] = []
    for number, first in enumerate(range(0, len(starts), size)):
        problem.progress("MB roll-outs", first, len(starts))
        chunk = starts[first : first + size]
        rngs = derive(seed, "model states", number), derive(seed, "model actions", number)
        parts.append(_chunk(problem, model, np.repeat(chunk, limits.rollouts, axis=0), limits, rngs))
    problem.progress("MB roll-outs", len(starts), len(starts))
    values = np.concatenate([part.values for part in parts], axis=2)
    shares = np.array([part.values.shape[2] for part in parts]) / values.shape[2]
    return RollOuts(
        values.reshape(*values.shape[:2], len(starts), limits.rollouts).mean(axis=3),
        shares @ np.stack([part.clipped for part in parts]),
        shares @ np.stack([part.unfinished for part in parts]),
    )


def _chunk(
    problem: Problem,
    model: MemberModel,
    starts: FloatArray,
    limits: Limits,
    rngs: tuple[np.random.Generator, np.random.Generator],
) -> RollOuts:
    members, policies, (n, width) = model.members, len(problem.policies), starts.shape
    own, horizon = streams(rngs[1], policies), problem.horizon
    states = np.broadcast_to(starts, (members, policies, n, width)).copy()
    values, alive = np.zeros((members, policies, n)), np.ones((members, policies, n))
    clipped, lived, discount, ranges = np.zeros(policies), np.zeros(policies), 1.0, model.ranges
    for _ in range(limits.max_steps if horizon is None else horizon):
        actions = _actions(problem, states, own)
        following, rewards, going = model.advance(states, actions, rngs[0])
        values += discount * alive * np.clip(rewards, ranges.least_reward, ranges.greatest_reward)
        states = np.clip(following, ranges.low, ranges.high)
        clipped += (alive * (states != following).any(axis=3)).sum(axis=(0, 2))
        lived += alive.sum(axis=(0, 2))
        alive *= going
        discount *= problem.gamma
        if horizon is None and discount * alive.max() < limits.tolerance:
            break
    left = np.zeros(policies) if horizon is not None else discount * alive.mean(axis=(0, 2))
    return RollOuts(values, clipped / np.maximum(lived, 1e-12), left)


def _actions(problem: Problem, states: FloatArray, rngs: list[np.random.Generator]) -> FloatArray:
    """Return features of one action of each policy in its own states: (E, P, n, A) from (E, P, n, D)."""
    members, _, n, width = states.shape
    data = problem.data
    parts: list[FloatArray] = []
    for p, (policy, rng) in enumerate(zip(problem.policies.policies, rngs, strict=True)):
        observations = data.flat_observations.unflatten(states[:, p].reshape(members * n, width))
        actions = data.flat_actions.flatten(policy.sample(observations, rng=rng))
        parts.append(np.clip(actions, *data.flat_actions.bounds).reshape(members, n, -1))
    return np.stack(parts, axis=1)
