"""FQE: exact solutions, exact gradients, and the rules of terminal states, horizons, seeds and intervals."""

import contextlib
import warnings
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import torch

from oat_gym.errors import ConfigurationError, EstimationWarning, InvalidDataError
from oat_gym.ope import FQE, Problem
from oat_gym.ope import _q_tabular as tabular
from oat_gym.ope._deviation import deviation
from oat_gym.ope._fqe_network import Architecture, backward, first_weights, forward, views
from oat_gym.ope._q_data import QData, RewardScale
from oat_gym.ope._q_function import action_choices, step_weights, value_scale
from oat_gym.ope._q_linear import FeatureMap, finite_weights, infinite_weights
from oat_gym.ope.fqe import _reasons
from tests.ope import mdps

SMALL = FQE(approximation="network", hidden=(32, 32), updates=1500, batch_size=128, learning_rate=3e-3, tau=0.05)


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", EstimationWarning)
        yield


def make_problem(n: int = 2000, *, horizon: int | None = None, gamma: float = 0.9, features=None, **kwargs) -> Problem:
    mdp = mdps.random_mdp(seed=3)
    policies = [mdps.random_policy(mdp, seed=1), mdps.random_policy(mdp, seed=2)]
    behavior = mdps.random_policy(mdp, seed=4, concentration=4.0)
    logs = mdps.sample_logs(mdp, behavior, n, 30, np.random.default_rng(0))
    return mdps.problem(logs, mdp, policies, behavior, gamma=gamma, horizon=horizon, features=features, **kwargs)


def truths(*, horizon: int | None = None, gamma: float = 0.9) -> np.ndarray:
    mdp = mdps.random_mdp(seed=3)
    return np.array([mdps.value(mdp, mdps.random_policy(mdp, seed=s), gamma, horizon) for s in (1, 2)])


def expected_rows(mdp: mdps.MDP):
    """Every transition once, weighted by its probability: an infinite data set that visits all pairs."""
    s, a, t = np.nonzero(mdp.transitions * ~mdp.terminal[:, None, None])
    return (s, a, mdp.rewards[s, a, t], t, mdp.terminal[t]), mdp.transitions[s, a, t]


def expected_model(mdp: mdps.MDP) -> tabular.EmpiricalModel:
    rows, weights = expected_rows(mdp)
    return tabular.empirical_model(*rows, weights=weights, shape=(mdp.n_states, mdp.n_actions))


# --- closed forms ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mdp", [mdps.chain(), mdps.random_mdp(12, 4, n_terminal=2)], ids=["chain", "random"])
def test_tables_equal_the_linear_solve_and_the_backward_recursion(mdp: mdps.MDP) -> None:
    policy, model = mdps.random_policy(mdp), expected_model(mdp)
    exact = mdps.state_values(mdp, policy, 0.97)
    np.testing.assert_allclose(tabular.infinite_values(model, policy, 0.97), exact, atol=1e-12)
    finite = tabular.finite_values(model, policy, 0.97, 25)
    for h in (0, 1, 7, 25):
        np.testing.assert_allclose(finite[h], mdps.state_values(mdp, policy, 0.97, h), atol=1e-12)
    function = tabular.TabularQ(model, finite[None], 0.97)
    s, a = (grid.ravel() for grid in np.meshgrid(range(mdp.n_states), range(mdp.n_actions), indexing="ij"))
    for h in (1, 9):
        q = function.q(np.eye(mdp.n_states)[s], np.eye(mdp.n_actions)[a], np.full(len(s), h))[0]
        np.testing.assert_allclose(q, mdps.action_values(mdp, policy, 0.97, h).ravel(), atol=1e-12)


