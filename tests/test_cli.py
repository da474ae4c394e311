"""The command line as its user meets it, in an empty folder."""

import csv
import dataclasses
import errno
import subprocess
import sys
import warnings
from contextlib import nullcontext
from pathlib import Path

import minari
import pytest
from gymnasium import spaces
from typer.testing import CliRunner

from oat_gym import AUGMENTERS, OAT, AugmentedDataset, MiningConfig, cli, metrics
from oat_gym.errors import AugmentationWarning, ConfigurationError, SaveError
from oat_gym.generation import BehaviorConfig, VAEMDPConfig
from tests.conftest import install_dataset, walks


def run(*arguments: str, folder: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", "from oat_gym.cli import main; main()", *arguments]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)


@pytest.mark.parametrize("command", [[], ["demo"], ["augment"], ["inspect"], ["compare"], ["cache"], ["cache", "list"]])
def test_help(command: list[str]) -> None:
    result = CliRunner().invoke(cli.app, [*command, "--help"])
    assert result.exit_code == 0
    assert "Usage" in result.output


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["augment", "nowhere/none-v0"], "minari download nowhere/none-v0"),
        (["augment", "maze2d-umaze", "--augmenter", "magic"], "no augmenter 'magic'"),
        (["augment", "maze2d-umaze", "--factor", "0.5"], "factor must be"),
        (["augment", "maze2d-umaze", "--length", "1000"], "No episode is as long"),
        (["augment", "maze2d-umaze", "--length", "x"], "--length"),
        (["augment", "maze2d-umaze", "--format", "csv"], "--format"),
        (["augment", "maze2d-umaze", "--out", "no id"], "is no dataset id"),
        (["augment", "maze2d-umaze", "--top", "0"], "top must be"),
        (["augment", "maze2d-umaze", "--factor", "ten"], "Invalid value for '--factor'"),
        (["augment", "maze2d-umaze", "--length", "\u00b2"], "--length"),
        (["augment", "maze2d-umaze", "--augmenter", "jittering", "--length", "20"], "only of oat, tda: leave it out"),
        (["augment", "maze2d-umaze", "--augmenter", "tda", "--top", "2"], "only of oat: leave it out"),
        (["augment", "maze2d-umaze", "--augmenter", "tda", "--length", "auto"], "length must be"),
        (["augment", "maze2d-umaze", "--augmenter", "tda", "--length", "1000"], "No episode is as long"),
        (["augment"], "Missing argument"),
        (["compare", "nowhere/none-v0"], "minari download nowhere/none-v0"),
        (["compare", "maze2d-umaze", "--augmenters", "oat,magic"], "no augmenter 'magic'"),
        (["compare", "maze2d-umaze", "--augmenters", "tda,oat,tda"], "names a method twice"),
        (["compare", "maze2d-umaze", "--factor", "1"], "--factor must be more than 1"),
        (["magic"], "No such command"),
        (["inspect", "maze2d-umze"], "Did you mean 'maze2d-umaze'?"),
        (["inspect", "oat_gym/maze2d-umze-v0"], "Did you mean 'oat_gym/maze2d-umaze-v0'?"),
        (["inspect", "x"], "The names are adroit-door-cloned"),
        (["inspect", "maze2d-umaze", "--length", "x"], "--length"),
        (["augment", "maze2d-umaze", "--length", "1000"], "Use --length 28 or --length auto."),
        (["augment", "maze2d-umaze", "--augmenter", "tda", "--length", "1000"], "Use --length 28."),
        (["demo", "--factor", "1"], "--factor must be more than 1"),
    ],
)
def test_bad_input_is_one_line_and_status_2(
    arguments: list[str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["oat-gym", *arguments])
    monkeypatch.setattr(warnings, "showwarning", warnings.showwarning)  # main replaces it
    with pytest.raises(SystemExit) as stop:
        cli.main()
    check_complaint(stop.value.code, capsys.readouterr().err, message, tmp_path)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["augment", "nowhere/none-v0"], "minari download nowhere/none-v0"),
        (["compare", "maze2d-umaze", "--augmenters", "oat,magic"], "no augmenter 'magic'"),
    ],
)
def test_bad_input_in_a_process_of_its_own(arguments: list[str], message: str, tmp_path: Path) -> None:
    result = run(*arguments, folder=tmp_path)
    check_complaint(result.returncode, result.stderr, message, tmp_path)


