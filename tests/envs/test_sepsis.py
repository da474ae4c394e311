"""The simulated ward: Gymnasium's contract, one patient as among many, stages and rewards, directions of effects."""

import doctest

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

from oat_gym.domains.sepsis_attributes import HIGH, LOW, NAMES
from oat_gym.domains.sepsis_belief import believed_values, current_values, last_known
from oat_gym.domains.sepsis_stages import PENALTIES, pressure_shock, stages
from oat_gym.envs import SEPSIS_ID, _sepsis_calibration, register, sepsis
from oat_gym.envs import _sepsis_model as model
from oat_gym.envs._sepsis_kernel import empty
from oat_gym.envs._sepsis_random import normal, uniform
from oat_gym.envs._sepsis_ward import Ward
from oat_gym.envs.sepsis import SepsisEnv, SepsisVectorEnv
from oat_gym.errors import ConfigurationError, InvalidDataError


def ward_of(n: int, *, horizon: int = 1160, seed: int = 0) -> Ward:
    ward = Ward(n, horizon=horizon)
    ward.admit(np.arange(n), np.random.default_rng(seed).integers(0, 2**63, n).astype(np.uint64))
    return ward


def actions_of(bed: int, steps: int) -> np.ndarray:
    return np.random.default_rng(1000 + bed).integers(0, 4, steps)


def test_gymnasiums_own_check_passes():
    register()
    check_env(gym.make(SEPSIS_ID).unwrapped)


@pytest.mark.parametrize("module", [sepsis])
def test_examples_in_docstrings(module):
    assert doctest.testmod(module, extraglobs={"np": np}).failed == 0


def test_gymnasium_makes_both_forms():
    register()
    envs = gym.make_vec(SEPSIS_ID, num_envs=3)
    assert isinstance(envs.unwrapped, SepsisVectorEnv)
    assert envs.metadata["autoreset_mode"] == AutoresetMode.NEXT_STEP
    assert envs.single_observation_space == gym.make(SEPSIS_ID).observation_space
    observations, _ = envs.reset(seed=1)
    assert envs.observation_space.contains(observations)


def test_a_patient_alone_and_among_others_is_the_same():
    steps, beds = 300, 5
    envs = SepsisVectorEnv(beds, horizon=120)
    seen, infos = envs.reset(seed=7)
    rows = [(seen, np.zeros(beds), np.zeros(beds, bool), np.zeros(beds, bool), infos)]
    plans = np.stack([actions_of(bed, steps) for bed in range(beds)])
    rows += [envs.step(plans[:, step]) for step in range(steps)]
    for bed in (0, 3):
        env = SepsisEnv(horizon=120)
        one, info = env.reset(seed=7 + bed)
        ended = False
        for step in range(steps + 1):
            observations, rewards, terminated, truncated, infos = rows[step]
            if step and ended:
                one, info = env.reset()
                assert not (rewards[bed] or terminated[bed] or truncated[bed])
                ended = False
            elif step:
                one, reward, end, cut, info = env.step(plans[bed, step - 1])
                assert (rewards[bed], terminated[bed], truncated[bed]) == (reward, end, cut)
                ended = end or cut
            for name, values in one.items():
                np.testing.assert_array_equal(observations[name][bed], values)
            assert {name: infos[name][bed].item() for name in info} == info


def test_the_step_after_an_end_admits_the_next_patient():
    envs = SepsisVectorEnv(4, horizon=3)
    envs.reset(seed=0)
    for step in range(12):
        _, rewards, terminated, truncated, infos = envs.step(np.full(4, 3))
        if step % 4 == 3:
            assert (infos["time"] == 0).all()
            assert not (rewards.any() or terminated.any() or truncated.any())
        else:
            assert (infos["time"] > 0).all()
        np.testing.assert_array_equal(terminated | truncated, np.full(4, step % 4 == 2))


