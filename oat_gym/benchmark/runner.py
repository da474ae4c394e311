"""Running jobs: one after another, over processes, or over a Dask cluster, with an estimate of the time left."""

from __future__ import annotations

import contextlib
import statistics
from collections.abc import Callable, Generator, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import joblib

from oat_gym.benchmark.job import JobReport, run_job
from oat_gym.benchmark.plan import Plan
from oat_gym.benchmark.protocol import Catalog, Job
from oat_gym.benchmark.store import cell_path, finished
from oat_gym.errors import ConfigurationError, SaveError

Listener = Callable[["Pace", JobReport | None], None]
"""Called as listener(pace, report) before the first job (None) and after each."""


@dataclass
class Pace:
    """How far a run has come, and how long the rest will take.

    A job that is still open is expected to cost the median of the finished ones of its dataset and variant; of its
    dataset and any variant; of its variant; of all: the first of these of which one is finished. The rest's costs are
    divided by the number of workers.
    """

    open: dict[tuple[str, str, int], Job]
    workers: int
    done: list[JobReport] = field(default_factory=list[JobReport])
    total: int = 0

    @classmethod
    def of(cls, jobs: Sequence[Job], workers: int) -> Pace:
        """Return the pace of a run that starts now."""
        return cls({_key(job): job for job in jobs}, max(1, workers), total=len(jobs))

    def add(self, report: JobReport) -> None:
        """Take note of a finished job."""
        self.open.pop(_key(report.job), None)
        self.done.append(report)

    def seconds_left(self) -> float | None:
        """Return the expected wall seconds of the open jobs; None before the first is finished."""
        if not self.done:
            return None
        costs = sum(self._expected(job) for job in self.open.values())
        longest = max((self._expected(job) for job in self.open.values()), default=0.0)
        return max(costs / self.workers, longest)

    def _expected(self, job: Job) -> float:
        same: tuple[Callable[[Job], bool], ...] = (
            lambda other: (other.dataset, other.variant.name) == (job.dataset, job.variant.name),
            lambda other: other.dataset == job.dataset,
            lambda other: other.variant.name == job.variant.name,
            lambda other: True,
        )
        for alike in same:
            known = [report.wall_seconds for report in self.done if alike(report.job)]
            if known:
                return statistics.median(known)
        return 0.0


def run(
    plan: Plan,
    folder: Path,
    *,
    n_jobs: int = 1,
    scheduler: str | None = None,
    catalog: Catalog | None = None,
    listen: Listener | None = None,
) -> list[JobReport]:
    """Compute what a plan lacks in `folder`; finished cells are left as they are.

    Args:
        plan: what to do (`make_plan`).
        folder: of the results; with a cluster, one that all its workers see under the same name.
        n_jobs: processes at a time; -1: one for each core.
        scheduler: address of a Dask scheduler, as "tcp://host:8786": its workers take the jobs, and take over those of
            a worker that is lost. Needs the extra `distributed`.
        catalog: where names of datasets lead; the installed domains by default.
        listen: told of progress.

    Raises:
        ConfigurationError: for settings that cannot work.
        SaveError: where a worker wrote its cells elsewhere.
    """
    if n_jobs == 0 or n_jobs < -1:
        raise ConfigurationError(f"n_jobs must be a number of processes, or -1 for one a core, got {n_jobs}.")
    tell: Listener = listen or (lambda pace, report: None)
    jobs = plan.open_jobs(folder)
    with _backend(n_jobs, scheduler) as (workers, options):
        pace = Pace.of(jobs, min(workers, max(1, len(jobs))))
        tell(pace, None)
        for report in _results(jobs, folder.resolve(), catalog, options):
            _check_written(report, folder)
            pace.add(report)
            tell(pace, report)
    return pace.done


@contextlib.contextmanager
def _backend(n_jobs: int, scheduler: str | None) -> Generator[tuple[int, dict[str, Any]]]:
    """Give the number of workers and the options of `joblib.Parallel`."""
    if scheduler is None:
        workers = joblib.cpu_count() if n_jobs == -1 else n_jobs
        yield workers, {"n_jobs": n_jobs}
        return
    try:
        from distributed import Client  # noqa: PLC0415  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise ConfigurationError("--scheduler needs Dask: pip install 'oat-gym[distributed]'.") from error
    try:
        client: Any = Client(scheduler, timeout=10)
    except (OSError, ValueError) as error:
        raise ConfigurationError(f"No Dask scheduler answers at {scheduler!r} ({error}).") from error
    with client:
        workers = sum(client.ncores().values())
        with joblib.parallel_config(backend="dask", wait_for_workers_timeout=30):
            yield workers, {"n_jobs": -1}


def _results(
    jobs: Sequence[Job], folder: Path, catalog: Catalog | None, options: dict[str, Any]
) -> Iterable[JobReport]:
    if options["n_jobs"] == 1:
        return (run_job(job, folder, catalog=catalog) for job in jobs)
    # One job a task: batches would tie long jobs together.
    settings: dict[str, Any] = {"return_as": "generator_unordered", "batch_size": 1, **options}
    calls = (joblib.delayed(run_job)(job, folder, catalog=catalog) for job in jobs)
    return cast("Iterable[JobReport]", joblib.Parallel(**settings)(calls))


def _check_written(report: JobReport, folder: Path) -> None:
    """Raise unless the cells that a worker calls finished can be read here."""
    failed = {fingerprint for fingerprint, reason in report.cells if reason}
    for cell in report.job.cells():
        if cell.fingerprint not in failed and finished(cell_path(folder, cell)) is None:
            raise SaveError(
                f"A worker finished {cell.name}, and {folder} does not have it: give a folder (--out) that all "
                "workers see under the same name."
            )


def _key(job: Job) -> tuple[str, str, int]:
    return job.dataset, job.variant.name, job.seed


def format_seconds(seconds: float | None) -> str:
    """Return a duration in words short enough for a progress bar.

    >>> format_seconds(None), format_seconds(75), format_seconds(7500)
    ('?', '1 min 15 s', '2 h 5 min')
    """
    if seconds is None:
        return "?"
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60} s"
    return f"{whole // 3600} h {whole % 3600 // 60} min"
