"""Folders that someone else made: recipes and metadata that lie, point elsewhere, or hold anything at all."""

import json
import shutil
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import minari
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from minari.data_collector import EpisodeBuffer

from oat_gym import OAT, AugmentedDataset
from oat_gym.errors import ConfigurationError, InvalidDataError, OatGymError, SourceChangedError
from oat_gym.recipe import check_folder, find_dataset
from oat_gym.synthesis import MAX_COUNT

RECIPE = "test/lazy-v0"
DISCRETE = '{"type": "Discrete", "n": 3, "start": 0}'
BAD_JSON = ["", "{", "[]", "null", "[" * 100_000, '{"a":' * 100_000, "1" * 5000, "\xff", '{"x": NaN}']


@pytest.fixture
def saved(walk_dataset: minari.MinariDataset, tiny_oat: OAT) -> Path:
    """Return the folder of a saved recipe with an appended episode and edited metadata."""
    data = AugmentedDataset(walk_dataset, tiny_oat, factor=2, seed=1)
    data.update_dataset_from_buffer([_episode()])
    data.storage.update_episode_metadata([{"note": "mine"}], [0])
    return data.save(RECIPE, lazy=True).storage.data_path


def _episode() -> EpisodeBuffer:
    return EpisodeBuffer(
        observations=np.zeros((4, 2), dtype=np.float32),
        actions=np.zeros((3, 2), dtype=np.float32),
        rewards=np.arange(3.0),
        terminations=np.zeros(3, dtype=bool),
        truncations=np.arange(3) == 2,
    )


def edit(path: Path, change: dict[str, Any]) -> None:
    path.write_text(json.dumps(json.loads(path.read_text()) | change))


def replace_at(value: Any, path: tuple[str | int, ...], new: Any) -> Any:
    if not path:
        return new
    copy = dict(value) if isinstance(value, dict) else list(value)
    copy[path[0]] = replace_at(value[path[0]], path[1:], new)
    return copy


def paths(value: Any, path: tuple[str | int, ...] = ()) -> list[tuple[str | int, ...]]:
    children = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [path, *(inner for key, part in children for inner in paths(part, (*path, key)))]


def use() -> None:
    """Open the recipe and use what needs no training."""
    data = find_dataset(RECIPE)
    assert isinstance(data, AugmentedDataset)
    assert (len(data), data.total_steps) == (25, 621)
    assert len(data[0]) == 24
    assert data[24].rewards.tolist() == [0, 1, 2]
    assert next(iter(data.storage.get_episode_metadata([0])))["note"] == "mine"


def test_an_honest_folder_works(saved: Path) -> None:
    use()
    check_folder(saved)


def _link(saved: Path, name: str, target: Path) -> None:
    part, away = saved / name, target / f"away-{name}"
    part.rename(away)
    part.symlink_to(away)


@pytest.mark.parametrize("name", ["recipe.json", "appended", "episode_metadata.json", "metadata.json"])
def test_links_are_refused(saved: Path, tmp_path: Path, name: str) -> None:
    _link(saved, name, tmp_path)
    with pytest.raises(InvalidDataError, match=rf"{name} is a link"):
        find_dataset(RECIPE)
    with pytest.raises(InvalidDataError, match=rf"{name} is a link"):
        minari.load_dataset(RECIPE)


def test_a_dataset_that_lives_elsewhere_as_a_whole_is_fine(saved: Path, tmp_path: Path) -> None:
    away = shutil.move(saved.parent, tmp_path / "away")
    saved.parent.symlink_to(away)
    use()


@pytest.mark.parametrize("kind", ["external link", "soft link", "external storage", "virtual"])
def test_links_inside_an_hdf5_file_are_refused(saved: Path, tmp_path: Path, kind: str) -> None:
    secret = tmp_path / "secret"
    secret.write_bytes(np.arange(3.0).tobytes())
    with h5py.File(saved / "appended" / "main_data.hdf5", "a") as file:
        group = file["episode_0"]
        del group["rewards"]
        if kind == "external link":
            group["rewards"] = h5py.ExternalLink(str(secret), "/rewards")
        elif kind == "soft link":
            group["rewards"] = h5py.SoftLink("/episode_0/terminations")
        elif kind == "external storage":
            group.create_dataset("rewards", (3,), "f8", external=[(str(secret), 0, 24)])
        else:
            layout = h5py.VirtualLayout((3,), "f8")
            layout[:] = h5py.VirtualSource(str(secret), "rewards", (3,))
            group.create_virtual_dataset("rewards", layout)
    with pytest.raises(InvalidDataError, match="which no Minari file does"):
        find_dataset(RECIPE)


