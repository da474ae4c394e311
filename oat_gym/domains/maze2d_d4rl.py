"""The maze as D4RL's maze2d-umaze-v1 has it: one fixed goal, and DOPE's eleven policies.

D4RL's point mass and PointMaze's are one MuJoCo model. What differs is the frame (D4RL counts x down the rows and y
along the columns, from an origin of its own), the goal (fixed in D4RL, and not in the observation), the start (with a
random velocity), and the reward (1 in every step within 0.5 m of the goal; nothing terminates). `D4RLMaze` gives
PointMaze that frame, goal, start and reward; DOPE's policies then drive it as they are.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import gymnasium as gym
import minari
import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from gymnasium.vector import SyncVectorEnv
from minari.data_collector import EpisodeBuffer

from oat_gym._rng import check_seed, derive
from oat_gym.domains._data import converted, find_file
from oat_gym.domains.maze2d_env import HORIZON, open_mazes
from oat_gym.domains.maze2d_layout import UMAZE
from oat_gym.domains.task import Task
from oat_gym.domains.truth import Truth, read_truth
from oat_gym.embedded import embedded_path
from oat_gym.errors import ConfigurationError
from oat_gym.io.writing import DatasetCard, dataset_from_episodes, episode_buffer
from oat_gym.ope.dope import load_dope_policies
from oat_gym.ope.mlp_policy import MLPPolicy
from oat_gym.ope.policy import Policy
from oat_gym.spaces import Batch

FloatArray = npt.NDArray[np.float64]

TASK = "maze2d-umaze-d4rl"
GOAL = (1.0, 1.0)
"""D4RL's goal, in its frame: in the cell at the U's upper left end, 0.28 m off its centre."""
RADIUS = 0.5
"""Distance from the goal in metres within which a step earns 1."""
OBSERVATION_SPACE = spaces.Box(-np.inf, np.inf, (4,), np.float64)
ACTION_SPACE = spaces.Box(-1.0, 1.0, (2,), np.float32)

_OFFSET = 0.2  # metres from D4RL's coordinates of a cell's row and column to the cell's centre
_POSITION_NOISE, _SPEED_NOISE = 0.1, 0.1
_HOW = (
    "Put DOPE's maze2d_umaze_dapg_0.npz ... maze2d_umaze_dapg_10.npz (google-research/deep_ope, Apache-2.0) in "
    "robotics/dope_policies/maze2d_umaze of the folder that OAT_GYM_DATA names, or give path=."
)
_DESCRIPTION = (
    "The episodes of oat_gym/maze2d-umaze-v0 as D4RL's maze2d-umaze-v1 would show them: its frame, its fixed goal and "
    "its reward of 1 in every step within 0.5 m of that goal. As in D4RL, the planner walked to random goals and the "
    "reward was put in afterwards. Made by oat_gym, not by D4RL."
)


def d4rl_states(states: npt.ArrayLike) -> FloatArray:
    """Return PointMaze's states x, y, velocities (..., 4) in D4RL's frame.

    >>> d4rl_states([-1.0, 1.0, 0.5, -2.0]).round(6).tolist()  # the centre of the upper left cell
    [0.8, 0.8, 2.0, 0.5]
    """
    x, y, speed_x, speed_y = np.moveaxis(np.asarray(states, dtype=np.float64), -1, 0)
    row, column = (len(UMAZE.cells) - 1) / 2 - y, x + (len(UMAZE.cells[0]) - 1) / 2
    return np.stack([row - _OFFSET, column - _OFFSET, -speed_y, speed_x], axis=-1)


def pointmaze_states(states: npt.ArrayLike) -> FloatArray:
    """Return D4RL's states (..., 4) in PointMaze's frame: the inverse of `d4rl_states`."""
    down, right, speed_down, speed_right = np.moveaxis(np.asarray(states, dtype=np.float64), -1, 0)
    x, y = right + _OFFSET - (len(UMAZE.cells[0]) - 1) / 2, (len(UMAZE.cells) - 1) / 2 - down - _OFFSET
    return np.stack([x, y, speed_right, -speed_down], axis=-1)


def d4rl_actions(forces: npt.NDArray[np.floating]) -> npt.NDArray[np.floating]:
    """Return PointMaze's forces (..., 2) in D4RL's frame."""
    return np.stack([-forces[..., 1], forces[..., 0]], axis=-1)


def pointmaze_actions(actions: npt.NDArray[np.floating]) -> npt.NDArray[np.floating]:
    """Return D4RL's actions (..., 2) as PointMaze's forces: the inverse of `d4rl_actions`."""
    return np.stack([actions[..., 1], -actions[..., 0]], axis=-1)


def d4rl_rewards(states: npt.ArrayLike) -> FloatArray:
    """Return 1 for each state (..., 4) in D4RL's frame that is at the goal, else 0.

    >>> d4rl_rewards([[1.0, 1.4, 0.0, 0.0], [1.0, 1.6, 0.0, 0.0]]).tolist()
    [1.0, 0.0]
    """
    distance = np.linalg.norm(np.asarray(states, dtype=np.float64)[..., :2] - GOAL, axis=-1)
    return (distance <= RADIUS).astype(np.float64)


class D4RLMaze(gym.Env[FloatArray, npt.NDArray[np.float32]]):
    """PointMaze's U-maze as D4RL's maze2d-umaze-v1; 300 steps truncate it.

    Args:
        maze: the environment of `open_maze()`, which this one drives and does not close.

    >>> with open_maze() as maze:
    ...     D4RLMaze(maze).reset(seed=0)[0].shape
    (4,)
    """

    def __init__(self, maze: gym.Env[Any, Any]) -> None:
        self.observation_space, self.action_space = OBSERVATION_SPACE, ACTION_SPACE
        self._point: Any = maze.get_wrapper_attr("point_env")
        self._maze, self._steps = maze, 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[FloatArray, dict[str, Any]]:
        """Put the point in a random free cell with a random velocity."""
        super().reset(seed=seed)
        self._maze.reset(seed=0)  # whatever the simulator keeps between episodes is cleared
        state = _start(self.np_random)
        x, y, *speed = pointmaze_states(state)
        self._point.set_state(np.array([x, y]), np.array(speed))
        self._steps = 0
        return self._state(), {}

    def step(self, action: npt.NDArray[np.float32]) -> tuple[FloatArray, float, bool, bool, dict[str, Any]]:
        """Apply a force in D4RL's frame."""
        self._point.step(pointmaze_actions(np.asarray(action)))
        self._steps += 1
        state = self._state()
        return state, float(d4rl_rewards(state)), False, self._steps >= HORIZON, {}

    def _state(self) -> FloatArray:
        return d4rl_states(np.concatenate([self._point.data.qpos, self._point.data.qvel]))


