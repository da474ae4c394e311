"""Published numbers: tables come out of them as they do of the cells, and a new run adds to them and loses nothing."""

import dataclasses
import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest

from oat_gym.benchmark.analysis import Analysis
from oat_gym.benchmark.results import Results
from oat_gym.benchmark.store import CellResult
from oat_gym.benchmark.tables import all_tables
from tests.benchmark.known import ERRORS, cell, results_of

DATASETS = {
    "adroit-door-human": True,
    "maze2d-umaze": True,
    "maze2d-umaze-d4rl": True,
    "tutoring-smartprimer": False,
}
PUBLISHED = Path(__file__).parent / "results" / "benchmark"


def load(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, Path(__file__).with_name(f"{name}.py"))
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def script() -> ModuleType:
    return load("publish")


def run_of(*cells: CellResult) -> Analysis:
    """A run of one dataset with some cells in the place of its own."""
    whole = results_of({"adroit-door-human": True})
    places = {(part.variant, part.family, part.seed) for part in cells}
    others = [part for part in whole.cells if (part.variant, part.family, part.seed) not in places]
    return Analysis(dataclasses.replace(whole, cells=(*others, *cells)))


def only(analysis: Analysis, *variants: str) -> Analysis:
    results: Results = analysis.results
    cells = tuple(part for part in results.cells if part.variant in variants)
    return Analysis(dataclasses.replace(results, cells=cells))


def improvements(numbers: object, variant: str) -> list[dict]:
    return [row for row in numbers.improvements if row["variant"] == variant]  # type: ignore[attr-defined]


def test_tables_of_published_numbers_are_those_of_the_cells(script: ModuleType, tmp_path: Path) -> None:
    analysis = Analysis(results_of(DATASETS))
    script.Numbers.of(analysis).write(tmp_path)
    published = script.Published(script.Numbers.read(tmp_path))
    expected = {table.name: table for table in all_tables(analysis) if not table.name.startswith("table-01")}
    found = {table.name: table for table in all_tables(published)}
    assert set(found) == set(expected)
    for name, table in found.items():
        assert table.header == expected[name].header
        assert sorted(table.rows) == sorted(expected[name].rows), name
    assert "estimates-tutoring-smartprimer" in found


def test_a_run_adds_its_variants_and_leaves_the_others(script: ModuleType) -> None:
    whole = Analysis(results_of({"adroit-door-human": True}))
    old = script.Numbers.of(only(whole, "none", "oat-paper"))
    added = script.merged(old, script.Numbers.of(only(whole, "none", "jittering", "scaling")))
    assert improvements(added, "oat-paper") == improvements(old, "oat-paper")
    assert {row["variant"] for row in added.cells} == set(ERRORS)
    assert len(added.cells) == len(script.Numbers.of(whole).cells)
    assert {row["baseline"] for row in improvements(added, "jittering")} == {"none"}  # that run had no OAT
    again = script.merged(added, script.Numbers.of(only(whole, "none", "jittering")))
    assert sorted(map(str, again.cells)) == sorted(map(str, added.cells))


def test_a_run_of_published_variants_adds_comparisons_that_were_not_there(script: ModuleType) -> None:
    whole = Analysis(results_of({"adroit-door-human": True}))
    old = script.merged(
        script.Numbers.of(only(whole, "none", "oat-paper")), script.Numbers.of(only(whole, "none", "jittering"))
    )
    assert {row["baseline"] for row in improvements(old, "jittering")} == {"none"}
    more = script.merged(old, script.Numbers.of(only(whole, "oat-paper", "none", "jittering")))
    assert {row["baseline"] for row in improvements(more, "jittering")} == {"none", "oat-paper"}
    assert {str(row) for row in old.improvements} <= {str(row) for row in more.improvements}
    two = [dict(row) | {"seeds": "2"} for row in more.improvements if row["baseline"] == "oat-paper"]
    of_two = [row for row in more.improvements if row["baseline"] == "none"] + two
    again = script.merged(dataclasses.replace(more, improvements=tuple(of_two)), script.Numbers.of(whole))
    assert {str(row) for row in more.improvements} <= {str(row) for row in again.improvements}  # by three seeds again
    fewer = [part for part in whole.results.cells if part.seed > 0 or part.variant != "oat-paper"]
    two_seeds = Analysis(dataclasses.replace(whole.results, cells=tuple(fewer)))
    assert script.merged(old, script.Numbers.of(only(two_seeds, "oat-paper", "none", "jittering"))) == old


