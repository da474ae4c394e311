"""Roll-outs: known laws come back, starts, limits, determinism, storage."""

import dataclasses
import hashlib
import subprocess
import sys

import numpy as np
import pytest
import torch

from oat_gym.errors import ConfigurationError, InvalidDataError, TrainingError
from oat_gym.generation import ActionPolicy, FittedVAEMDP, Limits, VAEMDPConfig, fit_vae_mdp
from oat_gym.spaces import Layout

QUICK = VAEMDPConfig(
    latent=4, encoder=(32, 32), lstm=24, dense=24, max_updates=600, batch_size=64, patience=None, learning_rate=1e-2
)


@pytest.fixture(scope="module")
def linear_system(kit):
    """A model of the linear-Gaussian system, its training spans, and the exact moments by time."""
    spans, mean, variance = kit.linear_gaussian(np.random.default_rng(0), 400, 5)
    layouts = {"state_layout": kit.real(1), "action_layout": kit.real(1)}
    return fit_vae_mdp(*spans, config=QUICK, rng=np.random.default_rng(1), **layouts), spans, mean, variance


@pytest.fixture(scope="module")
def tiny_model(kit):
    spans = kit.random_spans(np.random.default_rng(0))
    layouts = {"state_layout": kit.real(3), "action_layout": kit.real(2)}
    return fit_vae_mdp(*spans, config=kit.tiny, rng=np.random.default_rng(1), **layouts), spans


def test_a_linear_gaussian_systems_moments(kit, linear_system):
    model, _, mean, variance = linear_system
    samples = model.sample(4000, rng=np.random.default_rng(2), policy=kit.GaussianPolicy())
    states = samples.states[..., 0]
    np.testing.assert_allclose(states.mean(0), mean, atol=0.15)
    np.testing.assert_allclose(states.std(0), np.sqrt(variance), rtol=0.2)
    # cov(s_t, s_{t+1}) = 0.8 var(s_t) and cov(a_t, s_{t+1}) = 0.5
    along_time = [np.cov(states[:, t], states[:, t + 1])[0, 1] for t in range(5)]
    np.testing.assert_allclose(along_time, 0.8 * variance[:-1], atol=0.2)
    with_action = [np.cov(samples.actions[:, t, 0], states[:, t + 1])[0, 1] for t in range(5)]
    np.testing.assert_allclose(with_action, 0.5, atol=0.15)


def test_log_prob_is_the_policys(kit, linear_system):
    policy = kit.GaussianPolicy(gain=0.5, scale=0.3)
    assert isinstance(policy, ActionPolicy)
    samples = linear_system[0].sample(50, rng=np.random.default_rng(0), policy=policy)
    for t in range(5):
        np.testing.assert_array_equal(
            samples.log_prob[:, t], policy.log_prob(samples.states[:, t], samples.actions[:, t])
        )


def test_rewards_belong_to_the_next_state(kit):
    # States are independent in time and r_t = s_{t+1}: a reward decoded from z_t would follow s_t instead.
    rng = np.random.default_rng(0)
    states, actions = rng.normal(size=(400, 4, 1)), rng.normal(size=(400, 3, 1))
    layouts = {"state_layout": kit.real(1), "action_layout": kit.real(1)}
    model = fit_vae_mdp(states, actions, states[:, 1:, 0], config=QUICK, rng=rng, **layouts)
    samples = model.sample(2000, rng=rng, policy=kit.GaussianPolicy())
    for t in range(3):
        assert np.corrcoef(samples.rewards[:, t], samples.states[:, t + 1, 0])[0, 1] > 0.7
        assert abs(np.corrcoef(samples.rewards[:, t], samples.states[:, t, 0])[0, 1]) < 0.2


