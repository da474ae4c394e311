"""What is known of the numbers of the diagnoses before they are computed, and that a killed one goes on."""

import csv
import dataclasses
import importlib.util
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from gymnasium import spaces
from minari import MinariDataset

from oat_gym import AugmentedDataset, Function, Jittering, Scaling, domains
from oat_gym.benchmark.analysis import Analysis
from oat_gym.benchmark.grid import format_number
from oat_gym.benchmark.plan import make_plan, write_manifest
from oat_gym.benchmark.protocol import Question
from oat_gym.benchmark.results import Results, read_results
from oat_gym.benchmark.runner import run
from oat_gym.benchmark.variants import NONE, parse_variants
from oat_gym.metrics.steps import Scale, Steps
from oat_gym.ope import PolicySet
from oat_gym.spaces import FlatSpace
from tests.benchmark import tiny

SCRIPT = Path(__file__).with_name("diagnose_steps.py")


def load(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, SCRIPT.with_name(f"{name}.py"))
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


@pytest.fixture(autouse=True)
def beside_each_other(monkeypatch: pytest.MonkeyPatch) -> None:
    """Scripts find what lies in their folder, as where they are run."""
    monkeypatch.syspath_prepend(SCRIPT.parent)


@pytest.fixture(scope="module")
def script() -> ModuleType:
    return load("diagnose_steps")


@pytest.fixture(scope="module")
def found(script: ModuleType) -> dict[float, dict[str, float]]:
    """The numbers of jittering by its sigma, on some episodes of the maze."""
    whole, policies = domains.load("maze2d-umaze"), domains.policies("maze2d-umaze")
    subject = script.Subject(
        MinariDataset(whole.storage, episode_indices=whole.episode_indices[:12]),
        PolicySet.of({name: policies[name] for name in ("umaze-0", "umaze-10")}),
        script.SIMULATORS["maze2d-umaze"],
        limits=script.Limits(steps=200, states=50),
    )
    return {sigma: script.diagnose(subject, Jittering(sigma=sigma), factor=3) for sigma in (0.0, 0.05)}


def test_the_simulator_repeats_real_steps(found: dict[float, dict[str, float]]) -> None:
    assert found[0.0]["check_state"] < 1e-6
    assert found[0.0]["check_reward"] == 0


def test_copies_change_nothing_and_bring_nothing_nearer(found: dict[float, dict[str, float]]) -> None:
    copies = found[0.0]
    assert copies["share_generated"] == 1
    assert copies["change"] == copies["simulator_reward"] == copies["simulator_in_wall"] == 0
    assert copies["simulator_state"] < 1e-6
    assert copies["near_ratio"] == pytest.approx(1, abs=1e-9)


def test_noise_of_a_known_size_is_found(found: dict[float, dict[str, float]]) -> None:
    noisy = found[0.05]
    assert noisy["change_state"] == pytest.approx(0.05, rel=0.05)
    assert noisy["change_reward"] == pytest.approx(0.05, rel=0.1)
    assert 0.03 < noisy["change_action"] < 0.05  # forces at their bounds stay inside them
    assert noisy["near_ratio"] < 1
    assert noisy["seam"] is None


def test_the_simulator_sees_an_error_in_its_size(script: ModuleType, found: dict[float, dict[str, float]]) -> None:
    steps = Steps(
        states=np.array([[-1.0, 1.0, 1.0, 1.0, -1.0, 1.0, 0.5, 0.0]]),
        actions=np.zeros((1, 2)),
        rewards=np.ones(1),
        next_states=np.zeros((1, 8)),
        episodes=np.zeros(1, dtype=np.int64),
        numbers=np.zeros(1, dtype=np.int64),
    )
    unit = (np.zeros(1), np.ones(1))
    scale = Scale(states=unit, actions=unit, rewards=unit, changes=(np.zeros(8), np.full(8, 0.5)))
    true, reward, in_wall = script.SIMULATORS["maze2d-umaze"](steps.states, steps.actions)
    assert true[0, 0] > -1 and reward[0] == 0 and not in_wall[0]
    off = Steps(**vars(steps) | {"next_states": np.hstack((np.zeros((1, 4)), true + 1.0))})
    errors = script.simulator_errors(script.SIMULATORS["maze2d-umaze"], off, scale, "x")
    assert errors["x_state"] == errors["x_state_median"] == pytest.approx(2.0)
    assert errors["x_reward"] == 1


