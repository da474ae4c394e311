"""The dataset that is augmented: read once, checked, never written to."""

from __future__ import annotations

import copy
import hashlib
import json
import warnings
from collections.abc import Callable, Iterable
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from minari import EpisodeData, MinariDataset

from oat_gym.episodes import IntArray, check_episode, content_hash
from oat_gym.errors import InvalidDataError, SourceChangedError
from oat_gym.lazy_metadata import LazyMetadata
from oat_gym.provenance import METADATA_KEYS, has_provenance
from oat_gym.serialization import metadata_to_json
from oat_gym.spaces import FlatSpace


class Source:
    """The episodes of a Minari dataset (or of a view of one), numbered 0 to N-1 in the view's order.

    Lengths are known at once; the data is read on first use and kept in memory, since a stitch from memory is tens of
    times faster than one from HDF5. What `episode` gives is shared: callers copy before they change it.
    """

    def __init__(self, dataset: MinariDataset, *, expected_fingerprint: str | None = None) -> None:
        if dataset.total_episodes == 0:
            raise InvalidDataError(
                f"The dataset {dataset.id!r} (or this view of it) has no episodes; at least one is needed to augment."
            )
        self.dataset = dataset
        self.expected_fingerprint = expected_fingerprint

    def __len__(self) -> int:
        """Return the number of episodes."""
        return len(self.ids)

    @cached_property
    def ids(self) -> IntArray:
        """The storage id of each episode, (N,)."""
        return np.array(self.dataset.episode_indices, dtype=np.int64)

    @property
    def view(self) -> MinariDataset:
        """The dataset restricted to these episodes, whatever becomes of the indices of the user's own view."""
        view = copy.copy(self.dataset)
        view.episode_indices = self.ids
        return view

    @cached_property
    def metadata(self) -> tuple[dict[str, Any], ...]:
        """The metadata that the storage keeps for each episode.

        A key of the user's that is also one of ours (`METADATA_KEYS`) is renamed to `original_<key>`, with a warning.
        """
        try:
            metadata = tuple(self.dataset.storage.get_episode_metadata(self.ids))
        except (KeyError, FileNotFoundError) as error:
            raise InvalidDataError(
                f"The dataset {self.dataset.id!r} claims {self.dataset.storage.total_episodes} episodes, and one of "
                f"them is missing ({error}): it is damaged."
            ) from error
        clashes = {key for part in metadata if not has_provenance(part) for key in METADATA_KEYS if key in part}
        if not clashes:
            return metadata
        warnings.warn(
            f"The episode metadata of {self.dataset.id!r} has keys that tell provenance in an augmented dataset: "
            f"{', '.join(sorted(clashes))}. There they are renamed, with 'original_' before the name.",
            UserWarning,
            stacklevel=2,
        )
        return tuple(part if has_provenance(part) else _rename_clashes(part) for part in metadata)

    @cached_property
    def lengths(self) -> IntArray:
        """The number of steps of each episode, (N,)."""
        return np.array([metadata["total_steps"] for metadata in self.metadata], dtype=np.int64)

    @property
    def observation_space(self) -> spaces.Space[Any]:
        """The dataset's observation space."""
        return self.dataset.observation_space

    @property
    def action_space(self) -> spaces.Space[Any]:
        """The dataset's action space."""
        return self.dataset.action_space

    @property
    def is_loaded(self) -> bool:
        """Whether the episodes are in memory."""
        return "episodes" in self.__dict__

    @cached_property
    def episodes(self) -> tuple[EpisodeData, ...]:
        """All episodes, checked against the T+1 rule and against the lengths that the storage claims."""
        episodes = tuple(EpisodeData(**data) for data in self.dataset.storage.get_episodes(list(self.ids)))
        for number, episode in enumerate(episodes):
            check_episode(episode, self.observation_space, self.action_space)
            self.check_length(number, len(episode.rewards))
        self._check_fingerprint(episodes)
        return episodes

    def check_length(self, number: int, length: int) -> None:
        """Raise `InvalidDataError` unless `length`, what was read, is what the metadata of episode `number` says."""
        if length != self.lengths[number]:
            raise InvalidDataError(
                f"Episode {number} of {self.dataset.id!r} gives {length} steps where its metadata says "
                f"{self.lengths[number]}. Arrow and Parquet storages cut episodes over 32,767 rows (Minari issue 351): "
                "store the dataset as HDF5."
            )

    def _check_fingerprint(self, episodes: tuple[EpisodeData, ...]) -> None:
        if self.expected_fingerprint and content_hash(episodes) != self.expected_fingerprint:
            raise SourceChangedError(
                f"The dataset {self.dataset.id!r} no longer has the content that this augmented dataset was made from "
                f"(expected SHA-256 {self.expected_fingerprint[:12]}...). Restore that version, or augment the new one."
            )

    @cached_property
    def fingerprint(self) -> str:
        """SHA-256 of the episodes' content, the same whatever the storage format."""
        return content_hash(self.episodes)

    @cached_property
    def metadata_fingerprint(self) -> str:
        """SHA-256 of what the storage keeps for each episode beside its data, without numbers and provenance."""
        rows = [
            {
                key: metadata_to_json(value)
                for key, value in (part.known_items() if isinstance(part, LazyMetadata) else part.items())
                if key not in ("id", *METADATA_KEYS)
            }
            for part in self.metadata
        ]
        return hashlib.sha256(json.dumps(rows, sort_keys=True).encode()).hexdigest()

    @cached_property
    def flat_observations(self) -> FlatSpace:
        """The flattening of the observation space."""
        return FlatSpace.of(self.observation_space, "observation space")

    @cached_property
    def flat_actions(self) -> FlatSpace:
        """The flattening of the action space."""
        return FlatSpace.of(self.action_space, "action space")

    def state_matrices(self) -> list[npt.NDArray[np.float64]]:
        """Return the (T_i + 1, width) feature matrix of each episode's observations.

        Raises:
            InvalidDataError: if an observation is NaN or infinite.
        """
        return [
            _finite(self.flat_observations.flatten(episode.observations), "observation", number)
            for number, episode in enumerate(self.episodes)
        ]

    def action_matrices(self) -> list[npt.NDArray[np.float64]]:
        """Return the (T_i, width) feature matrix of each episode's actions; NaN or infinite ones are an error."""
        return [
            _finite(self.flat_actions.flatten(episode.actions), "action", number)
            for number, episode in enumerate(self.episodes)
        ]

    def rewards(self) -> list[npt.NDArray[np.float64]]:
        """Return the (T_i,) rewards of each episode; NaN or infinite ones are an error."""
        return [
            _finite(np.asarray(episode.rewards, dtype=np.float64), "reward", number)
            for number, episode in enumerate(self.episodes)
        ]


