"""SPAWNER: the noisy mean of two episodes of one kind, aligned by dynamic time warping."""

from __future__ import annotations

import math
import threading
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import ClassVar
from weakref import WeakKeyDictionary

import numpy as np

from oat_gym._rng import derive
from oat_gym.augmenters.base import Augmenter, Sampler, Variation
from oat_gym.augmenters.series import (
    Columns,
    Series,
    check_labels,
    check_number,
    check_series,
    episode_classes,
    has_ended,
)
from oat_gym.dtw import dtw_path
from oat_gym.episodes import IntArray
from oat_gym.errors import AugmentationWarning, InvalidDataError
from oat_gym.progress import ProgressCallback, silent
from oat_gym.source import Source
from oat_gym.spaces import FloatMatrix, Layout
from oat_gym.stitching import Span, stitchable_copy


@dataclass(frozen=True)
class SPAWNER(Augmenter):
    """Suboptimal warped time-series generator (Kamycki, Kapuscinski and Oszust, Sensors 20(1):98, 2020).

    An episode and a random partner are both cut at one random fraction of their lengths; each pair of parts is
    aligned by DTW in a band. Along the two paths, one behind the other, a synthetic row is drawn from
    N((x1 + x2) / 2, sigma |x1 - x2|), and the last observation in the same way from the two last observations.
    Discrete parts take the category of either episode with equal probability (the mean one-hot weights). Noise is
    relative to the distance, as the authors' and not as in the port of Iwana and Uchida (a fixed jitter, and partners
    whose index is not mapped back to the class).

    The length is that of the two paths, at least the longer episode's; it is known before anything is generated
    (`lengths` reads the episodes and aligns them). A row that the path holds while the partner moves on is
    repeated, so that dynamics are slower there: a weakness of the method. The partner ends as the episode does (by
    termination or not) and is of its class; the flags are the episode's, at the end. Infos are those of the
    episode's own rows along the path. Values are clipped to the spaces; integer rewards become floats.

    An episode without a partner is copied, with an `AugmentationWarning`. One of a single step is not cut.

    Args:
        sigma: standard deviation of the noise as a share of the distance between the two values.
        band: half width of the DTW band, as a share of the longer part; widened by the difference of the lengths.
        labels: the class of each source episode, in order; None: above the median return or not.

    >>> SPAWNER().sigma, SPAWNER().band
    (0.05, 0.1)
    """

    name: ClassVar[str] = "spawner"
    trains: ClassVar[bool] = False
    expected_failures: ClassVar[Mapping[str, str]] = {
        "zero-strength": "without noise it still is the mean of two different episodes"
    }
    sigma: float = 0.05
    band: float = 0.1
    labels: tuple[int, ...] | None = None

    def __post_init__(self) -> None:
        check_number("sigma", self.sigma)
        check_number("band", self.band, high=1.0)
        check_labels(self.labels)

    def check(self, source: Source) -> None:
        """Raise where a space cannot be modelled, labels do not fit, or there is no second episode."""
        check_series(source, self.labels)
        if len(source) < 2:
            raise InvalidDataError(
                f"SPAWNER combines pairs of episodes, and {source.dataset.id!r} (or this view of it) has "
                f"{len(source)}: at least 2 are needed. Jittering, Scaling and Permutation work on one."
            )

    def lengths(self, source: Source, episodes: IntArray, variations: IntArray, *, seed: int) -> IntArray:
        """Return the lengths of the paths; reads the source and aligns each pair, under a millisecond a pair."""
        pairing = _Pairing(self, Series(source), seed)
        return np.array([pairing.length(int(i), int(k)) for i, k in zip(episodes, variations, strict=True)])

    def fit(self, source: Source, *, seed: int, progress: ProgressCallback = silent) -> Sampler:
        """Return the sampler; warns of episodes that have no partner."""
        pairing = _Pairing(self, Series(source), seed)
        alone = sum(not len(pairing.partners(i)) for i in range(len(source)))
        if alone:
            warnings.warn(
                f"{alone} of {len(source)} episodes have no other episode of their class and kind of ending: their "
                "synthetic episodes are exact copies of them. Give labels with fewer classes.",
                AugmentationWarning,
                stacklevel=2,
            )
        return _SPAWNERSampler(self, pairing, seed)


Alignment = tuple[int, IntArray]
"""(partner, (L, 2) rows of the episode and of the partner)."""

# `lengths` aligns what `variation` needs again: the latest alignments of a source are kept while the source lives.
_KEPT_ALIGNMENTS = 8192
_alignments: WeakKeyDictionary[Source, dict[tuple[SPAWNER, int], dict[tuple[int, int], Alignment | None]]]
_alignments = WeakKeyDictionary()
_lock = threading.Lock()


