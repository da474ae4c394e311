"""AugmentedDataset as a Minari dataset, with an augmenter that needs no training."""

import copy
import itertools
import json
import pickle
import platform
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import minari
import numpy as np
import pytest
from gymnasium import spaces
from minari import EpisodeData
from minari.dataset import _storages

import oat_gym
from oat_gym import AugmentedDataset, Function
from oat_gym._staging import owned_folder
from oat_gym.errors import ConfigurationError, InvalidDataError, SourceChangedError
from oat_gym.storage import AugmentedStorage

MakeDataset = Callable[..., minari.MinariDataset]
LENGTHS = [3, 7, 1, 5]


def shuffled_rewards(episode: EpisodeData, rng: np.random.Generator) -> EpisodeData:
    episode.rewards[:] = rng.permutation(episode.rewards) + rng.uniform(0.1, 0.2)
    return episode


def same(left: EpisodeData, right: EpisodeData) -> bool:
    return left.id == right.id and _same_tree(vars(left), vars(right))


def _same_tree(left: object, right: object) -> bool:
    if isinstance(left, dict):
        return left.keys() == right.keys() and all(_same_tree(left[key], right[key]) for key in left)
    if isinstance(left, np.ndarray):
        return left.dtype == right.dtype and np.array_equal(left, right)
    return left == right


@pytest.mark.parametrize("data_format", ["hdf5", "arrow", "parquet"])
def test_the_first_episodes_are_the_sources_byte_for_byte(make_dataset: MakeDataset, data_format: str) -> None:
    real = make_dataset(LENGTHS, data_format=data_format)
    for count in (0, 5):
        data = AugmentedDataset(real, Function(shuffled_rewards), count=count)
        for fitted in (False, True):
            assert all(_same_tree(_plain(a), _plain(b)) for a, b in zip(data[0:4], real, strict=True)), fitted
            data.fit()


def _plain(episode: EpisodeData) -> dict[str, object]:
    """Return the fields in a form that compares object arrays of dictionaries (arrow's nested infos) too."""
    return {
        key: value.tolist() if _is_object(value) else value for key, value in vars(episode).items() if key != "infos"
    }


def _is_object(value: object) -> bool:
    return isinstance(value, np.ndarray) and value.dtype == object


def test_lengths_and_steps_are_known_without_generating(make_dataset: MakeDataset) -> None:
    def fail(episode: EpisodeData, rng: np.random.Generator) -> EpisodeData:
        raise AssertionError("nothing may be generated")

    data = AugmentedDataset(make_dataset(LENGTHS), Function(fail), factor=3)
    assert (len(data), data.total_episodes, data.total_steps) == (12, 12, 48)
    assert data.spec.total_steps == 48
    assert data.storage.total_episodes == 12
    assert not data.is_fitted
    assert "4 real + 8 synthetic" in repr(data)


@pytest.mark.parametrize(("kwargs", "count"), [({}, 36), ({"factor": 1}, 0), ({"factor": 2.5}, 6), ({"count": 3}, 3)])
def test_factor_and_count(make_dataset: MakeDataset, kwargs: dict[str, float], count: int) -> None:
    assert len(AugmentedDataset(make_dataset(LENGTHS), Function(shuffled_rewards), **kwargs)) == 4 + count


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"factor": 0.5}, "factor must be a number of at least 1"),
        ({"factor": float("nan")}, "factor must be"),
        ({"factor": "10"}, "factor must be"),
        ({"count": -1}, "count must be an integer of at least 0"),
        ({"count": 2.5}, "count must be an integer"),
        ({"factor": 2, "count": 2}, "factor or count, not both"),
        ({"seed": -1}, "seed must be a non-negative integer"),
        ({"seed": 1.5}, "seed must be a non-negative integer"),
        ({"augmenter": "oat"}, "augmenter must be"),
        ({"source": 3}, "source must be"),
        ({"source": [{"name": "J. Doe"}]}, r"got a list. Make a dataset of episodes with .{,140}$"),
        ({"source": "nowhere"}, "no dataset id"),
        ({"source": "nowhere/none-v0"}, "minari download nowhere/none-v0"),
    ],
)
def test_bad_arguments_are_named_at_once(make_dataset: MakeDataset, kwargs: dict[str, object], message: str) -> None:
    arguments = {"source": make_dataset(LENGTHS), "augmenter": Function(shuffled_rewards)} | kwargs
    with pytest.raises((ConfigurationError, FileNotFoundError), match=message):
        AugmentedDataset(arguments.pop("source"), arguments.pop("augmenter"), **arguments)


