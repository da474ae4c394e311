"""Model-based estimation: perfect models equal the process, tables are exact, learned models come near known values."""

import warnings
from dataclasses import FrozenInstanceError, replace

import numpy as np
import pytest
import torch

from oat_gym.errors import ConfigurationError, EstimationWarning, InvalidDataError, TrainingError
from oat_gym.ope import FQE, GaussianPolicy, ModelBased, PolicySet, Problem
from oat_gym.ope._model_autoregressive import FactorTask, variables
from oat_gym.ope._model_data import Moves, split
from oat_gym.ope._model_ensemble import MeanTask, one_hot_draw
from tests.ope import linear, mdps

ENSEMBLE = ModelBased(kind="ensemble", hidden=(32,), updates=2000, ensemble=2)
FACTORS = ModelBased(kind="autoregressive", hidden=(64,), updates=1500, learning_rate=5e-3, ensemble=1, rollouts=4)
TINY = replace(ENSEMBLE, updates=60)
GAINS = (-0.4, 0.2)


class Perfect:
    """The process itself on one-hot states and actions; ends are drawn, or given as probabilities."""

    def __init__(self, mdp: mdps.MDP, *, drawn: bool) -> None:
        self.mdp, self.drawn = mdp, drawn

    def step(self, states, actions, *, rng):
        s, a = states.argmax(axis=1), actions.argmax(axis=1)
        if self.drawn:
            after = mdps.draw(self.mdp.transitions[s, a], rng)
            return np.eye(self.mdp.n_states)[after], self.mdp.rewards[s, a, after], ~self.mdp.terminal[after]
        going = self.mdp.continuing[s, a]
        share = going.sum(axis=1)
        after = mdps.draw(np.where(share[:, None] > 0, going, 1.0), rng)
        return np.eye(self.mdp.n_states)[after], self.mdp.expected_rewards[s, a], share


def make_problem(n: int = 1500, *, horizon: int | None = None, gamma: float = 0.9, **kwargs) -> Problem:
    mdp = mdps.random_mdp(seed=3)
    policies = [mdps.random_policy(mdp, seed=1), mdps.random_policy(mdp, seed=2)]
    behavior = mdps.random_policy(mdp, seed=4, concentration=4.0)
    logs = mdps.sample_logs(mdp, behavior, n, 30, np.random.default_rng(0))
    return mdps.problem(logs, mdp, policies, behavior, gamma=gamma, horizon=horizon, **kwargs)


def truths(*, horizon: int | None = None, gamma: float = 0.9) -> np.ndarray:
    mdp = mdps.random_mdp(seed=3)
    return np.array([mdps.value(mdp, mdps.random_policy(mdp, seed=s), gamma, horizon) for s in (1, 2)])


# --- exact -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("horizon", [None, 3, 12])
@pytest.mark.parametrize("gamma", [0.9, 1.0])
def test_a_perfect_deterministic_model_gives_the_value_exactly(horizon: int | None, gamma: float) -> None:
    mdp = mdps.chain(5, slip=0.0)
    right = np.tile([0.0, 1.0], (mdp.n_states, 1))
    logs = mdps.sample_logs(mdp, right, 20, 40, np.random.default_rng(0))
    problem = mdps.problem(logs, mdp, [right], right, gamma=gamma, horizon=horizon)
    estimates = ModelBased(model=Perfect(mdp, drawn=True), tolerance=1e-12).estimate(problem, seeds=(0,))[0]
    np.testing.assert_allclose(estimates.values, mdps.value(mdp, right, gamma, horizon), atol=1e-12)


