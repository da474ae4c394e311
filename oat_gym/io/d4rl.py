"""D4RL's HDF5 layout into Minari datasets and back: `read_d4rl` and `write_d4rl`.

The layout has one row a step: `observations`, `actions`, `rewards`, `terminals`, mostly `timeouts`, sometimes
`next_observations`; `infos/*` with one row a step; `metadata/*` of any shape. Dtypes are kept; rewards and flags may be
(N, 1), flags may be floats. Infos have T rows, row t for step t.

**Where episodes end.** At terminals and timeouts. Data without `timeouts` is cut at terminals, after
`max_episode_steps` rows, and where `next_observations` is not the next row's observation, as in what D4RL's
`qlearning_dataset` returns (these are truncations). The last row always ends an episode: a trailing unfinished one is
kept, truncated. A file of `write_d4rl` is cut where it was written, unless `cut_at` or `max_episode_steps` is given:
then its rows are read like any other file's, without the infos of resets and the metadata of episodes.

**The last observation** of an episode is its last `next_observations`, taken as given (`qlearning_dataset` puts the
next episode's first observation there at a terminal; no estimator looks at it, models of states do). Without that key,
an episode that ends in a terminal repeats its last observation (nothing is estimated beyond a terminal). Any other
loses its last step, whose outcome is unknown: the step before is then the truncated one, and an episode of one row is
left out. The dataset's metadata counts both under "d4rl" (`repeated_observations`, `dropped_steps`) and keeps
`metadata/*` there.

>>> observations = np.array([[0.0], [1.0], [5.0], [6.0], [7.0]])
>>> rows = {"observations": observations, "actions": np.zeros((5, 1)), "rewards": np.arange(5.0)}
>>> data = read_d4rl({**rows, "terminals": np.array([0, 1, 0, 0, 0]), "timeouts": np.array([0, 0, 0, 0, 1])})
>>> [episode.observations.ravel().tolist() for episode in data]
[[0.0, 1.0, 1.0], [5.0, 6.0, 7.0]]
"""

from __future__ import annotations

import dataclasses
import hashlib
import logging
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

import minari
import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from minari import MinariDataset
from minari.serialization import serialize_space

from oat_gym.cache import fingerprint
from oat_gym.errors import ConfigurationError, DatasetExistsError
from oat_gym.export import check_dataset_id, new_dataset_folder, write_dataset
from oat_gym.io import _d4rl_note as notes
from oat_gym.io._cached_dataset import cached_dataset
from oat_gym.io._d4rl_columns import columns_of, kept_metadata
from oat_gym.io._d4rl_cut import CutAt, cut, doubly_flagged, found_stops, noted_stops
from oat_gym.io._d4rl_file import Flat, flatten_mapping, read_flat, write_flat
from oat_gym.io._d4rl_rows import array_space, rows_of, spaces_of
from oat_gym.io.writing import DatasetCard
from oat_gym.serialization import metadata_to_json, source_metadata

logger = logging.getLogger(__name__)

VERSION = 1  # raise it when the conversion changes: conversions in the cache are then made again
SUFFIXES = (".hdf5", ".h5")


@dataclass(frozen=True)
class _Reading:
    """The arguments of `read_d4rl`, checked."""

    dataset_id: str
    max_episode_steps: int | None
    cut_at: CutAt | None
    env_spec: EnvSpec | None
    observation_space: spaces.Space[Any] | None
    action_space: spaces.Space[Any] | None
    file: str | None

    def __post_init__(self) -> None:
        limit = self.max_episode_steps
        if limit is not None and (not isinstance(limit, int) or limit < 1):
            raise ConfigurationError(f"max_episode_steps must be a whole number of at least 1, got {limit!r}.")
        if self.cut_at is not None and self.cut_at not in get_args(CutAt):
            raise ConfigurationError(f"cut_at must be one of {', '.join(get_args(CutAt))}, got {self.cut_at!r}.")
        for role, space in (("observation", self.observation_space), ("action", self.action_space)):
            if space is not None:
                array_space(role, space)
        DatasetCard(dataset_id=self.dataset_id, description="")  # checks the id

    def options(self) -> dict[str, Any]:
        """Return them as JSON data, for a fingerprint."""
        return {
            "dataset_id": self.dataset_id,
            "max_episode_steps": self.max_episode_steps,
            "cut_at": self.cut_at,
            "env_spec": None if self.env_spec is None else self.env_spec.to_json(),
            "spaces": [None if s is None else serialize_space(s) for s in (self.observation_space, self.action_space)],
            "file": self.file,
        }


