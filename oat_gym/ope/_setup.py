"""From the settings of `evaluate` to what estimators get: checks, behaviour policies, initial states, resamples."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Literal, get_args

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from oat_gym._rng import check_seed, derive
from oat_gym.episodes import BoolArray
from oat_gym.errors import ConfigurationError
from oat_gym.ope.behavior import KnownBehavior, fit_log_prob, logged_log_prob
from oat_gym.ope.cloning import BehaviorCloning
from oat_gym.ope.estimator import Estimator
from oat_gym.ope.logged import Logged
from oat_gym.ope.policy import Policy, PolicySet
from oat_gym.ope.problem import Part, Problem
from oat_gym.spaces import Batch, get_leaf, iter_leaf_spaces, map_tree

FloatArray = npt.NDArray[np.float64]
Parts = Literal["all", "none"] | tuple[Part, ...]
UseAugmented = Parts | Mapping[str, Parts] | None
Behavior = Literal["clone", "logged"] | BehaviorCloning | Policy
PARTS: frozenset[Part] = frozenset(get_args(Part))
DEFAULT_PARTS: frozenset[Part] = frozenset({"training"})
RESAMPLES = 1000
MAX_COUNTS = 50_000_000
"""Most numbers in the matrix of resamples by default: beyond it there are fewer resamples."""


class BehaviorSource:
    """log beta(a|s) of every logged step, made once for a seed.

    Attributes:
        asked: the seeds that were asked for since it was cleared.
        held_out: mean log-likelihood of held-out steps, by seed, where the behaviour policy is cloned.
    """

    def __init__(self, behavior: Behavior, problem: Problem, *, training: BoolArray, weighted: BoolArray) -> None:
        self.asked: set[int] = set()
        self.held_out: dict[int, float] = {}
        self._behavior: Behavior = behavior
        self._problem, self._training, self._weighted = problem, training, weighted
        self._known: dict[int, FloatArray] = {}

    def __call__(self, seed: int) -> FloatArray:
        """Return (n,) log-probabilities."""
        self.asked.add(seed)
        key = seed if self._behavior == "clone" or isinstance(self._behavior, BehaviorCloning) else -1
        if key not in self._known:
            self._known[key] = self._make(seed)
        return self._known[key]

    def _make(self, seed: int) -> FloatArray:
        behavior, problem = self._behavior, self._problem
        if behavior == "logged":
            return logged_log_prob(problem.data, episodes=self._weighted)
        if isinstance(behavior, str | BehaviorCloning):
            fit = fit_log_prob(
                problem.data,
                config=_of_one_kind(BehaviorCloning() if isinstance(behavior, str) else behavior, problem.policies),
                seed=seed,
                episodes=self._training,
                device=problem.device,
                progress=problem.progress,
            )
            self.held_out[seed] = fit.held_out_log_likelihood
            return fit.log_prob
        return KnownBehavior(behavior).log_prob(problem.data, episodes=self._weighted)


def _of_one_kind(config: BehaviorCloning, targets: PolicySet) -> BehaviorCloning:
    """Return settings of cloning whose density is of the target policies' kind, where it was left to us."""
    censored = all(getattr(policy, "censored", False) for policy in targets.policies)
    return replace(config, density="censored") if config.density == "auto" and censored else config


def check_behavior(behavior: Behavior) -> None:
    """Raise `ConfigurationError` unless `behavior` is one of the four kinds."""
    if behavior in ("clone", "logged") or isinstance(behavior, BehaviorCloning | Policy):
        return
    raise ConfigurationError(
        "behavior must be 'clone', 'logged' (infos['log_prob']), an ope.BehaviorCloning(...) or a policy with "
        f"log_prob, sample and mean, got {behavior!r}."
    )


def check_seeds(seeds: int | Sequence[int]) -> tuple[int, ...]:
    """Return the seeds: 0 to n-1 for a number n.

    Raises:
        ConfigurationError: for no seed, a repeated one, or one that is no non-negative integer.
    """
    chosen: Sequence[int] = (
        seeds if not isinstance(seeds, int | np.integer) else range(0 if isinstance(seeds, bool) else int(seeds))
    )
    numbers = tuple(check_seed(seed) for seed in chosen)
    if not numbers or len(set(numbers)) != len(numbers):
        raise ConfigurationError(f"seeds must be a positive number of seeds, or different seeds, got {seeds!r}.")
    return numbers


