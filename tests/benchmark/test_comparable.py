"""Which cells may stand beside each other: another question, policy, dataset, version or setting is another cell."""

import dataclasses
import json
import logging
import math
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from oat_gym import ope
from oat_gym.benchmark import job as job_module
from oat_gym.benchmark.ground import recorded_return, survey, tell_apart
from oat_gym.benchmark.plan import Plan, make_plan, write_manifest
from oat_gym.benchmark.protocol import Catalog, Question
from oat_gym.benchmark.results import read_results
from oat_gym.benchmark.runner import run
from oat_gym.benchmark.variants import parse_variants
from oat_gym.domains import Task, Truth
from oat_gym.errors import ConfigurationError, InvalidDataError
from oat_gym.ope.problem import Problem
from oat_gym.source import Source
from tests.benchmark import tiny

QUESTION = Question(resamples=20, resets=5)
TASK = tiny.CATALOG.tasks["line"]


def catalog_with(**changes: object) -> Catalog:
    return dataclasses.replace(tiny.CATALOG, tasks={"line": dataclasses.replace(TASK, **changes)})


def plan_of(catalog: Catalog = tiny.CATALOG, *, seeds: tuple[int, ...] = (0,), **changes: object) -> Plan:
    settings = {"question": QUESTION, "budget": tiny.BUDGET, "catalog": catalog} | changes
    return make_plan(tiny.SUITE, parse_variants("jittering"), seeds=seeds, **settings)


def compute(plan: Plan, folder: Path, catalog: Catalog = tiny.CATALOG) -> None:
    write_manifest(folder, plan, seeds=sorted({job.seed for job in plan.jobs}), device="cpu", command="bench")
    run(plan, folder, catalog=catalog)


def other_policies() -> dict[str, ope.Policy]:
    pull = partial(tiny._pull, 0.4)
    return tiny.policies() | {"weak": ope.GaussianPolicy(pull, 0.4, tiny.ACTIONS)}


def other_starts(count: int, seed: int) -> np.ndarray:
    return np.ones((count, 2))


@pytest.mark.parametrize(
    "changed",
    [
        {"policies": other_policies},
        {"policies": tiny.real_policies},
        {"horizon": 9},
        {"initial_states": other_starts},
        {"initial_states": None},
    ],
)
def test_a_changed_task_makes_other_cells(changed: dict[str, object]) -> None:
    cells = {cell.fingerprint for job in plan_of().jobs for cell in job.cells()}
    others = {cell.fingerprint for job in plan_of(catalog_with(**changed)).jobs for cell in job.cells()}
    assert cells.isdisjoint(others)


def test_a_discount_that_is_the_tasks_own_is_the_same_question_in_other_words() -> None:
    (own, told) = (plan_of(question=dataclasses.replace(QUESTION, gamma=gamma)).jobs[0] for gamma in (None, 0.9))
    assert own.ground == told.ground
    assert plan_of(question=dataclasses.replace(QUESTION, gamma=0.5)).jobs[0].ground != own.ground


def test_a_policy_is_known_by_what_it_does_and_not_by_its_last_digits() -> None:
    source = Source(tiny.CATALOG.load("line"))
    policies = tiny.policies()
    nudged = {"weak": ope.GaussianPolicy(partial(tiny._pull, 0.2 * (1 + 1e-9)), 0.4, tiny.ACTIONS)}
    changed = {"weak": ope.GaussianPolicy(partial(tiny._pull, 0.2), 0.5, tiny.ACTIONS)}  # another spread only
    told = dict(tell_apart(source, policies))
    assert len(set(told.values())) == len(policies)
    assert dict(tell_apart(source, nudged))["weak"] == told["weak"]
    assert dict(tell_apart(source, changed))["weak"] != told["weak"]


def test_the_device_is_part_of_the_ground_and_its_number_is_not() -> None:
    source = Source(tiny.CATALOG.load("line"))
    grounds = [survey(source, TASK, None, gamma=None, device=device) for device in ("cpu", "cuda:0", "cuda:1")]
    assert grounds[0] != grounds[1] == grounds[2]


