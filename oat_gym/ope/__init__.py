"""Off-policy evaluation: what a policy would earn, from episodes that other policies recorded."""

from oat_gym.ope import intervals, metrics
from oat_gym.ope._setup import UseAugmented
from oat_gym.ope.agreement import AgreementCurve, agreement_curve, agreement_rate
from oat_gym.ope.behavior import BehaviorFit, ClonedPolicy, KnownBehavior, fit_log_prob, logged_log_prob
from oat_gym.ope.cloning import BehaviorCloning
from oat_gym.ope.dice import DICE
from oat_gym.ope.dope import load_dope_policies, load_dope_policy
from oat_gym.ope.doubly_robust import DoublyRobust
from oat_gym.ope.estimator import Diagnostics, Estimates, Estimator
from oat_gym.ope.evaluate import evaluate
from oat_gym.ope.fqe import FQE
from oat_gym.ope.function_policy import FunctionPolicy
from oat_gym.ope.gaussian import GaussianPolicy
from oat_gym.ope.importance import ImportanceSampling
from oat_gym.ope.logged import Logged
from oat_gym.ope.mlp_policy import MLPPolicy
from oat_gym.ope.model_based import ModelBased
from oat_gym.ope.policies import CategoricalPolicy, EpsilonGreedyPolicy, TabularPolicy, UniformPolicy
from oat_gym.ope.policy import DiscretePolicy, Policy, PolicySet, PolicyStack, RepeatingStack, StackablePolicy
from oat_gym.ope.problem import Part, Problem
from oat_gym.ope.result import Result
from oat_gym.ope.torch_policy import TorchCategoricalPolicy, TorchPolicy

ESTIMATORS: dict[str, type[Estimator]] = {
    "fqe": FQE,
    "is": ImportanceSampling,
    "dice": DICE,
    "dr": DoublyRobust,
    "mb": ModelBased,
}
"""The five families by the names that the command line uses."""

__all__ = [
    "DICE",
    "ESTIMATORS",
    "FQE",
    "AgreementCurve",
    "BehaviorCloning",
    "BehaviorFit",
    "CategoricalPolicy",
    "ClonedPolicy",
    "Diagnostics",
    "DiscretePolicy",
    "DoublyRobust",
    "EpsilonGreedyPolicy",
    "Estimates",
    "Estimator",
    "FunctionPolicy",
    "GaussianPolicy",
    "ImportanceSampling",
    "KnownBehavior",
    "Logged",
    "MLPPolicy",
    "ModelBased",
    "Part",
    "Policy",
    "PolicySet",
    "PolicyStack",
    "Problem",
    "RepeatingStack",
    "Result",
    "StackablePolicy",
    "TabularPolicy",
    "TorchCategoricalPolicy",
    "TorchPolicy",
    "UniformPolicy",
    "UseAugmented",
    "agreement_curve",
    "agreement_rate",
    "evaluate",
    "fit_log_prob",
    "intervals",
    "load_dope_policies",
    "load_dope_policy",
    "logged_log_prob",
    "metrics",
]
