"""FQE for 11 policies against d3rlpy's FQE.fit: CPU time of a policy's gradient step, in one run.

    OAT_GYM_D3RLPY_PYTHON=PYTHON python tests/benchmarks/bench_fqe.py [--updates 2000] [--rounds 3]

PYTHON is an interpreter where `d3rlpy==2.8.1` is installed (it needs another gym than ours). Both sides get random
data of the sizes of door-human: 25 episodes of 268 steps, observations 39 wide and actions 28, minibatches of 256,
two hidden layers of 256, float32, on one thread. Ours trains 11 policies, d3rlpy one. They take turns; the CPU seconds
are of training alone, after a warm-up, and the ratio is that of the medians. `--seeds 3` trains 11 policies x 3 seeds
as well.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
import warnings

POLICIES, EPISODES, STEPS, OBSERVATION, ACTION = 11, 25, 268, 39, 28


def ours(updates: int, seeds: int) -> float:
    """Return the CPU milliseconds of one gradient step of one policy and seed."""
    import numpy as np
    import torch
    from gymnasium import spaces

    from oat_gym.episodes import Transitions
    from oat_gym.errors import EstimationWarning
    from oat_gym.ope import FQE, Logged, PolicySet, Problem
    from oat_gym.spaces import FlatSpace

    class Linear:
        """tanh(s W), deterministic."""

        def __init__(self, seed: int) -> None:
            self.weight = np.random.default_rng(seed).normal(size=(OBSERVATION, ACTION)) / OBSERVATION**0.5

        def mean(self, observations):
            return np.tanh(observations @ self.weight)

        def sample(self, observations, *, rng):
            return self.mean(observations)

        def log_prob(self, observations, actions):
            return np.zeros(len(observations))

    torch.set_num_threads(1)
    rng, n = np.random.default_rng(0), EPISODES * STEPS
    last = np.tile(np.arange(STEPS) == STEPS - 1, EPISODES)
    steps = Transitions(
        observations=rng.normal(size=(n, OBSERVATION)),
        actions=rng.uniform(-1, 1, size=(n, ACTION)),
        rewards=rng.normal(size=n),
        next_observations=rng.normal(size=(n, OBSERVATION)),
        terminated=np.zeros(n, dtype=bool),
        truncated=last,
        episode=np.repeat(np.arange(EPISODES), STEPS),
        step=np.tile(np.arange(STEPS), EPISODES),
        synthetic=np.zeros(n, dtype=bool),
    )
    data = Logged(
        steps=steps,
        flat_observations=FlatSpace.of(spaces.Box(-np.inf, np.inf, (OBSERVATION,))),
        flat_actions=FlatSpace.of(spaces.Box(-1, 1, (ACTION,))),
        offsets=np.arange(EPISODES + 1) * STEPS,
        unit=np.arange(EPISODES),
        synthetic=np.zeros(EPISODES, dtype=bool),
    )
    problem = Problem(
        data=data,
        policies=PolicySet.of([Linear(seed) for seed in range(POLICIES)]),
        gamma=0.995,
        horizon=None,
        initial=steps.observations[::STEPS],
        initial_unit=np.arange(EPISODES),
        behavior=lambda seed: np.zeros(n),
        resamples=np.ones((2, EPISODES)),
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", EstimationWarning)  # random data, few updates
        FQE(updates=20).estimate(problem, seeds=(0,))
        begin = time.process_time()
        FQE(updates=updates).estimate(problem, seeds=tuple(range(seeds)))
    return (time.process_time() - begin) * 1e3 / updates / POLICIES / seeds


def peer(updates: int) -> float:
    """Return the CPU milliseconds of one gradient step of d3rlpy's FQE."""
    import d3rlpy
    import numpy as np
    import torch

    torch.set_num_threads(1)
    rng, n = np.random.default_rng(0), EPISODES * STEPS
    last = np.tile(np.arange(STEPS) == STEPS - 1, EPISODES).astype(np.float32)
    dataset = d3rlpy.dataset.MDPDataset(
        rng.normal(size=(n, OBSERVATION)).astype(np.float32),
        rng.uniform(-1, 1, size=(n, ACTION)).astype(np.float32),
        rng.normal(size=n).astype(np.float32),
        np.zeros(n, dtype=np.float32),
        timeouts=last,
    )
    policy = d3rlpy.algos.TD3Config().create(device="cpu:0")
    policy.build_with_dataset(dataset)
    fqe = d3rlpy.ope.FQE(algo=policy, config=d3rlpy.ope.FQEConfig(batch_size=256), device="cpu:0")
    settings = {
        "show_progress": False,
        "experiment_name": "bench",
        "logger_adapter": d3rlpy.logging.NoopAdapterFactory(),
    }
    fqe.fit(dataset, n_steps=20, n_steps_per_epoch=20, **settings)
    begin = time.process_time()
    fqe.fit(dataset, n_steps=updates, n_steps_per_epoch=updates, **settings)
    return (time.process_time() - begin) * 1e3 / updates


def run(side: str, python: str, updates: int, seeds: int) -> float:
    """Measure one side in a process of its own."""
    environment = os.environ | {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
    if side == "peer":
        environment.pop("PYTHONPATH", None)
    command = [python, __file__, "--side", side, "--updates", str(updates), "--seeds", str(seeds)]
    done = subprocess.run(command, env=environment, check=True, capture_output=True, text=True)
    return float(done.stdout.strip().splitlines()[-1])


def main() -> None:
    """Run both sides in turns and print one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--updates", type=int, default=2000)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--side", choices=("ours", "peer"), help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.side:
        print(ours(args.updates, args.seeds) if args.side == "ours" else peer(args.updates))
        return
    python = os.environ.get("OAT_GYM_D3RLPY_PYTHON")
    if not python:
        parser.error("set OAT_GYM_D3RLPY_PYTHON to an interpreter with d3rlpy==2.8.1")
    times: dict[str, list[float]] = {"ours": [], "peer": []}
    for _ in range(args.rounds):
        times["peer"].append(run("peer", python, args.updates, 1))
        times["ours"].append(run("ours", sys.executable, args.updates, 1))
    middle = {side: statistics.median(values) for side, values in times.items()}
    report: dict[str, object] = {"cpu_ms_a_policy_and_step": middle, "all": times}
    report["ratio"] = middle["peer"] / middle["ours"]
    if args.seeds > 1:
        several = run("ours", sys.executable, args.updates, args.seeds)
        report[f"{args.seeds}_seeds_cost"] = several * args.seeds / middle["ours"]
    print(json.dumps(report, indent=1))


if __name__ == "__main__":
    main()
