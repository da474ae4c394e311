"""PST sets: selection, order of ties, thinning, and clear answers where there is nothing to mine."""

from __future__ import annotations

import dataclasses
from itertools import pairwise

import numpy as np
import pytest

from oat_gym.errors import ConfigurationError, InvalidDataError
from oat_gym.mining import MiningConfig, count_tdss, mine
from oat_gym.mining.pst import select_sets


def regimes(seed: int = 0, n: int = 4, lengths: tuple[int, ...] = (30, 25, 20)) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    return [
        np.concatenate([rng.normal(5 * k, 1.0, (length + i, 2)) for k, length in enumerate(lengths)]) for i in range(n)
    ]


def run(series, **settings):
    config = MiningConfig(**({"n_clusters": 3, "switch_penalty": 10.0} | settings))
    return mine(series, config=config, rng=np.random.default_rng(0))


def sets_of(sequences, length, **settings):
    labels = [np.array(s) for s in sequences]
    table = count_tdss(labels, length, aligned=settings.pop("aligned", False))
    return select_sets(labels, table, **({"min_support": 1, "top": None} | settings))


def test_top_window_is_in_every_series_and_its_places_hold_it():
    result = run(regimes(), length=20)
    (best,) = result.sets
    assert best.support == 4
    assert best.length == 20
    for i, start in best.all_occurrences.tolist():
        assert tuple(result.labels[i][start : start + 20].tolist()) == best.labels
    assert result.support_curve[20] == 4
    assert result.supports[0] == 4
    assert "W=20" in repr(result)


@pytest.mark.parametrize("length", [3, 8])
def test_kept_occurrences_do_not_overlap_and_none_is_missed(length):
    for item in run(regimes(), length=length, top=None, min_support=1.0).sets:
        for i in np.unique(item.all_occurrences[:, 0]):
            kept = item.occurrences[item.occurrences[:, 0] == i, 1]
            everything = item.all_occurrences[item.all_occurrences[:, 0] == i, 1]
            assert np.all(np.diff(kept) >= length)
            assert kept[0] == everything[0]
            assert all(np.abs(kept - start).min() < length for start in everything)


def test_order_of_ties():
    def order(sequences, length=2):
        return [item.labels for item in sets_of(sequences, length)]

    assert order([[0, 0, 1], [0, 0, 1]])[0] == (0, 1)  # more switches
    assert order([[2, 3, 0, 1, 0, 1], [2, 3, 0, 1]])[0] == (2, 3)  # fewer occurrences than (0, 1)
    assert order([[3, 2, 1, 0], [3, 2, 1, 0]])[0] == (3, 2)  # earliest start
    assert order([[1, 0], [1, 0], [0, 1], [0, 1]])[0] == (0, 1)  # lexicographic
    assert order([[0, 1, 5], [5, 2, 2], [2, 2]])[0] == (2, 2)  # support goes first


def test_threshold_and_top():
    sequences = [[0, 1, 2], [0, 1, 3], [0, 1, 2], [4, 4, 4]]
    assert {item.support for item in sets_of(sequences, 2, min_support=2)} == {2, 3}
    assert [item.support for item in sets_of(sequences, 2, top=1)] == [3]
    assert sets_of(sequences, 2, min_support=4) == ()
    assert MiningConfig(min_support=0.5).threshold(5) == 3
    assert MiningConfig(min_support=2).threshold(5) == 2
    assert MiningConfig(min_support=0.9).threshold(10) == 9


def test_aligned_counts_the_same_position_only():
    sequences = [[0, 1, 5, 5], [5, 0, 1, 5], [7, 0, 1, 8]]
    best = sets_of(sequences, 2, aligned=True, top=1)[0]
    assert (best.labels, best.support, best.all_occurrences.tolist()) == ((0, 1), 2, [[1, 1], [2, 1]])
    assert sets_of(sequences, 2, top=1)[0].support == 3


def test_auto_length_is_the_longest_with_enough_support():
    result = run(regimes(), length="auto")
    assert result.sets[0].support >= 0.9 * 4
    labels = list(result.labels)
    assert count_tdss(labels, result.length + 1).support.max() < 0.9 * 4


