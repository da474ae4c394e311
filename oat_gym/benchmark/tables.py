"""The paper's tables in its layout, our numbers beside the paper's, and tables of all that was found."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from oat_gym.benchmark import paper
from oat_gym.benchmark.analysis import MEAN, RIVALRY, RIVALS, Analysis, Finding
from oat_gym.benchmark.captions import USES, notes
from oat_gym.benchmark.estimates import estimates_table
from oat_gym.benchmark.grid import Table, format_number
from oat_gym.benchmark.scores import METRICS, Metric
from oat_gym.benchmark.variants import NONE, VARIANTS
from oat_gym.ope import metrics as ope_metrics

SIGNS = {"helps": "+", "hurts": "-", "no evidence": "", "not measured": ""}
"""What stands behind a number that differs from no augmentation with an interval that excludes zero."""
FLOOR = "mean recorded return"
"""In the place of an estimator: the log's own average, said of every policy."""
EXPERT = "expert"
"""Name of the policy that others are tested against in table 1."""


def all_tables(analysis: Analysis) -> tuple[Table, ...]:
    """Return every table that the results fill at least one row of: the paper's, and those of other datasets."""
    made: list[Table | None] = [table_1(analysis, dataset) for dataset in analysis.results.datasets]
    made.append(table_2(analysis))
    made += [paper_table(analysis, level, metric) for level in paper.LEVELS for metric in METRICS]
    made += [dataset_table(analysis, dataset) for dataset in analysis.with_truth()]
    made += [help_table(analysis, dataset, metric) for dataset in analysis.with_truth() for metric in METRICS]
    made += [
        help_table(analysis, dataset, metric, baseline=baseline)
        for dataset in analysis.with_truth()
        for metric in RIVALRY
        for baseline in RIVALS
    ]
    made += [estimates_table(analysis, dataset) for dataset in analysis.without_truth()]
    made += [overview_table(analysis, metric, baseline=name) for metric in RIVALRY for name in (NONE, *RIVALS)]
    return tuple(table for table in made if table is not None)


def adroit_dataset(analysis: Analysis, level: str, task: str) -> str | None:
    """Return the dataset of a level and task of Adroit that was measured; None where there is none."""
    kinds = (level, "cloned-from-expert") if level == "cloned" else (level,)
    names = [f"adroit-{task}-{kind}" for kind in kinds]
    return next((name for name in names if name in analysis.with_truth()), None)


def paper_table(analysis: Analysis, level: str, metric: Metric) -> Table | None:
    """Return one of tables 3 to 14: a row for each estimator and method, for each task ours and the paper's number."""
    datasets = {task: adroit_dataset(analysis, level, task) for task in paper.TASKS}
    if not any(datasets.values()):
        return None
    rows = [
        (family, method_name(variant), *_pairs(analysis, datasets, level, metric, family=family, variant=variant))
        for family in analysis.results.families
        for variant in _methods(analysis, *datasets.values())
    ]
    number = paper.TABLES[level, metric]
    header = ("estimator", "method", *(text for task in paper.TASKS for text in (task, "paper")))
    caption = f"Table {number}. {METRICS[metric].capitalize()}, Adroit {level}. {notes(analysis, datasets)}"
    return Table(f"table-{number:02d}", caption, header, tuple(rows))


def table_2(analysis: Analysis) -> Table | None:
    """Return table 2: averages over the estimators, Adroit human, all four metrics of each task.

    Of a task that was not measured it has the paper's numbers alone.
    """
    datasets = {task: adroit_dataset(analysis, "human", task) for task in paper.TASKS}
    if not any(datasets.values()):
        return None
    rows: list[tuple[str, ...]] = []
    for task, dataset in datasets.items():
        for variant in _methods(analysis, dataset):
            cells = [
                text
                for metric in METRICS
                for text in _pairs(analysis, {task: dataset}, "human", metric, family=MEAN, variant=variant)
            ]
            rows.append((task, method_name(variant), *cells))
    header = ("task", "method", *(text for name in METRICS.values() for text in (name, "paper")))
    caption = f"Table 2. Averages over the estimators, Adroit human. {notes(analysis, datasets)}"
    return Table("table-02", caption, header, tuple(rows))


