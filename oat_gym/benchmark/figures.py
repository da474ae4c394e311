"""The paper's figures 4 to 9 from plain numbers: improvements with intervals, coverage, returns, agreement curves."""

# ruff: noqa: PLC0415  (matplotlib is imported only when a picture is drawn)
from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from oat_gym.benchmark.improvement import Improvement, Verdict
from oat_gym.errors import ConfigurationError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FloatArray = npt.NDArray[np.float64]
COLORS: dict[Verdict, str] = {
    "helps": "#009E73",
    "no evidence": "#9A9A9A",
    "hurts": "#D55E00",
    "not measured": "#D8D8D8",
}
"""Okabe and Ito's colours, which people with colour-blindness tell apart."""
SERIES = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00")
_TEXT = 8.0
_DPI = 160


@dataclass(frozen=True)
class Panel:
    """One metric of a figure of bars: a title, the unit, and for each name an improvement and the paper's number."""

    title: str
    unit: str
    names: Sequence[str]
    improvements: Sequence[Improvement | None]
    paper: Sequence[float] = ()


def improvement_bars(panels: Sequence[Panel], *, title: str, columns: int = 2) -> Figure:
    """Return bars of improvements with their intervals, coloured by verdict (the paper's figures 5, 7 and 9).

    A diamond marks the paper's number, where there is one. What was not measured is written so.

    Raises:
        ConfigurationError: without panels.
    """
    if not panels:
        raise ConfigurationError("A figure of improvements needs at least one panel.")
    rows = math.ceil(len(panels) / columns)
    height = 0.55 + rows * (0.75 + 0.2 * max(len(panel.names) for panel in panels))
    figure = _figure(3.6 * min(columns, len(panels)), height)
    grid = figure.subplots(rows, min(columns, len(panels)), squeeze=False)
    for axes, panel in zip(grid.ravel(), panels, strict=False):
        _draw_bars(axes, panel)
    for axes in grid.ravel()[len(panels) :]:
        axes.set_axis_off()
    _key(figure, with_paper=any(np.isfinite(panel.paper).any() for panel in panels if len(panel.paper)))
    figure.suptitle(textwrap.fill(title, 45 * min(columns, len(panels))), fontsize=_TEXT + 1)
    return figure


def _draw_bars(axes: Axes, panel: Panel) -> None:
    places = np.arange(len(panel.names))[::-1]
    for y, change in zip(places, panel.improvements, strict=True):
        if change is None or not math.isfinite(change.value):
            axes.text(0, y, " not measured", fontsize=_TEXT - 1.5, color="#777777", va="center")
            continue
        axes.barh(y, change.value, height=0.66, color=COLORS[change.verdict])
        axes.plot(change.value, y, "|", color=COLORS[change.verdict], markersize=9)  # a bar of no length is seen too
        if change.n_seeds > 1 and math.isfinite(change.low):
            axes.plot([change.low, change.high], [y, y], color="black", linewidth=1.0)
    _limit(axes, [change for change in panel.improvements if change is not None], marks=panel.paper)
    for y, change in zip(places, panel.improvements, strict=True):
        if change is not None and change.n_seeds > 1:
            _mark_cut(axes, change, y)
    for y, number in zip(places, panel.paper, strict=False):
        if math.isfinite(number):
            axes.plot(number, y, "D", color="white", markeredgecolor="black", markersize=4, clip_on=True)
    axes.axvline(0, color="black", linewidth=0.8)
    axes.set_yticks(places, list(panel.names), fontsize=_TEXT)
    axes.set_title(panel.title, fontsize=_TEXT)
    axes.set_xlabel(f"{panel.unit}, right is better", fontsize=_TEXT - 1)
    axes.tick_params(axis="x", labelsize=_TEXT - 1)
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_ylim(-0.6, len(panel.names) - 0.4)


def _mark_cut(axes: Axes, change: Improvement, y: float) -> None:
    """Draw an arrowhead where an interval leaves the picture."""
    left, right = axes.get_xlim()
    for outside, edge, marker in ((change.low < left, left, "<"), (change.high > right, right, ">")):
        if outside:
            axes.plot(edge, y, marker, color="black", markersize=4, clip_on=False)


