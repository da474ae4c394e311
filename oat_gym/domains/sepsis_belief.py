"""What is believed of the attributes between two measurements, after Temporal Belief Memory.

Source: Kim and Chi, "Temporal Belief Memory: Imputing Missing Data during RNN Training", IJCAI 2018: the last recorded
value is believed less the longer ago it was recorded, in real time and not in steps. There the rate is learnt inside a
recurrent network. Here it is the fixed half-life of each attribute (`sepsis_attributes`), so that an observation is a
function of the patient's own past alone, the same in training and test data and in everybody's tables. The missing
indicators that go with it are Lipton, Kale and Wetzel's, "Directly modeling missing data in sequences with RNNs", 2016.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from oat_gym.domains.sepsis_attributes import HALF_LIFE, NORMAL

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class LastKnown:
    """What was last recorded, at each of N events.

    Attributes:
        values: (N, D) the last recorded values, NaN before the first.
        ages: (N, D) hours since they were recorded, infinite before the first.
    """

    values: FloatArray
    ages: FloatArray


def last_known(recorded: FloatArray, hours: FloatArray) -> LastKnown:
    """Return the last recorded value of each attribute at each event, the event itself included.

    Args:
        recorded: (N, D) values, NaN where nothing was recorded.
        hours: (N,) times in hours, which never decrease.

    >>> known = last_known(np.array([[np.nan], [5.0], [np.nan]]), np.array([0.0, 1.0, 3.0]))
    >>> known.values.ravel().tolist(), known.ages.ravel().tolist()
    ([nan, 5.0, 5.0], [inf, 0.0, 2.0])
    """
    rows = np.where(np.isnan(recorded), -1, np.arange(len(recorded))[:, None])
    rows = np.maximum.accumulate(rows, axis=0)
    ages = np.where(rows >= 0, hours[:, None] - hours[rows], np.inf)
    values = np.where(rows >= 0, np.take_along_axis(recorded, np.maximum(rows, 0), axis=0), np.nan)
    return LastKnown(values, ages)


def belief(ages: FloatArray, half_life: FloatArray = HALF_LIFE) -> FloatArray:
    """Return the belief in values of these ages, 2 ** (-age / half_life): 1 when recorded, 0 before the first record.

    >>> belief(np.array([0.0, 8.0, np.inf]), np.array(8.0)).tolist()
    [1.0, 0.5, 0.0]
    """
    return np.exp2(-ages / half_life)


def believed_values(known: LastKnown, normal: FloatArray = NORMAL, half_life: FloatArray = HALF_LIFE) -> FloatArray:
    """Return (N, D) the imputed values, normal + belief * (last value - normal); a value just recorded is itself.

    What nobody measures any more is mostly what became normal, so values fade to the normal ones, not to the mean of
    those that were measured.
    """
    last = np.where(np.isnan(known.values), normal, known.values)
    return np.where(known.ages == 0, last, normal + belief(known.ages, half_life) * (last - normal))


def current_values(known: LastKnown, half_life: FloatArray = HALF_LIFE) -> FloatArray:
    """Return (N, D) the last recorded values, not faded, and NaN once less than half of the belief is left.

    This is what the rules of `sepsis_stages` read: a faded value would cross their thresholds without any news.
    """
    return np.where(known.ages <= half_life, known.values, np.nan)
