"""From cells to tables, figures and the page: numbers that are known beforehand come out where they belong."""

import csv
import dataclasses
import math
import re
import time
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from oat_gym.benchmark import figures, paper
from oat_gym.benchmark.analysis import Analysis
from oat_gym.benchmark.estimates import estimates_table
from oat_gym.benchmark.grid import write_tables
from oat_gym.benchmark.improvement import Parts
from oat_gym.benchmark.page import make_page
from oat_gym.benchmark.protocol import Question
from oat_gym.benchmark.results import Results, Setting, with_truth
from oat_gym.benchmark.scores import METRICS
from oat_gym.benchmark.store import CellResult, read_result, write_result
from oat_gym.benchmark.story import (
    bar_panels,
    best_sentences,
    by_level,
    floor_sentence,
    groups_of,
    level_panels,
    sentence,
)
from oat_gym.benchmark.tables import all_tables, dataset_table, help_table, overview_table, paper_table
from oat_gym.benchmark.tidy import cell_rows, estimate_rows, improvement_of, improvement_rows, to_csv, write_tidy
from oat_gym.errors import CacheError, ConfigurationError

POLICIES = tuple(f"p{number}" for number in range(7))
TRUE = np.linspace(0.0, 600.0, 7)
QUESTION = {"initial": "reset", "behavior": "clone", "gamma": None}
GROUND = {"data": "x", "computed": "numpy 2"}


def cell(
    dataset: str, variant: str, family: str, seed: int, *, error: float, known: bool = True, reason: str = ""
) -> CellResult:
    """A cell whose estimates are off by `error`, give or take 1."""
    rng = np.random.default_rng([seed, len(variant), len(family), int(error)])
    values = TRUE + error + rng.normal(size=7)
    return CellResult(
        dataset=dataset, task="adroit-door", variant=variant, family=family, estimator=family, seed=seed, budget="full",
        initial="reset (5 states)", policies=(*POLICIES[:6], "expert"), values=values,
        replicates=values[:, None] + rng.normal(size=(7, 40)), true=TRUE if known else np.full(7, math.nan),
        true_errors=np.zeros(7), reason=reason,
        record={
            "config": {"question": QUESTION, "ground": GROUND},
            "fingerprint": f"{dataset}{variant}{family}{seed}", "n_episodes": 25,
            "finished": float(seed), "gamma": 0.995, "horizon": 200, "truth_note": "" if known else "Nobody knows.",
            "environment": {"numpy": "2"}, "cost": {"cpu_seconds": 1.0, "wall_seconds": 2.0, "peak_memory_mb": 3.0},
        },
    )  # fmt: skip


ERRORS = {"none": 100.0, "oat-paper": 40.0, "jittering": 100.0, "scaling": 220.0}


def results_of(datasets: dict[str, bool], *, seeds: int = 3, extra: tuple[CellResult, ...] = ()) -> Results:
    cells = [
        cell(name, variant, family, seed, error=error, known=known)
        for name, known in datasets.items()
        for variant, error in ERRORS.items()
        for family in ("FQE", "IS")
        for seed in range(seeds)
    ]
    manifest = {
        "question": QUESTION, "budget": {"name": "full"}, "datasets": [*datasets, "adroit-pen-human"],
        "jobs_order": list(ERRORS), "missing": {"adroit-pen-human": "run `minari download D4RL/pen/human-v2`"},
        "grounds": dict.fromkeys(datasets, GROUND), "recorded": {name: [250.0, 20.0] for name in datasets},
        "cells": {}, "budget_line": "budget 'full'", "command": "oat-gym bench", "started": time.time(),
    }  # fmt: skip
    members = (*cells, *extra)
    manifest["cells"] = {str(number): part.record["fingerprint"] for number, part in enumerate(members)}
    return Results(Setting("full", Question()), members, (manifest,), ())


@pytest.fixture(scope="module")
def analysis() -> Analysis:
    return Analysis(results_of({"adroit-door-human": True, "logs": False}))