def dataset_table(analysis: Analysis, dataset: str) -> Table:
    """Return all metrics of one dataset: a row for each estimator (and their mean) and variant that was tried on it.

    The last row is the error of the mean recorded return, said of every policy (`Analysis.floor`).
    """
    rows = [
        (family, variant, *(cell_text(analysis, dataset, variant, family, metric) for metric in METRICS))
        for family in (*analysis.results.families, MEAN)
        for variant in _tried(analysis, dataset)
    ]
    floor = analysis.floor(dataset)
    if floor is not None:
        rows.append((FLOOR, NONE, format_number(floor), *("-" for _ in list(METRICS)[1:])))
    caption = f"All metrics of {dataset}. {notes(analysis, {dataset: dataset})}"
    return Table(f"dataset-{dataset}", caption, ("estimator", "variant", *METRICS.values()), tuple(rows))


def help_table(analysis: Analysis, dataset: str, metric: Metric, *, baseline: str = NONE) -> Table | None:
    """Return whether each variant helped each estimator, and their mean: the improvement, its interval, the verdict.

    With a `baseline` other than no augmentation the table says which variants are better and which are worse than it.
    """
    columns = (MEAN, *analysis.results.families)
    rows: list[tuple[str, ...]] = []
    for variant in (name for name in analysis.results.variants if name not in (NONE, baseline)):
        found = [analysis.finding(dataset, variant, name, metric, baseline=baseline) for name in columns]
        if any(each is not None for each in found):
            seeds = max(each.improvement.n_seeds for each in found if each is not None)
            rows.append((variant, str(seeds), *(_verdict_text(each, len(analysis.results.families)) for each in found)))
    if not rows:
        return None
    unit = "percent less error" if metric == "mae" else "in its own unit"
    plain = baseline == NONE
    question, other = ("Did it help", "no augmentation") if plain else (f"Is it better than {baseline}", baseline)
    caption = (
        f"{question} on {dataset}? Improvement of the {METRICS[metric]} over {other} ({unit}, positive is "
        f"better), 95% interval and verdict; of FQE and MB from given starts it is for these recorded episodes. "
        f"{notes(analysis, {dataset: dataset}, signs=False)}{'' if plain else f' {USES}'}"
    )
    name = f"helped-{metric}-{dataset}" if plain else f"against-{baseline}-{metric}-{dataset}"
    return Table(name, caption, ("variant", "seeds", *columns), tuple(rows))


def overview_table(analysis: Analysis, metric: Metric, *, baseline: str = NONE) -> Table | None:
    """Return the improvement of the mean over the estimators, a row for each variant and a column for each dataset.

    Before them: the mean over all tasks in both forms of `Analysis.over_all`, and on how many datasets, of those with
    two seeds or more, a variant helps and hurts. None for one dataset, which has a table itself.
    """
    datasets = analysis.with_truth()
    rows: list[tuple[str, ...]] = []
    for variant in (name for name in analysis.results.variants if name not in (NONE, baseline)):
        found = [analysis.finding(dataset, variant, MEAN, metric, baseline=baseline) for dataset in datasets]
        verdicts = [each.improvement.verdict for each in found if each is not None and each.improvement.n_seeds > 1]
        counts = [f"{verdicts.count(verdict)} of {len(verdicts)}" for verdict in ("helps", "hurts")]
        if any(each is not None for each in found):
            families = len(analysis.results.families)
            whole = [
                _verdict_text(analysis.over_all(variant, MEAN, metric, baseline=baseline, between=between), families)
                for between in (False, True)
            ]
            rows.append((variant, *whole, *counts, *(_overview_text(each, families) for each in found)))
    if len(datasets) < 2 or not rows:
        return None
    unit, plain = "percent less error" if metric == "mae" else "in its own unit", baseline == NONE
    caption = (
        f"Improvement of the {METRICS[metric]}, the estimators' mean, over {'no augmentation' if plain else baseline} "
        f"({unit}, positive is better), 95% interval and verdict. {analysis.results.setting.describe()}. Over all: the "
        "mean over tasks of two seeds or more; datasets that share policies or episodes count as one. Its first "
        "interval is of these datasets, the second, of another such task, comes from how much the tasks differ. The "
        f"seeds of each dataset are in its own table. {USES}"
    )
    words = ("helps on", "hurts on") if plain else ("better on", "worse on")
    name = f"overview-{metric}" if plain else f"overview-against-{baseline}-{metric}"
    return Table(name, caption, ("variant", "over all", "another task", *words, *datasets), tuple(rows))


