"""Minari's own behaviours on every space that it stores, in its three formats, with and without synthetic episodes."""

import copy
import gc
import multiprocessing
import os
import pickle
import shutil
import subprocess
import sys
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import gymnasium
import minari
import numpy as np
import pytest
from gymnasium import spaces
from minari import EpisodeData, MinariDataset
from minari.cli import app
from minari.data_collector import EpisodeBuffer
from typer.testing import CliRunner

from oat_gym import AugmentedDataset, Function
from oat_gym.checks import check_dataset
from oat_gym.errors import InvalidDataError

FORMATS = ("hdf5", "arrow", "parquet")
LENGTHS = [2, 4, 1, 3]
TEXT = spaces.Text(8, min_length=0, charset="abcé 1")
SPACES: dict[str, tuple[spaces.Space, spaces.Space]] = {
    "float": (spaces.Box(-np.inf, np.inf, (3,), np.float32), spaces.Box(-1, 1, (2, 2), np.float64)),
    "integer": (spaces.Box(-9, 9, (2,), np.int16), spaces.Box(-5, 5, (), np.int64)),
    "image": (spaces.Box(0, 255, (40, 40, 3), np.uint8), spaces.Discrete(4)),
    "discrete": (spaces.Discrete(5, start=-2), spaces.MultiDiscrete([2, 3])),
    "binary": (spaces.MultiBinary(4), spaces.MultiBinary((2, 2))),
    "text": (TEXT, TEXT),
    "nested": (
        spaces.Dict(
            camera=spaces.Box(0, 255, (40, 40, 3), np.uint8),
            word=TEXT,
            parts=spaces.Tuple((spaces.Discrete(3), spaces.Dict(x=spaces.Box(-1, 1, (2,)), y=spaces.MultiBinary(2)))),
        ),
        spaces.Tuple((spaces.Box(-1, 1, (1,)), spaces.Dict(gear=spaces.Discrete(3), say=TEXT))),
    ),
}
MODES = ("count=0", "identity")


def identity(episode: EpisodeData, rng: np.random.Generator) -> EpisodeData:
    return episode


def batch(space: spaces.Space, rows: int) -> Any:
    """Return `rows` samples of a space, in the form in which Minari stores them."""
    if isinstance(space, spaces.Dict):
        return {key: batch(child, rows) for key, child in space.spaces.items()}
    if isinstance(space, spaces.Tuple):
        return tuple(batch(child, rows) for child in space.spaces)
    samples = [space.sample() for _ in range(rows)]
    return samples if isinstance(space, spaces.Text) else np.stack(samples).astype(space.dtype)


def buffer(
    number: int, length: int, observation_space: spaces.Space, action_space: spaces.Space, *, infos: bool = True
) -> EpisodeBuffer:
    observation_space.seed(number)
    action_space.seed(number)
    steps = np.arange(length + 1)
    return EpisodeBuffer(
        seed=number,
        options={"goal": {"row": number}, "start": np.array([number, 1])},
        observations=batch(observation_space, length + 1),
        actions=batch(action_space, length),
        rewards=1000.0 * number + steps[:-1],
        terminations=(steps[:-1] == length - 1) & (number % 2 == 0),
        truncations=(steps[:-1] == length - 1) & (number % 2 == 1),
        infos={
            "clock": list(1000.0 * number + steps),
            "word": [f"w{number}-{step}" for step in steps],
            "nested": {"twice": np.stack([steps, steps], axis=1).astype(np.float32)},
        }
        if infos
        else None,
    )


def create(dataset_id: str, kind: str, data_format: str, *, infos: bool = True) -> MinariDataset:
    observation_space, action_space = SPACES[kind]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        dataset = minari.create_dataset_from_buffers(
            dataset_id,
            [
                buffer(number, length, observation_space, action_space, infos=infos)
                for number, length in enumerate(LENGTHS)
            ],
            observation_space=observation_space,
            action_space=action_space,
            data_format=data_format,
        )
    dataset.storage.update_episode_metadata([{"note": f"n{number}", "level": number} for number in range(4)])
    return dataset


