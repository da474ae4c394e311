"""Mixture: a share of the synthetic episodes from each of several augmenters."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from oat_gym._rng import derive
from oat_gym.augmenters._parts import (
    check_parts,
    joined_failures,
    part_seed,
    under_prefix,
    with_prefix,
    zero_strengths,
)
from oat_gym.augmenters.base import Augmenter, Sampler, Variation
from oat_gym.cache import Arrays
from oat_gym.episodes import IntArray
from oat_gym.errors import ConfigurationError
from oat_gym.mining import MiningResult
from oat_gym.progress import ProgressCallback, silent
from oat_gym.source import Source

_PARTS = "parts"


@dataclass(frozen=True)
class Mixture(Augmenter):
    """A share of the synthetic episodes from each of several augmenters.

    Which augmenter makes variation k of episode i depends on the seed, i, k and the number of source episodes only.
    The shares are kept in every prefix of variations as nearly as whole episodes allow (`apportion`), and which
    episodes of a variation go to which augmenter is drawn anew for each k. Every augmenter learns from all episodes;
    what it generates for those that go to another one is not used. `AugmentedDataset.mining` is that of the first
    augmenter that mines.

    Args:
        augmenters: at least one augmenter.
        shares: a positive number for each, relative to their sum; None: equal shares.

    Raises:
        ConfigurationError: for anything but a tuple of augmenters, and for shares that are not as many positive
            finite numbers.

    >>> from oat_gym import OAT, Function
    >>> def softer(episode, rng):
    ...     episode.rewards[:] *= rng.uniform(0.9, 1.0)
    ...     return episode
    >>> Mixture((OAT(), Function(softer)), shares=(3.0, 1.0)).proportions.tolist()
    [0.75, 0.25]
    """

    name: ClassVar[str] = "mixture"
    augmenters: tuple[Augmenter, ...]
    shares: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        check_parts("Mixture", self.augmenters)
        if self.shares is None:
            return
        if not isinstance(self.shares, tuple) or len(self.shares) != len(self.augmenters):
            raise ConfigurationError(
                f"shares must be a tuple of {len(self.augmenters)} numbers, one for each augmenter, or None for equal "
                f"ones; got {self.shares!r}."
            )
        for share in self.shares:
            if isinstance(share, bool) or not isinstance(share, int | float) or not 0 < share < math.inf:
                raise ConfigurationError(f"Each share must be a positive finite number, got {share!r}.")

    @property
    def proportions(self) -> npt.NDArray[np.float64]:
        """The shares, which sum to 1: one for each augmenter."""
        shares = np.ones(len(self.augmenters)) if self.shares is None else np.array(self.shares, dtype=np.float64)
        return shares / shares.sum()

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
    def at_zero_strength(self) -> Mixture | None:
        """All augmenters at zero strength, where all have such."""
        zeros = zero_strengths(self.augmenters)
        return None if zeros is None else Mixture(zeros, self.shares)

    def check(self, source: Source) -> None:
        """Raise where the source's spaces or lengths rule one of the augmenters out."""
        for part in self.augmenters:
            part.check(source)

    def assignment(self, n_source: int, variations: int, *, seed: int) -> IntArray:
        """Return which augmenter makes variation k of episode i, (variations, n_source), for k from 0."""
        slots = apportion(self.proportions, n_source * variations).reshape(variations, n_source)
        orders = [derive(seed, self.name, "order", k).permutation(n_source) for k in range(variations)]
        return np.stack([row[order] for row, order in zip(slots, orders, strict=True)]) if variations else slots

    def lengths(self, source: Source, episodes: IntArray, variations: IntArray, *, seed: int) -> IntArray:
        """Return the number of steps of each variation: that of the augmenter that makes it."""
        if not len(episodes):
            return np.zeros(0, dtype=np.int64)
        makers = self.assignment(len(source), int(variations.max()) + 1, seed=seed)[variations, episodes]
        lengths = np.zeros(len(episodes), dtype=np.int64)
        for number, part in enumerate(self.augmenters):
            own = makers == number
            if own.any():
                part_of_it = part_seed(seed, self.name, number)
                lengths[own] = part.lengths(source, episodes[own], variations[own], seed=part_of_it)
        return lengths

    def fit(self, source: Source, *, seed: int, progress: ProgressCallback = silent) -> Sampler:
        """Fit every augmenter to the source."""
        samplers = [
            part.fit(source, seed=part_seed(seed, self.name, number), progress=progress)
            for number, part in enumerate(self.augmenters)
        ]
        return MixtureSampler(self, source, seed, samplers)

    def restore(self, source: Source, arrays: Arrays, value: Any, *, seed: int) -> Sampler:
        """Return the sampler whose `state()` was (arrays, value)."""
        samplers = [
            part.restore(
                source, under_prefix(f"{number}/", arrays), value[number], seed=part_seed(seed, self.name, number)
            )
            for number, part in enumerate(self.augmenters)
        ]
        return MixtureSampler(self, source, seed, samplers)


