"""Outcome against agreement: how often an event happened where the logged actions agreed with a policy.

Where a policy cannot be tried, as in hospitals, the paper (appendix D.2, after Raghu et al., 2017) compares patients:
if the policy is good, the more the treatments agreed with it, the rarer septic shock should be. This compares patients
and not policies: sicker patients may be treated differently for reasons that no record holds.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from oat_gym.errors import ConfigurationError, InvalidDataError
from oat_gym.ope.intervals import check_confidence
from oat_gym.ope.logged import Logged
from oat_gym.ope.policy import Policy

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]


@dataclass(frozen=True)
class AgreementCurve:
    """Event rates by agreement.

    Attributes:
        low: (K,) least agreement of each group.
        high: (K,) greatest agreement of each group, not in it except for 1.
        count: (K,) episodes in the group.
        events: (K,) how many of them had the event.
        rate: (K,) events / count, NaN for an empty group.
        rate_low: (K,) lower end of Wilson's interval of the rate, 0 for an empty group.
        rate_high: (K,) upper end, 1 for an empty group.
    """

    low: FloatArray
    high: FloatArray
    count: IntArray
    events: IntArray
    rate: FloatArray
    rate_low: FloatArray
    rate_high: FloatArray


def agreement_rate(data: Logged, policy: Policy) -> FloatArray:
    """Return (E,) the share of the steps of each episode at which the logged action is the policy's.

    The policy's action is `policy.mean` (the most probable one); actions agree where all their features do, so this is
    for discrete actions.
    """
    wanted = data.flat_actions.flatten(policy.mean(data.steps.observations))
    same = (wanted == data.flat_actions.flatten(data.steps.actions)).all(axis=1)
    return np.add.reduceat(same.astype(np.float64), data.offsets[:-1]) / data.lengths


def agreement_curve(
    agreement: npt.ArrayLike,
    event: npt.ArrayLike,
    *,
    edges: Sequence[float] = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0),
    kind: Literal["bins", "at-least"] = "bins",
    confidence: float = 0.95,
) -> AgreementCurve:
    """Return the rate of an event, such as septic shock, by agreement with a policy.

    Args:
        agreement: (E,) share of agreeing steps of each episode (`agreement_rate`).
        event: (E,) booleans: whether the episode had the event.
        edges: increasing, within 0 to 1.
        kind: "bins" groups episodes between neighbouring edges; "at-least" is the paper's: all episodes with at least
            that agreement, one group for each edge, so that groups overlap.
        confidence: of Wilson's intervals, which do not break down for rates near 0 or small groups.

    Raises:
        ConfigurationError: for edges that are not increasing within [0, 1], or an unknown kind.
        InvalidDataError: for lengths that differ, or agreement outside [0, 1].

    >>> curve = agreement_curve([0.1, 0.9, 1.0, 0.2], [True, False, False, True], edges=(0.0, 0.5, 1.0))
    >>> curve.count.tolist(), curve.rate.tolist()
    ([2, 2], [1.0, 0.0])
    """
    check_confidence(confidence)
    shares, events = np.asarray(agreement, dtype=np.float64), np.asarray(event, dtype=bool)
    if shares.ndim != 1 or shares.shape != events.shape or not ((shares >= 0) & (shares <= 1)).all():
        raise InvalidDataError(
            f"agreement must be shares from 0 to 1, one for each event, got shapes {shares.shape} and {events.shape}."
        )
    limits = np.asarray(edges, dtype=np.float64)
    if limits.ndim != 1 or len(limits) < 2 or not (np.diff(limits) > 0).all() or limits[0] < 0 or limits[-1] > 1:
        raise ConfigurationError(f"edges must be at least two increasing numbers from 0 to 1, got {edges!r}.")
    if kind == "bins":
        low, high = limits[:-1], limits[1:]
    elif kind == "at-least":
        low, high = limits, np.ones(len(limits))
    else:
        raise ConfigurationError(f"kind must be 'bins' or 'at-least', got {kind!r}.")
    inside = (shares >= low[:, None]) & ((shares < high[:, None]) | (high[:, None] == 1.0))
    count, hits = inside.sum(axis=1), (inside & events).sum(axis=1)
    rate_low, rate_high = wilson_interval(hits, count, confidence=confidence)
    rate = np.where(count > 0, hits / np.maximum(count, 1), math.nan)
    return AgreementCurve(low, high, count, hits, rate, rate_low, rate_high)


def wilson_interval(
    hits: npt.ArrayLike, count: npt.ArrayLike, *, confidence: float = 0.95
) -> tuple[FloatArray, FloatArray]:
    """Return Wilson's score interval of a share, `hits` of `count`; (0, 1) where count is 0.

    >>> low, high = wilson_interval(5, 10)
    >>> round(float(low), 4), round(float(high), 4)
    (0.2366, 0.7634)
    """
    from scipy import stats  # noqa: PLC0415  (slow to import, and needed here only)

    check_confidence(confidence)
    n, z = np.asarray(count, dtype=np.float64), float(stats.norm.ppf(0.5 + confidence / 2))
    size = np.maximum(n, 1.0)
    share = np.asarray(hits, dtype=np.float64) / size
    centre = (share + z**2 / (2 * size)) / (1 + z**2 / size)
    width = z / (1 + z**2 / size) * np.sqrt(share * (1 - share) / size + z**2 / (4 * size**2))
    return np.where(n > 0, np.maximum(centre - width, 0.0), 0.0), np.where(n > 0, np.minimum(centre + width, 1.0), 1.0)
