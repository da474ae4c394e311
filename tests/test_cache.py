import itertools
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from oat_gym import cache
from oat_gym.cache import (
    CacheEntry,
    CacheWarning,
    NewerFormatError,
    canonical,
    fingerprint,
    read_sealed,
    write_sealed,
)
from oat_gym.errors import CacheError


@dataclass(frozen=True)
class Inner:
    rate: float = 0.5


@dataclass(frozen=True)
class Outer:
    inner: Inner = Inner()
    sizes: tuple[int, ...] = (1, 2)


def test_fingerprints_tell_settings_apart_and_are_stable() -> None:
    base = fingerprint(config=Outer(), seed=0)
    assert base == fingerprint(seed=0, config=Outer())
    assert len({base, fingerprint(config=Outer(), seed=1), fingerprint(config=Outer(Inner(0.6)), seed=0)}) == 3
    assert canonical(Outer()) == {"class": "Outer", "inner": {"class": "Inner", "rate": 0.5}, "sizes": [1, 2]}
    with pytest.raises(TypeError, match="no JSON form"):
        canonical({"f": print})


def test_an_item_comes_back_as_it_was(tmp_path: Path) -> None:
    entry = CacheEntry("abcd", folder=tmp_path)
    arrays = {"a": np.arange(6).reshape(2, 3), "b/c": np.array(2.5), "empty": np.zeros((0, 2), dtype=bool)}
    assert entry.read("model") is None
    assert entry.write("model", arrays, {"curve": {"20": 3}, "none": None})
    read, value = entry.read("model")
    assert value == {"curve": {"20": 3}, "none": None}
    for name, array in arrays.items():
        assert read[name].dtype == array.dtype
        np.testing.assert_array_equal(read[name], array)


def test_any_flipped_byte_is_found(tmp_path: Path) -> None:
    path = tmp_path / "item.safetensors"
    write_sealed(path, {"weights": np.arange(5, dtype=np.float32)}, {"epochs": 3})
    good = path.read_bytes()
    read, value = read_sealed(path)
    for position, mask in itertools.product(range(len(good)), (0x01, 0x11, 0x80, 0xFF)):
        damaged = bytearray(good)
        damaged[position] ^= mask
        path.write_bytes(damaged)
        try:
            got, got_value = read_sealed(path)
        except CacheError:
            continue
        # A byte that means nothing (padding) may pass, but never with other content.
        assert got_value == value
        np.testing.assert_array_equal(got["weights"], read["weights"])


def test_equal_content_gives_equal_bytes(tmp_path: Path) -> None:
    arrays = {"b": np.ones(3, dtype=np.float32), "a": np.arange(4), "c/d": np.zeros((2, 1), dtype=bool)}
    for number in range(10):
        write_sealed(tmp_path / f"{number}", dict(sorted(arrays.items(), reverse=bool(number % 2))), {"x": 1, "y": [2]})
    assert len({(tmp_path / f"{number}").read_bytes() for number in range(10)}) == 1


def test_what_a_killed_process_left_goes_with_the_next_lock(tmp_path: Path) -> None:
    entry = CacheEntry("abcd", folder=tmp_path)
    entry.write("model", {"weights": np.ones(2)}, None)
    (entry.path / ".model.safetensors.0123abcd").write_bytes(b"half")
    with entry.lock():
        assert [path.name for path in entry.path.iterdir()] == ["model.safetensors"]


def test_a_newer_format_is_neither_read_nor_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    entry = CacheEntry("abcd", folder=tmp_path)
    with monkeypatch.context() as newer:
        newer.setattr(cache, "FORMAT_VERSION", 2)
        assert entry.write("model", {"weights": np.ones(2)}, None)
    path = entry.path / "model.safetensors"
    before = path.read_bytes()
    with pytest.raises(NewerFormatError, match="update oat_gym"):
        read_sealed(path)
    with pytest.warns(CacheWarning, match="left alone"):
        assert entry.read("model") is None
    assert not entry.write("model", {"weights": np.zeros(2)}, None)
    assert path.read_bytes() == before


@pytest.mark.parametrize("size", [0, 4, 30, -1])
def test_a_truncated_item_is_removed_and_reads_as_absent(tmp_path: Path, size: int) -> None:
    entry = CacheEntry("abcd", folder=tmp_path)
    entry.write("model", {"weights": np.arange(50.0)}, None)
    path = next(entry.path.glob("*.safetensors"))
    path.write_bytes(path.read_bytes()[:size])
    assert entry.read("model") is None
    assert not path.exists()


def test_a_full_disk_is_a_warning_and_leaves_nothing_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    entry = CacheEntry("abcd", folder=tmp_path)
    entry.write("model", {"weights": np.ones(2)}, None)

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(cache.os, "fsync", full)
    with pytest.warns(CacheWarning, match="No space left"):
        assert not entry.write("model", {"weights": np.zeros(2)}, None)
    assert [path.name for path in entry.path.iterdir()] == ["model.safetensors"]
    assert entry.read("model")[0]["weights"].tolist() == [1, 1]


def test_the_folder_is_what_the_environment_names(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OAT_GYM_CACHE", "/somewhere/else")
    assert cache.cache_folder() == Path("/somewhere/else")
    monkeypatch.delenv("OAT_GYM_CACHE")
    assert cache.cache_folder().name == "oat_gym"


def test_the_lock_is_held_by_one_at_a_time_and_can_be_taken_again(tmp_path: Path) -> None:
    entry = CacheEntry("abcd", folder=tmp_path)
    with entry.lock():
        assert (entry.path.parent / "abcd.lock").exists()
    with entry.lock():
        pass
