"""Several policies together equal each one alone, whatever is stacked."""

import tracemalloc
from itertools import pairwise

import numpy as np
import pytest
from gymnasium import spaces

from oat_gym import ope
from oat_gym.errors import ConfigurationError
from oat_gym.ope.mlp_policy import MLPStack
from oat_gym.ope.policies import TabularStack
from oat_gym.ope.policy import streams

BOX = spaces.Box(-1, 1, (3,))


def perceptron(seed: int, *, hidden: tuple[int, ...] = (16, 16), **settings) -> ope.MLPPolicy:
    generator = np.random.default_rng(seed)

    def layer(inputs: int, outputs: int) -> tuple[np.ndarray, np.ndarray]:
        return generator.normal(size=(outputs, inputs)) / np.sqrt(inputs), 0.3 * generator.normal(size=outputs)

    layers = tuple(layer(a, b) for a, b in pairwise((5, *hidden)))
    return ope.MLPPolicy(layers, layer(hidden[-1], 3), layer(hidden[-1], 3), action_space=BOX, **settings)


def check_equal_to_each(policies: list[ope.Policy], observations: np.ndarray, actions: np.ndarray) -> None:
    """Compare mean, log_prob and sample of the set with those of each policy; the set is evaluated twice.

    Several samples at once are those of as many calls, to the last bit, and leave the generator where these leave it.
    """
    together = ope.PolicySet.of(policies)
    rngs = streams(np.random.default_rng(11), len(policies))
    sampled = together.sample(observations, rng=np.random.default_rng(11))
    means, log_probs = together.mean(observations), together.log_prob(observations, actions)
    for p, policy in enumerate(policies):
        np.testing.assert_allclose(means[p], policy.mean(observations), atol=1e-6)
        np.testing.assert_allclose(sampled[p], policy.sample(observations, rng=rngs[p]), atol=1e-6)
        np.testing.assert_allclose(log_probs[p], policy.log_prob(observations, actions), rtol=1e-9, atol=1e-6)
    np.testing.assert_array_equal(sampled, together.sample(observations, rng=np.random.default_rng(11)))
    assert not np.array_equal(sampled, together.sample(observations, rng=np.random.default_rng(12)))
    once, often = np.random.default_rng(11), np.random.default_rng(11)
    several = together.samples(observations, 3, rng=once)
    for j in range(3):
        np.testing.assert_array_equal(several[:, j], together.sample(observations, rng=often))
    assert once.bit_generator.state == often.bit_generator.state


@pytest.mark.parametrize(
    "settings", [{}, {"nonlinearity": "relu"}, {"censored": True}, {"squash": True}, {"hidden": (700,)}]
)
def test_stacked_perceptrons_equal_each_alone(settings: dict) -> None:
    policies = [perceptron(seed, **settings) for seed in range(4)]
    generator = np.random.default_rng(0)
    observations, actions = generator.normal(size=(1500, 5)), generator.uniform(-1.2, 1.2, size=(1500, 3))
    assert len(ope.PolicySet.of(policies)._groups) == 1
    assert isinstance(ope.PolicySet.of(policies)._groups[0][1], MLPStack)
    check_equal_to_each(policies, observations, actions)


def test_stacked_tables_equal_each_alone() -> None:
    generator = np.random.default_rng(0)
    tables = [generator.dirichlet(np.ones(4), size=6) for _ in range(3)]
    policies = [ope.TabularPolicy(table, first_action=2) for table in tables]
    states, actions = generator.integers(0, 6, size=200), generator.integers(2, 6, size=200)
    assert isinstance(ope.PolicySet.of(policies)._groups[0][1], TabularStack)
    check_equal_to_each(policies, states, actions)
    np.testing.assert_array_equal(ope.PolicySet.of(policies).probabilities(states), np.stack(tables)[:, states])


def test_a_mixed_set_keeps_the_order_of_its_policies() -> None:
    policies: list[ope.Policy] = [
        perceptron(0),
        ope.GaussianPolicy(lambda s: s[:, :3], 0.2, action_space=BOX),
        perceptron(1, hidden=(8,)),
        perceptron(2),
        perceptron(3, nonlinearity="relu"),
        perceptron(4),
    ]
    together = ope.PolicySet.of(policies)
    assert [numbers for numbers, _ in together._groups] == [(0, 3, 5), (1,), (2,), (4,)]
    generator = np.random.default_rng(0)
    check_equal_to_each(policies, generator.normal(size=(40, 5)), generator.uniform(-1, 1, size=(40, 3)))


def test_deterministic_and_stochastic_policies_are_not_confused() -> None:
    policies = [perceptron(0), perceptron(0, deterministic=True)]
    drawn = ope.PolicySet.of(policies).sample(np.zeros((5, 5)), rng=np.random.default_rng(0))
    np.testing.assert_array_equal(drawn[1], policies[1].mean(np.zeros((5, 5))))
    assert not np.array_equal(drawn[0], drawn[1])


def test_policies_with_other_bounds_are_not_stacked() -> None:
    wide = perceptron(0)
    narrow = ope.MLPPolicy(wide.hidden, wide.mean_layer, wide.log_std_layer, action_space=spaces.Box(-0.1, 0.1, (3,)))
    means = ope.PolicySet.of([wide, narrow]).mean(np.ones((4, 5)))
    assert np.abs(means[1]).max() <= np.float32(0.1) < np.abs(means[0]).max()


def test_what_a_policy_draws_does_not_depend_on_the_others() -> None:
    first, second = perceptron(0), perceptron(1)
    alone = ope.PolicySet.of([first]).sample(np.zeros((6, 5)), rng=np.random.default_rng(3))
    pair = ope.PolicySet.of([first, second]).sample(np.zeros((6, 5)), rng=np.random.default_rng(3))
    np.testing.assert_allclose(alone[0], pair[0], atol=1e-6)
    turned = ope.PolicySet.of([second, first]).sample(np.zeros((6, 5)), rng=np.random.default_rng(3))
    np.testing.assert_allclose(turned[::-1], pair, atol=1e-6)


def test_sampling_does_not_depend_on_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    together, states = ope.PolicySet.of([perceptron(0), perceptron(1)]), np.ones((50, 5))
    whole = together.sample(states, rng=np.random.default_rng(0))
    monkeypatch.setattr("oat_gym.ope.mlp_policy._CHUNK", 7 * 2 * 16)
    np.testing.assert_allclose(whole, together.sample(states, rng=np.random.default_rng(0)), atol=1e-6)


def test_memory_of_a_large_batch_is_little_more_than_its_result() -> None:
    together = ope.PolicySet.of([perceptron(seed) for seed in range(11)])
    states = np.zeros((70_000, 5))
    together.mean(states[:10])
    tracemalloc.start()
    result = together.mean(states)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert result.nbytes == 11 * 70_000 * 3 * 4
    assert peak < result.nbytes + 10e6


def test_names_and_kinds_are_checked() -> None:
    with pytest.raises(ConfigurationError, match="different names"):
        ope.PolicySet(("a", "a"), (perceptron(0), perceptron(1)))
    with pytest.raises(ConfigurationError, match="must have sample"):
        ope.PolicySet.of({"a": "no policy"})  # type: ignore[dict-item]
    mixed = ope.PolicySet.of([ope.TabularPolicy([[1.0]]), ope.FunctionPolicy(int, spaces.Discrete(1))])
    assert mixed.probabilities(np.zeros(1, dtype=int)) is None
