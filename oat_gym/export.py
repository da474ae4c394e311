"""Saving: an augmented dataset as an ordinary Minari dataset, or as a recipe. Complete or absent, never between."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import re
import shutil
import tempfile
from collections.abc import Callable, Generator, Iterable, Iterator
from pathlib import Path
from typing import Any, Literal

import numpy as np
from minari import EpisodeData
from minari.data_collector import EpisodeBuffer
from minari.dataset.minari_dataset import parse_dataset_id
from minari.dataset.minari_storage import METADATA_FILE_NAME, MinariStorage
from minari.namespace import NAMESPACE_METADATA_FILENAME
from minari.storage import get_dataset_path

from oat_gym._staging import owned_folder
from oat_gym.cache import write_atomically
from oat_gym.episodes import plain_infos
from oat_gym.errors import ConfigurationError, DatasetExistsError, OatGymError, SaveError
from oat_gym.serialization import metadata_to_json
from oat_gym.spaces import map_tree, tree_length

DataFormat = Literal["hdf5", "arrow", "parquet"]
DATA_FORMATS: tuple[DataFormat, ...] = ("hdf5", "arrow", "parquet")

# Written by the storage itself, or true of the source only.
_OWN_KEYS = {
    "total_episodes",
    "total_steps",
    "dataset_size",
    "data_format",
    "jpeg_encoding",
    "observation_space",
    "action_space",
    "env_spec",
    "dataset_id",
}


_STAGING = ".oat_gym-"
_DISK_ERRORS = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EIO}
_ERRNO = re.compile(r"errno = (\d+)")  # how HDF5 tells it in its messages

_BATCH_BYTES = 64_000_000
_EPISODE_OVERHEAD, _LEAF_OVERHEAD = 4_000, 500  # what HDF5 adds, at most, for attributes and for each array


def check_dataset_id(dataset_id: str) -> Path:
    """Return the folder of a new dataset.

    Raises:
        ConfigurationError: if the id is not of Minari's form `namespace/name-v0`, or its namespace is a dataset.
        DatasetExistsError: if there is a dataset of this id.
        SaveError: if Minari's folder of datasets cannot be made.
    """
    try:
        parse_dataset_id(dataset_id)
    except (TypeError, ValueError) as error:
        raise ConfigurationError(
            f"{dataset_id!r} is no dataset id: expected (namespace/)name-v(version), for example 'door/human-oat-v0'."
        ) from error
    try:
        path = get_dataset_path(dataset_id)
        exists = os.path.lexists(path)
    except OSError as error:
        raise _save_error(dataset_id, error) from error
    if exists:
        raise _exists_error(dataset_id, path)
    inside = [parent for parent in _namespaces(path) if (parent / "data").exists()]
    if inside:
        raise ConfigurationError(f"{dataset_id!r} lies inside the dataset at {inside[0]}: choose another namespace.")
    return path


@contextlib.contextmanager
def new_dataset_folder(dataset_id: str) -> Generator[Path]:
    """Give the empty `data` folder of a new dataset; when the block ends well it moves to its place in one step.

    The work is done in a hidden folder beside the datasets, which Minari does not list; it is removed when the block
    fails, and a folder left by a killed process is removed by the next save on the same machine.

    Raises:
        DatasetExistsError: if there is a dataset of this id, at the start or (made by another process) at the end.
        SaveError: if the disk refuses.
    """
    path = check_dataset_id(dataset_id).resolve()
    root = get_dataset_path().resolve()  # Minari cannot measure a folder by a relative path
    try:
        staging = owned_folder(_STAGING, root)
    except OSError as error:
        raise _save_error(dataset_id, error) from error
    try:
        folder = staging / path.name  # mkdtemp's own folder is for its owner only
        (folder / "data").mkdir(parents=True)
        yield folder / "data"
        _publish(folder, path, dataset_id)
    except (OSError, RuntimeError, ValueError) as error:  # HDF5 tells a full disk by any of them
        if _is_disk_error(error):
            raise _save_error(dataset_id, error) from error
        raise
    finally:
        shutil.rmtree(staging, ignore_errors=True)


def _publish(folder: Path, path: Path, dataset_id: str) -> None:
    check_dataset_id(dataset_id)
    try:
        _make_namespaces(path, folder.parent)
        folder.rename(path)
    except OSError as error:
        raise (_exists_error(dataset_id, path) if path.exists() else _save_error(dataset_id, error)) from error


def write_dataset(
    data_path: Path,
    dataset_id: str,
    episodes: Iterable[tuple[EpisodeData, dict[str, Any]]],
    *,
    like: dict[str, Any],
    spaces: tuple[Any, Any],
    data_format: DataFormat,
    step_mask: Callable[[dict[str, Any]], Any] | None = None,
) -> None:
    """Write episodes and their metadata as the dataset `dataset_id` into the empty folder `data_path`.

    Args:
        data_path: the dataset's `data` folder.
        dataset_id: the id that the dataset will have.
        episodes: (episode, metadata) in order.
        like: raw metadata of a dataset whose author, scores, environment and so on the new one shares.
        spaces: observation and action space.
        data_format: one of `DATA_FORMATS`.
        step_mask: gives, from an episode's metadata, T booleans to store as `infos["synthetic"]`; None stores none.
    """
    data_path.rmdir()
    storage = MinariStorage.new(
        data_path,
        observation_space=spaces[0],
        action_space=spaces[1],
        data_format=data_format,
        jpeg_encoding=False,  # what was iterated is what is stored, to the last bit
    )
    kept: list[dict[str, Any]] = []

    def buffers() -> Iterator[EpisodeBuffer]:
        for number, (episode, metadata) in enumerate(episodes):
            kept.append(metadata)
            mask = None if step_mask is None else step_mask(metadata)
            yield _buffer(number, episode, mask, for_arrow=data_format != "hdf5")

    with _size_known_later(storage):
        for batch, size in _batches(buffers()):
            _ensure_space(data_path, size)
            storage.update_episodes(batch)
        _ensure_space(data_path, len(kept) * _EPISODE_OVERHEAD)
        storage.update_episode_metadata([_storable(metadata, data_format) for metadata in kept], range(len(kept)))
    _write_common_metadata(data_path, dataset_id, like)
    storage.update_metadata({"dataset_size": float(storage.get_size())})


def _batches(buffers: Iterable[EpisodeBuffer]) -> Iterator[tuple[list[EpisodeBuffer], int]]:
    """Yield the buffers in lists, with the bytes that each list may take on disk."""
    batch: list[EpisodeBuffer] = []
    size = 0
    for buffer in buffers:
        batch.append(buffer)
        size += _EPISODE_OVERHEAD + sum(_stored_bytes(part) for part in vars(buffer).values())
        if size > _BATCH_BYTES:
            yield batch, size
            batch, size = [], 0
    if batch:
        yield batch, size


def _stored_bytes(part: Any) -> int:
    if isinstance(part, dict):
        return sum(_stored_bytes(value) for value in part.values())
    if isinstance(part, np.ndarray):
        return part.nbytes + _LEAF_OVERHEAD
    if isinstance(part, tuple | list):
        return sum(_stored_bytes(value) for value in part)
    return 4 * len(part) + 16 if isinstance(part, str) else 16


def _ensure_space(folder: Path, needed: int) -> None:
    """Raise OSError where `needed` bytes do not fit: HDF5 that meets a full disk half-way can crash the interpreter."""
    if hasattr(os, "posix_fallocate"):
        with tempfile.TemporaryFile(dir=folder) as probe, _unsupported_is_fine():
            os.posix_fallocate(probe.fileno(), 0, needed)
    free = shutil.disk_usage(folder).free
    if free < needed:
        raise OSError(errno.ENOSPC, f"about {needed / 1e6:.1f} MB are needed and {free / 1e6:.1f} MB are free")


@contextlib.contextmanager
def _unsupported_is_fine() -> Generator[None]:
    try:
        yield
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.EOPNOTSUPP):
            raise


def _buffer(number: int, episode: EpisodeData, mask: Any, *, for_arrow: bool) -> EpisodeBuffer:
    infos: dict[str, Any] | None = plain_infos(episode.infos)
    if mask is not None:
        # Infos have T+1 rows where the environment's reset gave one, else T: the mask takes the same form.
        rows = max(tree_length(infos), len(mask)) if infos else len(mask)
        infos = {**(infos or {}), "synthetic": np.concatenate([np.zeros(rows - len(mask), dtype=bool), mask])}
    if infos and for_arrow:
        infos = map_tree(lambda leaf: _arrow_info(leaf, len(episode.rewards)), infos)
    return EpisodeBuffer(
        id=number,
        observations=episode.observations,
        actions=episode.actions,
        rewards=episode.rewards,  # pyright: ignore[reportArgumentType]  (Minari takes arrays as well as lists)
        terminations=episode.terminations,  # pyright: ignore[reportArgumentType]
        truncations=episode.truncations,  # pyright: ignore[reportArgumentType]
        infos=infos,
    )


def _arrow_info(leaf: Any, length: int) -> Any:
    """Return an info as Minari's arrow storage takes it: T+1 rows (the first one doubled), flat ones as a list.

    Its writer refuses infos of T rows, and its reader fails on one-dimensional arrays.
    """
    if isinstance(leaf, np.ndarray):
        leaf = np.concatenate([leaf[:1], leaf]) if len(leaf) == length else leaf
        return list(leaf) if leaf.ndim == 1 else leaf
    return [*leaf[:1], *leaf] if len(leaf) == length else leaf


def _storable(metadata: dict[str, Any], data_format: str) -> dict[str, Any]:
    metadata = {key: value for key, value in metadata.items() if key not in ("id", "total_steps") and value is not None}
    return _flatten(metadata) if data_format == "hdf5" else metadata_to_json(metadata)


def _flatten(metadata: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return nested metadata as HDF5 attributes: Minari joins the keys by a slash."""
    flat: dict[str, Any] = {}
    for key, value in metadata.items():
        flat |= _flatten(value, f"{prefix}{key}/") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return flat


