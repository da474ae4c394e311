"""DICE: ratios with restarts are exact in tables; networks follow the Lagrangian and come near known values."""

import warnings
from dataclasses import FrozenInstanceError, replace

import numpy as np
import pytest
import torch

from oat_gym.errors import ConfigurationError, EstimationWarning, InvalidDataError, TrainingError
from oat_gym.ope import DICE, FQE, Problem
from oat_gym.ope import _q_tabular as tabular
from oat_gym.ope._dice_data import DiceBatches, encoder_of, ends
from oat_gym.ope._dice_tabular import discounted_visits, tabular_ratios
from oat_gym.ope._dice_training import SHIFT, Objective, Saddle
from oat_gym.ope._fqe_network import Architecture
from oat_gym.ope._q_data import QData
from tests.ope import linear, mdps

NETWORK = DICE(approximation="network", updates=1500, hidden=(32, 32))
TINY = replace(NETWORK, updates=40)


def make_problem(n: int = 1000, *, horizon: int | None = None, gamma: float = 0.9, **kwargs) -> Problem:
    mdp = mdps.random_mdp(seed=3)
    policies = [mdps.random_policy(mdp, seed=1), mdps.random_policy(mdp, seed=2)]
    behavior = mdps.random_policy(mdp, seed=4, concentration=4.0)
    logs = mdps.sample_logs(mdp, behavior, n, 30, np.random.default_rng(0))
    return mdps.problem(logs, mdp, policies, behavior, gamma=gamma, horizon=horizon, **kwargs)


def expected_model(mdp: mdps.MDP) -> tabular.EmpiricalModel:
    s, a, t = np.nonzero(mdp.transitions * ~mdp.terminal[:, None, None])
    weights, shape = mdp.transitions[s, a, t], (mdp.n_states, mdp.n_actions)
    return tabular.empirical_model(s, a, mdp.rewards[s, a, t], t, mdp.terminal[t], weights=weights, shape=shape)


# --- exact -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mdp", [mdps.chain(), mdps.random_mdp(12, 4, n_terminal=2)], ids=["chain", "random"])
@pytest.mark.parametrize(("gamma", "horizon"), [(0.97, None), (1.0, None), (0.97, 9), (1.0, 9)])
def test_discounted_visits_equal_the_occupancy(mdp: mdps.MDP, gamma: float, horizon: int | None) -> None:
    policy = mdps.random_policy(mdp, concentration=3.0)
    visits = discounted_visits(expected_model(mdp), policy, mdp.initial, gamma, horizon)
    np.testing.assert_allclose(visits, mdps.occupancy(mdp, policy, gamma, horizon), atol=1e-10)


@pytest.mark.parametrize("gamma", [0.9, 1.0])
def test_the_restarted_process_has_the_alive_occupancy(gamma: float) -> None:
    mdp = mdps.random_mdp(seed=3)
    policy = mdps.random_policy(mdp, seed=1)
    visits = mdps.occupancy(mdp, policy, gamma)
    share = visits / visits.sum()
    ending = 1.0 - mdp.continuing.sum(axis=2)
    start = mdp.initial[:, None] * policy
    arrive = np.einsum("sa,sat->t", share, mdp.continuing)[:, None] * policy
    tau = (share * ending).sum()
    np.testing.assert_allclose(share, (1 - gamma) * start + gamma * (arrive + tau * start), atol=1e-12)
    assert visits.sum() == pytest.approx(1 / (1 - gamma + gamma * tau))


@pytest.mark.parametrize("horizon", [None, 8])
def test_ratios_average_one_and_are_those_of_the_occupancies(horizon: int | None) -> None:
    problem, mdp = make_problem(4000, horizon=horizon), mdps.random_mdp(seed=3)
    table = np.stack([mdps.random_policy(mdp, seed=s) for s in (1, 2)])
    ratios = tabular_ratios(problem, QData.of(problem), table)
    np.testing.assert_allclose(ratios.zeta.mean(axis=1), 1.0)
    steps = problem.data.steps
    logged = np.zeros((mdp.n_states, mdp.n_actions))
    np.add.at(logged, (steps.observations, steps.actions), 1 / len(steps))
    for policy, zeta in zip(table, ratios.zeta, strict=True):
        visits = mdps.occupancy(mdp, policy, 0.9, horizon)
        truth = (visits / visits.sum() / np.where(logged > 0, logged, 1.0))[steps.observations, steps.actions]
        assert np.abs(zeta - truth).mean() < 0.06
        assert np.corrcoef(zeta, truth)[0, 1] > 0.99


