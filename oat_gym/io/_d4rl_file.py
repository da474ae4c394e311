"""D4RL's HDF5 layout as a flat dictionary ("infos/qpos" -> array), read without following links and written whole."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from oat_gym.errors import DatasetExistsError, DatasetNotFoundError, InvalidDataError, OatGymError, SaveError

Array = npt.NDArray[Any]
Value = Array | list[str] | str
"""Numbers of any shape, one text a row, or one text."""

Flat = dict[str, Value]

_MAX_DEPTH = 16
_BLOCK_BYTES = 1 << 20


def read_flat(path: Path) -> Flat:
    """Return every dataset of an HDF5 file under its path. The file is closed again, whatever happens.

    Raises:
        DatasetNotFoundError: if there is no such file.
        InvalidDataError: if it is no HDF5 file, is damaged, or refers to data outside itself.
    """
    if not path.is_file():
        raise DatasetNotFoundError(f"There is no file {path}; give the path of a D4RL HDF5 file.")
    try:
        with h5py.File(path, "r") as file:
            return {name: plain_value(name, item[()]) for name, item in _datasets(file, "", 0)}
    except InvalidDataError as error:
        raise InvalidDataError(f"{path}: {error}") from error
    except (OSError, RuntimeError, KeyError, ValueError) as error:
        raise InvalidDataError(
            f"{path} cannot be read as HDF5 ({error}): it is another kind of file, or is truncated or damaged. Get it "
            "again."
        ) from error


def flatten_mapping(data: Mapping[str, Any], prefix: str = "") -> Flat:
    """Return a dictionary of arrays, nested or with keys such as "infos/qpos", in the form that `read_flat` gives.

    Raises:
        InvalidDataError: for values that are neither numbers nor text.
    """
    flat: Flat = {}
    for key, value in data.items():
        name = f"{prefix}{key}"
        found = flatten_mapping(value, f"{name}/") if isinstance(value, Mapping) else {name: plain_value(name, value)}
        if set(found) & set(flat):
            raise InvalidDataError(f"The dictionary has {sorted(set(found) & set(flat))} twice.")
        flat |= found
    for name in flat:
        parent = name.rpartition("/")[0]
        if parent in flat and parent != "infos":
            raise InvalidDataError(f"The dictionary has both {parent!r} and {name!r}; a name is an array or a group.")
    return flat


def write_flat(path: Path, values: Mapping[str, Value]) -> None:
    """Write values as an HDF5 file at `path`, which then is complete or absent; an existing file is never replaced.

    Raises:
        DatasetExistsError: if `path` exists.
        SaveError: if the disk refuses.
    """
    image = _image(values)
    try:
        _write_bytes(path, image)
    except OatGymError:
        raise
    except OSError as error:
        raise SaveError(
            f"{path} could not be written ({error}); nothing of it was left there. Free some space, or name a file in "
            "a folder that can be written."
        ) from error


def _image(values: Mapping[str, Value]) -> bytes:
    # In memory: HDF5 that meets a full disk can crash the interpreter.
    with h5py.File("image", "w", driver="core", backing_store=False, block_size=_BLOCK_BYTES) as file:
        for key, value in values.items():
            _write_value(file, key, value)
        file.flush()
        return file.id.get_file_image()


def _write_bytes(path: Path, data: bytes) -> None:
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    temporary = Path(name)
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        temporary.chmod(0o644)  # mkstemp keeps others out, which a data file should not
        _publish(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def plain_value(name: str, value: Any) -> Value:
    """Return numbers as an array, and text (bytes too) as strings.

    Raises:
        InvalidDataError: for anything else.
    """
    if isinstance(value, str | bytes):
        return _text(name, value)
    try:
        array = np.asarray(value)
    except ValueError as error:
        raise InvalidDataError(f"{name!r} is no array: {error}") from error
    if array.dtype.kind in "biufc":
        return array
    items = array.tolist()
    if array.ndim == 0 and isinstance(items, str | bytes):
        return _text(name, items)
    if array.ndim != 1 or not all(isinstance(item, str | bytes) for item in items):
        raise InvalidDataError(
            f"{name!r} holds {array.dtype} values of shape {array.shape}; expected numbers, booleans, or one text a "
            "row. Convert it or leave it out."
        )
    return [_text(name, item) for item in items]


def _text(name: str, value: str | bytes) -> str:
    try:
        text = value.decode("utf-8") if isinstance(value, bytes) else str(value)
    except UnicodeDecodeError as error:
        raise InvalidDataError(f"{name!r} holds bytes that are not UTF-8 text: {error}.") from error
    if "\0" in text:
        raise InvalidDataError(f"{name!r} holds text with a NUL character, which HDF5 cannot store.")
    return text


def _datasets(group: Any, prefix: str, depth: int) -> Iterator[tuple[str, Any]]:
    if depth > _MAX_DEPTH:
        raise InvalidDataError(f"its groups are nested over {_MAX_DEPTH} deep ({prefix}).")
    for key in group:
        name = f"{prefix}{key}"
        if not isinstance(group.get(key, getlink=True), h5py.HardLink):
            raise InvalidDataError(f"{name!r} is a link; links are not followed. Copy the data into the file.")
        item = group[key]
        if isinstance(item, h5py.Group):
            yield from _datasets(item, f"{name}/", depth + 1)
        elif isinstance(item, h5py.Dataset):
            if item.external or item.is_virtual:
                raise InvalidDataError(f"{name!r} keeps its data in other files. Copy the data into the file.")
            yield name, item


def _write_value(file: Any, name: str, value: Value) -> None:
    if isinstance(value, str | list):
        file.create_dataset(name, data=value, dtype=h5py.string_dtype())
    else:
        compression = "gzip" if value.ndim and value.size else None  # HDF5 compresses neither scalars nor nothing
        file.create_dataset(name, data=value, compression=compression)


def _publish(temporary: Path, path: Path) -> None:
    taken = DatasetExistsError(f"{path} is already there and was left as it is; choose another name or remove it.")
    try:
        os.link(temporary, path)  # unlike a rename, a link never replaces a file that appeared meanwhile
    except FileExistsError as error:
        raise taken from error
    except OSError as error:  # a file system without hard links
        if path.exists():
            raise taken from error
        temporary.replace(path)
