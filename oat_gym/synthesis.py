"""The plan of an augmented dataset and the work behind it: fit once, keep on disk, make episodes on demand."""

from __future__ import annotations

import threading
import warnings
from collections.abc import Iterator
from functools import cached_property
from typing import Any

import numpy as np
from gymnasium import Space

from oat_gym._rng import check_seed
from oat_gym.augmenters.base import Augmenter, Sampler, Variation
from oat_gym.cache import CacheEntry, canonical, fingerprint
from oat_gym.episodes import IntArray
from oat_gym.errors import AugmentationWarning, ConfigurationError
from oat_gym.progress import ProgressCallback, progress_bar
from oat_gym.source import Source
from oat_gym.spaces import iter_leaf_spaces

MAX_COUNT = 10_000_000
"""Most synthetic episodes of one dataset: a plan keeps a length for each, and a recipe may ask for anything."""

_SAMPLING = 2
"""In the name of each stored variation: raise it when a change alters what models that are stored generate."""


class Synthesis:
    """`count` synthetic episodes of `source` by `augmenter`, of which nothing is made before it is asked for.

    Synthetic episode j is variation j // N of source episode j % N (N source episodes), so every episode is used
    equally often and the plan, lengths included, is known without training.
    """

    def __init__(self, source: Source, augmenter: Augmenter, *, count: int, seed: int) -> None:
        if isinstance(count, bool) or not isinstance(count, int | np.integer) or count < 0:
            raise ConfigurationError(f"count must be an integer of at least 0, got {count!r}.")
        if count > MAX_COUNT:
            raise ConfigurationError(f"count may be {MAX_COUNT} at most, got {count}: make several datasets of them.")
        self.source = source
        self.augmenter = augmenter
        self.count = int(count)
        self.seed = check_seed(seed)
        if self.count:
            augmenter.check(source)
        self._lock = threading.RLock()
        self._sampler: Sampler | None = None
        self._material: list[Any] = []

    @property
    def n_real(self) -> int:
        """Number of source episodes, N."""
        return len(self.source)

    @cached_property
    def lengths(self) -> IntArray:
        """Steps of each episode, the real ones first: (N + count,)."""
        numbers = np.arange(self.count)
        i, k = numbers % self.n_real, numbers // self.n_real
        planned = self.augmenter.lengths(self.source, i, k, seed=self.seed) if self.count else numbers
        return np.concatenate([self.source.lengths, np.asarray(planned, dtype=np.int64)])

    @property
    def is_fitted(self) -> bool:
        """Whether synthetic episodes can be had without training."""
        return self.count == 0 or self._sampler is not None

    @property
    def sampler(self) -> Sampler:
        """The fitted augmenter; fits first where that is still to do."""
        self.fit()
        if self._sampler is None:
            raise ConfigurationError("No synthetic episode was asked for (count=0), so nothing was fitted.")
        return self._sampler

    def variation(self, j: int) -> Variation:
        """Return synthetic episode `j`, 0 <= j < count."""
        sampler = self.sampler
        i, k = j % self.n_real, j // self.n_real
        return sampler.variation(i, k, self._material[k])

    def fit(self, progress: ProgressCallback | bool | None = None) -> None:
        """Train, or read what was trained before from the cache, and generate what the plan needs.

        `progress` is a callback, or whether to draw a bar (None: where standard error is a terminal).
        """
        if self.is_fitted:
            return
        with self._lock:
            if self.is_fitted:
                return
            if progress is None or isinstance(progress, bool):
                with progress_bar(progress) as report:
                    self._fit(report)
            else:
                self._fit(progress)

    def _fit(self, progress: ProgressCallback) -> None:
        variations = range(-(-self.count // self.n_real))
        augmenter, source = self.augmenter, self.source
        if not (augmenter.cacheable and augmenter.trains):
            sampler = augmenter.fit(source, seed=self.seed, progress=progress)
            self._material = [
                sampler.decode(sampler.generate(k)) for k in _told("Generating variations", variations, progress)
            ]
            self._use(sampler)
            return
        entry = CacheEntry(self.cache_key)
        with entry.lock():
            stored = entry.read("model")
            if stored is None:
                stored = augmenter.fit(source, seed=self.seed, progress=progress).state()
                entry.write("model", *stored)
            # The sampler always comes from its stored form: a first run and a later one are the same run.
            sampler = augmenter.restore(source, *stored, seed=self.seed)
            self._material = [
                self._variation_material(entry, sampler, k)
                for k in _told("Generating variations", variations, progress)
            ]
        self._use(sampler)

    def _use(self, sampler: Sampler) -> None:
        for note in sampler.notes:
            warnings.warn(note, AugmentationWarning, stacklevel=2)
        self._sampler = sampler

    def _variation_material(self, entry: CacheEntry, sampler: Sampler, k: int) -> Any:
        name = f"variation-{_SAMPLING}-{k}"
        stored = entry.read(name)
        if stored is None:
            stored = sampler.generate(k), None
            entry.write(name, *stored)
        return sampler.decode(stored[0])

    @cached_property
    def cache_key(self) -> str:
        """Fingerprint of the source's content and spaces, the augmenter's configuration, and the seed."""
        return fingerprint(
            source=self.source.fingerprint,
            spaces=[_leaves(self.source.observation_space), _leaves(self.source.action_space)],
            augmenter=[self.augmenter.name, canonical(self.augmenter)],
            seed=self.seed,
        )


def _leaves(space: Space[Any]) -> list[list[str]]:
    """Return what identifies a space, whatever the order in which a Dict lists its keys."""
    return [[repr(path), repr(leaf)] for path, leaf in iter_leaf_spaces(space)]


def _told(description: str, numbers: range, progress: ProgressCallback) -> Iterator[int]:
    """Yield the numbers and report how many are done."""
    for number in numbers:
        progress(description, number, len(numbers))
        yield number
    progress(description, len(numbers), len(numbers))
