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

from oat_gym._ids import describe_ids
from oat_gym._staging import owned_folder
from oat_gym.cache import write_atomically
from oat_gym.episodes import plain_infos
from oat_gym.errors import ConfigurationError, DatasetExistsError, InvalidDataError, OatGymError, SaveError
from oat_gym.serialization import metadata_to_json
from oat_gym.spaces import in_kind_of, map_tree, tree_length

DataFormat = Literal["hdf5", "arrow", "parquet"]
DATA_FORMATS: tuple[DataFormat, ...] = ("hdf5", "arrow", "parquet")

STORAGE_KEYS = {
    "total_episodes",
    "total_steps",
    "dataset_size",
    "data_format",
    "jpeg_encoding",
    "observation_space",
    "action_space",
}
"""The metadata that a storage writes itself."""
_OWN_KEYS = STORAGE_KEYS | {"env_spec", "dataset_id"}


_STAGING = ".oat_gym-"
_DISK_ERRORS = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EIO}
_ERRNO = re.compile(r"errno = (\d+)")  # how HDF5 tells it in its messages

INFOS_ROWS = "infos_rows"
"""Key of an episode's metadata: how many rows of its infos were recorded, where a first one was added to them."""

_ARROW_ROWS = 32_767  # Minari's arrow reader gives no more rows of an episode than that, and says nothing
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
            f"{dataset_id!r} is no dataset id: expected the form {describe_ids(dataset_id)}."
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
        if is_disk_error(error):
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

    Minari's Arrow and Parquet storage takes infos of T+1 rows only (a row of the reset, then those of the steps).
    Infos of T rows get a copy of their first row before them there, and the episode's metadata says so:
    `infos_rows` is then T, the number of the last rows that were recorded. Integer rewards become floats there, and
    observations and actions of another kind of number than their space get its dtype.

    Args:
        data_path: the dataset's `data` folder.
        dataset_id: the id that the dataset will have.
        episodes: (episode, metadata) in order.
        like: raw metadata of a dataset whose author, scores, environment and so on the new one shares.
        spaces: observation and action space.
        data_format: one of `DATA_FORMATS`.
        step_mask: gives, from an episode's metadata, T booleans to store as `infos["synthetic"]`; None stores none.

    Raises:
        InvalidDataError: for an episode that is too long for the format (`check_length`).
        OSError: if the disk refuses.
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
            length = len(episode.rewards)
            check_length(number, length, data_format)
            for_arrow = data_format != "hdf5"
            mask = None if step_mask is None else step_mask(metadata)
            padded = INFOS_ROWS in metadata or (for_arrow and _has_leaf_of(episode.infos, length))
            kept.append(metadata | {INFOS_ROWS: length} if padded else metadata)
            yield _buffer(number, episode, mask, spaces=spaces, for_arrow=for_arrow)

    with _size_known_later(storage):
        for batch, size in _batches(buffers()):
            ensure_space(data_path, size)
            storage.update_episodes(batch)
        ensure_space(data_path, len(kept) * _EPISODE_OVERHEAD)
        storage.update_episode_metadata([_storable(metadata, data_format) for metadata in kept], range(len(kept)))
    _write_common_metadata(data_path, dataset_id, like)
    storage.update_metadata({"dataset_size": float(storage.get_size())})


def check_length(number: int, length: int, data_format: str) -> None:
    """Check that an episode of `length` steps can be read back from a data format.

    Raises:
        InvalidDataError: if Minari would cut it without a word: Arrow and Parquet give at most 32,767 rows back.
    """
    if data_format != "hdf5" and length + 1 > _ARROW_ROWS:
        raise InvalidDataError(
            f"Episode {number} has {length} steps ({length + 1} observations), and Minari reads at most {_ARROW_ROWS} "
            f"rows of an episode back from data_format={data_format!r}: the rest would be lost. Save it with "
            "data_format='hdf5'."
        )


