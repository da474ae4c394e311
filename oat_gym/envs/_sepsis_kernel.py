"""One event of every patient, compiled: the course of the disease, the next time, and what is measured then."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from oat_gym.domains.sepsis_attributes import COLUMN, NAMES
from oat_gym.domains.sepsis_stages import CONSECUTIVE_HOURS, LOW_MEAN, LOW_SYSTOLIC
from oat_gym.envs import _sepsis_calibration as table
from oat_gym.envs import _sepsis_model as m
from oat_gym.envs._sepsis_random import normal, uniform

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

N_ATTRIBUTES = len(NAMES)
_PATHOGEN, _ANTIBIOTIC, _INFLAMMATION, _DAMAGE = m.PATHOGEN, m.ANTIBIOTIC, m.INFLAMMATION, m.DAMAGE
_VASOPLEGIA, _LUNG, _VASOPRESSOR, _HYPOXIA = m.VASOPLEGIA, m.LUNG, m.VASOPRESSOR, m.HYPOXIA
_T_ANTIBIOTIC, _T_INFLAMMATION, _T_DAMAGE = m.HOURS["antibiotic"], m.HOURS["inflammation"], m.HOURS["damage"]
_T_REPAIR, _T_VASOPLEGIA, _T_LUNG = m.HOURS["repair"], m.HOURS["vasoplegia"], m.HOURS["lung"]
_SHOWN = np.array([_INFLAMMATION, _DAMAGE, _VASOPLEGIA, _LUNG, _HYPOXIA, _VASOPRESSOR])
_LOADINGS = m.loadings(NAMES)
_VALUES, _SCORES = np.array(table.VALUE_QUANTILES), np.array(table.SCORE_QUANTILES)
_KINDS, _MEASURED = np.cumsum(table.KIND_SHARES), np.array(table.KIND_MEASURED)
_LEVELS, _GAPS = np.array(table.COUNT_LEVELS), np.array(table.HOURS_BETWEEN_EVENTS)
_EVENTS = np.array(table.EVENTS_PER_VISIT)
_OWN = np.array([COLUMN[m.SHARED_OFFSET.get(name, name)] for name in NAMES])
_MEMORY = np.array(
    [
        m.MEMORY["vital" if column < m.VITALS or name == "coma_scale" else "laboratory"]
        for column, name in enumerate(NAMES)
    ]
)
PRESSURES = np.array([COLUMN["systolic_pressure"], COLUMN["mean_pressure"]])
_LOW = np.array([LOW_SYSTOLIC, LOW_MEAN])

# What a step's random numbers are for.
_KIND, _MASK, _NOISE, _COURSE, _GAP, _SEED, _SEED_SIZE, _DEATH = 0, 1, 16, 31, 34, 35, 36, 37
_ADMISSION, _TRAIT = 40, 55


class Patients(NamedTuple):
    """Columns of n patients, which the functions below change in place.

    Attributes:
        keys: (n,) of their random numbers.
        steps: (n,) events since the first.
        hours: (n,) since the first event.
        treatments: (n, 2) antibiotics and oxygen in effect.
        hidden: (n, 8) the hidden state (`_sepsis_model`).
        traits: (n, 19) what does not change: four traits, and the offsets of attributes.
        values: (n, 15) the last measured values.
        scores: (n, 15) their scores.
        deviations: (n, 15) the deviation within the patient when they were measured.
        ages: (n, 15) hours since then, infinite before the first measurement.
        low: (n, 2) whether the last reading of systolic and mean pressure was low.
        read_at: (n, 2) hour of that reading.
        persistent: (n, 2) whether the pressures are persistently low since then.
    """

    keys: npt.NDArray[np.uint64]
    steps: npt.NDArray[np.int64]
    hours: FloatArray
    treatments: npt.NDArray[np.int8]
    hidden: FloatArray
    traits: FloatArray
    values: FloatArray
    scores: FloatArray
    deviations: FloatArray
    ages: FloatArray
    low: BoolArray
    read_at: FloatArray
    persistent: BoolArray


def empty(n: int) -> Patients:
    """Return the columns of n patients of whom nothing is known."""
    attributes = (n, N_ATTRIBUTES)
    return Patients(
        keys=np.zeros(n, dtype=np.uint64),
        steps=np.zeros(n, dtype=np.int64),
        hours=np.zeros(n),
        treatments=np.zeros((n, 2), dtype=np.int8),
        hidden=np.zeros((n, m.N_HIDDEN)),
        traits=np.zeros((n, m.OFFSET + N_ATTRIBUTES)),
        values=np.zeros(attributes),
        scores=np.zeros(attributes),
        deviations=np.zeros(attributes),
        ages=np.full(attributes, np.inf),
        low=np.zeros((n, 2), dtype=bool),
        read_at=np.full((n, 2), -np.inf),
        persistent=np.zeros((n, 2), dtype=bool),
    )


@njit(nogil=True)
def admit(p: Patients) -> None:
    """Draw traits and the hidden state of patients on admission."""
    for i in range(len(p.keys)):
        key, traits, hidden = p.keys[i], p.traits[i], p.hidden[i]
        for offset in range(N_ATTRIBUTES):
            traits[m.OFFSET + offset] = normal(key, 0, _ADMISSION + offset)
        traits[m.GROWTH] = m.GROWTH_RATE * math.exp(m.GROWTH_SPREAD * normal(key, 0, _TRAIT))
        resistant = uniform(key, 0, _TRAIT + 1) < m.RESISTANT_SHARE
        traits[m.SUSCEPTIBILITY] = m.RESISTANT_KILL if resistant else 1.0
        traits[m.CHRONIC_LUNG] = m.CHRONIC_LUNG_SPREAD * abs(normal(key, 0, _TRAIT + 2))
        traits[m.PLANNED_EVENTS] = math.floor(np.interp(uniform(key, 0, _TRAIT + 3), _LEVELS, _EVENTS))
        severity = uniform(key, 0, _TRAIT + 4)
        hidden[_PATHOGEN] = m.FIRST_PATHOGEN * math.exp(m.FIRST_PATHOGEN_RISE * severity)
        hidden[_INFLAMMATION] = m.FIRST_INFLAMMATION + m.FIRST_INFLAMMATION_RISE * severity
        hidden[_DAMAGE] = m.FIRST_DAMAGE * severity * uniform(key, 0, _TRAIT + 5)
        hidden[_VASOPLEGIA] = m.FIRST_VASOPLEGIA * severity
        hidden[_LUNG] = traits[m.CHRONIC_LUNG] + m.FIRST_LUNG * severity
        hidden[_HYPOXIA] = max(0.0, hidden[_LUNG] - m.TOLERATED_LUNG)


@njit(nogil=True)
def course(p: Patients) -> BoolArray:
    """Move patients to their next events under the treatments in effect; return who dies on the way, (n,)."""
    died = np.zeros(len(p.keys), dtype=np.bool_)
    for i in range(len(p.keys)):
        p.steps[i] += 1
        key, step = p.keys[i], p.steps[i]
        dt = np.interp(uniform(key, step, _GAP), _LEVELS, _GAPS)
        p.hours[i] += dt
        for j in range(N_ATTRIBUTES):
            p.ages[i, j] += dt
        _infection(p, i, dt)
        _body(p, i, dt)
        hazard = m.DEATH_RATE * max(0.0, p.hidden[i, _DAMAGE] - m.DEATH_FROM)
        died[i] = uniform(key, step, _DEATH) < 1.0 - math.exp(-hazard * dt)
    return died


@njit(nogil=True)
def _toward(level: float, target: float, dt: float, tau: float) -> float:
    """Return the solution of d level / dt = (target - level) / tau after dt."""
    return target + (level - target) * math.exp(-dt / tau)


@njit(nogil=True)
def _noisy(level: float, target: float, dt: float, tau: float, draw: float) -> float:
    """Return a step of the Ornstein-Uhlenbeck process about `target`, not below zero."""
    spread = m.NOISE * math.sqrt(1.0 - math.exp(-2.0 * dt / tau))
    return max(0.0, _toward(level, target, dt, tau) + spread * draw)


@njit(nogil=True)
def _infection(p: Patients, i: int, dt: float) -> None:
    """Antibiotic level, then logistic growth of the pathogen at the rate that is left, solved exactly."""
    state, key, step = p.hidden[i], p.keys[i], p.steps[i]
    state[_ANTIBIOTIC] = _toward(state[_ANTIBIOTIC], float(p.treatments[i, 0]), dt, _T_ANTIBIOTIC)
    killed = m.KILL_RATE * p.traits[i, m.SUSCEPTIBILITY] * state[_ANTIBIOTIC] + m.IMMUNE_RATE * state[_INFLAMMATION]
    rate = p.traits[i, m.GROWTH] - killed
    factor = math.exp(min(rate * dt, 30.0))
    load = state[_PATHOGEN] * factor
    if rate > 0.0:
        load /= 1.0 + state[_PATHOGEN] * (factor - 1.0)
    if uniform(key, step, _SEED) < 1.0 - math.exp(-m.NEW_INFECTION_RATE * dt):
        load += m.NEW_INFECTION_SIZE * uniform(key, step, _SEED_SIZE)
    state[_PATHOGEN] = min(max(load, m.LEAST_PATHOGEN), 1.0)


@njit(nogil=True)
def _body(p: Patients, i: int, dt: float) -> None:
    """Inflammation, lung, vessels and organs, each following those before it."""
    state, key, step, oxygen = p.hidden[i], p.keys[i], p.steps[i], float(p.treatments[i, 1])
    drive = state[_PATHOGEN] / (state[_PATHOGEN] + m.HALF_RESPONSE) + m.DAMAGE_TO_INFLAMMATION * state[_DAMAGE]
    state[_INFLAMMATION] = _noisy(state[_INFLAMMATION], drive, dt, _T_INFLAMMATION, normal(key, step, _COURSE))
    excess = max(0.0, state[_INFLAMMATION] - m.TOLERATED_INFLAMMATION)
    lung = p.traits[i, m.CHRONIC_LUNG] + m.INFLAMMATION_TO_LUNG * state[_INFLAMMATION]
    lung += m.DAMAGE_TO_LUNG * state[_DAMAGE]
    state[_LUNG] = _noisy(state[_LUNG], lung, dt, _T_LUNG, normal(key, step, _COURSE + 1))
    lacking = state[_LUNG] - m.TOLERATED_LUNG
    state[_HYPOXIA] = max(0.0, lacking - m.OXYGEN_RELIEF * oxygen)
    tone = m.INFLAMMATION_TO_VASOPLEGIA * excess + m.DAMAGE_TO_VASOPLEGIA * state[_DAMAGE]
    state[_VASOPLEGIA] = _noisy(state[_VASOPLEGIA], tone, dt, _T_VASOPLEGIA, normal(key, step, _COURSE + 2))
    on = state[_VASOPLEGIA] > (m.VASOPRESSOR_OFF if state[_VASOPRESSOR] > 0.0 else m.VASOPRESSOR_ON)
    state[_VASOPRESSOR] = 1.0 if on else 0.0
    harm = m.INFLAMMATION_TO_DAMAGE * excess + m.HYPOXIA_TO_DAMAGE * state[_HYPOXIA]
    harm += m.VASOPLEGIA_TO_DAMAGE * max(0.0, state[_VASOPLEGIA] - m.TOLERATED_VASOPLEGIA)
    harm += m.TOXICITY * state[_ANTIBIOTIC]
    if oxygen > 0.0 and lacking < 0.0:
        harm += m.HYPEROXIA
    state[_DAMAGE] = _toward(state[_DAMAGE], harm, dt, _T_DAMAGE if harm > state[_DAMAGE] else _T_REPAIR)


@njit(nogil=True)
def measure(p: Patients) -> None:
    """Measure what the events measure: `values`, `scores` and `deviations` change where `ages` become 0.

    Deviations within a patient are an Ornstein-Uhlenbeck process that is looked at when it is measured.
    """
    for i in range(len(p.keys)):
        key, step = p.keys[i], p.steps[i]
        kind = min(int(np.searchsorted(_KINDS, uniform(key, step, _KIND))), len(_KINDS) - 1)
        for j in range(N_ATTRIBUTES):
            if uniform(key, step, _MASK + j) >= _MEASURED[kind, j]:
                continue
            kept = math.exp(-p.ages[i, j] / _MEMORY[j])
            fresh = math.sqrt(1.0 - kept * kept) * normal(key, step, _NOISE + j)
            p.deviations[i, j] = kept * p.deviations[i, j] + fresh
            p.scores[i, j] = _score(p, i, j)
            p.values[i, j] = np.interp(p.scores[i, j], _SCORES[j], _VALUES[j])
            p.ages[i, j] = 0.0
    _follow_pressure(p)


@njit(nogil=True)
def _score(p: Patients, i: int, j: int) -> float:
    """Return what ranks the value of attribute j: offset, deviation, and what shows of the hidden state."""
    score = m.BETWEEN_PATIENTS * p.traits[i, m.OFFSET + _OWN[j]] + m.WITHIN_PATIENT * p.deviations[i, j]
    for column in range(len(_SHOWN)):
        score += _LOADINGS[j, column] * p.hidden[i, _SHOWN[column]]
    return score + _LOADINGS[j, len(_SHOWN)] * p.treatments[i, 1]


@njit(nogil=True)
def _follow_pressure(p: Patients) -> None:
    """Update whether the pressures are persistently low: `sepsis_stages.persistent`, event by event."""
    for i in range(len(p.keys)):
        for k in range(2):
            j = PRESSURES[k]
            if p.ages[i, j] > 0.0:
                continue
            low = p.values[i, j] < _LOW[k]
            close = p.hours[i] - p.read_at[i, k] <= CONSECUTIVE_HOURS + 1e-9
            p.persistent[i, k] = low and (p.persistent[i, k] or (p.low[i, k] and close))
            p.low[i, k], p.read_at[i, k] = low, p.hours[i]
