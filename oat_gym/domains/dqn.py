"""Deep Q-learning from a dataset: how the sepsis and tutoring domains get their target policies.

Source: Mnih et al., "Human-level control through deep reinforcement learning", Nature 518, 2015: a target network that
is copied from time to time, and errors clipped to [-1, 1] (the Huber loss). The paper that oat_gym implements trains
its target policies with it off policy, from the recorded transitions (appendices D and E). Two things differ from Mnih
et al.: the replay memory is the dataset, and Adam takes the place of RMSProp.
"""

from __future__ import annotations

import copy
import os
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import minari
import numpy as np
import numpy.typing as npt
import torch
from gymnasium import spaces
from torch import Tensor, nn

from oat_gym._rng import derive, torch_generator
from oat_gym.cache import read_sealed, write_sealed
from oat_gym.episodes import collect_transitions
from oat_gym.errors import CacheError, ConfigurationError, DatasetNotFoundError, InvalidDataError, TrainingError
from oat_gym.ope._deviation import deviation
from oat_gym.ope.policies import CategoricalPolicy, EpsilonGreedyPolicy, check_discrete
from oat_gym.spaces import Batch, FlatSpace

FloatArray = npt.NDArray[np.float64]
VERSION = 1  # raise it when training changes, so that no cached network of an older one is used
EVALUATION_EPSILON = 0.05
"""Mnih et al. evaluate their networks with this share of random actions."""


@dataclass(frozen=True)
class DQN:
    """Settings of deep Q-learning from a dataset of `Discrete` actions.

    Args:
        learning_rate: of Adam.
        gamma: discount, in [0, 1).
        hidden: units of the hidden layers (ReLU).
        updates: gradient steps.
        batch_size: transitions in each.
        target_every: gradient steps between two copies into the target network.
        reward_scale: rewards are divided by it, so that the clipped errors have a sensible size; `None`: the standard
            deviation of the data's rewards.

    Raises:
        ConfigurationError: for values that cannot work.

    >>> DQN(learning_rate=1e-4).gamma
    0.99
    """

    learning_rate: float = 1e-3
    gamma: float = 0.99
    hidden: tuple[int, ...] = (64, 64)
    updates: int = 5000
    batch_size: int = 64
    target_every: int = 100
    reward_scale: float | None = None

    def __post_init__(self) -> None:
        if not self.learning_rate > 0 or not 0 <= self.gamma < 1:
            raise ConfigurationError(
                f"learning_rate must be positive and gamma in [0, 1), got {self.learning_rate} and {self.gamma}."
            )
        if min(self.updates, self.batch_size, self.target_every, *self.hidden) < 1:
            raise ConfigurationError("updates, batch_size, target_every and every hidden layer must be at least 1.")
        if self.reward_scale is not None and not self.reward_scale > 0:
            raise ConfigurationError(f"reward_scale must be positive or None, got {self.reward_scale}.")

    def fit(self, dataset: minari.MinariDataset, *, seed: int = 0) -> QNetwork:
        """Return the network trained on the dataset's transitions; the same seed gives the same weights.

        Terminal transitions bootstrap zero, truncated ones do not end anything.

        Raises:
            ConfigurationError: if actions are not `Discrete`.
            TrainingError: if the values diverge.
        """
        actions = dataset.action_space
        check_discrete(actions, "DQN")
        space = FlatSpace.of(dataset.observation_space, "observation space")
        data, moments, scale = _prepare(dataset, space, self.reward_scale)
        network = _mlp(space.layout.width, self.hidden, int(actions.n), derive(seed, "dqn", "weights"))
        _train(network, data, self, torch_generator(derive(seed, "dqn", "batches")))
        weights = {name: tensor.detach().numpy().copy() for name, tensor in network.state_dict().items()}
        if not all(np.isfinite(array).all() for array in weights.values()):
            raise TrainingError(f"Deep Q-learning diverged: {self}. Lower the learning rate.")
        return QNetwork({**weights, **moments, "reward_scale": scale}, dataset.observation_space, actions)


