"""D4RL's layout: exact round trips, D4RL's own reading conventions, and a named error for everything else."""

import doctest
import subprocess
import sys
import warnings
from dataclasses import replace
from pathlib import Path

import gymnasium as gym
import h5py
import minari
import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import oat_gym
from oat_gym.episodes import content_hash
from oat_gym.errors import (
    CacheError,
    ConfigurationError,
    DatasetExistsError,
    DatasetNotFoundError,
    InvalidDataError,
    UnsupportedSpaceError,
)
from oat_gym.io import d4rl
from oat_gym.io.d4rl import d4rl_metadata, is_d4rl_path, read_d4rl, write_d4rl
from oat_gym.io.writing import DatasetCard, dataset_from_episodes, episode_buffer

ENDS = {"terminal": (True, False), "timeout": (False, True), "both": (True, True), "neither": (False, False)}


def coded(episode, rows, width=2, dtype=np.float32):
    """Return (rows, width) values that tell episode, row and column: never equal for two of them."""
    return (1000 * episode + np.arange(rows)[:, None] + 0.25 * np.arange(width)).astype(dtype)


def make(folder, lengths, ends, *, dtype=np.float32, infos=None, action="box", seeds=True):
    """Return a value-coded dataset; `infos` is a function of (episode, steps)."""
    box = spaces.Box(-np.inf, np.inf, (2,), dtype)
    actions = spaces.Discrete(40, start=-2) if action == "discrete" else spaces.Box(-1e6, 1e6, (3,), dtype)
    buffers = []
    for e, (n, end) in enumerate(zip(lengths, ends, strict=True)):
        last = np.arange(n) == n - 1
        buffers.append(
            episode_buffer(
                observations=coded(e, n + 1, dtype=dtype),
                actions=np.arange(n) - 2 if action == "discrete" else -coded(e, n, 3, dtype),
                rewards=coded(e, n, 1, dtype)[:, 0] / 7,
                terminations=last & ENDS[end][0],
                truncations=last & ENDS[end][1],
                infos=infos(e, n) if infos else None,
                seed=e + 5 if seeds else None,
            )
        )
    card = DatasetCard(dataset_id="tests/coded-v3", description="coded", author="me", extra={"note": [1, 2]})
    return dataset_from_episodes(buffers, directory=folder, card=card, observation_space=box, action_space=actions)


def assert_same(got, expected):
    assert len(got) == len(expected)
    for a, b in zip(got, expected, strict=True):
        for name in ("observations", "actions", "rewards", "terminations", "truncations"):
            assert getattr(a, name).dtype == getattr(b, name).dtype, name
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)
    assert content_hash(got.iterate_episodes()) == content_hash(expected.iterate_episodes())  # infos too
    assert (got.observation_space, got.action_space) == (expected.observation_space, expected.action_space)
    for a, b in zip(_episode_metadata(got), _episode_metadata(expected), strict=True):
        assert a == b


def _episode_metadata(data):
    found = data.storage.get_episode_metadata(data.episode_indices)
    return [{key: value for key, value in part.items() if key != "id"} for part in found]


def qlearning(file, terminate_on_end=False):
    """Return transitions as D4RL documents `qlearning_dataset`: s' is the next row, timeout rows are skipped."""
    rows = []
    for i in range(len(file["rewards"]) - 1):
        if file["timeouts"][i] and not terminate_on_end:
            continue
        rows.append(
            (file["observations"][i], file["actions"][i], file["rewards"][i], file["observations"][i + 1],
             bool(file["terminals"][i]))
        )  # fmt: skip
    keys = ("observations", "actions", "rewards", "next_observations", "terminals")
    return {key: np.array([row[k] for row in rows]) for k, key in enumerate(keys)}


def sequences(file):
    """Return episodes as D4RL documents `sequence_dataset`: rows up to each terminal or timeout, the rest dropped."""
    found, start = [], 0
    for i in range(len(file["rewards"])):
        if file["terminals"][i] or file["timeouts"][i]:
            found.append({key: values[start : i + 1] for key, values in file.items()})
            start = i + 1
    return found


