"""From cells to findings: improvements of every dataset, variant and estimator, and over tasks."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import chain, product

import numpy as np
import numpy.typing as npt

from oat_gym.benchmark.improvement import Improvement, between_tasks, improve, over_related, over_tasks
from oat_gym.benchmark.results import Results
from oat_gym.benchmark.scores import METRICS, Draws, Metric, draw_scores, score
from oat_gym.benchmark.store import CellResult
from oat_gym.benchmark.variants import NONE
from oat_gym.domains import TASKS
from oat_gym.ope.intervals import bootstrap_interval

FloatArray = npt.NDArray[np.float64]
MEAN = "mean"
"""In the place of a family: the average over the estimators."""
RIVALS = ("oat-paper", "oat")
"""The forms of OAT that every other variant is compared with."""
RIVALRY: tuple[Metric, ...] = ("mae", "rank_correlation")
"""The metrics by which they are: those of the paper's claim to be ahead of every other method."""


@dataclass(frozen=True)
class Finding:
    """The improvement of some datasets by one variant, for one family of estimators or "mean", by one metric.

    `families` are those that it is of: a mean leaves out families that failed on either side. `baseline` is the variant
    that it is compared with.
    """

    datasets: tuple[str, ...]
    variant: str
    family: str
    metric: Metric
    improvement: Improvement
    families: tuple[str, ...]
    baseline: str = NONE


@dataclass(frozen=True)
class Estimate:
    """What an estimator says of a policy: the mean over some seeds.

    `low` and `high` are the ends of its 95% bootstrap interval over the recorded episodes, `deviation` is over the
    seeds (NaN for one). `change` is the mean over the seeds that both have of what it differs by from the estimate
    without augmentation (NaN where there are none).
    """

    dataset: str
    variant: str
    family: str
    policy: str
    seeds: int
    value: float
    low: float
    high: float
    deviation: float
    change: float