def test_verdicts_follow_the_errors(analysis: Analysis) -> None:
    verdicts = {name: analysis.finding("adroit-door-human", name, "mean", "mae") for name in ERRORS if name != "none"}
    assert {name: found.improvement.verdict for name, found in verdicts.items()} == {
        "oat-paper": "helps", "jittering": "no evidence", "scaling": "hurts",
    }  # fmt: skip
    assert verdicts["oat-paper"].improvement.value == pytest.approx(60, abs=2)
    assert "lowers the error by" in sentence(verdicts["oat-paper"], of="OAT")
    assert sentence(verdicts["oat-paper"], of="OAT").endswith("helps.")
    assert analysis.finding("logs", "oat-paper", "mean", "mae") is None
    assert analysis.with_truth() == ("adroit-door-human",)
    worse = sentence(verdicts["scaling"], of="scaling")
    numbers = [float(part) for part in re.findall(r"-?\d+(?:\.\d+)?", worse.split("%", 1)[1].replace("95%", ""))]
    assert "raises the error by 120%" in worse and numbers[0] < 120 < numbers[1]  # the interval is of the same sign


def test_estimates_are_told_where_nobody_knows_the_truth(analysis: Analysis) -> None:
    table = estimates_table(analysis, "logs")
    assert table is not None
    assert table.header[2:9] == (*POLICIES[:6], "expert")
    assert table.header[9:] == ("seeds", "seeds apart", "moved by", "order kept")
    assert [row[:2] for row in table.rows] == [(family, name) for family in ("FQE", "IS") for name in ERRORS]
    assert "return 250 on average, discounted (standard error 20)" in table.caption
    assert "values from reset (5 states) starts" in table.caption
    rows = {row[:2]: row for row in table.rows}
    assert rows["FQE", "none"][-2:] == ("-", "-")
    moved = {name: float(rows["IS", name][-2]) for name in ERRORS if name != "none"}
    assert moved == pytest.approx({"oat-paper": 60, "jittering": 0, "scaling": 120}, abs=2)
    assert {row[-1] for row in table.rows if row[1] != "none"} == {"1.00"}  # errors that all policies share
    values = [part.values for part in analysis.cells("logs", "scaling", "IS")]
    assert rows["IS", "scaling"][2].startswith(f"{np.mean(values, axis=0)[0]:.0f} (")
    found = {(each.family, each.variant, each.policy): each for each in analysis.estimates("logs")}
    one = found["IS", "scaling", "p0"]
    assert one.low < one.value < one.high and one.seeds == 3
    assert one.deviation == pytest.approx(np.std([part[0] for part in values], ddof=1))
    apart = np.mean(np.std(values, axis=0, ddof=1))
    assert (rows["IS", "scaling"][-4], float(rows["IS", "scaling"][-3])) == ("3", pytest.approx(apart, rel=0.01))
    assert estimates_table(analysis, "elsewhere") is None
    names = {table.name for table in all_tables(analysis)}
    assert "estimates-logs" in names and "estimates-adroit-door-human" not in names


def test_estimates_are_compared_at_the_seeds_that_both_have() -> None:
    whole = results_of({"logs": False})
    far = cell("logs", "none", "IS", 9, error=9000.0, known=False)  # a seed that no other variant has
    kept = tuple(part for part in whole.cells if part.variant != "oat-paper" or part.seed == 0)
    partial = Analysis(dataclasses.replace(whole, cells=(*kept, far)))
    rows = {row[:2]: row for row in estimates_table(partial, "logs").rows}
    assert float(rows["IS", "scaling"][-2]) == pytest.approx(120, abs=2)
    assert rows["IS", "none"][-4] == "4" and rows["IS", "oat-paper"][-4:-2] == ("1", "-")
    assert "4 seeds (" in estimates_table(partial, "logs").caption