def contents(path):
    found = {}
    with h5py.File(path) as file:
        file.visititems(lambda name, item: found.update({name: item[()]}) if isinstance(item, h5py.Dataset) else None)
    return found


def raw(n=6, **changes):
    """Return a plain D4RL dictionary of n rows with one terminal (row 2) and one timeout (row 4)."""
    at = np.arange(n)
    base = {
        "observations": coded(0, n), "actions": coded(3, n), "rewards": at.astype(np.float32),
        "terminals": at == 2, "timeouts": at == 4,
    }  # fmt: skip
    base |= changes
    return {key: value for key, value in base.items() if value is not None}


def full_infos(e, n):
    return {
        "qpos": coded(e, n, 3, np.float64),
        "reset_too": coded(e, n + 1, 1)[:, 0].astype(np.float64),
        "goal": {"deep": {"at": np.arange(n) + 100 * e}, "hit": np.arange(n) % 2 == 0},
        "words": [f"é{e}-{t}" for t in range(n + 1)],
    }


# ---------------------------------------------------------------------------------------------- round trips


@settings(max_examples=25, deadline=None, suppress_health_check=list(HealthCheck))
@given(
    episodes=st.lists(st.tuples(st.integers(1, 30), st.sampled_from(sorted(ENDS))), min_size=1, max_size=10),
    dtype=st.sampled_from([np.float32, np.float64]),
    infos=st.sampled_from([None, full_infos]),
    action=st.sampled_from(["box", "discrete"]),
)
def test_reading_what_was_written_gives_the_same_dataset(tmp_path_factory, episodes, dtype, infos, action):
    folder = tmp_path_factory.mktemp("d4rl")
    data = make(folder / "set", *zip(*episodes, strict=True), dtype=dtype, infos=infos, action=action)
    path = write_d4rl(data, folder / "data.hdf5")
    again = read_d4rl(path)
    assert_same(again, data)
    assert again.id == "tests/coded-v3"
    kept = {key: value for key, value in again.storage.metadata.items() if key not in ("dataset_size", "jpeg_encoding")}
    assert kept == {key: data.storage.metadata[key] for key in kept}
    write_d4rl(again, folder / "again.hdf5")
    first, second = contents(path), contents(folder / "again.hdf5")
    assert first.keys() == second.keys()
    for name, values in first.items():
        np.testing.assert_array_equal(values, second[name])


def test_the_rows_are_aligned_and_the_file_has_d4rls_keys(tmp_path):
    lengths, ends = [3, 1, 5, 2], ["terminal", "timeout", "both", "neither"]
    file = contents(write_d4rl(make(tmp_path / "set", lengths, ends, infos=full_infos), tmp_path / "x.hdf5"))
    starts = np.cumsum([0, *lengths])
    for e, n in enumerate(lengths):
        rows = slice(starts[e], starts[e] + n)
        np.testing.assert_array_equal(file["observations"][rows], coded(e, n))
        np.testing.assert_array_equal(file["next_observations"][rows], coded(e, n + 1)[1:])
        np.testing.assert_array_equal(file["actions"][rows], -coded(e, n, 3))
        np.testing.assert_array_equal(file["infos/qpos"][rows], coded(e, n, 3, np.float64))
        np.testing.assert_array_equal(file["infos/goal/deep/at"][rows], np.arange(n) + 100 * e)
        np.testing.assert_array_equal(file["infos/reset_too"][rows], coded(e, n + 1, 1)[1:, 0])  # row t: after step t
    assert np.flatnonzero(file["terminals"]).tolist() == [2, 8]
    assert np.flatnonzero(file["timeouts"]).tolist() == [3, 10]  # truncations & ~terminations, and the flagless end
    assert file["terminals"].dtype == file["timeouts"].dtype == bool


