"""Intervals of improvements: known improvements are covered, and nothing is found where there is nothing."""

import math

import numpy as np
import pytest

from oat_gym.benchmark.improvement import improve, over_related, over_tasks
from oat_gym.benchmark.scores import METRICS, Draws, Metric, draw_scores, policy_picks, resampled_score, score
from oat_gym.errors import InvalidDataError
from oat_gym.ope import metrics

B = 60


def _noisy(rng: np.random.Generator, *, seeds: int, policies: int, bias: float, noise: float, seed_noise: float = 0.5):
    """Estimates of a method whose errors are bias + policy + seed + both + episodes, and their replicates."""
    true = np.sort(rng.normal(0, 5, size=policies))
    shared = rng.normal(0, 0.5, size=policies)

    def method(scale: float) -> tuple[np.ndarray, np.ndarray]:
        own = rng.normal(0, 0.7, size=(1, policies)) + rng.normal(0, seed_noise, size=(seeds, 1))
        own = own + rng.normal(0, noise, size=(seeds, policies))
        values = true + scale * (bias + shared + own)
        return values, values[..., None] + 0.1 * rng.normal(size=(seeds, policies, B))

    return true, method


def _improve(true: np.ndarray, before, after, metric: Metric):
    exact = np.zeros(len(true))
    sides = [[draw_scores(*side, true, exact, metric)] for side in (before, after)]
    return improve(*sides, metric, n_policies=len(true), n_episodes=25)


@pytest.mark.parametrize("metric", ["mae", "rank_correlation"])
@pytest.mark.parametrize("seed_noise", [0.2, 2.0])
def test_where_nothing_changes_the_interval_holds_zero_in_about_95_percent(metric: Metric, seed_noise: float) -> None:
    found = 0
    for trial in range(120):
        rng = np.random.default_rng(trial)
        true, method = _noisy(rng, seeds=3, policies=11, bias=3.0, noise=0.5, seed_noise=seed_noise)
        verdict = _improve(true, method(1.0), method(1.0), metric).verdict
        found += verdict in ("helps", "hurts")
    assert found / 120 <= 0.09  # the nominal 5%, and two standard errors of 120 trials above it


def test_seeds_in_which_a_metric_is_undefined_do_not_count() -> None:
    """Equal estimates have no ranks: of three seeds one is left, and one seed never decides."""
    true = np.arange(5.0)
    flat, ranked = np.zeros(5), np.arange(5.0)
    before = np.stack([ranked[::-1], flat, flat])
    after = np.stack([ranked, ranked, ranked])
    sides = [(values, np.repeat(values[..., None], B, axis=2)) for values in (before, after)]
    change = _improve(true, *sides, "rank_correlation")
    assert (change.n_seeds, change.verdict) == (1, "no evidence")
    assert change.value == pytest.approx(2.0)


@pytest.mark.parametrize("ratio", [0.5, 2.0])
def test_a_known_improvement_is_covered(ratio: float) -> None:
    """Errors are scaled by `ratio`: over seeds and policies, the expected error changes by 100 (1 - ratio) percent."""
    expected, trials = 100 * (1 - ratio), 100
    covered, named, wrong = 0, 0, 0
    for trial in range(trials):
        rng = np.random.default_rng(1000 + trial)
        true, method = _noisy(rng, seeds=3, policies=11, bias=3.0, noise=0.5)
        change = _improve(true, method(1.0), method(ratio), "mae")
        covered += change.low <= expected <= change.high
        named += change.verdict == ("helps" if expected > 0 else "hurts")
        wrong += change.verdict == ("hurts" if expected > 0 else "helps")
    assert covered / trials >= 0.90
    assert wrong == 0
    assert named / trials > 0.5  # not by being so wide that nothing is ever found


def test_the_null_is_not_covered_by_width_alone() -> None:
    """With many seeds and small noise, an improvement of 10 percent is found."""
    rng = np.random.default_rng(0)
    true = np.linspace(-5, 5, 11)
    values = true + 3.0 + 0.1 * rng.normal(size=(10, 11))
    better = true + 2.7 + 0.1 * rng.normal(size=(10, 11))
    sides = [(each, each[..., None] + 0.05 * rng.normal(size=(10, 11, B))) for each in (values, better)]
    change = _improve(true, *sides, "mae")
    assert change.verdict == "helps"
    assert change.value == pytest.approx(10, abs=1)
    assert change.low < 10 < change.high


def test_pairs_that_move_together_have_a_narrow_interval() -> None:
    """A seed that shifts both sides alike says nothing about their difference."""
    true = np.linspace(0, 1, 8)
    shift = np.array([[0.0], [5.0], [10.0]])
    before, after = (true[::-1] * 0 + true + shift + offset for offset in (4.0, 3.0))
    sides = [(each, np.repeat(each[..., None], B, axis=-1)) for each in (before, after)]
    paired = _improve(true, *sides, "rank_correlation")
    assert paired.standard_error == pytest.approx(0, abs=1e-12)


def test_one_seed_is_never_evidence() -> None:
    true = np.linspace(0, 1, 8)
    sides = [(np.array([true + gap]), (true + gap)[None, :, None] + np.zeros((1, 8, B))) for gap in (10.0, 1.0)]
    change = _improve(true, *sides, "mae")
    assert change.low > 80
    assert change.verdict == "no evidence"


