"""`oat-gym evaluate` as its user meets it."""

import csv
from pathlib import Path

import minari
import numpy as np
import pytest
from typer.testing import CliRunner

from oat_gym import cli, domains, ope
from oat_gym.domains.truth import exact_truth
from oat_gym.errors import ConfigurationError, DatasetNotFoundError, EstimationWarning, InvalidDataError


@pytest.fixture
def policies(tmp_path: Path) -> Path:
    """Two policies of the walks: one steps right, one left."""
    folder = tmp_path / "policies"
    folder.mkdir()
    for number, sign in enumerate((1.0, -1.0)):
        np.savez(
            folder / f"walk_{number}.npz",
            **{
                "fc0.weight": np.zeros((4, 2), np.float32),
                "fc0.bias": np.zeros(4, np.float32),
                "last_fc.weight": np.zeros((2, 4), np.float32),
                "last_fc.bias": np.full(2, 0.2 * sign, np.float32),
                "last_fc_log_std.weight": np.zeros((2, 4), np.float32),
                "last_fc_log_std.bias": np.zeros(2, np.float32),
                "nonlinearity": np.array("tanh"),
                "output_distribution": np.array("gaussian"),
            },
        )
    return folder


def evaluate(*arguments: str) -> str:
    result = CliRunner().invoke(
        cli.app, ["evaluate", "test/walks-v0", "--estimators", "is", "--seeds", "1", *arguments]
    )
    if result.exception is not None:
        raise result.exception
    return result.output


def test_the_values_of_the_library_are_printed_and_written(
    walk_dataset: minari.MinariDataset, policies: Path, tmp_path: Path
) -> None:
    file = tmp_path / "values.csv"
    with pytest.warns(EstimationWarning, match="effective sample size"):
        printed = evaluate("--policies", str(policies), "--horizon", "6", "--gamma", "0.9", "--out", str(file))
        known = ope.load_dope_policies(policies, action_space=walk_dataset.action_space)  # type: ignore[arg-type]
        expected = ope.evaluate(walk_dataset, known, [ope.ImportanceSampling()], gamma=0.9, horizon=6, seeds=1)
    rows = list(csv.DictReader(file.read_text().splitlines()))
    assert [row["policy"] for row in rows] == ["walk_0", "walk_1"]
    assert [float(row["value"]) for row in rows] == [row["value"] for row in expected.rows]
    assert f"{expected.rows[0]['value']:.4g}" in printed


def test_augmented_episodes_are_paired_and_the_truth_is_compared(
    walk_dataset: minari.MinariDataset, policies: Path, tmp_path: Path
) -> None:
    (tmp_path / "truth.csv").write_text("policy,value\nwalk_0,1.0\nwalk_1,-1.0\n")
    with pytest.warns(EstimationWarning):
        printed = evaluate(
            *("--policies", str(policies), "--horizon", "6", "--truth", str(tmp_path / "truth.csv")),
            *("--augmenter", "jittering", "--factor", "2", "--use-augmented", "all"),
        )
    for words in ("real", "augmented", "Change by the synthetic episodes", "mae", "regret at 1"):
        assert words in printed
    _, changes = printed.split("Change by the synthetic episodes:")
    assert changes.count("  False") == 2  # the behaviour policy is a clone
    assert "covers training False: Resamples do not reach what was fitted" in changes


def test_estimates_are_kept_within_what_policies_can_earn(
    walk_dataset: minari.MinariDataset, policies: Path, tmp_path: Path
) -> None:
    file = tmp_path / "values.csv"
    arguments = ["--policies", str(policies), "--horizon", "6", "--out", str(file)]
    with pytest.warns(EstimationWarning):
        evaluate(*arguments)
        free = [float(row["value"]) for row in csv.DictReader(file.read_text().splitlines())]
        middle = sum(free) / 2
        evaluate(*arguments, "--within", str(middle), str(max(free) + 1))
    kept = [float(row["value"]) for row in csv.DictReader(file.read_text().splitlines())]
    assert min(free) < middle
    assert kept == [max(value, middle) for value in free]


def test_a_dataset_of_no_task_needs_policies(walk_dataset: minari.MinariDataset) -> None:
    with pytest.raises(ConfigurationError, match=r"no task named 'test/walks-v0'.*Give --policies"):
        evaluate()


