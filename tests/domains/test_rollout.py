"""Roll-outs against environments whose every number tells the seed and the step."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv

from oat_gym.domains.rollout import Recording, roll_out
from oat_gym.errors import ConfigurationError, InvalidDataError
from oat_gym.ope import GaussianPolicy, TabularPolicy

BOX = spaces.Box(-np.inf, np.inf, (1,), np.float32)


def length_of(seed: int) -> int:
    return 2 + seed % 4


def terminates(seed: int) -> bool:
    return seed % 2 == 0


class Coded(gym.Env[np.ndarray, np.ndarray]):
    """Observation and reward are 1000 seed + step; episodes last 2 to 5 steps, those of even seeds terminate.

    After an automatic reset (no seed) it plays an episode of negative numbers, which nobody may see.
    """

    observation_space = spaces.Box(-np.inf, np.inf, (1,), np.float64)
    action_space = BOX

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        super().reset(seed=seed)
        self.code = -77 if seed is None else seed
        self.t = 0
        return self._observation(), {"clock": -1.0}

    def step(self, action: np.ndarray):
        self.t += 1
        over = self.t >= length_of(self.code)
        info = {"clock": float(self.t), "force": np.array(action, dtype=np.float64)}
        even = terminates(self.code)
        return self._observation(), 1000.0 * self.code + self.t, over and even, over and not even, info

    def _observation(self):
        return np.array([1000.0 * self.code + self.t])


def doubling() -> GaussianPolicy:
    """Return the policy whose action is twice the observation, plus a little noise."""
    return GaussianPolicy(lambda states: 2 * np.asarray(states), 1e-3)


def coded(count: int, mode: AutoresetMode = AutoresetMode.NEXT_STEP) -> SyncVectorEnv:
    return SyncVectorEnv([Coded] * count, autoreset_mode=mode)


@pytest.mark.parametrize("num_envs", [1, 3, 4, 20])
def test_every_number_stays_at_its_episode_and_step(num_envs):
    """Eleven episodes of unequal lengths, in batches that the last one does not fill."""
    seeds = list(range(3, 14))
    made = roll_out(coded(num_envs), doubling(), seeds=seeds, horizon=9, record=Recording(infos=("clock", "force")))
    assert made.rewards.shape == (11, 9)
    assert made.lengths.tolist() == [length_of(seed) for seed in seeds]
    assert made.terminated.tolist() == [terminates(seed) for seed in seeds]
    assert len(made.episodes) == 11
    for seed, rewards, episode in zip(seeds, made.rewards, made.episodes, strict=True):
        length = length_of(seed)
        steps = np.arange(1, length + 1)
        assert rewards.tolist() == [*(1000.0 * seed + steps), *[0.0] * (9 - length)]
        assert episode.rewards.tolist() == rewards[:length].tolist()
        assert episode.observations[:, 0].tolist() == [1000.0 * seed + t for t in range(length + 1)]
        np.testing.assert_allclose(episode.actions[:, 0], 2 * episode.observations[:-1, 0], atol=0.01, rtol=1e-6)
        np.testing.assert_array_equal(episode.infos["force"], episode.actions)
        assert episode.infos["clock"].tolist() == steps.tolist()
        last = steps == length
        np.testing.assert_array_equal(episode.terminations, last & terminates(seed))
        np.testing.assert_array_equal(episode.truncations, last & (not terminates(seed)))
        assert episode.seed == seed


def test_the_horizon_truncates_what_has_not_ended():
    made = roll_out(coded(4), doubling(), seeds=range(4), horizon=3, record=Recording())
    assert made.lengths.tolist() == [2, 3, 3, 3]
    assert made.terminated.tolist() == [True, False, False, False]  # seed 2 would have terminated in its 4th step
    assert [bool(episode.truncations[-1]) for episode in made.episodes] == [False, True, True, True]
    assert [bool(episode.terminations[-1]) for episode in made.episodes] == [True, False, False, False]


def test_an_end_of_both_kinds_is_a_termination():
    class Both(Coded):
        def step(self, action):
            observation, reward, ends, cuts, info = super().step(action)
            return observation, reward, ends or cuts, ends or cuts, info

    (episode,) = roll_out(SyncVectorEnv([Both]), doubling(), seeds=[1], horizon=9, record=Recording()).episodes
    assert episode.terminations[-1]
    assert not episode.truncations.any()


def test_one_seed_gives_one_result_and_another_policy_seed_another():
    first, again = (roll_out(coded(3), doubling(), seeds=range(5), horizon=6, record=Recording()) for _ in range(2))
    other = roll_out(coded(3), doubling(), seeds=range(5), horizon=6, policy_seed=1, record=Recording())
    for one, two, three in zip(first.episodes, again.episodes, other.episodes, strict=True):
        np.testing.assert_array_equal(one.actions, two.actions)
        assert (one.actions != three.actions).any()
        np.testing.assert_array_equal(one.observations, three.observations)  # starts do not depend on the policy's seed
    batches = roll_out(coded(2), doubling(), seeds=[5, 5, 5, 5], horizon=6, record=Recording()).episodes
    noise = [tuple((episode.actions - 2 * episode.observations[:-1]).ravel()) for episode in batches]
    assert len(set(noise)) == 4, "batches or environments share their random numbers"


def test_seeds_may_be_numpys_and_are_kept_as_integers():
    (episode, _) = roll_out(coded(2), doubling(), seeds=np.array([4, 6]), horizon=6, record=Recording()).episodes
    assert type(episode.seed) is int


def test_log_prob_is_that_of_the_action_taken():
    policy = GaussianPolicy(lambda states: 0.001 * np.asarray(states), 0.5, spaces.Box(-1, 1, (1,)), censored=True)
    made = roll_out(coded(3), policy, seeds=range(7), horizon=9, record=Recording(log_prob=True))
    for episode in made.episodes:
        expected = policy.log_prob(episode.observations[:-1], episode.actions)
        np.testing.assert_allclose(episode.infos["log_prob"], expected, rtol=1e-12)
        assert len(expected) == len(episode.rewards)


class InPlace(VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """A vector environment that writes over the observations it gave and the actions it got."""

    def __init__(self, mode: Any = None) -> None:
        self.num_envs, self.metadata = 2, {} if mode is None else {"autoreset_mode": mode}
        self.single_action_space, self.single_observation_space = BOX, BOX
        self.state = np.zeros((2, 1), dtype=np.float32)

    def reset(self, *, seed=None, options=None):
        self.state[:, 0] = seed
        return self.state, {}

    def step(self, actions):
        self.state += 1
        actions[:] = 99.0
        no = np.zeros(2, dtype=bool)
        return self.state, self.state[:, 0], no, no, {}


def test_environments_that_reuse_their_arrays_do_no_harm():
    made = roll_out(InPlace(), doubling(), seeds=[10, 20, 30], horizon=4, record=Recording(log_prob=True))
    for seed, episode in zip((10, 20, 30), made.episodes, strict=True):
        assert episode.observations[:, 0].tolist() == [seed + t for t in range(5)]
        np.testing.assert_allclose(episode.actions, 2 * episode.observations[:-1], atol=0.01)
        expected = doubling().log_prob(episode.observations[:-1], episode.actions)
        np.testing.assert_allclose(episode.infos["log_prob"], expected)
        assert episode.rewards.tolist() == episode.observations[1:, 0].tolist()


@pytest.mark.parametrize("mode", [AutoresetMode.SAME_STEP, AutoresetMode.DISABLED])
def test_other_ways_to_reset_are_refused(mode):
    """Same-step: the last observation would be the next episode's. Disabled: ended environments cannot be stepped."""
    with pytest.raises(ConfigurationError, match=rf"next-step.*{mode.name}"):
        roll_out(coded(2, mode), doubling(), seeds=[0], horizon=3)
    with pytest.raises(ConfigurationError, match="next-step"):
        roll_out(InPlace(mode), doubling(), seeds=[0], horizon=3)


