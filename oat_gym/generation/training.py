"""Training of VAE-MDPs: all sets, and all learning rates of a grid, side by side in one network."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from oat_gym._rng import torch_generator
from oat_gym.errors import InvalidDataError, TrainingError
from oat_gym.generation._layers import Adam, initial_weights, one_thread, unpack
from oat_gym.generation._tracker import BestTracker
from oat_gym.generation.config import VAEMDPConfig
from oat_gym.generation.limits import Limits
from oat_gym.generation.normalizer import Normalizer
from oat_gym.generation.sampling import FittedVAEMDP, History
from oat_gym.generation.sequences import Sequences, hold_out
from oat_gym.generation.vae_mdp import REWARD_LAYOUT, Batch, VAEMDPNetwork
from oat_gym.spaces import Layout

Progress = Callable[[str, int, int], None]
"""Called as progress(description, done, total)."""

HELD_OUT_DRAWS = 4
"""Draws of z for each held-out sequence; the same draws at each look, so that looks can be compared."""


class _SetData(NamedTuple):
    """One set as z-scored tensors, (M, time, width) each, and its split."""

    normalizers: tuple[Normalizer, Normalizer, Normalizer]
    tensors: tuple[Tensor, Tensor, Tensor, Tensor, Tensor]
    train: npt.NDArray[np.int64]
    held_out: npt.NDArray[np.int64]


@dataclass
class _Stream:
    """The random numbers of one set: they depend on its own generator and sizes only, never on other sets'."""

    rng: np.random.Generator
    noise: torch.Generator
    train: npt.NDArray[np.int64]
    size: int
    queue: npt.NDArray[np.int64]

    def minibatch(self) -> npt.NDArray[np.int64]:
        """Return the next indices; every sequence is seen once before any is seen again."""
        if len(self.queue) < self.size:
            self.queue = np.concatenate((self.queue, self.rng.permutation(self.train)))
        chosen, self.queue = self.queue[: self.size], self.queue[self.size :]
        return chosen


def fit_vae_mdp(
    states: npt.NDArray[np.floating[Any]],
    actions: npt.NDArray[np.floating[Any]],
    rewards: npt.NDArray[np.floating[Any]],
    *,
    state_layout: Layout,
    action_layout: Layout,
    config: VAEMDPConfig,
    rng: np.random.Generator,
    groups: npt.NDArray[np.integer[Any]] | None = None,
    mask: npt.NDArray[np.bool_] | None = None,
    terminal: npt.NDArray[np.bool_] | None = None,
    name: str = "PST set 0",
    progress: Progress | None = None,
) -> FittedVAEMDP:
    """Train a VAE-MDP on one set of spans by maximising the evidence lower bound (paper Eq. 1).

    Args:
        states: (M, W+1, state width) flat features, in their own units.
        actions: (M, W, action width).
        rewards: (M, W).
        state_layout: columns of a state.
        action_layout: columns of an action.
        config: architecture and training.
        rng: source of all randomness.
        groups: see `Sequences`, as `mask`, `terminal` and `name`.
        mask: see `Sequences`.
        terminal: see `Sequences`.
        name: see `Sequences`.
        progress: called as progress(description, done, total) while training.

    Raises:
        InvalidDataError: if shapes do not agree.
        TrainingError: if the data is not finite, or training diverges; the message names the set.

    >>> rng = np.random.default_rng(0)
    >>> states, actions = rng.normal(size=(8, 4, 2)), rng.normal(size=(8, 3, 1))
    >>> layout, one = Layout(2, (0, 1), ()), Layout(1, (0,), ())
    >>> config = VAEMDPConfig(max_updates=5)
    >>> model = fit_vae_mdp(
    ...     states, actions, states[:, 1:, 0], state_layout=layout, action_layout=one, config=config, rng=rng
    ... )
    >>> model.sample(10, rng=rng, actions=np.zeros((10, 3, 1))).states.shape
    (10, 4, 2)
    """
    spans = Sequences(states, actions, rewards, groups, mask, terminal, name)
    models = fit_many(
        [spans], state_layout=state_layout, action_layout=action_layout, config=config, rng=rng, progress=progress
    )
    return models[0]


