"""One job: augment a dataset once, estimate every policy with every estimator, write each cell as it is finished."""

from __future__ import annotations

import contextlib
import math
import time
import warnings
from collections.abc import Callable, Generator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from minari import MinariDataset
from threadpoolctl import threadpool_limits

from oat_gym import ope
from oat_gym.augmenters import Augmenter
from oat_gym.benchmark.augmented import describe_augmented
from oat_gym.benchmark.measure import Clock, environment
from oat_gym.benchmark.protocol import Catalog, Cell, Job
from oat_gym.benchmark.store import CellResult, cell_path, finished, write_augmented, write_result
from oat_gym.benchmark.variants import on_device
from oat_gym.dataset import AugmentedDataset
from oat_gym.domains import Task, Truth
from oat_gym.domains.adroit_rewards import RewardWarning
from oat_gym.errors import ConfigurationError, DatasetNotFoundError, EstimationWarning, OatGymError
from oat_gym.ope.problem import Problem

FAILURES: tuple[type[Exception], ...] = (OatGymError, ArithmeticError, MemoryError, RuntimeError, ValueError)
"""What one cell may fail with while the others go on; anything else is a bug and ends the run."""


@dataclass(frozen=True)
class JobReport:
    """What became of a job: (fingerprint, reason of failure or "") of each cell, and what it cost."""

    job: Job
    cells: tuple[tuple[str, str], ...]
    cpu_seconds: float
    wall_seconds: float