@pytest.mark.parametrize("approximation", ["tabular", "linear"])
@pytest.mark.parametrize("horizon", [None, 8])
def test_closed_forms_are_exact_in_the_empirical_process(approximation: str, horizon: int | None) -> None:
    problem = make_problem(3000, horizon=horizon)
    steps = problem.data.steps
    mdp = mdps.random_mdp(seed=3)
    counts, totals = np.zeros((2, mdp.n_states, mdp.n_actions, mdp.n_states))
    index = (steps.observations, steps.actions, steps.next_observations)
    np.add.at(counts, index, 1.0)
    np.add.at(totals, index, steps.rewards)
    visited = counts.sum(axis=2, keepdims=True)
    empirical = mdps.MDP(
        np.divide(counts, visited, out=np.zeros_like(counts), where=visited > 0),
        np.divide(totals, counts, out=np.zeros_like(counts), where=counts > 0),
        np.bincount(problem.initial, minlength=mdp.n_states) / len(problem.initial),
        mdp.terminal,
    )
    expected = [mdps.value(empirical, mdps.random_policy(mdp, seed=s), 0.9, horizon) for s in (1, 2)]
    estimates = FQE(approximation=approximation, ridge=0.0).estimate(problem, seeds=(0,))[0]
    np.testing.assert_allclose(estimates.values, expected, atol=1e-9)
    assert np.abs(estimates.values - truths(horizon=horizon)).max() < 0.1


def test_lstd_equals_its_definition_by_fixed_point() -> None:
    rng = np.random.default_rng(0)
    phi, after, rewards = rng.normal(size=(50, 3)), 0.5 * rng.normal(size=(50, 3)), rng.normal(size=50)
    settings = {"gamma": 0.9, "ridge": 0.0, "weights": np.ones(50)}
    theta = infinite_weights(phi, after, rewards, **settings)
    projected = np.linalg.lstsq(phi, rewards + 0.9 * after @ theta, rcond=None)[0]
    np.testing.assert_allclose(theta, projected, atol=1e-10)
    finite = finite_weights(phi, after, rewards, horizon=60, **settings)
    np.testing.assert_allclose(finite[3], np.linalg.lstsq(phi, rewards + 0.9 * after @ finite[2], rcond=None)[0])
    np.testing.assert_allclose(finite[60], theta, atol=1e-6)  # iteration converges where the operator contracts


def test_values_of_pairs_that_the_data_lacks_are_reported() -> None:
    mdp = mdps.chain()
    right = np.tile([0.0, 1.0], (mdp.n_states, 1))
    stay = np.tile([1.0, 0.0], (mdp.n_states, 1))
    logs = mdps.sample_logs(mdp, right, 300, 40, np.random.default_rng(0))
    problem = mdps.problem(logs, mdp, [right, stay, mdps.mix(right, stay, 0.5)], right, gamma=0.9)
    with pytest.warns(EstimationWarning, match="policy-1, policy-2 does what the data does not hold"):
        estimates = FQE().estimate(problem, seeds=(0,))[0]
    mass = [numbers["unsupported_mass"] for numbers in estimates.diagnostics]
    assert mass[0] == 0.0
    assert mass[1] == pytest.approx(1.0)  # the first action is already unknown
    assert 0.5 < mass[2] < 1.0
    np.testing.assert_allclose(estimates.values, estimates.values[0])  # all are kept to what was ever done


@pytest.mark.parametrize("horizon", [None, 5])
def test_values_under_the_supported_policy_are_the_means_of_its_action_values(horizon: int | None) -> None:
    mdp = mdps.random_mdp(8, 5, seed=1)
    policy, behavior = mdps.random_policy(mdp, seed=2), mdps.random_policy(mdp, seed=3, concentration=0.3)
    logs = mdps.sample_logs(mdp, behavior, 25, 20, np.random.default_rng(0))
    problem = mdps.problem(logs, mdp, [policy], behavior, gamma=0.9, horizon=horizon, n_resamples=2)
    with quiet():
        fit = FQE().fit_q(problem, seeds=(0,))[0]
    model = fit.function.model
    assert 0 < (model.visits[~mdp.terminal] == 0).sum() < 20
    kept = tabular.supported_policy(model, policy)
    pairs = np.eye(8)[np.repeat(np.arange(8), 5)], np.eye(5)[np.tile(np.arange(5), 8)]
    steps = None if horizon is None else np.full(40, horizon)
    table = fit.function.q(*pairs, steps)[0].reshape(8, 5)
    values = fit.function.values[0] if horizon is None else fit.function.values[0, -1]
    np.testing.assert_allclose((policy * table).sum(axis=1), values)  # pi itself, not only what is kept of it
    np.testing.assert_allclose((kept * table).sum(axis=1)[kept.any(axis=1)], values[kept.any(axis=1)])
    assert fit.values[0] == pytest.approx(values[problem.initial].mean())


