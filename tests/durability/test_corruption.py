"""Damaged caches, full and read-only disks: found, made again, or a clear error; never other data."""

import json
import os
import resource
import shutil
import tempfile
import warnings
from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager
from pathlib import Path

import minari
import numpy as np
import pytest
from minari import EpisodeData

from oat_gym import OAT, AugmentedDataset, Function
from oat_gym.cache import CacheWarning, cache_folder
from oat_gym.episodes import content_hash
from oat_gym.errors import CacheError, DatasetExistsError, SaveError
from oat_gym.export import new_dataset_folder


def noisy(episode: EpisodeData, rng: np.random.Generator) -> EpisodeData:
    episode.rewards[:] += rng.normal(size=len(episode.rewards))
    return episode


def digest(data: minari.MinariDataset) -> str:
    return content_hash(data[index] for index in range(len(data)))


def files(folder: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


@contextmanager
def no_file_over(size: int) -> Generator[None]:
    """Let the disk refuse files of more than `size` bytes: what a full disk does, without privileges."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@contextmanager
def as_an_ordinary_user() -> Generator[None]:
    """Put the superuser's rights aside, whom permissions do not stop."""
    own = os.geteuid()
    if own == 0:
        os.seteuid(65534)
    try:
        yield
    finally:
        os.seteuid(own)


@pytest.fixture
def items(
    walk_dataset: minari.MinariDataset, tiny_oat: OAT, monkeypatch: pytest.MonkeyPatch
) -> tuple[Callable[[], AugmentedDataset], str]:
    """Fit once; give a function that makes the same dataset again, and its digest.

    Training again gives what it gave before (the kill harness shows that), at once.
    """

    def make() -> AugmentedDataset:
        return AugmentedDataset(walk_dataset, tiny_oat, factor=3, seed=4)

    data = make()
    truth, fitted = digest(data), data.synthesis.sampler
    monkeypatch.setattr(OAT, "fit", lambda *_, **__: fitted)
    return make, truth


def damaged(good: bytes) -> Iterator[tuple[str, bytes]]:
    """Yield forms of a file with one byte changed, at both ends and at places between, and cut ones."""
    places = sorted({0, 1, 8, 40, len(good) - 1, *np.linspace(2, len(good) - 2, 6, dtype=int).tolist()})
    for place in places:
        changed = bytearray(good)
        changed[place] ^= 1 << (place % 8)
        yield f"bit {place % 8} of byte {place}", bytes(changed)
    for size in (0, 7, len(good) // 2, len(good) - 1):
        yield f"cut to {size}", good[:size]


@pytest.mark.parametrize("name", ["model", "variation-2-0", "variation-2-1"])
def test_a_damaged_cache_file_is_made_again(items: tuple[Callable[[], AugmentedDataset], str], name: str) -> None:
    make, truth = items
    path = next(cache_folder().rglob(f"{name}.safetensors"))
    good = path.read_bytes()
    for what, bad in damaged(good):
        path.write_bytes(bad)
        assert digest(make()) == truth, what
        assert path.read_bytes() in (good, bad), what  # made again, or of no consequence
        assert not bad or path.read_bytes() == good or digest(make()) == truth, what


def test_a_cache_file_that_cannot_be_read_is_a_clear_error(items: tuple[Callable[[], AugmentedDataset], str]) -> None:
    path = next(cache_folder().rglob("model.safetensors"))
    path.unlink()
    path.mkdir()  # permissions do not stop the superuser; this does
    with pytest.raises(CacheError, match=r"model\.safetensors cannot be read .* OAT_GYM_CACHE"):
        items[0]().fit()


def test_permissions_that_forbid_reading_are_a_clear_error(
    items: tuple[Callable[[], AugmentedDataset], str], monkeypatch: pytest.MonkeyPatch
) -> None:
    data = items[0]()
    assert data.synthesis.cache_key  # reads the source
    with tempfile.TemporaryDirectory() as name:
        folder = shutil.copytree(cache_folder(), Path(name) / "cache")
        monkeypatch.setenv("OAT_GYM_CACHE", str(folder))
        for path in (Path(name), folder, *folder.rglob("*")):
            path.chmod(0o777)
        next(folder.rglob("model.safetensors")).chmod(0)
        with as_an_ordinary_user(), pytest.raises(CacheError, match=r"cannot be read .*Permission denied"):
            data.fit()


@pytest.mark.parametrize("size", [0, 300, 5000])
def test_a_full_disk_while_fitting_is_a_warning_and_the_data_is_right(
    items: tuple[Callable[[], AugmentedDataset], str], size: int
) -> None:
    make, truth = items
    data = make()
    shutil.rmtree(cache_folder())
    with no_file_over(size), pytest.warns(CacheWarning, match=r"could not be kept in the cache at .* Free some space"):
        assert digest(data) == truth
    assert not [path for path in cache_folder().rglob("*") if path.is_file() and path.suffix != ".lock"]
    assert digest(make()) == truth
    assert len(list(cache_folder().rglob("*.safetensors"))) == 3


def test_a_file_in_the_place_of_the_cache_is_a_warning_and_the_data_is_right(
    items: tuple[Callable[[], AugmentedDataset], str],
) -> None:
    make, truth = items
    shutil.rmtree(cache_folder())
    cache_folder().write_text("mine")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        assert digest(make()) == truth
    messages = [str(warning.message) for warning in caught if warning.category is CacheWarning]
    assert "No lock could be taken" in messages[0]
    assert all("Free some space or name another folder in OAT_GYM_CACHE" in message for message in messages[1:])
    assert len(messages) == 4  # the lock, the model and two variations
    assert cache_folder().read_text() == "mine"


def test_the_cache_of_a_newer_version_is_left_alone_with_a_message(
    items: tuple[Callable[[], AugmentedDataset], str], caplog: pytest.LogCaptureFixture
) -> None:
    make, truth = items
    (cache_folder() / "v1").rename(cache_folder() / "v2")
    before = files(cache_folder() / "v2")
    assert digest(make()) == truth
    assert "what a newer oat_gym made (v2): it is left alone" in caplog.text
    assert files(cache_folder() / "v2") == before
    caplog.clear()
    assert digest(make()) == truth
    assert not caplog.text  # said when it mattered, and not again


def test_an_item_of_a_newer_format_is_left_alone_with_a_message(
    items: tuple[Callable[[], AugmentedDataset], str],
) -> None:
    make, truth = items
    path = next(cache_folder().rglob("model.safetensors"))
    newer = path.read_bytes().replace(rb"\"format\": 1", rb"\"format\": 2", 1)
    assert newer != path.read_bytes()
    path.write_bytes(newer)
    with pytest.warns(CacheWarning, match=r"has format 2, and this oat_gym reads 1: update oat_gym.* left alone"):
        assert digest(make()) == truth
    assert path.read_bytes() == newer


@pytest.mark.parametrize("kind", ["hdf5", "arrow", "parquet", "recipe"])
@pytest.mark.parametrize("size", [0, 300, 1500])
def test_a_full_disk_while_saving_is_an_error_and_leaves_nothing(
    walk_dataset: minari.MinariDataset, tiny_oat: OAT, kind: str, size: int
) -> None:
    data = AugmentedDataset(walk_dataset, tiny_oat if kind == "recipe" else Function(noisy), factor=3)
    root = minari.storage.get_dataset_path()
    before = files(root)
    message = r"'other/full-v0' could not be written to .*nothing of it was left there. Free some space"
    with no_file_over(size), pytest.raises(SaveError, match=message) as caught:
        data.save("other/full-v0", data_format="hdf5" if kind == "recipe" else kind, lazy=kind == "recipe")
    assert isinstance(caught.value, OSError)
    assert {name: content for name, content in files(root).items() if "namespace" not in name} == {
        name: content for name, content in before.items() if "namespace" not in name
    }
    assert list(minari.list_local_datasets()) == ["test/walks-v0"]
    data.save("other/full-v0", data_format="hdf5" if kind == "recipe" else kind, lazy=kind == "recipe")


def test_a_failing_hdf5_is_told_as_a_full_disk() -> None:
    """HDF5 is not driven against a full disk itself: it can crash the interpreter, which is why space is probed."""
    message = "Unable to synchronously create dataset (file write failed: errno = 28, error message = 'No space left'"
    with pytest.raises(SaveError, match="Free some space"), new_dataset_folder("other/full-v0"):
        raise ValueError(message)
    with pytest.raises(ValueError, match="something else"), new_dataset_folder("other/full-v0"):
        raise ValueError("something else")


def test_datasets_that_cannot_be_written_there_are_a_clear_error(
    walk_dataset: minari.MinariDataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = AugmentedDataset(walk_dataset, Function(noisy), factor=2)
    (tmp_path / "taken").write_text("mine")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "taken"))
    with pytest.raises(SaveError, match=r"could not be written to .*taken.* MINARI_DATASETS_PATH"):
        data.save("test/new-v0")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "free"))
    (tmp_path / "free").mkdir()
    (tmp_path / "free" / "test").write_text("mine")
    with pytest.raises(SaveError, match="could not be written"):
        data.save("test/new-v0")
    assert files(tmp_path) == {str(tmp_path / "taken"): b"mine", str(tmp_path / "free" / "test"): b"mine"}


