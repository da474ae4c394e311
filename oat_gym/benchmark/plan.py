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
from oat_gym.benchmark.job import find_truth
from oat_gym.benchmark.measure import environment
from oat_gym.benchmark.protocol import Catalog, Job, Question, Suite, make_jobs
from oat_gym.benchmark.store import cell_path, finished
from oat_gym.benchmark.variants import Variant
from oat_gym.cache import canonical, fingerprint, write_atomically
from oat_gym.errors import ConfigurationError, DatasetNotFoundError
from oat_gym.source import Source


@dataclass(frozen=True)
class Plan:
    """A run before it starts.

    Attributes:
        suite: what is run.
        jobs: all jobs, finished ones too.
        missing: dataset -> why it cannot be run here, which says how to get it.
        unknown_truth: dataset -> why its policies' true values are unknown.
        policies: dataset -> number of target policies.
    """

    suite: Suite
    jobs: tuple[Job, ...]
    missing: dict[str, str]
    unknown_truth: dict[str, str]
    policies: dict[str, int]

    @property
    def n_cells(self) -> int:
        """Number of cells of all jobs."""
        return sum(len(job.budget.estimators) for job in self.jobs)

    def open_jobs(self, folder: Path) -> tuple[Job, ...]:
        """Return the jobs that have a cell without a finished file in `folder`."""
        return tuple(job for job in self.jobs if any(finished(cell_path(folder, cell)) is None for cell in job.cells()))


def make_plan(
    suite: Suite,
    variants: Sequence[Variant],
    *,
    seeds: Sequence[int],
    question: Question,
    budget: Budget,
    catalog: Catalog | None = None,
) -> Plan:
    """Return the plan of a suite; a dataset that is not at hand is named in `missing`, never an error.

    Raises:
        ConfigurationError: for no seed or a repeated one.
    """
    if not seeds or len(set(seeds)) < len(seeds):
        raise ConfigurationError(f"seeds must be different seeds, at least one, got {list(seeds)!r}.")
    places = catalog or Catalog.installed()
    content: dict[str, tuple[str, npt.NDArray[np.int64]]] = {}
    missing: dict[str, str] = {}
    unknown: dict[str, str] = {}
    policies: dict[str, int] = {}
    for name in suite.datasets:
        try:
            task = places.task_of(name)[1]
            policies[name] = len(task.policies())
            source = Source(places.load(name, episodes=budget.episodes))
            content[name] = source.fingerprint, source.lengths
        except (ConfigurationError, DatasetNotFoundError) as error:
            missing[name] = str(error)
            policies.pop(name, None)
            continue
        truth, why = find_truth(task, task.gamma if question.gamma is None else question.gamma)
        if truth is None:
            unknown[name] = why
    jobs = make_jobs(content, variants, seeds=seeds, question=question, budget=budget)
    return Plan(suite, jobs, missing, unknown, policies)


def write_manifest(folder: Path, plan: Plan, *, seeds: Sequence[int], device: str, command: str) -> Path:
    """Write what this run is, as `runs/SUITE-FINGERPRINT.json` in the folder of results; return the path.

    The same run again gives the same file name; runs of other suites, seeds or settings have files of their own, so
    that the parts of a benchmark can be computed in one folder or brought together in one.
    """
    variants = {job.variant.name: job.variant for job in plan.jobs}
    asked = {
        "suite": plan.suite.name,
        "datasets": plan.suite.datasets,
        "variants": {name: variant.description() for name, variant in variants.items()},
        "seeds": list(seeds),
        "missing": plan.missing,
        "question": plan.jobs[0].question if plan.jobs else None,
        "budget": plan.jobs[0].budget if plan.jobs else None,
    }
    told: dict[str, Any] = canonical(asked)
    told |= {
        "about": plan.suite.about,
        "unknown_truth": plan.unknown_truth,
        "policies": plan.policies,
        "jobs_order": list(variants),
        "notes": {name: variant.note for name, variant in variants.items()},
        "budget_line": plan.jobs[0].budget.describe() if plan.jobs else "",
        "cells": sorted(cell.fingerprint for job in plan.jobs for cell in job.cells()),
        "environment": environment(device),
        "command": command,
        "started": time.time(),
    }
    path = folder / "runs" / f"{plan.suite.name}-{fingerprint(run=canonical(asked))[:12]}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, (json.dumps(told, indent=1, sort_keys=True) + "\n").encode())
    return path


def read_manifests(folder: Path) -> list[dict[str, Any]]:
    """Return the manifests of a folder of results, the oldest first.

    Raises:
        ConfigurationError: where there is none: nothing was run there.
    """
    found: list[dict[str, Any]] = [json.loads(path.read_text()) for path in sorted((folder / "runs").glob("*.json"))]
    if not found:
        raise ConfigurationError(f"{folder} holds no results: run `oat-gym bench --suite quick --out {folder}` first.")
    return sorted(found, key=lambda manifest: float(manifest["started"]))
