"""The paper's own numbers (tables 1 to 14), to stand beside ours.

`paper.csv` holds tables 2 to 14: a row for each table, level of human involvement, metric, estimator and method; for
each task the mean and the standard deviation over three seeds. "-" is the paper's own sign for an undefined rank
correlation; an empty cell is a number that is not legible in the copy that we read (and, in table 2, a standard
deviation that the paper does not give). Regret@1 of TDA by DICE in table 5 is not legible either; it follows from the
average in table 2.

Table 2 is the average of tables 3 to 6 over the five estimators: errors and regrets agree to the last digit, rank
correlations do not (as OAT on relocate: 0.384 in table 2, 0.492 from table 4); both are kept as printed.
"""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from oat_gym.benchmark.scores import Metric
from oat_gym.errors import ConfigurationError

TASKS = ("pen", "door", "relocate", "hammer")
LEVELS = ("human", "cloned", "expert")
"""Of human involvement, from most to least."""
ESTIMATORS = ("FQE", "MB", "IS", "DR", "DICE")
METHODS = (
    "NoAug.", "OAT", "VAE-MDP", "TimeGAN", "VAE", "SPAWNER", "DGW", "Permutation", "Jittering", "Scaling", "TDA",
)  # fmt: skip
TABLES: dict[tuple[str, Metric], int] = {
    ("human", "mae"): 3,
    ("human", "rank_correlation"): 4,
    ("human", "regret_at_1"): 5,
    ("human", "regret_at_5"): 6,
    ("cloned", "mae"): 7,
    ("cloned", "rank_correlation"): 8,
    ("cloned", "regret_at_1"): 9,
    ("cloned", "regret_at_5"): 10,
    ("expert", "mae"): 11,
    ("expert", "rank_correlation"): 12,
    ("expert", "regret_at_1"): 13,
    ("expert", "regret_at_5"): 14,
}
"""Number of each table of single estimators."""

TABLE_1: dict[str, tuple[tuple[float, float], ...]] = {
    "NoAug.": ((7.24, 0.00), (7.07, 0.00), (-4.48, 0.00)),
    "OAT": ((3.10, 0.00), (1.33, 0.19), (2.11, 0.06)),
    "TDA": ((10.14, 0.00), (5.82, 0.00), (-13.58, 0.00)),
    "VAE": ((-1.94, 0.06), (-1.92, 0.06), (0.54, 0.13)),
    "TimeGAN": ((1.90, 0.06), (-2.25, 0.03), (-2.25, 0.03)),
    "SPAWNER": ((-1.00, 0.32), (-1.00, 0.32), (1.00, 0.32)),
    "DGW": ((-1.43, 0.06), (-1.43, 0.16), (1.43, 0.16)),
    "Permutation": ((-1.78, 0.08), (-1.77, 0.08), (1.77, 0.08)),
    "Jittering": ((-1.89, 0.06), (-1.89, 0.06), (1.90, 0.06)),
    "Scaling": ((-1.33, 0.06), (-1.33, 0.06), (1.33, 0.06)),
    "Empirical result": ((2.01, 0.04), (0.61, 0.54), (0.20, 0.84)),
}
"""Table 1: t and p of three policies against the expert's in tutoring, by importance sampling."""


@dataclass(frozen=True)
class Printed:
    """A number of the paper: its mean and standard deviation; NaN where undefined, not legible or not there."""

    mean: float
    deviation: float = math.nan

    @property
    def known(self) -> bool:
        """Whether there is a number."""
        return math.isfinite(self.mean)


def printed(level: str, metric: Metric, estimator: str, method: str, task: str) -> Printed:
    """Return a number of tables 2 to 14; `estimator` "mean" is the average over the five (table 2, level "human").

    Raises:
        ConfigurationError: for a row or a task that the tables do not have.

    >>> printed("human", "mae", "FQE", "OAT", "door")
    Printed(mean=255.0, deviation=17.0)
    """
    key = (level, metric, estimator, method)
    if key not in _rows() or task not in TASKS:
        raise ConfigurationError(f"The paper's tables have no {key} of {task!r}.")
    return _rows()[key][task]


def average(level: str, metric: Metric, method: str, task: str) -> Printed:
    """Return the mean over the five estimators: of table 2 where it has it, else of the single tables.

    NaN where a number of the five is undefined or not legible.
    """
    if (level, metric, "mean", method) in _rows():
        return printed(level, metric, "mean", method, task)
    return Printed(sum(printed(level, metric, each, method, task).mean for each in ESTIMATORS) / len(ESTIMATORS))


@cache
def _rows() -> dict[tuple[str, str, str, str], dict[str, Printed]]:
    with Path(__file__).with_name("paper.csv").open(newline="", encoding="utf-8") as lines:
        return {
            (row["level"], row["metric"], row["estimator"], row["method"]): {
                task: Printed(_number(row[task]), _number(row[f"{task}_sd"])) for task in TASKS
            }
            for row in csv.DictReader(lines)
        }


def _number(text: str) -> float:
    return math.nan if text in ("", "-") else float(text)