def test_cells_of_other_grounds_and_earlier_settings_are_left_out(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """The older run has two seeds; the newer one, with other policies, has one: only that one may be compared."""
    compute(plan_of(seeds=(0, 1)), tmp_path)
    changed = catalog_with(policies=other_policies)
    compute(plan_of(changed), tmp_path, changed)
    with caplog.at_level(logging.WARNING):
        (results,) = read_results(tmp_path)
    assert {(cell.variant, cell.seed) for cell in results.cells} == {("none", 0), ("jittering", 0)}
    assert len(results.cells) == 4
    assert "8 cells of older settings" in caplog.text
    assert (plan_of(changed, seeds=(0, 1)).superseded(tmp_path), plan_of(changed).superseded(tmp_path)) == (4, 0)
    assert len({str(cell.record["config"]["ground"]) for cell in results.cells}) == 1


def test_questions_of_other_sizes_are_settings_of_their_own(tmp_path: Path) -> None:
    compute(plan_of(), tmp_path)
    compute(plan_of(question=dataclasses.replace(QUESTION, resamples=30)), tmp_path)
    found = read_results(tmp_path)
    assert [results.setting.question.resamples for results in found] == [20, 30]
    assert [len(results.cells) for results in found] == [4, 4]
    assert all(results.unfinished == 0 for results in found)


def test_true_values_are_those_of_the_last_run(tmp_path: Path) -> None:
    compute(plan_of(), tmp_path)

    def better(gamma: float) -> Truth:
        truth = tiny.truth(gamma)
        return dataclasses.replace(truth, values={name: value + 1.0 for name, value in truth.values.items()})

    before = read_results(tmp_path)[0].cells
    catalog = catalog_with(truth=better)
    plan = plan_of(catalog)
    assert plan.open_jobs(tmp_path) == ()
    compute(plan, tmp_path, catalog)
    after = read_results(tmp_path)[0].cells
    for old, new in zip(before, after, strict=True):
        np.testing.assert_allclose(new.true, old.true + 1.0)
        np.testing.assert_array_equal(new.values, old.values)


def test_a_truth_is_of_its_ground_only(tmp_path: Path) -> None:
    """Another policy of the same name has another value; the estimators that did not see it are left out."""

    def other_truth(gamma: float) -> Truth:
        truth = tiny.truth(gamma)
        return dataclasses.replace(truth, values={**truth.values, "weak": 100.0})

    compute(plan_of(), tmp_path)
    first = read_results(tmp_path)[0].cells
    changed = catalog_with(policies=other_policies, truth=other_truth)
    compute(plan_of(changed, budget=tiny.BUDGET.choose("is")), tmp_path, changed)
    second = read_results(tmp_path)[0].cells
    assert {cell.family for cell in second} == {"IS"}
    assert all(cell.true[1] == 100.0 for cell in second)
    write_manifest(tmp_path, plan_of(), seeds=[0], device="cpu", command="again")  # nothing of it is computed anew
    third = read_results(tmp_path)[0].cells
    assert [cell.true.tolist() for cell in third] == [cell.true.tolist() for cell in second]
    assert first[0].true[1] != 100.0


def test_a_failed_run_does_not_push_out_finished_cells(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    compute(plan_of(), tmp_path)
    later = catalog_with(horizon=9)

    def broken(*_: object, **__: object) -> None:
        raise InvalidDataError("a damaged file")

    with monkeypatch.context() as patch:
        patch.setattr(job_module.ope, "evaluate", broken)
        compute(plan_of(later), tmp_path, later)
    (results,) = read_results(tmp_path)
    assert [cell.failed for cell in results.cells] == [False] * 4


def test_estimates_that_are_no_numbers_are_a_failed_cell(tmp_path: Path) -> None:
    budget = dataclasses.replace(tiny.BUDGET, estimators=(("fqe", _NoNumbers()), tiny.BUDGET.estimators[1]))
    compute(plan_of(budget=budget), tmp_path)
    cells = {(cell.variant, cell.family): cell for cell in read_results(tmp_path)[0].cells}
    assert cells["none", "FQE"].reason == "the estimates of fair are not finite"
    assert not cells["none", "IS"].failed


class _NoNumbers(ope.FQE):
    def estimate(self, problem: Problem, *, seeds: tuple[int, ...]) -> tuple[ope.Estimates, ...]:
        values = np.array([0.0, 1.0, np.nan, 3.0, 4.0, 5.0])
        draws = np.repeat(values[:, None], len(problem.resamples), axis=1)
        return (ope.Estimates(values, draws, tuple({} for _ in values)),)


def test_what_was_mined_and_generated_is_that_of_the_last_run(tmp_path: Path) -> None:
    compute(plan_of(), tmp_path)
    other = dataclasses.replace(tiny.BUDGET, name="other")
    compute(plan_of(budget=other), tmp_path)
    assert [len(results.augmented) for results in read_results(tmp_path)] == [2, 2]
    assert [results.setting.slug for results in read_results(tmp_path)] == [
        f"{name}-reset-clone-resets-5-resamples-20" for name in ("tiny", "other")
    ]


@pytest.mark.parametrize("change", [None, "truths", "augmented"])
def test_a_manifest_of_another_version_is_named(change: str | None, tmp_path: Path) -> None:
    path = write_manifest(tmp_path, plan_of(), seeds=[0], device="cpu", command="bench")
    told = json.loads(path.read_text())
    path.write_text("{" if change is None else json.dumps({key: told[key] for key in told if key != change}))
    with pytest.raises(ConfigurationError, match="another version of oat_gym, or is damaged"):
        read_results(tmp_path)


def test_a_damaged_dataset_is_named_and_the_rest_is_planned() -> None:
    def damaged() -> None:
        raise InvalidDataError("episode 3 holds a NaN")

    datasets = {**tiny.CATALOG.datasets, "line-human": damaged}
    plan = plan_of(dataclasses.replace(tiny.CATALOG, datasets=datasets))
    assert plan.missing["line-human"] == "episode 3 holds a NaN"
    assert {job.dataset for job in plan.jobs} == {"line"}


def test_the_recorded_return_is_discounted_up_to_the_horizon() -> None:
    rewards = [episode.rewards for episode in tiny.CATALOG.load("line", episodes=None).iterate_episodes()]
    returns = [sum(tiny.GAMMA**t * reward for t, reward in enumerate(each[: tiny.STEPS])) for each in rewards]
    mean, error = plan_of(budget=dataclasses.replace(tiny.BUDGET, episodes=None)).recorded["line"]
    assert mean == pytest.approx(np.mean(returns))
    assert error == pytest.approx(np.std(returns, ddof=1) / math.sqrt(len(returns)))
    source = Source(tiny.CATALOG.load("line", episodes=None))
    short = [each[0] + 0.5 * each[1] for each in rewards]
    assert recorded_return(source, gamma=0.5, horizon=2)[0] == pytest.approx(np.mean(short))
    whole = [each.sum() for each in rewards]
    assert recorded_return(source, gamma=1.0, horizon=None)[0] == pytest.approx(np.mean(whole))


def test_a_task_without_truth_has_none_in_the_plan() -> None:
    task: Task = dataclasses.replace(TASK, truth=None)
    plan = plan_of(dataclasses.replace(tiny.CATALOG, tasks={"line": task}))
    assert plan.truths == {} and "line" in plan.unknown_truth
