"""Minari datasets from episodes, in a folder of the caller's choice and written atomically."""

from __future__ import annotations

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

from oat_gym.episodes import check_episode
from oat_gym.errors import ConfigurationError, DatasetExistsError, InvalidDataError
from oat_gym.spaces import Batch, get_leaf, iter_leaf_spaces

logger = logging.getLogger(__name__)


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
                f"dataset_id={self.dataset_id!r} is not a Minari id; write it as 'namespace/name-v0'."
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
    Minari's own root is not touched; to list the dataset there, choose `directory` inside it. The format is HDF5.

    Raises:
        DatasetExistsError: if `directory` exists.
        InvalidDataError: without episodes, and for episodes that break the T+1 rule or leave the spaces.
    """
    target = Path(directory)
    if target.exists():
        raise DatasetExistsError(f"{target} is already there and was left as it is; choose another directory.")
    buffers = list(episodes)
    if not buffers:
        raise InvalidDataError("No episodes were given, and a Minari dataset has at least one.")
    for number, buffer in enumerate(buffers):
        _check_buffer(number, buffer, observation_space, action_space)
    target.parent.mkdir(parents=True, exist_ok=True)
    temporary = Path(tempfile.mkdtemp(prefix=f".{target.name}-", dir=target.parent))
    try:
        storage = MinariStorage.new(temporary / "data", observation_space, action_space, card.env_spec)
        storage.update_metadata(card.metadata())
        storage.update_episodes(buffers)
        temporary.chmod(0o755)  # mkdtemp keeps others out, which a dataset folder should not
        _publish(temporary, target)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    logger.info("wrote %d episodes to %s", len(buffers), target)
    return minari.MinariDataset(target / "data")


def _publish(temporary: Path, target: Path) -> None:
    try:
        temporary.replace(target)
    except OSError as error:  # another process was faster
        if not target.exists():
            raise
        raise DatasetExistsError(f"{target} appeared while this dataset was written, and was left as it is.") from error


def _check_buffer(
    number: int, buffer: EpisodeBuffer, observation_space: gym.Space[Any], action_space: gym.Space[Any]
) -> None:
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
    _check_values(f"The observations of episode {number}", episode.observations, observation_space)
    _check_values(f"The actions of episode {number}", episode.actions, action_space)


def _check_values(what: str, batch: Batch, space: gym.Space[Any]) -> None:
    for path, leaf in iter_leaf_spaces(space):
        if not _inside(get_leaf(batch, path), leaf):
            where = "".join(f"[{key!r}]" for key in path)
            raise InvalidDataError(f"{what}{where} are not all in {leaf}; correct the values or widen the space.")


def _inside(values: Sequence[Any], leaf: gym.Space[Any]) -> bool:
    if not isinstance(leaf, spaces.Box):
        return all(leaf.contains(value) for value in values)
    array = np.asarray(values)
    return array.shape[1:] == leaf.shape and bool(((array >= leaf.low) & (array <= leaf.high)).all())
