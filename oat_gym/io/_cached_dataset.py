"""A Minari dataset inside a cache entry: made once by whoever comes first, and checked at each opening."""

from __future__ import annotations

import hashlib
import logging
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

from minari import MinariDataset

from oat_gym.cache import CacheEntry
from oat_gym.errors import CacheError

logger = logging.getLogger(__name__)

DATASET = "dataset"
_ITEM = "conversion"
_STAGING = ".making-"


def cached_dataset(key: str, write: Callable[[Path], None]) -> MinariDataset:
    """Return the dataset of the cache entry `key`, which `write` makes in an empty folder where it is not there.

    Other processes wait for the one that makes it. A conversion whose bytes changed since is made again.

    Raises:
        CacheError: if it cannot be stored.
    """
    entry = CacheEntry(key)
    folder = entry.path / DATASET
    with entry.lock():
        if not _is_intact(entry, folder):
            try:
                _make(entry, folder, write)
            except OSError as error:
                raise CacheError(
                    f"The converted dataset cannot be stored in the cache at {entry.path} ({error}). Free some space, "
                    "or name another folder in OAT_GYM_CACHE."
                ) from error
    return MinariDataset(folder / "data")


def _is_intact(entry: CacheEntry, folder: Path) -> bool:
    item = entry.read(_ITEM)
    if item is None:
        return False
    try:
        if _digests(folder) == item[1]:
            return True
    except OSError as error:
        logger.warning("%s cannot be read (%s).", folder, error)
    logger.warning("The converted dataset at %s was changed or damaged; it is made again.", folder)
    return False


def _make(entry: CacheEntry, folder: Path, write: Callable[[Path], None]) -> None:
    entry.path.mkdir(parents=True, exist_ok=True)  # who cleared the cache held the lock until now
    for leftover in entry.path.glob(f"{_STAGING}*"):  # of a killed process: this one holds the lock
        shutil.rmtree(leftover)
    staging = Path(tempfile.mkdtemp(prefix=_STAGING, dir=entry.path))
    try:
        (staging / "data").mkdir()
        write(staging / "data")
        staging.chmod(0o755)  # mkdtemp keeps others out, which a shared cache should not
        if folder.exists():
            shutil.rmtree(folder)
        staging.rename(folder)
    finally:
        shutil.rmtree(staging, ignore_errors=True)
    entry.write(_ITEM, {}, _digests(folder))


def _digests(folder: Path) -> dict[str, str]:
    found: dict[str, str] = {}
    for path in sorted(folder.rglob("*")):
        if path.is_file():
            with path.open("rb") as file:
                found[str(path.relative_to(folder))] = hashlib.file_digest(file, "sha256").hexdigest()
    return found
