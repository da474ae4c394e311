"""TimeGAN's five networks (Yoon, Jarrett and van der Schaar, NeurIPS 2019) and series drawn from them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from oat_gym._rng import torch_generator
from oat_gym.errors import ConfigurationError, TrainingError
from oat_gym.generation._gru import gru, gru_shapes, open_gates
from oat_gym.generation._layers import Shapes, Weights, initial_weights, layer_shapes, linear, one_thread, unpack
from oat_gym.generation.config import check_integer, check_number


@dataclass(frozen=True)
class TimeGANConfig:
    """Architecture and training of TimeGAN.

    Attributes:
        hidden: nodes of a GRU layer, and dimension of the latent space.
        layers: GRU layers of a network; the supervisor has one less.
        embedding_iterations: minibatches of the first phase, embedder and recovery.
        supervised_iterations: minibatches of the second phase, supervisor and generator.
        joint_iterations: iterations of the third phase, all together: two updates of generator and embedder each, and
            at most one of the discriminator.
        batch_size: series in a minibatch.
        learning_rate: Adam's learning rate; by default above the original's 1e-3, since there are fewer iterations.
        gamma: weight of the losses on the generator's output before the supervisor.
        discriminator_threshold: the discriminator is updated only while its loss is above this.
        device: torch device to train and sample on.

    Raises:
        ConfigurationError: if a value is out of its range.

    >>> TimeGANConfig.from_preset("paper").joint_iterations
    50000
    """

    hidden: int = 24
    layers: int = 3
    embedding_iterations: int = 600
    supervised_iterations: int = 300
    joint_iterations: int = 200
    batch_size: int = 16
    learning_rate: float = 3e-3
    gamma: float = 1.0
    discriminator_threshold: float = 0.15
    device: str = "cpu"

    def __post_init__(self) -> None:
        for name in ("hidden", "embedding_iterations", "supervised_iterations", "joint_iterations"):
            check_integer(name, getattr(self, name), at_least=1)
        check_integer("layers", self.layers, at_least=2)
        check_integer("batch_size", self.batch_size, at_least=2)
        check_number("learning_rate", self.learning_rate, above=0.0)
        check_number("gamma", self.gamma, at_least=0.0)
        check_number("discriminator_threshold", self.discriminator_threshold, at_least=0.0)

    @classmethod
    def from_preset(cls, preset: str) -> TimeGANConfig:
        """Return a named configuration: "default", or "paper" (50,000 iterations a phase, batches of 128, rate 1e-3).

        Raises:
            ConfigurationError: for any other name.
        """
        check_preset(preset)
        if preset == "default":
            return cls()
        many = 50_000
        return cls(
            embedding_iterations=many,
            supervised_iterations=many,
            joint_iterations=many,
            batch_size=128,
            learning_rate=1e-3,
        )


@dataclass(frozen=True)
class TimeGANNetworks:
    """The five networks as functions of their weights and time-major series (L, N, ...).

    Each is a GRU stack and an affine layer, with a sigmoid but for the discriminator. All run forwards in time, so that
    padding behind the end of a series cannot change what comes before.

    Attributes:
        width: columns of a row, and of the noise.
        config: sizes.
    """

    width: int
    config: TimeGANConfig

    @cached_property
    def shapes(self) -> dict[str, Shapes]:
        """Shape of each weight, in the three groups that are updated together."""
        hidden, width = self.config.hidden, self.width
        return {
            "autoencoder": self._network("embedder", width, hidden) | self._network("recovery", hidden, width),
            "generator": self._network("generator", width, hidden)
            | self._network("supervisor", hidden, hidden, less=1),
            "discriminator": self._network("discriminator", hidden, 1),
        }

    def initial(self, group: str, generator: torch.Generator) -> Tensor:
        """Return fresh weights of a group, (1, P)."""
        flat = initial_weights(self.shapes[group], generator)[None]
        open_gates(unpack(flat, self.shapes[group]), self.config.hidden)
        return flat

    def embed(self, weights: Weights, x: Tensor) -> Tensor:
        """Return latent states (L, N, hidden) of rows (L, N, width)."""
        return _run(weights, "embedder", x).sigmoid()

    def recover(self, weights: Weights, hidden: Tensor) -> Tensor:
        """Return rows (L, N, width), min-max scaled, of latent states."""
        return _run(weights, "recovery", hidden).sigmoid()

    def generate(self, weights: Weights, noise: Tensor) -> Tensor:
        """Return latent states before the supervisor of noise (L, N, width)."""
        return _run(weights, "generator", noise).sigmoid()

    def supervise(self, weights: Weights, hidden: Tensor) -> Tensor:
        """Return each next latent state, predicted from those up to now."""
        return _run(weights, "supervisor", hidden).sigmoid()

    def discriminate(self, weights: Weights, hidden: Tensor) -> Tensor:
        """Return the logits (L, N) of latent states being real."""
        return _run(weights, "discriminator", hidden)[..., 0]

    def noise(self, length: int, count: int, generator: torch.Generator) -> Tensor:
        """Return uniform noise (length, count, width), drawn on the CPU so that every device sees the same."""
        noise = torch.rand((length, count, self.width), generator=generator, dtype=torch.float32)
        return noise.to(self.config.device)

    def _network(self, name: str, inputs: int, outputs: int, *, less: int = 0) -> dict[str, tuple[int, int]]:
        hidden = self.config.hidden
        shapes = gru_shapes(name, inputs, hidden, self.config.layers - less)
        return shapes | layer_shapes(f"{name}.out", hidden, outputs)


@dataclass(frozen=True)
class FittedTimeGAN:
    """A trained TimeGAN. Made by `fit_timegan`; see there for an example.

    Attributes:
        networks: architecture.
        weights: weights of generator, supervisor and recovery by name, with a leading axis of one.
        low: (width,) least recorded value of each column.
        high: (width,) greatest.
        length: L, rows of the longest series.
        history: loss of each iteration by name: "embedding", "supervised", "generator", "embedder", "discriminator",
            and 0/1 "discriminator_updated".
    """

    networks: TimeGANNetworks
    weights: Mapping[str, Tensor]
    low: npt.NDArray[np.float64]
    high: npt.NDArray[np.float64]
    length: int
    history: Mapping[str, npt.NDArray[np.float64]]

    def sample(self, count: int, *, rng: np.random.Generator) -> npt.NDArray[np.float64]:
        """Return `count` series of L rows in the data's units and range, (count, L, width).

        Raises:
            TrainingError: if a generated value is not finite.
        """
        networks = self.networks
        with one_thread(), torch.no_grad():
            noise = networks.noise(self.length, count, torch_generator(rng))
            hidden = networks.supervise(self.weights, networks.generate(self.weights, noise))
            scaled = networks.recover(self.weights, hidden).transpose(0, 1).cpu().numpy()
        if not np.isfinite(scaled).all():
            raise TrainingError("TimeGAN generates values that are not finite. Train it with a lower learning_rate.")
        return self.low + scaled.astype(np.float64) * (self.high - self.low)

    def to_arrays(self) -> dict[str, npt.NDArray[Any]]:
        """Return everything but the configuration as named arrays, to store without pickle."""
        arrays = {f"weight.{name}": weight.detach().cpu().numpy().copy() for name, weight in self.weights.items()}
        arrays |= {f"history.{name}": losses.copy() for name, losses in self.history.items()}
        return arrays | {"low": self.low.copy(), "high": self.high.copy(), "length": np.array([self.length])}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, npt.NDArray[Any]], *, config: TimeGANConfig) -> FittedTimeGAN:
        """Return the model whose arrays `to_arrays` gave; its samples are the same byte for byte."""
        networks = TimeGANNetworks(len(arrays["low"]), config)
        names = [name for name in arrays if name.startswith("weight.")]
        histories = [name for name in arrays if name.startswith("history.")]
        return cls(
            networks=networks,
            weights={n.removeprefix("weight."): torch.tensor(arrays[n], device=config.device) for n in names},
            low=np.array(arrays["low"]),
            high=np.array(arrays["high"]),
            length=int(arrays["length"][0]),
            history={name.removeprefix("history."): np.array(arrays[name]) for name in histories},
        )


def check_preset(preset: str) -> None:
    """Raise `ConfigurationError` unless `preset` is "default" or "paper"."""
    if preset not in ("default", "paper"):
        raise ConfigurationError(f'preset must be "default" or "paper", got {preset!r}.')


def _run(weights: Weights, name: str, x: Tensor) -> Tensor:
    return linear(weights, f"{name}.out", gru(weights, name, x)[None])[0]
