"""Pictures: trajectories in a maze, the paper's Figure 4, the support curve, and the fidelity of methods.

Every function takes plain arrays and returns a `matplotlib.figure.Figure` that belongs to nobody else: pyplot and its
global state are not used, so no window opens and no back end is chosen. Matplotlib is imported when a picture is drawn.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from oat_gym.errors import ConfigurationError, InvalidDataError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Positions = npt.NDArray[np.floating[Any]]
"""One trajectory: (T+1, 2) positions; further columns are ignored."""
Span = tuple[int, int, int]
"""(episode, start, stop): steps start..stop-1 of an episode, which join the positions start..stop."""
Spans = Sequence[Sequence[Span]]
"""The spans of each PST set."""
Path = str | os.PathLike[str]

SET_COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
"""Okabe and Ito's colours, which people with colour-blindness tell apart, in order of contrast on white."""
REST_COLOR = "#9A9A9A"
WALL_COLOR = "#D9D4CC"
_DPI = 200
_TEXT = 8.0


def trajectories(
    axes: Axes,
    positions: Sequence[Positions],
    *,
    maze: npt.NDArray[np.floating[Any]] | None = None,
    spans: Spans = (),
    color: str = REST_COLOR,
    line_width: float = 0.6,
) -> None:
    """Draw trajectories into `axes`: walls, all trajectories in `color`, and each set's spans in its own colour.

    One line collection is added for the trajectories and one for each set that has spans.

    Args:
        axes: Matplotlib axes to draw into; its aspect becomes equal.
        positions: the trajectories.
        maze: (n, 4) wall rectangles, each x, y (lower left), width, height; as `domains.maze2d.UMAZE.walls()`.
        spans: for each PST set, its (episode, start, stop) spans.
        color: of what lies outside the spans.
        line_width: of these lines, in points; spans are drawn at 1.5 times that.

    Raises:
        InvalidDataError: for trajectories that are not (T+1, 2), and spans outside their episode.
        ConfigurationError: for more sets than there are colours.
    """
    from matplotlib.collections import LineCollection

    paths = [_path(i, rows) for i, rows in enumerate(positions)]
    if len(spans) > len(SET_COLORS):
        raise ConfigurationError(f"{len(spans)} sets were given and {len(SET_COLORS)} can be told apart; draw fewer.")
    alpha = float(np.clip(12.0 / max(len(paths), 1), 0.3, 1.0))
    if maze is not None:
        _draw_walls(axes, np.asarray(maze, dtype=np.float64))
    axes.add_collection(LineCollection(paths, colors=color, linewidths=line_width, alpha=alpha, zorder=2))
    for number, members in enumerate(spans):
        cut = [_cut(paths, span, number) for span in members]
        if cut:
            style = {"colors": SET_COLORS[number], "linewidths": 1.5 * line_width, "alpha": min(1.0, 1.6 * alpha)}
            axes.add_collection(LineCollection(cut, zorder=3 + number, label=f"set {number + 1}", **style))
    axes.autoscale_view()
    axes.set_aspect("equal")


def maze_figure(
    positions: Sequence[Positions],
    *,
    maze: npt.NDArray[np.floating[Any]] | None = None,
    spans: Spans = (),
    title: str | None = None,
    path: Path | None = None,
) -> Figure:
    """Return a figure of trajectories in one maze, with a dot at each start and a cross at each end.

    `path` saves it as well, in the format of its ending. See `trajectories` for the arguments and errors.

    >>> walk = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]])
    >>> len(maze_figure([walk]).axes)
    1
    """
    figure = _figure(3.4, 3.4)
    axes = figure.subplots()
    trajectories(axes, positions, maze=maze, spans=spans, color=SET_COLORS[0] if not spans else REST_COLOR)
    starts, ends = (np.array([np.asarray(rows)[i, :2] for rows in positions]) for i in (0, -1))
    axes.scatter(*starts.T, s=5, color=SET_COLORS[2], linewidths=0, zorder=10, label="start")
    axes.scatter(*ends.T, s=7, color=SET_COLORS[1], marker="x", linewidths=0.6, zorder=10, label="end")
    _label_maze(axes, title)
    _legend_below(figure, *axes.get_legend_handles_labels())
    return _finish(figure, path)


