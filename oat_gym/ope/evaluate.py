"""`evaluate`: many policies, estimators and seeds on one dataset, as one tidy table."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Generator, Sequence
from dataclasses import dataclass, replace
from os import PathLike
from typing import Any, get_args

import numpy as np
import numpy.typing as npt
from minari import MinariDataset

from oat_gym.dataset import find_source
from oat_gym.errors import ConfigurationError, ConformanceError, EstimationWarning
from oat_gym.ope._policy_checks import check_policies
from oat_gym.ope._setup import (
    Behavior,
    BehaviorSource,
    UseAugmented,
    augmented_parts,
    check_behavior,
    check_question,
    check_seeds,
    draw_resamples,
    initial_batch,
)
from oat_gym.ope.estimator import Estimates, Estimator
from oat_gym.ope.intervals import Method, check_confidence, return_bounds
from oat_gym.ope.logged import Logged
from oat_gym.ope.policy import Policies, PolicySet
from oat_gym.ope.problem import Part, Problem
from oat_gym.ope.result import Data, Key, Question, Result, Row, spread
from oat_gym.progress import ProgressCallback, progress_bar
from oat_gym.spaces import Batch

FloatArray = npt.NDArray[np.float64]


def evaluate(
    data: MinariDataset | str | PathLike[str],
    policies: Policies | PolicySet,
    estimators: Sequence[Estimator] | Estimator | None = None,
    *,
    gamma: float,
    horizon: int | None = None,
    seeds: int | Sequence[int] = 3,
    behavior: Behavior = "clone",
    initial_states: Batch | None = None,
    use_augmented: UseAugmented = None,
    paired: bool = False,
    interval: Method = "bootstrap",
    confidence: float = 0.95,
    resamples: int | None = None,
    device: str = "cpu",
    progress: ProgressCallback | bool | None = None,
) -> Result:
    """Estimate the discounted value of every policy from logged episodes.

    Args:
        data: a Minari dataset (an `AugmentedDataset` or a saved one too; it is read, never changed), the id of an
            installed or embedded one, or the path of a D4RL HDF5 file.
        policies: one policy, several, or several by name; see `ope.Policy`.
        estimators: the estimators, one of each family by default.
        gamma: discount, above 0 and at most 1; 1 needs a horizon, or episodes that all terminate.
        horizon: number of steps whose rewards count; None: all, without end.
        seeds: how many seeds (0, 1, ...), or the seeds themselves.
        behavior: the policy that recorded the data: "clone" (fitted to it; or an `ope.BehaviorCloning` with
            settings), "logged" (`infos["log_prob"]`), or a `Policy`.
        initial_states: (M, ...) a batch of observations to start from; the data's own by default.
        use_augmented: what synthetic episodes are used for. None, the default: "training" only (value functions,
            models and DICE's ratios), so that importance weights and initial states are real. "all": everywhere, as in
            the paper. "none". A tuple out of "training", "weights", "initial" and "behavior". Or a mapping from names
            or families of estimators to those.
        paired: evaluate with and without the synthetic episodes, with the same seeds and resamples; the rows then say
            "data", and `Result.differences` has the difference with its interval.
        interval: "bootstrap" (over real source episodes, augmented copies following theirs), "percentile" or "normal";
            see `ope.intervals`.
        confidence: of the intervals.
        resamples: number of bootstrap resamples; None: 1,000, fewer (but at least 200) for more than 50,000 episodes.
        device: torch device of the estimators that train.
        progress: a callback (description, done, total), or whether to draw a bar (None: at a terminal).

    Returns:
        The table, `Result.rows`: policy, estimator, seed, value, standard_error, low, high, diagnostics. The intervals
        of estimators that train hold fixed what was trained, unless they are told otherwise
        (`FQE(ensemble=10, bootstrap=True)`, `ModelBased(bootstrap=True)`); those of importance weights hold a cloned
        behaviour policy fixed, always. The diagnostic `interval_covers_training` is then 0, and `Result.table` marks
        them with a star.

    Raises:
        ConfigurationError: for settings that cannot work, and policies over another action space than the data's;
            before any work.
        InvalidDataError: for data that is not finite, or has no real episode, and for policies that return actions of
            another form, or NaN.

    Warns:
        EstimationWarning: where a value is not to be trusted; the rows' diagnostics hold its text too.

    >>> from oat_gym import domains, ope
    >>> data = domains.load("maze2d-umaze").filter_episodes(lambda episode: episode.id < 20)
    >>> policy = ope.FunctionPolicy(
    ...     lambda state: np.zeros(2), action_space=data.action_space, density=lambda s, a: np.zeros(len(a))
    ... )
    >>> result = ope.evaluate(data, {"own": policy}, ope.ImportanceSampling(), gamma=0.99, behavior=policy, horizon=14)
    >>> returns = [(episode.rewards[:14] * 0.99 ** np.arange(14)).sum() for episode in data]
    >>> bool(np.isclose(result.rows[0]["value"], np.mean(returns)))
    True
    """
    chosen, target, numbers = _estimators(estimators), PolicySet.of(policies), check_seeds(seeds)
    check_confidence(confidence)
    check_behavior(behavior)
    if interval not in get_args(Method):
        raise ConfigurationError(f"interval must be one of {', '.join(get_args(Method))}, got {interval!r}.")
    used = [augmented_parts(use_augmented, estimator, chosen) for estimator in chosen]
    logged = Logged.of(_dataset(data))
    check_question(logged, gamma=gamma, horizon=horizon, paired=paired)
    question = Question(float(gamma), horizon, interval, float(confidence), logged.n_units, paired)
    base = Problem(
        data=logged,
        policies=target,
        gamma=float(gamma),
        horizon=horizon,
        initial=None if initial_states is None else initial_batch(initial_states, logged),
        initial_unit=None,
        behavior=_no_behavior,
        resamples=draw_resamples(logged.n_units, resamples),
        device=device,
    )
    check_policies(target, logged)
    with _reporter(progress) as report:
        factory = _Factory(replace(base, progress=report), behavior)
        return _run_all(factory, list(zip(chosen, used, strict=True)), numbers, question)


def _run_all(
    factory: _Factory, chosen: list[tuple[Estimator, frozenset[Part]]], seeds: tuple[int, ...], question: Question
) -> Result:
    runs = [_Run(estimator, factory.problem(parts), factory.label) for estimator, parts in chosen]
    if question.paired:
        runs += [_Run(estimator, factory.problem(frozenset()), "real") for estimator, _ in chosen]
    for run in runs:
        run.estimator.check(run.problem)
    found = [_rows(run, seeds, question) for run in runs]
    rows = [row for part, _ in found for row in part]
    return Result(question, rows, {key: draws for _, part in found for key, draws in part.items()})


@dataclass(frozen=True)
class _Run:
    estimator: Estimator
    problem: Problem
    data: Data


class _Factory:
    """Makes one problem for each set of parts; estimators of the same parts share it, and with it what they fit."""

    def __init__(self, base: Problem, behavior: Behavior) -> None:
        self.label: Data = "augmented" if base.data.synthetic.any() else "real"
        self._base: Problem = base
        self._behavior: Behavior = behavior
        self._sources: dict[tuple[bool, bool], BehaviorSource] = {}
        self._problems: dict[frozenset[Part], Problem] = {}

    def problem(self, parts: frozenset[Part]) -> Problem:
        if parts not in self._problems:
            self._problems[parts] = self._make(parts)
        return self._problems[parts]

    def _make(self, parts: frozenset[Part]) -> Problem:
        problem = replace(self._base, use_augmented=parts, behavior=self._source(parts))
        if problem.initial is not None:
            return problem
        first = problem.episodes("initial")
        return replace(problem, initial=problem.data.initial_observations(first), initial_unit=problem.data.unit[first])

    def _source(self, parts: frozenset[Part]) -> BehaviorSource:
        base = replace(self._base, use_augmented=parts)
        key = ("behavior" in parts, "weights" in parts)
        if key not in self._sources:
            training, weighted = base.episodes("behavior"), base.episodes("weights")
            self._sources[key] = BehaviorSource(self._behavior, base, training=training, weighted=weighted)
        return self._sources[key]


def _rows(run: _Run, seeds: tuple[int, ...], question: Question) -> tuple[list[Row], dict[Key, FloatArray]]:
    """Run one estimator and return its rows and replicates; its warnings are kept and passed on."""
    source, name = run.problem.behavior, run.estimator.name
    if isinstance(source, BehaviorSource):
        source.asked.clear()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = run.estimator.estimate(run.problem, seeds=seeds)
        _check_shapes(found, run, seeds)
        _warn_of_values(found, run)
        _warn_of_certainty(found, run)
    for warning in caught:
        warnings.warn(warning.message, warning.category, stacklevel=3)
    texts = tuple(str(warning.message) for warning in caught if issubclass(warning.category, EstimationWarning))
    rows: list[Row] = []
    draws: dict[Key, FloatArray] = {}
    for seed, estimates in zip(seeds, found, strict=True):
        extra: dict[str, Any] = {"warnings": texts}
        if isinstance(source, BehaviorSource) and seed in source.asked and seed in source.held_out:
            extra["behavior_held_out_log_likelihood"] = source.held_out[seed]
            extra["interval_covers_training"] = 0.0  # resamples hold the clone fixed
        for p, policy in enumerate(run.problem.policies.names):
            value, replicates = float(estimates.values[p]), estimates.replicates[p]
            error, low, high = spread(value, replicates, question)
            row: Row = {"policy": policy, "estimator": name, "seed": seed}
            row |= {"data": run.data} if question.paired else {}
            row |= {"value": value, "standard_error": error, "low": low, "high": high}
            rows.append(row | {"diagnostics": dict(estimates.diagnostics[p]) | extra})
            draws[policy, name, seed, run.data] = replicates.copy()
    return rows, draws


def _check_shapes(found: tuple[Estimates, ...], run: _Run, seeds: tuple[int, ...]) -> None:
    n_policies, n_resamples = len(run.problem.policies), len(run.problem.resamples)
    for estimates in found:
        got = (estimates.values.shape, estimates.replicates.shape, len(estimates.diagnostics))
        expected = ((n_policies,), (n_policies, n_resamples), n_policies)
        if got != expected:
            raise ConformanceError(
                f"{run.estimator.name} returned values, replicates and diagnostics of shapes {got}, not {expected}."
            )
    if len(found) != len(seeds):
        raise ConformanceError(f"{run.estimator.name} returned {len(found)} estimates for {len(seeds)} seeds.")


def _warn_of_values(found: tuple[Estimates, ...], run: _Run) -> None:
    """Warn of values that are no numbers, or beyond what the recorded rewards allow."""
    problem = run.problem
    rows = problem.data.rows_of(~problem.data.synthetic)
    rewards, horizon = problem.data.steps.rewards[rows], problem.horizon
    if problem.gamma == 1.0 and horizon is None:
        horizon = int(problem.data.lengths.max())
    low, high = return_bounds(float(rewards.min()), float(rewards.max()), gamma=problem.gamma, horizon=horizon)
    values, slack = np.stack([estimates.values for estimates in found]), 1e-6 * max(high - low, 1e-12)
    outside = (values < low - slack) | (values > high + slack)
    findings = (
        (~np.isfinite(values), "not finite", ""),
        (outside, f"beyond what the rewards allow ({low:.4g} to {high:.4g})", " `Result.within` moves them there."),
    )
    for bad, what, advice in findings:
        if bad.any():
            where = tuple(int(index) for index in np.argwhere(bad)[0])
            warnings.warn(
                f"{run.estimator.name}: {int(bad.sum())} of {bad.size} values are {what}, such as {values[where]:.4g} "
                f"for policy {problem.policies.names[where[1]]!r}.{advice}",
                EstimationWarning,
                stacklevel=2,
            )


def _warn_of_certainty(found: tuple[Estimates, ...], run: _Run) -> None:
    """Warn of replicates that are all the same, as if the estimate had no error."""
    for estimates in found:
        spread_of = np.ptp(estimates.replicates, axis=1)
        certain = (spread_of < 1e-12 * np.abs(estimates.values)) & (estimates.values != 0.0)
        if certain.any():
            warnings.warn(
                f"{run.estimator.name}: {int(certain.sum())} of {len(certain)} estimates are the same in every "
                "resample, so that their intervals have no width. Either all episodes are alike, or resamples reach "
                "the initial states only, and not what was fitted: compare with other estimators and seeds.",
                EstimationWarning,
                stacklevel=2,
            )
            return


def _estimators(estimators: Sequence[Estimator] | Estimator | None) -> tuple[Estimator, ...]:
    if estimators is None:
        return default_estimators()
    several = tuple(estimators) if isinstance(estimators, Sequence) else (estimators,)
    wrong = [each for each in several if not isinstance(each, Estimator)]
    if wrong or not several:
        raise ConfigurationError(
            f"estimators must be instances such as ope.ImportanceSampling(), at least one, got {wrong or estimators!r}."
        )
    names = [each.name for each in several]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ConfigurationError(f"Estimators need different names; {', '.join(twice)} is there more than once.")
    return several


def default_estimators() -> tuple[Estimator, ...]:
    """Return one estimator of each of the paper's five families, with their defaults."""
    from oat_gym import ope  # noqa: PLC0415  (the estimators of the package, this module among them)

    return tuple(kind() for kind in ope.ESTIMATORS.values())


def _dataset(data: MinariDataset | str | PathLike[str]) -> MinariDataset:
    if isinstance(data, str | PathLike):
        return find_source(data)
    if not isinstance(data, MinariDataset):
        raise ConfigurationError(
            f"data must be a Minari dataset, its id or a D4RL file's path, got a {type(data).__name__}."
        )
    return data


def _no_behavior(seed: int) -> FloatArray:
    raise ConfigurationError("This problem has no behaviour policy yet.")


@contextlib.contextmanager
def _reporter(progress: ProgressCallback | bool | None) -> Generator[ProgressCallback]:
    if progress is None or isinstance(progress, bool):
        with progress_bar(progress) as report:
            yield report
    else:
        yield progress
