"""From D4RL's rows to Minari's episodes of T steps and T+1 observations."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from minari import EpisodeData

from oat_gym.episodes import IntArray
from oat_gym.errors import ConfigurationError, InvalidDataError
from oat_gym.io._d4rl_note import Note
from oat_gym.io._d4rl_rows import Rows, any_in_row

CutAt = Literal["terminals_or_timeouts", "timeouts"]


@dataclass(frozen=True)
class Episodes:
    """The episodes of a file, and what had to be done for want of a last observation.

    `repeated` episodes ended in a terminal, and their last observation is there twice; `dropped` steps led to an
    observation that the file does not have. `numbers` are the episodes' places in the file: one of a single row that
    was dropped is missing from them.
    """

    data: tuple[EpisodeData, ...]
    numbers: tuple[int, ...]
    repeated: int
    dropped: int


def noted_stops(rows: Rows, note: Note) -> IntArray:
    """Return the row after each episode that the file's note gives; `InvalidDataError` where the flags differ."""
    stops = np.cumsum(np.array(note.lengths, dtype=np.int64))
    flagged = rows.terminals | (False if rows.timeouts is None else rows.timeouts)
    unmarked = np.flatnonzero(~flagged[stops - 1])
    if len(unmarked):
        raise InvalidDataError(
            f"Episode {unmarked[0]} ends at row {stops[unmarked[0]] - 1} by 'metadata/oat_gym/note', and no flag is "
            "set there: the file was edited after oat_gym wrote it. Pass cut_at to read the rows alone."
        )
    return stops


def found_stops(rows: Rows, cut_at: CutAt, max_episode_steps: int | None) -> IntArray:
    """Return the row after each episode, found as `read_d4rl` says."""
    _check_means(rows, cut_at, max_episode_steps)
    ends = rows.terminals.copy() if cut_at == "terminals_or_timeouts" else np.zeros(len(rows), dtype=bool)
    jumps = _jumps(rows)
    if rows.timeouts is not None:
        ends |= rows.timeouts
        torn = np.flatnonzero(jumps & ~ends)
        if len(torn):
            raise InvalidDataError(
                f"Row {torn[0]} has another next observation than the observation of row {torn[0] + 1}, and no episode "
                f"ends there ({len(torn)} such rows). Pass a dictionary without 'timeouts' to cut there, or without "
                "'next_observations' to go by the observations."
            )
    else:
        ends |= jumps
    ends[-1] = True
    stops = np.flatnonzero(ends) + 1
    return stops if max_episode_steps is None else _apply_limit(stops, max_episode_steps, rows.timeouts is not None)


def cut(rows: Rows, stops: IntArray, *, unflagged: Iterable[int] = ()) -> Episodes:
    """Return the episodes that end before the rows `stops`; those in `unflagged` carry no flag at their end."""
    bounds = [0, *stops.tolist()]
    silent = set(unflagged)
    made = [
        _episode(rows, number, start, stop, flagged=number not in silent)
        for number, (start, stop) in enumerate(pairwise(bounds))
    ]
    numbers = tuple(number for number, episode in enumerate(made) if episode is not None)
    if not numbers:
        raise InvalidDataError(
            "No step is left: each row's next observation is unknown. Give 'next_observations', or longer episodes."
        )
    unknown = rows.next_observations is None
    at_terminal = rows.terminals[stops - 1]
    return Episodes(
        data=tuple(episode for episode in made if episode is not None),
        numbers=numbers,
        repeated=int(at_terminal.sum()) if unknown else 0,
        dropped=int((~at_terminal).sum()) if unknown else 0,
    )


def doubly_flagged(rows: Rows, stops: IntArray, note: Note | None) -> Rows:
    """Return rows whose timeouts are also set where the note says that a terminal episode was truncated too."""
    if note is None or not note.doubly:
        return rows
    timeouts = np.zeros(len(rows), dtype=bool) if rows.timeouts is None else rows.timeouts.copy()
    timeouts[stops[list(note.doubly)] - 1] = True
    return replace(rows, timeouts=timeouts)


def _check_means(rows: Rows, cut_at: CutAt, max_episode_steps: int | None) -> None:
    if rows.timeouts is not None or rows.next_observations is not None or max_episode_steps is not None:
        return
    if cut_at == "timeouts" or not rows.terminals.any():
        raise ConfigurationError(
            "Nothing says where episodes are cut off: there are no 'timeouts' and no 'next_observations'"
            + (", and no terminal is set" if cut_at != "timeouts" else "")
            + ". Pass max_episode_steps."
        )


def _jumps(rows: Rows) -> npt.NDArray[np.bool_]:
    """Return where the next row does not go on from this one; nowhere without next observations."""
    jumps = np.zeros(len(rows), dtype=bool)
    if rows.next_observations is not None:
        jumps[:-1] = any_in_row(rows.next_observations[:-1] != rows.observations[1:])
    return jumps


def _apply_limit(stops: IntArray, limit: int, has_timeouts: bool) -> IntArray:
    starts = np.concatenate([[0], stops[:-1]])
    if not has_timeouts:
        parts = [np.append(np.arange(a + limit, b, limit), b) for a, b in zip(starts, stops, strict=True)]
        return np.concatenate(parts)
    longest = int((stops - starts).argmax())
    if stops[longest] - starts[longest] > limit:
        raise InvalidDataError(
            f"Episode {longest} has {stops[longest] - starts[longest]} rows by its flags, more than max_episode_steps="
            f"{limit}. Leave max_episode_steps out, or pass a dictionary without 'timeouts'."
        )
    return stops


def _episode(rows: Rows, number: int, start: int, stop: int, *, flagged: bool) -> EpisodeData | None:
    terminal = bool(rows.terminals[stop - 1])
    if rows.next_observations is not None:
        observations = np.concatenate([rows.observations[start:stop], rows.next_observations[stop - 1 : stop]])
    elif terminal:
        observations = np.concatenate([rows.observations[start:stop], rows.observations[stop - 1 : stop]])
    else:
        observations = rows.observations[start:stop].copy()
    steps = slice(start, start + len(observations) - 1)
    length = steps.stop - start
    if not length:
        return None
    truncated = flagged and (not terminal or (rows.timeouts is not None and bool(rows.timeouts[stop - 1])))
    return EpisodeData(
        id=number,
        observations=observations,
        actions=rows.actions[steps].copy(),
        rewards=rows.rewards[steps].copy(),
        terminations=rows.terminals[steps].copy(),
        truncations=(np.arange(length) == length - 1) & truncated,
        infos=_infos_of(rows, number, steps),
    )


def _infos_of(rows: Rows, number: int, steps: slice) -> dict[str, Any]:
    infos: dict[str, Any] = {}
    for name, values in rows.infos.items():
        part: Any = values[steps]
        if name in rows.reset_infos:
            part = _prepend(rows.reset_infos[name][number : number + 1], part)
        *parents, last = name.split("/")
        branch = infos
        for key in parents:
            branch = branch.setdefault(key, {})
        branch[last] = part
    return infos


def _prepend(first: Any, rest: Any) -> Any:
    return [*first, *rest] if isinstance(rest, list) else np.concatenate([first, rest])
