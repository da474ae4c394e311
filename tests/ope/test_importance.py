"""Importance sampling: exact on policy, unbiased off policy, exact replicates, honest diagnostics."""

import dataclasses
import itertools
import warnings

import numpy as np
import pytest

from oat_gym.errors import ConfigurationError, EstimationWarning, InvalidDataError
from oat_gym.ope import ImportanceSampling, Problem
from oat_gym.ope._weights import importance_weights

from . import mdps

FORMS = [
    ImportanceSampling(kind=kind, weighted=weighted)
    for kind, weighted in itertools.product(("trajectory", "per-decision"), (True, False))
]
GAMMA = 0.9
CHAIN = mdps.chain(4)
LEFT = np.tile([0.6, 0.4], (5, 1))
RIGHT = np.tile([0.4, 0.6], (5, 1))


def estimate(form: ImportanceSampling, problem: Problem, *, quiet: bool = True):
    with warnings.catch_warnings():
        if quiet:
            warnings.simplefilter("ignore", EstimationWarning)
        return form.estimate(problem, seeds=(0,))[0]


def chain_problem(
    n: int = 40, *, seed: int = 0, length=60, policies=(LEFT, RIGHT), behavior=LEFT, **settings
) -> Problem:
    logs = mdps.sample_logs(CHAIN, behavior, n, length, np.random.default_rng(seed))
    return mdps.problem(logs, CHAIN, policies, behavior, **{"gamma": GAMMA, **settings})


def with_counts(problem: Problem, counts: np.ndarray) -> Problem:
    return dataclasses.replace(problem, resamples=counts)


@pytest.mark.parametrize("form", FORMS, ids=lambda form: form.name)
@pytest.mark.parametrize("horizon", [None, 7])
def test_on_policy_is_the_mean_return_exactly_with_unequal_lengths(
    form: ImportanceSampling, horizon: int | None
) -> None:
    rng = np.random.default_rng(3)
    logs = mdps.sample_logs(CHAIN, LEFT, 50, rng.integers(1, 30, 50), rng)
    assert len(set(logs.lengths)) > 10
    problem = mdps.problem(logs, CHAIN, [LEFT], LEFT, gamma=GAMMA, horizon=horizon)
    got = estimate(form, problem)
    assert got.values[0] == pytest.approx(logs.returns(GAMMA, horizon).mean(), abs=1e-13)
    means = problem.resamples @ logs.returns(GAMMA, horizon) / 50
    np.testing.assert_allclose(got.replicates[0], means, atol=1e-13)
    assert got.diagnostics[0]["effective_sample_size"] == pytest.approx(50)
    assert got.diagnostics[0]["mean_weight"] == pytest.approx(1)


@pytest.mark.parametrize("kind", ["trajectory", "per-decision"])
@pytest.mark.parametrize("horizon", [None, 5])
def test_off_policy_is_unbiased_with_action_dependent_termination(kind: str, horizon: int | None) -> None:
    # 2,000 data sets of 20 episodes: one large log, whose unnormalised returns are averaged in parts
    short, other = mdps.chain(2), np.tile([0.3, 0.7], (3, 1))
    logs = mdps.sample_logs(short, LEFT[:3], 40_000, 100, np.random.default_rng(1))
    problem = mdps.problem(logs, short, [other], LEFT[:3], gamma=GAMMA, horizon=horizon, n_resamples=1)
    returns = ImportanceSampling(kind=kind, weighted=False).weighted_returns(problem, seed=0)
    estimates = returns[0].reshape(2000, 20).mean(axis=1)
    truth = mdps.value(short, other, GAMMA, horizon)
    error = estimates.std(ddof=1) / np.sqrt(2000)
    assert abs(estimates.mean() - truth) < 3 * error
    on_policy = mdps.value(short, LEFT[:3], GAMMA, horizon)
    assert abs(on_policy - truth) > 8 * error  # a bias would be seen


@pytest.mark.parametrize("kind", ["trajectory", "per-decision"])
def test_self_normalised_forms_are_consistent(kind: str) -> None:
    problem = chain_problem(10_000, seed=2, length=100, policies=(RIGHT,), n_resamples=20)
    got = estimate(ImportanceSampling(kind=kind), problem)
    truth = mdps.value(CHAIN, RIGHT, GAMMA)
    assert abs(got.values[0] - truth) < 4 * got.replicates[0].std()
    assert got.replicates[0].std() < 0.1