def test_an_empty_dataset_is_refused(make_dataset: MakeDataset) -> None:
    empty = make_dataset(LENGTHS).filter_episodes(lambda episode: False)
    with pytest.raises(InvalidDataError, match="has no episodes"):
        AugmentedDataset(empty, Function(shuffled_rewards))


def test_any_order_of_access_gives_the_same_bytes(make_dataset: MakeDataset) -> None:
    real = make_dataset(LENGTHS)
    first = AugmentedDataset(real, Function(shuffled_rewards), factor=4, seed=3)
    second = AugmentedDataset(real, Function(shuffled_rewards), factor=4, seed=3)
    backwards = {int(episode.id): episode for episode in second.iterate_episodes(iter(range(15, -1, -1)))}
    assert all(same(episode, backwards[int(episode.id)]) for episode in first)
    assert all(same(first[i], first[i]) for i in range(16))
    other = AugmentedDataset(real, Function(shuffled_rewards), factor=4, seed=4)
    assert not same(other[5], first[5])
    assert not np.array_equal(first[4].rewards, first[8].rewards)  # variations of one episode differ


def test_episodes_share_no_memory_with_what_is_kept(make_dataset: MakeDataset) -> None:
    data = AugmentedDataset(make_dataset(LENGTHS), Function(shuffled_rewards), factor=2)
    for number in (1, 5):
        before, again = data[number], data[number]
        again.rewards[:] = -1
        again.observations["position"][:] = -1
        again.infos["nested"]["twice"][:] = -1
        assert same(data[number], before)


def test_global_random_states_are_not_touched(make_dataset: MakeDataset) -> None:
    state = np.random.get_state()[1].copy()  # noqa: NPY002
    list(AugmentedDataset(make_dataset(LENGTHS), Function(shuffled_rewards), factor=2))
    np.testing.assert_array_equal(np.random.get_state()[1], state)  # noqa: NPY002


def test_indexing_as_minari_does(make_dataset: MakeDataset) -> None:
    data = AugmentedDataset(make_dataset(LENGTHS), Function(shuffled_rewards), factor=2, seed=0)
    assert data[-1].id == 7
    assert [episode.id for episode in data[2:5]] == [2, 3, 4]
    assert [episode.id for episode in data.__getitems__([5, 0])] == [5, 0]
    assert [len(episode) for episode in data] == LENGTHS * 2
    assert {int(episode.id) for episode in data.sample_episodes(8)} == set(range(8))
    data.set_seed(0)
    first = [int(episode.id) for episode in data.sample_episodes(3)]
    data.set_seed(0)
    assert [int(episode.id) for episode in data.sample_episodes(3)] == first
    assert list(data.storage.apply(lambda episode: episode["id"], [6, 1])) == [6, 1]
    for wrong in (8, -9):
        with pytest.raises(IndexError):
            data[wrong]
    with pytest.raises(IndexError, match="There is no episode 8"):
        list(data.iterate_episodes([8]))


def test_views_stay_views(make_dataset: MakeDataset) -> None:
    data = AugmentedDataset(make_dataset(LENGTHS), Function(shuffled_rewards), factor=3)
    view = data.filter_episodes(lambda episode: len(episode) > 3)
    assert isinstance(view, AugmentedDataset)
    assert view.episode_indices.tolist() == [1, 3, 5, 7, 9, 11]
    assert view.total_steps == 36
    assert view.provenance(2).source == 1
    assert np.unique(view.transitions().episode).tolist() == list(range(6))
    data.episode_indices = np.array([4, 0])
    assert (len(data), data.total_steps) == (2, 6)
    assert [episode.id for episode in data] == [4, 0]


def test_a_view_of_a_dataset_can_be_augmented(make_dataset: MakeDataset) -> None:
    real = make_dataset(LENGTHS)
    data = AugmentedDataset(
        real.filter_episodes(lambda episode: len(episode) > 3), Function(shuffled_rewards), factor=2
    )
    assert [len(episode) for episode in data] == [7, 5, 7, 5]
    assert [int(episode.id) for episode in data] == [0, 1, 2, 3]
    assert data[0].observations["position"][0, 0] == 1000
    assert data.provenance(3).source == 1


