"""Training of a VAE of whole series."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from oat_gym._rng import torch_generator
from oat_gym.errors import TrainingError
from oat_gym.generation._layers import Adam, initial_weights, one_thread, unpack
from oat_gym.generation._tracker import BestTracker
from oat_gym.generation.padded import IntArray, PaddedSeries
from oat_gym.generation.sampling import History
from oat_gym.generation.sequences import hold_out
from oat_gym.generation.vae import (
    FittedVAE,
    Series,
    VAEConfig,
    VAENetwork,
    initial_scales,
    series_normalizer,
    to_tensors,
)

HELD_OUT_DRAWS = 4
"""Draws of z for each held-out series; the same draws at each look, so that looks can be compared."""

_DESCRIPTION = "training the VAE"


def fit_vae(
    series: PaddedSeries,
    *,
    config: VAEConfig,
    rng: np.random.Generator,
    progress: Callable[[str, int, int], None] | None = None,
) -> FittedVAE:
    """Train a VAE on whole series by maximising the evidence lower bound of what was recorded.

    Args:
        series: the episodes; each is a group of its own for the held-out split.
        config: architecture and training.
        rng: source of all randomness.
        progress: called as progress(description, done, total).

    Raises:
        TrainingError: if training diverges.

    >>> from oat_gym.spaces import Layout
    >>> rng, one = np.random.default_rng(0), Layout(1, (0,), ())
    >>> states, actions = rng.normal(size=(8, 4, 1)), rng.normal(size=(8, 3, 1))
    >>> episodes = list(states), list(actions), list(actions[..., 0])
    >>> series = PaddedSeries.of(*episodes, state_layout=one, action_layout=one)
    >>> fit_vae(series, config=VAEConfig(max_updates=5), rng=rng).sample(10, rng=rng).shape
    (10, 4, 3)
    """
    with one_thread():
        return _Training(series, config, rng).run(progress)


class _Training:
    def __init__(self, series: PaddedSeries, config: VAEConfig, rng: np.random.Generator) -> None:
        self.network = VAENetwork(series.state_layout, series.action_layout, series.rows.shape[1], config)
        self.normalizer = series_normalizer(series)
        self.data = to_tensors(series, self.normalizer, config.device)
        held = hold_out(np.arange(len(series)), share=config.validation, rng=rng, name="The VAE's training set")
        self.train, self.held_out = np.flatnonzero(~held), np.repeat(np.flatnonzero(held), HELD_OUT_DRAWS)
        self.rng, self.noise = rng, torch_generator(rng)
        self.flat = initial_weights(self.network.shapes, self.noise)[None].to(config.device)
        initial_scales(self.flat, self.network.shapes)
        rates = torch.tensor([config.learning_rate], dtype=torch.float32, device=config.device)
        self.adam = Adam(self.flat, rates, clip=config.gradient_clip)
        self.tracker = BestTracker(1, patience=config.patience)
        self.held_out_noise = self._noise(len(self.held_out))
        self.queue: IntArray = self.train[:0]

    def run(self, progress: Callable[[str, int, int], None] | None) -> FittedVAE:
        """Train until the held-out ELBO no longer rises, and return the best model."""
        config = self.network.config
        recent: list[Tensor] = []
        for update in range(1, config.max_updates + 1):
            recent.append(self._update())
            if update % config.evaluate_every and update < config.max_updates:
                continue
            train = torch.stack(recent).mean(0, keepdim=True)
            recent = []
            self.tracker.look(update, train, self._held_out_elbo(train), self.flat)
            if not self.tracker.finite[0]:
                raise TrainingError(
                    f"Training of the VAE diverged (the ELBO is not finite after {update} updates at learning rate "
                    f"{config.learning_rate:g}). Lower learning_rate or gradient_clip, or look for outliers."
                )
            if progress is not None:
                progress(_DESCRIPTION, update, config.max_updates)
            if self.tracker.all_stopped:
                break
        if progress is not None:
            progress(_DESCRIPTION, config.max_updates, config.max_updates)
        weights = unpack(self.tracker.weights, self.network.shapes)
        return FittedVAE(
            network=self.network,
            weights={name: weight.clone() for name, weight in weights.items()},
            normalizer=self.normalizer,
            history=History(*self.tracker.history(0, held_out=len(self.held_out) > 0)),
        )

    def _update(self) -> Tensor:
        """Make one update and return the minibatch's mean ELBO."""
        batch = self._pick(self._minibatch())
        flat = self.flat.requires_grad_()
        elbo = self.network.terms(unpack(flat, self.network.shapes), batch, self._noise(len(batch.rows))).elbo
        # For each row, so that the gradient's size does not grow with the length.
        gradient = torch.autograd.grad(-elbo.sum() / batch.states.sum(), flat)[0]
        self.flat = flat.detach()
        self.adam.step(self.flat, gradient)
        return elbo.detach().mean()

    def _minibatch(self) -> IntArray:
        """Return the next indices; every series is seen once before any is seen again."""
        size = min(self.network.config.batch_size, len(self.train))
        if len(self.queue) < size:
            self.queue = np.concatenate((self.queue, self.rng.permutation(self.train)))
        chosen, self.queue = self.queue[:size], self.queue[size:]
        return chosen

    def _held_out_elbo(self, train: Tensor) -> Tensor:
        """Return the mean ELBO of the held-out series, (1,); the training ELBO where none is held out."""
        if not len(self.held_out):
            return train
        with torch.no_grad():
            weights = unpack(self.flat, self.network.shapes)
            return self.network.terms(weights, self._pick(self.held_out), self.held_out_noise).elbo.mean(
                0, keepdim=True
            )

    def _pick(self, indices: IntArray) -> Series:
        rows = torch.from_numpy(indices).to(self.data.rows.device)
        return Series(*(tensor[rows] for tensor in self.data))

    def _noise(self, count: int) -> Tensor:
        noise = torch.randn((1, count, self.network.config.latent), generator=self.noise, dtype=torch.float32)
        return noise.to(self.network.config.device)