@pytest.mark.parametrize("form", FORMS, ids=lambda form: form.name)
def test_replicates_are_the_estimates_of_the_resampled_data(form: ImportanceSampling) -> None:
    """A resample that holds an episode twice is the data set with that episode twice."""
    rng = np.random.default_rng(5)
    logs = mdps.sample_logs(CHAIN, LEFT, 12, rng.integers(1, 25, 12), rng)
    counts = rng.multinomial(12, np.full(12, 1 / 12), size=6).astype(float)
    replicates = estimate(form, with_counts(mdps.problem(logs, CHAIN, [LEFT, RIGHT], LEFT, gamma=GAMMA), counts))
    for b, row in enumerate(counts.astype(int)):
        chosen = np.repeat(np.arange(12), row)
        fields = {
            name: getattr(logs, name)[chosen] for name in ("states", "actions", "rewards", "lengths", "terminated")
        }
        again = estimate(form, mdps.problem(mdps.Logs(**fields), CHAIN, [LEFT, RIGHT], LEFT, gamma=GAMMA))
        np.testing.assert_allclose(replicates.replicates[:, b], again.values, rtol=1e-12)


def test_the_stepwise_form_against_a_plain_loop(monkeypatch: pytest.MonkeyPatch) -> None:
    from oat_gym.ope import _normalised

    problem = chain_problem(15, seed=6, length=np.random.default_rng(0).integers(1, 30, 15))
    steps, offsets = problem.data.steps, problem.data.offsets
    ratio = np.exp(problem.target_log_prob()[1] - problem.behavior(0))
    total = 0.0
    for t in range(int(problem.data.lengths.max())):
        weights, rewards = [], []
        for e in range(15):
            rows = slice(offsets[e], offsets[e + 1])
            weights.append(np.prod(ratio[rows][: t + 1]))
            rewards.append(steps.rewards[rows][t] if t < problem.data.lengths[e] else 0.0)
        total += GAMMA**t * np.dot(weights, rewards) / np.sum(weights)
    assert estimate(ImportanceSampling(), problem).values[1] == pytest.approx(total, rel=1e-12)
    whole = estimate(ImportanceSampling(), problem)
    monkeypatch.setattr(_normalised, "BLOCK", 45)  # three steps a block
    np.testing.assert_allclose(estimate(ImportanceSampling(), problem).replicates, whole.replicates, rtol=1e-12)


def test_weights_beyond_the_range_of_floats() -> None:
    """Log weights of +-1000s: the largest episode decides, and a resample without it is decided by the next."""
    problem = chain_problem(8, seed=7, length=30, policies=(LEFT,))
    shift = np.array([-4000.0, -2000.0, 0.0, 900.0, 1800.0, 2700.0, 3600.0, 5000.0])
    first = problem.data.offsets[:-1]
    counts = np.array([[1, 1, 1, 1, 1, 1, 1, 1], [2, 2, 1, 1, 1, 1, 0, 0], [3, 5, 0, 0, 0, 0, 0, 0]], dtype=float)
    problem = with_counts(problem, counts)
    problem.shared["target"] = problem.behavior(0)[None].copy()
    problem.shared["target"][0, first] += shift
    discounted = np.add.reduceat(problem.data.steps.rewards * GAMMA**problem.data.steps.step, first)
    for kind in ("trajectory", "per-decision"):
        got = estimate(ImportanceSampling(kind=kind), problem)
        np.testing.assert_allclose(got.replicates[0], discounted[[7, 5, 1]], rtol=1e-12)
        assert got.diagnostics[0]["effective_sample_size"] == pytest.approx(1)
        assert got.diagnostics[0]["largest_weight"] == pytest.approx(1)


