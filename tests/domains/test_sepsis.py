"""The target policies and the septic-shock curve of the sepsis task, and the open demo's numbers."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from oat_gym.checks import check_dataset
from oat_gym.domains import sepsis, sepsis_clif
from oat_gym.domains.dqn import DQN
from oat_gym.domains.sepsis_stages import rewards
from oat_gym.ope import BehaviorCloning, Logged, UniformPolicy, agreement_rate
from tests.domains.clif import Clif

ROOT = Path(__file__).parents[2]


def visits(*, offset: float = 0.0) -> Clif:
    """Ten visits of ten patients of ten events each; the even ones get a vasopressor, the first five oxygen."""
    made = Clif()
    for number in range(10):
        name = made.visit(f"v{number}", f"p{number}")
        for hour in range(1, 10):
            made.vital(name, hour, heart_rate=60 + number + offset, map=75 + hour)
        if number % 2 == 0:
            made.pressor(name, 4.5, 0.2)
        if number < 5:
            made.device(name, 0, "IMV")
    return made


def small_targets() -> dict[str, tuple[DQN, int]]:
    return {"one": (DQN(updates=3), 0), "other": (DQN(updates=3), 1), "slow": (DQN(updates=3, learning_rate=1e-5), 0)}


def test_the_targets_are_the_papers_five():
    default = DQN(learning_rate=1e-3, gamma=0.99)
    assert sepsis.TARGETS["dqn"] == (default, 0)
    changes = {
        name: {
            key
            for key in ("learning_rate", "gamma", "updates", "hidden", "batch_size", "target_every", "reward_scale")
            if getattr(settings, key) != getattr(default, key)
        }
        for name, (settings, _) in sepsis.TARGETS.items()
    }
    assert [len(change) for change in changes.values()] == [0, 1, 1, 0, 1]
    assert [seed for _, seed in sepsis.TARGETS.values()] == [0, 0, 0, 1, 0]


def test_policies_are_trained_once_for_the_same_data(tmp_path, monkeypatch):
    monkeypatch.setattr(sepsis, "TARGETS", small_targets())
    folder = visits().write(tmp_path / "one")
    seen = []
    fit = DQN.fit

    def counted(self, dataset, *, seed=0):
        seen.append({int(episode.infos["patient"][0]) for episode in dataset})
        return fit(self, dataset, seed=seed)

    monkeypatch.setattr(DQN, "fit", counted)
    first = sepsis.policies(folder)
    train, _ = sepsis_clif.train_test(sepsis_clif.sepsis_clif(folder))
    trained_on = {int(episode.infos["patient"][0]) for episode in train}
    assert seen == [trained_on] * 3
    again = sepsis.policies(folder)
    assert len(seen) == 3
    observations = train[0].observations
    rows = [policy.policy.q_values(observations) for policy in (*first.values(), *again.values())]
    for number in range(3):
        np.testing.assert_array_equal(rows[number], rows[number + 3])
    assert not np.allclose(rows[0], rows[1])
    probabilities = first["one"].probabilities(observations)
    assert set(np.unique(probabilities.round(6))) == {0.0125, 0.9625}
    sepsis.policies(visits(offset=1.0).write(tmp_path / "two"))
    assert len(seen) == 6


def test_the_shock_curve_by_hand(tmp_path):
    dataset = sepsis_clif.sepsis_clif(visits().write(tmp_path))
    shock = sepsis.in_shock(dataset)
    assert shock.sum() == 5

    class Always(UniformPolicy):
        def probabilities(self, observations):
            return np.eye(4)[np.full(len(observations["values"]), 3)]

    always = Always(dataset.action_space)  # antibiotics and oxygen: what five visits had at all nine steps
    logged = Logged.of(dataset)
    share = agreement_rate(logged, always)
    oxygen = np.array([(episode.actions >= 2).all() for episode in dataset])
    np.testing.assert_array_equal(share, oxygen)
    curve = sepsis.shock_curves(dataset, {"always": always})["always"]
    assert curve.low.tolist() == [0.0, 0.2, 0.4, 0.6, 0.8, 1.0]
    assert curve.count.tolist() == [10, 5, 5, 5, 5, 5]
    np.testing.assert_allclose(curve.rate, [0.5] + [(shock & oxygen).sum() / 5] * 5)
    assert (shock & oxygen).sum() == 3


def test_the_behaviour_is_cloned(tmp_path):
    dataset = sepsis_clif.sepsis_clif(visits().write(tmp_path))
    fitted = sepsis.behavior(dataset, config=BehaviorCloning(hidden=(16,), folds=2, max_updates=100))
    observations = {key: values[:4] for key, values in dataset[0].observations.items()}
    probabilities = fitted.policy().probabilities(observations)
    assert probabilities.shape == (4, 4)
    np.testing.assert_allclose(probabilities.sum(axis=1), 1, atol=1e-6)
    assert fitted.held_out_log_likelihood > np.log(1 / 4)


def test_no_truth_is_claimed():
    task = sepsis.TASKS["sepsis"]
    assert task.truth is None
    assert task.initial_states is None
    assert set(task.datasets) == set(sepsis.DATASETS)


@pytest.fixture(scope="module")
def build():
    """Return the build script as a module."""
    spec = importlib.util.spec_from_file_location("build_sepsis", ROOT / "datasets" / "build_sepsis.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.shared_data
def test_the_open_demo(shared_data, monkeypatch, build):
    monkeypatch.setenv("OAT_GYM_DATA", str(shared_data))
    dataset = sepsis.DATASETS["sepsis-clif"]()
    assert check_dataset(dataset)
    lengths = [len(episode) + 1 for episode in dataset]
    assert (len(lengths), sum(lengths), min(lengths), max(lengths)) == (83, 21595, 48, 1076)
    assert sepsis.in_shock(dataset).sum() == 60
    missing = 1 - np.concatenate([episode.observations["recorded"] for episode in dataset]).mean()
    assert missing == pytest.approx(0.777, abs=0.0005)
    for episode in dataset:
        assert (np.diff(episode.infos["time"]) > 0).all()
        np.testing.assert_array_equal(episode.rewards, rewards(episode.infos["stage"]))
        assert episode.terminations[-1]
    stays = sum(int((np.diff(episode.infos["stage"]) == 0).sum()) for episode in dataset)
    assert stays / dataset.total_steps > 0.85  # stages last: they do not flicker
    train, test = (sepsis.DATASETS[f"sepsis-clif-{part}"]() for part in ("train", "test"))
    assert (len(train), len(test)) == (69, 14)
    card = (ROOT / "datasets" / "sepsis-clif" / "README.md").read_text()
    assert build.numbers(dataset) in card  # the card's tables are those of the data


def test_the_list_of_open_visits_is_complete():
    digests = (ROOT / "datasets" / "sepsis-clif" / "open_visits.txt").read_text().split()
    assert len(set(digests)) == 275
    assert all(len(item) == 12 and int(item, 16) >= 0 for item in digests)
