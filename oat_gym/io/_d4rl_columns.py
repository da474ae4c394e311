"""From Minari's episodes to D4RL's rows, with a note of what the rows cannot say."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from minari import EpisodeData, MinariDataset

from oat_gym.episodes import BoolArray, check_episode, next_states, plain_infos, states
from oat_gym.errors import InvalidDataError
from oat_gym.export import STORAGE_KEYS
from oat_gym.io import _d4rl_note as notes
from oat_gym.io._d4rl_file import Array, Flat, plain_value
from oat_gym.io._d4rl_rows import rows_of, spaces_of
from oat_gym.provenance import renumbered
from oat_gym.serialization import metadata_to_json, source_metadata
from oat_gym.spaces import in_kind_of
from oat_gym.storage import AugmentedStorage


def columns_of(data: MinariDataset) -> Flat:
    """Return a dataset as D4RL's columns.

    Raises:
        InvalidDataError: for what the layout cannot hold.
    """
    episodes = list(data.iterate_episodes())
    if not episodes:
        raise InvalidDataError(f"The dataset {data.id!r} (or this view of it) has no episodes to write.")
    _check_seams(data)
    episodes = _of_one_kind(episodes, data)
    for number, episode in enumerate(episodes):
        check_episode(episode, data.observation_space, data.action_space)
        _check_flags(number, episode)
    columns: Flat = {
        "observations": join_rows("observations", [states(e) for e in episodes]),
        "actions": join_rows("actions", [e.actions for e in episodes]),
        "rewards": join_rows("rewards", [e.rewards for e in episodes]),
        "next_observations": join_rows("observations", [next_states(e) for e in episodes]),
        "terminals": np.concatenate([e.terminations for e in episodes]).astype(bool),
        "timeouts": np.concatenate([_timeouts(e) for e in episodes]),
    }
    columns |= infos_to_rows([e.infos for e in episodes], [len(e.rewards) for e in episodes])
    raw = source_metadata(data)
    columns |= notes.metadata_from_json(kept_metadata(raw))
    columns[notes.NOTE] = _note_of(data, raw, episodes).to_text()
    rows = rows_of(columns)  # what is written can be read: the same checks, before anything is on disk
    spaces_of(rows, None, None)
    return columns


def kept_metadata(raw: Mapping[str, Any]) -> dict[str, Any]:
    """Return the `metadata/*` of a D4RL file that a dataset's raw metadata keeps."""
    about = raw.get("d4rl")
    found = about.get("metadata") if isinstance(about, Mapping) else None
    return dict(found) if isinstance(found, Mapping) else {}


def infos_to_rows(infos: list[Any], lengths: list[int]) -> Flat:
    """Return the infos of all episodes as `infos/*` of one row a step, and their reset rows beside the note.

    An info of T+1 rows begins with the reset's; that row is kept apart, so that row t is what step t returned.

    Raises:
        InvalidDataError: if an info has another number of rows, or the episodes' infos differ in keys, dtype or shape.
    """
    flat = [_flatten_infos(plain_infos(part), number) for number, part in enumerate(infos)]
    rows: Flat = {}
    for number, part in enumerate(flat):
        if set(part) != set(flat[0]):
            raise InvalidDataError(f"Episode {number} has the infos {sorted(part)} and episode 0 {sorted(flat[0])}.")
    for name in flat[0]:
        values = [part[name] for part in flat]
        extra = {len(value) - length for value, length in zip(values, lengths, strict=True)}
        if extra not in ({0}, {1}):
            raise InvalidDataError(
                f"infos[{name!r}] has lengths that the layout cannot hold: an episode of T steps needs T rows, or T+1 "
                "with the reset's first, alike in all episodes."
            )
        if extra == {1}:
            rows[notes.RESET_INFOS + name] = join_rows(f"infos[{name!r}]", [value[:1] for value in values])
            values = [value[1:] for value in values]
        rows[f"infos/{name}"] = join_rows(f"infos[{name!r}]", values)
    return rows


def join_rows(name: str, parts: list[Any]) -> Array | list[str]:
    """Return the parts one after another; `InvalidDataError` where their dtypes or shapes differ."""
    if all(isinstance(part, list) for part in parts):
        return [row for part in parts for row in part]
    for number, part in enumerate(parts):
        if isinstance(part, list) or isinstance(parts[0], list):
            raise InvalidDataError(f"{name} holds text in some episodes only ({number} differs from 0).")
        if (part.dtype, part.shape[1:]) != (parts[0].dtype, parts[0].shape[1:]):
            raise InvalidDataError(
                f"{name} of episode {number} has dtype {part.dtype} and rows of shape {part.shape[1:]}, of episode 0 "
                f"{parts[0].dtype} and {parts[0].shape[1:]}; the layout has one for all. Convert them first."
            )
    return np.concatenate(parts)


