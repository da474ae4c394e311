"""What the diagnoses share that read the cells of `oat-gym bench` again: their command line, and a table of texts."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path

from oat_gym.benchmark.analysis import Finding
from oat_gym.benchmark.grid import Table
from oat_gym.cache import write_atomically

Row = dict[str, str]


def told(found: Finding | None, *, digits: int = 0) -> str:
    """Return an improvement with its interval, in bold where that excludes zero; "-" for less than two seeds."""
    if found is None or found.improvement.n_seeds < 2:
        return "-"
    change = found.improvement
    value, low, high = (_number(number, digits) for number in (change.value, change.low, change.high))
    return f"**{value} ({low} to {high})**" if change.verdict in ("helps", "hurts") else f"{value} ({low} to {high})"


def _number(value: float, digits: int) -> str:
    """Return a number in so many digits, one more where it would be told as 0 and is not."""
    if not round(value, digits):
        return f"{value:.{digits + 1}f}" if round(value, digits + 1) else "0"
    return f"{value:.{digits}f}"


def write(out: Path, rows: Sequence[Row], *, name: str, caption: str) -> None:
    """Write the rows as `name`.csv and `name`.md."""
    table = Table(name, caption, tuple(rows[0]), tuple(tuple(row.values()) for row in rows))
    out.mkdir(parents=True, exist_ok=True)
    write_atomically(out / f"{name}.csv", table.to_csv().replace("**", "").encode())
    write_atomically(out / f"{name}.md", table.to_markdown().encode())


def run(
    rows_of: Callable[[Path, Sequence[str]], list[Row]], *, name: str, caption: str, description: str, variants: str
) -> None:
    """Read the command line, compute the rows, write both files and print the table."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("results", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--variants", default=variants)
    options = parser.parse_args()
    write(options.out, rows_of(options.results, options.variants.split(",")), name=name, caption=caption)
    print((options.out / f"{name}.md").read_text())
