"""Metrics against brute force and hand-made cases."""

import itertools
import math
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from oat_gym.errors import ConfigurationError, InvalidDataError
from oat_gym.ope.agreement import agreement_curve, agreement_rate, wilson_interval
from oat_gym.ope.metrics import absolute_error, rank_correlation, regret_at_k, summary, t_test

from . import mdps


def brute_force_regret(predicted: np.ndarray, true: np.ndarray, k: int) -> float:
    """The mean over all orders of the policies, which break ties in each possible way."""
    found = []
    for order in itertools.permutations(range(len(true))):
        chosen = sorted(order, key=lambda i: -predicted[i])[:k]  # a stable sort keeps the order of tied ones
        found.append(true[list(chosen)].max())
    return float((true.max() - np.mean(found)) / abs(true.max()))


@pytest.mark.parametrize("k", [1, 2, 4])
@pytest.mark.parametrize("predicted", [[1, 2, 3, 4, 5], [1, 1, 1, 1, 1], [2, 2, 1, 3, 2], [0, 5, 5, 0, 0]])
def test_regret_is_the_mean_over_random_tie_breaking(predicted: list[int], k: int) -> None:
    true = np.array([3.0, -1.0, 7.0, 2.0, 5.0])
    got = regret_at_k(predicted, true, k, convention="raw")
    assert got == pytest.approx(brute_force_regret(np.array(predicted), true, k))


def test_a_constant_predictor_gets_the_average_regret_and_not_zero() -> None:
    true = [10.0, 0.0, 5.0]
    assert regret_at_k([1, 1, 1], true, 1) == pytest.approx(0.5)
    assert regret_at_k([1, 1, 1], true, 3) == 0.0
    assert regret_at_k([3, 2, 1], true, 1) == 0.0
    assert regret_at_k([1, 3, 2], true, 1) == 1.0


def test_the_conventions() -> None:
    true, predicted = np.array([100.0, 200.0, 300.0]), np.array([900.0, 100.0, 600.0])
    np.testing.assert_allclose(absolute_error(predicted, true), [800, 100, 300])
    # scaled: true 0, 0.5, 1; estimates 4 and 2.5 are cut at 2
    np.testing.assert_allclose(absolute_error(predicted, true, convention="dope"), [2.0, 0.5, 1.0])
    assert regret_at_k(predicted, true, 1, convention="raw") == pytest.approx(200 / 300)
    # the estimates that are cut are tied: policy 0 or policy 2
    assert regret_at_k(predicted, true, 1, convention="dope") == pytest.approx(0.5)
    low = np.array([-900.0, 150.0, 120.0])  # nothing is cut from below
    assert absolute_error(low, true, convention="dope")[0] == pytest.approx(5.0)
    assert math.isnan(regret_at_k([1, 2], [0.0, -1.0], 1, convention="raw"))
    assert regret_at_k([1, 2], [-1.0, -3.0], 1, convention="raw") == pytest.approx(2.0)


def test_nan_estimates_are_chosen_last() -> None:
    assert regret_at_k([np.nan, 1.0, 2.0], [10.0, 5.0, 0.0], 2) == pytest.approx(0.5)
    assert regret_at_k([np.nan, np.nan, 2.0], [10.0, 6.0, 0.0], 2) == pytest.approx(0.2)


def test_rank_correlation_is_spearman_and_nan_where_nothing_is_ranked() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        predicted, true = rng.integers(0, 5, 8).astype(float), rng.normal(size=8)
        assert rank_correlation(predicted, true) == pytest.approx(stats.spearmanr(predicted, true).statistic)
    assert rank_correlation([1, 2, 3], [1, 8, 27]) == pytest.approx(1.0)
    for predicted, true in (([1, 1, 1], [1, 2, 3]), ([1, 2, 3], [4, 4, 4]), ([np.nan, 1, 2], [1, 2, 3]), ([1], [1])):
        assert math.isnan(rank_correlation(predicted, true))


def test_the_t_test_needs_no_luck_with_the_number_of_resamples() -> None:
    """Two policies of one value: the paper's test calls them different with many resamples, ours keeps its level."""
    rng = np.random.default_rng(0)
    wrong, ours = 0, 0
    for _ in range(200):
        returns = rng.normal(size=(2, 40))
        counts = rng.multinomial(40, np.full(40, 1 / 40), size=1000)
        first, second = returns @ counts.T / 40
        wrong += t_test(first, second, method="paper").p_value < 0.05
        ours += t_test(first, second, n=40).p_value < 0.05
    assert wrong > 120
    assert 2 <= ours <= 22


def test_the_papers_test_is_welchs() -> None:
    rng = np.random.default_rng(1)
    first, second = rng.normal(size=30), 0.5 + 2 * rng.normal(size=50)
    test = t_test(first, second, method="paper")
    expected = stats.ttest_ind(first, second, equal_var=False)
    assert (test.statistic, test.p_value, test.degrees) == pytest.approx(
        (expected.statistic, expected.pvalue, expected.df)
    )
    assert t_test(first, first).p_value == 1.0
    assert t_test(first + 1, first).p_value == 0.0


def test_a_shared_resample_pairs_the_policies() -> None:
    rng = np.random.default_rng(2)
    noise = rng.normal(size=500)
    small = t_test(noise + 0.3, noise + 0.05 * rng.normal(size=500), n=25)
    assert small.standard_error == pytest.approx(0.05, rel=0.15)
    assert small.p_value < 0.001