def fit_many(
    sets: Sequence[Sequences],
    *,
    state_layout: Layout,
    action_layout: Layout,
    config: VAEMDPConfig,
    rng: np.random.Generator,
    progress: Progress | None = None,
) -> list[FittedVAEMDP]:
    """Train one VAE-MDP for each set, all in one batched network (less time than one after the other).

    Each set has its own weights, random stream, held-out episodes, gradient norm and early stop, so its model is the
    one it would get alone, up to rounding.

    Raises:
        InvalidDataError: if there are no sets, or their W, widths or end heads differ.
        TrainingError: if training of a set diverges at every learning rate; the message names it.
    """
    _check_sets(sets, state_layout, action_layout)
    network = VAEMDPNetwork(state_layout, action_layout, config, ends=sets[0].terminal is not None)
    streams = rng.spawn(len(sets))
    with one_thread():
        data = [_prepare(s, network, stream) for s, stream in zip(sets, streams, strict=True)]
        return _Training(network, sets, data, streams).run(progress)


class _Training:
    """The state of one training run. Members are ordered by set, then by learning rate."""

    def __init__(
        self,
        network: VAEMDPNetwork,
        sets: Sequence[Sequences],
        data: Sequence[_SetData],
        rngs: Sequence[np.random.Generator],
    ) -> None:
        config = network.config
        self.network, self.sets, self.data = network, sets, data
        self.rates = len(config.learning_rates)
        self.streams = [
            _Stream(rng, torch_generator(rng), d.train, min(config.batch_size, len(d.train)), d.train[:0])
            for d, rng in zip(data, rngs, strict=True)
        ]
        first = torch.stack([initial_weights(network.shapes, stream.noise) for stream in self.streams])
        self.flat = self._to_members(first)
        learning_rates = torch.tensor(config.learning_rates * len(data), dtype=torch.float32, device=config.device)
        self.adam = Adam(self.flat, learning_rates, clip=config.gradient_clip, decay=config.lr_decay)
        self.held_out = self._held_out_batch()
        self.tracker = BestTracker(len(self.flat), patience=config.patience, start=network.kl_warmup)

    def run(self, progress: Progress | None) -> list[FittedVAEMDP]:
        """Train until every member has stopped, and return the best model of each set."""
        config = self.network.config
        description = f"training {len(self.sets)} VAE-MDPs" if len(self.sets) > 1 else f"training {self.sets[0].name}"
        recent: list[Tensor] = []
        for update in range(1, config.max_updates + 1):
            recent.append(self._update(update))
            if update % config.evaluate_every and update < config.max_updates:
                continue
            train = torch.stack(recent).mean(0)
            recent = []
            self.tracker.look(update, train, self._held_out_elbo(train), self.flat)
            self._check_alive(update)
            if progress is not None:
                progress(description, update, config.max_updates)
            if self.tracker.all_stopped:
                break
        if progress is not None:
            progress(description, config.max_updates, config.max_updates)
        return [self._result(index) for index in range(len(self.sets))]

    def _update(self, update: int) -> Tensor:
        """Make one update of every member and return each one's ELBO for a sequence, (K,)."""
        batch, noise, present = self._batch([s.minibatch() for s in self.streams], [s.noise for s in self.streams])
        flat = self.flat.requires_grad_()
        terms = self.network.terms(unpack(flat, self.network.shapes), batch, noise)
        kl_weight = min(1.0, update / max(1, self.network.kl_warmup))
        # For each time step, so that the gradient's size does not grow with W.
        steps = (present[:, None] * batch.mask).sum((1, 2)) + present.sum(1)
        loss = -((terms.elbo(kl_weight) * present).sum(1) / steps).sum()
        gradient = torch.autograd.grad(loss, flat)[0]
        self.flat = flat.detach()
        self.adam.step(self.flat, gradient)
        return (terms.elbo().detach() * present).sum(1) / present.sum(1)

    def _batch(
        self, indices: Sequence[npt.NDArray[np.int64]], generators: Sequence[torch.Generator]
    ) -> tuple[Batch, Tensor, Tensor]:
        """Return a batch, its noise and which of its sequences exist (K, N); sets with fewer sequences are padded."""
        width = max(len(chosen) for chosen in indices)
        latent, length = self.network.config.latent, self.sets[0].steps + 1
        tensors: list[list[Tensor]] = []
        present = torch.zeros((len(indices), width))
        for row, (chosen, generator) in enumerate(zip(indices, generators, strict=True)):
            present[row, : len(chosen)] = 1.0
            noise = torch.randn((len(chosen), length, latent), generator=generator, dtype=torch.float32)
            picked = [tensor[torch.from_numpy(chosen)] for tensor in self.data[row].tensors]
            tensors.append([_pad(tensor, width).transpose(0, 1) for tensor in (*picked, noise)])
        stacked = [self._to_members(torch.stack(parts).contiguous()) for parts in zip(*tensors, strict=True)]
        states, actions, rewards, mask, terminal, noise = stacked
        return Batch(states, actions, rewards, mask, terminal), noise, self._to_members(present)

    def _held_out_batch(self) -> tuple[Batch, Tensor, Tensor] | None:
        """Return the held-out sequences, each several times with its own noise; `None` if no set holds any out."""
        if not any(len(d.held_out) for d in self.data):
            return None
        indices = [np.repeat(d.held_out, HELD_OUT_DRAWS) for d in self.data]
        return self._batch(indices, [stream.noise for stream in self.streams])

    def _held_out_elbo(self, train: Tensor) -> Tensor:
        """Return each member's ELBO for a held-out sequence, (K,); the training ELBO where its set holds none out."""
        if self.held_out is None:
            return train
        batch, noise, present = self.held_out
        with torch.no_grad():
            elbo = self.network.terms(unpack(self.flat, self.network.shapes), batch, noise).elbo()
        count = present.sum(1)
        return torch.where(count > 0, (elbo * present).sum(1) / count.clamp(min=1.0), train)

    def _check_alive(self, update: int) -> None:
        """Raise `TrainingError` for a set whose members have all diverged."""
        alive = self.tracker.finite.view(len(self.sets), self.rates).any(1)
        for spans, is_alive in zip(self.sets, alive.tolist(), strict=True):
            if not is_alive:
                raise TrainingError(
                    f"{spans.name}: training diverged (the ELBO is not finite after {update} updates at every learning "
                    f"rate of {self.network.config.learning_rates}). Lower learning_rate or gradient_clip, or look for "
                    "outliers in the data."
                )

    def _result(self, index: int) -> FittedVAEMDP:
        members = range(index * self.rates, (index + 1) * self.rates)
        best = max(members, key=lambda member: float(self.tracker.score[member]))
        weights = unpack(self.tracker.weights[best : best + 1], self.network.shapes)
        held_out = len(self.data[index].held_out) > 0
        return FittedVAEMDP(
            network=self.network,
            weights={name: weight.clone() for name, weight in weights.items()},
            normalizers=self.data[index].normalizers,
            limits=Limits.of(*self.sets[index].rows(), margin=self.network.config.range_margin),
            steps=self.sets[index].steps,
            learning_rate=self.network.config.learning_rates[best % self.rates],
            history=History(*self.tracker.history(best, held_out=held_out)),
            name=self.sets[index].name,
        )

    def _to_members(self, per_set: Tensor) -> Tensor:
        return per_set.repeat_interleave(self.rates, dim=0).to(self.network.config.device)


