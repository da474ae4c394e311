"""The contract of an off-policy estimator, as checks that anyone can run."""

from __future__ import annotations

import ast
import copy
import dataclasses
import math
import warnings
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from oat_gym.checks._process import GAMMA, corridor, corridor_value, loop, pose, with_copies
from oat_gym.checks._trial import global_states
from oat_gym.checks.report import Broken, Check, NotApplicable, Report, run_checks
from oat_gym.errors import ConfigurationError, EstimationWarning
from oat_gym.ope.estimator import Estimates, Estimator
from oat_gym.ope.logged import Logged
from oat_gym.ope.problem import Problem

FloatArray = npt.NDArray[np.float64]
ROUNDING = 1e-3
"""Up to this share of the largest value may be rounding, where policies or seeds are batched differently."""


@dataclass
class Subject:
    """An estimator, and how far off its values may be (of values of size 1)."""

    estimator: Estimator
    tolerance: float

    @cached_property
    def data(self) -> Logged:
        """The corridor's log."""
        return corridor(np.random.default_rng(1))

    @cached_property
    def first(self) -> Estimates:
        """The estimates of seed 0."""
        return self.run(pose(self.data))[0]

    def run(self, problem: Problem, *, seeds: tuple[int, ...] = (0,)) -> tuple[Estimates, ...]:
        """Estimate without a word on the `EstimationWarning`s."""
        return self.told(problem, seeds=seeds)[0]

    def told(self, problem: Problem, *, seeds: tuple[int, ...] = (0,)) -> tuple[tuple[Estimates, ...], list[str]]:
        """Return the estimates and the texts of the `EstimationWarning`s."""
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            self.estimator.check(problem)
            found = self.estimator.estimate(problem, seeds=seeds)
        return found, [str(warning.message) for warning in caught if issubclass(warning.category, EstimationWarning)]

    def expect(self, got: float, expected: float, what: str, *, scale: float = 1.0) -> None:
        """Raise `Broken` unless `got` is within the tolerance of `expected`."""
        if not abs(got - expected) <= self.tolerance * scale:  # NaN is broken too
            raise Broken(f"{what}: the value is {got:.4g}, expected {expected:.4g} +- {self.tolerance * scale:.2g}")


def configuration(subject: Subject) -> int:
    """It is a frozen dataclass with a name and a family, hashable, and equal to its copies."""
    estimator = subject.estimator
    kind = type(estimator)
    if "__dataclass_params__" not in vars(kind) or not getattr(kind, "__dataclass_params__").frozen:  # noqa: B009
        raise Broken(f"{kind.__name__} must be a frozen dataclass: decorate it by @dataclass(frozen=True)")
    for what in ("name", "family"):
        if not isinstance(getattr(estimator, what, None), str):
            raise Broken(f"its {what} must be a string, got {getattr(estimator, what, None)!r}")
    for twin in (copy.deepcopy(estimator), dataclasses.replace(estimator)):
        if twin != estimator or hash(twin) != hash(estimator):
            raise Broken(f"its copy {twin!r} is not equal to it, or has another hash")
    return 2


def rebuilt_by_repr(subject: Subject) -> int:
    """Its repr is a call that rebuilds it; the text is read and not run."""
    text = repr(subject.estimator)
    known = {type(part).__name__: type(part) for part in _parts(subject.estimator)}
    try:
        twin = _read(ast.parse(text, mode="eval").body, known)
    except (SyntaxError, ValueError, TypeError) as error:
        raise Broken(f"its repr {text} does not rebuild it: {error}") from None
    if twin != subject.estimator:
        raise Broken(f"its repr {text} rebuilds {twin!r}, which is not equal to it")
    return 1


def _parts(value: Any) -> list[Any]:
    fields = dataclasses.fields(value)
    inner = [getattr(value, field.name) for field in fields]
    return [value, *(part for each in inner if dataclasses.is_dataclass(each) for part in _parts(each))]


def _read(node: ast.expr, known: dict[str, type[Any]]) -> Any:
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in known:
        return known[node.func.id](**{word.arg: _read(word.value, known) for word in node.keywords if word.arg})
    if isinstance(node, ast.Tuple):
        return tuple(_read(item, known) for item in node.elts)
    return ast.literal_eval(node)


def shapes(subject: Subject) -> int:
    """One value, row of replicates and mapping of numbers a policy, for each seed."""
    problem = pose(subject.data)
    found = subject.run(problem, seeds=(0, 1))
    if len(found) != 2:
        raise Broken(f"two seeds give {len(found)} estimates")
    n_policies, n_resamples = len(problem.policies), len(problem.resamples)
    for estimates in found:
        for name, expected in (("values", (n_policies,)), ("replicates", (n_policies, n_resamples))):
            got = getattr(estimates, name)
            if got.shape != expected or got.dtype != np.float64:
                raise Broken(f"{name} are {got.dtype}{list(got.shape)}, expected float64{list(expected)}")
            if not np.isfinite(got).all():
                raise Broken(f"{name} are not all finite on sound data")
        numbers = [value for row in estimates.diagnostics for value in row.values()]
        if len(estimates.diagnostics) != n_policies or not all(isinstance(value, float | int) for value in numbers):
            raise Broken("diagnostics must be a mapping from names to numbers for each policy")
    return 2


