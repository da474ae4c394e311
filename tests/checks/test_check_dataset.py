"""check_dataset passes sound datasets, and names the one rule that a broken dataset breaks."""

import dataclasses
import itertools
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import minari
import numpy as np
import pytest
from minari import EpisodeData

import oat_gym
from oat_gym import OAT, AugmentedDataset, Function
from oat_gym import dataset as dataset_module
from oat_gym import storage as storage_module
from oat_gym.augmenters.base import Variation
from oat_gym.checks import CHECKS, ChecksFailed, check_dataset
from oat_gym.checks import dataset as checks_module
from oat_gym.checks._compare import saved_infos_difference
from oat_gym.errors import ConfigurationError, ConformanceError, InvalidDataError
from oat_gym.export import write_dataset
from oat_gym.storage import AugmentedStorage

MakeDataset = Callable[..., minari.MinariDataset]
LENGTHS = [3, 7, 1, 5]


def halved(episode: EpisodeData, rng: np.random.Generator) -> EpisodeData:
    episode.rewards[:] *= 0.5
    return episode


def change(data: dict[str, Any], **fields: Any) -> dict[str, Any]:
    return {**data, **fields}


# What is wrong with each episode that is read: only synthetic ones are spoilt (ids from 4), so that the comparison of
# real ones with the source stays out of it.


def shifted(data: dict[str, Any]) -> dict[str, Any]:
    """Observations that lack the first one, as a reader has that mixes up s and s'."""
    return change(data, observations={key: value[1:] for key, value in data["observations"].items()})


def nan_reward(data: dict[str, Any]) -> dict[str, Any]:
    return change(data, rewards=np.where(np.arange(len(data["rewards"])) == 0, np.nan, data["rewards"]))


def nan_observation(data: dict[str, Any]) -> dict[str, Any]:
    position = data["observations"]["position"].copy()
    position[-1, 1] = np.nan
    return change(data, observations={**data["observations"], "position": position})


def outside(data: dict[str, Any]) -> dict[str, Any]:
    mode = data["observations"]["mode"].copy()
    mode[0] = 3
    return change(data, observations={**data["observations"], "mode": mode})


_counter = itertools.count()
_kept: dict[int, dict[str, Any]] = {}

SPOILT: list[tuple[str, str, Callable[[dict[str, Any]], dict[str, Any]]]] = [
    ("t-plus-one", r"observations\['mode'\] has 3 rows, expected 4 for 3 rewards", shifted),
    ("t-plus-one", "actions has 2 rows, expected 3", lambda d: change(d, actions=d["actions"][:-1])),
    ("t-plus-one", "truncations has 2 rows, expected 3", lambda d: change(d, truncations=d["truncations"][:-1])),
    ("structure", "must be a dict with the keys", lambda d: change(d, observations={"position": 0})),
    ("structure", "must be a dict", lambda d: change(d, observations=d["observations"]["position"])),
    (
        "dtypes",
        "actions has dtype float64, expected float32",
        lambda d: change(d, actions=d["actions"].astype(np.float64)),
    ),
    ("dtypes", "terminations have dtype int8", lambda d: change(d, terminations=d["terminations"].astype(np.int8))),
    ("shapes", r"rows of shape \(1, 1\)", lambda d: change(d, actions=d["actions"][..., None])),
    ("shapes", "rewards has 2 dimensions", lambda d: change(d, rewards=d["rewards"][:, None])),
    ("spaces", "at row 0 is .*3.*outside Discrete", outside),
    ("finite", "reward at step 0 is not finite", nan_reward),
    ("finite", "is NaN at row 3", nan_observation),
    ("flags", "has a flag set at step 0", lambda d: change(d, truncations=np.ones_like(d["truncations"]))),
    (
        "infos",
        r"infos\['clock'\] has 2 rows for 3 steps",
        lambda d: change(d, infos={**d["infos"], "clock": d["infos"]["clock"][: len(d["rewards"]) - 1]}),
    ),
    ("infos-kept", r"the infos \['clock'\]", lambda d: change(d, infos={"clock": d["infos"]["clock"]})),
    ("infos-kept", r"the infos \[\]", lambda d: change(d, infos={})),
    ("ids", "asked for by id 4 calls itself 0", lambda d: change(d, id=0)),
    ("determinism", "rewards at row 0", lambda d: change(d, rewards=d["rewards"] + next(_counter))),
    (
        "aliasing",
        "share the memory of observations",
        lambda d: _kept.setdefault(id(_kept) + int(d["id"]), d),
    ),
]


