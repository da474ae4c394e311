"""Small datasets whose values tell the episode and the step they belong to, to run augmenters on."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from minari import EpisodeData, MinariDataset
from minari.data_collector import EpisodeBuffer

from oat_gym.io.writing import DatasetCard, dataset_from_episodes, episode_buffer
from oat_gym.spaces import Batch, iter_leaf_spaces, slice_tree

LENGTHS = (26, 1, 31, 22, 2, 35, 24, 28)
"""Steps of the episodes of a probe: unequal, one of a single step, enough of over 20 steps to mine windows in."""

Place = tuple[int, int]
"""(episode, step)."""


@dataclass(frozen=True)
class Probe:
    """A dataset to run an augmenter on; `coded` where no observation is there twice."""

    name: str
    dataset: MinariDataset
    coded: bool = True


def places_of(episodes: tuple[EpisodeData, ...]) -> dict[bytes, Place]:
    """Return where each observation belongs, by its bytes: of episodes in which no observation is there twice."""
    return {
        row_bytes(episode.observations, step): (number, step)
        for number, episode in enumerate(episodes)
        for step in range(len(episode.rewards) + 1)
    }


def row_bytes(batch: Batch, step: int) -> bytes:
    """Return one row of a batch as bytes."""
    row = slice_tree(batch, slice(step, step + 1))
    return b"|".join(part.tobytes() for part in _arrays(row))


def _arrays(tree: Batch) -> list[np.ndarray[Any, Any]]:
    if isinstance(tree, dict | tuple):
        parts = [tree[key] for key in sorted(tree)] if isinstance(tree, dict) else tree
        return [array for part in parts for array in _arrays(part)]
    return [np.asarray(tree)]


def continuous_probe(folder: Path) -> Probe:
    """Return episodes in bounded Boxes, whose bounds the data reaches; every second one terminates."""
    box = _bounding_box([_continuous(number, length)[0] for number, length in enumerate(LENGTHS)])
    actions = _bounding_box([_continuous(number, length)[1] for number, length in enumerate(LENGTHS)])
    buffers = [_buffer(n, length, *_continuous(n, length), ends=n % 2 == 0) for n, length in enumerate(LENGTHS)]
    return Probe("continuous", _store(folder / "continuous", buffers, box, actions))


def discrete_probe(folder: Path) -> Probe:
    """Return episodes of a Dict of Discrete and MultiDiscrete spaces, and Discrete actions; none terminates."""
    observations = spaces.Dict(mode=spaces.Discrete(3), place=spaces.MultiDiscrete([len(LENGTHS), max(LENGTHS) + 1]))
    buffers = [_discrete(number, length) for number, length in enumerate(LENGTHS)]
    return Probe("discrete", _store(folder / "discrete", buffers, observations, spaces.Discrete(11)))


def one_step_probe(folder: Path) -> Probe:
    """Return continuous episodes of one step each."""
    parts = [_continuous(number, 1) for number in range(len(LENGTHS))]
    box, actions = _bounding_box([part[0] for part in parts]), _bounding_box([part[1] for part in parts])
    buffers = [_buffer(number, 1, *part, ends=number % 2 == 0) for number, part in enumerate(parts)]
    return Probe("one-step", _store(folder / "one-step", buffers, box, actions))


def _continuous(number: int, length: int) -> tuple[Batch, Batch]:
    steps = np.arange(length + 1)
    episode = np.full(length + 1, number)
    observations = np.stack([episode, steps, (7 * episode + 3 * steps) % 11], axis=1).astype(np.float32)
    actions = np.stack([0.1 * steps[:-1], episode[:-1] - 3.5], axis=1).astype(np.float32)
    return observations, actions


def _discrete(number: int, length: int) -> EpisodeBuffer:
    steps = np.arange(length + 1)
    place = np.stack([np.full(length + 1, number), steps], axis=1).astype(np.int64)
    actions = (3 * number + steps[:-1]) % 11
    return _buffer(number, length, {"mode": (number + steps) % 3, "place": place}, actions, ends=False)


def _buffer(number: int, length: int, observations: Batch, actions: Batch, *, ends: bool) -> EpisodeBuffer:
    last = np.arange(length) == length - 1
    clock = 100.0 * number + np.arange(length + 1)
    return episode_buffer(
        observations=observations,
        actions=actions,
        rewards=clock[:-1] / 10,
        terminations=last & ends,
        truncations=last & (not ends),
        infos={"clock": clock[:, None]},
        seed=number,
    )


def _bounding_box(batches: list[Batch]) -> spaces.Box:
    rows = np.concatenate(batches)
    return spaces.Box(rows.min(axis=0), rows.max(axis=0), dtype=np.float32)


def _store(
    folder: Path, buffers: list[EpisodeBuffer], observations: spaces.Space[Any], actions: spaces.Space[Any]
) -> MinariDataset:
    card = DatasetCard(dataset_id=f"check/{folder.name}-v0", description="Values that tell their episode and step.")
    return dataset_from_episodes(
        buffers, directory=folder, card=card, observation_space=observations, action_space=actions
    )


def leaf_outside(batch: Batch, space: spaces.Space[Any]) -> str | None:
    """Return the first value of a batch that lies outside its space, in words; None where there is none."""
    for path, leaf_space in iter_leaf_spaces(space):
        leaf = batch
        for key in path:
            leaf = leaf[key]
        for row, value in enumerate(leaf):
            if not leaf_space.contains(value if isinstance(value, str) else np.asarray(value)):
                where = "".join(f"[{key!r}]" for key in path)
                return f"{where} at row {row} is {value!r}, which is not in {leaf_space}"
    return None
