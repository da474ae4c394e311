"""The maze's target policies, their true values, and the memoryless planner that they learned from."""

import tempfile

import numpy as np
import pytest

from oat_gym import domains
from oat_gym.domains.maze2d_env import HORIZON, initial_states, open_mazes
from oat_gym.domains.maze2d_layout import UMAZE
from oat_gym.domains.maze2d_planner import Planner, memoryless_actions, next_points
from oat_gym.domains.maze2d_policies import NAMES, NOISE, load_policy, maze_policy, save_layers
from oat_gym.domains.rollout import roll_out
from oat_gym.domains.truth import discounted_returns
from oat_gym.errors import ConfigurationError, InvalidDataError
from oat_gym.ope import PolicySet


@pytest.fixture(scope="module")
def policies():
    return domains.policies("maze2d-umaze")


@pytest.fixture(scope="module")
def states():
    episodes = [domains.load("maze2d-umaze")[number] for number in (3, 50, 120)]
    return {key: np.concatenate([e.observations[key][:-1] for e in episodes]) for key in episodes[0].observations}


def rows(states, chosen):
    return {key: values[chosen] for key, values in states.items()}


def test_there_are_eleven_policies_evaluated_in_one_product(policies):
    assert tuple(policies) == NAMES
    assert len(PolicySet.of(policies)._groups) == 1


def test_a_policy_on_a_batch_is_the_policy_on_each_row_and_in_a_set(policies, states):
    few = rows(states, slice(0, 40, 8))
    together = PolicySet.of(policies)
    for number, policy in enumerate(policies.values()):
        mean = policy.mean(few)
        alone = [policy.mean(rows(states, slice(i, i + 1)))[0] for i in range(0, 40, 8)]
        np.testing.assert_allclose(mean, alone, atol=1e-6)
        np.testing.assert_allclose(mean, together.mean(few)[number], atol=1e-6)
        density = together.log_prob(few, mean)[number]
        np.testing.assert_allclose(policy.log_prob(few, mean), density, atol=1e-6)


def test_log_prob_is_a_distribution_of_density_inside_and_mass_on_the_bounds(policies, states):
    """Integrated over the open square, its edges and its corners, the likelihood is one."""
    count = 200
    inside = (np.arange(count) + 0.5) * 2 / count - 1
    values, weights = np.r_[-1.0, inside, 1.0], np.r_[1.0, np.full(count, 2 / count), 1.0]
    actions = np.stack(np.meshgrid(values, values, indexing="ij"), axis=-1).reshape(-1, 2)
    one = rows(states, np.full(len(actions), 20))
    for name in ("umaze-0", "umaze-5", "umaze-10"):
        likelihood = np.exp(policies[name].log_prob(one, actions))
        assert likelihood @ np.outer(weights, weights).ravel() == pytest.approx(1.0, abs=1e-3)


def test_samples_scatter_around_the_mean(policies, states):
    one = rows(states, np.zeros(4000, dtype=int) + 30)
    policy = policies["umaze-4"]
    drawn = policy.sample(one, rng=np.random.default_rng(0))
    assert drawn.dtype == np.float32
    assert np.abs(drawn).max() <= 1
    inside = np.abs(policy.mean(one)[0]) < 0.2  # where clipping hardly changes the moments
    assert inside.any()
    np.testing.assert_allclose(drawn.mean(axis=0)[inside], policy.mean(one)[0][inside], atol=0.03)
    np.testing.assert_allclose(drawn.std(axis=0)[inside], NOISE, atol=0.03)


def test_the_best_policy_does_what_the_planner_does_and_the_worst_does_not(policies, states):
    wanted = memoryless_actions(states["observation"], states["desired_goal"], planner=Planner())
    error = [np.abs(policy.mean(states) - wanted).mean() for policy in policies.values()]
    assert np.argmin(error) == 10
    assert np.argmax(error) == 0
    assert error[10] < error[0] / 2


