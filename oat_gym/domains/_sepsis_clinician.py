"""A clinician's policy for `oat_gym/Sepsis-v0`: keeps what runs, and starts or stops it by the signs at the bedside."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from oat_gym.domains.sepsis_attributes import COLUMN
from oat_gym.errors import ConfigurationError
from oat_gym.ope.policies import CategoricalPolicy
from oat_gym.spaces import Batch

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Clinician(CategoricalPolicy):
    """Antibiotics and oxygen assistance, each decided by a logistic rule of what is believed of the patient.

    The log-odds of giving antibiotics rise with fever, white cells, heart rate and lactate; those of giving oxygen with
    breathing rate, inspired oxygen, lactate and a low saturation. What is in effect stays in effect most of the time.

    Args:
        antibiotics: log-odds of giving antibiotics to a patient without signs.
        oxygen: the same of oxygen assistance.
        inertia: how much the log-odds are higher for a treatment in effect, and lower for another one.
        attention: factor of the signs; 0 is a clinician who does not look.

    Raises:
        ConfigurationError: for settings that are not finite.

    >>> well = {"values": np.array([[75, 36.8, 120, 85, 16, 98, 0.21, 90, 15, 7.5, 250, 1, 0.9, 14, 0.6]]),
    ...         "treatments": np.array([[0, 0]])}
    >>> Clinician().probabilities(well).argmax(axis=1).tolist()
    [0]
    """

    antibiotics: float = -0.3
    oxygen: float = -0.6
    inertia: float = 4.0
    attention: float = 1.0

    def __post_init__(self) -> None:
        settings = (self.antibiotics, self.oxygen, self.inertia, self.attention)
        if not np.isfinite(settings).all():
            raise ConfigurationError(f"The settings of a Clinician must be finite, got {settings}.")

    def probabilities(self, observations: Batch) -> FloatArray:
        """Return pi(a|s) of none, antibiotics, oxygen and both, (n, 4)."""
        running = 2.0 * np.asarray(observations["treatments"], dtype=np.float64) - 1.0
        infected, breathless = _signs(np.asarray(observations["values"], dtype=np.float64))
        antibiotics = _logistic(self.antibiotics + self.attention * infected + self.inertia * running[:, 0])
        oxygen = _logistic(self.oxygen + self.attention * breathless + self.inertia * running[:, 1])
        without, given = np.stack([1 - antibiotics, antibiotics], axis=1), np.stack([1 - oxygen, oxygen], axis=1)
        return (given[:, :, None] * without[:, None, :]).reshape(-1, 4)


def _signs(values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return how much speaks for an infection and for lack of oxygen, (n,) each, about 0 to 5."""
    infected = (
        1.2 * np.clip(values[:, COLUMN["temperature"]] - 37.2, 0.0, 2.0)
        + np.clip((values[:, COLUMN["white_cells"]] - 9.0) / 5.0, 0.0, 1.5)
        + np.clip((values[:, COLUMN["heart_rate"]] - 85.0) / 20.0, 0.0, 1.5)
        + 0.5 * np.clip(values[:, COLUMN["lactate"]] - 1.0, 0.0, 2.0)
    )
    breathless = (
        0.5 * np.clip(97.0 - values[:, COLUMN["oxygen_saturation"]], 0.0, 5.0)
        + np.clip((values[:, COLUMN["respiratory_rate"]] - 17.0) / 5.0, 0.0, 1.5)
        + 3.0 * np.clip(values[:, COLUMN["inspired_oxygen"]] - 0.21, 0.0, 0.4)
        + 0.5 * np.clip(values[:, COLUMN["lactate"]] - 1.0, 0.0, 2.0)
    )
    return infected, breathless


def _logistic(odds: FloatArray) -> FloatArray:
    return 1.0 / (1.0 + np.exp(-odds))
