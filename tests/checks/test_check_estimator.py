"""check_estimator passes sound estimators, and names the rule that each broken one breaks."""

import warnings
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np
import pytest

from oat_gym.checks import ChecksFailed, check_estimator
from oat_gym.checks.estimator import ESTIMATOR_CHECKS
from oat_gym.errors import ConfigurationError, EstimationWarning
from oat_gym.ope import Estimates, Estimator, ImportanceSampling, Problem

FORMS = [
    ImportanceSampling(),
    ImportanceSampling(weighted=False),
    ImportanceSampling(kind="trajectory"),
    ImportanceSampling(kind="trajectory", weighted=False),
]


@pytest.mark.parametrize("form", FORMS, ids=lambda form: form.name)
def test_sound_estimators_pass(form: ImportanceSampling) -> None:
    report = check_estimator(form)
    assert [name for name, _ in report.passed] == [check.name for check in ESTIMATOR_CHECKS]


@dataclass(frozen=True)
class Sound(Estimator):
    """Importance sampling behind a place to break."""

    family: ClassVar[str] = "IS"

    @property
    def name(self) -> str:
        return "broken"

    def estimate(self, problem: Problem, *, seeds: tuple[int, ...]) -> tuple[Estimates, ...]:
        return ImportanceSampling().estimate(problem, seeds=seeds)


def changed(found: tuple[Estimates, ...], **functions: Any) -> tuple[Estimates, ...]:
    return tuple(
        replace(each, **{name: function(getattr(each, name)) for name, function in functions.items()}) for each in found
    )


@dataclass(frozen=True)
class Unseeded(Sound):
    def estimate(self, problem: Problem, *, seeds: tuple[int, ...]) -> tuple[Estimates, ...]:
        noise = np.random.default_rng().normal()
        return changed(super().estimate(problem, seeds=seeds), values=lambda v: v + 1e-9 * noise)


@dataclass(frozen=True)
class SharedStream(Sound):
    """One generator for all seeds: the second seed depends on the first."""

    def estimate(self, problem: Problem, *, seeds: tuple[int, ...]) -> tuple[Estimates, ...]:
        rng = np.random.default_rng(seeds[0])
        found = super().estimate(problem, seeds=seeds)
        return tuple(replace(each, values=each.values + 0.02 * rng.normal()) for each in found)


@dataclass(frozen=True)
class ByPosition(Sound):
    def estimate(self, problem: Problem, *, seeds: tuple[int, ...]) -> tuple[Estimates, ...]:
        return changed(super().estimate(problem, seeds=seeds), values=lambda v: v + 0.02 * np.arange(len(v)))


@dataclass(frozen=True)
class Writes(Sound):
    def estimate(self, problem: Problem, *, seeds: tuple[int, ...]) -> tuple[Estimates, ...]:
        found = super().estimate(problem, seeds=seeds)
        problem.resamples[0] = 0.0
        return found


@dataclass(frozen=True)
class GlobalState(Sound):
    def estimate(self, problem: Problem, *, seeds: tuple[int, ...]) -> tuple[Estimates, ...]:
        np.random.rand()  # noqa: NPY002
        return super().estimate(problem, seeds=seeds)


@dataclass(frozen=True)
class Biased(Sound):
    """Adds half of the value again, as an infinite horizon does to a finite one."""

    def estimate(self, problem: Problem, *, seeds: tuple[int, ...]) -> tuple[Estimates, ...]:
        return changed(super().estimate(problem, seeds=seeds), values=lambda v: 1.5 * v, replicates=lambda r: 1.5 * r)


@dataclass(frozen=True)
class Bootstraps(Sound):
    """Takes an end for the state that is recorded after it, whatever ended the episode."""

    def estimate(self, problem: Problem, *, seeds: tuple[int, ...]) -> tuple[Estimates, ...]:
        steps = problem.data.steps
        loops = problem.horizon is None and bool((steps.terminated & (steps.next_observations == 0)).any())
        factor = 1 / (1 - problem.gamma) if loops else 1.0
        return changed(super().estimate(problem, seeds=seeds), values=lambda v: v * factor)


@dataclass(frozen=True)
class SilentOnTruncation(Sound):
    def estimate(self, problem: Problem, *, seeds: tuple[int, ...]) -> tuple[Estimates, ...]:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", EstimationWarning)
            return super().estimate(problem, seeds=seeds)


@dataclass(frozen=True)
class ClipsRewards(Sound):
    def estimate(self, problem: Problem, *, seeds: tuple[int, ...]) -> tuple[Estimates, ...]:
        steps = problem.data.steps
        data = replace(problem.data, steps=replace(steps, rewards=np.clip(steps.rewards, -1, 1)))
        return super().estimate(replace(problem, data=data), seeds=seeds)