@pytest.mark.parametrize(("check", "message", "spoil"), SPOILT)
def test_spoilt_episodes_are_caught_by_one_check(
    make_dataset: MakeDataset,
    monkeypatch: pytest.MonkeyPatch,
    check: str,
    message: str,
    spoil: Callable[[dict[str, Any]], dict[str, Any]],
) -> None:
    _kept.clear()
    sound = AugmentedStorage.get_episodes

    def get_episodes(self: AugmentedStorage, episode_indices: Iterable[int]) -> Iterator[dict[str, Any]]:
        return (spoil(data) if int(data["id"]) == 4 else data for data in sound(self, episode_indices))

    monkeypatch.setattr(AugmentedStorage, "get_episodes", get_episodes)  # copies of the dataset are spoilt alike
    _expect_only(AugmentedDataset(make_dataset(LENGTHS), Function(halved), count=6, seed=1), check, message)


def _expect_only(broken: minari.MinariDataset, check: str, message: str) -> None:
    with pytest.raises(ConformanceError, match=f"(?s)FAILED {check}: .*{message}") as caught:
        check_dataset(broken)
    assert isinstance(caught.value, ChecksFailed)
    assert [name for name, _ in caught.value.report.failed] == [check]


class Readonly(AugmentedDataset):
    """The parts that the subclasses below break."""


class WrongTotalSteps(Readonly):
    @property
    def total_steps(self) -> int:
        return super().total_steps + 1


class WrongLength(Readonly):
    def __len__(self) -> int:
        return super().__len__() + 1


class TwiceTheSame(Readonly):
    @property
    def episode_indices(self) -> Any:
        return np.where(self._episode_indices == 9, 8, self._episode_indices)

    @episode_indices.setter
    def episode_indices(self, new_value: Any) -> None:
        self._episode_indices = new_value


class UnknownId(Readonly):
    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.episode_indices = np.append(self.episode_indices[:-1], 10)

    def iterate_episodes(self, episode_indices: Any = None) -> Iterator[EpisodeData]:
        return super().iterate_episodes([min(int(number), 9) for number in episode_indices])


class ShiftedIndexing(Readonly):
    def __getitem__(self, idx: Any) -> Any:
        return super().__getitem__(0 if idx == 1 else idx)


class EndlessIndexing(Readonly):
    def __getitem__(self, idx: Any) -> Any:
        return super().__getitem__((idx + 10) % 10)


class ListsOnly(Readonly):
    def iterate_episodes(self, episode_indices: Any = None) -> Iterator[EpisodeData]:
        if isinstance(episode_indices, Iterator):
            episode_indices = list(episode_indices)[:-1]
        return super().iterate_episodes(episode_indices)


class UnseededSampling(Readonly):
    def sample_episodes(self, n_episodes: int) -> Any:
        chosen = 2 * (next(_counter) % 2) + np.arange(n_episodes)
        return list(self.iterate_episodes(chosen))


class RepeatedSampling(Readonly):
    def sample_episodes(self, n_episodes: int) -> Any:
        return [self[0]] * n_episodes


class PlainViews(Readonly):
    def filter_episodes(self, condition: Any) -> Any:
        return minari.MinariDataset.filter_episodes(self, condition)


class UnfilteredViews(Readonly):
    def filter_episodes(self, condition: Any) -> Any:
        return self


class GlobalRandomness(Readonly):
    def iterate_episodes(self, episode_indices: Any = None) -> Iterator[EpisodeData]:
        np.random.random()  # noqa: NPY002
        return super().iterate_episodes(episode_indices)


class LostOnPickling(Readonly):
    def __reduce__(self) -> Any:
        return _first_of, (self.storage,)

    def __copy__(self) -> Any:
        return self.open(self.storage, self.episode_indices)

    def __deepcopy__(self, memo: Any) -> Any:
        return self


class LostOnCopying(Readonly):
    def __deepcopy__(self, memo: Any) -> Any:
        return _first_of(self.storage)


def _first_of(storage: AugmentedStorage) -> AugmentedDataset:
    return LostOnPickling.open(storage, np.array([0]))


class OtherSpaces(Readonly):
    @property
    def spec(self) -> Any:
        return dataclasses.replace(super().spec, action_space=super().observation_space)


