"""Training of network FQE: all policies, ensemble members and seeds side by side."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from oat_gym.episodes import IntArray
from oat_gym.generation._layers import one_thread
from oat_gym.ope._fqe_batch import Batches, Encoder, Minibatch
from oat_gym.ope._fqe_network import Architecture, Layers, backward, first_weights, forward, views
from oat_gym.ope._q_data import RewardScale
from oat_gym.ope._q_function import Choices, step_weights
from oat_gym.progress import ProgressCallback

FloatArray = npt.NDArray[np.float64]
LOOKS = 20
"""How often the values are taken while training."""
BLOCK = 4096
"""Rows of one member that are evaluated at a time."""
SMALL = 2**26
"""Multiplications in a layer of all members below which one thread is used."""


@dataclass(frozen=True)
class Settings:
    """How the networks are trained; see `FQE`."""

    updates: int
    learning_rate: float
    tau: float
    weight_decay: float


@dataclass(frozen=True)
class NetworkQ:
    """Action values by E networks for each of P policies; `layers` hold E * P members, policies fastest.

    Q = c_h (scale * u + center), with u the network's output and c_h the sum of discounts of the remaining steps.
    """

    layers: Layers
    encoder: Encoder
    reward: RewardScale
    totals: FloatArray
    """Sum of discounts by remaining steps; one entry without a horizon."""
    n_policies: int
    device: str

    def q(self, states: FloatArray, actions: FloatArray, remaining: IntArray | None) -> FloatArray:
        """Return Q(s, a), (P, n), the mean of the members (see `QFunction`)."""
        return self.member_q(states, actions, remaining).mean(axis=0)

    def member_q(self, states: FloatArray, actions: FloatArray, remaining: IntArray | None) -> FloatArray:
        """Return Q(s, a) of each member, (E, P, n)."""
        parts: list[FloatArray] = []
        for start in range(0, len(states), BLOCK):
            rows = slice(start, start + BLOCK)
            steps = None if remaining is None else remaining[rows]
            parts.append(self._block(states[rows], actions[..., rows, :], steps))
        return np.concatenate(parts, axis=2)

    def v(self, states: FloatArray, choices: Choices, remaining: IntArray | None) -> FloatArray:
        """Return V(s) of each member, (E, P, n)."""
        total: FloatArray | float = 0.0
        for j, actions in enumerate(choices.actions):
            total = total + choices.weights[:, :, j] * self.member_q(states, actions, remaining)
        return np.asarray(total)

    @torch.no_grad()
    def _block(self, states: FloatArray, actions: FloatArray, remaining: IntArray | None) -> FloatArray:
        members, n, device = len(self.layers[0][0]), len(states), self.device
        steps = np.zeros(n, dtype=np.int64) if remaining is None else remaining
        own = np.broadcast_to(actions, (self.n_policies, n, actions.shape[-1]))
        chosen = self.encoder.actions(own, device).repeat(members // self.n_policies, 1, 1)
        columns = [self.encoder.states(states, device).expand(members, n, -1)]
        columns += [] if self.encoder.discrete else [chosen]
        if self.encoder.horizon is not None:
            columns.append(self.encoder.steps(torch.from_numpy(steps).to(device)).view(1, n, 1).expand(members, n, 1))
        heads = forward(self.layers, torch.cat(columns, dim=2))[-1]
        out = (heads * chosen).sum(dim=2) if self.encoder.discrete else heads.squeeze(2)
        values = out.to("cpu", torch.float64).numpy().reshape(-1, self.n_policies, n)
        return (values * self.reward.scale + self.reward.center) * self.totals[steps]


@dataclass(frozen=True)
class Course:
    """How training went, for each of K members.

    Attributes:
        values: (looks, K) mean value of the initial states.
        td_error: (K,) root mean square of the last tenth's temporal-difference errors, in environment units.
        clipped: (K,) share of the last tenth's targets that were clipped.
    """

    values: FloatArray
    td_error: FloatArray
    clipped: FloatArray


class Trainer:
    """The state of one run. Members are ordered by seed, then ensemble member, then policy."""

    def __init__(
        self,
        architecture: Architecture,
        settings: Settings,
        reward: RewardScale,
        *,
        generators: Sequence[torch.Generator],
        n_policies: int,
        device: str,
    ) -> None:
        self._settings, self._bounds = settings, (reward.low, reward.high)
        self.members = len(generators) * n_policies
        flat = first_weights(architecture, generators, n_policies).to(device)
        gradient = torch.zeros_like(flat)
        self._flat = torch.nn.Parameter(flat)
        self._flat.grad = gradient
        self._target = flat.clone()
        self._layers = views(self._flat.data, architecture, self.members)
        self._gradient = views(gradient, architecture, self.members)
        self.target_layers = views(self._target, architecture, self.members)
        # Weights shrink by the factor 1 - weight_decay at each update; torch multiplies its setting by the rate.
        decay = settings.weight_decay / settings.learning_rate
        # eps is small because u, a mean of z-scored rewards, is (1 - gamma) times the values that its default suits
        self._optimizer = torch.optim.AdamW(
            [self._flat], lr=settings.learning_rate, weight_decay=decay, eps=1e-12, fused=True
        )
        self._squared, self._clipped = (torch.zeros(self.members, device=device) for _ in range(2))

    def update(self, batch: Minibatch, *, measure: bool) -> None:
        """Take one gradient step on a minibatch, and let the target network follow."""
        following = _selected(forward(self.target_layers, batch.next_inputs)[-1], batch.next_select)
        aim = torch.addcmul(batch.earned, batch.carry, following)
        target = aim.clamp(*self._bounds)
        outputs = forward(self._layers, batch.inputs)
        error = _selected(outputs[-1], batch.select) - target
        if measure:
            self._squared += (error * batch.total).square().mean(dim=1)
            self._clipped += (aim != target).to(torch.float32).mean(dim=1)
        upstream = error.mul_(2.0 / error.shape[1]).unsqueeze(2)
        backward(self._layers, outputs, upstream if batch.select is None else upstream * batch.select, self._gradient)
        self._optimizer.step()
        self._target.lerp_(self._flat.data, self._settings.tau)

    @torch.no_grad()
    def run(self, batches: Batches, look: QLook, progress: ProgressCallback, name: str) -> Course:
        """Train to the end."""
        with self._threads(batches.size):
            return self._run(batches, look, progress, name)

    def _threads(self, rows: int) -> AbstractContextManager[None]:
        """Small layers on one thread: sharing them out costs more than it saves."""
        largest = max(weight.numel() for weight, _ in self._layers)
        return one_thread() if largest * rows < SMALL else nullcontext()

    def _run(self, batches: Batches, look: QLook, progress: ProgressCallback, name: str) -> Course:
        updates = self._settings.updates
        last, every = max(updates // 10, 1), max(updates // LOOKS, 1)
        values: list[FloatArray] = []
        for done in range(1, updates + 1):
            self.update(batches.draw(), measure=done > updates - last)
            if done % every == 0 or done == updates:
                values.append(look.values())
                progress(name, done, updates)
        squared, clipped = (part.cpu().numpy().astype(np.float64) / last for part in (self._squared, self._clipped))
        return Course(np.stack(values), np.sqrt(squared), clipped)


@dataclass(frozen=True)
class QLook:
    """The values of the initial states, as training goes."""

    function: NetworkQ
    states: FloatArray
    choices: Choices
    remaining: IntArray | None

    def each(self) -> FloatArray:
        """Return V(s0), (E, P, M)."""
        return self.function.v(self.states, self.choices, self.remaining)

    def values(self) -> FloatArray:
        """Return the mean of V(s0) over the initial states, (E * P,)."""
        return self.each().mean(axis=2).ravel()


def discount_totals(gamma: float, horizon: int | None, scale: float) -> FloatArray:
    """Return the sums of discounts by remaining steps, or the one without a horizon."""
    return np.array([scale]) if horizon is None else step_weights(gamma, horizon)


def _selected(heads: Tensor, select: Tensor | None) -> Tensor:
    return heads.squeeze(2) if select is None else (heads * select).sum(dim=2)
