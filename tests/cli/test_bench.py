"""`oat-gym bench` and `oat-gym report` as their user meets them."""

import csv
import re
from pathlib import Path

import pytest
from typer.testing import CliRunner

from oat_gym import cli, domains
from oat_gym.benchmark import budget, protocol
from oat_gym.errors import ConfigurationError, DatasetNotFoundError
from tests.benchmark import tiny


@pytest.fixture
def tiny_suite(monkeypatch: pytest.MonkeyPatch) -> None:
    """Add the domain of the tests to the installed ones, and its suite."""
    monkeypatch.setattr(domains, "DATASETS", {**domains.DATASETS, **tiny.CATALOG.datasets})
    monkeypatch.setattr(domains, "TASKS", {**domains.TASKS, **tiny.CATALOG.tasks})
    monkeypatch.setitem(protocol.SUITES, "line", tiny.SUITE)
    monkeypatch.setitem(budget.BUDGETS, "standard", tiny.BUDGET)


@pytest.mark.usefixtures("tiny_suite")
def test_a_suite_runs_resumes_and_becomes_a_page(tmp_path: Path) -> None:
    arguments = ["bench", "--suite", "line", "--augmenters", "jittering", "--seeds", "2", "--out", str(tmp_path)]
    first = CliRunner().invoke(cli.app, arguments, catch_exceptions=False)
    assert first.exit_code == 0
    assert "line-human: not measured. D4RL/line/human-v2 is not here" in first.output
    assert "8 cells in 4 jobs, 0 of them finished" in first.output
    assert re.search(r"^1/4 line none seed 0: \d+ s; \d+ s left$", first.output, re.MULTILINE)
    assert re.search(r"^4/4 line jittering seed 1: \d+ s; 0 s left$", first.output, re.MULTILINE)
    assert "jittering" in first.output
    assert "the error by" in first.output
    (manifest,) = (tmp_path / "runs").glob("*.json")
    manifest.write_text("{}")
    with pytest.raises(ConfigurationError, match="another version"):  # before anything is computed
        CliRunner().invoke(cli.app, arguments, catch_exceptions=False)
    manifest.unlink()
    again = CliRunner().invoke(cli.app, arguments, catch_exceptions=False)
    assert "4 of them finished" in again.output
    assert list(tmp_path.glob("tables/*/tables.md"))
    assert list(tmp_path.glob("tables/*/cells.csv"))
    page_file, pictures = str(tmp_path / "page.html"), tmp_path / "pictures"
    made = CliRunner().invoke(cli.app, ["report", str(tmp_path), "--out", page_file, "--pictures", str(pictures)])
    assert made.exit_code == 0
    page = (tmp_path / "page.html").read_text()
    assert "minari download D4RL/line/human-v2" in page
    assert "What was generated" in page
    assert not re.search(r"""(src|href)\s*=\s*["'](?!data:)""", page) and "<script" not in page  # nothing is loaded
    written = sorted(pictures.glob("*.png"))
    assert len(written) == len(set(re.findall('data:image/png;base64,([^"]+)', page))) > 3
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in written)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--suite", "magic"], "no suite 'magic'"),
        (["--augmenters", "magic"], "no variant 'magic'"),
        (["--estimators", "magic"], "no estimator magic"),
        (["--seeds", "0"], "--seeds must be"),
        (["--seeds", "2", "--seed", "1"], "not both"),
        (["--initial", "somewhere"], "--initial must be"),
        (["--behavior", "magic"], "--behavior must be"),
        (["--gamma", "2"], "--gamma must be"),
        (["--budget", "magic"], "--budget must be"),
        (["--quick", "--budget", "full"], "not both"),
        (["--datasets", "maze2d-umaze,magic"], "no dataset magic; it has maze2d-umaze"),
        (["--device", "magic"], "--device 'magic'"),
    ],
)
def test_bad_input_is_named(arguments: list[str], message: str, tmp_path: Path) -> None:
    result = CliRunner().invoke(cli.app, ["bench", *arguments, "--out", str(tmp_path)])
    assert isinstance(result.exception, ConfigurationError)
    assert message in str(result.exception)


@pytest.mark.usefixtures("tiny_suite")
def test_some_datasets_of_a_suite(tmp_path: Path) -> None:
    arguments = ["bench", "--suite", "line", "--datasets", "line", "--augmenters", "none", "--seeds", "1"]
    done = CliRunner().invoke(cli.app, [*arguments, "--out", str(tmp_path)], catch_exceptions=False)
    assert done.exit_code == 0
    assert "line-human" not in done.output
    assert "2 cells in 1 jobs" in done.output
    assert "averages over" not in done.output  # nothing was compared


@pytest.mark.usefixtures("tiny_suite")
def test_a_run_tells_what_it_found_and_not_what_an_earlier_one_did(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    where = ["--augmenters", "jittering", "--seeds", "1", "--out", str(tmp_path)]
    CliRunner().invoke(cli.app, ["bench", "--suite", "line", "--datasets", "line", *where], catch_exceptions=False)
    monkeypatch.setitem(protocol.SUITES, "logs", protocol.Suite("logs", ("line-logs",), "nobody knows the truth"))
    monkeypatch.setattr(protocol.Catalog, "installed", lambda: tiny.CATALOG)
    done = CliRunner().invoke(cli.app, ["bench", "--suite", "logs", *where], catch_exceptions=False)
    assert done.exit_code == 0
    assert "the error by" not in done.output
    page, pictures = tmp_path / "page.html", tmp_path / "pictures"
    CliRunner().invoke(cli.app, ["report", str(tmp_path), "--out", str(page), "--pictures", str(pictures)])
    assert "How often a fall happened among the episodes" in page.read_text()  # the agreement curves
    assert len(list(pictures.glob("*.png"))) > 1


def test_a_cell_of_the_quick_suite(tmp_path: Path) -> None:
    arguments = ["bench", "--suite", "quick", "--augmenters", "oat", "--estimators", "fqe,is", "--seeds", "1"]
    done = CliRunner().invoke(cli.app, [*arguments, "--out", str(tmp_path)], catch_exceptions=False)
    assert done.exit_code == 0
    (table,) = tmp_path.glob("tables/*/cells.csv")
    cells = list(csv.DictReader(table.read_text().splitlines()))
    assert {(cell["variant"], cell["family"], cell["reason"]) for cell in cells} == {
        (variant, family, "") for variant in ("none", "oat") for family in ("FQE", "IS")
    }
    assert all(float(cell["mae"]) > 0 and float(cell["peak_memory_mb"]) > 10 for cell in cells)


def test_nothing_at_hand_and_nothing_to_report(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(protocol.SUITES, "none", protocol.Suite("none", ("nowhere",), "nothing"))
    result = CliRunner().invoke(cli.app, ["bench", "--suite", "none", "--out", str(tmp_path)])
    assert isinstance(result.exception, DatasetNotFoundError)
    assert "nowhere" in result.output
    result = CliRunner().invoke(cli.app, ["report", str(tmp_path)])
    assert isinstance(result.exception, ConfigurationError)
    assert "oat-gym bench" in str(result.exception)