def check_complaint(status: object, errors: str, message: str, folder: Path) -> None:
    assert status == 2
    assert message in errors
    assert errors.count("\n") == 1
    assert "Traceback" not in errors
    assert list(folder.iterdir()) == []


def test_inspect_shows_a_plain_and_an_augmented_dataset(
    walk_dataset: minari.MinariDataset, tiny_oat: OAT, tmp_path: Path
) -> None:
    result = run("inspect", "test/walks-v0", "--no-mine", folder=tmp_path)
    assert result.returncode == 0, result.stderr
    assert "Box(-100.0, 100.0, (2,), float32)" in result.stdout
    AugmentedDataset(walk_dataset, tiny_oat, factor=2).save("test/walks-oat-v0", lazy=True)
    result = run("inspect", "test/walks-oat-v0", folder=tmp_path)
    assert result.returncode == 0, result.stderr
    for words in ("synthetic", "seam in (sd)", "support", "PST set"):
        assert words in result.stdout


def short_episodes() -> minari.MinariDataset:
    return install_dataset("test/short-v0", walks(6, 8), spaces.Box(-100, 100, (2,)), spaces.Box(-1, 1, (2,)))


def test_inspect_of_short_episodes_says_that_nothing_was_mined(tmp_path: Path) -> None:
    short_episodes()
    result = run("inspect", "test/short-v0", folder=tmp_path)
    assert result.returncode == 0, result.stderr
    assert "episodes" in result.stdout
    assert "Not mined. No episode is as long as a sub-trajectory of 20 steps" in result.stdout
    assert result.stdout.rstrip().endswith("Use --length 4.")
    assert "MiningConfig" not in result.stdout + result.stderr


def test_episodes_of_a_source_that_is_augmented_are_not_called_real(walk_dataset: minari.MinariDataset) -> None:
    AugmentedDataset(walk_dataset, AUGMENTERS["jittering"](), factor=2).save("test/more-v0")
    arguments = ["augment", "test/more-v0", "--augmenter", "jittering", "--factor", "2", "--out", "test/most-v0"]
    result = CliRunner().invoke(cli.app, arguments)
    assert "test/most-v0: 24 of the source + 24 synthetic episodes." in result.output


def test_help_is_short() -> None:
    assert "icu-sepsis" not in CliRunner().invoke(cli.app, ["augment", "--help"]).output