def run_job(job: Job, folder: Path, *, catalog: Catalog | None = None) -> JobReport:
    """Compute the cells of a job that are not finished, and write their files into `folder`.

    Everything runs on one thread: sums over several threads differ in their last digits with the number of threads,
    and a cell's result is to depend on its own inputs and seed only. A cell that fails is written with the reason.
    """
    clock, places = Clock(), catalog or Catalog.installed()
    missing = [cell for cell in job.cells() if finished(cell_path(folder, cell)) is None]
    with one_thread(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        desk = _Desk(job, folder, tuple(missing), {})
        if missing:
            try:
                _evaluate(desk, places)
            except FAILURES as error:
                _fail_rest(desk, places, f"{type(error).__name__}: {error}")
    cost = clock.cost()
    report = tuple((cell.fingerprint, desk.reasons.get(cell.fingerprint, "")) for cell in job.cells())
    return JobReport(job, report, cost["cpu_seconds"], cost["wall_seconds"])


@contextlib.contextmanager
def one_thread() -> Generator[None]:
    """Limit torch and the linear algebra libraries to one thread."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with threadpool_limits(limits=1):
            yield
    finally:
        torch.set_num_threads(before)


@dataclass(frozen=True)
class _Desk:
    """What the parts of a job share; `reasons` collects why cells failed ("": they did not)."""

    job: Job
    folder: Path
    missing: tuple[Cell, ...]
    reasons: dict[str, str]


@dataclass(frozen=True)
class Measured(ope.Estimator):
    """An estimator whose cost is measured, and whose estimates or failure are handed over as soon as they are there.

    It makes one failing estimator a failed cell and not the end of the job: NaN estimates are returned for it.
    """

    inner: ope.Estimator
    done: Callable[[ope.Estimates | str, Mapping[str, Any]], None]
    family: ClassVar[str] = "measured"

    @property
    def name(self) -> str:
        """The name of the estimator inside."""
        return self.inner.name

    def estimate(self, problem: Problem, *, seeds: tuple[int, ...]) -> tuple[ope.Estimates, ...]:
        """Return the estimates of the estimator inside, or NaN where it failed."""
        clock = Clock()
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            try:
                self.inner.check(problem)
                found = self.inner.estimate(problem, seeds=seeds)
            except FAILURES as error:
                self.done(f"{type(error).__name__}: {error}", {"cost": clock.cost(), "warnings": []})
                return tuple(_nothing(problem) for _ in seeds)
        texts = [str(warning.message) for warning in caught if issubclass(warning.category, EstimationWarning)]
        self.done(found[0], {"cost": clock.cost(), "warnings": list(dict.fromkeys(texts))})
        return found


def _nothing(problem: Problem) -> ope.Estimates:
    n_policies = len(problem.policies)
    nan = np.full((n_policies, len(problem.resamples)), math.nan)
    return ope.Estimates(nan[:, 0], nan, tuple({} for _ in range(n_policies)))


def _evaluate(desk: _Desk, places: Catalog) -> None:
    job = desk.job
    real, doubts = _load(places, job)
    name, task = places.task_of(job.dataset)
    policies = task.policies()
    augmenter = job.variant.with_policies(policies)
    data, augmentation = _augment(desk, real, augmenter, name, _curves(places, job, real, policies))
    known = _known(task, job, list(policies), real.total_episodes, name)
    known["truth_note"] = " ".join(text for text in (known["truth_note"], *doubts) if text)
    estimators = [Measured(cell.estimator[1], _writer(desk, cell, known, augmentation)) for cell in desk.missing]
    ope.evaluate(
        data,
        policies,
        estimators,
        gamma=job.ground.gamma,
        horizon=job.ground.horizon,
        seeds=(job.seed,),
        behavior=job.budget.cloning if job.question.behavior == "clone" else "logged",
        initial_states=job.question.starts(task),
        use_augmented=_by_name(job.variant.use_augmented, estimators),
        resamples=job.question.resamples,
        device=job.device,
        progress=False,
    )


def _load(places: Catalog, job: Job) -> tuple[MinariDataset, list[str]]:
    """Return a job's dataset and what was said of its rewards when it was opened."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        real = places.load(job.dataset, episodes=job.budget.episodes)
    return real, [str(warning.message) for warning in caught if issubclass(warning.category, RewardWarning)]


def _by_name(use: ope.UseAugmented, estimators: list[Measured]) -> ope.UseAugmented:
    """Return a use that names families (which a measured estimator hides) as one that names estimators."""
    if not isinstance(use, Mapping):
        return use
    names = {each.name: next((n for n in (each.name, each.inner.family) if n in use), None) for each in estimators}
    return {name: ("training",) if found is None else use[found] for name, found in names.items()}


def _curves(
    places: Catalog, job: Job, real: MinariDataset, policies: Mapping[str, ope.Policy]
) -> dict[str, Any] | None:
    """Return the agreement curves of a dataset that has them, with the job that augments nothing."""
    if job.variant.augmenter is not None or job.dataset not in places.curves:
        return None
    event, compute = places.curves[job.dataset]
    names = {"at": "low", "rate": "rate", "low": "rate_low", "high": "rate_high", "count": "count"}
    curves = {
        policy: {key: [float(value) for value in getattr(curve, name)] for key, name in names.items()}
        for policy, curve in compute(real, policies).items()
    }
    return {"event": event, "curves": curves}


def _augment(
    desk: _Desk, real: MinariDataset, augmenter: Augmenter | None, task: str, agreement: dict[str, Any] | None
) -> tuple[MinariDataset, dict[str, Any]]:
    """Return the dataset of the job and what making it cost; its description is written into the folder."""
    job, clock = desk.job, Clock()
    data, kept = real, False
    if augmenter is not None:
        data = AugmentedDataset(real, on_device(augmenter, job.device), factor=job.variant.factor, seed=job.seed)
        kept = data.is_fitted
        data.fit(progress=False)
    arrays, value = describe_augmented(data, real, seed=job.seed)
    cost = clock.cost() | {"from_cache": kept}
    heads = {"dataset": job.dataset, "task": task, "variant": job.variant.name, "note": job.variant.note}
    heads |= {"seed": job.seed, "budget": job.budget.name, "cost": cost, "agreement": agreement}
    write_augmented(desk.folder, job.name, arrays, heads | value)
    return data, cost


def find_truth(task: Task, gamma: float) -> tuple[Truth | None, str]:
    """Return the true values of a task, or None and why nobody knows them."""
    if task.truth is None:
        return None, "The log is of real people: nobody knows what the policies would have earned."
    try:
        return task.truth(gamma), ""
    except (DatasetNotFoundError, ConfigurationError) as error:
        return None, str(error)


def _known(task: Task, job: Job, policies: list[str], episodes: int, name: str) -> dict[str, Any]:
    """Return what all cells of a job say of their task: discount, horizon, true values."""
    truth, why = find_truth(task, job.ground.gamma)
    values = [math.nan if truth is None else float(truth.values.get(name, math.nan)) for name in policies]
    errors = [math.nan if truth is None else float(truth.standard_errors.get(name, math.nan)) for name in policies]
    return {
        "task": name,
        "paper": task.paper,
        "policies": policies,
        "gamma": job.ground.gamma,
        "horizon": job.ground.horizon,
        "truth": {"values": values, "errors": errors, "episodes": 0 if truth is None else truth.episodes},
        "truth_note": why if truth is None else truth.note,
        "n_episodes": int(episodes),
    }


def _writer(
    desk: _Desk, cell: Cell, known: Mapping[str, Any], augmentation: Mapping[str, Any]
) -> Callable[[ope.Estimates | str, Mapping[str, Any]], None]:
    """Return what writes a cell's file when its estimator is done."""

    def write(found: ope.Estimates | str, extra: Mapping[str, Any]) -> None:
        blank = _blank(desk, cell, known)
        record = dict(blank.record) | dict(extra) | {"augmentation_cost": dict(augmentation)}
        if not isinstance(found, str) and not np.isfinite(found.values).all():
            bad = [name for name, value in zip(blank.policies, found.values, strict=True) if not np.isfinite(value)]
            found = f"the estimates of {', '.join(bad)} are not finite"
        if isinstance(found, str):
            result = replace(blank, reason=found, record=record)
        else:
            diagnostics = [{key: float(value) for key, value in each.items()} for each in found.diagnostics]
            record |= {"diagnostics": diagnostics}
            result = replace(blank, values=found.values, replicates=found.replicates, record=record)
        desk.reasons[cell.fingerprint] = result.reason
        write_result(cell_path(desk.folder, cell), result)

    return write


def _blank(desk: _Desk, cell: Cell, known: Mapping[str, Any]) -> CellResult:
    """Return a cell without estimates."""
    truth, job = known["truth"], desk.job
    shape = (len(known["policies"]), job.question.resamples)
    start = "data" if job.ground.starts == "data" else f"reset ({job.question.resets} states)"
    heads = {name: known[name] for name in ("paper", "gamma", "horizon", "truth_note", "n_episodes")}
    return CellResult(
        dataset=cell.dataset,
        task=known["task"],
        variant=cell.variant.name,
        family=cell.estimator[1].family,
        estimator=cell.estimator[1].name,
        seed=cell.seed,
        budget=job.budget.name,
        initial=start,
        policies=tuple(known["policies"]),
        values=np.full(shape[0], math.nan),
        replicates=np.full(shape, math.nan),
        true=np.array(truth["values"], dtype=np.float64),
        true_errors=np.array(truth["errors"], dtype=np.float64),
        reason="",
        record=heads
        | {
            "config": cell.config,
            "fingerprint": cell.fingerprint,
            "truth_episodes": truth["episodes"],
            "environment": environment(job.device),
            "finished": time.time(),
            "diagnostics": [],
        },
    )


def _fail_rest(desk: _Desk, places: Catalog, reason: str) -> None:
    """Write a failed cell for each one that did not come to its estimator."""
    name, task = places.task_of(desk.job.dataset)
    known = _known(task, desk.job, [], 0, name)
    for cell in desk.missing:
        if cell.fingerprint not in desk.reasons:
            desk.reasons[cell.fingerprint] = reason
            write_result(cell_path(desk.folder, cell), replace(_blank(desk, cell, known), reason=reason))