def test_discrete_transitions_have_their_frequencies(kit):
    # Action 0 keeps the state with probability 0.8, action 1 moves it on by one with probability 0.8.
    rng = np.random.default_rng(0)
    m, steps = 500, 4
    states, actions = [rng.integers(3, size=m)], rng.integers(2, size=(m, steps))
    for t in range(steps):
        follows = rng.random(m) < 0.8
        states.append(np.where(follows, (states[-1] + actions[:, t]) % 3, (states[-1] + actions[:, t] + 1) % 3))
    s = np.stack(states, axis=1)
    model = fit_vae_mdp(
        kit.one_hot(s, 3),
        kit.one_hot(actions, 2),
        (s[:, 1:] == 2).astype(float),
        state_layout=Layout(3, (), ((0, 3),)),
        action_layout=Layout(2, (), ((0, 2),)),
        config=QUICK,
        rng=rng,
    )
    samples = model.sample(5000, rng=rng, policy=kit.UniformDiscrete(2))
    assert set(np.unique(samples.states)) == {0.0, 1.0}
    assert (samples.states.sum(-1) == 1).all()
    codes, chosen = samples.states.argmax(-1), samples.actions.argmax(-1)
    errors = []
    for state in range(3):
        for action in range(2):  # a model that forgets state and action is off by 0.47
            there = (codes[:, :-1] == state) & (chosen == action)
            frequencies = np.bincount(codes[:, 1:][there], minlength=3) / there.sum()
            expected = np.zeros(3)
            expected[(state + action) % 3], expected[(state + action + 1) % 3] = 0.8, 0.2
            np.testing.assert_allclose(frequencies, expected, atol=0.3)
            errors.append(np.abs(frequencies - expected).mean())
    assert np.mean(errors) < 0.12


def test_a_posterior_start_stays_near_its_start_state(kit, linear_system):
    model, spans, _, _ = linear_system
    first = spans[0][:, 0]
    policy = kit.GaussianPolicy()
    posterior = model.sample(
        len(first), rng=np.random.default_rng(0), policy=policy, start="posterior", start_states=first
    )
    prior = model.sample(len(first), rng=np.random.default_rng(0), policy=policy)

    def distance(samples):
        return np.abs(samples.states[:, 0] - first).mean()

    assert distance(posterior) < 0.7 * distance(prior)
    assert np.corrcoef(posterior.states[:, 1, 0], first[:, 0])[0, 1] > 0.4


def test_single_steps(kit):
    spans, _, _ = kit.linear_gaussian(np.random.default_rng(0), 30, 1)
    layouts = {"state_layout": kit.real(1), "action_layout": kit.real(1)}
    model = fit_vae_mdp(*spans, config=kit.tiny, rng=np.random.default_rng(0), **layouts)
    samples = model.sample(7, rng=np.random.default_rng(0), policy=kit.GaussianPolicy())
    shapes = [x.shape for x in (samples.states, samples.actions, samples.rewards, samples.log_prob, samples.lengths)]
    assert shapes == [(7, 2, 1), (7, 1, 1), (7, 1), (7, 1), (7,)]


def test_constant_columns_stay_what_they_are(kit):
    s, a, r = kit.random_spans(np.random.default_rng(0))
    s[..., 1], a[..., 0], r[:] = 1e6, -3.0, 7.0
    layouts = {"state_layout": kit.real(3), "action_layout": kit.real(2)}
    model = fit_vae_mdp(s, a, r, config=kit.tiny, rng=np.random.default_rng(0), **layouts)
    samples = model.sample(20, rng=np.random.default_rng(0), policy=kit.GaussianPolicy(width=2))
    assert (samples.states[..., 1] == 1e6).all()
    assert (samples.actions[..., 0] == -3.0).all()
    assert (samples.rewards == 7.0).all()


