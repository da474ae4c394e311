"""Tables to episodes: values encode (episode, row), lengths differ, and rows come in any order."""

import doctest
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest

from oat_gym.errors import ConfigurationError, InvalidDataError
from oat_gym.io import tables
from oat_gym.io.tables import episodes_from_table

LENGTHS = {4: 3, 9: 5, 12: 2}
ROLES = {"episode": "id", "order": "t", "observations": ["x", "y"], "action": "a", "reward": "r"}


def make_table(lengths=LENGTHS, *, shuffle=None):
    """x = 100 id + t, y = -x, a = t mod 2, r = id + t / 10, p = 1 / (t + 2); t starts at 10."""
    number = np.repeat(list(lengths), list(lengths.values()))
    t = np.concatenate([np.arange(10, 10 + length) for length in lengths.values()])
    x = 100.0 * number + t
    table = {"id": number, "t": t, "x": x, "y": -x, "a": t % 2, "r": number + t / 10, "p": 1 / (t + 2.0)}
    if shuffle is not None:
        rows = np.random.default_rng(shuffle).permutation(len(t))
        table = {name: values[rows] for name, values in table.items()}
    return table


def encoded(number, length):
    return [100.0 * number + t for t in range(10, 10 + length)]


@pytest.mark.parametrize("shuffle", [None, 0, 1])
def test_terminated_episodes_keep_all_rows_and_repeat_the_last_observation(shuffle):
    found = episodes_from_table(make_table(shuffle=shuffle), **ROLES, propensity="p", infos=["p"], consecutive=True)
    assert [len(episode) for episode in found] == [3, 5, 2]
    for (number, length), episode in zip(LENGTHS.items(), found, strict=True):
        x = encoded(number, length)
        t = np.arange(10, 10 + length)
        assert episode.observations.tolist() == [[v, -v] for v in [*x, x[-1]]]
        assert episode.actions.tolist() == (t % 2).tolist()
        assert episode.actions.dtype.kind == "i"
        assert episode.rewards.tolist() == (number + t / 10).tolist()
        assert episode.terminations.tolist() == [False] * (length - 1) + [True]
        assert not episode.truncations.any()
        np.testing.assert_allclose(episode.infos["log_prob"], -np.log(t + 2))
        np.testing.assert_array_equal(episode.infos["p"], 1 / (t + 2))


def test_times_that_go_back_are_named():
    table = make_table() | {"clock": np.array([0, 1, 2, 0, 5, 4, 6, 7, 0, 1])}
    assert episodes_from_table(table, **ROLES, time="t")
    with pytest.raises(InvalidDataError, match=r"'clock' goes back from 5 to 4 in episode .*9"):
        episodes_from_table(table, **ROLES, time="clock")


def test_an_info_is_not_silently_replaced():
    table = make_table() | {"time": make_table()["t"] + 1, "log_prob": make_table()["p"]}
    found = episodes_from_table(table, **ROLES, infos=["time"], time="time")
    assert found[0].infos["time"].tolist() == [11, 12, 13]
    for clash in ({"infos": ["time"], "time": "t"}, {"infos": ["log_prob"], "propensity": "p"}):
        with pytest.raises(ConfigurationError, match="twice: that column"):
            episodes_from_table(table, **ROLES, **clash)


class Strict(dict):
    """A frame whose missing columns raise an error of its own, as polars does."""

    def __missing__(self, key):
        raise RuntimeError(key)


def test_a_missing_column_is_named_whatever_the_table_raises():
    records = np.array([(1, 0, 0.0, 0, 0.0)], dtype=[(name, float) for name in ("id", "t", "x", "y", "a")])
    for table in (Strict({name: values for name, values in make_table().items() if name != "r"}), records):
        with pytest.raises(ConfigurationError, match=r"no column 'r'; its columns are \['id', 't', 'x', 'y', 'a'"):
            episodes_from_table(table, **ROLES)


