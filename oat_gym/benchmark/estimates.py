"""Estimates where nobody knows the true values: how far augmentation moves them, and whether their order stays."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from oat_gym.benchmark.analysis import Analysis, Estimate
from oat_gym.benchmark.captions import notes
from oat_gym.benchmark.grid import Table, format_number
from oat_gym.benchmark.scores import score
from oat_gym.benchmark.variants import NONE


def estimates_table(analysis: Analysis, dataset: str) -> Table | None:
    """Return the estimates of a dataset: a row for each estimator and variant, a column for each policy.

    The last columns say what augmentation changed: the mean over the policies of |change|, and the rank correlation of
    the policies with and without it. None where there are no estimates.
    """
    found: dict[tuple[str, str], list[Estimate]] = {}
    for each in analysis.estimates(dataset):
        found.setdefault((each.family, each.variant), []).append(each)
    if not found:
        return None
    policies = tuple(each.policy for each in next(iter(found.values())))
    rows = [
        (family, variant, *map(_text, estimates), *_changes(estimates, found.get((family, NONE), ())))
        for (family, variant), estimates in found.items()
    ]
    recorded = analysis.recorded(dataset)
    log = ""
    if recorded is not None:
        mean, error = map(format_number, recorded)
        log = f" The recorded episodes return {mean} on average (standard error {error})."
    caption = (
        f"Estimates of {dataset}, whose true values nobody knows: mean over the seeds and 95% bootstrap interval over "
        f"the recorded episodes. That they move when data is augmented does not say that they get better.{log} "
        f"{notes(analysis, {dataset: dataset}, signs=False)}"
    )
    header = ("estimator", "variant", *policies, "moved by", "order kept")
    return Table(f"estimates-{dataset}", caption, header, tuple(rows))


def _text(estimate: Estimate) -> str:
    value, low, high = (format_number(number) for number in (estimate.value, estimate.low, estimate.high))
    return f"{value} ({low} to {high})"


def _changes(estimates: Sequence[Estimate], before: Sequence[Estimate]) -> tuple[str, str]:
    """Return the mean |change| over the policies, and the rank correlation with the estimates before; "-" for those."""
    if not before or estimates[0].variant == NONE:
        return "-", "-"
    now, then = (np.array([each.value for each in side]) for side in (estimates, before))
    kept = float(score(now, then, "rank_correlation"))
    return format_number(float(np.abs(now - then).mean())), "-" if math.isnan(kept) else f"{kept:.2f}"
