"""The human door demonstrations against their file, and made-up files of the same layout."""

import json

import numpy as np
import pytest

from oat_gym.domains import adroit, load
from oat_gym.errors import InvalidDataError


@pytest.mark.shared_data
def test_the_demonstrations_are_those_of_the_file(shared_data, monkeypatch):
    monkeypatch.setenv("OAT_GYM_DATA", str(shared_data))
    dataset = load("adroit-door-human")
    with np.load(shared_data / adroit.FILE, allow_pickle=False) as file:
        lengths, observations, actions, rewards = (
            file[key] for key in ("lengths", "observations", "actions", "rewards")
        )
    steps = [len(episode) for episode in dataset]
    assert steps == list(lengths - 1)
    assert (len(steps), min(steps), max(steps), dataset.total_steps) == (25, 222, 299, 6729 - 25)
    start = 0
    for episode, rows in zip(dataset, lengths, strict=True):
        here = slice(start, start + rows)
        np.testing.assert_array_equal(episode.observations, observations[here])
        np.testing.assert_array_equal(episode.infos["raw_action"], actions[here][:-1])
        np.testing.assert_array_equal(episode.actions, np.clip(actions[here][:-1], -1, 1))
        np.testing.assert_array_equal(episode.rewards, rewards[here][:-1])
        assert not episode.terminations.any()
        assert episode.truncations.tolist() == [False] * (rows - 2) + [True]
        start += rows
    assert any((np.abs(e.infos["raw_action"]) > 1).any() for e in dataset), "nothing was clipped: a weak test"


@pytest.mark.shared_data
def test_the_spaces_are_the_environments(shared_data, monkeypatch):
    monkeypatch.setenv("OAT_GYM_DATA", str(shared_data))
    dataset = load("adroit-door-human")
    env = dataset.recover_environment(eval_env=True)
    assert dataset.observation_space == env.observation_space
    assert dataset.action_space == env.action_space
    assert (env.spec.id, env.spec.max_episode_steps) == ("AdroitHandDoor-v1", 200)
    assert dataset.env_spec.max_episode_steps == 300
    env.close()
    assert all(dataset.action_space.contains(action) for episode in dataset for action in episode.actions)


def write_demonstrations(path, rows, **changes):
    """Rows encode (episode, row): observation 100 e + t in every feature, action e + t / 10, reward the same."""
    number = np.repeat(np.arange(len(rows)), rows)
    row = np.concatenate([np.arange(length) for length in rows])
    arrays = {
        "observations": np.repeat((100 * number + row)[:, None], 39, axis=1).astype(np.float32),
        "actions": np.repeat((number + row / 10)[:, None], 28, axis=1).astype(np.float32),
        "rewards": (number + row / 10).astype(np.float32),
        "lengths": np.array(rows),
    }
    np.savez(path, **{key: value for key, value in (arrays | changes).items() if value is not None})


def test_values_stay_at_their_episode_and_step(tmp_path):
    write_demonstrations(tmp_path / "demos.npz", [3, 5, 2])
    dataset = adroit.door_human(tmp_path / "demos.npz")
    assert [len(episode) for episode in dataset] == [2, 4, 1]
    for number, episode in enumerate(dataset):
        steps = np.arange(len(episode))
        assert episode.observations[:, 7].tolist() == [100 * number + t for t in range(len(episode) + 1)]
        np.testing.assert_allclose(episode.infos["raw_action"][:, 3], number + steps / 10, rtol=1e-6)
        np.testing.assert_allclose(episode.actions[:, 3], np.minimum(number + steps / 10, 1), rtol=1e-6)


def test_a_file_of_another_layout_is_refused(tmp_path):
    write_demonstrations(tmp_path / "a.npz", [3, 4], lengths=None)
    with pytest.raises(InvalidDataError, match=r"lacks the arrays \['lengths'\]"):
        adroit.door_human(tmp_path / "a.npz")
    write_demonstrations(tmp_path / "b.npz", [3, 4], lengths=np.array([3, 3]))
    with pytest.raises(InvalidDataError, match="lengths sum to 6, and there are 7 observations"):
        adroit.door_human(tmp_path / "b.npz")


def test_pickles_are_never_loaded(tmp_path):
    write_demonstrations(tmp_path / "c.npz", [3, 4], rewards=np.array([{}, []] * 3 + [1], dtype=object))
    with pytest.raises(ValueError, match="allow_pickle=False"):
        adroit.door_human(tmp_path / "c.npz")


def test_the_second_load_reads_the_first_conversion(tmp_path):
    write_demonstrations(tmp_path / "demos.npz", [3, 4])
    first, second = (adroit.door_human(tmp_path / "demos.npz") for _ in range(2))
    assert first.storage.data_path == second.storage.data_path
    metadata = json.loads((first.storage.data_path / "metadata.json").read_text())
    assert metadata["dataset_id"] == "oat_gym/door-human-v0"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["demos.npz"], "nothing is written beside the source"