def test_values_rise_from_bad_to_the_planners_in_steps_of_several_standard_errors():
    found = domains.truth("maze2d-umaze", gamma=0.995)
    values, errors = (np.array([getattr(found, field)[n] for n in NAMES]) for field in ("values", "standard_errors"))
    assert (found.horizon, found.episodes) == (HORIZON, 1000)
    assert (np.diff(values) > 2 * np.hypot(errors[1:], errors[:-1])).all()
    assert values[0] < 0.15
    lengths = np.array([len(episode) for episode in domains.load("maze2d-umaze")])
    data = np.mean(0.995 ** (lengths - 1))
    assert abs(values[-1] - data) < 0.05, "the best policy walks as well as the data's planner"


def test_the_stored_truth_agrees_with_fresh_roll_outs(policies, tmp_path, monkeypatch):
    """Other seeds, so that the difference is that of independent means."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    found, count = domains.truth("maze2d-umaze", gamma=0.995), 24
    with open_mazes(8) as envs:
        for name in ("umaze-3", "umaze-10"):
            made = roll_out(envs, policies[name], seeds=range(5000, 5000 + count), horizon=HORIZON, policy_seed=7)
            mean = discounted_returns(made.rewards, 0.995).mean()
            error = np.hypot(found.standard_deviations[name] / count**0.5, found.standard_errors[name])
            assert abs(mean - found.values[name]) < 4 * error
    assert not list(tmp_path.iterdir()), "the environments' XML files were left behind"


def test_initial_states_are_the_environments(tmp_path):
    first, again, other = (initial_states(40, seed) for seed in (1, 1, 2))
    assert {key: rows.shape for key, rows in first.items()} == {
        "observation": (40, 4),
        "achieved_goal": (40, 2),
        "desired_goal": (40, 2),
    }
    for key in first:
        np.testing.assert_array_equal(first[key], again[key])
    assert (first["desired_goal"] != other["desired_goal"]).any()
    assert not first["observation"][:, 2:].any(), "episodes start at rest"
    assert (np.linalg.norm(first["achieved_goal"] - first["desired_goal"], axis=1) > 0.1).all()
    with pytest.raises(ConfigurationError, match="count"):
        initial_states(0, 0)


def test_the_memoryless_planner_heads_for_the_next_cell_and_at_last_for_the_goal():
    goal = UMAZE.center((3, 1)) + 0.1
    for cell in UMAZE.free:
        (point,) = next_points(UMAZE.center(cell)[None] + 0.2, goal[None])
        path = UMAZE.shortest_path(cell, (3, 1))
        np.testing.assert_array_equal(point, goal if len(path) <= 2 else UMAZE.center(path[1]))
    force = memoryless_actions(np.array([[-1.0, 1.0, 0.0, 0.0]]), goal[None], planner=Planner())
    assert force.tolist() == [[1.0, 0.0]]
    with pytest.raises(ConfigurationError, match="free cells"):
        next_points(np.array([[0.0, 0.0]]), goal[None])
    with pytest.raises(ConfigurationError, match="negative"):
        Planner(noise=-0.1)


def test_saved_layers_come_back_and_damaged_files_are_refused(tmp_path, states):
    rng = np.random.default_rng(0)
    layers = [(rng.standard_normal((o, i)), rng.standard_normal(o)) for i, o in ((6, 5), (5, 5), (5, 2))]
    path = tmp_path / "a.safetensors"
    save_layers(path, layers)
    few = rows(states, slice(0, 3))
    np.testing.assert_allclose(load_policy(path).mean(few), maze_policy(layers).mean(few), atol=1e-5)
    content = path.read_bytes()
    save_layers(path, layers)
    assert path.read_bytes() == content
    for broken in (content[:-8], content[:-1] + bytes([content[-1] ^ 1]), b""):
        path.write_bytes(broken)
        with pytest.raises(InvalidDataError, match="not a whole file"):
            load_policy(path)


def test_other_observations_are_refused(policies):
    with pytest.raises(InvalidDataError, match="dict of observation"):
        policies["umaze-0"].mean(np.zeros((3, 4)))
