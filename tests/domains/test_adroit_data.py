"""Data made by policies: replay from the seeds, the same bytes again, the halves of `cloned`, and the experts' form."""

from pathlib import Path

import minari
import numpy as np
import pytest
from gymnasium import spaces
from minari.data_collector import EpisodeBuffer

from oat_gym.checks import check_dataset
from oat_gym.domains import adroit, load
from oat_gym.domains.adroit_data import cloned_dataset, expert_dataset
from oat_gym.domains.adroit_env import make_env
from oat_gym.domains.adroit_policies import expert_policy
from oat_gym.domains.adroit_rewards import ADROIT, hand_to_object
from oat_gym.errors import ConfigurationError, DatasetNotFoundError, InvalidDataError
from oat_gym.ope import BehaviorCloning
from tests.conftest import install_dataset

_STEPS = 230  # of the door: an episode of 200 steps and one that is cut at 30
_QUICK = BehaviorCloning(density="censored", folds=1, max_updates=20, hidden=(8,))


def write_expert(folder: Path, name: str, *, inputs: int, actions: int, **changes) -> Path:
    """Write an expert of made-up weights where the data folder has the real one."""
    rng = np.random.default_rng(0)
    widths = (inputs, 5, 6, actions)
    arrays = {
        "log_std": np.linspace(-2, -0.5, actions),
        "in_shift": rng.normal(size=inputs),
        "in_scale": rng.uniform(0.5, 2, inputs),
        "out_shift": rng.normal(size=actions),
        "out_scale": rng.uniform(0.5, 2, actions),
    }
    for layer in range(3):
        arrays[f"fc{layer}.weight"] = rng.normal(size=(widths[layer + 1], widths[layer])) / 3
        arrays[f"fc{layer}.bias"] = rng.normal(size=widths[layer + 1]) / 3
    path = folder / "robotics" / "hand_dapg_expert" / f"{name}_expert.npz"
    path.parent.mkdir(parents=True, exist_ok=True)
    kept = {key: value for key, value in (arrays | changes).items() if value is not None}
    np.savez(path, **{key: np.asarray(value, dtype=np.float32) for key, value in kept.items()})
    return path


@pytest.fixture
def door_expert(tmp_path, monkeypatch) -> Path:
    monkeypatch.setenv("OAT_GYM_DATA", str(tmp_path / "data"))
    return write_expert(tmp_path / "data", "door", inputs=39, actions=28)


def test_the_expert_computes_what_mjrl_computes(door_expert):
    with np.load(door_expert) as file:
        w = {key: file[key].astype(np.float64) for key in file}
    rows = np.random.default_rng(1).normal(size=(7, 39))
    hidden = np.tanh((rows - w["in_shift"]) / (w["in_scale"] + 1e-8) @ w["fc0.weight"].T + w["fc0.bias"])
    hidden = np.tanh(hidden @ w["fc1.weight"].T + w["fc1.bias"])
    mean = (hidden @ w["fc2.weight"].T + w["fc2.bias"]) * w["out_scale"] + w["out_shift"]
    policy = expert_policy("door")
    np.testing.assert_allclose(policy.mean(rows), np.clip(mean, -1, 1), atol=1e-5)
    assert 0.02 < (np.abs(mean) > 1).mean() < 0.98, "some means are beyond the bounds, and some are not"
    draws = np.stack([policy.sample(rows[:1], rng=np.random.default_rng(k))[0] for k in range(400)])
    inside = (np.abs(mean[0]) + 3 * np.exp(w["log_std"])) < 1
    assert inside.any()
    np.testing.assert_allclose(draws.std(axis=0)[inside], np.exp(w["log_std"])[inside], rtol=0.2)


def replayed(dataset: minari.MinariDataset, name: str):
    """Yield each episode and what its actions give from its seed."""
    env = make_env(name)
    seeds = [part["seed"] for part in dataset.storage.get_episode_metadata(dataset.episode_indices)]
    for episode, seed in zip(dataset, seeds, strict=True):
        first, _ = env.reset(seed=int(seed))
        steps = [env.step(action) for action in episode.actions]
        yield episode, np.stack([first, *(step[0] for step in steps)]), steps
    env.close()


