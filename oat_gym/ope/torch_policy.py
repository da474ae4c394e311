"""Torch modules as policies."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from gymnasium import spaces
from torch import Tensor, nn
from torch.distributions import Categorical, Distribution, Normal

from oat_gym.errors import ConfigurationError, InvalidDataError
from oat_gym.ope._torch_squashed import center_of, inside_of
from oat_gym.ope.gaussian import ActionBox
from oat_gym.ope.policies import CategoricalPolicy, check_discrete
from oat_gym.ope.policy import FloatArray
from oat_gym.spaces import Batch, tree_length


@dataclass(frozen=True, eq=False)
class TorchPolicy:
    """A torch module over a Box of actions.

    The module takes a float32 tensor of observations (n, ...) and returns a `torch.distributions.Distribution` of
    actions, or a pair (mean, log standard deviation) of a diagonal Gaussian. It is called without gradients, in the
    mode (train or eval) that it is in, on its own device.

    Squashed Gaussians (SAC's) are a `TransformedDistribution` of a tanh and, for other bounds than -1 and 1, an
    `AffineTransform`. Torch gives it neither mean nor mode: `mean` is then the mean of what is transformed, pushed
    through the transforms (SAC's own deterministic action; of a tanh it is the median). Its density at the bounds is
    zero or infinite: `log_prob` reads actions closer to a tanh's -1 or 1 than 1e-4 as if they were there, as
    `MLPPolicy` and the cloned tanh-Gaussian do.

    Attributes:
        module: the module (any callable of a tensor).
        action_space: Box of the actions; results are clipped to it.
        features: observations (a batch) -> array (n, ...) for the module; for Dict observations,
            `FlatSpace.of(observation_space).flatten`. `None`: the observations themselves.
        deterministic: `sample` returns `mean`; `log_prob` stays that of the distribution.
        mean_module: gives the mean actions (n, ...) for what the module takes, where its distribution does not know
            them (or others are wanted).

    >>> module = lambda states: (2 * states, torch.zeros_like(states))
    >>> policy = TorchPolicy(module, spaces.Box(-1, 1, (1,)))
    >>> policy.mean(np.array([[0.25]])).tolist()
    [[0.5]]
    """

    module: Callable[[Tensor], Any]
    action_space: spaces.Box
    features: Callable[[Batch], npt.ArrayLike] | None = None
    deterministic: bool = False
    mean_module: Callable[[Tensor], Any] | None = None

    def __post_init__(self) -> None:
        ActionBox(self.action_space)

    def sample(self, observations: Batch, *, rng: np.random.Generator) -> npt.NDArray[Any]:
        """Return n actions, clipped to the space; torch's random state is left as it was."""
        if self.deterministic:
            return self.mean(observations)
        distribution, device = self._distribution(observations), module_device(self.module)
        with torch.random.fork_rng(devices=[device] if device.type == "cuda" else []):
            _seed(int(rng.integers(0, 2**63 - 1)), device)  # distributions draw from the global state only
            return self._actions(distribution.sample(), observations)

    def mean(self, observations: Batch) -> npt.NDArray[Any]:
        """Return the n mean actions, clipped to the space (of a distribution without a mean: its mode).

        Raises:
            ConfigurationError: for a distribution with neither that is no transformed one; give `mean_module`.
        """
        if self.mean_module is not None:
            center = call_module(self.mean_module, observations, self.features)
            if not isinstance(center, Tensor):
                raise InvalidDataError(f"TorchPolicy: mean_module must return a tensor, got {type(center).__name__}.")
            return self._actions(center, observations)
        distribution = self._distribution(observations)
        center = center_of(distribution)
        if center is None:
            raise ConfigurationError(
                f"TorchPolicy: {type(distribution).__name__} has neither mean nor mode, which estimators of "
                "deterministic actions need: give mean_module=, a function of the same tensor that returns the mean "
                "actions (n, ...)."
            )
        return self._actions(center, observations)

    def log_prob(self, observations: Batch, actions: Batch) -> FloatArray:
        """Return log pi(a|s), (n,)."""
        taken = torch.as_tensor(np.array(actions, dtype=np.float32), device=module_device(self.module))
        with torch.no_grad():
            distribution = self._distribution(observations)
            values = distribution.log_prob(inside_of(distribution, taken))
        return values.reshape(len(taken), -1).sum(dim=1).cpu().numpy().astype(np.float64)

    def _distribution(self, observations: Batch) -> Distribution:
        output = call_module(self.module, observations, self.features)
        if isinstance(output, tuple) and len(output) == 2:  # pyright: ignore[reportUnknownArgumentType]
            mean, log_std = output  # pyright: ignore[reportUnknownVariableType]
            output = Normal(mean, log_std.exp().expand_as(mean))  # pyright: ignore
        if not isinstance(output, Distribution):
            raise InvalidDataError(
                "TorchPolicy: the module must return a torch Distribution or a pair (mean, log_std), got "
                f"{type(output).__name__}. For logits over Discrete actions use TorchCategoricalPolicy."
            )
        return output

    def _actions(self, values: Tensor, observations: Batch) -> npt.NDArray[Any]:
        shape = (tree_length(observations), *self.action_space.shape)
        if tuple(values.shape) != shape:
            raise InvalidDataError(f"TorchPolicy: actions of shape {shape} are expected, got {tuple(values.shape)}.")
        flat = values.detach().cpu().numpy().astype(np.float64).reshape(shape[0], -1)
        return ActionBox(self.action_space).to_actions(flat)


@dataclass(frozen=True, eq=False)
class TorchCategoricalPolicy(CategoricalPolicy):
    """A torch module over `Discrete` actions: it returns logits (n, K) or a `Categorical`.

    For a value network (a DQN), whose outputs are no logits, wrap this in an `EpsilonGreedyPolicy`.

    Attributes:
        module: see `TorchPolicy`.
        action_space: a `Discrete` space of K actions.
        features: see `TorchPolicy`.

    >>> policy = TorchCategoricalPolicy(lambda states: torch.zeros(len(states), 2), spaces.Discrete(2))
    >>> policy.probabilities(np.zeros((1, 3))).tolist()
    [[0.5, 0.5]]
    """

    module: Callable[[Tensor], Any]
    action_space: spaces.Discrete
    features: Callable[[Batch], npt.ArrayLike] | None = None

    def __post_init__(self) -> None:
        check_discrete(self.action_space, "TorchCategoricalPolicy")

    @property
    def first_action(self) -> int:
        """The number of the first action."""
        return int(self.action_space.start)

    def probabilities(self, observations: Batch) -> FloatArray:
        """Return pi(a|s) of each action, (n, K)."""
        output = call_module(self.module, observations, self.features)
        logits = output.logits if isinstance(output, Categorical) else output
        expected = (tree_length(observations), int(self.action_space.n))
        if not isinstance(logits, Tensor) or tuple(logits.shape) != expected:
            got = tuple(logits.shape) if isinstance(logits, Tensor) else type(output).__name__
            raise InvalidDataError(
                f"TorchCategoricalPolicy: the module must return logits of shape {expected} or a Categorical, "
                f"got {got}."
            )
        return logits.double().softmax(dim=1).cpu().numpy()


def _seed(seed: int, device: torch.device) -> None:
    """Seed torch's global state of one device."""
    if device.type == "cuda":
        with torch.cuda.device(device):
            torch.cuda.manual_seed(seed)
    torch.default_generator.manual_seed(seed)


def module_device(module: Callable[[Tensor], Any]) -> torch.device:
    """Return where a module's parameters lie; the CPU for a module without any, or a plain function."""
    first = next(module.parameters(), None) if isinstance(module, nn.Module) else None
    return torch.device("cpu") if first is None else first.device


def call_module(
    module: Callable[[Tensor], Any], observations: Batch, features: Callable[[Batch], npt.ArrayLike] | None
) -> object:
    """Call a module on a batch of observations, as float32 and without gradients."""
    inputs = observations if features is None else features(observations)
    if isinstance(inputs, dict | tuple | list):
        raise ConfigurationError(
            "A torch policy takes one array of observations, and these are nested: give features=, a function of the "
            "batch, such as FlatSpace.of(observation_space).flatten."
        )
    with torch.no_grad():
        return module(torch.as_tensor(np.array(inputs, dtype=np.float32), device=module_device(module)))