@pytest.mark.parametrize("shuffle", [None, 3])
def test_cut_off_episodes_end_in_the_last_recorded_observation(shuffle):
    found = episodes_from_table(make_table(shuffle=shuffle), **ROLES, terminated=False, infos=["t"])
    for (number, length), episode in zip(LENGTHS.items(), found, strict=True):
        steps = length - 1
        assert episode.observations[:, 0].tolist() == encoded(number, length)
        assert len(episode.actions) == len(episode.rewards) == steps
        assert episode.infos["t"].tolist() == list(range(10, 10 + steps))
        assert episode.truncations.tolist() == [False] * (steps - 1) + [True]
        assert not episode.terminations.any()


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ([{"id": 1, "name": "J. Doe"}] * 500, r"^The table is a list; .*pandas.DataFrame\(rows\)"),
        ("log.csv", r"^The table is a str; .*pandas.read_csv"),
        (Path("log.csv"), r"^The table is a \w*Path; .*pandas.read_csv"),
        (np.zeros((500, 6)), "^The table is a ndarray; .*name its columns"),
        (pd.Series(["J. Doe"] * 500), "^The table is a Series; .*name its columns"),
        (None, "^The table is a NoneType; "),
    ],
)
def test_what_is_no_table_is_named_by_its_type_alone(table, message):
    with pytest.raises(ConfigurationError, match=message) as caught:
        episodes_from_table(table, **ROLES)
    assert len(str(caught.value)) < 300
    assert "Doe" not in str(caught.value)


def test_of_many_columns_some_are_named():
    with pytest.raises(ConfigurationError, match=r"'c29'\] and 70 more\.$"):
        episodes_from_table({f"c{i}": [0] for i in range(100)}, **ROLES)


@pytest.mark.parametrize("terminated", [None, 1, pd.Series(["J. Doe"])])
def test_how_episodes_ended_is_told_or_asked_for(terminated):
    with pytest.raises(ConfigurationError, match="terminated must be True, False or the name of a column, got a"):
        episodes_from_table(make_table(), **ROLES, terminated=terminated)


def test_a_column_can_say_which_episodes_terminated():
    table = make_table(shuffle=2)
    table["end"] = ((table["id"] == 9) & (table["t"] == 14)).astype(int)
    found = episodes_from_table(table, **ROLES, terminated="end")
    assert [len(episode) for episode in found] == [2, 5, 1]
    assert [episode.terminations[-1] for episode in found] == [False, True, False]
    assert [episode.truncations[-1] for episode in found] == [True, False, True]
    table["end"] = (table["t"] == 11).astype(int)
    with pytest.raises(InvalidDataError, match="Episode 4 terminates at its row 1 and has 3 rows"):
        episodes_from_table(table, **ROLES, terminated="end")


@pytest.mark.parametrize("code", [2.0, -1.0, 0.5])
def test_other_codes_of_an_end_are_refused(code):
    """2 may say that a patient was censored, which is no termination."""
    table = make_table()
    table["end"] = np.where((table["id"] == 9) & (table["t"] == 14), code, 0.0)
    with pytest.raises(InvalidDataError, match=f"1 values that are neither 0 nor 1, the first {code} in row 7"):
        episodes_from_table(table, **ROLES, terminated="end")
    table["end"] = table["end"] != 0
    assert [episode.terminations[-1] for episode in episodes_from_table(table, **ROLES, terminated="end")] == [0, 1, 0]


@pytest.mark.parametrize("zone", [None, "UTC", "America/New_York"])
def test_dates_beyond_what_nanoseconds_hold_keep_their_order(zone):
    days = np.array(["2020-01-01", "9999-12-31", "2300-01-01"], dtype="datetime64[us]")
    when = pd.Series(days).dt.tz_localize("UTC").dt.tz_convert(zone) if zone else pd.Series(days)
    frame = pd.DataFrame({"id": 1, "x": [0.0, 2.0, 1.0], "a": [0, 2, 1], "r": 0.0, "when": when})
    roles = ROLES | {"order": "when", "observations": "x"}
    (episode,) = episodes_from_table(frame, **roles, time="when")
    assert episode.observations.tolist() == [0, 1, 2, 2]
    assert episode.infos["time"].tolist() == [day.astype("datetime64[s]").astype(int) for day in days[[0, 2, 1]]]