@pytest.mark.parametrize(("gamma", "horizon"), [(0.9, None), (0.9, 8), (1.0, 8), (1.0, None)])
def test_tables_give_the_value_of_the_empirical_process(gamma: float, horizon: int | None) -> None:
    problem = make_problem(gamma=gamma, horizon=horizon)
    mine, theirs = (config.estimate(problem, seeds=(0,))[0] for config in (DICE(), FQE(approximation="tabular")))
    np.testing.assert_allclose(mine.values, theirs.values, atol=1e-9)
    assert all(d["mean_ratio"] == pytest.approx(1.0) for d in mine.diagnostics)


def test_on_policy_replicates_are_weighted_means_with_the_ratios_fixed() -> None:
    problem = make_problem(200, horizon=5)
    estimates = DICE().estimate(problem, seeds=(0,))[0]
    mdp = mdps.random_mdp(seed=3)
    table = np.stack([mdps.random_policy(mdp, seed=s) for s in (1, 2)])
    ratios = tabular_ratios(problem, QData.of(problem), table)
    weights = ratios.zeta * problem.resamples[7][problem.data.steps.episode]
    expected = ratios.mass * (weights @ problem.data.steps.rewards) / weights.sum(axis=1)
    np.testing.assert_allclose(estimates.replicates[:, 7], expected)
    assert estimates.diagnostics[0]["interval_covers_training"] == 0.0


def test_what_the_data_lacks_is_reported() -> None:
    mdp = mdps.chain()
    right = np.tile([0.0, 1.0], (mdp.n_states, 1))
    stay = np.tile([1.0, 0.0], (mdp.n_states, 1))
    logs = mdps.sample_logs(mdp, right, 300, 40, np.random.default_rng(0))
    problem = mdps.problem(logs, mdp, [right, stay, mdps.mix(right, stay, 0.5)], right, gamma=0.9)
    with pytest.warns(EstimationWarning) as caught:
        estimates = DICE().estimate(problem, seeds=(0,))[0]
    assert any("policy-1, policy-2 does what the data does not hold" in str(w.message) for w in caught)
    mass = [numbers["unsupported_mass"] for numbers in estimates.diagnostics]
    assert mass[0] == 0.0
    assert mass[1] == pytest.approx(1.0)
    assert 0.5 < mass[2] < 1.0
    np.testing.assert_allclose(estimates.values, estimates.values[0])  # kept to the one action that was ever taken


def with_other_copies(problem: Problem) -> Problem:
    """Add synthetic copies of the long episodes only, which change the distribution of steps."""
    data, steps = problem.data, problem.data.steps
    chosen = np.flatnonzero(data.lengths > 5)
    rows = data.rows_of(data.lengths > 5)
    names = ("observations", "actions", "rewards", "next_observations", "terminated", "truncated", "step")
    columns = {name: np.concatenate((getattr(steps, name), getattr(steps, name)[rows])) for name in names}
    number = np.repeat(len(data) + np.arange(len(chosen)), data.lengths[chosen])
    lengths = np.concatenate((data.lengths, data.lengths[chosen]))
    columns |= {"episode": np.concatenate((steps.episode, number))}
    columns |= {"synthetic": np.arange(len(steps) + len(rows)) >= len(steps)}
    synthetic, unit = np.arange(len(lengths)) >= len(data), np.concatenate((data.unit, data.unit[chosen]))
    offsets = np.concatenate(([0], np.cumsum(lengths)))
    logged = replace(data, steps=replace(steps, **columns), unit=unit, synthetic=synthetic, offsets=offsets)
    return replace(problem, data=logged)


@pytest.mark.parametrize("config", [DICE(), TINY], ids=["tabular", "network"])
def test_steps_are_averaged_where_the_ratios_were_trained(config: DICE) -> None:
    # the process of the copies is the real one, and only the distribution of steps another: values stay right
    problem = with_other_copies(make_problem(400, horizon=6))
    exact = DICE().estimate(replace(problem, use_augmented=frozenset()), seeds=(0,))[0]
    found = []
    for parts in (frozenset({"training"}), frozenset({"training", "weights"})):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", EstimationWarning)
            found.append(config.estimate(replace(problem, use_augmented=parts), seeds=(0,))[0])
    np.testing.assert_array_equal(found[0].values, found[1].values)
    if config == DICE():
        np.testing.assert_allclose(found[0].values, exact.values, atol=0.2)
        assert [own["mean_ratio"] for own in found[0].diagnostics] == pytest.approx([1.0, 1.0])


