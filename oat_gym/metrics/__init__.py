"""Fidelity: how like the real data the generated data of any method is.

>>> import oat_gym
>>> from oat_gym import metrics
>>> data = oat_gym.AugmentedDataset("oat_gym/maze2d-umaze-v0", oat_gym.Function(lambda e, rng: e), factor=2)
>>> metrics.fidelity(data, limit=100).memorised.value
1.0
"""

from oat_gym.metrics.comparison import Comparison, compare, fidelity
from oat_gym.metrics.distances import marginal_wasserstein, mmd, sliced_wasserstein
from oat_gym.metrics.models import DynamicsModel, discriminative_score
from oat_gym.metrics.neighbors import Coverage, ball_coverage, copies, grid_coverage, nearest
from oat_gym.metrics.scores import METRICS, Fidelity, Metric, Score

__all__ = [
    "METRICS",
    "Comparison",
    "Coverage",
    "DynamicsModel",
    "Fidelity",
    "Metric",
    "Score",
    "ball_coverage",
    "compare",
    "copies",
    "discriminative_score",
    "fidelity",
    "grid_coverage",
    "marginal_wasserstein",
    "mmd",
    "nearest",
    "sliced_wasserstein",
]
