"""`oat-gym report`: one self-contained HTML page of a folder of benchmark results."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from oat_gym.benchmark.page import write_page
from oat_gym.cli._output import prepare_file, prepare_folder
from oat_gym.cli._shared import out
from oat_gym.errors import ConfigurationError


def report(
    folder: Annotated[Path, typer.Argument(help="Folder that `oat-gym bench --out` wrote.")],
    file: Annotated[Path | None, typer.Option("--out", help="The page; FOLDER/report.html without it.")] = None,
    pictures: Annotated[
        Path | None, typer.Option(help="Write its pictures into this folder too, as PNG files.")
    ] = None,
) -> None:
    """Make a page for readers who know the domain: what was mined, what was generated, did it help, how sure are we.

    Pictures are inside the page, and it loads nothing from elsewhere.
    """
    if not folder.is_dir():
        raise ConfigurationError(f"{str(folder)!r} is no folder of results: run `oat-gym bench --out {folder}` first.")
    if file is not None and file.is_dir():
        file /= "report.html"
    file = file or folder / "report.html"
    prepare_file(file)
    if pictures is not None:
        prepare_folder(pictures, option="--pictures")
    page = write_page(folder, file, pictures=pictures)
    out.print(f"Report: {page}")