class MaskTooShort(Readonly):
    def provenance(self, index: int) -> oat_gym.Provenance:
        origin = super().provenance(index)
        return _Cut(**vars(origin)) if origin.synthetic else origin


class _Cut(oat_gym.Provenance):
    @property
    def mask(self) -> Any:
        return super().mask[1:]

    def __eq__(self, other: object) -> bool:
        return vars(self) == vars(other)

    __hash__ = None


class WrongProvenance(Readonly):
    def provenance(self, index: int) -> oat_gym.Provenance:
        origin = super().provenance(index)
        return dataclasses.replace(origin, source=0) if index == 5 else origin


class ShiftedNextStates(Readonly):
    def transitions(self, *, flat: bool = False) -> oat_gym.Transitions:
        columns = super().transitions(flat=flat)
        return dataclasses.replace(columns, next_observations=columns.observations)


class ShiftedEpisodes(Readonly):
    def transitions(self, *, flat: bool = False) -> oat_gym.Transitions:
        columns = super().transitions(flat=flat)
        return dataclasses.replace(columns, rewards=np.roll(columns.rewards, 1))


class LostSteps(Readonly):
    def transitions(self, *, flat: bool = False) -> oat_gym.Transitions:
        columns = super().transitions(flat=flat)
        return dataclasses.replace(columns, rewards=columns.rewards[:-1])


SUBCLASSES: list[tuple[str, str, type[Readonly]]] = [
    ("total-steps", "have 42 steps in all, but {'total_steps': 43", WrongTotalSteps),
    ("size", r"'len\(dataset\)': 11", WrongLength),
    ("ids", "the id 8 is there 2 times", TwiceTheSame),
    ("ids", r"ids 0 to 10 are not inside 0..9", UnknownId),
    ("indexing", r"dataset\[1\] gives episode 0", ShiftedIndexing),
    ("bounds", r"dataset\[10\] of 10 episodes is no IndexError", EndlessIndexing),
    ("index-kinds", "a generator of ids gives 9 episodes, expected 10", ListsOnly),
    ("sampling", r"after set_seed\(0\) the draw is", UnseededSampling),
    ("sampling", r"a draw of 5 gives \[0, 0", RepeatedSampling),
    ("views", "gives a MinariDataset", PlainViews),
    ("views", "filter_episodes keeps 10 episodes, expected 7", UnfilteredViews),
    ("random-state", "moved NumPy's global random state", GlobalRandomness),
    ("pickling", "unpickling gives a LostOnPickling of other episodes", LostOnPickling),
    ("deep-copy", "a deep copy gives a LostOnPickling of other episodes", LostOnCopying),
    ("specification", "spec.action_space is Dict", OtherSpaces),
    ("masks", "the mask of episode 4 has 2 entries for 3 steps", MaskTooShort),
    ("provenance", "episode 5: the metadata gives", WrongProvenance),
    ("transitions", r"are not its steps: next_observations\['", ShiftedNextStates),
    ("transitions", "are not its steps: rewards at row 0", ShiftedEpisodes),
    ("transitions", r"transitions\(\) has 41 rows for 42 steps", LostSteps),
]


@pytest.mark.parametrize(("check", "message", "kind"), SUBCLASSES)
def test_broken_datasets_are_caught_by_one_check(
    make_dataset: MakeDataset, check: str, message: str, kind: type[Readonly]
) -> None:
    _expect_only(kind(make_dataset(LENGTHS), Function(halved), count=6, seed=1), check, message)


# Broken storages --------------------------------------------------------------------------------------------------


class WrongMetadataSteps(AugmentedStorage):
    def get_episode_metadata(self, episode_indices: Iterable[int]) -> Iterator[dict[str, Any]]:
        for metadata in super().get_episode_metadata(episode_indices):
            yield metadata | ({"total_steps": 99} if metadata["id"] == 5 else {})


class LostMetadata(AugmentedStorage):
    def get_episode_metadata(self, episode_indices: Iterable[int]) -> Iterator[dict[str, Any]]:
        for metadata in super().get_episode_metadata(episode_indices):
            yield {key: value for key, value in metadata.items() if key != "options"}


class ClaimedSpans(AugmentedStorage):
    """Says that the first step only was generated, where the function changed all of them."""

    def variation(self, number: int) -> Variation | None:
        made = super().variation(number)
        return made and dataclasses.replace(made, spans=(oat_gym.Span(0, 1),))

    def provenance(self, number: int, variation: Variation | None = None) -> oat_gym.Provenance:
        return super().provenance(number, variation or self.variation(number))


