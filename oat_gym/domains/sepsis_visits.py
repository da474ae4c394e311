"""Visits with suspected infection from CLIF tables: irregular events, 15 attributes, and the treatments in effect."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from oat_gym.domains.sepsis_attributes import (
    ASSESSMENTS,
    ATTRIBUTES,
    COLUMN,
    HIGH,
    LABS,
    LOW,
    RESPIRATORY,
    VITALS,
    Attribute,
)
from oat_gym.domains.sepsis_tables import Columns, Tables, check_clocks, digest, is_open, read_table
from oat_gym.errors import InvalidDataError

logger = logging.getLogger(__name__)

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]
Times = npt.NDArray[np.datetime64]

ANTIBIOTICS = "CMS_sepsis_qualifying_antibiotics"
"""The `med_group` whose administration makes an infection suspected, and a visit part of the data."""
VASOPRESSORS = ("angiotensin", "dopamine", "epinephrine", "norepinephrine", "phenylephrine", "vasopressin")
ANTIBIOTIC_HOURS = 24.0
"""A dose is in effect this long: doses follow each other within 24 hours in 96 of 100 cases."""
OXYGEN_HOURS = 12.0
"""A charted device is in effect this long, or until the next one: 97 of 100 gaps are shorter."""
NO_OXYGEN = ("room air",)
NO_DOSE = ("stop", "not_given")


@dataclass(frozen=True)
class Visit:
    """One hospitalisation, as N events in time.

    Attributes:
        patient: number of the patient, from 0.
        hours: (N,) hours since the first event, increasing.
        recorded: (N, 15) values recorded at each event, NaN where none was.
        antibiotics: (N,) whether an antibiotic is in effect after the event.
        oxygen: (N,) whether oxygen assistance is in effect after the event.
        vasopressor: (N,) whether a vasopressor is running.
        ended: whether the record has the visit's end (a discharge, by death too); events charted after it are kept.
    """

    patient: int
    hours: FloatArray
    recorded: FloatArray
    antibiotics: BoolArray
    oxygen: BoolArray
    vasopressor: BoolArray
    ended: bool


@dataclass(frozen=True)
class Records:
    """Records of all visits, one a row: which visit, when, and what."""

    visit: npt.NDArray[np.int64]
    time: Times
    value: FloatArray
    column: npt.NDArray[np.int64]

    def parts(self, count: int) -> list[Records]:
        """Return the records of each of `count` visits, in the order of time (rows of one time stay in order)."""
        order = np.lexsort((self.time, self.visit))
        edges = np.searchsorted(self.visit[order], np.arange(1, count))
        return [self.take(rows) for rows in np.split(order, edges)]

    def take(self, rows: npt.NDArray[Any]) -> Records:
        """Return some of the rows."""
        return Records(self.visit[rows], self.time[rows], self.value[rows], self.column[rows])


def read_visits(tables: Tables) -> list[Visit]:
    """Return the visits with a sepsis-qualifying antibiotic, patient by patient, a patient's in the order of time.

    Patients are numbered in the order of a digest of their ids, which says nothing of them nor of the calendar. An
    event is a time at which one of the 15 attributes, an antibiotic or an oxygen device was recorded; results of a
    laboratory count when they are there, not when the blood was drawn. Values recorded twice at one time are averaged,
    those outside the plausible range left out.

    Raises:
        ConfigurationError: without pyarrow.
        InvalidDataError: for missing tables, columns and units, and if no visit has such an antibiotic.
    """
    check_clocks(tables)
    doses = read_table(tables, "medication_admin_intermittent")
    given = (doses["med_group"] == ANTIBIOTICS) & ~np.isin(doses["mar_action_category"], NO_DOSE)
    given &= ~np.isnat(doses["admin_dttm"])  # nobody knows when, so that it is no event
    ids = np.unique(doses["hospitalization_id"][given])
    if tables.open_only:
        ids = ids[is_open(ids)]
    if not len(ids):
        raise InvalidDataError(f"No visit of {tables.folder} has an antibiotic of the med_group {ANTIBIOTICS!r}.")
    stays = read_table(tables, "hospitalization", visits=ids.tolist())
    support = read_table(tables, RESPIRATORY, visits=ids.tolist())
    pressors = read_table(tables, "medication_admin_continuous", visits=ids.tolist())
    streams = (
        _measurements(tables, support, ids),
        _records(doses, given, ids),
        _records(support, support["device_category"] != "", ids, values=_assists(support["device_category"])),
        _vasopressors(pressors, ids),
    )
    parts = zip(*(stream.parts(len(ids)) for stream in streams), strict=True)
    patients, ended = _stays(stays, ids)
    made = [_visit(*part, patient=int(p), ended=bool(e)) for part, p, e in zip(parts, patients, ended, strict=True)]
    order = np.lexsort((np.array([start for start, _ in made]), patients))
    return [made[number][1] for number in order]


def _measurements(tables: Tables, support: Columns, ids: npt.NDArray[np.str_]) -> Records:
    """Return the plausible records of the 15 attributes, of all tables."""
    parts: list[Records] = []
    for name, (time, category, value) in _LONG.items():
        table = read_table(tables, name, visits=ids.tolist())
        for attribute in (a for a in ATTRIBUTES if a.table == name):
            rows = table[category] == attribute.category
            if name == LABS:
                _check_units(table["reference_unit"][rows & np.isfinite(table[value])], attribute)
            parts.append(_plausible(attribute, _records(table, rows, ids, values=table[value], time=time)))
    oxygen = ATTRIBUTES[COLUMN["inspired_oxygen"]]
    parts.append(_plausible(oxygen, _records(support, slice(None), ids, values=support[oxygen.category])))
    return Records(*(np.concatenate([getattr(part, name) for part in parts]) for name in _FIELDS))


_FIELDS = ("visit", "time", "value", "column")
_LONG = {
    VITALS: ("recorded_dttm", "vital_category", "vital_value"),
    LABS: ("lab_result_dttm", "lab_category", "lab_value_numeric"),
    ASSESSMENTS: ("recorded_dttm", "assessment_category", "numerical_value"),
}
"""The tables with one value a row: their columns of times, categories and values."""


def _plausible(attribute: Attribute, records: Records) -> Records:
    """Return the records of an attribute whose values are plausible, with its column."""
    known = records.take(np.isfinite(records.value))
    inside = (known.value >= attribute.low) & (known.value <= attribute.high)
    if len(inside) and inside.mean() < 0.5:
        raise InvalidDataError(
            f"{attribute.name} ({attribute.table}: {attribute.category}) has a median of {np.median(known.value):g}; "
            f"values in {attribute.unit} are expected, from {attribute.low:g} to {attribute.high:g}. Convert its unit."
        )
    if not inside.all():
        logger.info(
            "left out %d of %d values of %s that are not plausible", (~inside).sum(), len(inside), attribute.name
        )
    kept = known.take(inside)
    return Records(kept.visit, kept.time, kept.value, np.full(len(kept.visit), COLUMN[attribute.name]))


def _check_units(units: npt.NDArray[np.str_], attribute: Attribute) -> None:
    accepted = {unit.casefold() for unit in (attribute.unit, *attribute.spellings)}
    strange = sorted({unit for unit in np.unique(units).tolist() if unit.strip().casefold() not in accepted})
    if strange:
        raise InvalidDataError(
            f"Lab {attribute.category!r} has the reference_unit {', '.join(map(repr, strange))}; {attribute.unit!r} is "
            "expected. Convert the values, and state the unit."
        )


def _records(
    table: Columns,
    rows: Any,
    ids: npt.NDArray[np.str_],
    *,
    values: npt.NDArray[Any] | None = None,
    columns: npt.NDArray[np.int64] | None = None,
    time: str | None = None,
) -> Records:
    """Return the chosen rows of a table that belong to a visit and have a time."""
    times = table[time or next(name for name in table if name.endswith("_dttm"))][rows]
    visits = table["hospitalization_id"][rows]
    known = np.isin(visits, ids) & ~np.isnat(times)
    blank = np.zeros(len(known))
    value = blank if values is None else values[rows].astype(np.float64)
    column = blank.astype(np.int64) if columns is None else columns[rows]
    return Records(np.searchsorted(ids, visits[known]), times[known], value[known], column[known])


def _assists(devices: npt.NDArray[np.str_]) -> BoolArray:
    return ~np.isin(np.char.lower(devices), NO_OXYGEN)


def _vasopressors(table: Columns, ids: npt.NDArray[np.str_]) -> Records:
    """Return every change of a vasopressor: which (column), and whether it runs afterwards (value)."""
    rows = np.isin(table["med_category"], VASOPRESSORS)
    runs = (np.nan_to_num(table["med_dose"]) > 0) & ~np.isin(table["mar_action_category"], NO_DOSE)
    agents = np.zeros(len(rows), dtype=np.int64)
    agents[rows] = np.searchsorted(VASOPRESSORS, table["med_category"][rows])
    return _records(table, rows, ids, values=runs, columns=agents)


def _stays(table: Columns, ids: npt.NDArray[np.str_]) -> tuple[npt.NDArray[np.int64], BoolArray]:
    """Return the number of each visit's patient, and whether its end is recorded."""
    row_of = {name: row for row, name in enumerate(table["hospitalization_id"].tolist())}
    absent = [name for name in ids.tolist() if name not in row_of]
    if absent or len(row_of) != len(table["hospitalization_id"]):
        raise InvalidDataError(
            f"clif_hospitalization must have one row a visit; {len(absent)} visits with antibiotics have none, and "
            f"{len(table['hospitalization_id']) - len(row_of)} are repeated."
        )
    rows = np.array([row_of[name] for name in ids.tolist()])
    digests = np.array([digest(patient) for patient in table["patient_id"][rows].tolist()])
    return np.unique(digests, return_inverse=True)[1], ~np.isnat(table["discharge_dttm"][rows])