def same_seed(subject: Subject) -> int:
    """The same seed gives the same numbers."""
    again = subject.run(pose(subject.data))[0]
    if not (np.array_equal(again.values, subject.first.values) and _same(again.replicates, subject.first.replicates)):
        raise Broken(f"seed 0 gives {subject.first.values}, and then {again.values}")
    return 2


def other_seeds(subject: Subject) -> int:
    """A seed's result does not depend on the seeds beside it."""
    beside = subject.run(pose(subject.data), seeds=(5, 0))[1]
    _expect_close(beside, subject.first, "seed 0 beside seed 5")
    return 2


def policy_order(subject: Subject) -> int:
    """A policy's result does not depend on the order of the policies."""
    names = ("behaviour", "left", "right")
    turned = subject.run(pose(subject.data, names[::-1]))[0]
    turned = Estimates(turned.values[::-1], turned.replicates[::-1], turned.diagnostics[::-1])
    _expect_close(turned, subject.first, "policies in another order")
    return 3


def _expect_close(got: Estimates, expected: Estimates, what: str) -> None:
    scale = float(np.abs(expected.values).max()) + 1e-12
    for name in ("values", "replicates"):
        gap = float(np.abs(getattr(got, name) - getattr(expected, name)).max())
        if not gap <= ROUNDING * scale:
            raise Broken(f"{what}: {name} differ by {gap:.3g}, of values up to {scale:.3g}")


def _same(left: FloatArray, right: FloatArray) -> bool:
    return np.array_equal(left, right, equal_nan=True)


def untouched(subject: Subject) -> int:
    """It writes to no array of the problem."""
    problem = pose(subject.data)
    arrays = _arrays(problem)
    before = {name: array.copy() for name, array in arrays.items()}
    subject.run(problem)
    for name, array in _arrays(problem).items():
        if name in before and not _same(np.asarray(array), before[name]):
            raise Broken(f"it has written to {name}")
    return len(arrays)


def _arrays(problem: Problem) -> dict[str, npt.NDArray[Any]]:
    data, steps = problem.data, problem.data.steps
    parts = {f"steps.{field.name}": getattr(steps, field.name) for field in dataclasses.fields(steps)}
    features = {"states": data.states, "next_states": data.next_states, "actions": data.actions}
    rest = {"offsets": data.offsets, "unit": data.unit, "resamples": problem.resamples, "initial": problem.initial}
    return parts | features | rest | {"target_log_prob": problem.target_log_prob()}


def random_states(subject: Subject) -> int:
    """Global random states stay as they are."""
    before = global_states()
    subject.run(pose(subject.data))
    after = global_states()
    moved = [name for name in before if before[name] != after[name]]
    if moved:
        raise Broken(f"it moved the global random state of {', '.join(moved)}")
    return len(before)


def on_policy(subject: Subject) -> int:
    """The behaviour policy's own value is right, with and without a horizon."""
    error = float(subject.first.replicates[0].std())
    gap = abs(float(subject.first.values[0]) - corridor_value())
    if not gap <= subject.tolerance + 4 * max(error, 0.05):
        raise Broken(f"its value is {subject.first.values[0]:.4g}, the truth {corridor_value():.4g}")
    rewards = subject.data.steps.rewards[subject.data.offsets[:-1]]
    one = subject.run(pose(subject.data, ("behaviour",), horizon=1))[0]
    subject.expect(float(one.values[0]), float(rewards.mean()), "horizon=1, where the value is the mean first reward")
    return 2


def terminal(subject: Subject) -> int:
    """Terminal states bootstrap zero."""
    got = subject.run(pose(loop(1, terminates=True), ("behaviour",)))[0]
    subject.expect(float(got.values[0]), 1.0, "episodes of one step that terminate with the reward 1")
    return 1


def truncation(subject: Subject) -> int:
    """Truncated steps bootstrap; an estimator that cannot says so."""
    (got,), texts = subject.told(pose(loop(3, terminates=False), ("behaviour",)))
    if texts:
        return 1  # it has said that the value is cut short
    endless = 1 / (1 - GAMMA)
    what = "episodes that are cut after three rewards of 1, without an EstimationWarning"
    subject.expect(float(got.values[0]), endless, what, scale=endless)
    return 1


