"""SmartPrimer's target policies, and the check of on-policy values against what students achieved."""

import doctest

import numpy as np
import pytest
from gymnasium import spaces

from oat_gym import domains, ope
from oat_gym.checks import check_dataset
from oat_gym.domains import tutor_outcomes, tutor_policies, tutoring
from oat_gym.domains.tutor_policies import ConstantPolicy, RecordedPolicy
from oat_gym.errors import ConfigurationError, DatasetNotFoundError, InvalidDataError
from oat_gym.io.writing import DatasetCard, dataset_from_episodes, episode_buffer

COLUMNS = "UserID,Condition,Grade,Complete,Anxiety,Pre,ImprovementAbsolute,ImprovementAdjusted,Engagement"
ROWS = ["45.0,Online A,2.0,Y,10,4,0,0,2", "50.0,Online D,2.0,N,10,3,-1,0,2", "51.0,Online D,3.0,Y,9,2,4,5,3"]


TAUGHT_DIFFERENTLY = (234, 267, 388, 595)
"""Students who were in a state that another of them met when the tutor had changed."""


def write_outcomes(path, rows=ROWS):
    path.write_text("\n".join([COLUMNS, *rows]) + "\n")
    return path


def recorded(tmp_path, *, probabilities, actions, states):
    """A log of one student whose policy is known."""
    probabilities, actions = np.array(probabilities, dtype=float), np.array(actions)
    taken = np.maximum(probabilities[np.arange(len(actions)), actions], tutoring.PROBABILITY_FLOOR)
    buffer = episode_buffer(
        observations=np.array([*states, states[-1]], dtype=float)[:, None],
        actions=actions,
        rewards=np.ones(len(actions)),
        terminations=np.arange(len(actions)) == len(actions) - 1,
        truncations=np.zeros(len(actions), dtype=bool),
        infos={"probabilities": probabilities, "log_prob": np.log(taken)},
    )
    return dataset_from_episodes(
        [buffer],
        directory=tmp_path / "log",
        card=DatasetCard(dataset_id="tests/recorded-v0", description="one student"),
        observation_space=spaces.Box(-10, 10, (1,), np.float64),
        action_space=spaces.Discrete(2),
    )


def test_a_recorded_policy_gives_back_what_was_logged(tmp_path):
    rows = [[0.7, 0.3], [1.0, 0.0], [0.4, 0.6]]
    dataset = recorded(tmp_path, probabilities=rows, actions=[1, 1, 0], states=[0.0, 1.0, 5.0])
    policy = RecordedPolicy.of(dataset)
    states = np.array([[0.0], [1.0], [5.0]])
    expected = [[0.7, 0.3], [0.9995, 0.0005], [0.4, 0.6]]  # an action that was taken had some probability
    np.testing.assert_allclose(policy.probabilities(states), expected)
    np.testing.assert_allclose(policy.log_prob(states, np.array([1, 1, 0])), dataset[0].infos["log_prob"])
    np.testing.assert_allclose(policy.probabilities(np.array([[2.9], [3.1]])), [expected[1], expected[2]])


def test_a_state_recorded_twice_has_the_mean_of_its_probabilities(tmp_path):
    rows = [[0.7, 0.3], [0.5, 0.5]]
    dataset = recorded(tmp_path, probabilities=rows, actions=[0, 1], states=[2.0, 2.0])
    np.testing.assert_allclose(RecordedPolicy.of(dataset).probabilities(np.array([[2.0]])), [[0.6, 0.4]])


def test_broken_policies_are_refused():
    with pytest.raises(InvalidDataError, match="do not agree"):
        RecordedPolicy(np.zeros((2, 3)), np.ones((1, 1)))
    with pytest.raises(ConfigurationError, match="sum"):
        RecordedPolicy(np.zeros((1, 3)), np.array([[0.5, 0.4]]))
    with pytest.raises(ConfigurationError, match="sum"):
        ConstantPolicy((0.5, 0.6))
    rows = ConstantPolicy.mostly(2, n_actions=4, epsilon=0.2).probabilities(np.zeros((3, 8)))
    np.testing.assert_allclose(rows, np.tile([0.05, 0.05, 0.85, 0.05], (3, 1)))


