"""check_augmenter passes sound augmenters, and names the one rule that a broken one breaks."""

import dataclasses
import itertools
import random
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, ClassVar

import minari
import numpy as np
import pytest
import torch
from minari import EpisodeData

from oat_gym import DGW, OAT, Augmenter, Compose, Function, MiningConfig, Mixture, Span
from oat_gym._rng import derive
from oat_gym.augmenters.base import Sampler, Variation
from oat_gym.checks import AUGMENTER_CHECKS, ChecksFailed, Report, check_augmenter
from oat_gym.checks._probe import LENGTHS
from oat_gym.episodes import copy_episode
from oat_gym.errors import ConfigurationError, ConformanceError, InvalidDataError
from oat_gym.generation import BehaviorConfig, VAEMDPConfig
from oat_gym.source import Source
from oat_gym.spaces import slice_tree


@dataclass(frozen=True)
class Sound(Augmenter):
    """Noise on the rewards of the first half of an episode; what the classes below break."""

    name: ClassVar[str] = "sound"
    strength: float = 1.0

    @property
    def at_zero_strength(self) -> Augmenter | None:
        return dataclasses.replace(self, strength=0.0)

    def fit(self, source: Source, *, seed: int, progress: Any = None) -> Sampler:
        offset = np.concatenate([episode.rewards for episode in source.episodes]).mean()
        return SoundSampler(self, source, seed, offset)

    def restore(self, source: Source, arrays: Any, value: Any, *, seed: int) -> Sampler:
        return SoundSampler(self, source, seed, value["offset"])

    def spoil(self, episode: EpisodeData, source: Source, i: int, k: int) -> EpisodeData:
        return episode

    def span(self, length: int) -> Span:
        return Span(0, (length + 1) // 2)

    def stream(self, seed: int, i: int, k: int) -> np.random.Generator:
        return derive(seed, "sound", i, k)


class SoundSampler(Sampler):
    def __init__(self, config: Sound, source: Source, seed: int, offset: float) -> None:
        self.config, self.source, self.seed, self.offset = config, source, seed, float(offset)

    def state(self) -> tuple[Any, Any]:
        return {}, {"offset": self.offset}

    def variation(self, i: int, k: int, material: Any) -> Variation:
        episode = copy_episode(self.source.episodes[i], number=i)
        span = self.config.span(len(episode.rewards))
        noise = self.config.stream(self.seed, i, k).normal(self.offset, size=span.stop - span.start)
        episode.rewards[span.start : span.stop] += self.config.strength * noise
        return Variation(self.config.spoil(episode, self.source, i, k), (span,))


def noisy(episode: EpisodeData, rng: np.random.Generator) -> EpisodeData:
    episode.rewards[:] += rng.normal(size=len(episode.rewards))
    return episode


# Configurations ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Nameless(Sound):
    name: ClassVar[str] = ""


@dataclass(frozen=True)
class Impostor(Sound):
    name: ClassVar[str] = "oat"


class Undecorated(Sound):
    pass


@dataclass(frozen=True)
class Thawed(Sound):
    pass


Thawed.__setattr__ = object.__setattr__


@dataclass(frozen=True)
class Unhashable(Sound):
    weights: Any = field(default_factory=lambda: [1.0])


@dataclass(frozen=True)
class LostInPickle(Sound):
    def __reduce__(self) -> Any:
        return LostInPickle, (self.strength + 1,)


@dataclass(frozen=True)
class Unpicklable(Sound):
    def __reduce__(self) -> Any:
        raise TypeError("an open file")


@dataclass(frozen=True)
class HiddenSetting(Sound):
    window: int = field(default=3, repr=False)


@dataclass(frozen=True)
class ShortRepr(Sound):
    def __repr__(self) -> str:
        return f"<ShortRepr {self.strength}>"


@dataclass(frozen=True)
class ComplexSetting(Sound):
    phase: complex = 1j


@dataclass(frozen=True)
class SettingOfAnotherType(Sound):
    window: int = 0.5  # JSON gives back a float, which the annotation does not allow


# Running ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class OnlyDiscrete(Sound):
    def check(self, source: Source) -> None:
        if source.observation_space.shape is not None and len(source) == len(LENGTHS) and source.lengths.max() > 1:
            raise InvalidDataError("Boxes are not for it.")


@dataclass(frozen=True)
class OnlyBoxes(Sound):
    def spoil(self, episode: EpisodeData, source: Source, i: int, k: int) -> EpisodeData:
        episode.actions.shape[1]
        return episode


@dataclass(frozen=True)
class OnlyOurs(Sound):
    def check(self, source: Source) -> None:
        if source.dataset.id == "test/walks-v0":
            raise InvalidDataError("Walks are not for it.")


@dataclass(frozen=True)
class NeedsTwoSteps(Sound):
    def check(self, source: Source) -> None:
        np.diff(np.arange(source.lengths.max()))[0]


@dataclass(frozen=True)
class LongerSoon(Sound):
    def lengths(self, source: Source, episodes: Any, variations: Any, *, seed: int) -> Any:
        return source.lengths[episodes] + (variations == 1)


@dataclass(frozen=True)
class ChangesSource(Sound):
    def fit(self, source: Source, *, seed: int, progress: Any = None) -> Sampler:
        sampler = super().fit(source, seed=seed)
        source.episodes[0].infos["clock"][0] = -1.0
        return sampler


@dataclass(frozen=True)
class GlobalNumpy(Sound):
    def spoil(self, episode: EpisodeData, source: Source, i: int, k: int) -> EpisodeData:
        episode.rewards[0] += self.strength * np.random.random()  # noqa: NPY002
        return episode


@dataclass(frozen=True)
class GlobalRandom(Sound):
    def spoil(self, episode: EpisodeData, source: Source, i: int, k: int) -> EpisodeData:
        random.random()
        return episode


@dataclass(frozen=True)
class GlobalTorch(Sound):
    def fit(self, source: Source, *, seed: int, progress: Any = None) -> Sampler:
        torch.rand(1)
        return super().fit(source, seed=seed)


_counter = itertools.count()


@dataclass(frozen=True)
class Counting(Sound):
    def stream(self, seed: int, i: int, k: int) -> np.random.Generator:
        return derive(seed, next(_counter))


@dataclass(frozen=True)
class InOrder(Sound):
    """Draws all variations from one generator, so that the order of access decides."""

    def fit(self, source: Source, *, seed: int, progress: Any = None) -> Sampler:
        return InOrderSampler(self, source, seed, 0.0)


class InOrderSampler(SoundSampler):
    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.rng = derive(self.seed)

    def variation(self, i: int, k: int, material: Any) -> Variation:
        made = super().variation(i, k, material)
        made.episode.rewards[0] += self.config.strength * self.rng.normal()
        return made


@dataclass(frozen=True)
class Forgetful(Sound):
    def restore(self, source: Source, arrays: Any, value: Any, *, seed: int) -> Sampler:
        return SoundSampler(self, source, seed, 0.0)


@dataclass(frozen=True)
class OneVariation(Sound):
    def stream(self, seed: int, i: int, k: int) -> np.random.Generator:
        return derive(seed, i)


@dataclass(frozen=True)
class SeedIgnored(Sound):
    def stream(self, seed: int, i: int, k: int) -> np.random.Generator:
        return derive(0, i, k)


# What episodes hold -------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class SharesSource(Sound):
    def spoil(self, episode: EpisodeData, source: Source, i: int, k: int) -> EpisodeData:
        return dataclasses.replace(episode, actions=source.episodes[i].actions)


_kept: dict[Any, Any] = {}


@dataclass(frozen=True)
class SharesVariations(Sound):
    def spoil(self, episode: EpisodeData, source: Source, i: int, k: int) -> EpisodeData:
        # with the source, whose id another one may get once it is gone
        kept = _kept.setdefault((id(source), i), (source, episode.truncations))
        return dataclasses.replace(episode, truncations=kept[1])


@dataclass(frozen=True)
class SharesInfos(Sound):
    def spoil(self, episode: EpisodeData, source: Source, i: int, k: int) -> EpisodeData:
        return dataclasses.replace(episode, infos=source.episodes[i].infos)


def _all_observations(episode: EpisodeData, change: Callable[[np.ndarray], np.ndarray]) -> EpisodeData:
    batch = episode.observations
    changed = {key: change(part) for key, part in batch.items()} if isinstance(batch, dict) else change(batch)
    return dataclasses.replace(episode, observations=changed)


@dataclass(frozen=True)
class Outside(Sound):
    def spoil(self, episode: EpisodeData, source: Source, i: int, k: int) -> EpisodeData:
        return _all_observations(episode, _first_far_away) if self.strength else episode


def _first_far_away(rows: np.ndarray) -> np.ndarray:
    rows = rows.copy()
    rows[0] = 99
    return rows


@dataclass(frozen=True)
class NotFinite(Sound):
    def spoil(self, episode: EpisodeData, source: Source, i: int, k: int) -> EpisodeData:
        episode.rewards[0] += self.strength * np.inf if self.strength else 0.0
        return episode


@dataclass(frozen=True)
class TooFewObservations(Sound):
    def spoil(self, episode: EpisodeData, source: Source, i: int, k: int) -> EpisodeData:
        return dataclasses.replace(episode, observations=slice_tree(episode.observations, slice(1, None)))


@dataclass(frozen=True)
class EarlyEnd(Sound):
    def spoil(self, episode: EpisodeData, source: Source, i: int, k: int) -> EpisodeData:
        episode.truncations[0] |= self.strength > 0
        return episode


@dataclass(frozen=True)
class InventedEnd(Sound):
    def spoil(self, episode: EpisodeData, source: Source, i: int, k: int) -> EpisodeData:
        if self.strength > 0:
            episode.terminations[-1], episode.truncations[-1] = True, False
        return episode

    def span(self, length: int) -> Span:
        return Span(0, length)


@dataclass(frozen=True)
class Endless(Sound):
    def spoil(self, episode: EpisodeData, source: Source, i: int, k: int) -> EpisodeData:
        if self.strength > 0:
            episode.terminations[-1] = episode.truncations[-1] = False
        return episode

    def span(self, length: int) -> Span:
        return Span(0, length)


@dataclass(frozen=True)
class ShiftedActions(Sound):
    def spoil(self, episode: EpisodeData, source: Source, i: int, k: int) -> EpisodeData:
        return dataclasses.replace(episode, actions=np.roll(episode.actions, int(self.strength), axis=0))


@dataclass(frozen=True)
class ShiftedRewards(Sound):
    def spoil(self, episode: EpisodeData, source: Source, i: int, k: int) -> EpisodeData:
        return dataclasses.replace(episode, rewards=np.roll(episode.rewards, int(self.strength)))


@dataclass(frozen=True)
class ShiftedObservations(Sound):
    def spoil(self, episode: EpisodeData, source: Source, i: int, k: int) -> EpisodeData:
        return _all_observations(episode, lambda rows: np.roll(rows, int(self.strength), axis=0))


@dataclass(frozen=True)
class NoZero(Sound):
    @property
    def at_zero_strength(self) -> Augmenter | None:
        return None


@dataclass(frozen=True)
class NotQuiteZero(Sound):
    @property
    def at_zero_strength(self) -> Augmenter | None:
        return dataclasses.replace(self, strength=1e-9)


@dataclass(frozen=True)
class LosesInfos(Sound):
    def spoil(self, episode: EpisodeData, source: Source, i: int, k: int) -> EpisodeData:
        return dataclasses.replace(episode, infos={}) if self.strength else episode


@dataclass(frozen=True)
class SpansTooFar(Sound):
    def fit(self, source: Source, *, seed: int, progress: Any = None) -> Sampler:
        return TooFarSampler(self, source, seed, 0.0)

    def restore(self, source: Source, arrays: Any, value: Any, *, seed: int) -> Sampler:
        return TooFarSampler(self, source, seed, 0.0)


class TooFarSampler(SoundSampler):
    def variation(self, i: int, k: int, material: Any) -> Variation:
        made = super().variation(i, k, material)
        return dataclasses.replace(made, spans=(*made.spans, Span(99, 100)))


@dataclass(frozen=True)
class OnlyOnce(Sound):
    def check(self, source: Source) -> None:
        if len(source) > len(LENGTHS):
            raise InvalidDataError("Too many episodes.")


BROKEN: list[tuple[str, str, Augmenter]] = [
    ("named", "its name must be a string, got ''", Nameless()),
    ("named", "its name 'oat' is that of OAT", Impostor()),
    ("immutable", "Undecorated is no dataclass itself", Undecorated()),
    ("immutable", "its setting 'strength' can be set", Thawed()),
    ("immutable", "it has no hash", Unhashable()),
    ("picklable", r"its pickle gives back LostInPickle\(strength=2.0\)", LostInPickle()),
    ("picklable", "it cannot be pickled.*an open file", Unpicklable()),
    ("repr", "which is not equal to it", HiddenSetting(window=5)),
    ("repr", "does not rebuild it", ShortRepr()),
    ("settings", "of type complex has no JSON form", ComplexSetting()),
    ("settings", "has the value 0.5, and <class 'int'> is expected", SettingOfAnotherType()),
    ("continuous", "it raised InvalidDataError: Boxes are not for it", OnlyDiscrete()),
    ("discrete", "it raised IndexError", OnlyBoxes()),
    ("one-step", "it raised IndexError", NeedsTwoSteps()),
    ("source-unchanged", "the episodes of the source were changed", ChangesSource()),
    ("random-state", "random state of numpy.random was moved", GlobalNumpy()),
    ("random-state", "random state of random was moved", GlobalRandom()),
    ("random-state", "random state of torch was moved", GlobalTorch()),
    ("determinism", "asked for from the last to the first, gives another variation 0 of episode 0", InOrder()),
    ("restoring", "a restored sampler gives another variation 0 of episode 0: rewards at row 0", Forgetful()),
    ("variations-differ", "variations 0 and 1 of every episode are the same", OneVariation()),
    ("seeds-differ", "the seeds 0 and 1 give the same episodes", SeedIgnored()),
    ("memory", "variation 0 of episode 0 shares memory with episode 0 of the source", SharesSource()),
    ("memory", "variation 1 of episode 0 shares memory with variation 0 of episode 0", SharesVariations()),
    ("memory", "variation 0 of episode 0 shares memory with episode 0 of the source", SharesInfos()),
    ("lengths", "variation 1 of episode 0 has 26 steps, and np.int64.27. were announced", LongerSoon()),
    ("spaces", "observations at row 0 is .* which is not in Box", Outside()),
    ("spaces", "a reward is not finite", NotFinite()),
    ("flags", "has a flag set at step 0 of 26", EarlyEnd()),
    ("flags", "discrete: variation 0 of episode 0 terminates, and no episode of the source does", InventedEnd()),
    ("flags", "does not end, and every episode of the source does", Endless()),
    ("alignment", "its action is not the one recorded with its observation", ShiftedActions()),
    ("alignment", "its reward is not the one recorded with its observation", ShiftedRewards()),
    ("alignment", "its observation is that of episode 0, step 12", ShiftedObservations()),
    ("zero-strength", "at_zero_strength is None", NoZero()),
    ("zero-strength", "variation 0 of episode 0 is not its source: rewards at row 0", NotQuiteZero()),
    ("conformance", "check_dataset finds infos-kept", LosesInfos()),
    ("conformance", "has a span 99:100", SpansTooFar()),
    ("augmented-twice", "it raised InvalidDataError: Too many episodes", OnlyOnce()),
]


@pytest.mark.parametrize(("check", "message", "broken"), BROKEN, ids=[type(row[2]).__name__ for row in BROKEN])
def test_broken_augmenters_are_caught_by_one_check(check: str, message: str, broken: Augmenter) -> None:
    _expect_only(check, message, broken)


def _expect_only(check: str, message: str, broken: Augmenter, **arguments: Any) -> None:
    with pytest.raises(ConformanceError, match=f"(?s)FAILED {check}: .*{message}") as caught:
        check_augmenter(broken, limit=4, **arguments)
    assert isinstance(caught.value, ChecksFailed)
    assert [name for name, _ in caught.value.report.failed] == [check]


def test_what_fails_everywhere_is_told_once_for_each_kind_of_space() -> None:
    with pytest.raises(ChecksFailed) as caught:
        check_augmenter(TooFewObservations())
    assert [name for name, _ in caught.value.report.failed] == ["continuous", "discrete", "one-step"]
    with pytest.raises(ChecksFailed, match=r"determinism: continuous: a second fit") as caught:
        check_augmenter(Counting())
    assert {name for name, _ in caught.value.report.failed} <= {"determinism", "zero-strength"}


def test_a_dataset_of_the_users_is_run_on_as_well(walk_dataset: minari.MinariDataset) -> None:
    _expect_only("own-dataset", "Walks are not for it", OnlyOurs(), dataset=walk_dataset)
    report = check_augmenter(Sound(), walk_dataset)
    assert report.counts["own-dataset"] == 2 * len(walk_dataset)
    assert not report.skipped


def test_settings_for_other_data_are_checked_on_that_alone(walk_dataset: minari.MinariDataset) -> None:
    report = check_augmenter(OnlyWalks(), walk_dataset)
    assert {name for name, _ in report.skipped} == {"continuous", "discrete", "alignment"}
    with pytest.raises(ChecksFailed, match="FAILED continuous: it raised ConfigurationError: Walks only"):
        check_augmenter(OnlyWalks())


def test_one_label_for_each_episode_is_for_one_dataset(walk_dataset: minari.MinariDataset) -> None:
    report = check_augmenter(DGW(labels=(0, 1) * 6), walk_dataset, limit=4)
    assert {name for name, _ in report.skipped} == {"continuous", "discrete", "alignment", "augmented-twice"}
    assert "12 classes and the source 36 episodes" in dict(report.skipped)["augmented-twice"]
    assert report.counts["conformance"]


@dataclass(frozen=True)
class OnlyWalks(Sound):
    def check(self, source: Source) -> None:
        if len(source) == len(LENGTHS):
            raise ConfigurationError("Walks only.")


# Expected failures --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Declared(NoZero):
    expected_failures: ClassVar[dict[str, str]] = {"zero-strength": "its noise has no scale"}


@dataclass(frozen=True)
class Pessimist(Sound):
    expected_failures: ClassVar[dict[str, str]] = {"memory": "it is careless"}


@dataclass(frozen=True)
class Mistyped(Sound):
    expected_failures: ClassVar[dict[str, str]] = {"memroy": "it is careless"}


def test_expected_failures_are_reported_with_their_reason() -> None:
    report = check_augmenter(Declared())
    assert [name for name, _ in report.expected_failed] == ["zero-strength"]
    assert "its noise has no scale [at_zero_strength is None" in dict(report.expected_failed)["zero-strength"]
    assert "failed as expected zero-strength: its noise has no scale" in str(report)
    assert "zero-strength" not in report.counts


def test_expected_failures_that_do_not_come_are_failures() -> None:
    _expect_only("memory", r"it was expected to fail \(it is careless\) but passed", Pessimist())
    _expect_only("memroy", r"expected to fail \(it is careless\), and no check has this name", Mistyped())


def test_what_is_made_of_others_may_pass_what_its_parts_fail() -> None:
    report = check_augmenter(Compose((Pessimist(), Sound())))
    assert report.counts["memory"]
    assert report.expected_failed == ()
    report = check_augmenter(Mixture((Declared(), Sound())))
    assert [name for name, _ in report.expected_failed] == ["zero-strength"]
    _expect_only("memroy", "and no check has this name", Mixture((Mistyped(), Sound())))


# Sound augmenters ---------------------------------------------------------------------------------------------------


def _outcomes(report: Report) -> dict[str, str]:
    outcomes = {name: "passed" for name, _ in report.passed}
    outcomes |= {name: "skipped" for name, _ in report.skipped}
    return outcomes | {name: "expected" for name, _ in report.expected_failed}


def test_a_sound_augmenter_passes_every_check() -> None:
    outcomes = _outcomes(check_augmenter(Sound()))
    assert outcomes == {check.name: "passed" for check in AUGMENTER_CHECKS} | {"own-dataset": "skipped"}


def test_a_users_function_passes() -> None:
    outcomes = _outcomes(check_augmenter(Function(noisy)))
    assert {name for name, outcome in outcomes.items() if outcome == "expected"} == {"zero-strength"}
    skipped = {name for name, outcome in outcomes.items() if outcome == "skipped"}
    assert skipped == {"repr", "settings", "own-dataset", "alignment"}


@pytest.mark.parametrize(
    "augmenter",
    [
        Compose((Sound(), Sound(0.5))),
        Mixture((Sound(), Sound(0.5)), shares=(3.0, 1.0)),
        Compose((Mixture((Sound(), Sound(2.0))), Sound(0.5))),
    ],
)
def test_augmenters_made_of_sound_ones_pass_every_check(augmenter: Augmenter) -> None:
    outcomes = _outcomes(check_augmenter(augmenter))
    assert outcomes == {check.name: "passed" for check in AUGMENTER_CHECKS} | {"own-dataset": "skipped"}


def test_oat_passes_alone_and_composed(caplog: pytest.LogCaptureFixture) -> None:
    mining = MiningConfig(n_clusters=3, length=6, top=2, switch_penalty=5.0)
    oat = OAT(mining=mining, model=VAEMDPConfig(max_updates=10), behavior=BehaviorConfig(max_updates=20))
    for augmenter in (oat, Mixture((oat, Compose((oat, Sound()))))):
        outcomes = _outcomes(check_augmenter(augmenter, limit=6))
        assert {name for name, outcome in outcomes.items() if outcome == "expected"} == {"zero-strength"}
        assert {name for name, outcome in outcomes.items() if outcome == "skipped"} == {"own-dataset"}


_fits: list[int] = []


@dataclass(frozen=True)
class CountsFits(Sound):
    def fit(self, source: Source, *, seed: int, progress: Any = None) -> Sampler:
        _fits.append(seed) if self.strength else None
        return super().fit(source, seed=seed)


def test_it_fits_as_often_as_it_says(walk_dataset: minari.MinariDataset) -> None:
    _fits.clear()
    check_augmenter(CountsFits())
    assert len(_fits) == 7
    check_augmenter(CountsFits(), walk_dataset)
    assert len(_fits) == 7 + 9


def test_nothing_is_kept_on_disk(tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OAT_GYM_CACHE", str(tmp_path / "cache"))
    check_augmenter(Sound())
    assert not (tmp_path / "cache").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"augmenter": Sound}, "takes an oat_gym.Augmenter such as"),
        ({"augmenter": Sound(), "dataset": "test/walks-v0"}, "must be a minari.MinariDataset"),
        ({"augmenter": Sound(), "limit": 0}, "limit must be at least 1"),
        ({"augmenter": Sound(), "seed": -1}, "seed must be a non-negative integer"),
    ],
)
def test_bad_arguments_are_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        check_augmenter(**arguments)


def test_every_check_is_broken_by_something() -> None:
    names = [check.name for check in AUGMENTER_CHECKS]
    assert len(set(names)) == len(names) >= 20
    assert set(names) == {name for name, _, _ in BROKEN} | {"own-dataset"}
