"""Where the real data is, and where datasets converted from it are kept."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from pathlib import Path

import minari

from oat_gym.cache import fingerprint
from oat_gym.errors import DatasetNotFoundError
from oat_gym.io._cached_dataset import cached_dataset


def data_folder() -> Path | None:
    """Return the folder of real data: what OAT_GYM_DATA names, else `../shared/data` beside a source checkout.

    None where neither is given. Loaders then say how to get the data.

    Raises:
        DatasetNotFoundError: if OAT_GYM_DATA names no folder.
    """
    named = os.environ.get("OAT_GYM_DATA")
    if named:
        if not Path(named).is_dir():
            raise DatasetNotFoundError(f"OAT_GYM_DATA={named} is not a folder; correct it or unset it.")
        return Path(named)
    beside = Path(__file__).resolve().parents[3] / "shared" / "data"
    return beside if beside.is_dir() else None


def find_file(relative: str, *, path: str | os.PathLike[str] | None, how_to_get: str) -> Path:
    """Return the data file `relative` (as "tutoring/log.csv") of the data folder.

    Where `path` is given it is looked up instead: the file itself, or a folder that holds it under its own name or
    under `relative`.

    Raises:
        DatasetNotFoundError: if the file is not there. The message ends with `how_to_get`.
    """
    root = Path(path) if path is not None else data_folder()
    if root is not None:
        for candidate in (root, root / relative, root / Path(relative).name):
            if candidate.is_file():
                return candidate
    looked = "no data folder is set" if root is None else f"looked in {root}"
    raise DatasetNotFoundError(f"{Path(relative).name} was not found ({looked}). {how_to_get}")


def converted(
    name: str, source: Path, *, version: int, write: Callable[[Path], minari.MinariDataset]
) -> minari.MinariDataset:
    """Return the dataset converted from `source`, from the cache where it was converted before.

    `write` gets the folder to make, as `dataset_from_episodes` takes it. The cache knows the conversion by the source's
    bytes, the converter's `version` and Minari's (which refuses data of a newer one), so changed data or code never
    meets an old one.
    """
    content = hashlib.sha256(source.read_bytes()).hexdigest()
    return generated(write, domain=name, content=content, version=version)


def generated(write: Callable[[Path], minari.MinariDataset], **key: object) -> minari.MinariDataset:
    """Return the dataset that `write` makes, from the cache where it was made before.

    The cache knows it by `key` (name, size, seed, version of the code, whatever the data depends on) and Minari's
    version.
    """

    def fill(data: Path) -> None:
        made = data.parent / "made"
        write(made)
        data.rmdir()
        (made / "data").rename(data)
        made.rmdir()

    return cached_dataset(fingerprint(minari=minari.__version__, **key), fill)