def test_d4rls_readers_get_the_right_values(tmp_path):
    lengths, ends = [4, 1, 6, 3, 2], ["terminal", "terminal", "timeout", "neither", "terminal"]
    data = make(tmp_path / "set", lengths, ends)
    file = contents(write_d4rl(data, tmp_path / "x.hdf5"))
    got = qlearning(file)
    expected = [
        (e, t, t == n - 1 and end == "terminal")
        for e, (n, end) in enumerate(zip(lengths, ends, strict=True))
        for t in range(n if end == "terminal" else n - 1)
    ][:-1]  # D4RL never uses the last row
    assert len(got["rewards"]) == len(expected)
    for row, (e, t, terminal) in enumerate(expected):
        np.testing.assert_array_equal(got["observations"][row], coded(e, t + 1)[t])
        np.testing.assert_array_equal(got["actions"][row], -coded(e, t + 1, 3)[t])
        assert got["rewards"][row] == (coded(e, t + 1, 1)[t, 0] / np.float32(7))
        assert got["terminals"][row] == terminal
        if not terminal:  # beyond a terminal D4RL gives the next episode's first row, and masks it
            np.testing.assert_array_equal(got["next_observations"][row], coded(e, t + 2)[t + 1])
    rows = {key: file[key] for key in ("observations", "actions", "rewards", "terminals", "timeouts")}
    found = sequences(rows)
    assert [len(part["rewards"]) for part in found] == lengths
    for e, part in enumerate(found):
        np.testing.assert_array_equal(part["observations"], coded(e, lengths[e]))


def test_a_qlearning_dictionary_becomes_episodes_again(tmp_path):
    lengths, ends = [4, 6, 3, 5], ["terminal", "timeout", "terminal", "timeout"]
    file = contents(write_d4rl(make(tmp_path / "set", lengths, ends), tmp_path / "x.hdf5"))
    got = qlearning(file)
    again = read_d4rl(got)
    assert [len(episode) for episode in again] == [4, 5, 3, 4]  # its timeout rows are gone
    for e, episode in enumerate(again):
        n = len(episode)
        np.testing.assert_array_equal(episode.observations[: n if ends[e] == "terminal" else n + 1],
                                      coded(e, n if ends[e] == "terminal" else n + 1))  # fmt: skip
        assert (episode.terminations[-1], episode.truncations[-1]) == ENDS[ends[e]]


def test_an_augmented_dataset_keeps_its_provenance(tmp_path):
    def negated(episode, rng):
        return replace(episode, rewards=-episode.rewards)

    data = oat_gym.AugmentedDataset(make(tmp_path / "set", [3, 5], ["terminal", "timeout"]),
                                    oat_gym.Function(negated), count=3)  # fmt: skip
    again = read_d4rl(write_d4rl(data, tmp_path / "x.hdf5"))
    assert [bool(part["synthetic"]) for part in _episode_metadata(again)] == [False, False, True, True, True]
    assert content_hash(again.iterate_episodes()) == content_hash(data.iterate_episodes())
    view = data.filter_episodes(lambda episode: len(episode) == 5)
    assert content_hash(read_d4rl(write_d4rl(view, tmp_path / "view.hdf5"))) == content_hash(view)


@pytest.mark.parametrize("data_format", ["arrow", "parquet"])
def test_other_storage_formats_write_the_same_rows(tmp_path, data_format):
    data = make(tmp_path / "set", [3, 5], ["terminal", "timeout"], infos=lambda e, n: {"a": list(coded(e, n + 1))})
    copy = oat_gym.AugmentedDataset(data, count=0).save("tests/copy-v0", data_format=data_format)
    left, right = (contents(write_d4rl(d, tmp_path / f"{k}.hdf5")) for k, d in enumerate((data, copy)))
    for name in ("observations", "next_observations", "actions", "rewards", "infos/a", "terminals", "timeouts"):
        np.testing.assert_array_equal(left[name], right[name], err_msg=name)


def test_terminals_inside_an_episode_survive(tmp_path):
    data = read_d4rl(raw(next_observations=coded(0, 7)[1:], timeouts=np.arange(6) == 5), cut_at="timeouts")
    assert [len(episode) for episode in data] == [6]
    assert np.flatnonzero(data[0].terminations).tolist() == [2]
    again = read_d4rl(write_d4rl(data, tmp_path / "x.hdf5"))
    assert_same(again, data)
    assert [len(episode) for episode in read_d4rl(tmp_path / "x.hdf5", cut_at="terminals_or_timeouts")] == [3, 3]


