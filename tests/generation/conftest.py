"""Small systems with known laws, and fast settings."""

from types import SimpleNamespace

import numpy as np
import pytest

from oat_gym.generation import VAEMDPConfig
from oat_gym.spaces import Layout


def real(width):
    return Layout(width, tuple(range(width)), ())


def one_hot(codes, size):
    return np.eye(size)[codes]


TINY = VAEMDPConfig(latent=3, encoder=(12, 8), lstm=6, dense=5, max_updates=20, evaluate_every=5, patience=None)


class GaussianPolicy:
    """a ~ N(gain s + offset, scale^2), in closed form."""

    def __init__(self, gain=0.0, offset=0.0, scale=1.0, width=1):
        self.gain, self.offset, self.scale, self.width = gain, offset, scale, width

    def sample(self, observations, *, rng):
        mean = self.gain * observations[:, : self.width] + self.offset
        return mean + self.scale * rng.normal(size=mean.shape)

    def log_prob(self, observations, actions):
        z = (actions - self.gain * observations[:, : self.width] - self.offset) / self.scale
        return (-0.5 * z**2 - np.log(self.scale) - 0.5 * np.log(2 * np.pi)).sum(1)


class UniformDiscrete:
    """A uniform choice of one of `size` actions, one-hot."""

    def __init__(self, size):
        self.size = size

    def sample(self, observations, *, rng):
        return one_hot(rng.integers(self.size, size=len(observations)), self.size)

    def log_prob(self, observations, actions):
        return np.full(len(observations), -np.log(self.size))


def random_spans(rng, m=12, steps=4, states=3, actions=2):
    s = rng.normal(size=(m, steps + 1, states)) * 2 + 5
    return s, rng.normal(size=(m, steps, actions)), rng.normal(size=(m, steps))


def linear_gaussian(rng, m, steps):
    """s' = 0.8 s + 0.5 a + 0.3 e with s_1 ~ N(1, 1) and a ~ N(0, 1); r = s'. Returns spans and the moments by time."""
    s = [1 + rng.normal(size=m)]
    a = rng.normal(size=(m, steps))
    mean, variance = [1.0], [1.0]
    for t in range(steps):
        s.append(0.8 * s[-1] + 0.5 * a[:, t] + 0.3 * rng.normal(size=m))
        mean.append(0.8 * mean[-1])
        variance.append(0.64 * variance[-1] + 0.25 + 0.09)
    states = np.stack(s, axis=1)
    return (states[..., None], a[..., None], states[:, 1:]), np.array(mean), np.array(variance)


@pytest.fixture(scope="session")
def kit():
    """The functions and classes of this file."""
    return SimpleNamespace(
        real=real,
        one_hot=one_hot,
        tiny=TINY,
        GaussianPolicy=GaussianPolicy,
        UniformDiscrete=UniformDiscrete,
        random_spans=random_spans,
        linear_gaussian=linear_gaussian,
    )
