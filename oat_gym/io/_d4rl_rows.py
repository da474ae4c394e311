"""The rows of a D4RL file, checked; every break of the layout is a named error."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces

from oat_gym.episodes import BoolArray
from oat_gym.errors import ConfigurationError, InvalidDataError, UnsupportedSpaceError
from oat_gym.io._d4rl_file import Array, Flat
from oat_gym.io._d4rl_note import METADATA, RESET_INFOS, Note, read_note

ArraySpace = spaces.Box | spaces.Discrete | spaces.MultiDiscrete | spaces.MultiBinary
"""The spaces whose batches are one array, which is all that the layout holds."""

REQUIRED = ("observations", "actions", "rewards", "terminals")
OPTIONAL = ("timeouts", "next_observations")


@dataclass(frozen=True)
class Rows:
    """N rows, one a step.

    `observations` and `next_observations` are (N, ...), `actions` (N, ...), `rewards`, `terminals` and `timeouts` (N,).
    `infos` has N rows a key ("goal/position" where nested); `reset_infos` one row an episode.
    """

    observations: Array
    actions: Array
    rewards: Array
    terminals: BoolArray
    timeouts: BoolArray | None
    next_observations: Array | None
    infos: dict[str, Array | list[str]]
    reset_infos: dict[str, Array | list[str]]
    note: Note | None

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.rewards)


def rows_of(flat: Flat) -> Rows:
    """Return the checked rows of a flat dictionary of D4RL's keys.

    Raises:
        InvalidDataError: for missing and unknown keys, lengths or shapes that disagree, NaN, and flags that are not 0
            or 1.
    """
    _check_keys(flat)
    rewards = _column(flat, "rewards")
    if not len(rewards):
        raise InvalidDataError("'rewards' has no rows; at least one is needed.")
    infos = {name.removeprefix("infos/"): flat[name] for name in flat if name.startswith("infos/")}
    if "infos" in flat and np.size(
        flat["infos"]
    ):  # some files (kitchen) have one dataset of this name, or an empty one
        infos["infos"] = flat["infos"]
    rows = Rows(
        observations=_numbers(flat, "observations"),
        actions=_numbers(flat, "actions"),
        rewards=rewards,
        terminals=_flags(flat, "terminals"),
        timeouts=_flags(flat, "timeouts") if "timeouts" in flat else None,
        next_observations=_numbers(flat, "next_observations") if "next_observations" in flat else None,
        infos={name: _info_rows(name, value, len(rewards)) for name, value in infos.items()},
        reset_infos=_reset_infos(flat),
        note=read_note(flat),
    )
    _check_lengths(rows)
    return rows


def spaces_of(
    rows: Rows, observation_space: spaces.Space[Any] | None, action_space: spaces.Space[Any] | None
) -> tuple[spaces.Space[Any], spaces.Space[Any]]:
    """Return the spaces: those given, else those noted in the file, else unbounded boxes of the data's dtype.

    Raises:
        ConfigurationError: for whole-number data of which nothing says the range.
        InvalidDataError: if the data is not in its space.
        UnsupportedSpaceError: for a space whose batches are not one array.
    """
    noted = rows.note.spaces() if rows.note else (None, None)
    found = (
        observation_space or noted[0] or _box("observation", rows.observations),
        action_space or noted[1] or _box("action", rows.actions),
    )
    parts = [("observation", found[0], {"observations": rows.observations})]
    parts.append(("action", found[1], {"actions": rows.actions}))
    if rows.next_observations is not None:
        parts[0][2]["next_observations"] = rows.next_observations
    for role, space, arrays in parts:
        for name, values in arrays.items():
            check_inside(name, values, array_space(role, space))
    return found


def array_space(role: str, space: spaces.Space[Any]) -> ArraySpace:
    """Return the space if the layout holds it; `UnsupportedSpaceError` if not."""
    if isinstance(space, ArraySpace):
        return space
    raise UnsupportedSpaceError(
        f"The {role} space is {space}, and D4RL's layout holds one array a step: Box, Discrete, MultiDiscrete or "
        "MultiBinary. Flatten it first (oat_gym.spaces.FlatSpace)."
    )


def check_inside(name: str, values: Array, space: ArraySpace) -> None:
    """Raise `InvalidDataError` unless every row of `values` is in the space (up to its dtype)."""
    if values.shape[1:] != (space.shape or ()):
        raise InvalidDataError(f"{name!r} has rows of shape {values.shape[1:]}, and {space} has shape {space.shape}.")
    if not isinstance(space, spaces.Box) and values.dtype.kind not in "biu":
        raise InvalidDataError(f"{name!r} holds {values.dtype} values; {space} needs whole numbers: convert them.")
    low, high = _bounds(space)
    outside = any_in_row(~((values >= low) & (values <= high)))
    if outside.any():
        row = int(outside.argmax())
        raise InvalidDataError(
            f"{name!r} leaves {space} in {int(outside.sum())} rows, the first {row} ({values[row]}); correct the "
            "values or give a wider space."
        )


def any_in_row(mask: BoolArray) -> BoolArray:
    """Return (N,) whether any entry of each row of an (N, ...) mask is true."""
    return np.asarray(mask.any(axis=tuple(range(1, mask.ndim))))


def _bounds(space: ArraySpace) -> tuple[Any, Any]:
    if isinstance(space, spaces.Box):
        return space.low, space.high
    if isinstance(space, spaces.Discrete):
        return space.start, space.start + space.n - 1
    if isinstance(space, spaces.MultiDiscrete):
        return space.start, space.start + space.nvec - 1
    return 0, 1


def _box(role: str, values: Array) -> spaces.Box:
    if values.dtype.kind != "f":
        raise ConfigurationError(
            f"The {role}s are {values.dtype} values, and nothing in the data says their range: pass {role}_space, for "
            "example gymnasium.spaces.Discrete(n)."
        )
    return spaces.Box(-np.inf, np.inf, values.shape[1:], values.dtype.type)


def _check_keys(flat: Flat) -> None:
    missing = [name for name in REQUIRED if name not in flat]
    if missing:
        raise InvalidDataError(f"The keys {missing} are missing; there are {sorted(flat)}. D4RL's layout needs them.")
    known = (*REQUIRED, *OPTIONAL, "infos")
    unknown = [name for name in flat if name not in known and not name.startswith(("infos/", METADATA))]
    if unknown:
        raise InvalidDataError(
            f"The keys {unknown} are not of D4RL's layout. Pass a dictionary without them, or with them as 'infos/...' "
            "(one row a step) or 'metadata/...'."
        )


def _numbers(flat: Flat, name: str) -> Array:
    values = flat[name]
    if isinstance(values, str | list) or not values.ndim:
        raise InvalidDataError(f"{name!r} is {'text' if isinstance(values, str | list) else 'one number'}, not rows.")
    if values.dtype.kind == "c":
        raise InvalidDataError(f"{name!r} holds complex numbers; expected real ones.")
    bad = any_in_row(np.isnan(values))
    if bad.any():
        raise InvalidDataError(
            f"{name!r} has NaN in {int(bad.sum())} rows, the first {int(bad.argmax())}; drop or repair their episodes."
        )
    return values


def _column(flat: Flat, name: str) -> Array:
    values = _numbers(flat, name)
    if values.ndim == 2 and values.shape[1] == 1:
        values = values[:, 0]
    if values.ndim != 1:
        raise InvalidDataError(f"{name!r} has shape {values.shape}; expected (N,) or (N, 1).")
    return values


def _flags(flat: Flat, name: str) -> BoolArray:
    values = _column(flat, name)
    wrong = (values != 0) & (values != 1)
    if wrong.any():
        row = int(wrong.argmax())
        raise InvalidDataError(f"{name!r} has {values[row]} in row {row}; flags are 0 or 1.")
    return values.astype(bool)


def _info_rows(name: str, values: Any, n: int) -> Array | list[str]:
    if isinstance(values, str) or not np.ndim(values):
        raise InvalidDataError(
            f"'infos/{name}' is a single value; infos have one row a step. Put it under 'metadata/'."
        )
    if len(values) != n:
        raise InvalidDataError(f"'infos/{name}' has {len(values)} rows and 'rewards' {n}; infos have one row a step.")
    return values


def _reset_infos(flat: Flat) -> dict[str, Array | list[str]]:
    found: dict[str, Array | list[str]] = {}
    for name, value in flat.items():
        if name.startswith(RESET_INFOS):
            if isinstance(value, str):
                raise InvalidDataError(f"{name!r} is a single text; expected one row an episode.")
            found[name.removeprefix(RESET_INFOS)] = value
    return found


def _check_lengths(rows: Rows) -> None:
    for name in (*REQUIRED, *OPTIONAL):
        values = getattr(rows, name)
        if values is not None and len(values) != len(rows):
            raise InvalidDataError(f"{name!r} has {len(values)} rows and 'rewards' {len(rows)}; they must agree.")
    following = rows.next_observations
    if following is not None and following.shape != rows.observations.shape:
        raise InvalidDataError(
            f"'next_observations' has shape {following.shape} and 'observations' {rows.observations.shape}."
        )
    if following is not None and following.dtype != rows.observations.dtype:
        raise InvalidDataError(
            f"'next_observations' is {following.dtype} and 'observations' {rows.observations.dtype}; convert one."
        )
    if rows.note and sum(rows.note.lengths) != len(rows):
        raise InvalidDataError(
            f"There are {len(rows)} rows, and 'metadata/oat_gym/note' speaks of {sum(rows.note.lengths)}: the file was "
            "edited after oat_gym wrote it. Pass a dictionary without that key to read the rows alone."
        )
    for name, value in rows.reset_infos.items():
        if rows.note is None or name not in rows.infos or len(value) != len(rows.note.lengths):
            raise InvalidDataError(f"'{RESET_INFOS}{name}' matches neither the episodes nor 'infos/{name}'.")
