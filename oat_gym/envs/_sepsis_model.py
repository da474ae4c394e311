"""The patient of `oat_gym/Sepsis-v0`: constants of the hidden course of the disease, and how it shows.

The course is a reduced model of acute inflammation, after Kumar et al., "The dynamics of acute inflammation" (J. Theor.
Biol. 230, 2004) and Reynolds et al., "A reduced mathematical model of the acute inflammatory response" (J. Theor. Biol.
242, 2006): a pathogen grows logistically and is killed by the immune response and by antibiotics; it drives
inflammation; inflammation damages organs; damage feeds inflammation back. Three parts are added. Vasoplegia: inflamed
and damaged vessels lose their tone, which vasopressors, given by a fixed protocol, make up for in part. Lung injury:
what it lacks in oxygen, and oxygen assistance does not give, damages organs as well. Harm by treatment: antibiotics
are slightly toxic to the kidney (acute kidney injury under antibiotics: Patek et al., Clin. Kidney J. 13, 2020), and
oxygen that is not needed harms (hyperoxia in septic shock: Asfar et al., HYPERS2S, Lancet Respir. Med. 5, 2017). So
treating at once is better than late (Kumar et al., Crit. Care Med. 34, 2006), and treating for ever is not best.

All levels are without unit, about 0 to 1. They are chosen, not estimated: directions are clinical, sizes were set so
that a clinician's policy gives stages as frequent as in the real tables. The measured attributes' marginals, times and
missing patterns are those of the tables (`_sepsis_calibration`).
"""

from __future__ import annotations

import numpy as np

# Columns of a patient's hidden state.
PATHOGEN, ANTIBIOTIC, INFLAMMATION, DAMAGE, VASOPLEGIA, LUNG, VASOPRESSOR, HYPOXIA = range(8)
N_HIDDEN = 8

# Columns of a patient's traits, drawn on admission; the 15 offsets of attributes follow.
GROWTH, SUSCEPTIBILITY, CHRONIC_LUNG, PLANNED_EVENTS = range(4)
OFFSET = 4

HOURS = {"antibiotic": 5.0, "inflammation": 9.0, "damage": 22.0, "repair": 45.0, "vasoplegia": 5.0, "lung": 12.0}
"""Time constants in hours; organs are damaged twice as fast as they are repaired."""

GROWTH_RATE, GROWTH_SPREAD = 0.075, 0.35  # pathogen, per hour; log-normal over patients
KILL_RATE, RESISTANT_SHARE, RESISTANT_KILL = 0.22, 0.12, 0.5  # by antibiotics, per hour; of resistant strains, a factor
IMMUNE_RATE = 0.035  # killing by a full inflammatory response, per hour
NEW_INFECTION_RATE, NEW_INFECTION_SIZE = 1 / 140.0, 0.12  # hospital-acquired ones, per hour
LEAST_PATHOGEN = 1e-4

HALF_RESPONSE = 0.22  # pathogen that drives half of the greatest inflammation
DAMAGE_TO_INFLAMMATION = 0.35
TOLERATED_INFLAMMATION = 0.3  # inflammation up to here harms nothing
INFLAMMATION_TO_DAMAGE, HYPOXIA_TO_DAMAGE, VASOPLEGIA_TO_DAMAGE = 1.1, 1.3, 0.4
TOXICITY, HYPEROXIA = 0.26, 0.20  # of antibiotics, and of oxygen without need, on organs
INFLAMMATION_TO_VASOPLEGIA, DAMAGE_TO_VASOPLEGIA = 0.75, 0.45
INFLAMMATION_TO_LUNG, DAMAGE_TO_LUNG, CHRONIC_LUNG_SPREAD = 0.6, 0.25, 0.22
TOLERATED_VASOPLEGIA = 0.42  # vasoplegia up to here harms no organ
TOLERATED_LUNG, OXYGEN_RELIEF = 0.28, 0.45  # lung injury without hypoxia; more of it that oxygen makes up for
FIRST_PATHOGEN, FIRST_PATHOGEN_RISE = 0.02, 3.4  # on admission: least, and exponent of the patient's severity (0 to 1)
FIRST_INFLAMMATION, FIRST_INFLAMMATION_RISE = 0.15, 0.45  # least, and more by severity
FIRST_DAMAGE, FIRST_VASOPLEGIA, FIRST_LUNG = 0.30, 0.40, 0.20  # by severity
NOISE = 0.09  # stationary standard deviation of inflammation, vasoplegia and lung injury about their course

VASOPRESSOR_ON, VASOPRESSOR_OFF = 0.46, 0.24  # vasoplegia where the protocol starts and stops the vasopressor
DEATH_FROM, DEATH_RATE = 0.70, 0.03  # damage beyond which patients die, and how often, per hour and unit beyond

SHOWN = ("inflammation", "damage", "vasoplegia", "lung", "hypoxia", "vasopressor", "oxygen")
"""What attributes depend on: hidden levels, whether a vasopressor runs, and the oxygen given."""

#                                     infl  dam   vaso  lung  hyp   press oxy
LOADINGS = {
    "heart_rate": (2.4, 0.4, 1.0, 0.0, 0.8, 0.0, 0.0),
    "temperature": (2.2, -0.8, 0.0, 0.0, 0.0, 0.0, 0.0),
    "systolic_pressure": (-0.3, -0.2, -2.6, 0.0, 0.0, 0.5, 0.0),
    "mean_pressure": (-0.3, -0.2, -2.8, 0.0, 0.0, 0.6, 0.0),
    "respiratory_rate": (1.4, 0.2, 0.0, 1.2, 1.0, 0.0, 0.0),
    "oxygen_saturation": (0.0, 0.0, 0.0, -0.8, -3.2, 0.0, 0.2),
    "inspired_oxygen": (0.0, 0.2, 0.0, 1.6, 0.4, 0.0, 0.9),
    "arterial_oxygen": (0.0, 0.0, 0.0, -1.6, -1.2, 0.0, 0.5),
    "coma_scale": (-0.4, -1.8, -0.6, 0.0, -1.0, 0.0, 0.0),
    "white_cells": (2.4, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    "platelets": (-0.4, -2.2, 0.0, 0.0, 0.0, 0.0, 0.0),
    "lactate": (0.4, 1.2, 1.8, 0.0, 1.0, 0.3, 0.0),
    "creatinine": (0.0, 2.6, 0.4, 0.0, 0.0, 0.0, 0.0),
    "urea_nitrogen": (0.0, 2.4, 0.2, 0.0, 0.0, 0.0, 0.0),
    "bilirubin": (0.2, 2.0, 0.0, 0.0, 0.3, 0.0, 0.0),
}
"""How an attribute's score rises with each of `SHOWN`; the score's rank is the rank of the attribute's value."""

BETWEEN_PATIENTS, WITHIN_PATIENT = 0.7, 0.5
"""Standard deviations of an attribute's score that the disease does not explain."""
MEMORY = {"vital": 2.0, "laboratory": 24.0}
"""Hours after which the deviation within a patient is forgotten to 1/e."""
VITALS = 6  # the first attributes, measured at the bedside; also the coma scale
SHARED_OFFSET = {"mean_pressure": "systolic_pressure", "urea_nitrogen": "creatinine"}
"""Attributes whose deviation between patients is that of another."""


def loadings(names: tuple[str, ...]) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """Return `LOADINGS` in the order of names, (15, 7)."""
    return np.array([LOADINGS[name] for name in names])
