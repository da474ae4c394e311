"""Confidence intervals hold the truth as often as they say."""

import math

import numpy as np
import pytest
from scipy import stats

from oat_gym.errors import ConfigurationError, InvalidDataError
from oat_gym.ope import ImportanceSampling, PolicySet, Problem
from oat_gym.ope._normalised import Spans, normalised_means
from oat_gym.ope._weights import importance_weights
from oat_gym.ope.importance import discounted_returns
from oat_gym.ope.intervals import (
    bootstrap_interval,
    empirical_bernstein_interval,
    hoeffding_interval,
    return_bounds,
    standard_error,
    t_interval,
)

from . import mdps

GAMMA = 0.9
SETS, EPISODES = 1000, 200
CHAIN = mdps.chain(3)
BEHAVIOR, TARGET = np.full((4, 2), 0.5), np.tile([0.4, 0.6], (4, 1))


@pytest.fixture(scope="module")
def logs() -> tuple[Problem, np.ndarray]:
    """1,000 data sets of 200 episodes, as one log, and the resamples."""
    drawn = mdps.sample_logs(CHAIN, BEHAVIOR, SETS * EPISODES, 60, np.random.default_rng(0))
    data = mdps.logged(drawn, CHAIN)
    beta = mdps.Table(BEHAVIOR).log_prob(data.steps.observations, data.steps.actions)
    problem = Problem(
        data=data,
        policies=PolicySet.of([mdps.Table(TARGET)]),
        gamma=GAMMA,
        horizon=None,
        initial=drawn.states[:, 0],
        initial_unit=None,
        behavior=lambda seed: beta,
        resamples=np.ones((1, 1)),
    )
    counts = np.random.default_rng(1).multinomial(EPISODES, np.full(EPISODES, 1 / EPISODES), size=500)
    return problem, counts.astype(float)


def coverage(interval: tuple[np.ndarray, np.ndarray], truth: float) -> float:
    return float(np.mean((interval[0] <= truth) & (truth <= interval[1])))


def test_the_bootstrap_interval_holds_the_value_of_another_policy_in_95_of_100_data_sets(logs) -> None:
    problem, counts = logs
    truth = mdps.value(CHAIN, TARGET, GAMMA)
    ordinary = ImportanceSampling(weighted=False).weighted_returns(problem, seed=0).reshape(SETS, EPISODES)
    assert 0.93 <= coverage(bootstrap_interval(ordinary @ counts.T / EPISODES, n=EPISODES), truth) <= 0.97
    log_weights = importance_weights(problem, 0).log_final.reshape(SETS, EPISODES)
    returns = discounted_returns(problem, Spans.of(problem)).reshape(SETS, EPISODES)
    weighted = np.stack([normalised_means(w, g, counts)[1] for w, g in zip(log_weights, returns, strict=True)])
    assert 0.93 <= coverage(bootstrap_interval(weighted, n=EPISODES), truth) <= 0.97
    # a nominal 80% interval is another one: the level is not ignored
    assert 0.76 <= coverage(bootstrap_interval(weighted, n=EPISODES, confidence=0.8), truth) <= 0.84


def test_intervals_of_mean_returns(logs) -> None:
    """t is near its level; the two that hold for every distribution hold at least as often, and are not vacuous."""
    problem, _ = logs
    truth = mdps.value(CHAIN, BEHAVIOR, GAMMA)
    returns = discounted_returns(problem, Spans.of(problem)).reshape(SETS, EPISODES)
    bounds = return_bounds(-0.1, 1.0, gamma=GAMMA)
    assert bounds == pytest.approx((-1.0, 10.0))
    assert 0.93 <= coverage(t_interval(returns), truth) <= 0.97
    widths = {}
    for interval in (hoeffding_interval, empirical_bernstein_interval):
        low, high = interval(returns, bounds=bounds)
        assert coverage((low, high), truth) >= 0.95
        widths[interval] = float((high - low).mean())
    assert widths[hoeffding_interval] < bounds[1] - bounds[0]


def test_few_episodes_need_wider_percentiles() -> None:
    """With 12 normal returns plain percentiles hold the mean in under 93%, the corrected ones in more."""
    rng = np.random.default_rng(2)
    sample = rng.normal(size=(4000, 12))
    counts = rng.multinomial(12, np.full(12, 1 / 12), size=400)
    replicates = sample @ counts.T / 12
    plain = coverage(bootstrap_interval(replicates, method="percentile"), 0.0)
    corrected = coverage(bootstrap_interval(replicates, n=12), 0.0)
    normal = coverage(bootstrap_interval(replicates, n=12, method="normal", values=sample.mean(axis=1)), 0.0)
    assert plain < 0.925
    assert corrected > plain + 0.015
    assert normal > plain + 0.015
    assert coverage(t_interval(sample), 0.0) == pytest.approx(0.95, abs=0.012)


