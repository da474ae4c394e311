"""Per-decision importance sampling, self-normalised and with bootstrap intervals, on very many trajectories.

    python tests/benchmarks/bench_importance.py [--episodes 221700] [--length 100] [--resamples N] [--at-most 10]

Trajectories have 1 to 2 x `--length` - 1 steps of five actions. The time counted is that of `estimate`: importance
ratios, weights, values, replicates and diagnostics, of one policy, without compiling the kernels (one small run
before). The peer is what one writes by hand, a padded array of all trajectories with a loop over the resamples, timed
on `--peer-resamples` of them. Exit status 1 if ours takes more than `--at-most` CPU
seconds (on a machine that does nothing else the wall clock shows less).
"""

from __future__ import annotations

import argparse
import json
import resource
import time
import warnings

import numpy as np
from gymnasium import spaces

from oat_gym.episodes import Transitions
from oat_gym.errors import EstimationWarning
from oat_gym.ope import ImportanceSampling, Logged, PolicySet, Problem, TabularPolicy
from oat_gym.ope._setup import draw_resamples
from oat_gym.spaces import FlatSpace

TARGET, BEHAVIOR = np.array([[0.24, 0.2, 0.2, 0.18, 0.18]]), np.full((1, 5), 0.2)


def make_problem(episodes: int, length: int, resamples: int | None) -> Problem:
    """Return random trajectories of one state."""
    rng = np.random.default_rng(0)
    lengths = rng.integers(1, 2 * length, size=episodes)
    offsets = np.concatenate(([0], np.cumsum(lengths)))
    n = int(offsets[-1])
    actions, zeros = rng.integers(0, 5, size=n), np.zeros(n, dtype=np.int64)
    ends = np.zeros(n, dtype=bool)
    ends[offsets[1:] - 1] = True
    steps = Transitions(
        observations=zeros,
        actions=actions,
        rewards=rng.normal(size=n),
        next_observations=zeros,
        terminated=ends,
        truncated=np.zeros(n, dtype=bool),
        episode=np.repeat(np.arange(episodes), lengths),
        step=np.arange(n) - np.repeat(offsets[:-1], lengths),
        synthetic=np.zeros(n, dtype=bool),
    )
    data = Logged(
        steps=steps,
        flat_observations=FlatSpace.of(spaces.Discrete(1)),
        flat_actions=FlatSpace.of(spaces.Discrete(5)),
        offsets=offsets.astype(np.int64),
        unit=np.arange(episodes),
        synthetic=np.zeros(episodes, dtype=bool),
    )
    log_beta = TabularPolicy(BEHAVIOR).log_prob(zeros, actions)
    return Problem(
        data=data,
        policies=PolicySet.of(TabularPolicy(TARGET)),
        gamma=0.99,
        horizon=None,
        initial=zeros[:1],
        initial_unit=np.zeros(1, dtype=np.int64),
        behavior=lambda seed: log_beta,
        resamples=draw_resamples(episodes, resamples),
    )


def by_hand(problem: Problem, resamples: int) -> tuple[float, np.ndarray]:
    """Return value and replicates by padded arrays and a loop over resamples."""
    data, steps = problem.data, problem.data.steps
    shape = (len(data), int(data.lengths.max()))
    ratio, rewards = np.zeros(shape), np.zeros(shape)
    ratio[steps.episode, steps.step] = problem.target_log_prob()[0] - problem.behavior(0)
    rewards[steps.episode, steps.step] = steps.rewards
    weights = np.exp(np.cumsum(ratio, axis=1))  # ratios of 1 after the end keep the last weight
    powers = problem.gamma ** np.arange(shape[1])

    def estimate(chosen: np.ndarray) -> float:
        w = weights[chosen]
        return float(((w * rewards[chosen]).sum(axis=0) / w.sum(axis=0)) @ powers)

    everything = np.arange(len(data))
    return estimate(everything), np.array(
        [estimate(np.repeat(everything, row.astype(int))) for row in problem.resamples[:resamples]]
    )


def main() -> int:
    """Time both, and print one JSON line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=221_700)
    parser.add_argument("--length", type=int, default=100)
    parser.add_argument("--resamples", type=int, default=None, help="by default as many as `evaluate` draws")
    parser.add_argument("--peer-resamples", type=int, default=3)
    parser.add_argument("--at-most", type=float, default=10.0)
    args = parser.parse_args()
    warnings.simplefilter("ignore", EstimationWarning)
    form = ImportanceSampling()
    form.estimate(make_problem(20, 5, 10), seeds=(0,))
    problem = make_problem(args.episodes, args.length, args.resamples)
    problem.target_log_prob()
    start, cpu = time.perf_counter(), time.process_time()
    got = form.estimate(problem, seeds=(0,))[0]
    wall, cpu = time.perf_counter() - start, time.process_time() - cpu
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    start = time.process_time()
    value, replicates = by_hand(problem, args.peer_resamples)
    theirs = (time.process_time() - start) / (1 + args.peer_resamples) * (1 + len(problem.resamples))
    np.testing.assert_allclose(got.values[0], value, rtol=1e-9)
    np.testing.assert_allclose(got.replicates[0, : args.peer_resamples], replicates, rtol=1e-9)
    print(
        json.dumps(
            {"steps": len(problem.data.steps), "resamples": len(problem.resamples), "wall_s": wall, "cpu_s": cpu}
            | {"peak_gib": peak, "by_hand_cpu_s": theirs, "cpu_ratio": theirs / cpu}
        )
    )
    return 0 if cpu <= args.at_most else 1


if __name__ == "__main__":
    raise SystemExit(main())
