"""A linear process with known values: s' = A s + B a + noise, a ~ N(gain s, spread), r = c + w s - q |s|^2."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from oat_gym.episodes import Transitions
from oat_gym.ope import GaussianPolicy, PolicySet, Problem
from oat_gym.ope.logged import Logged
from oat_gym.spaces import FlatSpace

FloatArray = npt.NDArray[np.float64]
A = np.array([[0.8, 0.2], [-0.1, 0.7]])
B = np.array([[0.3], [0.5]])
W = np.array([1.0, 0.5])
START = np.array([1.0, -0.5])
NOISE, START_NOISE, BEHAVIOR, SPREAD = 0.2, 0.3, 0.8, 0.4


def policy(gain: float, spread: float = SPREAD) -> GaussianPolicy:
    return GaussianPolicy(lambda s: gain * np.asarray(s).sum(axis=1, keepdims=True), spread)


def value(gain: float, *, gamma: float, horizon: int = 400, quadratic: float = 0.0) -> float:
    """Return the discounted value, by the recursion of mean and covariance."""
    closed = A + B @ np.full((1, 2), gain)
    mean, covariance, total = START, START_NOISE**2 * np.eye(2), 0.0
    for t in range(horizon):
        total += gamma**t * (0.5 + W @ mean - quadratic * (mean @ mean + np.trace(covariance)))
        covariance = closed @ covariance @ closed.T + SPREAD**2 * B @ B.T + NOISE**2 * np.eye(2)
        mean = closed @ mean
    return float(total)


def problem(
    gains: tuple[float, ...], n: int, length: int, *, gamma: float, horizon: int | None = None, quadratic: float = 0.0
) -> Problem:
    """Return n truncated episodes of a wide behaviour policy with no gain."""
    rng = np.random.default_rng(0)
    states = np.empty((n, length + 1, 2))
    actions = BEHAVIOR * rng.standard_normal((n, length, 1))
    states[:, 0] = START + START_NOISE * rng.standard_normal((n, 2))
    for t in range(length):
        noise = NOISE * rng.standard_normal((n, 2))
        states[:, t + 1] = states[:, t] @ A.T + actions[:, t] @ B.T + noise
    now = states[:, :-1].reshape(-1, 2)
    last = np.tile(np.arange(length) == length - 1, n)
    steps = Transitions(
        observations=now,
        actions=actions.reshape(-1, 1),
        rewards=0.5 + now @ W - quadratic * np.square(now).sum(axis=1),
        next_observations=states[:, 1:].reshape(-1, 2),
        terminated=np.zeros(n * length, dtype=bool),
        truncated=last,
        episode=np.repeat(np.arange(n), length),
        step=np.tile(np.arange(length), n),
        synthetic=np.zeros(n * length, dtype=bool),
    )
    data = Logged(
        steps=steps,
        flat_observations=FlatSpace.of(spaces.Box(-np.inf, np.inf, (2,), np.float64), "observation space"),
        flat_actions=FlatSpace.of(spaces.Box(-np.inf, np.inf, (1,), np.float64), "action space"),
        offsets=np.arange(n + 1) * length,
        unit=np.arange(n),
        synthetic=np.zeros(n, dtype=bool),
    )
    behavior = policy(0.0, BEHAVIOR).log_prob(steps.observations, steps.actions)
    return Problem(
        data=data,
        policies=PolicySet.of([policy(gain) for gain in gains]),
        gamma=gamma,
        horizon=horizon,
        initial=states[:, 0],
        initial_unit=np.arange(n),
        behavior=lambda seed: behavior,
        resamples=rng.multinomial(n, np.full(n, 1 / n), size=30).astype(np.float64),
    )
