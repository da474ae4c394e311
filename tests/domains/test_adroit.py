"""The human demonstrations against their file and Minari's, and the tasks: policies, true values, initial states."""

import csv
import json

import gymnasium as gym
import minari
import numpy as np
import pytest
from gymnasium import spaces
from minari.data_collector import EpisodeBuffer
from scipy.stats import spearmanr

from oat_gym import domains
from oat_gym.domains import adroit, load
from oat_gym.domains.adroit_rewards import ADROIT, RewardWarning, reward_convention
from oat_gym.domains.truth import GAMMAS
from oat_gym.errors import DatasetNotFoundError, InvalidDataError
from tests.conftest import install_dataset


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


@pytest.mark.shared_data
def test_the_demonstrations_carry_d4rls_reward(shared_data, monkeypatch):
    monkeypatch.setenv("OAT_GYM_DATA", str(shared_data))
    for episode in load("adroit-door-human"):
        assert reward_convention(episode.rewards, episode.observations[1:], ADROIT["door"]) == "d4rl"
    with np.load(
        shared_data / adroit.FILE, allow_pickle=False
    ) as file:  # the same actions, replayed in the installed one
        rewards, observations = file["replay_rewards_gymrobotics"][:-1], file["replay_observations"][1:]
    assert reward_convention(rewards, observations, ADROIT["door"]) == "stock"


def install_minari_door(sign: float) -> None:
    """Install a D4RL/door/human-v2 of a hand at rest 0.5 m from the handle of a closed door."""
    rows = np.zeros((11, 39))
    rows[:, 36] = 0.5
    buffer = EpisodeBuffer(
        observations=rows,
        actions=np.zeros((10, 28), dtype=np.float32),
        rewards=np.full(10, sign * 0.05 - 0.1 * 1.57**2),
        terminations=np.zeros(10, dtype=bool),
        truncations=np.arange(10) == 9,
    )
    install_dataset(
        "D4RL/door/human-v2", [buffer], spaces.Box(-np.inf, np.inf, (39,), np.float64), spaces.Box(-1, 1, (28,))
    )


def test_minaris_demonstrations_are_taken_as_they_are():
    install_minari_door(-1.0)
    dataset = load("adroit-door-human")
    assert dataset.id == "D4RL/door/human-v2"
    assert dataset[0].rewards[0] == pytest.approx(-0.05 - 0.1 * 1.57**2)


def test_minaris_demonstrations_with_the_environments_reward_are_converted_with_a_warning():
    install_minari_door(1.0)
    with pytest.warns(RewardWarning, match=r"the true values of 'adroit-door' count D4RL's.* converted to these"):
        dataset = load("adroit-door-human")
    assert dataset.id == "oat_gym/door-human-v0"
    np.testing.assert_allclose(dataset[0].rewards, -0.05 - 0.1 * 1.57**2)
    np.testing.assert_allclose(dataset[0].infos["stock_reward"], 0.05 - 0.1 * 1.57**2)
    np.testing.assert_array_equal(dataset[0].observations, minari.load_dataset("D4RL/door/human-v2")[0].observations)


@pytest.mark.parametrize("content", [b"no numbers", b"PK\x03\x04 cut off"])
def test_a_damaged_file_is_named(content: bytes, tmp_path):
    (tmp_path / "door.npz").write_bytes(content)
    with pytest.raises(InvalidDataError, match=r"door\.npz cannot be read as plain arrays.*minari download"):
        adroit.door_human(tmp_path / "door.npz")


@pytest.mark.parametrize("name", sorted(ADROIT))
def test_true_values_are_stored_for_every_policy_and_discount(name: str):
    stored = {gamma: domains.truth(f"adroit-{name}", gamma=gamma) for gamma in GAMMAS}
    for truth in stored.values():
        assert list(truth.values) == [f"{name}_dapg_{number}" for number in range(11)]
        assert truth.episodes >= 200
        assert truth.horizon == ADROIT[name].horizon == domains.task(f"adroit-{name}").horizon
        numbers = [*truth.values.values(), *truth.standard_errors.values()]
        assert np.isfinite(numbers).all()
        assert min(truth.standard_errors.values()) > 0
        for policy, error in truth.standard_errors.items():
            assert error == pytest.approx(truth.standard_deviations[policy] / truth.episodes**0.5)
        assert "D4RL" in truth.note
    best = [truth.values[f"{name}_dapg_10"] for truth in stored.values()]
    assert best == sorted(best, reverse=True), "a successful policy earns less the more the future is discounted"
    assert domains.truth(f"adroit-{name}").gamma == 0.995


@pytest.mark.shared_data
@pytest.mark.parametrize("name", sorted(ADROIT))
def test_true_values_agree_with_an_earlier_check(name: str, shared_data):
    """50 other episodes of the same policies, with the environment's own reward, undiscounted."""
    with (shared_data / "robotics" / "dope_policies" / "ground_truth_check.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if row["task"] == name]
    truth = domains.truth(f"adroit-{name}", gamma=1.0)
    check = {f"{name}_dapg_{row['policy']}": row for row in rows}
    values = np.array(list(truth.values.values()))
    means = np.array([float(check[policy]["ours_det_return_mean"]) for policy in truth.values])
    deviations = np.array([float(check[policy]["ours_det_return_std"]) for policy in truth.values])
    assert spearmanr(values, means).statistic > 0.9
    error = np.hypot(list(truth.standard_errors.values()), deviations / 50**0.5)
    at_most = 0.2 * ADROIT[name].horizon  # what the sign of a hand 1 m away is worth
    assert (np.abs(values - means) < 5 * error + at_most).all()


@pytest.mark.shared_data
@pytest.mark.parametrize("name", sorted(ADROIT))
def test_the_policies_are_dopes_and_take_their_mean_action(name: str, shared_data, monkeypatch):
    monkeypatch.setenv("OAT_GYM_DATA", str(shared_data))
    policies = domains.policies(f"adroit-{name}")
    assert list(policies) == list(domains.truth(f"adroit-{name}").values)
    states = domains.initial_states(f"adroit-{name}", count=2)
    for policy in policies.values():
        actions = policy.sample(states, rng=np.random.default_rng(0))
        np.testing.assert_array_equal(actions, policy.mean(states))
        assert np.abs(actions).max() <= 1
        clipped = np.ones_like(actions)
        assert (policy.log_prob(states, clipped) <= 0).all(), (
            "a product of probabilities: no density of a clipped entry"
        )
    assert actions.shape[1:] == gym.spec(ADROIT[name].env_id).make().action_space.shape


def test_missing_policies_say_how_to_get_them(tmp_path, monkeypatch):
    monkeypatch.setenv("OAT_GYM_DATA", str(tmp_path))
    with pytest.raises(DatasetNotFoundError, match=r"pen_dapg_0\.npz was not found.*deep_ope.*OAT_GYM_DATA"):
        domains.policies("adroit-pen")


def test_the_paper_has_all_four_tasks():
    assert [task.paper for task in adroit.TASKS.values()] == ["pen", "door", "hammer", "relocate"]
    assert all(task.gamma == 0.995 for task in adroit.TASKS.values())
