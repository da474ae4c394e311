"""Whole episodes as padded series of [state, action, reward] rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from oat_gym.errors import InvalidDataError, TrainingError
from oat_gym.spaces import FloatMatrix, Layout

IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class PaddedSeries:
    """N episodes as series of rows [s_t, a_t, r_t], padded behind their ends to L = (most steps) + 1 rows.

    An episode of T steps has T+1 rows: the last holds a state only (the T+1 rule).

    Attributes:
        rows: (N, L, width) flat features in their own units; what `recorded` does not mark is zero.
        lengths: (N,) number of steps T of each episode.
        state_layout: columns of a state.
        action_layout: columns of an action.

    >>> one = Layout(1, (0,), ())
    >>> episode = [np.ones((3, 1))], [np.ones((2, 1))], [np.ones(2)]
    >>> series = PaddedSeries.of(*episode, state_layout=one, action_layout=one)
    >>> series.rows.tolist()
    [[[1.0, 1.0, 1.0], [1.0, 1.0, 1.0], [1.0, 0.0, 0.0]]]
    """

    rows: npt.NDArray[np.float64]
    lengths: IntArray
    state_layout: Layout
    action_layout: Layout

    @classmethod
    def of(
        cls,
        states: Sequence[FloatMatrix],
        actions: Sequence[FloatMatrix],
        rewards: Sequence[npt.NDArray[np.float64]],
        *,
        state_layout: Layout,
        action_layout: Layout,
    ) -> PaddedSeries:
        """Return the series of episodes with (T_i+1, state width) states, (T_i, action width) actions, (T_i,) rewards.

        Raises:
            InvalidDataError: if the lengths of an episode's parts do not agree.
            TrainingError: if a value is NaN or infinite.
        """
        lengths = np.array([len(part) for part in rewards], dtype=np.int64)
        width = state_layout.width
        rows = np.zeros((len(lengths), int(lengths.max()) + 1, width + action_layout.width + 1))
        for i, (s, a, r) in enumerate(zip(states, actions, rewards, strict=True)):
            if len(s) != len(r) + 1 or len(a) != len(r):
                raise InvalidDataError(
                    f"Episode {i} has {len(s)} states and {len(a)} actions beside {len(r)} rewards; T rewards go with "
                    "T+1 states and T actions."
                )
            rows[i, : len(s), :width] = s
            rows[i, : len(r), width:-1] = a
            rows[i, : len(r), -1] = r
            if not np.isfinite(rows[i]).all():
                raise TrainingError(f"Episode {i} has values that are not finite; fill or drop them first.")
        return cls(rows, lengths, state_layout, action_layout)

    def __len__(self) -> int:
        return len(self.lengths)

    @cached_property
    def layout(self) -> Layout:
        """What the columns of a row mean."""
        return series_layout(self.state_layout, self.action_layout)

    @cached_property
    def recorded_rows(self) -> BoolArray:
        """(N, L) which rows hold a state: the first T+1."""
        return np.arange(self.rows.shape[1]) <= self.lengths[:, None]

    @cached_property
    def recorded_steps(self) -> BoolArray:
        """(N, L) which rows hold an action and a reward: the first T."""
        return np.arange(self.rows.shape[1]) < self.lengths[:, None]

    @cached_property
    def recorded(self) -> BoolArray:
        """(N, L, width) which entries were recorded."""
        return np.concatenate(
            (
                np.repeat(self.recorded_rows[..., None], self.state_layout.width, axis=2),
                np.repeat(self.recorded_steps[..., None], self.action_layout.width + 1, axis=2),
            ),
            axis=2,
        )

    def column_values(self) -> list[npt.NDArray[np.float64]]:
        """Return the recorded values of each column, padding left out."""
        recorded = self.recorded
        return [self.rows[..., column][recorded[..., column]] for column in range(self.rows.shape[2])]


def series_layout(state_layout: Layout, action_layout: Layout) -> Layout:
    """Return the layout of a row [state, action, reward]."""
    start = state_layout.width
    last = start + action_layout.width
    return Layout(
        last + 1,
        (*state_layout.continuous, *(start + column for column in action_layout.continuous), last),
        (*state_layout.categorical, *((start + low, start + high) for low, high in action_layout.categorical)),
    )


def split_rows(
    rows: npt.NDArray[np.floating[Any]], state_width: int
) -> tuple[npt.NDArray[Any], npt.NDArray[Any], npt.NDArray[Any]]:
    """Return the states (..., state width), actions and rewards (...) of rows (..., width), as views."""
    return rows[..., :state_width], rows[..., state_width:-1], rows[..., -1]
