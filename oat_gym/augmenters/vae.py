"""VAE: whole episodes from a variational autoencoder that knows no transitions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal, get_args

import numpy as np
import numpy.typing as npt

from oat_gym._rng import derive
from oat_gym.augmenters._whole import WholeSampler, check_count, padded_series
from oat_gym.augmenters.base import Augmenter
from oat_gym.cache import Arrays
from oat_gym.errors import ConfigurationError, InvalidDataError
from oat_gym.generation.padded import series_layout
from oat_gym.generation.vae import FittedVAE, VAEConfig, VAENetwork
from oat_gym.generation.vae_training import fit_vae
from oat_gym.progress import ProgressCallback, silent
from oat_gym.source import Source

Start = Literal["prior", "posterior"]

MIN_EPISODES = 2
"""Fewest episodes: one has no variation between episodes, which is what z stands for."""

MAX_WEIGHTS = 100_000_000
"""Most weights, beyond which training would take several GB: they grow with the longest episode."""


@dataclass(frozen=True)
class VAE(Augmenter):
    """A vanilla variational autoencoder of entire multivariate series (Barak et al. 2022, as the paper compares it).

    An episode is one padded series of [s, a, r] rows, z-scored, discrete parts as one-hots. An MLP maps the whole of
    it to q(z|x) (Kingma and Welling, 2014), another maps z to all rows at once: Gaussians and, for discrete parts,
    categoricals, with likelihoods only where something was recorded (the last row of an episode is a state only).
    Nothing says that one step follows from the one before: beside VAE-MDP, this isolates the structure of the MDP.

    No code was published with it; sizes and training are those of this library's other models. A synthetic episode
    has the length, the flags and the infos of its source episode: z does not know the length, so a short episode is
    the beginning of a generated series.

    Args:
        model: the network and its training.
        start: z from the "prior" N(0, I), or from the "posterior" q(z|x) of the source episode, which gives variations
            of that episode rather than new ones.
        observation_noise: draw rows from p(x|z), so that spreads are those of the data, as OAT's paper does; if
            false, take means and most likely categories: smoother, less varied series.

    Raises:
        ConfigurationError: for a setting out of its range.

    >>> VAE(start="posterior").model.latent
    16
    """

    name: ClassVar[str] = "vae"
    expected_failures: ClassVar[Mapping[str, str]] = {"zero-strength": "every step is generated: there is no strength"}
    model: VAEConfig = field(default_factory=VAEConfig)
    start: Start = "prior"
    observation_noise: bool = True

    def __post_init__(self) -> None:
        if not isinstance(self.model, VAEConfig):
            raise ConfigurationError(f"model must be a VAEConfig, got {self.model!r}.")
        if self.start not in get_args(Start):
            raise ConfigurationError(f"start must be one of {', '.join(get_args(Start))}; got {self.start!r}.")
        if not isinstance(self.observation_noise, bool):
            raise ConfigurationError(f"observation_noise must be True or False, got {self.observation_noise!r}.")

    def check(self, source: Source) -> None:
        """Raise where the spaces cannot be modelled, a single episode is all there is, or episodes are too long."""
        layouts = source.flat_observations.layout, source.flat_actions.layout
        check_count(source, least=MIN_EPISODES, what="The VAE", why="one episode shows no variation between episodes.")
        longest = int(source.lengths.max())
        size = VAENetwork(*layouts, longest + 1, self.model).size
        if size > MAX_WEIGHTS:
            raise InvalidDataError(
                f"A VAE of whole episodes of {longest} steps and {series_layout(*layouts).width} features needs {size} "
                f"weights, more than {MAX_WEIGHTS}. Use VAEMDP, whose size does not grow with the length, narrower "
                "layers, or shorter episodes."
            )

    def fit(self, source: Source, *, seed: int, progress: ProgressCallback = silent) -> VAESampler:
        """Train the VAE on all episodes."""
        self.check(source)
        model = fit_vae(padded_series(source), config=self.model, rng=derive(seed, "vae"), progress=progress)
        return VAESampler(self, source, seed, model=model)

    def restore(self, source: Source, arrays: Arrays, value: Any, *, seed: int) -> VAESampler:
        """Return the sampler that `VAESampler.state` described."""
        return VAESampler(self, source, seed, model=FittedVAE.from_arrays(arrays, config=self.model))


class VAESampler(WholeSampler):
    """Variations of episodes by a trained VAE."""

    def __init__(self, config: VAE, source: Source, seed: int, *, model: FittedVAE) -> None:
        super().__init__(source, margin=config.model.range_margin)
        self._config, self._seed, self._model = config, seed, model

    @property
    def model(self) -> FittedVAE:
        """The trained model."""
        return self._model

    def state(self) -> tuple[Arrays, Any]:
        """Return all that was learnt, as arrays."""
        return self._model.to_arrays(), None

    def sample(self, k: int) -> npt.NDArray[np.floating[Any]]:
        """Return one series for each episode."""
        return self._model.sample(
            len(self._source),
            rng=derive(self._seed, "vae", k),
            start=self._series if self._config.start == "posterior" else None,
            observation_noise=self._config.observation_noise,
        )
