"""Mining once: the result of a series is kept in the cache, for every method and setting that starts from it."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from oat_gym._rng import derive
from oat_gym.cache import CacheEntry, fingerprint
from oat_gym.mining.pst import MiningConfig, MiningResult, mine
from oat_gym.mining.state import mining_from_state, mining_to_state
from oat_gym.progress import ProgressCallback, silent

FloatArray = npt.NDArray[np.float64]


def mine_once(
    series: Sequence[FloatArray],
    *,
    config: MiningConfig,
    seed: int,
    times: Sequence[FloatArray] | None = None,
    progress: ProgressCallback = silent,
) -> MiningResult:
    """Return what `mine` finds, from the cache where the same series were mined with the same settings and seed.

    Mining takes most of the time of fitting OAT, and its forms differ in what they do with the windows: how models are
    trained, where roll-outs start, how seams are made. They share one result.
    """
    key = fingerprint(part="mining", config=config, seed=seed, series=_digest(series), times=_digest(times or ()))
    entry = CacheEntry(key)
    with entry.lock():
        stored = entry.read("mining")
        if stored is None:
            rng = derive(seed, "mining")
            stored = mining_to_state(mine(series, config=config, times=times, rng=rng, progress=progress))
            entry.write("mining", *stored)
    return mining_from_state(*stored)


def _digest(arrays: Sequence[FloatArray]) -> str:
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(f"{array.dtype.str}{array.shape}".encode())
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()
