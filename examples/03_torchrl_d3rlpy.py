"""Hand an augmented dataset to TorchRL and to d3rlpy, with the right rows in their replay buffers.

    python examples/03_torchrl_d3rlpy.py

Each part runs where its library is installed (`pip install torchrl`, `pip install d3rlpy`) and says so where it is not.
Both libraries have a Minari reader of their own; TorchRL 0.14's gives zeros and d3rlpy 2.8's shifts observations
against actions from the second episode on, so use these functions instead.
"""

import minari
import numpy as np

import oat_gym


def quieter(episode: minari.EpisodeData, rng: np.random.Generator) -> minari.EpisodeData:
    """Return the episode with rewards scaled a little: a stand-in for a real augmenter such as OAT()."""
    episode.rewards[:] *= rng.uniform(0.9, 1.0)
    return episode


def show_torchrl(data: minari.MinariDataset) -> None:
    buffer = oat_gym.to_torchrl(data, batch_size=128, flat=True, seed=0)
    sample = buffer.sample()
    print(
        "TorchRL:",
        len(buffer),
        "rows; a sample has",
        sorted(map(str, sample.keys(include_nested=True, leaves_only=True))),
    )
    slices = oat_gym.to_torchrl(data, batch_size=120, slice_length=10, flat=True, seed=0).sample()
    print("TorchRL: slices of 10 steps of episodes", slices["episode"].unique().tolist())


def show_d3rlpy(data: minari.MinariDataset) -> None:
    dataset = oat_gym.to_d3rlpy(data)
    batch = dataset.sample_transition_batch(128)
    print("d3rlpy:", len(dataset.episodes), "episodes; a batch has observations of", batch.observations.shape)


if __name__ == "__main__":
    augmented = oat_gym.AugmentedDataset("oat_gym/maze2d-umaze-v0", oat_gym.Function(quieter), count=50, seed=0)
    for show in (show_torchrl, show_d3rlpy):
        try:
            show(augmented)
        except ImportError as error:
            print(error)