class MixtureSampler(Sampler):
    """Variations by one of several samplers each."""

    def __init__(self, config: Mixture, source: Source, seed: int, samplers: list[Sampler]) -> None:
        self._config = config
        self._n_source = len(source)
        self._seed = seed
        self._samplers = samplers
        self._makers: IntArray = np.zeros((0, len(source)), dtype=np.int64)

    @property
    def mining(self) -> MiningResult | None:
        """What the first sampler that mines has mined."""
        return next((sampler.mining for sampler in self._samplers if sampler.mining is not None), None)

    @property
    def notes(self) -> tuple[str, ...]:
        """Those of all samplers."""
        return tuple(note for sampler in self._samplers for note in sampler.notes)

    def state(self) -> tuple[Arrays, Any]:
        """Return the states of all samplers, the arrays under the number of each."""
        states = [sampler.state() for sampler in self._samplers]
        arrays = [with_prefix(f"{number}/", part) for number, (part, _) in enumerate(states)]
        return {name: array for part in arrays for name, array in part.items()}, [value for _, value in states]

    def generate(self, k: int) -> Arrays:
        """Return what the samplers that have an episode in variation `k` generate for it."""
        used = np.unique(self._of(k))
        arrays: Arrays = {_PARTS: used}
        for number in used:
            arrays |= with_prefix(f"{number}/", self._samplers[number].generate(k))
        return arrays

    def decode(self, arrays: Arrays) -> dict[int, Any]:
        """Return what each sampler that is used decodes."""
        numbers = [int(number) for number in arrays[_PARTS]]
        return {number: self._samplers[number].decode(under_prefix(f"{number}/", arrays)) for number in numbers}

    def variation(self, i: int, k: int, material: dict[int, Any]) -> Variation:
        """Return what the sampler that variation `k` of source episode `i` belongs to makes of it."""
        number = int(self._of(k)[i])
        return self._samplers[number].variation(i, k, material[number])

    def _of(self, k: int) -> IntArray:
        makers = self._makers
        if k >= len(makers):  # twice as many each time, so that asking for one after the other stays cheap
            makers = self._config.assignment(self._n_source, 2 * k + 1, seed=self._seed)
            self._makers = makers
        return makers[k]


def apportion(proportions: npt.NDArray[np.float64], total: int) -> IntArray:
    """Return `total` numbers of parts in an order in which every prefix has each part's share (`proportions`, sum 1).

    The c-th turn of a part with share p is due at (c + 1/2) / p, and turns are taken in the order in which they are
    due: Webster's apportionment, so that no two parts of a prefix could come nearer to their shares by an exchange.
    A prefix of the result is the result for a smaller total.

    >>> apportion(np.array([0.75, 0.25]), 8).tolist()
    [0, 0, 1, 0, 0, 0, 1, 0]
    """
    turns = [np.arange(math.ceil(total * share) + len(proportions)) for share in proportions]
    due = np.concatenate([(turn + 0.5) / share for turn, share in zip(turns, proportions, strict=True)])
    parts = np.repeat(np.arange(len(proportions)), [len(turn) for turn in turns])
    return parts[np.argsort(due, kind="stable")][:total]