@pytest.mark.parametrize("drawn", [True, False])
@pytest.mark.parametrize("horizon", [None, 6])
def test_a_perfect_model_equals_the_process_in_expectation(drawn: bool, horizon: int | None) -> None:
    mdp, problem = mdps.random_mdp(seed=3), make_problem(400, horizon=horizon)
    starts = np.repeat(np.arange(mdp.n_states), np.round(6000 * mdp.initial).astype(int))
    problem = replace(problem, initial=starts, initial_unit=None)
    config = ModelBased(model=Perfect(mdp, drawn=drawn), max_starts=10_000)
    estimates = config.estimate(problem, seeds=(0,))[0]
    sd = 3.0  # of a return, at most
    np.testing.assert_allclose(estimates.values, truths(horizon=horizon), atol=4 * sd / np.sqrt(len(starts)))


@pytest.mark.parametrize("horizon", [None, 8])
def test_tables_equal_tabular_fqe(horizon: int | None) -> None:
    problem = make_problem(horizon=horizon)
    ours, theirs = (config.estimate(problem, seeds=(0, 1)) for config in (ModelBased(), FQE()))
    np.testing.assert_allclose(ours[0].values, theirs[0].values)
    np.testing.assert_allclose(ours[1].replicates, theirs[1].replicates)
    assert np.abs(ours[0].values - truths(horizon=horizon)).max() < 0.15


def test_cut_roll_outs_miss_no_more_than_their_bound() -> None:
    mdp, problem = mdps.chain(3, slip=0.9), make_problem(50)
    endless = replace(mdp, terminal=np.zeros_like(mdp.terminal), rewards=np.ones_like(mdp.rewards))
    table = np.tile([0.5, 0.5], (mdp.n_states, 1))
    logs = mdps.sample_logs(endless, table, 50, 30, np.random.default_rng(0))
    problem = mdps.problem(logs, endless, [table], table, gamma=0.9)
    with pytest.warns(EstimationWarning, match="truncation_bound"):
        cut = ModelBased(model=Perfect(endless, drawn=False), max_steps=7).estimate(problem, seeds=(0,))[0]
    assert cut.values[0] + cut.diagnostics[0]["truncation_bound"] == pytest.approx(10.0)
    whole = ModelBased(model=Perfect(endless, drawn=False)).estimate(problem, seeds=(0,))[0]
    assert whole.values[0] == pytest.approx(10.0, abs=0.02)


# --- learned ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("horizon", [None, 20])
def test_the_ensemble_finds_the_values_of_a_linear_process(horizon: int | None) -> None:
    problem = linear.problem(GAINS, 600, 25, gamma=0.9, horizon=horizon)
    truth = [linear.value(gain, gamma=0.9, horizon=horizon or 400) for gain in GAINS]
    estimates = ENSEMBLE.estimate(problem, seeds=(0,))[0]
    np.testing.assert_allclose(estimates.values, truth, rtol=0.06)
    noise = estimates.diagnostics[0]["held_out_state_error"]
    assert 0.15 < noise < 0.35  # what no model can predict
    assert estimates.diagnostics[0]["held_out_reward_error"] < 0.01


def test_the_autoregressive_model_knows_noise() -> None:
    problem = linear.problem(GAINS, 600, 25, gamma=0.9, horizon=20, quadratic=0.3)
    truth = [linear.value(gain, gamma=0.9, horizon=20, quadratic=0.3) for gain in GAINS]
    estimates = replace(FACTORS, updates=1000, rollouts=2).estimate(problem, seeds=(0,))[0]
    np.testing.assert_allclose(estimates.values, truth, rtol=0.12)


@pytest.mark.parametrize(("config", "horizon"), [(ENSEMBLE, 8), (FACTORS, None)], ids=["ensemble", "autoregressive"])
def test_discrete_states_and_action_dependent_ends(config: ModelBased, horizon: int | None) -> None:
    problem = make_problem(600, horizon=horizon)
    estimates = replace(config, rollouts=3).estimate(problem, seeds=(0,))[0]
    exact = ModelBased(kind="tabular").estimate(problem, seeds=(0,))[0]
    np.testing.assert_allclose(estimates.values, exact.values, atol=0.3)
    assert np.abs(estimates.values[0] - exact.values[1]) > 0.5  # the policies differ by more


