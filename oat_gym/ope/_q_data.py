"""The transitions that action values are fitted to, as arrays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from oat_gym.episodes import BoolArray, IntArray
from oat_gym.ope._deviation import deviation
from oat_gym.ope._q_function import value_scale
from oat_gym.ope.problem import Problem
from oat_gym.spaces import Batch, map_tree

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class QData:
    """n training transitions and the ranges of their values.

    Attributes:
        rows: (n,) their rows in the data.
        states: (n, D) features.
        actions: (n, A) features.
        next_states: (n, D) features.
        next_observations: the next states as a batch of the space.
        rewards: (n,) in environment units.
        terminated: (n,) true where the next state is terminal: nothing is earned after it.
        unit: (n,) the real episode that a row is from or was made from.
        discrete: True where the action space is one `Discrete`.
    """

    rows: IntArray
    states: FloatArray
    actions: FloatArray
    next_states: FloatArray
    next_observations: Batch
    rewards: FloatArray
    terminated: BoolArray
    unit: IntArray
    discrete: bool

    @classmethod
    def of(cls, problem: Problem) -> QData:
        """Take the rows of the problem's training part."""
        data, rows = problem.data, problem.rows("training")
        layout = data.flat_actions.layout
        return cls(
            rows=rows,
            states=data.states[rows],
            actions=data.actions[rows],
            next_states=data.next_states[rows],
            next_observations=map_tree(lambda leaf: leaf[rows], data.steps.next_observations),
            rewards=data.steps.rewards[rows].astype(np.float64),
            terminated=data.steps.terminated[rows],
            unit=data.unit[data.steps.episode[rows]],
            discrete=layout.categorical == ((0, layout.width),),
        )

    def resampled_rows(self, counts: FloatArray | None) -> IntArray:
        """Return the rows, 0 to n-1, of a resample that holds real episode i `counts[i]` times; None: each once."""
        rows = np.arange(len(self.rows))
        return rows if counts is None else np.repeat(rows, counts[self.unit].astype(np.int64))


@dataclass(frozen=True)
class RewardScale:
    """z-scoring of rewards, and the bounds that values have in z-scored units.

    The mean is 0 where any episode terminates, since a terminal state earns nothing for ever: subtracting a mean would
    change what ending is worth. For the same reason the bounds then hold 0. A value of `scale * u + center * c` in
    environment units corresponds to u, where c is the sum of discounts of the steps that it counts.
    """

    center: float
    scale: float
    low: float
    high: float

    @classmethod
    def of(cls, data: QData) -> RewardScale:
        """Return the scaling of the training rewards; constant rewards are only centred."""
        ends = bool(data.terminated.any())
        center = 0.0 if ends else float(data.rewards.mean())
        scale = float(deviation(data.rewards)) or max(abs(float(data.rewards[0])), 1.0)
        low, high = (data.rewards.min() - center) / scale, (data.rewards.max() - center) / scale
        return cls(center, scale, min(low, 0.0) if ends else low, max(high, 0.0) if ends else high)

    def bounds(self, problem: Problem) -> tuple[float, float]:
        """Return the least and greatest value in environment units."""
        total = value_scale(problem)
        return (self.low * self.scale + self.center) * total, (self.high * self.scale + self.center) * total
