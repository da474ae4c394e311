"""The command line as its user meets it: in a process of its own, in an empty folder."""

import dataclasses
import subprocess
import sys
import warnings
from pathlib import Path

import minari
import pytest
from typer.testing import CliRunner

from oat_gym import OAT, AugmentedDataset, cli
from oat_gym.errors import AugmentationWarning
from oat_gym.generation import BehaviorConfig, VAEMDPConfig


def run(*arguments: str, folder: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", "from oat_gym.cli import main; main()", *arguments]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)


@pytest.mark.parametrize("command", [[], ["demo"], ["augment"], ["inspect"], ["cache"], ["cache", "list"]])
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
        (["augment"], "Missing argument"),
        (["magic"], "No such command"),
        (["demo", "--factor", "1"], "--factor must be more than 1"),
    ],
)
def test_bad_input_is_one_line_and_status_2(arguments: list[str], message: str, tmp_path: Path) -> None:
    result = run(*arguments, folder=tmp_path)
    assert result.returncode == 2
    assert message in result.stderr
    assert result.stderr.count("\n") == 1
    assert "Traceback" not in result.stderr
    assert list(tmp_path.iterdir()) == []


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


def test_augment_saves_what_the_library_makes(
    walk_dataset: minari.MinariDataset, monkeypatch: pytest.MonkeyPatch, tiny_oat: OAT
) -> None:
    monkeypatch.setattr(cli, "_configure", lambda name, length, top: tiny_oat)
    result = CliRunner().invoke(cli.app, ["augment", "test/walks-v0", "--factor", "3", "--seed", "4"])
    assert result.exit_code == 0, result.output
    saved = minari.load_dataset("test/walks-oat-v0")
    expected = AugmentedDataset(walk_dataset, tiny_oat, factor=3, seed=4)
    assert all((a.rewards == b.rewards).all() for a, b in zip(saved, expected, strict=True))


def test_demo_writes_one_folder_and_runs_twice(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    small = {"model": VAEMDPConfig(max_updates=5), "behavior": BehaviorConfig(max_updates=20)}
    mining = dataclasses.replace(cli.DEMO_CONFIG.mining, n_clusters=4, init="kmeans")
    monkeypatch.setattr(cli, "DEMO_CONFIG", dataclasses.replace(cli.DEMO_CONFIG, mining=mining, **small))
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
    assert "1 entries" in listed.output
    path = runner.invoke(cli.app, ["cache", "path"]).output.strip()
    assert Path(path).is_dir()
    assert "Deleted 1 entries" in runner.invoke(cli.app, ["cache", "clear"]).output
    assert "0 entries" in runner.invoke(cli.app, ["cache", "list"]).output