class DerivedSource(Source):
    """Episodes in memory that were made from those of another source, one from each, in its spaces and order.

    Metadata and dataset are those of the other source. `make` is called once, when the episodes are first asked for;
    `lengths` are known before.
    """

    def __init__(self, origin: Source, lengths: IntArray, make: Callable[[], Iterable[EpisodeData]]) -> None:
        super().__init__(origin.dataset)
        self._origin = origin
        self._lengths = lengths
        self._make = make

    @cached_property
    def ids(self) -> IntArray:
        """The storage ids of the episodes that these were made from, (N,)."""
        return self._origin.ids

    @cached_property
    def metadata(self) -> tuple[dict[str, Any], ...]:
        """What the storage keeps for the episodes that these were made from."""
        return self._origin.metadata

    @cached_property
    def lengths(self) -> IntArray:
        """The number of steps of each episode, (N,)."""
        return self._lengths

    @cached_property
    def episodes(self) -> tuple[EpisodeData, ...]:
        """All episodes, checked against the T+1 rule and the lengths that were announced."""
        episodes = tuple(self._make())
        for number, episode in enumerate(episodes):
            check_episode(episode, self.observation_space, self.action_space)
            self.check_length(number, len(episode.rewards))
        return episodes

    def check_length(self, number: int, length: int) -> None:
        """Raise `InvalidDataError` unless `length`, what was made, is what was announced for episode `number`."""
        if length != self.lengths[number]:
            raise InvalidDataError(
                f"Episode {number} was made with {length} steps where its augmenter announced {self.lengths[number]}."
            )


def _rename_clashes(metadata: dict[str, Any]) -> dict[str, Any]:
    return {f"original_{key}" if key in METADATA_KEYS else key: value for key, value in metadata.items()}


def _finite(values: npt.NDArray[np.float64], what: str, number: int) -> npt.NDArray[np.float64]:
    bad = ~np.isfinite(values)
    if bad.any():
        where = np.argwhere(bad)[0]
        raise InvalidDataError(
            f"The {what} at step {where[0]} of episode {number} is {values[tuple(where)]}"
            + (f" (feature {where[1]})" if values.ndim > 1 else "")
            + ": finite numbers are needed. Drop or repair the episode first (filter_episodes)."
        )
    return values
