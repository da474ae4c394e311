"""TICC: planted clusters, a monotone objective, Toeplitz structure, and what it does at the edges."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from oat_gym.errors import ConfigurationError, InvalidDataError
from oat_gym.mining import TICC
from oat_gym.mining._em import objective_of
from oat_gym.mining._toeplitz import toeplitz_graphical_lasso
from oat_gym.mining._windows import join_series, stack_windows, switch_penalties


def planted(seed: int, means: float, n_series: int = 8, features: int = 5, clusters: int = 3):
    """Series of unequal lengths whose regimes differ by correlation, and by mean where `means` > 0."""
    rng = np.random.default_rng(seed)
    mixing = rng.normal(size=(clusters, features, features))
    centres = rng.normal(scale=means, size=(clusters, features)) if means else np.zeros((clusters, features))
    series, labels = [], []
    for i in range(n_series):
        order = rng.permutation(clusters)
        runs = [np.full(int(rng.integers(40, 80 + 5 * i)), k) for k in order]
        truth = np.concatenate(runs)
        noise = rng.normal(size=(len(truth), features))
        series.append(centres[truth] + np.einsum("tij,tj->ti", mixing[truth], noise))
        labels.append(truth)
    return series, labels


def accuracy(found, truth, clusters: int) -> float:
    found, truth = np.concatenate(found), np.concatenate(truth)
    table = np.zeros((clusters, clusters))
    np.add.at(table, (found, truth), 1)
    return table[linear_sum_assignment(-table)].sum() / len(truth)


@pytest.mark.parametrize(("means", "window"), [(0.0, 1), (3.0, 1), (0.0, 2), (3.0, 3)])
def test_planted_clusters_are_recovered(means, window):
    series, truth = planted(1, means)
    model = TICC(3, window, switch_penalty=20.0).fit(series)
    assert accuracy(model.labels_, truth, 3) >= 0.95
    assert [len(x) for x in model.labels_] == [len(x) for x in series]


@pytest.mark.parametrize("window", [1, 3])
@pytest.mark.parametrize("clusters", [2, 6, 15])
def test_objective_never_falls_and_is_what_the_docs_say(window, clusters):
    series, _ = planted(2, 0.5)
    model = TICC(clusters, window, switch_penalty=5.0).fit(series)
    assert np.all(np.diff(model.objectives_) > 0)
    assert model.objective_ == model.objectives_[-1]
    assert model.n_iter_ == len(model.objectives_)
    rows = join_series([(x - model.center_) / model.scale_ for x in series])
    windows, labels = stack_windows(rows, window), np.concatenate(model.labels_)
    total = 0.0
    for x, k in zip(windows, labels, strict=True):
        theta, centred = model.precisions_[k], x - model.means_[k]
        total += 0.5 * (np.linalg.slogdet(theta)[1] - centred @ theta @ centred - len(x) * np.log(2 * np.pi))
    total -= 5.0 / np.log(np.e + 1) * sum((np.diff(part) != 0).sum() for part in model.labels_)
    assert model.objective_ == pytest.approx(total, rel=1e-9)


def test_precisions_are_exactly_block_toeplitz_and_positive_definite():
    series, _ = planted(3, 1.0)
    model = TICC(4, 3, switch_penalty=10.0).fit(series)
    blocks = model.precisions_.reshape(4, 3, 5, 3, 5).transpose(0, 1, 3, 2, 4)
    for i in range(2):
        for j in range(2):
            assert np.array_equal(blocks[:, i, j], blocks[:, i + 1, j + 1])
    assert np.array_equal(model.precisions_, model.precisions_.transpose(0, 2, 1))
    assert np.linalg.eigvalsh(model.precisions_).min() > 0


def test_predict_on_the_training_series_gives_its_labels():
    series, _ = planted(4, 1.0)
    model = TICC(3, 2, switch_penalty=10.0).fit(series)
    for found, kept in zip(model.predict(series), model.labels_, strict=True):
        assert np.array_equal(found, kept)


def test_same_seed_same_bytes_and_inputs_untouched():
    series, _ = planted(5, 1.0)
    before = [x.copy() for x in series]
    a, b = (TICC(4, 2, seed=7).fit(series) for _ in range(2))
    assert a.precisions_.tobytes() == b.precisions_.tobytes()
    assert all(np.array_equal(x, y) for x, y in zip(a.labels_, b.labels_, strict=True))
    assert all(np.array_equal(x, y) for x, y in zip(series, before, strict=True))


def test_initial_labels_decide_the_start():
    series, truth = planted(6, 0.0)
    model = TICC(3, initial_labels=truth, switch_penalty=20.0).fit(series)
    assert model.init_ == "initial_labels"
    assert np.mean(np.concatenate(model.labels_) == np.concatenate(truth)) > 0.97


def test_auto_takes_the_better_of_both_initialisations():
    series, _ = planted(7, 0.5)
    finals = {init: TICC(5, init=init, switch_penalty=5.0).fit(series).objective_ for init in ("kmeans", "gmm")}
    assert TICC(5, switch_penalty=5.0).fit(series).objective_ == max(finals.values())


def test_empty_clusters_are_reseeded():
    series, _ = planted(8, 0.0)
    start = [np.zeros(len(x), dtype=int) for x in series]
    model = TICC(3, initial_labels=start, switch_penalty=10.0).fit(series)
    assert len(np.unique(np.concatenate(model.labels_))) == 3
    assert np.all(np.diff(model.objectives_) > 0)


def test_windows_never_leak_across_series():
    rows = join_series([np.full((3, 1), 1.0), np.full((1, 1), 5.0), np.full((4, 1), 9.0)])
    windows = stack_windows(rows, 3)
    assert np.all(windows == windows[:, :1])
    rows = join_series([np.arange(4.0)[:, None]])
    assert stack_windows(rows, 3).tolist() == [[0, 0, 0], [0, 0, 1], [0, 1, 2], [1, 2, 3]]


def test_labels_of_a_series_do_not_depend_on_its_neighbours():
    series, _ = planted(9, 1.0)
    model = TICC(3, 3, switch_penalty=10.0).fit(series)
    alone = [model.predict([x])[0] for x in series]
    for x, y in zip(alone, model.predict(series[::-1])[::-1], strict=True):
        assert np.array_equal(x, y)


def test_time_penalty():
    rows = join_series([np.zeros((3, 1)), np.zeros((1, 1))])
    assert switch_penalties(rows, 7.0, None) == pytest.approx(np.full(4, 7.0 / np.log(np.e + 1)))
    unit = switch_penalties(rows, 7.0, [[0.0, 1.0, 2.0], [5.0]])
    assert np.array_equal(unit[1:3], switch_penalties(rows, 7.0, None)[1:3])
    penalties = switch_penalties(rows, 7.0, [[0.0, 2.0, 2.0], [5.0]])
    assert penalties[1:3] == pytest.approx([7.0 / np.log(np.e + 2.0), 7.0])


def test_a_long_gap_makes_a_switch_cheap():
    rng = np.random.default_rng(0)
    series = [np.concatenate([rng.normal(0, 1, (30, 1)), rng.normal(4, 1, (30, 1))]) for _ in range(4)]
    model = TICC(2, switch_penalty=10.0).fit(series)
    probe = [np.concatenate([np.zeros((20, 1)), np.full((2, 1), 4.0), np.zeros((20, 1))])]
    gaps = np.ones(42)
    gaps[[20, 22]] = 1e9
    steady = TICC.predict(model, probe, times=[np.arange(42.0)])[0]
    model.switch_penalty = 30.0
    assert len(np.unique(model.predict(probe)[0])) == 1
    assert len(np.unique(model.predict(probe, times=[np.cumsum(gaps)])[0])) == 2
    assert len(steady) == 42


def test_length_one_series_and_constant_features():
    rng = np.random.default_rng(0)
    series = [rng.normal(size=(length, 3)) for length in (1, 50, 1, 60)]
    for x in series:
        x[:, 1] = 0.1
    model = TICC(3, 2, switch_penalty=2.0).fit(series)
    assert [len(x) for x in model.labels_] == [1, 50, 1, 60]
    assert np.isfinite(model.means_).all() and np.isfinite(model.precisions_).all()
    without = TICC(3, 2, switch_penalty=2.0, initial_labels=model.labels_).fit([x[:, [0, 2]] for x in series])
    again = TICC(3, 2, switch_penalty=2.0, initial_labels=model.labels_).fit(series)
    assert all(np.array_equal(x, y) for x, y in zip(without.labels_, again.labels_, strict=True))


def test_all_rows_equal():
    model = TICC(3).fit([np.ones((10, 2)), np.ones((5, 2))])
    assert len(np.unique(np.concatenate(model.labels_))) == 1
    assert np.isfinite(model.objective_)


def test_progress_is_reported():
    calls = []
    series, _ = planted(10, 1.0, n_series=3)
    TICC(3, init="kmeans").fit(series, progress=lambda *a: calls.append(a))
    assert calls and all(name == "TICC (kmeans)" and 0 < done <= total for name, done, total in calls)


def test_learned_objective_beats_the_truth_with_other_parameters():
    series, truth = planted(11, 0.0)
    model = TICC(3, switch_penalty=20.0, standardize=False).fit(series)
    rows = join_series(series)
    problem = model._problem(rows, None)
    flat = np.concatenate(truth)
    means = np.stack([rows.values[flat == k].mean(axis=0) for k in range(3)])
    covariances = np.stack([np.cov(rows.values[flat == k].T, bias=True) for k in range(3)])
    precisions, _ = toeplitz_graphical_lasso(covariances, window=1, sparsity=0.11, tolerance=1e-6)
    assert model.objective_ >= objective_of(problem, flat, means, precisions) - 1.0  # ADMM stops a little earlier


BAD_SERIES = [
    ([], "empty"),
    ([np.zeros((0, 2))], "at least one row"),
    ([np.zeros(4)], r"x\[:, None\]"),
    ([np.zeros((4, 2)), np.zeros((4, 3))], "Series 1 has 3 features"),
    ([np.zeros((4, 2)), np.array([[0.0, 1.0], [np.nan, 0.0]])], "Series 1 holds NaN or infinity, first in row 1"),
    ([np.array([[np.inf]])], "row 0"),
    ([["a", "b"]], "not an array of numbers"),
]


@pytest.mark.parametrize(("series", "message"), BAD_SERIES)
def test_bad_series(series, message):
    with pytest.raises(InvalidDataError, match=message):
        TICC(2).fit(series)


@pytest.mark.parametrize(
    "times", [[[0.0, 1.0]], [[0.0, 1.0, 0.5]], [[0.0, np.nan, 1.0]], [[0.0, 1.0, 2.0], [0.0]]], ids=str
)
def test_bad_times(times):
    with pytest.raises(InvalidDataError, match=r"times|series"):
        TICC(2).fit([np.arange(3.0)[:, None]], times=times)


@pytest.mark.parametrize(
    "settings",
    [
        {"n_clusters": 0},
        {"n_clusters": 2.5},
        {"window": 0},
        {"sparsity": 0.0},
        {"sparsity": float("nan")},
        {"switch_penalty": -1.0},
        {"max_iterations": 0},
        {"init": "random"},
        {"seed": -1},
    ],
    ids=str,
)
def test_bad_settings(settings):
    with pytest.raises(ConfigurationError):
        TICC(**settings)


def test_bad_use():
    with pytest.raises(ConfigurationError, match="more than the 3 rows"):
        TICC(4).fit([np.zeros((3, 1))])
    with pytest.raises(ConfigurationError, match="fit"):
        TICC(2).predict([np.zeros((3, 1))])
    for labels in ([[0, 1]], [[0, 1, 2]], [[0.0, 1.0, 0.0]], [[0, 1, 0], [0]]):
        with pytest.raises(ConfigurationError, match="initial_labels"):
            TICC(2, initial_labels=labels).fit([np.arange(3.0)[:, None]])
    model = TICC(2).fit([np.arange(9.0)[:, None]])
    with pytest.raises(InvalidDataError, match="fit saw 1"):
        model.predict([np.zeros((3, 2))])
