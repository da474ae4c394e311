"""Kills and competing processes: the short form of `kill.py` and `crowd.py`, which also run by themselves."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest


@pytest.fixture(scope="module")
def summary() -> dict[str, Any]:
    script = Path(__file__).with_name("short.py")
    done = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, timeout=280, check=False)
    assert done.returncode == 0, done.stderr[-4000:]
    return json.loads(done.stdout)


def test_a_kill_at_a_random_moment_loses_nothing(summary: dict[str, Any]) -> None:
    assert sum(summary["random"]["phases"].values()) == 6


def test_a_kill_before_any_change_of_the_file_system_loses_nothing(summary: dict[str, Any]) -> None:
    assert sum(summary["steps"]["phases"].values()) == 3
    assert all(steps > 5 for steps in summary["steps"]["steps"].values())


def test_of_eight_processes_one_trains_and_all_read_the_same(summary: dict[str, Any]) -> None:
    assert summary["crowd"]["fit"] == {"trained": 1, "failed": 0, "entries": 2, "same": 1, "left": []}


def test_a_killed_holder_of_the_lock_does_not_stop_the_next(summary: dict[str, Any]) -> None:
    assert summary["crowd"]["holder"] == {"before": 1, "trained": 2, "failed": 0, "left": []}


def test_of_eight_saves_under_one_id_one_wins_whole(summary: dict[str, Any]) -> None:
    save = summary["crowd"]["save"]
    assert (save["saved"], save["exists"], save["winner"], save["left"]) == (1, 7, True, [])
