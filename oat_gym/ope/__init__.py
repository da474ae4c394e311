"""Off-policy evaluation: what a policy would earn, from episodes that other policies recorded."""

from oat_gym.ope.estimator import Diagnostics, Estimates, Estimator
from oat_gym.ope.logged import Logged
from oat_gym.ope.policy import DiscretePolicy, Policy, PolicySet
from oat_gym.ope.problem import Part, Problem

__all__ = [
    "Diagnostics",
    "DiscretePolicy",
    "Estimates",
    "Estimator",
    "Logged",
    "Part",
    "Policy",
    "PolicySet",
    "Problem",
]