def test_a_discrete_action_must_be_the_same(script: ModuleType) -> None:
    states = np.array([[0.0], [1.0], [3.0]])
    points = Steps(
        states=states,
        actions=np.array([[1.0, 0.0], [1.0, 0.0], [0.0, 1.0]]),
        rewards=np.zeros(3),
        next_states=states,
        episodes=np.array([0, 1, 2]),
        numbers=np.zeros(3, dtype=np.int64),
    )
    flat = FlatSpace.of(spaces.Discrete(2))
    scale = Scale.of(points, observations=FlatSpace.of(spaces.Box(-9, 9, (1,))), actions=flat)
    second = np.array([[[0.0, 1.0]]])  # only the third step, three metres away, took it
    targets = script.Targets(points.take(np.array([0])), second, np.ones(2, dtype=bool))
    assert targets.distance(points, scale) == pytest.approx(3 / states.std(), rel=1e-6)


def test_rows_that_are_there_are_not_computed_again(tmp_path: Path) -> None:
    cell = ("--datasets", "maze2d-umaze", "--variants", "jittering", "--seeds", "0", "--steps", "60", "--states", "5")

    def call(what: str) -> str:
        command = [sys.executable, str(SCRIPT), what, "--out", str(tmp_path), *cell]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        return done.stdout

    assert call("run").startswith("maze2d-umaze jittering 0")
    assert call("run") == ""
    call("tables")
    (row,) = csv.DictReader((tmp_path / "steps.csv").read_text().splitlines())
    assert float(row["change"]) == pytest.approx(0.03, rel=0.1)
    text = (tmp_path / "steps.md").read_text()
    assert "| jittering | 1 |" in text and "{" not in text


def test_ends_that_are_generated_are_counted_with_their_rewards(tmp_path: Path) -> None:
    module = load("diagnose_ends")
    whole = domains.load("maze2d-umaze")
    real = MinariDataset(whole.storage, episode_indices=whole.episode_indices[:4])
    found = module.ends(AugmentedDataset(real, Scaling(sigma=0.5), factor=3, seed=0), 4)
    assert found["share_generated"] == found["terminating"] == found["ends_generated"] == 100
    assert found["end_reward_recorded"] == 1  # the maze's episodes terminate at the goal
    assert 0 < abs(found["end_reward"] - 1) < 2
    assert found["other_reward_recorded"] == 0
    copies = module.ends(AugmentedDataset(real, Function(lambda episode, rng: episode), factor=2, seed=0), 4)
    numbers = {name: f"{value}" for name, value in copies.items()}
    row = {"dataset": "maze", "variant": "x", "seed": "0", **numbers, "commit": "c"}
    module.write(tmp_path, [row, row | {"seed": "1"}])
    assert len((tmp_path / "ends.csv").read_text().splitlines()) == 3
    assert "| maze | x | 2 |" in (tmp_path / "ends.md").read_text()
    arguments = ["--datasets", "maze2d-umaze", "--variants", "jittering", "--seeds", "0", "--out", str(tmp_path)]
    for _ in range(2):  # the second time nothing is left to do
        command = [sys.executable, str(SCRIPT.with_name("diagnose_ends.py")), *arguments]
        told = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    assert not told
    assert len((tmp_path / "ends.csv").read_text().splitlines()) == 4


def benchmark(folder: Path, variants: str, *, estimators: int) -> Results:
    """Return the results of a tiny benchmark with two seeds."""
    budget = dataclasses.replace(tiny.BUDGET, estimators=tiny.BUDGET.estimators[:estimators])
    settings = {"question": Question(resamples=20, resets=5), "budget": budget, "catalog": tiny.CATALOG}
    plan = make_plan(tiny.SUITE, parse_variants(variants), seeds=(0, 1), **settings)
    write_manifest(folder, plan, seeds=(0, 1), device="cpu", command="bench")
    run(plan, folder, catalog=tiny.CATALOG)
    (results,) = read_results(folder)
    return results