@pytest.mark.parametrize("criterion", ["silhouette", "bic"])
def test_auto_clusters_finds_the_planted_number(criterion):
    result = run(regimes(), n_clusters="auto", candidates=(2, 3, 5, 7), criterion=criterion)
    assert result.n_clusters == 3
    assert list(result.criterion_scores) == [2, 3, 5, 7]
    assert criterion in repr(result)


def test_same_generator_same_result():
    a, b = run(regimes(), length=10), run(regimes(), length=10)
    assert all(np.array_equal(x, y) for x, y in zip(a.labels, b.labels, strict=True))
    assert a.sets[0].labels == b.sets[0].labels


def test_series_shorter_than_a_window():
    series = [*regimes(), np.zeros((5, 2)), np.zeros((1, 2))]
    result = run(series, length=20)
    assert result.n_too_short == 2
    assert "2 of 6 series have fewer than 20 rows" in repr(result)
    assert set(result.sets[0].all_occurrences[:, 0].tolist()) <= {0, 1, 2, 3}
    with pytest.raises(InvalidDataError, match=r"W=200.*75 to 84 rows.*median 79\.5.*length=.auto"):
        run(regimes(), length=200)


def test_no_window_reaches_the_threshold():
    result = run(regimes(), length=20, min_support=5)
    assert result.sets == ()
    assert "no window reaches the support of 5; the best has 4" in repr(result)


@pytest.mark.parametrize(
    "settings",
    [
        {"n_clusters": 0},
        {"n_clusters": "many"},
        {"candidates": (), "n_clusters": "auto"},
        {"criterion": "aic"},
        {"length": 0},
        {"length": "long"},
        {"auto_share": 0.0},
        {"min_support": 0},
        {"min_support": 1.5},
        {"top": 0},
        {"top": None},
        {"window": 0},
        {"sparsity": -1.0},
    ],
    ids=str,
)
def test_bad_settings(settings):
    with pytest.raises(ConfigurationError):
        MiningConfig(**settings)


def test_bad_series_and_frozen_settings():
    for series in ([], [np.zeros((0, 2))], [np.full((30, 2), np.nan)], [np.zeros(30)]):
        with pytest.raises(InvalidDataError):
            run(series, length=2)
    with pytest.raises(ConfigurationError, match="rows of all series"):
        run([np.zeros((2, 1))], length=1)
    with pytest.raises(dataclasses.FrozenInstanceError):
        MiningConfig().top = 2


@pytest.mark.shared_data
def test_door_demonstrations(shared_data):
    """On the real demonstrations all 25 episodes share windows of up to 40 rows, whatever the switch penalty."""
    data = np.load(shared_data / "robotics" / "adroit_human" / "door_human_25demos.npz")
    series = np.split(data["observations"], np.cumsum(data["lengths"])[:-1])
    for penalty in (4.0, 100.0):
        config = MiningConfig(switch_penalty=penalty, init="kmeans")
        result = mine(series, config=config, rng=np.random.default_rng(0))
        assert result.sets[0].support == 25
        assert count_tdss(list(result.labels), 40).support.max() == 25


def test_distinct_sets_are_not_one_set_moved_by_a_row():
    sequence = np.repeat([0, 1, 2, 3], 10)
    labels = [sequence.copy() for _ in range(5)]
    table = count_tdss(labels, 8, aligned=False)
    literal = select_sets(labels, table, min_support=1, top=3)
    assert [item.support for item in literal] == [5, 5, 5]
    assert all(abs(a.occurrences[0, 1] - b.occurrences[0, 1]) < 8 for a, b in pairwise(literal))
    distinct = select_sets(labels, table, min_support=1, top=3, distinct=True)
    assert distinct[0].labels == literal[0].labels
    starts = sorted(int(item.occurrences[0, 1]) for item in distinct)
    assert len(starts) == 3
    assert all(b - a >= 8 for a, b in pairwise(starts))


def test_auto_length_without_any_shared_row_is_an_error():
    series = [np.full((6, 1), 10.0 * k) + np.random.default_rng(k).normal(size=(6, 1)) for k in range(4)]
    with pytest.raises(InvalidDataError, match="not even single rows do"):
        run(series, n_clusters=4, length="auto", switch_penalty=1.0)
