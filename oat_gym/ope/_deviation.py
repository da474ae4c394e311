"""Standard deviations that tell a constant from numbers that vary."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
ROUNDING = 1e-9
"""A standard deviation below this share of the largest number is rounding: that of a thousand times 0.1 is 1e-17."""


def deviation(numbers: npt.NDArray[np.floating]) -> FloatArray:
    """Return the standard deviation over the first axis, 0 where the numbers are one up to rounding.

    >>> deviation(np.full((1000, 1), 0.1)).tolist(), deviation(np.array([0.0, 2.0])).tolist()
    ([0.0], 1.0)
    """
    found = numbers.std(axis=0)
    return np.where(found > ROUNDING * np.abs(numbers).max(axis=0), found, 0.0)