def read_d4rl(
    source: str | os.PathLike[str] | Mapping[str, Any],
    *,
    max_episode_steps: int | None = None,
    cut_at: CutAt | None = None,
    dataset_id: str | None = None,
    env_spec: EnvSpec | None = None,
    observation_space: spaces.Space[Any] | None = None,
    action_space: spaces.Space[Any] | None = None,
) -> MinariDataset:
    """Return the episodes of a D4RL HDF5 file, or of a dictionary of its arrays, as a Minari dataset.

    The dictionary may be what `h5py` or D4RL's `get_dataset` and `qlearning_dataset` give: `observations`, `actions`,
    `rewards`, `terminals`, and optionally `timeouts`, `next_observations`, `infos/*` and `metadata/*` (nested or with
    slashes in the keys).

    The module's page says where episodes end and which last observation they get. A dictionary may be what D4RL's
    `get_dataset` and `qlearning_dataset` give: `observations`, `actions`, `rewards`, `terminals`, optionally
    `timeouts`, `next_observations`, `infos/*` and `metadata/*` (nested or with slashes in the keys).

    Args:
        source: path of the file, or the dictionary.
        max_episode_steps: the time limit, in rows; with `timeouts` in the data, an upper bound that is checked.
        cut_at: "terminals_or_timeouts" (default), or "timeouts": terminals inside an episode stay there (antmaze).
        dataset_id: store it among Minari's datasets under this free id. Default: in the cache (`OAT_GYM_CACHE`), under
            a hash of content and settings; converted once, checked at each opening, and not a place to append to.
        env_spec: the environment, for `recover_environment`.
        observation_space: default: as noted by `write_d4rl`, else an unbounded Box of the data's dtype.
        action_space: likewise. Whole-number data needs to be told its space.

    Raises:
        DatasetNotFoundError: if there is no such file.
        InvalidDataError: for damaged files, missing or unknown keys, lengths that disagree, NaN, flags other than 0
            and 1, data outside the spaces, next observations that contradict the flags.
        ConfigurationError: where nothing says where episodes end, or which whole numbers an action may be.
        UnsupportedSpaceError: for spaces that are not one array a step.
        DatasetExistsError, CacheError: if there is a dataset of this id, or the cache cannot store it.
    """
    path = None if isinstance(source, Mapping) else Path(source)
    flat = flatten_mapping(source) if isinstance(source, Mapping) else read_flat(Path(source))
    reading = _Reading(
        dataset_id=dataset_id or _default_id(flat, path),
        max_episode_steps=max_episode_steps,
        cut_at=cut_at,
        env_spec=env_spec,
        observation_space=observation_space,
        action_space=action_space,
        file=None if path is None else path.name,
    )
    return _store(flat, reading, named=dataset_id is not None)


def write_d4rl(data: MinariDataset, path: str | os.PathLike[str]) -> Path:
    """Write a Minari dataset (or a view of it, or an augmented one) as a D4RL HDF5 file and return its path.

    Rows are steps, in the dataset's order and dtypes: `observations`, `actions`, `rewards`, `next_observations` (so
    that no last observation is lost), `terminals`, `timeouts = truncations & ~terminations`, `infos/*` and the
    `metadata/*` that `read_d4rl` kept. The end of an episode that carries no flag is marked as a timeout, since every
    reader of D4RL would join it to the next one. Infos of T+1 rows (the reset's first) give the rows of their steps.

    What the layout has no place for goes to `metadata/oat_gym`, which readers of D4RL pass over: ends without a flag,
    ends with both, infos of resets, spaces, and Minari's metadata (in JSON's types). `read_d4rl` of the file then gives
    the same dataset, to the last bit of every observation, action, reward, flag and info.

    Raises:
        DatasetExistsError: if `path` exists; it is left as it is.
        UnsupportedSpaceError: for Dict, Tuple, Text and other spaces that are not one array a step.
        InvalidDataError: for what the layout cannot hold: no episodes, NaN, a truncation before an episode's last
            step, next states that are no observation, dtypes that differ between episodes (but integers recorded for
            real numbers become floats beside generated ones), infos of other lengths, or values outside their spaces.
        ConfigurationError: if the folder of `path` is not there.
        SaveError: if the disk refuses; nothing is left behind.

    Example: `write_d4rl(minari.load_dataset("D4RL/door/human-v2"), "door-human.hdf5")`.
    """
    target = Path(path)
    if target.exists():
        raise DatasetExistsError(f"{target} is already there and was left as it is; choose another name or remove it.")
    if not target.parent.is_dir():
        raise ConfigurationError(f"There is no folder {target.parent}; make it first.")
    array_space("observation", data.observation_space)
    array_space("action", data.action_space)
    flat = columns_of(data)
    write_flat(target, flat)
    logger.info("wrote %d rows to %s", len(flat["rewards"]), target)
    return target


