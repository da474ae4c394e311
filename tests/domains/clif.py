"""Made-up CLIF tables, a method call a record."""

from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from oat_gym.domains.sepsis_tables import TABLES
from oat_gym.domains.sepsis_visits import ANTIBIOTICS

START = datetime(2151, 3, 4, 5, 6, tzinfo=UTC)
TYPES = {"text": pa.large_string(), "number": pa.float64(), "time": pa.timestamp("us", tz="UTC")}


class Clif:
    """Tables in memory; hours count from one date for all visits."""

    def __init__(self) -> None:
        self.rows: dict[str, list[dict[str, Any]]] = {name: [] for name in TABLES}

    def visit(self, name: str, patient: str, *, hour: float | None = 0.0, discharged: bool = True) -> str:
        """Add a visit, with an antibiotic at `hour` (None: without)."""
        self._add("hospitalization", name, patient_id=patient, discharge_dttm=time(9999) if discharged else None)
        if hour is not None:
            self.dose(name, hour)
        return name

    def vital(self, name: str, hour: float, **values: float) -> None:
        for category, value in values.items():
            self._add("vitals", name, recorded_dttm=time(hour), vital_category=category, vital_value=value)

    def lab(self, name: str, hour: float | None, category: str, value: float, unit: str | None = "mg/dL") -> None:
        when = None if hour is None else time(hour)
        self._add(
            "labs", name, lab_result_dttm=when, lab_category=category, lab_value_numeric=value, reference_unit=unit
        )

    def device(self, name: str, hour: float, category: str | None = None, fio2: float | None = None) -> None:
        self._add("respiratory_support", name, recorded_dttm=time(hour), device_category=category, fio2_set=fio2)

    def coma(self, name: str, hour: float, value: float) -> None:
        self._add(
            "patient_assessments",
            name,
            recorded_dttm=time(hour),
            assessment_category="gcs_total",
            numerical_value=value,
        )

    def dose(self, name: str, hour: float, *, group: str = ANTIBIOTICS, action: str = "given") -> None:
        self._add(
            "medication_admin_intermittent", name, admin_dttm=time(hour), med_group=group, mar_action_category=action
        )

    def pressor(
        self, name: str, hour: float, dose: float, agent: str = "norepinephrine", action: str = "start"
    ) -> None:
        self._add(
            "medication_admin_continuous",
            name,
            admin_dttm=time(hour),
            med_category=agent,
            med_dose=dose,
            mar_action_category=action,
        )

    def write(self, folder: Path) -> Path:
        """Write all tables, columns in another order than they are read in, and with one more."""
        folder.mkdir(parents=True, exist_ok=True)
        for name, columns in TABLES.items():
            kinds = {"note": "text", **dict(reversed(columns.items()))}
            data = {
                column: pa.array([row.get(column) for row in self.rows[name]], type=TYPES[kind])
                for column, kind in kinds.items()
            }
            pq.write_table(pa.table(data), folder / f"clif_{name}.parquet")
        return folder

    def _add(self, table: str, name: str, **values: Any) -> None:
        self.rows[table].append({"hospitalization_id": name, **values})


def time(hour: float) -> datetime:
    return START + timedelta(hours=hour)


def three_visits() -> Clif:
    """Three visits of two patients, 5, 3 and 9 events; the heart rate encodes visit and event: 60 + 20 e + t."""
    made = Clif()
    for e, (name, patient, events) in enumerate([("v-a", "p-1", 5), ("v-b", "p-1", 3), ("v-c", "p-2", 9)]):
        start = 1000.0 * e
        made.visit(name, patient, hour=start)
        for t in range(events):
            made.vital(name, start + t**2 / 8, heart_rate=60 + 20 * e + t)
    return made
