"""AugmentedStorage: real, synthetic and appended episodes as one Minari storage of data format "oat".

Episode ids are dense: 0..N-1 are the source's, N..N+count-1 the synthetic ones, those after them were appended by the
user (`update_dataset_from_buffer`) and live in a Minari storage of our own beside `metadata.json`; the source is never
written to. The directory is a temporary one until the dataset is saved as a recipe.
"""

from __future__ import annotations

import copy
import dataclasses
import itertools
import json
import logging
import pathlib
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from minari import EpisodeData
from minari.data_collector import EpisodeBuffer
from minari.dataset._storages import _registry  # pyright: ignore[reportPrivateUsage]
from minari.dataset.minari_storage import METADATA_FILE_NAME, MinariStorage

from oat_gym._live import LIVE, attach
from oat_gym._staging import owned_folder
from oat_gym.augmenters.base import Variation, inherited_next_states
from oat_gym.cache import write_atomically
from oat_gym.episodes import check_episode, copy_episode
from oat_gym.errors import InvalidDataError, SaveError, SourceChangedError
from oat_gym.export import buffer_bytes, check_length, ensure_space, is_disk_error
from oat_gym.lazy_metadata import LazyMetadata
from oat_gym.provenance import METADATA_KEYS, Provenance, merge_spans
from oat_gym.recipe import (
    APPENDED,
    DATA_FORMAT,
    EPISODE_METADATA_FILE,
    LIVE_RECIPE,
    RECIPE_FILE,
    check_if_augmented,
    open_recipe,
    write_metadata,
)
from oat_gym.serialization import metadata_to_json
from oat_gym.source import Source
from oat_gym.spaces import Batch
from oat_gym.synthesis import Synthesis

_log = logging.getLogger(__name__)


