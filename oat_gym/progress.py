"""Progress of long work: a plain callable, and a rich bar for those who sit at a terminal."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Generator

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

ProgressCallback = Callable[[str, int, int], None]
"""Called as progress(description, done, total)."""


def silent(description: str, done: int, total: int) -> None:
    """Report nothing."""


@contextlib.contextmanager
def progress_bar(show: bool | None = None) -> Generator[ProgressCallback]:
    """Give a callback that draws one bar for each description on standard error.

    `show=None` draws where standard error is a terminal and stays silent elsewhere (in a log, a worker, a test).
    """
    if not (sys.stderr.isatty() if show is None else show):
        yield silent
        return
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True)) as bar:
        tasks: dict[str, TaskID] = {}

        def report(description: str, done: int, total: int) -> None:
            if description not in tasks:
                tasks[description] = bar.add_task(description, total=total)
            bar.update(tasks[description], completed=done, total=total)

        yield report
