"""The simulated tutoring log, its target policies and their true values."""

import doctest
import importlib.util
import re
from pathlib import Path

import numpy as np
import pytest

from oat_gym import domains, ope
from oat_gym.checks import check_dataset
from oat_gym.domains import tutor_sim
from oat_gym.envs.tutor import FEATURES, TutorEnv

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("OAT_GYM_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield domains.load("tutor-sim-178")


def card_script():
    spec = importlib.util.spec_from_file_location("build_tutoring", ROOT / "datasets" / "build_tutoring.py")
    module = importlib.util.module_from_spec(spec)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(__import__("sys").modules, "build_tutoring", module)  # dataclasses look their module up
        spec.loader.exec_module(module)
    return module


def test_the_log_is_the_expert_policys(small):
    assert (len(small), small.total_steps, small.id) == (178, 178 * 12, "oat_gym/tutor-sim-178-v0")
    check_dataset(small.filter_episodes(lambda episode: episode.id < 10))
    taken = np.concatenate([episode.actions for episode in small])
    np.testing.assert_allclose(np.bincount(taken) / len(taken), 1 / 3, atol=4 * np.sqrt(2 / 9 / len(taken)))
    clock = FEATURES.index("session_seconds")
    for episode in small:
        np.testing.assert_allclose(episode.infos["log_prob"], -np.log(3))
        np.testing.assert_array_equal(episode.infos["time"], episode.observations[:-1, clock])  # when it was decided
        assert episode.terminations.tolist() == [False] * 11 + [True]
        assert not episode.rewards[:-1].any()


def test_an_episode_can_be_lived_again(small):
    """The recorded seed and actions give the recorded episode in the registered environment."""
    (metadata,) = small.storage.get_episode_metadata([5])
    (episode,) = small.iterate_episodes([5])
    env = TutorEnv()
    seen = [env.reset(seed=int(metadata["seed"]))[0]]
    for action in episode.actions:
        observation, reward, *_ = env.step(int(action))
        seen.append(observation)
    np.testing.assert_array_equal(np.stack(seen), episode.observations)
    assert reward == episode.rewards[-1]
    assert isinstance(small.recover_environment().unwrapped, TutorEnv)


def test_it_builds_again_to_the_same_bytes_and_another_seed_to_others(tmp_path):
    def build(name, seed):
        tutor_sim._write(6, seed, tmp_path / name)
        return {path.name: path.read_bytes() for path in sorted((tmp_path / name).rglob("*")) if path.is_file()}

    first = build("one", 0)
    assert set(first) == {"main_data.hdf5", "metadata.json"}
    assert build("two", 0) == first
    assert build("three", 1)["main_data.hdf5"] != first["main_data.hdf5"]


def test_students_are_the_same_whatever_the_policy():
    policies = domains.policies("tutor-sim")
    starts = [
        tutor_sim.roll_outs(policies[name], episodes=20, seed=4, record=tutor_sim.Recording()).episodes
        for name in ("expert", "dqn-1e-3")
    ]
    for one, two in zip(*starts, strict=True):
        np.testing.assert_array_equal(one.observations[0], two.observations[0])


def test_initial_states_of_two_seeds_are_of_different_students():
    first, again, other = (domains.initial_states("tutor-sim", count=20, seed=seed) for seed in (0, 0, 1))
    np.testing.assert_array_equal(first, again)
    assert {row.tobytes() for row in first}.isdisjoint(row.tobytes() for row in other)


def test_there_are_the_papers_four_policies():
    policies = domains.policies("tutor-sim")
    states = domains.initial_states("tutor-sim", count=50, seed=3)
    assert states.shape == (50, 142)
    assert list(policies) == ["expert", "dqn-1e-3", "dqn-1e-4", "dqn-1e-5"]
    assert (policies["expert"].probabilities(states) == 1 / 3).all()
    for name in list(policies)[1:]:
        rows = policies[name].probabilities(states)
        np.testing.assert_allclose(np.sort(rows, axis=1), np.tile([0.05 / 3, 0.05 / 3, 1 - 0.1 / 3], (50, 1)))


def test_true_values_hold_in_fresh_roll_outs_and_differ():
    truth = domains.truth("tutor-sim")
    assert (truth.gamma, truth.horizon) == (0.9, 12)
    assert truth.episodes >= 1000
    for name, policy in domains.policies("tutor-sim").items():
        gains = tutor_sim.roll_outs(policy, episodes=1500, seed=99).rewards
        assert not gains[:, :-1].any()
        values = gains[:, -1] * 0.9**11
        error = np.hypot(truth.standard_errors[name], values.std(ddof=1) / np.sqrt(len(values)))
        assert abs(values.mean() - truth.values[name]) < 4 * error
    values = sorted(truth.values.values())
    assert min(np.diff(values)) > 4 * np.sqrt(2) * max(truth.standard_errors.values())


def test_on_policy_estimates_come_out_right(small):
    """With recorded probabilities the expert's weights are 1: the estimate is the mean return, near the true value."""
    expert = {"expert": domains.policies("tutor-sim")["expert"]}
    estimators = [ope.ImportanceSampling(), ope.ImportanceSampling(kind="trajectory", weighted=False)]
    found = ope.evaluate(small, expert, estimators, gamma=0.9, seeds=1, behavior="logged", interval="normal")
    returns = np.array([episode.rewards[-1] for episode in small]) * 0.9**11
    truth = domains.truth("tutor-sim")
    for row in found.rows:
        assert row["value"] == pytest.approx(returns.mean())
        assert abs(row["value"] - truth.values["expert"]) < 4 * returns.std() / np.sqrt(len(returns))


def test_the_task_names_its_datasets():
    task = domains.task("tutor-sim-178")
    assert task is domains.TASKS["tutor-sim"]
    assert (task.paper, task.gamma, task.horizon) == ("tutoring", 0.9, 12)
    assert set(task.datasets) <= set(domains.DATASETS)


def test_the_card_says_what_the_truth_file_holds():
    text = (ROOT / "datasets" / "tutor-sim" / "README.md").read_text()
    truth = domains.truth("tutor-sim")
    for name, value in truth.values.items():
        assert f"| {name} | {value:.4f} | {truth.standard_errors[name]:.4f} |" in text
    assert re.search(r"of 1,307 \(\d+%\)", text)


def test_the_cards_table_counts_what_is_there(small):
    lines = "\n".join(card_script().statistics(small, ("solve", "study", "together")))
    assert "| students (episodes), decisions (steps) | 178, 2,136 |" in lines
    assert "| ends | 178 terminated" in lines


def test_examples_in_docstrings():
    assert doctest.testmod(tutor_sim).failed == 0
