"""Function: the user's own augmenter, any f(episode, rng) -> episode."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from minari import EpisodeData

from oat_gym._rng import derive
from oat_gym.augmenters.base import Augmenter, Sampler, Variation
from oat_gym.episodes import check_episode, copy_episode
from oat_gym.errors import ConfigurationError, InvalidDataError
from oat_gym.progress import ProgressCallback, silent
from oat_gym.source import Source
from oat_gym.stitching import Span


@dataclass(frozen=True)
class Function(Augmenter):
    """An augmenter from a function of an episode and a random generator.

    `function(episode, rng)` gets a copy of a source episode (a `minari.EpisodeData`) and a `numpy.random.Generator`
    that depends on the seed, the episode and the variation only. It returns an episode with as many steps; all its
    steps count as generated. It may change the episode in place. Every space is accepted.

    >>> def louder(episode, rng):
    ...     episode.rewards[:] *= rng.uniform(0.9, 1.1)
    ...     return episode
    >>> Function(louder).name
    'function'
    """

    name: ClassVar[str] = "function"
    trains: ClassVar[bool] = False
    expected_failures: ClassVar[Mapping[str, str]] = {"zero-strength": "how much a function changes is not a setting"}
    function: Callable[[EpisodeData, np.random.Generator], EpisodeData]

    def __post_init__(self) -> None:
        if not callable(self.function):
            raise ConfigurationError(f"Function takes a callable f(episode, rng) -> episode, got {self.function!r}.")

    @property
    def cacheable(self) -> bool:
        """False: a function has no JSON form."""
        return False

    def fit(self, source: Source, *, seed: int, progress: ProgressCallback = silent) -> Sampler:
        """Return a sampler that calls the function; nothing is learnt."""
        return _FunctionSampler(self, source, seed)


class _FunctionSampler(Sampler):
    def __init__(self, augmenter: Function, source: Source, seed: int) -> None:
        self._augmenter = augmenter
        self._source = source
        self._seed = seed

    def variation(self, i: int, k: int, material: object) -> Variation:
        original = self._source.episodes[i]
        result = self._augmenter.function(copy_episode(original, number=i), derive(self._seed, "function", i, k))
        if not isinstance(result, EpisodeData):
            raise InvalidDataError(
                f"The function given to Function returned {type(result).__name__} for episode {i}; it must return a "
                "minari.EpisodeData."
            )
        check_episode(result, self._source.observation_space, self._source.action_space)
        if len(result.rewards) != len(original.rewards):
            raise InvalidDataError(
                f"The function given to Function returned {len(result.rewards)} steps for episode {i} of "
                f"{len(original.rewards)}; the length must stay, since it is announced before anything is generated."
            )
        parts = ("observations", "actions", "infos")
        ordered = {name: _in_key_order(getattr(original, name), getattr(result, name)) for name in parts}
        return Variation(dataclasses.replace(result, **ordered), (Span(0, len(result.rewards)),))


def _in_key_order(recorded: Any, made: Any) -> Any:
    """Return `made`, its dictionaries in the order of the recorded ones: arrow reads no dataset with both orders."""
    if isinstance(recorded, dict) and isinstance(made, dict) and recorded.keys() == made.keys():
        return {key: _in_key_order(recorded[key], made[key]) for key in recorded}
    if isinstance(recorded, tuple) and isinstance(made, tuple) and len(recorded) == len(made):
        return tuple(_in_key_order(*pair) for pair in zip(recorded, made, strict=True))
    return made