def test_estimates_are_of_the_newest_run_with_all_seeds(script: ModuleType) -> None:
    whole = Analysis(results_of({"tutoring-smartprimer": False}))
    numbers = script.Numbers.of(whole)
    bare = dataclasses.replace(numbers, estimates=())
    assert {row["variant"] for row in numbers.estimates} == set(ERRORS)
    more = script.merged(bare, script.Numbers.of(only(whole, "none", "scaling")))
    assert {row["variant"] for row in more.estimates} == {"none", "scaling"}
    assert len(script.merged(more, numbers).estimates) == len(numbers.estimates)
    fewer = Analysis(dataclasses.replace(whole.results, cells=tuple(c for c in whole.results.cells if c.seed > 0)))
    assert script.merged(bare, script.Numbers.of(fewer)) == bare
    newer = [
        dataclasses.replace(c, record=dict(c.record) | {"environment": {"commit": "new"}}) for c in whole.results.cells
    ]
    again = script.Numbers.of(Analysis(dataclasses.replace(whole.results, cells=tuple(newer))))
    assert {row["commit"] for row in script.merged(numbers, again).cells} == {"new"}


def test_more_seeds_and_other_settings_replace_what_is_published(script: ModuleType) -> None:
    whole = Analysis(results_of({"adroit-door-human": True}))
    old = script.Numbers.of(whole)
    fourth = [
        cell("adroit-door-human", name, family, 3, error=ERRORS[name])
        for name in ("none", "scaling")
        for family in ("FQE", "IS")
    ]
    more = script.merged(old, script.Numbers.of(only(run_of(*fourth), "none", "scaling")))
    assert {row["seeds"] for row in improvements(more, "scaling") if row["baseline"] == "none"} == {"4"}
    assert {row["seeds"] for row in improvements(more, "jittering")} == {"3"}
    over_oat = [row for row in improvements(more, "scaling") if row["baseline"] == "oat-paper"]
    assert over_oat and over_oat == [row for row in old.improvements if row in over_oat]  # that run had no OAT
    part = cell("adroit-door-human", "oat-paper", "FQE", 0, error=1.0)
    part = dataclasses.replace(part, record=dict(part.record) | {"fingerprint": "other"})
    other = script.merged(old, script.Numbers.of(only(run_of(part), "none", "oat-paper")))
    assert improvements(other, "oat-paper") != improvements(old, "oat-paper")
    assert {row["baseline"] for row in improvements(other, "scaling")} == {"none"}  # those over the former are gone


def test_a_method_that_was_corrected_replaces_its_rows(script: ModuleType) -> None:
    """Its configuration does not tell; that the same cells without augmentation come out as before does."""
    old = script.Numbers.of(Analysis(results_of({"adroit-door-human": True})))
    corrected = [cell("adroit-door-human", "oat-paper", "FQE", seed, error=10.0) for seed in range(3)]
    run = only(run_of(*corrected), "none", "oat-paper")
    new = script.merged(old, script.Numbers.of(run))
    assert improvements(new, "oat-paper") == improvements(script.Numbers.of(run), "oat-paper")
    assert improvements(new, "oat-paper") != improvements(old, "oat-paper")
    assert {row["baseline"] for row in improvements(new, "scaling")} == {"none"}  # those over the former are gone
    elsewhere = [cell("adroit-door-human", "none", "FQE", seed, error=99.0) for seed in range(3)]
    rounded_otherwise = only(run_of(*corrected, *elsewhere), "none", "oat-paper")
    assert script.merged(old, script.Numbers.of(rounded_otherwise)) == old


