"""Configurations and metadata as plain JSON, and back; no code is ever read from a file."""

from __future__ import annotations

import dataclasses
import json
import math
import types
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from minari import MinariDataset
from minari.dataset.minari_storage import MinariStorage
from minari.serialization import serialize_space

from oat_gym.errors import InvalidDataError


def read_json(path: Path) -> Any:
    """Return what a JSON file holds.

    Raises:
        InvalidDataError: if it cannot be read, is no JSON, or is nested too deeply.
    """
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise InvalidDataError(
            f"{path} is damaged, or was not written by oat_gym ({error}). Restore it, or save the dataset again."
        ) from error


def config_from_json(cls: type[Any], value: Mapping[str, Any], *, known: tuple[type[Any], ...] = ()) -> Any:
    """Return the frozen dataclass `cls` whose canonical JSON (`oat_gym.cache.canonical`) is `value`.

    Nested dataclasses are those that the field's annotation names, or one of `known` where the annotation names a
    base class of it; lists become tuples. No other class is ever looked up.

    Raises:
        InvalidDataError: if `value` is not of this class or a field is missing, unknown, of another type than its
            annotation, or out of its range.
    """
    names = {field.name for field in dataclasses.fields(cls)}
    if not isinstance(value, Mapping) or value.get("class") != cls.__name__ or set(value) - {"class"} != names:
        raise InvalidDataError(f"Expected the settings of {cls.__name__} ({', '.join(sorted(names))}), got {value!r}.")
    hints = typing.get_type_hints(cls)
    try:
        return cls(**{name: _field_from_json(hints[name], value[name], known) for name in names})
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        raise InvalidDataError(f"The settings of {cls.__name__} cannot be read: {error}") from error


def _field_from_json(hint: Any, value: Any, known: tuple[type[Any], ...]) -> Any:
    if isinstance(value, Mapping):
        return _nested_from_json(hint, value, known)
    if isinstance(value, list) and any(isinstance(item, Mapping) for item in value):
        items = typing.get_args(hint)
        if typing.get_origin(hint) is not tuple or items[1:] != (...,):
            raise InvalidDataError(f"Settings in a list are given where {hint} is expected.")
        return tuple(_field_from_json(items[0], item, known) for item in value)
    if isinstance(value, list):
        value = _tuples(value)
    if not _fits(hint, value):
        raise InvalidDataError(f"A setting has the value {value!r}, and {hint} is expected.")
    return value


def _nested_from_json(hint: Any, value: Mapping[str, Any], known: tuple[type[Any], ...]) -> Any:
    named = [hint, *typing.get_args(hint)]
    bases = tuple(one for one in named if isinstance(one, type))
    for candidate in (*named, *(one for one in known if issubclass(one, bases))):
        if dataclasses.is_dataclass(candidate) and getattr(candidate, "__name__", "") == value.get("class"):
            return config_from_json(typing.cast("type[Any]", candidate), value, known=known)
    raise InvalidDataError(f"Unknown settings {value.get('class')!r} for a field of type {hint}.")


def _tuples(value: Any) -> Any:
    return tuple(_tuples(item) for item in value) if isinstance(value, list) else value


def _fits(hint: Any, value: Any) -> bool:
    """Return whether a plain value is one that the annotation of a setting allows; NaN is none."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return any(_fits(argument, value) for argument in arguments)
    if origin is typing.Literal:
        return any(type(value) is type(argument) and value == argument for argument in arguments)
    if origin is tuple:
        expected = arguments[:1] * len(value) if arguments[1:] == (...,) and isinstance(value, tuple) else arguments
        return (
            isinstance(value, tuple)
            and len(value) == len(expected)
            and all(_fits(one, item) for one, item in zip(expected, value, strict=True))
        )
    if hint is float:
        return isinstance(value, int | float) and not isinstance(value, bool) and not math.isnan(value)
    if hint is int:
        return isinstance(value, int) and not isinstance(value, bool)
    return hint is Any or (isinstance(hint, type) and isinstance(value, hint))


def metadata_to_json(value: Any) -> Any:
    """Return episode metadata as JSON data: arrays as lists, NumPy scalars as numbers, nested dictionaries kept."""
    if isinstance(value, Mapping):
        return {str(key): metadata_to_json(part) for key, part in value.items()}
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, list | tuple | set):
        return [metadata_to_json(part) for part in value]
    return value


def source_metadata(dataset: MinariDataset) -> dict[str, Any]:
    """Return the raw metadata of a dataset, its spaces written out (old datasets leave them to their environment)."""
    metadata = MinariStorage.read_raw_metadata(dataset.storage.data_path)
    metadata["observation_space"] = serialize_space(dataset.observation_space)
    metadata["action_space"] = serialize_space(dataset.action_space)
    return metadata