@dataclass
class Analysis:
    """Improvements of the cells of one setting, computed when asked for and kept.

    Only datasets whose true values are known have any; of the others there are `estimates`.
    """

    results: Results
    _cells: dict[tuple[str, str, str], dict[int, CellResult]] = field(init=False)
    _draws: dict[tuple[str, str, str, tuple[int, ...], Metric], Draws] = field(init=False)
    _known: tuple[str, ...] = field(init=False)
    _tasks: dict[str, str] = field(init=False)

    def __post_init__(self) -> None:
        self._cells, self._draws = {}, {}
        for cell in self.results.cells:
            if not cell.failed:
                self._cells.setdefault((cell.dataset, cell.variant, cell.family), {})[cell.seed] = cell
        self._tasks = {cell.dataset: _episodes_of(cell.task) for cell in self.results.cells}
        known = {cell.dataset for cell in self.results.cells if not cell.failed and cell.knows_truth}
        self._known = tuple(name for name in self.results.datasets if name in known)

    def with_truth(self) -> tuple[str, ...]:
        """Return the datasets whose policies' true values are known."""
        return self._known

    def without_truth(self) -> tuple[str, ...]:
        """Return the datasets that have estimates and no true values."""
        return tuple(name for name in self.results.datasets if name not in (*self.with_truth(), *self.failed()))

    def failed(self) -> tuple[str, ...]:
        """Return the datasets of which no cell was finished."""
        done = {cell.dataset for cell in self.results.cells if not cell.failed}
        return tuple(name for name in self.results.datasets if name not in done)

    def cells(self, dataset: str, variant: str, family: str) -> tuple[CellResult, ...]:
        """Return the finished cells of one place in the tables, by seed."""
        found = self._cells.get((dataset, variant, family), {})
        return tuple(found[seed] for seed in sorted(found))

    def floor(self, dataset: str) -> float | None:
        """Return the mean absolute error of the mean recorded return, said of every policy; None where unknown.

        An estimator that is further off tells less than the log's own average.
        """
        done = (cell for cell in self.results.cells if cell.dataset == dataset and not cell.failed and cell.knows_truth)
        cell, log = next(done, None), self.recorded(dataset)
        if cell is None or log is None:
            return None
        return float(score(np.full(len(cell.true), log[0]), cell.true, "mae"))

    def recorded(self, dataset: str) -> tuple[float, float] | None:
        """Return the mean recorded return of a dataset, discounted, and its standard error; None where unknown."""
        return self.results.recorded.get(dataset)

    def estimates(self, dataset: str) -> tuple[Estimate, ...]:
        """Return the estimates of a dataset, by estimator, variant and policy."""
        return tuple(
            each
            for family, variant in product(self.results.families, self.results.variants)
            for each in estimates_of(self.cells(dataset, variant, family), self.cells(dataset, NONE, family))
        )

    def scores(
        self, dataset: str, variant: str, family: str, metric: Metric, *, seeds: Sequence[int] | None = None
    ) -> FloatArray:
        """Return the metric of each seed, or of those in `seeds`, (S,); empty where nothing was measured."""
        cells = self.cells(dataset, variant, family)
        if not cells or not cells[0].knows_truth:
            return np.empty(0)
        there = tuple(cell.seed for cell in cells) if seeds is None else tuple(seeds)
        return self._draw(dataset, variant, family, there, metric).points

    def common_seeds(self, dataset: str, variant: str, families: Sequence[str]) -> tuple[int, ...]:
        """Return the seeds of a variant that were finished for all of some families."""
        return self._seeds(dataset, (variant,), families)

    def finding(
        self, dataset: str, variant: str, family: str, metric: Metric, *, baseline: str = NONE
    ) -> Finding | None:
        """Return the improvement over a baseline; None where a side was not measured."""
        families, sides = self.results.families if family == MEAN else (family,), (baseline, variant)
        both = [name for name in families if self._seeds(dataset, sides, (name,))]
        seeds = self._seeds(dataset, sides, both)
        if not both or not seeds or dataset not in self.with_truth():
            return None
        before = [self._draw(dataset, baseline, name, seeds, metric) for name in both]
        after = [self._draw(dataset, variant, name, seeds, metric) for name in both]
        cell = self.cells(dataset, baseline, both[0])[0]
        n_policies, n_episodes = len(cell.policies), int(cell.record["n_episodes"])
        improvement = improve(before, after, metric, n_policies=n_policies, n_episodes=n_episodes)
        return Finding((dataset,), variant, family, metric, improvement, tuple(both), baseline)

    def over(self, datasets: Sequence[str], variant: str, family: str, metric: Metric) -> Finding | None:
        """Return the mean improvement over several datasets; None where none was measured."""
        found = [each for name in datasets if (each := self.finding(name, variant, family, metric)) is not None]
        if not found:
            return None
        mean = over_tasks([each.improvement for each in found])
        families = tuple(dict.fromkeys(name for each in found for name in each.families))
        names = tuple(name for each in found for name in each.datasets)
        return Finding(names, variant, family, metric, mean, families)

    def over_all(
        self,
        variant: str,
        family: str,
        metric: Metric,
        *,
        baseline: str = NONE,
        datasets: Sequence[str] | None = None,
        between: bool = False,
    ) -> Finding | None:
        """Return the mean over all tasks, each the mean of its datasets; None where no dataset has two seeds or more.

        Datasets of one task share policies or episodes (`over_related`). Those of one seed are left out. `datasets`
        takes some datasets alone. The interval is of these datasets, or with `between` of how much the tasks differ
        (`between_tasks`).
        """
        found = [
            each
            for name in self.with_truth()
            if (datasets is None or name in datasets)
            and (each := self.finding(name, variant, family, metric, baseline=baseline)) is not None
            and each.improvement.n_seeds > 1
        ]
        if not found:
            return None
        tasks: dict[str, list[Improvement]] = {}
        for each in found:
            tasks.setdefault(self._tasks[each.datasets[0]], []).append(each.improvement)
        mean = (between_tasks if between else over_tasks)([over_related(members) for members in tasks.values()])
        families = tuple(dict.fromkeys(name for each in found for name in each.families))
        return Finding(tuple(each.datasets[0] for each in found), variant, family, metric, mean, families, baseline)

    def all_findings(self, *, baseline: str = NONE) -> Iterable[Finding]:
        """Give the improvements of every dataset with known truth, variant, family and "mean", and metric.

        Over a form of OAT it gives those by the metrics of `RIVALRY`.
        """
        metrics = tuple(METRICS) if baseline == NONE else RIVALRY
        variants = [name for name in self.results.variants if name not in (NONE, baseline)]
        families = (MEAN, *self.results.families)
        for dataset, variant, family, metric in product(self.with_truth(), variants, families, metrics):
            found = self.finding(dataset, variant, family, metric, baseline=baseline)
            if found is not None:
                yield found

    def comparisons(self) -> Iterable[Finding]:
        """Give the improvements over no augmentation, and over each of `RIVALS`."""
        return chain.from_iterable(self.all_findings(baseline=name) for name in (NONE, *RIVALS))

    def _seeds(self, dataset: str, sides: Sequence[str], families: Sequence[str]) -> tuple[int, ...]:
        """Return the seeds that both sides, variants, have for all of some families."""
        found = [self._cells.get((dataset, side, name), {}) for side in sides for name in families]
        return tuple(sorted(set[int].intersection(*(set(part) for part in found)))) if found else ()

    def _draw(self, dataset: str, variant: str, family: str, seeds: tuple[int, ...], metric: Metric) -> Draws:
        key = (dataset, variant, family, seeds, metric)
        if key not in self._draws:
            cells = [self._cells[dataset, variant, family][seed] for seed in seeds]
            values, replicates = np.stack([c.values for c in cells]), np.stack([c.replicates for c in cells])
            self._draws[key] = draw_scores(values, replicates, cells[0].true, cells[0].true_errors, metric)
        return self._draws[key]


def estimates_of(cells: Sequence[CellResult], before: Sequence[CellResult]) -> tuple[Estimate, ...]:
    """Return the estimates of each policy from the cells of one dataset, variant and estimator, of different seeds.

    `before` are those without augmentation.
    """
    if not cells:
        return ()
    first, values = cells[0], np.stack([cell.values for cell in cells])
    draws = np.mean([cell.replicates for cell in cells], axis=0)
    low, high = bootstrap_interval(draws, n=int(first.record["n_episodes"]))
    deviation = values.std(axis=0, ddof=1) if len(cells) > 1 else np.full(values.shape[1], np.nan)
    then = {cell.seed: cell.values for cell in before}
    changes = [cell.values - then[cell.seed] for cell in cells if cell.seed in then and cell.variant != NONE]
    change = np.mean(changes, axis=0) if changes else np.full(values.shape[1], np.nan)
    columns = (values.mean(axis=0), low, high, deviation, change)
    return tuple(
        Estimate(first.dataset, first.variant, first.family, policy, len(cells), *map(float, numbers))
        for policy, *numbers in zip(first.policies, *columns, strict=True)
    )


def _episodes_of(task: str) -> str:
    """Return the task whose recorded episodes a task's datasets hold: mostly its own."""
    known = TASKS.get(task)
    return task if known is None else known.episodes_of or task