def test_outcomes_are_told_by_condition(tmp_path):
    groups = tutoring.outcomes(write_outcomes(tmp_path / "table.csv"))
    assert {name: group.user_id.tolist() for name, group in groups.items()} == {"control": [45], "rl": [50, 51]}
    assert groups["rl"].returns.tolist() == [-8.0, 5.0]  # who did not finish, and the adjusted gain
    assert groups["rl"].of([51]).gain.tolist() == [4.0]
    with pytest.raises(InvalidDataError, match=r"\[45\] are not in this condition"):
        groups["rl"].of([51, 45])


def test_a_table_that_is_missing_or_another_is_refused(tmp_path):
    with pytest.raises(DatasetNotFoundError, match="OAT_GYM_DATA"):
        tutoring.outcomes(tmp_path)
    (tmp_path / "other.csv").write_text("a,b\n1,2\n")
    with pytest.raises(InvalidDataError, match="not the table of outcomes"):
        tutoring.outcomes(tmp_path / "other.csv")
    with pytest.raises(InvalidDataError, match="could not convert"):
        tutoring.outcomes(write_outcomes(tmp_path / "damaged.csv", [ROWS[0].replace("45.0", "x")]))
    with pytest.raises(InvalidDataError, match="a row that lacks columns"):
        tutoring.outcomes(write_outcomes(tmp_path / "cut.csv", [*ROWS[:-1], ROWS[-1][:8]]))
    with pytest.raises(InvalidDataError, match="no student of the condition 'rl'"):
        tutoring.outcomes(write_outcomes(tmp_path / "half.csv", ROWS[:1]))


@pytest.mark.shared_data
def test_importance_sampling_of_the_logged_policy_is_the_mean_return(shared_data, monkeypatch):
    """Weights are 1 (to rounding) in every step, but for four students in two states where the tutor had changed."""
    monkeypatch.setenv("OAT_GYM_DATA", str(shared_data))
    dataset, policies = domains.load("tutoring-smartprimer"), domains.policies("tutoring-smartprimer")
    check_dataset(dataset.filter_episodes(lambda episode: episode.id < 20))
    plain = ope.ImportanceSampling(kind="trajectory", weighted=False)
    estimators = [plain, ope.ImportanceSampling()]
    same = dataset.filter_episodes(lambda episode: int(episode.infos["user_id"][0]) not in TAUGHT_DIFFERENTLY)
    assert len(same) == 174
    for data, tolerance in ((same, 1e-3), (dataset, 0.1)):
        returns = np.array([episode.rewards.sum() for episode in data])
        options = {"gamma": 1.0, "seeds": 1, "behavior": "logged", "interval": "normal"}
        found = ope.evaluate(data, {"logged": policies["logged"]}, estimators, **options)
        for row in found.rows:
            assert row["value"] == pytest.approx(returns.mean(), abs=tolerance)
    assert list(policies) == ["logged", "dqn", "uniform", *tutoring.ACTIONS]
    states = dataset[0].observations
    for policy in policies.values():
        rows = policy.probabilities(states)
        assert (rows >= 0).all()
        np.testing.assert_allclose(rows.sum(axis=1), 1.0)


@pytest.mark.shared_data
def test_on_policy_values_agree_with_what_students_achieved(shared_data, monkeypatch):
    """The log's mean return is the outcome of its students up to the small rewards for feedback, and the RL group's."""
    monkeypatch.setenv("OAT_GYM_DATA", str(shared_data))
    dataset, groups = domains.load("tutoring-smartprimer"), tutoring.outcomes()
    assert {name: len(group) for name, group in groups.items()} == {"control": 69, "rl": 269}
    returns = np.array([episode.rewards.sum() for episode in dataset])
    students = groups["rl"].of([episode.infos["user_id"][0] for episode in dataset])
    assert len(students) == 178
    np.testing.assert_allclose(returns.mean(), students.returns.mean(), atol=0.2)
    assert np.median(np.abs(returns - students.returns)) < 0.1
    mean, error = tutoring.mean_and_error(groups["rl"].returns)
    assert abs(returns.mean() - mean) < 1.96 * error
    assert set(students.completed[returns < -4]) == {False}


@pytest.mark.shared_data
def test_nobody_knows_the_true_values_of_real_students(shared_data):
    assert domains.task("tutoring-smartprimer").gamma == 0.9
    with pytest.raises(ConfigurationError, match="Nobody knows"):
        domains.truth("tutoring-smartprimer")


@pytest.mark.parametrize("module", [tutor_outcomes, tutor_policies])
def test_examples_in_docstrings(module):
    assert doctest.testmod(module).failed == 0
