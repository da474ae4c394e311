"""Findings in words and pictures: what the page of `oat-gym report` is made of."""

from __future__ import annotations

import base64
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from oat_gym import plots
from oat_gym.benchmark import figures, paper
from oat_gym.benchmark.analysis import MEAN, Analysis, Finding
from oat_gym.benchmark.captions import stand_ins_of
from oat_gym.benchmark.figures import Panel
from oat_gym.benchmark.grid import format_number
from oat_gym.benchmark.improvement import Improvement
from oat_gym.benchmark.scores import METRICS, Metric
from oat_gym.benchmark.tables import adroit_dataset
from oat_gym.benchmark.variants import NONE, VARIANTS
from oat_gym.cache import Arrays
from oat_gym.domains import maze2d

UNITS: dict[Metric, str] = {
    "mae": "percent less error",
    "rank_correlation": "rise of the correlation",
    "regret_at_1": "fall of the regret",
    "regret_at_5": "fall of the regret",
}
Group = tuple[str, Sequence[str]]
"""A title and the datasets that are averaged over."""


@dataclass(frozen=True)
class Picture:
    """A picture of the page: a PNG file's bytes in base64, a caption, and the text for those who do not see it."""

    data: str
    caption: str
    alt: str

    @classmethod
    def of(cls, figure: Any, caption: str, *, alt: str = "") -> Picture:
        """Return the picture of a matplotlib figure."""
        return cls(base64.b64encode(figures.to_png(figure)).decode(), caption, alt or caption)


def groups_of(analysis: Analysis) -> list[tuple[Group, str | None]]:
    """Return the groups of datasets whose improvements are averaged, and the level of the paper's numbers of each.

    Only tasks of one level are: other datasets may share episodes or policies and are not independent.
    """
    groups: list[tuple[Group, str | None]] = []
    for level in paper.LEVELS:
        names = [name for task in paper.TASKS if (name := adroit_dataset(analysis, level, task))]
        if names:
            others = stand_ins_of(names)
            title = f"Adroit {level}: {len(names)} of 4 tasks"
            title += f" ({len(others)} stand-ins: {', '.join(others)})" if others else ""
            groups.append(((title, names), level))
    adroit = {name for (_, names), _ in groups for name in names}
    groups += [((name, [name]), None) for name in analysis.with_truth() if name not in adroit]
    return groups


def part_of(found: Finding, analysis: Analysis, group: Group) -> str:
    """Return which estimators and how many datasets a mean is of, where that is not all of them; else ""."""
    parts: list[str] = []
    if found.family == MEAN and set(found.families) != set(analysis.results.families):
        parts.append(f"{', '.join(found.families)} only")
    if len(found.datasets) < len(group[1]):
        parts.append(f"{len(found.datasets)} of {len(group[1])} datasets")
    return "; ".join(parts)


def sentence(found: Finding, *, of: str, part: str = "") -> str:
    """Return a finding in words: by how much, how sure, and the verdict; `part` says what a mean is of."""
    change = found.improvement
    if not math.isfinite(change.value):
        return f"{of}: not measured."
    better = change.value >= 0
    ends = (change.low, change.high) if better else (-change.high, -change.low)
    size, low, high = (format_number(number) for number in (abs(change.value), *ends))
    told = f"95% interval {low} to {high}" if math.isfinite(change.low) else "no interval"
    ends = told + (f"; {part}" if part else "")
    what = {
        "mae": f"{'lowers' if better else 'raises'} the error by {size}% ({ends})",
        "rank_correlation": f"{'raises' if better else 'lowers'} the rank correlation by {size} ({ends})",
    }
    default = f"{'lowers' if better else 'raises'} the {METRICS[found.metric]} by {size} ({ends})"
    text = f"{of} {what.get(found.metric, default)}: {change.verdict}."
    return text if change.n_seeds > 1 else f"{text} One seed says nothing about chance in training."


def summary_rows(analysis: Analysis, group: Group) -> list[dict[str, Any]]:
    """Return, for each variant, its verdict by each metric, averaged over the estimators and the group's datasets."""
    rows: list[dict[str, Any]] = []
    for variant in _measured(analysis, group):
        found = {metric: analysis.over(group[1], variant, MEAN, metric) for metric in METRICS}
        part = next((part_of(each, analysis, group) for each in found.values() if each is not None), "")
        text = f"{note(variant)} ({part})" if part else note(variant)
        rows.append({"variant": variant, "note": text, "cells": [_verdict(each) for each in found.values()]})
    return rows


