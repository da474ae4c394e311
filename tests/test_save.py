"""Saving: in Minari's formats, and as a recipe."""

import dataclasses
import json
import os
from collections.abc import Callable
from pathlib import Path

import minari
import numpy as np
import pytest
from gymnasium import spaces
from minari import EpisodeData
from minari.data_collector import EpisodeBuffer

from oat_gym import OAT, AugmentedDataset, Function, Permutation, read_d4rl, write_d4rl
from oat_gym.errors import (
    AugmentationWarning,
    ConfigurationError,
    DatasetExistsError,
    InvalidDataError,
    SourceChangedError,
)
from oat_gym.ope.logged import Logged
from oat_gym.provenance import Provenance
from tests.conftest import install_dataset, walks

MakeDataset = Callable[..., minari.MinariDataset]
LENGTHS = [3, 7, 1, 5]
BOX2 = spaces.Box(-np.inf, np.inf, (2,))


def same(episode: EpisodeData, rng: np.random.Generator) -> EpisodeData:
    return episode


def noisy(episode: EpisodeData, rng: np.random.Generator) -> EpisodeData:
    episode.rewards[:] += rng.normal(size=len(episode.rewards))
    episode.observations["position"][1:] += rng.normal(size=episode.observations["position"][1:].shape)
    return episode


@pytest.mark.parametrize("source_format", ["hdf5", "arrow", "parquet"])
@pytest.mark.parametrize("data_format", ["hdf5", "arrow", "parquet"])
def test_what_is_loaded_is_what_was_iterated(make_dataset: MakeDataset, source_format: str, data_format: str) -> None:
    data = AugmentedDataset(make_dataset(LENGTHS, data_format=source_format), Function(noisy), factor=3, seed=2)
    data.save("test/saved-v0", data_format=data_format)
    loaded = minari.load_dataset("test/saved-v0")
    assert type(loaded) is minari.MinariDataset
    assert data_format == loaded.storage.FORMAT
    assert (len(loaded), loaded.total_steps) == (12, 48)
    for got, made in zip(loaded, data, strict=True):
        for name in ("actions", "rewards", "terminations", "truncations"):
            np.testing.assert_array_equal(getattr(got, name), getattr(made, name))
            assert getattr(got, name).dtype == getattr(made, name).dtype
        for key in ("position", "mode"):
            np.testing.assert_array_equal(got.observations[key], made.observations[key])
        np.testing.assert_array_equal(got.infos["clock"], made.infos["clock"])
    for got, made in zip(
        loaded.storage.get_episode_metadata(range(12)), data.storage.get_episode_metadata(range(12)), strict=True
    ):
        assert Provenance.from_metadata(got, 0) == Provenance.from_metadata(made, 0)
        assert (got["seed"], got["options"]) == (made["seed"], made["options"])


@pytest.mark.parametrize("data_format", ["arrow", "parquet"])
def test_an_episode_too_long_for_a_format_is_refused(data_format: str) -> None:
    def walk(length: int) -> EpisodeBuffer:
        return EpisodeBuffer(
            observations=np.arange(length + 1, dtype=np.float32)[:, None],
            actions=np.zeros((length, 1), dtype=np.float32),
            rewards=np.arange(length, dtype=np.float64),
            terminations=np.zeros(length, dtype=bool),
            truncations=np.arange(length) == length - 1,
        )

    box = spaces.Box(-np.inf, np.inf, (1,))
    longest = AugmentedDataset(install_dataset("test/long-v0", [walk(32_766)], box, box), Function(same), factor=1)
    loaded = longest.save("test/kept-v0", data_format=data_format)
    np.testing.assert_array_equal(loaded[0].observations, longest[0].observations)
    long = AugmentedDataset(install_dataset("test/long-v1", [walk(3), walk(32_767)], box, box), Function(same))
    message = "Episode 1 has 32767 steps .* Save it with data_format='hdf5'"
    with pytest.raises(InvalidDataError, match=message):
        long.save("test/cut-v0", data_format=data_format)
    assert "test/cut-v0" not in minari.list_local_datasets()


