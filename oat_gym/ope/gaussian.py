"""Gaussian policies over a Box: a function for the mean, and the densities they share."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from scipy.special import log_ndtr

from oat_gym.errors import ConfigurationError, InvalidDataError
from oat_gym.ope.policy import FloatArray
from oat_gym.spaces import Batch, tree_length

_HALF_LOG_TWO_PI = 0.5 * math.log(2 * math.pi)


def gaussian_log_density(values: FloatArray, mean: FloatArray, std: FloatArray) -> FloatArray:
    """Return the log-density of each entry of `values`; shapes broadcast."""
    return -0.5 * ((values - mean) / std) ** 2 - np.log(std) - _HALF_LOG_TWO_PI


def clipped_log_probability(
    values: FloatArray, mean: FloatArray, std: FloatArray, low: FloatArray, high: FloatArray
) -> FloatArray:
    """Return the log-likelihood of each entry of a Gaussian variable that is clipped to [low, high].

    Inside it is the log-density; on a bound, or beyond it, the log of the probability mass that clipping puts there.
    """
    below, above = log_ndtr((low - mean) / std), log_ndtr((mean - high) / std)
    inside = gaussian_log_density(values, mean, std)
    return np.where(values <= low, below, np.where(values >= high, above, inside))


@dataclass(frozen=True)
class ActionBox:
    """How a policy's real-valued outputs become actions: shape, dtype and bounds.

    `None` for the space: any shape, float64, no bounds.
    """

    space: spaces.Box | None

    def __post_init__(self) -> None:
        if self.space is not None and (
            not isinstance(self.space, spaces.Box)  # pyright: ignore[reportUnnecessaryIsInstance]
            or not np.issubdtype(self.space.dtype, np.floating)
        ):
            raise ConfigurationError(f"A Gaussian policy takes a Box of floats as action_space, got {self.space!r}.")

    @property
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Lower and upper bounds of the flat actions, (A,), or scalars -inf and inf."""
        if self.space is None:
            return np.asarray(-np.inf), np.asarray(np.inf)
        return self.space.low.ravel().astype(np.float64), self.space.high.ravel().astype(np.float64)

    @property
    def dtype(self) -> np.dtype[Any]:
        """The dtype of actions."""
        return np.dtype(np.float64) if self.space is None else self.space.dtype

    def to_actions(self, flat: FloatArray) -> npt.NDArray[Any]:
        """Return flat values (..., A) as actions, clipped, in the space's dtype."""
        if self.space is None:
            return flat
        clipped = np.clip(flat, *self.bounds).astype(self.space.dtype)
        return clipped.reshape((*flat.shape[:-1], *self.space.shape))

    def to_flat(self, actions: Batch, *, width: int) -> FloatArray:
        """Return actions (n, ...) as (n, width), or raise `InvalidDataError`."""
        flat = np.asarray(actions, dtype=np.float64).reshape(len(actions), -1)
        if flat.shape[1] != width:
            raise InvalidDataError(f"The policy has {width} action columns; the actions given have {flat.shape[1]}.")
        return flat

    def log_prob(self, values: FloatArray, mean: FloatArray, std: FloatArray, *, censored: bool) -> FloatArray:
        """Return the log-likelihood of flat actions, summed over the last axis; see `GaussianPolicy.censored`."""
        if censored:
            return clipped_log_probability(values, mean, std, *self.bounds).sum(axis=-1)
        return gaussian_log_density(values, mean, std).sum(axis=-1)


@dataclass(frozen=True)
class GaussianPolicy:
    """A diagonal Gaussian around a function of the observations, clipped to the action space.

    Attributes:
        function: observations (a batch) -> mean actions (n, A) before clipping.
        std: standard deviation: a number, an array (A,), or a function of the observations -> (n, A), or one of these.
        action_space: Box of the actions; `None`: one vector an action, no bounds, float64.
        deterministic: `sample` returns the mean, clipped; `log_prob` stays that of the Gaussian.
        censored: what `log_prob` is for bounded actions. False: the Gaussian density of the action as it was chosen,
            before the environment clips it. True: the likelihood of the clipped action, whose entries on a bound have
            the probability that clipping puts there. Numerator and denominator of an importance ratio must be of one
            kind (see `BehaviorCloning.density`).

    Raises:
        ConfigurationError: if `std` is not positive, or the space is not a Box of floats.

    >>> policy = GaussianPolicy(lambda states: 2 * states, 0.5)
    >>> policy.log_prob(np.array([[1.0]]), np.array([[2.0]])).round(4).tolist()
    [-0.2258]
    """

    function: Callable[[Batch], npt.ArrayLike]
    std: float | npt.NDArray[np.floating] | Callable[[Batch], npt.ArrayLike]
    action_space: spaces.Box | None = None
    deterministic: bool = False
    censored: bool = False

    def __post_init__(self) -> None:
        ActionBox(self.action_space)
        if not callable(self.std):
            check_std(np.asarray(self.std))

    def sample(self, observations: Batch, *, rng: np.random.Generator) -> npt.NDArray[np.floating]:
        """Return n actions, clipped to the space."""
        mean = self._mean(observations)
        if not self.deterministic:
            mean = mean + self._std(observations, mean) * rng.standard_normal(mean.shape)
        return ActionBox(self.action_space).to_actions(mean)

    def mean(self, observations: Batch) -> npt.NDArray[np.floating]:
        """Return the n mean actions, clipped to the space."""
        return ActionBox(self.action_space).to_actions(self._mean(observations))

    def log_prob(self, observations: Batch, actions: Batch) -> FloatArray:
        """Return log pi(a|s), (n,); see `censored`."""
        mean, box = self._mean(observations), ActionBox(self.action_space)
        values = box.to_flat(actions, width=mean.shape[1])
        return box.log_prob(values, mean, self._std(observations, mean), censored=self.censored)

    def _mean(self, observations: Batch) -> FloatArray:
        n = tree_length(observations)
        mean = np.asarray(self.function(observations), dtype=np.float64)
        if mean.ndim < 2 or len(mean) != n:
            raise InvalidDataError(
                f"GaussianPolicy: the function must return {n} mean actions, shape ({n}, A), got {mean.shape}."
            )
        return mean.reshape(n, -1)

    def _std(self, observations: Batch, mean: FloatArray) -> FloatArray:
        std = np.asarray(self.std(observations) if callable(self.std) else self.std, dtype=np.float64)
        check_std(std)
        return np.broadcast_to(std.reshape(len(mean), -1) if std.ndim > 1 else std, mean.shape)


def check_std(std: npt.NDArray[np.floating]) -> None:
    """Raise `ConfigurationError` unless standard deviations are positive and finite."""
    if not (np.isfinite(std) & (std > 0)).all():
        raise ConfigurationError(f"Standard deviations must be positive and finite, got {std.tolist()!r:.200}.")
