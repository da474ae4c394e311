"""Generating spans: the VAE-MDP, its training and its roll-outs, and the cloned behaviour policy."""

from oat_gym.generation.behavior import BehaviorModel, fit_behavior
from oat_gym.generation.config import PAPER_LEARNING_RATES, BehaviorConfig, VAEMDPConfig
from oat_gym.generation.limits import Bounds, Limits
from oat_gym.generation.normalizer import Normalizer
from oat_gym.generation.policy import ActionPolicy
from oat_gym.generation.sampling import FittedVAEMDP, History, Samples
from oat_gym.generation.sequences import Sequences
from oat_gym.generation.training import Progress, fit_many, fit_vae_mdp

__all__ = [
    "PAPER_LEARNING_RATES",
    "ActionPolicy",
    "BehaviorConfig",
    "BehaviorModel",
    "Bounds",
    "FittedVAEMDP",
    "History",
    "Limits",
    "Normalizer",
    "Progress",
    "Samples",
    "Sequences",
    "VAEMDPConfig",
    "fit_behavior",
    "fit_many",
    "fit_vae_mdp",
]
