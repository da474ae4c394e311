"""Write the two tables that are read first anew from the published numbers; nothing is computed.

    python tests/benchmarks/tell.py --in tests/benchmarks/results/benchmark

In FOLDER/README.md: the improvement of the mean error on every dataset, and which other variants help and hurt. In
FOLDER/default.md: percent less error of the default form of OAT than of its former form, the paper's and none; its
table of ranks is of cells that are not published.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import replace
from pathlib import Path

from publish import Numbers, Published
from reread import told

from oat_gym.benchmark.analysis import MEAN, Finding
from oat_gym.benchmark.protocol import SUITES
from oat_gym.benchmark.variants import NONE
from oat_gym.cache import write_atomically

COLUMNS = ("oat-paper", "oat-prior", "oat", "jittering", "scaling")
"""The variants of the README's table that have a column of their own."""
FAMILIES = (MEAN, "FQE", "MB", "IS", "DR", "DICE")
FORMS = ("oat", "oat-prior", "oat-paper")
COMPARISONS = (
    ("the default over the former one", "oat-prior", "oat", True),
    ("the default over the paper's form", "oat-paper", "oat", True),
    ("the default over none", "oat", NONE, False),
    ("the former default over none", "oat-prior", NONE, False),
    ("the paper's form over none", "oat-paper", NONE, False),
)
"""Words, variant, baseline, and whether the words name the baseline first: what is published is over `oat`."""


def by_dataset(published: Published) -> str:
    """Return the README's table: a row for each dataset whose true values are known."""
    ends = ("others that help", "others that hurt")
    lines = [f"| dataset | {' | '.join((*COLUMNS, *ends))} |", "|---" * (1 + len(COLUMNS) + len(ends)) + "|"]
    for dataset in published.with_truth():
        found = {name: published.finding(dataset, name, MEAN, "mae") for name in published.results.variants}
        verdicts = {name: each.improvement.verdict for name, each in found.items() if each is not None}
        others = [
            ", ".join(name for name, verdict in verdicts.items() if verdict == word and name not in COLUMNS) or "-"
            for word in ("helps", "hurts")
        ]
        cells = [told(found.get(name)) for name in COLUMNS]
        lines.append(f"| {' | '.join((dataset, *cells, *others))} |")
    return "\n".join(lines)


def of_the_default(published: Published) -> str:
    """Return the table of errors of `default.md`."""
    every = [name for name in published.with_truth() if all(_measured(published, name, form) for form in FORMS)]
    expert = [name for name in SUITES["adroit-expert"].datasets if name in every]
    cloned = [name for name in SUITES["adroit-cloned"].datasets if name in every]
    chosen = [*expert, *cloned, "maze2d-umaze-d4rl"]
    rest = ["icu-sepsis-features", "sepsis-mdp-features", "maze2d-umaze"]
    groups = (
        (f"door-human left out: 4 tasks and maze2d-umaze-d4rl, {len(chosen)} datasets", chosen, False),
        ("another such task: the interval of how much these 5 differ", chosen, True),
        (f"of these, Adroit expert, {len(expert)}", expert, False),
        (f"of these, Adroit cloned, {len(cloned)}", cloned, False),
        ("ICU-Sepsis, MDP, maze2d-umaze, 3", rest, False),
        (f"all that have the three forms, {len(every)}", every, False),
    )
    lines = ["| datasets | | mean of five | FQE | MB | IS | DR | DICE |", "|---|---|---|---|---|---|---|---|"]
    for label, datasets, between in groups:
        for words, variant, baseline, backwards in COMPARISONS:
            found = [
                published.over_all(variant, name, "mae", baseline=baseline, datasets=datasets, between=between)
                for name in FAMILIES
            ]
            cells = [told(turned(each) if backwards else each) for each in found]
            lines.append(f"| {label} | {words} | {' | '.join(cells)} |")
    return "\n".join(lines)


def _measured(published: Published, dataset: str, form: str) -> bool:
    return published.finding(dataset, form, MEAN, "mae") is not None


def turned(found: Finding | None) -> Finding | None:
    """Return the improvement of the baseline over the variant, in percent of the variant's error."""
    if found is None:
        return None
    change = found.improvement
    value, high, low = (-100 * math.expm1(-math.log1p(-each / 100)) for each in (change.value, change.low, change.high))
    return replace(found, improvement=replace(change, value=value, low=low, high=high))


def replaced(text: str, table: str) -> str:
    """Return the text with the first table that has the same heading replaced."""
    head = table.partition("\n")[0]
    before, found, after = text.partition(f"{head}\n")
    if not found:
        raise SystemExit(f"There is no table {head!r}.")
    _, gap, rest = after.partition("\n\n")
    return f"{before}{table}{gap}{rest}"


def main() -> None:
    """Read the command line and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--in", dest="folder", type=Path, required=True)
    folder = parser.parse_args().folder
    published = Published(Numbers.read(folder))
    for name, table in (("README.md", by_dataset(published)), ("default.md", of_the_default(published))):
        path = folder / name
        write_atomically(path, replaced(path.read_text(), table).encode())


if __name__ == "__main__":
    main()
