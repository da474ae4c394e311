"""Steps per CPU second of the vector environments, episodes' ends and new starts included.

    python tests/benchmarks/bench_envs.py --beds 1000 --steps 400

The target is 100,000 steps a second on one core. `SyncVectorEnv` over the single environment is the peer: the same
trajectories, one patient at a time.
"""

from __future__ import annotations

import argparse
import time

import gymnasium as gym

from oat_gym.envs import SEPSIS_ID, TUTOR_ID, register


def steps_per_second(name: str, beds: int, steps: int, *, mode: str) -> float:
    """Return environment steps per CPU second under random actions, after a first step (compilation)."""
    envs = gym.make_vec(name, num_envs=beds, vectorization_mode=mode)
    envs.reset(seed=0)
    envs.action_space.seed(0)
    actions = [envs.action_space.sample() for _ in range(steps)]
    envs.step(actions[0])
    start = time.process_time()
    for taken in actions:
        envs.step(taken)
    rate = beds * steps / (time.process_time() - start)
    envs.close()
    return rate


def main(arguments: list[str] | None = None) -> dict[str, float]:
    """Measure both environments, print the table, and return steps per CPU second by name."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--beds", type=int, default=1000)
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--peer-steps", type=int, default=40)
    options = parser.parse_args(arguments)
    register()
    found: dict[str, float] = {}
    for name in (SEPSIS_ID, TUTOR_ID):
        found[name] = steps_per_second(name, options.beds, options.steps, mode="vector_entry_point")
        peer = steps_per_second(name, min(options.beds, 16), options.peer_steps, mode="sync")
        print(f"{name}: {found[name]:,.0f} steps/CPU s with {options.beds} at once; SyncVectorEnv {peer:,.0f}")
    return found


if __name__ == "__main__":
    main()