# --- networks --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("preset", ["bestdice", "dualdice", "gendice"])
def test_every_preset_finds_the_values(preset: str) -> None:
    problem = make_problem()
    config = replace(DICE.preset(preset), approximation="network", updates=1500, hidden=(32, 32))
    exact = DICE().estimate(problem, seeds=(0,))[0]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", EstimationWarning)  # few updates
        estimates = config.estimate(problem, seeds=(0,))[0]
    np.testing.assert_allclose(estimates.values, exact.values, atol=0.2)
    for own, table in zip(estimates.diagnostics, exact.diagnostics, strict=True):
        assert own["mean_ratio"] == pytest.approx(1.0, abs=0.15)
        assert own["time_alive"] == pytest.approx(table["time_alive"], rel=0.05)


def test_a_horizon_counts_its_steps_only() -> None:
    problem = make_problem(horizon=8)
    exact = DICE().estimate(problem, seeds=(0,))[0]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", EstimationWarning)
        estimates = replace(NETWORK, hidden=(64, 64)).estimate(problem, seeds=(0,))[0]
    np.testing.assert_allclose(estimates.values, exact.values, atol=0.25)
    assert estimates.diagnostics[0]["time_alive"] == pytest.approx(exact.diagnostics[0]["time_alive"], rel=0.06)


def test_a_linear_process_with_continuous_actions() -> None:
    gains = (-0.4, 0.0)
    problem = linear.problem(gains, 600, 25, gamma=0.9)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", EstimationWarning)
        estimates = NETWORK.estimate(problem, seeds=(0,))[0]
    truth = [linear.value(gain, gamma=0.9) for gain in gains]
    np.testing.assert_allclose(estimates.values, truth, rtol=0.06)
    assert estimates.diagnostics[0]["time_alive"] == pytest.approx(10.0)  # nothing terminates: known


@pytest.mark.parametrize("preset", ["bestdice", "dualdice", "gendice"])
@pytest.mark.parametrize("horizon", [None, 4])
def test_gradients_are_those_of_the_lagrangian(preset: str, horizon: int | None) -> None:
    problem, config = make_problem(40, horizon=horizon), DICE.preset(preset)
    objective = Objective(
        primal=config.primal,
        dual=config.dual,
        reward=not config.zero_reward,
        normalise=config.normalise,
        positive=config.positive,
        hidden=(5,),
        updates=1,
        batch_size=16,
        nu_rate=1e-9,
        zeta_rate=1e-9,
        action_draws=1,
    )
    encoder = encoder_of(problem)
    batch = DiceBatches(problem, encoder, size=16, action_draws=1, seeds=(0,)).draw()
    architecture = Architecture(encoder.inputs, (5,), encoder.heads)
    saddle = Saddle(architecture, objective, seeds=(0,), policies=2, problem=problem)
    nu, zeta = ([(w.clone().requires_grad_(), b.clone().requires_grad_()) for w, b in net] for net in nets(saddle))
    with torch.no_grad():
        saddle.update(batch)
    lagrangian(nu, zeta, batch, config, scale=saddle._scale).backward()
    for layers, found, sign in ((nu, saddle._nu_gradient, 1 / saddle._scale), (zeta, saddle._zeta_gradient, -1.0)):
        for (weight, bias), (got_weight, got_bias) in zip(layers, found, strict=True):
            torch.testing.assert_close(got_weight, sign * weight.grad, rtol=1e-3, atol=1e-6)
            torch.testing.assert_close(got_bias, sign * bias.grad, rtol=1e-3, atol=1e-6)


def nets(saddle: Saddle):
    return saddle._nu, saddle.zeta_layers


def lagrangian(nu, zeta, batch, config: DICE, *, scale: float, gamma: float = 0.9):
    """The sum over members of equation 12 of Yang et al., at lambda = 0."""

    def network(layers, x, select):
        (w1, b1), (w2, b2) = layers
        return (((x @ w1 + b1).relu() @ w2 + b2) * select).sum(dim=2)

    size = batch.done.shape[1]
    now, after, first = (scale * network(nu, batch.inputs, batch.select)).split(size, dim=1)
    raw = network(zeta, batch.inputs[:, :size], batch.select[:, :size])
    ratio = torch.nn.functional.softplus(raw + SHIFT) if config.positive else 1.0 + raw
    following = torch.where(batch.done > 0, first, after)
    rewards = 0.0 if config.zero_reward else batch.rewards
    terms = (1 - gamma) * first + ratio * (rewards + gamma * following - now)
    return (terms + config.primal * now**2 / 2 - config.dual * ratio**2 / 2).mean(dim=1).sum()


