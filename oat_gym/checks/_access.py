"""Checks of how a dataset is read: sizes, ids, every way of access, views, copies, random state."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable, Iterable
from typing import Any

import minari
import numpy as np
from minari import EpisodeData, MinariDataset

from oat_gym.checks._compare import FIELDS, shared_leaf
from oat_gym.checks._subject import Subject
from oat_gym.checks.report import Broken, Check, NotApplicable
from oat_gym.dataset import AugmentedDataset


def size(subject: Subject) -> int:
    """`len`, total_episodes, episode_indices and spec agree."""
    dataset = subject.dataset
    got = {
        "len(dataset)": len(dataset),
        "total_episodes": dataset.total_episodes,
        "len(episode_indices)": len(dataset.episode_indices),
        "spec.total_episodes": int(dataset.spec.total_episodes),
    }
    if len(set(got.values())) > 1:
        raise Broken(f"the numbers of episodes disagree: {got}")
    return len(dataset)


def ids(subject: Subject) -> int:
    """Ids are those of the storage, none twice, and an episode carries the id that it was asked for by."""
    indices, total = np.asarray(subject.dataset.episode_indices), subject.dataset.storage.total_episodes
    if not np.issubdtype(indices.dtype, np.integer) or indices.ndim != 1:
        raise Broken(f"episode_indices must be one row of integers, got {indices.dtype}{list(indices.shape)}")
    if len(np.unique(indices)) != len(indices):
        values, counts = np.unique(indices, return_counts=True)
        raise Broken(f"the id {values[counts > 1][0]} is there {counts.max()} times")
    if not np.isin(indices, np.arange(total)).all():
        raise Broken(f"ids {indices.min()} to {indices.max()} are not inside 0..{total - 1} of the storage")
    for number, episode in zip(subject.numbers, subject.episodes, strict=True):
        if int(episode.id) != number:
            raise Broken(f"the episode asked for by id {number} calls itself {episode.id}")
    return len(indices)


def metadata_steps(subject: Subject) -> int:
    """The metadata of an episode has its id and its number of steps."""
    if len(subject.metadata) != len(subject.episodes):
        raise Broken(f"{len(subject.episodes)} episodes have {len(subject.metadata)} metadata")
    for episode, metadata in zip(subject.episodes, subject.metadata, strict=True):
        steps, claimed = len(episode.rewards), metadata.get("total_steps")
        if claimed != steps:
            raise Broken(f"episode {episode.id} has {steps} steps, its metadata says {claimed}")
        if metadata.get("id", episode.id) != episode.id:
            raise Broken(f"the metadata of episode {episode.id} has the id {metadata['id']}")
    return len(subject.metadata)


def total_steps(subject: Subject) -> int:
    """total_steps is the sum over the episodes, in the dataset, its spec and (for a whole one) its storage."""
    dataset = subject.dataset
    expected = sum(int(part["total_steps"]) for part in dataset.storage.get_episode_metadata(dataset.episode_indices))
    got = {"total_steps": dataset.total_steps, "spec.total_steps": dataset.spec.total_steps}
    if len(dataset) == dataset.storage.total_episodes:
        got |= {"storage.total_steps": dataset.storage.total_steps}
    wrong = {name: int(value) for name, value in got.items() if value != expected}
    if wrong:
        raise Broken(f"the episodes have {expected} steps in all, but {wrong}")
    return expected


def specification(subject: Subject) -> int:
    """Spaces, id, environment and path are the same in the dataset, its spec and its metadata."""
    dataset, spec, metadata = subject.dataset, subject.dataset.spec, subject.dataset.storage.metadata
    pairs: dict[str, tuple[Any, Any]] = {
        "spec.observation_space": (spec.observation_space, dataset.observation_space),
        "spec.action_space": (spec.action_space, dataset.action_space),
        "metadata['observation_space']": (metadata["observation_space"], dataset.observation_space),
        "metadata['action_space']": (metadata["action_space"], dataset.action_space),
        "spec.dataset_id": (spec.dataset_id, dataset.id),
        "metadata['dataset_id']": (metadata["dataset_id"], dataset.id),
        "spec.env_spec": (spec.env_spec, dataset.env_spec),
        "spec.data_path": (spec.data_path, str(dataset.storage.data_path)),
        "metadata['total_episodes']": (metadata["total_episodes"], dataset.storage.total_episodes),
    }
    for name, (got, expected) in pairs.items():
        if got != expected:
            raise Broken(f"{name} is {got!r}, the dataset says {expected!r}")
    return len(pairs)


def determinism(subject: Subject) -> int:
    """Reading again gives the same, in iterators that run at the same time and in another order."""
    count = len(subject.numbers)
    first, second = (subject.dataset.iterate_episodes(subject.numbers) for _ in range(2))
    for position, (left, right) in enumerate(zip(first, second, strict=True)):
        subject.expect_equal(left, position, "one of two iterators side by side")
        subject.expect_equal(right, position, "the other of two iterators side by side")
    backwards = subject.dataset.iterate_episodes(subject.numbers[::-1])
    for position, episode in zip(reversed(range(count)), backwards, strict=True):
        subject.expect_equal(episode, position, "reading backwards")
    return 3 * count


def index_kinds(subject: Subject) -> int:
    """Lists, arrays, tuples and generators of ids give the same episodes, in the order asked for."""
    numbers = subject.numbers
    kinds: dict[str, Iterable[int]] = {
        "an array of ids": np.array(numbers, dtype=np.int64),
        "a tuple of ids": tuple(numbers),
    }
    if isinstance(subject.dataset, AugmentedDataset):  # Minari's own arrow storage gives nothing for a generator
        kinds["a generator of ids"] = (number for number in numbers)
    for name, indices in kinds.items():
        got = list(subject.dataset.iterate_episodes(indices))
        if len(got) != len(numbers):
            raise Broken(f"{name} gives {len(got)} episodes, expected {len(numbers)}")
        for position, episode in enumerate(got):
            subject.expect_equal(episode, position, name)
    return len(kinds) * len(numbers)


def indexing(subject: Subject) -> int:
    """dataset[i] is the i-th episode, also from the end."""
    total = len(subject.dataset)
    for place, position in enumerate(subject.positions):
        subject.expect_equal(subject.dataset[position], place, f"dataset[{position}]")
        subject.expect_equal(subject.dataset[position - total], place, f"dataset[{position - total}]")
    return 2 * len(subject.positions)


def bounds(subject: Subject) -> int:
    """An index beyond either end is an IndexError."""
    total = len(subject.dataset)
    for index in (total, -total - 1):
        try:
            subject.dataset[index]
        except IndexError:
            continue
        raise Broken(f"dataset[{index}] of {total} episodes is no IndexError")
    return 2


def storage_reads(subject: Subject) -> int:
    """storage.get_episodes and storage.apply give what the dataset gives."""
    storage = subject.dataset.storage
    for position, data in enumerate(storage.get_episodes(subject.numbers)):
        subject.expect_equal(EpisodeData(**data), position, "storage.get_episodes")
    applied = list(storage.apply(lambda data: (int(data["id"]), len(data["rewards"])), subject.numbers))
    expected = [(int(episode.id), len(episode.rewards)) for episode in subject.episodes]
    if applied != expected:
        raise Broken(f"storage.apply gives (id, steps) {applied[:3]}..., expected {expected[:3]}...")
    return 2 * len(subject.numbers)


def sampling(subject: Subject) -> int:
    """sample_episodes draws from the view without repeats, and set_seed repeats the draw."""
    draws: list[list[int]] = []
    amount = min(len(subject.dataset), 5)
    for _ in range(2):
        twin = copy.copy(subject.dataset)  # the seed of the user's own stays as it is
        twin.set_seed(0)
        draws.append([int(episode.id) for episode in twin.sample_episodes(amount)])
    if draws[0] != draws[1]:
        raise Broken(f"after set_seed(0) the draw is {draws[0]}, and then {draws[1]}")
    if len(set(draws[0])) != amount or not set(draws[0]) <= set(map(int, subject.dataset.episode_indices)):
        raise Broken(f"a draw of {amount} gives {draws[0]}")
    return amount


def views(subject: Subject) -> int:
    """filter_episodes and user-set episode_indices give views of the same kind, in their order."""
    twin = copy.copy(subject.dataset)
    twin.episode_indices = np.array(subject.numbers, dtype=np.int64)
    lengths = [len(episode.rewards) for episode in subject.episodes]
    limit = sorted(lengths)[len(lengths) // 2]
    view = twin.filter_episodes(lambda episode: len(episode.rewards) <= limit)
    kept = [place for place, length in enumerate(lengths) if length <= limit]
    if type(view) is not type(subject.dataset):
        raise Broken(f"filter_episodes of a {type(subject.dataset).__name__} gives a {type(view).__name__}")
    _expect_view(view, kept, subject, "filter_episodes")
    twin.episode_indices = np.array(subject.numbers[::-1], dtype=np.int64)
    _expect_view(twin, list(reversed(range(len(lengths)))), subject, "setting episode_indices")
    return 2


def _expect_view(view: MinariDataset, kept: list[int], subject: Subject, how: str) -> None:
    if len(view) != len(kept):
        raise Broken(f"{how} keeps {len(view)} episodes, expected {len(kept)}")
    steps = sum(len(subject.episodes[place].rewards) for place in kept)
    if view.total_steps != steps:
        raise Broken(f"the view of {how} has {view.total_steps} total steps, expected {steps}")
    for place, episode in zip(kept, view, strict=True):
        subject.expect_equal(episode, place, f"the view of {how}")


def aliasing(subject: Subject) -> int:
    """Two reads share no memory, so that changing one episode changes no other."""
    again = subject.dataset.iterate_episodes(subject.numbers)
    metadata = subject.dataset.storage.get_episode_metadata(subject.numbers)
    for number, left, right in zip(subject.numbers, subject.metadata, metadata, strict=True):
        where = shared_leaf(left, right, "metadata")
        if where:
            raise Broken(f"two reads of the metadata of episode {number} share {where}")
    for left, right in zip(subject.episodes, again, strict=True):
        for name in FIELDS:
            where = shared_leaf(getattr(left, name), getattr(right, name), name)
            if where:
                raise Broken(f"two reads of episode {left.id} share the memory of {where}")
    return len(subject.episodes)


def random_state(subject: Subject) -> int:
    """Reading leaves NumPy's global random state alone."""
    before = _global_state()
    for _ in subject.dataset.iterate_episodes(subject.numbers):
        pass
    if _global_state() != before:
        raise Broken("reading episodes moved NumPy's global random state")
    return 1


