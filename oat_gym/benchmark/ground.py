"""What the cells of a dataset have in common: its content, its task's policies, horizon and starts, what computed."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import metadata

import numpy as np
import numpy.typing as npt

from oat_gym.domains import Task
from oat_gym.ope import Policy
from oat_gym.ope._normalised import discounts
from oat_gym.ope.policy import PolicySet
from oat_gym.ope.problem import flatten_policies
from oat_gym.source import Source
from oat_gym.spaces import Batch

FloatArray = npt.NDArray[np.float64]
PROBE = 256
"""Recorded steps on which policies are told apart."""


@dataclass(frozen=True)
class Ground:
    """What a result depends on beside the method, the estimator and the seed. Cells of two grounds are never compared.

    Attributes:
        data: fingerprint of the dataset's content.
        gamma: discount.
        horizon: number of steps that count; None for endless.
        policies: (name, what it does on recorded steps in three digits) of each target policy: another policy of the
            same name is noticed, and the last digits of another machine are not.
        starts: the initial states that values count from, in the same form; "data" for the data's own.
        computed: versions and kind of device that estimates may differ between.
    """

    data: str
    gamma: float
    horizon: int | None
    policies: tuple[tuple[str, str], ...]
    starts: str
    computed: str


def survey(source: Source, task: Task, starts: Batch | None, *, gamma: float | None, device: str) -> Ground:
    """Return the ground that a dataset's cells stand on.

    Args:
        source: the dataset.
        task: its task.
        starts: the initial states that values count from; None for the data's own.
        gamma: discount; None: the task's.
        device: torch device of the estimators.
    """
    features = None if starts is None else source.flat_observations.flatten(starts)
    return Ground(
        data=source.fingerprint,
        gamma=float(task.gamma if gamma is None else gamma),
        horizon=task.horizon,
        policies=tell_apart(source, task.policies()),
        starts="data" if features is None else _brief(features),
        computed=f"{_series('numpy')}, {_series('torch')}, {device.partition(':')[0]}",
    )


def recorded_return(source: Source, *, gamma: float, horizon: int | None) -> tuple[float, float]:
    """Return the mean discounted return of the recorded episodes' first `horizon` steps, and its standard error.

    Said of every policy it is an estimate too, the least that any estimator has to beat. The error is NaN for one
    episode.
    """
    returns = [rewards[:horizon] @ discounts(gamma, len(rewards[:horizon])) for rewards in source.rewards()]
    spread = float(np.std(returns, ddof=1)) if len(returns) > 1 else math.nan
    return float(np.mean(returns)), spread / math.sqrt(len(returns))


def tell_apart(source: Source, policies: Mapping[str, Policy]) -> tuple[tuple[str, str], ...]:
    """Return (name, mean actions and log-probabilities in brief) of each policy, on the first recorded steps."""
    observations, actions = _probe(source)
    several, space = PolicySet.of(policies), source.flat_actions
    means = flatten_policies(several.mean(observations), space, len(several))
    logs = several.log_prob(observations, actions)
    return tuple(
        (name, f"{_brief(mean)}; {_brief(log[np.isfinite(log)])}")
        for name, mean, log in zip(several.names, means, logs, strict=True)
    )


def _probe(source: Source) -> tuple[Batch, Batch]:
    """Return up to `PROBE` observations and actions: the first steps of the first episodes."""
    states: list[FloatArray] = []
    actions: list[FloatArray] = []
    for episode_states, episode_actions in zip(source.state_matrices(), source.action_matrices(), strict=True):
        steps = len(episode_actions)
        states.append(episode_states[:steps])
        actions.append(episode_actions)
        if sum(map(len, actions)) >= PROBE:
            break
    observations = source.flat_observations.unflatten(np.concatenate(states)[:PROBE])
    return observations, source.flat_actions.unflatten(np.concatenate(actions)[:PROBE])


def _brief(numbers: FloatArray) -> str:
    """Return size, mean and root mean square, in three digits."""
    if not numbers.size:
        return "none"
    return f"{numbers.size} {numbers.mean():.3g} {np.sqrt(np.square(numbers).mean()):.3g}"


def _series(library: str) -> str:
    return f"{library} {'.'.join(metadata.version(library).split('+')[0].split('.')[:2])}"
