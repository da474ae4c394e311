"""Compose: several augmenters in sequence, each on what the one before it made."""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import numpy as np
from minari import EpisodeData

from oat_gym.augmenters._parts import (
    check_parts,
    joined_failures,
    part_seed,
    under_prefix,
    with_prefix,
    zero_strengths,
)
from oat_gym.augmenters.base import Augmenter, Sampler, Variation, inherited_next_states
from oat_gym.cache import Arrays, canonical
from oat_gym.episodes import IntArray
from oat_gym.errors import AugmentationWarning, ConfigurationError
from oat_gym.mining import MiningResult
from oat_gym.progress import ProgressCallback, silent
from oat_gym.provenance import merge_spans
from oat_gym.source import DerivedSource, Source


@dataclass(frozen=True)
class Compose(Augmenter):
    """Several augmenters in sequence: the first makes variation k of every episode, the next one augments those, ...

    Each later augmenter sees the N episodes that the one before it made for variation k as its source, and makes its
    own variation k of them. One that trains and is not the first is therefore trained once for each variation: ten
    times at `factor=11`. Put the one that trains first, where it is trained once, and those that train nothing
    after it. `AugmentedDataset.mining` is that of the first.

    A step counts as generated where any of them changed it. Where the first one keeps next states of its own
    (`OAT(seam="literal")`), they stay at the steps that no later one changed. The episodes between two augmenters are
    kept in memory once they are made.

    Args:
        augmenters: at least one augmenter, in the order in which they are applied.

    Raises:
        ConfigurationError: for anything but a tuple of augmenters.

    >>> from oat_gym import OAT, Function
    >>> def softer(episode, rng):
    ...     episode.rewards[:] *= rng.uniform(0.9, 1.0)
    ...     return episode
    >>> both = Compose((OAT(), Function(softer)))
    >>> [part.name for part in both.augmenters], both.cacheable
    (['oat', 'function'], False)
    """

    name: ClassVar[str] = "compose"
    augmenters: tuple[Augmenter, ...]

    def __post_init__(self) -> None:
        check_parts("Compose", self.augmenters)

    @property
    def trains(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]  (depends on the parts)
        """Whether any of the augmenters trains."""
        return any(part.trains for part in self.augmenters)

    @property
    def expected_failures(self) -> Mapping[str, str]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Those of the augmenters, which the whole may pass."""
        return joined_failures(self.augmenters)

    @property
    def cacheable(self) -> bool:
        """Whether all augmenters are."""
        return all(part.cacheable for part in self.augmenters)

    @property
    def at_zero_strength(self) -> Compose | None:
        """All augmenters at zero strength, where all have such."""
        zeros = zero_strengths(self.augmenters)
        return None if zeros is None else Compose(zeros)

    def check(self, source: Source) -> None:
        """Raise where the source's spaces or lengths rule one of the augmenters out."""
        for part in self.augmenters:
            part.check(source)

    def lengths(self, source: Source, episodes: IntArray, variations: IntArray, *, seed: int) -> IntArray:
        """Return the number of steps of each variation after the last augmenter.

        Raises:
            ConfigurationError: where a later augmenter has to read episodes to tell its lengths, and an earlier one
                would have to be trained to make them.
        """
        if all(type(part).lengths is Augmenter.lengths for part in self.augmenters):
            return source.lengths[episodes]
        lengths = np.zeros(len(episodes), dtype=np.int64)
        for k in np.unique(variations):
            chosen = variations == k
            lengths[chosen] = self._planned(source, int(k), seed)[episodes[chosen]]
        return lengths

    def _planned(self, source: Source, k: int, seed: int) -> IntArray:
        """Return the steps of variation `k` of every episode, (N,)."""
        before = source
        for number, part in enumerate(self.augmenters):
            lengths = _lengths_of_all(part, before, k, part_seed(seed, self.name, number))
            before = DerivedSource(source, lengths, partial(self._made_at_once, source, k, seed, number + 1))
        return before.lengths

    def _made_at_once(self, source: Source, k: int, seed: int, stop: int) -> list[EpisodeData]:
        """Return variation `k` of every episode by the first `stop` augmenters, where these train nothing."""
        head = Compose(self.augmenters[:stop])
        if head.trains:
            raise ConfigurationError(
                f"{self.augmenters[stop]!r} reads episodes to tell how long its own will be, and here these are made "
                f"by {self.augmenters[stop - 1]!r}, which has to be trained first. Put the one that reads them first."
            )
        sampler = head.fit(source, seed=seed)
        material = sampler.decode(sampler.generate(k))
        return [sampler.variation(i, k, material).episode for i in range(len(source))]

    def fit(self, source: Source, *, seed: int, progress: ProgressCallback = silent) -> Sampler:
        """Fit the first augmenter; the others are fitted to what it makes, when a variation is generated."""
        return ComposeSampler(self, source, seed, self.augmenters[0].fit(source, seed=seed, progress=progress))

    def restore(self, source: Source, arrays: Arrays, value: Any, *, seed: int) -> Sampler:
        """Return the sampler whose `state()` was (arrays, value)."""
        return ComposeSampler(self, source, seed, self.augmenters[0].restore(source, arrays, value, seed=seed))


