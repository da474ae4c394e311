"""Permutation: whole transitions move, decoded from values that tell episode and step."""

from collections.abc import Callable

import minari
import numpy as np
import pytest

from oat_gym import AugmentedDataset, Permutation
from oat_gym.augmenters.permutation import permuted_steps
from oat_gym.episodes import content_hash

MakeDataset = Callable[..., minari.MinariDataset]
LENGTHS = [9, 14, 1, 7, 30, 23]  # even numbers end by termination


def test_every_transition_decodes_to_one_recorded_step(make_dataset: MakeDataset) -> None:
    real = make_dataset(LENGTHS)
    columns = AugmentedDataset(real, Permutation(), factor=6, seed=0).transitions()
    made = columns.synthetic
    code = columns.observations["position"][made, 0]
    episode, step = code // 1000, code % 1000
    np.testing.assert_array_equal(episode, columns.episode[made] % len(LENGTHS))
    np.testing.assert_array_equal(columns.observations["mode"][made], step % 3)
    np.testing.assert_array_equal(columns.actions[made, 0], code + 0.25)
    np.testing.assert_array_equal(columns.rewards[made], code)
    np.testing.assert_array_equal(columns.next_observations["position"][made, 0], code + 1)
    np.testing.assert_array_equal(columns.next_observations["mode"][made], (step + 1) % 3)
    assert (step != columns.step[made]).mean() > 0.3
    for number in range(6, 36):  # each step of the source once
        mine = columns.episode[made] == number
        assert sorted(step[mine]) == list(range(LENGTHS[number % 6]))


def test_a_terminal_transition_stays_last_and_a_truncated_one_moves(make_dataset: MakeDataset) -> None:
    columns = AugmentedDataset(make_dataset(LENGTHS), Permutation(), factor=12, seed=0).transitions()
    code = columns.observations["position"][:, 0]
    lengths = np.array(LENGTHS)[columns.episode % 6]
    recorded_last = code % 1000 == lengths - 1
    ended = columns.episode % 2 == 0
    np.testing.assert_array_equal(columns.terminated, recorded_last & ended)
    np.testing.assert_array_equal(columns.terminated, (columns.step == lengths - 1) & ended)
    np.testing.assert_array_equal(columns.truncated, (columns.step == lengths - 1) & ~ended)
    assert (recorded_last & ~ended & (columns.step < lengths - 1)).sum() > 10


def test_the_last_observation_is_the_next_state_of_the_last_transition(make_dataset: MakeDataset) -> None:
    data = AugmentedDataset(make_dataset(LENGTHS), Permutation(), factor=5, seed=0)
    for number in range(6, 30):
        position = data[number].observations["position"][:, 0]
        assert position[-1] == position[-2] + 1
        moved = np.flatnonzero(np.diff(position) != 1)
        assert sorted(data.storage.variation(number).next_states) == moved.tolist()
        assert len(moved) <= 3


def test_one_segment_is_the_source_itself(make_dataset: MakeDataset) -> None:
    real = make_dataset(LENGTHS)
    zero = Permutation().at_zero_strength
    data = AugmentedDataset(real, zero, factor=2)
    assert content_hash(data[6:12]) == content_hash(real)
    assert not data.storage.variation(7).next_states


@pytest.mark.parametrize(("length", "n"), [(10, 4), (12, 4), (3, 4), (1, 4), (7, 1)])
def test_segments_are_equal_and_all_orders_are_as_likely(length: int, n: int) -> None:
    rng = np.random.default_rng(0)
    sizes = sorted(len(part) for part in np.array_split(np.arange(length), min(n, length)))
    seen: dict[tuple[int, ...], int] = {}
    for _ in range(600):
        steps = permuted_steps(length, n, keep_last=False, rng=rng)
        assert sorted(steps) == list(range(length))
        seen[tuple(steps)] = seen.get(tuple(steps), 0) + 1
        cuts = np.flatnonzero(np.diff(steps) != 1) + 1
        if len(cuts) == len(sizes) - 1:
            assert sorted(np.diff([0, *cuts, length])) == sizes
    orders = int(np.prod(np.arange(1, len(sizes) + 1)))
    assert len(seen) == orders
    assert max(seen.values()) < 600 / orders + 5 * np.sqrt(600 / orders)
