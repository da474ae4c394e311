"""The yardstick that real steps give: two halves of their episodes, each in the other's place."""

from __future__ import annotations

from functools import cached_property

import numpy as np

from oat_gym._rng import derive
from oat_gym.metrics.distances import marginal_wasserstein, median_distance, mmd, sliced_wasserstein
from oat_gym.metrics.models import discriminative_score
from oat_gym.metrics.neighbors import ball_coverage, grid_coverage
from oat_gym.metrics.scores import Score
from oat_gym.metrics.steps import Scale, Steps

FLOOR = 1e-3
"""Added above and below in ratios, in the units compared: data without any error gives 1, not 0/0."""

Levels = dict[str, float]


class Yardstick:
    """Distances, coverage, roughness and the classifier's score of generated steps, and of half the real ones.

    `real` holds steps of at least four episodes; `limit` is the most steps of a sample.
    """

    def __init__(self, real: Steps, *, scale: Scale, seed: int, limit: int) -> None:
        self._real = real
        self._scale = scale
        self._seed = seed
        self._limit = limit
        first, second = (
            real.take(np.isin(real.episodes, members)).sample(limit, derive(seed, "metrics", "half", h))
            for h, members in enumerate(halves(real, seed=seed))
        )
        self.samples = first, second

    def scores(self, generated: Steps) -> dict[str, Score]:
        """Return the scores of generated steps, of which as many are taken as a half has."""
        size = sum(len(half) for half in self.samples) // 2
        sample = generated.sample(max(size, 2), derive(self._seed, "metrics", "generated"))
        levels = _mean([self._levels(sample, half) for half in self.samples])
        scores = {name: Score(value, self._references[name]) for name, value in levels.items()}
        real = self._real.sample(self._limit, derive(self._seed, "metrics", "real"))
        both = generated.sample(len(real), derive(self._seed, "metrics", "told apart"))
        return scores | {"discriminative": Score(self._told_apart(real, both), self._halves_told_apart)}

    @cached_property
    def _references(self) -> Levels:
        first, second = self.samples
        return _mean([self._levels(first, second), self._levels(second, first)])

    @cached_property
    def _halves_told_apart(self) -> float | None:
        return self._told_apart(*self.samples)

    @cached_property
    def _bandwidth(self) -> float:
        first, second = (self._scale.rows(half) for half in self.samples)
        return median_distance(first, second)

    def _levels(self, new: Steps, real: Steps) -> Levels:
        """Return what is measured between two samples of steps."""
        scale = self._scale
        pairs, rows = [scale.inputs(part) for part in (new, real)], [scale.rows(part) for part in (new, real)]
        few = pairs[0].shape[1] <= 2
        coverage = grid_coverage(*pairs) if few else ball_coverage(*pairs, groups=real.episodes)
        sizes = [float(scale.sizes(part).mean()) for part in (new, real)]
        return {
            "coverage_gained": coverage.gained,
            "coverage_lost": coverage.lost,
            "marginal": float(marginal_wasserstein(*rows).mean()),
            "sliced": sliced_wasserstein(*rows, rng=derive(self._seed, "metrics", "projections")),
            "mmd": mmd(*rows, bandwidth=self._bandwidth),
            "roughness": ratio(*sizes),
        }

    def _told_apart(self, first: Steps, second: Steps) -> float | None:
        size, rng = min(len(first), len(second)), derive(self._seed, "metrics", "classifier")
        parts = [steps.sample(size, rng) for steps in (first, second)]
        rows = [np.hstack((self._scale.inputs(part), self._scale.outcomes(part))) for part in parts]
        labels = np.repeat([False, True], [len(part) for part in parts])
        groups = np.concatenate([part.episodes for part in parts])
        return discriminative_score(np.concatenate(rows), labels, groups=groups, rng=rng)


def halves(real: Steps, *, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the numbers of the episodes of each half, drawn by `seed`."""
    order = derive(seed, "metrics", "halves").permutation(np.unique(real.episodes))
    return order[::2], order[1::2]


def ratio(value: float, reference: float) -> float:
    """Return value / reference, both raised by `FLOOR`."""
    return (value + FLOOR) / (reference + FLOOR)


def _mean(both: list[Levels]) -> Levels:
    return {name: float(np.mean([levels[name] for levels in both])) for name in both[0]}