def augmented(real: MinariDataset, mode: str) -> AugmentedDataset:
    return AugmentedDataset(real, count=0) if mode == "count=0" else AugmentedDataset(real, Function(identity), count=6)


def plain(value: Any) -> Any:
    """Return a batch or infos as nested lists, so that any two can be compared with ==."""
    if isinstance(value, dict):
        return {key: plain(part) for key, part in value.items()}
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, list | tuple):
        return [plain(part) for part in value]
    return value.decode() if isinstance(value, bytes) else value


def content(episode: EpisodeData) -> dict[str, Any]:
    return {key: plain(value) for key, value in vars(episode).items() if key != "id"}


@pytest.fixture(params=[(kind, name) for kind in SPACES for name in FORMATS], ids="-".join)
def real(request: pytest.FixtureRequest) -> MinariDataset:
    return create("test/real-v0", *request.param)


@pytest.mark.parametrize("mode", MODES)
def test_the_contract_holds_and_it_reads_as_minari_reads(real: MinariDataset, mode: str) -> None:
    data = augmented(real, mode)
    report = check_dataset(data)
    assert len(report.passed) >= 37
    total = 4 if mode == "count=0" else 10
    assert (len(data), data.total_steps) == (total, 10 if total == 4 else 10 + 10 + 6)
    originals = [content(episode) for episode in real]
    for number, episode in enumerate(data):
        assert content(episode) == originals[number % 4]
    for asked in ([2, 0], np.array([2, 0]), (2, 0), (number for number in (2, 0)), iter(np.array([2, 0]))):
        assert [int(episode.id) for episode in data.iterate_episodes(asked)] == [2, 0]
    pairs = [(int(a.id), int(b.id)) for a in data for b in data.iterate_episodes([3, 1])]
    assert pairs == [(i, j) for i in range(total) for j in (3, 1)]  # nested loops over one dataset
    with ThreadPoolExecutor(4) as pool:
        read = list(pool.map(lambda number: content(data[number]), range(total)))
    assert read == [originals[number % 4] for number in range(total)]
    metadata = list(data.storage.get_episode_metadata(iter(range(total))))
    for number, part in enumerate(metadata):
        assert (part["id"], part["total_steps"]) == (number, LENGTHS[number % 4])
        assert (part["seed"], plain(part["options"])) == (
            number % 4,
            {"goal": {"row": number % 4}, "start": [number % 4, 1]},
        )
        assert (part["note"], part["level"]) == (f"n{number % 4}", number % 4)


@pytest.mark.parametrize("mode", MODES)
def test_appending_goes_to_an_overlay(real: MinariDataset, mode: str) -> None:
    before = {path: path.read_bytes() for path in real.storage.data_path.rglob("*") if path.is_file()}
    data = augmented(real, mode)
    total = len(data)
    part = minari.split_dataset(data, [2], seed=0)[0]
    twin = copy.deepcopy(data)
    for number in (9, 10):
        data.update_dataset_from_buffer([buffer(number, 5, *SPACES[_kind(real)])])
    assert (len(data), data.storage.total_episodes) == (total + 2, total + 2)
    assert data[total].rewards.tolist() == (9000.0 + np.arange(5)).tolist()
    assert [int(episode.id) for episode in data[total:]] == [total, total + 1]
    assert next(iter(data.storage.get_episode_metadata([total])))["seed"] == 9
    check_dataset(data)
    # what else reads this directory sees the new episodes, and can add to them
    for other in (part, twin):
        assert next(other.iterate_episodes([total])).rewards[0] == 9000.0
    twin.update_dataset_from_buffer([buffer(11, 2, *SPACES[_kind(real)])])
    assert next(data.iterate_episodes([total + 2])).rewards.tolist() == [11000.0, 11001.0]
    assert {path: path.read_bytes() for path in real.storage.data_path.rglob("*") if path.is_file()} == before


def _kind(real: MinariDataset) -> str:
    return next(kind for kind, pair in SPACES.items() if pair == (real.observation_space, real.action_space))


