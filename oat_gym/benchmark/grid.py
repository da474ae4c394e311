"""A table as text, in markdown and CSV, and numbers as its cells show them."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from oat_gym.cache import write_atomically


@dataclass(frozen=True)
class Table:
    """A table as text: `name` for files, a caption, a header and rows of as many cells."""

    name: str
    caption: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]

    def to_markdown(self) -> str:
        """Return it as a markdown table under its caption."""
        lines = [f"**{self.caption}**", "", _line(self.header), _line(("---",) * len(self.header))]
        return "\n".join([*lines, *(_line(row) for row in self.rows), ""])

    def to_csv(self) -> str:
        """Return it as CSV, without the caption."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerows([self.header, *self.rows])
        return text.getvalue()


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def write_tables(tables: Sequence[Table], folder: Path) -> list[Path]:
    """Write each table as NAME.md and NAME.csv and all of them as tables.md; return the paths."""
    folder.mkdir(parents=True, exist_ok=True)
    files = {f"{table.name}.{ending}": text for table in tables for ending, text in _forms(table)}
    files["tables.md"] = "\n".join(table.to_markdown() for table in tables)
    for name, text in files.items():
        write_atomically(folder / name, text.encode())
    return [folder / name for name in files]


def _forms(table: Table) -> tuple[tuple[str, str], ...]:
    return (("md", table.to_markdown()), ("csv", table.to_csv()))


def format_number(value: float) -> str:
    """Return a number with about three digits, "-" for NaN.

    >>> format_number(1234.5), format_number(0.1234), format_number(float("nan"))
    ('1234', '0.123', '-')
    """
    if not math.isfinite(value):
        return "-"
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}"
