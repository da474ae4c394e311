"""Whether it helps to give synthetic episodes only to the estimators that gained from them on other tasks.

    python tests/benchmarks/diagnose_use.py RESULTS --out FOLDER [--variants oat,oat-paper,jittering,scaling]

Reads the cells of a folder of `oat-gym bench` and computes nothing anew. For every family of estimators a method is
used where it lowered the error on the tasks of `CHOICE`, seeds 0-2, and not used elsewhere; "best" takes, for every
family, the method that lowered it most there. What these choices do is reported on the tasks of `REPORT`, which had no
part in them. Writes `FOLDER/use.csv` and `FOLDER/use.md`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from reread import Row, run, told

from oat_gym.benchmark.analysis import MEAN, Analysis
from oat_gym.benchmark.results import Results, read_results
from oat_gym.benchmark.store import CellResult
from oat_gym.benchmark.variants import NONE

Choice = dict[str, str]
"""Family of estimators -> the variant whose data it is given."""
CHOICE = (
    "adroit-door-human",
    "sepsis-mdp-features",
    "icu-sepsis-features",
    "sepsis-sim",
    "maze2d-umaze",
    "maze2d-umaze-d4rl",
)
REPORT = (
    "adroit-pen-expert",
    "adroit-door-expert",
    "adroit-hammer-expert",
    "adroit-relocate-expert",
    "adroit-pen-cloned-from-expert",
    "adroit-door-cloned-from-expert",
    "adroit-hammer-cloned-from-expert",
    "adroit-relocate-cloned-from-expert",
)
"""Adroit-door-cloned is in neither: half of it are the demonstrations of adroit-door-human."""
CHOICE_SEEDS = (0, 1, 2)
BEST, CHOSEN = "best", "chosen"
CAPTION = (
    "How much of the mean error of five estimators methods take off in percent (95% interval; bold: excludes zero),"
    " used for all of them and for those alone that they helped on other tasks"
)


def gains(results: Results, variants: Sequence[str]) -> dict[str, dict[str, float]]:
    """Return family -> variant -> its improvement of the error (effect, log scale) over the tasks of `CHOICE`."""
    cells = tuple(cell for cell in results.cells if cell.dataset in CHOICE and cell.seed in CHOICE_SEEDS)
    analysis = Analysis(replace(results, cells=cells))
    return {
        family: {
            variant: found.improvement.effect
            for variant in variants
            if (found := analysis.over_all(variant, family, "mae")) is not None
        }
        for family in results.families
    }


def choices(effects: Mapping[str, Mapping[str, float]], variants: Sequence[str]) -> dict[str, Choice]:
    """Return what each method's name stands for: the variant that each family is given."""
    own = {
        variant: {family: variant if found.get(variant, 0.0) > 0 else NONE for family, found in effects.items()}
        for variant in variants
    }
    ranked = {family: max(found.items(), key=lambda pair: pair[1]) for family, found in effects.items()}
    return own | {BEST: {family: name if effect > 0 else NONE for family, (name, effect) in ranked.items()}}


def composed(results: Results, choice: Choice) -> Results:
    """Return the cells without augmentation, and the chosen ones under the name `CHOSEN`."""
    cells = [cell for cell in results.cells if cell.dataset in REPORT]
    taken = (replace(cell, variant=CHOSEN) for cell in cells if choice[cell.family] == cell.variant)
    return replace(results, cells=(*(cell for cell in cells if cell.variant == NONE), *_complete(taken, choice)))


def _complete(cells: Iterator[CellResult], choice: Choice) -> list[CellResult]:
    """Return the cells of those datasets and seeds that all families have: the mean is of five."""
    found = list(cells)
    places = [(cell.dataset, cell.seed) for cell in found if not cell.failed]
    whole = {place for place in places if places.count(place) == len(choice)}
    return [cell for cell in found if (cell.dataset, cell.seed) in whole]


def rows_of(folder: Path, variants: Sequence[str]) -> list[Row]:
    """Return a row for each method and one for "best"."""
    (results,) = read_results(folder)
    everywhere = Analysis(results)
    rows: list[Row] = []
    for name, choice in choices(gains(results, variants), variants).items():
        chosen = Analysis(composed(results, choice))
        used = (f"{family} {variant}" if name == BEST else family for family, variant in choice.items())
        taken = [text for text, variant in zip(used, choice.values(), strict=True) if variant != NONE]
        always = None if name == BEST else everywhere.over_all(name, MEAN, "mae", datasets=REPORT)
        found = chosen.over_all(CHOSEN, MEAN, "mae")
        rows.append(
            {
                "method": name,
                "used for": ", ".join(taken) or "none",
                "everywhere": told(always),
                "as chosen": told(found),
                "another task": told(chosen.over_all(CHOSEN, MEAN, "mae", between=True)),
                "rank correlation": told(chosen.over_all(CHOSEN, MEAN, "rank_correlation"), digits=2),
                "datasets": "0" if found is None else str(len(found.datasets)),
            }
        )
    return rows


if __name__ == "__main__":
    run(rows_of, name="use", caption=CAPTION, description=__doc__, variants="oat-paper,oat,oat-prior,jittering,scaling")