def test_a_policy_that_does_what_nobody_did_has_no_self_normalised_value() -> None:
    never = np.tile([1.0, 0.0], (5, 1))
    logs = mdps.sample_logs(CHAIN, np.tile([0.0, 1.0], (5, 1)), 20, 30, np.random.default_rng(0))
    problem = mdps.problem(logs, CHAIN, [never], RIGHT, gamma=GAMMA)
    with pytest.warns(EstimationWarning, match="effective sample size of 1 of 1 policies is under 10 .least: 0.00"):
        got = ImportanceSampling().estimate(problem, seeds=(0,))[0]
    assert np.isnan(got.values[0])
    assert estimate(ImportanceSampling(weighted=False), problem).values[0] == 0.0


def test_augmented_copies_follow_their_source() -> None:
    """With copies of every episode among the returns, value and replicates are those of the episodes alone."""
    rng = np.random.default_rng(8)
    logs = mdps.sample_logs(CHAIN, LEFT, 10, rng.integers(2, 20, 10), rng)
    fields = ("states", "actions", "rewards", "lengths", "terminated")
    doubled = mdps.Logs(**{name: np.concatenate([getattr(logs, name)] * 2) for name in fields})
    alone = mdps.problem(logs, CHAIN, [RIGHT], LEFT, gamma=GAMMA)
    both = mdps.problem(doubled, CHAIN, [RIGHT], LEFT, gamma=GAMMA, use_augmented=frozenset({"weights"}))
    synthetic = np.arange(20) >= 10
    data = dataclasses.replace(both.data, unit=np.arange(20) % 10, synthetic=synthetic)
    both = dataclasses.replace(both, data=data, resamples=alone.resamples)
    for form in FORMS:
        one, two = estimate(form, alone), estimate(form, both)
        np.testing.assert_allclose(two.values, one.values, rtol=1e-12)
        np.testing.assert_allclose(two.replicates, one.replicates, rtol=1e-12)
        assert two.diagnostics[0]["effective_sample_size"] == pytest.approx(one.diagnostics[0]["effective_sample_size"])
        real_only = estimate(form, dataclasses.replace(both, use_augmented=frozenset()))
        np.testing.assert_allclose(real_only.values, one.values, rtol=1e-12)


def test_clipping_bounds_each_ratio_and_is_counted() -> None:
    problem = chain_problem(30, policies=(np.tile([0.01, 0.99], (5, 1)), LEFT), behavior=LEFT)
    weights = importance_weights(problem, 0, log_ratio_clip=(-1.0, 0.5))
    raw = problem.target_log_prob() - problem.behavior(0)
    assert weights.log_ratio.min() == -1.0
    assert weights.log_ratio.max() == 0.5
    np.testing.assert_allclose(weights.share_clipped, ((raw < -1) | (raw > 0.5)).mean(axis=1))
    assert weights.share_clipped[0] == 1.0
    assert weights.share_clipped[1] == 0.0
    got = estimate(ImportanceSampling(clip=(-1.0, 0.5)), problem)
    assert [d["share_clipped"] for d in got.diagnostics] == [1.0, 0.0]


def test_episodes_that_are_not_weighted_have_the_ratio_one() -> None:
    problem = chain_problem(12, policies=(RIGHT,))
    data = dataclasses.replace(problem.data, synthetic=np.arange(12) >= 8)
    impossible = np.where(data.synthetic[data.steps.episode], -np.inf, problem.behavior(0))
    problem = dataclasses.replace(problem, data=data, behavior=lambda seed: impossible)
    weights = importance_weights(problem, 0, log_ratio_clip=(-0.1, 0.1))
    assert (weights.log_ratio[:, data.synthetic[data.steps.episode]] == 0).all()
    assert weights.share_clipped[0] == 1.0  # of the steps that count


def test_weights_are_cumulated_within_episodes_and_kept_at_the_horizon() -> None:
    problem = chain_problem(20, seed=4, length=25, horizon=6)
    weights = importance_weights(problem, 0)
    steps, ratio = problem.data.steps, problem.target_log_prob() - problem.behavior(0)
    for e in range(20):
        rows = np.flatnonzero(steps.episode == e)
        expected = np.cumsum(ratio[1, rows[:6]])
        expected = np.concatenate([expected, np.full(len(rows) - len(expected), expected[-1])])
        np.testing.assert_allclose(weights.log_cumulative[1, rows], expected, atol=1e-12)
        np.testing.assert_allclose(weights.log_before[1, rows], np.concatenate([[0], expected[:-1]]), atol=1e-12)
        assert weights.log_final[1, e] == pytest.approx(expected[-1])
    assert weights.counted.sum() == np.minimum(problem.data.lengths, 6).sum()


