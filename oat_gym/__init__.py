"""Trajectory augmentation for off-policy evaluation, as a drop-in Minari dataset.

>>> import oat_gym
>>> data = oat_gym.AugmentedDataset("oat_gym/maze2d-umaze-v0", oat_gym.OAT(), factor=10, seed=0)
>>> len(data)
2500

Importing the package teaches Minari the data format "oat" (see `oat_gym.dataset.install`) and Gymnasium the simulators
of `oat_gym.envs`.
"""

import importlib.metadata

from oat_gym import checks, domains, envs, metrics, mining, ope
from oat_gym.augmenters import AUGMENTERS, Augmenter, Function
from oat_gym.augmenters.compose import Compose
from oat_gym.augmenters.dgw import DGW
from oat_gym.augmenters.jittering import Jittering
from oat_gym.augmenters.mixture import Mixture
from oat_gym.augmenters.oat import OAT
from oat_gym.augmenters.permutation import Permutation
from oat_gym.augmenters.scaling import Scaling
from oat_gym.augmenters.spawner import SPAWNER
from oat_gym.augmenters.tda import TDA
from oat_gym.augmenters.timegan import TimeGAN
from oat_gym.augmenters.vae import VAE
from oat_gym.augmenters.vae_mdp import VAEMDP
from oat_gym.dataset import AugmentedDataset, augment, install
from oat_gym.episodes import Transitions
from oat_gym.io.consumers import to_d3rlpy, to_torchrl
from oat_gym.io.d4rl import read_d4rl, write_d4rl
from oat_gym.io.torch import LoaderConfig, TorchBatch, TorchLoader, to_torch
from oat_gym.mining import MiningConfig, MiningResult
from oat_gym.provenance import Provenance
from oat_gym.stitching import Span

__version__ = importlib.metadata.version("oat-gym")

install()
envs.register()

__all__ = [
    "AUGMENTERS",
    "DGW",
    "OAT",
    "SPAWNER",
    "TDA",
    "VAE",
    "VAEMDP",
    "AugmentedDataset",
    "Augmenter",
    "Compose",
    "Function",
    "Jittering",
    "LoaderConfig",
    "MiningConfig",
    "MiningResult",
    "Mixture",
    "Permutation",
    "Provenance",
    "Scaling",
    "Span",
    "TimeGAN",
    "TorchBatch",
    "TorchLoader",
    "Transitions",
    "augment",
    "checks",
    "domains",
    "envs",
    "metrics",
    "mining",
    "ope",
    "read_d4rl",
    "to_d3rlpy",
    "to_torch",
    "to_torchrl",
    "write_d4rl",
]