def zero_rewards(subject: Subject) -> int:
    """Without rewards every value is zero."""
    steps = subject.data.steps
    data = dataclasses.replace(subject.data, steps=dataclasses.replace(steps, rewards=np.zeros(len(steps))))
    for value in subject.run(pose(data))[0].values:
        subject.expect(float(value), 0.0, "data without rewards")
    return 3


def reward_scale(subject: Subject) -> int:
    """Rewards ten times as large give values ten times as large."""
    steps = subject.data.steps
    data = dataclasses.replace(subject.data, steps=dataclasses.replace(steps, rewards=10 * steps.rewards))
    got = subject.run(pose(data))[0].values
    for value, expected in zip(got, 10 * subject.first.values, strict=True):
        subject.expect(float(value), float(expected), "rewards ten times as large", scale=10.0)
    return 3


def reward_shift(subject: Subject) -> int:
    """One more of reward a step is one more of value where episodes have one step."""
    got = subject.run(pose(loop(1, terminates=True, reward=6.0), ("behaviour",)))[0]
    subject.expect(float(got.values[0]), 6.0, "episodes of one step with the reward 1 + 5", scale=6.0)
    return 1


def units(subject: Subject) -> int:
    """Copies of the data do not narrow the interval: replicates resample real episodes."""
    before = subject.first.replicates.std(axis=1)
    if not (before > 1e-9).all():
        raise NotApplicable("its replicates do not vary")
    copies = with_copies(subject.data, 3)
    after = subject.run(pose(copies, everywhere=True))[0].replicates.std(axis=1)
    if not (after > 0.7 * before).all():  # as independent data they would have half the error
        raise Broken(f"with three copies of each episode standard errors go from {before} to {after}")
    return 3


def real_only(subject: Subject) -> int:
    """Synthetic episodes that it may not use change nothing."""
    strange = with_copies(subject.data, 1, extra_reward=50.0)
    got = subject.run(pose(strange))[0].values
    for value, expected in zip(got, subject.first.values, strict=True):
        subject.expect(float(value), float(expected), "with synthetic episodes that use_augmented leaves out")
    return 3


ESTIMATOR_CHECKS: tuple[Check[Subject], ...] = (
    Check("configuration", "it is a frozen dataclass, equal to its copies", configuration),
    Check("repr", "its repr rebuilds it", rebuilt_by_repr, ("configuration",)),
    Check("shapes", "values, replicates and diagnostics of every policy and seed", shapes),
    Check("same-seed", "the same seed gives the same numbers", same_seed, ("shapes",)),
    Check("other-seeds", "seeds do not depend on each other", other_seeds, ("same-seed",)),
    Check("policy-order", "policies do not depend on their order", policy_order, ("same-seed",)),
    Check("untouched", "the data is not written to", untouched, ("shapes",)),
    Check("random-state", "global random states stay as they are", random_states, ("shapes",)),
    Check("on-policy", "the behaviour policy's value is right", on_policy, ("same-seed",)),
    Check("terminal", "terminal states bootstrap zero", terminal, ("shapes",)),
    Check("truncation", "truncated steps bootstrap, or a warning says that they cannot", truncation, ("shapes",)),
    Check("zero-rewards", "no rewards, no value", zero_rewards, ("shapes",)),
    Check("reward-scale", "values scale with rewards", reward_scale, ("same-seed",)),
    Check("reward-shift", "values shift with rewards", reward_shift, ("terminal",)),
    Check("units", "copies are no independent data", units, ("same-seed",)),
    Check("real-only", "use_augmented is obeyed", real_only, ("same-seed",)),
)
"""Every check of `check_estimator`, in the order in which they are run."""


def check_estimator(estimator: Estimator, *, tolerance: float = 0.1) -> Report:
    """Hold the contract of an estimator against one, configured as it is: a user's own or one of `oat_gym.ope`.

    The rules are in `ESTIMATOR_CHECKS`. It is run about 15 times, with three policies, on logs of 80 episodes over
    three states and two actions whose values are known, so one that trains is to be given settings for quick training.

    Args:
        estimator: the configuration to check.
        tolerance: how far values may be from the truth, for returns of size 1.

    Returns:
        The report of the checks that passed, and of those that had nothing to look at.

    Raises:
        ChecksFailed: (a `ConformanceError`) listing every check that failed, with the first thing that broke it.
        ConfigurationError: for something that is no estimator, or a tolerance that is not positive.

    >>> from oat_gym.ope import ImportanceSampling
    >>> check_estimator(ImportanceSampling()).failed
    ()
    """
    if not isinstance(estimator, Estimator):
        raise ConfigurationError(f"check_estimator takes an oat_gym.ope.Estimator such as FQE(), got {estimator!r}.")
    if not 0 < tolerance < math.inf:
        raise ConfigurationError(f"tolerance must be a positive number, got {tolerance!r}.")
    return run_checks(repr(estimator), Subject(estimator, float(tolerance)), ESTIMATOR_CHECKS)
