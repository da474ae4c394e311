"""Jittering: the noise has the spread that it should, and none is none."""

from collections.abc import Callable

import minari
import numpy as np
import pytest
from gymnasium import spaces

from oat_gym import AugmentedDataset, Jittering, Scaling
from oat_gym.episodes import content_hash
from tests.conftest import install_dataset, walks

MakeDataset = Callable[..., minari.MinariDataset]


def test_noise_is_normal_with_sigma_times_the_spread_of_the_channel(walk_dataset: minari.MinariDataset) -> None:
    data = AugmentedDataset(walk_dataset, Jittering(sigma=0.1), factor=21, seed=0)
    for name, n_channels in (("observations", 2), ("actions", 2), ("rewards", 1)):
        recorded = [getattr(walk_dataset[i], name).reshape(-1, n_channels) for i in range(12)]
        spread = np.concatenate(recorded).astype(float).std(axis=0)
        gaps = np.concatenate(
            [getattr(data[number], name).reshape(-1, n_channels) - recorded[number % 12] for number in range(12, 252)]
        )
        noise = gaps / (0.1 * spread)
        error = 1 / np.sqrt(len(noise))
        assert (np.abs(noise.mean(axis=0)) < 4 * error).all()
        assert (np.abs(noise.std(axis=0) - 1) < 4 * error).all()
        assert np.abs(np.mean(noise[:-1] * noise[1:])) < 5 * error  # each step has its own


@pytest.mark.parametrize("method", [Jittering(sigma=0.0), Scaling(sigma=0.0), Jittering().at_zero_strength])
def test_no_strength_gives_the_source_to_the_last_bit(method: Jittering, make_dataset: MakeDataset) -> None:
    real = make_dataset([3, 7, 1, 5])
    assert content_hash(AugmentedDataset(real, method, factor=2)[4:8]) == content_hash(real)


@pytest.mark.parametrize("method", [Jittering(), Scaling()])
def test_constant_channels_discrete_parts_and_values_out_of_bounds(method: Jittering) -> None:
    buffers = walks(4, 20)
    for buffer in buffers:
        buffer.observations[:, 1] = 0.1  # constant, though its mean is not 0.1 to the last bit
        buffer.actions[:, 0] = 5.0  # outside of the space, and constant
    real = install_dataset("test/constant-v0", buffers, spaces.Box(-0.5, 0.5, (2,)), spaces.Box(-1, 1, (2,)))
    data = AugmentedDataset(real, method, factor=4)
    for number in range(4, 16):
        np.testing.assert_array_equal(data[number].observations[:, 1], np.float32(0.1))
        np.testing.assert_array_equal(data[number].actions[:, 0], 5.0)
        assert np.abs(data[number].observations[:, 0]).max() <= 0.5  # what was changed is clipped
        assert not np.array_equal(data[number].rewards, real[number % 4].rewards)


def test_discrete_parts_stay(make_dataset: MakeDataset) -> None:
    real = make_dataset([5, 9, 6])
    data = AugmentedDataset(real, Jittering(sigma=5.0), factor=2)
    for number in range(3, 6):
        np.testing.assert_array_equal(data[number].observations["mode"], real[number - 3].observations["mode"])
