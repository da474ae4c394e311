"""A variational autoencoder of whole series, with no notion of steps that follow from each other."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from oat_gym._rng import torch_generator
from oat_gym.errors import TrainingError
from oat_gym.generation._layers import Shapes, Weights, mlp, mlp_shapes, one_thread, unpack
from oat_gym.generation.config import check_hidden, check_integer, check_number
from oat_gym.generation.distributions import Gaussian, MixedHead, gaussian_from, gaussian_kl
from oat_gym.generation.normalizer import Normalizer, layout_from_arrays, layout_to_arrays
from oat_gym.generation.padded import PaddedSeries, series_layout
from oat_gym.generation.sampling import History
from oat_gym.spaces import Layout

_LEAST_POSTERIOR_SCALE = 1e-3


@dataclass(frozen=True)
class VAEConfig:
    """Architecture and training of a VAE of whole series.

    Attributes:
        latent: dimension of z.
        encoder: hidden layers of q(z|x); those of p(x|z) are the same in reverse order.
        learning_rate: Adam's learning rate.
        batch_size: series in a minibatch.
        max_updates: most minibatch updates.
        patience: stop after so many updates without a better held-out ELBO, and go back to the best weights; `None`
            runs all updates and keeps the last weights.
        evaluate_every: updates between two looks at the held-out ELBO.
        validation: share of the episodes held out; see `VAEMDPConfig.validation`.
        gradient_clip: largest norm of the gradient of the loss (negative ELBO for each row).
        scale_floor: least scale of the Gaussians, in standard deviations of the data.
        range_margin: generated values may leave the data's range by this share of it.
        device: torch device to train and sample on.

    Raises:
        ConfigurationError: if a value is out of its range.

    >>> VAEConfig().latent
    16
    """

    latent: int = 16
    encoder: tuple[int, ...] = (128, 64)
    learning_rate: float = 1e-3
    batch_size: int = 32
    max_updates: int = 2000
    patience: int | None = 200
    evaluate_every: int = 20
    validation: float = 0.2
    gradient_clip: float = 10.0
    scale_floor: float = 0.05
    range_margin: float = 0.1
    device: str = "cpu"

    def __post_init__(self) -> None:
        for name in ("latent", "batch_size", "max_updates", "evaluate_every"):
            check_integer(name, getattr(self, name), at_least=1)
        if self.patience is not None:
            check_integer("patience", self.patience, at_least=1)
        check_hidden("encoder", self.encoder)
        for name in ("learning_rate", "gradient_clip", "scale_floor"):
            check_number(name, getattr(self, name), above=0.0)
        check_number("validation", self.validation, at_least=0.0, below=1.0)
        check_number("range_margin", self.range_margin, at_least=0.0)


class Series(NamedTuple):
    """A batch of z-scored series.

    `rows` is (N, L, width); `states` and `steps` (N, L) are 1 where a row has a state, and an action and a reward too.
    """

    rows: Tensor
    states: Tensor
    steps: Tensor


class Terms(NamedTuple):
    """The parts of each series' ELBO, (N,) each: the log-likelihood of what was recorded, and KL(q || prior)."""

    log_likelihood: Tensor
    kl: Tensor

    @property
    def elbo(self) -> Tensor:
        """The evidence lower bound."""
        return self.log_likelihood - self.kl


