"""The dynamics model and the classifier on data whose answer is known."""

import numpy as np
import pytest

from oat_gym.errors import InvalidDataError
from oat_gym.metrics import DynamicsModel, discriminative_score
from oat_gym.metrics.models import _folds


def test_dynamics_model_knows_a_linear_system_and_not_its_shuffled_outcomes():
    rng = np.random.default_rng(0)
    inputs = rng.uniform(-1, 1, (2000, 3))
    outputs = np.stack((inputs[:, 0] - inputs[:, 1], inputs[:, 2]), axis=1)
    model = DynamicsModel.fit(inputs[:1000], outputs[:1000], rng=rng)
    good = model.errors(inputs[1000:], outputs[1000:])
    bad = model.errors(inputs[1000:], rng.permutation(outputs[1000:]))
    assert good.shape == (2,)
    assert (bad > 5 * good).all()


def draw(shift, n=40, each=20):
    """Two samples in n groups that hold both, each group around its own place."""
    rng = np.random.default_rng(1)
    groups = np.repeat(np.arange(n), each)
    rows = rng.normal(size=(n, 4))[groups] + rng.normal(size=(n * each, 4))
    labels = rng.random(n * each) < 0.5
    return rows + shift * labels[:, None], labels, groups


@pytest.mark.parametrize(("shift", "low", "high"), [(0.0, 0.0, 0.06), (10.0, 0.49, 0.5)])
def test_classifier_tells_what_is_shifted_and_only_that(shift, low, high):
    rows, labels, groups = draw(shift)
    score = discriminative_score(rows, labels, groups=groups, rng=np.random.default_rng(0))
    assert low <= score <= high


def test_groups_that_were_seen_are_not_recognised():
    """Labels that are those of the group: without whole groups held out, the classifier would know them by place."""
    rows, _, groups = draw(0.0)
    rows = 10 * np.random.default_rng(3).normal(size=(40, 4))[groups] + 0.01 * rows
    labels = groups % 2 == 0
    honest = discriminative_score(rows, labels, groups=groups, rng=np.random.default_rng(0))
    leaky = discriminative_score(rows, labels, groups=np.arange(len(rows)), rng=np.random.default_rng(0))
    assert leaky > 0.45
    assert honest < 0.25


def test_unbalanced_classes_do_not_make_a_score():
    rng = np.random.default_rng(0)
    rows, labels, groups = rng.normal(size=(1000, 2)), np.arange(1000) % 10 == 0, np.arange(1000)
    assert discriminative_score(rows, labels, groups=groups, rng=rng) < 0.06


@pytest.mark.parametrize("only_true", [0, 1, 3])
@pytest.mark.parametrize("only_false", [0, 1, 3])
@pytest.mark.parametrize("both", [0, 1, 2, 5])
def test_each_fold_leaves_both_labels_to_train_on(only_true, both, only_false):
    groups = np.array([*range(only_true + both), *range(only_true, only_true + both + only_false)])
    labels = np.arange(len(groups)) < only_true + both
    folds = _folds(labels, groups, np.random.default_rng(0))
    if min(only_true, only_false) + both < 2:
        assert folds is None
        return
    for fold in range(folds.max() + 1):
        assert len(np.unique(labels[folds != fold])) == 2
    assert all(len(np.unique(folds[groups == group])) == 1 for group in groups)


def test_shapes_must_agree():
    with pytest.raises(InvalidDataError, match="do not agree"):
        discriminative_score(np.zeros((3, 1)), np.zeros(2, dtype=bool), groups=np.zeros(3), rng=np.random.default_rng())
