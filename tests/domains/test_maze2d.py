"""The embedded maze dataset, its build script and the maze's geometry."""

import importlib.util
import sys
import tempfile
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from types import ModuleType

import minari
import numpy as np
import pytest
from gymnasium_robotics.envs.maze import maps
from gymnasium_robotics.envs.maze.maze_v4 import Maze as PointMazeMaze

from oat_gym import domains
from oat_gym.domains.maze2d import UMAZE, Maze
from oat_gym.errors import ConfigurationError

ROOT = Path(__file__).parents[2]
SUCCESS_DISTANCE = 0.45
CORRIDOR = Maze(((1, 1, 1, 1), (1, 0, 0, 1), (1, 1, 1, 1)), size=2.0)


@pytest.fixture(scope="module")
def dataset() -> minari.MinariDataset:
    return domains.load("maze2d-umaze")


@pytest.fixture(scope="module")
def script() -> Iterator[ModuleType]:
    name = "build_maze2d_umaze"
    spec = importlib.util.spec_from_file_location(name, ROOT / "datasets" / f"{name}.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    yield module
    del sys.modules[name]


@pytest.fixture
def temporary_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    yield folder


def test_the_dataset_has_250_episodes_of_unequal_lengths(dataset):
    lengths = [len(episode) for episode in dataset]
    assert len(dataset) == 250
    assert sum(lengths) == dataset.total_steps == 17_584
    assert len(set(lengths)) > 50
    assert dataset.id == "oat_gym/maze2d-umaze-v0"


def test_every_episode_keeps_the_t_plus_1_rule_and_its_spaces(dataset):
    for episode in dataset:
        steps = len(episode.rewards)
        assert [len(rows) for rows in episode.observations.values()] == [steps + 1] * 3
        assert len(episode.actions) == len(episode.terminations) == len(episode.truncations) == steps
        assert len(episode.infos["success"]) == steps + 1
        first = {key: rows[0] for key, rows in episode.observations.items()}
        assert dataset.observation_space.contains(first)
        assert all(dataset.action_space.contains(action) for action in episode.actions)


def test_an_episode_terminates_exactly_where_it_comes_to_its_goal(dataset):
    for episode in dataset:
        seen = episode.observations
        distance = np.linalg.norm(seen["achieved_goal"] - seen["desired_goal"], axis=1)
        arrived = distance[1:] <= SUCCESS_DISTANCE
        np.testing.assert_array_equal(episode.terminations, arrived)
        np.testing.assert_array_equal(episode.rewards, arrived.astype(float))
        assert not episode.terminations[:-1].any()
        assert episode.truncations.sum() == (0 if arrived[-1] else 1)
        assert (seen["desired_goal"] == seen["desired_goal"][0]).all()


def test_no_position_is_inside_a_wall(dataset):
    for episode in dataset:
        for position in episode.observations["achieved_goal"]:
            assert UMAZE.cell_of(position) in UMAZE.free


def test_recorded_actions_replay_to_the_recorded_observations(dataset, script, temporary_folder):
    with script.open_maze() as env:
        for number in (0, 100, 249):
            episode = dataset[number]
            (metadata,) = dataset.storage.get_episode_metadata([number])
            replayed = [env.reset(seed=metadata["seed"])[0]]
            rewards = []
            for action in episode.actions:
                observation, reward, *_ = env.step(action)
                replayed.append(observation)
                rewards.append(reward)
            for key, rows in episode.observations.items():
                np.testing.assert_allclose([row[key] for row in replayed], rows, atol=1e-6)
            np.testing.assert_array_equal(rewards, episode.rewards)


def test_the_environment_can_be_recovered_and_ends_in_its_goal(dataset, temporary_folder):
    env = dataset.recover_environment()
    assert env.observation_space == dataset.observation_space
    assert env.action_space == dataset.action_space
    assert env.unwrapped.continuing_task is False
    env.close()


def test_two_builds_with_one_seed_are_the_same_bytes_and_another_seed_is_not(script, tmp_path, temporary_folder):
    for name, seed in (("a", 5), ("b", 5), ("c", 6)):
        script.build(tmp_path / name, episodes=3, seed=seed, reference_episodes=1)
    files = ["data/main_data.hdf5", "data/metadata.json", "trajectories.png"]
    assert sorted(str(p.relative_to(tmp_path / "a")) for p in (tmp_path / "a").rglob("*.*")) == files
    a, b, c = ([(tmp_path / name / file).read_bytes() for file in files] for name in "abc")
    assert a == b
    assert a[0] != c[0]
    assert not list(temporary_folder.iterdir()), "the environment's XML files were left behind"


def test_the_embedded_dataset_is_what_the_script_builds(dataset, script, tmp_path, temporary_folder):
    """The first episodes do not depend on how many are built."""
    script.build(tmp_path / "few", episodes=3, seed=0, reference_episodes=1)
    for built, embedded in zip(minari.MinariDataset(tmp_path / "few" / "data"), dataset, strict=False):
        np.testing.assert_allclose(built.observations["observation"], embedded.observations["observation"], atol=1e-6)
        np.testing.assert_allclose(built.actions, embedded.actions, atol=1e-6)


def test_the_folder_is_small_and_opening_it_writes_nothing(dataset):
    folder = ROOT / "datasets" / "maze2d-umaze"
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*")}
    list(domains.load("maze2d-umaze"))
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*")} == before
    assert sum(path.stat().st_size for path in before) < 5_000_000
    assert (folder / "trajectories.png").stat().st_size < 150_000


def test_the_card_states_the_statistics_of_the_data(dataset):
    lengths = np.array([len(episode) for episode in dataset])
    card = (ROOT / "datasets" / "maze2d-umaze" / "README.md").read_text()
    quartiles = ", ".join(f"{value:.0f}" for value in np.percentile(lengths, [25, 50, 75]))
    assert f"{lengths.min()} to {lengths.max()}; quartiles {quartiles}; mean {lengths.mean():.1f}" in card
    assert f"{np.mean(0.99 ** (lengths - 1)):.3f} at gamma 0.99, {np.mean(0.995 ** (lengths - 1)):.3f}" in card
    actions = np.concatenate([episode.actions for episode in dataset])
    assert f"{100 * np.mean(np.abs(actions) == 1):.0f}% of the entries" in card


def test_geometry_agrees_with_the_environment():
    assert [list(row) for row in UMAZE.cells] == maps.U_MAZE
    reference = PointMazeMaze(maps.U_MAZE, 1.0, 0.4)
    for cell in UMAZE.free:
        np.testing.assert_allclose(UMAZE.center(cell), reference.cell_rowcol_to_xy(np.array(cell)))
        position = UMAZE.center(cell) + np.array([0.3, -0.4])
        assert UMAZE.cell_of(position) == tuple(reference.cell_xy_to_rowcol(position)) == cell


def test_walls_cover_the_wall_cells_and_nothing_else():
    walls = CORRIDOR.walls()
    assert walls.shape == (10, 4)
    assert walls[:, 2:].prod(axis=1).sum() == 10 * CORRIDOR.size**2
    for cell in CORRIDOR.free:
        x, y = CORRIDOR.center(cell)
        inside = (
            (walls[:, 0] < x) & (x < walls[:, 0] + walls[:, 2]) & (walls[:, 1] < y) & (y < walls[:, 1] + walls[:, 3])
        )
        assert not inside.any()


def test_the_shortest_path_is_shortest():
    """In the U, the only simple path goes round; in an open room, it has Manhattan length."""
    assert UMAZE.shortest_path((1, 1), (3, 1)) == [(1, 1), (1, 2), (1, 3), (2, 3), (3, 3), (3, 2), (3, 1)]
    room = Maze(tuple((0,) * 5 for _ in range(4)))
    for start in room.free:
        for goal in room.free:
            path = room.shortest_path(start, goal)
            assert len(path) - 1 == abs(start[0] - goal[0]) + abs(start[1] - goal[1])
            assert all(abs(a[0] - b[0]) + abs(a[1] - b[1]) == 1 for a, b in pairwise(path))


def test_impossible_paths_and_maps_are_refused():
    with pytest.raises(ConfigurationError, match="must be free cells"):
        UMAZE.shortest_path((0, 0), (1, 1))
    with pytest.raises(ConfigurationError, match="No path joins"):
        Maze(((0, 1, 0),)).shortest_path((0, 0), (0, 2))
    for cells, message in [((), "rows of one length"), (((0, 1), (0,)), "rows of one length"), (((2,),), "0 .free.")]:
        with pytest.raises(ConfigurationError, match=message):
            Maze(cells)
    with pytest.raises(ConfigurationError, match="size must be positive"):
        Maze(((0,),), size=0.0)