def test_gamma_one_needs_an_end() -> None:
    loop = tabular.empirical_model(
        np.array([0]), np.array([0]), np.array([1.0]), np.array([0]), np.array([False]), shape=(1, 1)
    )
    with pytest.raises(InvalidDataError, match="no solution"):
        tabular.infinite_values(loop, np.ones((1, 1)), 1.0)
    problem = make_problem(200, gamma=1.0)
    cut = replace(problem.data.steps, terminated=np.zeros(len(problem.data.steps), dtype=bool))
    with pytest.raises(ConfigurationError, match="needs data whose every episode terminates"):
        value_scale(replace(problem, data=replace(problem.data, steps=cut)))


# --- networks --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("hidden", [(5,), (6, 4), (5, 4, 3)])
@pytest.mark.parametrize("heads", [1, 3])
def test_the_backward_pass_equals_autograd(hidden: tuple[int, ...], heads: int) -> None:
    architecture = Architecture(7, hidden, heads)
    flat = first_weights(architecture, [torch.Generator().manual_seed(s) for s in (0, 1)], 2).double()
    flat += 0.1 * torch.randn(flat.shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    x, upstream = (
        torch.randn(4, 9, width, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
        for width in (7, heads)
    )
    assert len(flat) == 4 * architecture.size
    gradient = torch.full_like(flat, torch.nan)
    layers = views(flat, architecture, 4)
    backward(layers, forward(layers, x), upstream, views(gradient, architecture, 4))

    leaf = flat.clone().requires_grad_(True)
    out = x
    for number, (weight, bias) in enumerate(views(leaf, architecture, 4)):
        out = out @ weight + bias
        out = out.relu() if number < len(hidden) else out
    (out * upstream).sum().backward()
    torch.testing.assert_close(gradient, leaf.grad, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("horizon", [None, 6])
def test_networks_come_to_the_values(horizon: int | None) -> None:
    features = np.random.default_rng(0).normal(size=(6, 4))
    problem = make_problem(horizon=horizon, features=features)
    assert FQE().form(problem) == "network"
    exact = FQE().estimate(make_problem(horizon=horizon), seeds=(0,))[0]  # of the same data, without approximation
    estimates = replace(SMALL, updates=2500, ensemble=2).estimate(problem, seeds=(0,))[0]
    np.testing.assert_allclose(estimates.values, exact.values, atol=0.08)
    np.testing.assert_allclose(estimates.replicates, exact.replicates, atol=0.15)


def test_sampled_actions_come_to_the_same_values() -> None:
    class Sampled:
        def __init__(self, table: mdps.Table) -> None:
            self.sample, self.mean, self.log_prob = table.sample, table.mean, table.log_prob

    problem = make_problem()
    unknown = replace(problem.policies, policies=tuple(Sampled(policy) for policy in problem.policies.policies))
    sampled = replace(problem, policies=unknown)
    assert FQE().form(sampled) == "network"
    rng = np.random.default_rng(0)
    choices = action_choices(sampled, sampled.initial, draws=5, rng=rng)
    assert choices.actions.shape == (5, 2, 2000, 3)
    exact = FQE().estimate(problem, seeds=(0,))[0].values
    linear = FQE(approximation="linear", action_draws=30).estimate(sampled, seeds=(0,))[0].values
    np.testing.assert_allclose(linear, exact, atol=0.05)
    with pytest.raises(ConfigurationError, match="tabular' needs Discrete"):
        FQE(approximation="tabular").estimate(sampled, seeds=(0,))


@pytest.mark.parametrize("approximation", ["tabular", "linear", "network"])
@pytest.mark.parametrize(
    ("terminates", "horizon", "expected"), [(True, None, 1.0), (False, None, 5.0), (False, 3, 2.44)]
)
def test_terminal_states_end_and_truncations_go_on(
    approximation: str, terminates: bool, horizon: int | None, expected: float
) -> None:
    once = mdps.MDP(np.ones((1, 1, 1)), np.ones((1, 1, 1)), np.ones(1), np.zeros(1, dtype=bool))
    logs = mdps.sample_logs(once, np.ones((1, 1)), 50, 1, np.random.default_rng(0))
    logs = replace(logs, terminated=np.full(50, terminates))
    problem = mdps.problem(logs, once, [np.ones((1, 1))], np.ones((1, 1)), gamma=0.8, horizon=horizon)
    fqe = FQE(approximation=approximation, hidden=(16,), updates=400, learning_rate=3e-3, tau=0.05)
    assert fqe.estimate(problem, seeds=(0,))[0].values[0] == pytest.approx(expected, abs=0.02)


def test_a_seed_does_not_depend_on_the_others_and_an_ensemble_is_a_mean() -> None:
    problem = make_problem(300, features=np.random.default_rng(0).normal(size=(6, 4)))
    with quiet():
        fqe = replace(SMALL, updates=150, ensemble=2)
        several = fqe.fit_q(problem, seeds=(0, 1, 2))
        alone = fqe.fit_q(problem, seeds=(1,))[0]
    np.testing.assert_allclose(several[1].values, alone.values, rtol=1e-4)
    assert not np.allclose(several[0].values, alone.values, rtol=1e-2)
    members = alone.function.member_q(problem.data.states, problem.data.actions, None)
    assert members.shape == (2, 2, len(problem.data.steps))
    mean = alone.function.q(problem.data.states, problem.data.actions, None)
    np.testing.assert_allclose(members.mean(axis=0), mean)
    assert alone.diagnostics[0]["ensemble_sd"] > 0


def test_no_steps_to_go_are_worth_nothing() -> None:
    problem = make_problem(200, horizon=5)
    with quiet():
        function = replace(SMALL, updates=20).fit_q(problem, seeds=(0,))[0].function
    states, actions = problem.data.states, problem.data.actions
    assert (function.q(states, actions, np.zeros(len(states), dtype=np.int64)) == 0).all()
    assert (function.q(states, actions, np.full(len(states), 2)) != 0).all()


# --- intervals, warnings, settings -----------------------------------------------------------------------------------


def test_intervals_cover_training_only_with_bootstrap() -> None:
    problem = make_problem(200, n_resamples=40)
    held, refitted = FQE().estimate(problem, seeds=(0,))[0], FQE(bootstrap=True).estimate(problem, seeds=(0,))[0]
    assert held.diagnostics[0]["interval_covers_training"] == 0.0
    assert refitted.diagnostics[0]["interval_covers_training"] == 1.0
    np.testing.assert_array_equal(held.values, refitted.values)
    assert (refitted.replicates.std(axis=1) > 1.5 * held.replicates.std(axis=1)).all()
    # the error over many data sets is what the refitted replicates show
    values = [FQE().estimate(replace_logs(problem, seed), seeds=(0,))[0].values for seed in range(1, 41)]
    ratio = refitted.replicates.std(axis=1) / np.std(values, axis=0)
    assert ((ratio > 0.6) & (ratio < 1.6)).all()


def replace_logs(problem: Problem, seed: int) -> Problem:
    mdp = mdps.random_mdp(seed=3)
    behavior = mdps.random_policy(mdp, seed=4, concentration=4.0)
    logs = mdps.sample_logs(mdp, behavior, 200, 30, np.random.default_rng(seed))
    tables = [policy.table for policy in problem.policies.policies]
    return mdps.problem(logs, mdp, tables, behavior, gamma=0.9, n_resamples=2)


def test_network_members_are_trained_on_resamples() -> None:
    problem = make_problem(150, n_resamples=6)
    with quiet():
        fit = replace(SMALL, updates=60, ensemble=3, bootstrap=True).fit_q(problem, seeds=(0,))[0]
    states, remaining = problem.initial_states, None
    choices = action_choices(problem, problem.initial, draws=1, rng=np.random.default_rng(0))
    each = fit.function.v(states, choices, remaining)
    weights = problem.initial_weights()
    for b in range(6):
        np.testing.assert_allclose(fit.replicates[:, b], each[b % 3] @ weights[b], rtol=1e-6)
    with pytest.raises(ConfigurationError, match="ensemble must be 2 to 6"):
        replace(SMALL, bootstrap=True, ensemble=7).check(problem)


def test_values_that_have_not_settled_or_are_at_the_bounds_are_warned_of() -> None:
    features = np.eye(6)
    problem = make_problem(300, features=features, gamma=0.99)
    with pytest.warns(EstimationWarning, match="has not settled"):
        replace(SMALL, updates=200).estimate(problem, seeds=(0,))
    settled = {"late_change": 0.0, "share_clipped": 0.0}
    assert not _reasons(problem, SMALL, 3.0, settled, bounds=(-5.0, 5.0))
    clipped = settled | {"share_clipped": 0.3}
    for value, numbers, where in ((5.5, {}, "lies outside what"), (4.9, clipped, "is at the bounds that")):
        found = _reasons(problem, SMALL, value, numbers, bounds=(-5.0, 5.0))
        assert found == [f"{where} the data's rewards allow, -5 to 5"]


def test_targets_are_clipped_to_what_rewards_allow() -> None:
    problem = make_problem(100, features=np.eye(6))
    data = QData.of(problem)
    reward = RewardScale.of(data)
    assert reward.center == 0.0  # there are terminal states
    rewards = problem.data.steps.rewards
    np.testing.assert_allclose(reward.bounds(problem), [10 * rewards.min(), 10 * rewards.max()])
    going = RewardScale.of(replace(data, terminated=np.zeros_like(data.terminated)))
    assert going.center == pytest.approx(rewards.mean())
    np.testing.assert_allclose(going.bounds(problem), reward.bounds(problem))
    positive = RewardScale.of(replace(data, rewards=data.rewards - data.rewards.min() + 1.0))
    assert positive.bounds(problem)[0] == 0.0  # an early end is worth less than the least reward for ever


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"approximation": "forest"}, "approximation must be one of"),
        ({"hidden": ()}, "hidden must hold"),
        ({"updates": 0}, "updates must be at least 1"),
        ({"tau": 1.5}, "tau in"),
        ({"degree": 3}, "degree must be 1 or 2"),
    ],
)
def test_settings_are_checked(settings: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        FQE(**settings)


def test_the_dope_preset_has_the_reference_settings() -> None:
    dope = FQE.preset("dope")
    assert (dope.updates, dope.batch_size, dope.hidden) == (1_000_000, 256, (256, 256))
    assert (dope.learning_rate, dope.tau, dope.weight_decay) == (3e-4, 0.005, 1e-5)
    with pytest.raises(ConfigurationError, match="preset 'dope'"):
        FQE.preset("paper")


def test_discount_sums() -> None:
    np.testing.assert_allclose(step_weights(0.5, 3), [0.0, 1.0, 1.5, 1.75])
    np.testing.assert_allclose(step_weights(1.0, 3), [0.0, 1.0, 2.0, 3.0])


def test_constants_that_floats_cannot_hold_are_constants() -> None:
    # the standard deviation of 1,000 times 0.1 is 1e-17 and not 0
    problem = make_problem(300, features=np.eye(6), horizon=5)
    data = QData.of(problem)
    tenth = replace(data, rewards=np.full(len(data.rewards), 0.1))
    assert tenth.rewards.std() > 0
    assert RewardScale.of(tenth) == RewardScale(0.0, 1.0, 0.0, 0.1)
    going = RewardScale.of(replace(tenth, terminated=np.zeros_like(data.terminated)))
    assert (going.scale, going.low, going.high) == (1.0, going.low, going.low)
    assert RewardScale.of(replace(tenth, rewards=30 * tenth.rewards)).scale == 3.0
    assert RewardScale.of(data).scale == data.rewards.std()  # ordinary rewards: to the bit
    x = np.random.default_rng(0).normal(3.0, 1e-3, size=(1000, 3))
    x[:, 1] = 0.1
    np.testing.assert_array_equal(deviation(x), x.std(axis=0) * [1, 0, 1])
    scale = FeatureMap.of(x, x[:, :1], degree=1, discrete=True, one_hot=False).scale
    np.testing.assert_array_equal(scale, np.where([True, False, True], x.std(axis=0), 1.0))


def test_constant_rewards_are_worth_their_discounts() -> None:
    problem = make_problem(300, features=np.eye(6), horizon=5)
    steps = problem.data.steps
    constant = replace(steps, rewards=np.full(len(steps), 0.1), terminated=np.zeros_like(steps.terminated))
    assert constant.rewards.std() > 0
    problem = replace(problem, data=replace(problem.data, steps=constant))
    with quiet():
        found = replace(SMALL, updates=300).estimate(problem, seeds=(0,))[0]
    np.testing.assert_allclose(found.values, 0.1 * (1 - 0.9**5) / 0.1, rtol=0.02)
    ending = replace(problem, data=replace(problem.data, steps=replace(constant, terminated=steps.terminated)))
    with quiet():
        found = replace(SMALL, updates=300).estimate(ending, seeds=(0,))[0]
    assert (found.values > 0.1).all()
    assert (found.values < 0.1 * (1 - 0.9**5) / 0.1).all()
