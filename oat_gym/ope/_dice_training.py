"""Training of network DICE: the saddle point of the Lagrangian for all policies and seeds side by side."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor
from torch.nn.functional import softplus

from oat_gym._rng import derive, torch_generator
from oat_gym.episodes import IntArray
from oat_gym.errors import TrainingError
from oat_gym.generation._layers import one_thread
from oat_gym.ope._dice_data import DiceBatch, DiceBatches, columns, encoder_of
from oat_gym.ope._fqe_batch import Encoder
from oat_gym.ope._fqe_network import Architecture, backward, first_weights, forward, views
from oat_gym.ope._q_function import value_scale
from oat_gym.ope.problem import Problem

FloatArray = npt.NDArray[np.float64]
SHIFT = 0.5413248546129181
"""softplus(SHIFT) = 1: positive ratios start near one."""
LOOKS = 10
"""How often the ratios are taken in the second half of the updates; their mean is used."""
BLOCK = 4096
"""Rows of one member that are evaluated at a time."""


@dataclass(frozen=True)
class Objective:
    """Terms of the Lagrangian and how its saddle point is looked for; see `DICE`."""

    primal: float
    dual: float
    reward: bool
    normalise: bool
    positive: bool
    hidden: tuple[int, ...]
    updates: int
    batch_size: int
    nu_rate: float
    zeta_rate: float
    action_draws: int


class Saddle:
    """nu, zeta and lambda of K members, and one step of gradient descent (nu, lambda) and ascent (zeta)."""

    def __init__(
        self, architecture: Architecture, objective: Objective, *, seeds: Sequence[int], policies: int, problem: Problem
    ) -> None:
        self._objective, self._gamma, self._scale = objective, problem.gamma, value_scale(problem)
        self._members, device = len(seeds) * policies, problem.device
        generators = [[torch_generator(derive(seed, "dice", part)) for seed in seeds] for part in ("nu", "zeta")]
        flats = [torch.nn.Parameter(first_weights(architecture, part, policies).to(device)) for part in generators]
        gradients = [torch.zeros_like(flat) for flat in flats]
        self._lambda = torch.nn.Parameter(torch.zeros(self._members, device=device))
        self._lambda.grad = torch.zeros(self._members, device=device)
        for flat, gradient in zip(flats, gradients, strict=True):
            flat.grad = gradient
        self._nu, self.zeta_layers = (views(flat.data, architecture, self._members) for flat in flats)
        self._nu_gradient, self._zeta_gradient = (views(g, architecture, self._members) for g in gradients)
        settings = ((flats[0], objective.nu_rate), (flats[1], objective.zeta_rate), (self._lambda, objective.nu_rate))
        groups = [{"params": [part], "lr": rate} for part, rate in settings]
        self._optimizer = torch.optim.Adam(groups, betas=(0.0, 0.99), fused=True)

    def ratio(self, raw: Tensor) -> Tensor:
        """Return zeta from the network's output."""
        return softplus(raw + SHIFT) if self._objective.positive else raw + 1.0

    def update(self, batch: DiceBatch) -> None:
        """Take one step on a minibatch."""
        want, size, gamma = self._objective, batch.done.shape[1], self._gamma
        own = None if batch.select is None else batch.select[:, :size]
        nu = forward(self._nu, batch.inputs)
        zeta = forward(self.zeta_layers, batch.inputs[:, :size])
        values = selected(nu[-1], batch.select) * self._scale
        raw = selected(zeta[-1], own)
        ratio = self.ratio(raw)
        now, after, first = values.split(size, dim=1)
        going = 1.0 - batch.done
        error = gamma * (going * after + batch.done * first) - now
        if want.reward:
            error += batch.rewards
        if want.normalise:
            error -= self._lambda.data[:, None]
        pull = torch.cat(
            (want.primal * now - ratio, gamma * going * ratio, (1 - gamma) + gamma * batch.done * ratio), dim=1
        )
        push = want.dual * ratio - error
        if want.positive:
            push *= (raw + SHIFT).sigmoid()
        backward(self._nu, nu, upstream(pull / size, batch.select), self._nu_gradient)
        backward(self.zeta_layers, zeta, upstream(push / size, own), self._zeta_gradient)
        if self._lambda.grad is not None and want.normalise:
            self._lambda.grad.copy_(1.0 - ratio.mean(dim=1))
        self._optimizer.step()