def _global_state() -> bytes:
    return pickle.dumps(np.random.get_state())  # noqa: NPY002


def pickling(subject: Subject) -> int:
    """A pickled dataset comes back as the same dataset."""
    if isinstance(subject.dataset, AugmentedDataset) and subject.dataset.storage.synthesis is not None:
        try:
            pickle.dumps(subject.dataset.augmenter)
        except (pickle.PicklingError, AttributeError, TypeError) as error:
            raise NotApplicable(f"the augmenter cannot be pickled: {error}") from None
    return _expect_twin(lambda data: pickle.loads(pickle.dumps(data)), subject, "unpickling")  # noqa: S301


def deep_copy(subject: Subject) -> int:
    """A deep copy is the same dataset."""
    return _expect_twin(copy.deepcopy, subject, "a deep copy")


def _expect_twin(function: Callable[[MinariDataset], MinariDataset], subject: Subject, how: str) -> int:
    twin = function(subject.dataset)
    if type(twin) is not type(subject.dataset) or not np.array_equal(
        twin.episode_indices, subject.dataset.episode_indices
    ):
        raise Broken(f"{how} gives a {type(twin).__name__} of other episodes")
    for place, episode in enumerate(twin.iterate_episodes(subject.numbers)):
        subject.expect_equal(episode, place, how)
    return len(subject.numbers)


