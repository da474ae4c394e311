"""The augmentation methods: one file each, one entry each in `AUGMENTERS`."""

from oat_gym.augmenters.base import Augmenter, Sampler, Variation
from oat_gym.augmenters.dgw import DGW
from oat_gym.augmenters.function import Function
from oat_gym.augmenters.jittering import Jittering
from oat_gym.augmenters.oat import OAT
from oat_gym.augmenters.permutation import Permutation
from oat_gym.augmenters.scaling import Scaling
from oat_gym.augmenters.spawner import SPAWNER
from oat_gym.augmenters.tda import TDA
from oat_gym.augmenters.timegan import TimeGAN
from oat_gym.augmenters.vae import VAE
from oat_gym.augmenters.vae_mdp import VAEMDP

AUGMENTERS: dict[str, type[Augmenter]] = {
    "oat": OAT,
    "vae-mdp": VAEMDP,
    "vae": VAE,
    "timegan": TimeGAN,
    "tda": TDA,
    "permutation": Permutation,
    "jittering": Jittering,
    "scaling": Scaling,
    "spawner": SPAWNER,
    "dgw": DGW,
}
"""Every method by the name that the command line and recipes use."""

__all__ = [
    "AUGMENTERS",
    "DGW",
    "OAT",
    "SPAWNER",
    "TDA",
    "VAE",
    "VAEMDP",
    "Augmenter",
    "Function",
    "Jittering",
    "Permutation",
    "Sampler",
    "Scaling",
    "TimeGAN",
    "Variation",
]
