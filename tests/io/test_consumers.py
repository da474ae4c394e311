"""to_torchrl and to_d3rlpy: with the real libraries where they are, and their conversions everywhere.

The real checks run in an environment of their own: OAT_GYM_TORCHRL_PYTHON and OAT_GYM_D3RLPY_PYTHON name an interpreter
that has the library and this package; else the present one is used where it has the library.
"""

import importlib.util
import json
import os
import subprocess
import sys
import types
from pathlib import Path

import numpy as np
import pytest
from gymnasium import spaces
from minari.data_collector import EpisodeBuffer

from oat_gym import AugmentedDataset, Function
from oat_gym.errors import ConfigurationError, InvalidDataError, UnsupportedSpaceError
from oat_gym.io import consumers
from oat_gym.io.consumers import to_d3rlpy, to_torchrl
from oat_gym.io.d4rl import write_d4rl
from tests.conftest import install_dataset

LENGTHS = (3, 1, 6, 4)


def louder(episode, rng):
    episode.rewards[:] += 0.5
    return episode


@pytest.mark.parametrize("library", ["torchrl", "d3rlpy"])
def test_with_the_real_library(library, tmp_path):
    variable = f"OAT_GYM_{library.upper()}_PYTHON"
    interpreter = os.environ.get(variable)
    if not interpreter:
        if importlib.util.find_spec(library) is None:
            pytest.skip(f"needs {library}: install it, or name an interpreter that has it in {variable}")
        interpreter = sys.executable
    script = Path(__file__).with_name("consumer_checks.py")
    done = subprocess.run(
        [interpreter, "-W", "error", str(script), library, str(tmp_path)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert library in json.loads(done.stdout.splitlines()[-1])
    example = Path(__file__).parents[2] / "examples" / "03_torchrl_d3rlpy.py"
    shown = subprocess.run([interpreter, str(example)], capture_output=True, text=True, check=False, cwd=tmp_path)
    assert shown.returncode == 0, shown.stderr
    line = {"torchrl": "TorchRL: ", "d3rlpy": "d3rlpy: "}[library]
    assert any(text.startswith(line) for text in shown.stdout.splitlines()), shown.stdout


@pytest.fixture
def augmented(make_dataset):
    return AugmentedDataset(make_dataset(LENGTHS), Function(louder), count=4)


@pytest.fixture
def given(monkeypatch):
    """A stand-in for d3rlpy that keeps what MDPDataset is given."""
    stand_in = types.SimpleNamespace(
        MDPDataset=lambda **given: given,
        ActionSpace=types.SimpleNamespace(DISCRETE="discrete", CONTINUOUS="continuous"),
    )
    monkeypatch.setattr(consumers, "_optional", lambda *_: stand_in)
    return to_d3rlpy


def simple(space, action_space, *, flags=None, steps=3):
    buffer = EpisodeBuffer(
        observations=np.stack([np.asarray(space.sample()) for _ in range(steps + 1)]),
        actions=np.stack([np.asarray(action_space.sample()) for _ in range(steps)]),
        rewards=np.arange(steps, dtype=np.float64),
        terminations=np.zeros(steps, dtype=bool) if flags is None else np.array(flags),
        truncations=np.zeros(steps, dtype=bool),
    )
    return install_dataset("test/simple-v0", [buffer, buffer], space, action_space)


def test_torchrl_rows_are_the_columns(augmented):
    rows = consumers._torchrl_rows(consumers._columns(augmented, flat=False))
    columns = augmented.transitions()
    for name in ("position", "mode"):
        np.testing.assert_array_equal(rows["observation"][name], columns.observations[name])
        np.testing.assert_array_equal(rows["next"]["observation"][name], columns.next_observations[name])
    np.testing.assert_array_equal(rows["action"], columns.actions)
    np.testing.assert_array_equal(rows["next"]["reward"], columns.rewards[:, None])
    for name, flags in (("terminated", columns.terminated), ("truncated", columns.truncated)):
        np.testing.assert_array_equal(rows["next"][name], flags[:, None])
        assert not rows[name].any()
        assert rows[name].shape == (len(columns), 1)
    np.testing.assert_array_equal(rows["next"]["done"], (columns.terminated | columns.truncated)[:, None])
    np.testing.assert_array_equal(rows["synthetic"], columns.synthetic)


def test_an_unfinished_episode_is_marked_truncated_at_its_end():
    data = simple(spaces.Box(-1, 1, (2,)), spaces.Box(-1, 1, (1,)))
    rows = consumers._torchrl_rows(consumers._columns(data, flat=False))
    assert rows["next"]["truncated"][:, 0].tolist() == rows["next"]["done"][:, 0].tolist() == [False, False, True] * 2


def test_tuples_become_numbered_keys():
    space = spaces.Tuple([spaces.Box(-1, 1, (2,)), spaces.Discrete(3)])
    buffer = EpisodeBuffer(
        observations=(np.zeros((3, 2), dtype=np.float32), np.array([0, 1, 2])),
        actions=np.zeros((2, 1), dtype=np.float32),
        rewards=np.zeros(2),
        terminations=np.zeros(2, dtype=bool),
        truncations=np.array([False, True]),
    )
    data = install_dataset("test/tuple-v0", [buffer], space, spaces.Box(-1, 1, (1,)))
    rows = consumers._torchrl_rows(consumers._columns(data, flat=False))
    assert rows["observation"]["1"].tolist() == [0, 1]
    assert rows["next"]["observation"]["1"].tolist() == [1, 2]


def test_d3rlpy_is_given_one_row_a_step(augmented, given, caplog):
    found, columns = given(augmented), augmented.transitions()
    np.testing.assert_array_equal(found["observations"], augmented.transitions(flat=True).observations)
    np.testing.assert_array_equal(found["actions"], columns.actions)
    np.testing.assert_array_equal(found["rewards"], columns.rewards)
    np.testing.assert_array_equal(found["terminals"], columns.terminated)
    np.testing.assert_array_equal(found["timeouts"], columns.truncated)
    assert found["action_space"] == "continuous"
    assert found["action_size"] == 1
    assert "2 truncated episodes of one step" in caplog.text


def test_d3rlpy_discrete_actions_start_at_zero_and_images_keep_their_shape(given):
    data = simple(spaces.Box(0, 255, (3, 8, 8), np.uint8), spaces.Discrete(4, start=3))
    found = given(data)
    assert found["observations"].dtype == np.uint8
    assert found["observations"].shape == (6, 3, 8, 8)
    np.testing.assert_array_equal(found["actions"][:3, 0], data[0].actions - 3)
    assert (found["action_space"], found["action_size"]) == ("discrete", 4)
    assert found["timeouts"].tolist() == [0, 0, 1] * 2


def test_d3rlpy_refuses_what_its_format_cannot_hold(given, make_dataset):
    box = spaces.Box(-1, 1, (2,))
    with pytest.raises(InvalidDataError, match="Step 1 of episode 0 has an end flag"):
        given(simple(box, box, flags=[False, True, False]))
    with pytest.raises(InvalidDataError, match=r"no episodes"):
        given(make_dataset(LENGTHS).filter_episodes(lambda episode: False))
    steps = {"state_row": np.arange(3), "next_row": np.array([1, 9, 3]), "step": np.arange(3), "episode": np.zeros(3)}
    with pytest.raises(InvalidDataError, match="1 transitions, the first at step 1 of episode 0"):
        consumers._check_contiguous(steps)


def test_d3rlpy_refuses_actions_it_has_no_form_for(given):
    with pytest.raises(UnsupportedSpaceError, match="Box or Discrete actions"):
        given(simple(spaces.Box(-1, 1, (2,)), spaces.MultiDiscrete([2, 3])))


def test_bad_settings_are_errors(make_dataset):
    data = make_dataset(LENGTHS)
    with pytest.raises(ConfigurationError, match="not a multiple of slice_length=3"):
        to_torchrl(data, batch_size=256, slice_length=3)
    with pytest.raises(ConfigurationError, match="batch_size must be"):
        to_torchrl(data, batch_size=0)
    with pytest.raises(ConfigurationError, match="seed must be"):
        to_torchrl(data, seed=-1)


@pytest.mark.parametrize(("function", "module"), [(to_torchrl, "tensordict"), (to_d3rlpy, "d3rlpy.dataset")])
def test_a_missing_library_is_named(function, module, make_dataset, monkeypatch):
    monkeypatch.setitem(sys.modules, module, None)
    name = "torchrl" if function is to_torchrl else "d3rlpy"
    with pytest.raises(ImportError, match=f"{name} is needed for this and is not installed: pip install {name}"):
        function(make_dataset(LENGTHS))


def test_a_d4rl_file_is_a_source(given, tmp_path):
    box = spaces.Box(-1, 1, (2,))
    path = write_d4rl(simple(box, box), tmp_path / "simple.hdf5")
    for source in (path, str(path), "test/simple-v0"):
        assert given(source)["rewards"].tolist() == [0, 1, 2, 0, 1, 2]
        assert consumers._columns(source, flat=False).n_steps == 6


def test_what_is_no_dataset_is_an_error(given):
    with pytest.raises(ConfigurationError, match="A Minari dataset, the id of one"):
        given([1, 2])