def test_truncation_before_the_horizon_is_told() -> None:
    problem = chain_problem(400, length=3, policies=(LEFT,))
    with pytest.warns(EstimationWarning, match=r"100% of the episodes are truncated before the end, .* hides 72\.9%"):
        got = ImportanceSampling().estimate(problem, seeds=(0,))[0]
    assert got.diagnostics[0]["unseen_discount"] == pytest.approx(GAMMA**3)
    shorter = estimate(ImportanceSampling(), dataclasses.replace(problem, horizon=3), quiet=False)
    assert shorter.diagnostics[0]["truncated_before_horizon"] == 0.0
    longer = estimate(ImportanceSampling(), dataclasses.replace(problem, horizon=6))
    powers = GAMMA ** np.arange(6)
    assert longer.diagnostics[0]["unseen_discount"] == pytest.approx(powers[3:].sum() / powers.sum())
    undiscounted = estimate(ImportanceSampling(), dataclasses.replace(problem, horizon=6, gamma=1.0))
    assert undiscounted.diagnostics[0]["unseen_discount"] == pytest.approx(0.5)


def test_few_episodes_and_given_initial_states_are_told() -> None:
    with pytest.warns(EstimationWarning, match=r"least: 9\.00 of 9 real episodes"):
        ImportanceSampling().estimate(chain_problem(9, policies=(LEFT,)), seeds=(0,))
    problem = chain_problem(20, policies=(LEFT,), initial=np.zeros(3, dtype=int), length=200)
    with pytest.warns(EstimationWarning, match="from the initial states of the data"):
        ImportanceSampling().estimate(problem, seeds=(0,))


def test_impossible_behaviour_and_densities_that_are_no_numbers() -> None:
    problem = chain_problem(10)
    impossible = dataclasses.replace(
        problem, behavior=lambda seed: np.where(problem.data.steps.step == 1, -np.inf, -1.0)
    )
    with pytest.raises(InvalidDataError, match="step 1 of episode 0 the log-probability -inf"):
        ImportanceSampling().estimate(impossible, seeds=(0,))
    short = dataclasses.replace(problem, behavior=lambda seed: np.zeros(3))
    with pytest.raises(InvalidDataError, match=r"shape \(3,\), expected one for each"):
        ImportanceSampling().estimate(short, seeds=(0,))
    problem.shared["target"] = np.full((2, len(problem.data.steps)), np.inf)
    with pytest.raises(ConfigurationError, match="Policy 'policy-0' gives the action at step 0"):
        ImportanceSampling().estimate(problem, seeds=(0,))


def test_seeds_ask_for_their_own_behaviour() -> None:
    problem = chain_problem(200, policies=(LEFT,), length=200)
    log_beta = problem.behavior(0)
    moved = dataclasses.replace(problem, behavior=lambda seed: log_beta - 0.01 * seed * problem.data.steps.actions)
    form = ImportanceSampling(kind="trajectory")
    first, second = form.estimate(moved, seeds=(0, 5))
    assert first.values[0] != second.values[0]
    assert form.estimate(moved, seeds=(5,))[0].values[0] == second.values[0]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"kind": "step"}, "kind must be one of trajectory, per-decision, got 'step'"),
        ({"weighted": "yes"}, "weighted must be True or False"),
        ({"clip": (1.0, 2.0)}, "least <= 0 <= greatest"),
        ({"clip": 3.0}, "least <= 0 <= greatest"),
    ],
)
def test_settings_are_checked(settings: dict, message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        ImportanceSampling(**settings)


def test_names_and_preset() -> None:
    assert len({form.name for form in FORMS}) == 4
    assert ImportanceSampling.preset("dope") == ImportanceSampling(clip=(-6.0, 2.0))
    assert eval(repr(ImportanceSampling.preset("dope"))) == ImportanceSampling.preset("dope")
    with pytest.raises(ConfigurationError, match="preset 'dope'"):
        ImportanceSampling.preset("best")