def test_values_stay_within_limits(kit, tiny_model):
    model, (s, a, r) = tiny_model
    wild = kit.GaussianPolicy(scale=100.0, width=2)
    samples = model.sample(300, rng=np.random.default_rng(0), policy=wild)
    for values, data in ((samples.states, s), (samples.actions, a), (samples.rewards[..., None], r[..., None])):
        low, high = data.min((0, 1)), data.max((0, 1))
        room = 0.1 * (high - low)
        assert (values >= low - room - 1e-9).all()
        assert (values <= high + room + 1e-9).all()
    # The log-probability is that of the action as clipped.
    np.testing.assert_array_equal(samples.log_prob[:, 0], wild.log_prob(samples.states[:, 0], samples.actions[:, 0]))
    inner = Limits.of(
        s.reshape(-1, 3), a.reshape(-1, 2), r.ravel(), margin=0.1, action_bounds=(np.full(2, -0.5), np.full(2, np.inf))
    )
    assert model.sample(300, rng=np.random.default_rng(0), policy=wild, limits=inner).actions.min() == -0.5


@pytest.mark.parametrize("noise", [True, False])
def test_what_is_constant_in_the_spans_stays_so_within_wider_limits(kit, noise):
    s, a, r = kit.random_spans(np.random.default_rng(0))
    s[..., 1], r[:] = 0.002, 0.0
    layouts = {"state_layout": kit.real(3), "action_layout": kit.real(2)}
    model = fit_vae_mdp(s, a, r, config=kit.tiny, rng=np.random.default_rng(1), **layouts)
    free = np.array([[0.0, 0.0, 0.0], [20.0, 0.01, 20.0]])
    limits = Limits.of(free, np.array([[-9.0] * 2, [9.0] * 2]), np.array([0.0, 1.0]), margin=0.1)
    arguments = {"policy": kit.GaussianPolicy(width=2), "limits": limits, "observation_noise": noise}
    samples = model.sample(50, rng=np.random.default_rng(0), **arguments)
    assert (samples.states[..., 1] == 0.002).all()
    assert (samples.rewards == 0).all()
    assert np.ptp(samples.states[..., 0]) > 0
    # a constant that the limits do not hold: the nearest value that they do
    low = Limits(limits.states, limits.actions, (0.5, 1.0))
    assert (model.sample(5, rng=np.random.default_rng(0), **arguments | {"limits": low}).rewards == 0.5).all()


def test_recorded_actions_are_replayed(kit, tiny_model):
    model, (_, actions, _) = tiny_model
    samples = model.sample(12, rng=np.random.default_rng(0), actions=actions)
    np.testing.assert_array_equal(samples.actions, actions)
    assert np.isnan(samples.log_prob).all()
    policy = kit.GaussianPolicy(width=2)
    scored = model.sample(12, rng=np.random.default_rng(0), actions=actions, policy=policy)
    np.testing.assert_array_equal(scored.log_prob[:, 1], policy.log_prob(scored.states[:, 1], actions[:, 1]))


def test_without_observation_noise_the_heads_give_their_means(kit, linear_system):
    model, spans, _, _ = linear_system
    actions = np.repeat(spans[1][:1], 2000, axis=0)
    noisy, clean = (
        model.sample(2000, rng=np.random.default_rng(0), actions=actions, observation_noise=noise).states
        for noise in (True, False)
    )
    assert clean[:, 1:].std() < noisy[:, 1:].std()
    np.testing.assert_allclose(clean.mean(0), noisy.mean(0), atol=0.1)


def test_sampled_ends(kit):
    # Spans end after 2 steps or after 6, half of them each.
    rng = np.random.default_rng(0)
    s, a, r = kit.random_spans(rng, m=200, steps=6)
    mask, terminal = np.ones((200, 6), dtype=bool), np.zeros((200, 6), dtype=bool)
    mask[::2, 2:], terminal[::2, 1], terminal[1::2, 5] = False, True, True
    s[::2, 2] += 30  # the last state tells
    s[1::2, 6] += 30
    layouts = {"state_layout": kit.real(3), "action_layout": kit.real(2)}
    model = fit_vae_mdp(s, a, r, mask=mask, terminal=terminal, config=QUICK, rng=rng, **layouts)
    lengths = model.sample(1000, rng=rng, policy=kit.GaussianPolicy(width=2)).lengths
    assert 0.25 < (lengths == 2).mean() < 0.7
    assert (lengths == 6).mean() > 0.3
    restored = FittedVAEMDP.from_arrays(model.to_arrays(), config=QUICK)
    assert restored.network.ends