def test_provenance_and_metadata(make_dataset: MakeDataset) -> None:
    data = AugmentedDataset(make_dataset(LENGTHS), Function(shuffled_rewards), factor=3)
    origins = [data.provenance(i) for i in range(12)]
    assert [origin.source for origin in origins] == [0, 1, 2, 3] * 3
    assert [origin.variation for origin in origins] == [None] * 4 + [0] * 4 + [1] * 4
    assert [origin.synthetic for origin in origins] == [False] * 4 + [True] * 8
    assert not origins[1].mask.any()
    assert origins[5].mask.tolist() == [True] * 7
    metadata = list(data.storage.get_episode_metadata([1, 5]))
    assert [part["seed"] for part in metadata] == [1, 1]
    assert [part["options"] for part in metadata] == [{"goal": {"row": 1}}] * 2
    assert metadata[1]["spans"].tolist() == [[0, 7]]
    assert metadata[1]["id"] == 5


def test_transitions_keep_the_t_plus_one_rule(make_dataset: MakeDataset) -> None:
    columns = AugmentedDataset(make_dataset(LENGTHS), Function(lambda e, rng: e), factor=2).transitions()
    assert len(columns) == 32
    expected = 1000.0 * (columns.episode % 4) + columns.step
    np.testing.assert_array_equal(columns.observations["position"][:, 0], expected)
    np.testing.assert_array_equal(columns.next_observations["position"][:, 0], expected + 1)
    np.testing.assert_array_equal(columns.next_observations["mode"], (columns.step + 1) % 3)
    np.testing.assert_array_equal(columns.actions[:, 0], expected + 0.25)
    np.testing.assert_array_equal(columns.rewards, expected)
    np.testing.assert_array_equal(columns.synthetic, columns.episode >= 4)
    last = columns.step == np.array(LENGTHS)[columns.episode % 4] - 1
    np.testing.assert_array_equal(columns.terminated, last & (columns.episode % 2 == 0))
    np.testing.assert_array_equal(columns.truncated, last & (columns.episode % 2 == 1))
    flat = AugmentedDataset(make_dataset([2], dataset_id="test/two-v0"), Function(lambda e, rng: e), count=1)
    assert flat.transitions(flat=True).observations.shape == (4, 5)


def test_appended_episodes_go_to_a_store_of_our_own(make_dataset: MakeDataset) -> None:
    real = make_dataset(LENGTHS)
    data = AugmentedDataset(real, Function(shuffled_rewards), factor=2)
    before = _files(real.storage.data_path)
    data.update_dataset_from_buffer([_buffer(2), _buffer(4)])
    assert (len(data), data.storage.total_episodes) == (10, 10)
    assert (data.total_steps, data.storage.total_steps) == (38, 38)
    assert [len(episode) for episode in data[8:]] == [2, 4]
    assert [int(episode.id) for episode in data[7:]] == [7, 8, 9]
    assert data.provenance(9) == oat_gym.Provenance(False, 9, None, (), 4)
    assert len(data.transitions()) == 38
    assert _files(real.storage.data_path) == before
    with pytest.raises(InvalidDataError, match="ids 0 to 7"):
        data.storage.update_episodes([_buffer(2, number=3)])


def _buffer(length: int, number: int | None = None) -> minari.data_collector.EpisodeBuffer:
    return minari.data_collector.EpisodeBuffer(
        id=number,
        observations={"position": np.zeros((length + 1, 2), np.float32), "mode": np.zeros(length + 1, np.int64)},
        actions=np.zeros((length, 1), np.float32),
        rewards=np.zeros(length),
        terminations=np.zeros(length, bool),
        truncations=np.arange(length) == length - 1,
        infos={"clock": np.zeros(length + 1), "nested": {"twice": np.zeros((length + 1, 2))}},
    )


