"""Batches of tensors: which steps an item of a loader holds, and how they are gathered."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch

from oat_gym.episodes import BoolArray, IntArray
from oat_gym.io._columns import Columns
from oat_gym.spaces import Batch, map_tree


class TorchBatch(NamedTuple):
    """A batch of B transitions, windows or episodes.

    Transitions: every field has the shape (B, ...); `mask` is all true. Windows and padded episodes of L steps:
    `observations` (B, L+1, ...), all else (B, L, ...); `mask` is true at the steps that were recorded, and where it is
    false the other fields are zero (`episode` and `step`: -1). `next_observations` is `observations[:, 1:]` except at
    the seams of `OAT(seam="literal")`, where it is the transition's own next state.

    Observations and actions are tensors, or dicts and tuples of tensors as the spaces are nested; `terminated` and
    `truncated` are kept apart, so that a truncated step can bootstrap; `episode` and `step` say where a step comes from
    (`episode` counts in the dataset or view that was loaded), `synthetic` whether it was generated.
    """

    observations: Batch
    actions: Batch
    rewards: torch.Tensor
    next_observations: Batch
    terminated: torch.Tensor
    truncated: torch.Tensor
    episode: torch.Tensor
    step: torch.Tensor
    synthetic: torch.Tensor
    mask: torch.Tensor

    def map(self, function: Callable[[torch.Tensor], torch.Tensor]) -> TorchBatch:
        """Return the batch with `function` applied to every tensor."""
        return TorchBatch(*(map_tree(function, field) for field in self))

    def to(self, device: str | torch.device, *, non_blocking: bool = False) -> TorchBatch:
        """Return the batch on a device; with `non_blocking` pinned batches are copied while the host goes on."""
        return self.map(lambda tensor: tensor.to(device, non_blocking=non_blocking))

    def pin_memory(self) -> TorchBatch:
        """Return the batch in pinned host memory, from which an accelerator copies without waiting."""
        return self.map(lambda tensor: tensor.pin_memory())


@dataclass(frozen=True)
class Items:
    """What a loader draws from, M items of consecutive steps of one episode.

    `start` (M,) is the first step, `length` (M,) the number of recorded steps, `synthetic` (M,) whether any of them was
    generated. `width` is what sequences are padded to (None: the longest of the batch; 0: single transitions).
    """

    start: torch.Tensor
    length: torch.Tensor
    synthetic: BoolArray
    width: int | None

    def __len__(self) -> int:
        """Return the number of items M."""
        return len(self.start)

    def to(self, device: torch.device) -> Items:
        """Return the items on a device."""
        return Items(self.start.to(device), self.length.to(device), self.synthetic, self.width)


def transition_items(columns: Columns) -> Items:
    """Return one item for each step."""
    n = columns.n_steps
    return Items(torch.arange(n), torch.ones(n, dtype=torch.int64), columns.synthetic, 0)


def episode_items(columns: Columns) -> Items:
    """Return one item for each episode."""
    starts = np.concatenate([[0], np.cumsum(columns.lengths)[:-1]])
    return _items(columns, starts, columns.lengths, None)


def window_items(columns: Columns, *, length: int, stride: int) -> Items:
    """Return the windows of each episode.

    They start at every `stride`-th step; the last one ends where the episode ends, whatever the stride, so that no step
    is left out. An episode shorter than `length` is one window, padded.
    """
    starts: list[IntArray] = []
    first = 0
    for steps in columns.lengths.tolist():
        last = max(steps - length, 0)
        offsets = np.append(np.arange(0, last, stride, dtype=np.int64), last)
        starts.append(first + offsets)
        first += steps
    sizes = np.minimum(columns.lengths, length)
    return _items(columns, np.concatenate(starts), np.repeat(sizes, [len(part) for part in starts]), length)


def gather(columns: Columns, items: Items, chosen: torch.Tensor) -> TorchBatch:
    """Return the batch of the items numbered `chosen` (B,)."""
    starts = items.start.index_select(0, chosen)
    if items.width == 0:
        mask = torch.ones(len(starts), dtype=torch.bool, device=starts.device)
        return _batch(columns, starts, columns.steps["state_row"].index_select(0, starts), mask)
    lengths = items.length.index_select(0, chosen)
    width = int(lengths.max()) if items.width is None else items.width
    offsets = torch.arange(width + 1, device=starts.device)
    mask = offsets[:-1] < lengths[:, None]
    rows = torch.where(mask, starts[:, None] + offsets[:-1], columns.n_steps)
    # The T+1 observations of an episode are consecutive rows; the padding row of all is the last one.
    first = columns.steps["state_row"].index_select(0, starts)
    states = torch.where(offsets <= lengths[:, None], first[:, None] + offsets, columns.steps["state_row"][-1])
    return _batch(columns, rows, states, mask)


def _items(columns: Columns, starts: IntArray, lengths: IntArray, width: int | None) -> Items:
    generated = np.concatenate([[0], np.cumsum(columns.synthetic)])
    synthetic = generated[starts + lengths] > generated[starts]
    return Items(torch.from_numpy(starts), torch.from_numpy(lengths.copy()), synthetic, width)


def _batch(columns: Columns, rows: torch.Tensor, states: torch.Tensor, mask: torch.Tensor) -> TorchBatch:
    steps = columns.steps
    following = _take(steps["next_row"], rows)
    return TorchBatch(
        observations=_take_tree(columns.observations, states),
        actions=_take_tree(columns.actions, rows),
        rewards=_take(steps["rewards"], rows),
        next_observations=_take_tree(columns.observations, following),
        terminated=_take(steps["terminated"], rows),
        truncated=_take(steps["truncated"], rows),
        episode=_take(steps["episode"], rows),
        step=_take(steps["step"], rows),
        synthetic=_take(steps["synthetic"], rows),
        mask=mask,
    )


def _take_tree(tree: Batch, rows: torch.Tensor) -> Any:
    return map_tree(lambda column: _take(column, rows), tree)


def _take(column: torch.Tensor, rows: torch.Tensor) -> torch.Tensor:
    index = rows.reshape(-1)
    if column.device.type == "cpu":
        # torch's own gather wakes a pool of threads, which costs more than the copy where cores are shared.
        taken = torch.from_numpy(column.numpy().take(index.numpy(), axis=0))
    else:
        taken = column.index_select(0, index)
    return taken.reshape(*rows.shape, *column.shape[1:])
