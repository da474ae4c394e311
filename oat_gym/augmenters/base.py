"""What an augmenter is: a frozen configuration that is fitted to a source and then makes variations of its episodes."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
from minari import EpisodeData

from oat_gym.cache import Arrays
from oat_gym.episodes import IntArray
from oat_gym.mining import MiningResult
from oat_gym.progress import ProgressCallback, silent
from oat_gym.source import Source
from oat_gym.spaces import Batch
from oat_gym.stitching import Span, spans_mask


@dataclass(frozen=True)
class Variation:
    """One synthetic episode.

    `episode` shares no memory with the source; `spans` are its generated steps; `next_states` holds the next states
    that differ from `observations[t+1]` (the paper's literal seam), batches of one row keyed by step. `log_prob` (T,)
    is that of the generated actions under the policy that drew them, NaN at recorded steps; None for methods that
    have no such policy.
    """

    episode: EpisodeData
    spans: tuple[Span, ...]
    next_states: dict[int, Batch] = field(default_factory=dict[int, Batch])
    log_prob: npt.NDArray[np.float64] | None = None


def inherited_next_states(earlier: Mapping[int, Batch], steps: int, later: Variation) -> dict[int, Batch]:
    """Return the next states of a variation: its own, and where it changed nothing those of what it was made from.

    `earlier` are the next states of that episode, which has `steps` steps.
    """
    length = len(later.episode.rewards)
    changed = spans_mask(later.spans, length)
    kept = {t: row for t, row in earlier.items() if steps == length and not changed[t]}
    return later.next_states | kept


class Sampler(ABC):
    """A fitted augmenter: variation k of source episode i, as a pure function of (seed, i, k).

    The work is in two steps, so that the expensive one is done once and kept: `generate(k)` makes all that variation
    k of any episode needs, in one batch, as arrays for the cache; `variation` puts one episode together from it.
    """

    @abstractmethod
    def variation(self, i: int, k: int, material: Any) -> Variation:
        """Return variation `k` of source episode `i`; `material` is what `decode` made of `generate(k)`."""

    @property
    def mining(self) -> MiningResult | None:
        """What was mined, for methods that mine."""
        return None

    @property
    def notes(self) -> tuple[str, ...]:
        """What users are warned of when the sampler is put to use; nothing by default."""
        return ()

    def generate(self, k: int) -> Arrays:
        """Return the generated arrays of variation `k`; none by default (everything is made by `variation`)."""
        return {}

    def decode(self, arrays: Arrays) -> Any:
        """Return the arrays of `generate` in the form that `variation` reads fastest; by default as they are."""
        return arrays

    def state(self) -> tuple[Arrays, Any]:
        """Return (arrays, JSON value) from which `Augmenter.restore` makes an equal sampler; empty by default."""
        return {}, None


@dataclass(frozen=True)
class Augmenter(ABC):
    """Base of all augmenters: a frozen dataclass, so that its repr rebuilds it and its fields identify the cache."""

    name: ClassVar[str]
    trains: ClassVar[bool] = True
    """Whether `fit` takes long enough for its result to be kept on disk."""
    expected_failures: ClassVar[Mapping[str, str]] = {}
    """Checks of `oat_gym.checks.check_augmenter` that the method cannot pass, and the reason of each.

    Of a method that is made of others they are those that it may fail.
    """

    @property
    def at_zero_strength(self) -> Augmenter | None:
        """The same method at zero strength, whose variations equal their sources; None where no setting is one."""
        return None

    @property
    def cacheable(self) -> bool:
        """Whether the settings have a JSON form, which tells one result from another on disk and in recipes."""
        return True

    @abstractmethod
    def fit(self, source: Source, *, seed: int, progress: ProgressCallback = silent) -> Sampler:
        """Learn from `source` and return the sampler of stream `seed`. Raises an `OatGymError` where it cannot work.

        A seed and not a generator: what is restored from the cache in another process, and any variation (i, k) in
        any order, must draw the same numbers, so that each part derives its own stream (`oat_gym._rng.derive`).
        """

    def restore(self, source: Source, arrays: Arrays, value: Any, *, seed: int) -> Sampler:
        """Return the sampler whose `state()` was (arrays, value); by default it is fitted anew."""
        return self.fit(source, seed=seed)

    def check(self, source: Source) -> None:  # noqa: B027  (most methods have no demand of their own)
        """Raise an `OatGymError` where spaces or lengths rule the method out; reads no episode."""

    def lengths(self, source: Source, episodes: IntArray, variations: IntArray, *, seed: int) -> IntArray:
        """Return the number of steps of each variation (episodes[j], variations[j]), before anything is generated.

        It is called when a dataset is opened, so it trains nothing; by default the lengths of the source episodes.
        """
        return source.lengths[episodes]
