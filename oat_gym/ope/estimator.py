"""What an estimator is: a frozen configuration that turns a problem and seeds into estimates for all policies."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from oat_gym.ope.problem import Problem

FloatArray = npt.NDArray[np.float64]
Diagnostics = Mapping[str, float]
"""Numbers that say how far an estimate can be trusted, by name."""


@dataclass(frozen=True)
class Estimates:
    """The estimates of one run for P policies.

    `values` (P,) are discounted returns from the initial states in environment units. `replicates` (P, B) are the
    same estimates on the B bootstrap resamples of the source episodes (`Problem.resamples`), from which errors and
    intervals come. `diagnostics` holds a mapping for each policy.
    """

    values: FloatArray
    replicates: FloatArray
    diagnostics: tuple[Diagnostics, ...]


@dataclass(frozen=True)
class Estimator(ABC):
    """Base of all estimators: a frozen dataclass, validated when it is made."""

    @property
    @abstractmethod
    def name(self) -> str:
        """The name in results; it tells apart the forms of one family ("IS per-decision weighted")."""

    family: ClassVar[str]
    """"FQE", "IS", "DICE", "DR" or "MB": the paper's five families."""

    @abstractmethod
    def estimate(self, problem: Problem, *, seeds: tuple[int, ...]) -> tuple[Estimates, ...]:
        """Return the estimates of all policies for each seed; a seed's result does not depend on the other seeds.

        Raises an `OatGymError` where it cannot work, and warns (`EstimationWarning`) where its result is not to be
        trusted.
        """

    def check(self, problem: Problem) -> None:  # noqa: B027  (most estimators take every problem)
        """Raise an `OatGymError` where the problem rules the estimator out, before any work."""
