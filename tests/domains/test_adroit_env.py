"""Adroit's two rewards: the wrapper against the simulator's own state, and telling them apart in data."""

import doctest

import numpy as np
import pytest

from oat_gym.domains import adroit_env, adroit_rewards
from oat_gym.domains.adroit_env import env_spec, make_env, make_vec_env, reset_observations
from oat_gym.domains.adroit_rewards import ADROIT, d4rl_reward, hand_to_object, reward_convention, stock_reward
from oat_gym.errors import ConfigurationError

_SITES = {"door": ("S_grasp", "S_handle"), "hammer": ("S_grasp", None), "relocate": ("S_grasp", None)}
_STEPS = 15


def simulator_distance(env, name: str) -> float:
    """Return the distance from palm to object out of MuJoCo's state, not the observation."""
    data = env.unwrapped.data
    palm, handle = _SITES[name]
    target = data.site(handle).xpos if handle else data.body("Object").xpos
    return float(np.linalg.norm(data.site(palm).xpos - target))


@pytest.mark.parametrize("name", sorted(ADROIT))
def test_the_wrapper_subtracts_the_distance_that_the_environment_adds(name: str):
    env, stock_env = make_env(name), make_env(name).env
    observation, _ = env.reset(seed=7)
    stock_env.reset(seed=7)
    rng = np.random.default_rng(0)
    for _ in range(_STEPS):
        action = rng.uniform(-1, 1, env.action_space.shape).astype(np.float32)
        observation, reward, terminated, _, info = env.step(action)
        _, stock, *_ = stock_env.step(action)
        assert info["stock_reward"] == pytest.approx(float(stock), abs=1e-12)
        if name == "pen":
            assert reward == info["stock_reward"]
        else:
            distance = simulator_distance(env, name)
            assert distance > 0.01
            assert hand_to_object(observation, ADROIT[name]) == pytest.approx(distance, abs=1e-9)
            assert reward == pytest.approx(float(stock) - 0.2 * distance, abs=1e-9)
        assert not terminated
        assert isinstance(info["success"], bool)
    env.close()
    stock_env.close()


def test_relocates_reward_is_d4rls_formula():
    """With the ball on the table and far from its target, D4RL's reward is minus a tenth of the distance."""
    env = make_env("relocate")
    env.reset(seed=3)
    for _ in range(5):
        _, reward, *_ = env.step(np.zeros(30, dtype=np.float32))
        assert reward == pytest.approx(-0.1 * simulator_distance(env, "relocate"), abs=1e-9)
    env.close()


def test_the_two_rewards_are_each_others_inverse():
    rng = np.random.default_rng(0)
    for task in ADROIT.values():
        rows, rewards = rng.normal(size=(20, 46)), rng.normal(size=20)
        np.testing.assert_allclose(stock_reward(d4rl_reward(rewards, rows, task), rows, task), rewards, atol=1e-12)
        assert (np.abs(d4rl_reward(rewards, rows, task) - rewards).max() > 0.01) == (task.name != "pen")


@pytest.mark.parametrize("name", ["door", "relocate"])
def test_data_tells_which_reward_it_carries(name: str):
    env = make_env(name)
    env.reset(seed=1)
    rng = np.random.default_rng(1)
    steps = [env.step(rng.uniform(-1, 1, env.action_space.shape).astype(np.float32)) for _ in range(30)]
    env.close()
    following = np.stack([step[0] for step in steps])
    rewards = np.array([step[1] for step in steps])
    assert reward_convention(rewards, following, ADROIT[name]) == "d4rl"
    stock = np.array([step[4]["stock_reward"] for step in steps])
    assert reward_convention(stock, following, ADROIT[name]) == "stock"
    assert reward_convention(stock + 1000, following, ADROIT[name]) == "unknown"


def test_a_lifted_ball_does_not_mislead():
    """Most steps with the ball in the air, rewarded in D4RL's way."""
    rows = np.zeros((50, 39))
    rows[:, 30], rows[:, 33], rows[:, 36] = 0.05, 0.5, 0.5
    lifted = np.arange(50) >= 5
    rewards = -0.1 * 0.05 + lifted * (1.0 - 0.5 * 0.5 - 0.5 * 0.5)
    assert reward_convention(rewards, rows, ADROIT["relocate"]) == "d4rl"
    assert reward_convention(rewards + 0.2 * 0.05, rows, ADROIT["relocate"]) == "stock"


def test_the_hammers_reward_cannot_be_told_and_the_pens_is_the_same_in_both():
    rows = np.zeros((3, 46))
    assert reward_convention(np.zeros(3), rows, ADROIT["hammer"]) == "unknown"
    assert reward_convention(np.zeros(3), rows, ADROIT["pen"]) == "d4rl"


def test_episodes_have_d4rls_length():
    for name, task in ADROIT.items():
        assert env_spec(name).max_episode_steps == task.horizon == (100 if name == "pen" else 200)
    envs = make_vec_env("pen", 2, horizon=3)
    envs.reset(seed=0)
    ends = [envs.step(np.zeros((2, 24), dtype=np.float32))[3].tolist() for _ in range(3)]
    envs.close()
    assert ends == [[False, False], [False, False], [True, True]]


def test_the_specification_of_others_is_not_changed():
    import gymnasium as gym

    env_spec("pen")
    assert gym.spec("AdroitHandPen-v1").max_episode_steps == 200


def test_reset_observations_depend_on_the_seed_only():
    first, again, other = (reset_observations("door", 3, seed) for seed in (0, 0, 1))
    assert first.shape == (3, 39)
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 1e-3
    assert len(np.unique(first[:, 32])) == 3, "the door stands elsewhere in each episode"


def test_an_unknown_task_is_refused_with_the_names():
    with pytest.raises(ConfigurationError, match="no Adroit task 'mug'; the tasks are pen, door, hammer, relocate"):
        make_env("mug")


@pytest.mark.parametrize("module", [adroit_env, adroit_rewards])
def test_examples_in_docstrings(module):
    assert doctest.testmod(module).failed == 0