def figure4(
    original: Sequence[Positions],
    augmented: Sequence[Positions],
    *,
    maze: npt.NDArray[np.floating[Any]],
    spans: Spans,
    augmented_spans: Spans | None = None,
    supports: Sequence[int] | None = None,
    path: Path | None = None,
) -> Figure:
    """Return the paper's Figure 4: the PST sets in the original trajectories (left) and in the augmented ones (right).

    Args:
        original: the recorded trajectories.
        augmented: the augmented trajectories.
        maze: (n, 4) wall rectangles.
        spans: for each PST set, its (episode, start, stop) spans in `original`.
        augmented_spans: the same for `augmented`. Default: `spans`, for one augmented trajectory an original, in order.
        supports: the number of sequences that contain each set's TDSS (paper, Definition 2.1), for the legend. Default:
            the number of original trajectories with a span of the set.
        path: where to save the figure as well.

    Raises:
        InvalidDataError, ConfigurationError: as `trajectories`, and where the sets' numbers disagree.

    >>> walk = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]])
    >>> wall = np.array([[-1.0, -1.0, 0.5, 3.0]])
    >>> len(figure4([walk], [walk + 0.1], maze=wall, spans=[[(0, 0, 1)]]).axes)
    2
    """
    right = spans if augmented_spans is None else augmented_spans
    counts = [len({episode for episode, _, _ in members}) for members in spans] if supports is None else list(supports)
    if not len(spans) == len(right) == len(counts):
        raise ConfigurationError(
            f"spans has {len(spans)} sets, augmented_spans {len(right)} and supports {len(counts)}; give one a set."
        )
    figure = _figure(6.8, 3.9)
    panels = figure.subplots(1, 2, sharex=True, sharey=True)
    for axes, rows, members, title in zip(
        panels, (original, augmented), (spans, right), ("original", "augmented"), strict=True
    ):
        trajectories(axes, rows, maze=maze, spans=members)
        _label_maze(axes, f"{title} ({len(rows)} trajectories)")
    panels[1].set_ylabel("")
    labels = [f"PST set {i} (support {count} of {len(original)})" for i, count in enumerate(counts)]
    _legend_below(figure, *_handles(labels))
    return _finish(figure, path)


def support_curve(
    curve: Mapping[int, int],
    *,
    episodes: int | None = None,
    chosen: int | None = None,
    path: Path | None = None,
) -> Figure:
    """Return the best support at each window length W, the curve from which `W="auto"` is read.

    Args:
        curve: window length (steps) -> support (number of sequences) of the best TDSS of that length.
        episodes: the number of sequences N; draws N and 0.9 N, the level that `W="auto"` asks for.
        chosen: the window length in use, marked where given.
        path: where to save the figure as well.

    Raises:
        InvalidDataError: for an empty curve.
        ConfigurationError: if `chosen` is not one of the lengths.

    >>> len(support_curve({5: 25, 10: 24, 20: 11}, episodes=25, chosen=10).axes)
    1
    """
    if not curve:
        raise InvalidDataError("The support curve is empty; give at least one window length.")
    if chosen is not None and chosen not in curve:
        raise ConfigurationError(f"chosen={chosen} is not on the curve; its window lengths are {sorted(curve)}.")
    lengths = sorted(curve)
    figure = _figure(3.4, 2.4)
    axes = figure.subplots()
    axes.plot(lengths, [curve[w] for w in lengths], color=SET_COLORS[0], marker="o", markersize=3, linewidth=1.2)
    if episodes is not None:
        axes.axhline(episodes, color=REST_COLOR, linewidth=0.8, label=f"all {episodes} sequences")
        axes.axhline(0.9 * episodes, color=REST_COLOR, linewidth=0.8, linestyle="--", label="90%")
    if chosen is not None:
        axes.plot([chosen], [curve[chosen]], "o", color=SET_COLORS[1], markersize=6, label=f"W = {chosen}")
    axes.set_xlabel("window length W (steps)", fontsize=_TEXT)
    axes.set_ylabel("best support (sequences)", fontsize=_TEXT)
    axes.set_ylim(0, 1.08 * max(episodes or 0, *curve.values(), 1))
    axes.tick_params(labelsize=_TEXT)
    axes.spines[["top", "right"]].set_visible(False)
    _legend_below(figure, *axes.get_legend_handles_labels())
    return _finish(figure, path)