@pytest.mark.parametrize(
    "name", ["../walks-v0", "/etc/passwd-v0", "test/../../etc-v0", "..", "", "a\0b-v0", "x" * 300 + "-v0", 3, None]
)
def test_a_source_outside_is_refused(saved: Path, name: object) -> None:
    recipe = json.loads((saved / "recipe.json").read_text())
    recipe["source"]["id"] = name
    (saved / "recipe.json").write_text(json.dumps(recipe))
    with pytest.raises(ConfigurationError, match="is no dataset id"):
        find_dataset(RECIPE)


def test_a_recipe_that_is_its_own_source_is_refused(saved: Path) -> None:
    recipe = json.loads((saved / "recipe.json").read_text())
    recipe["source"]["id"] = RECIPE
    (saved / "recipe.json").write_text(json.dumps(recipe))
    with pytest.raises(InvalidDataError, match="is its own source"):
        find_dataset(RECIPE)


@pytest.mark.parametrize("count", [10**12, 10**18, 10**400])
def test_a_huge_count_allocates_nothing(saved: Path, count: int) -> None:
    edit(saved / "recipe.json", {"count": count})
    edit(saved / "metadata.json", {"total_episodes": count + 13, "total_steps": 25 * count})
    with pytest.raises(OatGymError, match=f"{MAX_COUNT} at most|damaged"):
        find_dataset(RECIPE)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"total_episodes": 26}, SourceChangedError, "says 26 episodes"),
        ({"total_episodes": 10**12}, SourceChangedError, "episodes"),
        ({"total_steps": 625}, SourceChangedError, "625 steps"),
        ({"total_episodes": -1}, InvalidDataError, "'total_episodes' is -1"),
        ({"total_episodes": "25"}, InvalidDataError, "expected int"),
        ({"total_steps": True}, InvalidDataError, "expected int"),
        ({"observation_space": None}, InvalidDataError, "expected str"),
        ({"observation_space": '{"type": "Pickle"}'}, InvalidDataError, "is no space"),
        (
            {"observation_space": DISCRETE},
            InvalidDataError,
            "another observation_space",
        ),
        ({"action_space": DISCRETE}, InvalidDataError, "another action_space"),
        ({"minari_version": "99.0"}, InvalidDataError, "cannot be opened"),
        ({"data_format": "zip"}, InvalidDataError, "cannot be opened"),
        ({"env_spec": "{}"}, InvalidDataError, "cannot be opened"),
        ({"dataset_id": 3}, InvalidDataError, "cannot be opened"),
    ],
)
def test_metadata_that_lies_is_an_error(
    saved: Path, change: dict[str, Any], error: type[Exception], message: str
) -> None:
    edit(saved / "metadata.json", change)
    with pytest.raises(error, match=message):
        find_dataset(RECIPE)


def test_metadata_without_spaces_runs_no_environment(saved: Path, tmp_path: Path) -> None:
    """Minari makes missing spaces by `gymnasium.make` of whatever entry point the metadata names."""
    metadata = json.loads((saved / "metadata.json").read_text())
    del metadata["observation_space"]
    metadata["env_spec"] = json.dumps(
        {
            "id": "Evil-v0",
            "entry_point": "pathlib:Path.touch",
            "kwargs": {"self": str(tmp_path / "ran")},
            "additional_wrappers": [],
            "vector_entry_point": None,
        }
    )
    for folder in (saved, saved / "appended"):
        shutil.copy(folder / "metadata.json", tmp_path / "kept.json")
        (folder / "metadata.json").write_text(json.dumps(metadata))
        with pytest.raises(InvalidDataError, match="'observation_space' is None"):
            find_dataset(RECIPE)
        shutil.copy(tmp_path / "kept.json", folder / "metadata.json")
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"total_episodes": 2}, "lacks some of its 2 episodes"),
        ({"total_episodes": 10**12}, "lacks some of its"),
        ({"total_steps": 4}, "has 3 steps where its metadata says 4"),
        ({"data_format": "oat"}, "which no appended part has"),
        ({"data_format": "arrow"}, "lacks some of its|damaged|which no appended"),
    ],
)
def test_an_appended_part_that_lies_is_an_error(saved: Path, change: dict[str, Any], message: str) -> None:
    edit(saved / "appended" / "metadata.json", change)
    with pytest.raises(InvalidDataError, match=message):
        find_dataset(RECIPE)


