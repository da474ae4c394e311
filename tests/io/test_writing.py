"""Minari datasets in a folder of the caller's choice: complete or not at all."""

import doctest
import errno
from pathlib import Path

import minari
import numpy as np
import pytest
from gymnasium import spaces

from oat_gym import _ids
from oat_gym.errors import ConfigurationError, DatasetExistsError, InvalidDataError, SaveError
from oat_gym.io import writing
from oat_gym.io.writing import DatasetCard, dataset_from_episodes, episode_buffer

CARD = DatasetCard(dataset_id="tests/made-up-v0", description="made up", extra={"note": 7})
SPACES = {
    "observation_space": spaces.Dict(a=spaces.Box(0, 1000, (2,), np.float64), b=spaces.Discrete(5)),
    "action_space": spaces.Box(-1, 1, (1,), np.float32),
}


def make_episode(number, steps, **changes):
    codes = 100.0 * number + np.arange(steps + 1)
    parts = {
        "observations": {"a": np.stack([codes, codes], axis=1), "b": np.arange(steps + 1) % 5},
        "actions": np.full((steps, 1), number / 10, dtype=np.float32),
        "rewards": codes[:steps],
        "terminations": np.zeros(steps, dtype=bool),
        "truncations": np.arange(steps) == steps - 1,
        "infos": {"code": codes[:steps]},
    }
    return episode_buffer(**(parts | changes))


def test_episodes_come_back_as_they_went_in(tmp_path):
    lengths = [3, 1, 6]
    dataset = dataset_from_episodes(
        [make_episode(i, length) for i, length in enumerate(lengths)],
        directory=tmp_path / "nested" / "set",
        card=CARD,
        **SPACES,
    )
    again = minari.MinariDataset(tmp_path / "nested" / "set" / "data")
    for opened in (dataset, again):
        assert [len(episode) for episode in opened] == lengths
        for number, episode in enumerate(opened):
            expected = make_episode(number, lengths[number])
            np.testing.assert_array_equal(episode.observations["a"], expected.observations["a"])
            np.testing.assert_array_equal(episode.observations["b"], expected.observations["b"])
            np.testing.assert_array_equal(episode.actions, expected.actions)
            np.testing.assert_array_equal(episode.infos["code"], expected.infos["code"])
    metadata = again.storage.metadata
    assert (metadata["dataset_id"], metadata["description"], metadata["note"]) == ("tests/made-up-v0", "made up", 7)
    assert again.observation_space == SPACES["observation_space"]


def test_an_existing_folder_is_left_as_it_is(tmp_path):
    (tmp_path / "set").mkdir()
    (tmp_path / "set" / "precious").write_text("data")
    with pytest.raises(DatasetExistsError, match="already there"):
        dataset_from_episodes([make_episode(0, 2)], directory=tmp_path / "set", card=CARD, **SPACES)
    assert [path.name for path in tmp_path.rglob("*")] == ["set", "precious"]


def test_a_failed_write_leaves_nothing(tmp_path, monkeypatch):
    ragged = make_episode(0, 2, infos={"code": object()})
    with pytest.raises(TypeError):
        dataset_from_episodes([ragged], directory=tmp_path / "set", card=CARD, **SPACES)
    assert not list(tmp_path.iterdir())


