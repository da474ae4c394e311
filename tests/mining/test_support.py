"""Support counts equal a naive count, on any sequences."""

from __future__ import annotations

from collections import Counter, defaultdict

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from oat_gym.errors import ConfigurationError, InvalidDataError
from oat_gym.mining import count_tdss, longest_length, support_curve, support_of

SEQUENCES = st.lists(st.lists(st.integers(-1, 2), min_size=1, max_size=14), min_size=1, max_size=6)


def naive(sequences, length, aligned):
    holders, occurrences = defaultdict(set), Counter()
    for i, labels in enumerate(sequences):
        for start in range(len(labels) - length + 1):
            key = (tuple(labels[start : start + length]), start if aligned else None)
            holders[key].add(i)
            occurrences[key] += 1
    return {key: (len(held), occurrences[key]) for key, held in holders.items()}


@settings(max_examples=150, deadline=None)
@given(SEQUENCES, st.integers(1, 9), st.booleans())
def test_counts_equal_a_naive_count(sequences, length, aligned):
    table = count_tdss(sequences, length, aligned=aligned)
    found = {}
    for entry, (i, start) in enumerate(table.first.tolist()):
        key = (tuple(sequences[i][start : start + length]), start if aligned else None)
        found[key] = (int(table.support[entry]), int(table.occurrences[entry]))
        for j, place in table.windows_of(entry).tolist():
            assert tuple(sequences[j][place : place + length]) == key[0]
    assert found == naive(sequences, length, aligned)
    assert len(found) == len(table.support)


@settings(max_examples=60, deadline=None)
@given(SEQUENCES, st.integers(1, 6), st.booleans())
def test_longest_length_and_curve_agree(sequences, wanted, aligned):
    longest = max(map(len, sequences))
    curve = support_curve(sequences, range(1, longest + 1), aligned=aligned)
    values = list(curve.values())
    assert values == sorted(values, reverse=True)
    good = [length for length, best in curve.items() if best >= wanted]
    assert longest_length(sequences, wanted, aligned=aligned) == max(good, default=0)
    grid = support_curve(sequences, aligned=aligned)
    assert all(curve[length] == best for length, best in grid.items())


@settings(max_examples=60, deadline=None)
@given(SEQUENCES, st.lists(st.integers(-1, 2), min_size=1, max_size=4))
def test_support_of_one_tdss(sequences, tdss):
    text = [",".join(map(str, s)) for s in sequences]
    wanted = ",".join(map(str, tdss))
    assert support_of(tdss, sequences) == sum(f",{wanted}," in f",{item}," for item in text)


def test_long_windows_of_many_labels_stay_exact():
    rng = np.random.default_rng(0)
    common = rng.integers(0, 1000, 300)
    sequences = [np.r_[rng.integers(0, 1000, 50 + i), common, rng.integers(0, 1000, 9)] for i in range(20)]
    assert support_curve(sequences, [299, 300, 301]) == {299: 20, 300: 20, 301: 1}
    changed = [x.copy() for x in sequences]
    changed[3][50 + 3 + 150] += 1000
    assert support_curve(changed, [300]) == {300: 19}
    assert support_curve(sequences, [300], aligned=True) == {300: 1}


def test_empty_sequences_hold_no_window_and_keep_their_number():
    nothing = np.empty(0, dtype=np.int64)
    one, other = [0, 1, 1], [1, 1, 0, 1]
    full = count_tdss([one, other], 2)
    gaps = count_tdss([nothing, one, nothing, nothing, other, nothing], 2)
    np.testing.assert_array_equal(gaps.support, full.support)
    np.testing.assert_array_equal(gaps.first, full.first * [3, 1] + [1, 0])
    np.testing.assert_array_equal(gaps.windows_of(0), full.windows_of(0) * [3, 1] + [1, 0])
    assert support_curve([nothing, one, other]) == support_curve([one, other])
    assert longest_length([nothing, one, other], 2) == longest_length([one, other], 2)


def test_bad_input():
    with pytest.raises(InvalidDataError, match="2 label sequences hold no label"):
        count_tdss([np.empty(0, dtype=np.int64)] * 2, 1)
    with pytest.raises(InvalidDataError, match="empty"):
        count_tdss([], 2)
    for labels in ([[]], [[0.5, 1.0]], [[[1, 2]]]):
        with pytest.raises(InvalidDataError, match="sequence 0"):
            count_tdss(labels, 2)
    for length in (0, -1, 2.0, True):
        with pytest.raises(ConfigurationError, match="length W"):
            count_tdss([[1, 2]], length)
    assert len(count_tdss([[1, 2]], 3).support) == 0
