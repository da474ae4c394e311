"""DGW: references from the right class, warps and windows as the paper says."""

import minari
import numpy as np
import pytest
from gymnasium import spaces
from minari.data_collector import EpisodeBuffer

from oat_gym import DGW, AugmentedDataset
from oat_gym.augmenters.dgw import DGWSampler, slice_positions, values_at, warp_positions
from oat_gym.dtw import dtw
from oat_gym.errors import AugmentationWarning
from oat_gym.source import Source
from oat_gym.spaces import Layout
from tests.conftest import install_dataset

LABELS = (4, 4, 9, 4, 9, 9, 4, 9, 9)


def episode(number: int, length: int, *, terminates: bool = False) -> EpisodeBuffer:
    """Return an episode that runs through 1 + sin at a pace of its own; its reward is the time."""
    steps = np.arange(length + 1)
    pace = (steps / length) ** (1 + 0.3 * number)
    last = steps[1:] == length
    return EpisodeBuffer(
        observations=np.stack([1 + np.sin(6 * pace), steps], axis=1).astype(np.float32),
        actions=steps[:-1, None].astype(np.float32),
        rewards=steps[:-1].astype(float),
        terminations=last & terminates,
        truncations=last & (not terminates),
        infos={"t": steps},
    )


@pytest.fixture
def dataset() -> minari.MinariDataset:
    buffers = [episode(e, 20 + 3 * e, terminates=e % 2 == 0) for e in range(9)]
    return install_dataset("test/paces-v0", buffers, spaces.Box(-9, 99, (2,)), spaces.Box(-9, 99, (1,)))


def fitted(dataset: minari.MinariDataset, config: DGW) -> DGWSampler:
    return config.fit(Source(dataset), seed=0)


def test_positives_are_of_the_own_class_and_negatives_of_another(dataset: minari.MinariDataset) -> None:
    sampler = fitted(dataset, DGW(labels=LABELS))
    seen: dict[int, set[int]] = {i: set() for i in range(9)}
    for i in range(9):
        for k in range(40):
            positives, negatives = sampler.batch(i, k)
            assert len(positives) == len(negatives) == 3
            assert len({*positives, *negatives}) == 6
            assert i not in positives
            assert all(LABELS[p] == LABELS[i] for p in positives)
            assert all(LABELS[n] != LABELS[i] for n in negatives)
            assert sampler.reference(i, k) in positives
            seen[i] |= set(map(int, positives))
    # every other member of the class is drawn: no index of a shorter list was used for the data
    assert seen == {i: {j for j in range(9) if j != i and LABELS[j] == LABELS[i]} for i in range(9)}


def test_the_reference_is_far_from_other_classes_and_near_its_own(dataset: minari.MinariDataset) -> None:
    sampler = fitted(dataset, DGW(labels=LABELS, band=1.0))
    rows = [sampler._series.rows(i) for i in range(9)]
    for i, k in [(0, 0), (2, 1), (5, 3), (8, 2)]:
        positives, negatives = sampler.batch(i, k)
        gains = [
            np.mean([dtw(rows[p], rows[n]) for n in negatives])
            - np.mean([dtw(rows[p], rows[q]) for q in positives if q != p])
            for p in positives
        ]
        assert sampler.reference(i, k) == positives[np.argmax(gains)]


def test_time_is_warped_alike_in_states_actions_rewards_and_infos(dataset: minari.MinariDataset) -> None:
    data = AugmentedDataset(dataset, DGW(labels=LABELS), factor=5, seed=0)
    changed = 0
    for number in range(9, 45):
        made, i = data[number], number % 9
        time = made.rewards  # recorded time, which the warp moves
        assert len(time) == 20 + 3 * i
        np.testing.assert_allclose(made.observations[:-1, 1], time, rtol=1e-6)
        np.testing.assert_allclose(made.actions[:, 0], time, rtol=1e-6)
        np.testing.assert_array_equal(made.infos["t"][:-1], np.floor(time + 0.5))
        assert made.observations[-1, 1] == pytest.approx(time[-1] + 1)  # the recorded next state of the last row
        assert (np.diff(time) >= 0).all()
        changed += not np.array_equal(time, np.arange(len(time)))
        if i % 2 == 0:  # ended by termination: the terminal transition stays last
            assert time[-1] == len(time) - 1
            np.testing.assert_array_equal(made.observations[-1], dataset[i].observations[-1])
    assert changed > 30