def _limit(axes: Axes, changes: Sequence[Improvement], *, marks: Sequence[float] = ()) -> None:
    """Keep one interval that is far wider than the values from hiding all others; it then leaves the picture."""
    signed = np.array([change.value for change in changes if math.isfinite(change.value)])
    values = np.abs(signed)
    ends = np.array([e for change in changes for e in (change.low, change.high) if math.isfinite(e)])
    axes.locator_params(axis="x", nbins=5)
    if not len(values):
        axes.set_xlim(-1, 1)
        return
    shown = np.array([number for number in marks if math.isfinite(number)])
    reach = max(3.0 * float(np.quantile(values, 0.75)), 1.15 * float(np.abs([*values, *shown]).max()))
    reach = reach if reach > 1e-6 else max(float(np.abs(ends).max(initial=0.0)), 0.1)
    there = np.concatenate([signed, ends, shown])
    low = max(float(min(there.min(), -values.max() * 0.05)), -reach)
    high = min(float(max(there.max(), values.max() * 0.05)), reach)
    axes.set_xlim(1.05 * low - 1e-3 * reach, 1.05 * high + 1e-3 * reach)


def _key(figure: Figure, *, with_paper: bool) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles: list[Any] = [Patch(color=COLORS[name], label=name) for name in ("helps", "no evidence", "hurts")]
    handles.append(Line2D([], [], color="black", linewidth=1, label="95% interval"))
    if with_paper:
        style: dict[str, Any] = {"marker": "D", "color": "white", "markeredgecolor": "black", "markersize": 4}
        handles.append(Line2D([], [], label="the paper", **style))
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), fontsize=_TEXT - 1, frameon=False)


def improvement_by_level(
    panels: Mapping[str, Mapping[str, Sequence[Improvement | None]]], *, levels: Sequence[str], title: str
) -> Figure:
    """Return improvements by level of human involvement (figure 8): metric -> variant -> one for each level."""
    if not panels:
        raise ConfigurationError("A figure of levels needs at least one metric.")
    n_variants = max(len(members) for members in panels.values())
    figure = _figure(7.2, 0.8 + math.ceil(len(panels) / 2) * (0.7 + 0.3 * n_variants))
    grid = figure.subplots(math.ceil(len(panels) / 2), min(2, len(panels)), squeeze=False)
    for axes, (metric, members) in zip(grid.ravel(), panels.items(), strict=False):
        for y, (_, changes) in enumerate(reversed(list(members.items()))):
            for place, change in enumerate(changes):
                if change is not None and math.isfinite(change.value):
                    _draw_point(axes, change, y + 0.22 * (1 - place), SERIES[place])
        known = [change for changes in members.values() for change in changes if change is not None]
        _limit(axes, known)
        axes.axvline(0, color="black", linewidth=0.8)
        axes.set_yticks(range(len(members)), list(reversed(list(members))), fontsize=_TEXT)
        axes.set_title(metric, fontsize=_TEXT)
        axes.tick_params(axis="x", labelsize=_TEXT - 1)
        axes.spines[["top", "right"]].set_visible(False)
    for axes in grid.ravel()[len(panels) :]:
        axes.set_axis_off()
    _level_key(figure, levels)
    figure.suptitle(title, fontsize=_TEXT + 1)
    return figure


def _draw_point(axes: Axes, change: Improvement, y: float, color: str) -> None:
    if change.n_seeds > 1 and math.isfinite(change.low):
        axes.plot([change.low, change.high], [y, y], color=color, linewidth=1.0)
    axes.plot(change.value, y, "o", color=color, markersize=3.5)


def _level_key(figure: Figure, levels: Sequence[str]) -> None:
    from matplotlib.lines import Line2D

    handles = [
        Line2D([], [], marker="o", color=SERIES[place], markersize=4, linewidth=1, label=level)
        for place, level in enumerate(levels)
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), fontsize=_TEXT - 1, frameon=False)


def coverage(
    arrays: Mapping[str, npt.NDArray[Any]], *, labels: Sequence[str], title: str, walls: FloatArray | None = None
) -> Figure:
    """Return recorded trajectories (left) and augmented ones (right), generated steps in colour (figure 4).

    `arrays` are those of `describe_augmented`; `walls` (n, 4) are a maze's.
    """
    figure = _figure(6.8, 3.5)
    panels = figure.subplots(1, 2, sharex=True, sharey=True)
    for axes, prefix, name in zip(panels, ("real", "synthetic"), ("recorded", "augmented"), strict=True):
        _draw_walls(axes, walls)
        numbers = arrays[f"{prefix}_episode"]
        for number in np.unique(numbers):
            points = arrays[prefix][numbers == number]
            axes.plot(*points.T, color="#9A9A9A", linewidth=0.6, alpha=0.7)
            made = arrays[f"{prefix}_generated"][numbers == number]
            axes.plot(*np.where(made[:, None], points, math.nan).T, color=SERIES[0], linewidth=0.8, alpha=0.8)
        axes.set_title(f"{name} ({len(np.unique(numbers))} trajectories shown)", fontsize=_TEXT)
        axes.set_xlabel(labels[0], fontsize=_TEXT)
        axes.tick_params(labelsize=_TEXT - 1)
        if walls is not None:
            axes.set_aspect("equal")
    panels[0].set_ylabel(labels[1], fontsize=_TEXT)
    _coverage_key(figure)
    figure.suptitle(title, fontsize=_TEXT + 1)
    return figure