def _overview_text(found: Finding | None, families: int) -> str:
    if found is not None and found.improvement.n_seeds == 1 and math.isfinite(found.improvement.value):
        return f"{format_number(found.improvement.value)} (one seed)"
    return _verdict_text(found, families)


def _verdict_text(found: Finding | None, families: int) -> str:
    """Return an improvement, its interval and the verdict; a mean of fewer than all `families` is said to be so."""
    if found is None or not math.isfinite(found.improvement.value):
        return "-"
    change, number = found.improvement, len(found.families)
    of = f" [{number} of {families} estimators]" if found.family == MEAN and number < families else ""
    numbers = [format_number(number) for number in (change.value, change.low, change.high)]
    if not math.isfinite(change.low):
        return f"{numbers[0]} (no interval){of}"
    words = ("helps", "hurts") if found.baseline == NONE else ("better", "worse")
    word = {"helps": f" {words[0]}", "hurts": f" {words[1]}"}.get(change.verdict, "")
    return f"{numbers[0]} ({numbers[1]} to {numbers[2]}){word}{of}"


def table_1(analysis: Analysis, dataset: str) -> Table | None:
    """Return table 1 for a dataset with a policy "expert": t and p of each other policy, by importance sampling.

    "paper" is Welch's test of the two samples of replicates, as the paper describes it; its t grows with the number of
    resamples. "paired" takes the deviation of paired differences as standard error (`ope.metrics.t_test`). The last
    column has the paper's own numbers, of the three policies of its tutoring data.
    """
    cells = analysis.cells(dataset, NONE, "IS")
    if not cells or EXPERT not in cells[0].policies:
        return None
    others = [name for name in cells[0].policies if name != EXPERT]
    rows = [
        (
            method_name(variant),
            method,
            *_tests(analysis, dataset, variant, others, method),
            _paper_tests(variant, method),
        )
        for variant in analysis.results.variants
        for method in ("paper", "paired")
        if analysis.cells(dataset, variant, "IS")
    ]
    rows += _empirical(analysis, dataset, others)
    caption = (
        f"Table 1. t and p of each policy against {EXPERT!r} on {dataset}, by importance sampling. "
        f"{analysis.results.setting.describe()}."
    )
    return Table(f"table-01-{dataset}", caption, ("method", "test", *others, "the paper's three"), tuple(rows))


def _paper_tests(variant: str, method: str) -> str:
    row = VARIANTS[variant].paper if variant in VARIANTS else ""
    printed = paper.TABLE_1.get("NoAug." if variant == NONE else row, ()) if method == "paper" else ()
    return "; ".join(f"{t:.2f} ({p:.2f})" for t, p in printed)


def _tests(analysis: Analysis, dataset: str, variant: str, others: Sequence[str], method: str) -> list[str]:
    cells = analysis.cells(dataset, variant, "IS")
    draws = np.mean([cell.replicates for cell in cells], axis=0)
    names, units = list(cells[0].policies), int(cells[0].record["n_episodes"])
    texts: list[str] = []
    for name in others:
        sides = draws[names.index(name)], draws[names.index(EXPERT)]
        if not np.isfinite(sides).all():
            texts.append("-")
            continue
        test = ope_metrics.t_test(*sides, method="paper" if method == "paper" else "bootstrap", n=units)
        texts.append(f"{test.statistic:.2f} ({test.p_value:.2f})")
    return texts