def test_a_mean_of_fewer_estimators_is_said_to_be_so() -> None:
    whole = results_of({"adroit-door-human": True, "maze2d-umaze": True})
    lost = ("adroit-door-human", "scaling", "IS")
    kept = tuple(part for part in whole.cells if (part.dataset, part.variant, part.family) != lost)
    partial = Analysis(dataclasses.replace(whole, cells=kept))
    rows = {row[0]: row for row in help_table(partial, "adroit-door-human", "mae").rows}
    assert rows["scaling"][2].endswith("[1 of 2 estimators]") and "[" not in rows["jittering"][2]
    overview = {row[0]: row for row in overview_table(partial, "mae").rows}
    assert overview["scaling"][5].endswith("[1 of 2 estimators]") and "[" not in overview["scaling"][6]


def test_a_variant_that_was_not_tried_on_a_dataset_has_no_row_there() -> None:
    whole = results_of({"adroit-door-human": True})
    kept = tuple(cell for cell in whole.cells if cell.variant != "scaling")
    table = dataset_table(Analysis(Results(whole.setting, kept, whole.manifests, ())), "adroit-door-human")
    assert {row[1] for row in table.rows} == {"none", "oat-paper", "jittering"}


def test_the_logs_own_average_stands_below_the_estimators(analysis: Analysis) -> None:
    off = float(np.abs(TRUE - 250).mean())
    assert analysis.floor("adroit-door-human") == pytest.approx(off) and analysis.floor("logs") is None
    *rows, last = dataset_table(analysis, "adroit-door-human").rows
    assert last == ("mean recorded return", "none", f"{off:.0f}", "-", "-", "-")
    assert not any("recorded" in cell for row in rows for cell in row)
    told = floor_sentence(analysis, "adroit-door-human")
    assert told in make_page((analysis.results,))
    assert (
        "250 on average, discounted (standard error 20)" in told
        and f"off by {off:.0f}, further than every estimator" in told
    )
    far = [cell("adroit-door-human", "none", "IS", seed, error=500.0) for seed in range(3)]
    whole = results_of({"adroit-door-human": True})
    kept = (*(part for part in whole.cells if (part.variant, part.family) != ("none", "IS")), *far)
    worse = Analysis(Results(whole.setting, kept, whole.manifests, ()))
    assert floor_sentence(worse, "adroit-door-human").endswith("further off without augmentation: IS.")
    older = [{name: told for name, told in whole.manifests[0].items() if name != "recorded"}]
    unknown = Analysis(Results(whole.setting, whole.cells, tuple(older), ()))
    assert unknown.floor("adroit-door-human") is None and floor_sentence(unknown, "adroit-door-human") == ""


def test_variants_are_compared_with_one_another_in_pairs(analysis: Analysis) -> None:
    table = help_table(analysis, "adroit-door-human", "mae", baseline="oat-paper")
    rows = {row[0]: dict(zip(table.header, row, strict=True)) for row in table.rows}
    assert table.name == "against-oat-paper-mae-adroit-door-human"
    assert "no augmentation" not in table.caption
    assert "better than oat-paper" in table.caption and "over oat-paper" in table.caption
    assert set(rows) == {"jittering", "scaling"}
    assert all(row["mean"].endswith(") worse") and row["FQE"].endswith(") worse") for row in rows.values())
    place = ("adroit-door-human", "mean", "mae")
    one = analysis.finding(place[0], "scaling", *place[1:], baseline="oat-paper").improvement
    other = analysis.finding(place[0], "oat-paper", *place[1:], baseline="scaling").improvement
    assert one.effect == pytest.approx(-other.effect)
    assert one.standard_error == pytest.approx(other.standard_error)
    assert help_table(analysis, "adroit-door-human", "mae", baseline="oat") is None  # not measured


