"""What a run will do: which datasets are at hand, which jobs follow, which cells are finished already."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from oat_gym.benchmark.budget import Budget
from oat_gym.benchmark.ground import Ground, recorded_return, survey
from oat_gym.benchmark.job import find_truth
from oat_gym.benchmark.measure import environment
from oat_gym.benchmark.protocol import Catalog, Job, Question, Suite, make_jobs
from oat_gym.benchmark.store import cell_path, finished
from oat_gym.benchmark.variants import Variant
from oat_gym.cache import canonical, fingerprint, write_atomically
from oat_gym.domains import Truth
from oat_gym.errors import ConfigurationError, DatasetNotFoundError, InvalidDataError
from oat_gym.source import Source


@dataclass(frozen=True)
class Plan:
    """A run before it starts.

    Attributes:
        suite: what is run.
        jobs: all jobs, finished ones too.
        missing: dataset -> why it cannot be run here, which says how to get it.
        unknown_truth: dataset -> why its policies' true values are unknown.
        truths: dataset -> true values of its policies, where they are known.
        recorded: dataset -> mean return of its episodes and its standard error (`recorded_return`).
    """

    suite: Suite
    jobs: tuple[Job, ...]
    missing: dict[str, str]
    unknown_truth: dict[str, str]
    truths: dict[str, Truth]
    recorded: dict[str, tuple[float, float]]

    @property
    def n_cells(self) -> int:
        """Number of cells of all jobs."""
        return sum(len(job.budget.estimators) for job in self.jobs)

    def open_jobs(self, folder: Path) -> tuple[Job, ...]:
        """Return the jobs that have a cell without a finished file in `folder`."""
        return tuple(job for job in self.jobs if any(finished(cell_path(folder, cell)) is None for cell in job.cells()))

    def superseded(self, folder: Path) -> int:
        """Return how many of the plan's cells `folder` holds only for other settings, data or versions."""
        cells = [cell for job in self.jobs for cell in job.cells() if not cell_path(folder, cell).exists()]
        return sum(any(folder.glob(f"{cell.place}-*.safetensors")) for cell in cells)


def make_plan(
    suite: Suite,
    variants: Sequence[Variant],
    *,
    seeds: Sequence[int],
    question: Question,
    budget: Budget,
    device: str = "cpu",
    catalog: Catalog | None = None,
) -> Plan:
    """Return the plan of a suite; a dataset that is not at hand, or damaged, is named in `missing`, never an error.

    Raises:
        ConfigurationError: for no seed or a repeated one.
    """
    if not seeds or len(set(seeds)) < len(seeds):
        raise ConfigurationError(f"seeds must be different seeds, at least one, got {list(seeds)!r}.")
    places = catalog or Catalog.installed()
    content: dict[str, tuple[Ground, npt.NDArray[np.int64]]] = {}
    missing: dict[str, str] = {}
    unknown: dict[str, str] = {}
    truths: dict[str, Truth] = {}
    recorded: dict[str, tuple[float, float]] = {}
    for name in suite.datasets:
        try:
            task = places.task_of(name)[1]
            source = Source(places.load(name, episodes=budget.episodes))
            ground = survey(source, task, question.starts(task), gamma=question.gamma, device=device)
            recorded[name] = recorded_return(source, gamma=ground.gamma, horizon=ground.horizon)
        except (ConfigurationError, DatasetNotFoundError, InvalidDataError) as error:
            missing[name] = str(error)
            continue
        content[name] = ground, source.lengths
        truth, why = find_truth(task, ground.gamma)
        if truth is None:
            unknown[name] = why
        else:
            truths[name] = truth
    jobs = make_jobs(content, variants, seeds=seeds, question=question, budget=budget, device=device)
    return Plan(suite, jobs, missing, unknown, truths, recorded)


def write_manifest(folder: Path, plan: Plan, *, seeds: Sequence[int], device: str, command: str) -> Path:
    """Write what this run is, as `runs/SUITE-FINGERPRINT.json` in the folder of results; return the path.

    The same run again gives the same file name; runs of other suites, seeds or settings have files of their own, so
    that the parts of a benchmark can be computed in one folder or brought together in one.

    Raises:
        ConfigurationError: for a plan without jobs.
    """
    if not plan.jobs:
        raise ConfigurationError(f"There is nothing to run: {plan.missing}.")
    variants = {job.variant.name: job.variant for job in plan.jobs}
    asked = {
        "suite": plan.suite.name,
        "datasets": plan.suite.datasets,
        "variants": {name: variant.description() for name, variant in variants.items()},
        "seeds": list(seeds),
        "missing": plan.missing,
        "question": plan.jobs[0].question,
        "budget": plan.jobs[0].budget,
    }
    told: dict[str, Any] = canonical(asked)
    told |= {
        "about": plan.suite.about,
        "unknown_truth": plan.unknown_truth,
        "truths": {name: _truth(truth) for name, truth in plan.truths.items()},
        "truth_notes": {name: truth.note for name, truth in plan.truths.items()},
        "recorded": plan.recorded,
        "jobs_order": list(variants),
        "notes": {name: variant.note for name, variant in variants.items()},
        "budget_line": plan.jobs[0].budget.describe(),
        "grounds": canonical({job.dataset: job.ground for job in plan.jobs}),
        "augmented": {f"{job.dataset}/{job.variant.name}-{job.seed}": job.name for job in plan.jobs},
        "cells": {cell.place: cell.fingerprint for job in plan.jobs for cell in job.cells()},
        "environment": environment(device),
        "command": command,
        "started": time.time(),
    }
    path = folder / "runs" / f"{plan.suite.name}-{fingerprint(run=canonical(asked))[:12]}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, (json.dumps(told, indent=1, sort_keys=True) + "\n").encode())
    return path


def _truth(truth: Truth) -> dict[str, list[float]]:
    """Return policy -> [value, standard error]."""
    return {name: [float(value), float(truth.standard_errors[name])] for name, value in truth.values.items()}


def read_manifests(folder: Path) -> list[dict[str, Any]]:
    """Return the manifests of a folder of results, the oldest first.

    Raises:
        ConfigurationError: where there is none (nothing was run there), or one that this version cannot read.
    """
    found = [_read_manifest(path) for path in sorted((folder / "runs").glob("*.json"))]
    if not found:
        raise ConfigurationError(f"{folder} holds no results: run `oat-gym bench --suite quick --out {folder}` first.")
    return sorted(found, key=lambda manifest: float(manifest["started"]))


def _read_manifest(path: Path) -> dict[str, Any]:
    try:
        told = json.loads(path.read_text())
    except ValueError:
        told = None
    if not isinstance(told, dict) or not {"augmented", "grounds", "truths", "question", "started"} <= set(told):
        raise ConfigurationError(
            f"{path} was written by another version of oat_gym, or is damaged. Delete it and run `oat-gym bench` again "
            "with the same options (cells that are still valid are kept), or give another folder with --out."
        )
    return told
