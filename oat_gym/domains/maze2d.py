"""Maze2D-umaze: the embedded dataset of 250 planner episodes, its target policies and their true values.

The dataset is ours: way-points of a shortest path, followed by a noisy PD controller in gymnasium-robotics'
`PointMaze_UMaze-v3`. It stands in for D4RL's maze2d-umaze of the paper and is not that dataset.
`datasets/build_maze2d_umaze.py` in the repository builds it. `maze2d_d4rl` sees the same episodes as D4RL's task of a
fixed goal, where DOPE's policies can be evaluated.
"""

from __future__ import annotations

from collections.abc import Callable

import minari

from oat_gym.domains import maze2d_d4rl
from oat_gym.domains.maze2d_env import HORIZON, initial_states
from oat_gym.domains.maze2d_layout import UMAZE, Cell, Maze
from oat_gym.domains.maze2d_policies import umaze_policies
from oat_gym.domains.task import Task
from oat_gym.domains.truth import Truth, read_truth
from oat_gym.embedded import embedded_path
from oat_gym.ope.policy import Policy

DATASET_ID = "oat_gym/maze2d-umaze-v0"
TASK = "maze2d-umaze"


def umaze() -> minari.MinariDataset:
    """Return the embedded dataset, opened in place and for reading (nothing is written or downloaded).

    Observations are a Dict as the environment gives it: `observation` (x, y, velocity x, velocity y; metres and metres
    a second), `achieved_goal` (x, y) and `desired_goal` (x, y). Actions are forces in [-1, 1]. The reward is 1 in the
    step that reaches the goal (within 0.45 m), which terminates the episode, and 0 before; the time limit of 300 steps
    truncates.

    Raises:
        DatasetNotFoundError: if the installation lacks the data.

    >>> len(umaze())
    250
    """
    return minari.MinariDataset(embedded_path(DATASET_ID))


def truth(gamma: float) -> Truth:
    """Return the true values of the target policies: E[gamma^(T-1)] of an episode that reaches its goal in T steps.

    Raises:
        ConfigurationError: for a discount that is not stored.

    >>> values = truth(0.995).values
    >>> values["umaze-0"] < values["umaze-10"]
    True
    """
    return read_truth(TASK, gamma=gamma)


def _policies() -> dict[str, Policy]:
    return {**umaze_policies()}


DATASETS: dict[str, Callable[[], minari.MinariDataset]] = {TASK: umaze, **maze2d_d4rl.DATASETS}
"""Name of each dataset and the function that opens it."""

TASKS: dict[str, Task] = {
    TASK: Task(
        datasets=(TASK,),
        policies=_policies,
        truth=truth,
        initial_states=initial_states,
        horizon=HORIZON,
        paper="maze2d-umaze",
    ),
    **maze2d_d4rl.TASKS,
}
"""Name of each task and what its datasets are evaluated with."""

__all__ = ["DATASETS", "DATASET_ID", "TASKS", "UMAZE", "Cell", "Maze", "truth", "umaze"]