@pytest.mark.parametrize("kind", ["ensemble", "autoregressive"])
def test_slopes_are_the_derivatives_of_the_losses(kind: str) -> None:
    moves, rng = Moves.of(make_problem(30)), torch.Generator().manual_seed(0)
    rows = torch.arange(12).view(2, 6)
    if kind == "ensemble":
        task = MeanTask(moves.inputs, moves.changes, blocks=moves.layout.categorical, hidden=(4,), device="cpu")
        target = torch.from_numpy(moves.changes[rows]).float()
    else:
        task = FactorTask(moves, variables(moves), hidden=(4,), device="cpu")
    heads = torch.randn(2 * task.copies, 6, task.architecture.heads, generator=rng, requires_grad=True)
    slope = task.slope(heads.detach(), rows)
    loss = -(target * heads.log_softmax(dim=-1)).sum() if kind == "ensemble" else task.loss(heads, rows).sum()
    loss.backward()
    torch.testing.assert_close(slope, heads.grad, rtol=1e-4, atol=1e-6)


def test_gaussian_slopes_are_weighted_by_the_standard_deviation() -> None:
    moves, rng = Moves.of(linear.problem(GAINS, 20, 10, gamma=0.9)), torch.Generator().manual_seed(0)
    task, rows = FactorTask(moves, variables(moves), hidden=(4,), device="cpu"), torch.arange(12).view(2, 6)
    heads = torch.rand(2 * task.copies, 6, 2, generator=rng, requires_grad=True)
    task.loss(heads, rows).sum().backward()
    weight = heads.detach()[..., 1:].clamp(-4, 2).exp()
    weight[[2, 5]] = 1.0  # the reward's mean is learned by least squares
    torch.testing.assert_close(task.slope(heads.detach(), rows), weight * heads.grad, rtol=1e-4, atol=1e-6)


def test_the_autoregressive_mask_hides_what_comes_later() -> None:
    moves = Moves.of(linear.problem(GAINS, 20, 10, gamma=0.9))
    factors = variables(moves)
    assert [(f.start, f.given) for f in factors] == [(0, 0), (1, 1), (2, 2)]
    task = FactorTask(moves, factors, hidden=(4,), device="cpu")
    x = task.inputs(torch.arange(5).view(1, 5))
    width = moves.inputs.shape[1]
    for network, given in enumerate((0, 1, 2)):
        assert (x[network, :, width + given :] == 0).all()
        np.testing.assert_allclose(x[network, :, width : width + given], moves.changes[:5, :given], rtol=1e-5)


def test_categories_are_drawn_with_their_probabilities() -> None:
    drawn = one_hot_draw(np.tile([0.2, 0.0, 0.8], (1, 2, 20_000, 1)), np.random.default_rng(0))
    np.testing.assert_allclose(drawn[0, 0].mean(axis=0), [0.2, 0.0, 0.8], atol=0.015)
    np.testing.assert_array_equal(drawn[:, 0], drawn[:, 1])  # policies have their random numbers in common


@pytest.mark.parametrize("config", [TINY, replace(FACTORS, updates=60), None], ids=["ensemble", "factors", "given"])
def test_a_policy_depends_on_no_other(config: ModelBased | None) -> None:
    config = config or ModelBased(model=Perfect(mdps.random_mdp(seed=3), drawn=True))
    problem = make_problem(30, horizon=5)
    both = problem.policies
    for names in ((both.names[1], both.names[0]), (both.names[1],)):
        chosen = PolicySet.of({name: both.policies[both.names.index(name)] for name in names})
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", EstimationWarning)
            whole = config.estimate(problem, seeds=(0,))[0]
            other = config.estimate(replace(problem, policies=chosen), seeds=(0,))[0]
        np.testing.assert_allclose(other.values[0], whole.values[1], rtol=1e-5)
        np.testing.assert_allclose(other.replicates[0], whole.replicates[1], rtol=1e-5)


