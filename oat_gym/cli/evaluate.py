"""`oat-gym evaluate`: the values of policies from weight files, estimated from a dataset, augmented or not."""

from __future__ import annotations

import csv
import io
import math
from pathlib import Path
from typing import Annotated, Any

import typer
from gymnasium import spaces
from minari import MinariDataset
from rich.table import Table

from oat_gym import domains, ope
from oat_gym.augmenters import AUGMENTERS
from oat_gym.cache import write_atomically
from oat_gym.cli._output import prepare_file
from oat_gym.cli._shared import Dataset, Factor, Seed, check_choice, find_augmenter, length_advice, open_source, out
from oat_gym.dataset import AugmentedDataset
from oat_gym.errors import ConfigurationError, DatasetNotFoundError, InvalidDataError
from oat_gym.ope.result import PARTIAL, check_range
from oat_gym.progress import progress_bar
from oat_gym.spaces import Batch

_RESETS = 200
_LENGTH_ADVICE = "Use `oat-gym augment --length {length}` first, and evaluate what it writes."
_PARTS: dict[str, ope.UseAugmented] = {"training": None, "all": "all", "none": "none"}
Policies = Annotated[
    str | None, typer.Option(help="Folder of policy weights (npz, as DOPE's), or a task; else the task of DATASET.")
]
Use = Annotated[str, typer.Option(help=f"What sees synthetic episodes: {', '.join(_PARTS)}.")]
Initial = Annotated[
    str, typer.Option(help="Where values count from: data (its first states), or reset (the task's environment).")
]
Within = Annotated[
    tuple[float, float] | None,
    typer.Option(metavar="LOW HIGH", help="What policies can earn: estimates beyond are moved to the nearer one."),
]


def evaluate(
    dataset: Dataset,
    policies: Policies = None,
    estimators: Annotated[str, typer.Option(help=f"all, or some of {','.join(ope.ESTIMATORS)}.")] = "all",
    gamma: Annotated[float | None, typer.Option(help="Discount; else the task's, or 0.995.")] = None,
    horizon: Annotated[int | None, typer.Option(help="Steps whose rewards count; else the task's, or all.")] = None,
    seeds: Annotated[int, typer.Option(help="How many seeds each estimator is run with.")] = 3,
    augmenter: Annotated[str, typer.Option(help=f"none, or one of {', '.join(AUGMENTERS)}.")] = "none",
    factor: Factor = 10,
    seed: Seed = 0,
    use_augmented: Use = "training",
    behavior: Annotated[str, typer.Option(help="Behaviour policy: clone, or logged (infos['log_prob']).")] = "clone",
    truth: Annotated[Path | None, typer.Option(help="CSV of true values, columns policy and value.")] = None,
    initial: Initial = "data",
    within: Within = None,
    file: Annotated[Path | None, typer.Option("--out", help="CSV file for every estimate.")] = None,
) -> None:
    """Estimate what each policy would earn, from the episodes of DATASET.

    With an augmenter (or a dataset that is augmented already) every estimate is made with and without the synthetic
    episodes, and the change is shown. Estimates for a task's policies are compared with their true values, where these
    are known.
    """
    chosen = _estimators(estimators)
    check_choice("--use-augmented", use_augmented, tuple(_PARTS))
    check_choice("--initial", initial, ("data", "reset"))
    check_choice("--behavior", behavior, ("clone", "logged"))
    if seeds < 1:
        raise ConfigurationError(f"--seeds must be at least 1, got {seeds}.")
    if within is not None:
        check_range(*within)
    given = None if truth is None else read_truth(truth)
    data = _data(dataset, augmenter, factor, seed)
    targets, task = _targets(policies, dataset, data)
    gamma = (task.gamma if task else 0.995) if gamma is None else gamma
    horizon = task.horizon if horizon is None and task else horizon
    starts = _initial_states(task) if initial == "reset" else None
    known = _known(given, task, list(targets), gamma=gamma, horizon=horizon)
    if file is not None:
        prepare_file(file)
    with progress_bar() as progress, length_advice(_LENGTH_ADVICE):
        if isinstance(data, AugmentedDataset):
            data.fit(progress=progress)
        result = ope.evaluate(
            data,
            targets,
            chosen,
            gamma=gamma,
            horizon=horizon,
            seeds=seeds,
            behavior="logged" if behavior == "logged" else "clone",
            initial_states=starts,
            use_augmented=_PARTS[use_augmented],
            paired=isinstance(data, AugmentedDataset) and use_augmented != "none",
            progress=progress,
        )
    result = result if within is None else result.within(*within)
    _tell(result, known, file, elsewhere=starts is None and task is not None and task.initial_states is not None)


def _tell(
    result: ope.Result, known: dict[str, float] | domains.Truth | None, file: Path | None, *, elsewhere: bool
) -> None:
    """Print estimates and errors, and write the file; `elsewhere`: true values count from other states."""
    _print_estimates(result)
    if file is not None:
        write_atomically(file, to_csv(result.rows).encode())
        out.print(f"Every estimate: {file}")
    if known is not None:
        if elsewhere:
            out.print("True values count from the environment's resets, estimates from the data's first states.")
        _print_errors(result, known)


