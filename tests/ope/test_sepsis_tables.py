"""The tabular forms on the sepsis processes: exact with the process known, near it from logs that hold a part of it."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from oat_gym.errors import EstimationWarning
from oat_gym.ope import DICE, FQE, ModelBased
from oat_gym.ope import _q_tabular as tabular
from tests.ope import mdps
from tests.ope.test_fqe import expected_model

pytestmark = pytest.mark.shared_data


def test_icu_sepsis_equals_the_linear_solve(shared_data: Path) -> None:
    mdp, policy = icu_sepsis(shared_data)
    model = expected_model(mdp)
    for table in (policy, np.full_like(policy, 1 / policy.shape[1])):
        exact = mdps.state_values(mdp, table, 0.99)
        np.testing.assert_allclose(tabular.infinite_values(model, table, 0.99), exact, atol=1e-8)
        np.testing.assert_allclose(
            tabular.finite_values(model, table, 0.99, 12)[-1], mdps.state_values(mdp, table, 0.99, 12), atol=1e-8
        )


def test_icu_sepsis_from_logs_on_policy_is_within_sampling_error(shared_data: Path) -> None:
    mdp, expert = icu_sepsis(shared_data)
    behavior = np.eye(expert.shape[1])[expert.argmax(axis=1)]  # one action a state: the data holds what it needs
    logs = mdps.sample_logs(mdp, behavior, 1000, 300, np.random.default_rng(0))
    problem = mdps.problem(logs, mdp, [behavior], behavior, gamma=1.0, n_resamples=2)
    estimates = FQE().estimate(problem, seeds=(0,))[0]
    assert estimates.diagnostics[0]["unsupported_mass"] == 0.0
    error = logs.returns(1.0).std() / 1000**0.5  # on policy the solve has about the error of the mean return
    assert abs(estimates.values[0] - mdps.value(mdp, behavior, 1.0)) < 3 * error


def test_icu_sepsis_with_stochastic_policies_that_do_more_than_the_data_holds(shared_data: Path) -> None:
    mdp, expert = icu_sepsis(shared_data)
    uniform = np.full_like(expert, 1 / expert.shape[1])
    behavior = mdps.mix(expert, uniform, 0.5)
    logs = mdps.sample_logs(mdp, behavior, 1000, 300, np.random.default_rng(0))
    policies = [expert, uniform, behavior]
    problem = mdps.problem(logs, mdp, policies, behavior, gamma=0.99, n_resamples=2)
    error = logs.returns(0.99).std() / 1000**0.5
    truth = [mdps.value(mdp, table, 0.99) for table in policies]
    for estimator in (FQE(), DICE(), ModelBased()):
        with pytest.warns(EstimationWarning, match="does what the data does not hold"):
            estimates = estimator.estimate(problem, seeds=(0,))[0]
        assert [numbers["unsupported_mass"] > 0.3 for numbers in estimates.diagnostics] == [True] * 3
        np.testing.assert_allclose(estimates.values, truth, atol=3 * error)


def test_the_sepsis_simulator_equals_the_linear_solve(shared_data: Path) -> None:
    arrays = np.load(shared_data / "sepsis" / "sepsis_sim" / "oberst_sontag_sepsis_mdp_sparse.npz")
    (states, actions, following, probability), rewards, size = sepsis_simulator(arrays)
    rng = np.random.default_rng(0)
    policy = rng.dirichlet(np.ones(8), size=size)
    ends = rewards[following] != 0
    model = tabular.empirical_model(
        states, actions, rewards[following], following, ends, weights=probability, shape=(size, 8)
    )
    step = np.zeros((size, size))
    np.add.at(step, (states, following), probability * policy[states, actions] * ~ends)
    earned = np.bincount(states, probability * policy[states, actions] * rewards[following], minlength=size)
    exact = np.linalg.solve(np.eye(size) - 0.99 * step, earned)
    np.testing.assert_allclose(tabular.infinite_values(model, policy, 0.99), exact, atol=1e-8)


@cache
def icu_sepsis(folder: Path) -> tuple[mdps.MDP, np.ndarray]:
    """The process and its expert policy; death, survival and the absorbing state behind them are terminal."""
    arrays = np.load(folder / "sepsis" / "icu_sepsis" / "dynamics.npz")
    terminal = np.arange(len(arrays["d_0"])) >= 713
    return mdps.MDP(arrays["tx_mat"], arrays["r_mat"], arrays["d_0"], terminal), arrays["expert_policy"]


def sepsis_simulator(arrays):
    """Distinct transitions of the 2 x 720 states (with and without diabetes), and the reward of coming to each."""
    diabetes, action, state, following = arrays["tx_idx"].astype(np.int64)
    rewards = np.zeros((2, 720))
    d, _, _, to = arrays["r_idx"].astype(np.int64)  # the reward depends on the next state alone
    rewards[d, to] = arrays["r_val"]
    states, to, probability = 720 * diabetes + state, 720 * diabetes + following, arrays["tx_val"].astype(np.float64)
    totals = np.bincount(states * 8 + action, probability, minlength=1440 * 8)
    return (states, action, to, probability / totals[states * 8 + action]), rewards.ravel(), 1440