def test_files_metadata_survives(tmp_path):
    weights = np.linspace(0, 1, 6, dtype=np.float32).reshape(2, 3)
    metadata = {
        "algorithm": "SAC", "iteration": np.int64(1000), "scale": np.float32(0.1), "bad": float("nan"),
        "policy": {"fc0": {"weight": weights}}, "names": np.array([b"a", b"bc"]),
    }  # fmt: skip
    source = tmp_path / "hopper-medium-v2.hdf5"
    with h5py.File(source, "w") as file:
        for key, value in raw().items():
            file[key] = value
        for key, value in metadata.items():
            if isinstance(value, dict):
                file["metadata/policy/fc0/weight"] = weights
            else:
                file[f"metadata/{key}"] = value
    data = read_d4rl(source)
    assert data.id == "d4rl/hopper-medium-v2"
    about = data.storage.metadata["d4rl"]
    assert about["metadata"]["algorithm"] == "SAC"
    assert about["metadata"]["iteration"] == 1000
    assert (about["dropped_steps"], about["repeated_observations"]) == (2, 1)
    back = contents(write_d4rl(data, tmp_path / "again.hdf5"))
    with h5py.File(source) as file:
        for key in ("iteration", "scale", "bad", "policy/fc0/weight"):
            assert back[f"metadata/{key}"].dtype == file[f"metadata/{key}"].dtype
            np.testing.assert_array_equal(back[f"metadata/{key}"], file[f"metadata/{key}"][()])
    assert back["metadata/names"].tolist() == [b"a", b"bc"]
    again = read_d4rl(tmp_path / "again.hdf5")
    assert again.storage.metadata["d4rl"] == about
    np.testing.assert_array_equal(d4rl_metadata(again)["policy/fc0/weight"], weights)
    assert d4rl_metadata(make(tmp_path / "set", [2], ["timeout"])) == {}


# ---------------------------------------------------------------------------------------------- layouts


def test_without_next_observations_a_terminal_repeats_and_a_cut_drops():
    data = read_d4rl(raw())  # a terminal at row 2, a timeout at row 4, a trailing row
    assert [len(episode) for episode in data] == [3, 1]  # the trailing episode of one row has no known outcome
    first, second = data[0], data[1]
    np.testing.assert_array_equal(first.observations, coded(0, 3)[[0, 1, 2, 2]])
    np.testing.assert_array_equal(second.observations, coded(0, 5)[3:5])
    assert (first.terminations.tolist(), first.truncations.tolist()) == ([False, False, True], [False] * 3)
    assert (second.terminations.tolist(), second.truncations.tolist()) == ([False], [True])
    assert data.storage.metadata["d4rl"] == {"repeated_observations": 1, "dropped_steps": 2}


def test_with_next_observations_nothing_is_dropped_and_the_trailing_end_is_truncated():
    following = coded(9, 6)
    following[[0, 1, 3]] = coded(0, 6)[[1, 2, 4]]
    data = read_d4rl(raw(next_observations=following))
    assert [len(episode) for episode in data] == [3, 2, 1]
    for episode, last in zip(data, (2, 4, 5), strict=True):
        np.testing.assert_array_equal(episode.observations[-1], coded(9, 6)[last])
    assert [bool(episode.truncations[-1]) for episode in data] == [False, True, True]


def test_kitchens_layout():
    flat = np.arange(6.0) / 2
    data = read_d4rl(
        raw(terminals=(np.arange(6) % 3 == 2).astype(np.float32)[:, None], rewards=np.arange(6.0)[:, None],
            timeouts=None, infos=flat)
    )  # fmt: skip
    assert [len(episode) for episode in data] == [3, 3]
    assert [episode.terminations[-1] for episode in data] == [True, True]
    np.testing.assert_array_equal(np.concatenate([episode.infos["infos"] for episode in data]), flat)
    assert np.concatenate([episode.rewards for episode in data]).tolist() == list(range(6))
    assert read_d4rl(raw(infos=np.zeros(0)))[0].infos == {}