def test_the_policies_and_values_of_a_task(
    walk_dataset: minari.MinariDataset, policies: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    known = ope.load_dope_policies(policies, action_space=walk_dataset.action_space)  # type: ignore[arg-type]
    values = {"walk_0": 1.0, "walk_1": -1.0}
    task = domains.Task(
        datasets=("test/walks-v0",),
        policies=lambda: {**known},
        truth=lambda gamma: exact_truth(values, gamma=gamma, horizon=6, command="by hand"),
        gamma=0.9,
        horizon=6,
    )
    monkeypatch.setitem(domains.TASKS, "walks", task)
    with pytest.warns(EstimationWarning):
        by_dataset, by_name = evaluate(), evaluate("--policies", "walks")
        shorter = evaluate("--horizon", "5")
    assert by_dataset == by_name
    assert "mae" in by_dataset
    assert "mae" not in shorter, "values of 6 steps are no truth for 5"
    with pytest.raises(ConfigurationError, match="--initial reset is for policies of a task with an environment"):
        evaluate("--initial", "reset")
    with pytest.raises(ConfigurationError, match="gamma must be"):
        evaluate("--gamma", "0")


def test_estimates_are_kept_where_no_true_value_is_known(
    walk_dataset: minari.MinariDataset, policies: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    known = ope.load_dope_policies(policies, action_space=walk_dataset.action_space)  # type: ignore[arg-type]
    starts: list[int] = []

    def resets(count: int, seed: int) -> np.ndarray:
        starts.append(count)
        return np.zeros((count, 2))

    def nothing(gamma: float) -> domains.Truth:
        raise ConfigurationError(f"nothing is stored for {gamma}")

    task = domains.Task(("test/walks-v0",), lambda: {**known}, truth=nothing, initial_states=resets, horizon=6)
    monkeypatch.setitem(domains.TASKS, "walks", task)
    with pytest.warns(EstimationWarning):
        printed = evaluate("--gamma", "0.97", "--initial", "reset", "--out", str(tmp_path / "values.csv"))
    assert "Not compared with true values: nothing is stored for 0.97" in printed
    assert len((tmp_path / "values.csv").read_text().splitlines()) == 3
    assert starts == [200]
    (tmp_path / "truth.csv").write_text("policy,value\nwalk_0,1.0\n")
    with pytest.raises(InvalidDataError, match="true values has none of walk_1"):
        evaluate("--truth", str(tmp_path / "truth.csv"))


@pytest.mark.parametrize(
    "case",
    [
        (["--estimators", "magic"], ConfigurationError, "no estimator 'magic'"),
        (["--use-augmented", "half"], ConfigurationError, "--use-augmented must be one of"),
        (["--within", "1", "-1"], ConfigurationError, "within needs two finite numbers, low < high, got 1.0 and -1.0"),
        (["--within", "0", "inf"], ConfigurationError, "within needs two finite numbers"),
        (["--seeds", "0"], ConfigurationError, "--seeds must be at least 1, got 0"),
        (["--behavior", "guess"], ConfigurationError, "--behavior must be one of clone, logged"),
        (["--augmenter", "magic"], ConfigurationError, "no augmenter 'magic'"),
        (["--gamma", "1.5", "--policies", "POLICIES"], ConfigurationError, "gamma must be"),
        (["--truth", "BAD"], InvalidDataError, "columns policy and value"),
        ([], DatasetNotFoundError, "no npz file"),
        (["--policies", "adroit-nothing"], DatasetNotFoundError, "no npz file in adroit-nothing"),
    ],
)
def test_bad_input(
    walk_dataset: minari.MinariDataset,
    policies: Path,
    tmp_path: Path,
    case: tuple[list[str], type[Exception], str],
) -> None:
    arguments, error, message = case
    (tmp_path / "bad.csv").write_text("name,worth\na,1\n")
    (tmp_path / "empty").mkdir()
    places = {"POLICIES": str(policies), "BAD": str(tmp_path / "bad.csv")}
    given = ["--policies", str(tmp_path / "empty"), *(places.get(argument, argument) for argument in arguments)]
    with pytest.raises(error, match=message):
        evaluate(*given)