class _Pairing:
    """Which two episodes make a variation, and along which path: pure functions of (seed, i, k)."""

    def __init__(self, config: SPAWNER, series: Series, seed: int) -> None:
        self.series = series
        self._config = config
        self._seed = seed
        self._kinds = np.stack([episode_classes(series.source, config.labels), has_ended(series.source)], axis=1)
        with _lock:
            kept = _alignments.setdefault(series.source, {})
            if (config, seed) not in kept:
                kept.clear()
            self._kept = kept.setdefault((config, seed), {})

    def partners(self, i: int) -> IntArray:
        """Return the other episodes of the class and the kind of ending of episode `i`."""
        alike = np.flatnonzero((self._kinds == self._kinds[i]).all(axis=1))
        return alike[alike != i]

    def length(self, i: int, k: int) -> int:
        """Return the number of steps of variation `k` of episode `i`."""
        alignment = self.alignment(i, k)
        return int(self.series.source.lengths[i]) if alignment is None else len(alignment[1])

    def alignment(self, i: int, k: int) -> Alignment | None:
        """Return the partner and the path of variation `k` of episode `i`; None where it has no partner."""
        if (i, k) in self._kept:
            return self._kept[i, k]
        alignment = self._align(i, k)
        with _lock:
            if len(self._kept) >= _KEPT_ALIGNMENTS:
                self._kept.clear()
            self._kept[i, k] = alignment
        return alignment

    def _align(self, i: int, k: int) -> Alignment | None:
        partners = self.partners(i)
        if not len(partners):
            return None
        rng = derive(self._seed, "spawner", i, k)
        partner = int(rng.choice(partners))
        path = spawner_path(
            self.series.rows(i), self.series.rows(partner), fraction=rng.random(), band=self._config.band
        )
        return partner, path


class _SPAWNERSampler(Sampler):
    def __init__(self, config: SPAWNER, pairing: _Pairing, seed: int) -> None:
        self._config = config
        self._pairing = pairing
        self._seed = seed

    def variation(self, i: int, k: int, material: object) -> Variation:
        series, alignment = self._pairing.series, self._pairing.alignment(i, k)
        if alignment is None:
            return Variation(stitchable_copy(series.source.episodes[i], number=i), ())
        partner, path = alignment
        rng = derive(self._seed, "spawner-noise", i, k)
        pair = [_along(series.columns(number), path[:, side]) for side, number in enumerate((i, partner))]
        parts = zip(*((one.states, one.actions, one.rewards) for one in pair), series.layouts, strict=True)
        sigma = self._config.sigma
        drawn = Columns(*(noisy_mean(x1, x2, layout, sigma=sigma, rng=rng) for x1, x2, layout in parts))
        return Variation(series.rebuilt(i, drawn, path[:, 0]), (Span(0, len(path)),))


def spawner_path(x: FloatMatrix, y: FloatMatrix, *, fraction: float, band: float) -> IntArray:
    """Return the (L, 2) path of two series that are cut at one fraction of their lengths, part by part.

    A series of one row is not cut, and then the other one is not either.
    """
    n, m = len(x), len(y)
    cuts = [(0, 0), (n, m)]
    if min(n, m) > 1:
        cuts.insert(1, (min(max(round(fraction * n), 1), n - 1), min(max(round(fraction * m), 1), m - 1)))
    parts: list[IntArray] = []
    for (i, j), (p, q) in pairwise(cuts):
        radius = math.ceil(band * max(p - i, q - j))
        parts.append(dtw_path(x[i:p], y[j:q], radius=radius)[0] + (i, j))
    return np.concatenate(parts)


def noisy_mean(
    x1: FloatMatrix, x2: FloatMatrix, layout: Layout, *, sigma: float, rng: np.random.Generator
) -> FloatMatrix:
    """Return rows from N((x1 + x2) / 2, sigma |x1 - x2|); one-hot blocks are those of x1 or x2 with equal probability.

    The three are (L, width). Where x1 and x2 agree, so does the result, to the last bit.
    """
    drawn = 0.5 * x1 + 0.5 * x2 + sigma * np.abs(x1 - x2) * rng.standard_normal(x1.shape)
    for start, stop in layout.categorical:
        of_first = rng.random(len(x1)) < 0.5
        drawn[:, start:stop] = np.where(of_first[:, None], x1[:, start:stop], x2[:, start:stop])
    return drawn


def _along(columns: Columns, rows: IntArray) -> Columns:
    """Return an episode's columns at the rows of a path, the last state after them."""
    return Columns(columns.states[np.append(rows, rows[-1] + 1)], columns.actions[rows], columns.rewards[rows])
