"""The Adroit environments of gymnasium-robotics, with the rewards of D4RL and its episode lengths.

No Adroit environment of gymnasium-robotics terminates: the time limit truncates. (D4RL's pen ends an episode when the
pen drops. Here a dropped pen costs 5 a step until the limit.)
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import SyncVectorEnv

from oat_gym._rng import reset_seeds
from oat_gym.domains.adroit_rewards import AdroitTask, adroit_task, d4rl_reward

FloatArray = npt.NDArray[np.float64]
Actions = npt.NDArray[np.float32]

REQUIREMENTS = ("gymnasium-robotics>=1.3", "mujoco>=3.1")
"""What pip installs to make the environments."""


class D4RLReward(gym.Wrapper[FloatArray, Actions, FloatArray, Actions]):
    """An Adroit environment whose reward is D4RL's; `info["stock_reward"]` has the environment's own.

    >>> env = make_env("door")
    >>> observation, _ = env.reset(seed=0)
    >>> observation, reward, _, _, info = env.step(np.zeros(28, dtype=np.float32))
    >>> reward < info["stock_reward"]
    True
    """

    def __init__(self, env: gym.Env[FloatArray, Actions], task: AdroitTask) -> None:
        super().__init__(env)
        self.task = task

    def step(self, action: Actions) -> tuple[FloatArray, float, bool, bool, dict[str, Any]]:
        """Step, and give D4RL's reward."""
        observation, stock, terminated, truncated, info = self.env.step(action)
        infos = {**info, "success": bool(info["success"]), "stock_reward": float(stock)}  # a numpy bool before
        return observation, float(d4rl_reward(float(stock), observation, self.task)), terminated, truncated, infos


def make_env(name: str, *, horizon: int | None = None) -> D4RLReward:
    """Return the environment of a task ("pen", "door", "hammer", "relocate") with D4RL's reward.

    Args:
        name: the task.
        horizon: episodes are truncated after so many steps; by default D4RL's number.

    Raises:
        ConfigurationError: for an unknown name.
    """
    task = adroit_task(name)
    _register()
    env = gym.make(task.env_id, max_episode_steps=horizon or task.horizon, disable_env_checker=True)
    return D4RLReward(env, task)


def make_vec_env(name: str, num_envs: int, *, horizon: int | None = None) -> SyncVectorEnv:
    """Return `num_envs` environments of a task with D4RL's reward, stepped together; see `make_env`."""
    return SyncVectorEnv([lambda: make_env(name, horizon=horizon)] * num_envs)


def env_spec(name: str) -> EnvSpec:
    """Return gymnasium-robotics' specification of a task's environment (stock reward), truncated as in D4RL."""
    task = adroit_task(name)
    _register()
    return replace(gym.spec(task.env_id), max_episode_steps=task.horizon)


def reset_observations(name: str, count: int, seed: int) -> FloatArray:
    """Return the observations (count, D) of `count` resets of a task's environment."""
    env = make_env(name)
    rows = [env.reset(seed=value)[0] for value in reset_seeds(count, seed, "adroit resets", name)]
    env.close()
    return np.stack(rows)


def _register() -> None:
    import gymnasium_robotics  # noqa: PLC0415  (takes a second and prints a notice: only when it is needed)

    gym.register_envs(gymnasium_robotics)