def test_the_same_seeds_give_the_same_patients_and_others_do_not():
    def course(seed):
        envs = SepsisVectorEnv(3)
        seen = [envs.reset(seed=seed)[0]["values"]]
        return np.stack(seen + [envs.step(np.array([0, 1, 3]))[0]["values"] for _ in range(20)])

    np.testing.assert_array_equal(course(5), course(5))
    np.testing.assert_array_equal(course(5)[:, 1:2], course([99, 6, 98])[:, 1:2])
    assert (course(5) != course(50)).any(axis=(0, 2)).all()
    envs = SepsisVectorEnv(3)
    envs.reset(seed=5)
    assert (envs.reset()[0]["values"] != course(5)[0]).any()  # without a seed the next patients come


def test_what_is_returned_is_the_callers_own():
    envs = SepsisVectorEnv(2)
    seen, infos = envs.reset(seed=0)
    kept = {name: values.copy() for name, values in seen.items()}
    time = infos["time"]
    for _ in range(5):
        envs.step(np.array([1, 2]))
    assert (time == 0).all()
    for name, values in kept.items():
        np.testing.assert_array_equal(seen[name], values)


def test_stages_beliefs_and_rewards_are_those_of_the_real_visits_rules():
    n, events = 60, 120
    ward, rng = ward_of(n), np.random.default_rng(0)
    recorded, hours, stage, believed, vaso, rewards = [], [], [], [], [], []

    def note():
        recorded.append(np.where(ward.patients.ages == 0, ward.patients.values, np.nan))
        hours.append(ward.patients.hours.copy())
        stage.append(ward.stage.copy())
        believed.append(ward.observations()["values"])
        vaso.append((ward.patients.hidden[:, model.VASOPRESSOR] > 0) | ward.died)

    note()
    going_on = np.ones(n, dtype=bool)
    for _ in range(events):
        rewards.append(ward.treat(rng.integers(0, 4, n), going_on).rewards)
        note()
    persistent = 0
    for patient in range(n):
        log = np.stack([row[patient] for row in recorded])
        times = np.array([row[patient] for row in hours])
        known = last_known(log, times)
        by_pressure = pressure_shock(log, times)
        persistent += by_pressure.sum()
        shock = by_pressure | np.array([row[patient] for row in vaso])
        seen = np.array([row[patient] for row in stage])
        np.testing.assert_array_equal(seen, stages(current_values(known), shock))
        values = np.clip(believed_values(known), LOW, HIGH)
        np.testing.assert_allclose(np.stack([row[patient] for row in believed]), values, rtol=1e-5)
        potential = -np.cumsum(PENALTIES)[seen]
        np.testing.assert_allclose(np.cumsum([row[patient] for row in rewards]), potential[1:] - potential[0])
    assert persistent > 20  # the rule of two low readings was put to the test


def test_what_is_measured_has_the_real_marginals():
    ward = ward_of(4000)
    known = ward.patients.ages == 0
    expected = np.array(_sepsis_calibration.KIND_SHARES) @ np.array(_sepsis_calibration.KIND_MEASURED)
    np.testing.assert_allclose(known.mean(axis=0), expected, atol=4 * np.sqrt(0.25 / 4000))
    assert 1 - expected.mean() == pytest.approx(0.777, abs=0.005)
    ward.treat(np.zeros(4000, dtype=np.int64), np.ones(4000, dtype=bool))
    hours = np.quantile(ward.patients.hours, (0.3, 0.5, 0.7))
    table = np.interp((0.3, 0.5, 0.7), _sepsis_calibration.COUNT_LEVELS, _sepsis_calibration.HOURS_BETWEEN_EVENTS)
    np.testing.assert_allclose(hours, table, rtol=0.15, atol=0.03)
    low, high = (np.array(_sepsis_calibration.VALUE_QUANTILES)[:, end] for end in (0, -1))
    values = np.where(known, ward.patients.values, low)
    assert (values >= low - 1e-9).all()
    assert (values <= high + 1e-9).all()


def outcome_of(action: int, *, n: int = 400, steps: int = 120) -> dict[str, float]:
    ward = ward_of(n, seed=3)
    going_on, dead = np.ones(n, dtype=bool), np.zeros(n, dtype=bool)
    total = np.zeros(n)
    for _ in range(steps):
        outcome = ward.treat(np.full(n, action), going_on)
        dead |= ward.died
        total += outcome.rewards
        going_on &= ~ward.died
    levels = {"pathogen": model.PATHOGEN, "hypoxia": model.HYPOXIA, "antibiotic": model.ANTIBIOTIC}
    found = {name: float(ward.patients.hidden[:, column].mean()) for name, column in levels.items()}
    return found | {"deaths": float(dead.mean()), "return": float(total.mean())}


