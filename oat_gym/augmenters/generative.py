"""What the methods that roll out VAE-MDPs share: their settings, what they learn, and how they act and clip."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, ClassVar, Literal, Self, get_args

import numpy as np
import numpy.typing as npt

from oat_gym._rng import derive
from oat_gym.augmenters.base import Augmenter, Sampler
from oat_gym.cache import Arrays
from oat_gym.errors import ConfigurationError
from oat_gym.generation import (
    ActionPolicy,
    BehaviorConfig,
    BehaviorModel,
    FittedVAEMDP,
    Limits,
    Sequences,
    VAEMDPConfig,
    fit_behavior,
    fit_many,
)
from oat_gym.progress import ProgressCallback
from oat_gym.source import Source
from oat_gym.spaces import FlatSpace, FloatMatrix

Start = Literal["prior", "posterior"]


@dataclass(frozen=True, kw_only=True)
class GenerativeAugmenter(Augmenter):
    """The settings of a method that samples from VAE-MDPs; `OAT` says what they mean."""

    expected_failures: ClassVar[Mapping[str, str]] = {
        "zero-strength": "what is generated is a sample of a learnt model, which has no strength to set to zero"
    }
    model: VAEMDPConfig = field(default_factory=VAEMDPConfig)
    behavior: BehaviorConfig = field(default_factory=BehaviorConfig)
    start: Start = "prior"
    policy: ActionPolicy | None = None
    observation_noise: bool = True

    def __post_init__(self) -> None:
        check_choice("start", self.start, get_args(Start))
        check_kind("model", self.model, VAEMDPConfig)
        check_kind("behavior", self.behavior, BehaviorConfig)
        if not isinstance(self.observation_noise, bool):
            raise ConfigurationError(f"observation_noise must be True or False, got {self.observation_noise!r}.")
        if self.policy is not None and not isinstance(self.policy, ActionPolicy):
            raise ConfigurationError(f"policy must have the methods sample and log_prob, got {self.policy!r}.")

    @property
    def cacheable(self) -> bool:
        """False with a policy of the user's."""
        return self.policy is None

    @classmethod
    def preset(cls, preset: Literal["default", "paper"]) -> Self:
        """Return a named configuration: "default", or "paper" (appendix B.2: 100 updates of 4 sequences)."""
        return cls() if preset == "default" else cls(model=VAEMDPConfig.from_preset(preset))

    def check(self, source: Source) -> None:
        """Raise where the spaces cannot be modelled."""
        _ = source.flat_observations, source.flat_actions


@dataclass(frozen=True)
class Matrices:
    """The episodes of a source as feature matrices: states (T_i + 1, width), actions (T_i, width), rewards (T_i,)."""

    states: list[FloatMatrix]
    actions: list[FloatMatrix]
    rewards: list[npt.NDArray[np.float64]]

    @classmethod
    def of(cls, source: Source) -> Matrices:
        """Return the matrices of a source; raises `InvalidDataError` for values that are not finite."""
        return cls(source.state_matrices(), source.action_matrices(), source.rewards())


@dataclass(frozen=True)
class Learned:
    """What was learnt from a source: the clone of its behaviour policy, and a VAE-MDP for each set of sequences."""

    behavior: BehaviorModel
    models: tuple[FittedVAEMDP, ...]

    def to_arrays(self) -> Arrays:
        """Return everything but the settings and the names as arrays."""
        parts = {"behavior/": self.behavior.to_arrays()}
        parts |= {f"model{g}/": model.to_arrays() for g, model in enumerate(self.models)}
        return {prefix + name: array for prefix, part in parts.items() for name, array in part.items()}

    @classmethod
    def from_arrays(
        cls, arrays: Mapping[str, npt.NDArray[Any]], *, config: GenerativeAugmenter, names: Sequence[str]
    ) -> Learned:
        """Return what `to_arrays` described; `names` is how messages call each set."""
        behavior = BehaviorModel.from_arrays(with_prefix(arrays, "behavior/"), config=config.behavior)
        models = tuple(
            FittedVAEMDP.from_arrays(with_prefix(arrays, f"model{g}/"), config=config.model, name=name)
            for g, name in enumerate(names)
        )
        return cls(behavior, models)