@pytest.mark.parametrize("config", [TINY, replace(FACTORS, updates=100)], ids=["ensemble", "factors"])
def test_episodes_of_one_step_have_no_dynamics_and_a_value(config: ModelBased) -> None:
    once = mdps.MDP(np.ones((1, 1, 1)), np.ones((1, 1, 1)), np.ones(1), np.zeros(1, dtype=bool))
    logs = mdps.sample_logs(once, np.ones((1, 1)), 50, 1, np.random.default_rng(0))
    logs = replace(logs, terminated=np.ones(50, dtype=bool))
    problem = mdps.problem(logs, once, [np.ones((1, 1))], np.ones((1, 1)), gamma=0.9)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", EstimationWarning)
        value = replace(config, updates=300).estimate(problem, seeds=(0,))[0].values[0]
    assert value == pytest.approx(1.0, abs=0.15)


# --- contract --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("config", [TINY, replace(FACTORS, updates=60)], ids=["ensemble", "autoregressive"])
def test_a_seed_depends_on_no_other_and_no_global_state(config: ModelBased) -> None:
    problem = linear.problem(GAINS, 30, 10, gamma=0.9, horizon=5)
    before = torch.random.get_rng_state()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", EstimationWarning)
        both, alone = config.estimate(problem, seeds=(3, 5)), config.estimate(problem, seeds=(5,))
    np.testing.assert_allclose(both[1].values, alone[0].values, rtol=1e-5)
    assert not np.allclose(both[0].values, both[1].values, rtol=1e-6)
    assert torch.equal(before, torch.random.get_rng_state())


def test_held_out_episodes_are_never_trained_on() -> None:
    problem = linear.problem(GAINS, 20, 10, gamma=0.9)
    moves = Moves.of(problem)
    for bootstrap in (False, True):
        parts = split(problem, moves, seeds=(0, 1), ensemble=3, bootstrap=bootstrap, share=0.2, size=64)
        for rows, held in zip(parts.training, parts.held, strict=True):
            assert not set(moves.unit[rows]) & set(moves.unit[held])
            assert len(set(moves.unit[held])) == 4
        assert (len({tuple(rows) for rows in parts.training}) == 6) == bootstrap


def test_bootstrap_replicates_hold_the_spread_of_the_models() -> None:
    problem = linear.problem(GAINS, 30, 10, gamma=0.9, horizon=5)
    problem = replace(problem, initial=np.array([[1.0, -0.5]]), initial_unit=None)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", EstimationWarning)
        fixed = TINY.estimate(problem, seeds=(0,))[0]
        trained = replace(TINY, ensemble=4, bootstrap=True).estimate(problem, seeds=(0,))[0]
    assert np.ptp(fixed.replicates, axis=1).max() == 0.0
    assert fixed.diagnostics[0]["interval_covers_training"] == 0.0
    assert len(np.unique(trained.replicates[0])) == 4
    assert trained.diagnostics[0]["interval_covers_training"] == 1.0


def test_states_and_rewards_stay_in_the_range_of_the_data() -> None:
    problem = linear.problem((3.0,), 40, 10, gamma=0.9)  # an unstable policy
    with pytest.warns(EstimationWarning, match="leave the range"):
        estimates = TINY.estimate(problem, seeds=(0,))[0]
    rewards = problem.data.steps.rewards
    assert rewards.min() * 10 <= estimates.values[0] <= rewards.max() * 10
    assert estimates.diagnostics[0]["share_clipped"] > 0.25