def splitting(subject: Subject) -> int:
    """minari.split_dataset gives parts that share the episodes out."""
    dataset = subject.dataset
    sizes = [len(dataset) // 2, len(dataset) - len(dataset) // 2]
    parts = minari.split_dataset(dataset, sizes, seed=0)
    got = sorted(int(number) for part in parts for number in part.episode_indices)
    if got != sorted(map(int, dataset.episode_indices)):
        raise Broken(f"the parts of split_dataset hold the ids {got[:5]}..., not those of the dataset")
    part = copy.copy(parts[1])
    part.episode_indices = np.array(subject.numbers[:1], dtype=np.int64)
    subject.expect_equal(part[0], 0, "a part of split_dataset")
    return len(got)


READ = ("ids", "size", "determinism")
ACCESS_CHECKS: tuple[Check[Subject], ...] = (
    Check("ids", "ids are unique, known, and those asked for", ids, ("readable",)),
    Check("size", "the numbers of episodes agree", size, ("ids",)),
    Check("metadata-steps", "metadata has the episode's id and steps", metadata_steps, ("ids", "t-plus-one")),
    Check("total-steps", "total_steps is the sum over episodes", total_steps, ("metadata-steps",)),
    Check("specification", "dataset, spec and metadata agree", specification, ("ids",)),
    Check("determinism", "reading again gives the same", determinism, ("ids",)),
    Check("index-kinds", "any iterable of ids is accepted", index_kinds, READ),
    Check("indexing", "dataset[i] is the i-th episode", indexing, READ),
    Check("bounds", "an index out of range is an IndexError", bounds, READ),
    Check("storage", "the storage gives what the dataset gives", storage_reads, READ),
    Check("sampling", "set_seed decides sample_episodes", sampling, READ),
    Check("views", "views keep type, order and steps", views, (*READ, "total-steps")),
    Check("aliasing", "reads share no memory", aliasing, READ),
    Check("random-state", "global random state is not touched", random_state, ("readable",)),
    Check("pickling", "pickling keeps the dataset", pickling, READ),
    Check("deep-copy", "deep copies are the dataset", deep_copy, READ),
    Check("splitting", "split_dataset shares the episodes out", splitting, READ),
)