class ComposeSampler(Sampler):
    """Variations by one sampler after the other."""

    def __init__(self, config: Compose, source: Source, seed: int, first: Sampler) -> None:
        self._config = config
        self._source = source
        self._seed = seed
        self._first = first

    @property
    def mining(self) -> MiningResult | None:
        """What the first augmenter mined."""
        return self._first.mining

    @property
    def notes(self) -> tuple[str, ...]:
        """Those of the first sampler; the others are fitted to every variation, and warn when it is first read."""
        return self._first.notes

    def state(self) -> tuple[Arrays, Any]:
        """Return the state of the first sampler; what the others learn from variation k is in `generate(k)`."""
        return self._first.state()

    def generate(self, k: int) -> Arrays:
        """Return what each sampler generates for variation `k`, and the state of those after the first that train."""
        arrays: Arrays = {}
        self._chain(k, arrays, stored=False)
        return arrays

    def decode(self, arrays: Arrays) -> _Material:
        """Return the arrays, from which the samplers are made when the first episode is asked for."""
        return _Material(arrays)

    def variation(self, i: int, k: int, material: _Material) -> Variation:
        """Return what the last sampler makes of what the one before it made of ... source episode `i`."""
        if material.chain is None:
            material.chain = self._chain(k, material.arrays, stored=True)
        return material.chain.variation(i)

    def _chain(self, k: int, arrays: Arrays, *, stored: bool) -> _Chain:
        """Return the samplers of variation `k`; `arrays` are read where they are stored, else filled."""
        chain, source = _Chain(k, len(self._source)), self._source
        for number, part in enumerate(self._config.augmenters):
            seed, prefix = part_seed(self._seed, self._config.name, number), f"{number}/"
            first = self._first if number == 0 else None
            sampler = first or _fitted(part, source, seed, prefix, arrays, stored=stored)
            if not stored:
                arrays |= with_prefix(f"{prefix}made/", sampler.generate(k))
            for note in sampler.notes if stored and first is None else ():  # those of the first are `notes`
                warnings.warn(note, AugmentationWarning, stacklevel=2)
            chain.links.append((sampler, sampler.decode(under_prefix(f"{prefix}made/", arrays))))
            if number + 1 < len(self._config.augmenters):
                lengths = _lengths_of_all(part, source, k, seed)
                source = DerivedSource(self._source, lengths, partial(chain.episodes, number))
        return chain


class _Chain:
    """The samplers of one variation, each with its decoded material, and the episodes between them."""

    def __init__(self, k: int, total: int) -> None:
        self.links: list[tuple[Sampler, Any]] = []
        self._k = k
        self._total = total
        self._between: dict[int, tuple[Variation, ...]] = {}

    def variation(self, i: int, number: int = -1) -> Variation:
        """Return episode `i` after link `number`, by default the last one."""
        number %= len(self.links)
        sampler, material = self.links[number]
        made = sampler.variation(i, self._k, material)
        return made if number == 0 else put_over(self._after(number - 1)[i], made)

    def episodes(self, number: int) -> list[EpisodeData]:
        """Return all episodes after link `number`."""
        return [made.episode for made in self._after(number)]

    def _after(self, number: int) -> tuple[Variation, ...]:
        if number not in self._between:
            self._between[number] = tuple(self.variation(i, number) for i in range(self._total))
        return self._between[number]


@dataclass
class _Material:
    arrays: Arrays
    chain: _Chain | None = None


def put_over(earlier: Variation, later: Variation) -> Variation:
    """Return `later`, which was made from `earlier`, with what still holds of the spans and next states of that."""
    spans = merge_spans(earlier.spans, later.spans, length=len(later.episode.rewards))
    next_states = inherited_next_states(earlier.next_states, len(earlier.episode.rewards), later)
    return Variation(later.episode, spans, next_states)


def _fitted(part: Augmenter, source: Source, seed: int, prefix: str, arrays: Arrays, *, stored: bool) -> Sampler:
    """Return the sampler of a part; the state of one that trains is read from `arrays`, or put there first."""
    if not part.trains:
        return part.fit(source, seed=seed)
    if not stored:
        learnt, value = part.fit(source, seed=seed).state()
        text = json.dumps(canonical(value)).encode()
        arrays |= with_prefix(f"{prefix}state/", learnt) | {f"{prefix}value": np.frombuffer(text, dtype=np.uint8)}
    value = json.loads(arrays[f"{prefix}value"].tobytes())
    # From the stored form in both cases, so that a first run and a later one are the same run.
    return part.restore(source, under_prefix(f"{prefix}state/", arrays), value, seed=seed)


def _lengths_of_all(part: Augmenter, source: Source, k: int, seed: int) -> IntArray:
    """Return the steps of variation `k` of every episode of `source`, (N,)."""
    numbers = np.arange(len(source))
    planned = part.lengths(source, numbers, np.full(len(source), k), seed=seed)
    return np.asarray(planned, dtype=np.int64)
