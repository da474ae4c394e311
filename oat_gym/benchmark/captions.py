"""What captions must say: seeds, setting, budget, what is missing, stand-ins for the paper's data."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from oat_gym.benchmark.analysis import Analysis
from oat_gym.benchmark.results import Results

USES = (
    "oat and its forms use synthetic episodes for training alone, the paper's methods for every estimator: IS with "
    "the former sees the recorded episodes alone."
)
"""What must be known where means over the estimators are compared."""


def notes(analysis: Analysis, datasets: Mapping[str, str | None], *, signs: bool = True) -> str:
    """Return what a caption must say: seeds, setting, budget, gaps, stand-ins, and what means and `SIGNS` are."""
    there = [name for name in datasets.values() if name is not None]
    told, fewer = seed_numbers(analysis, there)
    text = f"{told}{', mean ± standard deviation' if signs else ''}; "
    text += "rows of other seeds are compared by the seeds that they share; " if signs and fewer else ""
    text += f"{analysis.results.setting.describe()}; {'; '.join(budget_lines(analysis.results))}."
    text += " + or - : better or worse than no augmentation, 95% interval excludes zero." if signs else ""
    absent, stand_ins = [task for task, name in datasets.items() if name is None], stand_ins_of(there)
    text += f" Not measured here: {', '.join(absent)}." if absent else ""
    return text + (f" Stand-ins, not the paper's data: {', '.join(stand_ins)}." if stand_ins else "")


def seed_numbers(analysis: Analysis, datasets: Sequence[str]) -> tuple[str, bool]:
    """Return how many seeds there are and which variants have fewer, in words, and whether any has."""
    seeds = fewest_seeds(analysis, datasets)
    most = max(seeds.values(), default=0)
    fewer = ", ".join(f"{count} for {name}" for name, count in seeds.items() if count < most)
    return f"{most} seeds{f' ({fewer})' if fewer else ''}", bool(fewer)


def fewest_seeds(analysis: Analysis, datasets: Sequence[str]) -> dict[str, int]:
    """Return the number of seeds of each variant, on that of its datasets where it has the fewest."""
    counts: dict[str, dict[str, set[int]]] = {}
    for cell in analysis.results.cells:
        if cell.dataset in datasets and not cell.failed:
            counts.setdefault(cell.variant, {}).setdefault(cell.dataset, set()).add(cell.seed)
    return {name: min(map(len, found.values())) for name, found in counts.items()}


def budget_lines(results: Results) -> list[str]:
    """Return what the budgets of the runs that gave the cells were."""
    there = {cell.record["fingerprint"] for cell in results.cells}
    made = [manifest for manifest in results.manifests if there & set(manifest["cells"].values())]
    return sorted({manifest["budget_line"] for manifest in made})


def stand_ins_of(datasets: Sequence[str]) -> list[str]:
    """Return the datasets that stand in for the paper's: cloned from an expert's roll-outs, not from people's."""
    return [name for name in datasets if name.endswith("-from-expert")]