def _of_one_kind(episodes: list[EpisodeData], data: MinariDataset) -> list[EpisodeData]:
    """Return the episodes with numbers of one kind where generated ones are floats and recorded ones integers."""
    kinds = {tuple(np.asarray(part).dtype.kind for part in (e.observations, e.actions, e.rewards)) for e in episodes}
    if len(kinds) == 1:
        return episodes
    return [
        replace(
            episode,
            observations=in_kind_of(data.observation_space, episode.observations),
            actions=in_kind_of(data.action_space, episode.actions),
            rewards=episode.rewards.astype(np.float64) if episode.rewards.dtype.kind in "biu" else episode.rewards,
        )
        for episode in episodes
    ]


def _check_seams(data: MinariDataset) -> None:
    storage = data.storage
    if isinstance(storage, AugmentedStorage) and any(storage.next_states(int(n)) for n in data.episode_indices):
        raise InvalidDataError(
            "Some transitions (literal seams, permuted segments) have a next state of their own, where readers of "
            "D4RL's layout take the next row's observation. Use seam='contiguous' or 'matched', another method, or "
            "transitions()."
        )


def _check_flags(number: int, episode: EpisodeData) -> None:
    early = np.flatnonzero(np.asarray(episode.truncations)[:-1])
    if len(early):
        raise InvalidDataError(
            f"Episode {number} is truncated at step {early[0]} and goes on to {len(episode.rewards)} steps; D4RL's "
            "readers would cut it there. Split it, or clear the flag."
        )
    if np.ndim(episode.rewards) != 1:
        raise InvalidDataError(
            f"The rewards of episode {number} have shape {np.shape(episode.rewards)}; expected (T,)."
        )


def _timeouts(episode: EpisodeData) -> BoolArray:
    """Return `truncations & ~terminations`, set at an end without a flag too."""
    terminated = np.asarray(episode.terminations, dtype=bool)
    ends = np.arange(len(terminated)) == len(terminated) - 1
    return ends & ~terminated


def _note_of(data: MinariDataset, raw: Mapping[str, Any], episodes: list[EpisodeData]) -> notes.Note:
    ends = [(bool(e.terminations[-1]), bool(e.truncations[-1])) for e in episodes]
    metadata = {key: value for key, value in raw.items() if key not in STORAGE_KEYS}
    if isinstance(metadata.get("d4rl"), Mapping):
        metadata["d4rl"] = {key: value for key, value in metadata["d4rl"].items() if key != "metadata"}
    per_episode = renumbered(data.storage.get_episode_metadata(data.episode_indices), data.episode_indices)
    return notes.Note(
        lengths=tuple(len(e.rewards) for e in episodes),
        unflagged=tuple(number for number, end in enumerate(ends) if end == (False, False)),
        doubly=tuple(number for number, end in enumerate(ends) if end == (True, True)),
        observation_space=str(raw["observation_space"]),
        action_space=str(raw["action_space"]),
        metadata=metadata,
        episodes=tuple(
            {key: value for key, value in metadata_to_json(part).items() if key not in ("id", "total_steps")}
            for part in per_episode
        ),
    )


def _flatten_infos(infos: Any, number: int, prefix: str = "") -> dict[str, Array | list[str]]:
    flat: dict[str, Array | list[str]] = {}
    for key, value in (infos or {}).items():
        name = f"{prefix}{key}"
        if not isinstance(key, str) or not key or "/" in key or key == ".":
            raise InvalidDataError(f"The info {name!r} has a name that HDF5 cannot store; rename it.")
        if isinstance(value, Mapping):
            if not value:
                raise InvalidDataError(f"infos[{name!r}] of episode {number} is an empty group; leave it out.")
            flat |= _flatten_infos(value, number, f"{name}/")
            continue
        rows = plain_value(f"infos[{name!r}] of episode {number}", value)
        if isinstance(rows, str) or not np.ndim(rows):
            raise InvalidDataError(f"infos[{name!r}] of episode {number} is a single value; expected one row a step.")
        flat[name] = rows
    return flat
