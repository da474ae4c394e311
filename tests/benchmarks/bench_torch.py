"""to_torch against a DataLoader over MinariDataset with a padding collate function: transitions per second.

    python tests/benchmarks/bench_torch.py [--episodes 300] [--steps 200] [--batch-episodes 16] [--workers 0]

The peer is what Minari's documentation shows: `DataLoader(dataset, batch_size, shuffle=True, collate_fn=...)` whose
collate function turns each part of each episode into a tensor and pads the batch with `pad_sequence`. Both sides give
batches of as many transitions (`--batch-episodes` times `--steps`), read the same dataset, and count one run of whole
epochs after one warm-up batch; to_torch's time to read the dataset is given too. Exit status 1 if the ratio is under
`--at-least`.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import tempfile
import time
import warnings
from pathlib import Path
from typing import Any

import minari
import numpy as np
import torch
from gymnasium import spaces
from minari.data_collector import EpisodeBuffer
from torch.nn.utils.rnn import pad_sequence
from torch.utils.data import DataLoader

from oat_gym.io.torch import to_torch


def make_dataset(episodes: int, steps: int, features: int, actions: int, data_format: str) -> minari.MinariDataset:
    """Random float32 episodes of one length."""
    rng = np.random.default_rng(0)
    buffers = [
        EpisodeBuffer(
            observations=rng.normal(size=(steps + 1, features)).astype(np.float32),
            actions=rng.normal(size=(steps, actions)).astype(np.float32),
            rewards=rng.normal(size=steps),
            terminations=np.zeros(steps, dtype=bool),
            truncations=np.arange(steps) == steps - 1,
        )
        for _ in range(episodes)
    ]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return minari.create_dataset_from_buffers(
            "bench/torch-v0",
            buffers,
            observation_space=spaces.Box(-np.inf, np.inf, (features,)),
            action_space=spaces.Box(-np.inf, np.inf, (actions,)),
            data_format=data_format,
        )


def collate(batch: list[Any]) -> dict[str, torch.Tensor]:
    """Pad the parts of the episodes of a batch to one length."""

    def padded(name: str) -> torch.Tensor:
        return pad_sequence([torch.as_tensor(np.array(getattr(episode, name))) for episode in batch], batch_first=True)

    parts = ("observations", "actions", "rewards", "terminations", "truncations")
    return {"id": torch.tensor([int(episode.id) for episode in batch]), **{name: padded(name) for name in parts}}


def cpu_seconds() -> float:
    """CPU time of this process and of its ended children (the workers of an epoch)."""
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime


def rate(batches: Any, count: Any, *, seconds: float) -> tuple[float, float]:
    """Return (transitions a second, transitions a CPU second) of whole epochs for at least `seconds`."""
    next(iter(batches))
    total, start, cpu = 0, time.perf_counter(), cpu_seconds()
    while time.perf_counter() - start < seconds:
        for batch in batches:
            total += count(batch)
    return total / (time.perf_counter() - start), total / (cpu_seconds() - cpu)


def main() -> int:
    """Run both sides and print one JSON line for each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=300)
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--features", type=int, default=39)
    parser.add_argument("--actions", type=int, default=28)
    parser.add_argument("--batch-episodes", type=int, default=16)
    parser.add_argument("--data-format", choices=("hdf5", "arrow", "parquet"), default="hdf5")
    parser.add_argument("--workers", type=int, default=0, help="worker processes of the peer")
    parser.add_argument("--seconds", type=float, default=3.0, help="least time of each side")
    parser.add_argument("--at-least", type=float, default=10.0)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        os.environ["MINARI_DATASETS_PATH"] = folder
        data = make_dataset(args.episodes, args.steps, args.features, args.actions, args.data_format)
        peer = DataLoader(data, args.batch_episodes, shuffle=True, collate_fn=collate, num_workers=args.workers)
        theirs = rate(peer, lambda batch: batch["rewards"].numel(), seconds=args.seconds)
        print(json.dumps({"loader": "DataLoader over MinariDataset", "per_s": theirs[0], "per_cpu_s": theirs[1]}))
        ratios: list[float] = []
        batch_size = args.batch_episodes * args.steps
        length = min(50, args.steps)
        for name, settings in {
            "transitions": {"batch_size": batch_size},
            "transitions, memory-mapped": {"batch_size": batch_size, "memory_map": Path(folder) / "columns"},
            "transitions, batches of 256": {"batch_size": 256},
            "episodes": {"kind": "episodes", "batch_size": args.batch_episodes},
            "windows": {"kind": "windows", "length": length, "stride": length, "batch_size": batch_size // length},
        }.items():
            start = time.process_time()
            loader = to_torch(data, **settings)
            reading = time.process_time() - start
            ours = rate(loader, lambda batch: int(batch.mask.sum()), seconds=args.seconds)
            ratios.append(ours[0] / theirs[0])
            print(
                json.dumps(
                    {"loader": f"to_torch {name}", "per_s": ours[0], "per_cpu_s": ours[1], "ratio": ratios[-1]}
                    | {"cpu_ratio": ours[1] / theirs[1], "reading_cpu_s": reading, "len": len(loader)}
                )
            )
    return 0 if ratios[0] >= args.at_least else 1


if __name__ == "__main__":
    raise SystemExit(main())
