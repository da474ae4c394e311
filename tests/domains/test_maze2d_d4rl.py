"""D4RL's view of the maze: frames, start, reward, data, and DOPE's published returns."""

import json

import numpy as np
import pytest

from oat_gym import domains
from oat_gym.checks import check_dataset
from oat_gym.domains import maze2d_d4rl as module
from oat_gym.domains.maze2d_d4rl import D4RLMaze
from oat_gym.domains.maze2d_env import open_maze
from oat_gym.domains.maze2d_layout import UMAZE
from oat_gym.domains.rollout import roll_out
from oat_gym.errors import DatasetNotFoundError

TASK = "maze2d-umaze-d4rl"


def test_frames_are_inverse_and_put_cells_where_d4rl_has_them():
    """D4RL's walls are boxes at (row + 1, column + 1) and its point's body is at (1.2, 1.2)."""
    for row, column in UMAZE.free:
        x, y = UMAZE.center((row, column))
        np.testing.assert_allclose(module.d4rl_states([x, y, 0, 0])[:2], [row - 0.2, column - 0.2])
    states, actions = np.random.default_rng(0).standard_normal((2, 5, 4))
    np.testing.assert_allclose(module.pointmaze_states(module.d4rl_states(states)), states, atol=1e-12)
    forces = actions[:, :2]
    np.testing.assert_allclose(module.pointmaze_actions(module.d4rl_actions(forces)), forces)


def test_forces_and_velocities_turn_alike():
    """The frames differ by a rotation: what turns the velocity turns the force."""
    pairs = np.random.default_rng(0).standard_normal((6, 2))
    turned = module.d4rl_states(np.concatenate([np.zeros((6, 2)), pairs], axis=1))[:, 2:]
    np.testing.assert_array_equal(turned, module.d4rl_actions(pairs))


def test_an_action_moves_the_point_along_its_own_axis():
    with open_maze() as maze:
        env = D4RLMaze(maze)
        for action in ([1, 0], [-1, 0], [0, 1], [0, -1]):
            before, _ = env.reset(seed=3)
            after, *_ = env.step(np.array(action, dtype=np.float32))
            change = after[2:] - before[2:]
            assert np.argmax(np.abs(change)) == np.argmax(np.abs(action))
            assert np.sign(change[np.argmax(np.abs(action))]) == sum(action)


def test_starts_are_d4rls():
    first = domains.initial_states(TASK, count=400, seed=0)
    cells = np.round(first[:, :2]).astype(int)
    assert {tuple(map(int, cell)) for cell in cells} == set(UMAZE.free)
    assert np.abs(first[:, :2] - cells).max() <= 0.1
    np.testing.assert_allclose(first[:, 2:].std(axis=0), 0.1, rtol=0.2)


def test_the_data_is_the_embedded_one_turned(tmp_path):
    mine, theirs = domains.load("maze2d-umaze"), domains.load(TASK)
    check_dataset(theirs)
    assert (len(theirs), theirs.total_steps) == (len(mine), mine.total_steps)
    earned = 0.0
    for one, other in zip(mine, theirs, strict=True):
        np.testing.assert_allclose(
            module.pointmaze_states(other.observations), one.observations["observation"], atol=1e-9
        )
        np.testing.assert_array_equal(module.pointmaze_actions(other.actions), one.actions)
        goal = module.pointmaze_states([*module.GOAL, 0, 0])[:2]
        near = np.linalg.norm(one.observations["achieved_goal"][1:] - goal, axis=1) <= 0.5
        np.testing.assert_array_equal(other.rewards, near)
        assert not other.terminations.any()
        assert other.truncations.nonzero()[0].tolist() == [len(near) - 1]
        earned += other.rewards.sum()
    assert earned > 100, "hardly any reward: a weak test"


def test_missing_policies_say_how_to_get_them(tmp_path):
    with pytest.raises(DatasetNotFoundError, match="google-research/deep_ope"):
        module.dope_policies(tmp_path)


@pytest.mark.shared_data
def test_dopes_policies_earn_what_dope_published(shared_data, monkeypatch):
    """The stored truth against DOPE's means (100 episodes each, as its standard deviations say how sure they are)."""
    monkeypatch.setenv("OAT_GYM_DATA", str(shared_data))
    published = json.loads((shared_data / "robotics/dope_policies/d4rl_policies.json").read_text())
    found = domains.truth(TASK, gamma=1.0)
    mine, theirs = [], []
    for row in published:
        name = row["policy_path"].split("/")[-1].removesuffix(".pkl")
        if name in found.values:
            error = np.hypot(row["return_std:"] / 100**0.5, found.standard_errors[name])
            assert abs(found.values[name] - row["return_mean"]) < 4 * error
            mine.append(found.values[name])
            theirs.append(row["return_mean"])
    assert len(mine) == 11
    assert np.corrcoef(np.argsort(np.argsort(mine)), np.argsort(np.argsort(theirs)))[0, 1] > 0.95


@pytest.mark.shared_data
def test_the_stored_truth_agrees_with_fresh_roll_outs(shared_data, monkeypatch):
    monkeypatch.setenv("OAT_GYM_DATA", str(shared_data))
    found, policies = domains.truth(TASK, gamma=1.0), domains.policies(TASK)
    assert list(policies) == list(found.values)
    with module.open_d4rl_mazes(8) as envs:
        for name in ("maze2d_umaze_dapg_0", "maze2d_umaze_dapg_10"):
            made = roll_out(envs, policies[name], seeds=range(900, 916), horizon=300)
            error = np.hypot(found.standard_deviations[name] / 4, found.standard_errors[name])
            assert abs(made.rewards.sum(axis=1).mean() - found.values[name]) < 4 * error
            assert (made.lengths == 300).all()