@dataclass(frozen=True)
class Panel:
    """One panel of `fidelity`: a title, what is on its axis, a value for each method, and the value of real data.

    None in `values` is a method without this value; where `references` is None, or empty, no line is drawn. `limits`
    are the least and the largest possible value, where there are such: they are the ends of the axis.
    """

    title: str
    label: str
    values: Sequence[float | None]
    references: Sequence[float | None] = ()
    limits: tuple[float, float] | None = None


def fidelity(
    methods: Sequence[str],
    panels: Sequence[Panel],
    *,
    title: str | None = None,
    path: Path | None = None,
) -> Figure:
    """Return small multiples that compare methods: one panel a metric, one row a method, a line where real data lies.

    Each value is a dot, joined to the line of its real data; a method without a value shows "none". An axis without
    limits is logarithmic where all its values are positive and the largest is over 20 times the smallest.

    Args:
        methods: names, from top to bottom.
        panels: the metrics, from left to right and then down; those without any value are left out.
        title: over the figure.
        path: where to save the figure as well.

    Raises:
        InvalidDataError: for no methods, no panel with a value, or a panel with another number of values.

    >>> figure = fidelity(["copy", "noise"], [Panel("MMD", "squared", [0.0, 0.2], [0.01, 0.01])])
    >>> figure.axes[0].get_title(loc="left")
    'MMD'
    """
    for panel in panels:
        counts = len(panel.values), len(panel.references)
        if counts[0] != len(methods) or counts[1] not in (0, len(methods)):
            raise InvalidDataError(
                f"The panel {panel.title!r} has {counts[0]} values, {counts[1]} references; expected {len(methods)}, "
                "one a method (references may be left out)."
            )
    shown = [panel for panel in panels if any(value is not None for value in panel.values)]
    if not shown:
        raise InvalidDataError("There is nothing to draw: no method has a value in any panel.")
    columns = min(5, len(shown))
    rows = -(-len(shown) // columns)
    figure = _figure(1.4 + 1.75 * columns, 0.7 + rows * (0.75 + 0.19 * len(methods)))
    grid = figure.subplots(rows, columns, sharey=True, squeeze=False)
    for axes, panel in zip(grid.flat, shown, strict=False):
        _draw_panel(axes, panel)
    for axes in grid.flat[len(shown) :]:
        axes.set_visible(False)
    for axes in grid[:, 0]:
        axes.set_yticks(range(len(methods)), methods)
        axes.set_ylim(len(methods) - 0.4, -0.6)
    if title is not None:
        figure.suptitle(title, fontsize=_TEXT + 2)
    _legend_below(figure, *_fidelity_handles())
    return _finish(figure, path)


def _draw_panel(axes: Axes, panel: Panel) -> None:
    from matplotlib.ticker import FixedLocator, LogFormatterSciNotation, MaxNLocator, NullFormatter

    references = list(panel.references) or [None] * len(panel.values)
    known = [(row, value, references[row]) for row, value in enumerate(panel.values) if value is not None]
    levels = np.array([number for _, *pair in known for number in pair if number is not None], dtype=np.float64)
    low, high = panel.limits or (min(0.0, float(levels.min())), max(float(levels.max()), 1e-12))
    if panel.limits is None and levels.min() > 0 and levels.max() > 20 * levels.min():
        low = float(levels.min())
        axes.set_xscale("log")
        axes.margins(x=0.15)
        axes.xaxis.set_major_formatter(LogFormatterSciNotation())
        axes.xaxis.set_minor_formatter(NullFormatter())
    else:
        axes.set_xlim(low - 0.06 * (high - low), high + 0.1 * (high - low))
        axes.xaxis.set_major_locator(FixedLocator([low, (low + high) / 2, high]) if panel.limits else MaxNLocator(3))
    for row, value, reference in known:
        if reference is not None:
            axes.vlines(reference, row - 0.5, row + 0.5, color=SET_COLORS[1], linewidth=1.2, zorder=1)
        axes.hlines(row, low if reference is None else reference, value, color=REST_COLOR, linewidth=1.0, zorder=2)
        axes.plot([value], [row], "o", color=SET_COLORS[0], markersize=4, zorder=3)
    for row, value in enumerate(panel.values):
        if value is None:
            where = axes.get_yaxis_transform()
            axes.text(0.5, row, "none", transform=where, ha="center", va="center", fontsize=_TEXT - 2, color=REST_COLOR)
    _style_panel(axes, panel)


def _style_panel(axes: Axes, panel: Panel) -> None:
    axes.set_title(panel.title, fontsize=_TEXT + 1, loc="left")
    axes.set_xlabel(panel.label, fontsize=_TEXT - 1)
    axes.tick_params(labelsize=_TEXT - 1, length=2.5)
    axes.tick_params(axis="y", labelsize=_TEXT, length=0)
    axes.grid(axis="y", color=WALL_COLOR, linewidth=0.4)
    axes.set_axisbelow(True)
    axes.spines[["top", "right", "left"]].set_visible(False)


def _fidelity_handles() -> tuple[list[Any], list[str]]:
    from matplotlib.lines import Line2D

    dot = Line2D([], [], color=SET_COLORS[0], marker="o", markersize=4, linewidth=0)
    return [dot, Line2D([], [], color=SET_COLORS[1], linewidth=1)], ["method", "real data in its place"]


def _path(number: int, rows: Positions) -> npt.NDArray[np.float64]:
    values = np.asarray(rows, dtype=np.float64)
    if values.ndim != 2 or len(values) < 2 or values.shape[1] < 2:
        raise InvalidDataError(f"Trajectory {number} has shape {values.shape}; expected (T+1, 2) with T >= 1.")
    return values[:, :2]


def _cut(paths: Sequence[npt.NDArray[np.float64]], span: Span, number: int) -> npt.NDArray[np.float64]:
    episode, start, stop = span
    if not 0 <= episode < len(paths) or not 0 <= start < stop < len(paths[episode]):
        raise InvalidDataError(
            f"Set {number + 1} has the span {span}, which is outside the {len(paths)} trajectories given; expected "
            "(episode, start, stop) with 0 <= start < stop <= T."
        )
    return paths[episode][start : stop + 1]


def _draw_walls(axes: Axes, walls: npt.NDArray[np.float64]) -> None:
    from matplotlib.collections import PolyCollection

    if walls.ndim != 2 or walls.shape[1] != 4:
        raise InvalidDataError(f"maze has shape {walls.shape}; expected (n, 4): x, y, width, height of each wall.")
    corners = walls[:, None, :2] + walls[:, None, 2:] * np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    blocks = PolyCollection(list(corners), facecolor=WALL_COLOR, edgecolor=WALL_COLOR, linewidth=0.4, zorder=1)
    axes.add_collection(blocks, autolim=False)
    inset = 0.6 * walls[:, 2:].min()  # a strip of the outer walls is enough to see them
    axes.update_datalim([corners.min(axis=(0, 1)) + inset, corners.max(axis=(0, 1)) - inset])
    axes.margins(0)


def _label_maze(axes: Axes, title: str | None) -> None:
    axes.set_xlabel("x (m)", fontsize=_TEXT)
    axes.set_ylabel("y (m)", fontsize=_TEXT)
    axes.tick_params(labelsize=_TEXT, length=2.5)
    if title is not None:
        axes.set_title(title, fontsize=_TEXT + 1)


def _handles(labels: Sequence[str]) -> tuple[list[Any], list[str]]:
    from matplotlib.lines import Line2D

    handles = [Line2D([], [], color=SET_COLORS[i], linewidth=2) for i in range(len(labels))]
    return [*handles, Line2D([], [], color=REST_COLOR, linewidth=1)], [*labels, "rest of the trajectories"]


def _legend_below(figure: Figure, handles: Sequence[Any], labels: Sequence[str]) -> None:
    if labels:
        columns = min(len(labels), 2 if figure.get_figwidth() > 5 else 3)
        figure.legend(handles, labels, loc="outside lower center", ncols=columns, fontsize=_TEXT, frameon=False)


def _figure(width: float, height: float) -> Figure:
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), dpi=_DPI, layout="constrained")


def _finish(figure: Figure, path: Path | None) -> Figure:
    if path is not None:
        figure.savefig(path, dpi=_DPI, bbox_inches="tight")
    return figure