def test_recorded_episodes_replay_from_their_seeds(door_expert):
    dataset = expert_dataset("door", steps=_STEPS)
    assert [len(episode) for episode in dataset] == [200, 30]
    policy = expert_policy("door")
    for episode, observations, steps in replayed(dataset, "door"):
        np.testing.assert_array_equal(episode.observations, observations)
        np.testing.assert_array_equal(episode.rewards, [step[1] for step in steps])
        for key in ("stock_reward", "success"):
            np.testing.assert_array_equal(episode.infos[key], [step[4][key] for step in steps])
        expected = policy.log_prob(episode.observations[:-1], episode.actions)
        np.testing.assert_allclose(episode.infos["log_prob"], expected, rtol=1e-6)
        distance = hand_to_object(episode.observations[1:], ADROIT["door"])
        np.testing.assert_allclose(episode.infos["stock_reward"] - episode.rewards, 0.2 * distance, atol=1e-12)
        assert not episode.terminations.any()
        assert episode.truncations.tolist() == [False] * (len(episode) - 1) + [True]
    starts = [episode.observations[0] for episode in dataset]
    assert np.abs(starts[0] - starts[1]).max() > 1e-3
    check_dataset(dataset)


def files_of(dataset: minari.MinariDataset) -> dict[str, bytes]:
    folder = Path(dataset.storage.data_path)
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def test_data_comes_out_the_same_to_the_byte(tmp_path, monkeypatch):
    write_expert(tmp_path, "pen", inputs=45, actions=24)
    monkeypatch.setenv("OAT_GYM_DATA", str(tmp_path))
    made = []
    for number in range(2):
        monkeypatch.setenv("OAT_GYM_CACHE", str(tmp_path / f"cache{number}"))
        expert = expert_dataset("pen", steps=110)
        clone = cloned_dataset("pen", expert, level="cloned-from-expert", steps=205, cloning=_QUICK)
        assert str(tmp_path / f"cache{number}") in str(expert.storage.data_path)
        assert [len(episode) for episode in (*expert, *clone)] == [100, 10, 100, 100, 5]
        starts = np.stack([episode.observations[0] for episode in (*expert, *clone)])
        assert len(np.unique(starts, axis=0)) == 4, "the clone's copy of the first demonstration starts as it does"
        made.append((files_of(expert), files_of(clone)))
    assert made[0] == made[1]
    assert files_of(expert_dataset("pen", steps=110, seed=1)) != made[0][0]


def demonstrations(lengths: list[int], *, infos=None, reward=-1.0) -> minari.MinariDataset:
    """Return demonstrations of the door whose every value encodes (episode, step); actions leave the bounds."""
    buffers = []
    for number, length in enumerate(lengths):
        code = 1000.0 * number + np.arange(length + 1)
        buffers.append(
            EpisodeBuffer(
                observations=np.repeat(code[:, None], 39, axis=1),
                actions=np.full((length, 28), 1.5) - np.arange(length)[:, None] / length,
                rewards=np.full(length, reward) - code[:-1],
                terminations=np.zeros(length, dtype=bool),
                truncations=np.arange(length) == length - 1,
                infos=dict.fromkeys(infos, code[:-1]) if infos else None,
            )
        )
    box = spaces.Box(-np.inf, np.inf, (39,), np.float64)
    return install_dataset("D4RL/door/human-v2", buffers, box, spaces.Box(-2, 2, (28,), np.float64))


def test_cloned_is_half_whole_demonstrations_and_half_roll_outs():
    source = demonstrations([20, 30, 40, 50])
    dataset = cloned_dataset("door", source, level="cloned", steps=300, cloning=_QUICK)
    lengths = [len(episode) for episode in dataset]
    assert lengths[:4] == [20, 30, 40, 50], "140 of 150 steps"
    assert lengths[4:] == [160]
    assert dataset.storage.metadata["demonstrations"] == 4
    for number, (episode, original) in enumerate(zip(dataset, source, strict=False)):
        np.testing.assert_array_equal(episode.observations, original.observations)
        np.testing.assert_allclose(episode.actions, np.clip(original.actions, -1, 1), rtol=1e-6)
        np.testing.assert_array_equal(episode.rewards, original.rewards)
        assert episode.observations[-1, 0] == 1000 * number + len(episode)
    assert all(set(episode.infos) == {"stock_reward"} for episode in dataset)
    *_, (made, observations, steps) = replayed_last(dataset)
    np.testing.assert_array_equal(made.observations, observations)
    np.testing.assert_array_equal(made.rewards, [step[1] for step in steps])
    check_dataset(dataset)


def replayed_last(dataset: minari.MinariDataset):
    last = dataset.filter_episodes(lambda episode: episode.id == dataset.total_episodes - 1)
    return list(replayed(last, "door"))