def check_question(data: Logged, *, gamma: float, horizon: int | None, paired: bool) -> None:
    """Raise `ConfigurationError` for a discount or horizon that gives no finite value, or nothing to pair."""
    if isinstance(gamma, bool) or not isinstance(gamma, float | int | np.floating) or not 0 < gamma <= 1:
        raise ConfigurationError(f"gamma must be above 0 and at most 1, got {gamma!r}.")
    if horizon is not None and (isinstance(horizon, bool) or not isinstance(horizon, int | np.integer) or horizon < 1):
        raise ConfigurationError(f"horizon must be a number of steps, at least 1, or None, got {horizon!r}.")
    last = data.offsets[1:][~data.synthetic] - 1
    endless = int((~data.steps.terminated[last]).sum())
    if gamma == 1 and horizon is None and endless:
        raise ConfigurationError(
            f"gamma=1 without a horizon has no finite value here: {endless} of {len(last)} episodes do not reach a "
            "terminal state. Give horizon= (steps that count) or gamma below 1."
        )
    if paired and not data.synthetic.any():
        raise ConfigurationError("paired=True compares with and without synthetic episodes, and there are none.")


def augmented_parts(
    use_augmented: UseAugmented, estimator: Estimator, estimators: Sequence[Estimator]
) -> frozenset[Part]:
    """Return the parts of `estimator` that see synthetic episodes.

    Raises:
        ConfigurationError: for an unknown part, estimator or family.
    """
    if not isinstance(use_augmented, Mapping):
        return _parts(use_augmented)
    wanted: Mapping[str, Parts] = use_augmented
    known = {each.name for each in estimators} | {each.family for each in estimators}
    unknown = sorted(set(wanted) - known)
    if unknown:
        raise ConfigurationError(
            f"use_augmented names {', '.join(unknown)}; estimators and families are {', '.join(sorted(known))}."
        )
    return _parts(wanted[estimator.name] if estimator.name in wanted else wanted.get(estimator.family))


def _parts(value: Parts | None) -> frozenset[Part]:
    if value is None:
        return DEFAULT_PARTS
    if isinstance(value, str):
        named: dict[str, frozenset[Part]] = {"all": PARTS, "none": frozenset()}
        if value in named:
            return named[value]
    elif set(value) <= PARTS:
        return frozenset(value)
    raise ConfigurationError(
        f"use_augmented must be None, 'all', 'none', a tuple out of {', '.join(sorted(PARTS))}, or a mapping from "
        f"estimators to those, got {value!r}."
    )


def draw_resamples(n_units: int, resamples: int | None) -> FloatArray:
    """Return (B, N): how often each of B bootstrap resamples holds each of N real episodes.

    They are the same for every seed, estimator and policy, so that differences can be taken resample by resample.

    Raises:
        ConfigurationError: for fewer than two resamples.
    """
    if resamples is None:
        resamples = max(200, min(RESAMPLES, MAX_COUNTS // n_units))
    if isinstance(resamples, bool) or not isinstance(resamples, int | np.integer) or resamples < 2:
        raise ConfigurationError(f"resamples must be a whole number, at least 2, got {resamples!r}.")
    rng, counts = derive(0, "bootstrap", n_units), np.empty((int(resamples), n_units))
    for row in counts:
        row[:] = np.bincount(rng.integers(0, n_units, size=n_units), minlength=n_units)
    return counts


def initial_batch(states: Any, data: Logged) -> Batch:
    """Return the initial states that a user gave as a batch of M observations.

    Raises:
        ConfigurationError: unless they have the form of the observation space with one more axis in front, M >= 1, and
            are finite.
    """
    space = data.flat_observations.space
    batch = states if isinstance(space, spaces.Dict | spaces.Tuple) else np.asarray(states)
    lengths: set[int] = set()
    for path, leaf in iter_leaf_spaces(space):
        try:
            values = np.asarray(get_leaf(batch, path))
        except (KeyError, IndexError, TypeError):
            raise ConfigurationError(f"initial_states must be a batch of {space}: nothing is at {path!r}.") from None
        if values.ndim == 0 or values.shape[1:] != (leaf.shape or ()) or not np.isfinite(values).all():
            raise ConfigurationError(
                f"initial_states must be M finite observations, of shape (M, {', '.join(map(str, leaf.shape or ()))}) "
                f"for {leaf}, got shape {values.shape}. A single state needs one more axis: state[None]."
            )
        lengths.add(len(values))
    if len(lengths) != 1 or 0 in lengths:
        raise ConfigurationError(f"initial_states must hold at least one observation, all parts alike: {lengths}.")
    return map_tree(np.array, batch)
