"""The maze environment of the embedded dataset, opened as a vector and left without a trace."""

from __future__ import annotations

from collections.abc import Callable, Generator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import SyncVectorEnv

from oat_gym._rng import check_seed
from oat_gym.errors import ConfigurationError
from oat_gym.spaces import Batch, map_tree

ENV_ID = "PointMaze_UMaze-v3"
HORIZON = 300
"""Number of steps after which an episode is truncated."""


@contextmanager
def open_maze(*, continuing: bool = False) -> Generator[gym.Env[Any, Any]]:
    """Open the environment, and remove the XML file that it leaves in the temporary folder.

    Args:
        continuing: the goal neither ends an episode nor moves; by default reaching it terminates the episode.

    >>> with open_maze() as env:
    ...     env.spec.max_episode_steps
    300
    """
    import gymnasium_robotics  # noqa: PLC0415  (takes a second and prints a notice: only when it is needed)

    gym.register_envs(gymnasium_robotics)
    options = {"continuing_task": True, "reset_target": False} if continuing else {"continuing_task": False}
    env = gym.make(ENV_ID, **options)
    try:
        yield env
    finally:
        model_file = Path(env.get_wrapper_attr("tmp_xml_file_path"))
        env.close()
        model_file.unlink(missing_ok=True)


@contextmanager
def open_mazes(
    count: int, *, wrap: Callable[[gym.Env[Any, Any]], gym.Env[Any, Any]] = lambda env: env
) -> Generator[SyncVectorEnv]:
    """Open `count` goal-terminated environments, each handed to `wrap`, that are stepped together.

    Raises:
        ConfigurationError: for a count below 1.
    """
    if count < 1:
        raise ConfigurationError(f"count must be at least 1, got {count}.")
    with ExitStack() as stack:
        envs = [stack.enter_context(open_maze()) for _ in range(count)]
        yield SyncVectorEnv([lambda env=env: wrap(env) for env in envs])


def initial_states(count: int, seed: int) -> Batch:
    """Return the observations after `count` resets: a random start at rest and a random goal.

    Raises:
        ConfigurationError: for a count below 1 or a negative seed.
    """
    if count < 1:
        raise ConfigurationError(f"count must be at least 1, got {count}.")
    seeds = np.random.SeedSequence(check_seed(seed)).generate_state(count)
    with open_maze() as env:
        first = [env.reset(seed=int(value))[0] for value in seeds]
    return map_tree(lambda *rows: np.stack(rows), first[0], *first[1:])
