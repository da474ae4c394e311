"""The rules of sepsis against hand cases and plain loops: belief, stages, rewards."""

import doctest
from itertools import pairwise

import numpy as np
import pytest

from oat_gym.domains import sepsis, sepsis_belief, sepsis_clif, sepsis_stages
from oat_gym.domains.sepsis_attributes import ATTRIBUTES, COLUMN, HALF_LIFE, HIGH, LOW, NAMES, NORMAL
from oat_gym.domains.sepsis_stages import PENALTIES, STAGES, persistent, pressure_shock, rewards, stages


@pytest.mark.parametrize("module", [sepsis, sepsis_belief, sepsis_clif, sepsis_stages])
def test_examples_in_docstrings(module):
    assert doctest.testmod(module).failed == 0


def patient(**values: float) -> np.ndarray:
    row = np.full((1, len(NAMES)), np.nan)
    for name, value in values.items():
        row[0, COLUMN[name]] = value
    return row


def gappy(rng: np.random.Generator, events: int) -> tuple[np.ndarray, np.ndarray]:
    recorded = LOW + rng.random((events, len(NAMES))) * (HIGH - LOW)
    recorded[rng.random(recorded.shape) < 0.78] = np.nan
    return recorded, np.cumsum(rng.exponential(2.0, events))


def test_belief_against_a_loop():
    recorded, hours = gappy(np.random.default_rng(0), 60)
    imputed = sepsis_belief.believed_values(sepsis_belief.last_known(recorded, hours))
    current = sepsis_belief.current_values(sepsis_belief.last_known(recorded, hours))
    for column, attribute in enumerate(ATTRIBUTES):
        last, when = None, 0.0
        for event, hour in enumerate(hours):
            if not np.isnan(recorded[event, column]):
                last, when = recorded[event, column], hour
            if last is None:
                assert imputed[event, column] == attribute.normal
                assert np.isnan(current[event, column])
                continue
            trust = 0.5 ** ((hour - when) / attribute.half_life)
            expected = trust * last + (1 - trust) * attribute.normal
            assert imputed[event, column] == pytest.approx(expected, rel=1e-12)
            known = current[event, column]
            assert known == last if trust >= 0.5 else np.isnan(known)


def test_what_was_just_recorded_is_not_changed():
    recorded, hours = gappy(np.random.default_rng(1), 50)
    imputed = sepsis_belief.believed_values(sepsis_belief.last_known(recorded, hours))
    new = ~np.isnan(recorded)
    np.testing.assert_array_equal(imputed[new], recorded[new])


def test_nothing_is_known_before_it_is_recorded():
    recorded, hours = gappy(np.random.default_rng(2), 40)
    changed = recorded.copy()
    changed[25:] = LOW
    for function in (sepsis_belief.believed_values, sepsis_belief.current_values):
        one, other = (function(sepsis_belief.last_known(rows, hours)) for rows in (recorded, changed))
        np.testing.assert_array_equal(one[:25], other[:25])
    one, other = (pressure_shock(rows, hours) for rows in (recorded, changed))
    np.testing.assert_array_equal(one[:25], other[:25])


@pytest.mark.parametrize(
    ("values", "stage"),
    [
        ({}, "none"),
        (dict(zip(NAMES, NORMAL, strict=True)), "none"),
        ({"heart_rate": 120, "temperature": 37}, "none"),  # one criterion, and no sign of infection
        ({"temperature": 38.0}, "none"),
        ({"temperature": 38.1}, "infection"),
        ({"temperature": 35.9}, "infection"),
        ({"white_cells": 12.1}, "infection"),
        ({"white_cells": 3.9}, "infection"),
        ({"heart_rate": 91, "respiratory_rate": 21}, "inflammation"),
        ({"heart_rate": 90, "respiratory_rate": 20, "temperature": 38.1}, "infection"),
        ({"temperature": 38.1, "white_cells": 13}, "inflammation"),
        ({"creatinine": 2.0}, "organ failure"),
        ({"creatinine": 1.9, "bilirubin": 1.9, "platelets": 100, "coma_scale": 13, "lactate": 2.0}, "none"),
        ({"bilirubin": 2.0}, "organ failure"),
        ({"platelets": 99}, "organ failure"),
        ({"coma_scale": 12}, "organ failure"),
        ({"lactate": 2.1}, "organ failure"),
        ({"oxygen_saturation": 89}, "organ failure"),
        ({"arterial_oxygen": 62}, "organ failure"),  # 62 / 0.21 = 295
        ({"arterial_oxygen": 64}, "none"),
        ({"arterial_oxygen": 100, "inspired_oxygen": 0.4}, "organ failure"),
        ({"arterial_oxygen": 130, "inspired_oxygen": 0.4}, "none"),
        ({"systolic_pressure": 89}, "organ failure"),
        ({"mean_pressure": 64}, "organ failure"),
        ({"urea_nitrogen": 200}, "none"),
    ],
)
def test_stages_of_hand_cases(values, stage):
    row = patient(**values)
    assert STAGES[stages(row, np.array([False]))[0]] == stage
    assert STAGES[stages(row, np.array([True]))[0]] == "septic shock"


def shock_by_loop(recorded: np.ndarray, hours: np.ndarray) -> list[bool]:
    result = []
    for event in range(len(hours)):
        found = False
        for name, limit in (("systolic_pressure", 90.0), ("mean_pressure", 65.0)):
            readings = [(h, v) for h, v in zip(hours, recorded[:, COLUMN[name]], strict=True) if not np.isnan(v)]
            readings = [(h, v) for h, v in readings if h <= hours[event]]
            on = False
            for (before, first), (now, second) in pairwise(readings):
                on = second < limit and (on or (first < limit and now - before <= 0.5))
            found |= on and hours[event] - readings[-1][0] <= HALF_LIFE[COLUMN[name]]
        result.append(bool(found))
    return result


def test_pressure_shock_against_a_loop():
    rng = np.random.default_rng(3)
    seen = 0
    for _ in range(40):
        hours = np.cumsum(rng.choice([0.25, 0.5, 1.0, 9.0], 30, p=[0.4, 0.3, 0.2, 0.1]))
        recorded = np.full((30, len(NAMES)), np.nan)
        recorded[:, COLUMN["systolic_pressure"]] = rng.choice([80.0, 120.0, np.nan], 30)
        recorded[:, COLUMN["mean_pressure"]] = rng.choice([60.0, 80.0, np.nan], 30)
        expected = shock_by_loop(recorded, hours)
        assert pressure_shock(recorded, hours).tolist() == expected
        seen += sum(expected)
    assert 100 < seen < 1100


def test_low_readings_of_two_kinds_are_no_pair():
    recorded = np.concatenate([patient(systolic_pressure=80), patient(mean_pressure=60)])
    assert not pressure_shock(recorded, np.array([0.0, 0.2])).any()


def test_no_readings_are_no_shock():
    assert not persistent(np.full(3, np.nan), np.arange(3.0), limit=90.0, holds=8.0).any()


def test_entering_a_stage_costs_its_penalty_and_leaving_gives_it_back():
    for stage in range(1, 5):
        up, down = rewards(np.array([stage - 1, stage, stage - 1]))
        assert (up, down) == (-PENALTIES[stage], PENALTIES[stage])


def test_rewards_telescope():
    rng = np.random.default_rng(4)
    potential = -np.cumsum(PENALTIES)
    for _ in range(20):
        stage = rng.integers(0, 5, 50)
        earned = rewards(stage)
        assert earned.sum() == potential[stage[-1]] - potential[stage[0]]
        assert (np.sign(earned) == -np.sign(np.diff(stage))).all()