def test_a_family_that_failed_on_one_side_is_left_out_of_the_mean_of_both() -> None:
    whole = results_of({"adroit-door-human": True})
    kept = tuple(c for c in whole.cells if not (c.variant == "scaling" and c.family == "IS"))
    found = Analysis(Results(whole.setting, kept, whole.manifests, ())).finding(
        "adroit-door-human", "scaling", "mean", "mae"
    )
    assert found.families == ("FQE",)
    few = tuple(c for c in whole.cells if c.variant != "scaling" or c.seed == 0)
    assert (
        "3 seeds (1 for scaling)"
        in dataset_table(Analysis(Results(whole.setting, few, whole.manifests, ())), "adroit-door-human").caption
    )
    partial = Analysis(Results(whole.setting, kept, whole.manifests, ()))
    (group, _), *_ = groups_of(partial)
    told = {line.split()[0]: line for line in best_sentences(partial, group) if "error" in line}
    assert "FQE only" in told["scaling"] and "only" not in told["jittering"]
    assert "FQE only" in make_page((partial.results,))
    assert found.improvement.before == pytest.approx(100, abs=2)


def test_the_papers_numbers_stand_beside_ours(analysis: Analysis) -> None:
    table = paper_table(analysis, "human", "mae")
    rows = {(row[0], row[1]): dict(zip(table.header, row, strict=False)) for row in table.rows}
    assert table.header[2:6] == ("pen", "paper", "door", "paper")
    by_place = {(row[0], row[1]): row for row in table.rows}
    oat = by_place["FQE", "OAT (oat-paper)"]
    assert oat[4].startswith("40 ±") or float(oat[4].split()[0]) == pytest.approx(40, abs=1)
    assert oat[4].endswith("+")
    assert oat[5] == "255 ± 17"
    assert oat[2] == "" and oat[3] == "540 ± 17"  # pen was not measured; the paper has it
    assert by_place["FQE", "NoAug. (none)"][5] == "389 ± 60"
    assert rows
    assert paper_table(analysis, "expert", "mae") is None


def test_the_papers_averages_agree_with_its_single_tables() -> None:
    """Errors and regrets of table 2 are the means of tables 3, 5 and 6; the paper's claims follow from them."""
    for metric in ("mae", "regret_at_1", "regret_at_5"):
        for method in paper.METHODS:
            for task in paper.TASKS:
                single = [paper.printed("human", metric, each, method, task).mean for each in paper.ESTIMATORS]
                assert paper.average("human", metric, method, task).mean == pytest.approx(np.mean(single), abs=0.01)
    claims = {"pen": 71, "door": 36, "hammer": 45, "relocate": 76}
    for task, percent in claims.items():
        before, after = (paper.average("human", "mae", method, task).mean for method in ("NoAug.", "OAT"))
        assert 100 * (before - after) / before == pytest.approx(percent, abs=0.6)
    with pytest.raises(ConfigurationError, match="no"):
        paper.printed("human", "mae", "FQE", "magic", "door")


def test_all_tables_are_written_and_hold_what_they_say(analysis: Analysis, tmp_path: Path) -> None:
    tables = all_tables(analysis)
    names = {table.name for table in tables}
    assert {"table-02", "table-03", "table-04", "dataset-adroit-door-human"} <= names
    assert "table-01-adroit-door-human" in names  # one of the policies is called expert
    helped = next(table for table in tables if table.name == "helped-mae-adroit-door-human")
    cells = {row[0]: dict(zip(helped.header, row, strict=True)) for row in helped.rows}
    assert set(cells) == {"oat-paper", "jittering", "scaling"}
    assert cells["oat-paper"]["FQE"].endswith(") helps") and cells["scaling"]["mean"].endswith(") hurts")
    assert float(cells["oat-paper"]["FQE"].split()[0]) == pytest.approx(60, abs=2)
    assert cells["jittering"]["seeds"] == "3" and cells["jittering"]["mean"].endswith(")")
    for table in tables:
        assert all(len(row) == len(table.header) for row in table.rows)
        assert "3 seeds" in table.caption or table.name.startswith("table-01")
    paths = write_tables(tables, tmp_path)
    assert (tmp_path / "tables.md") in paths
    assert "Table 3." in (tmp_path / "tables.md").read_text()