@dataclass(frozen=True)
class CountsCopies(Sound):
    """Takes copies for independent data."""

    def estimate(self, problem: Problem, *, seeds: tuple[int, ...]) -> tuple[Estimates, ...]:
        copies = problem.episodes("weights").sum() / problem.data.n_units
        found = super().estimate(problem, seeds=seeds)
        return tuple(
            changed((each,), replicates=lambda r, v=each.values: v[:, None] + (r - v[:, None]) / np.sqrt(copies))[0]
            for each in found
        )


@dataclass(frozen=True)
class UsesEverything(Sound):
    def estimate(self, problem: Problem, *, seeds: tuple[int, ...]) -> tuple[Estimates, ...]:
        return super().estimate(replace(problem, use_augmented=frozenset({"weights"})), seeds=seeds)


@dataclass(frozen=True)
class OneSeedOnly(Sound):
    def estimate(self, problem: Problem, *, seeds: tuple[int, ...]) -> tuple[Estimates, ...]:
        return super().estimate(problem, seeds=seeds[:1])


@dataclass(frozen=True)
class SinglePrecision(Sound):
    def estimate(self, problem: Problem, *, seeds: tuple[int, ...]) -> tuple[Estimates, ...]:
        return changed(super().estimate(problem, seeds=seeds), values=lambda v: v.astype(np.float32))


@dataclass(frozen=True)
class NotANumber(Sound):
    def estimate(self, problem: Problem, *, seeds: tuple[int, ...]) -> tuple[Estimates, ...]:
        return changed(super().estimate(problem, seeds=seeds), replicates=lambda r: r * np.nan)


class Plain(Sound):
    """No dataclass of its own."""

    settings: ClassVar[int] = 1


@dataclass(frozen=True)
class Forgetful(Sound):
    """Its repr leaves a setting out."""

    setting: int = field(default=0, repr=False)


@dataclass(frozen=True)
class ConstantOffset(Sound):
    def estimate(self, problem: Problem, *, seeds: tuple[int, ...]) -> tuple[Estimates, ...]:
        return changed(super().estimate(problem, seeds=seeds), values=lambda v: v + 0.3)


BROKEN = [
    (Unseeded(), "same-seed", "seed 0 gives"),
    (SharedStream(), "other-seeds", "seed 0 beside seed 5: values differ"),
    (ByPosition(), "policy-order", "policies in another order: values differ"),
    (Writes(), "untouched", "it has written to resamples"),
    (GlobalState(), "random-state", "global random state of numpy.random"),
    (Biased(), "on-policy", "its value is"),
    (Bootstraps(), "terminal", "terminate with the reward 1: the value is 10"),
    (SilentOnTruncation(), "truncation", "cut after three rewards of 1"),
    (ClipsRewards(), "reward-scale", "rewards ten times as large"),
    (ClipsRewards(), "reward-shift", "reward 1 \\+ 5: the value is 1"),
    (CountsCopies(), "units", "with three copies of each episode standard errors go from"),
    (UsesEverything(), "real-only", "that use_augmented leaves out"),
    (OneSeedOnly(), "shapes", "two seeds give 1 estimates"),
    (SinglePrecision(), "shapes", "values are float32"),
    (NotANumber(), "shapes", "not all finite"),
    (Plain(), "configuration", "must be a frozen dataclass"),
    (Forgetful(setting=3), "repr", "which is not equal to it"),
    (ConstantOffset(), "zero-rewards", "data without rewards: the value is 0.3"),
]


@pytest.mark.parametrize(("broken", "check", "message"), BROKEN, ids=lambda part: type(part).__name__)
def test_broken_estimators_are_caught(broken: Estimator, check: str, message: str) -> None:
    with pytest.raises(ChecksFailed, match=f"(?s)FAILED {check}: [^\n]*{message}"):
        check_estimator(broken)


def test_every_check_has_a_broken_estimator() -> None:
    assert {check for _, check, _ in BROKEN} == {check.name for check in ESTIMATOR_CHECKS}


def test_one_fault_is_one_finding() -> None:
    for broken, check in ((Writes(), "untouched"), (GlobalState(), "random-state"), (CountsCopies(), "units")):
        with pytest.raises(ChecksFailed) as caught:
            check_estimator(broken)
        assert [name for name, _ in caught.value.report.failed] == [check]


def test_what_is_no_estimator_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="check_estimator takes"):
        check_estimator(ImportanceSampling)
    with pytest.raises(ConfigurationError, match="tolerance must be a positive"):
        check_estimator(ImportanceSampling(), tolerance=0.0)
