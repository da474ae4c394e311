"""Minari datasets in a folder of the caller's choice: complete or not at all."""

import doctest
from pathlib import Path

import minari
import numpy as np
import pytest
from gymnasium import spaces

from oat_gym.errors import ConfigurationError, DatasetExistsError, InvalidDataError
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


def test_examples_in_docstrings():
    assert doctest.testmod(writing).failed == 0