def test_a_time_limit_cuts_data_without_timeouts():
    data = read_d4rl(raw(n=9, timeouts=None, infos={"deep": {"at": np.arange(9)}}), max_episode_steps=4)
    # rows 0-2 (terminal), 3-6 (limit: the last step's outcome is unknown), 7-8 (trailing)
    assert [episode.infos["deep"]["at"].tolist() for episode in data] == [[0, 1, 2], [3, 4, 5], [7]]
    assert [bool(episode.truncations[-1]) for episode in data] == [False, True, True]
    ignoring = read_d4rl(raw(n=9, timeouts=None), max_episode_steps=4, cut_at="timeouts")
    assert [len(episode) for episode in ignoring] == [3, 3]  # the last, of one row, is gone


def test_both_flags_are_kept():
    episode = read_d4rl(raw(timeouts=np.arange(6) == 2))[0]
    assert episode.terminations[-1]
    assert episode.truncations[-1]


def test_integer_actions_need_a_space():
    actions = np.arange(6) % 3
    data = read_d4rl(raw(actions=actions), action_space=spaces.Discrete(3))
    assert data[0].actions.tolist() == [0, 1, 2]
    assert data.action_space == spaces.Discrete(3)
    with pytest.raises(ConfigurationError, match="pass action_space"):
        read_d4rl(raw(actions=actions))


def test_an_environment_and_an_id_of_ones_own():
    data = read_d4rl(raw(), dataset_id="mine/data-v0", env_spec=gym.spec("CartPole-v1"))
    assert minari.load_dataset("mine/data-v0").id == data.id == "mine/data-v0"
    assert data.env_spec.id == "CartPole-v1"
    with pytest.raises(DatasetExistsError, match="already at"):
        read_d4rl(raw(), dataset_id="mine/data-v0")
    with pytest.raises(InvalidDataError, match="missing"):
        read_d4rl(raw(actions=None), dataset_id="mine/other-v0")
    assert list(minari.list_local_datasets()) == ["mine/data-v0"]


# ---------------------------------------------------------------------------------------------- the cache


