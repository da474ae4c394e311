"""Plain Python functions as policies."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from oat_gym.errors import ConfigurationError, InvalidDataError
from oat_gym.ope.policy import FloatArray
from oat_gym.spaces import Batch, FlatSpace, map_tree, tree_length


@dataclass(frozen=True)
class FunctionPolicy:
    """A function observation -> action, as users of Gymnasium write policies.

    Attributes:
        function: the action taken, for one observation (or a batch, with `batched`).
        action_space: the space of its actions; results are clipped into a Box and cast to its dtype.
        batched: whether the functions take and return batches.
        draw: function (observation, rng) -> action of a stochastic policy; `None`: the policy is deterministic.
        density: function (observations, actions) -> log pi(a|s), (n,), always on batches. Without it, a deterministic
            policy over discrete actions has log-probability 0 for its own action and minus infinity for any other;
            in all other cases `log_prob` raises.

    >>> policy = FunctionPolicy(lambda observation: 2 * observation, action_space=spaces.Box(-1, 1, (1,)))
    >>> policy.mean(np.array([[0.25], [3.0]])).tolist()
    [[0.5], [1.0]]
    """

    function: Callable[[Any], Any]
    action_space: spaces.Space[Any]
    batched: bool = False
    draw: Callable[[Any, np.random.Generator], Any] | None = None
    density: Callable[[Batch, Batch], npt.ArrayLike] | None = None

    def sample(self, observations: Batch, *, rng: np.random.Generator) -> Batch:
        """Return n actions: drawn by `draw`, or those of the deterministic policy."""
        chosen = self.draw
        if chosen is None:
            return self.mean(observations)
        return self._evaluate(lambda observation: chosen(observation, rng), observations)

    def mean(self, observations: Batch) -> Batch:
        """Return the n actions of `function`."""
        return self._evaluate(self.function, observations)

    def log_prob(self, observations: Batch, actions: Batch) -> FloatArray:
        """Return log pi(a|s), (n,).

        Raises:
            ConfigurationError: if the density is not known.
            InvalidDataError: if `density` returns another shape than (n,).
        """
        n = tree_length(observations)
        if self.density is not None:
            values = np.asarray(self.density(observations, actions), dtype=np.float64)
            if values.shape != (n,):
                raise InvalidDataError(f"FunctionPolicy: density must return shape ({n},), got {values.shape}.")
            return values
        flat = FlatSpace.of(self.action_space, "action space")
        if flat.layout.continuous or self.draw is not None:
            raise ConfigurationError(
                "This FunctionPolicy has no density, which importance weights need: give FunctionPolicy(..., "
                "density=function(observations, actions) -> log pi(a|s)), or use an estimator that needs none (FQE)."
            )
        same = (flat.flatten(actions) == flat.flatten(self.mean(observations))).all(axis=1)
        return np.where(same, 0.0, -np.inf)

    def _evaluate(self, function: Callable[[Any], Any], observations: Batch) -> Batch:
        n = tree_length(observations)
        if self.batched:
            actions = function(observations)
        else:
            each = [function(map_tree(lambda leaf, i=i: leaf[i], observations)) for i in range(n)]
            actions = map_tree(lambda *leaves: np.stack([np.asarray(leaf) for leaf in leaves]), each[0], *each[1:])
        flat = FlatSpace.of(self.action_space, "action space")
        matrix = flat.flatten(actions)
        if matrix.shape != (n, flat.layout.width):
            raise InvalidDataError(
                f"FunctionPolicy: the function gave actions of {matrix.shape[1]} columns for {matrix.shape[0]} "
                f"observations; {n} actions of {self.action_space} are expected. With batched=True it takes and "
                "returns batches, otherwise one observation and one action."
            )
        return flat.unflatten(matrix)