def test_another_ground_leaves_out_all_that_was_published_of_a_dataset(script: ModuleType) -> None:
    old = script.Numbers.of(Analysis(results_of(DATASETS)))
    ground = [cell("adroit-door-human", "none", "FQE", seed, error=50.0) for seed in range(3)]
    ground = [dataclasses.replace(c, record=dict(c.record) | {"fingerprint": f"other{c.seed}"}) for c in ground]
    new = script.merged(old, script.Numbers.of(only(run_of(*ground), "none", "scaling")))
    assert {row["variant"] for row in new.cells if row["dataset"] == "adroit-door-human"} == {"none", "scaling"}
    assert {row["variant"] for row in new.cells if row["dataset"] == "maze2d-umaze"} == set(ERRORS)


def test_table_1_keeps_rows_of_methods_that_a_run_does_not_have(script: ModuleType) -> None:
    head = ("method", "test", "a")
    former = (("NoAug. (none)", "paper", "1"), ("Jittering", "paper", "2"), ("Empirical result", "roll-outs", "3"))
    text = script.Table("table-01-line", "Before", head, former).to_markdown()
    now = script.Table("table-01-line", "Now", head, (("NoAug. (none)", "paper", "4"), ("SPAWNER", "paper", "5")))
    found = script.with_former_rows(now, text)
    assert (found.caption, found.rows) == ("Now", (now.rows[0], now.rows[1], former[1], former[2]))
    assert script.with_former_rows(now, "") == now
    assert script.with_former_rows(dataclasses.replace(now, header=(*head[:2], "b")), text).rows == now.rows


def test_table_1_is_of_the_cells_that_are_published(script: ModuleType) -> None:
    whole = Analysis(results_of({"adroit-door-human": True}))
    published = script.Published(script.Numbers.of(only(whole, "none", "scaling")))
    fewer = [c for c in whole.results.cells if c.seed > 0 or c.variant != "scaling"]
    run = Analysis(dataclasses.replace(whole.results, cells=tuple(fewer)))
    assert {c.variant for c in script.published_part(run, published).results.cells} == {"none"}
    assert {c.variant for c in script.published_part(whole, published).results.cells} == {"none", "scaling"}


def test_what_is_published_is_what_its_numbers_say(script: ModuleType) -> None:
    """Every committed table is that of the committed numbers; table 1 needs estimates and is left out."""
    published = script.Published(script.Numbers.read(PUBLISHED))
    tables = script.tables_of(published, (), PUBLISHED)
    assert len(tables) > 60
    for table in tables:
        assert (PUBLISHED / f"{table.name}.md").read_text() == table.to_markdown(), table.name
    written = {path.stem for path in PUBLISHED.glob("*.md") if path.stem.startswith(script.KEPT)}
    assert written == {table.name for table in tables} | {"table-01-tutor-sim"}


def test_what_nothing_published_is_of_is_removed(script: ModuleType, tmp_path: Path) -> None:
    script.Numbers.of(Analysis(results_of(DATASETS))).write(tmp_path)
    numbers = script.Numbers.read(tmp_path)
    others = ("README.md", "table-01-tutor-sim.md", "estimates-maze2d-umaze-d4rl.png")
    for name in (*others, "bars-sepsis-sim.png", "dataset-sepsis-sim.md"):
        (tmp_path / name).write_text("kept or not")
    assert script.publish((), tmp_path) == numbers
    there = {path.name for path in tmp_path.iterdir()}
    assert {*others, "bars-maze2d-umaze.png", "dataset-maze2d-umaze.md", "cells.csv"} <= there
    assert there.isdisjoint({"bars-sepsis-sim.png", "dataset-sepsis-sim.md"})


@pytest.mark.parametrize(("name", "table"), [("README.md", "by_dataset"), ("default.md", "of_the_default")])
def test_the_tables_that_are_read_first_are_what_the_published_numbers_say(
    script: ModuleType, name: str, table: str
) -> None:
    load("reread")
    tell, text = load("tell"), (PUBLISHED / name).read_text()
    rows = getattr(tell, table)(script.Published(script.Numbers.read(PUBLISHED)))
    assert len(rows.splitlines()) >= 2 + 16
    assert tell.replaced(text, rows) == text
    first = rows.splitlines()[2]
    assert tell.replaced(text.replace(first, first.replace("(", "(9", 1)), rows) == text