def test_the_overview_has_every_dataset_and_counts_verdicts() -> None:
    whole = results_of({"adroit-door-human": True, "line": True, "logs": False})
    kept = tuple(
        part
        for part in whole.cells
        if (part.dataset, part.variant) != ("line", "scaling")
        and (part.dataset, part.variant, part.seed > 0) != ("line", "jittering", True)
    )
    table = overview_table(Analysis(Results(whole.setting, kept, whole.manifests, ())), "mae")
    rows = {row[0]: dict(zip(table.header[1:], row[1:], strict=True)) for row in table.rows}
    assert table.header == ("variant", "over all", "another task", "helps on", "hurts on", "adroit-door-human", "line")
    assert rows["scaling"]["over all"] == rows["scaling"]["adroit-door-human"]  # of the one that was measured
    assert rows["jittering"]["over all"] == rows["jittering"]["adroit-door-human"]  # one seed does not count
    counts = {name: (row["helps on"], row["hurts on"]) for name, row in rows.items()}
    expected = {"oat-paper": ("2 of 2", "0 of 2"), "jittering": ("0 of 1", "0 of 1"), "scaling": ("0 of 1", "1 of 1")}
    assert counts == expected
    assert rows["oat-paper"]["line"].endswith(") helps") and rows["scaling"]["line"] == "-"
    assert rows["jittering"]["line"].endswith("(one seed)")
    assert overview_table(Analysis(results_of({"line": True})), "mae") is None
    against = overview_table(Analysis(whole), "mae", baseline="oat-paper")
    assert against.header[3:5] == ("better on", "worse on") and {row[0] for row in against.rows} == {
        "jittering",
        "scaling",
    }
    assert all(row[1].endswith(") worse") for row in against.rows)


def test_datasets_of_one_task_count_as_one() -> None:
    whole = Analysis(results_of({"adroit-door-human": True, "adroit-door-expert": True}))
    one = whole.finding("adroit-door-human", "oat-paper", "mean", "mae").improvement
    both = whole.over_all("oat-paper", "mean", "mae")
    assert both.datasets == ("adroit-door-human", "adroit-door-expert")
    assert both.improvement.standard_error == pytest.approx(one.standard_error)
    assert whole.over_all("oat", "mean", "mae") is None
    some = whole.over_all("oat-paper", "FQE", "mae", datasets=["adroit-door-expert"])
    assert some.improvement == whole.finding("adroit-door-expert", "oat-paper", "FQE", "mae").improvement


def test_the_mean_over_tasks_is_told_for_these_and_for_another(analysis: Analysis) -> None:
    """The second interval is of how much the tasks differ; tasks that share recorded episodes are one."""
    found = results_of({"adroit-door-human": True, "maze2d-umaze": True, "maze2d-umaze-d4rl": True})
    cells = (dataclasses.replace(part, task=part.dataset) for part in found.cells)
    whole = Analysis(dataclasses.replace(found, cells=tuple(cells)))
    these = whole.over_all("oat-paper", "FQE", "mae").improvement
    another = whole.over_all("oat-paper", "FQE", "mae", between=True).improvement
    assert another.value == pytest.approx(these.value)
    assert another.degrees == 1  # door and maze: two tasks
    assert another.parts.policies == another.parts.seeds == 0
    alone = analysis.over_all("oat-paper", "FQE", "mae", between=True).improvement
    assert math.isnan(alone.low) and alone.verdict == "no evidence"


def test_a_mean_over_estimators_is_of_the_seeds_that_all_have() -> None:
    whole = results_of({"adroit-door-human": True})
    far = cell("adroit-door-human", "oat-paper", "FQE", 3, error=9000.0)  # IS of this seed was not finished
    table = dataset_table(Analysis(results_of({"adroit-door-human": True}, extra=(far,))), "adroit-door-human")
    without = dataset_table(Analysis(whole), "adroit-door-human")
    rows, expected = ({row[:2]: row[2:] for row in part.rows} for part in (table, without))
    assert rows["mean", "oat-paper"] == expected["mean", "oat-paper"]
    assert rows["FQE", "oat-paper"] != expected["FQE", "oat-paper"]
    assert "4 seeds (3 for none, 3 for jittering, 3 for scaling)" in table.caption