def test_three_seeds_use_students_quantile() -> None:
    """Where only seeds vary, nu = S - 1 and the half-width is 4.30 standard errors."""
    true = np.zeros(1)
    rng = np.random.default_rng(3)
    before, after = (np.exp(rng.normal(size=(3, 1))) for _ in range(2))
    sides = [(each, np.repeat(each[..., None], B, axis=-1)) for each in (before, after)]
    change = _improve(true, *sides, "mae")
    assert change.degrees == pytest.approx(2)
    width = -math.log1p(-change.high / 100) - change.effect
    assert width / change.standard_error == pytest.approx(4.3027, abs=1e-3)
    assert change.parts.policies == change.parts.truth == 0


def test_the_error_of_true_values_widens_the_interval() -> None:
    true = np.linspace(0, 1, 8)
    sides = [(np.tile(true + gap, (3, 1)), np.tile((true + gap)[:, None], (3, 1, B))) for gap in (0.5, 0.4)]
    exact, rolled = (
        improve(
            *[[draw_scores(*side, true, np.full(8, error), "mae")] for side in sides], "mae", n_policies=8, n_episodes=9
        )
        for error in (0.0, 0.3)
    )
    assert exact.parts.truth == 0 < rolled.parts.truth
    assert rolled.high - rolled.low > exact.high - exact.low


def test_undefined_metrics_are_left_out_on_both_sides() -> None:
    """The second seed of one side ranks nothing: the comparison is of the others."""
    before = Draws(np.array([0.2, math.nan, 0.4]), *(np.full((9, 3), 0.3),) * 3)
    after = Draws(np.array([0.5, 0.9, 0.7]), *(np.full((9, 3), 0.6),) * 3)
    change = improve([before], [after], "rank_correlation", n_policies=5, n_episodes=5)
    assert change.value == pytest.approx(0.3)
    nothing = Draws(np.full(3, math.nan), *(np.full((9, 3), math.nan),) * 3)
    assert improve([nothing], [after], "rank_correlation", n_policies=5, n_episodes=5).verdict == "not measured"


def test_the_mean_over_tasks_has_the_variance_of_a_mean() -> None:
    rng = np.random.default_rng(0)
    true, method = _noisy(rng, seeds=4, policies=9, bias=3.0, noise=0.5)
    one = _improve(true, method(1.0), method(0.7), "mae")
    both = over_tasks([one, one])
    assert both.effect == pytest.approx(one.effect)
    assert both.standard_error == pytest.approx(one.standard_error / math.sqrt(2))
    assert both.degrees == pytest.approx(2 * one.degrees)
    alike = over_related([one, one])  # the same twice is no more than once
    assert alike.effect == pytest.approx(one.effect)
    assert alike.standard_error == pytest.approx(one.standard_error)
    assert alike.degrees == one.degrees and (alike.low, alike.high) == pytest.approx((one.low, one.high))
    for mean in (over_tasks, over_related):
        with pytest.raises(InvalidDataError, match="one metric"):
            mean([])
    with pytest.raises(InvalidDataError, match="same estimators and seeds"):
        improve([], [], "mae", n_policies=2, n_episodes=2)


@pytest.mark.parametrize("metric", METRICS)
def test_scores_of_many_rows_are_those_of_ope_metrics(metric: Metric) -> None:
    rng = np.random.default_rng(0)
    true = rng.normal(size=8)
    rows = rng.normal(size=(4, 5, 8))
    rows[0, 0, :6] = rows[0, 0, 0]  # ties at the threshold
    rows[1, 1] = 1.0
    rows[2, 2, 3] = np.nan
    got = score(rows, true, metric)
    one = {
        "mae": lambda row: metrics.absolute_error(row, true).mean(),
        "rank_correlation": lambda row: metrics.rank_correlation(row, true),
        "regret_at_1": lambda row: metrics.regret_at_k(row, true, 1, convention="raw"),
        "regret_at_5": lambda row: metrics.regret_at_k(row, true, 5, convention="raw"),
    }[metric]
    expected = np.array([[one(row) if np.isfinite(row).all() else np.nan for row in block] for block in rows])
    np.testing.assert_allclose(got, expected, atol=1e-12)
    assert score(rows[0, 0], true, metric) == pytest.approx(expected[0, 0])  # a single row


def test_regrets_that_few_resamples_define_are_no_evidence() -> None:
    """Regret@5 of six policies: a resample has six different ones in one of 65 draws."""
    true = np.arange(6.0)
    sides = [np.tile(order, (3, 1)) for order in (true[::-1], true)]
    change = _improve(true, *[(each, np.repeat(each[..., None], B, axis=2)) for each in sides], "regret_at_5")
    assert change.value > 0 and change.verdict == "no evidence" and change.parts.main == "policies"


@pytest.mark.parametrize("metric", METRICS)
def test_resampled_scores_are_scores_of_the_resample(metric: Metric) -> None:
    rng = np.random.default_rng(1)
    true, rows, picks = rng.normal(size=9), rng.normal(size=(3, 9)), policy_picks(9)[:20]
    got = resampled_score(rows, true, picks, metric)
    assert got.shape == (20, 3)
    for r, drawn in enumerate(picks):
        members = np.unique(drawn) if metric.startswith("regret") else drawn
        k = {"regret_at_1": 1, "regret_at_5": 5}.get(metric)
        if k is None:
            expected = score(rows[:, drawn], true[drawn], metric)
        elif k > 1 and len(members) <= k:
            expected = [np.nan] * len(rows)
        else:
            expected = [metrics.regret_at_k(row[members], true[members], k, convention="raw") for row in rows]
        np.testing.assert_allclose(got[r], expected, atol=1e-12)
