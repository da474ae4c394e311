"""Deep Q-learning from a dataset: known optimal values, repeatability, files."""

import numpy as np
import pytest
from gymnasium import spaces

from oat_gym.domains.dqn import DQN, QNetwork
from oat_gym.errors import ConfigurationError, DatasetNotFoundError, InvalidDataError
from oat_gym.io.writing import DatasetCard, dataset_from_episodes, episode_buffer

LINE = 4
GAMMA = 0.9
BOX = spaces.Box(-100.0, 100.0, (2,), np.float64)


def line_dataset(folder, *, episodes=200, first_action=0, seed=0, reward=None):
    """A corridor of 4 cells: action 0 goes left, 1 goes right; leaving at the right pays 10 and terminates."""
    rng = np.random.default_rng(seed)

    def walk():
        cell, cells, actions, rewards = int(rng.integers(LINE)), [], [], []
        cells.append(cell)
        for _ in range(8):
            action = int(rng.integers(2))
            actions.append(action + first_action)
            cell = max(cell - 1, 0) if action == 0 else cell + 1
            cells.append(cell)
            rewards.append(10.0 if cell == LINE else 0.0)
            if cell == LINE:
                break
        steps = len(actions)
        last = np.arange(steps) == steps - 1
        ended = last & (cell == LINE)
        place = np.array(cells, dtype=float)
        return episode_buffer(
            observations=np.stack([place, 50 + 3 * place], axis=1),
            actions=np.array(actions),
            rewards=np.array(rewards) if reward is None else np.full(steps, reward),
            terminations=ended,
            truncations=last & ~ended,
        )

    return dataset_from_episodes(
        [walk() for _ in range(episodes)],
        directory=folder,
        card=DatasetCard(dataset_id="test/line-v0", description="a corridor"),
        observation_space=BOX,
        action_space=spaces.Discrete(2, start=first_action),
    )


STATES = np.stack([np.arange(LINE), 50 + 3 * np.arange(LINE)], axis=1).astype(float)


def optimal_values():
    right = 10.0 * GAMMA ** np.arange(LINE - 1, -1, -1.0)
    return np.stack([GAMMA * right[[0, 0, 1, 2]], right], axis=1)


@pytest.mark.parametrize("first_action", [0, 3])
def test_the_optimal_values_of_a_corridor(tmp_path, first_action):
    data = line_dataset(tmp_path / "data", first_action=first_action)
    network = DQN(learning_rate=3e-3, gamma=GAMMA, hidden=(32,), updates=2000, target_every=50).fit(data, seed=0)
    np.testing.assert_allclose(network.q_values(STATES), optimal_values(), atol=0.3)
    assert network.mean(STATES).tolist() == [1 + first_action] * LINE
    assert network.softened(0.1).probabilities(STATES)[0].round(3).tolist() == [0.05, 0.95]


def test_the_same_seed_gives_the_same_weights_and_files_keep_them(tmp_path):
    data = line_dataset(tmp_path / "data", episodes=20)
    config = DQN(updates=20, hidden=(8, 8))
    one, again, other = (config.fit(data, seed=seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one.q_values(STATES), again.q_values(STATES))
    assert (one.q_values(STATES) != other.q_values(STATES)).any()
    one.save(tmp_path / "q.safetensors")
    again.save(tmp_path / "again.safetensors")
    assert (tmp_path / "q.safetensors").read_bytes() == (tmp_path / "again.safetensors").read_bytes()
    loaded = QNetwork.load(
        tmp_path / "q.safetensors", observation_space=data.observation_space, action_space=data.action_space
    )
    np.testing.assert_array_equal(loaded.q_values(STATES), one.q_values(STATES))


def test_bad_files_and_settings_are_refused(tmp_path):
    network = DQN(updates=1, hidden=(4,)).fit(line_dataset(tmp_path / "data", episodes=3))
    file = tmp_path / "q.safetensors"
    network.save(file)
    two = spaces.Discrete(2)
    with pytest.raises(DatasetNotFoundError, match=r"no file .*absent"):
        QNetwork.load(tmp_path / "absent", observation_space=BOX, action_space=two)
    with pytest.raises(InvalidDataError, match="2 features and 3 actions is expected"):
        QNetwork.load(file, observation_space=BOX, action_space=spaces.Discrete(3))
    file.write_bytes(file.read_bytes()[:-3])
    with pytest.raises(InvalidDataError, match="not a whole QNetwork file"):
        QNetwork.load(file, observation_space=BOX, action_space=two)
    for bad in ({"gamma": 1.0}, {"learning_rate": 0.0}, {"hidden": (0,)}, {"reward_scale": 0.0}):
        with pytest.raises(ConfigurationError):
            DQN(**bad)


def test_constant_rewards_are_not_divided_by_their_rounding(tmp_path):
    data = line_dataset(tmp_path / "data", episodes=50, reward=0.1)
    config = DQN(learning_rate=3e-3, gamma=0.5, hidden=(16,), updates=300, target_every=20)
    values = config.fit(data, seed=0).q_values(STATES)
    assert (values > 0.05).all()
    assert (values < 0.25).all()
