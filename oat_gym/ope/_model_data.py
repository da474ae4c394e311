"""What dynamics models are fitted to: z-scored inputs and targets, and the split into training and held-out steps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from oat_gym._rng import derive
from oat_gym.episodes import IntArray
from oat_gym.errors import InvalidDataError
from oat_gym.ope._q_data import QData
from oat_gym.ope.problem import Problem
from oat_gym.spaces import Layout

FloatArray = npt.NDArray[np.float64]
MIN_VARIANCE = 1e-8
"""z-scored columns of less variance are constant up to rounding: their errors are not counted in parts of it."""


@dataclass(frozen=True)
class Scale:
    """z-scores of columns; constant columns are only centred."""

    center: FloatArray
    spread: FloatArray

    @classmethod
    def of(cls, columns: FloatArray) -> Scale:
        """Take the means and standard deviations of (n, W) columns."""
        spread = columns.std(axis=0)
        return cls(columns.mean(axis=0), np.where(spread > 1e-8, spread, 1.0))

    def __call__(self, columns: FloatArray) -> FloatArray:
        """Return the z-scores."""
        return (columns - self.center) / self.spread

    def inverse(self, scores: FloatArray) -> FloatArray:
        """Return the columns of z-scores."""
        return scores * self.spread + self.center


@dataclass(frozen=True)
class Ranges:
    """Least and greatest value of each state column (D,) and of the rewards: roll-outs are clipped to them."""

    low: FloatArray
    high: FloatArray
    least_reward: float
    greatest_reward: float

    @classmethod
    def unlimited(cls, width: int) -> Ranges:
        """Return ranges that clip nothing."""
        return cls(np.full(width, -np.inf), np.full(width, np.inf), -np.inf, np.inf)


@dataclass(frozen=True)
class Moves:
    """n transitions as a model sees them.

    Attributes:
        inputs: (n, D + A) z-scored states and actions.
        changes: (n, D) z-scored changes of continuous state columns; one-hot blocks of next states as they are.
        rewards: (n, 1) z-scored.
        going: (n,) 1 where the episode goes on, 0 where it terminated.
        unit: (n,) real episode of each.
        layout: of the state columns.
        scales: of inputs, changes and rewards.
        ranges: of the data.
    """

    inputs: FloatArray
    changes: FloatArray
    rewards: FloatArray
    going: FloatArray
    unit: IntArray
    layout: Layout
    scales: tuple[Scale, Scale, Scale]
    ranges: Ranges

    @classmethod
    def of(cls, problem: Problem) -> Moves:
        """Take the rows of the problem's training part."""
        data, layout = QData.of(problem), problem.data.flat_observations.layout
        going = ~data.terminated
        moving = going if going.any() else ~going  # where every episode is one step long, no move matters
        inputs = np.concatenate((data.states, data.actions), axis=1)
        changes = data.next_states.copy()
        real = list(layout.continuous)
        changes[:, real] -= data.states[:, real]
        of_changes = Scale.of(changes[moving])
        of_changes.center[_one_hot(layout)], of_changes.spread[_one_hot(layout)] = 0.0, 1.0
        scales = Scale.of(inputs), of_changes, Scale.of(data.rewards[:, None])
        seen = np.concatenate((data.states, data.next_states))
        return cls(
            inputs=scales[0](inputs),
            changes=of_changes(changes),
            rewards=scales[2](data.rewards[:, None]),
            going=going.astype(np.float64),
            unit=data.unit,
            layout=layout,
            scales=scales,
            ranges=Ranges(seen.min(0), seen.max(0), float(data.rewards.min()), float(data.rewards.max())),
        )

    @property
    def ends(self) -> bool:
        """Whether any episode terminates: continuation is learned only then."""
        return bool((self.going == 0).any())

    def next_states(self, states: FloatArray, changes: FloatArray) -> FloatArray:
        """Return next states (..., D) from states and the models' z-scored changes."""
        result = self.scales[1].inverse(changes)
        real = list(self.layout.continuous)
        result[..., real] += states[..., real]
        return result


@dataclass(frozen=True)
class Split:
    """Rows of `Moves` for G networks.

    Attributes:
        training: those that each network is trained on.
        held: (G, m) held-out rows, repeated or thinned to m.
    """

    training: tuple[IntArray, ...]
    held: IntArray

    def where(self, allowed: npt.NDArray[np.bool_]) -> Split:
        """Return the split of the rows that `allowed` (n,) holds."""
        size = self.held.shape[1]
        held = [
            np.resize(kept if len(kept := rows[allowed[rows]]) else np.flatnonzero(allowed), size) for rows in self.held
        ]
        return Split(tuple(rows[allowed[rows]] for rows in self.training), np.stack(held))


def split(
    problem: Problem, moves: Moves, *, seeds: Sequence[int], ensemble: int, bootstrap: bool, share: float, size: int
) -> Split:
    """Hold out a share of the real episodes (at least one), with the synthetic ones made from them.

    A single episode is split by steps. The members of a seed's ensemble hold out the same episodes; with `bootstrap`
    member m is trained on resample m.

    Raises:
        InvalidDataError: if a member has no step to train on.
    """
    training: list[IntArray] = []
    held: list[IntArray] = []
    units = np.unique(moves.unit)
    for seed in seeds:
        rng = derive(seed, "model held out")
        blocks = moves.unit if len(units) > 1 else np.arange(len(moves.unit))
        each = rng.permutation(np.unique(blocks))
        out = np.isin(blocks, each[: max(round(share * len(each)), 1)])
        for member in range(ensemble):
            rows = np.flatnonzero(~out)
            if bootstrap:
                counts = problem.resamples[member % len(problem.resamples)]
                rows = np.repeat(rows, counts[moves.unit[rows]].astype(np.int64))
            if not len(rows) or (moves.going.any() and not moves.going[rows].any()):
                raise InvalidDataError("A dynamics model has no episode to learn from: there are too few episodes.")
            training.append(rows)
            held.append(np.resize(rng.permutation(np.flatnonzero(out)) if not member else held[-1], size))
    return Split(tuple(training), np.stack(held))


def _one_hot(layout: Layout) -> list[int]:
    return [column for start, stop in layout.categorical for column in range(start, stop)]


def tensor(values: FloatArray, device: str) -> Tensor:
    """Return float32 values on the device."""
    return torch.from_numpy(np.ascontiguousarray(values, dtype=np.float32)).to(device)
