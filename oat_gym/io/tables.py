"""Episodes from a table of logged decisions, one row a decision.

A log of T rows holds T observations and no observation after the last action, so the T+1 rule needs a decision that
depends on how the episode ended. See `episodes_from_table`; `oat_gym.io.writing` makes a Minari dataset of the result.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Sequence
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
from minari.data_collector import EpisodeBuffer

from oat_gym.errors import ConfigurationError, InvalidDataError
from oat_gym.io.writing import episode_buffer

Array = npt.NDArray[Any]
Columns = str | Sequence[str]
"""One column, or several that form a vector in this order."""

_NAMES_SHOWN = 30
"""Most column names that an error lists."""


class Table(Protocol):
    """Anything whose `table[name]` is a column: a dict of arrays, a pandas or polars frame, a pyarrow table."""

    def __getitem__(self, key: str, /) -> Any:
        """Return one column."""
        ...


def episodes_from_table(  # noqa: PLR0917  (the columns are part of the data)
    frame: Table,
    episode: str,
    order: str,
    observations: Columns,
    action: Columns,
    reward: str,
    time: str | None = None,
    propensity: str | None = None,
    *,
    terminated: bool | str = True,
    infos: Sequence[str] = (),
    consecutive: bool | None = None,
) -> list[EpisodeBuffer]:
    """Return the episodes of a log (a row a decision, in any order), in the order of `np.unique` of their ids.

    The log lacks the observation after an episode's last action. An episode that **terminated** keeps its L rows as
    T = L steps, and its last observation is repeated at the end (no method looks beyond a terminal step). One that was
    **cut off** has T = L - 1 steps, since where its last action led is unknown. Infos have T rows, one a step.

    Args:
        frame: pandas or polars frame, pyarrow table, or a mapping from column names to arrays.
        episode: column of episode ids (numbers or strings).
        order: column that orders the rows of an episode (numbers or dates).
        observations: one column, or several that form vectors; they become float64.
        action: one column, or several that form vectors; numbers stay as they are (`dataset_from_episodes` makes
            integers of booleans and whole floats for a Discrete space).
        reward: column of rewards.
        time: column of times (numbers or dates), given back as `infos["time"]`, in seconds where it holds dates.
        propensity: column with the probability that the action taken had, in (0, 1]; gives `infos["log_prob"]`.
        terminated: True or False for all episodes, or a column that is 1 in the last row of those that terminated.
        infos: further columns, each given back as `infos[column]`.
        consecutive: require `order` to go up by exactly 1 in each episode, so that a lost row is an error; None, the
            default: where it holds integers. Give False where they are times, or other numbers with gaps.

    Raises:
        ConfigurationError: for what is no table, a table that lacks a column, and another `terminated`.
        InvalidDataError: for unequal or empty columns, values that are no finite numbers, two rows with one order, gaps
            (see `consecutive`), probabilities outside (0, 1], and ends that leave an episode no complete step.

    >>> log = {"id": [7, 7, 7], "t": [2, 0, 1], "x": [0.2, 0.0, 0.1], "a": [0, 1, 1], "r": [1.0, 0.0, 0.0]}
    >>> found = episodes_from_table(log, episode="id", order="t", observations=["x"], action="a", reward="r")
    >>> found[0].observations.ravel().tolist(), found[0].actions.tolist()
    ([0.0, 0.1, 0.2, 0.2], [1, 1, 0])
    """
    _check_table(frame)
    ids, position = _identifiers(frame, episode), _ordinals(frame, order)
    steps = _step_columns(frame, observations, action, reward) | {"ended": _ends(frame, terminated, len(ids))}
    extras = _info_columns(frame, infos, propensity, time)
    _check_lengths(episode, len(ids), {order: position, **steps, **extras})
    if consecutive is None:
        consecutive = position.dtype.kind in "iu"
    parts = _sorted_rows(ids, position, names=(episode, order), consecutive=consecutive)
    if time is not None:
        _check_times(extras["time"], ids, parts, name=time)
    _check_ends(ids, steps["ended"], parts, from_column=isinstance(terminated, str))
    return [_episode(ids[part[0]], _take(steps, part), _take(extras, part)) for part in parts]


def _check_table(table: object) -> None:
    """Raise `ConfigurationError` that names the type, and none of the values, unless an object has named columns."""
    if _has_columns(table):
        return
    advice = "name its columns: pandas.DataFrame(values, columns=[...])"
    if isinstance(table, str | os.PathLike):
        advice = "read the file first, for example with pandas.read_csv"
    elif isinstance(table, Iterable) and not hasattr(table, "dtype"):
        advice = "make a frame of rows first: pandas.DataFrame(rows); lists of episodes are for dataset_from_episodes"
    raise ConfigurationError(
        f"The table is a {type(table).__name__}; expected a pandas or polars frame, a pyarrow table or a mapping from "
        f"column names to arrays: {advice}."
    )


def _has_columns(table: Any) -> bool:
    if any(hasattr(table, name) for name in ("column_names", "columns")):
        return True
    dtype = getattr(table, "dtype", None)  # of a structured array, or of a pandas Series, which is one column
    return hasattr(table, "keys") if dtype is None else getattr(dtype, "names", None) is not None


def _step_columns(table: Table, observations: Columns, action: Columns, reward: str) -> dict[str, Array]:
    return {
        "observations": _matrix(table, observations).astype(np.float64),
        "actions": _matrix(table, action),
        "rewards": _numbers(table, reward).astype(np.float64),
    }


def _ends(table: Table, terminated: bool | str, rows: int) -> npt.NDArray[np.bool_]:
    if isinstance(terminated, str):
        return _flags(table, terminated)
    if not isinstance(terminated, bool | np.bool_):
        raise ConfigurationError(
            f"terminated must be True, False or the name of a column, got a {type(terminated).__name__}: give False "
            "where the log stops before the episodes end, and a column where only some of them terminated."
        )
    return np.full(rows, terminated)


def _flags(table: Table, name: str) -> npt.NDArray[np.bool_]:
    values = _numbers(table, name)
    other = np.flatnonzero((values != 0) & (values != 1))
    if len(other):
        raise InvalidDataError(
            f"Column {name!r} has {len(other)} values that are neither 0 nor 1, the first {values[other[0]]} in row "
            f"{other[0]}; give 1 in the last row of episodes that terminated and 0 elsewhere, also of cut-off ones."
        )
    return values.astype(bool)


def _info_columns(table: Table, infos: Sequence[str], propensity: str | None, time: str | None) -> dict[str, Array]:
    for name, made_of in (("log_prob", propensity), ("time", time)):
        if name in infos and made_of not in (None, name):
            raise ConfigurationError(
                f"infos would hold {name!r} twice: that column, and what is made of {made_of!r}. Rename one."
            )
    columns = {name: _numbers(table, name) for name in infos}
    if propensity is not None:
        columns["log_prob"] = _log_probabilities(table, propensity)
    if time is not None:
        columns["time"] = _seconds(_ordinals(table, time))
    return columns


def _check_times(times: Array, ids: Array, parts: Sequence[Array], *, name: str) -> None:
    for part in parts:
        back = np.flatnonzero(np.diff(times[part]) < 0)
        if len(back):
            before, after = times[part][back[0] : back[0] + 2]
            raise InvalidDataError(
                f"Column {name!r} goes back from {before} to {after} in episode {ids[part[0]]!r}; times must not "
                "decrease in the order of the rows. Correct them, or order the rows by them."
            )


def _column(table: Table, name: str) -> Array:
    names = _column_names(table)
    if name not in names:
        more = f" and {len(names) - _NAMES_SHOWN} more" if len(names) > _NAMES_SHOWN else ""
        raise ConfigurationError(f"The table has no column {name!r}; its columns are {names[:_NAMES_SHOWN]}{more}.")
    values = table[name]
    if getattr(getattr(values, "dtype", None), "tz", None) is not None:  # pandas would give objects; in UTC
        array = values.to_numpy(dtype=f"datetime64[{values.dtype.unit}]")
    else:
        array = np.asarray(values.to_numpy() if hasattr(values, "to_numpy") else values)
    if array.ndim != 1:
        raise InvalidDataError(f"Column {name!r} has shape {array.shape}; a column has one value a row.")
    return array


def _column_names(table: Any) -> list[str]:
    """Return the names of the columns of a pyarrow table, a frame, a structured array or a mapping."""
    for names in (getattr(table, "column_names", None), getattr(getattr(table, "dtype", None), "names", None)):
        if names is not None:
            return list(names)
    return list(getattr(table, "columns", table))


def _numbers(table: Table, name: str) -> Array:
    values = _column(table, name)
    if values.dtype.kind not in "biuf":
        raise InvalidDataError(f"Column {name!r} holds {values.dtype} values; convert it to numbers first.")
    _check_finite(name, np.isfinite(values))
    return values


def _check_finite(name: str, valid: npt.NDArray[np.bool_]) -> None:
    if not valid.all():
        bad = np.flatnonzero(~valid)
        raise InvalidDataError(
            f"Column {name!r} has {len(bad)} missing or infinite values, the first in row {bad[0]}; fill them or drop "
            "the episodes they are in."
        )


def _ordinals(table: Table, name: str) -> Array:
    values = _column(table, name)
    if values.dtype.kind != "M":
        return _numbers(table, name)
    _check_finite(name, ~np.isnat(values))
    return values


def _seconds(times: Array) -> Array:
    if times.dtype.kind != "M":
        return times
    epoch = np.zeros(1, dtype=times.dtype)  # in the column's own unit: nanoseconds end in 2262
    return (times - epoch) / np.timedelta64(1, "s")


def _identifiers(table: Table, name: str) -> Array:
    values = _column(table, name)
    if values.dtype.kind in "biuf":
        return _numbers(table, name)
    given = values.tolist()
    _check_finite(name, np.array([not (value is None or _is_nan(value)) for value in given], dtype=bool))
    kinds = sorted({type(value).__name__ for value in given} - {"str"})
    if kinds:
        raise InvalidDataError(
            f"Column {name!r} holds {', '.join(kinds)} values; ids must be all numbers or all texts."
        )
    return values.astype(str)


def _is_nan(value: object) -> bool:
    return isinstance(value, float) and math.isnan(value)


def _matrix(table: Table, columns: Columns) -> Array:
    if isinstance(columns, str):
        return _numbers(table, columns)
    if not columns:
        raise ConfigurationError("An empty list of columns was given; name at least one.")
    parts = [_numbers(table, name) for name in columns]
    _check_lengths(columns[0], len(parts[0]), dict(zip(columns, parts, strict=True)))
    return np.stack(parts, axis=1)


def _log_probabilities(table: Table, name: str) -> npt.NDArray[np.float64]:
    values = _numbers(table, name).astype(np.float64)
    outside = np.flatnonzero((values <= 0) | (values > 1))
    if len(outside):
        raise InvalidDataError(
            f"Column {name!r} has {len(outside)} values outside (0, 1], the first {values[outside[0]]} in row "
            f"{outside[0]}; it must hold the probability that the logged action had."
        )
    return np.log(values)


def _check_lengths(name: str, rows: int, columns: dict[str, Array]) -> None:
    if rows == 0:
        raise InvalidDataError("The table has no rows.")
    for other, values in columns.items():
        if len(values) != rows:
            raise InvalidDataError(f"Column {name!r} has {rows} rows and {other!r} has {len(values)}.")


def _sorted_rows(ids: Array, position: Array, *, names: tuple[str, str], consecutive: bool) -> list[npt.NDArray[Any]]:
    codes = np.unique(ids, return_inverse=True)[1]
    rows = np.lexsort((position, codes))
    same = codes[rows][1:] == codes[rows][:-1]
    repeated = np.flatnonzero(same & (position[rows][1:] == position[rows][:-1]))
    if len(repeated):
        row = rows[repeated[0]]
        raise InvalidDataError(
            f"Episode {names[0]}={ids[row]} has two rows with {names[1]}={position[row]} ({len(repeated)} such pairs "
            "in the table); each row of an episode needs its own place."
        )
    if consecutive:
        _check_consecutive(ids[rows], position[rows], same, names)
    return np.split(rows, np.flatnonzero(~same) + 1)


def _check_consecutive(ids: Array, position: Array, same: npt.NDArray[np.bool_], names: tuple[str, str]) -> None:
    if position.dtype.kind == "M":
        raise ConfigurationError(f"consecutive=True needs whole numbers, and {names[1]!r} holds dates.")
    gaps = np.flatnonzero(same & (np.diff(position.astype(np.float64)) != 1))
    if len(gaps):
        gap = gaps[0]
        raise InvalidDataError(
            f"Episode {names[0]}={ids[gap]} goes from {names[1]}={position[gap]} to {position[gap + 1]} ({len(gaps)} "
            "such gaps in the table); rows are missing. Pass consecutive=False if they are not decisions."
        )


def _take(columns: dict[str, Array], rows: npt.NDArray[Any]) -> dict[str, Array]:
    return {name: values[rows] for name, values in columns.items()}


def _check_ends(ids: Array, ended: Array, parts: Sequence[npt.NDArray[Any]], *, from_column: bool) -> None:
    for part in parts if from_column else ():
        early = np.flatnonzero(ended[part[:-1]])
        if len(early):
            raise InvalidDataError(
                f"Episode {ids[part[0]]} terminates at its row {early[0]} and has {len(part)} rows; split it there."
            )


def _episode(name: object, values: dict[str, Array], infos: dict[str, Array]) -> EpisodeBuffer:
    """Apply the rule of `episodes_from_table` to the sorted rows of one episode."""
    terminal, seen = bool(values["ended"][-1]), values["observations"]
    steps = len(seen) if terminal else len(seen) - 1
    if steps == 0:
        raise InvalidDataError(
            f"Episode {name} has one row and did not terminate, which leaves no complete step; leave it out."
        )
    last = np.arange(steps) == steps - 1
    return episode_buffer(
        observations=np.concatenate([seen, seen[-1:]]) if terminal else seen,
        actions=values["actions"][:steps],
        rewards=values["rewards"][:steps],
        terminations=last if terminal else np.zeros(steps, dtype=bool),
        truncations=np.zeros(steps, dtype=bool) if terminal else last,
        infos={key: column[:steps] for key, column in infos.items()},
    )
