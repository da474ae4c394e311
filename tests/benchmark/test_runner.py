"""Running the benchmark: resuming, damage, order and workers, what is missing, what fails."""

import dataclasses
import json
import logging
import platform
import shutil
from pathlib import Path

import numpy as np
import pytest

from oat_gym import ope
from oat_gym.benchmark import job as job_module
from oat_gym.benchmark.measure import processor
from oat_gym.benchmark.plan import Plan, make_plan, read_manifests, write_manifest
from oat_gym.benchmark.protocol import SUITES, Question, Suite, find_suite
from oat_gym.benchmark.results import read_results
from oat_gym.benchmark.runner import Pace, run
from oat_gym.benchmark.store import cell_path, read_result
from oat_gym.benchmark.variants import VARIANTS, find_variant, fit_length, on_device, parse_variants, quick_augmenter
from oat_gym.errors import ConfigurationError, TrainingError
from tests.benchmark import tiny

QUESTION = Question(resamples=20, resets=5)


def plan_of(names: str = "jittering", seeds: tuple[int, ...] = (0,), **changes: object) -> Plan:
    settings = {"question": QUESTION, "budget": tiny.BUDGET, "catalog": tiny.CATALOG} | changes
    return make_plan(tiny.SUITE, parse_variants(names), seeds=seeds, **settings)


def contents(folder: Path, plan: Plan) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    cells = [cell for job in plan.jobs for cell in job.cells()]
    found = {cell.fingerprint: read_result(cell_path(folder, cell)) for cell in cells}
    return {key: (result.values, result.replicates) for key, result in found.items()}


def assert_same(first: dict, second: dict) -> None:
    assert first.keys() == second.keys()
    for key, (values, replicates) in first.items():
        np.testing.assert_array_equal(values, second[key][0])
        np.testing.assert_array_equal(replicates, second[key][1])


@pytest.fixture(scope="module")
def computed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Plan, Path]:
    plan, folder = plan_of(seeds=(0, 1)), tmp_path_factory.mktemp("computed")
    run(plan, folder, catalog=tiny.CATALOG)
    return plan, folder


@pytest.fixture
def finished(computed: tuple[Plan, Path], tmp_path: Path) -> tuple[Plan, Path]:
    """A finished run that a test may change."""
    shutil.copytree(computed[1], tmp_path / "one")
    return computed[0], tmp_path / "one"


def test_the_maker_of_the_processor_is_read_from_the_kernels_list(tmp_path: Path) -> None:
    listed = tmp_path / "cpuinfo"
    listed.write_text("processor\t: 0\nvendor_id\t: GenuineIntel\n\nprocessor\t: 1\nvendor_id\t: GenuineIntel\n")
    assert processor(listed) == "GenuineIntel"
    listed.write_text("processor\t: 0\nCPU implementer\t: 0x41\n")  # ARM's lists have no maker's name
    assert processor(listed) == processor(tmp_path / "absent") == platform.processor()


def test_estimates_come_near_the_exact_values(finished: tuple[Plan, Path]) -> None:
    plan, folder = finished
    for cell in plan.jobs[0].cells():
        result = read_result(cell_path(folder, cell))
        assert result.knows_truth and not result.failed
        if result.family == "FQE":
            np.testing.assert_allclose(result.values[1:], result.true[1:], atol=1.0)
        assert result.record["cost"]["wall_seconds"] > 0
        assert result.record["cost"]["peak_memory_mb"] > 10
        assert result.record["environment"]["numpy"] == np.__version__
        assert processor() in result.record["environment"]["machine"]
        assert result.record["config"]["estimator"]["class"] in ("FQE", "ImportanceSampling")


def test_a_finished_run_does_nothing_and_a_lost_or_damaged_cell_is_computed_again(
    finished: tuple[Plan, Path], caplog: pytest.LogCaptureFixture
) -> None:
    plan, folder = finished
    before = contents(folder, plan)
    assert run(plan, folder, catalog=tiny.CATALOG) == []
    lost, damaged = (cell_path(folder, job.cells()[0]) for job in plan.jobs[:2])
    untouched = cell_path(folder, plan.jobs[0].cells()[1])
    stamp = untouched.stat().st_mtime_ns
    lost.unlink()
    data = bytearray(damaged.read_bytes())
    data[-3] ^= 1
    damaged.write_bytes(bytes(data))
    with caplog.at_level(logging.WARNING):
        assert len(run(plan, folder, catalog=tiny.CATALOG)) == 2
    assert "computed again" in caplog.text
    assert_same(before, contents(folder, plan))
    assert untouched.stat().st_mtime_ns == stamp  # the finished cells of the same job are left as they are


