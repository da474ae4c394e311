"""Gaussian policies whose mean is a small perceptron, many of them in one batched product."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import torch
from gymnasium import spaces

from oat_gym.errors import ConfigurationError, InvalidDataError
from oat_gym.generation._layers import one_thread
from oat_gym.ope._densities import INSIDE
from oat_gym.ope.gaussian import ActionBox, gaussian_log_density
from oat_gym.ope.policy import FloatArray
from oat_gym.spaces import Batch

Affine = tuple[npt.NDArray[np.floating], npt.NDArray[np.floating]]
"""A layer x -> W x + b: W (outputs, inputs) and b (outputs,)."""

_CHUNK = 1 << 17  # numbers of the widest layer that are computed at a time, over all policies (1 MiB)


@dataclass(frozen=True, eq=False)
class MLPPolicy:
    """A diagonal Gaussian whose mean and log standard deviation are linear in a perceptron's last hidden layer.

    Attributes:
        hidden: the hidden layers.
        mean_layer: the layer of the means.
        log_std_layer: the layer of the log standard deviations.
        nonlinearity: after each hidden layer.
        action_space: actions are clipped to it and have its shape and dtype; `None`: vectors of float64, no bounds.
        squash: actions are the tanh of the Gaussian, in (-1, 1); `log_prob` then has the Jacobian of the tanh, and
            reads actions closer to -1 or 1 than 1e-4 as if they were there (as the clone's tanh-Gaussian and DOPE do).
        deterministic: `sample` returns `mean`; `log_prob` stays that of the distribution.
        censored: `log_prob` is that of the clipped action, see `GaussianPolicy.censored`.
        features: observations (a batch) -> matrix (n, inputs), for observations that are no such matrix; for Dict
            observations, `FlatSpace.of(observation_space).flatten`.

    Raises:
        ConfigurationError: if the layers do not fit together or hold numbers that are not finite.

    >>> one = (np.array([[1.0]]), np.array([0.0]))
    >>> policy = MLPPolicy((one,), one, (np.zeros((1, 1)), np.zeros(1)))
    >>> policy.mean(np.array([[0.5]])).round(4).tolist()
    [[0.4621]]
    """

    hidden: tuple[Affine, ...]
    mean_layer: Affine
    log_std_layer: Affine
    nonlinearity: Literal["tanh", "relu"] = "tanh"
    action_space: spaces.Box | None = None
    squash: bool = False
    deterministic: bool = False
    censored: bool = False
    features: Callable[[Batch], npt.ArrayLike] | None = None

    def __post_init__(self) -> None:
        ActionBox(self.action_space)
        if self.nonlinearity not in ("tanh", "relu"):
            raise ConfigurationError(f'nonlinearity must be "tanh" or "relu", got {self.nonlinearity!r}.')
        if self.squash and self.censored:
            raise ConfigurationError("A squashed Gaussian is inside its bounds: it cannot be censored as well.")
        for number, (weight, bias) in enumerate(self._layers):
            good = weight.ndim == 2 and weight.size and bias.shape == weight.shape[:1]
            if not good or not (np.isfinite(weight).all() and np.isfinite(bias).all()):
                raise ConfigurationError(
                    f"Layer {number} must have finite weights (outputs, inputs) and biases (outputs,), got shapes "
                    f"{weight.shape} and {bias.shape}."
                )
        for (before, _), (after, _) in pairwise((*self.hidden, self.mean_layer)):
            if after.shape[1] != before.shape[0]:
                raise ConfigurationError(f"A layer of {before.shape[0]} outputs meets one of {after.shape[1]} inputs.")
        if self.mean_layer[0].shape != self.log_std_layer[0].shape:
            raise ConfigurationError("Means and log standard deviations must have as many outputs.")
        if self.action_space is not None and int(np.prod(self.action_space.shape)) != self.n_actions:
            raise ConfigurationError(
                f"The policy has {self.n_actions} action columns, not those of {self.action_space}."
            )

    @property
    def n_observations(self) -> int:
        """Number of inputs."""
        return self._layers[0][0].shape[1]

    @property
    def n_actions(self) -> int:
        """Number of action columns."""
        return self.mean_layer[0].shape[0]

    def sample(self, observations: Batch, *, rng: np.random.Generator) -> npt.NDArray[Any]:
        """Return n actions, clipped to the space."""
        return self._alone.sample(observations, rngs=[rng])[0]

    def mean(self, observations: Batch) -> npt.NDArray[Any]:
        """Return the n mean actions (tanh of the mean, where squashed), clipped to the space."""
        return self._alone.mean(observations)[0]

    def log_prob(self, observations: Batch, actions: Batch) -> FloatArray:
        """Return log pi(a|s), (n,)."""
        return self._alone.log_prob(observations, actions)[0]

    @property
    def architecture(self) -> Hashable:
        """Everything but the numbers in the layers."""
        shapes = tuple(weight.shape for weight, _ in self._layers)
        box = self.action_space
        bounds = None if box is None else (box.shape, str(box.dtype), box.low.tobytes(), box.high.tobytes())
        return shapes, self.nonlinearity, bounds, self.squash, self.deterministic, self.censored, self.features

    @classmethod
    def stack(cls, policies: Sequence[MLPPolicy]) -> MLPStack:
        """Return policies of one architecture as one computation."""
        layers: list[tuple[FloatArray, FloatArray]] = []
        for number in range(len(policies[0]._layers)):
            weights = [policy._layers[number][0].T for policy in policies]
            biases = [policy._layers[number][1][None] for policy in policies]
            layers.append((np.stack(weights).astype(np.float64), np.stack(biases).astype(np.float64)))
        return MLPStack(policies[0], tuple(layers))

    @property
    def _layers(self) -> tuple[Affine, ...]:
        return (*self.hidden, self.mean_layer, self.log_std_layer)

    @cached_property
    def _alone(self) -> MLPStack:
        return self.stack([self])


@dataclass(frozen=True, eq=False)
class MLPStack:
    """Q policies of one architecture (`first`'s), with weights (Q, inputs, outputs) and biases (Q, 1, outputs).

    Observations are worked through in chunks, so that memory beyond the result stays small. Log-probabilities are
    computed in float64, actions in float32 where the action space holds float32 (else in float64).
    """

    first: MLPPolicy
    layers: tuple[tuple[FloatArray, FloatArray], ...]

    def sample(self, observations: Batch, *, rngs: Sequence[np.random.Generator]) -> npt.NDArray[Any]:
        """Return actions (Q, n, ...)."""
        return self.samples(observations, rngs=[rngs])[:, 0]

    def samples(self, observations: Batch, *, rngs: Sequence[Sequence[np.random.Generator]]) -> npt.NDArray[Any]:
        """Return actions (Q, J, n, ...), the j-th drawn from `rngs[j]`."""
        if self.first.deterministic:
            return np.repeat(self._actions(observations, [None]), len(rngs), axis=1)
        return self._actions(observations, rngs)

    def mean(self, observations: Batch) -> npt.NDArray[Any]:
        """Return the mean actions (Q, n, ...)."""
        return self._actions(observations, [None])[:, 0]

    def log_prob(self, observations: Batch, actions: Batch) -> FloatArray:
        """Return log pi(a|s), (Q, n)."""
        box, matrix = ActionBox(self.first.action_space), self._matrix(observations, np.float64)
        taken = box.to_flat(actions, width=self.first.n_actions)
        result = np.empty((len(self.layers[0][0]), len(matrix)))
        for rows, mean, log_std in self._outputs(matrix):
            if self.first.squash:
                inside = np.clip(taken[rows], -1 + INSIDE, 1 - INSIDE)
                density = gaussian_log_density(np.arctanh(inside), mean, np.exp(log_std)) - np.log1p(-(inside**2))
                result[:, rows] = density.sum(axis=-1)
            else:
                result[:, rows] = box.log_prob(taken[rows], mean, np.exp(log_std), censored=self.first.censored)
        return result

    def _actions(self, observations: Batch, rngs: Sequence[Sequence[np.random.Generator] | None]) -> npt.NDArray[Any]:
        """Return (Q, J, n, ...): actions drawn from each of `rngs`, the mean ones for None."""
        box = ActionBox(self.first.action_space)
        precision = np.float32 if box.dtype == np.float32 else np.float64
        matrix = self._matrix(observations, precision)
        shape = (len(self.layers[0][0]), len(rngs), len(matrix))
        result = np.empty((*shape, self.first.n_actions), dtype=box.dtype)
        for rows, mean, log_std in self._outputs(matrix):
            for j, own in enumerate(rngs):
                flat = mean
                if own is not None:
                    noise = np.stack([rng.standard_normal(mean.shape[1:], dtype=precision) for rng in own])
                    flat = mean + np.exp(log_std) * noise
                result[:, j, rows] = np.clip(np.tanh(flat) if self.first.squash else flat, *box.bounds)
        return result if box.space is None else result.reshape((*shape, *box.space.shape))

    def _outputs(self, matrix: npt.NDArray[Any]) -> Iterator[tuple[slice, npt.NDArray[Any], npt.NDArray[Any]]]:
        """Yield rows, means (Q, m, A) and log standard deviations (Q, m or 1, A) of one chunk after another.

        They are computed in the precision of `matrix`.
        """
        inputs = torch.from_numpy(matrix)
        layers = [tuple(torch.from_numpy(part).to(inputs.dtype) for part in layer) for layer in self.layers]
        *hidden, (mean_weight, mean_bias), (std_weight, std_bias) = layers
        constant = not bool(std_weight.any())
        width = max(weight.shape[-1] for weight, _ in self.layers)
        size = max(1, _CHUNK // (len(mean_weight) * width))
        with one_thread(), torch.no_grad():
            for start in range(0, len(matrix), size):
                x = inputs[start : start + size].expand(len(mean_weight), -1, -1)
                for weight, bias in hidden:
                    x = torch.baddbmm(bias, x, weight)
                    x = x.tanh_() if self.first.nonlinearity == "tanh" else x.relu_()
                log_std = std_bias if constant else torch.baddbmm(std_bias, x, std_weight)
                mean = torch.baddbmm(mean_bias, x, mean_weight)
                yield slice(start, start + size), mean.numpy(), log_std.numpy()

    def _matrix(self, observations: Batch, precision: type[np.floating]) -> npt.NDArray[Any]:
        if self.first.features is not None:
            observations = self.first.features(observations)
        if isinstance(observations, dict | tuple | list):
            raise InvalidDataError(
                "MLPPolicy takes a matrix of observations, and these are nested: give features=, a function of the "
                "batch, such as FlatSpace.of(observation_space).flatten."
            )
        matrix = np.array(observations, dtype=precision)
        if matrix.ndim != 2 or matrix.shape[1] != self.first.n_observations:
            raise InvalidDataError(
                f"MLPPolicy takes observations of shape (n, {self.first.n_observations}), got {matrix.shape}."
            )
        return matrix
