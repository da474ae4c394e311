"""`oat-gym bench`: a suite of the benchmark, resumable, over processes or a cluster."""

from __future__ import annotations

import contextlib
import shlex
import sys
from collections.abc import Generator
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from oat_gym.benchmark.analysis import Analysis
from oat_gym.benchmark.budget import BUDGETS, Budget
from oat_gym.benchmark.grid import write_tables
from oat_gym.benchmark.job import JobReport
from oat_gym.benchmark.plan import Plan, make_plan, read_manifests, write_manifest
from oat_gym.benchmark.protocol import SUITES, Question, Suite, find_suite
from oat_gym.benchmark.results import Results, read_results
from oat_gym.benchmark.runner import Listener, Pace, format_seconds, run
from oat_gym.benchmark.story import best_sentences, groups_of
from oat_gym.benchmark.tables import all_tables
from oat_gym.benchmark.tidy import write_tidy
from oat_gym.benchmark.variants import VARIANTS, Variant, find_variant, parse_variants
from oat_gym.cli._output import prepare_folder
from oat_gym.cli._shared import check_choice, out
from oat_gym.errors import ConfigurationError, DatasetNotFoundError

Folder = Annotated[Path, typer.Option("--out", help="Folder of the results; a run goes on where it was stopped.")]


def bench(
    suite: Annotated[str, typer.Option(help=f"One of {', '.join(SUITES)}.")] = "quick",
    augmenters: Annotated[str, typer.Option(help=f"all, or some of {', '.join(VARIANTS)}.")] = "all",
    datasets: Annotated[str, typer.Option(help="all of the suite, or some of them.")] = "all",
    estimators: Annotated[str, typer.Option(help="all, or some of fqe,is,dice,dr,mb.")] = "all",
    seeds: Annotated[int | None, typer.Option(help="How many seeds (0, 1, ...); the suite's own number.")] = None,
    seed: Annotated[int | None, typer.Option(help="This seed alone, to share seeds out over machines.")] = None,
    folder: Folder = Path("oat-gym-bench"),
    jobs: Annotated[int, typer.Option(help="Processes at a time; -1: one for each core.")] = 1,
    scheduler: Annotated[str | None, typer.Option(help="Address of a Dask scheduler, as tcp://host:8786.")] = None,
    device: Annotated[str, typer.Option(help="Torch device: cpu or cuda.")] = "cpu",
    budget: Annotated[str | None, typer.Option(help=f"Training: {', '.join(BUDGETS)}; the suite's own.")] = None,
    quick: Annotated[
        bool, typer.Option(help="The same as --budget quick: a moment's training, to try it out.")
    ] = False,
    initial: Annotated[str, typer.Option(help="Where values count from: reset (the environment) or data.")] = "reset",
    behavior: Annotated[str, typer.Option(help="Behaviour policy: clone, or logged.")] = "clone",
    gamma: Annotated[float | None, typer.Option(help="Discount; the task's own.")] = None,
) -> None:
    """Compare ways of augmenting by what they do to off-policy evaluation.

    Every dataset of the suite is augmented in every way and evaluated by every estimator with every seed. Finished
    cells are files of the folder: run the same command again after an interruption and it goes on. Tables and CSV
    files are written at the end; `oat-gym report FOLDER` makes a page of them.
    """
    chosen = _narrow(find_suite(suite), datasets)
    variants = _variants(chosen, augmenters)
    numbers = _seeds(chosen, seeds, seed)
    settings = _budget(chosen, budget, quick=quick).choose(estimators)
    question = _question(initial, behavior, gamma)
    _check_folder(folder)
    _check_device(device)
    plan = make_plan(chosen, variants, seeds=numbers, question=question, budget=settings, device=device)
    _tell_plan(plan, folder)
    if not plan.jobs:
        raise DatasetNotFoundError(f"No dataset of the suite {suite!r} is on this machine: see above how to get them.")
    command = f"oat-gym {shlex.join(sys.argv[1:])}"
    write_manifest(folder, plan, seeds=numbers, device=device, command=command)
    with _display(plan) as listen:
        reports = run(plan, folder, n_jobs=jobs, scheduler=scheduler, listen=listen)
    _tell_failures(reports)
    for results in read_results(folder):
        _finish(results, folder, plan.suite.datasets)
    out.print(f"A page to read: oat-gym report {folder}")


def _narrow(suite: Suite, names: str) -> Suite:
    """Return the suite with some of its datasets."""
    if names.strip() == "all":
        return suite
    wanted = tuple(dict.fromkeys(name.strip() for name in names.split(",")))
    unknown = [name for name in wanted if name not in suite.datasets]
    if unknown:
        raise ConfigurationError(
            f"The suite {suite.name!r} has no dataset {', '.join(unknown)}; it has {', '.join(suite.datasets)}."
        )
    return replace(suite, datasets=wanted)


