"""From cells to tables: numbers that are known beforehand come out where they belong."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from oat_gym.benchmark import paper
from oat_gym.benchmark.analysis import Analysis
from oat_gym.benchmark.estimates import estimates_table
from oat_gym.benchmark.grid import write_tables
from oat_gym.benchmark.results import Results
from oat_gym.benchmark.tables import (
    all_tables,
    dataset_table,
    help_table,
    overview_table,
    paper_table,
    table_1,
    table_2,
)
from oat_gym.errors import ConfigurationError
from tests.benchmark.known import ERRORS, POLICIES, cell, results_of


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


def test_the_papers_numbers_stand_beside_ours(analysis: Analysis) -> None:
    table = paper_table(analysis, "human", "mae")
    assert table.header[2:6] == ("pen", "paper", "door", "paper")
    by_place = {(row[0], row[1]): row for row in table.rows}
    oat = by_place["FQE", "OAT (oat-paper)"]
    assert oat[4].startswith("40 ±") or float(oat[4].split()[0]) == pytest.approx(40, abs=1)
    assert oat[4].endswith("+")
    assert oat[5] == "255 ± 17"
    assert oat[2] == "" and oat[3] == "540 ± 17"  # pen was not measured; the paper has it
    assert by_place["FQE", "NoAug. (none)"][5] == "389 ± 60"
    assert paper_table(analysis, "expert", "mae") is None
    assert table.caption.endswith("Not measured here: pen, relocate, hammer.")


def test_table_2_has_the_papers_numbers_where_nothing_was_measured(analysis: Analysis) -> None:
    table = table_2(analysis)
    rows = {row[:2]: row[2:] for row in table.rows}
    assert rows["pen", "OAT (oat-paper)"][:4] == ("", "887", "", "0.09")
    ours, theirs = rows["door", "NoAug. (none)"][:2]
    assert float(ours) == pytest.approx(100, abs=2) and theirs == "604"
    assert table.caption.endswith("Not measured here: pen, relocate, hammer.")


def test_a_table_of_the_paper_has_no_rows_of_what_was_tried_elsewhere() -> None:
    whole = results_of({"adroit-door-human": True, "line": True})
    ours = tuple(dataclasses.replace(c, variant="oat-cut") for c in whole.cells if c.variant == "scaling")
    cells = (*(c for c in whole.cells if c.dataset == "line" or c.variant != "scaling"), *ours)
    manifest = {**whole.manifests[0], "jobs_order": [*ERRORS, "oat-cut"]}

    def methods(*dropped: str) -> set[str]:
        kept = tuple(c for c in cells if c.variant not in dropped or c.dataset == "line")
        found = Analysis(Results(whole.setting, kept, (manifest,), ()))
        return {row[1] for row in paper_table(found, "human", "mae").rows}

    assert methods() == {"NoAug. (none)", "OAT (oat-paper)", "Jittering", "Scaling", "oat-cut"}  # the paper has Scaling
    assert methods("oat-cut") == {"NoAug. (none)", "OAT (oat-paper)", "Jittering", "Scaling"}


def test_table_1_has_the_tests_of_the_replicates(analysis: Analysis) -> None:
    """t and p against the expert, the means over seeds of importance sampling's replicates on both sides."""
    table = table_1(analysis, "adroit-door-human")
    rows = {row[:2]: row[2:] for row in table.rows}
    draws = np.mean([cell.replicates for cell in analysis.cells("adroit-door-human", "none", "IS")], axis=0)
    welch = stats.ttest_ind(draws[2], draws[-1], equal_var=False)
    assert rows["NoAug. (none)", "paper"][2] == f"{welch.statistic:.2f} ({welch.pvalue:.2f})"
    paired = draws[2] - draws[-1]
    t = paired.mean() / paired.std(ddof=1)
    assert rows["NoAug. (none)", "paired"][2] == f"{t:.2f} ({2 * stats.t.sf(abs(t), 24):.2f})"  # 25 episodes
    assert rows["NoAug. (none)", "paper"][-1] == "7.24 (0.00); 7.07 (0.00); -4.48 (0.00)"
    assert rows["Empirical result", "roll-outs"][:6] == ("exact",) * 6
    assert table_1(analysis, "line") is None


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