def test_many_initial_states_are_thinned_and_rolled_in_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    mdp, problem = mdps.random_mdp(seed=3), make_problem(600, horizon=4)
    config = ModelBased(model=Perfect(mdp, drawn=False), max_starts=300)
    whole = config.estimate(problem, seeds=(0,))[0]
    monkeypatch.setattr("oat_gym.ope._model_rollout.CHUNK", 500)
    parts = config.estimate(problem, seeds=(0,))[0]
    assert whole.replicates.shape == parts.replicates.shape == (2, 50)
    np.testing.assert_allclose(whole.values, parts.values, atol=0.4)


def test_settings_that_cannot_work_are_named() -> None:
    for settings, word in (
        ({"kind": "gp"}, "kind"),
        ({"hidden": ()}, "hidden"),
        ({"updates": 0}, "updates"),
        ({"held_out": 1.0}, "held_out"),
        ({"tolerance": 0.0}, "tolerance"),
        ({"model": 3}, "model"),
    ):
        with pytest.raises(ConfigurationError, match=word):
            ModelBased(**settings)
    with pytest.raises(ConfigurationError, match="presets"):
        ModelBased.preset("gp")
    with pytest.raises(FrozenInstanceError):
        ModelBased().updates = 3
    problem = linear.problem(GAINS, 5, 4, gamma=0.9)
    with pytest.raises(ConfigurationError, match="kind='tabular' needs"):
        ModelBased(kind="tabular").check(problem)
    with pytest.raises(ConfigurationError, match="ensemble must be 2 to"):
        ModelBased(ensemble=1, bootstrap=True).check(problem)


def test_broken_models_are_refused() -> None:
    class Wrong:
        def step(self, states, actions, *, rng):
            return states, np.zeros((len(states), 1)), np.ones(len(states))

    problem = linear.problem(GAINS, 5, 4, gamma=0.9)
    with pytest.raises(InvalidDataError, match=r"model\.step must return"):
        ModelBased(model=Wrong()).estimate(problem, seeds=(0,))
    with pytest.raises(TrainingError, match="diverged"), np.errstate(all="ignore"):
        replace(TINY, learning_rate=1e30).estimate(problem, seeds=(0,))


@pytest.mark.parametrize("kind", ["ensemble", "autoregressive"])
def test_a_clock_does_not_swamp_the_held_out_error(kind: str) -> None:
    # the clock t/H moves by the same step always, and its change varies by rounding only
    length = 12
    problem = linear.problem(GAINS, 60, length, gamma=0.9)
    moves = Moves.of(problem)
    clock = (problem.data.steps.step + 1) / length - problem.data.steps.step / length
    noise = (clock - clock.mean())[:, None]
    assert 0 < noise.var() < 1e-30
    ticking = replace(moves, changes=np.concatenate((moves.changes[:, :1], noise), axis=1))
    rows = torch.arange(len(noise))[None]
    if kind == "ensemble":
        task = MeanTask(ticking.inputs, ticking.changes, hidden=(4,), device="cpu")
        heads = torch.zeros(1, len(noise), 2) + torch.tensor([0.0, 1e-3])  # a network that is off by 0.001
        assert float(task.squared_error(heads, rows).mean()) == pytest.approx(1.0, rel=1e-3)
        return
    factors = FactorTask(ticking, variables(ticking), hidden=(4,), device="cpu")
    heads = torch.full((3, len(noise), 2), 1e-3)
    error = factors.squared_error(heads, rows).mean(dim=1)
    assert error.tolist() == pytest.approx([1.0, 1e-6, 1.0], rel=1e-2)


def test_nan_actions_are_found_before_training() -> None:
    problem = linear.problem(GAINS, 20, 5, gamma=0.9)
    broken = GaussianPolicy(lambda s: np.where(s[:, :1] > 1.0, np.nan, 0.0), 0.1)
    problem = replace(problem, policies=PolicySet.of({"good": linear.policy(0.0), "broken": broken}))
    with pytest.raises(InvalidDataError, match="'broken' returned NaN actions"):
        replace(TINY, updates=10**9).estimate(problem, seeds=(0,))
