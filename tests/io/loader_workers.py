"""A program: the batches of a plain torch DataLoader over an AugmentedDataset, by start method and worker count.

    python loader_workers.py FOLDER

It makes a small dataset in FOLDER, augments it, and prints one JSON object: for each "method/workers" the digest of all
batches of one shuffled epoch. It is a program of its own since spawned workers import the main module.
"""

import hashlib
import json
import os
import sys
import warnings

import minari
import numpy as np
import torch
from gymnasium import spaces
from minari.data_collector import EpisodeBuffer
from torch.utils.data import DataLoader

import oat_gym


def noisy(episode, rng):
    """Add noise of this variation's own to the actions."""
    episode.actions[:] += rng.normal(size=episode.actions.shape).astype(np.float32)
    return episode


def collate(episodes):
    """Join episodes without padding: their numbers, lengths and values."""
    return {
        "id": torch.tensor([int(episode.id) for episode in episodes]),
        "length": torch.tensor([len(episode.rewards) for episode in episodes]),
        "observations": torch.from_numpy(np.concatenate([episode.observations for episode in episodes])),
        "actions": torch.from_numpy(np.concatenate([episode.actions for episode in episodes])),
        "rewards": torch.from_numpy(np.concatenate([episode.rewards for episode in episodes])),
    }


def make_source():
    """Return seven value-coded episodes of unequal length."""
    buffers = []
    for number, steps in enumerate((3, 1, 6, 2, 5, 4, 8)):
        codes = 100.0 * number + np.arange(steps + 1)
        buffers.append(
            EpisodeBuffer(
                observations=np.stack([codes, -codes], axis=1).astype(np.float32),
                actions=codes[:-1, None].astype(np.float32),
                rewards=codes[:-1],
                terminations=np.zeros(steps, dtype=bool),
                truncations=np.arange(steps) == steps - 1,
            )
        )
    box = spaces.Box(-np.inf, np.inf, (2,))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return minari.create_dataset_from_buffers(
            "test/workers-v0", buffers, observation_space=box, action_space=spaces.Box(-np.inf, np.inf, (1,))
        )


def digest_of(data, *, method, workers):
    """Return the SHA-256 of every batch of one epoch."""
    loader = DataLoader(
        data,
        batch_size=4,
        shuffle=True,
        generator=torch.Generator().manual_seed(7),
        num_workers=workers,
        multiprocessing_context=method if workers else None,
        collate_fn=collate,
    )
    digest = hashlib.sha256()
    for batch in loader:
        for name in sorted(batch):
            digest.update(batch[name].numpy().tobytes())
    return digest.hexdigest()


if __name__ == "__main__":
    os.environ["MINARI_DATASETS_PATH"] = sys.argv[1]
    augmented = oat_gym.AugmentedDataset(make_source(), oat_gym.Function(noisy), count=14, seed=3)
    # Not a byte of the source is in memory here: every worker opens the HDF5 file itself.
    runs = [("fork", 0), ("fork", 2), ("fork", 4), ("spawn", 2), ("spawn", 4)]
    found = {f"{method}/{workers}": digest_of(augmented, method=method, workers=workers) for method, workers in runs}
    other = oat_gym.AugmentedDataset(augmented.source, oat_gym.Function(noisy), count=14, seed=4)
    found["other seed"] = digest_of(other, method="fork", workers=0)
    json.dump(found, sys.stdout)
