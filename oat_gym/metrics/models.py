"""What models learn from data: the error of one-step predictions, and whether a classifier tells two samples apart.

scikit-learn is imported when a model is fitted: it takes as long to import as the rest of the package.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from threadpoolctl import threadpool_limits

from oat_gym.episodes import IntArray
from oat_gym.errors import InvalidDataError
from oat_gym.spaces import FloatMatrix

FOLDS = 5
"""Most folds of the classifier's cross-validation."""
_TREES = 50


@dataclass(frozen=True)
class DynamicsModel:
    """A regression of what a step does (a state's change, the reward) on state and action.

    Extremely randomised trees (Geurts et al., 2006): on half of the 25 human door demonstrations (67 inputs, 40
    outputs) their error on the other half is a fifth below that of ridge regression and of a small neural network.
    """

    trees: Any

    @classmethod
    def fit(cls, inputs: FloatMatrix, outputs: FloatMatrix, *, rng: np.random.Generator) -> DynamicsModel:
        """Fit to `inputs` (n, D) and `outputs` (n, K)."""
        from sklearn.ensemble import ExtraTreesRegressor

        trees: Any = ExtraTreesRegressor(
            n_estimators=_TREES, min_samples_leaf=2, max_features=0.5, random_state=_state(rng)
        )
        return cls(trees.fit(inputs, outputs))

    def errors(self, inputs: FloatMatrix, outputs: FloatMatrix) -> npt.NDArray[np.float64]:
        """Return the mean absolute error of each output, (K,)."""
        predicted = np.asarray(self.trees.predict(inputs)).reshape(outputs.shape)
        return np.abs(predicted - outputs).mean(axis=0)


def discriminative_score(
    rows: FloatMatrix, labels: npt.NDArray[np.bool_], *, groups: IntArray, rng: np.random.Generator
) -> float | None:
    """Return |accuracy - 1/2| of a classifier that tells the rows of label True from the others.

    After Yoon et al., "Time-series generative adversarial networks" (NeurIPS 2019), on single steps: gradient boosted
    trees, cross-validated. 0: it cannot tell them; 1/2: it always can. The accuracy is the mean of the two classes'.
    With few groups that hold one label each it is far from 1/2 by chance, to either side: between two halves of 25
    episodes the score is about 0.1, of 8 episodes up to 0.35.

    Args:
        rows: (n, D) features.
        labels: (n,) booleans.
        groups: (n,) a group never lies in training and test at once, so that the variations of one episode, and the
            episode, cannot be recognised by having been seen.
        rng: source of all randomness.

    Returns:
        The score, or None where a label has fewer than two groups, which leaves nothing to train on.

    Raises:
        InvalidDataError: for shapes that do not agree.
    """
    from sklearn.ensemble import HistGradientBoostingClassifier

    if rows.ndim != 2 or labels.shape != (len(rows),) or groups.shape != (len(rows),):
        raise InvalidDataError(f"rows {rows.shape}, labels {labels.shape} and groups {groups.shape} do not agree.")
    fold = _folds(labels, groups, rng)
    if fold is None:
        return None
    predicted = np.zeros(len(rows), dtype=bool)
    classifier: Any = HistGradientBoostingClassifier
    # One thread: the sums of several come in any order, and the result must not depend on that.
    with threadpool_limits(limits=1):
        for number in range(int(fold.max()) + 1):
            test = fold == number
            model = classifier(max_iter=60, max_leaf_nodes=15, early_stopping=False, random_state=_state(rng))
            predicted[test] = model.fit(rows[~test], labels[~test]).predict(rows[test])
    accuracy = (predicted[labels].mean() + (~predicted[~labels]).mean()) / 2
    return float(abs(accuracy - 0.5))


def _folds(labels: npt.NDArray[np.bool_], groups: IntArray, rng: np.random.Generator) -> IntArray | None:
    """Return the fold of each row, such that both labels are in training whichever fold is left out."""
    with_true, with_false = np.unique(groups[labels]), np.unique(groups[~labels])
    if min(len(with_true), len(with_false)) < 2:
        return None
    # In this order the groups of each label are neighbours, and neighbours lie in different folds.
    parts = (
        np.setdiff1d(with_true, with_false),
        np.intersect1d(with_true, with_false),
        np.setdiff1d(with_false, with_true),
    )
    ordered = np.concatenate([rng.permutation(part) for part in parts])
    fold_of = dict(zip(ordered.tolist(), (np.arange(len(ordered)) % min(FOLDS, len(ordered))).tolist(), strict=True))
    return np.array([fold_of[group] for group in groups.tolist()], dtype=np.int64)


def _state(rng: np.random.Generator) -> int:
    return int(rng.integers(2**31 - 1))