@pytest.mark.parametrize("data_format", ["hdf5", "arrow", "parquet"])
def test_infos_without_a_row_of_the_reset_are_padded_where_they_must_be_and_it_is_told(data_format: str) -> None:
    buffer = EpisodeBuffer(
        observations=np.zeros((5, 1), dtype=np.float32),
        actions=np.zeros((4, 1), dtype=np.float32),
        rewards=np.zeros(4),
        terminations=np.zeros(4, dtype=bool),
        truncations=np.arange(4) == 3,
        infos={"clock": np.arange(1.0, 5.0)},
    )
    box = spaces.Box(-1, 1, (1,))
    data = AugmentedDataset(install_dataset("test/short-v0", [buffer, buffer], box, box), Function(same), factor=2)
    loaded = data.save("test/padded-v0", data_format=data_format)
    for episode, metadata in zip(loaded, loaded.storage.get_episode_metadata(range(4)), strict=True):
        padded = data_format != "hdf5"
        assert metadata.get("infos_rows") == (4 if padded else None)
        assert np.asarray(episode.infos["clock"]).tolist() == [1.0] * padded + [1.0, 2.0, 3.0, 4.0]
    again = AugmentedDataset(loaded, Function(same), factor=1).save("test/again-v0")
    assert np.asarray(again[0].infos["clock"])[-4:].tolist() == [1.0, 2.0, 3.0, 4.0]
    assert next(iter(again.storage.get_episode_metadata([0]))).get("infos_rows") == metadata.get("infos_rows")


def test_steps_are_marked_on_demand(make_dataset: MakeDataset) -> None:
    data = AugmentedDataset(make_dataset(LENGTHS), Function(noisy), factor=2)
    loaded = data.save("test/marked-v0", mark_steps=True)
    for number, episode in enumerate(loaded):
        # infos have a row for the reset before those of the steps
        assert episode.infos["synthetic"].tolist() == [False] + [number >= 4] * len(episode)


def test_a_view_is_saved_as_the_view(make_dataset: MakeDataset) -> None:
    data = AugmentedDataset(make_dataset(LENGTHS), Function(noisy), factor=3)
    view = data.filter_episodes(lambda episode: len(episode) == 5)
    loaded = view.save("test/view-v0")
    assert [len(episode) for episode in loaded] == [5, 5, 5]
    np.testing.assert_array_equal(loaded[2].rewards, data[11].rewards)


@pytest.mark.parametrize("kind", ["minari", "d4rl"])
def test_a_saved_view_counts_the_sources_of_its_copies_anew(tmp_path: Path, kind: str) -> None:
    """Estimators resample real episodes: a copy that names the wrong one would be drawn with it."""
    data = AugmentedDataset(install_dataset("test/walks-v0", walks(4, 5), BOX2, BOX2), Function(same), factor=3)
    view = data.filter_episodes(lambda episode: episode.id % 4 != 0)
    in_minari = kind == "minari"
    saved = view.save("test/view-v0") if in_minari else read_d4rl(write_d4rl(view, tmp_path / "view.hdf5"))
    assert Logged.of(saved).unit.tolist() == Logged.of(view).unit.tolist() == [0, 1, 2] * 3
    for number, metadata in enumerate(saved.storage.get_episode_metadata(range(9))):
        origin = Provenance.from_metadata(metadata, number)
        assert origin.source == number % 3
        np.testing.assert_array_equal(saved[origin.source].observations[0], saved[number].observations[0])


def test_next_states_that_are_no_observation_stay_wherever_they_can() -> None:
    """Permuted segments keep their own next states: in views of Minari's, as a source, not in files."""
    data = AugmentedDataset(install_dataset("test/walks-v0", walks(4, 9), BOX2, BOX2), Permutation(), factor=3)
    wanted = data.transitions().next_observations
    assert (wanted != np.concatenate([episode.observations[1:] for episode in data])).any()
    (part,) = minari.split_dataset(data, [12], seed=0)
    order = np.asarray(part.episode_indices)
    rows = np.concatenate([np.flatnonzero(data.transitions().episode == number) for number in order])
    np.testing.assert_array_equal(Logged.of(part).steps.next_observations, wanted[rows])
    again = AugmentedDataset(data, Function(same), count=0)
    np.testing.assert_array_equal(again.transitions().next_observations, wanted)
    with pytest.warns(AugmentationWarning, match=r"the saved dataset has observations\[t\+1\] there"):
        saved = data.save("test/permuted-v0")
    np.testing.assert_array_equal(
        AugmentedDataset(saved, Function(same), count=0).transitions().next_observations,
        np.concatenate([episode.observations[1:] for episode in data]),
    )
    with pytest.raises(InvalidDataError, match="have a next state of their own"):
        write_d4rl(data, Path("never.hdf5"))


