"""Random streams: named children of one seed, and the bridge from NumPy to torch."""

from __future__ import annotations

import zlib

import numpy as np
import torch

from oat_gym.errors import ConfigurationError


def check_seed(seed: int) -> int:
    """Return `seed` as an int, or raise `ConfigurationError` if it is not a non-negative integer."""
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or seed < 0:
        raise ConfigurationError(f"seed must be a non-negative integer, got {seed!r}.")
    return int(seed)


def derive(seed: int, *keys: int | str) -> np.random.Generator:
    """Return the generator of the stream named by `keys` under `seed`.

    The stream depends on the seed and the keys only, so any order of access gives the same numbers.

    >>> float(derive(0, "pst", 3).random()) == float(derive(0, "pst", 3).random())
    True
    """
    words = [zlib.crc32(key.encode()) if isinstance(key, str) else key for key in keys]
    return np.random.default_rng(np.random.SeedSequence(check_seed(seed), spawn_key=words))


def reset_seeds(count: int, seed: int, *keys: int | str) -> list[int]:
    """Return seeds of `count` resets of an environment; those of neighbouring `seed`s do not overlap."""
    return [int(value) for value in derive(seed, *keys).integers(0, 2**31 - 1, size=count)]


def torch_generator(rng: np.random.Generator, device: str | torch.device = "cpu") -> torch.Generator:
    """Return a torch generator seeded by one draw from `rng`; torch's global state is not touched."""
    generator = torch.Generator(device=device)
    return generator.manual_seed(int(rng.integers(0, 2**63 - 1)))
