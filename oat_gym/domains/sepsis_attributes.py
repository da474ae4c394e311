"""The 15 attributes of the sepsis task: where CLIF keeps them, their units, plausible range, and how long they hold.

The paper names three of its 15 attributes (heart rate, temperature, creatinine) and says that they were selected by the
diagnostic rules of sepsis (section 3.2, appendix D.1). These 15 are what the rules of `sepsis_stages` read, and blood
urea nitrogen, which the authors' earlier septic-shock studies have as well. Bands, another usual one, is no CLIF lab.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

VITALS, LABS, RESPIRATORY, ASSESSMENTS = "vitals", "labs", "respiratory_support", "patient_assessments"


@dataclass(frozen=True)
class Attribute:
    """One attribute.

    Attributes:
        name: its name here.
        unit: unit of its values.
        table: the CLIF table that it is read from.
        category: its category in that table (of `respiratory_support`: the column).
        low: least plausible value; what lies outside low to high is an artefact, and counts as not recorded.
        high: greatest plausible value.
        normal: what is assumed where nothing is known: the usual value of a healthy adult.
        half_life: hours after which half of the belief in a recorded value is left (`sepsis_belief`), somewhat more
            than the usual time between two records.
        spellings: further spellings of the unit that mean the same (labs carry their unit with each value).
    """

    name: str
    unit: str
    table: str
    category: str
    low: float
    high: float
    normal: float
    half_life: float
    spellings: tuple[str, ...] = ()


_COUNT = ("10^3/µL", "10^3/uL", "10*3/µL", "10^9/L", "10*9/L", "K/uL", "K/µL")

ATTRIBUTES = (
    Attribute("heart_rate", "beats/min", VITALS, "heart_rate", 10, 300, 75, 8),
    Attribute("temperature", "degrees C", VITALS, "temp_c", 25, 45, 36.8, 12),
    Attribute("systolic_pressure", "mmHg", VITALS, "sbp", 20, 300, 120, 8),
    Attribute("mean_pressure", "mmHg", VITALS, "map", 10, 250, 85, 8),
    Attribute("respiratory_rate", "breaths/min", VITALS, "respiratory_rate", 1, 80, 16, 8),
    Attribute("oxygen_saturation", "%", VITALS, "spo2", 20, 100, 98, 8),
    Attribute("inspired_oxygen", "fraction", RESPIRATORY, "fio2_set", 0.21, 1, 0.21, 12),
    Attribute("arterial_oxygen", "mmHg", LABS, "po2_arterial", 10, 700, 90, 12),
    Attribute("coma_scale", "points", ASSESSMENTS, "gcs_total", 3, 15, 15, 12),
    Attribute("white_cells", "10*3/uL", LABS, "wbc", 0, 500, 7.5, 48, _COUNT),
    Attribute("platelets", "10*3/uL", LABS, "platelet_count", 0, 2000, 250, 48, _COUNT),
    Attribute("lactate", "mmol/L", LABS, "lactate", 0, 30, 1, 24, ("mEq/L",)),
    Attribute("creatinine", "mg/dL", LABS, "creatinine", 0, 30, 0.9, 48),
    Attribute("urea_nitrogen", "mg/dL", LABS, "bun", 0, 300, 14, 48),
    Attribute("bilirubin", "mg/dL", LABS, "bilirubin_total", 0, 80, 0.6, 48),
)
"""The attributes in the order of the observation's columns."""

NAMES = tuple(attribute.name for attribute in ATTRIBUTES)
"""Their names, in this order."""

COLUMN = {name: column for column, name in enumerate(NAMES)}
"""Name -> column."""


def column_of(values: tuple[float, ...] | list[float]) -> npt.NDArray[np.float64]:
    """Return one number for each attribute as a read-only (15,) array."""
    array = np.array(values, dtype=np.float64)
    array.setflags(write=False)
    return array


LOW = column_of([attribute.low for attribute in ATTRIBUTES])
HIGH = column_of([attribute.high for attribute in ATTRIBUTES])
NORMAL = column_of([attribute.normal for attribute in ATTRIBUTES])
HALF_LIFE = column_of([attribute.half_life for attribute in ATTRIBUTES])
