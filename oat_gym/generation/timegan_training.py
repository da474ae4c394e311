"""TimeGAN's three phases of training.

After Yoon, Jarrett and van der Schaar, "Time-series Generative Adversarial Networks", NeurIPS 2019, and the authors'
code (github.com/jsyoon0823/TimeGAN, timegan.py): the same losses, weights, order of updates and a separate Adam for
each phase. Different: masks for unequal lengths, in losses and moments; and GRU layers in torch's form, which applies
the reset gate behind the product with the state.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from oat_gym._rng import torch_generator
from oat_gym.errors import InvalidDataError, TrainingError
from oat_gym.generation import _timegan_losses as losses
from oat_gym.generation._layers import Adam, Weights, one_thread, unpack
from oat_gym.generation.timegan import FittedTimeGAN, TimeGANConfig, TimeGANNetworks

Progress = Callable[[str, int, int], None]

GENERATOR_UPDATES = 2
"""Updates of generator and embedder for one of the discriminator."""


class Batch(NamedTuple):
    """A minibatch, time-major: scaled rows (L, N, width), which entries (L, N, width) and rows (L, N) count."""

    x: Tensor
    entries: Tensor
    rows: Tensor


def fit_timegan(
    rows: npt.NDArray[np.floating[Any]],
    recorded: npt.NDArray[np.bool_] | None = None,
    *,
    config: TimeGANConfig,
    rng: np.random.Generator,
    progress: Progress | None = None,
) -> FittedTimeGAN:
    """Train TimeGAN on N series of up to L rows.

    Args:
        rows: (N, L, width).
        recorded: (N, L, width) which entries were recorded; a series is recorded from its first row to its last, at
            the end of which entries may be missing. What was not recorded has no effect. `None`: all.
        config: architecture and training.
        rng: source of all randomness.
        progress: called as progress(phase, done, total).

    Raises:
        InvalidDataError: with fewer than two series or two rows, or shapes that do not agree.
        TrainingError: if a loss is not finite; the message names the phase.

    >>> rng = np.random.default_rng(0)
    >>> config = TimeGANConfig(embedding_iterations=2, supervised_iterations=2, joint_iterations=2)
    >>> fit_timegan(rng.normal(size=(8, 5, 2)), config=config, rng=rng).sample(3, rng=rng).shape
    (3, 5, 2)
    """
    if recorded is None:
        recorded = np.ones(rows.shape, dtype=bool)
    if rows.ndim != 3 or rows.shape[0] < 2 or rows.shape[1] < 2 or rows.shape != recorded.shape:
        raise InvalidDataError(
            f"TimeGAN takes (N, L, width) series and a mask of the same shape, N and L at least 2; got {rows.shape} "
            f"and {recorded.shape}."
        )
    with one_thread():
        return _Training(rows, recorded, config, rng).run(progress)


def scaled_and_filled(
    rows: npt.NDArray[np.floating[Any]], recorded: npt.NDArray[np.bool_]
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return min-max scaled rows, and the least and greatest recorded value (width,) of each column.

    A constant column is 0. What was not recorded repeats the row before: the networks read the last row of an episode,
    which has no action, without a jump; no loss counts it.
    """
    low = np.where(recorded, rows, np.inf).min(axis=(0, 1)).astype(np.float64)
    high = np.where(recorded, rows, -np.inf).max(axis=(0, 1)).astype(np.float64)
    spread = np.where(high > low, high - low, 1.0)
    scaled = (np.where(recorded, rows, low) - low) / spread
    for step in range(1, rows.shape[1]):
        scaled[:, step] = np.where(recorded[:, step], scaled[:, step], scaled[:, step - 1])
    return scaled, low, high


