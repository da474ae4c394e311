"""A program: to_torchrl or to_d3rlpy checked with the real library, in whatever environment runs it.

    python consumer_checks.py torchrl|d3rlpy FOLDER

The episodes' values code (episode, step), so that a shifted, swapped or empty row is seen. It prints one JSON object
and exits with status 0, or fails with the assertion that did not hold.
"""

import json
import os
import sys
import warnings
from importlib.metadata import version

import minari
import numpy as np
import torch
from gymnasium import spaces
from minari.data_collector import EpisodeBuffer

import oat_gym
from oat_gym.io.consumers import to_d3rlpy, to_torchrl

LENGTHS = (3, 1, 6, 4)


def louder(episode, rng):
    """Add a half to the rewards, so that a synthetic row is known."""
    episode.rewards[:] += 0.5
    return episode


def make_dataset(action_space):
    """Return four episodes that code (episode, step): the even ones terminate, the last one ends with neither flag."""
    buffers = []
    for number, steps in enumerate(LENGTHS):
        codes = 1000.0 * number + np.arange(steps + 1)
        last = np.arange(steps) == steps - 1
        discrete = isinstance(action_space, spaces.Discrete)
        actions = 2 + np.arange(steps) % 3 if discrete else codes[:-1, None].astype(np.float32) + 0.25
        buffers.append(
            EpisodeBuffer(
                observations=np.stack([codes, -codes], axis=1).astype(np.float32),
                actions=actions,
                rewards=codes[:-1],
                terminations=last & (number % 2 == 0),
                truncations=last & (number == 1),
            )
        )
    box = spaces.Box(-np.inf, np.inf, (2,))
    name = f"test/{type(action_space).__name__.lower()}-v0"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return minari.create_dataset_from_buffers(name, buffers, observation_space=box, action_space=action_space)


def check_rows(rows, augmented):
    """Compare every row of a TorchRL buffer with the columns of the dataset."""
    columns = augmented.transitions()
    assert rows.batch_size == torch.Size([augmented.total_steps])
    expected = {
        "observation": columns.observations,
        "action": columns.actions,
        ("next", "observation"): columns.next_observations,
        ("next", "reward"): columns.rewards[:, None],
        "episode": columns.episode,
        "step": columns.step,
        "synthetic": columns.synthetic,
    }
    for key, values in expected.items():
        np.testing.assert_array_equal(rows[key].numpy(), values, err_msg=str(key))
    lengths = np.array(LENGTHS)[columns.episode % 4]
    last = columns.step == lengths - 1
    terminated = last & (columns.episode % 4 % 2 == 0)
    for name, flags in (("terminated", terminated), ("truncated", last & ~terminated), ("done", last)):
        assert rows["next", name].dtype == torch.bool
        assert rows[name].shape == rows["next", name].shape == (len(columns), 1), name
        np.testing.assert_array_equal(rows["next", name][:, 0].numpy(), flags, err_msg=name)
        assert not rows[name].any()
    assert (rows["next", "observation"][:, 0] == rows["observation"][:, 0] + 1).all()


def check_torchrl():
    """Every row, samples, slices, the seed, and torch's global random state."""
    augmented = oat_gym.AugmentedDataset(
        make_dataset(spaces.Box(-np.inf, np.inf, (1,))), oat_gym.Function(louder), count=4
    )
    state = torch.random.get_rng_state()
    buffer = to_torchrl(augmented, batch_size=64, seed=1)
    assert len(buffer) == augmented.total_steps
    check_rows(buffer[:], augmented)
    sample = buffer.sample()
    assert (sample["next", "observation"][:, 0] == sample["observation"][:, 0] + 1).all()
    assert (sample["action"][:, 0] == sample["observation"][:, 0] + 0.25).all()
    assert (sample["next", "reward"][:, 0] == sample["observation"][:, 0] + 0.5 * sample["synthetic"]).all()
    again = to_torchrl(augmented, batch_size=64, seed=1).sample()
    other = to_torchrl(augmented, batch_size=64, seed=2).sample()
    assert torch.equal(again["observation"], sample["observation"])
    assert not torch.equal(other["observation"], sample["observation"])
    slices = to_torchrl(augmented, batch_size=60, slice_length=3, seed=1).sample()
    same_episode = slices["episode"][1:] == slices["episode"][:-1]
    steps_on = slices["step"][1:] == slices["step"][:-1] + 1
    ends = slices["next", "truncated"][:-1, 0] | slices["next", "terminated"][:-1, 0]  # TorchRL ends each slice so
    assert (ends | (same_episode & steps_on)).all()
    assert (slices["next", "observation"][:, 0] == slices["observation"][:, 0] + 1).all()
    assert torch.equal(torch.random.get_rng_state(), state)
    return {"torchrl": version("torchrl"), "tensordict": version("tensordict")}


def check_d3rlpy():
    """Every row of every episode, sampled transitions, discrete actions."""
    augmented = oat_gym.AugmentedDataset(
        make_dataset(spaces.Box(-np.inf, np.inf, (1,))), oat_gym.Function(louder), count=4
    )
    dataset = to_d3rlpy(augmented)
    # d3rlpy keeps no episode without a transition that has a next state: one truncated step has none
    kept = [episode for episode in augmented if len(episode.rewards) > 1 or episode.terminations[-1]]
    assert len(kept) == len(augmented) - 2
    for number, (found, episode) in enumerate(zip(dataset.episodes, kept, strict=True)):
        np.testing.assert_array_equal(found.observations, episode.observations[:-1], err_msg=str(number))
        np.testing.assert_array_equal(found.actions, episode.actions)
        np.testing.assert_array_equal(found.rewards[:, 0], episode.rewards)
        assert found.terminated == bool(episode.terminations[-1])
    np.random.seed(0)  # noqa: NPY002 - d3rlpy samples from NumPy's global state
    batch = dataset.sample_transition_batch(500)
    following = batch.next_observations[:, 0]
    alive = batch.terminals[:, 0] == 0
    np.testing.assert_array_equal(following[alive], batch.observations[alive, 0] + 1)
    np.testing.assert_array_equal(batch.actions[:, 0], batch.observations[:, 0] + 0.25)
    assert alive.any() > 0 < (~alive).sum()
    assert set(batch.rewards[:, 0] - batch.observations[:, 0]) == {0.0, 0.5}
    discrete = to_d3rlpy(make_dataset(spaces.Discrete(3, start=2)))
    assert discrete.dataset_info.action_size == 3
    for found, steps in zip(discrete.episodes, (3, 6, 4), strict=True):
        np.testing.assert_array_equal(found.actions[:, 0], np.arange(steps) % 3)
    return {"d3rlpy": version("d3rlpy")}


if __name__ == "__main__":
    os.environ["MINARI_DATASETS_PATH"] = sys.argv[2]
    result = {"torchrl": check_torchrl, "d3rlpy": check_d3rlpy}[sys.argv[1]]()
    print(json.dumps(result | {"torch": torch.__version__, "minari": version("minari")}))