def floor_sentence(analysis: Analysis, dataset: str) -> str:
    """Return how far off the log's own average is, and which estimators are further off without augmentation; or ""."""
    floor, log = analysis.floor(dataset), analysis.recorded(dataset)
    if floor is None or log is None:
        return ""
    mean, error = log
    errors = {name: analysis.scores(dataset, NONE, name, "mae") for name in analysis.results.families}
    measured = {name: float(found.mean()) for name, found in errors.items() if len(found)}
    worse = [name for name, off in measured.items() if off > floor]
    told = f"The recorded episodes return {format_number(mean)} on average, discounted (standard error "
    told += f"{format_number(error)}). Said of every policy, that is off by {format_number(floor)}"
    if worse:
        return f"{told}; further off without augmentation: {', '.join(worse)}."
    return f"{told}, further than every estimator without augmentation." if measured else f"{told}."


def _measured(analysis: Analysis, group: Group) -> list[str]:
    """Return the variants that have cells of a group's datasets, in the order of the runs."""
    there = {cell.variant for cell in analysis.results.cells if cell.dataset in group[1]} - {NONE}
    return [variant for variant in analysis.results.variants if variant in there]


def note(variant: str) -> str:
    """Return what a variant is, in a line."""
    return VARIANTS[variant].note if variant in VARIANTS else ""


def _verdict(found: Finding | None) -> dict[str, str]:
    if found is None or not math.isfinite(found.improvement.value):
        return {"word": "not measured", "style": "none", "number": "", "interval": ""}
    change = found.improvement
    unit = "%" if found.metric == "mae" else ""
    return {
        "word": change.verdict,
        "style": {"helps": "good", "hurts": "bad"}.get(change.verdict, "open"),
        "number": ("+" if change.value >= 0 else "") + format_number(change.value) + unit,
        "interval": "one seed" if change.n_seeds < 2 else _interval(change),
    }


def _interval(change: Improvement) -> str:
    """Return an interval, or that there is none: too few policies are left in resamples to say."""
    if not math.isfinite(change.low):
        return "no interval"
    return f"{format_number(change.low)} to {format_number(change.high)}"


def best_sentences(analysis: Analysis, group: Group) -> list[str]:
    """Return the findings for errors and ranks of every variant, in words, the best first."""
    found = [
        each
        for variant in _measured(analysis, group)
        for metric in ("mae", "rank_correlation")
        if (each := analysis.over(group[1], variant, MEAN, metric)) is not None
    ]
    errors = {each.variant: each.improvement.value for each in found if each.metric == "mae"}
    found.sort(key=lambda each: (-errors.get(each.variant, -math.inf), each.variant, each.metric != "mae"))
    return [sentence(each, of=each.variant, part=part_of(each, analysis, group)) for each in found]


def bars(analysis: Analysis, group: Group, *, family: str = MEAN, level: str | None = None) -> Picture | None:
    """Return the bars of all metrics of a group of datasets (figures 5, 7 and 9); None where nothing was measured.

    `level` names the level of the paper's tables whose numbers are marked.
    """
    panels = bar_panels(analysis, group, family=family, level=level)
    if not panels:
        return None
    caption = f"Improvement over no augmentation, {group[0]}. Bars to the right are better; lines are 95% intervals."
    return Picture.of(figures.improvement_bars(panels, title=group[0]), caption)


def bar_panels(analysis: Analysis, group: Group, *, family: str, level: str | None) -> list[Panel]:
    """Return what `bars` draws: a panel for each metric that was measured."""
    names = _measured(analysis, group)
    panels: list[Panel] = []
    for metric, title in METRICS.items():
        found = [analysis.over(group[1], variant, family, metric) for variant in names]
        if not any(each is not None and math.isfinite(each.improvement.value) for each in found):
            continue
        changes = [None if each is None else each.improvement for each in found]
        marks = [math.nan if level is None else _paper_change(level, metric, name, group[1]) for name in names]
        labels = [_bar_label(name, each, group) for name, each in zip(names, found, strict=True)]
        panels.append(Panel(title, UNITS[metric], labels, changes, marks))
    return panels


def _bar_label(variant: str, found: Finding | None, group: Group) -> str:
    """Return a variant's name, with the number of datasets where that is not all of the group's."""
    if found is None or len(found.datasets) == len(group[1]):
        return variant
    return f"{variant} ({len(found.datasets)} of {len(group[1])})"


def _paper_change(level: str, metric: Metric, variant: str, datasets: Sequence[str]) -> float:
    """Return the improvement that the paper's tables have for a variant, averaged over the tasks of some datasets."""
    method = VARIANTS[variant].paper if variant in VARIANTS else ""
    tasks = [task for task in paper.TASKS for name in datasets if name.startswith(f"adroit-{task}-")]
    if not method or not tasks:
        return math.nan
    changes: list[float] = []
    for task in tasks:
        before, after = (paper.average(level, metric, name, task).mean for name in ("NoAug.", method))
        change = after - before if metric == "rank_correlation" else before - after
        changes.append(math.log(before / after) if metric == "mae" else change)
    mean = float(np.mean(changes))
    return 100 * -math.expm1(-mean) if metric == "mae" else mean