def test_ids_that_are_neither_numbers_nor_texts_are_told_by_their_type():
    table = make_table()
    table["id"] = table["id"].astype(object)
    with pytest.raises(InvalidDataError, match="'id' holds int values; ids must be all numbers or all texts"):
        episodes_from_table(table, **ROLES)
    table["id"][3] = None
    with pytest.raises(InvalidDataError, match="'id' has 1 missing"):
        episodes_from_table(table, **ROLES)


def test_every_kind_of_table_gives_the_same_episodes():
    table = make_table(shuffle=0)
    expected = episodes_from_table(table, **ROLES)
    lists = {name: values.tolist() for name, values in table.items()}
    for other in (lists, pd.DataFrame(table), pa.table(table)):
        for one, two in zip(expected, episodes_from_table(other, **ROLES), strict=True):
            np.testing.assert_array_equal(one.observations, two.observations)
            np.testing.assert_array_equal(one.actions, two.actions)
            np.testing.assert_array_equal(one.rewards, two.rewards)


def test_string_ids_dates_and_vector_actions():
    table = make_table(shuffle=4)
    table["name"] = np.array([f"visit-{i:02d}" for i in table["id"]])
    table["when"] = np.datetime64("2020-01-01T00:00:00") + table["t"].astype("timedelta64[m]")
    for form in (table, pd.DataFrame(table)):
        found = episodes_from_table(
            form, episode="name", order="when", observations="x", action=["a", "p"], reward="r", time="when"
        )
        assert [episode.observations[0] for episode in found] == [410.0, 910.0, 1210.0]
        assert found[1].observations.shape == (6,)
        assert found[1].actions.shape == (5, 2)
        np.testing.assert_allclose(np.diff(found[1].infos["time"]), 60.0)
    with pytest.raises(ConfigurationError, match="consecutive=True needs whole numbers"):
        episodes_from_table(table, **(ROLES | {"order": "when"}), consecutive=True)


def test_the_table_is_neither_changed_nor_aliased():
    table = make_table()
    before = {name: values.copy() for name, values in table.items()}
    found = episodes_from_table(table, **ROLES, terminated=False, infos=["p"])
    for episode in found:
        for array in (episode.observations, episode.actions, episode.rewards, episode.infos["p"]):
            assert not any(np.shares_memory(array, column) for column in table.values())
            array[:] = 0
    for name, values in table.items():
        np.testing.assert_array_equal(values, before[name])


def changed(column, row, value):
    table = make_table()
    table[column] = table[column].astype(np.result_type(table[column], type(value)))
    table[column][row] = value
    return table