@pytest.mark.parametrize("export", FORMATS)
def test_saved_views_keep_content_metadata_and_infos(real: MinariDataset, export: str) -> None:
    data = augmented(real, "identity")
    view = data.filter_episodes(lambda episode: len(episode) > 1)
    assert isinstance(view, AugmentedDataset)
    saved = view.save("test/saved-v0", data_format=export)
    assert len(saved) == len(view) == 8
    for got, made in zip(saved, view, strict=True):
        expected = content(made)
        assert content(got) | {"infos": None} == expected | {"infos": None}
        assert _infos(got) == _infos(made)
    fields = ("seed", "options", "note", "level", "synthetic", "variation", "spans")
    stored = saved.storage.get_episode_metadata(range(8))
    for got, made in zip(stored, view.storage.get_episode_metadata(view.episode_indices), strict=True):
        assert {key: plain(got[key]) for key in fields} == {key: plain(made[key]) for key in fields}
        assert view.episode_indices[got["source"]] == made["source"]  # the copy counts anew
    check_dataset(saved)


def _infos(episode: EpisodeData) -> Any:
    nested = episode.infos["nested"]
    twice = nested["twice"] if isinstance(nested, dict) else [row["twice"] for row in nested]
    return plain(episode.infos["clock"]), plain(episode.infos["word"]), plain(np.array(twice).tolist())


# Views, randomness, copies: one space is enough ------------------------------------------------------------------


@pytest.fixture(params=FORMATS)
def small(request: pytest.FixtureRequest) -> MinariDataset:
    return create("test/small-v0", "nested", request.param)


@pytest.mark.parametrize("mode", MODES)
def test_views_and_samples(small: MinariDataset, mode: str) -> None:
    data = augmented(small, mode)
    draws = []
    for _ in range(2):
        data.set_seed(3)
        draws.append([[int(episode.id) for episode in data.sample_episodes(3)] for _ in range(2)])
    small.set_seed(3)
    assert draws[0] == draws[1]
    if mode == "count=0":  # the very draw of Minari
        assert draws[0][0] == [int(episode.id) for episode in small.sample_episodes(3)]
    with pytest.raises(ValueError, match="larger"):
        data.sample_episodes(len(data) + 1)
    view = data.filter_episodes(lambda episode: episode.rewards[0] >= 1000)
    assert {int(episode.id) for episode in view.sample_episodes(len(view))} == set(view.episode_indices.tolist())
    again = view.filter_episodes(lambda episode: len(episode) == 1)
    assert set(again.episode_indices.tolist()) == ({2} if mode == "count=0" else {2, 6})
    empty = view.filter_episodes(lambda episode: False)
    assert (len(empty), empty.total_steps, list(empty)) == (0, 0, [])
    data.episode_indices = np.array([3, 1])
    assert (len(data), data.total_steps, data.spec.total_episodes) == (2, 7, 2)
    assert [int(episode.id) for episode in data] == [3, 1]
    assert int(data[-1].id) == 1
    assert len(list(data.storage.apply(lambda episode: episode["id"]))) == (4 if mode == "count=0" else 10)


def test_a_view_changed_later_does_not_change_what_was_augmented(small: MinariDataset) -> None:
    view = small.filter_episodes(lambda episode: len(episode) > 1)
    data = AugmentedDataset(view, Function(identity), count=3)
    expected = [content(episode) for episode in data]
    dumped = pickle.dumps(data)
    view.episode_indices = np.array([2])
    assert [content(episode) for episode in data] == expected
    for twin in (pickle.loads(pickle.dumps(data)), pickle.loads(dumped), copy.deepcopy(data)):
        assert [content(episode) for episode in twin] == expected


def test_a_spawned_process_reads_the_same() -> None:
    data = augmented(create("test/small-v0", "nested", "hdf5"), "identity")
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        assert pool.apply(_read, (data,)) == _read(data)


def _read(data: AugmentedDataset) -> list[dict[str, Any]]:
    return [content(episode) for episode in data]


