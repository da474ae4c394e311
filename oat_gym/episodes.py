"""Episodes in Minari's form, and the one place where the T+1 rule is stated.

**The T+1 rule.** An episode of T steps holds T+1 observations and T actions, rewards, terminations and truncations.
Step t goes from `observations[t]` by `actions[t]` to `observations[t+1]`: the next state of step t is
`observations[t+1]`, of the last step `observations[T]`. Everything else in the package calls the helpers below.
"""

from __future__ import annotations

import copy
import hashlib
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from minari import EpisodeData

from oat_gym.errors import InvalidDataError
from oat_gym.spaces import Batch, concatenate_trees, copy_tree, iter_leaf_spaces, map_tree, slice_tree

BoolArray = npt.NDArray[np.bool_]
IntArray = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Transitions:
    """Transitions (s, a, r, s') as columns of n rows each, in the order of episodes and steps.

    `observations`, `actions` and `next_observations` are batches of the dataset's spaces; `rewards` (n,) are in
    environment units; `terminated` and `truncated` (n,) are kept apart, so that a truncated step can bootstrap;
    `episode` and `step` (n,) say where a row comes from, `synthetic` (n,) whether it was generated.
    """

    observations: Batch
    actions: Batch
    rewards: npt.NDArray[np.floating[Any]]
    next_observations: Batch
    terminated: BoolArray
    truncated: BoolArray
    episode: IntArray
    step: IntArray
    synthetic: BoolArray

    def __len__(self) -> int:
        """Return the number of transitions."""
        return len(self.rewards)


def states(episode: EpisodeData) -> Batch:
    """Return the T states s_t in which the actions were taken (a view)."""
    return slice_tree(episode.observations, slice(None, -1))


def next_states(episode: EpisodeData) -> Batch:
    """Return the T next states s'_t = observations[t+1] (a view)."""
    return slice_tree(episode.observations, slice(1, None))


def check_episode(episode: EpisodeData, observation_space: spaces.Space[Any], action_space: spaces.Space[Any]) -> None:
    """Raise `InvalidDataError` unless the episode keeps the T+1 rule in every part of its spaces."""
    length = len(episode.rewards)
    if length < 1:
        raise InvalidDataError(f"Episode {episode.id} has no steps; an episode needs at least one.")
    parts = [("observations", episode.observations, observation_space, length + 1)]
    parts.append(("actions", episode.actions, action_space, length))
    for name, batch, space, expected in parts:
        for path, leaf_space in iter_leaf_spaces(space):
            leaf = batch
            for key in path:
                leaf = leaf[key]
            if len(leaf) != expected:
                where = "".join(f"[{key!r}]" for key in path)
                raise InvalidDataError(
                    f"Episode {episode.id} has {length} rewards but {len(leaf)} {name}{where}, expected {expected}: "
                    "an episode of T steps holds T+1 observations and T actions."
                )
            if isinstance(leaf, np.ndarray) and leaf_space.shape is not None and leaf.shape[1:] != leaf_space.shape:
                where = "".join(f"[{key!r}]" for key in path)
                raise InvalidDataError(
                    f"Episode {episode.id} has {name}{where} of shape {leaf.shape[1:]} a step; {leaf_space} has "
                    f"{leaf_space.shape}."
                )
    for name in ("terminations", "truncations"):
        got = len(getattr(episode, name))
        if got != length:
            raise InvalidDataError(f"Episode {episode.id} has {length} rewards but {got} {name}; expected {length}.")


def copy_episode(episode: EpisodeData, *, number: int) -> EpisodeData:
    """Return a copy with id `number` that shares no memory with `episode`."""
    return EpisodeData(
        id=number,
        observations=copy_tree(episode.observations),
        actions=copy_tree(episode.actions),
        rewards=episode.rewards.copy(),
        terminations=episode.terminations.copy(),
        truncations=episode.truncations.copy(),
        infos=map_tree(_copy_info, episode.infos),
    )


def _copy_info(leaf: Any) -> Any:
    # arrow gives nested infos as arrays of dictionaries, which a plain copy would share
    return leaf.copy() if isinstance(leaf, np.ndarray) and leaf.dtype != object else copy.deepcopy(leaf)