class QNetwork(CategoricalPolicy):
    """Q(s, a) as a perceptron, and the policy that takes the action of the largest value.

    `softened` gives the policy that evaluations use.
    """

    def __init__(
        self,
        arrays: Mapping[str, npt.NDArray[Any]],
        observation_space: spaces.Space[Any],
        action_space: spaces.Discrete,
    ) -> None:
        """Check and copy the arrays (`QNetwork.load` and `DQN.fit` give them).

        Raises:
            InvalidDataError: if they do not fit the spaces.
        """
        check_discrete(action_space, "QNetwork")
        self._arrays = {name: np.array(array) for name, array in arrays.items()}
        self._action_space = action_space
        self._space = FlatSpace.of(observation_space, "observation space")
        names = sorted((name for name in self._arrays if name.endswith(".weight")), key=lambda name: int(name[:-7]))
        weights = [self._arrays[name] for name in names]
        width, n_actions = self._space.layout.width, int(action_space.n)
        if not weights or weights[0].shape[1] != width or weights[-1].shape[0] != n_actions:
            raise InvalidDataError(
                f"A QNetwork of {width} features and {n_actions} actions is expected, got weights of shapes "
                f"{[weight.shape for weight in weights]}."
            )
        self._module = _mlp(width, tuple(weight.shape[0] for weight in weights[:-1]), n_actions, None)
        self._module.load_state_dict({name: torch.as_tensor(self._arrays[name]) for name in self._module.state_dict()})

    @property
    def first_action(self) -> int:
        """The number of the first action."""
        return int(self._action_space.start)

    def q_values(self, observations: Batch) -> FloatArray:
        """Return Q(s, a) of each action in the units of the rewards, (n, K)."""
        features = (self._space.flatten(observations) - self._arrays["mean"]) / self._arrays["scale"]
        with torch.no_grad():
            values: Tensor = self._module(torch.as_tensor(features.astype(np.float32)))
        return values.double().numpy() * self._arrays["reward_scale"].item()

    def probabilities(self, observations: Batch) -> FloatArray:
        """Return 1 for the action of the largest value and 0 for the others, (n, K); the first of equals."""
        values = self.q_values(observations)
        return np.eye(values.shape[1])[values.argmax(axis=1)]

    @property
    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        """Copies of what `save` writes: weights, the features' mean and scale, the rewards' scale."""
        return {name: array.copy() for name, array in self._arrays.items()}

    def softened(self, epsilon: float = EVALUATION_EPSILON) -> EpsilonGreedyPolicy:
        """Return the epsilon-greedy policy, which gives every action a probability that importance weights can use."""
        return EpsilonGreedyPolicy(self, self._action_space, epsilon=epsilon)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the weights as one safetensors file."""
        write_sealed(Path(path), self._arrays, None)

    @classmethod
    def load(
        cls, path: str | os.PathLike[str], *, observation_space: spaces.Space[Any], action_space: spaces.Discrete
    ) -> QNetwork:
        """Return the network of a file that `save` wrote.

        Raises:
            DatasetNotFoundError: if there is no such file.
            InvalidDataError: if it is damaged or of other spaces.
        """
        path = Path(path)
        if not path.is_file():
            raise DatasetNotFoundError(f"There is no file {path}; QNetwork.save writes one.")
        try:
            arrays, _ = read_sealed(path)
        except CacheError as error:
            raise InvalidDataError(f"{path} is not a whole QNetwork file: {error}") from error
        return cls(arrays, observation_space, action_space)


@dataclass(frozen=True)
class _Data:
    """Standardised transitions as tensors: n rows."""

    states: Tensor
    actions: Tensor
    rewards: Tensor
    next_states: Tensor
    goes_on: Tensor


def _prepare(
    dataset: minari.MinariDataset, space: FlatSpace, reward_scale: float | None
) -> tuple[_Data, dict[str, npt.NDArray[Any]], npt.NDArray[Any]]:
    episodes = [(episode, np.zeros(len(episode.rewards), dtype=bool), {}) for episode in dataset]
    table = collect_transitions(episodes, range(len(episodes)))
    states, following = space.flatten(table.observations), space.flatten(table.next_observations)
    mean, scale = states.mean(axis=0), states.std(axis=0)
    scale[scale < 1e-6] = 1.0
    unit = float(deviation(table.rewards) or 1.0) if reward_scale is None else reward_scale
    first = int(dataset.action_space.start)  # pyright: ignore[reportAttributeAccessIssue]
    data = _Data(
        states=torch.as_tensor(((states - mean) / scale).astype(np.float32)),
        actions=torch.as_tensor(np.asarray(table.actions, dtype=np.int64) - first),
        rewards=torch.as_tensor((table.rewards / unit).astype(np.float32)),
        next_states=torch.as_tensor(((following - mean) / scale).astype(np.float32)),
        goes_on=torch.as_tensor((~table.terminated).astype(np.float32)),
    )
    return data, {"mean": mean, "scale": scale}, np.array(unit)


def _mlp(inputs: int, hidden: tuple[int, ...], outputs: int, rng: np.random.Generator | None) -> nn.Sequential:
    """Return a ReLU perceptron; with `rng` its weights are drawn uniformly within 1/sqrt(inputs) of each layer."""
    sizes = (inputs, *hidden, outputs)
    module = nn.Sequential()
    with torch.device("meta"):
        for number, (wide, out) in enumerate(pairwise(sizes)):
            module.append(nn.Linear(wide, out))
            if number < len(hidden):
                module.append(nn.ReLU())
    module.to_empty(device="cpu")
    if rng is not None:
        generator = torch_generator(rng)
        for layer in module:
            if isinstance(layer, nn.Linear):
                bound = layer.in_features**-0.5
                nn.init.uniform_(layer.weight, -bound, bound, generator=generator)
                nn.init.uniform_(layer.bias, -bound, bound, generator=generator)
    return module


def _train(network: nn.Sequential, data: _Data, config: DQN, generator: torch.Generator) -> None:
    target = copy.deepcopy(network)
    optimiser = torch.optim.Adam(network.parameters(), lr=config.learning_rate)
    loss = nn.SmoothL1Loss()
    for update in range(config.updates):
        if update % config.target_every == 0:
            target.load_state_dict(network.state_dict())
        rows = torch.randint(len(data.rewards), (config.batch_size,), generator=generator)
        with torch.no_grad():
            ahead = target(data.next_states[rows]).max(dim=1).values
            goal = data.rewards[rows] + config.gamma * data.goes_on[rows] * ahead
        value = network(data.states[rows]).gather(1, data.actions[rows, None])[:, 0]
        optimiser.zero_grad()
        loss(value, goal).backward()
        optimiser.step()