def test_a_conversion_is_made_once_and_again_when_it_was_damaged(tmp_path, monkeypatch, caplog):
    path = write_d4rl(make(tmp_path / "set", [3, 5], ["terminal", "timeout"]), tmp_path / "x.hdf5")
    data = read_d4rl(path)
    expected = content_hash(data)
    main = Path(data.storage.data_path) / "main_data.hdf5"
    made = main.stat().st_mtime_ns
    assert read_d4rl(path).storage.data_path == data.storage.data_path
    assert main.stat().st_mtime_ns == made
    damaged = bytearray(main.read_bytes())
    damaged[len(damaged) // 2] ^= 1
    main.write_bytes(damaged)
    assert content_hash(read_d4rl(path)) == expected
    assert "made again" in caplog.text
    other = read_d4rl(path, cut_at="terminals_or_timeouts")
    assert other.storage.data_path != data.storage.data_path
    assert not [p for p in tmp_path.iterdir() if p.name not in ("set", "x.hdf5")]


def test_a_disk_that_refuses_is_an_error(monkeypatch):
    def full(*args, **kwargs):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(d4rl, "write_dataset", full)
    with pytest.raises(CacheError, match="No space left"):
        read_d4rl(raw())


def test_the_input_is_not_changed():
    given_ = raw(next_observations=coded(0, 7)[1:])
    before = {key: value.copy() for key, value in given_.items()}
    data = read_d4rl(given_)
    data[0].observations[:] = -1
    for key, value in before.items():
        np.testing.assert_array_equal(given_[key], value)


# ---------------------------------------------------------------------------------------------- errors

NAN = np.where(np.arange(6) == 3, np.nan, 1.0).astype(np.float32)
BAD_DATA = [
    (raw(actions=None), r"\['actions'\] are missing"),
    (raw(terminals=None), r"\['terminals'\] are missing"),
    (raw(dones=np.zeros(6)), r"\['dones'\] are not of D4RL's layout"),
    (raw(actions=coded(0, 5)), "'actions' has 5 rows and 'rewards' 6"),
    (raw(terminals=np.zeros(7)), "'terminals' has 7 rows"),
    (raw(timeouts=np.zeros(5)), "'timeouts' has 5 rows"),
    (raw(next_observations=coded(0, 5)), "'next_observations' has 5 rows"),
    (raw(next_observations=coded(0, 6, 3)), r"'next_observations' has shape \(6, 3\)"),
    (raw(next_observations=coded(0, 7, 2, np.float64)[1:]), "'next_observations' is float64"),
    (raw(infos={"x": np.zeros(5)}), "'infos/x' has 5 rows"),
    (raw(infos=np.zeros(5)), "'infos/infos' has 5 rows"),
    (raw(infos={"x": 3}), "'infos/x' is a single value"),
    (raw(infos={"x": [{"a": 1}] * 6}), "'infos/x' holds object values"),
    (raw(rewards=NAN), "'rewards' has NaN in 1 rows, the first 3"),
    (raw(observations=np.stack([NAN, NAN], axis=1)), "'observations' has NaN"),
    (raw(actions=np.stack([NAN, NAN], axis=1)), "'actions' has NaN"),
    (raw(terminals=NAN), "'terminals' has NaN"),
    (raw(next_observations=np.stack([NAN, NAN], axis=1)), "'next_observations' has NaN"),
    (raw(terminals=np.arange(6) / 5), "'terminals' has 0.2 in row 1; flags"),
    (raw(rewards=np.zeros((6, 2))), r"'rewards' has shape \(6, 2\)"),
    (raw(rewards=3.0), "'rewards' is one number"),
    (raw(rewards="much"), "'rewards' is text"),
    (raw(actions=coded(0, 6).astype(complex)), "'actions' holds complex"),
    (raw(n=0), "has no rows"),
    (raw(observations=[[1.0], [1.0, 2.0]]), "'observations' is no array"),
    (raw(next_observations=coded(7, 6)), "Row 0 has another next observation"),
    (raw() | {"infos": {"a": np.zeros(6)}, "infos/a": np.zeros(6)}, "'infos/a'] twice"),
    (raw() | {"infos/a": np.zeros(6), "infos/a/b": np.zeros(6)}, "both 'infos/a' and 'infos/a/b'"),
    (raw(n=1), "No step is left"),
    (raw() | {"metadata/oat_gym/note": "{}"}, "note' is damaged"),
    (raw() | {"metadata/oat_gym/note": '{"format": 2}'}, "another format"),
]  # fmt: skip


@pytest.mark.parametrize(("data", "message"), BAD_DATA, ids=[message for _, message in BAD_DATA])
def test_bad_data_is_named(data, message):
    with pytest.raises(InvalidDataError, match=message):
        read_d4rl(data)


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"cut_at": "resets"}, ConfigurationError, "cut_at must be one of"),
        ({"max_episode_steps": 0}, ConfigurationError, "max_episode_steps must be"),
        ({"max_episode_steps": 2}, InvalidDataError, "Episode 0 has 3 rows by its flags, more than"),
        ({"dataset_id": "no version"}, ConfigurationError, "not a Minari id"),
        ({"action_space": spaces.Box(0, 1, (2,))}, InvalidDataError, "'actions' leaves Box"),
        ({"action_space": spaces.Box(0, 1, (3,))}, InvalidDataError, r"rows of shape \(2,\)"),
        ({"action_space": spaces.MultiDiscrete([2, 2])}, InvalidDataError, "needs whole numbers"),
        ({"observation_space": spaces.Text(5)}, UnsupportedSpaceError, "The observation space is Text"),
    ],
)
def test_bad_settings_are_named(options, error, message):
    with pytest.raises(error, match=message):
        read_d4rl(raw(), **options)


def test_data_that_does_not_say_where_it_ends_is_refused():
    for options in ({"terminals": np.zeros(6)}, {}):
        with pytest.raises(ConfigurationError, match="Nothing says where episodes are cut off"):
            read_d4rl(raw(timeouts=None, **options), cut_at=None if options else "timeouts")


@pytest.mark.parametrize("content", [b"", b"not HDF5 at all" * 50, None])
def test_a_damaged_file_is_named(tmp_path, content):
    path = tmp_path / "x.hdf5"
    write_d4rl(make(tmp_path / "set", [300] * 20, ["timeout"] * 20), path)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2] if content is None else content)
    with pytest.raises(InvalidDataError, match="cannot be read as HDF5"):
        read_d4rl(path)
    with pytest.raises(DatasetNotFoundError, match="There is no file"):
        read_d4rl(tmp_path / "absent.hdf5")


