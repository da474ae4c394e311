"""Mixture: shares, who makes what, and that each part makes what it makes alone."""

import dataclasses
from typing import Any

import minari
import numpy as np
import pytest

from oat_gym import OAT, AugmentedDataset, Function, Mixture
from oat_gym.augmenters._parts import part_seed
from oat_gym.augmenters.mixture import apportion
from oat_gym.episodes import content_hash
from oat_gym.errors import ConfigurationError

pytestmark = pytest.mark.filterwarnings("ignore::oat_gym.errors.AugmentationWarning")


def plus(episode: minari.EpisodeData, rng: np.random.Generator) -> minari.EpisodeData:
    episode.rewards[:] = 1000 + rng.uniform(size=len(episode.rewards))
    return episode


def minus(episode: minari.EpisodeData, rng: np.random.Generator) -> minari.EpisodeData:
    episode.rewards[:] = -1000 - rng.uniform(size=len(episode.rewards))
    return episode


PLUS, MINUS = Function(plus), Function(minus)


@pytest.mark.parametrize("shares", [(1.0, 1.0), (3.0, 1.0), (0.7, 0.2, 0.1), (1.0, 1e-3), (5.0, 3.0, 2.0, 1.0, 1.0)])
def test_every_prefix_has_the_shares_as_nearly_as_integers_allow(shares: tuple[float, ...]) -> None:
    proportions = np.array(shares) / sum(shares)
    order = apportion(proportions, 2000)
    counts = (order[:, None] == np.arange(len(shares))).cumsum(axis=0)
    exact = np.arange(1, 2001)[:, None] * proportions
    assert np.abs(counts - exact).max() <= 1.0
    for total in (0, 1, 7, 1999):
        assert apportion(proportions, total).tolist() == order[:total].tolist()


def test_equal_shares_are_counted_to_one_in_every_run_of_variations() -> None:
    mixture = Mixture((PLUS, MINUS, PLUS))
    makers = mixture.assignment(25, 40, seed=0)
    assert makers.shape == (40, 25)
    for start in range(0, 40, 3):
        for stop in range(start + 1, 41, 5):
            counts = np.bincount(makers[start:stop].ravel(), minlength=3)
            assert np.ptp(counts) <= 2  # each end of the run is off by less than one
    assert np.bincount(makers[:3].ravel()).tolist() == [25, 25, 25]


def test_which_episodes_go_where_changes_with_the_variation_and_the_seed() -> None:
    mixture = Mixture((PLUS, MINUS))
    makers = mixture.assignment(25, 20, seed=0)
    assert not (makers == makers[0]).all()
    assert (makers != mixture.assignment(25, 20, seed=1)).any()
    np.testing.assert_array_equal(makers[:7], mixture.assignment(25, 7, seed=0))
    assert makers.mean(axis=0).min() > 0.2  # no episode is always made by the same one
    assert makers.mean(axis=0).max() < 0.8


def test_each_episode_is_made_by_the_one_that_it_was_assigned_to(walk_dataset: minari.MinariDataset) -> None:
    mixture = Mixture((PLUS, MINUS), shares=(2.0, 1.0))
    data = AugmentedDataset(walk_dataset, mixture, factor=4, seed=5)
    makers = mixture.assignment(12, 3, seed=5)
    assert [episode.rewards[0] < 0 for episode in data[12:]] == (makers.ravel() == 1).tolist()
    assert (makers == 1).sum() == 12


def test_of_one_is_that_one(walk_dataset: minari.MinariDataset) -> None:
    alone = AugmentedDataset(walk_dataset, PLUS, factor=3, seed=2)
    assert content_hash(AugmentedDataset(walk_dataset, Mixture((PLUS,)), factor=3, seed=2)) == content_hash(alone)


def test_a_part_makes_what_it_makes_alone(
    walk_dataset: minari.MinariDataset, tiny_oat: OAT, monkeypatch: pytest.MonkeyPatch
) -> None:
    paper = dataclasses.replace(tiny_oat, seam="literal")
    mixture = Mixture((tiny_oat, paper))
    data = AugmentedDataset(walk_dataset, mixture, factor=3, seed=1).fit()
    parts = [
        AugmentedDataset(walk_dataset, part, factor=3, seed=part_seed(1, "mixture", number))
        for number, part in enumerate(mixture.augmenters)
    ]
    makers = mixture.assignment(12, 2, seed=1).ravel()
    for number in range(12, 36):
        part = parts[makers[number - 12]]
        assert content_hash([data[number]]) == content_hash([part[number]])
        assert data.provenance(number) == part.provenance(number)
    assert repr(data.mining) == repr(parts[0].mining)
    literal = data.transitions().next_observations[data.transitions().episode >= 12]
    assert (literal != np.concatenate([episode.observations[1:] for episode in data[12:]])).any()
    monkeypatch.setattr(OAT, "fit", None)  # what was learnt comes from the cache
    assert content_hash(AugmentedDataset(walk_dataset, mixture, factor=3, seed=1)) == content_hash(data)


def test_it_takes_its_properties_from_its_parts(tiny_oat: OAT) -> None:
    assert not Mixture((PLUS, MINUS)).trains
    assert Mixture((PLUS, tiny_oat)).trains
    assert Mixture((tiny_oat,)).cacheable
    assert not Mixture((PLUS, tiny_oat)).cacheable
    assert Mixture((PLUS,)).expected_failures == {
        "zero-strength": f"function: {PLUS.expected_failures['zero-strength']}"
    }
    assert Mixture((PLUS,)).at_zero_strength is None


@pytest.mark.parametrize(
    ("augmenters", "shares", "message"),
    [
        ((), None, "at least one augmenter, got an empty tuple"),
        ([PLUS], None, r"takes a tuple of augmenters, got \[Function"),
        ((PLUS, OAT), None, "takes instances of oat_gym.Augmenter .* got <class"),
        ((PLUS, MINUS), (1.0,), r"a tuple of 2 numbers.* got \(1.0,\)"),
        ((PLUS, MINUS), [1.0, 1.0], r"got \[1.0, 1.0\]"),
        ((PLUS, MINUS), (1.0, 0.0), "positive finite number, got 0.0"),
        ((PLUS, MINUS), (1.0, float("inf")), "positive finite number, got inf"),
        ((PLUS, MINUS), (1.0, float("nan")), "positive finite number, got nan"),
        ((PLUS, MINUS), (1.0, True), "positive finite number, got True"),
    ],
)
def test_bad_settings_are_refused(augmenters: Any, shares: Any, message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        Mixture(augmenters, shares)
