"""How the states of a finite process are shown to learners: as numbers, or as the features that they stand for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from oat_gym.ope.policies import CategoricalPolicy, TabularPolicy
from oat_gym.ope.policy import Policy
from oat_gym.spaces import Batch

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
_ROWS = 4096  # observations compared with all centres at once


@dataclass(frozen=True)
class View:
    """An observation space for states 0 to S-1.

    Attributes:
        space: of the observations.
        observe: states (n,) -> observations.
        recover: observations -> states (n,); of observations that show no state exactly, the nearest.
    """

    space: gym.Space[Any]
    observe: Callable[[IntArray], Batch]
    recover: Callable[[Batch], IntArray]

    def policy(self, table: FloatArray) -> Policy:
        """Return a table (S, A) of probabilities as a policy on these observations."""
        known = TabularPolicy(table)
        return known if isinstance(self.space, spaces.Discrete) else FeaturePolicy(known, self.recover)


@dataclass(frozen=True)
class FeaturePolicy(CategoricalPolicy):
    """A table of probabilities behind observations that show features of the state.

    Attributes:
        table: the policy on state numbers.
        recover: observations -> state numbers (n,).
    """

    table: TabularPolicy
    recover: Callable[[Batch], IntArray]

    def probabilities(self, observations: Batch) -> FloatArray:
        """Return pi(a|s) of the states that the observations show, (n, A)."""
        return self.table.probabilities(self.recover(observations))


def numbers(n_states: int) -> View:
    """Return the view of states as `Discrete(n_states)`.

    >>> numbers(3).observe(np.array([2, 0])).tolist()
    [2, 0]
    """

    def same(values: Batch) -> IntArray:
        return np.array(values, dtype=np.int64)

    return View(spaces.Discrete(n_states), same, same)


def categories(sizes: tuple[int, ...]) -> View:
    """Return the view of states as `MultiDiscrete(sizes)`, the first category changing slowest.

    >>> categories((2, 3)).observe(np.array([4])).tolist()
    [[1, 1]]
    """

    def observe(states: IntArray) -> Batch:
        return np.stack(np.unravel_index(states, sizes), axis=-1).astype(np.int64)

    def recover(observations: Batch) -> IntArray:
        return np.asarray(np.ravel_multi_index(tuple(np.asarray(observations).T), sizes), dtype=np.int64)

    return View(spaces.MultiDiscrete(list(sizes)), observe, recover)


def centres(points: FloatArray, *, known: int | None = None) -> View:
    """Return the view of states as the rows of `points` (S, D), recovered as the nearest row (Euclidean).

    Only the first `known` rows are recovered: the others stand for no place (ends, which show as zeros).

    >>> view = centres(np.array([[0.0, 0.0], [1.0, 1.0]]))
    >>> view.recover(np.array([[0.9, 0.7]])).tolist()
    [1]
    """

    def observe(states: IntArray) -> Batch:
        return points[states]

    def recover(observations: Batch) -> IntArray:
        rows = np.asarray(observations, dtype=np.float64)
        parts = [_nearest(rows[start : start + _ROWS], points[:known]) for start in range(0, len(rows), _ROWS)]
        return np.concatenate(parts) if parts else np.zeros(0, dtype=np.int64)

    return View(spaces.Box(-np.inf, np.inf, points.shape[1:], np.float64), observe, recover)


def _nearest(rows: FloatArray, points: FloatArray) -> IntArray:
    return (np.square(points).sum(axis=1) - 2.0 * rows @ points.T).argmin(axis=1)
