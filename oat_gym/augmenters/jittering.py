"""Jittering: independent Gaussian noise on every value."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from oat_gym._rng import derive
from oat_gym.augmenters.base import Augmenter, Sampler, Variation
from oat_gym.augmenters.series import Columns, Scale, Series, check_number, check_series
from oat_gym.episodes import copy_episode
from oat_gym.progress import ProgressCallback, silent
from oat_gym.source import Source
from oat_gym.spaces import FloatMatrix
from oat_gym.stitching import Span


@dataclass(frozen=True)
class Jittering(Augmenter):
    """Noise N(0, sigma) on each state, action and reward, in standard deviations of its channel over the data.

    Um et al., "Data augmentation of wearable sensor data for Parkinson's disease monitoring", ICMI 2017; sigma as in
    Iwana and Uchida, PLOS ONE 2021 (uchidalab/time_series_augmentation, `utils/augmentation.py`).

    All T+1 states get noise, each its own, so the next state of a step is the noisy state of the step after it.
    Values are clipped to the spaces. Discrete parts and constant channels stay as they are; flags and infos are the
    source's. Integer rewards become floats.

    Args:
        sigma: standard deviation of the noise; with 0 the variations equal their sources to the last bit.

    >>> Jittering().sigma
    0.03
    """

    name: ClassVar[str] = "jittering"
    trains: ClassVar[bool] = False
    sigma: float = 0.03

    def __post_init__(self) -> None:
        check_number("sigma", self.sigma)

    @property
    def at_zero_strength(self) -> Jittering:
        """No noise."""
        return replace(self, sigma=0.0)

    def check(self, source: Source) -> None:
        """Raise where a space cannot be modelled."""
        check_series(source, None)

    def fit(self, source: Source, *, seed: int, progress: ProgressCallback = silent) -> Sampler:
        """Return the sampler; only the channels' standard deviations are learnt."""
        return _JitteringSampler(self, Series(source), seed)


class _JitteringSampler(Sampler):
    def __init__(self, config: Jittering, series: Series, seed: int) -> None:
        self._config = config
        self._series = series
        self._seed = seed

    def variation(self, i: int, k: int, material: object) -> Variation:
        series, sigma = self._series, self._config.sigma
        old, rng = series.columns(i), derive(self._seed, "jittering", i, k)
        spans = (Span(0, len(old.rewards)),)
        if sigma == 0:
            return Variation(copy_episode(series.source.episodes[i], number=i), spans)
        parts = zip((old.states, old.actions, old.rewards), series.scales, strict=True)
        noisy = Columns(*(jitter(values, scale, sigma=sigma, rng=rng) for values, scale in parts))
        return Variation(series.altered(i, noisy), spans)


def jitter(values: FloatMatrix, scale: Scale, *, sigma: float, rng: np.random.Generator) -> FloatMatrix:
    """Return (n, width) values with noise of `sigma` times each column's spread."""
    return values + sigma * scale.spread * rng.standard_normal(values.shape)