@pytest.mark.parametrize(
    ("table", "options", "message"),
    [
        (changed("t", 4, 11.0 + 2), {}, "Episode id=9 has two rows with t=13"),
        (changed("t", 7, 20), {}, "Episode id=9 goes from t=13 to 20 .1 such gaps"),
        (changed("t", 7, 20.0), {"consecutive": True}, "Episode id=9 goes from t=13.0 to 20.0 .1 such gaps"),
        (changed("x", 2, np.nan), {}, "'x' has 1 missing or infinite values, the first in row 2"),
        (changed("r", 0, np.inf), {}, "'r' has 1 missing"),
        (changed("t", 3, np.nan), {}, "'t' has 1 missing"),
        (changed("p", 5, 0.0), {"propensity": "p"}, r"'p' has 1 values outside \(0, 1\], the first 0.0 in row 5"),
        (changed("p", 5, 1.5), {"propensity": "p"}, "the first 1.5 in row 5"),
        (make_table() | {"r": np.array(["a"] * 10)}, {}, "'r' holds <U1 values; convert it to numbers"),
        (make_table() | {"id": np.array(["a", None] * 5, dtype=object)}, {}, "'id' has 5 missing"),
        (make_table() | {"x": np.zeros((10, 2))}, {}, r"'x' has shape \(10, 2\)"),
        (make_table() | {"a": np.zeros(9)}, {}, "'id' has 10 rows and 'actions' has 9"),
        (make_table() | {"y": np.zeros(9)}, {}, "'x' has 10 rows and 'y' has 9"),
        ({name: np.zeros(0) for name in ["id", "t", "x", "y", "a", "r"]}, {}, "no rows"),
        (make_table({4: 3, 9: 1}), {"terminated": False}, "Episode 9 has one row and did not terminate"),
    ],
)
def test_damaged_tables_are_refused(table, options, message):
    with pytest.raises(InvalidDataError, match=message):
        episodes_from_table(table, **ROLES, **options)


@pytest.mark.parametrize("form", [dict, pd.DataFrame, pa.table])
def test_a_missing_column_is_named_with_those_there_are(form):
    with pytest.raises(ConfigurationError, match=r"no column 'z'; its columns are \['id', 't', 'x'"):
        episodes_from_table(form(make_table()), **(ROLES | {"reward": "z"}))
    with pytest.raises(ConfigurationError, match="name at least one"):
        episodes_from_table(form(make_table()), **(ROLES | {"observations": []}))


def test_columns_can_be_given_by_place():
    table = make_table()
    placed = episodes_from_table(table, "id", "t", ["x", "y"], "a", "r", "t", "p")
    named = episodes_from_table(table, **ROLES, time="t", propensity="p")
    for one, two in zip(placed, named, strict=True):
        np.testing.assert_array_equal(one.observations, two.observations)
        np.testing.assert_array_equal(one.rewards, two.rewards)
        assert {name: rows.tolist() for name, rows in one.infos.items()} == {
            name: rows.tolist() for name, rows in two.infos.items()
        }


@pytest.mark.parametrize("options", [{"consecutive": False}, {}])
def test_gaps_pass_where_they_are_expected(options):
    table = changed("t", 7, 20 if options else 20.5)  # real numbers are no count of rows
    assert [len(episode) for episode in episodes_from_table(table, **ROLES, **options)] == [3, 5, 2]


@pytest.mark.parametrize("form", [pd.DataFrame, pa.table])
def test_missing_numbers_of_nullable_columns_are_found(form):
    table = make_table()
    actions = table["a"].tolist()
    actions[4] = None
    column = pd.array(actions, dtype="Int64") if form is pd.DataFrame else pa.array(actions)
    with pytest.raises(InvalidDataError, match="'a' has 1 missing or infinite values, the first in row 4"):
        episodes_from_table(form(table | {"a": column}), **ROLES)
    whole = pd.DataFrame(make_table()).convert_dtypes()
    assert episodes_from_table(whole, **ROLES)[0].actions.dtype.kind == "i"


def test_dates_with_a_time_zone_are_read_as_utc():
    table = pd.DataFrame(make_table())
    plain = pd.Timestamp("2020-01-01") + pd.to_timedelta(table["t"], unit="h")
    zoned = (plain + pd.Timedelta(hours=1)).dt.tz_localize("Europe/Paris")
    for one, two in zip(
        episodes_from_table(table.assign(when=plain), **(ROLES | {"order": "when"}), time="when"),
        episodes_from_table(table.assign(when=zoned), **(ROLES | {"order": "when"}), time="when"),
        strict=True,
    ):
        np.testing.assert_array_equal(one.infos["time"], two.infos["time"])


def test_examples_in_docstrings():
    assert doctest.testmod(tables).failed == 0