def _check_sets(sets: Sequence[Sequences], state_layout: Layout, action_layout: Layout) -> None:
    if not sets:
        raise InvalidDataError("There are no sets of spans to train on; lower the support threshold or W.")
    for spans in sets:
        spans.check_layouts(state_layout, action_layout)
        if spans.steps != sets[0].steps or (spans.terminal is None) != (sets[0].terminal is None):
            raise InvalidDataError(
                f"{spans.name} has W={spans.steps} and {sets[0].name} W={sets[0].steps}, or only one has terminal "
                "flags: sets trained together must agree. Pad with a mask, or call fit_vae_mdp for each."
            )


def _prepare(spans: Sequences, network: VAEMDPNetwork, rng: np.random.Generator) -> _SetData:
    """Return a set as z-scored float32 tensors, padding set to 0, and its held-out split."""
    layouts = (network.state_layout, network.action_layout, REWARD_LAYOUT)
    state, action, reward = (Normalizer.fit(x, layout) for x, layout in zip(spans.rows(), layouts, strict=True))
    recorded = spans.recorded
    terminal = np.zeros_like(recorded) if spans.terminal is None else spans.terminal & recorded
    values = (
        np.where(spans.recorded_states[..., None], state.normalize(spans.states), 0.0),
        np.where(recorded[..., None], action.normalize(spans.actions), 0.0),
        np.where(recorded[..., None], reward.normalize(spans.rewards[..., None]), 0.0),
        recorded,
        terminal,
    )
    held = hold_out(spans.group_ids, share=network.config.validation, rng=rng, name=spans.name)
    tensors = tuple(torch.from_numpy(np.ascontiguousarray(x, dtype=np.float32)) for x in values)
    return _SetData((state, action, reward), tensors, np.flatnonzero(~held), np.flatnonzero(held))  # type: ignore[arg-type]


def _pad(tensor: Tensor, rows: int) -> Tensor:
    return (
        torch.cat((tensor, tensor.new_zeros((rows - len(tensor), *tensor.shape[1:])))) if len(tensor) < rows else tensor
    )