def _batches(buffers: Iterable[EpisodeBuffer]) -> Iterator[tuple[list[EpisodeBuffer], int]]:
    """Yield the buffers in lists, with the bytes that each list may take on disk."""
    batch: list[EpisodeBuffer] = []
    size = 0
    for buffer in buffers:
        batch.append(buffer)
        size += buffer_bytes(buffer)
        if size > _BATCH_BYTES:
            yield batch, size
            batch, size = [], 0
    if batch:
        yield batch, size


def buffer_bytes(buffer: EpisodeBuffer) -> int:
    """Return the bytes that a buffer may take on disk."""
    return _EPISODE_OVERHEAD + sum(_stored_bytes(part) for part in vars(buffer).values())


def _stored_bytes(part: Any) -> int:
    if isinstance(part, dict):
        return sum(_stored_bytes(value) for value in part.values())
    if isinstance(part, np.ndarray):
        return part.nbytes + _LEAF_OVERHEAD
    if isinstance(part, tuple | list):
        return sum(_stored_bytes(value) for value in part)
    return 4 * len(part) + 16 if isinstance(part, str) else 16


def ensure_space(folder: Path, needed_bytes: int) -> None:
    """Check that `needed_bytes` fit in a folder: HDF5 that meets a full disk half-way can crash the interpreter.

    Raises:
        OSError: if they do not, or the folder cannot be written.
    """
    if hasattr(os, "posix_fallocate"):
        with tempfile.TemporaryFile(dir=folder) as probe, _unsupported_is_fine():
            os.posix_fallocate(probe.fileno(), 0, needed_bytes)
    free = shutil.disk_usage(folder).free
    if free < needed_bytes:
        raise OSError(errno.ENOSPC, f"about {needed_bytes / 1e6:.1f} MB are needed and {free / 1e6:.1f} MB are free")


@contextlib.contextmanager
def _unsupported_is_fine() -> Generator[None]:
    try:
        yield
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.EOPNOTSUPP):
            raise


def _buffer(number: int, episode: EpisodeData, mask: Any, *, spaces: tuple[Any, Any], for_arrow: bool) -> EpisodeBuffer:
    infos: dict[str, Any] | None = plain_infos(episode.infos)
    if mask is not None:
        # Infos have T+1 rows where the environment's reset gave one, else T: the mask takes the same form.
        rows = max(tree_length(infos), len(mask)) if infos else len(mask)
        infos = {**(infos or {}), "synthetic": np.concatenate([np.zeros(rows - len(mask), dtype=bool), mask])}
    if infos and for_arrow:
        infos = map_tree(lambda leaf: _arrow_info(leaf, len(episode.rewards)), infos)
    observations, actions, rewards = episode.observations, episode.actions, episode.rewards
    if (
        for_arrow
    ):  # it reads all episodes as one table, and recorded numbers may be integers where generated ones are not
        observations, actions = in_kind_of(spaces[0], observations), in_kind_of(spaces[1], actions)
        rewards = rewards.astype(np.float64) if rewards.dtype.kind in "biu" else rewards
    return EpisodeBuffer(
        id=number,
        observations=observations,
        actions=actions,
        rewards=rewards,  # pyright: ignore[reportArgumentType]  (Minari takes arrays as well as lists)
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


def _has_leaf_of(infos: Any, rows: int) -> bool:
    infos = plain_infos(infos)
    if isinstance(infos, dict):
        return any(_has_leaf_of(part, rows) for part in infos.values())
    return infos is not None and len(infos) == rows


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


def is_disk_error(error: Exception) -> bool:
    """Return whether an exception tells that the disk refused (full, read-only, failing), HDF5's own ones included."""
    if isinstance(error, OatGymError):
        return False
    told = _ERRNO.search(str(error))
    number = int(told.group(1)) if told else getattr(error, "errno", None)
    return number in _DISK_ERRORS
