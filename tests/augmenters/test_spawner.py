"""SPAWNER: means along a path, lengths known before, endings kept."""

import weakref
from collections.abc import Callable

import minari
import numpy as np
import pytest
from gymnasium import spaces

from oat_gym import SPAWNER, AugmentedDataset
from oat_gym.augmenters.spawner import noisy_mean, spawner_path
from oat_gym.dtw import dtw_path
from oat_gym.episodes import content_hash
from oat_gym.source import Source
from oat_gym.spaces import Layout
from tests.conftest import install_dataset, value_coded_buffer, walks

MakeDataset = Callable[..., minari.MinariDataset]


def test_two_equal_episodes_give_the_same_one_again() -> None:
    twin = walks(1, 23)[0]
    real = install_dataset("test/twins-v0", [twin, twin], spaces.Box(-100, 100, (2,)), spaces.Box(-1, 1, (2,)))
    data = AugmentedDataset(real, SPAWNER(sigma=0.5), factor=6, seed=0)
    assert content_hash(data[2:12]) == content_hash([*real] * 5)


def test_lengths_are_exact_before_anything_is_generated(walk_dataset: minari.MinariDataset) -> None:
    data = AugmentedDataset(walk_dataset, SPAWNER(), factor=6, seed=0)
    lengths = data.storage.lengths(range(len(data)))
    assert not data.is_fitted
    assert data.total_steps == lengths.sum()
    assert [len(episode.rewards) for episode in data] == lengths.tolist()
    assert [len(episode.observations) for episode in data] == (lengths + 1).tolist()
    assert len(set(lengths[12:])) > 3
    assert (lengths[12:] >= np.tile(lengths[:12], 5)).all()
    numbers = np.array([3, 3, 0]), np.array([2, 0, 4])  # any order, any subset
    got = SPAWNER().lengths(Source(walk_dataset), *numbers, seed=0)
    assert got.tolist() == [lengths[12 + 2 * 12 + 3], lengths[12 + 3], lengths[12 + 4 * 12]]


def test_values_lie_about_the_mean_of_the_two_rows_of_the_path(make_dataset: MakeDataset) -> None:
    # coded values: position = 1000 e + t, action = position + 0.25, reward = position
    real = make_dataset([8, 5, 11, 6, 9, 7])
    data = AugmentedDataset(real, SPAWNER(sigma=0.0, labels=(0,) * 6), factor=8, seed=0)
    for number in range(6, 48):
        episode, i = data[number], number % 6
        clock = np.asarray(episode.infos["clock"])  # the recorded row of the episode itself: 1000 i + t
        partner = (2 * episode.rewards - clock[:-1]) // 1000  # (x1 + x2) / 2 is the reward
        assert len(set(partner)) == 1
        assert partner[0] != i
        assert partner[0] % 2 == i % 2  # the even ones end by termination: an ended episode stays ended
        position = episode.observations["position"][:, 0]
        np.testing.assert_array_equal(position[:-1], episode.rewards)
        np.testing.assert_array_equal(episode.actions[:, 0], episode.rewards + 0.25)
        ends = clock[-1], 1000 * partner[0] + len(real[int(partner[0])].rewards)
        assert position[-1] == np.mean(ends)  # the two last observations
        assert clock[0] == 1000 * i
        assert clock[-1] == 1000 * i + len(real[i].rewards)
        assert set(np.diff(clock[:-1])) <= {0.0, 1.0}


def test_partners_are_of_the_class() -> None:
    buffers = [value_coded_buffer(e, 5 + e) for e in range(6)]
    space = spaces.Dict(position=spaces.Box(-np.inf, np.inf, (2,)), mode=spaces.Discrete(3))
    real = install_dataset("test/classes-v0", buffers, space, spaces.Box(-np.inf, np.inf, (1,)))
    labels = (7, 7, 3, 7, 3, 3)
    data = AugmentedDataset(real, SPAWNER(sigma=0.0, labels=labels), factor=20, seed=0)
    seen: dict[int, set[int]] = {}
    for number in range(6, 120):
        episode = data[number]
        partner = int((2 * episode.rewards[0] - episode.infos["clock"][0]) // 1000)
        seen.setdefault(number % 6, set()).add(partner)
    assert seen == {i: {j for j in range(6) if j != i and labels[j] == labels[i]} for i in range(6)}


def test_the_noise_is_a_share_of_the_distance_and_categories_are_of_either() -> None:
    rng = np.random.default_rng(0)
    n = 20_000
    x1, x2 = np.tile([1.0, 5.0, 1.0, 0.0, 0.0], (n, 1)), np.tile([3.0, 5.0, 0.0, 0.0, 1.0], (n, 1))
    drawn = noisy_mean(x1, x2, Layout(5, (0, 1), ((2, 5),)), sigma=0.05, rng=rng)
    assert drawn[:, 0].mean() == pytest.approx(2.0, abs=4 * 0.1 / np.sqrt(n))
    assert drawn[:, 0].std() == pytest.approx(0.1, rel=0.03)
    np.testing.assert_array_equal(drawn[:, 1], 5.0)
    assert set(map(tuple, drawn[:, 2:])) == {(1.0, 0.0, 0.0), (0.0, 0.0, 1.0)}
    assert drawn[:, 2].mean() == pytest.approx(0.5, abs=0.02)


@pytest.mark.parametrize(("n", "m"), [(20, 31), (2, 9), (1, 6), (6, 1), (1, 1), (40, 40)])
def test_both_series_are_cut_at_one_fraction(n: int, m: int) -> None:
    rng = np.random.default_rng(0)
    x, y = rng.normal(size=(n, 2)), rng.normal(size=(m, 2))
    for fraction in (0.0, 0.3, 0.999):
        path = spawner_path(x, y, fraction=fraction, band=0.1)
        assert path[0].tolist() == [0, 0]
        assert path[-1].tolist() == [n - 1, m - 1]
        assert {tuple(step) for step in np.diff(path, axis=0)} <= {(0, 1), (1, 0), (1, 1)}
        if min(n, m) == 1:
            np.testing.assert_array_equal(path, dtw_path(x, y)[0])
            continue
        cut = [min(max(round(fraction * size), 1), size - 1) for size in (n, m)]
        assert cut in path.tolist()  # the second part begins there
        assert [cut[0] - 1, cut[1] - 1] in path.tolist()  # and the first one ends before


def test_alignments_go_with_the_source(make_dataset: MakeDataset) -> None:
    source = Source(make_dataset([5, 9, 6, 7]))
    SPAWNER().lengths(source, np.arange(4), np.zeros(4, dtype=np.int64), seed=0)
    gone = weakref.ref(source)
    del source
    assert gone() is None