def _start(rng: np.random.Generator) -> FloatArray:
    cell = np.array(UMAZE.free[int(rng.integers(len(UMAZE.free)))], dtype=np.float64)
    position = cell + rng.uniform(-_POSITION_NOISE, _POSITION_NOISE, 2)
    return np.concatenate([position, _SPEED_NOISE * rng.standard_normal(2)])


def open_d4rl_mazes(count: int) -> AbstractContextManager[SyncVectorEnv]:
    """Open `count` environments in D4RL's frame that are stepped together (`open_mazes`)."""
    return open_mazes(count, wrap=D4RLMaze)


def initial_states(count: int, seed: int) -> Batch:
    """Return `count` states of the start, (count, 4).

    Raises:
        ConfigurationError: for a count below 1 or a negative seed.
    """
    if count < 1:
        raise ConfigurationError(f"count must be at least 1, got {count}.")
    rng = derive(check_seed(seed), TASK)
    return np.stack([_start(rng) for _ in range(count)])


def dope_policies(path: str | os.PathLike[str] | None = None) -> dict[str, MLPPolicy]:
    """Return DOPE's eleven policies of maze2d-umaze-v1 by name; they take their mean action, as in DOPE.

    Args:
        path: the folder of their weight files; by default robotics/dope_policies/maze2d_umaze in the data folder.

    Raises:
        DatasetNotFoundError: if they are not there; the message says where they are from.
    """
    name = "maze2d_umaze_dapg_0.npz"
    first = find_file(f"robotics/dope_policies/maze2d_umaze/{name}", path=path, how_to_get=_HOW)
    return load_dope_policies(first.parent, action_space=ACTION_SPACE, censored=True)


def umaze_d4rl() -> minari.MinariDataset:
    """Return the 250 embedded episodes as D4RL's task shows them, converted once into the cache.

    Observations are x, y and velocities in D4RL's frame (4), actions forces in it (2); the reward is 1 in every step
    that ends within 0.5 m of the fixed goal. Each episode is truncated at its end, where the planner was at its goal.

    Raises:
        DatasetNotFoundError: if the installation lacks the embedded data.
    """
    embedded = embedded_path("oat_gym/maze2d-umaze-v0")
    return converted(TASK, embedded / "main_data.hdf5", version=1, write=lambda folder: _write(embedded, folder))


def _write(embedded: Path, folder: Path) -> minari.MinariDataset:
    return dataset_from_episodes(
        (_seen_by_d4rl(episode) for episode in minari.MinariDataset(embedded)),
        directory=folder,
        card=DatasetCard(
            dataset_id="oat_gym/maze2d-umaze-d4rl-v0",
            description=_DESCRIPTION,
            author="The oat_gym developers",
            algorithm_name="shortest path and noisy PD control",
        ),
        observation_space=OBSERVATION_SPACE,
        action_space=ACTION_SPACE,
    )


def _seen_by_d4rl(episode: minari.EpisodeData) -> EpisodeBuffer:
    states, steps = d4rl_states(episode.observations["observation"]), len(episode.rewards)
    return episode_buffer(
        observations=states,
        actions=d4rl_actions(episode.actions),
        rewards=d4rl_rewards(states[1:]),
        terminations=np.zeros(steps, dtype=bool),
        truncations=np.arange(steps) == steps - 1,
    )


def truth(gamma: float) -> Truth:
    """Return the true values of DOPE's policies in `D4RLMaze`.

    Raises:
        ConfigurationError: for a discount that is not stored.
    """
    return read_truth(TASK, gamma=gamma)


def _policies() -> dict[str, Policy]:
    return {**dope_policies()}


DATASETS: dict[str, Callable[[], minari.MinariDataset]] = {TASK: umaze_d4rl}
"""Name of each dataset and the function that opens it."""

TASKS: dict[str, Task] = {
    TASK: Task(
        datasets=(TASK,),
        policies=_policies,
        truth=truth,
        initial_states=initial_states,
        horizon=HORIZON,
        episodes_of="maze2d-umaze",
    )
}
"""Name of each task and what its datasets are evaluated with."""
