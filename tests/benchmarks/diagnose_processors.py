"""What makes the same seed give other last digits on another processor, and which settings even that.

    python tests/benchmarks/diagnose_processors.py --out FOLDER

Estimates by FQE, augments with OAT (maze2d-umaze, the first 40 episodes) and records roll-outs of two Adroit experts,
in a process of its own for each setting, with the kernels of MKL (torch's BLAS) for Intel's processors and for others,
with AVX2 and what the processor has, without and with settings that promise the same numbers everywhere. Rows with the
same letters have the same bytes. MKL asks a function of its own whether the processor is Intel's: a library in
LD_PRELOAD, which a C compiler makes here, answers in its place, so that one machine runs both. Needs Linux on x86-64,
`cc` and the experts' weights. Writes `FOLDER/diagnosis-processors.csv` and `.md`.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import torch
from reread import Row, write

import oat_gym
from oat_gym import ope
from oat_gym.domains.adroit_data import expert_dataset

CAPTION = (
    "Kernels for Intel's processors and for others, AVX2 and AVX-512: results with the same letter have the same bytes,"
    " in each column; CPU seconds of FQE and of OAT"
)
ANSWERS = {"intel": 1, "other": 0}
EVEN = {"MKL_CBWR": "COMPATIBLE"}
AVX2 = {"ATEN_CPU_CAPABILITY": "avx2"}
OTHER_BLAS = {"OPENBLAS_CORETYPE": "Haswell"}
VARIABLES = ({}, AVX2, OTHER_BLAS, EVEN, EVEN | AVX2, EVEN | AVX2 | OTHER_BLAS)
SETTINGS = tuple((vendor, variables) for variables in VARIABLES for vendor in ANSWERS)
EPISODES = 40
UPDATES = 200


def digest(arrays: Iterable[np.ndarray]) -> str:
    """Return a hash of the bytes of arrays."""
    found = hashlib.sha256()
    for array in arrays:
        found.update(np.ascontiguousarray(array).tobytes())
    return found.hexdigest()


def compute() -> dict[str, object]:
    """Return the hashes and CPU seconds of this process's setting."""
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    real = oat_gym.domains.load("maze2d-umaze").filter_episodes(lambda episode: episode.id < EPISODES)
    began = time.process_time()
    policies = oat_gym.domains.policies("maze2d-umaze")
    result = ope.evaluate(real, policies, [ope.FQE(updates=UPDATES)], gamma=0.99, horizon=100, seeds=1)
    estimated = time.process_time()
    data = oat_gym.AugmentedDataset(real, oat_gym.OAT(), factor=2, seed=0)
    made = digest(array for episode in data for array in (episode.actions, episode.rewards))
    augmented = time.process_time()
    experts = [expert_dataset(name, steps=2000) for name in ("door", "pen")]
    return {
        "FQE": digest([np.array([row["value"] for row in result.rows])]),
        "OAT": made,
        **{
            f"{name} expert": digest(e.observations for e in d)
            for name, d in zip(("door", "pen"), experts, strict=True)
        },
        "CPU s, FQE": estimated - began,
        "CPU s, OAT": augmented - estimated,
    }


def vendor_library(folder: Path, answer: int) -> Path:
    """Return a compiled library that tells MKL whether the processor is Intel's."""
    source, library = folder / f"vendor{answer}.c", folder / f"vendor{answer}.so"
    source.write_text(f"int mkl_serv_intel_cpu_true(void) {{ return {answer}; }}\n")
    subprocess.run(["cc", "-shared", "-fPIC", "-o", str(library), str(source)], check=True)
    return library


def measured(vendor: str, variables: dict[str, str], folder: Path) -> dict[str, object]:
    """Return what a process of this setting, with an empty cache, computes."""
    with tempfile.TemporaryDirectory() as cache:
        there = {"LD_PRELOAD": str(vendor_library(folder, ANSWERS[vendor])), "OAT_GYM_CACHE": cache}
        command = [sys.executable, __file__, "--one"]
        done = subprocess.run(command, env=os.environ | variables | there, check=True, stdout=subprocess.PIPE)
    return json.loads(done.stdout.splitlines()[-1])


def rows_of() -> list[Row]:
    """Return a row for each setting, hashes as letters in the order in which they came up."""
    letters: dict[str, list[object]] = {}
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as folder:
        for vendor, variables in SETTINGS:
            row = {
                "kernels of MKL": vendor,
                "settings": " ".join(f"{name}={value}" for name, value in variables.items()) or "-",
            }
            for name, value in measured(vendor, variables, Path(folder)).items():
                if isinstance(value, float):
                    row[name] = f"{value:.1f}"
                    continue
                known = letters.setdefault(name, [])
                if value not in known:
                    known.append(value)
                row[name] = "abcdefghijkl"[known.index(value)]
            rows.append(row)
            print(row, file=sys.stderr, flush=True)
    return rows


def main() -> None:
    """Read the command line and write the table, or compute one setting."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--one", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        print(json.dumps(compute()))
        return
    if options.out is None:
        parser.error("--out FOLDER is needed")
    write(options.out, rows_of(), name="diagnosis-processors", caption=CAPTION)
    print((options.out / "diagnosis-processors.md").read_text())


if __name__ == "__main__":
    main()