def test_a_cell_depends_on_its_own_inputs_only(finished: tuple[Plan, Path], tmp_path: Path) -> None:
    """Another order, other cells beside it, one estimator alone: the same bytes."""
    plan, folder = finished
    turned = dataclasses.replace(plan, jobs=plan.jobs[::-1])
    run(turned, tmp_path / "turned", catalog=tiny.CATALOG)
    assert_same(contents(folder, plan), contents(tmp_path / "turned", plan))
    alone = plan_of(seeds=(1,), budget=tiny.BUDGET.choose("is"))
    run(alone, tmp_path / "alone", catalog=tiny.CATALOG)
    everything = contents(folder, plan)
    for key, parts in contents(tmp_path / "alone", alone).items():
        np.testing.assert_array_equal(parts[0], everything[key][0])


def test_a_changed_configuration_is_another_cell(finished: tuple[Plan, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    plan, folder = finished
    other = plan_of(question=dataclasses.replace(QUESTION, initial="data"))
    names = {cell.fingerprint for job in plan.jobs for cell in job.cells()}
    assert names.isdisjoint(cell.fingerprint for job in other.jobs for cell in job.cells())
    assert len(run(other, folder, catalog=tiny.CATALOG)) == 2
    more = dataclasses.replace(tiny.BUDGET, cloning=ope.BehaviorCloning(max_updates=21))
    assert len(plan_of(budget=more).open_jobs(folder)) == 2
    assert plan_of().open_jobs(folder) == ()
    assert plan_of("jittering+training").open_jobs(folder)
    corrected = dataclasses.replace(VARIANTS["jittering"], revision=1)
    monkeypatch.setitem(VARIANTS, "jittering", corrected)
    assert [job.variant for job in plan_of().open_jobs(folder)] == [corrected]


def test_processes_give_the_same_cells(finished: tuple[Plan, Path], tmp_path: Path) -> None:
    import cloudpickle

    plan, folder = finished
    cloudpickle.register_pickle_by_value(tiny)
    try:
        run(plan, tmp_path / "many", n_jobs=2, catalog=tiny.CATALOG)
    finally:
        cloudpickle.unregister_pickle_by_value(tiny)
    assert_same(contents(folder, plan), contents(tmp_path / "many", plan))


def test_a_missing_dataset_is_named_and_the_rest_runs(finished: tuple[Plan, Path]) -> None:
    plan, folder = finished
    assert "minari download D4RL/line/human-v2" in plan.missing["line-human"]
    write_manifest(folder, plan, seeds=[0, 1], device="cpu", command="oat-gym bench")
    (results,) = read_results(folder)
    assert "minari download" in results.missing["line-human"]
    assert results.unfinished == 0
    unknown = make_plan(
        Suite("x", ("line", "nowhere"), "x"), parse_variants("none"), seeds=[0], question=QUESTION, budget=tiny.BUDGET,
        catalog=tiny.CATALOG,
    )  # fmt: skip
    assert "no dataset named 'nowhere'" in unknown.missing["nowhere"] or "No task" in unknown.missing["nowhere"]


def test_where_nobody_knows_the_truth_the_plan_says_so() -> None:
    suite = Suite("logs", ("line-logs",), "logs")
    plan = make_plan(
        suite, parse_variants("none"), seeds=[0], question=QUESTION, budget=tiny.BUDGET, catalog=tiny.CATALOG
    )
    assert "nobody knows" in plan.unknown_truth["line-logs"]


class _Diverges(ope.FQE):
    def estimate(self, problem, *, seeds):
        raise TrainingError("diverged")


def test_one_failing_estimator_is_a_failed_cell_and_is_tried_again(tmp_path: Path) -> None:
    budget = dataclasses.replace(tiny.BUDGET, estimators=(("fqe", _Diverges()), tiny.BUDGET.estimators[1]))
    plan = plan_of("none", budget=budget)
    (report,) = run(plan, tmp_path, catalog=tiny.CATALOG)
    assert [reason for _, reason in report.cells] == ["TrainingError: diverged", ""]
    fqe, other = (read_result(cell_path(tmp_path, cell)) for cell in plan.jobs[0].cells())
    assert fqe.failed and np.isnan(fqe.values).all()
    assert np.isfinite(other.values).all()
    assert len(plan.open_jobs(tmp_path)) == 1


def test_an_augmenter_that_cannot_work_fails_its_cells_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object, **__: object) -> None:
        raise TrainingError("no model")

    plan = plan_of()
    with monkeypatch.context() as patch:
        patch.setattr(job_module, "AugmentedDataset", broken)
        reports = {report.job.variant.name: report for report in run(plan, tmp_path, catalog=tiny.CATALOG)}
    assert {reason for _, reason in reports["none"].cells} == {""}
    assert {reason for _, reason in reports["jittering"].cells} == {"TrainingError: no model"}
    assert [job.variant.name for job in plan.open_jobs(tmp_path)] == ["jittering"]


def test_seeds_share_a_folder(tmp_path: Path) -> None:
    for seed in (0, 1):
        plan = plan_of("none", seeds=(seed,))
        write_manifest(tmp_path, plan, seeds=[seed], device="cpu", command=f"--seed {seed}")
        run(plan, tmp_path, catalog=tiny.CATALOG)
    (results,) = read_results(tmp_path)
    assert {cell.seed for cell in results.cells} == {0, 1}
    assert len(read_manifests(tmp_path)) == 2
    assert all(json.dumps(manifest) for manifest in read_manifests(tmp_path))


def test_the_time_left_follows_the_jobs_like_the_open_ones() -> None:
    plan = plan_of(seeds=(0, 1, 2))
    pace = Pace.of(plan.jobs, workers=2)
    assert pace.seconds_left() is None
    costs = {"none": 10.0, "jittering": 30.0}
    for job in plan.jobs[:2]:
        pace.add(job_module.JobReport(job, (), 1.0, costs[job.variant.name]))
    assert pace.seconds_left() == pytest.approx((2 * 10 + 2 * 30) / 2)
    for job in plan.jobs[2:5]:
        pace.add(job_module.JobReport(job, (), 1.0, costs[job.variant.name]))
    assert pace.seconds_left() == pytest.approx(30)  # one job is not shared out over two workers


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: find_suite("adroit"), "no suite 'adroit'"),
        (lambda: parse_variants("oat,magic"), "no variant 'magic'"),
        (lambda: parse_variants("oat,oat"), "twice"),
        (lambda: find_variant("none+training"), "no variant"),
        (lambda: tiny.BUDGET.choose("mb"), "no estimator mb"),
        (lambda: Question(initial="start"), "initial must be"),
        (lambda: plan_of(seeds=()), "at least one"),
        (lambda: run(plan_of(), Path("x"), n_jobs=0), "n_jobs"),
    ],
)
def test_bad_settings_are_named(call, message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        call()


def test_every_suite_has_datasets_and_variants() -> None:
    for suite in SUITES.values():
        assert suite.variants[0] == "none"
        assert set(suite.variants) <= set(VARIANTS)
    assert [v.name for v in parse_variants("oat")] == ["none", "oat"]


def test_variants_keep_their_form_on_other_devices_and_budgets() -> None:
    for variant in VARIANTS.values():
        if variant.augmenter is None:
            continue
        moved = on_device(variant.augmenter, "meta")
        assert ("meta" in repr(moved)) == ("device" in repr(variant.augmenter))
        assert type(quick_augmenter(variant.augmenter)) is type(variant.augmenter)
    oat = VARIANTS["oat-paper"].augmenter
    assert quick_augmenter(oat).seam == "literal"
    assert quick_augmenter(oat).model.max_updates == 60
    short = fit_length(oat, np.array([12, 12, 10]))
    assert short.mining.length == 6
    assert fit_length(oat, np.array([200, 300])) is oat
    assert fit_length(VARIANTS["tda"].augmenter, np.array([12])).length == 6
    both = VARIANTS["oat-jitter"].augmenter
    assert fit_length(both, np.array([12])).augmenters[0].mining.length == 6
    assert quick_augmenter(both).augmenters[0].model.max_updates == 60


def test_a_variant_may_use_synthetic_episodes_for_some_families_only(tmp_path: Path) -> None:
    variants = [
        VARIANTS["none"],
        VARIANTS["jittering"],
        dataclasses.replace(VARIANTS["jittering"], name="but-fqe", use_augmented={"FQE": "none", "IS": "all"}),
    ]
    plan = make_plan(tiny.SUITE, variants, seeds=(0,), question=QUESTION, budget=tiny.BUDGET, catalog=tiny.CATALOG)
    run(plan, tmp_path, catalog=tiny.CATALOG)
    results = [read_result(cell_path(tmp_path, cell)) for job in plan.jobs for cell in job.cells()]
    values = {(result.variant, result.family): result.values for result in results}
    np.testing.assert_array_equal(values["but-fqe", "FQE"], values["none", "FQE"])
    np.testing.assert_array_equal(values["but-fqe", "IS"], values["jittering", "IS"])
    assert (values["but-fqe", "IS"] != values["none", "IS"]).all()


def test_target_policies_act_in_roll_outs_where_a_variant_says_so(tmp_path: Path) -> None:
    variant = find_variant("oat-targets")
    assert VARIANTS["oat"].with_policies(tiny.policies()) is VARIANTS["oat"].augmenter
    proposals = variant.with_policies(tiny.policies()).policy
    states = np.zeros((4000, 2))
    actions = proposals.sample(states, rng=np.random.default_rng(0))
    # at x = 0 a policy of gain g takes g, plus noise of 0.4: the mixture's mean is the mean gain
    assert actions.mean() == pytest.approx(np.mean(list(tiny.GAINS.values())), abs=0.03)
    each = [np.exp(policy.log_prob(states[:3], actions[:3])) for policy in tiny.policies().values()]
    np.testing.assert_allclose(np.exp(proposals.log_prob(states[:3], actions[:3])), np.mean(each, axis=0))
    plan = plan_of("oat-targets")
    assert all(not reason for report in run(plan, tmp_path, catalog=tiny.CATALOG) for _, reason in report.cells)
    with pytest.raises(ConfigurationError, match="rolls out policies"):
        dataclasses.replace(VARIANTS["jittering"], targets=True)