class ChangedReal(AugmentedStorage):
    def get_episodes(self, episode_indices: Iterable[int]) -> Iterator[dict[str, Any]]:
        for data in super().get_episodes(episode_indices):
            yield change(data, rewards=data["rewards"] + (1e-9 if int(data["id"]) == 1 else 0.0))


class LyingApply(AugmentedStorage):
    def apply(self, function: Any, episode_indices: Any = None) -> Any:
        return [(0, 0)] * 10


class ForgetsTheLast(AugmentedStorage):
    """Announces one episode less than its plan has."""

    @property
    def total_episodes(self) -> int:
        return super().total_episodes - 1

    @property
    def metadata(self) -> dict[str, Any]:
        metadata = super().metadata
        return metadata | {"total_episodes": metadata["total_episodes"] - 1, "total_steps": metadata["total_steps"] - 7}


class SharedMetadata(AugmentedStorage):
    kept: dict[str, Any] = {"level": 1}  # noqa: RUF012

    def get_episode_metadata(self, episode_indices: Iterable[int]) -> Iterator[dict[str, Any]]:
        return (metadata | {"note": self.kept} for metadata in super().get_episode_metadata(episode_indices))


STORAGES: list[tuple[str, str, type[AugmentedStorage]]] = [
    ("metadata-steps", "episode 5 has 7 steps, its metadata says 99", WrongMetadataSteps),
    ("metadata-kept", "the metadata of episode 0 lacks 'options'", LostMetadata),
    ("outside-spans", "differs from its source outside its spans: rewards", ClaimedSpans),
    ("real-episodes", "real episode 1 is not the source's: rewards at row 0", ChangedReal),
    ("storage", "storage.apply gives", LyingApply),
    ("plan", "9 episodes in all, expected 4 real and 6 synthetic", ForgetsTheLast),
    ("aliasing", r"the metadata of episode 0 share metadata\['note'\]", SharedMetadata),
]


@pytest.mark.parametrize(("check", "message", "kind"), STORAGES)
def test_broken_storages_are_caught_by_one_check(
    make_dataset: MakeDataset, monkeypatch: pytest.MonkeyPatch, check: str, message: str, kind: type[AugmentedStorage]
) -> None:
    monkeypatch.setattr(dataset_module, "AugmentedStorage", kind)
    monkeypatch.setattr(storage_module, "AugmentedStorage", kind)
    _expect_only(AugmentedDataset(make_dataset(LENGTHS), Function(halved), count=6, seed=1), check, message)


def test_a_source_that_is_written_to_is_told(make_dataset: MakeDataset) -> None:
    real = make_dataset(LENGTHS)

    class Writing(AugmentedDataset):
        def sample_episodes(self, n_episodes: int) -> Any:
            real.storage.update_metadata({"touched": True})
            return super().sample_episodes(n_episodes)

    Writing.__qualname__ = "Writing"
    globals()["Writing"] = Writing
    _expect_only(Writing(real, Function(halved), count=6), "source-untouched", "metadata.json")


def test_a_source_of_another_environment_is_told(make_dataset: MakeDataset) -> None:
    data = AugmentedDataset(make_dataset(LENGTHS), Function(halved), count=1)
    other = make_dataset(LENGTHS, dataset_id="test/other-v0")
    other.storage.update_metadata({"ref_max_score": 3.0})
    with pytest.raises(ChecksFailed, match=r"metadata\['ref_max_score'\] is None, the source has 3.0"):
        check_dataset(data, source=other)


def test_a_plan_that_gives_other_bytes_is_told(make_dataset: MakeDataset) -> None:
    data = AugmentedDataset(make_dataset(LENGTHS), Function(halved), count=6).fit()
    data.storage.synthesis.seed = 7  # what was made was made with seed 0

    def noisy(episode: EpisodeData, rng: np.random.Generator) -> EpisodeData:
        episode.rewards[:] += rng.normal()
        return episode

    object.__setattr__(data.augmenter, "function", noisy)
    _expect_only(data, "rebuilding", "the dataset built again and iteration disagree, rewards")


