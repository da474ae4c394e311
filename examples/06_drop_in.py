"""An AugmentedDataset in every place that takes a Minari dataset, with an augmenter of your own.

Run it with `python examples/06_drop_in.py`; it works in temporary folders and trains nothing.
"""

import os
import pickle
import tempfile

import minari
import numpy as np

import oat_gym
from oat_gym.checks import check_dataset


def noisier(episode: minari.EpisodeData, rng: np.random.Generator) -> minari.EpisodeData:
    """Return the episode with a little noise on its rewards; the episode is a copy, so it may be changed in place."""
    episode.rewards[:] += rng.normal(scale=0.01, size=len(episode.rewards))
    return episode


def main() -> None:
    """Read, filter, split, extend, pickle, save and check one dataset as Minari's users do."""
    real = oat_gym.domains.load("maze2d-umaze").filter_episodes(lambda episode: episode.id < 20)
    data = oat_gym.AugmentedDataset(real, oat_gym.Function(noisier), factor=3, seed=0)
    print(isinstance(data, minari.MinariDataset), len(data), data.total_steps)

    data.set_seed(1)
    print("sampled", [int(episode.id) for episode in data.sample_episodes(4)])
    print("by generator", [len(episode) for episode in data.iterate_episodes(i for i in (0, 20, 40))])

    long = data.filter_episodes(lambda episode: len(episode) > 100)
    train, test = minari.split_dataset(long, [len(long) - 5, 5], seed=0)
    print("a view of", len(long), "in parts of", len(train), "and", len(test))

    first = data[0]
    data.update_dataset_from_buffer(
        [
            minari.data_collector.EpisodeBuffer(
                observations=first.observations,
                actions=first.actions,
                rewards=first.rewards,
                terminations=first.terminations,
                truncations=first.truncations,
            )
        ]
    )
    print("appended to our own store:", len(data), "episodes; the source still has", len(real))

    twin = pickle.loads(pickle.dumps(data))
    print("a pickle reads the same:", np.array_equal(twin[30].rewards, data[30].rewards))

    saved = long.save("example/maze-noisy-v0", data_format="hdf5")
    print(saved.id, len(saved), next(iter(saved.storage.get_episode_metadata([len(saved) - 1])))["synthetic"])

    print(check_dataset(data, limit=10))  # raises a ConformanceError with a list where a rule is broken


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        os.environ["MINARI_DATASETS_PATH"] = folder
        main()
