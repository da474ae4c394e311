"""`oat-gym cache`: what training left on disk."""

from __future__ import annotations

from typing import Annotated

import typer
from rich.table import Table

from oat_gym import cache_tools
from oat_gym.cli._shared import out

cache_app = typer.Typer(no_args_is_help=True, help="What the cache holds, and emptying it.")


@cache_app.command("list")
def cache_list() -> None:
    """List what the cache holds, the longest unused first."""
    table = Table(box=None, pad_edge=False, header_style="")
    for column in ("kind", "MB", "last used", "entry"):
        table.add_column(column, justify="right" if column == "MB" else "left")
    items = cache_tools.list_entries()
    for item in items:
        kind = item.kind if item.is_current else f"{item.kind} (format {item.version}, left alone)"
        table.add_row(kind, f"{item.size / 1e6:.2f}", f"{item.last_used:%Y-%m-%d %H:%M}", item.key[:16])
    out.print(table)
    out.print(f"{len(items)} entries, {sum(item.size for item in items) / 1e6:.1f} MB in {cache_tools.folder()}")


@cache_app.command("clear")
def cache_clear(
    unused_days: Annotated[float, typer.Option(help="Only what was not used for so many days.")] = 0.0,
) -> None:
    """Delete the cache's entries; what is deleted is made again when it is next needed."""
    done = cache_tools.clear(unused_days=unused_days)
    out.print(f"Deleted {len(done.removed)} entries, {done.freed / 1e6:.1f} MB.")
    for item in done.in_use:
        out.print(f"Left {item.key[:16]}: another process uses it.")


@cache_app.command("path")
def cache_path() -> None:
    """Print the cache folder (set it by OAT_GYM_CACHE)."""
    out.print(str(cache_tools.folder()))
