"""Labelling once: the labels of a set of series are kept in the cache, for every form of OAT that starts from them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from oat_gym._rng import derive
from oat_gym.cache import CacheEntry, digest_of, fingerprint
from oat_gym.mining.pst import MiningConfig, MiningResult, check_long_enough, find_windows, label, series_lengths
from oat_gym.mining.state import labelling_from_state, labelling_to_state
from oat_gym.progress import ProgressCallback, silent

FloatArray = npt.NDArray[np.float64]
LABELLING = (
    "n_clusters",
    "candidates",
    "criterion",
    "restarts",
    "window",
    "sparsity",
    "switch_penalty",
    "max_iterations",
    "init",
)
"""The settings that labels depend on; the others of `MiningConfig` are of the windows."""


def mine_once(
    series: Sequence[FloatArray],
    *,
    config: MiningConfig,
    seed: int,
    times: Sequence[FloatArray] | None = None,
    usable: Sequence[int] | None = None,
    progress: ProgressCallback = silent,
) -> MiningResult:
    """Return what `mine` finds, with the labels from the cache where the same series were labelled before.

    TICC takes most of the time of fitting OAT, and forms of OAT differ in the windows that they then look for and in
    what they do with them. They share the labels.

    Raises:
        InvalidDataError: as `mine`.
    """
    check_long_enough(series_lengths(series) if usable is None else usable, config)
    settings = {name: getattr(config, name) for name in LABELLING}
    rows = {f"series/{i}": part for i, part in enumerate(series)} | {f"times/{i}": t for i, t in enumerate(times or ())}
    entry = CacheEntry(fingerprint(part="labels", config=settings, seed=seed, rows=digest_of(rows)))
    with entry.lock():
        stored = entry.read("labels")
        if stored is None:
            found = label(series, config=config, rng=derive(seed, "mining"), times=times, progress=progress)
            stored = labelling_to_state(found)
            entry.write("labels", *stored)
    return find_windows(labelling_from_state(*stored), config=config, usable=usable)
