"""The best path of labels under a penalty for each switch (Viterbi), for all series in one pass."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray


def viterbi(
    scores: NDArray[np.float64], penalties: NDArray[np.float64], starts: NDArray[np.int64]
) -> tuple[NDArray[np.int64], float]:
    """Return the labels that maximise the sum of scores less the penalties of the switches, and that maximum.

    Series are independent: no penalty is paid between the last row of one and the first row of the next. Because
    every switch at a row costs the same, a step needs the best previous label only: O(n C), not O(n C^2). Ties
    prefer to stay, then the lowest label.

    Args:
        scores: (n, C) score of each label in each row, the rows of all series one after the other.
        penalties: (n,) non-negative cost of a switch between a row and the row before it.
        starts: (N,) first row of each series, increasing, the first one 0.

    >>> labels, best = viterbi(np.array([[1.0, 0.0], [0.0, 0.5], [1.0, 0.0]]), np.ones(3), np.array([0]))
    >>> labels.tolist(), best
    ([0, 0, 0], 2.0)
    """
    is_start = np.zeros(len(scores), dtype=np.bool_)
    is_start[starts] = True
    labels, best = _best_paths(np.ascontiguousarray(scores), penalties, is_start)
    return labels, float(best)


# Compiled when first called (about a second); not cached on disk, since packages may lie in read-only folders.
@njit(nogil=True)
def _best_paths(
    scores: NDArray[np.float64], penalties: NDArray[np.float64], is_start: NDArray[np.bool_]
) -> tuple[NDArray[np.int64], float]:
    n, n_labels = scores.shape
    value = np.empty(n_labels)
    back = np.empty((n, n_labels), dtype=np.int32)
    labels = np.empty(n, dtype=np.int64)
    total = 0.0
    for t in range(n):
        if is_start[t]:
            value[:] = scores[t]
        else:
            top = np.argmax(value)
            switched = value[top] - penalties[t]
            for k in range(n_labels):
                if switched > value[k]:
                    back[t, k] = top
                    value[k] = switched + scores[t, k]
                else:
                    back[t, k] = k
                    value[k] += scores[t, k]
        if t == n - 1 or is_start[t + 1]:
            label = np.argmax(value)
            total += value[label]
            s = t
            labels[s] = label
            while not is_start[s]:
                label = back[s, label]
                s -= 1
                labels[s] = label
    return labels, total


def path_score(
    scores: NDArray[np.float64],
    penalties: NDArray[np.float64],
    starts: NDArray[np.int64],
    labels: NDArray[np.int64],
) -> float:
    """Return the penalised score of given labels: what `viterbi` maximises."""
    switches = np.flatnonzero(np.diff(labels)) + 1
    switches = switches[~np.isin(switches, starts)]
    return float(scores[np.arange(len(labels)), labels].sum() - penalties[switches].sum())