@pytest.mark.parametrize("data_format", FORMATS)
def test_minari_combines_and_splits(data_format: str) -> None:
    # without infos: Minari's arrow storage cannot combine two datasets of its own that have strings or nested ones
    small = create("test/small-v0", "nested", data_format, infos=False)
    data = augmented(small, "identity")
    combined = minari.combine_datasets([data, small], "test/combined-v0")
    assert (len(combined), combined.total_steps) == (14, 26 + 10)
    assert combined.storage.FORMAT == small.storage.FORMAT
    assert [episode.rewards[0] for episode in combined] == [1000.0 * (number % 4) for number in range(10)] + [
        0.0,
        1000.0,
        2000.0,
        3000.0,
    ]
    parts = minari.split_dataset(data, [4, 6], seed=1)
    for part in parts:
        assert all(
            content(a) == content(b) for a, b in zip(part, data.iterate_episodes(part.episode_indices), strict=True)
        )


def test_metadata_handed_out_is_a_copy(small: MinariDataset) -> None:
    data = augmented(small, "identity")
    for number in (1, 5):
        metadata = next(iter(data.storage.get_episode_metadata([number])))
        metadata["options"]["goal"]["row"] = "changed"
        again = next(iter(data.storage.get_episode_metadata([number])))
        assert again["options"]["goal"]["row"] == 1
    with pytest.raises(IndexError, match="no episode 10"):
        data.storage.update_episode_metadata([{"note": 1}], [10])


def test_nested_infos_handed_out_are_a_copy(small: MinariDataset) -> None:
    data = augmented(small, "identity")
    data.fit()
    data[4]  # the source is in memory from here on
    for number in (0, 4):
        nested = data[number].infos["nested"]
        (nested if isinstance(nested, dict) else nested[0])["twice"] = "changed"
        assert _infos(data[number]) == _infos(small[0])


def test_keys_of_the_users_that_are_also_ours_are_kept_under_another_name(small: MinariDataset) -> None:
    small.storage.update_episode_metadata([{"source": f"camera {n}", "spans": "all"} for n in range(4)])
    with pytest.warns(UserWarning, match="renamed, with 'original_'"):
        data = augmented(small, "identity")
    for number, metadata in enumerate(data.storage.get_episode_metadata(range(10))):
        assert (metadata["original_source"], metadata["original_spans"]) == (f"camera {number % 4}", "all")
        assert metadata["source"] == number % 4
    assert data.provenance(5).synthetic
    saved = data.save("test/saved-v0")
    assert [part["original_source"] for part in saved.storage.get_episode_metadata([5])] == ["camera 1"]


def test_metadata_that_lies_about_lengths_is_an_error() -> None:
    real = create("test/real-v0", "float", "arrow")
    path = real.storage.data_path / "1" / "metadata.json"
    path.write_text(path.read_text().replace('"total_steps": 4', '"total_steps": 3'))
    data = AugmentedDataset(minari.load_dataset("test/real-v0"), count=0)
    with pytest.raises(InvalidDataError, match="gives 4 steps where its metadata says 3"):
        data[1]


# Environments, scores, collectors, the command line --------------------------------------------------------------

_ENTRY = "gymnasium.envs.classic_control.cartpole:CartPoleEnv"


def _cart_episode(number: int, rng: np.random.Generator) -> EpisodeBuffer:
    return EpisodeBuffer(
        seed=number,
        observations=rng.uniform(-0.4, 0.4, size=(5, 4)).astype(np.float32),
        actions=rng.integers(0, 2, size=4),
        rewards=np.ones(4),
        terminations=np.arange(4) == 3,
        truncations=np.zeros(4, dtype=bool),
    )


