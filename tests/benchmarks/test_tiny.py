"""A tiny cell of each benchmark, so that none of them rots; the numbers mean nothing here."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent
CELLS = {
    "bench_dtw.py": ("--rows", "30", "--features", "3", "--repeats", "2"),
    "bench_importance.py": ("--episodes", "300", "--length", "10", "--resamples", "20", "--peer-resamples", "1"),
    "bench_timegan_sine.py": (
        "--samples",
        "60",
        "--iterations",
        "2",
        "2",
        "2",
        "--batch",
        "16",
        "--repeats",
        "1",
        "--judging",
        "0.01",
    ),
    "bench_envs.py": ("--beds", "20", "--steps", "5", "--peer-steps", "2"),
    "bench_augmenters.py": ("--dataset", "oat_gym/maze2d-umaze-v0", "--factor", "1.1", "--only", "jittering,spawner"),
}


def run(name: str, *arguments: str, folder: Path) -> str:
    done = subprocess.run(
        [sys.executable, str(HERE / name), *arguments], cwd=folder, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize("name", CELLS)
def test_a_tiny_cell_runs(name: str, tmp_path: Path) -> None:
    assert run(name, *CELLS[name], folder=tmp_path)


@pytest.mark.skipif("OAT_GYM_D3RLPY_PYTHON" not in os.environ, reason="OAT_GYM_D3RLPY_PYTHON names no interpreter")
def test_fqe_beside_d3rlpy(tmp_path: Path) -> None:
    assert '"peer"' in run("bench_fqe.py", "--updates", "5", "--rounds", "1", folder=tmp_path)


def test_the_door_evidence(shared_data: Path, tmp_path: Path) -> None:
    run("ope_door_human.py", "run", "--out", str(tmp_path), "--cells", "is-endless", "--seeds", "1", folder=tmp_path)
    run("ope_door_human.py", "tables", "--out", str(tmp_path), folder=tmp_path)
    again = run(
        *("ope_door_human.py", "run", "--out", str(tmp_path)), "--cells", "is-endless", "--seeds", "1", folder=tmp_path
    )
    assert again == ""  # a finished cell is not run again
    assert len((tmp_path / "policies.csv").read_text().splitlines()) == 1 + 11


def test_the_diagnosis_of_training(tmp_path: Path) -> None:
    script, out = "diagnose_training.py", str(tmp_path / "cells")
    settings = ("--dataset", "maze2d-umaze", "--seeds", "1", "--budget", "quick", "--estimators", "fqe,is")
    run(script, "run", "--out", out, *settings, folder=tmp_path)
    again = run(script, "run", "--out", out, *settings, folder=tmp_path)
    assert {line.split(": ")[1].split(" jobs")[0] for line in again.splitlines()} == {"0"}
    table = run(script, "tables", "--out", out, "--to", str(tmp_path / "tables"), folder=tmp_path)
    rows = [[cell.strip() for cell in line.split("|")[2:4]] for line in table.splitlines() if "maze2d" in line]
    changes = (
        "none",
        "copies",
        "updates x0.1",
        "updates x10",
        "oat",
        "oat-paper updates x10",
        "data starts",
        "endless",
    )
    assert {("FQE", change) for change in changes} <= {(family, change) for family, change in rows}
    assert ("IS", "updates x10") not in {tuple(row) for row in rows}  # it takes no gradient steps