def test_links_out_of_the_file_are_not_followed(tmp_path):
    secret = tmp_path / "secret.hdf5"
    with h5py.File(secret, "w") as file:
        file["rewards"] = np.zeros(6)
    layout = h5py.VirtualLayout(shape=(6,), dtype=float)
    layout[:] = h5py.VirtualSource(secret, "rewards", shape=(6,))
    for number, link in enumerate((h5py.ExternalLink(str(secret), "/rewards"), h5py.SoftLink("/actions"), layout)):
        path = tmp_path / f"{number}.hdf5"
        with h5py.File(path, "w") as file:
            for key, value in raw(rewards=None).items():
                file[key] = value
            if link is layout:
                file.create_virtual_dataset("rewards", layout)
            else:
                file["rewards"] = link
        with pytest.raises(InvalidDataError, match=r"'rewards' (is a link|keeps its data in other files)"):
            read_d4rl(path)
    with h5py.File(path, "w") as file:
        file["loop"] = file["/"]
    with pytest.raises(InvalidDataError, match="nested over"):
        read_d4rl(path)


def test_files_are_closed_after_errors(tmp_path):
    path = tmp_path / "x.hdf5"
    with h5py.File(path, "w") as file:
        file["rewards"] = np.zeros(6)
        file["bad"] = np.array([b"\xff"])
    with pytest.raises(InvalidDataError, match="not UTF-8"):
        read_d4rl(path)
    with h5py.File(path, "a") as file:  # fails where a handle is open for reading
        del file["bad"]
    with pytest.raises(InvalidDataError, match="missing"):
        read_d4rl(path)
    with h5py.File(path, "a"):
        pass


def test_a_file_edited_after_it_was_written_is_named(tmp_path):
    path = write_d4rl(make(tmp_path / "set", [3, 5], ["terminal", "timeout"], infos=full_infos), tmp_path / "x.hdf5")
    file = contents(path)
    shorter = {key: value[:-1] if np.ndim(value) and "reset" not in key else value for key, value in file.items()}
    with pytest.raises(InvalidDataError, match="edited after oat_gym wrote it"):
        read_d4rl(shorter | {"infos/reset_too": file["infos/reset_too"][:-1]})
    with pytest.raises(InvalidDataError, match="no flag is set"):
        read_d4rl(file | {"terminals": np.zeros(8)})
    with pytest.raises(InvalidDataError, match="matches neither"):
        read_d4rl(file | {"metadata/oat_gym/reset_infos/other": np.zeros(2)})
    with pytest.raises(InvalidDataError, match="Row 2 has another next observation"):
        read_d4rl(file | {"terminals": np.zeros(8)}, cut_at="terminals_or_timeouts")
    rows = read_d4rl(file, cut_at="terminals_or_timeouts")  # the rows alone: without what only the note knows
    assert [len(episode.infos["reset_too"]) for episode in rows] == [3, 5]
    assert all("seed" not in part for part in _episode_metadata(rows))


def test_an_existing_file_is_left_as_it_is(tmp_path):
    data = make(tmp_path / "set", [3], ["timeout"])
    path = tmp_path / "x.hdf5"
    path.write_bytes(b"precious")
    with pytest.raises(DatasetExistsError, match="left as it is"):
        write_d4rl(data, path)
    assert path.read_bytes() == b"precious"
    with pytest.raises(ConfigurationError, match="no folder"):
        write_d4rl(data, tmp_path / "absent" / "x.hdf5")


@pytest.mark.parametrize("moment", ["fsync", "link"])
def test_a_failed_or_overtaken_write_leaves_nothing(tmp_path, monkeypatch, moment):
    data = make(tmp_path / "set", [3], ["timeout"])
    path = tmp_path / "x.hdf5"
    error: type[OSError] = OSError if moment == "fsync" else FileExistsError

    def fail(*_):
        raise error(28, "refused")

    monkeypatch.setattr(f"oat_gym.io._d4rl_file.os.{moment}", fail)
    with pytest.raises(OSError, match=r"refused|already there"):
        write_d4rl(data, path)
    assert [p.name for p in tmp_path.iterdir()] == ["set"]