@pytest.mark.parametrize("data_format", ["arrow", "parquet"])
def test_integers_recorded_for_real_numbers_are_saved_beside_generated_floats(data_format: str) -> None:
    def whole(buffer: EpisodeBuffer) -> EpisodeBuffer:
        return dataclasses.replace(
            buffer,
            observations=np.round(buffer.observations).astype(np.int64),
            rewards=np.round(buffer.rewards).astype(np.int64),
        )

    def halves(episode: EpisodeData, rng: np.random.Generator) -> EpisodeData:
        return dataclasses.replace(
            episode, observations=episode.observations.astype(np.float32) + 0.5, rewards=episode.rewards + 0.5
        )

    source = install_dataset("test/whole-v0", [whole(buffer) for buffer in walks(3, 5)], BOX2, BOX2)
    data = AugmentedDataset(source, Function(halves), factor=2)
    saved = data.save("test/both-v0", data_format=data_format)
    for got, made in zip(saved, data, strict=True):
        np.testing.assert_array_equal(got.observations, made.observations)
        np.testing.assert_array_equal(got.rewards, made.rewards)
    rows = read_d4rl(write_d4rl(data, Path(os.environ["MINARI_DATASETS_PATH"]) / "both.hdf5"))
    np.testing.assert_array_equal(rows[0].rewards, data[0].rewards)


def test_metadata_of_the_source_survives(make_dataset: MakeDataset) -> None:
    loaded = AugmentedDataset(make_dataset(LENGTHS), Function(noisy), factor=2, seed=5).save("test/meta-v0")
    metadata = loaded.storage.metadata
    assert metadata["author"] == {"tests"}
    assert metadata["code_permalink"] == "https://example.org"
    assert metadata["dataset_id"] == "test/meta-v0"
    assert metadata["dataset_size"] == loaded.storage.get_size()
    assert metadata["oat_gym"]["seed"] == 5
    assert metadata["oat_gym"]["count"] == 4
    assert "test/meta-v0" in minari.list_local_datasets()


@pytest.mark.parametrize("lazy", [False, True])
def test_a_dataset_that_exists_is_refused_before_any_work(make_dataset: MakeDataset, lazy: bool) -> None:
    def fail(episode: EpisodeData, rng: np.random.Generator) -> EpisodeData:
        raise AssertionError("no work may be done")

    data = AugmentedDataset(make_dataset(LENGTHS), Function(fail), factor=2)
    with pytest.raises(DatasetExistsError, match="already at"):
        data.save("test/coded-v0", lazy=lazy)
    for wrong in ("no version", "test/nothing", "../escape-v0"):
        with pytest.raises(ConfigurationError, match="is no dataset id"):
            data.save(wrong, lazy=lazy)
    with pytest.raises(ConfigurationError, match="two characters or more in the namespace, and 'x' has one"):
        data.save("x/h5-v0", lazy=lazy)
    with pytest.raises(ConfigurationError, match="data_format"):
        data.save("test/new-v0", data_format="csv")


def test_a_failed_save_leaves_nothing(make_dataset: MakeDataset) -> None:
    def fail(episode: EpisodeData, rng: np.random.Generator) -> EpisodeData:
        raise RuntimeError("stop here")

    data = AugmentedDataset(make_dataset(LENGTHS), Function(fail), factor=2)
    root = minari.storage.get_dataset_path()
    before = sorted(root.rglob("*"))
    with pytest.raises(RuntimeError, match="stop here"):
        data.save("other/broken-v0")
    assert sorted(root.rglob("*")) == before


def test_a_recipe_is_small_and_opens_as_an_augmented_dataset(walk_dataset: minari.MinariDataset, tiny_oat: OAT) -> None:
    data = AugmentedDataset(walk_dataset, tiny_oat, factor=3, seed=1)
    saved = data.save("test/lazy-v0", lazy=True)
    assert sum(path.stat().st_size for path in saved.storage.data_path.iterdir()) < 8000
    loaded = minari.load_dataset("test/lazy-v0")
    assert isinstance(loaded, AugmentedDataset)
    assert loaded.augmenter == tiny_oat
    assert (loaded.seed, len(loaded), loaded.id) == (1, 36, "test/lazy-v0")
    assert not loaded.is_fitted
    for number in (0, 13, 35):
        np.testing.assert_array_equal(loaded[number].observations, data[number].observations)
    text = (saved.storage.data_path / "recipe.json").read_text()
    assert str(walk_dataset.storage.data_path) not in text


