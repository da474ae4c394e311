"""Iterating a fitted AugmentedDataset against Minari reading the same episodes from the HDF5 export; and its memory.

    python tests/benchmarks/bench_iterate.py [--episodes 25] [--factor 10] [--repeats 5]

Episodes have 200 steps, 39 and 28 wide, float32. Both sides give `EpisodeData` one by one; medians of repeats, taken
in turn. Memory is the growth of the resident set from factor 10 to 100, against the size of the episodes.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import statistics
import tempfile
import time
import warnings
from collections.abc import Iterable

import minari
import numpy as np
from gymnasium import spaces
from minari.data_collector import EpisodeBuffer

from oat_gym import OAT, AugmentedDataset, MiningConfig
from oat_gym.generation import BehaviorConfig, VAEMDPConfig


def make_source(n: int) -> minari.MinariDataset:
    rng = np.random.default_rng(0)
    buffers = [
        EpisodeBuffer(
            observations=rng.normal(size=(201, 39)).cumsum(axis=0).astype(np.float32),
            actions=rng.normal(size=(200, 28)).astype(np.float32),
            rewards=rng.normal(size=200),
            terminations=np.zeros(200, dtype=bool),
            truncations=np.arange(200) == 199,
        )
        for _ in range(n)
    ]
    box = spaces.Box(-np.inf, np.inf, (39,)), spaces.Box(-np.inf, np.inf, (28,))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return minari.create_dataset_from_buffers(
            "bench/source-v0", buffers, observation_space=box[0], action_space=box[1]
        )


def rate(dataset: Iterable[minari.EpisodeData], n: int) -> float:
    """Return episodes per CPU second."""
    begin = time.process_time()
    count = sum(1 for _ in dataset)
    if count != n:
        raise RuntimeError(f"read {count} episodes, expected {n}")
    return n / (time.process_time() - begin)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=25)
    parser.add_argument("--factor", type=int, default=10)
    parser.add_argument("--repeats", type=int, default=5)
    args = parser.parse_args()
    os.environ["MINARI_DATASETS_PATH"] = tempfile.mkdtemp()
    os.environ["OAT_GYM_CACHE"] = tempfile.mkdtemp()
    config = OAT(
        mining=MiningConfig(n_clusters=3, length=20, init="kmeans"),
        model=VAEMDPConfig(max_updates=20),
        behavior=BehaviorConfig(max_updates=20),
    )
    real = make_source(args.episodes)
    data = AugmentedDataset(real, config, factor=args.factor).fit()
    saved = data.save("bench/export-v0")
    n = len(data)
    ours, theirs = zip(*((rate(data, n), rate(saved, n)) for _ in range(args.repeats)), strict=True)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    many = AugmentedDataset(real, config, factor=100).fit()
    read = sum(episode.observations.nbytes + episode.actions.nbytes for episode in many) / 1e6
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3 - before
    report = {
        "episodes": n,
        "episodes_per_cpu_s": statistics.median(ours),
        "minari_hdf5_episodes_per_cpu_s": statistics.median(theirs),
        "ratio": statistics.median(a / b for a, b in zip(ours, theirs, strict=True)),
        "memory_growth_at_factor_100_mb": grown,
        "episodes_read_at_factor_100_mb": read,
    }
    print(json.dumps(report, indent=1))


if __name__ == "__main__":
    main()
