"""The cache on disk: fingerprints, checksummed single-file items written atomically, and one lock an entry.

An *entry* is the folder of one fingerprint; an *item* is one safetensors file in it (arrays, and a JSON value in its
header), sealed with a digest of all that it holds. An item is either absent or complete: it is written beside its
place and moved there; what a killed process left beside it goes when the entry is next locked. What a newer library
wrote is left alone. Nothing is ever unpickled.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
import os
import secrets
import warnings
from collections.abc import Generator, Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import platformdirs
from filelock import FileLock, Timeout
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from oat_gym.errors import CacheError, NewerFormatError

FORMAT_VERSION = 1
"""Part of every path and fingerprint: a newer library never reads, nor touches, an older one's entries."""

_HEADER = "oat_gym"

Arrays = dict[str, npt.NDArray[Any]]

_log = logging.getLogger(__name__)


class CacheWarning(UserWarning):
    """An item could not be kept on disk; the result in memory is complete, but will be made again next time."""


def cache_folder() -> Path:
    """Return the cache folder: `OAT_GYM_CACHE`, or the platform's cache folder for oat_gym."""
    return Path(os.environ.get("OAT_GYM_CACHE") or platformdirs.user_cache_dir("oat_gym", appauthor=False))


def canonical(value: object) -> Any:
    """Return `value` as plain JSON data: dataclasses as their name and fields, tuples as lists, scalars as numbers.

    Raises:
        TypeError: if part of it has no JSON form.
    """
    if is_dataclass(value) and not isinstance(value, type):
        return {"class": type(value).__name__, **{key: canonical(part) for key, part in _fields(value).items()}}
    if isinstance(value, Mapping):
        return {str(key): canonical(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [canonical(part) for part in value]
    if isinstance(value, np.generic):
        return value.item()
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise TypeError(f"{value!r} of type {type(value).__name__} has no JSON form.")


def fingerprint(**parts: object) -> str:
    """Return the SHA-256, in hexadecimal, of the named parts and the cache's format version."""
    text = json.dumps(canonical({"format": FORMAT_VERSION, **parts}), sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def digest_of(arrays: Mapping[str, npt.NDArray[Any]], text: str = "") -> str:
    """Return the SHA-256 of named arrays (types, shapes and values, in the order of their names) and a text."""
    digest = hashlib.sha256(text.encode())
    for name in sorted(arrays):
        array = arrays[name]
        digest.update(f"|{name}|{array.dtype.str}|{array.shape}|".encode())
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()


class CacheEntry:
    """The items stored under one fingerprint.

    >>> import tempfile
    >>> entry = CacheEntry("ab12", folder=Path(tempfile.mkdtemp()))
    >>> entry.write("model", {"weights": np.ones(2)}, {"epochs": 3})
    True
    >>> arrays, meta = entry.read("model")
    >>> arrays["weights"].tolist(), meta
    ([1.0, 1.0], {'epochs': 3})
    """

    def __init__(self, key: str, *, folder: Path | None = None) -> None:
        self.key = key
        self.path = (folder or cache_folder()) / f"v{FORMAT_VERSION}" / key[:2] / key

    @contextlib.contextmanager
    def lock(self) -> Generator[None]:
        """Hold the entry's lock, which one process at a time has; others wait and say so in the log.

        Where the folder cannot be written (a read-only disk) no lock is taken: nothing can be written either.
        """
        lock = FileLock(self.path.parent / f"{self.key}.lock")
        try:
            self._make_folder()
            try:
                lock.acquire(timeout=0)
            except Timeout:
                _log.info("Waiting for another process that prepares the same data (%s).", self.path)
                lock.acquire()
            _remove_temporaries(self.path)
        except (OSError, NotImplementedError) as error:  # the latter: a file system without locks
            warnings.warn(f"No lock could be taken in the cache at {self.path}: {error}.", CacheWarning, stacklevel=3)
        try:
            yield
        finally:
            lock.release()

    def read(self, name: str) -> tuple[Arrays, Any] | None:
        """Return (arrays, value) of an item, or None where it is absent, damaged or of a newer format.

        A damaged one is removed; a newer one stays, with a `CacheWarning`.

        Raises:
            CacheError: if the file is there and cannot be read.
        """
        path = self._item(name)
        try:
            return read_sealed(path)
        except (FileNotFoundError, NotADirectoryError):  # the latter: a file stands where the folder should be
            return None
        except NewerFormatError as error:
            warnings.warn(f"{error} It is left alone, and the work is done again.", CacheWarning, stacklevel=3)
            return None
        except CacheError as error:
            _log.warning("%s It is made again.", error)
            with contextlib.suppress(OSError):  # a read-only disk: writing will say so
                path.unlink(missing_ok=True)
            return None
        except OSError as error:
            raise CacheError(
                f"The cache file {path} cannot be read ({error}). Make it readable, delete it, or name another folder "
                "in OAT_GYM_CACHE."
            ) from error

    def write(self, name: str, arrays: Mapping[str, npt.NDArray[Any]], value: object) -> bool:
        """Store an item atomically; return whether it could be. A full disk is a `CacheWarning`.

        An item of a newer format is not replaced (`read` has said so).
        """
        path = self._item(name)
        if _is_newer(path):
            return False
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_sealed(path, arrays, value)
        except OSError as error:
            message = (
                f"{name} could not be kept in the cache at {path.parent} ({error}): it will be made again next time."
            )
            warnings.warn(
                f"{message} Free some space or name another folder in OAT_GYM_CACHE.", CacheWarning, stacklevel=3
            )
            return False
        return True

    def _item(self, name: str) -> Path:
        return self.path / f"{name}.safetensors"

    def _make_folder(self) -> None:
        if self.path.is_dir():
            return
        root = self.path.parents[2]
        newer = [path.name for path in root.glob("v*") if _version(path.name[1:]) > FORMAT_VERSION]
        if newer:
            _log.warning(
                "The cache at %s also holds what a newer oat_gym made (%s): it is left alone, and the work is done "
                "again here. Update oat_gym to use it.",
                root,
                ", ".join(sorted(newer)),
            )
        self.path.mkdir(parents=True, exist_ok=True)


def write_sealed(path: Path, arrays: Mapping[str, npt.NDArray[Any]], value: object) -> None:
    """Write arrays and a JSON value to `path` as one safetensors file with a digest, atomically.

    Raises:
        OSError: if the disk refuses; `path` is then as it was before.
    """
    contiguous = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    text = json.dumps(canonical(value), sort_keys=True)
    header = {"digest": digest_of(contiguous, text), "format": FORMAT_VERSION, "value": text}
    # Under one key: safetensors writes several in any order, and equal content is to give equal bytes.
    write_atomically(path, save(contiguous, metadata={_HEADER: json.dumps(header, sort_keys=True)}))


def read_sealed(path: Path) -> tuple[Arrays, Any]:
    """Return (arrays, value) of a file that `write_sealed` wrote.

    Raises:
        FileNotFoundError: if there is no such file.
        CacheError: if it is damaged: truncated or altered.
        NewerFormatError: if a newer version of the library wrote it.
        OSError: if it cannot be read.
    """
    with path.open("rb") as opened:  # says what is wrong with a file that cannot be opened
        if not opened.read(1):
            raise CacheError(f"{path} is damaged: it is empty.")
    try:
        with safe_open(path, framework="numpy") as file:
            digest, version, text = _parse_header((file.metadata() or {}).get(_HEADER, ""))
            if version > FORMAT_VERSION:
                raise NewerFormatError(
                    f"{path} has format {version}, and this oat_gym reads {FORMAT_VERSION}: update oat_gym, "
                    "or name another folder in OAT_GYM_CACHE."
                )
            arrays = {str(name): np.array(file.get_tensor(name)) for name in file.keys()}  # noqa: SIM118
    except SafetensorError as error:
        raise CacheError(f"{path} is damaged: {error}.") from error
    if digest != digest_of(arrays, text):
        raise CacheError(f"{path} is damaged: its content does not match its digest.")
    return arrays, json.loads(text)


def write_atomically(path: Path, data: bytes) -> None:
    """Replace the file at `path` by one that holds `data`; a crash leaves the old file or the new one, whole."""
    # Not tempfile.mkstemp: its files are for their owner only, and a dataset may be shared.
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(8)}")
    try:
        with temporary.open("xb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def _parse_header(text: str) -> tuple[str, int, str]:
    """Return (digest, format, value) of a header; a damaged one has a digest that matches nothing."""
    try:
        header: Any = json.loads(text)
        digest, version, value = header["digest"], header["format"], header["value"]
    except (LookupError, RecursionError, TypeError, ValueError):
        return "", 0, ""
    return str(digest), version if type(version) is int else 0, str(value)


def _remove_temporaries(folder: Path) -> None:
    """Remove what `write_atomically` left when its process was killed; the caller holds the folder's lock."""
    for path in folder.glob(".*.safetensors.*"):
        path.unlink(missing_ok=True)


def _version(text: str) -> int:
    return int(text) if text.isascii() and text.isdecimal() and len(text) < 10 else 0


def _is_newer(path: Path) -> bool:
    try:
        read_sealed(path)
    except NewerFormatError:
        return True
    except (OSError, CacheError):
        return False
    return False


def _fields(value: Any) -> dict[str, Any]:
    return {field.name: getattr(value, field.name) for field in fields(value)}