def is_d4rl_path(name: str | os.PathLike[str]) -> bool:
    """Return whether a name is that of an HDF5 file (by its suffix), and not a Minari id.

    >>> is_d4rl_path("door-human-v1.hdf5"), is_d4rl_path("D4RL/door/human-v2")
    (True, False)
    """
    return Path(name).suffix.lower() in SUFFIXES


def d4rl_metadata(data: MinariDataset) -> dict[str, Any]:
    """Return the `metadata/*` that came with a D4RL file: {"algorithm": "SAC", "policy/fc0/bias": array, ...}."""
    found = notes.metadata_from_json(kept_metadata(source_metadata(data)))
    return {name.removeprefix(notes.METADATA): value for name, value in found.items()}


def _default_id(flat: Flat, path: Path | None) -> str:
    note = notes.read_note(flat)
    if note is not None:
        return str(note.metadata.get("dataset_id", "d4rl/data-v0"))
    stem = re.sub(r"[^A-Za-z0-9_-]+", "-", path.stem if path else "").strip("-") or "data"
    return f"d4rl/{stem}" if re.search(r"-v\d+$", stem) else f"d4rl/{stem}-v0"


def _hash(flat: Flat) -> str:
    digest = hashlib.sha256()
    for name in sorted(flat):
        value = flat[name]
        if isinstance(value, np.ndarray):
            digest.update(f"|{name}|{value.dtype.str}|{value.shape}|".encode())
            digest.update(np.ascontiguousarray(value).data)
        else:
            digest.update(f"|{name}|{value!r}|".encode())
    return digest.hexdigest()


def _store(flat: Flat, reading: _Reading, *, named: bool) -> MinariDataset:
    if not named:
        key = fingerprint(
            kind="d4rl", version=VERSION, minari=minari.__version__, data=_hash(flat), **reading.options()
        )
        return cached_dataset(key, lambda folder: _convert(flat, reading, folder))
    target = check_dataset_id(reading.dataset_id)
    with new_dataset_folder(reading.dataset_id) as folder:
        _convert(flat, reading, folder)
    return MinariDataset(target / "data")


def _convert(flat: Flat, reading: _Reading, folder: Path) -> None:
    """Write the episodes of a flat dictionary as a Minari dataset into the empty `folder`."""
    rows = rows_of(flat)
    note = rows.note if reading.cut_at is None and reading.max_episode_steps is None else None
    found = spaces_of(rows, reading.observation_space, reading.action_space)
    if note is None:
        stops = found_stops(rows, reading.cut_at or "terminals_or_timeouts", reading.max_episode_steps)
        episodes = cut(dataclasses.replace(rows, reset_infos={}), stops)
    else:
        stops = noted_stops(rows, note)
        episodes = cut(doubly_flagged(rows, stops, note), stops, unflagged=note.unflagged)
    if episodes.dropped:
        logger.warning("%d steps were left out: their next observations are not in the data.", episodes.dropped)
    counts = {"repeated_observations": episodes.repeated, "dropped_steps": episodes.dropped}
    write_dataset(
        folder,
        reading.dataset_id,
        (
            (episode, note.episodes[i] if note else {})
            for i, episode in zip(episodes.numbers, episodes.data, strict=True)
        ),
        like=_metadata(flat, reading, note, {} if note else counts),
        spaces=found,
        data_format="hdf5",
    )


def _metadata(flat: Flat, reading: _Reading, note: notes.Note | None, counts: dict[str, int]) -> dict[str, Any]:
    name = reading.file or "a dictionary of arrays"
    card = DatasetCard(dataset_id=reading.dataset_id, description=f"Read by oat_gym from D4RL's layout ({name}).")
    like = metadata_to_json(note.metadata if note else card.metadata())
    about = {**like.pop("d4rl", {}), **counts}
    extra = notes.metadata_to_json(flat)
    if extra:
        about["metadata"] = extra
    if about:
        like["d4rl"] = about
    if reading.env_spec is not None:
        like["env_spec"] = reading.env_spec.to_json()
    return like | {"minari_version": minari.__version__}