def test_a_dataset_that_appears_during_the_save_wins(walk_dataset: minari.MinariDataset) -> None:
    def rival(episode: EpisodeData, rng: np.random.Generator) -> EpisodeData:
        (minari.storage.get_dataset_path("test/new-v0") / "data").mkdir(parents=True, exist_ok=True)
        return episode

    data = AugmentedDataset(walk_dataset, Function(rival), factor=2)
    with pytest.raises(DatasetExistsError, match="already at"):
        data.save("test/new-v0")
    assert list(minari.storage.get_dataset_path("test/new-v0").iterdir()) == [
        minari.storage.get_dataset_path("test/new-v0") / "data"
    ]


def test_two_saves_in_one_process_do_not_share_a_folder(walk_dataset: minari.MinariDataset) -> None:
    with new_dataset_folder("one/same-v0") as first, new_dataset_folder("two/same-v0") as second:
        assert first != second
        for number, folder in enumerate((first, second)):
            (folder / "metadata.json").write_text(json.dumps(number))
    for number, namespace in enumerate(("one", "two")):
        path = minari.storage.get_dataset_path(f"{namespace}/same-v0") / "data" / "metadata.json"
        assert json.loads(path.read_text()) == number


def test_what_others_left_is_removed_and_what_they_do_is_not(walk_dataset: minari.MinariDataset) -> None:
    data = AugmentedDataset(walk_dataset, Function(noisy), factor=2)
    root = minari.storage.get_dataset_path()
    with new_dataset_folder("test/live-v0") as live:
        staging = live.parents[1]
        dead = root / staging.name.replace(f"-{os.getpid()}-", f"-{2**22 + 1}-")  # beyond the largest process id
        elsewhere = root / f".oat_gym-another.machine-{2**22 + 1}-abc"
        for folder in (dead, elsewhere):
            (folder / "x-v0" / "data").mkdir(parents=True)
        data.save("test/new-v0")
        assert staging.is_dir()
        assert elsewhere.is_dir()
        assert not dead.exists()
        (live / "metadata.json").write_text("{}")


def test_a_dataset_is_not_saved_inside_another(walk_dataset: minari.MinariDataset) -> None:
    before = files(minari.storage.get_dataset_path())
    with pytest.raises(ValueError, match="lies inside the dataset"):
        AugmentedDataset(walk_dataset, Function(noisy), factor=2).save("test/walks-v0/inner-v0")
    assert files(minari.storage.get_dataset_path()) == before


def test_others_may_read_what_is_saved(walk_dataset: minari.MinariDataset) -> None:
    saved = AugmentedDataset(walk_dataset, Function(noisy), factor=2).save("test/new-v0")
    mask = os.umask(0)
    os.umask(mask)
    for path in (saved.storage.data_path, *saved.storage.data_path.iterdir()):
        wanted = (0o777 if path.is_dir() else 0o666) & ~mask
        assert path.stat().st_mode & 0o777 == wanted, path
