"""Two ways to find the first labels of TICC: k-means on moments of short blocks, and a Gaussian mixture."""

from __future__ import annotations

import warnings
from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from oat_gym.mining._windows import Rows

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_BLOCK_ROWS = 20
_MAX_FEATURES = 60
_MAX_MIXTURE_ROWS = 20_000


def load_scikit_learn() -> tuple[ModuleType, ...]:
    """Import what this package uses of scikit-learn; a limit on threads holds only for libraries loaded before it."""
    from sklearn import cluster, decomposition, metrics, mixture

    return cluster, decomposition, metrics, mixture


def kmeans_labels(rows: Rows, *, n_clusters: int, seed: int) -> Ints:
    """Cluster blocks of up to 20 consecutive rows by their means and second moments: (n,) labels.

    Second moments tell apart regimes that have the same mean but other correlations, which is what TICC's clusters
    are. No block crosses from one series to the next. Blocks are shorter where there are few rows.
    """
    values = _reduce(rows.values, _MAX_FEATURES, seed)
    size = int(np.clip(len(values) // (4 * n_clusters), 1, _BLOCK_ROWS))
    place = np.arange(len(values)) - np.repeat(rows.starts, rows.lengths)
    block = np.cumsum(place % size == 0) - 1
    features = _block_moments(values, block)
    return _kmeans(_reduce(features, 3 * n_clusters, seed), n_clusters, seed)[block]


def mixture_labels(rows: Rows, *, n_clusters: int, seed: int) -> Ints:
    """Label each row by its component in a full-covariance Gaussian mixture: (n,) labels."""
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.mixture import GaussianMixture

    values = _reduce(rows.values, _BLOCK_ROWS, seed)
    rng = np.random.default_rng(seed)
    many = len(values) > _MAX_MIXTURE_ROWS
    sample = values[np.sort(rng.choice(len(values), _MAX_MIXTURE_ROWS, replace=False))] if many else values
    if len(np.unique(sample, axis=0)) < n_clusters:
        return kmeans_labels(rows, n_clusters=n_clusters, seed=seed)
    start = np.eye(n_clusters)[_kmeans(sample, n_clusters, seed)]
    mass = np.maximum(start.sum(axis=0), 1e-12)
    mixture = GaussianMixture(
        n_clusters,
        reg_covar=1e-3,
        max_iter=50,
        tol=1e-2,
        weights_init=mass / mass.sum(),
        means_init=(start.T @ sample) / mass[:, None],
        random_state=seed,
    )
    with warnings.catch_warnings():  # a starting point need not be converged
        warnings.simplefilter("ignore", ConvergenceWarning)
        mixture.fit(sample)
    return np.asarray(mixture.predict(values), dtype=np.int64)


def _reduce(values: Floats, n_components: int, seed: int) -> Floats:
    from sklearn.decomposition import PCA

    if values.shape[1] <= n_components or len(values) <= n_components:
        return values
    return np.asarray(PCA(n_components, svd_solver="randomized", random_state=seed).fit_transform(values))


def _block_moments(values: Floats, block: Ints) -> Floats:
    """(blocks, D + D(D+1)/2) means, then means of products, over each block's rows."""
    begin = np.flatnonzero(np.r_[True, np.diff(block) > 0])
    count = np.diff(np.r_[begin, len(values)])[:, None]
    left, right = np.triu_indices(values.shape[1])
    means = np.add.reduceat(values, begin, axis=0) / count
    products = np.empty((len(begin), len(left)))
    for b, (first, length) in enumerate(zip(begin, count[:, 0], strict=True)):
        rows = values[first : first + length]
        products[b] = (rows.T @ rows)[left, right] / length
    return np.concatenate([means, products], axis=1)


def _kmeans(points: Floats, n_clusters: int, seed: int) -> Ints:
    """k-means with as many clusters as there are distinct points, at most `n_clusters`."""
    from sklearn.cluster import KMeans
    from sklearn.exceptions import ConvergenceWarning

    distinct = len(np.unique(points, axis=0))
    with warnings.catch_warnings():  # nearly equal points can still merge
        warnings.simplefilter("ignore", ConvergenceWarning)
        model = KMeans(min(n_clusters, distinct), random_state=seed).set_params(n_init=20)
        labels = model.fit_predict(points)
    return np.asarray(labels, dtype=np.int64)
