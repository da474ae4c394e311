"""The augmentation methods: one file each, one entry each in `AUGMENTERS`."""

from oat_gym.augmenters.base import Augmenter, Sampler, Variation
from oat_gym.augmenters.function import Function
from oat_gym.augmenters.oat import OAT

AUGMENTERS: dict[str, type[Augmenter]] = {"oat": OAT}
"""Every method by the name that the command line and recipes use."""

__all__ = ["AUGMENTERS", "OAT", "Augmenter", "Function", "Sampler", "Variation"]