def test_what_cannot_change_is_uncertain_by_nothing(analysis: Analysis) -> None:
    one = analysis.finding("adroit-door-human", "oat-paper", "FQE", "mae").improvement
    same = dataclasses.replace(one, parts=Parts(0.0, 0.0, 0.0, 0.0))
    assert (same.parts.main, same.decides, one.decides) == ("-", False, True)
    assert not dataclasses.replace(one, n_seeds=1).decides


def test_a_policy_without_a_true_value_leaves_the_dataset_without_errors(tmp_path: Path) -> None:
    member = cell("adroit-door-human", "none", "FQE", 0, error=3.0)
    truths = {"adroit-door-human": {name: [1.0, 0.1] for name in member.policies[1:]}}
    manifest = {"grounds": {"adroit-door-human": member.record["config"]["ground"]}, "truths": truths}
    (known,) = with_truth([member], [manifest])
    assert not known.knows_truth and np.isfinite(known.true[1:]).all()
    assert known.record["truth_note"] == member.record["truth_note"]


def test_a_note_on_true_values_is_of_the_values_that_are_shown() -> None:
    member = cell("adroit-door-human", "none", "FQE", 0, error=3.0)
    member = dataclasses.replace(member, record=dict(member.record) | {"truth_note": "Of 10 roll-outs. A doubt."})
    own = {name: [float(value), 0.0] for name, value in zip(member.policies, member.true, strict=True)}
    ground = {"adroit-door-human": member.record["config"]["ground"]}
    notes = {"adroit-door-human": "Of 1,000 roll-outs."}
    other = {name: [1.0, 0.1] for name in own}
    for truth, note in ((own, "Of 10 roll-outs. A doubt."), (other, "Of 1,000 roll-outs.")):
        manifest = {"grounds": ground, "truths": {"adroit-door-human": truth}, "truth_notes": notes}
        (known,) = with_truth([member], [manifest])
        assert known.record["truth_note"] == note


def test_tidy_rows_keep_every_number(analysis: Analysis, tmp_path: Path) -> None:
    results = analysis.results
    rows = estimate_rows(results)
    assert len(rows) == 7 * len(results.cells)
    first = results.cells[0]
    assert rows[0]["value"] == first.values[0]
    assert rows[0]["low"] < rows[0]["value"] < rows[0]["high"]
    by_cell = cell_rows(results)
    assert by_cell[0]["mae"] == pytest.approx(np.abs(first.values - TRUE).mean())
    assert all(math.isnan(row["mae"]) for row in by_cell if row["dataset"] == "logs")
    assert "NaN" not in to_csv(by_cell) and "nan" not in to_csv(by_cell).split("\n", 1)[1]
    paths = {path.name for path in write_tidy(analysis, tmp_path)}
    assert {f"{name}.{kind}" for name in ("estimates", "cells", "improvements") for kind in ("csv", "parquet")} == paths
    assert pq.read_table(tmp_path / "estimates.parquet").num_rows == len(rows)


def test_improvements_come_back_from_their_file(analysis: Analysis, tmp_path: Path) -> None:
    """Means over tasks and verdicts of the rows of a file are those of the cells."""
    write_tidy(analysis, tmp_path)
    with (tmp_path / "improvements.csv").open(newline="") as file:
        again = [improvement_of(row) for row in csv.DictReader(file)]
    expected = list(analysis.comparisons())
    assert len(again) == len(expected) > len(list(analysis.all_findings()))
    for one, other in zip(again, expected, strict=True):
        assert dataclasses.replace(one, improvement=other.improvement) == other
        numbers = [
            [*dataclasses.astuple(found.improvement.parts), *dataclasses.astuple(found.improvement)[1:7]]
            for found in (one, other)
        ]
        assert numbers[0] == pytest.approx(numbers[1], rel=1e-6, nan_ok=True)
        assert one.improvement.verdict == other.improvement.verdict
    assert {row["baseline"] for row in improvement_rows(analysis)} == {"none", "oat-paper"}


