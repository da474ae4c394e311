"""`oat-gym compare`: the fidelity of several methods on one dataset, as a table, a CSV file and a picture."""

from __future__ import annotations

import csv
import io
from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from oat_gym import metrics, plots
from oat_gym.augmenters import AUGMENTERS, Augmenter
from oat_gym.cache import write_atomically
from oat_gym.cli._output import prepare_folder
from oat_gym.cli._shared import Dataset, Factor, Seed, find_augmenter, open_source, out
from oat_gym.errors import ConfigurationError
from oat_gym.metrics import METRICS, Comparison
from oat_gym.progress import progress_bar

_NAME_WIDTH, _COLUMN_WIDTH = 14, 13
"""Characters of the first column, and about those of each other."""


def compare(
    dataset: Dataset,
    augmenters: Annotated[str, typer.Option(help=f"all, or a list such as {','.join(list(AUGMENTERS)[:2])}.")] = "all",
    factor: Factor = 10,
    seed: Seed = 0,
    folder: Annotated[Path, typer.Option("--out", help="Folder for the table (CSV) and the picture (PNG).")] = Path(
        "oat-gym-compare"
    ),
) -> None:
    """Compare how like the real data of DATASET the episodes are that methods generate.

    One row a method: coverage, distances, dynamics, seams, a classifier, memorisation. The row "real data" above says
    what other real steps give in the place of the generated ones. A method that cannot work on the dataset is named
    with the reason.
    """
    methods = _choose(augmenters)
    source = open_source(dataset)
    if not factor > 1:
        raise ConfigurationError(f"Generated episodes are compared: --factor must be more than 1, got {factor:g}.")
    prepare_folder(folder)
    with progress_bar() as progress:
        rows = metrics.compare(source, methods, factor=factor, seed=seed, progress=progress)
    stem = source.id.rpartition("/")[2]
    table, picture = folder / f"{stem}.csv", folder / f"{stem}.png"
    write_atomically(table, to_csv(rows).encode())
    out.print(f"{source.id}, {factor:g} times the episodes, seed {seed}")
    _print_table(rows)
    out.print(f"Table: {table}")
    if any(row.fidelity is not None for row in rows):
        write_atomically(picture, _draw(rows, title=f"{source.id}, factor {factor:g}, seed {seed}"))
        out.print(f"Picture: {picture}")


def to_csv(rows: list[Comparison]) -> str:
    """Return a comparison as CSV: one line a method, empty cells for None, in the last column why a method failed."""
    names = ["n_real", "n_generated", *(f"{name}{end}" for name in METRICS for end in ("", "_reference"))]
    text = io.StringIO()
    writer = csv.DictWriter(text, ["augmenter", *names, "reason"], lineterminator="\n")
    writer.writeheader()
    for row in rows:
        numbers = {} if row.fidelity is None else row.fidelity.to_row()
        shown = {name: _rounded(value) for name, value in numbers.items()}
        writer.writerow({"augmenter": row.name, **shown, "reason": row.reason or ""})
    return text.getvalue()


def _choose(names: str) -> dict[str, Augmenter]:
    chosen = list(AUGMENTERS) if names.strip() == "all" else [name.strip() for name in names.split(",")]
    if len(set(chosen)) < len(chosen):
        raise ConfigurationError(f"--augmenters names a method twice: {names!r}.")
    return {name: find_augmenter(name) for name in chosen}


def _rounded(value: float | int | None) -> float | int | None:
    """Return a number with six digits: the last ones of a sum differ from one processor to another."""
    return float(f"{value:.6g}") if isinstance(value, float) else value


def _print_table(rows: list[Comparison]) -> None:
    """Print the numbers, as many metrics side by side as a narrow terminal shows, and the reasons of failures."""
    measured = [row for row in rows if row.fidelity is not None]
    for names in _blocks() if measured else ():
        table = Table(box=None, pad_edge=False, header_style="bold", padding=(0, 2, 0, 0))
        table.add_column("")
        for name in names:
            table.add_column(_header(name), justify="right")
        above: list[str] | None = None
        for row in measured:
            real = [_cell(_reference(row, name)) for name in names]
            if real != above:
                table.add_row("real data", *real, style="dim")
            above = real
            table.add_row(f"  {row.name}", *(_cell(_value(row, name)) for name in names))
        out.print(table)
        out.print()
    for row in rows:
        if row.reason is not None:
            out.print(f"{row.name}: {row.reason}", markup=False)


def _blocks() -> list[list[str]]:
    names, columns = list(METRICS), max(1, (out.width - _NAME_WIDTH) // _COLUMN_WIDTH)
    return [names[start : start + columns] for start in range(0, len(names), columns)]


def _header(name: str) -> str:
    """Return four short lines: the title on two, the unit, and which direction is better."""
    first, _, second = METRICS[name].title.partition(" ")
    return f"{first}\n{second}\n" + _axis(name).replace(", ", "\n")


def _value(row: Comparison, name: str) -> float | None:
    return None if row.fidelity is None else row.fidelity.score(name).value


def _reference(row: Comparison, name: str) -> float | None:
    return None if row.fidelity is None else row.fidelity.score(name).reference


def _axis(name: str) -> str:
    metric = METRICS[name]
    return f"{metric.unit}, {'near real' if metric.better == 'near reference' else metric.better}"


def _cell(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}"


def _draw(rows: list[Comparison], *, title: str) -> bytes:
    panels = [
        plots.Panel(
            title=metric.title,
            label=f"{_axis(name)} is better" if metric.better != "higher" else f"{metric.unit}, higher is more",
            values=[_value(row, name) for row in rows],
            references=[_reference(row, name) for row in rows],
            limits=metric.limits,
        )
        for name, metric in METRICS.items()
    ]
    image = io.BytesIO()
    plots.fidelity([row.name for row in rows], panels, title=title).savefig(image, format="png")
    return image.getvalue()
