"""What was mined and what was generated, in numbers and in small arrays for pictures: the report's first chapters."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from minari import MinariDataset

from oat_gym._rng import derive
from oat_gym.cache import Arrays
from oat_gym.dataset import AugmentedDataset
from oat_gym.errors import ConfigurationError
from oat_gym.mining import MiningResult
from oat_gym.provenance import Provenance
from oat_gym.source import Source

FloatArray = npt.NDArray[np.float64]
N_REAL, N_SYNTHETIC, N_POINTS = 40, 80, 60
"""How many episodes, and points of each, are kept for pictures."""


def describe_augmented(data: MinariDataset, real: MinariDataset, *, seed: int) -> tuple[Arrays, dict[str, Any]]:
    """Return (arrays, JSON value) that say what a dataset was made into.

    The arrays "real", "synthetic" (points, 2) and "real_episode", "synthetic_episode" (points,) are trajectories in a
    plane: positions where observations hold an `achieved_goal`, else the first two principal components of the real
    states, z-scored. "synthetic_generated" (points,) tells generated points from copied ones.
    """
    source = Source(real)
    plane = _Plane.of(source)
    arrays = plane.project(source.state_matrices(), count=N_REAL, seed=seed, prefix="real")
    value: dict[str, Any] = {
        "plane": plane.labels,
        "real": {"episodes": len(source), "steps": int(source.lengths.sum()), "returns": _spread(_returns(source))},
        "synthetic": None,
        "mining": None,
    }
    if not isinstance(data, AugmentedDataset):
        return arrays, value
    made = Source(MinariDataset(data.storage, episode_indices=data.episode_indices[len(source) :]))
    origins = [Provenance.from_metadata(part, number) for number, part in enumerate(made.metadata)]
    arrays |= plane.project(made.state_matrices(), count=N_SYNTHETIC, seed=seed, prefix="synthetic", origins=origins)
    value["synthetic"] = _synthetic(made, origins)
    mining = _mining(data)
    if mining is not None:
        value["mining"] = _mined(mining, len(source))
    return arrays, value


def _mining(data: AugmentedDataset) -> MiningResult | None:
    try:
        return data.mining
    except ConfigurationError:  # the method does not mine
        return None


def _mined(mining: MiningResult, n_source: int) -> dict[str, Any]:
    sets = [{"support": int(each.support), "occurrences": len(each.occurrences)} for each in mining.sets]
    return {
        "n_clusters": int(mining.n_clusters),
        "length": int(mining.length),
        "episodes": n_source,
        "curve": {str(width): int(support) for width, support in mining.support_curve.items()},
        "sets": sets,
    }


def _synthetic(made: Source, origins: list[Provenance]) -> dict[str, Any]:
    seams = [span.seam for origin in origins for span in origin.spans if span.seam is not None]
    generated = int(sum(origin.mask.sum() for origin in origins))
    return {
        "episodes": len(made),
        "steps": int(made.lengths.sum()),
        "generated_steps": generated,
        "untouched": sum(not origin.spans for origin in origins),
        "returns": _spread(_returns(made)),
        "seams": _spread(np.array(seams)[:, 0]) if seams else None,
    }


def _returns(source: Source) -> FloatArray:
    return np.array([rewards.sum() for rewards in source.rewards()], dtype=np.float64)


def _spread(values: FloatArray) -> list[float]:
    """Return the least value, the quartiles and the greatest value."""
    return [float(value) for value in np.quantile(values, [0, 0.25, 0.5, 0.75, 1])]


class _Plane:
    """Two dimensions that states are drawn in."""

    def __init__(self, center: FloatArray, axes: FloatArray, labels: list[str]) -> None:
        self._center, self._axes, self.labels = center, axes, labels

    @classmethod
    def of(cls, source: Source) -> _Plane:
        flat = source.flat_observations
        width = flat.layout.width
        for leaf in flat.leaves:
            if leaf.path and leaf.path[0] == "achieved_goal" and leaf.width == 2:
                axes = np.zeros((width, 2))
                axes[[leaf.start, leaf.start + 1], [0, 1]] = 1.0
                return cls(np.zeros(width), axes, ["x", "y"])
        rows = np.concatenate(source.state_matrices())
        if width == 1:
            return cls(np.zeros(1), np.array([[1.0, 0.0]]), ["state", ""])
        center, scale = rows.mean(axis=0), rows.std(axis=0)
        scaled = (rows - center) / np.where(scale > 0, scale, 1.0)
        _, _, axes = np.linalg.svd(np.cov(scaled, rowvar=False))
        axes = axes[:2] * np.sign(axes[:2, :1] + 1e-300)
        return cls(center, (axes / np.where(scale > 0, scale, 1.0)).T, ["first component", "second component"])

    def project(
        self,
        series: list[FloatArray],
        *,
        count: int,
        seed: int,
        prefix: str,
        origins: list[Provenance] | None = None,
    ) -> Arrays:
        """Return points, numbers of episodes and whether points were generated, of some of the trajectories."""
        chosen = np.sort(derive(seed, "picture", prefix).permutation(len(series))[:count])
        points: list[FloatArray] = []
        numbers: list[npt.NDArray[np.int64]] = []
        flags: list[npt.NDArray[np.bool_]] = []
        for i in chosen:
            steps = np.unique(np.linspace(0, len(series[i]) - 1, N_POINTS).astype(np.int64))
            points.append((series[i][steps] - self._center) @ self._axes)
            numbers.append(np.full(len(steps), i, dtype=np.int64))
            mask = np.zeros(len(series[i]), dtype=bool) if origins is None else np.append(origins[i].mask, False)
            flags.append(mask[steps])
        return {
            prefix: np.concatenate(points).astype(np.float32),
            f"{prefix}_episode": np.concatenate(numbers),
            f"{prefix}_generated": np.concatenate(flags),
        }