def _print_estimates(result: ope.Result) -> None:
    interval = ("standard_error", "low", "high", "covers_training")
    averages = result.over_seeds()
    _print_rows(averages, ("policy", "estimator", "data", "value", *interval))
    if result.question.paired:
        out.print("Change by the synthetic episodes:")
        _print_rows(result.differences, ("policy", "estimator", "seed", "difference", *interval))
    if not all(row["covers_training"] for row in averages):
        out.print("covers training False: " + " ".join(PARTIAL))


def _print_errors(result: ope.Result, known: dict[str, float] | domains.Truth) -> None:
    columns = ("estimator", "data", "seed", "mae", "rank_correlation", "regret_at_1", "regret_at_5")
    _print_rows(result.compare(known), columns)


def _initial_states(task: domains.Task | None) -> Batch:
    if task is None or task.initial_states is None:
        raise ConfigurationError("--initial reset is for policies of a task with an environment; leave it out.")
    return task.initial_states(_RESETS, 0)


def _known(
    given: dict[str, float] | None,
    task: domains.Task | None,
    policies: list[str],
    *,
    gamma: float,
    horizon: int | None,
) -> dict[str, float] | domains.Truth | None:
    """Return the true values to compare with, before anything is computed; None where there are none."""
    if given is not None:
        missing = [name for name in policies if name not in given]
        if missing:
            raise InvalidDataError(f"The file of true values has none of {', '.join(missing)}.")
        return given
    if task is None or task.truth is None or horizon != task.horizon:
        return None
    try:
        return task.truth(gamma)
    except (ConfigurationError, DatasetNotFoundError) as error:
        out.print(f"Not compared with true values: {error}", markup=False)
        return None


def read_truth(path: Path) -> dict[str, float]:
    """Return the true values of a CSV file with the columns policy and value.

    Raises:
        InvalidDataError: if a column is missing or a value is no finite number.
    """
    with path.open(newline="", encoding="utf-8") as lines:
        rows = list(csv.DictReader(lines))
    if not rows or not {"policy", "value"} <= set(rows[0]):
        raise InvalidDataError(f"{path} must have the columns policy and value and a row for each policy.")
    values: dict[str, float] = {}
    for row in rows:
        try:
            values[row["policy"]] = float(row["value"])
        except (TypeError, ValueError) as error:
            raise InvalidDataError(f"{path}: the value of {row['policy']!r} is {row['value']!r}, no number.") from error
    if not all(math.isfinite(value) for value in values.values()):
        raise InvalidDataError(f"{path} has a value that is not finite.")
    return values


def to_csv(rows: list[dict[str, Any]]) -> str:
    """Return estimates as CSV, the diagnostics in columns of their own."""
    flat = [
        {key: value for key, value in row.items() if key != "diagnostics"}
        | {key: value for key, value in row["diagnostics"].items() if key != "warnings"}
        for row in rows
    ]
    names = list(dict.fromkeys(key for row in flat for key in row))
    text = io.StringIO()
    writer = csv.DictWriter(text, names, lineterminator="\n")
    writer.writeheader()
    writer.writerows(flat)
    return text.getvalue()


def _estimators(names: str) -> list[ope.Estimator]:
    chosen = list(ope.ESTIMATORS) if names.strip() == "all" else [name.strip() for name in names.split(",")]
    for name in chosen:
        if name not in ope.ESTIMATORS:
            raise ConfigurationError(f"There is no estimator {name!r}; choose of {', '.join(ope.ESTIMATORS)}.")
    return [ope.ESTIMATORS[name]() for name in dict.fromkeys(chosen)]


def _targets(
    policies: str | None, dataset: str, data: MinariDataset
) -> tuple[dict[str, ope.Policy], domains.Task | None]:
    """Return the target policies, and the task that they are of."""
    if policies is None or policies in domains.TASKS:
        try:
            task = domains.task(dataset if policies is None else policies)
        except ConfigurationError as error:
            raise ConfigurationError(f"{error} Give --policies: one of these, or a folder of weight files.") from error
        return task.policies(), task
    if not isinstance(data.action_space, spaces.Box):
        raise ConfigurationError(
            f"Policies from weight files act in a Box; the actions of {data.id!r} are {data.action_space}."
        )
    return {**ope.load_dope_policies(policies, action_space=data.action_space)}, None


def _data(dataset: str, augmenter: str, factor: float, seed: int) -> MinariDataset:
    source = open_source(dataset)
    if augmenter == "none":
        return source
    method = find_augmenter(augmenter)
    with length_advice(_LENGTH_ADVICE):
        return AugmentedDataset(source, method, factor=factor, seed=seed)


def _print_rows(rows: list[dict[str, Any]], columns: tuple[str, ...]) -> None:
    names = [name for name in columns if name in rows[0]]
    table = Table(box=None, pad_edge=False, header_style="")
    for name in names:
        table.add_column(name.replace("_", " "), justify="left" if name in ("policy", "estimator", "data") else "right")
    for row in rows:
        table.add_row(*(_cell(row[name]) for name in names))
    out.print(table)


def _cell(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
