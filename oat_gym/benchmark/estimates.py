"""Estimates where nobody knows the true values: how far augmentation moves them, and whether their order stays."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from oat_gym.benchmark.analysis import Analysis, Estimate
from oat_gym.benchmark.captions import USES, budget_lines, seed_numbers
from oat_gym.benchmark.grid import Table, format_number
from oat_gym.benchmark.scores import score


def estimates_table(analysis: Analysis, dataset: str) -> Table | None:
    """Return the estimates of a dataset: a row for each estimator and variant, a column for each policy.

    The columns behind say how many seeds there are, how far apart they are (the mean over the policies of the standard
    deviation), and what augmentation changed at the same seeds: the mean over the policies of |change|, and the rank
    correlation of the policies with and without it. None where there are no estimates.
    """
    found: dict[tuple[str, str], list[Estimate]] = {}
    for each in analysis.estimates(dataset):
        found.setdefault((each.family, each.variant), []).append(each)
    if not found:
        return None
    policies = tuple(each.policy for each in next(iter(found.values())))
    rows = [(*place, *map(_text, estimates), *_summary(estimates)) for place, estimates in found.items()]
    header = ("estimator", "variant", *policies, "seeds", "seeds apart", "moved by", "order kept")
    return Table(f"estimates-{dataset}", _caption(analysis, dataset), header, tuple(rows))


def _caption(analysis: Analysis, dataset: str) -> str:
    starts = sorted({cell.initial for cell in analysis.results.cells if cell.dataset == dataset and not cell.failed})
    setting, log = analysis.results.setting, ""
    recorded = analysis.recorded(dataset)
    if recorded is not None:
        mean, error = map(format_number, recorded)
        log = f" The recorded episodes return {mean} on average, discounted (standard error {error})."
    return (
        f"Estimates of {dataset}, whose true values are not known here: mean over the seeds and 95% bootstrap interval "
        "over the recorded episodes. That they move when data is augmented does not say that they get better, and they "
        f"move between seeds too.{log} {seed_numbers(analysis, [dataset])[0]}; budget {setting.budget!r}, values from "
        f"{', '.join(starts)} starts, behaviour policy {setting.question.behavior!r}; "
        f"{'; '.join(budget_lines(analysis.results))}. {USES}"
    )


def _text(estimate: Estimate) -> str:
    value, low, high = (format_number(number) for number in (estimate.value, estimate.low, estimate.high))
    return f"{value} ({low} to {high})"


def _summary(estimates: Sequence[Estimate]) -> tuple[str, str, str, str]:
    """Return the last columns of a row; "-" where there is nothing to compare with."""
    values, changes = (np.array([getattr(each, name) for each in estimates]) for name in ("value", "change"))
    seeds = str(estimates[0].seeds), format_number(float(np.mean([each.deviation for each in estimates])))
    if np.isnan(changes).any():
        return *seeds, "-", "-"
    kept = float(score(values, values - changes, "rank_correlation"))
    return *seeds, format_number(float(np.abs(changes).mean())), "-" if math.isnan(kept) else f"{kept:.2f}"
