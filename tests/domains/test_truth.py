"""Stored truths: written, read and refused; the moments against sums by hand."""

import copy
import json
import pickle
import sys

import numpy as np
import pytest

from oat_gym.domains.truth import GAMMAS, discounted_returns, exact_truth, read_truth, stored_truth, write_truth
from oat_gym.errors import ConfigurationError, DatasetNotFoundError, InvalidDataError

REWARDS = {
    "good": np.array([[1.0, 2.0, 4.0], [3.0, 0.0, 0.0]]),
    "bad": np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
}


@pytest.fixture
def stored(tmp_path, monkeypatch):
    """Return a function that writes a truth file and makes it the one that is read."""

    def store(**changes):
        content = stored_truth(REWARDS, horizon=3, command="make truth", note="toy", **changes)
        write_truth(tmp_path / "truth" / "toy.json", content)
        monkeypatch.setattr(sys.modules["oat_gym.domains.truth"], "embedded_file", lambda relative: tmp_path / relative)
        return content

    return store


def test_discounted_returns_are_the_sums_of_the_definition():
    rng = np.random.default_rng(0)
    rewards = rng.standard_normal((4, 6))
    for gamma in (1.0, 0.9, 0.0):
        expected = [sum(gamma**t * row[t] for t in range(6)) for row in rewards]
        np.testing.assert_allclose(discounted_returns(rewards, gamma), expected)


def test_what_is_written_is_read(stored):
    stored()
    found = read_truth("toy", gamma=0.5 + 0.4)
    returns = {"good": [1 + 0.9 * 2 + 0.81 * 4, 3.0], "bad": [-0.81, 0.9]}
    assert list(found.values) == ["good", "bad"]
    for name, (one, two) in returns.items():
        assert found.values[name] == pytest.approx((one + two) / 2)
        assert found.standard_deviations[name] == pytest.approx(abs(one - two) / 2**0.5)
        assert found.standard_errors[name] == pytest.approx(abs(one - two) / 2)
    assert (found.gamma, found.horizon, found.episodes, found.note) == (0.9, 3, 2, "toy")
    assert {"gymnasium", "mujoco", "python"} <= set(found.versions)


def test_every_usual_discount_is_stored_and_another_is_refused_with_the_command(stored):
    stored()
    for gamma in GAMMAS:
        assert read_truth("toy", gamma=gamma).gamma == gamma
    with pytest.raises(ConfigurationError, match=r"not 0\.5\..*make truth"):
        read_truth("toy", gamma=0.5)


def test_an_integer_discount_is_the_float(stored):
    stored(gammas=(1,))
    assert read_truth("toy", gamma=1).values["good"] == 5.0


def test_a_file_is_plain_json_and_the_same_twice(stored, tmp_path):
    content = stored()
    first = (tmp_path / "truth" / "toy.json").read_bytes()
    stored()
    assert (tmp_path / "truth" / "toy.json").read_bytes() == first
    assert json.loads(first) == content


def test_a_truth_cannot_be_changed(stored):
    stored()
    found = read_truth("toy", gamma=1.0)
    with pytest.raises(TypeError):
        found.values["good"] = 0.0  # type: ignore[index]


@pytest.mark.parametrize(
    "rewards",
    [
        {},
        {"a": np.zeros((2, 3)), "b": np.zeros((3, 3))},
        {"a": np.zeros((1, 3))},
        {"a": np.zeros((2, 4))},
        {"a": np.zeros(3)},
        {"a": np.full((2, 3), np.nan)},
    ],
    ids=["none", "unequal", "one episode", "horizon", "flat", "nan"],
)
def test_rewards_that_are_no_roll_outs_are_refused(rewards):
    with pytest.raises(InvalidDataError):
        stored_truth(rewards, horizon=3, command="")


def test_a_missing_truth_says_so():
    with pytest.raises(DatasetNotFoundError, match="no-such-task"):
        read_truth("no-such-task", gamma=1.0)


def test_exact_values_have_no_error():
    found = exact_truth({"a": 1.5}, gamma=0.9, horizon=None, command="solve")
    assert (found.values["a"], found.standard_errors["a"], found.episodes) == (1.5, 0.0, 0)
    assert np.isnan(found.standard_deviations["a"])


def test_a_truth_goes_to_other_processes_and_is_copied():
    truth = exact_truth({"a": 1.0, "b": 2.0}, gamma=0.9, horizon=5, command="by hand")
    for other in (pickle.loads(pickle.dumps(truth)), copy.deepcopy(truth)):
        assert repr(other) == repr(truth)
        with pytest.raises(TypeError):
            other.values["a"] = 3.0