def _empirical(analysis: Analysis, dataset: str, others: Sequence[str]) -> list[tuple[str, ...]]:
    """Return the test of the true values, from their standard errors."""
    from scipy import stats  # noqa: PLC0415  (slow to import, and needed here only)

    cell = analysis.cells(dataset, NONE, "IS")[0]
    if not cell.knows_truth:
        return []
    names, texts = list(cell.policies), list[str]()
    for name in others:
        p, q = names.index(name), names.index(EXPERT)
        error = math.hypot(cell.true_errors[p], cell.true_errors[q])
        t = float(cell.true[p] - cell.true[q]) / error if error > 0 else math.nan
        texts.append("exact" if math.isnan(t) else f"{t:.2f} ({2 * stats.norm.sf(abs(t)):.2f})")
    printed = "; ".join(f"{t:.2f} ({p:.2f})" for t, p in paper.TABLE_1["Empirical result"])
    return [("Empirical result", "roll-outs", *texts, printed)]


def cell_text(analysis: Analysis, dataset: str, variant: str, family: str, metric: Metric) -> str:
    """Return our number of a place in the tables: mean, deviation over seeds and the sign of an improvement.

    A mean over the estimators is of the seeds that all of them have.
    """
    families = analysis.results.families if family == MEAN else (family,)
    seeds = analysis.common_seeds(dataset, variant, families)
    scores = [analysis.scores(dataset, variant, name, metric, seeds=seeds) for name in families] if seeds else []
    if not scores or not all(len(part) for part in scores):
        return "-"
    digits = 0 if metric == "mae" and abs(float(np.mean(scores[0]))) >= 100 else 2
    known = [part[np.isfinite(part)] for part in scores]
    if not all(len(part) for part in known):
        return "-"
    mean = float(np.mean([part.mean() for part in known]))
    text = f"{mean:.{digits}f}"
    if family != MEAN and len(known[0]) > 1:
        text += f" ± {known[0].std(ddof=1):.{digits}f}"
    found = None if variant == NONE else analysis.finding(dataset, variant, family, metric)
    sign = "" if found is None else SIGNS[found.improvement.verdict]
    return f"{text} {sign}".strip()


def _pairs(
    analysis: Analysis, datasets: dict[str, str | None], level: str, metric: Metric, *, family: str, variant: str
) -> list[str]:
    """Return, for each task, our number and the paper's."""
    texts: list[str] = []
    method = VARIANTS[variant].paper if variant in VARIANTS else ""
    look_up: Callable[[str], paper.Printed] = (
        (lambda task: paper.average(level, metric, method, task))
        if family == MEAN
        else (lambda task: paper.printed(level, metric, family, method, task))
    )
    for task, dataset in datasets.items():
        ours = "" if dataset is None else cell_text(analysis, dataset, variant, family, metric)
        theirs = look_up(task) if method and family in (*paper.ESTIMATORS, MEAN) else paper.Printed(math.nan)
        texts += [ours, _printed(theirs, metric)]
    return texts


def _printed(number: paper.Printed, metric: Metric) -> str:
    if not number.known:
        return ""
    digits = 0 if metric == "mae" else 2
    text = f"{number.mean:.{digits}f}"
    return text if math.isnan(number.deviation) else f"{text} ± {number.deviation:.{digits}f}"


def _tried(analysis: Analysis, *datasets: str | None) -> list[str]:
    """Return the variants that were tried on one of the datasets."""
    there = {cell.variant for cell in analysis.results.cells if cell.dataset in datasets}
    return [variant for variant in analysis.results.variants if variant in there]


def _methods(analysis: Analysis, *datasets: str | None) -> list[str]:
    """Return the variants that were tried on one of the datasets, and those that the paper has numbers of."""
    there = _tried(analysis, *datasets)
    printed = [name for name, variant in VARIANTS.items() if variant.paper]
    return [name for name in analysis.results.variants if name in there or name in printed]


def method_name(variant: str) -> str:
    """Return a variant's name, with the paper's where it repeats a row of its tables."""
    row = VARIANTS[variant].paper if variant in VARIANTS else ""
    return f"{row} ({variant})" if row and row.lower() != variant else row or variant
