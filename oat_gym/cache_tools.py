"""What is in the cache folder, and emptying it safely. Nothing here prints; the command line does."""

from __future__ import annotations

import contextlib
import re
import shutil
import time
from collections.abc import Generator, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

from filelock import FileLock, Timeout

from oat_gym.cache import FORMAT_VERSION, cache_folder
from oat_gym.errors import CacheError, ConfigurationError

Kind = Literal["fit", "dataset", "other"]

_DATASET = "dataset"


@dataclass(frozen=True)
class CacheItem:
    """One thing that the cache keeps.

    `kind` is "fit" (labels, or what was mined with the trained models), "dataset" (a conversion to Minari's format) or
    "other". `size` is in bytes; `last_used` is when a file of it was last written or, as far as the disk keeps that,
    read. `version` is the cache format of an entry, None where the thing has none.
    """

    path: Path
    kind: Kind
    size: int
    last_used: datetime
    version: int | None

    @property
    def is_current(self) -> bool:
        """Whether this version of oat_gym reads it; entries of other versions are listed and left alone."""
        return self.version is None or self.version == FORMAT_VERSION

    @property
    def key(self) -> str:
        """The name of its folder: an entry's fingerprint."""
        return self.path.name


@dataclass(frozen=True)
class Cleared:
    """What `clear` did: `freed` bytes, the items `removed`, and those that stay because they are `in_use`."""

    freed: int
    removed: tuple[CacheItem, ...]
    in_use: tuple[CacheItem, ...]


def folder() -> Path:
    """Return the cache folder: `OAT_GYM_CACHE`, or the platform's cache folder for oat_gym. It may not exist yet."""
    return cache_folder()


def list_entries() -> tuple[CacheItem, ...]:
    """Return everything in the cache, the longest unused first; nothing is opened or changed.

    Raises:
        CacheError: if the folder cannot be read.

    >>> all(item.size >= 0 for item in list_entries())
    True
    """
    root = cache_folder()
    try:
        items = [_item(path, kind, version) for path, kind, version in _places(root)]
    except OSError as error:
        raise CacheError(
            f"The cache at {root} cannot be read ({error}). Make it readable, or set OAT_GYM_CACHE."
        ) from error
    return tuple(sorted((item for item in items if item is not None), key=lambda item: (item.last_used, item.path)))


def clear(*, unused_days: float = 0.0) -> Cleared:
    """Delete what was not used for `unused_days` days (0: everything) and return what was freed.

    An entry whose lock another process holds is left and returned in `in_use`. Entries of other format versions, and
    folders that oat_gym did not make, are left alone; so are the empty lock files, which a waiting process may hold.
    What is deleted is made again when it is next needed; a converted dataset that is open somewhere must be opened
    again.

    Raises:
        ConfigurationError: for a negative number of days.
        CacheError: if something cannot be deleted.

    >>> clear(unused_days=36500).removed  # nothing is a hundred years old
    ()
    """
    if not unused_days >= 0:
        raise ConfigurationError(f"unused_days must be 0 or more, got {unused_days!r}.")
    newest = time.time() - unused_days * 86400
    removed: list[CacheItem] = []
    in_use: list[CacheItem] = []
    for item in list_entries():
        if item.kind == "other" or not item.is_current or item.last_used.timestamp() > newest:
            continue
        (removed if _remove(item) else in_use).append(item)
    return Cleared(sum(item.size for item in removed), tuple(removed), tuple(in_use))


def _places(root: Path) -> Iterator[tuple[Path, Kind, int | None]]:
    """Yield the folders (and stray files) of the cache; links are not followed."""
    for top in _folders(root):
        version = re.fullmatch(r"v(\d+)", top.name)
        if version:
            for shard in _folders(top):
                for path in _folders(shard):
                    yield path, "dataset" if (path / _DATASET).is_dir() else "fit", int(version[1])
        else:
            yield top, "other", None


def _folders(path: Path) -> list[Path]:
    return sorted(p for p in path.iterdir() if p.is_dir() and not p.is_symlink()) if path.is_dir() else []


def _item(path: Path, kind: Kind, version: int | None) -> CacheItem | None:
    """Return the item, or None if it went away while it was looked at."""
    try:
        files = [part.lstat() for part in path.rglob("*") if not part.is_dir() or part.is_symlink()]
        made = path.lstat().st_mtime
    except FileNotFoundError:
        return None
    used = max((max(file.st_mtime, file.st_atime) for file in files), default=made)
    size = sum(file.st_size for file in files)
    return CacheItem(path=path, kind=kind, size=size, last_used=datetime.fromtimestamp(used, UTC), version=version)


def _remove(item: CacheItem) -> bool:
    try:
        with _lock(item.path) as free:
            if free:
                shutil.rmtree(item.path)
            return free
    except FileNotFoundError:  # another process cleared it in the meantime
        return True
    except OSError as error:
        raise CacheError(f"{item.path} cannot be deleted ({error}). Delete it by hand.") from error
    return True


@contextlib.contextmanager
def _lock(entry: Path) -> Generator[bool]:
    """Hold an entry's lock where no other process does; give whether it could be had."""
    lock = FileLock(entry.parent / f"{entry.name}.lock")
    try:
        lock.acquire(timeout=0)
    except Timeout:
        yield False
        return
    try:
        yield True
    finally:
        lock.release()