def test_treatments_do_what_they_are_for():
    none, antibiotics, oxygen, both = (outcome_of(action) for action in range(4))
    assert antibiotics["pathogen"] < 0.2 * none["pathogen"]
    assert oxygen["hypoxia"] < 0.5 * none["hypoxia"]
    assert both["return"] > antibiotics["return"] > none["return"] + 10
    assert none["deaths"] > antibiotics["deaths"] + 0.2
    assert both["deaths"] <= antibiotics["deaths"]


def test_treatments_harm_those_who_do_not_need_them():
    damage = []
    for action in range(4):
        ward = ward_of(200)
        ward.patients.hidden[:] = 0.0
        ward.patients.traits[:, model.CHRONIC_LUNG] = 0.0
        for _ in range(60):
            ward.patients.hidden[:, model.PATHOGEN] = 0.0
            ward.treat(np.full(200, action), np.ones(200, dtype=bool))
        damage.append(ward.patients.hidden[:, model.DAMAGE].mean())
    assert damage[0] < min(damage[1], damage[2])
    assert max(damage[1], damage[2]) < damage[3]


def test_a_stay_ends_with_death_or_discharge_but_not_in_shock():
    ward = ward_of(300)
    going_on = np.ones(300, dtype=bool)
    deaths = discharges = 0
    while going_on.any():
        outcome = ward.treat(np.full(300, 1), going_on)
        discharged = outcome.terminated & ~ward.died
        assert (ward.stage[discharged] < 4).all()
        assert (ward.patients.steps[discharged] + 1 >= ward.patients.traits[discharged, model.PLANNED_EVENTS]).all()
        assert (ward.stage[ward.died] == 4).all()
        assert not (outcome.terminated & outcome.truncated).any()
        deaths += int(ward.died.sum())
        discharges += int(discharged.sum())
        going_on &= ~(outcome.terminated | outcome.truncated)
    assert deaths > 5
    assert discharges > 100


def test_counted_random_numbers_are_uniform_normal_and_unrelated():
    keys = np.arange(1, 5).astype(np.uint64) * np.uint64(7919)
    numbers = np.array([[uniform(key, step, draw) for step in range(400) for draw in (0, 1)] for key in keys])
    assert numbers.min() > 0
    assert numbers.max() < 1
    np.testing.assert_allclose(np.histogram(numbers, bins=10, range=(0, 1))[0] / numbers.size, 0.1, atol=0.025)
    related = np.corrcoef(np.concatenate([numbers[:, ::2], numbers[:, 1::2]]))
    assert np.abs(related - np.eye(8)).max() < 0.25
    drawn = np.array([normal(keys[0], step, 5) for step in range(4000)])
    assert abs(drawn.mean()) < 0.07
    assert drawn.std() == pytest.approx(1, abs=0.05)


def test_wrong_use_says_what_is_wrong():
    with pytest.raises(ConfigurationError, match="num_envs must be at least 1"):
        SepsisVectorEnv(0)
    with pytest.raises(ConfigurationError, match="horizon"):
        SepsisEnv(horizon=0)
    with pytest.raises(ConfigurationError, match="render_mode"):
        SepsisEnv(render_mode="human")
    env, envs = SepsisEnv(), SepsisVectorEnv(2)
    with pytest.raises(ConfigurationError, match="call reset"):
        env.step(0)
    with pytest.raises(ConfigurationError, match="reset before step"):
        envs.step(np.array([0, 0]))
    with pytest.raises(ConfigurationError, match="2 environments take"):
        envs.reset(seed=[1, 2, 3])
    envs.reset(seed=0)
    for wrong in (np.array([0]), np.array([0.0, 1.0]), np.array([0, 4]), np.array([-1, 0])):
        with pytest.raises(InvalidDataError):
            envs.step(wrong)


def test_every_attribute_has_loadings_and_columns():
    assert set(model.LOADINGS) == set(NAMES)
    assert model.loadings(NAMES).shape == (15, len(model.SHOWN))
    assert empty(3).values.shape == (3, 15)
