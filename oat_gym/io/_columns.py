"""A whole dataset as columns of tensors, one row a step: what the torch loaders take their batches from."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from os import PathLike
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from gymnasium import spaces
from minari import EpisodeData, MinariDataset

from oat_gym.episodes import BoolArray, IntArray, check_episode, hash_episode
from oat_gym.errors import ConfigurationError, InvalidDataError, UnsupportedSpaceError
from oat_gym.io.d4rl import is_d4rl_path, read_d4rl
from oat_gym.provenance import Provenance
from oat_gym.recipe import find_dataset
from oat_gym.spaces import Batch, FlatSpace, get_leaf, iter_leaf_spaces, map_tree
from oat_gym.storage import AugmentedStorage

LEAF_SPACES = (spaces.Box, spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary)
STEP_COLUMNS = ("rewards", "terminated", "truncated", "episode", "step", "synthetic", "state_row", "next_row")
PADDING = {"episode": -1, "step": -1}
"""What the padding row holds where it does not hold zeros."""

Named = dict[str, npt.NDArray[Any]]

DataSource = MinariDataset | str | PathLike[str]
"""A Minari dataset, the id of an installed or embedded one, or the path of a D4RL HDF5 file."""


@dataclass(frozen=True)
class Part:
    """One episode as it is read: its data, its mask of generated steps, and next states other than `observations[t+1]`.

    `number` is its position in the dataset; `next_states` has batches of one row keyed by step (literal seams).
    """

    number: int
    episode: EpisodeData
    synthetic: BoolArray
    next_states: dict[int, Batch]


@dataclass(frozen=True)
class Columns:
    """All steps of a dataset, n in N episodes.

    `observations` has the T+1 observations of each episode one after another, then the next states that are no
    observation of any episode (literal seams of OAT), and last a row of zeros. The others have n+1 rows, of which the
    last is padding: zeros, false, -1 in `episode` and `step`. `state_row` and `next_row` are rows of `observations`
    that hold s and s' of a step. `lengths` (N,) are the steps of each episode.
    """

    observations: Batch
    actions: Batch
    steps: dict[str, torch.Tensor]
    lengths: IntArray

    @property
    def n_steps(self) -> int:
        """Number of steps n; also the number of the padding row."""
        return int(self.lengths.sum())

    @cached_property
    def synthetic(self) -> BoolArray:
        """Which of the n steps were generated."""
        return self.steps["synthetic"][:-1].cpu().numpy()

    def to(self, device: torch.device) -> Columns:
        """Return the columns on a device."""
        return Columns(
            map_tree(lambda leaf: leaf.to(device), self.observations),
            map_tree(lambda leaf: leaf.to(device), self.actions),
            {name: column.to(device) for name, column in self.steps.items()},
            self.lengths,
        )

    @cached_property
    def digest(self) -> str:
        """SHA-256 of every column."""
        digest = hashlib.sha256()

        def feed(leaf: torch.Tensor) -> None:
            array = np.ascontiguousarray(leaf.cpu().numpy())
            digest.update(f"{array.dtype.str}{array.shape}".encode())
            digest.update(array.data)

        for tree in (self.observations, self.actions, self.steps):
            map_tree(feed, tree)
        return digest.hexdigest()


@dataclass(frozen=True)
class Layout:
    """How the observations and actions of a dataset become columns.

    `flat` turns both into one float matrix (`oat_gym.spaces.FlatSpace`), else there is one column for each leaf of the
    space; `dtype` is what floating-point values are cast to (None: they keep their own).
    """

    observation_space: spaces.Space[Any]
    action_space: spaces.Space[Any]
    flat: bool
    dtype: np.dtype[np.floating[Any]] | None

    def check(self) -> None:
        """Raise `UnsupportedSpaceError` for a space that no tensor holds, such as Text."""
        for role, space in (("observation", self.observation_space), ("action", self.action_space)):
            if self.flat:
                FlatSpace.of(space, f"{role} space")
                continue
            for _, leaf in iter_leaf_spaces(space):
                if not isinstance(leaf, LEAF_SPACES):
                    raise UnsupportedSpaceError(
                        f"The {role} space holds {leaf}, which no tensor holds. Box, Discrete, MultiDiscrete, "
                        "MultiBinary, and Dict and Tuple of them can be loaded: map the episodes first."
                    )

    def columns_of(self, role: str, batch: Batch) -> Named:
        """Return the named columns of a batch of the space of `role` ("observations" or "actions")."""
        space = self.observation_space if role == "observations" else self.action_space
        if self.flat:
            return {role: self._cast(FlatSpace.of(space).flatten(batch))}
        return {column_name(role, path): self._cast(get_leaf(batch, path)) for path, _ in iter_leaf_spaces(space)}

    def tree_of(self, role: str, columns: dict[str, torch.Tensor]) -> Batch:
        """Return the batch of tensors that `columns_of` named."""
        space = self.observation_space if role == "observations" else self.action_space
        return columns[role] if self.flat else _tree_of(space, role, (), columns)

    def episode_columns(self, part: Part, first_row: int) -> Named:
        """Return every column of one episode whose first observation is row `first_row` of all."""
        episode = part.episode
        length = len(episode.rewards)
        rows = first_row + np.arange(length, dtype=np.int64)
        return {
            **self.columns_of("observations", episode.observations),
            **self.columns_of("actions", episode.actions),
            "rewards": self._cast(episode.rewards),
            "terminated": np.asarray(episode.terminations, dtype=bool),
            "truncated": np.asarray(episode.truncations, dtype=bool),
            "episode": np.full(length, part.number, dtype=np.int64),
            "step": np.arange(length, dtype=np.int64),
            "synthetic": np.asarray(part.synthetic, dtype=bool),
            "state_row": rows,
            "next_row": rows + 1,
        }

    def _cast(self, values: Any) -> npt.NDArray[Any]:
        array = np.asarray(values)
        if np.issubdtype(array.dtype, np.floating):
            return array.astype(self.dtype or array.dtype, copy=False)
        if np.issubdtype(array.dtype, np.unsignedinteger) and array.dtype.itemsize > 1:
            return _signed(array)  # torch has few operations for unsigned integers wider than a byte
        return array


def open_source(data: DataSource) -> MinariDataset:
    """Return the dataset that a consumer is to read.

    Raises:
        DatasetNotFoundError: if it is not on this machine; nothing is downloaded.
        ConfigurationError: if it is no dataset, id of one, or path of a D4RL HDF5 file.
    """
    if isinstance(data, str | PathLike):
        data = read_d4rl(data) if is_d4rl_path(data) else find_dataset(str(data))
    if not isinstance(data, MinariDataset):
        raise ConfigurationError(
            f"A Minari dataset, the id of one, or the path of a D4RL HDF5 file is needed, got a {type(data).__name__}."
        )
    return data


def column_name(role: str, path: tuple[str | int, ...]) -> str:
    """Return the name of the column of one leaf of a space."""
    return "/".join((role, *map(str, path)))


def read_parts(data: MinariDataset) -> Iterator[Part]:
    """Yield the episodes of a dataset or a view, checked, with their provenance; one is in memory at a time.

    Raises:
        InvalidDataError: if there is no episode, or one breaks the T+1 rule or is not as long as its metadata says.
    """
    ids = [int(number) for number in data.episode_indices]
    if not ids:
        raise InvalidDataError(f"The dataset {data.id!r} (or this view of it) has no episodes: nothing to load.")
    for number, part in enumerate(_stored_parts(data, ids)):
        episode, mask = part.episode, part.synthetic
        check_episode(episode, data.observation_space, data.action_space)
        if len(mask) != len(episode.rewards):
            raise InvalidDataError(
                f"Episode {number} of {data.id!r} gives {len(episode.rewards)} steps where its metadata says "
                f"{len(mask)}: the dataset is damaged (Arrow and Parquet cut episodes over 32,767 rows)."
            )
        yield part


def hash_parts(parts: Iterator[Part]) -> str:
    """Return the SHA-256 of everything that the columns are made from."""
    digest = hashlib.sha256()
    for part in parts:
        hash_episode(digest, part.episode)
        digest.update(np.packbits(part.synthetic).tobytes())
        for step in sorted(part.next_states):
            digest.update(f"next state {step}".encode())
            map_tree(lambda leaf: digest.update(np.ascontiguousarray(leaf).data), part.next_states[step])
    return digest.hexdigest()


def write_columns(parts: Iterator[Part], layout: Layout, append: Callable[[str, npt.NDArray[Any]], None]) -> IntArray:
    """Give every column to `append(name, rows)`, episode by episode, the padding row last; return the lengths (N,)."""
    lengths: list[int] = []
    seams: list[tuple[int, Named]] = []  # steps, and the next states that belong there
    columns: Named = {}
    next_rows: list[npt.NDArray[Any]] = []
    n_steps = 0
    for part in parts:
        columns = layout.episode_columns(part, n_steps + len(lengths))
        seams += [(n_steps + t, layout.columns_of("observations", row)) for t, row in part.next_states.items()]
        next_rows.append(columns.pop("next_row"))
        for name, values in columns.items():
            append(name, values)
        lengths.append(len(part.episode.rewards))
        n_steps += lengths[-1]
    next_row = np.concatenate(next_rows)
    for number, (step, row) in enumerate(seams):
        next_row[step] = n_steps + len(lengths) + number
        for name, values in row.items():
            append(name, values)
    padding = n_steps + len(lengths) + len(seams)
    append("next_row", np.append(next_row, padding))
    for name, values in columns.items():
        fill = padding if name == "state_row" else PADDING.get(name, 0)
        append(name, np.full_like(values[:1], fill))
    return np.asarray(lengths, dtype=np.int64)


def assemble(columns: dict[str, torch.Tensor], layout: Layout, lengths: IntArray) -> Columns:
    """Return named columns as `Columns`."""
    return Columns(
        layout.tree_of("observations", columns),
        layout.tree_of("actions", columns),
        {name: columns[name] for name in STEP_COLUMNS},
        lengths,
    )


def columns_in_memory(data: MinariDataset, layout: Layout) -> Columns:
    """Read a dataset into columns of its own."""
    pieces: dict[str, list[npt.NDArray[Any]]] = {}
    lengths = write_columns(read_parts(data), layout, lambda name, rows: pieces.setdefault(name, []).append(rows))
    named: dict[str, torch.Tensor] = {}
    for name in list(pieces):
        named[name] = torch.from_numpy(np.concatenate(pieces.pop(name)))
    return assemble(named, layout, lengths)


def _stored_parts(data: MinariDataset, ids: list[int]) -> Iterator[Part]:
    storage = data.storage
    if isinstance(storage, AugmentedStorage):
        for number, identity in enumerate(ids):
            variation = storage.variation(identity)
            mask = storage.provenance(identity, variation).mask
            episode = next(iter(data.iterate_episodes([identity]))) if variation is None else variation.episode
            yield Part(number, episode, mask, storage.next_states(identity, variation))
        return
    metadata = storage.get_episode_metadata(ids)
    for number, (episode, known) in enumerate(zip(data.iterate_episodes(ids), metadata, strict=True)):
        yield Part(number, episode, Provenance.from_metadata(known, number).mask, {})


def _tree_of(
    space: spaces.Space[Any], role: str, path: tuple[str | int, ...], columns: dict[str, torch.Tensor]
) -> Batch:
    if isinstance(space, spaces.Dict):
        return {key: _tree_of(child, role, (*path, key), columns) for key, child in space.spaces.items()}
    if isinstance(space, spaces.Tuple):
        return tuple(_tree_of(child, role, (*path, i), columns) for i, child in enumerate(space.spaces))
    return columns[column_name(role, path)]


def _signed(array: npt.NDArray[Any]) -> npt.NDArray[np.int64]:
    largest = np.iinfo(np.int64).max
    if array.size and int(array.max()) > largest:
        raise InvalidDataError(f"The value {array.max()} does not fit torch's int64 (at most {largest}).")
    return array.astype(np.int64)