def test_a_recipe_of_a_view_names_its_episodes(walk_dataset: minari.MinariDataset, tiny_oat: OAT) -> None:
    view = walk_dataset.filter_episodes(lambda episode: len(episode) > 25)
    AugmentedDataset(view, tiny_oat, factor=2).save("test/lazy-v0", lazy=True)
    loaded = minari.load_dataset("test/lazy-v0")
    assert [len(episode) for episode in loaded[: len(view)]] == [len(episode) for episode in view]


def test_a_changed_source_is_an_error(
    walk_dataset: minari.MinariDataset, tiny_oat: OAT, make_dataset: MakeDataset
) -> None:
    AugmentedDataset(walk_dataset, tiny_oat, factor=2).save("test/lazy-v0", lazy=True)
    path = walk_dataset.storage.data_path / "main_data.hdf5"
    import h5py

    with h5py.File(path, "a") as file:
        file["episode_3/rewards"][2] += 1e-3
    loaded = minari.load_dataset("test/lazy-v0")
    for number in (0, 20):
        with pytest.raises(SourceChangedError, match="no longer has the content"):
            loaded[number]
    with h5py.File(path, "a") as file:
        del file["episode_11"]
    (path.parent / "metadata.json").write_text(
        json.dumps(json.loads((path.parent / "metadata.json").read_text()) | {"total_episodes": 11})
    )
    with pytest.raises(SourceChangedError, match="episode metadata"):
        minari.load_dataset("test/lazy-v0")


def test_a_missing_source_is_named(walk_dataset: minari.MinariDataset, tiny_oat: OAT) -> None:
    AugmentedDataset(walk_dataset, tiny_oat, factor=2).save("test/lazy-v0", lazy=True)
    walk_dataset.storage.data_path.parent.rename(walk_dataset.storage.data_path.parents[1] / "moved-v0")
    with pytest.raises(FileNotFoundError, match="minari download test/walks-v0"):
        minari.load_dataset("test/lazy-v0")


def test_what_has_no_recipe_is_refused(make_dataset: MakeDataset, walk_dataset: minari.MinariDataset) -> None:
    with pytest.raises(ConfigurationError, match="lazy=False"):
        AugmentedDataset(make_dataset(LENGTHS), Function(noisy), factor=2).save("test/no-v0", lazy=True)
    data = AugmentedDataset(walk_dataset, OAT(), factor=2)
    data.episode_indices = np.array([0, 3])
    with pytest.raises(ConfigurationError, match="not a view"):
        data.save("test/no-v0", lazy=True)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format": 2}, "update oat_gym"),
        ({"augmenter": {"name": "os.system", "settings": {}}}, "names the augmenter"),
        ({"augmenter": {"name": "oat", "settings": {"class": "OAT"}}}, "Expected the settings of OAT"),
        ({"count": "many"}, "count must be an integer"),
        (
            {"source": {"id": "../../etc-v0", "episodes": None, "content": "0" * 64, "metadata": "0" * 64}},
            "is no dataset id|not on this machine",
        ),
        (
            {"source": {"id": "/etc/passwd-v0", "episodes": None, "content": "0" * 64, "metadata": "0" * 64}},
            "is no dataset id|not on this machine",
        ),
        ({"source": {"id": "test/walks-v0", "episodes": None, "content": ""}}, "SHA-256"),
        (
            {"source": {"id": "test/walks-v0", "episodes": [99], "content": "0" * 64, "metadata": "0" * 64}},
            "names episodes that",
        ),
        ({"source": 3}, "damaged or no recipe"),
        ({"seed": -4}, "seed must be"),
        ({"count": 3}, "says 24 episodes"),
    ],
)
def test_a_hostile_or_damaged_recipe_is_an_error(
    walk_dataset: minari.MinariDataset, tiny_oat: OAT, change: dict[str, object], message: str
) -> None:
    saved = AugmentedDataset(walk_dataset, tiny_oat, factor=2).save("test/lazy-v0", lazy=True)
    path: Path = saved.storage.data_path / "recipe.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises((InvalidDataError, ConfigurationError, FileNotFoundError, SourceChangedError), match=message):
        minari.load_dataset("test/lazy-v0")
    path.write_text("{")
    with pytest.raises(InvalidDataError, match="damaged"):
        minari.load_dataset("test/lazy-v0")
