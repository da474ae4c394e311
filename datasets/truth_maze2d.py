"""Roll out the target policies of the U-maze and store their true values: datasets/truth/maze2d-umaze.json.

    python datasets/truth_maze2d.py --task maze2d-umaze --episodes 1000
    python datasets/truth_maze2d.py --task maze2d-umaze-d4rl --episodes 200

Every policy meets the same resets (seeds 0, 1, ...). The policies of maze2d-umaze-d4rl are DOPE's (OAT_GYM_DATA).
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
import numpy.typing as npt
from joblib import Parallel, delayed

from oat_gym import domains
from oat_gym.domains.maze2d_d4rl import open_d4rl_mazes
from oat_gym.domains.maze2d_env import HORIZON, open_mazes
from oat_gym.domains.rollout import roll_out
from oat_gym.domains.truth import stored_truth, write_truth

FloatArray = npt.NDArray[np.float64]

NUM_ENVS = 25
COMMAND = "python datasets/truth_maze2d.py --task {task} --episodes {episodes}"
TASKS = {
    "maze2d-umaze": (
        open_mazes,
        "PointMaze_UMaze-v3 with continuing_task=False: 1 on reaching the goal, which ends it. Actions are drawn.",
    ),
    "maze2d-umaze-d4rl": (
        open_d4rl_mazes,
        "PointMaze's U-maze with the start, fixed goal and reward of D4RL's maze2d-umaze-v1. Mean actions, clipped.",
    ),
}


def rewards_of(task: str, name: str, *, episodes: int, num_envs: int) -> FloatArray:
    """Return the rewards (episodes, horizon) of one policy."""
    cpu, policy = time.process_time(), domains.policies(task)[name]
    with TASKS[task][0](min(num_envs, episodes)) as envs:
        made = roll_out(envs, policy, seeds=range(episodes), horizon=HORIZON)
    cpu = time.process_time() - cpu
    print(f"{name}: mean return {made.rewards.sum(axis=1).mean():.3f}, {cpu:.0f} CPU s", flush=True)
    return made.rewards


def make_truth(task: str, *, episodes: int, num_envs: int, jobs: int, out: Path) -> None:
    """Write the truth file of a task."""
    names = list(domains.policies(task))
    work = (delayed(rewards_of)(task, name, episodes=episodes, num_envs=num_envs) for name in names)
    rewards = dict(zip(names, Parallel(n_jobs=jobs)(work), strict=True))
    command = COMMAND.format(task=task, episodes=episodes)
    command += "" if num_envs == NUM_ENVS else f" --num-envs {num_envs}"
    write_truth(out / f"{task}.json", stored_truth(rewards, horizon=HORIZON, command=command, note=TASKS[task][1]))
    print(f"wrote {out / f'{task}.json'}")


def main() -> None:
    """Read the command line and make the truth files."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", choices=tuple(TASKS), default="maze2d-umaze")
    parser.add_argument("--episodes", type=int, default=1000)
    parser.add_argument("--num-envs", type=int, default=NUM_ENVS)
    parser.add_argument("--jobs", type=int, default=1, help="processes; the result does not depend on it")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "truth")
    options = parser.parse_args()
    if options.episodes < 2 or options.num_envs < 1:
        parser.error("--episodes must be at least 2 and --num-envs at least 1")
    make_truth(options.task, episodes=options.episodes, num_envs=options.num_envs, jobs=options.jobs, out=options.out)


if __name__ == "__main__":
    main()