def test_the_warp_follows_the_reference() -> None:
    # one class moves early, the other one late: warped towards its reference, an episode's jump moves there
    def step(at: int, value: float) -> EpisodeBuffer:
        signal = (np.arange(61) >= at) * 1.0
        return EpisodeBuffer(
            observations=np.stack([signal, np.full(61, value)], axis=1).astype(np.float32),
            actions=np.zeros((60, 1), np.float32),
            rewards=np.zeros(60),
            terminations=np.zeros(60, bool),
            truncations=np.arange(60) == 59,
        )

    buffers = [step(30, 0.0), step(33, 0.0), step(30, 1.0), step(33, 1.0)]
    real = install_dataset("test/jumps-v0", buffers, spaces.Box(-9, 9, (2,)), spaces.Box(-1, 1, (1,)))
    sampler = fitted(real, DGW(labels=(0, 0, 1, 1), slice_ratio=1.0))
    assert [sampler.reference(i, 0) for i in range(4)] == [1, 0, 3, 2]
    material = sampler.decode(sampler.generate(0))
    signal = sampler.variation(0, 0, material).episode.observations[:, 0]
    jump = int(np.flatnonzero(signal >= 0.5)[0])
    # 30 of the 60 rows are stretched over 33 of the 63 rows of the path
    assert jump in {31, 32}
    assert np.array_equal(signal[:30], np.zeros(30))


def test_one_class_is_sliced_only_and_it_is_told(dataset: minari.MinariDataset) -> None:
    with pytest.warns(AugmentationWarning, match="9 of 9 episodes"):
        sampler = fitted(dataset, DGW(labels=(1,) * 9))
    assert all(sampler.reference(i, 0) is None for i in range(9))
    starts = set()
    for k in range(20):
        positions = sampler.decode(sampler.generate(k))[1]  # truncated, 23 steps
        np.testing.assert_allclose(np.diff(positions), 20 / 22)  # a window of ceil(0.9 * 23) = 21 rows on 23 steps
        starts.add(positions[0])
        ended = sampler.decode(sampler.generate(k))[0]
        assert ended[-1] == 19
        assert ended[0] in {0, 1, 2}
    assert starts == {0.0, 1.0, 2.0}


def test_the_most_warped_episode_keeps_all_of_its_steps(dataset: minari.MinariDataset) -> None:
    sampler = fitted(dataset, DGW(labels=LABELS))
    warps = [sampler._warp(i, 0) for i in range(9)]
    amounts = [np.abs(warp - np.arange(len(warp))).mean() / len(warp) for warp in warps]
    most = int(np.argmax(amounts))
    sliced = sampler.decode(sampler.generate(0))
    np.testing.assert_allclose(sliced[most], warps[most], atol=1e-9)
    odd = [i for i in range(1, 9, 2) if i != most]  # truncated ones, which lose an end
    assert any(not np.allclose(sliced[i][[0, -1]], warps[i][[0, -1]]) for i in odd)


def test_positions_and_values_at_them() -> None:
    rng = np.random.default_rng(0)
    np.testing.assert_allclose(warp_positions(np.arange(7), 7), np.arange(7))
    held = warp_positions(np.array([0, 0, 0, 1, 2, 3]), 4)
    np.testing.assert_allclose(held, [0, 0, 4 / 3, 3])
    assert warp_positions(np.array([0]), 1).tolist() == [0.0]
    assert slice_positions(np.array([0.0]), ratio=0.9, to_end=False, rng=rng).tolist() == [0.0]
    np.testing.assert_array_equal(slice_positions(held, ratio=1.0, to_end=False, rng=rng), held)
    values = np.array([[0.0, 1.0, 0.0], [10.0, 0.0, 1.0], [20.0, 1.0, 0.0]])
    got = values_at(values, np.array([0.0, 0.4, 0.6, 2.0]), Layout(3, (0,), ((1, 3),)))
    np.testing.assert_allclose(got[:, 0], [0, 4, 6, 20])
    assert got[:, 1].tolist() == [1, 1, 0, 1]