@dataclass(frozen=True)
class VAENetwork:
    """Encoder q(z|x), prior N(0, I) and decoder p(x|z) of series of `length` rows.

    The decoder gives a mean for each entry and logits for each category of the whole series at once. The scale of a
    Gaussian is learnt for each column (Rybkin et al. 2021): one for each entry would have no more than the few episodes
    to be learnt from.

    Attributes:
        state_layout: columns of a state.
        action_layout: columns of an action.
        length: L, rows of the longest series.
        config: sizes and training.
    """

    state_layout: Layout
    action_layout: Layout
    length: int
    config: VAEConfig

    @cached_property
    def layout(self) -> Layout:
        """The columns of a row [state, action, reward]."""
        return series_layout(self.state_layout, self.action_layout)

    @property
    def heads(self) -> tuple[MixedHead, MixedHead, MixedHead]:
        """The distributions of states, actions and rewards."""
        layouts = (self.state_layout, self.action_layout, Layout(1, (0,), ()))
        state, action, reward = (MixedHead(layout, self.config.scale_floor) for layout in layouts)
        return state, action, reward

    @property
    def shapes(self) -> Shapes:
        """Shape of each weight."""
        hidden, latent = self.config.encoder, self.config.latent
        shapes = mlp_shapes("encoder", self.length * self.layout.width, hidden, 2 * latent)
        shapes |= mlp_shapes("decoder", latent, hidden[::-1], self.length * self.layout.width)
        return shapes | {"scale.bias": (1, len(self.layout.continuous))}

    @property
    def size(self) -> int:
        """Number of weights."""
        return sum(rows * columns for rows, columns in self.shapes.values())

    def posterior(self, weights: Weights, series: Series) -> Gaussian:
        """Return q(z|x), (1, N, latent); what was not recorded is seen as 0, the mean of the data."""
        return gaussian_from(mlp(weights, "encoder", series.rows.flatten(1)[None]), _LEAST_POSTERIOR_SCALE)

    def decode(self, weights: Weights, z: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the outputs (N, L, head width) for the three heads, given z (1, N, latent)."""
        entries = mlp(weights, "decoder", z)[0].unflatten(1, (self.length, self.layout.width))
        scales = weights["scale.bias"].expand(len(entries), self.length, -1)
        outputs: list[Tensor] = []
        column = scale = 0
        for head in self.heads:
            part = entries[..., column : column + head.layout.width]
            count = len(head.layout.continuous)
            logits = [part[..., start:stop] for start, stop in head.layout.categorical]
            outputs.append(torch.cat((head.continuous(part), scales[..., scale : scale + count], *logits), dim=-1))
            column, scale = column + head.layout.width, scale + count
        state, action, reward = outputs
        return state, action, reward

    def log_likelihood(self, weights: Weights, z: Tensor, series: Series) -> Tensor:
        """Return log p(x|z) (N,) of what was recorded; the entries that were not have no part in it."""
        state, action, reward = self.decode(weights, z)
        s, a, r = series.rows.split((self.state_layout.width, self.action_layout.width, 1), dim=-1)
        state_head, action_head, reward_head = self.heads
        steps = action_head.log_prob(action, a) + reward_head.log_prob(reward, r)
        return (state_head.log_prob(state, s) * series.states + steps * series.steps).sum(1)

    def terms(self, weights: Weights, series: Series, noise: Tensor) -> Terms:
        """Return the ELBO's parts with one draw z = mean + scale * noise for each series; `noise` is (1, N, latent)."""
        q = self.posterior(weights, series)
        prior = Gaussian(torch.zeros_like(q.mean), torch.ones_like(q.scale))
        z = q.mean + q.scale * noise
        return Terms(self.log_likelihood(weights, z, series), gaussian_kl(q, prior)[0])


@dataclass(frozen=True)
class FittedVAE:
    """A trained VAE. Made by `fit_vae`; see there for an example.

    Attributes:
        network: architecture.
        weights: weights by name, with a leading axis of one.
        normalizer: of the rows.
        history: training and held-out ELBO.
    """

    network: VAENetwork
    weights: Mapping[str, Tensor]
    normalizer: Normalizer
    history: History

    def sample(
        self,
        count: int,
        *,
        rng: np.random.Generator,
        start: PaddedSeries | None = None,
        observation_noise: bool = True,
    ) -> npt.NDArray[np.float64]:
        """Return `count` series of L rows [s, a, r] in the data's units, (count, L, width); discrete parts one-hot.

        z comes from the prior, or, with `start` (`count` series), from q(z|x) of each of them. Rows are drawn from
        p(x|z), or, without `observation_noise`, are its means and most likely categories.

        Raises:
            TrainingError: if a generated value is not finite.
        """
        generator = torch_generator(rng)
        with one_thread(), torch.no_grad():
            z = torch.randn((1, count, self.network.config.latent), generator=generator, dtype=torch.float32)
            z = z.to(self.network.config.device)
            if start is not None:
                q = self.network.posterior(self.weights, to_tensors(start, self.normalizer, self.network.config.device))
                z = q.mean + q.scale * z
            outputs = self.network.decode(self.weights, z)
            noise = generator if observation_noise else None
            parts = [head.sample(output, noise) for head, output in zip(self.network.heads, outputs, strict=True)]
        rows = self.normalizer.denormalize(torch.cat(parts, dim=-1).cpu().numpy())
        if not np.isfinite(rows).all():
            raise TrainingError(
                "The VAE generates values that are not finite, so it is of no use. Train with a lower learning_rate or "
                "gradient_clip, or look for outliers in the data."
            )
        return rows

    def to_arrays(self) -> dict[str, npt.NDArray[Any]]:
        """Return everything but the configuration as named arrays, to store without pickle."""
        arrays = {f"weight.{name}": weight.detach().cpu().numpy().copy() for name, weight in self.weights.items()}
        arrays |= self.normalizer.to_arrays("normalizer")
        arrays |= layout_to_arrays(self.network.state_layout, "layout.state")
        arrays |= layout_to_arrays(self.network.action_layout, "layout.action")
        arrays |= {f"history.{name}": np.array(values) for name, values in self.history._asdict().items()}
        return arrays | {"length": np.array([self.network.length])}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, npt.NDArray[Any]], *, config: VAEConfig) -> FittedVAE:
        """Return the model whose arrays `to_arrays` gave; its samples are the same byte for byte."""
        state_layout, action_layout = (layout_from_arrays(arrays, f"layout.{what}") for what in ("state", "action"))
        network = VAENetwork(state_layout, action_layout, int(arrays["length"][0]), config)
        return cls(
            network=network,
            weights={name: torch.tensor(arrays[f"weight.{name}"], device=config.device) for name in network.shapes},
            normalizer=Normalizer.from_arrays(arrays, "normalizer"),
            history=History(*(np.array(arrays[f"history.{what}"]) for what in ("updates", "train", "held_out"))),
        )


def series_normalizer(series: PaddedSeries) -> Normalizer:
    """Return the z-scores of the columns over what was recorded of them."""
    width = series.rows.shape[2]
    mean, scale = np.zeros(width), np.ones(width)
    for column, values in enumerate(series.column_values()):
        if column in series.layout.continuous:
            one = Normalizer.fit(values[:, None], Layout(1, (0,), ()))
            mean[column], scale[column] = one.mean[0], one.scale[0]
    return Normalizer(mean, scale)


def to_tensors(series: PaddedSeries, normalizer: Normalizer, device: str) -> Series:
    """Return z-scored float32 tensors, 0 where nothing was recorded."""
    rows = np.where(series.recorded, normalizer.normalize(series.rows), 0.0)
    parts = (rows, series.recorded_rows, series.recorded_steps)
    return Series(*(torch.from_numpy(np.ascontiguousarray(part, dtype=np.float32)).to(device) for part in parts))


def initial_scales(flat: Tensor, shapes: Shapes) -> None:
    """Set the raw scales of a fresh (1, P) weight matrix in place so that the Gaussians start at the data's scale."""
    unpack(flat, shapes)["scale.bias"].fill_(float(np.log(np.expm1(1.0))))
