"""Compose: order, spans, lengths, next states, caching, recipes."""

import dataclasses
import json
from dataclasses import dataclass
from typing import Any, ClassVar

import minari
import numpy as np
import pytest

from oat_gym import OAT, AugmentedDataset, Augmenter, Compose, Function, Mixture, Span
from oat_gym._rng import derive
from oat_gym.augmenters.base import Sampler, Variation
from oat_gym.augmenters.compose import put_over
from oat_gym.cache import canonical
from oat_gym.episodes import content_hash, copy_episode
from oat_gym.errors import ConfigurationError, InvalidDataError
from oat_gym.progress import silent
from oat_gym.recipe import METHODS, RECIPE_FILE
from oat_gym.serialization import config_from_json
from oat_gym.source import Source
from oat_gym.spaces import slice_tree

pytestmark = pytest.mark.filterwarnings("ignore::oat_gym.errors.AugmentationWarning")


def doubled(episode: minari.EpisodeData, rng: np.random.Generator) -> minari.EpisodeData:
    episode.rewards[:] *= 2
    return episode


def lifted(episode: minari.EpisodeData, rng: np.random.Generator) -> minari.EpisodeData:
    episode.rewards[:] += rng.uniform()
    return episode


@dataclass(frozen=True)
class Cut(Augmenter):
    """The first steps of an episode, fewer for a higher k; `reads` makes it look at episodes to tell how many."""

    name: ClassVar[str] = "cut"
    trains: ClassVar[bool] = False
    reads: bool = False

    def fit(self, source: Source, *, seed: int, progress: Any = None) -> Sampler:
        return CutSampler(source)

    def lengths(self, source: Source, episodes: Any, variations: Any, *, seed: int) -> Any:
        lengths = np.array([len(e.rewards) for e in source.episodes]) if self.reads else source.lengths
        return np.maximum(lengths[episodes] - variations - 1, 1)


class CutSampler(Sampler):
    def __init__(self, source: Source) -> None:
        self.source = source

    def variation(self, i: int, k: int, material: Any) -> Variation:
        episode = copy_episode(self.source.episodes[i], number=i)
        stop = max(len(episode.rewards) - k - 1, 1)
        parts = {name: getattr(episode, name)[:stop] for name in ("actions", "rewards", "terminations", "truncations")}
        observations = slice_tree(episode.observations, slice(0, stop + 1))
        return Variation(dataclasses.replace(episode, observations=observations, **parts), (Span(0, stop),))


@dataclass(frozen=True)
class Learnt(Augmenter):
    """Adds the mean reward of its source, learnt in `fit`, to the rewards of the first step; counts its fits."""

    name: ClassVar[str] = "learnt"
    fits: ClassVar[list[float]] = []

    def fit(self, source: Source, *, seed: int, progress: Any = None) -> Sampler:
        mean = float(np.mean(np.concatenate([episode.rewards for episode in source.episodes])))
        self.fits.append(mean)
        (progress or silent)("Learning", 1, 1)
        return LearntSampler(source, seed, mean)

    def restore(self, source: Source, arrays: Any, value: Any, *, seed: int) -> Sampler:
        return LearntSampler(source, seed, value["mean"])


class LearntSampler(Sampler):
    def __init__(self, source: Source, seed: int, mean: float) -> None:
        self.source, self.seed, self.mean = source, seed, mean

    def state(self) -> Any:
        return {"mean": np.array([self.mean])}, {"mean": self.mean}

    def generate(self, k: int) -> Any:
        return {"noise": derive(self.seed, k).normal(size=len(self.source))}

    def variation(self, i: int, k: int, material: Any) -> Variation:
        episode = copy_episode(self.source.episodes[i], number=i)
        episode.rewards[0] += self.mean + material["noise"][i]
        return Variation(episode, (Span(0, 1),))


def test_the_second_sees_what_the_first_made(walk_dataset: minari.MinariDataset) -> None:
    for parts, expected in (
        ((Function(doubled), Function(lifted)), lambda r, u: 2 * r + u),
        ((Function(lifted), Function(doubled)), lambda r, u: 2 * (r + u)),
    ):
        data = AugmentedDataset(walk_dataset, Compose(parts), factor=2, seed=0)
        for number in range(12, 24):
            r, made = data[number - 12].rewards, data[number].rewards
            u = (made - 2 * r)[0] / (1 if parts[0].function is doubled else 2)
            assert 0 < u < 1
            np.testing.assert_allclose(made, expected(r, u))


def test_of_one_is_that_one_and_two_equal_ones_draw_different_numbers(walk_dataset: minari.MinariDataset) -> None:
    alone = AugmentedDataset(walk_dataset, Function(lifted), factor=3, seed=2)
    once = AugmentedDataset(walk_dataset, Compose((Function(lifted),)), factor=3, seed=2)
    twice = AugmentedDataset(walk_dataset, Compose((Function(lifted),) * 2), factor=3, seed=2)
    assert content_hash(once) == content_hash(alone)
    first = [episode.rewards[0] - data.rewards[0] for episode, data in zip(alone[12:24], alone[:12], strict=True)]
    second = [episode.rewards[0] - data.rewards[0] for episode, data in zip(twice[12:24], alone[12:24], strict=True)]
    assert not np.isclose(first, second).any()