def test_a_relative_directory_is_taken(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    dataset = dataset_from_episodes([make_episode(0, 2)], directory="set", card=CARD, **SPACES)
    assert dataset.storage.data_path == tmp_path / "set" / "data"
    with pytest.raises(DatasetExistsError, match="already there"):
        dataset_from_episodes([make_episode(0, 2)], directory="set", card=CARD, **SPACES)


def test_where_nothing_can_be_written_it_is_said(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    with pytest.raises(SaveError, match=r"could not be written to .*file/set .*give a directory"):
        dataset_from_episodes([make_episode(0, 2)], directory=tmp_path / "file" / "set", card=CARD, **SPACES)

    def full(self, target):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "replace", full)
    with pytest.raises(SaveError, match=r"No space left on device\); nothing of it was left"):
        dataset_from_episodes([make_episode(0, 2)], directory=tmp_path / "set", card=CARD, **SPACES)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def discrete(values, space=None):
    return dataset_from_episodes(
        [make_episode(0, len(values), actions=values)],
        directory="set",
        card=CARD,
        observation_space=SPACES["observation_space"],
        action_space=space or spaces.Discrete(2),
    )


@pytest.mark.parametrize(
    ("actions", "space"),
    [
        (np.array([True, False, True]), spaces.Discrete(2)),
        (np.array([1.0, 0.0, 1.0]), spaces.Discrete(2)),
        (np.array([[1.0], [0.0], [1.0]], np.float32), spaces.MultiDiscrete([2])),
    ],
)
def test_booleans_and_whole_floats_become_the_integers_of_the_space(tmp_path, monkeypatch, actions, space):
    monkeypatch.chdir(tmp_path)
    before = actions.copy()
    stored = discrete(actions, space)[0].actions
    assert stored.dtype.kind == "i"
    assert stored.ravel().tolist() == [1, 0, 1]
    np.testing.assert_array_equal(actions, before)


def test_observations_that_are_codes_become_integers_too(tmp_path):
    codes = {"a": np.zeros((3, 2)), "b": np.array([4.0, 0.0, 2.0])}
    episode = make_episode(0, 2, observations=codes)
    stored = dataset_from_episodes([episode], directory=tmp_path / "set", card=CARD, **SPACES)[0].observations["b"]
    assert (stored.dtype.kind, stored.tolist()) == ("i", [4, 0, 2])


@pytest.mark.parametrize(
    ("actions", "message"),
    [
        (np.array([1.0, 0.5]), r"episode 0 are of dtype float64, the first that is no integer 0.5, and Discrete\(2\)"),
        (np.array([1.0, np.inf]), "dtype float64, the first that is no integer inf"),
        (np.array(["a", "b"]), "are of dtype <U1, the first that is no integer a"),
        (np.array([1.0, 2.0]), r"are not all in Discrete\(2\)"),
    ],
)
def test_other_values_of_a_discrete_space_are_named_with_their_dtype(tmp_path, monkeypatch, actions, message):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InvalidDataError, match=message):
        discrete(actions)


def test_what_is_no_episode_is_named_by_its_type(tmp_path):
    with pytest.raises(ConfigurationError, match=r"^Episode 0 is a dict; expected an EpisodeBuffer: .{,130}$"):
        dataset_from_episodes([{"name": "J. Doe"}], directory=tmp_path / "set", card=CARD, **SPACES)


def test_losing_a_race_leaves_the_winner(tmp_path, monkeypatch):
    replace = Path.replace

    def slow(self, target):
        (target / "data").mkdir(parents=True)
        return replace(self, target)

    monkeypatch.setattr(Path, "replace", slow)
    with pytest.raises(DatasetExistsError, match="appeared while"):
        dataset_from_episodes([make_episode(0, 2)], directory=tmp_path / "set", card=CARD, **SPACES)
    assert [path.name for path in tmp_path.iterdir()] == ["set"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"observations": {"a": np.zeros((3, 2)), "b": np.zeros(4, dtype=int)}}, r"observations\['a'\], expected 4"),
        ({"actions": np.zeros((4, 1), dtype=np.float32)}, "4 actions"),
        ({"terminations": np.zeros(2, dtype=bool)}, "2 terminations"),
        ({"actions": np.full((3, 1), 1.01, dtype=np.float32)}, "actions of episode 1 are not all in Box"),
        ({"observations": {"a": np.full((4, 2), np.nan), "b": np.zeros(4, dtype=int)}}, r"1\['a'\] are not all"),
        (
            {"observations": {"a": np.zeros((4, 3)), "b": np.zeros(4, dtype=int)}},
            r"observations\['a'\] of shape \(3,\) a step",
        ),
        ({"observations": {"a": np.zeros((4, 2)), "b": np.full(4, 5)}}, r"1\['b'\] are not all in Discrete"),
        ({"rewards": np.zeros(0)}, "no steps"),
    ],
)
def test_episodes_that_break_the_rules_are_refused(tmp_path, changes, message):
    with pytest.raises(InvalidDataError, match=message):
        dataset_from_episodes(
            [make_episode(0, 2), make_episode(1, 3, **changes)], directory=tmp_path / "set", card=CARD, **SPACES
        )
    assert not list(tmp_path.iterdir())


def test_no_episodes_and_no_version_are_refused(tmp_path):
    with pytest.raises(InvalidDataError, match="No episodes"):
        dataset_from_episodes([], directory=tmp_path / "set", card=CARD, **SPACES)
    for name in ("unversioned", "two words-v0", ""):
        with pytest.raises(ConfigurationError, match="not a Minari id"):
            DatasetCard(dataset_id=name, description="")
    with pytest.raises(ConfigurationError, match="two characters or more in the namespace, and 'x' has one"):
        DatasetCard(dataset_id="x/log-v0", description="")


def test_examples_in_docstrings():
    assert doctest.testmod(writing).failed == doctest.testmod(_ids).failed == 0
