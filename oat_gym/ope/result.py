"""What an evaluation found: a tidy table of estimates, their replicates, and what is derived from them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, cast

import numpy as np
import numpy.typing as npt

from oat_gym.errors import ConfigurationError
from oat_gym.ope import metrics
from oat_gym.ope.intervals import Method, bootstrap_interval, standard_error

FloatArray = npt.NDArray[np.float64]
Row = dict[str, Any]
Data = Literal["real", "augmented"]
Key = tuple[str, str, int, Data]
"""Policy, estimator, seed, data."""
PARTIAL = (
    "Resamples do not reach what was fitted: this interval leaves out the error of training on another sample.",
    "Closed forms and ensembles have intervals with it: FQE(ensemble=10, bootstrap=True), ModelBased(bootstrap=True).",
    "So has importance sampling with a known behaviour policy (behavior=) in place of a clone.",
)
"""What is said of rows whose intervals do not cover training."""
_COLUMNS = ("policy", "estimator", "seed", "data", "value", "difference", "standard_error", "low", "high")


@dataclass(frozen=True)
class Question:
    """What was asked: discount, horizon, kind and level of the intervals, number of real episodes, paired or not."""

    gamma: float
    horizon: int | None
    interval: Method
    confidence: float
    n_units: int
    paired: bool


@dataclass(frozen=True)
class Result:
    """What `ope.evaluate` returns.

    Attributes:
        question: what was asked.
        rows: a dict for each policy, estimator and seed (and "data", "real" or "augmented", of a paired evaluation):
            policy, estimator, seed, value (environment units, discounted), standard_error, low, high, diagnostics. The
            diagnostics are numbers by name, and "warnings", a tuple of the `EstimationWarning`s of that estimator.
            `interval_covers_training` is 0 where resamples hold fixed what was fitted: action values, models, ratios,
            or a clone of the behaviour policy that importance weights are divided by.
        draws: the bootstrap replicates (B,) of each row, by (policy, estimator, seed, data). All rows share their
            resamples, so that replicates of two rows can be subtracted.
    """

    question: Question
    rows: list[Row]
    draws: Mapping[Key, FloatArray]

    def replicates(self, policy: str, estimator: str, seed: int, *, data: Data | None = None) -> FloatArray:
        """Return the (B,) bootstrap replicates of one row; `data` may be left out where it is not paired.

        Raises:
            ConfigurationError: for a row that is not there.
        """
        key: Key = (policy, estimator, seed, data or ("augmented" if self.question.paired else self._data))
        if key not in self.draws:
            names = sorted({(p, e) for p, e, _, _ in self.draws})
            raise ConfigurationError(f"There is no row {key!r}; policies and estimators are {names}.")
        return self.draws[key].copy()

    @property
    def _data(self) -> Data:
        return next(iter(self.draws))[3]

    @property
    def differences(self) -> list[Row]:
        """What augmentation changed, of a paired evaluation: a row for each policy, estimator and seed.

        `difference` is the estimate with the augmented data less the one without; its standard error and interval are
        of the differences between replicates on the same resamples. `covers_training` is False where the replicates of
        either hold fixed what was fitted: the interval then leaves out that two fits differ, and chance differences
        between fits lie outside it.

        Raises:
            ConfigurationError: for a result that is not paired.
        """
        if not self.question.paired:
            raise ConfigurationError("Only a paired evaluation has differences: ope.evaluate(..., paired=True).")
        values = {self._key(row): float(row["value"]) for row in self.rows}
        covers = {self._key(row): _covers(row) for row in self.rows}
        rows: list[Row] = []
        for policy, estimator, seed, data in values:
            if data == "real":
                continue
            both: list[Key] = [(policy, estimator, seed, "augmented"), (policy, estimator, seed, "real")]
            change = values[both[0]] - values[both[1]]
            error, low, high = self._spread(change, self.draws[both[0]] - self.draws[both[1]])
            head: Row = {"policy": policy, "estimator": estimator, "seed": seed}
            tail: Row = {"low": low, "high": high, "covers_training": all(covers[key] for key in both)}
            rows.append(head | {"difference": change, "standard_error": error} | tail)
        return rows

    def within(self, low: float, high: float) -> Result:
        """Return the result with each estimate moved to the nearest value in [low, high], what policies can earn.

        An estimate of a value in the range comes no further from it by that, whatever the estimator, and one that
        diverged no longer hides what others say. The range has to hold for every policy: what an episode pays where it
        pays once, or `ope.intervals.return_bounds` of the least and the greatest reward. Recorded returns are no such
        range.

        Replicates are moved too, for `differences` and `over_seeds`; intervals are cut to the range, and standard
        errors stay as they were. Near an end the estimators that were unbiased are so no longer. The diagnostic
        `outside_range` says by how much an estimate lay outside: a large one is a reason to distrust what is left.

        Raises:
            ConfigurationError: unless low < high are finite numbers.
        """
        check_range(low, high)
        rows: list[Row] = []
        for row in self.rows:
            moved = {name: float(np.clip(row[name], low, high)) for name in ("value", "low", "high")}
            outside = {"outside_range": float(row["value"]) - moved["value"]}
            rows.append(row | moved | {"diagnostics": row["diagnostics"] | outside})
        return Result(self.question, rows, {key: draws.clip(low, high) for key, draws in self.draws.items()})

    def over_seeds(self) -> list[Row]:
        """Return the average over the seeds: a row for each policy and estimator (and data, where paired).

        Replicates are averaged over the seeds too, which gives the error from the data; `seed_spread` is the standard
        deviation of the values over the S seeds, and spread / sqrt(S) the error from training. `standard_error` is the
        root of the sum of their squares, and the interval is widened alike (Student's t of S - 1 degrees of freedom).
        `covers_training` is False where the replicates hold fixed what was fitted (`interval_covers_training` of the
        diagnostics): the interval then has the randomness of training (with two seeds or more), but not what a fit to
        another sample would give.
        """
        groups: dict[tuple[str, str, str], list[Row]] = {}
        for row in self.rows:
            groups.setdefault((row["policy"], row["estimator"], row.get("data", "")), []).append(row)
        return [self._average(members) for members in groups.values()]

    def _average(self, members: list[Row]) -> Row:
        values = np.array([row["value"] for row in members], dtype=np.float64)
        value, n = float(values.mean()), len(values)
        error, low, high = self._spread(value, np.mean([self.draws[self._key(row)] for row in members], axis=0))
        spread = float(values.std(ddof=1)) if n > 1 else 0.0
        seed_error = spread / math.sqrt(n)
        if seed_error:
            from scipy import stats  # noqa: PLC0415  (slow to import, and needed here only)

            margin = seed_error * float(stats.t.ppf(0.5 + self.question.confidence / 2, n - 1))
            low = value - math.hypot(max(value - low, 0.0), margin)
            high = value + math.hypot(max(high - value, 0.0), margin)
        head = {key: members[0][key] for key in ("policy", "estimator", "data") if key in members[0]}
        tail = {"standard_error": math.hypot(error, seed_error), "low": low, "high": high}
        covers = {"covers_training": all(_covers(row) for row in members)}
        return head | {"seeds": n, "value": value, "seed_spread": spread} | tail | covers

    def compare(self, truth: Any, *, convention: metrics.Convention = "dope") -> list[Row]:
        """Return MAE, rank correlation and regrets of each estimator and seed (`ope.metrics.summary`).

        Args:
            truth: true values by policy, or an object with such `values` (`oat_gym.domains.truth`).
            convention: of the regrets.

        Raises:
            ConfigurationError: where the truth is of another discount or horizon.
            InvalidDataError: where a policy has no true value.
        """
        values = truth if isinstance(truth, Mapping) else getattr(truth, "values", None)
        if not isinstance(values, Mapping):
            raise ConfigurationError(f"truth must map policies to true values, or have such values, got {truth!r}.")
        for name in ("gamma", "horizon"):
            asked, known_for = getattr(self.question, name), getattr(truth, name, getattr(self.question, name))
            if asked != known_for:
                raise ConfigurationError(f"The truth is of {name}={known_for}, the estimates of {name}={asked}.")
        known = {str(name): float(cast(float, value)) for name, value in cast("Mapping[Any, Any]", values).items()}
        return metrics.summary(self, known, convention=convention)

    def t_test(self, baseline: str, *, method: Literal["bootstrap", "paper"] = "bootstrap") -> list[Row]:
        """Test every policy against the policy `baseline`, for each estimator and seed (`ope.metrics.t_test`).

        `covers_training` is False where the replicates of either policy hold the fit fixed. Two policies then differ by
        chance of training too, which the standard error leaves out, and `p_value` is NaN, whatever the method: use
        FQE(ensemble=10, bootstrap=True), a known behaviour policy, or compare the values over several seeds
        (`over_seeds`).

        Raises:
            ConfigurationError: for an unknown policy.
            InvalidDataError: where replicates are not finite.
        """
        names = {key[0] for key in self.draws}
        if baseline not in names:
            raise ConfigurationError(f"baseline must be one of the policies {', '.join(sorted(names))}: {baseline!r}.")
        covers = {self._key(row): _covers(row) for row in self.rows}
        rows: list[Row] = []
        for row in self.rows:
            if row["policy"] == baseline:
                continue
            policy, estimator, seed, data = self._key(row)
            other = self.draws[baseline, estimator, seed, data]
            test = metrics.t_test(
                self.draws[policy, estimator, seed, data], other, method=method, n=self.question.n_units
            )
            head = {key: row[key] for key in ("policy", "estimator", "seed", "data") if key in row}
            covered = covers[self._key(row)] and covers[baseline, estimator, seed, data]
            found = vars(test) | ({} if covered else {"p_value": math.nan})
            rows.append(head | {"baseline": baseline} | found | {"covers_training": covered})
        return rows

    def table(self) -> str:
        """Return the rows as text, one a line; a star marks intervals that leave out the error of training."""
        names = [name for name in _COLUMNS if any(name in row for row in self.rows)]
        cells = [names, *([_cell(row.get(name)) for name in names] for row in self.rows)]
        partial = [not _covers(row) for row in self.rows]
        for line, marked in zip(cells[1:], partial, strict=True):
            line[-1] += "*" * marked
        widths = [max(len(line[column]) for line in cells) for column in range(len(names))]
        lines = ["  ".join(c.ljust(w) for c, w in zip(line, widths, strict=True)).rstrip() for line in cells]
        return "\n".join([*lines, *(["* " + "\n  ".join(PARTIAL)] if any(partial) else [])])

    def to_frame(self) -> Any:
        """Return the rows as a `pandas.DataFrame`, a column for each diagnostic ("diagnostics.NAME").

        Raises:
            ImportError: if pandas is not installed; `result.rows` needs nothing.
        """
        try:
            import pandas as pd  # noqa: PLC0415  # pyright: ignore[reportMissingImports]
        except ImportError as error:
            raise ImportError("to_frame needs pandas: pip install pandas. result.rows holds the same.") from error
        flat = [
            {key: value for key, value in row.items() if key != "diagnostics"}
            | {f"diagnostics.{name}": value for name, value in row["diagnostics"].items()}
            for row in self.rows
        ]
        return pd.DataFrame(flat)

    def __str__(self) -> str:
        return self.table()

    def _key(self, row: Row) -> Key:
        return row["policy"], row["estimator"], row["seed"], row.get("data", self._data)

    def _spread(self, value: float, draws: FloatArray) -> tuple[float, float, float]:
        return spread(value, draws, self.question)


def check_range(low: float, high: float) -> None:
    """Raise unless low < high are finite numbers (`Result.within`)."""
    if not -math.inf < low < high < math.inf:
        raise ConfigurationError(f"within needs two finite numbers, low < high, got {low!r} and {high!r}.")


def spread(value: float, draws: FloatArray, question: Question) -> tuple[float, float, float]:
    """Return standard error, low and high of an estimate from its replicates (B,)."""
    low, high = bootstrap_interval(
        draws, n=question.n_units, confidence=question.confidence, method=question.interval, values=value
    )
    return float(standard_error(draws)), float(low), float(high)


def _covers(row: Row) -> bool:
    """Return whether resamples reach all that a row's estimate depends on, as far as the estimator says."""
    return bool(row["diagnostics"].get("interval_covers_training", 1.0))


def _cell(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
