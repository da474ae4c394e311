"""The steps that stationary distribution correction works on, with restarts at ends, and minibatches of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from oat_gym._rng import derive
from oat_gym.episodes import BoolArray, IntArray
from oat_gym.errors import InvalidDataError
from oat_gym.ope._deviation import deviation
from oat_gym.ope._fqe_batch import Encoder
from oat_gym.ope._q_data import QData
from oat_gym.ope._q_function import Choices, action_choices
from oat_gym.ope.problem import Problem
from oat_gym.spaces import map_tree, tree_length

FloatArray = npt.NDArray[np.float64]
CHUNK = 64
"""Updates whose rows are drawn at a time."""
INITIAL_DRAWS = 10
"""Actions kept for an initial state, of stochastic policies without known probabilities."""


def counted(problem: Problem, rows: IntArray) -> IntArray:
    """Return those of `rows` that lie before the horizon.

    Raises:
        InvalidDataError: if none is left.
    """
    if problem.horizon is not None:
        rows = rows[problem.data.steps.step[rows] < problem.horizon]
    if not len(rows):
        raise InvalidDataError("The estimator has no step to weight: the data holds no episode that it may use.")
    return rows


def ends(problem: Problem, rows: IntArray) -> BoolArray:
    """Return (n,) whether the process restarts after a step: it terminates or is the last before the horizon."""
    steps = problem.data.steps
    done = steps.terminated[rows]
    return done if problem.horizon is None else done | (steps.step[rows] == problem.horizon - 1)


class DiceBatch(NamedTuple):
    """B rows for each of S seeds, laid out for K = S * P members.

    `inputs` and `select` hold 3 B rows: of the step (s, a), of the next (s', a'), and of a start (s0, a0).
    """

    inputs: Tensor  # (K, 3B, inputs)
    select: Tensor | None  # (K, 3B, heads) one-hot actions, or probabilities of the policies' actions
    rewards: Tensor  # (K, B) z-scored
    done: Tensor  # (K, B) 1 where the process restarts


@dataclass(frozen=True)
class Side:
    """States and the policies' actions in them: columns (n, W), remaining steps (n,), J kept actions (P, J * n, A)."""

    states: Tensor
    remaining: Tensor
    actions: Tensor

    @classmethod
    def of(cls, encoder: Encoder, states: FloatArray, remaining: IntArray, choices: Choices, device: str) -> Side:
        """Encode n states with what the policies choose there."""
        actions = _policy_actions(encoder, choices, device)
        return cls(encoder.states(states, device), torch.from_numpy(remaining).to(device), actions)

    def pick(self, rows: Tensor, draws: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return states (S, B, W), remaining steps (S, B) and actions (S, P, B, A)."""
        flat = rows.flatten()
        chosen = (draws * len(self.states) + rows).flatten()
        actions = self.actions.index_select(1, chosen).view(len(self.actions), *rows.shape, -1).transpose(0, 1)
        return self.states[flat].view(*rows.shape, -1), self.remaining[rows], actions


class DiceBatches:
    """Draws minibatches; every seed has its own stream, and a minibatch is the same for all policies of a seed."""

    def __init__(
        self, problem: Problem, encoder: Encoder, *, size: int, action_draws: int, seeds: Sequence[int]
    ) -> None:
        data, keep = _training(problem)
        device, horizon = problem.device, problem.horizon or 0
        self.size, self._encoder, self._device = size, encoder, device
        self._policies, self._rngs = len(problem.policies), [derive(seed, "dice minibatches") for seed in seeds]
        following = action_choices(
            problem, data.next_observations, draws=action_draws, rng=derive(0, "dice next actions")
        )
        initial = action_choices(problem, problem.initial, draws=INITIAL_DRAWS, rng=derive(0, "dice initial actions"))
        remaining = (horizon - problem.data.steps.step[keep]).astype(np.int64)
        start = np.full(tree_length(problem.initial), horizon, dtype=np.int64)
        self._draws = [1 if data.discrete else len(choices) for choices in (following, initial)]
        self._states = encoder.states(data.states, device)
        self._actions = encoder.actions(data.actions, device)
        self._remaining = torch.from_numpy(remaining).to(device)
        self._next = Side.of(encoder, data.next_states, remaining - 1, following, device)
        self._first = Side.of(encoder, problem.initial_states, start, initial, device)
        # The restarted process never ends, so that a constant added to all rewards changes no ratio.
        unit = float(deviation(data.rewards)) or 1.0
        self._rewards = tensor((data.rewards - data.rewards.mean()) / unit, device)
        self._done = tensor(ends(problem, keep).astype(np.float64), device)
        self._queue: list[tuple[Tensor, ...]] = []

    def draw(self) -> DiceBatch:
        """Return the next minibatch."""
        if not self._queue:
            self._queue = self._refill()
        rows, draws, first, first_draws = self._queue.pop()
        (s, b), p = rows.shape, self._policies
        taken = self._actions[rows.flatten()].view(s, 1, b, -1).expand(s, p, b, -1)
        parts = [
            (self._states[rows.flatten()].view(s, b, -1), self._remaining[rows], taken),
            self._next.pick(rows, draws),
            self._first.pick(first, first_draws),
        ]
        states, remaining = (torch.cat([part[i] for part in parts], dim=1) for i in (0, 1))
        actions = torch.cat([part[2] for part in parts], dim=2)
        discrete = self._encoder.discrete

        def spread(values: Tensor) -> Tensor:
            return values[rows][:, None].expand(s, p, b).reshape(s * p, b)

        return DiceBatch(
            inputs=columns(self._encoder, states, None if discrete else actions, remaining, policies=p),
            select=actions.reshape(s * p, 3 * b, -1) if discrete else None,
            rewards=spread(self._rewards),
            done=spread(self._done),
        )

    def _refill(self) -> list[tuple[Tensor, ...]]:
        shape = (CHUNK, self.size)
        limits = (len(self._states), self._draws[0], len(self._first.states), self._draws[1])
        drawn = [[rng.integers(limit, size=shape) for limit in limits] for rng in self._rngs]
        each = [torch.from_numpy(np.stack(part, axis=1)).to(self._device) for part in zip(*drawn, strict=True)]
        return list(zip(*(part.unbind(0) for part in each), strict=True))


def columns(encoder: Encoder, states: Tensor, actions: Tensor | None, remaining: Tensor, *, policies: int) -> Tensor:
    """Return inputs (S * P, n, inputs) from states (S, n, D), actions (S, P, n, A) and remaining steps (S, n)."""
    s, n, width = states.shape
    inputs = torch.empty((s, policies, n, encoder.inputs), device=states.device)
    inputs[..., :width] = states[:, None]
    if actions is not None:
        inputs[..., width : width + actions.shape[-1]] = actions
    if encoder.horizon is not None:
        inputs[..., -1] = encoder.steps(remaining)[:, None]
    return inputs.view(s * policies, n, -1)


def encoder_of(problem: Problem) -> Encoder:
    """Return the z-scores of the steps that are trained on; the remaining steps of a horizon are one more column."""
    return Encoder.of(_training(problem)[0], problem.horizon)


def _training(problem: Problem) -> tuple[QData, IntArray]:
    """Return the training steps before the horizon, and their rows in the data."""
    data = QData.of(problem)
    rows = counted(problem, data.rows)
    if len(rows) == len(data.rows):
        return data, rows
    kept = np.flatnonzero(np.isin(data.rows, rows))
    selected = QData(
        rows=rows,
        states=data.states[kept],
        actions=data.actions[kept],
        next_states=data.next_states[kept],
        next_observations=map_tree(lambda leaf: leaf[kept], data.next_observations),
        rewards=data.rewards[kept],
        terminated=data.terminated[kept],
        unit=data.unit[kept],
        discrete=data.discrete,
    )
    return selected, rows


def _policy_actions(encoder: Encoder, choices: Choices, device: str) -> Tensor:
    """Return (P, J * n, A) kept actions; of discrete ones their probabilities (P, n, K)."""
    n_policies, n = choices.weights.shape[:2]
    each = choices.actions if choices.actions.ndim == 4 else choices.actions[:, None]
    actions = np.broadcast_to(each, (len(choices), n_policies, n, each.shape[-1]))
    if encoder.discrete:
        return tensor(np.einsum("jpnk,pnj->pnk", actions, choices.weights), device)
    return encoder.actions(actions.transpose(1, 0, 2, 3).reshape(n_policies, len(choices) * n, -1), device)


def tensor(values: FloatArray, device: str) -> Tensor:
    """Return float32 values on the device."""
    return torch.from_numpy(np.ascontiguousarray(values, dtype=np.float32)).to(device)
