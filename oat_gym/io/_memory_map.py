"""Columns on disk, memory-mapped: one flat file a column, found again by the content of the dataset.

A folder holds one sub-folder for each content; it is written under another name and moved into place, so it is complete
or absent. On opening, every file is checked against its digest; a damaged set is written again.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
import os
import shutil
from pathlib import Path
from typing import IO, Any

import numpy as np
import numpy.typing as npt
import torch
from filelock import FileLock
from minari import MinariDataset

from oat_gym.cache import fingerprint, write_atomically
from oat_gym.errors import OatGymError, SaveError
from oat_gym.io._columns import Columns, Layout, assemble, hash_parts, read_parts, write_columns

VERSION = 1
MANIFEST = "manifest.json"

_log = logging.getLogger(__name__)


def columns_on_disk(data: MinariDataset, layout: Layout, folder: Path) -> Columns:
    """Return the memory-mapped columns of a dataset, writing them first where `folder` does not have them.

    The files are opened copy-on-write: nothing that is done to a batch or a column reaches the disk.

    Raises:
        SaveError: if the folder cannot be written, or the disk is full; nothing incomplete stays under its final name.
    """
    key = fingerprint(
        torch_columns=VERSION,
        content=hash_parts(read_parts(data)),
        spaces=[repr(layout.observation_space), repr(layout.action_space)],
        flat=layout.flat,
        dtype=str(layout.dtype),
    )
    try:
        columns = _found_or_written(data, layout, folder / key)
    except OatGymError:
        raise
    except OSError as error:
        raise SaveError(
            f"The columns of {data.id!r} could not be kept in {folder} ({error}); nothing incomplete was left there. "
            "Free some space, or name a folder that can be written in memory_map (None keeps them in memory)."
        ) from error
    if columns is None:
        raise SaveError(f"The columns written to {folder / key} did not read back as they were: check the disk.")
    return columns


def _found_or_written(data: MinariDataset, layout: Layout, target: Path) -> Columns | None:
    target.parent.mkdir(parents=True, exist_ok=True)
    with FileLock(target.with_name(f".{target.name}.lock")):
        columns = _open(target, layout)
        if columns is None:
            _write(data, layout, target)
            columns = _open(target, layout)
    return columns


class _Files:
    """One open file a column, with what its manifest entry needs."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._open: dict[str, IO[bytes]] = {}
        self._digests: dict[str, Any] = {}
        self.entries: dict[str, dict[str, Any]] = {}

    def append(self, name: str, rows: npt.NDArray[Any]) -> None:
        if name not in self._open:
            self._open[name] = (self._folder / f"{len(self._open):03d}.bin").open("wb")
            self._digests[name] = hashlib.sha256()
            self.entries[name] = {"dtype": rows.dtype.str, "shape": [0, *rows.shape[1:]]}
        data = np.ascontiguousarray(rows).data
        self._open[name].write(data)
        self._digests[name].update(data)
        self.entries[name]["shape"][0] += len(rows)

    def close(self) -> None:
        with contextlib.ExitStack() as stack:  # closes every file, also where the disk refuses one
            for file in self._open.values():
                stack.enter_context(file)
            for name, file in self._open.items():
                self.entries[name]["sha256"] = self._digests[name].hexdigest()
                file.flush()
                os.fsync(file.fileno())


def _write(data: MinariDataset, layout: Layout, target: Path) -> None:
    # One name a content: what a killed process left there is taken away by the next one, under the lock.
    partial = target.with_name(f".{target.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir()
    files = _Files(partial)
    try:
        try:
            lengths = write_columns(read_parts(data), layout, files.append)
        finally:
            files.close()
        manifest = {"version": VERSION, "columns": files.entries, "lengths": lengths.tolist()}
        write_atomically(partial / MANIFEST, json.dumps(manifest).encode())
        partial.rename(target)
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise


def _open(target: Path, layout: Layout) -> Columns | None:
    if not target.exists():
        return None
    try:
        manifest = json.loads((target / MANIFEST).read_text())
        columns = {
            name: _map(target, number, entry) for number, (name, entry) in enumerate(manifest["columns"].items())
        }
        return assemble(columns, layout, np.asarray(manifest["lengths"], dtype=np.int64))
    except (FileNotFoundError, ValueError, KeyError, TypeError) as error:
        _log.warning("The columns at %s are damaged (%s): they are written again.", target, error)
        shutil.rmtree(target)
        return None


def _map(folder: Path, number: int, entry: dict[str, Any]) -> torch.Tensor:
    path = folder / f"{number:03d}.bin"  # never a name from the manifest
    with path.open("rb") as file:
        found = hashlib.file_digest(file, "sha256").hexdigest()
    if found != entry["sha256"]:
        raise ValueError(f"{path.name} does not match its digest")
    shape = tuple(entry["shape"])
    if 0 in shape:
        return torch.from_numpy(np.zeros(shape, dtype=entry["dtype"]))
    return torch.from_numpy(np.asarray(np.memmap(path, dtype=entry["dtype"], mode="c", shape=shape)))