def _coverage_key(figure: Figure) -> None:
    from matplotlib.lines import Line2D

    handles = [
        Line2D([], [], color="#9A9A9A", label="recorded step"),
        Line2D([], [], color=SERIES[0], label="generated"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=2, fontsize=_TEXT - 1, frameon=False)


def _draw_walls(axes: Axes, walls: FloatArray | None) -> None:
    from matplotlib.patches import Rectangle

    for x, y, width, height in () if walls is None else walls:
        axes.add_patch(Rectangle((x, y), width, height, facecolor="#D9D4CC", linewidth=0))


def returns_bars(names: Sequence[str], values: FloatArray, errors: FloatArray, *, title: str) -> Figure:
    """Return the true values of a task's policies with 95% intervals (figure 6, right)."""
    figure = _figure(3.6, 0.7 + 0.24 * len(names))
    axes = figure.subplots()
    places = np.arange(len(names))[::-1]
    axes.barh(places, values, height=0.66, color=SERIES[0], xerr=1.96 * np.nan_to_num(errors), ecolor="black")
    axes.set_yticks(places, list(names), fontsize=_TEXT)
    axes.set_xlabel("true value (discounted return)", fontsize=_TEXT - 1)
    axes.tick_params(axis="x", labelsize=_TEXT - 1)
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_title(title, fontsize=_TEXT)
    return figure


def estimates_against_truth(panels: Mapping[str, Mapping[str, FloatArray]], true: FloatArray, *, title: str) -> Figure:
    """Return estimates over true values: estimator -> variant -> (S, P) estimates; on the line, they are right."""
    figure = _figure(2.3 * len(panels), 2.9)
    grid = figure.subplots(1, len(panels), squeeze=False, sharex=True)
    for axes, (name, members) in zip(grid.ravel(), panels.items(), strict=True):
        axes.plot([true.min(), true.max()], [true.min(), true.max()], color="#9A9A9A", linewidth=1)
        for place, (variant, values) in enumerate(members.items()):
            style: dict[str, Any] = {"marker": "os^Dv"[place % 5], "linestyle": "", "markersize": 3, "alpha": 0.8}
            axes.plot(
                np.tile(true, len(values)), values.ravel(), color=SERIES[place % len(SERIES)], label=variant, **style
            )
        axes.set_title(name, fontsize=_TEXT)
        axes.tick_params(labelsize=_TEXT - 1.5)
        axes.set_xlabel("true value", fontsize=_TEXT - 1)
        axes.spines[["top", "right"]].set_visible(False)
    grid[0, 0].set_ylabel("estimate (every seed)", fontsize=_TEXT - 1)
    handles, labels = grid[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), fontsize=_TEXT - 1, frameon=False)
    figure.suptitle(title, fontsize=_TEXT + 1)
    return figure


def agreement_curves(curves: Mapping[str, Mapping[str, Sequence[float]]], *, event: str, title: str) -> Figure:
    """Return how often an event happened by agreement with each policy: policy -> at, rate, low, high, count."""
    figure = _figure(4.2, 3.0)
    axes = figure.subplots()
    for place, (name, curve) in enumerate(curves.items()):
        at, rate, low, high = (np.asarray(curve[key], dtype=np.float64) for key in ("at", "rate", "low", "high"))
        color = SERIES[place % len(SERIES)]
        axes.plot(at, rate, marker="o", markersize=3, linewidth=1.2, color=color, label=name)
        axes.fill_between(at, low, high, color=color, alpha=0.1, linewidth=0)
    axes.set_xlabel("share of decisions that agree with the policy, at least", fontsize=_TEXT)
    axes.set_ylabel(f"rate of {event}", fontsize=_TEXT)
    axes.set_ylim(0, 1)
    axes.tick_params(labelsize=_TEXT - 1)
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="outside lower center", ncols=min(3, len(curves)), fontsize=_TEXT - 1, frameon=False)
    figure.suptitle(title, fontsize=_TEXT + 1)
    return figure


def to_png(figure: Figure) -> bytes:
    """Return a figure as the bytes of a PNG file."""
    import io

    image = io.BytesIO()
    figure.savefig(image, format="png")
    return image.getvalue()


def _figure(width: float, height: float) -> Figure:
    from matplotlib.figure import Figure as NewFigure

    return NewFigure(figsize=(width, height), dpi=_DPI, layout="constrained")
