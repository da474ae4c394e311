"""Doubly robust estimators: exact with the exact Q, unbiased with any, right at terminal states and horizons."""

import contextlib
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import pytest
from scipy.optimize import minimize

from oat_gym.errors import ConfigurationError, EstimationWarning
from oat_gym.ope import FQE, DoublyRobust, ImportanceSampling
from oat_gym.ope._magic import bias_interval, blend_weights, partial_lengths, simplex_minimum, step_shares
from oat_gym.ope._normalised import Spans
from oat_gym.ope._weights import importance_weights
from oat_gym.ope.doubly_robust import normalised_errors, td_errors, weighted_terms
from tests.ope import mdps

FloatArray = npt.NDArray[np.float64]
KINDS = ("dr", "wdr", "magic")


@dataclass(frozen=True)
class Known:
    """Action values from tables: (P, S, A), or by remaining steps (P, H + 1, S, A)."""

    table: FloatArray

    def q(self, states: FloatArray, actions: FloatArray, remaining: npt.NDArray[np.int64] | None) -> FloatArray:
        assert actions.ndim == 2
        state, action = states.argmax(axis=1), actions.argmax(axis=1)
        return self.table[:, state, action] if remaining is None else self.table[:, remaining, state, action]


def exact(mdp: mdps.MDP, policies: list[FloatArray], gamma: float, horizon: int | None = None) -> Known:
    if horizon is None:
        return Known(np.stack([mdps.action_values(mdp, policy, gamma) for policy in policies]))
    zero = np.zeros((mdp.n_states, mdp.n_actions))
    by_steps = [
        [zero, *(mdps.action_values(mdp, policy, gamma, h) for h in range(1, horizon + 1))] for policy in policies
    ]
    return Known(np.array(by_steps))


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", EstimationWarning)
        yield


def deterministic_chain() -> mdps.MDP:
    return mdps.chain(slip=0.0)


