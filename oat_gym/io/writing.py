"""Minari datasets from episodes, in a folder of the caller's choice and written atomically."""

from __future__ import annotations

import dataclasses
import logging
import os
import shutil
import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium as gym
import minari
import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from minari.data_collector import EpisodeBuffer
from minari.dataset.episode_data import EpisodeData
from minari.dataset.minari_dataset import parse_dataset_id
from minari.dataset.minari_storage import MinariStorage

from oat_gym._ids import describe_ids
from oat_gym.episodes import check_episode
from oat_gym.errors import ConfigurationError, DatasetExistsError, InvalidDataError, SaveError
from oat_gym.export import is_disk_error
from oat_gym.spaces import Batch

logger = logging.getLogger(__name__)

_MOST_EXACT = 2**53
"""The largest number below which every float of 64 bits that is whole is one integer."""


@dataclass(frozen=True)
class DatasetCard:
    """What a Minari dataset says about itself (Minari's metadata of the same names).

    Args:
        dataset_id: Minari id with a version, as "tutoring/log-v0".
        description: what the data is and where it is from.
        author: who made it.
        algorithm_name: the policy that acted.
        env_spec: the environment, where there is one; `eval_env_spec` where evaluation uses another.
        requirements: pip requirements of the environment.
        extra: further metadata, stored under its own keys (values that JSON can hold).

    Raises:
        ConfigurationError: if the id is not one that Minari accepts.

    >>> DatasetCard(dataset_id="tutoring/log-v0", description="178 students").dataset_id
    'tutoring/log-v0'
    """

    dataset_id: str
    description: str
    author: str = "unknown"
    algorithm_name: str = "unknown"
    env_spec: EnvSpec | None = None
    eval_env_spec: EnvSpec | None = None
    requirements: tuple[str, ...] = ()
    extra: dict[str, Any] = field(default_factory=dict[str, Any])

    def __post_init__(self) -> None:
        """Check the id."""
        try:
            parse_dataset_id(self.dataset_id)
        except (TypeError, ValueError) as error:  # TypeError: Minari's answer to an id without a version
            raise ConfigurationError(
                f"dataset_id={self.dataset_id!r} is not a Minari id; write it as {describe_ids(self.dataset_id)}."
            ) from error

    def metadata(self) -> dict[str, Any]:
        """Return Minari's metadata dictionary, without the spaces and counts that the storage adds."""
        values: dict[str, Any] = {
            "dataset_id": self.dataset_id,
            "description": self.description,
            "author": {self.author},
            "algorithm_name": self.algorithm_name,
            "minari_version": minari.__version__,
            **self.extra,
        }
        if self.eval_env_spec is not None:
            values["eval_env_spec"] = self.eval_env_spec.to_json()
        if self.requirements:
            values["requirements"] = list(self.requirements)
        return values


def episode_buffer(
    *,
    observations: Batch,
    actions: Batch,
    rewards: Any,
    terminations: Any,
    truncations: Any,
    infos: dict[str, Any] | None = None,
    seed: int | None = None,
) -> EpisodeBuffer:
    """Return a Minari buffer of arrays (its own annotations ask for lists; its writers take both)."""
    return EpisodeBuffer(
        seed=seed,
        observations=observations,
        actions=actions,
        rewards=rewards,
        terminations=terminations,
        truncations=truncations,
        infos=infos,
    )


def dataset_from_episodes(
    episodes: Iterable[EpisodeBuffer],
    *,
    directory: str | os.PathLike[str],
    card: DatasetCard,
    observation_space: gym.Space[Any],
    action_space: gym.Space[Any],
) -> minari.MinariDataset:
    """Write episodes as a Minari dataset in `directory` (data in `directory/data`) and return it opened.

    The folder appears complete or not at all: it is written under a temporary name beside its place and renamed.
    Minari's own root is not touched; `minari.storage.get_dataset_path(card.dataset_id)` is the directory with which
    Minari knows the dataset by its id. The format is HDF5.

    Where a space is Discrete or MultiDiscrete, booleans and whole numbers stored as floats, as tables often have them,
    become integers.

    Raises:
        DatasetExistsError: if `directory` exists.
        SaveError: if the disk refuses; nothing is left behind.
        ConfigurationError: if an episode is no `EpisodeBuffer`.
        InvalidDataError: without episodes, and for episodes that break the T+1 rule or leave the spaces.
    """
    target = Path(directory).resolve()  # Minari cannot measure a folder by a relative path
    if os.path.lexists(target):
        raise DatasetExistsError(f"{target} is already there and was left as it is; choose another directory.")
    buffers = [_checked(*numbered, observation_space, action_space) for numbered in enumerate(episodes)]
    if not buffers:
        raise InvalidDataError("No episodes were given, and a Minari dataset has at least one.")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        temporary = Path(tempfile.mkdtemp(prefix=f".{target.name}-", dir=target.parent))
    except OSError as error:
        raise _save_error(target, error) from error
    try:
        storage = MinariStorage.new(temporary / "data", observation_space, action_space, card.env_spec)
        storage.update_metadata(card.metadata())
        storage.update_episodes(buffers)
        temporary.chmod(0o755)  # mkdtemp keeps others out, which a dataset folder should not
        _publish(temporary, target)
    except (OSError, RuntimeError, ValueError) as error:  # HDF5 tells a full disk by any of them
        if is_disk_error(error):
            raise _save_error(target, error) from error
        raise
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    logger.info("wrote %d episodes to %s", len(buffers), target)
    return minari.MinariDataset(target / "data")


