"""Conformance checks: the contract of a dataset, an augmenter or an estimator, held against one (no pytest needed).

>>> import oat_gym
>>> from oat_gym.checks import check_dataset
>>> report = check_dataset(oat_gym.AugmentedDataset("oat_gym/maze2d-umaze-v0", factor=1), limit=3)
>>> report.counts["t-plus-one"]
3
"""

from oat_gym.checks.augmenter import AUGMENTER_CHECKS, check_augmenter
from oat_gym.checks.dataset import CHECKS, check_dataset
from oat_gym.checks.estimator import ESTIMATOR_CHECKS, check_estimator
from oat_gym.checks.report import Check, ChecksFailed, Report

__all__ = [
    "AUGMENTER_CHECKS",
    "CHECKS",
    "ESTIMATOR_CHECKS",
    "Check",
    "ChecksFailed",
    "Report",
    "check_augmenter",
    "check_dataset",
    "check_estimator",
]
