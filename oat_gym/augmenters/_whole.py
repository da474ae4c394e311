"""What the methods share that generate whole episodes at once, as series of [s, a, r] rows."""

from __future__ import annotations

import dataclasses
from abc import abstractmethod
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from oat_gym.augmenters.base import Sampler, Variation
from oat_gym.cache import Arrays
from oat_gym.errors import InvalidDataError
from oat_gym.generation import Limits
from oat_gym.generation.padded import PaddedSeries, split_rows
from oat_gym.source import Source
from oat_gym.spaces import Batch, in_dtype_of, map_tree, slice_tree
from oat_gym.stitching import Span, stitchable_copy


class WholeEpisodes(NamedTuple):
    """One variation of every source episode in the dataset's spaces, one after the other."""

    observations: Batch
    actions: Batch
    rewards: npt.NDArray[np.float64]


def padded_series(source: Source) -> PaddedSeries:
    """Return the source's episodes as padded series."""
    return PaddedSeries.of(
        source.state_matrices(),
        source.action_matrices(),
        source.rewards(),
        state_layout=source.flat_observations.layout,
        action_layout=source.flat_actions.layout,
    )


def check_count(source: Source, *, least: int, what: str, why: str) -> None:
    """Raise `InvalidDataError` unless the source has `least` episodes; `why` explains the number."""
    if len(source) < least:
        raise InvalidDataError(
            f"{what} needs at least {least} episodes, got {len(source)}: {why} Use a method that needs no model of "
            "whole episodes (jittering, scaling, permutation), or more data."
        )


class WholeSampler(Sampler):
    """Variations that are generated from end to end; the length, flags and infos are those of the source episode.

    `generate(k)` keeps the recorded rows of all episodes one below the other, so that padding is not stored.
    """

    def __init__(self, source: Source, *, margin: float) -> None:
        self._source, self._margin = source, margin

    @abstractmethod
    def sample(self, k: int) -> npt.NDArray[np.floating[Any]]:
        """Return series (N, L, width) for variation `k` of each episode, in the data's units."""

    def generate(self, k: int) -> Arrays:
        """Return the rows of variation `k` of every episode, ((T_0 + 1) + (T_1 + 1) + ..., width)."""
        rows = self.sample(k)
        return {"rows": rows[self._series.recorded_rows].astype(np.float32)}

    def decode(self, arrays: Arrays) -> WholeEpisodes:
        """Return the rows within limits and in the dataset's spaces; the last row of an episode is a state only."""
        states, actions, rewards = split_rows(arrays["rows"].astype(np.float64), self._series.state_layout.width)
        steps = self._series.recorded_steps[self._series.recorded_rows]
        observations, acted = self._source.flat_observations, self._source.flat_actions
        return WholeEpisodes(
            observations.unflatten(self._limits.clip_states(states, observations.layout)),
            acted.unflatten(self._limits.clip_actions(actions[steps], acted.layout)),
            np.clip(rewards[steps], *self._limits.rewards),
        )

    def variation(self, i: int, k: int, material: WholeEpisodes) -> Variation:
        """Return variation `k` of source episode `i`."""
        original, length = self._source.episodes[i], int(self._series.lengths[i])
        first = int(self._series.lengths[:i].sum())
        rows, steps = slice(first + i, first + i + length + 1), slice(first, first + length)
        episode = stitchable_copy(original, number=i)
        episode = dataclasses.replace(
            episode,
            # The recorded tree comes first: arrow reads no dataset whose episodes have their keys in different orders.
            observations=map_tree(in_dtype_of, episode.observations, slice_tree(material.observations, rows)),
            actions=map_tree(in_dtype_of, episode.actions, slice_tree(material.actions, steps)),
            rewards=material.rewards[steps].astype(episode.rewards.dtype),
        )
        return Variation(episode, (Span(0, length, sample=k * len(self._source) + i),))

    @cached_property
    def _series(self) -> PaddedSeries:
        return padded_series(self._source)

    @cached_property
    def _limits(self) -> Limits:
        """The range of all recorded values, wider by the margin and inside the spaces' bounds."""
        return Limits.of(
            np.concatenate(self._source.state_matrices()),
            np.concatenate(self._source.action_matrices()),
            np.concatenate(self._source.rewards()),
            margin=self._margin,
            state_bounds=self._source.flat_observations.bounds,
            action_bounds=self._source.flat_actions.bounds,
        )