@dataclass(frozen=True)
class TrainedRatios:
    """Mean ratios (S, P, n) of the looks in the second half of the updates: the earlier and the later looks."""

    earlier: FloatArray
    later: FloatArray


@torch.no_grad()
def train_ratios(
    problem: Problem, objective: Objective, rows: IntArray, *, seeds: Sequence[int], name: str
) -> TrainedRatios:
    """Train all policies and seeds, and return the ratios of the weighted rows.

    Raises:
        TrainingError: if a ratio is not finite; the message names the policy.
    """
    encoder, policies = encoder_of(problem), len(problem.policies)
    batches = DiceBatches(problem, encoder, size=objective.batch_size, action_draws=objective.action_draws, seeds=seeds)
    architecture = Architecture(encoder.inputs, objective.hidden, encoder.heads)
    saddle = Saddle(architecture, objective, seeds=seeds, policies=policies, problem=problem)
    moments = _look_moments(objective.updates)
    halves = np.zeros((2, len(seeds) * policies, len(rows)))
    with one_thread():
        for done in range(1, objective.updates + 1):
            saddle.update(batches.draw())
            if done in moments:
                half = int(moments.index(done) >= len(moments) // 2)
                halves[half] += _ratios(saddle, problem, encoder, rows)
                problem.progress(name, done, objective.updates)
            elif done % max(objective.updates // 20, 1) == 0:
                problem.progress(name, done, objective.updates)
    first = max(len(moments) // 2, 1)
    earlier, later = (
        (part / count).reshape(len(seeds), policies, -1)
        for part, count in zip(halves, (first, max(len(moments) - first, 1)), strict=True)
    )
    trained = TrainedRatios(earlier if len(moments) > 1 else later, later)
    _check_finite(problem, trained)
    return trained


def _look_moments(updates: int) -> list[int]:
    first = updates // 2
    return sorted({first + round((updates - first) * k / LOOKS) for k in range(1, LOOKS + 1)})


def _ratios(saddle: Saddle, problem: Problem, encoder: Encoder, rows: IntArray) -> FloatArray:
    """Return zeta (K, n) of the rows."""
    members, device = len(saddle.zeta_layers[0][0]), problem.device
    parts: list[FloatArray] = []
    for start in range(0, len(rows), BLOCK):
        block = rows[start : start + BLOCK]
        states = encoder.states(problem.data.states[block], device)[None]
        actions = encoder.actions(problem.data.actions[block], device)[None]
        remaining = torch.from_numpy((problem.horizon or 0) - problem.data.steps.step[block]).to(device)[None]
        inputs = columns(encoder, states, None if encoder.discrete else actions[None], remaining, policies=1)
        raw = selected(
            forward(saddle.zeta_layers, inputs.expand(members, -1, -1))[-1], actions if encoder.discrete else None
        )
        parts.append(saddle.ratio(raw.double()).cpu().numpy())  # ratios may sink below what float32 holds
    return np.concatenate(parts, axis=1)


def _check_finite(problem: Problem, trained: TrainedRatios) -> None:
    bad = ~np.isfinite(trained.later + trained.earlier).all(axis=(0, 2))
    if bad.any():
        name = problem.policies.names[int(np.flatnonzero(bad)[0])]
        raise TrainingError(
            f"DICE diverged: the ratios of policy {name!r} are not finite. Lower nu_rate and zeta_rate, or check the "
            "data for extreme rewards and observations."
        )


def selected(heads: Tensor, select: Tensor | None) -> Tensor:
    """Return (K, B): the one output, or the mean of the heads under `select` (K, B, heads)."""
    return heads.squeeze(2) if select is None else (heads * select).sum(dim=2)


def upstream(slope: Tensor, select: Tensor | None) -> Tensor:
    """Return (K, B, heads): the derivative with respect to the heads from that of `selected` (K, B)."""
    return slope.unsqueeze(2) if select is None else slope.unsqueeze(2) * select
