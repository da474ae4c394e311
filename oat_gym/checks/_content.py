"""Checks of what episodes hold: the T+1 rule, spaces, dtypes, flags, infos."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from gymnasium import spaces
from minari import EpisodeData

from oat_gym.checks._subject import Subject
from oat_gym.checks.report import Broken, Check
from oat_gym.spaces import get_leaf, iter_leaf_spaces

Part = tuple[str, Any, spaces.Space[Any], int]  # where, values, space, rows expected


def readable(subject: Subject) -> int:
    """Iterating gives one episode for each id asked for."""
    episodes = subject.episodes
    if len(episodes) != len(subject.numbers):
        raise Broken(f"iteration over {len(subject.numbers)} episodes gives {len(episodes)}")
    wrong = [episode for episode in episodes if not isinstance(episode, EpisodeData)]
    if wrong:
        raise Broken(f"iteration gives a {type(wrong[0]).__name__} in place of a minari.EpisodeData")
    return len(episodes)


def structure(subject: Subject) -> int:
    """Observations and actions are nested as their spaces are."""
    for episode in subject.episodes:
        _structure(episode.observations, subject.dataset.observation_space, f"episode {episode.id}: observations")
        _structure(episode.actions, subject.dataset.action_space, f"episode {episode.id}: actions")
    return len(subject.episodes)


def _structure(batch: Any, space: spaces.Space[Any], where: str) -> None:
    if isinstance(space, spaces.Dict):
        if not isinstance(batch, dict) or set(batch) != set(space.spaces):
            raise Broken(f"{where} must be a dict with the keys {sorted(space.spaces)}, got {_outline(batch)}")
        for key, child in space.spaces.items():
            _structure(batch[key], child, f"{where}[{key!r}]")
    elif isinstance(space, spaces.Tuple):
        if not isinstance(batch, tuple) or len(batch) != len(space.spaces):
            raise Broken(f"{where} must be a tuple of {len(space.spaces)} parts, got {_outline(batch)}")
        for index, child in enumerate(space.spaces):
            _structure(batch[index], child, f"{where}[{index}]")
    elif not isinstance(batch, np.ndarray | list):
        raise Broken(f"{where} must be an array or a list, got {_outline(batch)}")


def _outline(batch: Any) -> str:
    return f"a dict of {sorted(map(str, batch))}" if isinstance(batch, dict) else f"a {type(batch).__name__}"


def t_plus_one(subject: Subject) -> int:
    """T+1 observations in every leaf, T actions, rewards, terminations and truncations, T at least 1."""
    for episode in subject.episodes:
        length = len(episode.rewards)
        if length < 1:
            raise Broken(f"episode {episode.id} has no steps")
        for where, values, _, rows in _parts(episode, subject):
            if len(values) != rows:
                raise Broken(f"{where} has {len(values)} rows, expected {rows} for {length} rewards")
        for name in ("terminations", "truncations"):
            if len(getattr(episode, name)) != length:
                got = len(getattr(episode, name))
                raise Broken(f"episode {episode.id}: {name} has {got} rows, expected {length} for {length} rewards")
    return len(subject.episodes)


def shapes(subject: Subject) -> int:
    """Every leaf has the shape of its space behind the rows; rewards and flags have one dimension."""
    for episode in subject.episodes:
        for where, values, space, _ in _array_parts(episode, subject):
            if values.shape[1:] != (space.shape or ()):
                raise Broken(f"{where} has rows of shape {values.shape[1:]}, expected {space.shape} of {space}")
        for name in ("rewards", "terminations", "truncations"):
            if np.ndim(getattr(episode, name)) != 1:
                raise Broken(f"episode {episode.id}: {name} has {np.ndim(getattr(episode, name))} dimensions")
    return len(subject.episodes)


def dtypes(subject: Subject) -> int:
    """Every leaf has the dtype of its space; rewards are numbers and flags booleans; texts are strings."""
    for episode in subject.episodes:
        for where, values, space, _ in _parts(episode, subject):
            if isinstance(space, spaces.Text):
                if not all(isinstance(text, str) for text in values):
                    raise Broken(f"{where} must hold strings")
            elif not isinstance(values, np.ndarray) or values.dtype != space.dtype:
                got = getattr(values, "dtype", type(values).__name__)
                raise Broken(f"{where} has dtype {got}, expected {space.dtype} of {space}")
        if not np.issubdtype(np.asarray(episode.rewards).dtype, np.number):
            raise Broken(f"episode {episode.id}: rewards have dtype {episode.rewards.dtype}")
        for name in ("terminations", "truncations"):
            dtype = np.asarray(getattr(episode, name)).dtype
            if dtype != np.bool_:
                raise Broken(f"episode {episode.id}: {name} have dtype {dtype}, expected bool")
    return len(subject.episodes)


def in_spaces(subject: Subject) -> int:
    """Every observation and action lies in its space (NaN is the business of `finite`)."""
    rows = 0
    for episode in subject.episodes:
        for where, values, space, _ in _parts(episode, subject):
            outside = _outside(values, space)
            if outside is not None:
                raise Broken(f"{where} at row {outside} is {values[outside]!r}, which is outside {space}")
            rows += len(values)
    return rows


def _outside(values: Any, space: spaces.Space[Any]) -> int | None:
    if isinstance(space, spaces.Box):
        bad = (values < space.low) | (values > space.high)
    elif isinstance(space, spaces.Discrete):
        bad = (values < space.start) | (values >= space.start + space.n)
    elif isinstance(space, spaces.MultiDiscrete):
        bad = (values < space.start) | (values >= space.start + space.nvec)
    elif isinstance(space, spaces.MultiBinary):
        bad = (values != 0) & (values != 1)
    else:
        bad = np.array([value not in space for value in values])
    rows = np.flatnonzero(bad.reshape(len(values), -1).any(axis=1))
    return int(rows[0]) if len(rows) else None


def finite(subject: Subject) -> int:
    """No reward, observation or action is NaN; rewards are finite."""
    count = 0
    for episode in subject.episodes:
        if not np.isfinite(episode.rewards).all():
            raise Broken(
                f"episode {episode.id}: the reward at step {_first(~np.isfinite(episode.rewards))} is not finite"
            )
        for where, values, _, _ in _array_parts(episode, subject):
            if np.issubdtype(values.dtype, np.inexact) and np.isnan(values).any():
                raise Broken(f"{where} is NaN at row {_first(np.isnan(values).reshape(len(values), -1).any(axis=1))}")
            count += 1
    return count


def _first(mask: Any) -> int:
    return int(np.flatnonzero(mask)[0])


def flags(subject: Subject) -> int:
    """An episode ends where a flag is set: no termination or truncation before the last step."""
    for episode in subject.episodes:
        early = np.flatnonzero(episode.terminations[:-1] | episode.truncations[:-1])
        if len(early):
            raise Broken(f"episode {episode.id} of {len(episode)} steps has a flag set at step {early[0]}")
    return len(subject.episodes)


def infos(subject: Subject) -> int:
    """Every info has T+1 rows (with one for the reset) or T."""
    count = 0
    for episode in subject.episodes:
        for where, values in _info_leaves(episode.infos or {}, f"episode {episode.id}: infos"):
            if len(values) not in (len(episode.rewards), len(episode.rewards) + 1):
                raise Broken(f"{where} has {len(values)} rows for {len(episode.rewards)} steps")
            count += 1
    return count


def _info_leaves(part: Any, where: str) -> Iterator[tuple[str, Any]]:
    if isinstance(part, dict | tuple):
        for key, child in part.items() if isinstance(part, dict) else enumerate(part):
            yield from _info_leaves(child, f"{where}[{key!r}]")
    elif np.ndim(part):  # a scalar says something of the whole episode
        yield where, part


def _parts(episode: EpisodeData, subject: Subject) -> Iterator[Part]:
    length = len(episode.rewards)
    sides = (
        ("observations", episode.observations, subject.dataset.observation_space, length + 1),
        ("actions", episode.actions, subject.dataset.action_space, length),
    )
    for name, batch, space, rows in sides:
        for path, leaf in iter_leaf_spaces(space):
            keys = "".join(f"[{key!r}]" for key in path)
            yield f"episode {episode.id}: {name}{keys}", get_leaf(batch, path), leaf, rows


def _array_parts(episode: EpisodeData, subject: Subject) -> Iterator[Part]:
    return (part for part in _parts(episode, subject) if isinstance(part[1], np.ndarray))


CONTENT_CHECKS: tuple[Check[Subject], ...] = (
    Check("readable", "iterating gives the episodes asked for", readable),
    Check("structure", "batches are nested as their spaces", structure, ("readable",)),
    Check("t-plus-one", "T steps hold T+1 observations and T actions, rewards and flags", t_plus_one, ("structure",)),
    Check("dtypes", "leaves have the dtypes of their spaces", dtypes, ("structure",)),
    Check("shapes", "leaves have the shapes of their spaces", shapes, ("t-plus-one", "dtypes")),
    Check("spaces", "values lie in their spaces", in_spaces, ("shapes",)),
    Check("finite", "no NaN, and finite rewards", finite, ("shapes",)),
    Check("flags", "flags are set at the last step only", flags, ("t-plus-one", "dtypes")),
    Check("infos", "infos have T or T+1 rows", infos, ("t-plus-one",)),
)