def _files(folder: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def test_metadata_edits_stay_ours(make_dataset: MakeDataset) -> None:
    real = make_dataset(LENGTHS)
    before = _files(real.storage.data_path)
    data = AugmentedDataset(real, Function(shuffled_rewards), factor=2)
    data.storage.update_episode_metadata([{"note": np.arange(2)}, {"note": "x"}], [1, 6])
    assert [part.get("note") for part in data.storage.get_episode_metadata([0, 1, 6])] == [None, [0, 1], "x"]
    data.storage.update_metadata({"description": "mine"})
    assert data.storage.metadata["description"] == "mine"
    with pytest.raises(ValueError, match="different lengths"):
        data.storage.update_episode_metadata([{}], [0, 1])
    assert _files(real.storage.data_path) == before


def test_minari_splits_and_combines_it(make_dataset: MakeDataset) -> None:
    real = make_dataset(LENGTHS)
    data = AugmentedDataset(real, Function(shuffled_rewards), factor=3)
    parts = minari.split_dataset(data, [5, 7], seed=0)
    assert sorted(int(i) for part in parts for i in part.episode_indices) == list(range(12))
    assert sum(part.total_steps for part in parts) == 48
    assert all(same(episode, data[int(episode.id)]) for part in parts for episode in part)
    both = minari.combine_datasets([data, real], "combined-v0")
    assert len(both) == 16
    np.testing.assert_array_equal(both[7].rewards, data[7].rewards)


def test_it_is_pickled_and_copied(make_dataset: MakeDataset) -> None:
    data = AugmentedDataset(make_dataset(LENGTHS), Function(shuffled_rewards), factor=2, seed=1)
    view = data.filter_episodes(lambda episode: len(episode) > 1)
    for twin in (copy.deepcopy(view), pickle.loads(pickle.dumps(view))):
        assert isinstance(twin, AugmentedDataset)
        assert all(same(a, b) for a, b in zip(twin, view, strict=True))


def test_it_is_augmented_twice(make_dataset: MakeDataset) -> None:
    once = AugmentedDataset(make_dataset(LENGTHS), Function(shuffled_rewards), factor=2)
    twice = AugmentedDataset(once, Function(lambda episode, rng: episode), factor=2)
    assert len(twice) == 16
    assert all(same(a, b) for a, b in zip(twice[0:8], once, strict=True))
    assert [twice.provenance(i).synthetic for i in (0, 5, 8)] == [False, True, True]
    assert twice.provenance(5).source == 1


def test_temporary_directories_go_with_the_dataset(make_dataset: MakeDataset) -> None:
    data = AugmentedDataset(make_dataset(LENGTHS), Function(shuffled_rewards), factor=2)
    view = data.filter_episodes(lambda episode: True)
    path = data.storage.data_path
    del data
    assert path.exists()
    assert len(list(view)) == 8
    del view
    assert not path.exists()


def test_the_format_is_registered_as_minari_does() -> None:
    assert _storages.get_minari_storage("oat") is AugmentedStorage
    assert AugmentedStorage.FORMAT == "oat"
    assert set(_storages.get_storage_keys()) == {"hdf5", "arrow", "parquet", "oat"}


def test_a_storage_of_the_format_is_made_and_filled_by_minari(tmp_path: Path) -> None:
    box = spaces.Box(-1, 1, (1,), dtype=np.float64)
    storage = minari.MinariStorage.new if hasattr(minari, "MinariStorage") else AugmentedStorage.new
    store = storage(tmp_path / "data", observation_space=box, action_space=box, data_format="oat")
    assert store.total_episodes == 0
    rows = np.linspace(-1, 1, 4)[:, None]
    buffer = minari.data_collector.EpisodeBuffer(
        observations=rows, actions=rows[:3], rewards=[1.0] * 3, terminations=[False] * 3, truncations=[False] * 3
    )
    store.update_episodes([buffer])
    again = AugmentedStorage.read(tmp_path / "data")
    assert (again.total_episodes, again.total_steps) == (1, 3)
    np.testing.assert_array_equal(next(iter(again.get_episodes([0])))["observations"], rows)


def test_another_process_is_told_where_a_temporary_dataset_lives(make_dataset: MakeDataset) -> None:
    data = AugmentedDataset(make_dataset(LENGTHS), Function(shuffled_rewards), factor=2)
    script = f"import minari, oat_gym\nminari.MinariDataset({str(data.storage.data_path)!r})"
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert "memory of another process" in run.stderr


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (lambda episode, rng: None, "must return a minari.EpisodeData"),
        (lambda episode, rng: _cut(episode), "expected"),
    ],
)
def test_a_function_that_returns_nonsense_is_told(
    make_dataset: MakeDataset, function: Callable[..., EpisodeData], message: str
) -> None:
    data = AugmentedDataset(make_dataset(LENGTHS), Function(function), count=2)
    with pytest.raises(InvalidDataError, match=message):
        data[5]
    with pytest.raises(ConfigurationError, match="callable"):
        Function(3)


def _cut(episode: EpisodeData) -> EpisodeData:
    return EpisodeData(**(vars(episode) | {"actions": episode.actions[:-1]}))