# Sound datasets ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("data_format", ["hdf5", "arrow", "parquet"])
def test_sound_datasets_pass(make_dataset: MakeDataset, data_format: str) -> None:
    real = make_dataset(LENGTHS, data_format=data_format)
    plain = check_dataset(real, formats=("hdf5",))
    assert len(plain.passed) == 27
    assert all("not an augmented one" in reason for _, reason in plain.skipped)
    for data in (AugmentedDataset(real, count=0), AugmentedDataset(real, Function(halved), count=6)):
        report = check_dataset(data, formats=("hdf5", "arrow", "parquet"))
        assert [name for name, _ in report.passed] == [check.name for check in CHECKS]
        nothing = {name for name, count in report.counts.items() if count == 0}
        assert nothing <= {"outside-spans", "infos-kept"}  # no synthetic episode, or nothing outside its spans
        assert report.counts["saving"] == 3 * len(data)


@pytest.mark.parametrize("data_format", ["hdf5", "arrow"])
def test_infos_that_are_saved_with_other_values_are_told(
    make_dataset: MakeDataset, data_format: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = make_dataset(LENGTHS)

    def write(path: Any, name: str, episodes: Iterable[tuple[EpisodeData, dict[str, Any]]], **settings: Any) -> None:
        spoilt = ((dataclasses.replace(e, infos=e.infos | {"clock": e.infos["clock"] + 1}), m) for e, m in episodes)
        write_dataset(path, name, spoilt, **settings)

    monkeypatch.setattr(checks_module, "write_dataset", write)
    with pytest.raises(ChecksFailed, match=r"comes back with other infos: infos\['clock'\] at row 0"):
        check_dataset(real, formats=(data_format,))


def test_a_padding_of_infos_is_allowed_where_it_is_noted() -> None:
    short, padded = {"a": np.array([3.0, 4.0])}, {"a": np.array([3.0, 3.0, 4.0])}
    assert saved_infos_difference(padded, short, 2) is None
    assert saved_infos_difference(short, short, None) is None
    for got, rows in ((padded, None), ({"a": np.array([0.0, 3.0, 4.0])}, 2), ({"b": padded["a"]}, 2), ({}, 2)):
        assert saved_infos_difference(got, short, rows)


def test_oat_passes(walk_dataset: minari.MinariDataset, tiny_oat: OAT) -> None:
    for seam in ("contiguous", "literal"):
        augmenter = dataclasses.replace(tiny_oat, seam=seam)
        report = check_dataset(AugmentedDataset(walk_dataset, augmenter, factor=3, seed=1))
        assert report.counts["outside-spans"] > 0
        assert len(report.passed) == len(CHECKS) - 1


def test_views_appended_and_saved_datasets_pass(make_dataset: MakeDataset) -> None:
    data = AugmentedDataset(make_dataset(LENGTHS), Function(halved), count=6)
    check_dataset(data.filter_episodes(lambda episode: len(episode) > 1))
    check_dataset(AugmentedDataset(data, Function(halved), count=4))
    check_dataset(data.save("test/saved-v0"))
    assert "the augmenter cannot be pickled" in str(
        check_dataset(AugmentedDataset(data, Function(lambda episode, rng: episode), count=2))
    )


def test_a_limit_looks_at_some_episodes(make_dataset: MakeDataset) -> None:
    data = AugmentedDataset(make_dataset(LENGTHS), Function(halved), count=6)
    report = check_dataset(data, limit=3)
    assert report.counts["readable"] == 3
    assert report.counts["size"] == 10
    assert dataclasses.is_dataclass(report)
    with pytest.raises(dataclasses.FrozenInstanceError):
        report.passed = ()
    assert str(report).startswith("AugmentedDataset test/coded-v0: 37 checks passed on")


def test_what_cannot_be_checked_is_told(make_dataset: MakeDataset) -> None:
    real = make_dataset(LENGTHS)
    for arguments, message in (
        ({"dataset": [1, 2]}, "takes a minari.MinariDataset"),
        ({"dataset": real, "limit": 0}, "limit must be at least 1"),
        ({"dataset": real, "formats": ("csv",)}, "formats must be among"),
    ):
        with pytest.raises(ConfigurationError, match=message):
            check_dataset(**arguments)
    with pytest.raises(InvalidDataError, match="no episodes to check"):
        check_dataset(real.filter_episodes(lambda episode: False))


def test_there_are_enough_checks_with_names_of_their_own() -> None:
    names = [check.name for check in CHECKS]
    assert len(set(names)) == len(names) >= 20
    covered = {name for name, _, _ in (*SPOILT, *SUBCLASSES, *STORAGES)}
    others = {"source-untouched", "environment", "rebuilding", "saving", "readable", "splitting"}
    assert set(names) == covered | others