class _Training:
    """The state of one training run: weights in the three groups that are updated together."""

    def __init__(
        self,
        rows: npt.NDArray[np.floating[Any]],
        recorded: npt.NDArray[np.bool_],
        config: TimeGANConfig,
        rng: np.random.Generator,
    ) -> None:
        self.config, self.rng, self.noise = config, rng, torch_generator(rng)
        scaled, self.low, self.high = scaled_and_filled(rows, recorded)
        self.lengths = recorded.any(axis=2).sum(axis=1)
        self.x = torch.from_numpy(scaled.astype(np.float32)).to(config.device)
        self.entries = torch.from_numpy(recorded.astype(np.float32)).to(config.device)
        self.networks = TimeGANNetworks(rows.shape[2], config)
        self.flats = {
            group: self.networks.initial(group, self.noise).to(config.device) for group in self.networks.shapes
        }
        self.history: dict[str, list[float]] = {}

    def run(self, progress: Progress | None) -> FittedTimeGAN:
        """Train in three phases."""
        self._phase("embedding", self.config.embedding_iterations, progress, "autoencoder", self.embedding_loss)
        self._phase("supervised", self.config.supervised_iterations, progress, "generator", self.supervised_loss)
        self._joint(progress)
        weights = self._weights("autoencoder") | self._weights("generator")
        kept = ("recovery.", "generator.", "supervisor.")
        return FittedTimeGAN(
            networks=self.networks,
            weights={name: weight.clone() for name, weight in weights.items() if name.startswith(kept)},
            low=self.low,
            high=self.high,
            length=self.x.shape[1],
            history={name: np.array(values) for name, values in self.history.items()},
        )

    def embedding_loss(self, trained: Weights, batch: Batch) -> Tensor:
        """Return 10 sqrt(MSE) of the recovery of embedded rows."""
        recovered = self.networks.recover(trained, self.networks.embed(trained, batch.x))
        return losses.embedder_loss(losses.recovery_loss(batch.x, recovered, batch.entries))

    def supervised_loss(self, trained: Weights, batch: Batch) -> Tensor:
        """Return the error of the supervisor's next step; only the supervisor has a part in it."""
        hidden = self._embedded(batch)
        return losses.supervised_loss(hidden, self.networks.supervise(trained, hidden), batch.rows)

    def generator_loss(self, trained: Weights, batch: Batch) -> Tensor:
        """Return U + gamma U_e + 100 sqrt(S) + 100 V."""
        networks, fixed, size = self.networks, self._weights("discriminator"), batch.x.shape[1]
        hidden, generated = self._embedded(batch), networks.generate(trained, self._noise(batch))
        supervised = networks.supervise(trained, torch.cat((generated, hidden), dim=1))
        fake = supervised[:, :size]
        logits = networks.discriminate(fixed, torch.cat((fake, generated), dim=1))
        recovered = networks.recover(self._weights("autoencoder"), fake)
        return losses.generator_loss(
            losses.real_loss(logits[:, :size], batch.rows),
            losses.real_loss(logits[:, size:], batch.rows),
            losses.supervised_loss(hidden, supervised[:, size:], batch.rows),
            losses.moment_loss(batch.x, recovered, batch.entries),
            self.config.gamma,
        )

    def embedder_loss(self, trained: Weights, batch: Batch) -> Tensor:
        """Return 10 sqrt(MSE) + 0.1 S."""
        hidden = self.networks.embed(trained, batch.x)
        recovered = self.networks.recover(trained, hidden)
        supervised = self.networks.supervise(self._weights("generator"), hidden)
        return losses.embedder_loss(
            losses.recovery_loss(batch.x, recovered, batch.entries),
            losses.supervised_loss(hidden, supervised, batch.rows),
        )

    def discriminator_loss(self, trained: Weights, batch: Batch) -> Tensor:
        """Return the cross-entropy of real and both kinds of generated latent states, gamma on the second kind."""
        networks, fixed, size = self.networks, self._weights("generator"), batch.x.shape[1]
        with torch.no_grad():
            generated = networks.generate(fixed, self._noise(batch))
            hidden = torch.cat((self._embedded(batch), networks.supervise(fixed, generated), generated), dim=1)
        real, fake, fake_e = networks.discriminate(trained, hidden).split(size, dim=1)
        return (
            losses.real_loss(real, batch.rows)
            + losses.fake_loss(fake, batch.rows)
            + self.config.gamma * losses.fake_loss(fake_e, batch.rows)
        )

    def batch(self) -> Batch:
        """Return a random minibatch, as long as its longest series."""
        size = min(self.config.batch_size, len(self.x))
        chosen = self.rng.permutation(len(self.x))[:size]
        return self.take(chosen)

    def take(self, chosen: npt.NDArray[np.int64]) -> Batch:
        """Return the series numbered `chosen`."""
        length, index = int(self.lengths[chosen].max()), torch.from_numpy(chosen).to(self.x.device)
        x, entries = (tensor[index, :length].transpose(0, 1).contiguous() for tensor in (self.x, self.entries))
        return Batch(x, entries, entries.amax(2))

    def _phase(
        self,
        name: str,
        iterations: int,
        progress: Progress | None,
        group: str,
        loss: Callable[[Weights, Batch], Tensor],
    ) -> None:
        adam = self._adam(group)
        for iteration in range(iterations):
            self._update(name, group, adam, loss, self.batch(), phase=name)
            self._report(progress, name, iteration, iterations)

    def _joint(self, progress: Progress | None) -> None:
        adams = {group: self._adam(group) for group in self.flats}
        threshold = self.config.discriminator_threshold
        for iteration in range(self.config.joint_iterations):
            for _ in range(GENERATOR_UPDATES):
                batch = self.batch()
                self._update("generator", "generator", adams["generator"], self.generator_loss, batch)
                self._update("embedder", "autoencoder", adams["autoencoder"], self.embedder_loss, batch)
            updated = self._update(
                "discriminator",
                "discriminator",
                adams["discriminator"],
                self.discriminator_loss,
                self.batch(),
                only_above=threshold,
            )
            self.history.setdefault("discriminator_updated", []).append(float(updated))
            self._report(progress, "joint", iteration, self.config.joint_iterations)

    def _update(
        self,
        name: str,
        group: str,
        adam: Adam,
        loss: Callable[[Weights, Batch], Tensor],
        batch: Batch,
        *,
        phase: str = "joint",
        only_above: float = -math.inf,
    ) -> bool:
        """Make one update of a group, unless the loss is not above `only_above`; return whether it was made."""
        flat = self.flats[group].requires_grad_()
        value = loss(unpack(flat, self.networks.shapes[group]), batch)
        number = float(value.detach())
        self.history.setdefault(name, []).append(number)
        if not math.isfinite(number):
            raise TrainingError(
                f"TimeGAN diverged in the {phase} phase: the {name} loss is {number} at iteration "
                f"{len(self.history[name])}. Lower learning_rate (now {self.config.learning_rate:g})."
            )
        above = number > only_above
        gradient = torch.autograd.grad(value, flat, allow_unused=True)[0] if above else None
        self.flats[group] = flat.detach()
        if gradient is not None:
            adam.step(self.flats[group], gradient)
        return above

    def _adam(self, group: str) -> Adam:
        rates = torch.tensor([self.config.learning_rate], dtype=torch.float32, device=self.config.device)
        return Adam(self.flats[group], rates, clip=math.inf)  # the original does not clip

    def _weights(self, group: str) -> dict[str, Tensor]:
        return unpack(self.flats[group].detach(), self.networks.shapes[group])

    def _embedded(self, batch: Batch) -> Tensor:
        with torch.no_grad():
            return self.networks.embed(self._weights("autoencoder"), batch.x)

    def _noise(self, batch: Batch) -> Tensor:
        return self.networks.noise(batch.rows.shape[0], batch.rows.shape[1], self.noise)

    def _report(self, progress: Progress | None, phase: str, iteration: int, iterations: int) -> None:
        if progress is not None:
            progress(f"training TimeGAN: {phase}", iteration + 1, iterations)