def _save_error(target: Path, error: Exception) -> SaveError:
    return SaveError(
        f"The dataset could not be written to {target} ({error}); nothing of it was left there. Free some space, or "
        "give a directory that can be written."
    )


def _publish(temporary: Path, target: Path) -> None:
    try:
        temporary.replace(target)
    except OSError as error:  # another process was faster
        if not target.exists():
            raise
        raise DatasetExistsError(f"{target} appeared while this dataset was written, and was left as it is.") from error


def _checked(
    number: int, buffer: EpisodeBuffer, observation_space: gym.Space[Any], action_space: gym.Space[Any]
) -> EpisodeBuffer:
    """Return an episode that keeps the T+1 rule and is inside the spaces, in integers where these hold integers."""
    if not isinstance(buffer, EpisodeBuffer):
        raise ConfigurationError(
            f"Episode {number} is a {type(buffer).__name__}; expected an EpisodeBuffer: episode_buffer makes one of "
            "arrays, and oat_gym.io.tables.episodes_from_table a list of them of a table."
        )
    episode = EpisodeData(
        id=number,
        observations=buffer.observations,
        actions=buffer.actions,
        rewards=np.asarray(buffer.rewards),
        terminations=np.asarray(buffer.terminations),
        truncations=np.asarray(buffer.truncations),
        infos=buffer.infos or {},
    )
    check_episode(episode, observation_space, action_space)
    return dataclasses.replace(
        buffer,
        observations=_inside(f"The observations of episode {number}", episode.observations, observation_space),
        actions=_inside(f"The actions of episode {number}", episode.actions, action_space),
    )


def _inside(what: str, batch: Batch, space: gym.Space[Any]) -> Batch:
    """Return a batch all of whose values are in the space; raise `InvalidDataError` that names what is not."""
    if isinstance(space, spaces.Dict):
        return batch | {key: _inside(f"{what}[{key!r}]", batch[key], part) for key, part in space.spaces.items()}
    if isinstance(space, spaces.Tuple):
        return tuple(_inside(f"{what}[{key}]", batch[key], part) for key, part in enumerate(space.spaces))
    if isinstance(space, spaces.Discrete | spaces.MultiDiscrete):
        batch = _integers(what, batch, space)
    if not _contains(batch, space):
        raise InvalidDataError(f"{what} are not all in {space}; correct the values or widen the space.")
    return batch


def _integers(what: str, values: Batch, space: gym.Space[Any]) -> Batch:
    """Return the values of a space of integers as integers; those that are stored as such stay as they are."""
    array = np.asarray(values)
    if array.dtype.kind in "iu":
        return values
    if array.dtype.kind == "b":
        return array.astype(space.dtype)
    bad = np.ones(array.shape, dtype=bool)
    if array.dtype.kind == "f":
        bad = ~(np.isfinite(array) & (array == np.floor(array)) & (np.abs(array) <= _MOST_EXACT))
    if bad.any():
        raise InvalidDataError(
            f"{what} are of dtype {array.dtype}, the first that is no integer {array[bad][0]!s:.40}, and {space} holds "
            "integers: convert them, or declare another space."
        )
    return array.astype(space.dtype)


def _contains(values: Sequence[Any], leaf: gym.Space[Any]) -> bool:
    if not isinstance(leaf, spaces.Box):
        return all(leaf.contains(value) for value in values)
    array = np.asarray(values)
    return array.shape[1:] == leaf.shape and bool(((array >= leaf.low) & (array <= leaf.high)).all())
