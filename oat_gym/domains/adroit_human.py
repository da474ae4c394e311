"""Adroit's human demonstrations: D4RL's human data from Minari, or for the door the file behind it."""

from __future__ import annotations

import os
import warnings
import zipfile
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import minari
import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from minari.data_collector import EpisodeBuffer

from oat_gym.domains._data import converted, find_file, generated
from oat_gym.domains.adroit_env import REQUIREMENTS, env_spec
from oat_gym.domains.adroit_rewards import (
    AdroitTask,
    Convention,
    RewardWarning,
    adroit_task,
    d4rl_reward,
    reward_convention,
)
from oat_gym.episodes import content_hash
from oat_gym.errors import DatasetNotFoundError, InvalidDataError
from oat_gym.io.writing import DatasetCard, dataset_from_episodes, episode_buffer

DATASET_ID = "oat_gym/door-human-v0"
FILE = "robotics/adroit_human/door_human_25demos.npz"
DEMONSTRATION_STEPS = 300
"""The longest demonstration has 300 rows; the registered environment is cut at 200 steps."""

_VERSION = 1  # raise it when the conversion changes
_DOOR_HOW_TO_GET = (
    f"Run `minari download D4RL/door/human-v2`, or set OAT_GYM_DATA to a folder that holds {FILE} (arrays "
    "observations, actions, rewards and lengths)."
)
_DESCRIPTION = (
    "The 25 human demonstrations behind D4RL's door-human (aravindr93/hand_dapg, Apache-2.0), with the rewards "
    "recorded then. The recording has no observation after the last action, so a demonstration of L rows gives "
    "L - 1 steps, and the last is truncated; no demonstration terminates. Recorded actions leave [-1, 1] in places: "
    "`actions` are clipped to the bounds as the environment clips them, and infos['raw_action'] keeps what was "
    "recorded."
)


def human(name: str) -> minari.MinariDataset:
    """Return the 25 human demonstrations of a task ("pen", "door", "hammer", "relocate").

    They are Minari's own `D4RL/TASK/human-v2` where it is installed (`dataset.id` tells); the door's are otherwise
    converted from the file that they were published in (`door_human`). Where Minari's data carries the installed
    environment's rewards (`reward_convention`), a copy with D4RL's, which the true values count, is made in the cache;
    the others are in its `infos["stock_reward"]`.

    Raises:
        ConfigurationError: for an unknown task.
        DatasetNotFoundError: if the data is not there; the message says how to get it.

    Warns:
        RewardWarning: if rewards were converted, or if nobody can tell which rewards Minari's data carries (the
            hammer's cannot be computed from observations).
    """
    task = adroit_task(name)
    dataset = door_human() if name == "door" else _from_minari(name)
    convention = _convention(dataset, task) if dataset.id == _minari_id(name) else "d4rl"
    if convention == "d4rl":
        return dataset
    found = "carries rewards that add" if convention == "stock" else "may carry rewards that add"
    done = "converted to these" if convention == "stock" else "given as they are, since nobody can tell from the data"
    warnings.warn(
        f"{dataset.id} {found} 0.1 x the distance from hand to object; the true values of 'adroit-{name}' count "
        f"D4RL's, which subtract it. Rewards are {done}.",
        RewardWarning,
        stacklevel=2,
    )
    return _with_d4rl_rewards(dataset, task) if convention == "stock" else dataset


def door_human(path: str | os.PathLike[str] | None = None) -> minari.MinariDataset:
    """Return the human door demonstrations: 25 episodes of 222 to 299 steps, 39 features, 28 actions.

    Without `path`, Minari's own `D4RL/door/human-v2` is used where it is installed (`dataset.id` tells); otherwise
    the demonstrations file is converted, once, into the cache (OAT_GYM_CACHE).

    The observation after the last recorded action is not in the file. An episode of L rows therefore has L observations
    and L - 1 actions and rewards, and its last step is truncated. Rewards are those recorded with the data, D4RL's; the
    installed environment's differ in the sign of one small term. Actions are clipped to [-1, 1], as the environment
    does before it acts; `infos["raw_action"]` has them as recorded. Values are the file's float32; observations are
    stored as float64, the dtype of AdroitHandDoor-v1.

    Args:
        path: the .npz file, or a folder that holds it.

    Raises:
        DatasetNotFoundError: if the data is not there; the message says how to get it.
        InvalidDataError: if the file does not hold what is expected.
    """
    if path is None and _minari_id("door") in minari.list_local_datasets():
        return minari.load_dataset(_minari_id("door"))
    source = find_file(FILE, path=path, how_to_get=_DOOR_HOW_TO_GET)

    return converted("door-human", source, version=_VERSION, write=lambda folder: _convert(source, folder))


