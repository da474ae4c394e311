"""DGW: an episode warped in time towards another one of its class, chosen by a discriminative teacher."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from oat_gym._rng import derive
from oat_gym.augmenters.base import Augmenter, Sampler, Variation
from oat_gym.augmenters.series import (
    Columns,
    Series,
    check_count,
    check_labels,
    check_number,
    check_series,
    episode_classes,
    has_ended,
)
from oat_gym.cache import Arrays
from oat_gym.dtw import dtw, dtw_path
from oat_gym.episodes import IntArray
from oat_gym.errors import AugmentationWarning
from oat_gym.progress import ProgressCallback, silent
from oat_gym.source import Source
from oat_gym.spaces import FloatMatrix, Layout
from oat_gym.stitching import Span

_KEPT_DISTANCES = 2**17

Positions = npt.NDArray[np.float64]
"""Recorded time, in steps, of each step of a synthetic episode: (T,), never decreasing."""


@dataclass(frozen=True)
class DGW(Augmenter):
    """Discriminative guided warping with variable slicing.

    Iwana and Uchida, "Time series data augmentation for neural networks by time warping with a discriminative
    teacher", ICPR 2020; uchidalab/time_series_augmentation, `discriminative_guided_warp` in `utils/augmentation.py`.

    Of a random batch of other episodes, half of the episode's own class (positive) and half of others (negative), the
    positive one with the largest mean DTW distance to the negative ones less that to the other positive ones is the
    reference. The episode's rows are put in the order of the DTW path between the two and brought back to its own
    length; of these a window is sliced and brought back to that length too. The window holds `slice_ratio` of the
    steps where nothing was warped, and more the more was warped, up to all of them. With one class, or an
    episode whose class has no other member, there is no reference and a window slice only (a warning tells it).

    In the authors' code an index within the class is never mapped back to the data, so that positives and negatives
    are episodes of any class. Here they are what the paper says. Other differences, all small: the two resamplings
    are composed and values interpolated once; DTW costs are squared distances; the window may also be the last one.

    **What warping does to s'.** Time runs slower or faster than it was recorded: where the path stands still, s' is
    near s whatever the action, and where it skips, one action has the effect of several. The rows are still real
    (or means of two neighbours), but the transitions between them are not the environment's. This is the method's
    own weakness, made for classification, and no option removes it. States, actions and rewards are warped alike; the
    last observation is the recorded next state of the last row. Where the episode ended by termination, the window
    reaches to its end, so that the terminal transition stays the last one; other windows may stop before it.

    Discrete parts and infos are taken from the nearest row. Flags and length stay. Values are clipped to the spaces;
    integer rewards become floats. An episode of one step stays as it is. In a small dataset few batches are possible,
    so that variations of one episode may be equal.

    Args:
        batch_size: episodes in the batch, half of them (rounded up) positive.
        band: half width of the DTW band, as a share of the longer episode; widened by the difference of the lengths.
        slice_ratio: shortest window as a share of the episode.
        labels: the class of each source episode, in order; None: above the median return or not.

    >>> DGW().batch_size, DGW().slice_ratio
    (6, 0.9)
    """

    name: ClassVar[str] = "dgw"
    trains: ClassVar[bool] = False
    expected_failures: ClassVar[Mapping[str, str]] = {
        "zero-strength": "an episode is warped towards another one whatever the settings"
    }
    batch_size: int = 6
    band: float = 0.1
    slice_ratio: float = 0.9
    labels: tuple[int, ...] | None = None

    def __post_init__(self) -> None:
        check_count("batch_size", self.batch_size, low=2)
        check_number("band", self.band, high=1.0)
        check_number("slice_ratio", self.slice_ratio, low=0.01, high=1.0)
        check_labels(self.labels)

    def check(self, source: Source) -> None:
        """Raise where a space cannot be modelled or labels do not fit."""
        check_series(source, self.labels)

    def fit(self, source: Source, *, seed: int, progress: ProgressCallback = silent) -> DGWSampler:
        """Return the sampler; only standard deviations and classes are learnt."""
        return DGWSampler(self, Series(source), seed)


class DGWSampler(Sampler):
    """Warped episodes. `generate` makes the positions of a whole variation, since the window depends on all of it."""

    def __init__(self, config: DGW, series: Series, seed: int) -> None:
        self._config = config
        self._series = series
        self._seed = seed
        self._ended = has_ended(series.source)
        self.classes = episode_classes(series.source, config.labels)
        self._distances: dict[tuple[int, int], float] = {}
        alone = sum(not (len(same) and len(other)) for same, other in map(self.rivals, range(len(self.classes))))
        if alone:
            warnings.warn(
                f"{alone} of {len(self.classes)} episodes have no other episode of their class, or there is none of "
                "another class: with no episode to be warped towards, their variations are window slices only. "
                "`labels` sets the classes.",
                AugmentationWarning,
                stacklevel=3,
            )

    def rivals(self, i: int) -> tuple[IntArray, IntArray]:
        """Return the other episodes of the class of episode `i`, and the episodes of other classes."""
        same = self.classes == self.classes[i]
        others = np.flatnonzero(same)
        return others[others != i], np.flatnonzero(~same)

    def batch(self, i: int, k: int) -> tuple[IntArray, IntArray]:
        """Return the positive and the negative episodes drawn for variation `k` of episode `i`; both may be empty."""
        rng = derive(self._seed, "dgw", i, k)
        positives, negatives = self.rivals(i)
        half = math.ceil(self._config.batch_size / 2), self._config.batch_size // 2
        return (
            rng.choice(positives, min(half[0], len(positives)), replace=False),
            rng.choice(negatives, min(half[1], len(negatives)), replace=False),
        )

    def reference(self, i: int, k: int) -> int | None:
        """Return the episode that variation `k` of episode `i` is warped towards; None where there is none."""
        positives, negatives = self.batch(i, k)
        if not len(positives) or not len(negatives):
            return None
        return int(positives[np.argmax([self._advantage(int(p), positives, negatives) for p in positives])])

    def _advantage(self, p: int, positives: IntArray, negatives: IntArray) -> float:
        others = [self._between(p, int(q)) for q in positives if q != p]
        return float(np.mean([self._between(p, int(q)) for q in negatives]) - (np.mean(others) if others else 0.0))

    def _between(self, a: int, b: int) -> float:
        pair = min(a, b), max(a, b)
        if pair not in self._distances:
            if len(self._distances) >= _KEPT_DISTANCES:
                self._distances.clear()
            self._distances[pair] = self._measure(*pair)
        return self._distances[pair]

    def _measure(self, a: int, b: int) -> float:
        x, y = self._series.rows(a), self._series.rows(b)
        return dtw(x, y, radius=math.ceil(self._config.band * max(len(x), len(y))))

    def generate(self, k: int) -> Arrays:
        """Return the positions of variation `k` of all episodes, one behind the other, as `positions` (n,)."""
        warps = [self._warp(i, k) for i in range(len(self.classes))]
        amounts = np.array([np.abs(warp - np.arange(len(warp))).mean() / len(warp) for warp in warps])
        shares = amounts / amounts.max() if amounts.max() > 0 else amounts
        shortest = self._config.slice_ratio
        sliced = [
            slice_positions(
                warp,
                ratio=shortest + (1 - shortest) * share,
                to_end=bool(self._ended[i]),
                rng=derive(self._seed, "dgw-slice", i, k),
            )
            for i, (warp, share) in enumerate(zip(warps, shares, strict=True))
        ]
        return {"positions": np.concatenate(sliced)}

    def _warp(self, i: int, k: int) -> Positions:
        reference = self.reference(i, k)
        rows = self._series.rows(i)
        if reference is None:
            return np.arange(len(rows), dtype=np.float64)
        guide = self._series.rows(reference)
        radius = math.ceil(self._config.band * max(len(rows), len(guide)))
        return warp_positions(dtw_path(guide, rows, radius=radius)[0][:, 1], len(rows))

    def decode(self, arrays: Arrays) -> list[Positions]:
        """Return the positions of each episode."""
        return np.split(arrays["positions"], np.cumsum(self._series.source.lengths)[:-1])

    def variation(self, i: int, k: int, material: list[Positions]) -> Variation:
        """Return episode `i` at the positions of variation `k`."""
        positions, old, series = material[i], self._series.columns(i), self._series
        times = np.append(positions, positions[-1] + 1), positions, positions
        parts = zip((old.states, old.actions, old.rewards), times, series.layouts, strict=True)
        warped = Columns(*(values_at(values, at, layout) for values, at, layout in parts))
        return Variation(series.rebuilt(i, warped, _nearest(positions)), (Span(0, len(positions)),))


def warp_positions(path: IntArray, length: int) -> Positions:
    """Return the rows of a DTW path, (L,), resampled linearly to `length` positions.

    >>> warp_positions(np.array([0, 0, 0, 1, 2]), 3).tolist()
    [0.0, 0.0, 2.0]
    """
    return np.interp(np.linspace(0, len(path) - 1, length), np.arange(len(path)), path)


def slice_positions(warp: Positions, *, ratio: float, to_end: bool, rng: np.random.Generator) -> Positions:
    """Return a random window of `ratio` of the positions, resampled linearly to their number; `to_end`: up to the end.

    A window up to the end starts where the other one would, so that its length is between `ratio` and all.
    """
    length = len(warp)
    width = min(length, math.ceil(ratio * length - 1e-9))
    start = int(rng.integers(0, length - width + 1))
    stop = length if to_end else start + width
    return np.interp(np.linspace(start, stop - 1, length), np.arange(length), warp)


def values_at(values: FloatMatrix, positions: Positions, layout: Layout) -> FloatMatrix:
    """Return (n, width) rows of `values` (m, width) at `positions` (n,), 0 to m-1: linear, one-hot blocks nearest."""
    before = np.minimum(np.floor(positions).astype(np.int64), len(values) - 1)
    after = np.minimum(before + 1, len(values) - 1)
    result = values[before] + (positions - before)[:, None] * (values[after] - values[before])
    for start, stop in layout.categorical:
        result[:, start:stop] = values[_nearest(positions), start:stop]
    return result


def _nearest(positions: Positions) -> IntArray:
    return np.floor(positions + 0.5).astype(np.int64)
