"""Build the embedded dataset maze2d-umaze: planner episodes in PointMaze_UMaze-v3, and its picture.

    python datasets/build_maze2d_umaze.py --episodes 250 --seed 0 --out datasets/maze2d-umaze

A planner of ours walks the shortest path over the maze's free cells; a PD controller with action noise follows the
way-points. Starts and goals are the environment's random ones. Episodes end in the goal (terminated) or at 300 steps
(truncated). The same seed and library versions give the same bytes.
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import gymnasium_robotics
import h5py
import numpy as np
import numpy.typing as npt
from minari.data_collector import EpisodeBuffer

from oat_gym import plots
from oat_gym.domains.maze2d import DATASET_ID, UMAZE
from oat_gym.io.writing import DatasetCard, dataset_from_episodes

FloatArray = npt.NDArray[np.float64]
Observation = dict[str, FloatArray]

MAIN_FILE = "main_data.hdf5"
OLDEST_MINARI = "0.5.3"  # a Minari refuses data that says it is from a newer one; the layout is that of 0.5.3
EXPERT_RETURN = 1.0  # each episode that reaches its goal earns exactly 1
DESCRIPTION = (
    "Episodes of a scripted planner in PointMaze_UMaze-v3 with continuing_task=False: random starts and goals, "
    "shortest path over the maze's cells, PD control to its way-points, Gaussian action noise. Reward 1 on reaching "
    "the goal, which terminates the episode; 300 steps truncate it. Made by oat_gym, not by D4RL."
)


@dataclass(frozen=True)
class Planner:
    """Way-points of the shortest path, followed by a PD controller with Gaussian action noise.

    Args:
        position_gain: force for each metre to the way-point.
        velocity_gain: force against each metre a second of velocity.
        noise: standard deviation of the noise on each action entry (before clipping to [-1, 1]).
        reach: a way-point within this many metres is passed.
    """

    position_gain: float = 1.6
    velocity_gain: float = 0.3
    noise: float = 0.3
    reach: float = 0.35

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


@contextmanager
def open_maze() -> Iterator[gym.Env[Any, Any]]:
    """Open the environment, and remove the XML file that it leaves in the temporary folder."""
    gym.register_envs(gymnasium_robotics)
    env = gym.make("PointMaze_UMaze-v3", continuing_task=False)
    try:
        yield env
    finally:
        model_file = Path(env.unwrapped.tmp_xml_file_path)  # type: ignore[attr-defined]
        env.close()
        model_file.unlink(missing_ok=True)


def record_episode(env: gym.Env[Any, Any], planner: Planner, *, seed: int) -> EpisodeBuffer:
    """Return one episode. `env.reset(seed=seed)` gives its start again; the noise is drawn from the same seed."""
    rng = np.random.default_rng([seed, 1])
    observation, info = env.reset(seed=seed)
    waypoints = planner.waypoints(observation)
    observations, infos = [observation], [info["success"]]
    actions, rewards, ends = [], [], []
    while not ends or not any(ends[-1]):
        actions.append(planner.action(observation, waypoints, rng))
        observation, reward, terminated, truncated, info = env.step(actions[-1])
        observations.append(observation)
        infos.append(info["success"])
        rewards.append(float(reward))
        ends.append((terminated, truncated and not terminated))
    return EpisodeBuffer(
        seed=seed,
        observations={key: np.stack([row[key] for row in observations]) for key in env.observation_space.spaces},
        actions=np.stack(actions),
        rewards=np.array(rewards),
        terminations=np.array([end[0] for end in ends]),
        truncations=np.array([end[1] for end in ends]),
        infos={"success": np.array(infos)},
    )


def random_return(env: gym.Env[Any, Any], *, episodes: int) -> float:
    """Return the mean return of uniformly random actions, Minari's lower reference score."""
    env.action_space.seed(0)
    total = 0.0
    for seed in range(episodes):
        env.reset(seed=seed)
        done = False
        while not done:
            _, reward, terminated, truncated, _ = env.step(env.action_space.sample())
            total += float(reward)
            done = terminated or truncated
    return total / episodes


def compact(source: Path, target: Path) -> None:
    """Copy an HDF5 file with contiguous arrays.

    Minari's writer makes every array resizable, which costs about 3 kB each: 7.6 MB for 250 episodes instead of 2.9.
    Minari reads both; only appending steps *to one of these episodes* needs its own layout.
    """

    def copy(old: h5py.Group, new: h5py.Group) -> None:
        new.attrs.update(old.attrs)
        for name, item in old.items():
            if isinstance(item, h5py.Group):
                copy(item, new.create_group(name))
            else:
                new.create_dataset(name, data=item[()])

    with h5py.File(source, "r") as old, h5py.File(target, "w", track_order=True) as new:
        copy(old, new)


def build(out: Path, *, episodes: int, seed: int, reference_episodes: int = 100) -> None:
    """Write `out/data` (the Minari dataset) and `out/trajectories.png`, in place of what was there."""
    seeds = np.random.SeedSequence(seed).generate_state(episodes)
    with open_maze() as env, tempfile.TemporaryDirectory() as temporary:
        recorded = [record_episode(env, Planner(), seed=int(value)) for value in seeds]
        extra = {
            "ref_min_score": random_return(env, episodes=reference_episodes),
            "ref_max_score": EXPERT_RETURN,
            "num_episodes_average_score": reference_episodes,
            "minari_version": OLDEST_MINARI,
        }
        storage = dataset_from_episodes(
            recorded,
            directory=Path(temporary) / "dataset",
            card=DatasetCard(
                dataset_id=DATASET_ID,
                description=DESCRIPTION,
                author="The oat_gym developers",
                algorithm_name="shortest path and noisy PD control",
                env_spec=env.spec,
                eval_env_spec=env.spec,
                requirements=("gymnasium-robotics>=1.3", "mujoco>=3.1"),
                extra=extra,
            ),
            observation_space=env.observation_space,
            action_space=env.action_space,
        ).storage
        data = Path(temporary) / "dataset" / "data"
        compact(data / MAIN_FILE, Path(temporary) / MAIN_FILE)
        (Path(temporary) / MAIN_FILE).replace(data / MAIN_FILE)
        storage.update_metadata({"dataset_size": storage.get_size()})
        out.mkdir(parents=True, exist_ok=True)
        shutil.rmtree(out / "data", ignore_errors=True)
        shutil.copytree(data, out / "data")
    positions = [episode.observations["observation"][:, :2] for episode in recorded]  # type: ignore[index]
    plots.maze_figure(positions, maze=UMAZE.walls(), path=out / "trajectories.png")


def main() -> None:
    """Read the command line and build."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=250)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "maze2d-umaze")
    options = parser.parse_args()
    if options.episodes < 1:
        parser.error(f"--episodes must be at least 1, got {options.episodes}")
    build(options.out, episodes=options.episodes, seed=options.seed)
    print(f"wrote {options.episodes} episodes to {options.out}")


if __name__ == "__main__":
    main()
