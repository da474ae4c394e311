"""Results whose errors, and so whose tables, are known beforehand."""

import math
import time

import numpy as np

from oat_gym.benchmark.protocol import Question
from oat_gym.benchmark.results import Results, Setting
from oat_gym.benchmark.store import CellResult

POLICIES = tuple(f"p{number}" for number in range(7))
TRUE = np.linspace(0.0, 600.0, 7)
QUESTION = {"initial": "reset", "behavior": "clone", "gamma": None}
GROUND = {"data": "x", "computed": "numpy 2"}


def cell(
    dataset: str, variant: str, family: str, seed: int, *, error: float, known: bool = True, reason: str = ""
) -> CellResult:
    """A cell whose estimates are off by `error`, give or take 1."""
    rng = np.random.default_rng([seed, len(variant), len(family), int(error)])
    values = TRUE + error + rng.normal(size=7)
    return CellResult(
        dataset=dataset, task="adroit-door", variant=variant, family=family, estimator=family, seed=seed, budget="full",
        initial="reset (5 states)", policies=(*POLICIES[:6], "expert"), values=values,
        replicates=values[:, None] + rng.normal(size=(7, 40)), true=TRUE if known else np.full(7, math.nan),
        true_errors=np.zeros(7), reason=reason,
        record={
            "config": {"question": QUESTION, "ground": GROUND},
            "fingerprint": f"{dataset}{variant}{family}{seed}", "n_episodes": 25,
            "finished": float(seed), "gamma": 0.995, "horizon": 200, "truth_note": "" if known else "Nobody knows.",
            "environment": {"numpy": "2"}, "cost": {"cpu_seconds": 1.0, "wall_seconds": 2.0, "peak_memory_mb": 3.0},
        },
    )  # fmt: skip


ERRORS = {"none": 100.0, "oat-paper": 40.0, "jittering": 100.0, "scaling": 220.0}


def results_of(datasets: dict[str, bool], *, seeds: int = 3, extra: tuple[CellResult, ...] = ()) -> Results:
    cells = [
        cell(name, variant, family, seed, error=error, known=known)
        for name, known in datasets.items()
        for variant, error in ERRORS.items()
        for family in ("FQE", "IS")
        for seed in range(seeds)
    ]
    manifest = {
        "question": QUESTION, "budget": {"name": "full"}, "datasets": [*datasets, "adroit-pen-human"],
        "jobs_order": list(ERRORS), "missing": {"adroit-pen-human": "run `minari download D4RL/pen/human-v2`"},
        "grounds": dict.fromkeys(datasets, GROUND), "recorded": {name: [250.0, 20.0] for name in datasets},
        "cells": {}, "budget_line": "budget 'full'", "command": "oat-gym bench", "started": time.time(),
    }  # fmt: skip
    members = (*cells, *extra)
    manifest["cells"] = {str(number): part.record["fingerprint"] for number, part in enumerate(members)}
    return Results(Setting("full", Question()), members, (manifest,), ())
