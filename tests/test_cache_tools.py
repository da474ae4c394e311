"""Listing and clearing the cache, while others use it."""

import doctest
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from oat_gym import cache, cache_tools
from oat_gym.cache import FORMAT_VERSION, CacheEntry
from oat_gym.cache_tools import clear, list_entries
from oat_gym.errors import CacheError, ConfigurationError
from oat_gym.io.d4rl import read_d4rl

DAY = 86400.0


def fill(key, size=100, *, days_ago=0.0):
    entry = CacheEntry(key)
    with entry.lock():
        entry.write("model", {"weights": np.zeros(size)}, None)
    age(entry.path, days_ago)
    return entry


def age(path, days):
    at = time.time() - days * DAY
    for part in (path, *path.rglob("*")):
        os.utime(part, (at, at))


def size_of(path):
    return sum(part.stat().st_size for part in path.rglob("*") if part.is_file())


def test_an_absent_cache_is_empty():
    assert cache_tools.folder() == cache.cache_folder()
    assert list_entries() == ()
    assert clear() == cache_tools.Cleared(freed=0, removed=(), in_use=())
    assert not cache.cache_folder().exists()


def test_every_kind_is_listed_with_its_size_and_the_longest_unused_first():
    old, new = fill("ab12", 500, days_ago=9), fill("ab34", 10, days_ago=2)
    other = cache.cache_folder() / "precious"
    other.mkdir()
    age(other, 1)
    data = read_d4rl({"observations": np.zeros((2, 1)), "actions": np.zeros((2, 1)), "rewards": np.zeros(2),
                      "terminals": np.ones(2)})  # fmt: skip
    items = list_entries()
    assert [item.kind for item in items] == ["fit", "fit", "other", "dataset"]
    assert [item.path for item in items[:3]] == [old.path, new.path, other]
    assert Path(data.storage.data_path).is_relative_to(items[3].path)
    assert [item.size for item in items] == [size_of(item.path) for item in items]
    assert [item.version for item in items] == [FORMAT_VERSION, FORMAT_VERSION, None, FORMAT_VERSION]
    assert abs(items[0].last_used.timestamp() - (time.time() - 9 * DAY)) < 60
    assert items[0].key == "ab12"


def test_clear_frees_what_it_says_and_leaves_the_rest():
    old, new = fill("ab12", 500, days_ago=9), fill("ab34", 10, days_ago=2)
    foreign = cache.cache_folder() / "precious" / "file"
    foreign.parent.mkdir()
    foreign.write_text("data")
    expected = size_of(old.path)
    done = clear(unused_days=5)
    assert (done.freed, [item.path for item in done.removed], done.in_use) == (expected, [old.path], ())
    assert (old.path.exists(), new.path.exists()) == (False, True)
    assert clear().freed > 0
    assert [item.kind for item in list_entries()] == ["other"]
    assert foreign.read_text() == "data"
    assert old.read("model") is None
    assert fill("ab12").read("model") is not None  # the cache works on


def test_other_versions_are_listed_and_left_alone():
    fill("ab12")
    newer = cache.cache_folder() / f"v{FORMAT_VERSION + 1}" / "cd" / "cdef"
    newer.mkdir(parents=True)
    (newer / "model.safetensors").write_bytes(b"of tomorrow")
    found = {item.version: item.is_current for item in list_entries()}
    assert found == {FORMAT_VERSION: True, FORMAT_VERSION + 1: False}
    assert [item.key for item in clear().removed] == ["ab12"]
    assert (newer / "model.safetensors").read_bytes() == b"of tomorrow"


def test_an_entry_that_another_process_holds_is_left():
    held, free = fill("ab12"), fill("cd34")
    holder = (
        "import sys; from oat_gym.cache import CacheEntry\n"
        "with CacheEntry('ab12').lock():\n"
        "    print('held', flush=True); sys.stdin.read()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", holder], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout.readline() == "held\n"
        done = clear()
        process.stdin.close()
        assert process.wait() == 0
    assert [item.path for item in done.removed] == [free.path]
    assert [item.path for item in done.in_use] == [held.path]
    assert held.read("model") is not None
    assert [item.path for item in clear().removed] == [held.path]


def test_links_are_not_followed(tmp_path):
    fill("ab12")
    outside = tmp_path / "outside"
    outside.mkdir()
    (outside / "precious").write_text("data")
    (cache.cache_folder() / "v1" / "ab" / "link").symlink_to(outside)
    (CacheEntry("ab12").path / "inside").symlink_to(outside)
    assert [item.key for item in clear().removed] == ["ab12"]
    assert (outside / "precious").read_text() == "data"


def test_what_cannot_be_deleted_or_read_is_an_error(monkeypatch):
    entry = fill("ab12")

    def refuse(*_):
        raise PermissionError(13, "denied")

    with monkeypatch.context() as patch:
        patch.setattr(cache_tools.shutil, "rmtree", refuse)
        with pytest.raises(CacheError, match="ab12 cannot be deleted"):
            clear()
    assert entry.read("model") is not None
    with monkeypatch.context() as patch:
        patch.setattr(Path, "iterdir", refuse)
        with pytest.raises(CacheError, match="cannot be read"):
            list_entries()
    with pytest.raises(ConfigurationError, match="unused_days must be 0 or more, got -1"):
        clear(unused_days=-1)


def test_examples_in_docstrings():
    assert doctest.testmod(cache_tools).failed == 0