def test_a_full_disk_is_a_clear_error_and_no_crash(tmp_path):
    data = make(tmp_path / "set", [300], ["timeout"])
    script = """
import resource, sys
import minari, oat_gym
from oat_gym.errors import SaveError
data = minari.MinariDataset(sys.argv[1])
for size in (0, 300, 5000):
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.getrlimit(resource.RLIMIT_FSIZE)[1]))
    try:
        oat_gym.write_d4rl(data, sys.argv[2])
    except SaveError as error:
        print(error)
"""
    path = tmp_path / "x.hdf5"
    command = [sys.executable, "-c", script, str(data.storage.data_path), str(path)]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    assert run.returncode == 0, (run.returncode, run.stderr)
    told = run.stdout.splitlines()
    assert len(told) == 3
    assert all(f"{path} could not be written" in line and "Free some space" in line for line in told)
    assert [p.name for p in tmp_path.iterdir()] == ["set"]


def test_a_file_system_without_hard_links_will_do(tmp_path, monkeypatch):
    data = make(tmp_path / "set", [3], ["timeout"])

    def no_links(*_):
        raise PermissionError(1, "no hard links")

    monkeypatch.setattr("oat_gym.io._d4rl_file.os.link", no_links)
    assert_same(read_d4rl(write_d4rl(data, tmp_path / "x.hdf5")), data)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["set", "x.hdf5"]


BAD_INFOS = [
    (lambda e, n: {"a": np.zeros(n + 2)}, r"infos\['a'\] has lengths"),
    (lambda e, n: {"a": np.zeros(n + e)}, r"infos\['a'\] has lengths"),
    (lambda e, n: {"a": np.zeros(n)} if e else {"b": np.zeros(n)}, r"Episode 1 has the infos \['a'\]"),
    (lambda e, n: {"a": np.zeros(n, np.float32 if e else np.float64)}, r"infos\['a'\] of episode 1 has dtype float32"),
    (lambda e, n: {"a": np.zeros((n, 1 + e))}, r"infos\['a'\] of episode 1 has dtype"),
    (lambda e, n: {"a": ["x"] * n if e else np.zeros(n)}, "text in some episodes only"),
]


@pytest.mark.parametrize(("infos", "message"), BAD_INFOS)
def test_infos_that_the_layout_cannot_hold_are_refused(tmp_path, infos, message):
    data = make(tmp_path / "set", [3, 4], ["timeout", "terminal"], infos=infos)
    with pytest.raises(InvalidDataError, match=message):
        write_d4rl(data, tmp_path / "x.hdf5")
    assert not (tmp_path / "x.hdf5").exists()


def test_spaces_and_flags_that_the_layout_cannot_hold_are_refused(tmp_path, make_dataset):
    with pytest.raises(UnsupportedSpaceError, match="The observation space is Dict"):
        write_d4rl(make_dataset([3, 4]), tmp_path / "x.hdf5")
    box = spaces.Box(-np.inf, np.inf, (2,), np.float32)
    early = episode_buffer(
        observations=coded(0, 4), actions=coded(0, 3), rewards=np.zeros(3), terminations=np.zeros(3, bool),
        truncations=np.array([True, False, True]),
    )  # fmt: skip
    card = DatasetCard(dataset_id="tests/early-v0", description="")
    data = dataset_from_episodes([early], directory=tmp_path / "e", card=card, observation_space=box, action_space=box)
    with pytest.raises(InvalidDataError, match="Episode 0 is truncated at step 0"):
        write_d4rl(data, tmp_path / "x.hdf5")
    nothing = data.filter_episodes(lambda _: False)
    with pytest.raises(InvalidDataError, match="no episodes to write"):
        write_d4rl(nothing, tmp_path / "x.hdf5")


def test_paths_are_told_from_ids_and_examples_run():
    assert is_d4rl_path(Path("a/b.H5"))
    assert not is_d4rl_path("oat_gym/maze2d-umaze-v0")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert doctest.testmod(d4rl).failed == 0