class AugmentedStorage(MinariStorage):
    """A Minari storage whose synthetic episodes are stitched from memory when they are read.

    As a class its `FORMAT` is the registered "oat"; an instance tells the format of its source, in which Minari
    writes what it derives from it (`combine_datasets`).
    """

    FORMAT = DATA_FORMAT

    def __init__(
        self,
        data_path: pathlib.Path,
        observation_space: gym.Space[Any],
        action_space: gym.Space[Any],
        jpeg_encoding: bool = True,
    ) -> None:
        super().__init__(pathlib.Path(data_path), observation_space, action_space, jpeg_encoding)
        live = LIVE.get(str(data_path))
        self.synthesis = live or open_recipe(self.data_path)
        if self.synthesis is not None:
            source_format = self.synthesis.source.dataset.storage.FORMAT
            self.FORMAT = source_format  # pyright: ignore[reportConstantRedefinition]  (a class attribute in Minari)
        self._appended: MinariStorage | None = None
        if live is None and self.synthesis is not None:
            self._check_totals(self.synthesis)

    @classmethod
    def of(cls, synthesis: Synthesis) -> AugmentedStorage:
        """Return the storage of a new augmented dataset, in a temporary directory that goes with it."""
        path = owned_folder("oat_gym-", pathlib.Path(tempfile.gettempdir()))
        write_metadata(path, synthesis)
        write_atomically(path / RECIPE_FILE, json.dumps(LIVE_RECIPE).encode())
        attach(path, synthesis, owned=True)
        source = synthesis.source
        return cls(path, source.observation_space, source.action_space, source.dataset.storage.jpeg_encoding)

    @classmethod
    def _create(
        cls,
        data_path: pathlib.Path,
        observation_space: gym.Space[Any],
        action_space: gym.Space[Any],
        jpeg_encoding: bool = True,
    ) -> MinariStorage:
        return cls(data_path, observation_space, action_space, jpeg_encoding)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle as the directory where that describes the dataset, else as the plan; never as open data."""
        if self.synthesis is None or str(self.data_path) not in LIVE:
            return _read, (str(self.data_path),)
        plan = self.synthesis
        overlay: _Overlay = self._appended_buffers(), self.edited_metadata()
        return _reopen, (str(self.data_path), overlay, plan.source.view, plan.augmenter, plan.count, plan.seed)

    def _appended_buffers(self) -> list[EpisodeBuffer]:
        if not (self.data_path / APPENDED).exists():
            return []
        storage = self._appended_storage()
        numbers = range(storage.total_episodes)
        parts = zip(storage.get_episodes(numbers), storage.get_episode_metadata(numbers), strict=True)
        return [
            dataclasses.replace(
                EpisodeBuffer(seed=metadata.get("seed"), options=metadata.get("options")), **{**data, "id": None}
            )
            for data, metadata in parts
        ]

    @property
    def total_episodes(self) -> int:
        """Number of real, synthetic and appended episodes."""
        if self.synthesis is None:
            return super().total_episodes
        has_appended = (self.data_path / APPENDED).exists()
        return self.n_planned + (self._appended_storage().total_episodes if has_appended else 0)

    @property
    def n_real(self) -> int:
        """Number of episodes of the source."""
        return self.synthesis.n_real if self.synthesis else 0

    @property
    def n_planned(self) -> int:
        """Number of real and synthetic episodes, without appended ones."""
        return self.n_real + self.synthesis.count if self.synthesis else 0

    def lengths(self, episode_indices: Iterable[int]) -> npt.NDArray[np.int64]:
        """Return the steps of each episode; generates nothing."""
        ids = np.asarray(list(episode_indices), dtype=np.int64)
        out = np.zeros(len(ids), dtype=np.int64)
        planned = ids < self.n_planned
        if self.synthesis is not None:
            out[planned] = self.synthesis.lengths[ids[planned]]
        if not planned.all():
            metadata = self._appended_storage().get_episode_metadata(ids[~planned] - self.n_planned)
            out[~planned] = [part["total_steps"] for part in metadata]
        return out

    def get_episodes(self, episode_indices: Iterable[int]) -> Iterator[dict[str, Any]]:
        """Yield the data of the episodes, in the order asked for; synthetic ones are made now."""
        for kind, numbers in self._runs(episode_indices):
            if kind == "synthetic":
                synthesis = self._plan()
                for number in numbers:
                    variation = synthesis.variation(int(number) - self.n_real)
                    yield {**vars(variation.episode), "id": number}
            elif kind == "real":
                yield from self._real_episodes(numbers)
            else:
                yield from self._appended_episodes(numbers)

    def _runs(self, episode_indices: Iterable[int]) -> Iterator[tuple[str, list[int]]]:
        """Yield runs of ids of one kind; one id at a time where the ids are an iterator, which may have no end."""
        if isinstance(episode_indices, Iterator):
            for number in episode_indices:
                yield self._kind(number, self.total_episodes), [number]
            return
        total = self.total_episodes
        for kind, run in itertools.groupby(episode_indices, key=lambda number: self._kind(number, total)):
            yield kind, list(run)

    def variation(self, number: int) -> Variation | None:
        """Return how the synthetic episode with id `number` was made; None for a real or an appended one."""
        return self._plan().variation(number - self.n_real) if self.n_real <= number < self.n_planned else None

    def provenance(self, number: int, variation: Variation | None = None) -> Provenance:
        """Return where episode `number` comes from; fits first where it is synthetic and `variation` is not given."""
        if number >= self.n_planned:
            metadata = next(iter(self._appended_storage().get_episode_metadata([number - self.n_planned])))
            return Provenance.from_metadata(metadata, number)
        synthesis = self._plan()
        if number < self.n_real:
            return self._source_provenance(number)
        j = number - self.n_real
        i, k = j % self.n_real, j // self.n_real
        length, new = int(synthesis.lengths[number]), (variation or synthesis.variation(j)).spans
        return Provenance(True, i, k, merge_spans(self._source_provenance(i).spans, new, length=length), length)

    def next_states(self, number: int, variation: Variation | None = None) -> dict[int, Batch]:
        """Return the next states of an episode that are not `observations[t+1]`: batches of one row, keyed by step.

        They come from literal seams, of this augmenter or of that of the source. Fits first, as `provenance` does.
        """
        if number < self.n_real:
            source = self._plan().source
            inner = source.dataset.storage
            return inner.next_states(int(source.ids[number])) if isinstance(inner, AugmentedStorage) else {}
        if (made := variation or self.variation(number)) is None:
            return {}
        i = (number - self.n_real) % self.n_real
        return inherited_next_states(self.next_states(i), int(self._plan().lengths[i]), made)

    def get_episode_metadata(self, episode_indices: Iterable[int]) -> Iterator[dict[str, Any]]:
        """Yield the source's metadata of each episode with its provenance (see `Provenance.to_metadata`)."""
        edits, total = self.edited_metadata(), self.total_episodes
        for number in map(int, episode_indices):
            if self._kind(number, total) == "appended":
                local = number - self.n_planned
                metadata = dict(next(iter(self._appended_storage().get_episode_metadata([local]))))
            else:
                source = number if number < self.n_real else (number - self.n_real) % self.n_real
                metadata = self._planned_metadata(number, source)
            metadata.update({"id": number, **edits.get(str(number), {})})
            yield metadata

    def _planned_metadata(self, number: int, source: int) -> dict[str, Any]:
        """Return the source's metadata and ours, which of a synthetic episode is made when it is asked for."""
        inherited = self._plan().source.metadata[source]
        known = inherited.known_items() if isinstance(inherited, LazyMetadata) else inherited.items()
        metadata = copy.deepcopy({key: value for key, value in known if key not in METADATA_KEYS})
        metadata["total_steps"] = int(self._plan().lengths[number])
        return LazyMetadata(metadata, lambda: self.provenance(number).to_metadata())

    def update_episode_metadata(
        self, metadatas: Iterable[dict[str, Any]], episode_indices: Iterable[int] | None = None
    ) -> None:
        """Add metadata to episodes; that of real and synthetic ones is kept beside them, not in the source."""
        indices = list(range(self.total_episodes) if episode_indices is None else episode_indices)
        updates = list(metadatas)
        if len(indices) != len(updates):
            raise ValueError("Metadatas and episode_indices have different lengths")
        edits = self.edited_metadata()
        total = self.total_episodes
        for number, update in zip(map(int, indices), updates, strict=True):
            self._kind(number, total)
            reserved = sorted({"id", "total_steps", *METADATA_KEYS} & update.keys())
            if reserved:
                raise InvalidDataError(f"The metadata {', '.join(reserved)} of an episode cannot be changed.")
            edits[str(number)] = edits.get(str(number), {}) | metadata_to_json(update)
        write_atomically(self.data_path / EPISODE_METADATA_FILE, json.dumps(edits).encode())
        self.update_metadata({"dataset_size": self.get_size()})

    def update_episodes(self, episodes: Iterable[EpisodeBuffer]) -> None:
        """Append episodes (or steps to an appended one) to the side store.

        Raises:
            InvalidDataError: for a buffer whose id is that of a real or a synthetic episode, or leaves a gap.
        """
        storage = self._appended_storage()
        for buffer in episodes:
            local = None if buffer.id is None else buffer.id - self.n_planned
            if local is not None and not 0 <= local <= storage.total_episodes:
                raise InvalidDataError(
                    f"Episode id {buffer.id} cannot be written: ids 0 to {self.n_planned - 1} are the source's and the "
                    f"synthetic ones, and the next free id is {self.n_planned + storage.total_episodes}."
                )
            self._append(storage, dataclasses.replace(buffer, id=local))
        planned = int(self.synthesis.lengths.sum()) if self.synthesis else 0
        totals = {
            "total_episodes": self.n_planned + storage.total_episodes,
            "total_steps": planned + storage.total_steps,
        }
        self.update_metadata({**totals, "dataset_size": self.get_size()})

    def _append(self, storage: MinariStorage, buffer: EpisodeBuffer) -> None:
        check_length(0 if buffer.id is None else buffer.id, len(buffer.rewards), storage.FORMAT)
        try:
            ensure_space(self.data_path, buffer_bytes(buffer))  # HDF5 takes the interpreter down on a full disk
            storage.update_episodes([buffer])
        except (OSError, RuntimeError, ValueError) as error:
            if not is_disk_error(error):
                raise
            raise SaveError(f"An episode could not be added at {self.data_path} ({error}): free some space.") from error

    def update_metadata(self, metadata: dict[str, Any]) -> None:
        """Add or change metadata of the dataset, as Minari does, but atomically: a crash leaves the old file whole."""
        path = self.data_path / METADATA_FILE_NAME
        with tempfile.TemporaryDirectory(prefix="oat_gym_metadata") as folder:
            draft = AugmentedStorage.__new__(AugmentedStorage)  # Minari's method needs a path and no more
            draft._data_path = pathlib.Path(folder)
            shutil.copyfile(path, draft.data_path / METADATA_FILE_NAME)
            MinariStorage.update_metadata(draft, metadata)
            write_atomically(path, (draft.data_path / METADATA_FILE_NAME).read_bytes())

    def edited_metadata(self) -> dict[str, dict[str, Any]]:
        """Return the metadata added by `update_episode_metadata`, by the number of the episode as a string."""
        path = self.data_path / EPISODE_METADATA_FILE
        return json.loads(path.read_text()) if path.exists() else {}

    def get_size(self) -> float:
        """Return the size in MB of the source and of the episodes that were appended."""
        if self.synthesis is None:
            return float(super().get_size())
        has_appended = (self.data_path / APPENDED).exists()
        appended = self._appended_storage().get_size() if has_appended else 0.0
        return float(np.round(self.synthesis.source.dataset.storage.get_size() + appended, 1))

    def _kind(self, number: int, total: int) -> str:
        if not 0 <= number < total:
            raise IndexError(f"There is no episode {number}: the dataset has {total} episodes, numbered from 0.")
        if number < self.n_real:
            return "real"
        return "synthetic" if number < self.n_planned else "appended"

    def _check_totals(self, synthesis: Synthesis) -> None:
        appended = self._appended_storage() if (self.data_path / APPENDED).exists() else None
        episodes = self.n_planned + (appended.total_episodes if appended else 0)
        metadata = MinariStorage.read_raw_metadata(self.data_path)
        claimed = (metadata["total_episodes"], metadata["total_steps"])
        if self.n_planned <= claimed[0] <= episodes:
            steps = int(synthesis.lengths.sum()) + (appended.total_steps if appended else 0)
            if claimed == (episodes, steps):
                return
            if appended is not None and claimed[1] < steps:
                _log.warning("%s: an append was cut off; its episodes are counted now.", self.data_path)
                self.update_metadata({"total_episodes": episodes, "total_steps": steps})
                return
        raise SourceChangedError(
            f"The metadata at {self.data_path} says {claimed[0]} episodes and {claimed[1]} steps, which is not what "
            f"its recipe and the source {synthesis.source.dataset.id!r} give. One of them was changed: save it again."
        )

    def _plan(self) -> Synthesis:
        if self.synthesis is None:
            raise InvalidDataError(f"The dataset at {self.data_path} has no source: all its episodes were appended.")
        return self.synthesis

    def _real_episodes(self, numbers: list[int]) -> Iterator[dict[str, Any]]:
        source = self._plan().source
        if source.is_loaded or source.expected_fingerprint:
            yield from (vars(copy_episode(source.episodes[int(number)], number=number)) for number in numbers)
            return
        stored = source.dataset.storage.get_episodes(list(source.ids[numbers]))
        for number, data in zip(numbers, stored, strict=True):
            source.check_length(int(number), len(data["rewards"]))
            check_episode(EpisodeData(**data), self.observation_space, self.action_space)
            yield {**data, "id": number}

    def _appended_episodes(self, numbers: list[int]) -> Iterator[dict[str, Any]]:
        stored = self._appended_storage().get_episodes([number - self.n_planned for number in numbers])
        for number, data in zip(numbers, stored, strict=True):
            check_episode(EpisodeData(**data), self.observation_space, self.action_space)
            yield {**data, "id": number}

    def _appended_storage(self) -> MinariStorage:
        """Return the side store, which another dataset on this directory (a split, a copy) may have begun."""
        path = self.data_path / APPENDED
        if self._appended is None and (path / METADATA_FILE_NAME).exists():
            self._appended = MinariStorage.read(path)
        elif self._appended is None:
            formats = {DATA_FORMAT: "hdf5"}
            self._appended = MinariStorage.new(
                path,
                observation_space=self.observation_space,
                action_space=self.action_space,
                data_format=formats.get(self.FORMAT, self.FORMAT),
                jpeg_encoding=self.jpeg_encoding,
            )
        return self._appended

    def _source_provenance(self, number: int) -> Provenance:
        source = self._plan().source
        inherited = Provenance.from_metadata(source.metadata[number], number)
        position = np.flatnonzero(source.ids == inherited.source) if inherited.synthetic else [number]
        return dataclasses.replace(inherited, source=int(position[0]) if len(position) else -1)


def register() -> None:
    """Make "oat" one of Minari's data formats, for every function of Minari that opens a dataset."""
    _registry[DATA_FORMAT] = lambda: AugmentedStorage


_Overlay = tuple[list[EpisodeBuffer], dict[str, dict[str, Any]]]
"""What was added to a live dataset: appended episodes, and edits of metadata."""


def _read(path: str) -> MinariStorage:
    check_if_augmented(pathlib.Path(path))
    return MinariStorage.read(path)


def _reopen(path: str, overlay: _Overlay, *plan: Any) -> MinariStorage:
    if path in LIVE:
        return MinariStorage.read(path)
    dataset, augmenter, count, seed = plan
    synthesis = Synthesis(Source(dataset), augmenter, count=count, seed=seed)
    if not pathlib.Path(path).exists():
        storage = AugmentedStorage.of(synthesis)
        appended, edits = overlay
        if appended:
            storage.update_episodes(appended)
        if edits:
            storage.update_episode_metadata(edits.values(), map(int, edits))
        return storage
    attach(pathlib.Path(path), synthesis, owned=False)
    return MinariStorage.read(path)
