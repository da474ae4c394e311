"""Random numbers by counting: each is a hash of a patient's key, the step, and what it is for.

So a patient's course depends on nothing but their key and treatments: alone or among thousands of others it is the
same. The hash is the finaliser of SplitMix64 (Steele, Lea and Flood, "Fast splittable pseudorandom number generators",
OOPSLA 2014), applied twice.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_FIRST = np.uint64(0xBF58476D1CE4E5B9)
_SECOND = np.uint64(0x94D049BB133111EB)
_30, _27, _31, _11 = np.uint64(30), np.uint64(27), np.uint64(31), np.uint64(11)
_DRAWS = np.uint64(128)  # random numbers of a step


@njit(nogil=True)
def _mix(x: np.uint64) -> np.uint64:
    x = (x ^ (x >> _30)) * _FIRST
    x = (x ^ (x >> _27)) * _SECOND
    return x ^ (x >> _31)


@njit(nogil=True)
def uniform(key: np.uint64, step: int, draw: int) -> float:
    """Return a number of (0, 1); `draw` is below 128."""
    count = np.uint64(step) * _DRAWS + np.uint64(draw)
    word = _mix(_mix(key) + (count + np.uint64(1)) * _GOLDEN) >> _11
    return (np.float64(word) + 0.5) * 2.0**-53


@njit(nogil=True)
def normal(key: np.uint64, step: int, draw: int) -> float:
    """Return a standard normal number (Box and Muller); it uses `draw` and `draw + 64`, and `draw` is below 64."""
    radius = math.sqrt(-2.0 * math.log(uniform(key, step, draw)))
    return radius * math.cos(2.0 * math.pi * uniform(key, step, draw + 64))