def _write_common_metadata(data_path: Path, dataset_id: str, like: dict[str, Any]) -> None:
    path = data_path / METADATA_FILE_NAME
    metadata = json.loads(path.read_text())
    metadata |= {key: value for key, value in like.items() if key not in _OWN_KEYS}
    if "env_spec" in like:
        metadata["env_spec"] = like["env_spec"]
    write_atomically(path, json.dumps(metadata | {"dataset_id": dataset_id}).encode())


@contextlib.contextmanager
def _size_known_later(storage: MinariStorage) -> Generator[None]:
    """Keep a storage from measuring its folder at each episode, which makes arrow exports quadratic."""
    storage.get_size = lambda: 0.0
    try:
        yield
    finally:
        del storage.get_size


def _namespaces(path: Path) -> list[Path]:
    """Return the folders of the namespaces of the dataset at `path`, the nearest first."""
    root = get_dataset_path().resolve()
    return [parent for parent in path.resolve().parents if parent.is_relative_to(root) and parent != root]


def _make_namespaces(path: Path, staging: Path) -> None:
    """Make them as Minari does, but so that neither a kill nor another process at the same work can spoil them."""
    for folder in _namespaces(path):
        folder.mkdir(parents=True, exist_ok=True)
        if not (folder / NAMESPACE_METADATA_FILENAME).exists():
            (staging / NAMESPACE_METADATA_FILENAME).write_bytes(b"{}")
            (staging / NAMESPACE_METADATA_FILENAME).replace(folder / NAMESPACE_METADATA_FILENAME)


def _exists_error(dataset_id: str, path: Path) -> DatasetExistsError:
    return DatasetExistsError(
        f"A dataset {dataset_id!r} is already at {path}; nothing was written. Choose another name or version, or "
        f"remove it with `minari delete {dataset_id}`."
    )


def _save_error(dataset_id: str, error: Exception) -> SaveError:
    folder = os.environ.get("MINARI_DATASETS_PATH") or "Minari's folder of datasets"
    return SaveError(
        f"The dataset {dataset_id!r} could not be written to {folder} ({error}); nothing of it was left there. Free "
        "some space, or name a folder that can be written in MINARI_DATASETS_PATH."
    )


def _is_disk_error(error: Exception) -> bool:
    if isinstance(error, OatGymError):
        return False
    told = _ERRNO.search(str(error))
    number = int(told.group(1)) if told else getattr(error, "errno", None)
    return number in _DISK_ERRORS