def learn(
    config: GenerativeAugmenter,
    source: Source,
    data: Matrices,
    sets: Sequence[Sequences],
    *,
    seed: int,
    progress: ProgressCallback,
) -> Learned:
    """Clone the behaviour policy from all of `data`, and train one VAE-MDP for each of `sets`."""
    behavior = fit_behavior(
        np.concatenate([rows[:-1] for rows in data.states]),
        np.concatenate(data.actions),
        state_layout=source.flat_observations.layout,
        action_layout=source.flat_actions.layout,
        groups=np.repeat(np.arange(len(source)), source.lengths),
        bounds=source.flat_actions.bounds,
        config=config.behavior,
        rng=derive(seed, "behavior"),
        progress=progress,
    )
    models = fit_many(
        sets,
        state_layout=source.flat_observations.layout,
        action_layout=source.flat_actions.layout,
        config=config.model,
        rng=derive(seed, "model"),
        progress=progress,
    )
    return Learned(behavior, tuple(models))


class GenerativeSampler(Sampler):
    """Holds what was learnt, and what every roll-out needs: the policy that acts, the data, and its range."""

    def __init__(self, config: GenerativeAugmenter, source: Source, seed: int, *, learned: Learned) -> None:
        self._source = source
        self._seed = seed
        self._learned = learned
        self._settings = config

    def state(self) -> tuple[Arrays, Any]:
        """Return all that was learnt as arrays."""
        return self._learned.to_arrays(), None

    @property
    def _policy(self) -> ActionPolicy:
        if self._settings.policy is None:
            return self._learned.behavior
        return _FlatPolicy(self._settings.policy, self._source.flat_observations, self._source.flat_actions)

    @cached_property
    def _data(self) -> Matrices:
        return Matrices.of(self._source)

    @cached_property
    def _limits(self) -> Limits:
        """The range of all recorded values, wider by the model's margin and inside the spaces' bounds."""
        return Limits.of(
            np.concatenate(self._data.states),
            np.concatenate(self._data.actions),
            np.concatenate(self._data.rewards),
            margin=self._settings.model.range_margin,
            state_bounds=self._source.flat_observations.bounds,
            action_bounds=self._source.flat_actions.bounds,
        )


@dataclass(frozen=True)
class _FlatPolicy:
    """A policy on batches of the dataset's spaces, as one on feature matrices."""

    policy: ActionPolicy
    observations: FlatSpace
    actions: FlatSpace

    def sample(
        self, observations: npt.NDArray[np.floating[Any]], *, rng: np.random.Generator
    ) -> npt.NDArray[np.floating[Any]]:
        return self.actions.flatten(self.policy.sample(self.observations.unflatten(observations), rng=rng))

    def log_prob(
        self, observations: npt.NDArray[np.floating[Any]], actions: npt.NDArray[np.floating[Any]]
    ) -> npt.NDArray[np.floating[Any]]:
        return self.policy.log_prob(self.observations.unflatten(observations), self.actions.unflatten(actions))


def with_prefix(arrays: Mapping[str, npt.NDArray[Any]], prefix: str) -> Arrays:
    """Return the arrays whose names start with `prefix`, under the rest of their names."""
    return {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}


def check_choice(name: str, value: object, allowed: tuple[str, ...]) -> None:
    """Raise `ConfigurationError` unless `value` is one of `allowed`."""
    if value not in allowed:
        raise ConfigurationError(f"{name} must be one of {', '.join(allowed)}; got {value!r}.")


def check_kind(name: str, value: object, kind: type[object]) -> None:
    """Raise `ConfigurationError` unless `value` is an instance of `kind`."""
    if not isinstance(value, kind):
        raise ConfigurationError(f"{name} must be a {kind.__name__}, got {value!r}.")
