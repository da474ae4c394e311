"""Behaviour cloning against policies known in closed form."""

import numpy as np
import pytest

from oat_gym.errors import ConfigurationError, InvalidDataError, TrainingError
from oat_gym.generation import ActionPolicy, BehaviorConfig, BehaviorModel, fit_behavior
from oat_gym.spaces import Layout

QUICK = BehaviorConfig(hidden=(32, 32), max_updates=600, learning_rate=3e-3)


def test_a_gaussian_policys_log_prob(kit):
    rng = np.random.default_rng(0)
    truth = kit.GaussianPolicy(gain=3.0, offset=10.0, scale=2.0, width=2)
    states = rng.normal(size=(4000, 3)) * [1, 5, 100]
    states[:, 1] = states[:, 0] ** 2
    actions = truth.sample(states, rng=rng)
    model = fit_behavior(states, actions, state_layout=kit.real(3), action_layout=kit.real(2), config=QUICK, rng=rng)
    assert isinstance(model, ActionPolicy)
    fresh = rng.normal(size=(2000, 3)) * [1, 5, 100]
    fresh[:, 1] = fresh[:, 0] ** 2
    taken = truth.sample(fresh, rng=rng)
    error = model.log_prob(fresh, taken) - truth.log_prob(fresh, taken)
    assert abs(error.mean()) < 0.1
    assert np.abs(error).mean() < 0.25
    assert model.held_out == pytest.approx(truth.log_prob(states, actions).mean(), abs=0.25)


def test_samples_have_the_cloned_moments(kit):
    rng = np.random.default_rng(0)
    truth = kit.GaussianPolicy(gain=-1.0, offset=4.0, scale=0.5)
    states = rng.normal(size=(3000, 1))
    model = fit_behavior(
        states,
        truth.sample(states, rng=rng),
        state_layout=kit.real(1),
        action_layout=kit.real(1),
        config=QUICK,
        rng=rng,
    )
    drawn = model.sample(np.full((5000, 1), 0.5), rng=rng)
    assert drawn.mean() == pytest.approx(3.5, abs=0.1)
    assert drawn.std() == pytest.approx(0.5, rel=0.15)


def test_discrete_policies(kit):
    rng = np.random.default_rng(0)
    states = rng.integers(2, size=6000)
    probabilities = np.array([[0.7, 0.2, 0.1], [0.1, 0.1, 0.8]])
    codes = (rng.random(6000)[:, None] > probabilities.cumsum(1)[states]).sum(1)
    model = fit_behavior(
        kit.one_hot(states, 2),
        kit.one_hot(codes, 3),
        state_layout=Layout(2, (), ((0, 2),)),
        action_layout=Layout(3, (), ((0, 3),)),
        config=QUICK,
        rng=rng,
    )
    for state in range(2):
        rows = np.repeat(kit.one_hot(np.array([state]), 2), 3, axis=0)
        np.testing.assert_allclose(np.exp(model.log_prob(rows, np.eye(3))), probabilities[state], atol=0.05)
        drawn = model.sample(np.repeat(rows[:1], 4000, axis=0), rng=rng)
        np.testing.assert_allclose(drawn.mean(0), probabilities[state], atol=0.06)


def test_actions_on_a_bound_carry_the_clipped_mass(kit):
    # a = clip(N(0.8, 0.5^2), -1, 1): 34% of the actions sit on the upper bound.
    rng = np.random.default_rng(0)
    states = rng.normal(size=(6000, 1))
    recorded = 0.8 + 0.5 * rng.normal(size=(6000, 1))
    bounds = (np.array([-1.0]), np.array([1.0]))
    layouts = {"state_layout": kit.real(1), "action_layout": kit.real(1)}
    model = fit_behavior(states, recorded, config=QUICK, rng=rng, bounds=bounds, **layouts)
    on_bound = np.exp(model.log_prob(np.zeros((1, 1)), np.ones((1, 1))))
    assert on_bound[0] == pytest.approx(0.3446, abs=0.05)
    inside = np.exp(model.log_prob(np.zeros((1, 1)), np.array([[0.8]])))
    assert inside[0] == pytest.approx(1 / (0.5 * np.sqrt(2 * np.pi)), rel=0.12)
    drawn = model.sample(np.zeros((4000, 1)), rng=rng)
    assert drawn.max() == 1.0
    assert (drawn == 1.0).mean() == pytest.approx(0.3446, abs=0.05)


@pytest.mark.parametrize("bounded", [False, True])
def test_storage_round_trip(kit, bounded):
    rng = np.random.default_rng(0)
    states, actions = rng.normal(size=(50, 2)), kit.one_hot(rng.integers(2, size=50), 3)
    actions[:, 0] = rng.normal(size=50)
    actions[:, 1:] = kit.one_hot(rng.integers(2, size=50), 2)
    model = fit_behavior(
        states,
        actions,
        state_layout=kit.real(2),
        action_layout=Layout(3, (0,), ((1, 3),)),
        config=BehaviorConfig(max_updates=20),
        rng=rng,
        bounds=(np.array([-1.0, 0, 0]), np.array([np.inf, 1, 1])) if bounded else None,
    )
    restored = BehaviorModel.from_arrays(model.to_arrays(), config=BehaviorConfig(max_updates=20))
    one, other = (m.sample(states, rng=np.random.default_rng(3)) for m in (model, restored))
    assert one.tobytes() == other.tobytes()
    assert model.log_prob(states, one).tobytes() == restored.log_prob(states, one).tobytes()
    assert (restored.bounds is None) != bounded


def test_whole_episodes_are_held_out_and_training_stops_early(kit):
    # The action is noise that depends on the episode only: held-out episodes cannot be predicted.
    rng = np.random.default_rng(0)
    groups = np.repeat(np.arange(12), 20)
    states = rng.normal(size=(12, 4))[groups] + 0.01 * rng.normal(size=(240, 4))
    actions = rng.normal(size=(12, 1))[groups]
    calls = []
    config = BehaviorConfig(max_updates=2000, patience=200)
    model = fit_behavior(
        states,
        actions,
        state_layout=kit.real(4),
        action_layout=kit.real(1),
        config=config,
        rng=rng,
        groups=groups,
        progress=lambda *call: calls.append(call),
    )
    assert len(calls) < 2000 / 50
    assert model.held_out < model.log_prob(states, actions).mean() + 1e-6


def test_bad_data_is_refused(kit):
    states, actions = np.zeros((20, 2)), np.zeros((20, 1))
    settings = {"state_layout": kit.real(2), "action_layout": kit.real(1), "rng": np.random.default_rng(0)}
    with pytest.raises(InvalidDataError, match=r"actions must have shape \(20, 1\)"):
        fit_behavior(states, actions[:-1], config=QUICK, **settings)
    broken = states.copy()
    broken[7, 1] = np.nan
    with pytest.raises(TrainingError, match="states of transition 7"):
        fit_behavior(broken, actions, config=QUICK, **settings)
    with pytest.raises(TrainingError, match="diverged"):
        fit_behavior(
            states + np.arange(40).reshape(20, 2), actions, config=BehaviorConfig(learning_rate=1e30), **settings
        )
    with pytest.raises(ConfigurationError, match="hidden"):
        BehaviorConfig(hidden=())
