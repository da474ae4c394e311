"""sepsis-sim: the log of the clinician, its policies and their stored values against fresh roll-outs."""

import doctest
import json

import numpy as np
import pytest

from oat_gym.checks import check_dataset
from oat_gym.domains import _sepsis_clinician, sepsis_sim
from oat_gym.domains._sepsis_clinician import Clinician
from oat_gym.domains.rollout import roll_out
from oat_gym.domains.sepsis import GAMMA
from oat_gym.domains.sepsis_attributes import NAMES
from oat_gym.domains.sepsis_stages import PENALTIES
from oat_gym.domains.truth import discounted_returns
from oat_gym.envs import _sepsis_calibration as calibration
from oat_gym.errors import ConfigurationError


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("OAT_GYM_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield sepsis_sim.load()


def test_examples_in_docstrings():
    assert doctest.testmod(_sepsis_clinician, extraglobs={"np": np}).failed == 0


def test_the_log_passes_the_checks(dataset, tmp_path):
    check_dataset(sepsis_sim.write_visits(tmp_path / "few", visits=12, seed=0))
    assert len(dataset) == sepsis_sim.VISITS
    assert dataset.id == "oat_gym/sepsis-sim-v0"


def test_recorded_log_probabilities_are_the_clinicians(dataset):
    for episode in dataset.iterate_episodes(range(15)):
        before = {name: rows[:-1] for name, rows in episode.observations.items()}
        expected = Clinician().log_prob(before, episode.actions)
        np.testing.assert_allclose(episode.infos["log_prob"], expected, rtol=1e-12)


def test_rewards_telescope_and_infos_belong_to_events(dataset):
    potential = -np.cumsum(PENALTIES)
    for episode in dataset:
        steps, stage, time = len(episode.rewards), episode.infos["stage"], episode.infos["time"]
        assert len(stage) == len(time) == steps + 1
        assert time[0] == 0
        assert (np.diff(time) > 0).all()
        np.testing.assert_array_equal(np.diff(potential[stage]), episode.rewards)
        assert episode.rewards.sum() == potential[stage[-1]] - potential[stage[0]]
        chosen = np.stack([episode.actions % 2, episode.actions // 2], axis=1)
        np.testing.assert_array_equal(episode.observations["treatments"][1:], chosen)


def test_marginals_are_near_those_of_the_real_records(dataset):
    recorded = np.concatenate([episode.observations["recorded"] for episode in dataset]) == 1
    values = np.concatenate([episode.observations["values"] for episode in dataset])
    assert 1 - recorded.mean() == pytest.approx(0.777, abs=0.01)
    for column, name in enumerate(NAMES):
        real = np.array(calibration.VALUE_QUANTILES[column])  # at 5, 10, 25, 40, 60, 75, 90 and 95%: 2, 3, 4, 5, 7, ...
        low, median, high = np.quantile(values[recorded[:, column], column], (0.15, 0.5, 0.85))
        assert real[2] <= low <= real[5], name
        assert real[4] <= median <= real[8], name
        assert real[7] <= high <= real[10], name


def test_a_build_is_the_same_bytes_again_and_other_seeds_are_not(tmp_path):
    content = []
    for name, seed in (("a", 3), ("b", 3), ("c", 4)):
        folder = sepsis_sim.write_visits(tmp_path / name, visits=3, seed=seed).storage.data_path
        content.append([(folder / file).read_bytes() for file in ("main_data.hdf5", "metadata.json")])
    assert content[0] == content[1]
    assert content[0][0] != content[2][0]


def test_the_stored_values_are_those_of_fresh_roll_outs():
    truth, targets = sepsis_sim.truth(GAMMA), sepsis_sim.policies()
    assert list(truth.values) == list(targets)
    assert truth.episodes >= 1000
    ward = sepsis_sim.open_ward(250)
    for name in ("dqn", "dqn-gamma-0.9", "no-treatment"):
        rewards = roll_out(ward, targets[name], seeds=range(250), horizon=sepsis_sim.HORIZON, policy_seed=9).rewards
        returns = discounted_returns(rewards, GAMMA)
        error = np.hypot(returns.std(ddof=1) / 250**0.5, truth.standard_errors[name])
        assert abs(returns.mean() - truth.values[name]) < 4 * error, name


def test_policies_are_told_apart_by_their_true_values():
    truth = sepsis_sim.truth(GAMMA)
    assert truth.values["both-treatments"] > truth.values["clinician"] > truth.values["no-treatment"]
    spread = max(truth.values.values()) - min(truth.values.values())
    assert spread > 20 * max(truth.standard_errors.values())


def test_initial_states_are_on_admission():
    starts = sepsis_sim.initial_states(30, 5)
    assert not starts["treatments"].any()
    np.testing.assert_array_equal(starts["values"], sepsis_sim.initial_states(30, 5)["values"])
    recorded = {row.tobytes() for episode in sepsis_sim.load() for row in episode.observations["values"][:1]}
    for seed in (0, 6):  # a few patients are alike: those who come with normal values
        other = {row.tobytes() for row in sepsis_sim.initial_states(30, seed)["values"]}
        assert len(other & ({row.tobytes() for row in starts["values"]} | recorded)) < 5


def test_a_clinician_keeps_what_runs_and_answers_to_signs():
    well = np.array([75, 36.8, 120, 85, 16, 98, 0.21, 90, 15, 7.5, 250, 1, 0.9, 14, 0.6])
    fever, breathless = well.copy(), well.copy()
    fever[NAMES.index("temperature")] = 39.5
    breathless[NAMES.index("oxygen_saturation")] = 88

    def chances(values, treatments):
        row = Clinician().probabilities({"values": values[None], "treatments": np.array([treatments])})[0]
        assert row.sum() == pytest.approx(1)
        return row[1] + row[3], row[2] + row[3]

    assert chances(fever, (0, 0))[0] > chances(well, (0, 0))[0]
    assert chances(breathless, (0, 0))[1] > chances(well, (0, 0))[1]
    assert chances(well, (1, 0))[0] > 0.9
    assert chances(well, (0, 0))[1] < 0.1
    with pytest.raises(ConfigurationError, match="finite"):
        Clinician(oxygen=float("nan"))


def test_the_calibration_holds_no_single_record():
    table = {name: getattr(calibration, name) for name in dir(calibration) if name.isupper()}
    assert sum(np.size(value) for value in table.values()) < 700
    assert len(json.dumps(table)) < 20_000
