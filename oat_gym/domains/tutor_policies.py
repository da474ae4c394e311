"""Policies of the SmartPrimer task: the tutor as its log records it, and simple ones to compare it with."""

from __future__ import annotations

from dataclasses import dataclass

import minari
import numpy as np
import numpy.typing as npt

from oat_gym.errors import InvalidDataError
from oat_gym.ope.policies import CategoricalPolicy, check_rows
from oat_gym.spaces import Batch

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class RecordedPolicy(CategoricalPolicy):
    """A tutor whose log holds the probability of each action, at the states of that log.

    At any other state it acts as at the nearest recorded one. Where a state was recorded more than once with different
    probabilities (the tutor learned in between), it has their mean.

    Attributes:
        states: (m, D) recorded states, all different.
        rows: (m, K) probabilities there.

    Raises:
        ConfigurationError: if rows are not probabilities.
        InvalidDataError: for shapes that do not agree.

    >>> tutor = RecordedPolicy(np.array([[0.0], [1.0]]), np.array([[0.9, 0.1], [0.2, 0.8]]))
    >>> tutor.probabilities(np.array([[0.1], [0.9]])).tolist()
    [[0.9, 0.1], [0.2, 0.8]]
    """

    states: FloatArray
    rows: FloatArray

    def __post_init__(self) -> None:
        if self.states.ndim != 2 or self.rows.ndim != 2 or len(self.states) != len(self.rows) or not len(self.rows):
            raise InvalidDataError(f"States {self.states.shape} and probabilities {self.rows.shape} do not agree.")
        check_rows(self.rows, "RecordedPolicy: state")

    @classmethod
    def of(cls, dataset: minari.MinariDataset) -> RecordedPolicy:
        """Return the policy of a log with `infos["probabilities"]` (K a step) and `infos["log_prob"]`.

        An action that was taken, and whose probability was rounded to 0, has what `log_prob` says; the most probable
        action makes up for it.
        """
        episodes = list(dataset)
        states = np.concatenate([episode.observations[: len(episode.actions)] for episode in episodes])
        printed = np.concatenate([episode.infos["probabilities"] for episode in episodes])
        actions = np.concatenate([episode.actions for episode in episodes])
        taken = np.exp(np.concatenate([episode.infos["log_prob"] for episode in episodes]))
        different, group = np.unique(states, axis=0, return_inverse=True)
        group = group.ravel()
        rows = np.zeros((len(different), printed.shape[1]))
        np.add.at(rows, group, printed)
        rows /= np.bincount(group)[:, None]
        lost = rows[group, actions] == 0
        rows[group[lost], actions[lost]] = taken[lost]
        rows[np.arange(len(rows)), rows.argmax(axis=1)] += 1.0 - rows.sum(axis=1)
        return cls(different, rows)

    def probabilities(self, observations: Batch) -> FloatArray:
        """Return pi(a|s) of each action, (n, K)."""
        queries = np.asarray(observations, dtype=np.float64)
        nearest = [int(((self.states - query) ** 2).sum(axis=1).argmin()) for query in queries]
        return self.rows[nearest]


@dataclass(frozen=True)
class ConstantPolicy(CategoricalPolicy):
    """The same probabilities in every state.

    Attributes:
        row: (K,) probabilities.

    Raises:
        ConfigurationError: if they are not probabilities.

    >>> ConstantPolicy((0.0, 1.0)).mean(np.zeros((2, 8))).tolist()
    [1, 1]
    """

    row: tuple[float, ...]

    def __post_init__(self) -> None:
        check_rows(np.array([self.row], dtype=np.float64), "ConstantPolicy: row")

    @classmethod
    def mostly(cls, action: int, *, n_actions: int, epsilon: float) -> ConstantPolicy:
        """Return the policy that takes one action, or with probability epsilon any."""
        row = np.full(n_actions, epsilon / n_actions)
        row[action] += 1.0 - epsilon
        return cls(tuple(row.tolist()))

    def probabilities(self, observations: Batch) -> FloatArray:
        """Return the row for each observation, (n, K)."""
        return np.tile(np.array(self.row), (len(np.asarray(observations)), 1))