def _variants(suite: Suite, names: str) -> tuple[Variant, ...]:
    if names.strip() == "all":
        return tuple(find_variant(name) for name in suite.variants)
    return parse_variants(names)


def _budget(suite: Suite, name: str | None, *, quick: bool) -> Budget:
    if quick and name not in (None, "quick"):
        raise ConfigurationError(f"Give --quick or --budget {name}, not both.")
    if name is not None:
        check_choice("--budget", name, tuple(BUDGETS))
    return BUDGETS["quick" if quick else name or suite.budget]


def _seeds(suite: Suite, seeds: int | None, seed: int | None) -> list[int]:
    if seed is not None and seeds is not None:
        raise ConfigurationError("Give --seeds N for seeds 0 to N-1, or --seed S for one, not both.")
    if seed is not None:
        return [seed]
    count = suite.seeds if seeds is None else seeds
    if count < 1:
        raise ConfigurationError(f"--seeds must be at least 1, got {count}.")
    return list(range(count))


def _question(initial: str, behavior: str, gamma: float | None) -> Question:
    check_choice("--initial", initial, ("reset", "data"))
    check_choice("--behavior", behavior, ("clone", "logged"))
    if gamma is not None and not 0 < gamma <= 1:
        raise ConfigurationError(f"--gamma must be above 0 and at most 1, got {gamma}.")
    return Question(
        initial="reset" if initial == "reset" else "data",
        behavior="clone" if behavior == "clone" else "logged",
        gamma=gamma,
    )


def _check_folder(folder: Path) -> None:
    prepare_folder(folder)
    if any((folder / "runs").glob("*.json")):
        read_manifests(folder)  # now, not after hours of computing


def _check_device(device: str) -> None:
    import torch  # noqa: PLC0415  (slow to import)

    try:
        torch.zeros(1, device=device)
    except (AssertionError, RuntimeError) as error:
        raise ConfigurationError(f"--device {device!r} cannot be used here ({error}); try cpu.") from error


def _tell_plan(plan: Plan, folder: Path) -> None:
    out.print(f"Suite {plan.suite.name}: {plan.suite.about}")
    for name, why in plan.missing.items():
        out.print(f"  {name}: not measured. {why}", markup=False)
    for name, why in plan.unknown_truth.items():
        out.print(f"  {name}: no error can be computed. {why}", markup=False)
    open_jobs = len(plan.open_jobs(folder))
    others = plan.superseded(folder)
    if others:
        out.print(
            f"  {others} cells of {folder} are of other settings, data or library versions than this run's: they are "
            "kept, and computed again for this one."
        )
    out.print(
        f"{plan.n_cells} cells in {len(plan.jobs)} jobs, {len(plan.jobs) - open_jobs} of them finished, in {folder}"
    )


@contextlib.contextmanager
def _display(plan: Plan) -> Generator[Listener]:
    """Give a listener that shows progress and the time left: a bar at a terminal, lines elsewhere."""
    if not sys.stderr.isatty():
        yield _print_line
        return
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task(plan.suite.name, total=len(plan.jobs))

        def show(pace: Pace, report: JobReport | None) -> None:
            text = f"{plan.suite.name}, {format_seconds(pace.seconds_left())} left"
            bar.update(task, description=text, completed=len(pace.done), total=pace.total)

        yield show


def _print_line(pace: Pace, report: JobReport | None) -> None:
    if report is None:
        return
    job, failed = report.job, sum(bool(reason) for _, reason in report.cells)
    print(
        f"{len(pace.done)}/{pace.total} {job.dataset} {job.variant.name} seed {job.seed}: "
        f"{format_seconds(report.wall_seconds)}{f', {failed} cells failed' if failed else ''}; "
        f"{format_seconds(pace.seconds_left())} left",
        file=sys.stderr,
        flush=True,
    )


def _tell_failures(reports: list[JobReport]) -> None:
    reasons: dict[str, int] = {}
    for report in reports:
        for _, reason in report.cells:
            if reason:
                reasons[reason] = reasons.get(reason, 0) + 1
    for reason, count in reasons.items():
        out.print(f"{count} cells failed: {reason}", markup=False)


def _finish(results: Results, folder: Path, asked: tuple[str, ...]) -> None:
    """Write tables and tidy files of a setting, and print what was found on the datasets of this run."""
    setting = results.setting
    where = folder / "tables" / setting.slug
    analysis = Analysis(results)
    if not results.cells:
        return
    write_tidy(analysis, where)
    write_tables(all_tables(analysis), where)
    for group, _ in groups_of(analysis):
        lines = best_sentences(analysis, group) if set(group[1]) & set(asked) else []
        if lines:
            out.print(f"{group[0]}, averages over {', '.join(results.families)}, {setting.describe()}:", markup=False)
        for line in lines:
            out.print(f"  {line}")
    out.print(f"Tables: {where}")
