"""The range that generated values may not leave."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from oat_gym.generation.normalizer import CONSTANT
from oat_gym.spaces import FloatMatrix, Layout

Bounds = tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]
"""Lower and upper bounds of each column, (width,) each."""


@dataclass(frozen=True)
class Limits:
    """Lower and upper bounds of states, actions and rewards. One-hot columns are never clipped.

    Attributes:
        states: two arrays of shape (state width,).
        actions: two arrays of shape (action width,).
        rewards: two numbers.

    >>> limits = Limits.of(np.array([[0.0], [10.0]]), np.array([[-1.0], [1.0]]), np.array([0.0, 2.0]), margin=0.1)
    >>> limits.states[1].tolist(), limits.rewards
    ([11.0], (-0.2, 2.2))
    """

    states: Bounds
    actions: Bounds
    rewards: tuple[float, float]

    @classmethod
    def of(
        cls,
        states: npt.NDArray[np.floating[Any]],
        actions: npt.NDArray[np.floating[Any]],
        rewards: npt.NDArray[np.floating[Any]],
        *,
        margin: float,
        state_bounds: Bounds | None = None,
        action_bounds: Bounds | None = None,
    ) -> Limits:
        """Return the range of the data, wider on either side by `margin` times its width, inside the spaces' bounds.

        Args:
            states: (n, state width) rows of the training data.
            actions: (m, action width).
            rewards: (m,).
            margin: share of each column's range.
            state_bounds: bounds of the observation space, as `FlatSpace.bounds` gives them.
            action_bounds: bounds of the action space. Recorded actions may exceed them (an environment clips them);
                generated actions then do not.
        """
        low, high = _widened(rewards.reshape(-1, 1), margin, None)
        return cls(
            _widened(states, margin, state_bounds),
            _widened(actions, margin, action_bounds),
            (float(low[0]), float(high[0])),
        )

    def holding(self, own: Limits) -> Limits:
        """Return these limits, shut where `own`, those of training spans, let a state column or the reward not vary.

        A network tells a constant by its error, in units that nothing has normalised: where rewards are 0 but at the
        goal, small rewards everywhere.
        """
        low, high = _held(_pair(self.rewards), _pair(own.rewards))
        return Limits(_held(self.states, own.states), self.actions, (float(low[0]), float(high[0])))

    def clip_states(self, states: FloatMatrix, layout: Layout) -> FloatMatrix:
        """Return (n, width) states with their real-valued columns clipped."""
        return _clip(states, self.states, layout)

    def clip_actions(self, actions: FloatMatrix, layout: Layout) -> FloatMatrix:
        """Return (n, width) actions with their real-valued columns clipped."""
        return _clip(actions, self.actions, layout)

    def to_arrays(self, prefix: str) -> dict[str, npt.NDArray[Any]]:
        """Return the bounds as (2, width) arrays."""
        return {
            f"{prefix}.states": np.stack(self.states),
            f"{prefix}.actions": np.stack(self.actions),
            f"{prefix}.rewards": np.array(self.rewards),
        }

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, npt.NDArray[Any]], prefix: str) -> Limits:
        """Return the limits that `to_arrays` wrote."""
        states, actions = np.array(arrays[f"{prefix}.states"]), np.array(arrays[f"{prefix}.actions"])
        low, high = arrays[f"{prefix}.rewards"]
        return cls((states[0], states[1]), (actions[0], actions[1]), (float(low), float(high)))


def _pair(bounds: tuple[float, float]) -> Bounds:
    return np.array([bounds[0]]), np.array([bounds[1]])


def _held(bounds: Bounds, own: Bounds) -> Bounds:
    constant = own[1] - own[0] <= CONSTANT * np.maximum(np.abs(own[0]), np.abs(own[1]))
    value = np.clip(own[0], *bounds)
    return np.where(constant, value, bounds[0]), np.where(constant, value, bounds[1])


def _widened(rows: npt.NDArray[np.floating[Any]], margin: float, bounds: Bounds | None) -> Bounds:
    low, high = rows.min(axis=0).astype(np.float64), rows.max(axis=0).astype(np.float64)
    room = margin * (high - low)
    low, high = low - room, high + room
    if bounds is None:
        return low, high
    # Clipping into the space also where all of the data lies beyond one of its bounds.
    return np.clip(low, *bounds), np.clip(high, *bounds)


def _clip(values: FloatMatrix, bounds: Bounds, layout: Layout) -> FloatMatrix:
    columns = list(layout.continuous)
    clipped = values.copy()
    clipped[:, columns] = np.clip(values[:, columns], bounds[0][columns], bounds[1][columns])
    return clipped