def test_discrete_actions_arrive_as_they_were_drawn():
    class Levers(Coded):
        observation_space, action_space = spaces.Discrete(2), spaces.Discrete(3)

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            return 0, {}

        def step(self, action):
            _, _, ends, cuts, _ = super().step(np.zeros(1))
            return self.t % 2, float(action), ends, cuts, {}

    policy = TabularPolicy([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    made = roll_out(SyncVectorEnv([Levers] * 2), policy, seeds=range(3), horizon=4, record=Recording(log_prob=True))
    for episode in made.episodes:
        assert episode.actions.tolist() == episode.rewards.tolist() == [1, 2, 1, 2][: len(episode.rewards)]
        assert not episode.infos["log_prob"].any()


def test_missing_infos_are_refused_and_never_filled_with_zeros():
    with pytest.raises(ConfigurationError, match="lack 'speed'"):
        roll_out(coded(2), doubling(), seeds=[0], horizon=3, record=Recording(infos=("speed",)))

    class Sometimes(Coded):
        def step(self, action):
            *rest, info = super().step(action)
            return *rest, (info if self.code == 3 or self.t == 1 else {})

    envs = SyncVectorEnv([Sometimes] * 2)
    record = Recording(infos=("clock",))
    with pytest.raises(ConfigurationError, match="lack 'clock'"):
        roll_out(envs, doubling(), seeds=[3, 4], horizon=5, record=record)
    made = roll_out(envs, doubling(), seeds=[3], horizon=5, record=record)  # the environment left over does not matter
    assert made.episodes[0].infos["clock"].tolist() == [1, 2, 3, 4, 5]


def test_nested_infos_are_refused():
    class Nested(Coded):
        def step(self, action):
            *rest, info = super().step(action)
            return *rest, {"deep": info}

    with pytest.raises(ConfigurationError, match="'deep' is nested"):
        roll_out(SyncVectorEnv([Nested]), doubling(), seeds=[0], horizon=3, record=Recording(infos=("deep",)))


def test_senseless_calls_are_refused():
    for seeds, horizon in (([], 3), ([0], 0)):
        with pytest.raises(ConfigurationError, match="seeds and a horizon"):
            roll_out(coded(1), doubling(), seeds=seeds, horizon=horizon)
    broken = GaussianPolicy(lambda states: np.full((len(states), 1), np.nan), 1.0)
    with pytest.raises(InvalidDataError, match="not finite"):
        roll_out(coded(1), broken, seeds=[0], horizon=2)


def test_without_a_recording_no_episode_is_kept():
    made = roll_out(coded(2), doubling(), seeds=range(3), horizon=6)
    assert made.episodes == ()
    assert made.rewards.sum() == sum(1000 * s * length_of(s) + sum(range(length_of(s) + 1)) for s in range(3))