def test_iterators_without_an_end_are_read_one_by_one(make_dataset: MakeDataset) -> None:
    data = AugmentedDataset(make_dataset(LENGTHS), Function(shuffled_rewards), factor=2)
    endless = data.iterate_episodes(number % 8 for number in itertools.count())
    assert [int(next(endless).id) for _ in range(10)] == [0, 1, 2, 3, 4, 5, 6, 7, 0, 1]


def never(episode: EpisodeData, rng: np.random.Generator) -> EpisodeData:
    raise AssertionError("nothing may be generated")


def test_counting_steps_generates_nothing_in_splits_and_nested_datasets(make_dataset: MakeDataset) -> None:
    data = AugmentedDataset(make_dataset(LENGTHS), Function(never), factor=3)
    assert sum(part.total_steps for part in minari.split_dataset(data, [5, 7], seed=0)) == 48
    twice = AugmentedDataset(data, Function(never), factor=2)
    assert (len(twice), twice.total_steps) == (24, 96)
    metadata = next(iter(data.storage.get_episode_metadata([5])))
    assert (metadata["total_steps"], metadata["seed"]) == (7, 1)
    with pytest.raises(AssertionError, match="nothing may be generated"):
        metadata["spans"]


def test_a_pickle_outlives_the_process_with_all_that_was_added(make_dataset: MakeDataset) -> None:
    data = AugmentedDataset(make_dataset(LENGTHS), Function(shuffled_rewards), factor=2, seed=1)
    data.update_dataset_from_buffer([_buffer(2)])
    data.storage.update_episode_metadata([{"note": "kept"}], [6])
    pickled, episodes = pickle.dumps(data), list(data)
    del data
    twin = pickle.loads(pickled)
    assert all(same(a, b) for a, b in zip(twin, episodes, strict=True))
    assert next(iter(twin.storage.get_episode_metadata([6])))["note"] == "kept"


def test_a_part_of_a_recipe_is_unpickled_by_a_process_that_knows_nothing(
    walk_dataset: minari.MinariDataset, tiny_oat: oat_gym.OAT, tmp_path: Path
) -> None:
    AugmentedDataset(walk_dataset, tiny_oat, factor=2).save("test/lazy-v0", lazy=True)
    part = minari.split_dataset(minari.load_dataset("test/lazy-v0"), [20], seed=0)[0]
    (tmp_path / "part").write_bytes(pickle.dumps(part))
    script = f"import pickle, pathlib\nprint(len(pickle.loads(pathlib.Path({str(tmp_path / 'part')!r}).read_bytes())))"
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert run.stdout.strip() == "20", run.stderr


def test_data_of_another_shape_than_its_space_is_an_error(make_dataset: MakeDataset) -> None:
    real = make_dataset(LENGTHS)
    path = real.storage.data_path / "metadata.json"
    metadata = json.loads(path.read_text())
    metadata["action_space"] = metadata["action_space"].replace('"shape": [1]', '"shape": [7]')
    for key in ("low", "high"):
        space = json.loads(metadata["action_space"])
        space[key] = [space[key][0]] * 7
        metadata["action_space"] = json.dumps(space)
    path.write_text(json.dumps(metadata))
    data = AugmentedDataset(minari.load_dataset("test/coded-v0"), Function(shuffled_rewards), count=0)
    with pytest.raises(InvalidDataError, match=r"actions of shape \(1,\) a step"):
        data[0]


def test_changed_seeds_of_a_source_are_a_changed_source(
    walk_dataset: minari.MinariDataset, tiny_oat: oat_gym.OAT
) -> None:
    AugmentedDataset(walk_dataset, tiny_oat, factor=2).save("test/lazy-v0", lazy=True)
    walk_dataset.storage.update_episode_metadata([{"seed": 999}], [0])
    with pytest.raises(SourceChangedError, match="episode metadata"):
        minari.load_dataset("test/lazy-v0")


def test_folders_of_other_hosts_are_left_alone(tmp_path: Path) -> None:
    dead = 2**22 + 1  # beyond the largest process id
    place = owned_folder("stage-", tmp_path).name.removeprefix("stage-").rsplit("-", 2)[0]
    ours, *others = (tmp_path / f"stage-{name}-{dead}-abc" for name in (place, f"{platform.node()}-gpu", f"{place}7"))
    for folder in (ours, *others):  # another host, and a container of the same name that sees other processes
        folder.mkdir()
    owned_folder("stage-", tmp_path)
    assert not ours.exists()
    assert all(folder.exists() for folder in others)