def test_the_process_restarts_where_episodes_end_and_not_where_they_are_cut() -> None:
    problem = make_problem(50)
    rows = np.arange(len(problem.data.steps))
    np.testing.assert_array_equal(ends(problem, rows), problem.data.steps.terminated)
    short = replace(problem, horizon=3)
    last = problem.data.steps.step == 2
    np.testing.assert_array_equal(ends(short, rows), problem.data.steps.terminated | last)


# --- contract --------------------------------------------------------------------------------------------------------


def test_a_seed_depends_on_no_other_and_no_global_state() -> None:
    problem = linear.problem((0.0, 0.1), 30, 10, gamma=0.9, horizon=5)
    before = torch.random.get_rng_state()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", EstimationWarning)
        both, alone = TINY.estimate(problem, seeds=(3, 5)), TINY.estimate(problem, seeds=(5,))
    np.testing.assert_allclose(both[1].values, alone[0].values, rtol=1e-4)
    np.testing.assert_allclose(both[1].replicates, alone[0].replicates, rtol=1e-4)
    assert not np.allclose(both[0].values, both[1].values, rtol=1e-6)
    assert torch.equal(before, torch.random.get_rng_state())


def test_presets_carry_the_published_flags_and_names() -> None:
    flags = {name: DICE.preset(name) for name in ("bestdice", "dualdice", "gendice")}
    assert [(c.primal, c.dual, c.zero_reward, c.normalise, c.positive) for c in flags.values()] == [
        (0.0, 1.0, False, True, True),
        (0.0, 1.0, True, False, False),
        (1.0, 0.0, True, True, True),
    ]
    assert [c.name for c in flags.values()] == ["DICE BestDICE", "DICE DualDICE", "DICE GenDICE"]
    assert DICE.preset("bestdice") == DICE()
    assert DICE.preset("gendice", original=True).updates == 100_000


def test_settings_that_cannot_work_are_named() -> None:
    for settings, word in (
        ({"approximation": "gp"}, "approximation"),
        ({"primal": 0.0, "dual": 0.0}, "primal and dual"),
        ({"hidden": ()}, "hidden"),
        ({"updates": 0}, "updates"),
        ({"nu_rate": 0.0}, "nu_rate"),
    ):
        with pytest.raises(ConfigurationError, match=word):
            DICE(**settings)
    with pytest.raises(ConfigurationError, match="presets"):
        DICE.preset("algaedice")
    with pytest.raises(FrozenInstanceError):
        DICE().updates = 3
    problem = linear.problem((0.0,), 5, 4, gamma=1.0, horizon=4)
    with pytest.raises(ConfigurationError, match="approximation='tabular' needs"):
        DICE(approximation="tabular").check(problem)
    with pytest.raises(ConfigurationError, match="normalise=True"):
        DICE.preset("dualdice").check(problem)


def test_divergence_and_missing_solutions_raise() -> None:
    problem = linear.problem((0.0,), 5, 4, gamma=0.9)
    with pytest.raises(TrainingError, match="diverged"):
        replace(TINY, nu_rate=1e30, zeta_rate=1e30).estimate(problem, seeds=(0,))
    loop = tabular.empirical_model(
        np.array([0]), np.array([0]), np.array([1.0]), np.array([0]), np.array([False]), shape=(1, 1)
    )
    with pytest.raises(InvalidDataError, match="no solution"):
        discounted_visits(loop, np.ones((1, 1)), np.ones(1), 1.0, None)


def test_constant_rewards_are_not_divided_by_their_rounding() -> None:
    problem = make_problem(300, features=np.random.default_rng(0).normal(size=(6, 3)))
    steps = replace(problem.data.steps, rewards=np.full(len(problem.data.steps), 0.1))
    assert steps.rewards.std() > 0
    problem = replace(problem, data=replace(problem.data, steps=steps))
    batches = DiceBatches(problem, encoder_of(problem), size=64, action_draws=1, seeds=(0,))
    assert batches.draw().rewards.abs().max() < 1e-12