def test_storage_gives_the_same_samples_byte_for_byte(kit, tiny_model):
    model, _ = tiny_model
    restored = FittedVAEMDP.from_arrays(model.to_arrays(), config=kit.tiny, name="restored")
    assert restored.name == "restored"
    assert restored.learning_rate == model.learning_rate
    np.testing.assert_array_equal(restored.history.train, model.history.train)
    policy = kit.GaussianPolicy(width=2)
    one, other = (m.sample(9, rng=np.random.default_rng(5), policy=policy) for m in (model, restored))
    assert all(x.tobytes() == y.tobytes() for x, y in zip(vars(one).values(), vars(other).values(), strict=True))


SCRIPT = """
import hashlib
import numpy as np
from oat_gym.generation import BehaviorConfig, VAEMDPConfig, fit_behavior, fit_vae_mdp
from oat_gym.spaces import Layout

rng = np.random.default_rng(0)
s, a = rng.normal(size=(9, 4, 2)), rng.normal(size=(9, 3, 1))
layouts = {"state_layout": Layout(2, (0, 1), ()), "action_layout": Layout(1, (0,), ())}
flat = s[:, :-1].reshape(-1, 2), a.reshape(-1, 1)
policy = fit_behavior(*flat, config=BehaviorConfig(max_updates=20), rng=rng, **layouts)
model = fit_vae_mdp(s, a, s[:, 1:, 0], config=VAEMDPConfig(max_updates=10), rng=rng, **layouts)
samples = model.sample(20, rng=rng, policy=policy)
digest = hashlib.sha256(b"".join(x.tobytes() for x in vars(samples).values())).hexdigest()
"""


def test_a_fresh_process_gives_the_same_bytes():
    here: dict[str, str] = {}
    exec(SCRIPT, here)
    threads = "import torch\ntorch.set_num_threads(2)\n"  # nor does the number of threads matter
    done = subprocess.run(
        [sys.executable, "-c", threads + SCRIPT + "print(digest)"],
        capture_output=True,
        text=True,
        check=True,
        env={"PYTHONPATH": ":".join(sys.path)},
    )
    assert done.stdout.strip() == here["digest"]
    assert len(done.stdout.strip()) == hashlib.sha256().digest_size * 2


def test_a_model_that_is_no_good_is_named(kit, tiny_model):
    model = tiny_model[0]
    broken = {name: torch.full_like(weight, torch.nan) for name, weight in model.weights.items()}
    with pytest.raises(TrainingError, match="PST set 0: a generated state is not finite"):
        dataclasses.replace(model, weights=broken).sample(3, rng=np.random.default_rng(0), actions=np.zeros((3, 4, 2)))


def test_wrong_arguments_are_refused(kit, tiny_model):
    model, rng, policy = tiny_model[0], np.random.default_rng(0), kit.GaussianPolicy(width=2)
    with pytest.raises(ConfigurationError, match="needs a policy"):
        model.sample(3, rng=rng)
    with pytest.raises(ConfigurationError, match="count must be at least 1"):
        model.sample(0, rng=rng, policy=policy)
    with pytest.raises(ConfigurationError, match='"posterior" with them'):
        model.sample(3, rng=rng, policy=policy, start="posterior")
    with pytest.raises(ConfigurationError, match="with start_states"):
        model.sample(3, rng=rng, policy=policy, start_states=np.zeros((3, 3)))
    with pytest.raises(InvalidDataError, match=r"actions must be finite, of shape \(3, 4, 2\)"):
        model.sample(3, rng=rng, actions=np.zeros((3, 5, 2)))
    with pytest.raises(InvalidDataError, match="policy must return finite actions"):
        model.sample(3, rng=rng, policy=kit.GaussianPolicy(width=1))