def _visit(
    measured: Records, doses: Records, devices: Records, pressors: Records, *, patient: int, ended: bool
) -> tuple[np.datetime64, Visit]:
    """Return the time of the first event, and the visit."""
    times, place = np.unique(np.concatenate([measured.time, doses.time, devices.time]), return_inverse=True)
    sums, counts = np.zeros((2, len(times), len(ATTRIBUTES)))
    cells = (place[: len(measured.time)], measured.column)
    np.add.at(sums, cells, measured.value)
    np.add.at(counts, cells, 1)
    recorded = np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)
    running = [
        _latest(times, pressors.take(pressors.column == agent), hours=np.inf) for agent in range(len(VASOPRESSORS))
    ]
    given = Records(doses.visit, doses.time, np.ones(len(doses.time)), doses.column)
    visit = Visit(
        patient=patient,
        hours=(times - times[0]) / np.timedelta64(1, "us") / 3.6e9,
        recorded=np.clip(recorded, LOW, HIGH),  # a mean may leave the range by a rounding
        antibiotics=_latest(times, given, hours=ANTIBIOTIC_HOURS),
        oxygen=_latest(times, devices, hours=OXYGEN_HOURS),
        vasopressor=np.any(running, axis=0),
        ended=ended,
    )
    return times[0], visit


def _latest(times: Times, records: Records, *, hours: float) -> BoolArray:
    """Return whether the latest record at each time has a value above 0 and is at most so many hours old.

    Of records of one time the largest counts.
    """
    order = np.lexsort((records.value, records.time))
    row = np.searchsorted(records.time[order], times, side="right") - 1
    known = row >= 0
    result = np.zeros(len(times), dtype=bool)
    latest = order[row[known]]
    ages = (times[known] - records.time[latest]) / np.timedelta64(1, "us") / 3.6e9
    result[known] = (records.value[latest] > 0) & (ages <= hours)
    return result
