"""Permutation: an episode cut into segments that are put together in another order."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from minari import EpisodeData

from oat_gym._rng import derive
from oat_gym.augmenters.base import Augmenter, Sampler, Variation
from oat_gym.augmenters.series import check_count, take_infos, take_rows
from oat_gym.episodes import IntArray
from oat_gym.progress import ProgressCallback, silent
from oat_gym.source import Source
from oat_gym.spaces import Batch
from oat_gym.stitching import Span


@dataclass(frozen=True)
class Permutation(Augmenter):
    """Permutation of segments of transitions (Um et al., "Data augmentation of wearable sensor data", ICMI 2017).

    An episode is cut into 1 to `max_segments` segments of equal size (sizes differ by one where the length is not
    divisible, as in Iwana and Uchida, "An empirical survey of data augmentation for time series classification",
    PLOS ONE 2021; uchidalab/time_series_augmentation, `utils/augmentation.py`), which are put in a random order.

    The items that move are whole transitions (s, a, r, s'): at the end of a segment s' stays the recorded one, which
    `transitions()` shows, while in Minari's form `observations[t+1]` is the first state of the next segment. The last
    observation is the recorded next state of the last transition. Infos move along. Every space is accepted.

    Where the episode ended by termination its last segment stays last, so that nothing follows a terminal transition;
    a truncated one is permuted freely, since a recording can stop anywhere. The truncation flag stays at the end.

    Args:
        max_segments: most segments; their number is uniform in 1..max_segments (at most one a step). With one (also
            drawn at random: a quarter of the time by default) the variation equals its source.

    >>> Permutation().max_segments, Permutation().at_zero_strength
    (4, Permutation(max_segments=1))
    """

    name: ClassVar[str] = "permutation"
    trains: ClassVar[bool] = False
    max_segments: int = 4

    def __post_init__(self) -> None:
        check_count("max_segments", self.max_segments, low=1)

    @property
    def at_zero_strength(self) -> Permutation:
        """One segment."""
        return replace(self, max_segments=1)

    def fit(self, source: Source, *, seed: int, progress: ProgressCallback = silent) -> Sampler:
        """Return the sampler; nothing is learnt."""
        return _PermutationSampler(self, source, seed)


class _PermutationSampler(Sampler):
    def __init__(self, config: Permutation, source: Source, seed: int) -> None:
        self._config = config
        self._source = source
        self._seed = seed

    def variation(self, i: int, k: int, material: object) -> Variation:
        original = self._source.episodes[i]
        rng = derive(self._seed, "permutation", i, k)
        steps = permuted_steps(
            len(original.rewards),
            int(rng.integers(1, self._config.max_segments + 1)),
            keep_last=bool(original.terminations[-1]),
            rng=rng,
        )
        episode, next_states = _reordered(original, steps, number=i)
        return Variation(episode, (Span(0, len(steps)),), next_states)


def permuted_steps(length: int, n_segments: int, *, keep_last: bool, rng: np.random.Generator) -> IntArray:
    """Return the recorded step at each of `length` places: segments in a random order, the last one last if told to.

    >>> permuted_steps(5, 2, keep_last=True, rng=np.random.default_rng(0)).tolist()
    [0, 1, 2, 3, 4]
    """
    segments = np.array_split(np.arange(length), min(n_segments, length))
    order = rng.permutation(len(segments) - keep_last)
    return np.concatenate([segments[s] for s in order] + ([segments[-1]] if keep_last else []))


def _reordered(original: EpisodeData, steps: IntArray, *, number: int) -> tuple[EpisodeData, dict[int, Batch]]:
    """Return the episode of the given steps, and the next states that are not `observations[t+1]`."""
    seams = np.flatnonzero(steps[1:] != steps[:-1] + 1)
    next_states = {int(t): take_rows(original.observations, steps[t : t + 1] + 1) for t in seams}
    episode = EpisodeData(
        id=number,
        observations=take_rows(original.observations, np.append(steps, steps[-1] + 1)),
        actions=take_rows(original.actions, steps),
        rewards=original.rewards[steps],
        terminations=original.terminations[steps],
        truncations=original.truncations.copy(),
        infos=take_infos(original.infos, len(steps), steps),
    )
    return episode, next_states
