from itertools import pairwise

import numpy as np
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st

from oat_gym.augmenters.spans import SpanSamples, place_spans, seam_jumps
from oat_gym.spaces import FlatSpace

WIDTH = 4
OCCURRENCES = st.lists(
    st.lists(st.tuples(st.integers(0, 3), st.integers(0, 30)), min_size=1, max_size=12, unique=True).map(
        lambda rows: np.array(sorted(rows))
    ),
    min_size=1,
    max_size=3,
)


@given(OCCURRENCES, st.integers(0, 3), st.integers(0, 5))
def test_spans_never_overlap_and_lie_at_occurrences_of_the_episode(sets: list[np.ndarray], i: int, k: int) -> None:
    placed = place_spans(sets, i, k, WIDTH)
    starts = sorted(start for _, start in placed)
    assert all(b - a >= WIDTH for a, b in pairwise(starts))
    assert len({g for g, _ in placed}) == len(placed)
    for g, start in placed:
        assert [i, start] in sets[g].tolist()


@given(OCCURRENCES, st.integers(0, 3), st.integers(0, 5))
def test_the_best_supported_set_is_always_placed_first(sets: list[np.ndarray], i: int, k: int) -> None:
    has_first = (sets[0][:, 0] == i).any()
    assert has_first == (0 in {g for g, _ in place_spans(sets, i, k, WIDTH)})


def test_occurrences_of_one_episode_are_taken_in_turn() -> None:
    rows = np.array([[0, 0], [0, 10], [1, 5], [0, 20]])
    assert [place_spans([rows], 0, k, WIDTH)[0][1] for k in range(4)] == [0, 10, 20, 0]


def test_a_later_set_goes_where_there_is_room() -> None:
    first, second = np.array([[0, 8]]), np.array([[0, 6], [0, 11], [0, 12]])
    assert place_spans([first, second], 0, 0, WIDTH) == ((0, 8), (1, 12))


def test_a_seam_jump_is_the_distance_in_standard_deviations() -> None:
    recorded = np.zeros((2, 3, 2))
    generated = recorded.copy()
    generated[0, 0] = (3.0, 5.0)  # 3 and 5 deviations of 1: root mean square sqrt(17)
    generated[1, -1] = (1.0, -1.0)
    jumps = seam_jumps(generated, recorded, np.array([1.0, 1.0]))
    np.testing.assert_allclose(jumps, [[np.sqrt(17), 0], [0, 1]])
    halved = seam_jumps(generated, recorded, np.array([2.0, 0.0]))  # a constant feature says nothing
    np.testing.assert_allclose(halved, [[1.5, 0], [0, 0.5]])


def test_samples_find_their_episode() -> None:
    observations = FlatSpace.of(spaces.Dict(x=spaces.Box(-99, 99, (1,)), mode=spaces.Discrete(2)))
    arrays = {
        "rows": np.array([[4, 7], [9, 1]]),
        "states": np.stack([np.full((3, 3), 10.0), np.full((3, 3), 20.0)]),
        "actions": np.zeros((2, 2, 1)),
        "rewards": np.array([[1.0, 2.0], [3.0, 4.0]]),
        "log_prob": np.zeros((2, 2)),
        "seams": np.array([[0.1, 0.2], [0.3, 0.4]]),
    }
    samples = SpanSamples.decode(arrays, observations, FlatSpace.of(spaces.Box(-1, 1, (1,))))
    span, new = samples.replacement(9, pst_set=2, number=7)
    assert (span.start, span.stop, span.pst_set, span.sample, span.seam) == (1, 3, 2, 7, (0.3, 0.4))
    assert new.observations["x"][:, 0].tolist() == [20, 20, 20]
    assert new.rewards.tolist() == [3, 4]