def test_lengths_are_known_before_anything_is_made(walk_dataset: minari.MinariDataset) -> None:
    data = AugmentedDataset(walk_dataset, Compose((Cut(), Learnt(), Cut(reads=False))), factor=4)
    Learnt.fits.clear()
    announced = data.storage.lengths(range(48))
    assert Learnt.fits == []
    assert announced[12:].tolist() == [len(data[i % 12]) - 2 * (i // 12 + 1) for i in range(36)]
    assert [len(episode) for episode in data] == announced.tolist()


def test_lengths_that_need_episodes_are_had_where_nothing_is_trained_for_them(
    walk_dataset: minari.MinariDataset,
) -> None:
    cheap = AugmentedDataset(walk_dataset, Compose((Function(doubled), Cut(reads=True))), factor=2)
    assert cheap.storage.lengths(range(12, 24)).tolist() == [len(episode) - 1 for episode in walk_dataset]
    costly = AugmentedDataset(walk_dataset, Compose((Cut(reads=True), Learnt())), factor=2)  # reads the source
    assert costly.total_steps == cheap.total_steps
    with pytest.raises(ConfigurationError, match=r"Cut\(reads=True\) reads episodes .* Learnt\(\), which has to be"):
        AugmentedDataset(walk_dataset, Compose((Learnt(), Cut(reads=True))), factor=2)


def test_what_trains_first_is_trained_once_and_what_trains_later_once_for_each_variation(
    walk_dataset: minari.MinariDataset,
) -> None:
    Learnt.fits.clear()
    AugmentedDataset(walk_dataset, Compose((Learnt(), Cut())), factor=4).fit()
    assert len(Learnt.fits) == 1
    Learnt.fits.clear()
    both = Compose((Learnt(), Learnt()))
    data = AugmentedDataset(walk_dataset, both, factor=4).fit()
    assert len(Learnt.fits) == 4
    later = Learnt.fits[1:]
    made = [np.concatenate([e.rewards for e in _after_first(walk_dataset, both, k)]).mean() for k in range(3)]
    np.testing.assert_allclose(later, made)
    Learnt.fits.clear()  # and all of it is read from the cache
    assert content_hash(AugmentedDataset(walk_dataset, both, factor=4)) == content_hash(data)
    assert Learnt.fits == []


def _after_first(real: minari.MinariDataset, compose: Compose, k: int) -> list[minari.EpisodeData]:
    alone = AugmentedDataset(real, compose.augmenters[0], factor=4)
    return alone[12 * (k + 1) : 12 * (k + 2)]


def test_progress_is_told(walk_dataset: minari.MinariDataset) -> None:
    told: list[tuple[str, int, int]] = []
    data = AugmentedDataset(walk_dataset, Compose((Learnt(), Function(doubled))), factor=3)
    data.fit(progress=lambda *what: told.append(what))
    assert told == [("Learning", 1, 1), *(("Generating variations", k, 2) for k in range(3))]


# Provenance and next states -----------------------------------------------------------------------------------------


def episode_of(length: int) -> minari.EpisodeData:
    last = np.arange(length) == length - 1
    rows = np.arange(length + 1.0)[:, None]
    return minari.EpisodeData(0, rows, rows[:-1], rows[:-1, 0], last & False, last, {})


def row(value: float) -> np.ndarray:
    return np.array([[value]])


def test_spans_are_united_and_next_states_stay_where_they_hold() -> None:
    earlier = Variation(episode_of(10), (Span(2, 5), Span(7, 8)), {1: row(91), 4: row(94), 7: row(97)})
    later = Variation(episode_of(10), (Span(4, 6),), {3: row(83), 5: row(85)})
    both = put_over(earlier, later)
    assert both.spans == (Span(2, 5), Span(4, 6), Span(7, 8))
    assert {t: float(s[0, 0]) for t, s in both.next_states.items()} == {1: 91, 3: 83, 5: 85, 7: 97}
    own = put_over(
        Variation(episode_of(10), (Span(2, 4),), {3: row(93)}), later
    )  # both know step 3, which is unchanged
    assert float(own.next_states[3][0, 0]) == 93
    everything = put_over(earlier, Variation(episode_of(10), (Span(0, 10),)))
    assert (everything.spans, everything.next_states) == ((Span(0, 10),), {})


def test_of_an_episode_that_was_cut_nothing_stays_behind_its_end() -> None:
    earlier = Variation(episode_of(10), (Span(2, 5), Span(6, 9)), {8: row(98)})
    both = put_over(earlier, Variation(episode_of(4), (Span(0, 4),)))
    assert (both.spans, both.next_states) == ((Span(0, 4),), {})


def test_masks_are_united_and_literal_seams_kept(walk_dataset: minari.MinariDataset, tiny_oat: OAT) -> None:
    literal = dataclasses.replace(tiny_oat, seam="literal")
    alone = AugmentedDataset(walk_dataset, literal, factor=2, seed=0)
    data = AugmentedDataset(walk_dataset, Compose((literal, Learnt())), factor=2, seed=0)
    assert repr(data.mining) == repr(alone.mining)
    for number in range(12, 24):
        expected = alone.provenance(number).mask.copy()
        expected[0] = True
        np.testing.assert_array_equal(data.provenance(number).mask, expected)
        before, after = (dataset.storage.variation(number).next_states for dataset in (alone, data))
        assert set(after) == set(before) - {0}
        for t in after:
            np.testing.assert_array_equal(after[t], before[t])


# Settings -----------------------------------------------------------------------------------------------------------


def test_it_takes_its_properties_from_its_parts(tiny_oat: OAT) -> None:
    cut, function = Cut(), Function(doubled)
    assert not Compose((cut, function)).trains
    assert Compose((cut, tiny_oat)).trains
    assert not Compose((tiny_oat, function)).cacheable
    assert Compose((tiny_oat, cut)).cacheable
    assert Compose((function, cut)).at_zero_strength is None
    assert set(Compose((cut, function)).expected_failures) == {"zero-strength"}


@pytest.mark.parametrize(
    ("augmenters", "message"),
    [
        ((), "Compose takes at least one augmenter"),
        ([Cut()], r"Compose takes a tuple of augmenters, got \[Cut"),
        (Cut(), "Compose takes a tuple of augmenters, got Cut"),
        ((Cut(), Cut), "takes instances of oat_gym.Augmenter"),
    ],
)
def test_bad_settings_are_refused(augmenters: Any, message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        Compose(augmenters)


def test_a_part_that_cannot_work_is_told_when_the_dataset_is_made(
    walk_dataset: minari.MinariDataset, tiny_oat: OAT
) -> None:
    long = dataclasses.replace(tiny_oat, mining=dataclasses.replace(tiny_oat.mining, length=99))
    for made in (Compose((Cut(), long)), Mixture((Cut(), long))):
        with pytest.raises(InvalidDataError, match="No episode is as long as a sub-trajectory of 99 steps"):
            AugmentedDataset(walk_dataset, made, factor=2)


def test_nested_ones_come_back_from_json_and_from_a_recipe(walk_dataset: minari.MinariDataset, tiny_oat: OAT) -> None:
    nested = Compose((Mixture((tiny_oat, Compose((tiny_oat,))), shares=(2.0, 1.0)), tiny_oat))
    settings = json.loads(json.dumps(canonical(nested)))
    assert config_from_json(Compose, settings, known=tuple(METHODS.values())) == nested
    small = Mixture((tiny_oat, Compose((tiny_oat,))))
    data = AugmentedDataset(walk_dataset, small, factor=2, seed=4)
    recipe = data.save("test/mixed-v0", lazy=True)
    assert recipe.augmenter == small
    assert content_hash(recipe) == content_hash(data)


def test_a_recipe_names_known_methods_only(walk_dataset: minari.MinariDataset, tiny_oat: OAT) -> None:
    for unknown in (Cut(), Function(doubled)):
        data = AugmentedDataset(walk_dataset, Compose((tiny_oat, unknown)), factor=2)
        with pytest.raises(ConfigurationError, match=rf"and {type(unknown).__name__}\(.*\) is not one"):
            data.save("test/unknown-v0", lazy=True)
    good = canonical(Compose((tiny_oat,)))
    for bad in (
        {**good, "augmenters": [{"class": "Cut", "reads": False}]},
        {**good, "augmenters": [{"class": "Augmenter"}]},
        {**good, "augmenters": [{"class": "MiningConfig"}]},
        {**good, "augmenters": [canonical(tiny_oat.mining)]},
        {**good, "augmenters": []},
        {**good, "augmenters": [canonical(tiny_oat), 3]},
        {**good, "augmenters": canonical(tiny_oat)},
        {**good, "augmenters": "oat"},
    ):
        with pytest.raises(InvalidDataError):
            config_from_json(Compose, bad, known=tuple(METHODS.values()))


def test_a_recipe_that_nests_without_end_is_refused(walk_dataset: minari.MinariDataset, tiny_oat: OAT) -> None:
    data = AugmentedDataset(walk_dataset, Compose((tiny_oat,)), factor=2).save("test/deep-v0", lazy=True)
    path = data.storage.data_path / RECIPE_FILE
    recipe = json.loads(path.read_text())
    for _ in range(400):
        recipe["augmenter"]["settings"] = {"class": "Compose", "augmenters": [recipe["augmenter"]["settings"]]}
    path.write_text(json.dumps(recipe))
    try:
        opened = AugmentedDataset("test/deep-v0", count=0)
    except InvalidDataError:
        return
    assert len(opened) == len(data)