def test_a_recipe_that_went_missing_is_an_error(saved: Path) -> None:
    (saved / "recipe.json").unlink()
    with pytest.raises(InvalidDataError, match=r"says 25 episodes .* recipe\.json is missing"):
        find_dataset(RECIPE)


@pytest.mark.parametrize("name", ["recipe.json", "metadata.json", "episode_metadata.json"])
@pytest.mark.parametrize("text", BAD_JSON)
def test_what_is_no_json_of_ours_is_an_error(saved: Path, name: str, text: str) -> None:
    (saved / name).write_bytes(text.encode("latin-1"))
    with pytest.raises(InvalidDataError, match=r"damaged|Expected|cannot be opened|is missing"):
        find_dataset(RECIPE)


@pytest.mark.parametrize("name", ["recipe.json", "metadata.json", "episode_metadata.json"])
def test_a_folder_in_the_place_of_a_file_is_an_error(saved: Path, name: str) -> None:
    (saved / name).unlink()
    (saved / name).mkdir()
    with pytest.raises(InvalidDataError, match=r"damaged|cannot be opened"):
        find_dataset(RECIPE)


def test_settings_of_a_wrong_type_are_refused(saved: Path) -> None:
    recipe = json.loads((saved / "recipe.json").read_text())
    wrong: list[tuple[str, Any]] = [("observation_noise", "yes"), ("times", 3), ("features", [1]), ("candidates", 1.0)]
    for name, value in wrong:
        bad = replace_at(recipe, ("augmenter", "settings", name), value)
        (saved / "recipe.json").write_text(json.dumps(bad))
        with pytest.raises(InvalidDataError, match="A setting has the value"):
            find_dataset(RECIPE)
    bad = replace_at(recipe, ("augmenter", "settings", "mining", "switch_penalty"), float("nan"))
    (saved / "recipe.json").write_text(json.dumps(bad))
    with pytest.raises(InvalidDataError, match="A setting has the value nan"):
        find_dataset(RECIPE)


def test_a_damaged_source_is_named_and_not_the_recipe(saved: Path, walk_dataset: minari.MinariDataset) -> None:
    (walk_dataset.storage.data_path / "metadata.json").write_text("{")
    with pytest.raises(InvalidDataError, match=r"The dataset 'test/walks-v0' at .* cannot be opened"):
        find_dataset(RECIPE)


JSON = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.integers(10**9, 10**30)
    | st.floats()
    | st.text(max_size=8)
    | st.sampled_from(["../x-v0", "/etc/passwd-v0", "test/walks-v0", RECIPE, "oat", "hdf5", "OAT", "__import__('os')"]),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=5,
)
FILES = ("recipe.json", "metadata.json", "episode_metadata.json", "appended/metadata.json")


@settings(max_examples=120, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_anything_in_place_of_anything_is_an_error_or_the_same_data(saved: Path, data: st.DataObject) -> None:
    path = saved / data.draw(st.sampled_from(FILES))
    good = path.read_text()
    value = json.loads(good)
    where = data.draw(st.sampled_from(paths(value)))
    try:
        path.write_text(json.dumps(replace_at(value, where, data.draw(JSON))))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Gymnasium's opinions on odd spaces
            _open_and_read()
    finally:
        path.write_text(good)


def _open_and_read() -> None:
    try:
        opened = find_dataset(RECIPE)
        real = [opened[index].rewards.tolist() for index in (0, 11)]
        described = list(opened.storage.get_episode_metadata([0, 24]))
    except OatGymError:
        return
    assert real == [minari.load_dataset("test/walks-v0")[index].rewards.tolist() for index in (0, 11)]
    assert len(described) == 2


def test_a_count_that_cannot_work_is_refused_for_users_too(walk_dataset: minari.MinariDataset, tiny_oat: OAT) -> None:
    make: list[Callable[[], AugmentedDataset]] = [
        lambda: AugmentedDataset(walk_dataset, tiny_oat, factor=1e12),
        lambda: AugmentedDataset(walk_dataset, tiny_oat, count=MAX_COUNT + 1),
    ]
    for attempt in make:
        with pytest.raises(ConfigurationError, match="at most"):
            attempt()
