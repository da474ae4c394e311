"""From cells to improvements, files, pictures and the page: what is known beforehand comes out."""

import csv
import dataclasses
import math
import re
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from oat_gym.benchmark import figures
from oat_gym.benchmark.analysis import Analysis
from oat_gym.benchmark.improvement import Parts
from oat_gym.benchmark.page import make_page
from oat_gym.benchmark.results import Results, with_truth
from oat_gym.benchmark.store import read_result, write_result
from oat_gym.benchmark.story import (
    bar_panels,
    best_sentences,
    by_level,
    floor_sentence,
    groups_of,
    level_panels,
    sentence,
)
from oat_gym.benchmark.tables import dataset_table
from oat_gym.benchmark.tidy import cell_rows, estimate_rows, improvement_of, improvement_rows, to_csv, write_tidy
from oat_gym.errors import CacheError, ConfigurationError
from tests.benchmark.known import ERRORS, TRUE, cell, results_of


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
    verdicts = {"oat-paper": ("good", "helps"), "jittering": ("", "no evidence"), "scaling": ("bad", "hurts")}
    for name, (style, word) in verdicts.items():  # of the error, the first column
        row = re.search(rf"<tr><td>{name}</td><td><span class=\"(\w*)\">([\w ]+)</span>", page)
        assert row and row.group(2) == word and (row.group(1) == style or not style)


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


def test_true_values_and_trajectories_are_drawn_as_they_are() -> None:
    values, errors = np.array([1.0, 3.0, -2.0]), np.array([0.1, 0.0, math.nan])  # exact values have no error
    (axes,) = figures.returns_bars(["a", "b", "c"], values, errors, title="x").axes
    assert [patch.get_width() for patch in axes.patches] == pytest.approx(values)
    assert [text.get_text() for text in axes.get_yticklabels()] == ["a", "b", "c"]
    points = np.arange(12.0).reshape(6, 2)
    episode, made = np.array([0, 0, 0, 4, 4, 4]), np.array([False, True, True, False, False, True])
    arrays = {"real": points, "real_episode": episode, "real_generated": np.zeros(6, dtype=bool)}
    arrays |= {"synthetic": points + 1, "synthetic_episode": episode, "synthetic_generated": made}
    drawn = figures.coverage(arrays, labels=("x", "y"), title="t", walls=np.array([[0.0, 0.0, 1.0, 1.0]]))
    recorded, augmented = drawn.axes
    assert "2 trajectories" in recorded.get_title() and len(recorded.patches) == 1
    coloured = [np.isfinite(line.get_ydata()).sum() for line in augmented.lines[1::2]]
    assert coloured == [2, 1] and not any(np.isfinite(line.get_ydata()).any() for line in recorded.lines[1::2])
    np.testing.assert_array_equal(augmented.lines[0].get_xydata(), points[:3] + 1)


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
