"""Controllers that walk the shortest path through a maze: the one that made the data, and one without memory."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from oat_gym.domains.maze2d_layout import UMAZE, Maze
from oat_gym.errors import ConfigurationError

FloatArray = npt.NDArray[np.float64]
Observation = dict[str, FloatArray]


@dataclass(frozen=True)
class Planner:
    """Way-points of the shortest path, followed by a PD controller with Gaussian action noise.

    Args:
        position_gain: force for each metre to the way-point.
        velocity_gain: force against each metre a second of velocity.
        noise: standard deviation of the noise on each action entry (before clipping to [-1, 1]).
        reach: a way-point within this many metres is passed.

    Raises:
        ConfigurationError: for a negative noise or reach.
    """

    position_gain: float = 1.6
    velocity_gain: float = 0.3
    noise: float = 0.3
    reach: float = 0.35

    def __post_init__(self) -> None:
        if self.noise < 0 or self.reach < 0:
            raise ConfigurationError(f"noise and reach must not be negative, got {self.noise} and {self.reach}.")

    def waypoints(self, observation: Observation) -> list[FloatArray]:
        """Return the points to visit from the start's cell (left out) to the goal itself."""
        start, goal = UMAZE.cell_of(observation["achieved_goal"]), UMAZE.cell_of(observation["desired_goal"])
        between = UMAZE.shortest_path(start, goal)[1:-1]
        return [*(UMAZE.center(cell) for cell in between), observation["desired_goal"]]

    def action(
        self, observation: Observation, waypoints: list[FloatArray], rng: np.random.Generator
    ) -> npt.NDArray[np.float32]:
        """Return the next action, in [-1, 1]; passed way-points are removed from `waypoints`."""
        position, velocity = observation["observation"][:2], observation["observation"][2:]
        while len(waypoints) > 1 and np.linalg.norm(waypoints[0] - position) < self.reach:
            del waypoints[0]
        force = self.position_gain * (waypoints[0] - position) - self.velocity_gain * velocity
        return np.clip(force + self.noise * rng.standard_normal(2), -1.0, 1.0).astype(np.float32)


def next_points(positions: FloatArray, goals: FloatArray, *, maze: Maze = UMAZE) -> FloatArray:
    """Return the point that each of n positions should head for, (n, 2): the next cell's centre, at last the goal.

    Unlike a `Planner`'s way-points it depends on the present position only, so that a network can learn it.

    Raises:
        ConfigurationError: if a position or goal is in a wall.

    >>> next_points(np.array([[-1.0, 1.0], [0.0, 1.0]]), np.array([[0.9, 1.1], [0.9, 1.1]])).tolist()
    [[0.0, 1.0], [0.9, 1.1]]
    """
    rows: list[FloatArray] = []
    for position, goal in zip(positions, goals, strict=True):
        path = maze.shortest_path(maze.cell_of(position), maze.cell_of(goal))
        rows.append(goal if len(path) <= 2 else maze.center(path[1]))
    return np.stack(rows)


def memoryless_actions(states: FloatArray, goals: FloatArray, *, planner: Planner) -> FloatArray:
    """Return the planner's force without noise, (n, 2) in [-1, 1], towards `next_points`.

    Args:
        states: (n, 4) x, y and velocities.
        goals: (n, 2).
        planner: whose gains to use.

    Raises:
        ConfigurationError: if a position or goal is in a wall.
    """
    error = next_points(states[:, :2], goals) - states[:, :2]
    return np.clip(planner.position_gain * error - planner.velocity_gain * states[:, 2:], -1.0, 1.0)