def test_estimates_are_kept_within_what_policies_can_earn(tmp_path: Path) -> None:
    module = load("diagnose_range")
    results = benchmark(tmp_path, "jittering", estimators=1)
    true, family = results.cells[0].true, results.families[0]
    module.OUTCOMES = {name: (true.mean(), true.mean()) for name in results.datasets}
    module.FAMILIES = (family,)
    *rows, whole = module.rows_of(tmp_path, ["jittering"])
    off = float(np.abs(true - true.mean()).mean())
    assert all(row["error within"] == format_number(off) and row["error"] != row["error within"] for row in rows)
    assert all(row["jittering within"] == "0 (0 to 0)" for row in (*rows, whole))  # one value is left for all
    load("reread").write(tmp_path, [*rows, whole], name="range", caption="Within")
    assert len((tmp_path / "range.csv").read_text().splitlines()) == len(rows) + 2


def test_synthetic_data_go_to_the_estimators_that_gained_elsewhere(tmp_path: Path) -> None:
    module = load("diagnose_use")
    variants = ["jittering", "scaling"]
    results = benchmark(tmp_path, "jittering,scaling", estimators=2)
    module.CHOICE = module.REPORT = results.datasets
    effects = module.gains(results, variants)
    plain = Analysis(results)
    for family, found in effects.items():
        for name, effect in found.items():
            errors = [plain.scores(results.datasets[0], side, family, "mae").mean() for side in (NONE, name)]
            assert effect == pytest.approx(np.log(errors[0] / errors[1]))
    first, second = effects
    made = {first: {"jittering": 0.2, "scaling": 0.3}, second: {"jittering": -0.1, "scaling": -0.2}}
    choice = module.choices(made, variants)
    assert choice["jittering"] == {first: "jittering", second: NONE}
    assert choice["best"] == {first: "scaling", second: NONE}
    chosen = Analysis(module.composed(results, choice["best"]))
    error = chosen.scores(results.datasets[0], module.CHOSEN, first, "mae")
    assert error.tolist() == plain.scores(results.datasets[0], "scaling", first, "mae").tolist()
    unchanged = chosen.finding(results.datasets[0], module.CHOSEN, second, "mae")
    assert unchanged is not None and unchanged.improvement.value == 0
    rows = module.rows_of(tmp_path, variants)
    assert [row["method"] for row in rows] == [*variants, "best"]
    load("reread").write(tmp_path, rows, name="use", caption="Use")
    assert len((tmp_path / "use.csv").read_text().splitlines()) == len(rows) + 1


def test_only_equal_cells_of_two_machines_are_compared(script: ModuleType) -> None:
    machines = load("diagnose_machines")
    place, other = ("line", "none", "FQE"), ("line", "none", "IS")

    def row(fingerprint: str, mae: str, seconds: str = "1.0") -> dict[str, str]:
        return {"fingerprint": fingerprint, "mae": mae, "commit": "c", "cpu_seconds": seconds}

    ours = {
        place: {0: row("a", "3"), 1: row("b", "5"), 2: row("c", "1"), 3: row("d", "7", "2.0")},
        other: {0: row("e", "")},  # nobody knows the true values
    }
    theirs = {place: {0: row("a", "1", "9.0"), 1: row("x", "5"), 3: row("d", "7", "2.0")}, other: {0: row("e", "")}}
    assert machines.pairs_of(ours, theirs) == {place: [(3.0, 1.0)]}
    assert machines.apart(3.0, 1.0) == 100.0
    assert machines.between_seeds([1.0, 3.0, 1.0]) == [100.0, 0.0, 100.0]


def test_equal_bytes_of_two_processors_have_one_letter(monkeypatch: pytest.MonkeyPatch) -> None:
    processors = load("diagnose_processors")
    rounding = np.array([0.1 + 0.2, 1.0]), np.array([0.3, 1.0])

    def measured(vendor: str, variables: dict[str, str], folder: Path) -> dict[str, object]:
        first = "MKL_CBWR" in variables or vendor == "intel"
        return {"FQE": processors.digest([rounding[0 if first else 1]]), "CPU s, FQE": 1.25}

    monkeypatch.setattr(processors, "measured", measured)
    rows = processors.rows_of()
    assert len({(row["kernels of MKL"], row["settings"]) for row in rows}) == len(rows)
    assert {row["FQE"] for row in rows if row["kernels of MKL"] == "intel"} == {"a"}
    plain = [row["FQE"] for row in rows if row["kernels of MKL"] == "other" and "MKL" not in row["settings"]]
    evened = [row["FQE"] for row in rows if "MKL" in row["settings"]]
    assert set(plain) == {"b"} and set(evened) == {"a"}
    assert {row["CPU s, FQE"] for row in rows} == {"1.2"}
