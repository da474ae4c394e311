"""The SmartPrimer log against its file, and made-up logs of the same layout."""

import csv
from collections import Counter

import numpy as np
import pytest

from oat_gym.domains import load, tutoring
from oat_gym.errors import InvalidDataError

COLUMNS = ("user_id", "action_number", *tutoring.FEATURES, "action", "reward", "p_hint", "p_nothing", "p_encourage")
COLUMNS = (*COLUMNS, "p_question")


def write_log(path, rows):
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        writer.writerows(rows)


def row(user, number, *, action=0, p=(0.7, 0.1, 0.1, 0.1), **changes):
    """A decision whose features encode (user, number): feature k is -number / 100 - k / 1000."""
    values = {name: -number / 100 - k / 1000 for k, name in enumerate(tutoring.FEATURES)}
    values |= {"user_id": user, "action_number": number, "action": action, "reward": user + number / 100}
    return values | {f"p_{name}": value for name, value in zip(tutoring.ACTIONS, p, strict=True)} | changes


@pytest.mark.shared_data
def test_all_students_and_decisions_are_there(shared_data, monkeypatch):
    monkeypatch.setenv("OAT_GYM_DATA", str(shared_data))
    dataset = load("tutoring-smartprimer")
    with (shared_data / tutoring.FILE).open(newline="") as file:
        log = list(csv.DictReader(file))
    lengths = [len(episode) for episode in dataset]
    assert (len(dataset), dataset.total_steps, min(lengths), max(lengths)) == (178, 859, 1, 28)
    assert sorted(lengths) == sorted(Counter(line["user_id"] for line in log).values())
    by_place = {(int(line["user_id"]), int(line["action_number"])): line for line in log}
    for episode in dataset:
        assert set(np.diff(episode.infos["action_number"])) <= {1}
        for t in range(len(episode)):
            line = by_place.pop((int(episode.infos["user_id"][t]), int(episode.infos["action_number"][t])))
            assert episode.observations[t].tolist() == [float(line[name]) for name in tutoring.FEATURES]
            assert episode.actions[t] == int(line["action"])
            assert episode.rewards[t] == float(line["reward"])
            logged = [float(line[f"p_{name}"]) for name in tutoring.ACTIONS]
            assert episode.infos["probabilities"][t].tolist() == logged
            assert episode.infos["log_prob"][t] == pytest.approx(np.log(max(logged[int(line["action"])], 0.0005)))
    assert not by_place


@pytest.mark.shared_data
def test_the_log_is_a_dataset_in_its_spaces(shared_data):
    dataset = tutoring.smartprimer(shared_data)
    floored = 0
    for episode in dataset:
        assert all(dataset.observation_space.contains(row) for row in episode.observations)
        assert all(dataset.action_space.contains(action) for action in episode.actions)
        assert episode.terminations.tolist() == [False] * (len(episode) - 1) + [True]
        assert not episode.truncations.any()
        assert np.isfinite(episode.infos["log_prob"]).all()
        np.testing.assert_allclose(episode.infos["probabilities"].sum(axis=1), 1.0)
        floored += int((episode.infos["log_prob"] == np.log(tutoring.PROBABILITY_FLOOR)).sum())
    assert floored == 2


def test_values_stay_at_their_student_and_step(tmp_path):
    rows = [row(3, 11), row(1, 7), row(3, 12), row(1, 5), row(1, 6), row(2, 9)]
    write_log(tmp_path / "log.csv", rows)
    dataset = tutoring.smartprimer(tmp_path / "log.csv")
    expected = {1: [5, 6, 7], 2: [9], 3: [11, 12]}
    assert [len(episode) for episode in dataset] == [3, 1, 2]
    for (user, numbers), episode in zip(expected.items(), dataset, strict=True):
        np.testing.assert_allclose(episode.rewards, [user + n / 100 for n in numbers])
        np.testing.assert_allclose(episode.observations[:, 0], [-n / 100 for n in [*numbers, numbers[-1]]])
        np.testing.assert_allclose(episode.observations[:, 7], [-n / 100 - 0.007 for n in [*numbers, numbers[-1]]])


def test_the_probability_of_the_action_taken_is_used(tmp_path):
    rows = [row(1, n, action=n, p=(0.1, 0.2, 0.6995, 0.0005)) for n in range(3)]
    write_log(tmp_path / "log.csv", [*rows, row(1, 3, action=3, p=(0.5, 0.25, 0.25, 0.0))])
    (episode,) = tutoring.smartprimer(tmp_path / "log.csv")
    np.testing.assert_allclose(np.exp(episode.infos["log_prob"]), [0.1, 0.2, 0.6995, tutoring.PROBABILITY_FLOOR])
    assert episode.infos["probabilities"][3].tolist() == [0.5, 0.25, 0.25, 0.0]


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([row(1, 5), row(1, 7)], "goes from action_number=5 to 7"),
        ([row(1, 5), row(1, 5)], "two rows with action_number=5"),
        ([row(1, 5, action=4)], r"has actions \[4\]; expected 0 to 3"),
        ([row(1, 5, reward="")], "not a number"),
        ([row(1, 5, action=1.7)], "the column action must hold whole numbers only"),
        ([row(float("nan"), 5, reward=0.0)], "the column user_id must hold whole numbers only"),
        ([row(1, 5, p=(0.7, 7.0, 0.1, 0.1))], "probabilities of actions outside 0 to 1"),
        ([row(1, 5, pos_norm=2.0)], "are not all in Box"),
        ([row(1, 5, neg_norm="nan")], "'neg_norm' has 1 missing"),
    ],
)
def test_a_damaged_log_is_refused(tmp_path, rows, message):
    write_log(tmp_path / "log.csv", rows)
    with pytest.raises(InvalidDataError, match=message):
        tutoring.smartprimer(tmp_path / "log.csv")


def test_a_log_that_was_cut_in_a_row_is_refused(tmp_path):
    write_log(tmp_path / "log.csv", [row(1, 5), row(1, 6)])
    whole = (tmp_path / "log.csv").read_text()
    (tmp_path / "log.csv").write_text(whole[: len(whole.rstrip()) - 12])
    with pytest.raises(InvalidDataError, match="not a number"):
        tutoring.smartprimer(tmp_path / "log.csv")


def test_missing_columns_are_named(tmp_path):
    (tmp_path / "log.csv").write_text("user_id,action_number\n1,2\n")
    with pytest.raises(InvalidDataError, match=r"lacks the columns .*'grade_norm'"):
        tutoring.smartprimer(tmp_path / "log.csv")
