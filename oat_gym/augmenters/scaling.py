"""Scaling: each channel of an episode stretched about its mean by one random factor."""

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
class Scaling(Augmenter):
    """Each channel of the z-scored series times a factor from N(1, sigma), one for an episode and channel.

    Um et al., "Data augmentation of wearable sensor data for Parkinson's disease monitoring", ICMI 2017; sigma as in
    Iwana and Uchida, PLOS ONE 2021 (uchidalab/time_series_augmentation, `utils/augmentation.py`).

    A value x of a channel with mean m over the data becomes m + f (x - m). All T+1 states share their channels'
    factors, so s and s' are scaled alike. Values are clipped to the spaces. Discrete parts and constant channels stay
    as they are; flags and infos are the source's. Integer rewards become floats.

    Args:
        sigma: standard deviation of the factor; with 0 the variations equal their sources to the last bit.

    >>> Scaling().sigma
    0.1
    """

    name: ClassVar[str] = "scaling"
    trains: ClassVar[bool] = False
    sigma: float = 0.1

    def __post_init__(self) -> None:
        check_number("sigma", self.sigma)

    @property
    def at_zero_strength(self) -> Scaling:
        """All factors 1."""
        return replace(self, sigma=0.0)

    def check(self, source: Source) -> None:
        """Raise where a space cannot be modelled."""
        check_series(source, None)

    def fit(self, source: Source, *, seed: int, progress: ProgressCallback = silent) -> Sampler:
        """Return the sampler; only the channels' means are learnt."""
        return _ScalingSampler(self, Series(source), seed)


class _ScalingSampler(Sampler):
    def __init__(self, config: Scaling, series: Series, seed: int) -> None:
        self._config = config
        self._series = series
        self._seed = seed

    def variation(self, i: int, k: int, material: object) -> Variation:
        series, sigma = self._series, self._config.sigma
        old, rng = series.columns(i), derive(self._seed, "scaling", i, k)
        spans = (Span(0, len(old.rewards)),)
        if sigma == 0:
            return Variation(copy_episode(series.source.episodes[i], number=i), spans)
        parts = zip((old.states, old.actions, old.rewards), series.scales, strict=True)
        scaled = Columns(*(stretch(values, scale, sigma=sigma, rng=rng) for values, scale in parts))
        return Variation(series.altered(i, scaled), spans)


def stretch(values: FloatMatrix, scale: Scale, *, sigma: float, rng: np.random.Generator) -> FloatMatrix:
    """Return (n, width) values, each column of which moved from its mean by one factor from N(1, sigma)."""
    extra = sigma * rng.standard_normal(values.shape[1]) * (scale.spread > 0)  # the factors less one
    return values + extra * (values - scale.mean)
