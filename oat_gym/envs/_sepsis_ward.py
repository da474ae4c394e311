"""Patients as columns of numbers: what `SepsisEnv` and `SepsisVectorEnv` share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from oat_gym.domains.sepsis_attributes import HALF_LIFE, HIGH, LOW
from oat_gym.domains.sepsis_belief import LastKnown, believed_values, current_values
from oat_gym.domains.sepsis_stages import PENALTIES, SHOCK, stages
from oat_gym.envs import _sepsis_model as model
from oat_gym.envs._sepsis_kernel import PRESSURES, admit, course, empty, measure
from oat_gym.errors import ConfigurationError

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]
IntArray = npt.NDArray[np.int64]

_POTENTIAL = -np.cumsum(PENALTIES)
_LOW, _HIGH = LOW.astype(np.float32), HIGH.astype(np.float32)


@dataclass(frozen=True)
class Outcome:
    """What came of n treatments: rewards (n,), and whether the stay ended (died or discharged) or was cut off."""

    rewards: FloatArray
    terminated: BoolArray
    truncated: BoolArray


class Ward:
    """n beds. A patient's course depends on their key and treatments only, not on who lies beside them."""

    def __init__(self, beds: int, *, horizon: int) -> None:
        """Make empty beds.

        Raises:
            ConfigurationError: for a horizon below 1.
        """
        if horizon < 1:
            raise ConfigurationError(f"horizon must be at least 1, got {horizon}.")
        self.horizon = horizon
        self.patients = empty(beds)
        self.died = np.zeros(beds, dtype=bool)
        self.stage = np.zeros(beds, dtype=np.int64)

    def admit(self, rows: IntArray, keys: npt.NDArray[np.uint64]) -> None:
        """Put new patients, known by their keys, into the beds `rows`, and measure them for the first time."""
        if not len(rows):
            return
        new = Ward(len(rows), horizon=self.horizon)
        new.patients.keys[:] = keys
        admit(new.patients)
        new._look()
        for column, fresh in zip(self.patients, new.patients, strict=True):
            column[rows] = fresh
        self.stage[rows], self.died[rows] = new.stage, False

    def treat(self, actions: IntArray, going_on: BoolArray) -> Outcome:
        """Treat the patients who are `going_on` (n,) until their next events; the others' numbers mean nothing."""
        before = self.stage
        self.patients.treatments[:] = np.stack([actions % 2, actions // 2], axis=1)
        self.died = course(self.patients) & going_on
        self._look()
        rewards = np.where(going_on, _POTENTIAL[self.stage] - _POTENTIAL[before], 0.0)
        complete = self.patients.steps + 1 >= self.patients.traits[:, model.PLANNED_EVENTS]
        terminated = going_on & (self.died | (complete & (self.stage < SHOCK)))
        return Outcome(rewards, terminated, going_on & ~terminated & (self.patients.steps >= self.horizon))

    def observations(self) -> dict[str, npt.NDArray[Any]]:
        """Return `OBSERVATION_SPACE`, batched, as arrays of the caller's own."""
        values = believed_values(self._known()).astype(np.float32)
        return {
            "recorded": (self.patients.ages == 0).astype(np.int8),
            "treatments": self.patients.treatments.copy(),
            "values": np.clip(values, _LOW, _HIGH),  # rounding to float32 may pass a bound
        }

    def infos(self) -> dict[str, npt.NDArray[Any]]:
        """Return time (hours since admission), stage and death of each patient, as arrays of the caller's own."""
        return {"time": self.patients.hours.copy(), "stage": self.stage.copy(), "died": self.died.copy()}

    def _look(self) -> None:
        """Measure what the event measures, and find the stage."""
        measure(self.patients)
        hours, read_at = self.patients.hours, self.patients.read_at
        fresh = hours[:, None] - read_at <= HALF_LIFE[PRESSURES]
        shock = (self.patients.persistent & fresh).any(axis=1) | (self.patients.hidden[:, model.VASOPRESSOR] > 0)
        self.stage = stages(current_values(self._known()), shock | self.died)

    def _known(self) -> LastKnown:
        ages = self.patients.ages
        return LastKnown(np.where(np.isinf(ages), np.nan, self.patients.values), ages)