def test_summary_has_a_row_for_each_estimator_and_seed() -> None:
    truth = {"a": 1.0, "b": 2.0, "c": 4.0}
    rows = [
        {"policy": policy, "estimator": estimator, "seed": seed, "value": value}
        for estimator, seed, values in (("X", 0, (1, 2, 3)), ("X", 1, (3, 2, 1)), ("Y", 0, (5, 5, 5)))
        for policy, value in zip("abc", values, strict=True)
    ]
    got = summary(SimpleNamespace(rows=rows), truth)
    assert [(row["estimator"], row["seed"]) for row in got] == [("X", 0), ("X", 1), ("Y", 0)]
    assert [row["mae"] for row in got] == pytest.approx([1 / 3, 5 / 3, 8 / 3])
    assert [row["mae_dope"] for row in got] == pytest.approx([1 / 9, 5 / 9, 8 / 9])
    assert [row["regret_at_1"] for row in got] == pytest.approx([0.0, 1.0, 5 / 9])
    assert got[0]["rank_correlation"] == pytest.approx(1.0)
    assert math.isnan(got[2]["rank_correlation"])
    assert "all estimates are the same" in got[2]["note"]
    assert math.isnan(got[0]["regret_at_5"])
    assert "not more than five" in got[0]["note"]
    with pytest.raises(InvalidDataError, match="No true value is given for c"):
        summary(SimpleNamespace(rows=rows), {"a": 1.0, "b": 2.0})
    same = summary(SimpleNamespace(rows=rows), {"a": 1.0, "b": 1.0, "c": 1.0})
    assert math.isnan(same[0]["mae_dope"])
    assert "all true values are the same" in same[0]["note"]


def test_wilsons_interval_covers_small_groups() -> None:
    rng = np.random.default_rng(0)
    hits = rng.binomial(12, 0.1, size=4000)
    low, high = wilson_interval(hits, np.full(4000, 12))
    assert 0.92 <= ((low <= 0.1) & (high >= 0.1)).mean() <= 0.99
    expected = stats.binomtest(3, 12).proportion_ci(method="wilson")
    assert (float(wilson_interval(3, 12)[0]), float(wilson_interval(3, 12)[1])) == pytest.approx(tuple(expected))


def test_agreement_is_the_share_of_steps_where_the_log_follows_the_policy() -> None:
    mdp = mdps.chain(3)
    logs = mdps.sample_logs(mdp, np.full((4, 2), 0.5), 30, 20, np.random.default_rng(0))
    policy = mdps.Table(np.tile([0.2, 0.8], (4, 1)))
    expected = [(logs.actions[e, : logs.lengths[e]] == 1).mean() for e in range(30)]
    np.testing.assert_allclose(agreement_rate(mdps.logged(logs, mdp), policy), expected)


def test_curves_count_every_episode_once_in_bins_and_from_a_threshold_on_as_in_the_paper() -> None:
    rng = np.random.default_rng(0)
    agreement = rng.integers(0, 11, 500) / 10
    event = rng.random(500) < 0.6 - 0.5 * agreement
    bins = agreement_curve(agreement, event, edges=(0.0, 0.25, 0.5, 1.0))
    assert bins.count.sum() == 500
    assert bins.events.sum() == event.sum()
    assert np.all(np.diff(bins.rate) < 0)
    assert np.all((bins.rate_low < bins.rate) & (bins.rate < bins.rate_high))
    paper = agreement_curve(agreement, event, edges=(0.0, 0.5, 1.0), kind="at-least")
    assert paper.count.tolist() == [500, (agreement >= 0.5).sum(), (agreement == 1).sum()]
    assert paper.rate[1] == pytest.approx(event[agreement >= 0.5].mean())
    empty = agreement_curve([0.1, 0.2], [True, False], edges=(0.0, 0.5, 1.0))
    assert math.isnan(empty.rate[1])
    assert (empty.rate_low[1], empty.rate_high[1]) == (0.0, 1.0)


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda: regret_at_k([1, 2], [1, 2], 3), ConfigurationError, "k must be from 1 to the 2"),
        (lambda: regret_at_k([1, 2], [1, 2], 0), ConfigurationError, "k must be from 1"),
        (lambda: absolute_error([1], [1, 2]), InvalidDataError, "one length"),
        (lambda: absolute_error([1, 2], [1, np.nan]), InvalidDataError, "True values must be finite"),
        (lambda: absolute_error([1, 2], [1, 2], convention="mean"), ConfigurationError, "'dope' or 'raw'"),
        (lambda: absolute_error([1, 2], [1, 1], convention="dope"), InvalidDataError, "all are the same"),
        (lambda: t_test([1, 2], [1, 2, 3]), InvalidDataError, "one size"),
        (lambda: t_test([1, np.nan], [1, 2]), InvalidDataError, "finite numbers, and 1 of 2 are NaN or infinite"),
        (lambda: t_test([1], [1, 2]), InvalidDataError, r"at least two numbers, got shape \(1,\)"),
        (lambda: t_test([1, 2], [1, 2], method="z"), ConfigurationError, "'bootstrap' or 'paper'"),
        (lambda: agreement_curve([0.5], [True, False]), InvalidDataError, "one for each event"),
        (lambda: agreement_curve([1.5], [True]), InvalidDataError, "from 0 to 1"),
        (lambda: agreement_curve([0.5], [True], edges=(0.5, 0.2)), ConfigurationError, "increasing"),
        (lambda: agreement_curve([0.5], [True], kind="above"), ConfigurationError, "'bins' or 'at-least'"),
    ],
)
def test_what_cannot_work_is_told(call, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        call()
