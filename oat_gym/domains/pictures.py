"""Pictures of a domain's data that show many episodes at once: no single patient or student can be read off them."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from oat_gym.errors import ConfigurationError, InvalidDataError
from oat_gym.ope.agreement import AgreementCurve
from oat_gym.plots import REST_COLOR, SET_COLORS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FloatArray = npt.NDArray[np.float64]
Path = str | os.PathLike[str]

_DPI, _TEXT = 110, 8.0


def shares_over_time(
    categories: Sequence[npt.NDArray[np.integer]],
    times: Sequence[FloatArray],
    *,
    names: Sequence[str],
    until: float,
    unit: str = "hours",
    path: Path | None = None,
) -> Figure:
    """Return a stacked picture of the share of episodes in each category, and how many episodes there still are.

    An episode is in its latest category until its last time, and counts no longer after it.

    Args:
        categories: for each episode (N,) categories 0, 1, ...
        times: for each episode (N,) the times at which they begin, which never decrease.
        names: of the categories.
        until: end of the time axis.
        unit: of the times.
        path: where to save the figure as well.

    Raises:
        ConfigurationError: for more categories than there are colours, or an `until` that is not positive.
        InvalidDataError: without episodes, or for arrays of different lengths.

    >>> figure = shares_over_time([np.array([0, 1])], [np.array([0.0, 2.0])], names=["well", "ill"], until=2.0)
    >>> len(figure.axes)
    2
    """
    if not 1 <= len(names) <= len(SET_COLORS) or until <= 0:
        raise ConfigurationError(f"Give 1 to {len(SET_COLORS)} names and a positive until, got {names!r} and {until}.")
    grid = np.linspace(0.0, until, 241)
    counts = _counts(categories, times, grid, len(names))
    present = counts.sum(axis=0)
    figure = _figure(4.6, 3.4)
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    upper.stackplot(grid, counts / np.maximum(present, 1), labels=names, colors=SET_COLORS[: len(names)], linewidth=0)
    upper.set_ylim(0, 1)
    upper.set_ylabel("share of episodes", fontsize=_TEXT)
    lower.step(grid, present, where="post", color=REST_COLOR)
    lower.set_ylim(bottom=0)
    lower.set_ylabel("episodes", fontsize=_TEXT)
    lower.set_xlabel(f"{unit} since the first event", fontsize=_TEXT)
    lower.set_xlim(0, until)
    return _finish(figure, path, legend=upper)


def agreement(
    curves: Mapping[str, AgreementCurve],
    *,
    event: str = "event",
    path: Path | None = None,
) -> Figure:
    """Return the rate of an event by agreement with each policy.

    The bars are Wilson intervals. The number beside a point counts its episodes, where it is not all of them; a point
    without episodes is left out.

    Args:
        curves: name of a policy -> its curve (`oat_gym.ope.agreement_curve`), at most six.
        event: what happened.
        path: where to save the figure as well.

    Raises:
        ConfigurationError: without curves, or with more than there are colours.

    >>> from oat_gym.ope import agreement_curve
    >>> len(agreement({"policy": agreement_curve([0.1, 0.9], [True, False], kind="at-least")}).axes)
    1
    """
    if not 1 <= len(curves) <= len(SET_COLORS):
        raise ConfigurationError(f"Give 1 to {len(SET_COLORS)} curves, got {len(curves)}.")
    figure = _figure(4.6, 3.4)
    axes = figure.subplots()
    for number, (name, curve) in enumerate(curves.items()):
        shift = 0.012 * (number - (len(curves) - 1) / 2)  # side by side, so that the bars can be told apart
        _draw_curve(axes, curve, label=name, color=SET_COLORS[number], shift=shift)
    axes.set_ylim(-0.03, 1.03)
    axes.set_xlabel("agreement of at least", fontsize=_TEXT)
    axes.set_ylabel(f"rate of {event}", fontsize=_TEXT)
    return _finish(figure, path, legend=axes)


def windows(
    values: FloatArray,
    others: FloatArray,
    *,
    names: Sequence[str],
    path: Path | None = None,
) -> Figure:
    """Return the course of each feature in mined windows: median and quartiles by step, and the median of all data.

    Args:
        values: (M, W, D) the windows.
        others: (n, D) all rows of the data.
        names: of the D features.
        path: where to save the figure as well.

    Raises:
        InvalidDataError: for shapes that do not agree.

    >>> len(windows(np.zeros((3, 5, 2)), np.zeros((9, 2)), names=["a", "b"]).axes)
    2
    """
    if values.ndim != 3 or not len(values) or values.shape[2] != others.shape[-1] or values.shape[2] != len(names):
        raise InvalidDataError(f"Windows {values.shape}, rows {others.shape} and {len(names)} names do not agree.")
    columns = min(5, len(names))
    rows = -(-len(names) // columns)
    figure = _figure(1.5 * columns, 1.15 * rows)
    panels = figure.subplots(rows, columns, sharex=True, squeeze=False)
    low, middle, high = np.quantile(values, [0.25, 0.5, 0.75], axis=0)
    steps = np.arange(values.shape[1])
    for column, axes in enumerate(panels.flat):
        if column >= len(names):
            axes.set_visible(False)
            continue
        axes.fill_between(steps, low[:, column], high[:, column], color=SET_COLORS[0], alpha=0.25, linewidth=0)
        axes.plot(steps, middle[:, column], color=SET_COLORS[0], linewidth=1.2)
        axes.axhline(np.median(others[:, column]), color=REST_COLOR, linewidth=0.8, linestyle="--")
        axes.set_title(names[column].replace("_", " "), fontsize=_TEXT - 1)
        _tidy(axes)
    return _finish(figure, path)


def _draw_curve(axes: Axes, curve: AgreementCurve, *, label: str, color: str, shift: float) -> None:
    shown = curve.count > 0
    x, rate, count = curve.low[shown] + shift, curve.rate[shown], curve.count[shown]
    reach = np.maximum([rate - curve.rate_low[shown], curve.rate_high[shown] - rate], 0.0)
    bars = axes.errorbar(x, rate, yerr=reach, label=label, color=color, linewidth=1.2, elinewidth=0.6)
    bars.lines[0].set(marker="o", markersize=3)
    for i in np.flatnonzero(count < count.max(initial=0)):  # at the first point all curves count all episodes
        place = (float(x[i]), float(rate[i]))
        axes.annotate(str(count[i]), place, (3, 3), textcoords="offset points", fontsize=_TEXT - 3, color=color)


def _counts(
    categories: Sequence[npt.NDArray[np.integer]], times: Sequence[FloatArray], grid: FloatArray, size: int
) -> FloatArray:
    """Return (size, len(grid)) the number of episodes in each category at each time."""
    if not categories or [len(part) for part in categories] != [len(part) for part in times]:
        raise InvalidDataError("Give one array of categories and one of times, of equal lengths, for each episode.")
    counts = np.zeros((size, len(grid)))
    for codes, begins in zip(categories, times, strict=True):
        inside = np.flatnonzero((grid >= begins[0]) & (grid <= begins[-1]))
        latest = np.searchsorted(begins, grid[inside], side="right") - 1
        counts[codes[latest], inside] += 1
    return counts


def _figure(width: float, height: float) -> Figure:
    from matplotlib.figure import Figure  # noqa: PLC0415  (imported when a picture is drawn)

    return Figure(figsize=(width, height), dpi=_DPI, layout="constrained")


def _tidy(axes: Axes) -> None:
    axes.tick_params(labelsize=_TEXT - 1)
    axes.spines[["top", "right"]].set_visible(False)


def _finish(figure: Figure, path: Path | None, *, legend: Axes | None = None) -> Figure:
    for axes in figure.axes:
        _tidy(axes)
    if legend is not None:
        handles, labels = legend.get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=_TEXT, frameon=False)
    if path is not None:
        is_png = os.path.splitext(path)[1].lower() in ("", ".png")  # noqa: PTH122  (a text, or any kind of path)
        figure.savefig(path, dpi=_DPI, metadata={"Software": None} if is_png else None)
    return figure