def test_the_page_says_it_all_and_loads_nothing(analysis: Analysis) -> None:
    failed = cell("adroit-door-human", "oat-paper", "IS", 9, error=0, reason="TrainingError: <diverged>")
    page = make_page((Analysis(results_of({"adroit-door-human": True, "logs": False}, extra=(failed,))).results,))
    assert not re.search(r"""(src|href)\s*=\s*["'](?!data:)""", page)
    assert "<script" not in page
    assert "url(" not in page
    assert "minari download D4RL/pen/human-v2" in page
    assert "No error can be computed here" in page
    assert "Nobody knows." in page
    assert "order kept" in page
    assert "&lt;diverged&gt;" in page  # what cells say is text, never markup
    for word in ("helps", "hurts", "no evidence"):
        assert word in page


def test_one_seed_is_said_to_be_no_evidence() -> None:
    page = make_page((results_of({"adroit-door-human": True}, seeds=1),))
    assert "One seed cannot tell" in page
    assert 'class="good"' not in page


def test_a_cell_comes_back_as_it_was_and_damage_is_seen(tmp_path: Path) -> None:
    one, path = cell("logs", "none", "IS", 0, error=3.0), tmp_path / "a" / "cell.safetensors"
    write_result(path, one)
    again = read_result(path)
    np.testing.assert_array_equal(again.values, one.values)
    np.testing.assert_allclose(again.replicates, one.replicates, rtol=1e-6)
    assert again.record == one.record
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(CacheError, match="damaged"):
        read_result(path)


def test_pictures_name_what_was_measured_on_some_datasets_only() -> None:
    levels = {f"adroit-{task}-{level}": True for task in ("pen", "door") for level in ("human", "expert")}
    whole = results_of(levels)
    kept = tuple(
        part
        for part in whole.cells
        if (part.variant, part.dataset) != ("scaling", "adroit-pen-human")
        and (part.variant, part.dataset.endswith("expert")) != ("jittering", True)
    )
    partial = Analysis(Results(whole.setting, kept, whole.manifests, ()))
    (group, level), *_ = groups_of(partial)
    panels = bar_panels(partial, group, family="mean", level=level)
    assert all(panel.names == ["oat-paper", "jittering", "scaling (1 of 2)"] for panel in panels)
    names = {level: [name for name in levels if name.endswith(level)] for level in ("human", "expert")}
    found = level_panels(partial, names)  # jittering was tried at one level alone
    assert found and all(list(panel) == ["oat-paper", "scaling (1, 2 tasks)"] for panel in found.values())
    assert by_level(partial) is not None
    assert by_level(Analysis(results_of({"adroit-door-human": True}))) is None


def test_bars_draw_what_was_measured(analysis: Analysis) -> None:
    names = [name for name in ERRORS if name != "none"]
    changes = [analysis.finding("adroit-door-human", name, "mean", "mae").improvement for name in names]
    panels = [figures.Panel("error", "percent", names, [*changes[:2], None], [10.0, math.nan, math.nan])]
    drawn = figures.improvement_bars(panels, title="x")
    axes = drawn.axes[0]
    assert [patch.get_width() for patch in axes.patches] == pytest.approx([change.value for change in changes[:2]])
    assert any("not measured" in text.get_text() for text in axes.texts)
    assert figures.to_png(drawn).startswith(b"\x89PNG")
    with pytest.raises(ConfigurationError, match="at least one panel"):
        figures.improvement_bars([], title="x")
    assert "mae" in METRICS
