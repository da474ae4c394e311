"""What D4RL's flat layout has no place for, kept as one JSON text in the file's `metadata/oat_gym/note`.

Readers of D4RL pass over it. It makes the round trip through `write_d4rl` and `read_d4rl` exact: where episodes end,
which ends carried which flags, the spaces, and the metadata of dataset and episodes.
"""

from __future__ import annotations

import base64
import binascii
import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from gymnasium import spaces
from minari.serialization import deserialize_space

from oat_gym.errors import InvalidDataError
from oat_gym.io._d4rl_file import Flat, Value

NOTE = "metadata/oat_gym/note"
RESET_INFOS = "metadata/oat_gym/reset_infos/"
METADATA = "metadata/"
FORMAT = 1


@dataclass(frozen=True)
class Note:
    """Facts beside the rows.

    `lengths` (one an episode) sum to the number of rows. `unflagged` are the episodes whose end had no flag, though the
    file marks it as a timeout; `doubly` those that ended with both flags, though the file has the terminal only.
    `observation_space` and `action_space` are Minari's serialised spaces, `metadata` is Minari's raw metadata and
    `episodes` that of each episode.
    """

    lengths: tuple[int, ...]
    unflagged: tuple[int, ...]
    doubly: tuple[int, ...]
    observation_space: str
    action_space: str
    metadata: dict[str, Any]
    episodes: tuple[dict[str, Any], ...]

    def to_text(self) -> str:
        """Return the note as JSON.

        Raises:
            InvalidDataError: for metadata of other types.
        """
        try:
            return json.dumps({"format": FORMAT, **asdict(self)}, sort_keys=True)
        except TypeError as error:
            raise InvalidDataError(
                f"The metadata of the dataset or of its episodes has no JSON form: {error}."
            ) from error

    def spaces(self) -> tuple[spaces.Space[Any], spaces.Space[Any]]:
        """Return the observation and the action space."""
        try:
            return deserialize_space(self.observation_space), deserialize_space(self.action_space)
        # Gymnasium asserts what its spaces need; NotImplementedError is Minari's answer to an unknown space.
        except (ArithmeticError, AssertionError, LookupError, NotImplementedError, TypeError, ValueError) as error:
            raise InvalidDataError(f"{NOTE!r} names spaces that cannot be read: {error!r}.") from error


def read_note(flat: Flat) -> Note | None:
    """Return the note of a file, or None where another program wrote the file.

    Raises:
        InvalidDataError: if it is damaged or of a newer format.
    """
    if NOTE not in flat:
        return None
    try:
        values = json.loads(str(flat[NOTE]))
        if values.pop("format") != FORMAT:
            raise InvalidDataError(f"{NOTE!r} is of another format than {FORMAT}: update oat_gym.")
        for name in ("lengths", "unflagged", "doubly"):
            values[name] = tuple(int(number) for number in values[name])
        values["episodes"] = tuple(dict(part) for part in values["episodes"])
        values["metadata"] = dict(values["metadata"])
        note = Note(**values)
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        if isinstance(error, InvalidDataError):
            raise
        raise InvalidDataError(f"{NOTE!r} is damaged: {error!r}. Delete it to read the rows alone.") from error
    known = range(len(note.lengths))
    if (
        min(note.lengths, default=0) < 1
        or len(note.episodes) != len(known)
        or not {*note.unflagged, *note.doubly} <= {*known}
    ):
        raise InvalidDataError(f"{NOTE!r} speaks of episodes that it has no lengths for: it is damaged.")
    return note


def metadata_to_json(flat: Flat) -> dict[str, Any]:
    """Return the `metadata/*` of a file, nested, as JSON data: plain numbers and text, other arrays by their bytes."""
    tree: dict[str, Any] = {}
    for name, value in flat.items():
        if not name.startswith(METADATA) or name == NOTE or name.startswith(RESET_INFOS):
            continue
        *parents, last = name.removeprefix(METADATA).split("/")
        branch = tree
        for key in parents:
            branch = branch.setdefault(key, {})
        branch[last] = _encode(value)
    return tree


def metadata_from_json(tree: Mapping[str, Any], prefix: str = METADATA) -> Flat:
    """Return what `metadata_to_json` made of a file's `metadata/*`, as it was.

    Raises:
        InvalidDataError: if the tree was not made by it.
    """
    flat: Flat = {}
    for key, value in tree.items():
        if not isinstance(value, Mapping):
            flat[f"{prefix}{key}"] = _decode(f"{prefix}{key}", value)
        elif "base64" in value:
            flat[f"{prefix}{key}"] = _decode_array(f"{prefix}{key}", value)
        else:
            flat |= metadata_from_json(value, f"{prefix}{key}/")
    return flat


def _encode(value: Value) -> Any:
    if isinstance(value, str | list):
        return value
    if value.ndim == 0 and value.dtype in (np.dtype(bool), np.dtype(np.int64), np.dtype(np.float64)):
        number = value.item()
        if math.isfinite(number):
            return number
    data = base64.b64encode(np.ascontiguousarray(value).tobytes()).decode()
    return {"dtype": value.dtype.str, "shape": list(value.shape), "base64": data}


def _decode(name: str, value: Any) -> Value:
    if isinstance(value, str) or (isinstance(value, list) and all(isinstance(item, str) for item in value)):
        return value
    if isinstance(value, bool | int | float):
        return np.array(value)
    raise InvalidDataError(f"The dataset's metadata has {value!r} as {name!r}, which read_d4rl did not write.")


def _decode_array(name: str, value: Mapping[str, Any]) -> Value:
    try:
        data = base64.b64decode(value["base64"], validate=True)
        return np.frombuffer(data, dtype=np.dtype(value["dtype"])).reshape(value["shape"]).copy()
    except (KeyError, TypeError, ValueError, binascii.Error) as error:
        raise InvalidDataError(f"The dataset's metadata {name!r} is damaged: {error}.") from error
