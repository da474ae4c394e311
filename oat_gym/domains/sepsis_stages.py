"""The four stages of sepsis, and the rewards of entering and leaving them (paper, section 3.2 and appendix D.1).

The paper's clinicians defined infection, inflammation, organ failure and septic shock (after Delano and Ward, 2016);
their rules are published for shock only. The others are the usual definitions, stated in `stages`. Every rule reads
the past and the present only.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from oat_gym.domains.sepsis_attributes import COLUMN, HALF_LIFE

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

STAGES = ("none", "infection", "inflammation", "organ failure", "septic shock")
"""What stage 0 to 4 mean."""
PENALTIES = (0.0, 5.0, 10.0, 20.0, 50.0)
"""What entering each stage costs, and leaving it gives back."""
SHOCK = 4
CONSECUTIVE_HOURS = 0.5
"""Two hypotensive readings at most this far apart are persistent hypotension."""
LOW_SYSTOLIC, LOW_MEAN = 90.0, 65.0


def stages(current: FloatArray, shock: BoolArray) -> IntArray:
    """Return the stage (0 to 4) at each of N events: the worst one whose rule holds.

    1. *Infection*: temperature above 38 or below 36 degrees C, or white cells above 12 or below 4 thousand per uL.
       An antibiotic is no sign of it here: it is an action, and a policy must not be charged for treating.
    2. *Inflammation*: two or more of the SIRS criteria: that temperature, those white cells, heart rate above 90,
       respiratory rate above 20 (Bone et al., 1992).
    3. *Organ failure*: any organ at two SOFA points or more (Singer et al., 2016): creatinine or bilirubin of 2 mg/dL
       or more, platelets below 100 thousand per uL, coma scale of 12 or less, PaO2/FiO2 below 300 mmHg (FiO2 0.21
       where none is set); or lactate above 2 mmol/L, saturation below 90%, systolic pressure below 90 or mean pressure
       below 65 mmHg.
    4. *Septic shock*: see `pressure_shock`, or any vasopressor.

    Args:
        current: (N, 15) values in the order of `sepsis_attributes.NAMES`, NaN where nothing is known.
        shock: (N,) whether the patient is in shock.
    """
    signs = sirs_criteria(current)
    infection, inflammation = signs[:, :2].any(axis=1), signs.sum(axis=1) >= 2
    result = np.where(inflammation, 2, infection.astype(np.int64))
    return np.where(shock, SHOCK, np.where(organ_failure(current), 3, result))


def sirs_criteria(current: FloatArray) -> BoolArray:
    """Return (N, 4) booleans: abnormal temperature, abnormal white cells, fast heart, fast breath."""
    temperature, cells = _column(current, "temperature"), _column(current, "white_cells")
    return np.stack(
        [
            (temperature > 38.0) | (temperature < 36.0),
            (cells > 12.0) | (cells < 4.0),
            _column(current, "heart_rate") > 90.0,
            _column(current, "respiratory_rate") > 20.0,
        ],
        axis=1,
    )


def organ_failure(current: FloatArray) -> BoolArray:
    """Return (N,) whether any organ fails (rule 3 of `stages`); what is not known fails nothing."""
    oxygen = _column(current, "inspired_oxygen")
    ratio = _column(current, "arterial_oxygen") / np.where(np.isnan(oxygen), 0.21, oxygen)
    return (
        (_column(current, "creatinine") >= 2.0)
        | (_column(current, "bilirubin") >= 2.0)
        | (_column(current, "platelets") < 100.0)
        | (_column(current, "coma_scale") <= 12.0)
        | (ratio < 300.0)
        | (_column(current, "lactate") > 2.0)
        | (_column(current, "oxygen_saturation") < 90.0)
        | (_column(current, "systolic_pressure") < LOW_SYSTOLIC)
        | (_column(current, "mean_pressure") < LOW_MEAN)
    )


def pressure_shock(recorded: FloatArray, hours: FloatArray) -> BoolArray:
    """Return (N,) whether the patient is in shock by blood pressure at each event.

    Shock begins with the second of two consecutive readings of one kind, at most 30 minutes apart, that are both low
    (systolic below 90, or mean below 65 mmHg), and lasts until a reading of that kind that is not low, or until the
    last one is older than the half-life of the attribute. The paper's third sign, a fall of the systolic pressure by
    40 mmHg within 8 hours, is left out: in intensive care it is met by treating a high pressure.

    Args:
        recorded: (N, 15) values, NaN where nothing was recorded.
        hours: (N,) times in hours.
    """
    kinds = (("systolic_pressure", LOW_SYSTOLIC), ("mean_pressure", LOW_MEAN))
    parts = [
        persistent(_column(recorded, name), hours, limit=limit, holds=float(HALF_LIFE[COLUMN[name]]))
        for name, limit in kinds
    ]
    return parts[0] | parts[1]


def persistent(readings: FloatArray, hours: FloatArray, *, limit: float, holds: float) -> BoolArray:
    """Return (N,) whether readings are persistently below `limit` (see `pressure_shock`); NaN is no reading.

    >>> hours = np.array([0.0, 0.4, 0.8, 1.0, 9.0, 9.4])
    >>> persistent(np.array([80.0, 85.0, np.nan, 95.0, 80.0, np.nan]), hours, limit=90.0, holds=8.0).tolist()
    [False, True, True, False, False, False]
    """
    at = np.flatnonzero(~np.isnan(readings))
    low = readings[at] < limit
    pair = np.zeros(len(at), dtype=bool)
    pair[1:] = low[1:] & low[:-1] & (np.diff(hours[at]) <= CONSECUTIVE_HOURS + 1e-9)
    # In shock at a reading: a pair has occurred since the last reading that was not low.
    order = np.arange(len(at))
    last_pair = np.maximum.accumulate(np.where(pair, order, -1)) if len(at) else order
    last_fine = np.maximum.accumulate(np.where(~low, order, -1)) if len(at) else order
    on = last_pair > last_fine
    latest = np.searchsorted(at, np.arange(len(readings)), side="right") - 1
    known = latest >= 0
    rows = at[latest[known]]
    result = np.zeros(len(readings), dtype=bool)
    result[known] = on[latest[known]] & (hours[known] - hours[rows] <= holds)
    return result


def rewards(stage: IntArray) -> FloatArray:
    """Return the (N-1,) rewards between N events, Phi(next) - Phi(stage), Phi minus the penalties up to a stage.

    Getting worse by one stage costs that stage's penalty, getting better gives it back, and a jump counts all the
    stages on the way. So what a visit earns is Phi(last) - Phi(first), whatever the path.

    >>> rewards(np.array([0, 1, 3, 4, 2, 0])).tolist()
    [-5.0, -30.0, -50.0, 70.0, 15.0]
    """
    potential = -np.cumsum(PENALTIES)
    return np.diff(potential[stage])


def _column(values: FloatArray, name: str) -> FloatArray:
    return values[:, COLUMN[name]]