def collect(data_format: str) -> MinariDataset:
    spec = gymnasium.envs.registration.EnvSpec("CartPole-v1", entry_point=_ENTRY)
    evaluation = copy.deepcopy(spec)
    evaluation.max_episode_steps = 77
    rng = np.random.default_rng(0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return minari.create_dataset_from_buffers(
            "test/cart-v0",
            [_cart_episode(number, rng) for number in range(3)],
            env=spec,
            eval_env=evaluation,
            ref_min_score=-1.0,
            ref_max_score=9.0,
            author={"a", "b"},
            requirements=["numpy>=1"],
            data_format=data_format,
        )


@pytest.mark.parametrize("data_format", FORMATS)
@pytest.mark.parametrize("mode", MODES)
def test_environments_and_scores(data_format: str, mode: str) -> None:
    real = collect(data_format)
    data = augmented(real, mode)
    for dataset in (data, data.save("test/copy-v0", data_format=data_format)):
        assert dataset.env_spec == real.env_spec
        assert dataset.spec.env_spec == real.spec.env_spec
        assert dataset.recover_environment().spec == real.recover_environment().spec
        assert dataset.recover_environment(eval_env=True).spec.max_episode_steps == 77
        np.testing.assert_array_equal(
            minari.get_normalized_score(dataset, np.array([-1.0, 4.0, 9.0])), np.array([0.0, 0.5, 1.0])
        )
        assert dataset.storage.metadata["author"] == {"a", "b"}
        assert dataset.observation_space == real.observation_space


def test_an_environment_that_is_not_installed_is_told() -> None:
    data = augmented(collect("hdf5"), "count=0")
    path = data.storage.data_path / "metadata.json"
    path.write_text(path.read_text().replace("gymnasium.envs.classic_control.cartpole:", "no_such_module:"))
    with pytest.raises(ModuleNotFoundError, match="no_such_module"):
        MinariDataset(data.storage.data_path).recover_environment()


@pytest.mark.filterwarnings("ignore:Implicitly cleaning up:ResourceWarning")
@pytest.mark.parametrize("data_format", FORMATS)
def test_a_data_collector_adds_to_it(data_format: str, monkeypatch: pytest.MonkeyPatch) -> None:
    data = augmented(collect(data_format), "identity")
    monkeypatch.setitem(sys.modules, "jax", _Jax)
    monkeypatch.setitem(sys.modules, "jax.tree_util", _Jax.tree_util)
    env = minari.DataCollector(gymnasium.make("CartPole-v1"), data_format=data_format)
    for seed in (1, 2):
        env.reset(seed=seed)
        done = False
        while not done:
            _, _, terminated, truncated, _ = env.step(env.action_space.sample())
            done = terminated or truncated
    env.add_to_dataset(data)
    env.close()
    del env
    gc.collect()  # Minari's collector leaves its temporary folders to the garbage collector, which warns
    assert (len(data), data.storage.total_episodes) == (11, 11)
    assert data[9].terminations[-1]
    assert len(data.source) == 3
    check_dataset(data)


class _Jax:
    """What `EpisodeBuffer.add_step_data` uses of jax, which only minari[create] installs."""

    class tree_util:  # noqa: N801
        @staticmethod
        def tree_map(function: Callable[..., Any], tree: Any, *others: Any) -> Any:
            if isinstance(tree, dict):
                return {key: _Jax.tree_util.tree_map(function, tree[key], *(o[key] for o in others)) for key in tree}
            return function(tree, *others)


@pytest.mark.parametrize("data_format", FORMATS)
def test_minaris_command_line_reads_a_saved_one(data_format: str, monkeypatch: pytest.MonkeyPatch) -> None:
    small = create("test/small-v0", "nested", data_format, infos=False)
    data = augmented(small, "identity")
    data.save("test/one-v0", data_format=small.storage.FORMAT)
    data.save("test/two-v0", data_format=small.storage.FORMAT)
    runner = CliRunner()
    monkeypatch.setenv("COLUMNS", "300")
    for command, expected in (
        (["list", "local"], "one"),
        (["show", "test/one-v0"], "test/one-v0"),
        (["combine", "test/one-v0", "test/two-v0", "--dataset-id", "test/both-v0"], "test/both-v0"),
    ):
        result = runner.invoke(app, command)
        assert result.exit_code == 0, (command, result.output, result.exception)
        assert expected in result.output
    assert len(minari.load_dataset("test/both-v0")) == 20


def test_the_installed_command_reads_a_saved_one(small: MinariDataset) -> None:
    augmented(small, "identity").save("test/one-v0")
    command = shutil.which("minari", path=os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]]))
    assert command is not None
    run = subprocess.run([command, "list", "local"], capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    assert "one-v0" in run.stdout