def setting(mdp: mdps.MDP, n: int, *, horizon: int | None = None, length: int = 60, seed: int = 0, gamma: float = 0.9):
    policies = [mdps.random_policy(mdp, seed=1, concentration=2.0), mdps.random_policy(mdp, seed=2, concentration=2.0)]
    behavior = mdps.mix(mdps.random_policy(mdp, seed=4, concentration=4.0), policies[0], 0.5)
    logs = mdps.sample_logs(mdp, behavior, n, length, np.random.default_rng(seed))
    return mdps.problem(logs, mdp, policies, behavior, gamma=gamma, horizon=horizon), policies


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("horizon", "length"), [(None, 200), (None, 6), (8, 200), (8, 8), (8, 5)])
def test_the_exact_q_gives_the_truth_where_nothing_is_random(kind: str, horizon: int | None, length: int) -> None:
    # no error is left to weight, at terminal states, at truncations (length below what is counted), at the horizon
    mdp = deterministic_chain()
    problem, policies = setting(mdp, 40, horizon=horizon, length=length)
    q = exact(mdp, policies, 0.9, horizon)
    errors = td_errors(problem, q, Spans.of(problem), draws=1, rng=np.random.default_rng(0))
    assert np.abs(errors).max() < 1e-12
    estimates = DoublyRobust(kind=kind, q=q).estimate(problem, seeds=(0,))[0]
    truth = [mdps.value(mdp, policy, 0.9, horizon) for policy in policies]
    np.testing.assert_allclose(estimates.values, truth, atol=1e-12)
    np.testing.assert_allclose(estimates.replicates, np.tile(np.array(truth)[:, None], 50), atol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("horizon", [None, 5])
def test_the_exact_q_is_closer_than_importance_sampling(kind: str, horizon: int | None) -> None:
    mdp = mdps.random_mdp(seed=3)
    problem, policies = setting(mdp, 3000, horizon=horizon)
    estimates = DoublyRobust(kind=kind, q=exact(mdp, policies, 0.9, horizon)).estimate(problem, seeds=(0,))[0]
    alone = ImportanceSampling(weighted=False).estimate(problem, seeds=(0,))[0]
    for p, policy in enumerate(policies):
        spread = estimates.replicates[p].std()
        assert abs(estimates.values[p] - mdps.value(mdp, policy, 0.9, horizon)) < 3.5 * spread
        assert spread < alone.replicates[p].std()


@pytest.mark.parametrize("horizon", [None, 4])
def test_a_wrong_q_stays_unbiased(horizon: int | None) -> None:
    # 2,000 data sets of 10 episodes, in one; the chain ends by what the policy does
    mdp = mdps.chain(3)
    problem, policies = setting(mdp, 20_000, horizon=horizon)
    rng = np.random.default_rng(0)
    shape = (2, mdp.n_states, mdp.n_actions) if horizon is None else (2, horizon + 1, mdp.n_states, mdp.n_actions)
    table = rng.normal(size=shape)
    wrong, spans = Known(table), Spans.of(problem)
    errors = td_errors(problem, wrong, spans, draws=1, rng=rng)
    logs = importance_weights(problem, 0).log_cumulative
    first = DoublyRobust(kind="dr", q=wrong).estimate(problem, seeds=(0,))[0]
    for p, policy in enumerate(policies):
        at_start = (policy * (table[p] if horizon is None else table[p, horizon])).sum(axis=1)[problem.initial]
        values = (at_start + weighted_terms(errors[p], logs[p], spans, 0.9)).reshape(2000, 10).mean(axis=1)
        truth = mdps.value(mdp, policy, 0.9, horizon)
        assert abs(values.mean() - truth) < 3 * values.std() / 2000**0.5
        assert abs(at_start.mean() - truth) > 10 * values.std() / 2000**0.5  # Q alone is far off
        assert first.values[p] == pytest.approx(values.mean(), abs=1e-10)


def test_without_action_values_it_is_importance_sampling() -> None:
    mdp = mdps.chain()
    problem, _ = setting(mdp, 200)
    zero = Known(np.zeros((2, mdp.n_states, mdp.n_actions)))
    for kind, weighted in (("dr", False), ("wdr", True)):
        ours = DoublyRobust(kind=kind, q=zero).estimate(problem, seeds=(0,))[0]
        theirs = ImportanceSampling(kind="per-decision", weighted=weighted).estimate(problem, seeds=(0,))[0]
        np.testing.assert_allclose(ours.values, theirs.values, atol=1e-12)
        np.testing.assert_allclose(ours.replicates, theirs.replicates, atol=1e-12)


def test_the_weighted_form_follows_its_definition() -> None:
    # eq. (9) of Thomas and Brunskill by loops, with frozen weights after the end
    mdp = mdps.random_mdp(seed=3)
    problem, policies = setting(mdp, 30)
    tables = np.random.default_rng(1).normal(size=(2, mdp.n_states, mdp.n_actions))
    tables[:, mdp.terminal] = 0.0
    with quiet():
        got = DoublyRobust(kind="wdr", q=Known(tables)).estimate(problem, seeds=(0,))[0].values
    steps, offsets, n = problem.data.steps, problem.data.offsets, 30
    ratios = np.exp(problem.target_log_prob() - problem.behavior(0))
    for p, policy in enumerate(policies):
        horizon = int(problem.data.lengths.max())
        rho, v = np.ones((n, horizon + 1)), (policy * tables[p]).sum(axis=1)
        for i in range(n):
            own = np.cumprod(ratios[p, offsets[i] : offsets[i + 1]])
            rho[i, 1 : len(own) + 1], rho[i, len(own) + 1 :] = own, own[-1]
        w = rho / rho.sum(axis=0)
        total = 0.0
        for i in range(n):
            for t, row in enumerate(range(offsets[i], offsets[i + 1])):
                s, a = steps.observations[row], steps.actions[row]
                total += 0.9**t * (w[i, t + 1] * (steps.rewards[row] - tables[p, s, a]) + w[i, t] * v[s])
        assert got[p] == pytest.approx(total, abs=1e-10)


# --- MAGIC -----------------------------------------------------------------------------------------------------------


def test_the_simplex_minimum_is_one() -> None:
    rng = np.random.default_rng(0)
    for size in (1, 2, 5, 12):
        root = rng.normal(size=(size, max(size // 2, 1)))
        matrix = root @ root.T + 0.01 * np.diag(rng.random(size))
        x = simplex_minimum(matrix)
        assert x.min() >= 0
        assert x.sum() == pytest.approx(1.0)
        others = rng.dirichlet(np.full(size, 0.3), size=3000)
        assert x @ matrix @ x <= np.einsum("ij,jk,ik->i", others, matrix, others).min() + 1e-9
        gradient = matrix @ x  # optimality: no coordinate offers a smaller slope than the support's
        assert gradient.min() >= x @ gradient - 1e-6


def test_magic_trusts_action_values_where_weights_vary_and_distrusts_wrong_ones() -> None:
    noise = np.random.default_rng(0).normal(size=(50, 4))
    partial = np.concatenate((np.full((50, 1), 0.02), 0.02 + noise * [0.1, 0.2, 0.4, 0.8]), axis=1)
    partial -= partial.mean(axis=0) - 0.02
    assert blend_weights(partial, (0.9, 1.1))[0] > 0.99  # no variance, no bias
    assert blend_weights(partial + np.eye(5)[0], (0.9, 1.1))[0] < 0.5  # 50 from the interval
    np.testing.assert_array_equal(partial_lengths(5, 20), np.arange(6))
    np.testing.assert_array_equal(partial_lengths(100, 3), [0, 50, 100])
    shares = step_shares(np.array([0.5, 0.3, 0.2]), np.array([0, 1, 3]), 3)
    np.testing.assert_allclose(shares, [0.5, 0.2, 0.2])


def test_biases_are_measured_to_the_90_percent_interval() -> None:
    replicates = np.random.default_rng(0).permutation(np.arange(1001.0))
    assert bias_interval(500.0, replicates) == pytest.approx((50.0, 950.0))
    assert bias_interval(20.0, replicates) == pytest.approx((20.0, 950.0))  # it holds the estimate itself
    assert bias_interval(1.0, np.array([np.nan])) == (1.0, 1.0)


def test_magic_follows_its_definition() -> None:
    # g_j by loops over steps, their covariance and bias, and the blend of least error by another solver
    mdp, n = mdps.random_mdp(seed=3), 40
    problem, policies = setting(mdp, n, horizon=6)
    table = np.random.default_rng(1).normal(size=(2, 7, mdp.n_states, mdp.n_actions)) * 0.5
    table[:, 0] = 0.0
    with quiet():
        got = DoublyRobust(kind="magic", q=Known(table)).estimate(problem, seeds=(0,))[0]
        full = DoublyRobust(kind="wdr", q=Known(table)).estimate(problem, seeds=(0,))[0]
    steps, offsets = problem.data.steps, problem.data.offsets
    ratios = np.exp(problem.target_log_prob() - problem.behavior(0))
    for p, policy in enumerate(policies):
        v = (policy * table[p]).sum(axis=2)
        parts = np.zeros((n, 7))
        parts[:, 0] = v[6, problem.initial] / n
        rho = np.ones((n, 6))
        for i in range(n):
            own = np.cumprod(ratios[p, offsets[i] : min(offsets[i + 1], offsets[i] + 6)])
            rho[i, : len(own)], rho[i, len(own) :] = own, own[-1]
        w = rho / rho.sum(axis=0)
        for i in range(n):
            for t, row in enumerate(range(offsets[i], min(offsets[i + 1], offsets[i] + 6))):
                after = 0.0 if steps.terminated[row] else v[5 - t, steps.next_observations[row]]
                own = table[p, 6 - t, steps.observations[row], steps.actions[row]]
                parts[i, t + 1] = 0.9**t * w[i, t] * (steps.rewards[row] + 0.9 * after - own)
        partial = parts.cumsum(axis=1)
        g, omega = partial.sum(axis=0), np.cov(partial.T) * n
        assert g[-1] == pytest.approx(full.values[p])
        low, high = (np.quantile(full.replicates[p], q) for q in (0.05, 0.95))
        bias = np.maximum(min(low, g[-1]) - g, 0) + np.maximum(g - max(high, g[-1]), 0)
        error = omega + np.outer(bias, bias)
        found = minimize(
            lambda x, a=error: x @ a @ x * 1e3,
            np.full(7, 1 / 7),
            bounds=[(0, 1)] * 7,
            constraints={"type": "eq", "fun": lambda x: x.sum() - 1},
            options={"ftol": 1e-14, "maxiter": 500},
        )
        assert got.values[p] == pytest.approx(found.x @ g, abs=2e-3)


def test_the_bias_of_magic_is_measured_to_the_interval_of_wdr(monkeypatch: pytest.MonkeyPatch) -> None:
    # of the whole estimate: V(s_0) is resampled with the corrections, unless its states were given
    mdp = mdps.random_mdp(seed=3)
    problem, policies = setting(mdp, 60)
    q, seen = exact(mdp, policies, 0.9), list[tuple[float, FloatArray]]()

    def noted(value: float, replicates: FloatArray) -> tuple[float, float]:
        seen.append((value, replicates))
        return bias_interval(value, replicates)

    monkeypatch.setattr("oat_gym.ope.doubly_robust.bias_interval", noted)
    for posed in (problem, replace(problem, initial=np.zeros(3, dtype=int), initial_unit=None)):
        seen.clear()
        with quiet():
            full = DoublyRobust(kind="wdr", q=q).estimate(posed, seeds=(0,))[0]
            DoublyRobust(kind="magic", q=q).estimate(posed, seeds=(0,))
        np.testing.assert_allclose([value for value, _ in seen], full.values)
        np.testing.assert_allclose([replicates for _, replicates in seen], full.replicates)


def test_intervals_hold_the_action_values_fixed() -> None:
    problem, _ = setting(mdps.random_mdp(seed=3), 100)
    fitted = DoublyRobust(q=FQE(bootstrap=True)).estimate(problem, seeds=(0,))[0]
    assert [numbers["interval_covers_training"] for numbers in fitted.diagnostics] == [0.0, 0.0]


def test_magic_is_the_blend_of_partial_sums() -> None:
    mdp = mdps.random_mdp(seed=3)
    problem, policies = setting(mdp, 100)
    estimates = DoublyRobust(kind="magic", q=exact(mdp, policies, 0.9)).estimate(problem, seeds=(0,))[0]
    full = DoublyRobust(kind="wdr", q=exact(mdp, policies, 0.9)).estimate(problem, seeds=(0,))[0]
    for numbers, other in zip(estimates.diagnostics, full.diagnostics, strict=True):
        assert 0 <= numbers["uncorrected_share"] <= 1
        assert abs(numbers["correction"]) <= abs(other["correction"]) + 0.1
    weights, spans = importance_weights(problem, 0), Spans.of(problem)
    errors = td_errors(problem, exact(mdp, policies, 0.9), spans, draws=1, rng=np.random.default_rng(0))
    parts = normalised_errors(errors[0], (weights.log_cumulative[0], weights.log_final[0]), spans)
    total = (parts.sum(axis=0) * 0.9 ** np.arange(parts.shape[1])).sum()
    assert total == pytest.approx(full.diagnostics[0]["correction"], abs=1e-12)


# --- with FQE --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("q", [FQE(), FQE(approximation="linear")], ids=["tabular", "linear"])
@pytest.mark.parametrize("horizon", [None, 5])
def test_fitted_action_values_come_to_the_truth(kind: str, q: FQE, horizon: int | None) -> None:
    mdp = mdps.random_mdp(seed=3)
    problem, policies = setting(mdp, 3000, horizon=horizon)
    first, second = DoublyRobust(kind=kind, q=q).estimate(problem, seeds=(0, 1))
    np.testing.assert_array_equal(first.values, second.values)
    for p, policy in enumerate(policies):
        assert abs(first.values[p] - mdps.value(mdp, policy, 0.9, horizon)) < 4 * first.replicates[p].std() + 0.02
    assert {"effective_sample_size", "correction", "interval_covers_training"} <= set(first.diagnostics[0])


def test_network_action_values_are_corrected() -> None:
    mdp = mdps.random_mdp(seed=3)
    features = np.random.default_rng(0).normal(size=(6, 4))
    tables = [mdps.random_policy(mdp, seed=1, concentration=2.0)]
    behavior = mdps.mix(mdps.random_policy(mdp, seed=4, concentration=4.0), tables[0], 0.5)
    logs = mdps.sample_logs(mdp, behavior, 2000, 60, np.random.default_rng(0))
    problem = mdps.problem(logs, mdp, tables, behavior, gamma=0.9, horizon=5, features=features)
    poor = FQE(approximation="network", hidden=(16,), updates=60, learning_rate=1e-3)  # far from settled
    with quiet():
        estimates = DoublyRobust(kind="dr", q=poor).estimate(problem, seeds=(0,))[0]
    truth = mdps.value(mdp, tables[0], 0.9, 5)
    uncorrected = estimates.values[0] - estimates.diagnostics[0]["correction"]
    assert abs(estimates.values[0] - truth) < 4 * estimates.replicates[0].std()
    assert abs(uncorrected - truth) > 2 * abs(estimates.values[0] - truth)


def test_few_episodes_are_warned_of() -> None:
    problem, _ = setting(mdps.chain(), 5)
    with pytest.warns(EstimationWarning, match="effective sample size of policy-0, policy-1 is under 10"):
        DoublyRobust(q=Known(np.zeros((2, 5, 2)))).estimate(problem, seeds=(0,))


def test_settings_are_checked_and_named() -> None:
    for wrong in ({"kind": "triply"}, {"q": 3}, {"action_draws": 0}, {"partial_sums": 1}, {"clip": (1.0, 2.0)}):
        with pytest.raises(ConfigurationError):
            DoublyRobust(**wrong)
    dope = DoublyRobust.preset("dope")
    assert (dope.kind, dope.clip, dope.q) == ("wdr", (-6.0, 2.0), FQE.preset("dope"))
    assert len({DoublyRobust(kind=kind).name for kind in KINDS}) == 3
    assert replace(dope, clip=None).name == f"DR weighted ({FQE.preset('dope').name})"


def test_given_initial_states_are_not_doubly_robust_and_told() -> None:
    mdp = mdps.random_mdp(seed=3)
    problem, _ = setting(mdp, 200)
    given = replace(problem, initial=problem.initial[:5], initial_unit=None)
    zero = Known(np.zeros((2, mdp.n_states, mdp.n_actions)))
    with pytest.warns(EstimationWarning, match="not of those given as initial_states") as caught:
        from_given = DoublyRobust(kind="dr", q=zero).estimate(given, seeds=(0, 1))[0]
    assert len(caught) == 1
    own = DoublyRobust(kind="dr", q=zero).estimate(problem, seeds=(0,))[0]
    np.testing.assert_allclose(from_given.values, own.values)  # a wrong Q gives the value from the data's own states


def test_intervals_hold_given_action_values_fixed() -> None:
    mdp = mdps.random_mdp(seed=3)
    problem, policies = setting(mdp, 100)
    found = DoublyRobust(q=exact(mdp, policies, 0.9)).estimate(problem, seeds=(0,))[0]
    assert [numbers["interval_covers_training"] for numbers in found.diagnostics] == [0.0, 0.0]
