"""How good estimates are: absolute error, rank correlation, regret, and significance of differences.

The two conventions of errors and regrets, by name:

- "raw": as the paper's equations 10 to 12 are printed, on values in environment units.
- "dope": as the DOPE benchmark computes them: true and estimated values are first scaled so that the worst of the
  task's policies has the true value 0 and the best one 1, and estimates are cut at 2 from above.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol, get_args

import numpy as np
import numpy.typing as npt

from oat_gym.errors import ConfigurationError, InvalidDataError
from oat_gym.ope.intervals import standard_error

FloatArray = npt.NDArray[np.float64]
Convention = Literal["dope", "raw"]
MAX_SCALED = 2.0
"""DOPE cuts scaled estimates at this value."""


def absolute_error(predicted: npt.ArrayLike, true: npt.ArrayLike, *, convention: Convention = "raw") -> FloatArray:
    """Return |V - estimate| of each of P policies, (P,) (paper, equation 10); their mean is the MAE of the tables.

    Raises:
        InvalidDataError: for values that do not match or are not finite (a true value; a NaN estimate gives NaN).

    >>> absolute_error([1.0, 4.0], [2.0, 4.0]).tolist()
    [1.0, 0.0]
    """
    estimates, truth = _scaled(predicted, true, convention)
    return np.abs(truth - estimates)


def rank_correlation(predicted: npt.ArrayLike, true: npt.ArrayLike) -> float:
    """Return Spearman's rank correlation of estimates and true values (paper, equation 12); ties get mean ranks.

    NaN where it is undefined: an estimate is NaN, all estimates (or all true values) are the same, so that they rank
    nothing, or there are fewer than two policies. A NaN is never counted as 0 or 1; `summary` says which it was.

    >>> rank_correlation([1.0, 2.0, 3.0], [10.0, 30.0, 20.0])
    0.5
    >>> rank_correlation([5.0, 5.0, 5.0], [10.0, 30.0, 20.0])
    nan
    """
    from scipy import stats  # noqa: PLC0415  (slow to import, and needed here only)

    estimates, truth = _pair(predicted, true)
    if undefined_ranks(estimates, truth):
        return math.nan
    ranks = stats.rankdata(estimates), stats.rankdata(truth)
    return float(np.corrcoef(*ranks)[0, 1])


def undefined_ranks(predicted: npt.ArrayLike, true: npt.ArrayLike) -> str:
    """Return why a rank correlation is undefined, "" where it is not."""
    estimates, truth = _pair(predicted, true)
    if len(truth) < 2:
        return "fewer than two policies"
    if np.isnan(estimates).any():
        return "an estimate is NaN"
    if (estimates == estimates[0]).all():
        return "all estimates are the same"
    return "all true values are the same" if (truth == truth[0]).all() else ""


def regret_at_k(predicted: npt.ArrayLike, true: npt.ArrayLike, k: int, *, convention: Convention = "dope") -> float:
    """Return (best - expected best among the k policies with the highest estimates) / |best| (paper, equation 11).

    Where estimates are tied, the expectation is over a fair draw among them: an estimator that gives every policy the
    same value has the regret of choosing k policies blindly, not the 0 or 1 that an order of indices would give. In
    the "dope" convention best is 1, and estimates that are cut at 2 are tied. NaN estimates are chosen last.

    The "raw" convention divides by the size of the best value in environment units; NaN where that is 0.

    Raises:
        ConfigurationError: for k outside 1 to P (the paper: "not applicable").

    >>> regret_at_k([1.0, 3.0, 2.0], [0.0, 5.0, 10.0], 1)
    0.5
    >>> regret_at_k([1.0, 1.0, 1.0], [0.0, 5.0, 10.0], 1)
    0.5
    """
    estimates, truth = _scaled(predicted, true, convention)
    if isinstance(k, bool) or not isinstance(k, int | np.integer) or not 1 <= k <= len(truth):
        raise ConfigurationError(f"k must be from 1 to the {len(truth)} policies, got {k!r}.")
    estimates = np.where(np.isnan(estimates), -np.inf, estimates)
    threshold = np.sort(estimates)[-k]
    surely, tied = truth[estimates > threshold], truth[estimates == threshold]
    floor = surely.max() if len(surely) else -np.inf
    best, found = truth.max(), _expected_best(np.maximum(tied, floor), int(k) - len(surely))
    return float((best - found) / abs(best)) if best else math.nan


def _expected_best(values: FloatArray, draws: int) -> float:
    """Return the expected maximum of `draws` of the values, drawn without replacement."""
    ordered, total = np.sort(values), math.comb(len(values), draws)
    chances = [math.comb(position, draws - 1) / total for position in range(len(values))]
    return float(ordered @ np.array(chances))


@dataclass(frozen=True)
class TTest:
    """A test of whether two policies differ in value.

    `difference` is the estimate's less the baseline's, `standard_error` its error, `statistic` their quotient,
    `p_value` two-sided, `degrees` those of Student's distribution.
    """

    difference: float
    standard_error: float
    statistic: float
    p_value: float
    degrees: float


def t_test(
    replicates: npt.ArrayLike,
    baseline: npt.ArrayLike,
    *,
    method: Literal["bootstrap", "paper"] = "bootstrap",
    n: int | None = None,
) -> TTest:
    """Test whether a policy's value differs from a baseline's, from bootstrap replicates of both (paper, table 1).

    Args:
        replicates: (B,) estimates of the policy on B resamples of the data (`Result.replicates`).
        baseline: (B,) those of the expert policy; on the same resamples for "bootstrap".
        method: "paper" is Welch's t-test of the two samples of replicates, as the paper describes it. Its standard
            error falls with the square root of B, a number the user chooses: any difference becomes "significant" with
            enough resamples. "bootstrap", the default, takes the standard deviation of the paired differences as the
            standard error of the difference, which more resamples only make more exact.
        n: number of source episodes, for the n - 1 degrees of freedom of "bootstrap"; None: the normal distribution.

    Raises:
        InvalidDataError: for replicates that do not match or are not finite.

    >>> rng = np.random.default_rng(0)
    >>> noise = rng.normal(size=1000)
    >>> round(t_test(1.0 + noise, noise + rng.normal(size=1000), n=30).p_value, 1)
    0.3
    """
    from scipy import stats  # noqa: PLC0415

    draws, others = _vector(replicates, "replicates"), _vector(baseline, "baseline")
    if method == "paper":
        variances = [part.var(ddof=1) / len(part) for part in (draws, others)]
        error = math.sqrt(sum(variances))
        sizes = (len(draws) - 1, len(others) - 1)
        degrees = error**4 / max(sum(v**2 / m for v, m in zip(variances, sizes, strict=True)), 1e-300)
    elif method == "bootstrap":
        if draws.shape != others.shape:
            raise InvalidDataError(f"Paired replicates need one size, got {draws.shape} and {others.shape}.")
        error, degrees = float(standard_error(draws - others)), math.inf if n is None else float(n - 1)
    else:
        raise ConfigurationError(f"method must be 'bootstrap' or 'paper', got {method!r}.")
    difference = float(draws.mean() - others.mean())
    statistic = difference / error if error else math.copysign(math.inf, difference) if difference else 0.0
    distribution = stats.norm if math.isinf(degrees) else stats.t(degrees)
    return TTest(difference, error, statistic, float(2 * distribution.sf(abs(statistic))), degrees)


def _vector(values: npt.ArrayLike, name: str) -> FloatArray:
    array = np.asarray(values, dtype=np.float64)
    if array.ndim != 1 or len(array) < 2:
        raise InvalidDataError(f"{name} must be a row of at least two numbers, got shape {array.shape}.")
    bad = int((~np.isfinite(array)).sum())
    if bad:
        raise InvalidDataError(
            f"{name} must be finite numbers, and {bad} of {len(array)} are NaN or infinite: on those resamples the "
            "estimator gave no value."
        )
    return array


def _pair(predicted: npt.ArrayLike, true: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
    estimates, truth = np.asarray(predicted, dtype=np.float64), np.asarray(true, dtype=np.float64)
    if estimates.ndim != 1 or estimates.shape != truth.shape or not len(truth):
        raise InvalidDataError(
            f"Estimates and true values must be rows of one length, got {estimates.shape} and {truth.shape}."
        )
    if not np.isfinite(truth).all():
        raise InvalidDataError(f"True values must be finite, got {truth}.")
    return estimates, truth


def _scaled(predicted: npt.ArrayLike, true: npt.ArrayLike, convention: Convention) -> tuple[FloatArray, FloatArray]:
    estimates, truth = _pair(predicted, true)
    if convention not in get_args(Convention):
        raise ConfigurationError(f"convention must be 'dope' or 'raw', got {convention!r}.")
    if convention == "raw":
        return estimates, truth
    low, span = truth.min(), np.ptp(truth)
    if not span:
        raise InvalidDataError(
            "The 'dope' convention scales by the range of the true values, and all are the same. Use 'raw'."
        )
    return np.minimum((estimates - low) / span, MAX_SCALED), (truth - low) / span


class HasRows(Protocol):
    """What `summary` reads: `ope.Result`, or anything with its rows."""

    @property
    def rows(self) -> Sequence[Mapping[str, Any]]:
        """Mappings with policy, estimator, seed and value, and data where it was paired."""
        ...


def summary(
    result: HasRows, truth: Mapping[str, float], *, convention: Convention = "dope"
) -> list[dict[str, str | int | float]]:
    """Return the metrics of each estimator and seed, over the policies.

    Each row has estimator, seed (and data, "real" or "augmented", where the result is paired), `mae` in environment
    units, `mae_dope`, `rank_correlation`, `regret_at_1` and `regret_at_5` in the given convention, and a `note` that
    says why a number is NaN ("" where none is). Regret@5 needs more than five policies.

    Args:
        result: what `ope.evaluate` returned.
        truth: the true value of each policy of the result, by name.
        convention: of the regrets.

    Raises:
        InvalidDataError: if a policy of the result has no true value.
    """
    groups: dict[tuple[Any, ...], dict[str, float]] = {}
    for row in result.rows:
        key = (row["estimator"], row["seed"], row.get("data"))
        groups.setdefault(key, {})[row["policy"]] = float(row["value"])
    rows: list[dict[str, str | int | float]] = []
    for (estimator, seed, data), values in groups.items():
        missing = sorted(set(values) - set(truth))
        if missing:
            raise InvalidDataError(f"No true value is given for {', '.join(missing)}; known: {', '.join(truth)}.")
        head: dict[str, str | int | float] = {"estimator": estimator, "seed": seed}
        rows.append(head | ({} if data is None else {"data": data}) | _metrics(values, truth, convention))
    return rows


def _metrics(values: dict[str, float], truth: Mapping[str, float], convention: Convention) -> dict[str, float | str]:
    estimates = np.array(list(values.values()))
    true = np.array([truth[name] for name in values])
    notes = [f"rank correlation: {reason}" for reason in (undefined_ranks(estimates, true),) if reason]
    scalable = bool(np.ptp(true) > 0)
    if not scalable:
        notes.append("dope: all true values are the same")

    def regret(k: int, *, least: int) -> float:
        if len(true) < least or (convention == "dope" and not scalable):
            return math.nan
        return regret_at_k(estimates, true, k, convention=convention)

    if len(true) <= 5:
        notes.append("regret@5: not more than five policies")
    return {
        "mae": float(absolute_error(estimates, true).mean()),
        "mae_dope": float(absolute_error(estimates, true, convention="dope").mean()) if scalable else math.nan,
        "rank_correlation": rank_correlation(estimates, true),
        "regret_at_1": regret(1, least=1),
        "regret_at_5": regret(5, least=6),
        "note": "; ".join(notes),
    }
