"""Sums over steps whose importance weights are normalised among the episodes, with exact bootstrap replicates.

At each step t the weights of all episodes sum to one. An episode that has ended keeps its last weight and adds
nothing more, as if it stayed in an absorbing state of reward zero; steps that never happened are not counted with a
weight of their own. On policy the sum is then the mean return, whatever the lengths.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import njit

from oat_gym.episodes import IntArray
from oat_gym.ope.problem import Problem

FloatArray = npt.NDArray[np.float64]
BLOCK = 8_000_000
"""Numbers in one block of (episodes, steps), so that memory stays bounded."""
TINY = 1e-280
"""A sum of scaled weights below this may have lost its digits: it is taken again at its own scale."""


@dataclass(frozen=True)
class Spans:
    """The counted rows of the episodes that are weighted.

    Attributes:
        first: (E,) first row of each episode.
        length: (E,) number of its steps before the horizon, at least 1.
        unit: (E,) the real episode that each is or was made from.
        number: (E,) its number in the data.
    """

    first: IntArray
    length: IntArray
    unit: IntArray
    number: IntArray

    @classmethod
    def of(cls, problem: Problem) -> Spans:
        """Return the episodes that the weights of a problem are taken from."""
        chosen, data = problem.episodes("weights"), problem.data
        length = data.lengths[chosen]
        if problem.horizon is not None:
            length = np.minimum(length, problem.horizon)
        return cls(data.offsets[:-1][chosen], length, data.unit[chosen], np.flatnonzero(chosen))

    def counts(self, resamples: FloatArray) -> FloatArray:
        """Return (B, E): how often each resample (B, N) holds each episode; copies follow their real episode."""
        if np.array_equal(self.unit, np.arange(resamples.shape[1])):
            return resamples
        return resamples[:, self.unit]


def discounts(gamma: float, n: int) -> FloatArray:
    """Return gamma^0 ... gamma^(n-1)."""
    return np.power(gamma, np.arange(n, dtype=np.float64))


def normalised_sums(
    log_weights: FloatArray,
    values: FloatArray,
    log_final: FloatArray,
    spans: Spans,
    *,
    gamma: float,
    counts: FloatArray,
) -> tuple[float, FloatArray]:
    """Return the sum over steps t of gamma^t times the weighted mean of `values` at t, and the same of each resample.

    NaN where all episodes have weight zero at some step: the policy then does what no logged episode did.

    Args:
        log_weights: (n,) log weight of each row of the data.
        values: (n,) what is averaged at each row.
        log_final: (E,) log weight that each episode keeps after its last counted step.
        spans: the episodes.
        gamma: discount.
        counts: (B, E) how often each resample holds each episode.
    """
    total, replicates = 0.0, np.zeros(len(counts))
    n_episodes, n_steps = len(spans.length), int(spans.length.max())
    width = max(1, min(n_steps, BLOCK // n_episodes))
    powers = discounts(gamma, n_steps)
    for start in range(0, n_steps, width):
        stop = min(start + width, n_steps)
        logs, parts = block = np.empty((2, n_episodes, stop - start))
        _fill((log_weights, values), log_final, (spans.first, spans.length), start, block)
        total += float(_weighted_means(logs, parts, None)[0] @ powers[start:stop])
        replicates += _weighted_means(logs, parts, counts) @ powers[start:stop]
    return total, replicates


def normalised_means(log_weights: FloatArray, values: FloatArray, counts: FloatArray) -> tuple[float, FloatArray]:
    """Return the mean of `values` (E,) under the normalised weights, and that of each resample, (B,)."""
    logs, parts = log_weights[:, None], values[:, None]
    return float(_weighted_means(logs, parts, None)[0, 0]), _weighted_means(logs, parts, counts)[:, 0]


def _weighted_means(logs: FloatArray, parts: FloatArray, counts: FloatArray | None) -> FloatArray:
    """Return (B, T) means of the columns of `parts` (E, T) under the weights exp(logs); counts None: one of each."""
    highest = logs.max(axis=0)
    highest[~np.isfinite(highest)] = 0.0
    scaled = np.exp(logs - highest)
    if counts is None:
        sums, weighted = scaled.sum(axis=0)[None], np.einsum("et,et->t", scaled, parts)[None]
    else:
        sums, weighted = counts @ scaled, counts @ (scaled * parts)
    lost = sums < TINY
    with np.errstate(invalid="ignore", divide="ignore"):
        means = weighted / sums
    if lost.any():
        chosen = np.ones((1, len(logs))) if counts is None else counts
        means[lost] = _means_one_by_one(logs, parts, chosen, np.argwhere(lost))
    return means


# A resample may lack the episodes of large weight: the others are then summed at the scale of the largest that is
# there. Both kernels are compiled when first called.
@njit(nogil=True)
def _means_one_by_one(logs: FloatArray, parts: FloatArray, counts: FloatArray, pairs: IntArray) -> FloatArray:
    means = np.empty(len(pairs))
    for k in range(len(pairs)):
        b, t = pairs[k]
        highest = -np.inf
        for e in range(len(logs)):
            if counts[b, e] > 0 and logs[e, t] > highest:
                highest = logs[e, t]
        total, weighted = 0.0, 0.0
        for e in range(len(logs)):
            if counts[b, e] > 0 and highest > -np.inf:
                weight = counts[b, e] * np.exp(logs[e, t] - highest)
                total += weight
                weighted += weight * parts[e, t]
        means[k] = weighted / total if total > 0 else np.nan
    return means


@njit(nogil=True)
def _fill(
    columns: tuple[FloatArray, FloatArray],
    log_final: FloatArray,
    spans: tuple[IntArray, IntArray],
    start: int,
    block: FloatArray,
) -> None:
    log_weights, values = columns
    first, length = spans
    for e in range(len(first)):
        for column in range(block.shape[2]):
            t = start + column
            if t < length[e]:
                block[0, e, column] = log_weights[first[e] + t]
                block[1, e, column] = values[first[e] + t]
            else:
                block[0, e, column] = log_final[e]
                block[1, e, column] = 0.0