def collect_transitions(
    episodes: Iterable[tuple[EpisodeData, BoolArray, dict[int, Batch]]], numbers: Iterable[int]
) -> Transitions:
    """Join episodes into columns.

    Args:
        episodes: for each episode its data, its mask of T booleans (true where generated), and the next states that
            differ from `observations[t+1]`, as batches of one row keyed by step (for the literal seam of the paper).
        numbers: the number of each episode, for the `episode` column.

    Raises:
        InvalidDataError: if there is no episode.
    """
    rows = list(zip(episodes, numbers, strict=True))
    if not rows:
        raise InvalidDataError("No episode to take transitions from: the dataset (or this view of it) is empty.")
    data = [episode for (episode, _, _), _ in rows]
    lengths = [len(episode.rewards) for episode in data]
    return Transitions(
        observations=concatenate_trees([states(episode) for episode in data]),
        actions=concatenate_trees([episode.actions for episode in data]),
        rewards=np.concatenate([episode.rewards for episode in data]),
        next_observations=concatenate_trees(
            [_replace_rows(next_states(episode), overrides) for (episode, _, overrides), _ in rows]
        ),
        terminated=np.concatenate([episode.terminations for episode in data]).astype(bool),
        truncated=np.concatenate([episode.truncations for episode in data]).astype(bool),
        episode=np.repeat(np.asarray([number for _, number in rows], dtype=np.int64), lengths),
        step=np.concatenate([np.arange(length) for length in lengths]),
        synthetic=np.concatenate([mask for (_, mask, _), _ in rows]),
    )


def _replace_rows(batch: Batch, rows: dict[int, Batch]) -> Batch:
    if not rows:
        return batch
    batch = copy_tree(batch)
    for step, row in rows.items():
        map_tree(lambda target, value, step=step: target.__setitem__(step, value[0]), batch, row)
    return batch


def hash_episode(digest: Any, episode: EpisodeData) -> None:
    """Feed the content of an episode to a hashlib digest: every array and info, not its number."""
    for name in ("observations", "actions", "rewards", "terminations", "truncations", "infos"):
        digest.update(name.encode())
        _hash_tree(digest, plain_infos(getattr(episode, name)))


def plain_infos(infos: Any) -> Any:
    """Return infos in one form, whatever storage format they come from.

    Dictionaries nested in arrays (as Minari's arrow storage gives them) become nested dictionaries. Strings, which HDF5
    gives as bytes in an array of objects and arrow as an array of fixed width that HDF5 refuses, become lists.
    """
    if isinstance(infos, dict):
        return {key: plain_infos(part) for key, part in infos.items()}
    if not isinstance(infos, np.ndarray) or not infos.ndim or not len(infos):
        return infos
    if infos.dtype == object and isinstance(infos[0], dict):
        return {key: plain_infos(np.array([part[key] for part in infos])) for key in infos[0]}
    if infos.dtype.kind == "U" and infos.ndim == 1:
        return infos.tolist()
    if infos.dtype == object and infos.ndim == 1 and all(isinstance(text, bytes) for text in infos):
        return [text.decode() for text in infos]
    return infos


def content_hash(episodes: Iterable[EpisodeData]) -> str:
    """Return the SHA-256 of the content of episodes, in order; equal for equal data in any storage format."""
    digest = hashlib.sha256()
    for episode in episodes:
        hash_episode(digest, episode)
    return digest.hexdigest()


def _hash_tree(digest: Any, batch: Batch) -> None:
    if batch is None or (isinstance(batch, dict) and not batch):  # no infos: None in one storage format, {} in another
        digest.update(b"{}")
    elif isinstance(batch, dict):
        for key in sorted(batch):
            digest.update(f"{key}:".encode())
            _hash_tree(digest, batch[key])
    elif isinstance(batch, tuple):
        for item in batch:
            _hash_tree(digest, item)
    elif isinstance(batch, np.ndarray) and batch.dtype != object:
        digest.update(f"{batch.dtype.str}{batch.shape}".encode())
        digest.update(np.ascontiguousarray(batch).data)
    else:
        digest.update(repr(list(batch) if isinstance(batch, np.ndarray) else batch).encode())
