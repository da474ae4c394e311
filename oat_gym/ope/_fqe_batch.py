"""The training data of network FQE as tensors, and minibatches of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from oat_gym.episodes import IntArray
from oat_gym.ope._q_data import QData, RewardScale
from oat_gym.ope._q_function import Choices, step_weights, value_scale
from oat_gym.ope.problem import Problem

FloatArray = npt.NDArray[np.float64]
CHUNK = 64
"""Updates whose rows are drawn at a time."""


@dataclass(frozen=True)
class Encoder:
    """Features of states, actions and remaining steps as a network's inputs: z-scored columns.

    With a horizon H, remaining steps h = 1..H are one more column of mean 0 and variance about 1. Discrete actions are
    no inputs: the network has a head for each.
    """

    state_center: FloatArray
    state_scale: FloatArray
    action_center: FloatArray
    action_scale: FloatArray
    discrete: bool
    horizon: int | None

    @classmethod
    def of(cls, data: QData, horizon: int | None) -> Encoder:
        """Take the means and standard deviations of the training data; constant columns are only centred."""
        return cls(*_z_scores(data.states), *_z_scores(data.actions), data.discrete, horizon)

    @property
    def inputs(self) -> int:
        """Number of columns."""
        actions = 0 if self.discrete else len(self.action_center)
        return len(self.state_center) + actions + (self.horizon is not None)

    @property
    def heads(self) -> int:
        """Number of outputs."""
        return len(self.action_center) if self.discrete else 1

    def states(self, states: FloatArray, device: str) -> Tensor:
        """Return (n, D) columns."""
        return _tensor((states - self.state_center) / self.state_scale, device)

    def actions(self, actions: FloatArray, device: str) -> Tensor:
        """Return (..., A) columns, discrete actions as they are."""
        return _tensor(actions if self.discrete else (actions - self.action_center) / self.action_scale, device)

    def steps(self, remaining: Tensor) -> Tensor:
        """Return the column of remaining steps."""
        horizon = self.horizon or 1
        return (remaining.to(torch.float32) * (2.0 / horizon) - 1.0) * 3.0**0.5


class Minibatch(NamedTuple):
    """B rows for each of S*E streams, laid out for K = S*E*P members.

    The network gives u, a weighted mean of rewards: Q = u times the sum of the discounts of the remaining steps. Its
    regression target is `earned + carry * u(next)`.
    """

    inputs: Tensor  # (K, B, inputs)
    select: Tensor | None  # (K, B, heads) one-hot actions; None with one head
    next_inputs: Tensor  # (K, B, inputs)
    next_select: Tensor | None  # (K, B, heads) probabilities of the next actions
    earned: Tensor  # (K, B)
    carry: Tensor  # (K, B)
    total: Tensor  # (K, B) sum of the discounts of the remaining steps


class Batches:
    """Draws minibatches. Each stream has its own generators, so that no stream depends on which others there are."""

    def __init__(
        self,
        problem: Problem,
        data: QData,
        reward: RewardScale,
        encoder: Encoder,
        choices: Choices,
        *,
        rngs: Sequence[np.random.Generator],
        rows: Sequence[IntArray],
        size: int,
    ) -> None:
        device = problem.device
        self._policies, self._rngs, self._rows, self.size = len(problem.policies), rngs, rows, size
        self._encoder, self._device = encoder, device
        self._states = encoder.states(data.states, device)
        self._actions = encoder.actions(data.actions, device)
        self._next_states = encoder.states(data.next_states, device)
        self._draws = 1 if data.discrete else len(choices)
        self._next_actions = _next_actions(encoder, choices, device)
        self._rewards = _tensor((data.rewards - reward.center) / reward.scale, device)
        self._going = _tensor((~data.terminated).astype(np.float64), device)
        self._earn, self._carry = (_tensor(table, device) for table in _discounting(problem))
        self._queue: list[tuple[Tensor, Tensor, Tensor]] = []

    def draw(self) -> Minibatch:
        """Return the next minibatch."""
        if not self._queue:
            self._queue = self._refill()
        rows, draws, steps = self._queue.pop()
        flat = rows.flatten()
        s, b, p = *rows.shape, self._policies
        own, following = self._rewards[flat].view(s, b), self._going[flat].view(s, b)
        earned, carry = self._earn[steps] * own, self._carry[steps] * following
        actions = self._actions[flat].view(s, 1, b, -1)
        chosen = (draws * len(self._states) + rows).flatten()
        next_actions = self._next_actions.index_select(1, chosen).view(p, s, b, -1).transpose(0, 1)
        discrete = self._encoder.discrete
        return Minibatch(
            inputs=self._inputs(self._states[flat], None if discrete else actions, steps),
            select=actions.expand(s, p, b, -1).reshape(s * p, b, -1) if discrete else None,
            next_inputs=self._inputs(self._next_states[flat], None if discrete else next_actions, steps - 1),
            next_select=next_actions.reshape(s * p, b, -1) if discrete else None,
            earned=earned[:, None].expand(s, p, b).reshape(s * p, b),
            carry=carry[:, None].expand(s, p, b).reshape(s * p, b),
            total=self._earn[steps].reciprocal()[:, None].expand(s, p, b).reshape(s * p, b),
        )

    def _inputs(self, states: Tensor, actions: Tensor | None, steps: Tensor) -> Tensor:
        (s, b), p, width = steps.shape, self._policies, states.shape[1]
        inputs = torch.empty((s, p, b, self._encoder.inputs), device=states.device)
        inputs[..., :width] = states.view(s, 1, b, width)
        if actions is not None:
            inputs[..., width : width + actions.shape[-1]] = actions
        if self._encoder.horizon is not None:
            inputs[..., -1] = self._encoder.steps(steps)[:, None]
        return inputs.view(s * p, b, -1)

    def _refill(self) -> list[tuple[Tensor, Tensor, Tensor]]:
        shape, horizon = (CHUNK, self.size), self._encoder.horizon
        rows, draws, steps = ([], [], [])
        for rng, own in zip(self._rngs, self._rows, strict=True):
            rows.append(own[rng.integers(len(own), size=shape)])
            draws.append(rng.integers(self._draws, size=shape))
            steps.append(
                np.zeros(shape, dtype=np.int64) if horizon is None else rng.integers(1, horizon + 1, size=shape)
            )
        columns = (torch.from_numpy(np.stack(part, axis=1)).to(self._device) for part in (rows, draws, steps))
        return list(zip(*(column.unbind(0) for column in columns), strict=True))


def _discounting(problem: Problem) -> tuple[FloatArray, FloatArray]:
    """Return the weights of the reward and of the next u in u, by remaining steps (one entry without a horizon)."""
    if problem.horizon is None:
        scale = value_scale(problem)
        return np.array([1.0 / scale]), np.array([problem.gamma])
    total = step_weights(problem.gamma, problem.horizon)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.nan_to_num(1.0 / total, posinf=0.0), np.append(0.0, problem.gamma * total[:-1] / total[1:])


def _next_actions(encoder: Encoder, choices: Choices, device: str) -> Tensor:
    """Return (P, J * n, A) cached actions, of discrete ones their probabilities (P, n, K)."""
    n_policies, n = choices.weights.shape[:2]
    actions = np.broadcast_to(
        choices.actions if choices.actions.ndim == 4 else choices.actions[:, None],
        (len(choices), n_policies, n, choices.actions.shape[-1]),
    )
    if encoder.discrete:
        return _tensor(np.einsum("jpnk,pnj->pnk", actions, choices.weights), device)
    return encoder.actions(actions.transpose(1, 0, 2, 3).reshape(n_policies, len(choices) * n, -1), device)


def _z_scores(columns: FloatArray) -> tuple[FloatArray, FloatArray]:
    spread = columns.std(axis=0)
    return columns.mean(axis=0), np.where(spread > 1e-8, spread, 1.0)


def _tensor(values: FloatArray, device: str) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, dtype=np.float32)).to(device)
