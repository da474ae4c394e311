"""What moves estimates beside augmentation: gradient steps, noise of a known size, initial states and horizon.

    python tests/benchmarks/diagnose_training.py run --out FOLDER [--dataset adroit-door-human] [--seeds 3] [--only ...]
    python tests/benchmarks/diagnose_training.py tables --out FOLDER --to FOLDER

Every row of the table is one change to the standard budget's evaluation of the recorded episodes alone:

- `updates x0.1`, `x0.3`, `x3`, `x10`: fewer or more gradient steps, batches of the same size. With equal updates a
  dataset made ten times as large is seen a tenth as often, as the recorded one is with `x0.1`. With equal epochs it is
  given ten times the steps, as in `oat updates x10` and `oat-paper updates x10`, beside `updates x10` alone.
- `copies`: nine exact copies of every episode, used as synthetic ones are: what is left of an augmentation without its
  content. `jitter S`: the same with noise of S standard deviations, for training only: regularisation without
  information.
- `data starts`: values from the logged first states, not from the environment's; `endless`: no horizon.

Cells are files of FOLDER, a run goes on where it was stopped, and every change has the same seeds.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from oat_gym import domains
from oat_gym.augmenters import Jittering
from oat_gym.benchmark.analysis import Analysis
from oat_gym.benchmark.budget import BUDGETS, Budget
from oat_gym.benchmark.grid import Table, write_tables
from oat_gym.benchmark.plan import Plan, make_plan, write_manifest
from oat_gym.benchmark.protocol import Catalog, Question, Suite
from oat_gym.benchmark.results import Results, read_results
from oat_gym.benchmark.runner import run
from oat_gym.benchmark.scores import METRICS
from oat_gym.benchmark.variants import NONE, VARIANTS, Variant

JITTERS = (0.03, 0.1, 0.3)
SCALES = (0.1, 0.3, 3.0)
QUESTION = Question()


@dataclass(frozen=True)
class Change:
    """One row: the evaluation of a variant under a changed budget, question or task, in a folder of its own."""

    name: str
    variants: tuple[Variant, ...] = (VARIANTS[NONE],)
    updates: float = 1.0
    question: Question = QUESTION
    endless: bool = False

    def budget(self, base: Budget) -> Budget:
        """Return the budget with so many times the gradient steps."""
        if self.updates == 1.0:
            return base
        kept = [pair for pair in base.estimators if pair[0] != "is"]  # it takes no steps
        return replace(base, estimators=tuple((key, scaled(each, self.updates)) for key, each in kept))

    def catalog(self, base: Catalog) -> Catalog:
        """Return the catalogue, tasks without a horizon where that is the change."""
        if not self.endless:
            return base
        tasks: Mapping[str, domains.Task] = {name: replace(task, horizon=None) for name, task in base.tasks.items()}
        return replace(base, tasks=tasks)


def scaled(estimator: Any, factor: float) -> Any:
    """Return an estimator with so many times the gradient steps."""
    if hasattr(estimator, "q"):
        return replace(estimator, q=scaled(estimator.q, factor))
    return replace(estimator, updates=max(1, round(factor * estimator.updates)))


def _noise(name: str, sigma: float) -> Variant:
    return Variant(name, Jittering(sigma=sigma), use_augmented=None, note=f"noise of {sigma} standard deviations")


_AUGMENTED = (VARIANTS["oat"], VARIANTS["oat-paper"])
CHANGES = (
    Change(
        NONE,
        (VARIANTS[NONE], _noise("copies", 0.0), *(_noise(f"jitter {size}", size) for size in JITTERS), *_AUGMENTED),
    ),
    *(Change(f"updates x{scale:g}", updates=scale) for scale in SCALES),
    Change("updates x10", (VARIANTS[NONE], *_AUGMENTED), updates=10.0),
    Change("data starts", question=Question(initial="data")),
    Change("endless", endless=True),
)


def plan_of(change: Change, dataset: str, seeds: int, budget: Budget, catalog: Catalog) -> Plan:
    """Return the plan of a change."""
    suite = Suite(f"diagnosis: {change.name}", (dataset,), "what moves estimates beside augmentation")
    return make_plan(
        suite,
        change.variants,
        seeds=range(seeds),
        question=change.question,
        budget=change.budget(budget),
        catalog=change.catalog(catalog),
    )


def run_all(out: Path, dataset: str, seeds: int, budget: Budget, catalog: Catalog, *, only: list[str]) -> None:
    """Compute what is missing of some changes."""
    for change in CHANGES:
        if change.name not in only:
            continue
        plan, folder = plan_of(change, dataset, seeds, budget, catalog), out / _slug(change.name)
        if plan.missing:
            raise SystemExit("\n".join(plan.missing.values()))
        write_manifest(folder, plan, seeds=range(seeds), device="cpu", command=" ".join(sys.argv))
        reports = run(plan, folder, catalog=change.catalog(catalog))
        print(f"{change.name}: {len(reports)} jobs, {sum(each.cpu_seconds for each in reports):.0f} CPU s", flush=True)


def tables(out: Path, to: Path) -> None:
    """Write `diagnosis-training` (all metrics, each change beside the unchanged evaluation) as CSV and markdown."""
    found: list[tuple[str, Analysis]] = []
    for change in CHANGES:
        folder = out / _slug(change.name)
        if folder.exists():
            found += [(change.name, Analysis(results)) for results in read_results(folder)]
    if not found or found[0][0] != NONE:
        raise SystemExit(f"{out} holds no results of the unchanged evaluation: use `run` first.")
    rows = [row for name, analysis in found for row in _rows(name, analysis)]
    results = found[0][1].results
    header = ("dataset", "estimator", "change", *METRICS.values(), "bias", "seeds")
    order = {family: place for place, family in enumerate(results.families)}
    rows.sort(key=lambda row: (row[0], order[row[1]]))  # stable: changes stay in their order
    write_tables([Table("diagnosis-training", _caption(results), header, tuple(rows))], to)
    print((to / "diagnosis-training.md").read_text())


def _rows(change: str, analysis: Analysis) -> list[tuple[str, ...]]:
    rows: list[tuple[str, ...]] = []
    for dataset in analysis.with_truth():
        for variant in analysis.results.variants:
            for family in analysis.results.families:
                cells = analysis.cells(dataset, variant, family)
                if not cells:
                    continue
                numbers = [_told(analysis.scores(dataset, variant, family, metric)) for metric in METRICS]
                bias = np.array([float((cell.values - cell.true).mean()) for cell in cells])
                name = " ".join(part for part in (variant, change) if part != NONE) or NONE
                rows.append((dataset, family, name, *numbers, _told(bias), str(len(cells))))
    return rows


def _told(values: np.ndarray) -> str:
    known = values[np.isfinite(values)]
    if not len(known):
        return "-"
    digits = 0 if abs(float(known.mean())) >= 20 else 2
    spread = f" ± {known.std(ddof=1):.{digits}f}" if len(known) > 1 else ""
    return f"{known.mean():.{digits}f}{spread}"


def _caption(results: Results) -> str:
    cells = [cell for cell in results.cells if not cell.failed]
    here = cells[0].record["environment"]
    versions = ", ".join(f"{name} {here[name]}" for name in ("python", "numpy", "torch"))
    commits = ", ".join(sorted({cell.record["environment"]["commit"] for cell in cells}))
    cost = math.fsum(cell.record["cost"]["cpu_seconds"] for cell in cells)
    return (
        f"What moves estimates beside augmentation: mean ± standard deviation over seeds "
        f"{sorted({cell.seed for cell in cells})}. {results.manifests[-1]['budget_line']}. "
        f"{cost:.0f} CPU s for the rows of the usual steps; commit {commits}; {versions}; {here['device']}."
    )


def _slug(name: str) -> str:
    return name.replace(" ", "-")


def main(arguments: list[str] | None = None) -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    running, telling = commands.add_parser("run"), commands.add_parser("tables")
    for each in (running, telling):
        each.add_argument("--out", type=Path, required=True, help="folder of the cells")
    running.add_argument("--dataset", default="adroit-door-human", choices=tuple(domains.DATASETS))
    running.add_argument("--seeds", type=int, default=3)
    running.add_argument("--budget", default="standard", choices=tuple(BUDGETS))
    running.add_argument("--estimators", default="all", help="all, or some of fqe,is,dice,dr,mb")
    names = [change.name for change in CHANGES]
    running.add_argument("--only", nargs="+", default=names, choices=names, help="some of the changes")
    telling.add_argument("--to", type=Path, required=True, help="folder of the tables")
    options = parser.parse_args(arguments)
    if options.command == "run":
        budget = BUDGETS[options.budget].choose(options.estimators)
        run_all(options.out, options.dataset, options.seeds, budget, Catalog.installed(), only=options.only)
    else:
        tables(options.out, options.to)


if __name__ == "__main__":
    main()
