"""True values of target policies: what estimates are measured against."""

from __future__ import annotations

import json
import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from importlib import metadata
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt

from oat_gym.cache import write_atomically
from oat_gym.embedded import embedded_file
from oat_gym.errors import ConfigurationError, InvalidDataError

FloatArray = npt.NDArray[np.float64]

GAMMAS = (1.0, 0.999, 0.995, 0.99, 0.98, 0.95, 0.9)
"""The discounts that stored truths hold."""

_VERSIONED = ("gymnasium", "gymnasium-robotics", "mujoco", "numpy")


@dataclass(frozen=True)
class Truth:
    """True values of a task's policies, in environment units.

    Attributes:
        values: policy -> V(pi), the mean discounted return over `episodes` roll-outs of at most `horizon` steps, or the
            exact value, where `episodes` is 0.
        standard_errors: policy -> standard error of that mean; 0 for exact values.
        standard_deviations: policy -> standard deviation of the discounted returns (NaN for exact values).
        gamma: the discount.
        horizon: number of steps that count; `None` for endless.
        episodes: number of roll-outs a policy, the same seeds for every policy; 0 for exact values.
        versions: library -> version that the roll-outs were made with.
        command: what makes them again.
        note: what a reader must know of them (as which reward they count).
    """

    values: Mapping[str, float]
    standard_errors: Mapping[str, float]
    standard_deviations: Mapping[str, float]
    gamma: float
    horizon: int | None
    episodes: int
    versions: Mapping[str, str]
    command: str
    note: str = ""

    def __post_init__(self) -> None:
        for name in ("values", "standard_errors", "standard_deviations", "versions"):
            object.__setattr__(self, name, MappingProxyType(dict(getattr(self, name))))
        if not set(self.values) == set(self.standard_errors) == set(self.standard_deviations):
            raise InvalidDataError("A Truth has a value, a standard error and a standard deviation for each policy.")

    def __reduce__(self) -> tuple[type[Truth], tuple[Any, ...]]:
        """Return plain parts: views of mappings can be neither pickled nor copied."""
        parts = (getattr(self, each.name) for each in fields(self))
        return Truth, tuple(dict(part) if isinstance(part, Mapping) else part for part in parts)


def discounted_returns(rewards: FloatArray, gamma: float) -> FloatArray:
    """Return sum_t gamma^t r_t of each row of (n, T) rewards that are 0 after an episode's end, (n,).

    >>> discounted_returns(np.array([[1.0, 2.0], [4.0, 0.0]]), 0.5).tolist()
    [2.0, 4.0]
    """
    return rewards @ gamma ** np.arange(rewards.shape[1])


def stored_truth(
    rewards: Mapping[str, FloatArray], *, horizon: int, command: str, note: str = "", gammas: Sequence[float] = GAMMAS
) -> dict[str, Any]:
    """Return what a truth file holds: mean, deviation and standard error of each policy and discount.

    Args:
        rewards: policy -> rewards (episodes, horizon) of its roll-outs, 0 after an episode's end.
        horizon: number of steps.
        command: what makes the file again.
        note: what a reader must know.
        gammas: the discounts to store.

    Raises:
        InvalidDataError: for rewards of unequal shapes, of fewer than two episodes, or not finite.
    """
    shapes = {array.shape for array in rewards.values()}
    if len(shapes) != 1 or len(shape := next(iter(shapes))) != 2 or shape[0] < 2 or shape[1] != horizon:
        raise InvalidDataError(f"Rewards must be (episodes, {horizon}) alike, two episodes or more; got {shapes}.")
    if not all(np.isfinite(array).all() for array in rewards.values()):
        raise InvalidDataError("Roll-outs gave rewards that are not finite.")
    return {
        "horizon": horizon,
        "episodes": shape[0],
        "versions": installed_versions(),
        "command": command,
        "note": note,
        "values": {
            str(float(gamma)): {name: _moments(array, gamma) for name, array in rewards.items()} for gamma in gammas
        },
    }


def write_truth(path: Path, stored: Mapping[str, Any]) -> None:
    """Write a truth file (JSON), atomically."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, (json.dumps(stored, indent=1) + "\n").encode())


def read_truth(task: str, *, gamma: float) -> Truth:
    """Return the stored truth of a task (`datasets/truth/TASK.json`) at a discount.

    Raises:
        DatasetNotFoundError: if the installation lacks the file.
        ConfigurationError: for a discount that is not stored; the message names the command that would store it.
    """
    stored = json.loads(embedded_file(f"truth/{task}.json").read_text())
    rows = stored["values"].get(str(float(gamma)))
    if rows is None:
        raise ConfigurationError(
            f"True values of {task!r} are stored for gamma in {', '.join(stored['values'])}, not {gamma}. "
            f"`{stored['command']}` makes them from roll-outs; add the discount to oat_gym.domains.truth.GAMMAS."
        )
    return Truth(
        values={name: row["mean"] for name, row in rows.items()},
        standard_errors={name: row["standard_error"] for name, row in rows.items()},
        standard_deviations={name: row["standard_deviation"] for name, row in rows.items()},
        gamma=float(gamma),
        **{name: stored[name] for name in ("horizon", "episodes", "versions", "command", "note")},
    )


def exact_truth(
    values: Mapping[str, float], *, gamma: float, horizon: int | None, command: str, note: str = ""
) -> Truth:
    """Return the Truth of values that were computed, not sampled."""
    return Truth(
        values=values,
        standard_errors=dict.fromkeys(values, 0.0),
        standard_deviations=dict.fromkeys(values, float("nan")),
        gamma=gamma,
        horizon=horizon,
        episodes=0,
        versions=installed_versions(),
        command=command,
        note=note,
    )


def installed_versions() -> dict[str, str]:
    """Return the versions of Python and of the libraries that roll-outs depend on."""
    return {"python": platform.python_version()} | {name: metadata.version(name) for name in _VERSIONED}


def _moments(rewards: FloatArray, gamma: float) -> dict[str, float]:
    returns = discounted_returns(rewards, gamma)
    deviation = float(returns.std(ddof=1))
    return {
        "mean": float(returns.mean()),
        "standard_deviation": deviation,
        "standard_error": deviation / len(returns) ** 0.5,
    }
