"""Minari to D4RL's HDF5 file and back, without losing a bit.

D4RL's layout holds one array a step, so the Dict observations of the embedded maze dataset are flattened first.
"""

import os
import tempfile
from itertools import islice
from pathlib import Path

import h5py
import numpy as np
from gymnasium import spaces
from minari import MinariDataset

from oat_gym.io.d4rl import read_d4rl, write_d4rl
from oat_gym.io.writing import DatasetCard, dataset_from_episodes, episode_buffer
from oat_gym.recipe import find_dataset
from oat_gym.spaces import FlatSpace


def main() -> None:
    """Flatten, write, look at the file as D4RL's readers do, read, compare."""
    maze = find_dataset("oat_gym/maze2d-umaze-v0")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        os.environ["OAT_GYM_CACHE"] = str(folder / "cache")  # read_d4rl converts into the cache
        flat = flatten(maze, folder / "flat", n_episodes=40)

        path = write_d4rl(flat, folder / "maze2d.hdf5")
        with h5py.File(path) as file:
            rows = {key: item.shape for key, item in file.items() if isinstance(item, h5py.Dataset)}
            print("the file:", rows)
            ends = np.flatnonzero(file["terminals"][:] | file["timeouts"][:])
        print("episodes end at rows", ends[:3], "...")

        again = read_d4rl(path)
        for ours, theirs in zip(again, flat, strict=True):
            for part in ("observations", "actions", "rewards", "terminations", "truncations"):
                left, right = getattr(ours, part), getattr(theirs, part)
                assert left.dtype == right.dtype
                assert np.array_equal(left, right), part
        print(f"{len(again)} episodes and {again.total_steps} steps are the same, to the last bit")


def flatten(data: MinariDataset, folder: Path, *, n_episodes: int) -> MinariDataset:
    """Return the first episodes with each observation as one vector."""
    features = FlatSpace.of(data.observation_space, "observation space")
    episodes = [
        episode_buffer(
            observations=features.flatten(episode.observations),
            actions=episode.actions,
            rewards=episode.rewards,
            terminations=episode.terminations,
            truncations=episode.truncations,
        )
        for episode in islice(data, n_episodes)
    ]
    return dataset_from_episodes(
        episodes,
        directory=folder,
        card=DatasetCard(dataset_id="maze2d/flat-v0", description="the maze dataset, observations as vectors"),
        observation_space=spaces.Box(-np.inf, np.inf, features.flatten(data[0].observations).shape[1:], np.float64),
        action_space=data.action_space,
    )


if __name__ == "__main__":
    main()