def test_fewer_demonstrations_where_half_holds_fewer():
    source = demonstrations([20, 30, 40, 50])
    dataset = cloned_dataset("door", source, level="cloned", steps=110, cloning=_QUICK)
    assert [len(episode) for episode in dataset] == [20, 30, 60]
    with pytest.raises(ConfigurationError, match="the first demonstration alone has 20"):
        cloned_dataset("door", source, level="cloned", steps=30, cloning=_QUICK)


def test_log_probabilities_are_kept_where_both_halves_have_them():
    dataset = cloned_dataset("door", demonstrations([20], infos=["log_prob"]), level="x", steps=50, cloning=_QUICK)
    assert set(dataset[0].infos) == {"log_prob", "stock_reward"}
    np.testing.assert_array_equal(dataset[0].infos["log_prob"], np.arange(20))
    assert np.isfinite(dataset[1].infos["log_prob"]).all()


def test_demonstrations_with_the_environments_reward_get_d4rls():
    """A door at rest whose hand is 1 m away: D4RL's reward -0.1 - 0.1 x 1.57^2, the environment's +0.1 - ..."""
    rows = np.zeros((31, 39))
    rows[:, 35] = 1.0
    buffer = EpisodeBuffer(
        observations=rows,
        actions=np.zeros((30, 28), dtype=np.float32),
        rewards=np.full(30, 0.1 - 0.1 * 1.57**2),
        terminations=np.zeros(30, dtype=bool),
        truncations=np.arange(30) == 29,
        infos={"success": np.arange(31) / 10},  # as Minari's collector has it: with the reset's row
    )
    box = spaces.Box(-np.inf, np.inf, (39,), np.float64)
    source = install_dataset("test/stock-v0", [buffer], box, spaces.Box(-1, 1, (28,)))
    dataset = cloned_dataset("door", source, level="cloned", steps=70, cloning=_QUICK)
    np.testing.assert_allclose(dataset[0].rewards, -0.1 - 0.1 * 1.57**2)
    np.testing.assert_allclose(dataset[0].infos["stock_reward"], 0.1 - 0.1 * 1.57**2)
    np.testing.assert_array_equal(dataset[0].infos["success"], np.arange(1, 31) / 10)


def test_the_four_levels_are_the_tasks_datasets(door_expert):
    assert set(adroit.DATASETS) == {
        f"adroit-{task}-{level}" for task in ADROIT for level in ("human", "cloned", "expert", "cloned-from-expert")
    }
    for name, task in adroit.TASKS.items():
        assert set(task.datasets) == {key for key in adroit.DATASETS if key.startswith(name + "-")}


@pytest.mark.parametrize("level", ["human", "cloned"])
def test_missing_demonstrations_say_how_to_get_them(level: str, door_expert):
    with pytest.raises(DatasetNotFoundError, match=r"minari download D4RL/pen/human-v2.*adroit-pen-cloned-from-expert"):
        load(f"adroit-pen-{level}")


@pytest.mark.parametrize("level", ["expert", "cloned-from-expert"])
def test_missing_experts_say_how_to_get_them(level: str, door_expert):
    with pytest.raises(DatasetNotFoundError, match=r"pen_expert\.npz was not found.*hand_dapg.*OAT_GYM_DATA"):
        load(f"adroit-pen-{level}")


def test_a_damaged_expert_is_refused(tmp_path, monkeypatch):
    monkeypatch.setenv("OAT_GYM_DATA", str(tmp_path))
    write_expert(tmp_path, "door", inputs=39, actions=28, in_scale=None, log_std=None)
    with pytest.raises(InvalidDataError, match="lacks the arrays log_std, in_scale"):
        expert_policy("door")
    path = write_expert(tmp_path, "pen", inputs=45, actions=24)
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(InvalidDataError, match="cannot be read"):
        expert_policy("pen")


def test_wrong_numbers_of_steps_are_refused(door_expert):
    with pytest.raises(ConfigurationError, match="steps must be at least 1, got 0"):
        expert_dataset("door", steps=0)


@pytest.mark.shared_data
def test_the_door_experts_data_opens_the_door(shared_data, monkeypatch):
    monkeypatch.setenv("OAT_GYM_DATA", str(shared_data))
    dataset = expert_dataset("door", steps=400)
    assert all(2500 < episode.rewards.sum() < 3200 for episode in dataset), "20 episodes give 3013"
    assert all(episode.infos["success"].sum() > 25 for episode in dataset), "D4RL's measure of success"