@pytest.mark.parametrize(
    "command",
    [
        ["demo"],
        ["compare", "maze2d-umaze", "--augmenters", "jittering"],
        ["bench"],
        ["evaluate", "maze2d-umaze", "--estimators", "is"],
    ],
    ids=lambda command: command[0],
)
def test_where_nothing_can_be_written_it_is_said_before_the_work(
    command: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("")

    def work(*_: object, **__: object) -> None:
        raise AssertionError("this is work")

    for place in ("metrics.compare", "ope.evaluate", "cli.demo.AugmentedDataset.fit", "cli.bench.make_plan"):
        monkeypatch.setattr(f"oat_gym.{place}", work)
    result = CliRunner().invoke(cli.app, [*command, "--out", str(tmp_path / "file" / "inside")])
    assert isinstance(result.exception, SaveError), result.output
    assert "--out" in str(result.exception)
    assert "cannot be written: the folder" in str(result.exception)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_augment_finds_a_folder_that_takes_no_files_before_the_work(
    walk_dataset: minari.MinariDataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(**_: object) -> None:
        raise PermissionError(errno.EACCES, "Permission denied")

    def work(*_: object, **__: object) -> None:
        raise AssertionError("this is work")

    monkeypatch.setattr("oat_gym.cli._output.tempfile.TemporaryFile", refuse)
    monkeypatch.setattr("oat_gym.cli.augment.AugmentedDataset.fit", work)
    result = CliRunner().invoke(cli.app, ["augment", "test/walks-v0", "--augmenter", "jittering"])
    assert isinstance(result.exception, SaveError), result.output
    assert "MINARI_DATASETS_PATH" in str(result.exception)
    assert "Permission denied" in str(result.exception)


def test_a_file_in_the_place_of_a_folder_and_the_other_way(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("")
    result = CliRunner().invoke(cli.app, ["demo", "--out", "file"])
    assert "--out must be a folder, and 'file' is a file" in str(result.exception)
    result = CliRunner().invoke(cli.app, ["evaluate", "maze2d-umaze", "--estimators", "is", "--out", str(tmp_path)])
    assert "--out must be a file" in str(result.exception)


def test_augment_saves_what_the_library_makes(
    walk_dataset: minari.MinariDataset, monkeypatch: pytest.MonkeyPatch, tiny_oat: OAT
) -> None:
    monkeypatch.setattr(cli.augment, "configure", lambda name, *, length, top: tiny_oat)
    result = CliRunner().invoke(cli.app, ["augment", "test/walks-v0", "--factor", "3", "--seed", "4"])
    assert result.exit_code == 0, result.output
    saved = minari.load_dataset("test/walks-oat-v0")
    expected = AugmentedDataset(walk_dataset, tiny_oat, factor=3, seed=4)
    assert all((a.rewards == b.rewards).all() for a, b in zip(saved, expected, strict=True))


@pytest.mark.parametrize("name", [name for name, kind in AUGMENTERS.items() if not kind.trains])
def test_augment_takes_every_method(name: str, walk_dataset: minari.MinariDataset) -> None:
    """Those that train are tested with small settings in their own folder."""
    told = (
        pytest.warns(AugmentationWarning, match="a next state of their own") if name == "permutation" else nullcontext()
    )
    with told:
        result = CliRunner().invoke(cli.app, ["augment", "test/walks-v0", "--augmenter", name, "--factor", "2"])
    assert result.exit_code == 0, result.output
    assert f"test/walks-{name}-v0: 12 real + 12 synthetic" in result.output
    saved = minari.load_dataset(f"test/walks-{name}-v0")
    expected = AugmentedDataset(walk_dataset, AUGMENTERS[name](), factor=2)
    assert all((a.rewards == b.rewards).all() for a, b in zip(saved, expected, strict=True))


def test_length_and_top_reach_the_methods_that_have_them() -> None:
    assert cli.configure("oat", length="7", top=3) == OAT(mining=MiningConfig(n_clusters="auto", length=7, top=3))
    assert cli.configure("oat", length="auto").mining.length == "auto"  # type: ignore[attr-defined]
    assert cli.configure("tda", length="7").length == 7  # type: ignore[attr-defined]
    assert all(cli.configure(name) == kind() for name, kind in AUGMENTERS.items())


def test_compare_prints_a_table_and_writes_it_with_a_picture(
    walk_dataset: minari.MinariDataset, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    methods = {"jittering": AUGMENTERS["jittering"], "long": lambda: AUGMENTERS["tda"](length=1000)}  # type: ignore[call-arg]
    monkeypatch.setattr("oat_gym.cli.compare.AUGMENTERS", methods)
    monkeypatch.setattr("oat_gym.cli._shared.AUGMENTERS", methods)
    folder = tmp_path / "made" / "here"
    arguments = ["compare", "test/walks-v0", "--factor", "2", "--out", str(folder)]
    result = CliRunner().invoke(cli.app, arguments)
    assert result.exit_code == 0, result.output
    assert {path.name for path in folder.iterdir()} == {"walks-v0.csv", "walks-v0.png"}
    assert (folder / "walks-v0.png").read_bytes().startswith(b"\x89PNG")
    rows = list(csv.DictReader((folder / "walks-v0.csv").read_text().splitlines()))
    assert [row["augmenter"] for row in rows] == ["jittering", "long"]
    found = metrics.fidelity(AugmentedDataset(walk_dataset, AUGMENTERS["jittering"](), factor=2))
    for name, value in found.to_row().items():
        cell = rows[0][name]
        assert cell == "" if value is None else float(cell) == pytest.approx(value, rel=1e-5, abs=1e-12), name
    assert rows[0]["reason"] == ""
    assert "No episode is as long" in rows[1]["reason"]
    assert rows[1]["marginal"] == ""
    assert "No episode is as long" in result.output
    lines = result.output.splitlines()
    assert max(map(len, lines[1:-6])) <= 80
    shown = [line.split()[1:] for line in lines if line.strip().startswith("jittering")]
    expected = [found.score(name).value for name in metrics.METRICS]
    assert [cell for cells in shown for cell in cells] == [
        "-" if value is None else f"{value:.3g}" for value in expected
    ]
    first = (folder / "walks-v0.csv").read_bytes()
    assert CliRunner().invoke(cli.app, arguments).exit_code == 0
    assert (folder / "walks-v0.csv").read_bytes() == first


def test_compare_where_no_method_can_work(
    walk_dataset: minari.MinariDataset, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    methods = {"long": lambda: AUGMENTERS["tda"](length=1000)}  # type: ignore[call-arg]
    monkeypatch.setattr("oat_gym.cli.compare.AUGMENTERS", methods)
    monkeypatch.setattr("oat_gym.cli._shared.AUGMENTERS", methods)
    result = CliRunner().invoke(cli.app, ["compare", "test/walks-v0", "--out", str(tmp_path)])
    assert result.exit_code == 0, result.output
    assert "long: No episode is as long" in result.output
    assert [path.name for path in tmp_path.iterdir() if path.is_file()] == ["walks-v0.csv"]


def test_compare_wants_a_folder(walk_dataset: minari.MinariDataset, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    arguments = ["compare", "test/walks-v0", "--augmenters", "jittering", "--out", str(tmp_path / "file")]
    result = CliRunner().invoke(cli.app, arguments)
    assert isinstance(result.exception, ConfigurationError)
    assert "--out must be a folder" in str(result.exception)


def test_demo_writes_one_folder_and_runs_twice(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    small = {"model": VAEMDPConfig(max_updates=5), "behavior": BehaviorConfig(max_updates=20)}
    mining = dataclasses.replace(cli.demo.DEMO_CONFIG.mining, n_clusters=4, init="kmeans")
    monkeypatch.setattr(cli.demo, "DEMO_CONFIG", dataclasses.replace(cli.demo.DEMO_CONFIG, mining=mining, **small))
    monkeypatch.chdir(tmp_path)
    warnings.simplefilter("ignore", AugmentationWarning)  # short episodes hold no PST
    for _ in range(2):
        result = CliRunner().invoke(cli.app, ["demo", "--factor", "2"])
        assert result.exit_code == 0, result.output
        assert "250 real + 250 synthetic" in result.output
    assert {path.name for path in tmp_path.iterdir()} == {"oat-gym-demo"}
    assert (tmp_path / "oat-gym-demo" / "figure4.png").read_bytes().startswith(b"\x89PNG")
    saved = minari.MinariDataset(tmp_path / "oat-gym-demo" / "datasets" / "maze2d-umaze" / "oat-v0" / "data")
    assert len(saved) == 500
    other = CliRunner().invoke(cli.app, ["demo", "--factor", "3"])
    assert "already at" in str(other.exception)


def test_the_cache_is_listed_and_cleared(walk_dataset: minari.MinariDataset, tiny_oat: OAT) -> None:
    AugmentedDataset(walk_dataset, tiny_oat, factor=2).fit()
    runner = CliRunner()
    listed = runner.invoke(cli.app, ["cache", "list"])
    assert "2 entries" in listed.output  # the labels and the models
    path = runner.invoke(cli.app, ["cache", "path"]).output.strip()
    assert Path(path).is_dir()
    assert "Deleted 2 entries" in runner.invoke(cli.app, ["cache", "clear"]).output
    assert "0 entries" in runner.invoke(cli.app, ["cache", "list"]).output
