"""Roll out the DOPE policies in the Adroit environments and store their true values: datasets/truth/adroit-TASK.json.

    python datasets/truth_adroit.py --tasks pen door hammer relocate --episodes 200

Every policy takes its mean action and meets the same resets (seeds 0, 1, ...). Rewards are D4RL's. The rewards of each
policy are kept in --work as soon as they are there, under the versions of the libraries and what the policy does: an
interrupted run goes on where it stopped, and a larger --episodes adds to what exists. It needs the policies' weight
files (OAT_GYM_DATA).
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
import numpy.typing as npt

from oat_gym.cache import fingerprint
from oat_gym.domains.adroit_env import make_vec_env
from oat_gym.domains.adroit_policies import dope_policies
from oat_gym.domains.adroit_rewards import ADROIT
from oat_gym.domains.rollout import roll_out
from oat_gym.domains.truth import installed_versions, stored_truth, write_truth
from oat_gym.ope import MLPPolicy

FloatArray = npt.NDArray[np.float64]

COMMAND = "python datasets/truth_adroit.py --tasks {task} --episodes {episodes}"
NOTE = {
    "pen": (
        "Mean actions, clipped to [-1, 1]; 100 steps, as in D4RL. D4RL ends an episode when the pen drops and the "
        "installed environment does not, so a dropped pen costs 5 a step until the 100th."
    ),
    "door": "Mean actions, clipped to [-1, 1]. {reward}",
    "hammer": "Mean actions, clipped to [-1, 1]. {reward}",
    "relocate": "Mean actions, clipped to [-1, 1]. {reward}",
}
REWARD = (
    "Rewards are D4RL's: the installed environment adds 0.1 x the distance from hand to object where D4RL subtracts it."
)


def rewards_of(name: str, policy: MLPPolicy, *, task: str, episodes: int, num_envs: int, work: Path) -> FloatArray:
    """Return rewards (episodes, horizon) of a policy, those already in `work` read and the others rolled out."""
    path = work / f"{name}-{_key(policy)}.npy"
    have = np.load(path, allow_pickle=False) if path.exists() else np.empty((0, ADROIT[task].horizon))
    if len(have) < episodes:
        start, cpu = len(have), time.process_time()
        envs = make_vec_env(task, min(num_envs, episodes - start))
        made = roll_out(envs, policy, seeds=range(start, episodes), horizon=ADROIT[task].horizon)
        envs.close()
        have = np.concatenate([have, made.rewards])
        partial = path.with_suffix(".part.npy")
        np.save(partial, have)
        partial.replace(path)
        print(f"{name}: episodes {start} to {episodes - 1}, {time.process_time() - cpu:.0f} CPU s", flush=True)
    return have[:episodes]


def _key(policy: MLPPolicy) -> str:
    """Return what tells rewards of other library versions or of other weights apart."""
    observation = np.linspace(-1.0, 1.0, policy.n_observations)[None]
    action = [round(float(number), 5) for number in np.asarray(policy.mean(observation))[0]]
    return fingerprint(versions=installed_versions(), action=action)[:12]


def make_truth(task: str, *, episodes: int, num_envs: int, work: Path, out: Path) -> None:
    """Write the truth file of a task."""
    work.mkdir(parents=True, exist_ok=True)
    rewards = {
        name: rewards_of(name, policy, task=task, episodes=episodes, num_envs=num_envs, work=work)
        for name, policy in dope_policies(task).items()
    }
    stored = stored_truth(
        rewards,
        horizon=ADROIT[task].horizon,
        command=COMMAND.format(task=task, episodes=episodes),
        note=NOTE[task].format(reward=REWARD),
    )
    write_truth(out / f"adroit-{task}.json", stored)
    print(f"wrote {out / f'adroit-{task}.json'}", flush=True)


def main() -> None:
    """Read the command line and make the truth files."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", choices=tuple(ADROIT), default=list(ADROIT))
    parser.add_argument("--episodes", type=int, default=200)
    parser.add_argument("--num-envs", type=int, default=25)
    parser.add_argument("--work", type=Path, default=Path("truth-rewards"), help="folder of rewards already rolled out")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "truth")
    options = parser.parse_args()
    if options.episodes < 2 or options.num_envs < 1:
        parser.error("--episodes must be at least 2 and --num-envs at least 1")
    for task in options.tasks:
        make_truth(task, episodes=options.episodes, num_envs=options.num_envs, work=options.work, out=options.out)


if __name__ == "__main__":
    main()
