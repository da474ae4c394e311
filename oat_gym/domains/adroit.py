"""Adroit door: the 25 human demonstrations of D4RL's door-human."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import gymnasium as gym
import minari
import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from minari.data_collector import EpisodeBuffer

from oat_gym.domains._data import converted, find_file
from oat_gym.domains.task import Task
from oat_gym.errors import InvalidDataError
from oat_gym.io.writing import DatasetCard, dataset_from_episodes, episode_buffer

MINARI_ID = "D4RL/door/human-v2"
DATASET_ID = "oat_gym/door-human-v0"
FILE = "robotics/adroit_human/door_human_25demos.npz"
DEMONSTRATION_STEPS = 300
"""The longest demonstration has 300 rows; the registered environment is cut at 200 steps."""

_VERSION = 1  # raise it when the conversion changes
_HOW_TO_GET = (
    f"Run `minari download {MINARI_ID}`, or set OAT_GYM_DATA to a folder that holds {FILE} (arrays observations, "
    "actions, rewards and lengths)."
)
_DESCRIPTION = (
    "The 25 human demonstrations behind D4RL's door-human (aravindr93/hand_dapg, Apache-2.0), with the rewards "
    "recorded then. The recording has no observation after the last action, so a demonstration of L rows gives "
    "L - 1 steps, and the last is truncated; no demonstration terminates. Recorded actions leave [-1, 1] in places: "
    "`actions` are clipped to the bounds as the environment clips them, and infos['raw_action'] keeps what was "
    "recorded."
)


def door_human(path: str | os.PathLike[str] | None = None) -> minari.MinariDataset:
    """Return the human door demonstrations: 25 episodes of 222 to 299 steps, 39 features, 28 actions.

    Without `path`, Minari's own `D4RL/door/human-v2` is used where it is installed (`dataset.id` tells); otherwise
    the demonstrations file is converted, once, into the cache (OAT_GYM_CACHE).

    The observation after the last recorded action is not in the file. An episode of L rows therefore has L observations
    and L - 1 actions and rewards, and its last step is truncated. Rewards are those recorded with the data; the
    installed environment's differ in the sign of one small term. Actions are clipped to [-1, 1], as the environment
    does before it acts; `infos["raw_action"]` has them as recorded. Values are the file's float32; observations are
    stored as float64, the dtype of AdroitHandDoor-v1.

    Args:
        path: the .npz file, or a folder that holds it.

    Raises:
        DatasetNotFoundError: if the data is not there; the message says how to get it.
        InvalidDataError: if the file does not hold what is expected.
    """
    if path is None and MINARI_ID in minari.list_local_datasets():
        return minari.load_dataset(MINARI_ID)
    source = find_file(FILE, path=path, how_to_get=_HOW_TO_GET)

    return converted("door-human", source, version=_VERSION, write=lambda folder: _convert(source, folder))


def _convert(source: Path, folder: Path) -> minari.MinariDataset:
    return dataset_from_episodes(
        _read_demonstrations(source),
        directory=folder,
        card=_card(),
        observation_space=spaces.Box(-np.inf, np.inf, (39,), np.float64),
        action_space=spaces.Box(-1.0, 1.0, (28,), np.float32),
    )


def _read_demonstrations(source: Path) -> list[EpisodeBuffer]:
    names = ("observations", "actions", "rewards", "lengths")
    with np.load(source, allow_pickle=False) as file:
        missing = [name for name in names if name not in file]
        if missing:
            raise InvalidDataError(f"{source} lacks the arrays {missing}; it has {sorted(file)}. {_HOW_TO_GET}")
        observations, actions, rewards, lengths = (file[name] for name in names)
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


def _card() -> DatasetCard:
    import gymnasium_robotics  # noqa: PLC0415  (takes a second and prints a notice: only when converting)

    gym.register_envs(gymnasium_robotics)
    spec = gym.spec("AdroitHandDoor-v1")
    return DatasetCard(
        dataset_id=DATASET_ID,
        description=_DESCRIPTION,
        author="Aravind Rajeswaran et al. (hand_dapg)",
        algorithm_name="human demonstrations",
        env_spec=replace(spec, max_episode_steps=DEMONSTRATION_STEPS),
        eval_env_spec=spec,
        requirements=("gymnasium-robotics>=1.3",),
    )


DATASETS: dict[str, Callable[[], minari.MinariDataset]] = {"adroit-door-human": door_human}
"""Name of each dataset and the function that opens it."""

TASKS: dict[str, Task] = {}
"""Name of each task and what its datasets are evaluated with."""