def test_closed_forms() -> None:
    low, high = hoeffding_interval(np.full(50, 3.0), bounds=(2.0, 6.0), confidence=0.9)
    assert high - 3.0 == pytest.approx(4.0 * math.sqrt(math.log(2 / 0.1) / 100))
    assert 3.0 - low == pytest.approx(high - 3.0)
    low, high = empirical_bernstein_interval(np.full(50, 3.0), bounds=(2.0, 6.0), confidence=0.9)
    assert high - 3.0 == pytest.approx(7 * 4.0 * math.log(4 / 0.1) / (3 * 49))
    sample = np.random.default_rng(0).normal(size=20)
    expected = stats.t.interval(0.9, 19, loc=sample.mean(), scale=stats.sem(sample))
    assert t_interval(sample, confidence=0.9) == pytest.approx(expected)


def test_small_variance_makes_the_empirical_bernstein_interval_the_narrower_one() -> None:
    rng = np.random.default_rng(0)
    quiet, loud = 0.5 + 0.01 * rng.random((1, 2000)), rng.integers(0, 2, (1, 2000)).astype(float)

    def width(interval: tuple[np.ndarray, np.ndarray]) -> float:
        return float((interval[1] - interval[0])[0])

    bounds = (0.0, 1.0)
    assert (
        width(empirical_bernstein_interval(quiet, bounds=bounds)) < width(hoeffding_interval(quiet, bounds=bounds)) / 3
    )
    assert width(empirical_bernstein_interval(loud, bounds=bounds)) > width(hoeffding_interval(loud, bounds=bounds))


def test_bounds_of_returns_enclose_every_return() -> None:
    rng = np.random.default_rng(0)
    for r_min, r_max, gamma, horizon in ((-1.0, 2.0, 0.9, None), (0.5, 2.0, 0.9, 8), (-2.0, -1.0, 1.0, 5)):
        low, high = return_bounds(r_min, r_max, gamma=gamma, horizon=horizon)
        for length in range(1, (horizon or 60) + 1):
            total = (rng.uniform(r_min, r_max, length) * gamma ** np.arange(length)).sum()
            assert low <= total <= high
    assert return_bounds(-1.0, 2.0, gamma=1.0, horizon=5) == (-5.0, 10.0)
    with pytest.raises(ConfigurationError, match="no bounds without a horizon"):
        return_bounds(0.0, 1.0, gamma=1.0)


def test_replicates_that_are_no_numbers_are_left_out() -> None:
    draws = np.array([[1.0, 2.0, 3.0, np.nan], [np.nan, np.nan, np.inf, 1.0], [1.0, 2.0, 3.0, 4.0]])
    error = standard_error(draws)
    assert error[0] == pytest.approx(1.0)
    assert np.isnan(error[1])
    low, high = bootstrap_interval(draws)
    assert (low[0], high[0]) == pytest.approx((1.05, 2.95))
    assert np.isnan(low[1])
    assert np.isnan(high[1])


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (
            lambda: bootstrap_interval([1.0, 2.0], method="bca"),
            ConfigurationError,
            "one of bootstrap, percentile, normal",
        ),
        (lambda: bootstrap_interval([1.0, 2.0], confidence=95), ConfigurationError, "between 0 and 1"),
        (lambda: bootstrap_interval([1.0, 2.0], method="normal"), ConfigurationError, "give values="),
        (lambda: t_interval([1.0]), InvalidDataError, "at least two returns"),
        (lambda: t_interval([1.0, np.nan]), InvalidDataError, "finite"),
        (lambda: hoeffding_interval([0.0, 3.0], bounds=(0.0, 1.0)), InvalidDataError, "outside the bounds"),
        (lambda: hoeffding_interval([0.0, 1.0], bounds=(1.0, 0.0)), ConfigurationError, "least, greatest"),
        (lambda: return_bounds(2.0, 1.0, gamma=0.9), ConfigurationError, "r_min must not be above"),
    ],
)
def test_what_cannot_work_is_told(call, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        call()
