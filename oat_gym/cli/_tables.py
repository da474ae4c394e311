"""Tables that more than one command prints."""

from __future__ import annotations

from typing import Any

from rich.table import Table

from oat_gym.cli._shared import out
from oat_gym.mining import MiningResult
from oat_gym.report import DatasetSummary, GroupSummary


def print_summary(summary: DatasetSummary) -> None:
    """Print spaces, and numbers of the real and of the synthetic episodes."""
    out.print(f"Dataset       {summary.dataset_id}")
    out.print(f"Observations  {summary.observation_space}")
    out.print(f"Actions       {summary.action_space}")
    table = Table(box=None, pad_edge=False, show_header=True, header_style="")
    table.add_column("")
    groups = {"real": summary.real, "synthetic": summary.synthetic}
    shown = {name: group for name, group in groups.items() if group is not None}
    for name in shown:
        table.add_column(name)
    for title, cells in _summary_rows(list(shown.values())):
        table.add_row(title, *cells)
    out.print(table)


def _summary_rows(groups: list[GroupSummary]) -> list[tuple[str, list[str]]]:
    rows = [
        ("episodes", [str(group.episodes) for group in groups]),
        ("steps", [str(group.steps) for group in groups]),
        ("length", [str(group.lengths) for group in groups]),
        ("return", [str(group.returns) for group in groups]),
    ]
    if any(group.generated_steps for group in groups):
        rows.append(("steps generated", [str(group.generated_steps) for group in groups]))
        rows.append(("no PST inside", [str(group.without_span) for group in groups]))
    for title, name in (("seam in (sd)", "entry_seams"), ("seam out (sd)", "exit_seams")):
        if any(getattr(group, name) for group in groups):
            rows.append((title, [str(getattr(group, name) or "") for group in groups]))
    return rows


def print_mining(mining: MiningResult, n_episodes: int) -> None:
    """Print the PST sets that were mined from so many episodes."""
    out.print(f"Clusters: {mining.n_clusters}. Sub-trajectories of W = {mining.length} steps; support is the number of")
    out.print(f"episodes, of {n_episodes}, that contain the same sequence of clusters.")
    if mining.n_too_short:
        out.print(f"{mining.n_too_short} episodes have fewer than {mining.length} steps and hold no sub-trajectory.")
    table = Table(box=None, pad_edge=False, header_style="")
    for column in ("PST set", "support", "share", "occurrences", "clusters in order"):
        table.add_column(column, justify="left" if column.startswith("clusters") else "right")
    for number, pst in enumerate(mining.sets):
        share = f"{pst.support / n_episodes:.0%}"
        table.add_row(str(number), str(pst.support), share, str(len(pst.occurrences)), _runs(pst.labels))
    out.print(table)


def _runs(labels: Any) -> str:
    """Return a label sequence as runs: 3x12 7x8 is twelve times cluster 3, then eight times cluster 7."""
    runs: list[list[int]] = []
    for label in labels:
        if runs and runs[-1][0] == label:
            runs[-1][1] += 1
        else:
            runs.append([int(label), 1])
    return " ".join(f"{label}x{count}" for label, count in runs)