def _minari_id(name: str) -> str:
    return f"D4RL/{name}/human-v2"


def _from_minari(name: str) -> minari.MinariDataset:
    if _minari_id(name) not in minari.list_local_datasets():
        raise DatasetNotFoundError(
            f"The human {name} demonstrations are not on this machine. Run `minari download {_minari_id(name)}`, or "
            f"load 'adroit-{name}-expert' or 'adroit-{name}-cloned-from-expert', which are made here."
        )
    return minari.load_dataset(_minari_id(name))


def _convention(dataset: minari.MinariDataset, task: AdroitTask) -> Convention:
    episodes = list(dataset.iterate_episodes())
    following = np.concatenate([np.asarray(episode.observations)[1:] for episode in episodes])
    return reward_convention(np.concatenate([episode.rewards for episode in episodes]), following, task)


def _with_d4rl_rewards(dataset: minari.MinariDataset, task: AdroitTask) -> minari.MinariDataset:
    def converted_episode(episode: minari.EpisodeData) -> EpisodeBuffer:
        return episode_buffer(
            observations=episode.observations,
            actions=episode.actions,
            rewards=d4rl_reward(episode.rewards, np.asarray(episode.observations)[1:], task),
            terminations=episode.terminations,
            truncations=episode.truncations,
            infos={**(episode.infos or {}), "stock_reward": episode.rewards},
        )

    def write(folder: Path) -> minari.MinariDataset:
        return dataset_from_episodes(
            map(converted_episode, dataset.iterate_episodes()),
            directory=folder,
            card=DatasetCard(
                dataset_id=f"oat_gym/{task.name}-human-v0",
                description=f"{dataset.id} with D4RL's rewards; infos['stock_reward'] has those of the source.",
                author="Aravind Rajeswaran et al. (hand_dapg)",
                algorithm_name="human demonstrations",
                env_spec=dataset.env_spec,
                requirements=REQUIREMENTS,
            ),
            observation_space=dataset.observation_space,
            action_space=dataset.action_space,
        )

    content = content_hash(dataset.iterate_episodes())
    return generated(write, domain=f"adroit-{task.name}-human", content=content, version=_VERSION)


def _convert(source: Path, folder: Path) -> minari.MinariDataset:
    spec = env_spec("door")
    return dataset_from_episodes(
        _read_demonstrations(source),
        directory=folder,
        card=DatasetCard(
            dataset_id=DATASET_ID,
            description=_DESCRIPTION,
            author="Aravind Rajeswaran et al. (hand_dapg)",
            algorithm_name="human demonstrations",
            env_spec=replace(spec, max_episode_steps=DEMONSTRATION_STEPS),
            eval_env_spec=spec,
            requirements=REQUIREMENTS,
        ),
        observation_space=spaces.Box(-np.inf, np.inf, (39,), np.float64),
        action_space=spaces.Box(-1.0, 1.0, (28,), np.float32),
    )


def _read_demonstrations(source: Path) -> list[EpisodeBuffer]:
    names = ("observations", "actions", "rewards", "lengths")
    try:
        with source.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file}
    except (ValueError, OSError, EOFError, zipfile.BadZipFile) as error:
        raise InvalidDataError(f"{source} cannot be read as plain arrays ({error}). {_DOOR_HOW_TO_GET}") from error
    missing = [name for name in names if name not in arrays]
    if missing:
        raise InvalidDataError(f"{source} lacks the arrays {missing}; it has {sorted(arrays)}. {_DOOR_HOW_TO_GET}")
    observations, actions, rewards, lengths = (arrays[name] for name in names)
    rows = int(lengths.sum())
    if not rows == len(observations) == len(actions) == len(rewards):
        raise InvalidDataError(f"{source}: lengths sum to {rows}, and there are {len(observations)} observations.")
    bounds = np.cumsum([0, *lengths])
    return [_demonstration(observations[a:b], actions[a:b], rewards[a:b]) for a, b in pairwise(bounds)]


def _demonstration(
    observations: npt.NDArray[Any], actions: npt.NDArray[Any], rewards: npt.NDArray[Any]
) -> EpisodeBuffer:
    steps = len(rewards) - 1
    return episode_buffer(
        observations=observations.astype(np.float64),
        actions=np.clip(actions[:steps], -1.0, 1.0).astype(np.float32),
        rewards=rewards[:steps].astype(np.float64),
        terminations=np.zeros(steps, dtype=bool),
        truncations=np.arange(steps) == steps - 1,
        infos={"raw_action": actions[:steps]},
    )