def by_level(analysis: Analysis) -> Picture | None:
    """Return the improvements by level of human involvement (figure 8) of variants that were measured at two or more.

    None where there is no such variant.
    """
    sets = {level: [adroit_dataset(analysis, level, task) for task in paper.TASKS] for level in paper.LEVELS}
    groups = {level: [name for name in names if name is not None] for level, names in sets.items()}
    panels = level_panels(analysis, groups)
    if not panels:
        return None
    title = "By level of human involvement (human: all by people; expert: none)"
    levels = [_level_label(level, names) for level, names in groups.items()]
    return Picture.of(figures.improvement_by_level(panels, levels=levels, title=title), title)


def level_panels(
    analysis: Analysis, groups: Mapping[str, Sequence[str]]
) -> dict[str, dict[str, list[Improvement | None]]]:
    """Return what `by_level` draws: metric -> variant -> its improvement on each level's datasets.

    A variant that was not measured on all datasets of each level has their numbers behind its name.
    """
    panels: dict[str, dict[str, list[Improvement | None]]] = {}
    for metric, title in METRICS.items():
        compared: dict[str, list[Improvement | None]] = {}
        for variant in analysis.results.variants:
            found = [analysis.over(names, variant, MEAN, metric) for names in groups.values()]
            if variant == NONE or sum(each is not None for each in found) < 2:
                continue
            numbers = [len(each.datasets) if each else 0 for each in found]
            whole = numbers == [len(names) for names in groups.values()]
            label = variant if whole else f"{variant} ({', '.join(map(str, numbers))} tasks)"
            compared[label] = [each and each.improvement for each in found]
        if compared:
            panels[f"{title}: {UNITS[metric]}"] = compared
    return panels


def _level_label(level: str, names: Sequence[str]) -> str:
    """Return a level with its number of tasks, and how many of them stand in for the paper's data."""
    others = stand_ins_of(names)
    return f"{level}: {len(names)} of 4 tasks" + (f", {len(others)} of them stand-ins" if others else "")


def coverage_picture(arrays: Arrays, value: Mapping[str, Any]) -> Picture:
    """Return what was recorded beside what was generated (figure 4)."""
    walls = maze2d.UMAZE.walls() if value["dataset"].startswith("maze2d") and value["plane"][0] == "x" else None
    title = f"{value['dataset']}, {value['variant']}, seed {value['seed']}"
    drawn = figures.coverage(arrays, labels=value["plane"], title=title, walls=walls)
    plane = "positions" if value["plane"][0] == "x" else "the two directions in which the recorded states vary most"
    return Picture.of(drawn, f"Recorded and augmented trajectories in {plane}; generated steps in blue.")


def support_picture(mining: Mapping[str, Any]) -> Picture:
    """Return the support curve of what was mined."""
    curve = {int(width): int(support) for width, support in mining["curve"].items()}
    chosen = int(mining["length"]) if int(mining["length"]) in curve else None
    drawn = plots.support_curve(curve, episodes=int(mining["episodes"]), chosen=chosen)
    return Picture.of(drawn, "In how many episodes the most common pattern of each length occurs.")


def truth_picture(analysis: Analysis, dataset: str) -> Picture | None:
    """Return the estimates of two variants over the true values, for each estimator."""
    shown = [name for name in (NONE, "oat", "oat-paper") if name in analysis.results.variants]
    shown += [name for name in analysis.results.variants if name not in shown][: max(0, 2 - len(shown))]
    panels: dict[str, dict[str, Any]] = {}
    true = None
    for family in analysis.results.families:
        members = {name: analysis.cells(dataset, name, family) for name in shown}
        there = {name: np.stack([cell.values for cell in cells]) for name, cells in members.items() if cells}
        if there:
            panels[family] = there
            true = next(cells[0].true for cells in members.values() if cells)
    if true is None:
        return None
    title = f"{dataset}: estimates over true values"
    caption = "Each point is a policy and a seed; on the grey line an estimate is right."
    return Picture.of(figures.estimates_against_truth(panels, true, title=title), caption)


def returns_picture(analysis: Analysis, dataset: str) -> Picture | None:
    """Return the true values of a dataset's policies (figure 6)."""
    for family in analysis.results.families:
        for cell in analysis.cells(dataset, NONE, family):
            title = f"True values of the policies of {cell.task}"
            drawn = figures.returns_bars(cell.policies, cell.true, cell.true_errors, title=title)
            return Picture.of(drawn, f"{title}, with 95% intervals where they come from roll-outs.")
    return None


def agreement_picture(value: Mapping[str, Any]) -> Picture | None:
    """Return the agreement curves of a dataset of which nobody knows the true values; None where it has none."""
    told = value.get("agreement")
    if not told:
        return None
    title = f"{value['dataset']}: {told['event']} by agreement with the policies"
    caption = (
        f"How often {told['event']} happened among the episodes whose decisions agreed with a policy at least so often."
        " It compares people and not policies: those treated differently may have been in another state to begin with."
    )
    return Picture.of(figures.agreement_curves(told["curves"], event=told["event"], title=title), caption)
