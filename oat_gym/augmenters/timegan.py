"""TimeGAN: whole episodes from a generative adversarial network over latent time series."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal

import numpy as np
import numpy.typing as npt

from oat_gym._rng import derive
from oat_gym.augmenters._whole import WholeSampler, check_count, padded_series
from oat_gym.augmenters.base import Augmenter
from oat_gym.cache import Arrays
from oat_gym.errors import ConfigurationError
from oat_gym.generation.timegan import FittedTimeGAN, TimeGANConfig
from oat_gym.generation.timegan_training import fit_timegan
from oat_gym.progress import ProgressCallback, silent
from oat_gym.source import Source

MIN_EPISODES = 5
"""Fewest episodes. TimeGAN matches standard deviations over episodes, whose own error from n of them is one part in
sqrt(2 (n - 1)): 71% at 2, 35% at 5; and its discriminator soon knows fewer by heart."""


@dataclass(frozen=True)
class TimeGAN(Augmenter):
    """TimeGAN (Yoon, Jarrett and van der Schaar, "Time-series Generative Adversarial Networks", NeurIPS 2019).

    An embedder and a recovery network take min-max scaled series to a latent space and back; a generator makes latent
    series of noise, a supervisor predicts their next step, a discriminator tells them from embedded ones. Three phases
    of training (embedding, supervised, joint), losses and update rule are those of the authors' code
    (github.com/jsyoon0823/TimeGAN, timegan.py). An episode is a series of [s, a, r] rows, discrete parts one-hot; the
    last row is a state only. Episodes of unequal lengths are masked in all losses and moments, and all networks run
    forwards in time, so that padding has no effect.

    A synthetic episode has the length, the flags and the infos of its source episode and is its source in nothing else.

    The default trains 600, 300 and 200 iterations at rate 3e-3 on 16 whole episodes at a time: minutes on a CPU for
    tens of episodes of hundreds of steps. That is far less than the original's 50,000 a phase at 1e-3 on 128 series of
    24 steps, which `TimeGAN.preset("paper")` runs: hours, and days with long episodes. Judge what it made before use.

    Args:
        model: the networks and their training.

    Raises:
        ConfigurationError: for a setting out of its range.

    >>> TimeGAN().model.hidden, TimeGAN.preset("paper").model.joint_iterations
    (24, 50000)
    """

    name: ClassVar[str] = "timegan"
    expected_failures: ClassVar[Mapping[str, str]] = {"zero-strength": "every step is generated: there is no strength"}
    model: TimeGANConfig = field(default_factory=TimeGANConfig)

    def __post_init__(self) -> None:
        if not isinstance(self.model, TimeGANConfig):
            raise ConfigurationError(f"model must be a TimeGANConfig, got {self.model!r}.")

    @classmethod
    def preset(cls, preset: Literal["default", "paper"]) -> TimeGAN:
        """Return a named configuration: "default", or "paper" (50,000 iterations a phase, minibatches of 128)."""
        return cls(model=TimeGANConfig.from_preset(preset))

    def check(self, source: Source) -> None:
        """Raise where the spaces cannot be modelled or there are too few episodes."""
        _ = source.flat_observations, source.flat_actions
        why = "it matches means and spreads over episodes, which fewer do not show, and would learn them by heart."
        check_count(source, least=MIN_EPISODES, what="TimeGAN", why=why)

    def fit(self, source: Source, *, seed: int, progress: ProgressCallback = silent) -> TimeGANSampler:
        """Train the five networks on all episodes."""
        self.check(source)
        series = padded_series(source)
        rng = derive(seed, "timegan")
        model = fit_timegan(series.rows, series.recorded, config=self.model, rng=rng, progress=progress)
        return TimeGANSampler(self, source, seed, model=model)

    def restore(self, source: Source, arrays: Arrays, value: Any, *, seed: int) -> TimeGANSampler:
        """Return the sampler that `TimeGANSampler.state` described."""
        return TimeGANSampler(self, source, seed, model=FittedTimeGAN.from_arrays(arrays, config=self.model))


class TimeGANSampler(WholeSampler):
    """Variations of episodes by a trained TimeGAN."""

    def __init__(self, config: TimeGAN, source: Source, seed: int, *, model: FittedTimeGAN) -> None:
        super().__init__(source, margin=0.0)  # a sigmoid cannot leave the range
        self._config, self._seed, self._model = config, seed, model

    @property
    def model(self) -> FittedTimeGAN:
        """The trained model."""
        return self._model

    def state(self) -> tuple[Arrays, Any]:
        """Return all that was learnt, as arrays."""
        return self._model.to_arrays(), None

    def sample(self, k: int) -> npt.NDArray[np.floating[Any]]:
        """Return one series for each episode."""
        return self._model.sample(len(self._source), rng=derive(self._seed, "timegan", k))
