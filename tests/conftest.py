"""Fixtures that several test folders use."""

import os
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path

import minari
import numpy as np
import pytest
from gymnasium import spaces
from minari.data_collector import EpisodeBuffer

from oat_gym import OAT, MiningConfig
from oat_gym.generation import BehaviorConfig, VAEMDPConfig


@pytest.fixture
def shared_data() -> Path:
    """Return the folder of the real data, or skip by name where it is absent."""
    folder = Path(os.environ.get("OAT_GYM_DATA") or Path(__file__).parents[2] / "shared" / "data")
    if not (folder / "robotics").is_dir():
        pytest.skip(f"needs the shared data folder: {folder} is not there (set OAT_GYM_DATA)")
    return folder


@pytest.fixture(autouse=True)
def _isolated_folders(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    """Point caches and Minari's datasets at temporary folders, so that tests leave nothing behind."""
    root = tmp_path_factory.mktemp("home")
    monkeypatch.setenv("OAT_GYM_CACHE", str(root / "cache"))
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(root / "minari"))


def code(episode: int, steps: np.ndarray) -> np.ndarray:
    """Return numbers that tell an episode and its steps: 1000 * episode + step."""
    return 1000.0 * episode + steps


def value_coded_buffer(episode: int, length: int, *, terminates: bool = False) -> EpisodeBuffer:
    """Return an episode whose every value encodes (episode, step)."""
    steps = np.arange(length + 1)
    values = code(episode, steps)
    last = steps[:-1] == length - 1
    return EpisodeBuffer(
        seed=episode,
        options={"goal": {"row": episode}},
        observations={
            "position": np.stack([values, -values], axis=1).astype(np.float32),
            "mode": (steps % 3).astype(np.int64),
        },
        actions=values[:-1, None].astype(np.float32) + 0.25,
        rewards=values[:-1],
        terminations=last & terminates,
        truncations=last & (not terminates),
        # a list: Minari's arrow storage cannot read back an info that was written as a one-dimensional array
        infos={"clock": list(values), "nested": {"twice": np.stack([values, values], axis=1)}},
    )


@pytest.fixture
def make_dataset(tmp_path: Path) -> Callable[..., minari.MinariDataset]:
    """Return a function that makes a value-coded dataset of given lengths, installed under a Minari id."""

    def make(
        lengths: Sequence[int], *, dataset_id: str = "test/coded-v0", data_format: str = "hdf5"
    ) -> minari.MinariDataset:
        space = spaces.Dict(position=spaces.Box(-np.inf, np.inf, (2,)), mode=spaces.Discrete(3))
        buffers = [value_coded_buffer(e, n, terminates=e % 2 == 0) for e, n in enumerate(lengths)]
        return install_dataset(dataset_id, buffers, space, spaces.Box(-np.inf, np.inf, (1,)), data_format)

    return make


def install_dataset(
    dataset_id: str,
    buffers: list[EpisodeBuffer],
    observation_space: spaces.Space,
    action_space: spaces.Space,
    data_format: str = "hdf5",
) -> minari.MinariDataset:
    """Store buffers as a local Minari dataset, without the warnings about metadata that tests do not need."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return minari.create_dataset_from_buffers(
            dataset_id,
            buffers,
            observation_space=observation_space,
            action_space=action_space,
            data_format=data_format,
            code_permalink="https://example.org",
            author="tests",
        )


def walks(n: int, length: int, *, seed: int = 0) -> list[EpisodeBuffer]:
    """Return n random walks in the plane, of `length` to `length + n % 5` steps: state += action, reward = -|state|."""
    rng = np.random.default_rng(seed)
    buffers: list[EpisodeBuffer] = []
    for number in range(n):
        steps = length + number % 5
        phase = np.arange(steps) < steps // 2
        actions = np.where(phase[:, None], (1.0, 0.0), (0.0, -1.0)) * 0.2 + 0.05 * rng.normal(size=(steps, 2))
        states = np.concatenate([np.zeros((1, 2)), np.cumsum(actions, axis=0)]) + 0.02 * rng.normal(size=(steps + 1, 2))
        buffers.append(
            EpisodeBuffer(
                observations=states.astype(np.float32),
                actions=actions.astype(np.float32),
                rewards=-np.linalg.norm(states[1:], axis=1),
                terminations=np.zeros(steps, dtype=bool),
                truncations=np.arange(steps) == steps - 1,
            )
        )
    return buffers


@pytest.fixture
def walk_dataset() -> minari.MinariDataset:
    """Return a small dataset on which OAT trains in a second or two."""
    box = spaces.Box(-100, 100, (2,))
    return install_dataset("test/walks-v0", walks(12, 24), box, spaces.Box(-1, 1, (2,)))


@pytest.fixture
def tiny_oat() -> OAT:
    """Return OAT with settings for a quick fit."""
    mining = MiningConfig(n_clusters=3, length=6, top=2, switch_penalty=5.0)
    return OAT(mining=mining, model=VAEMDPConfig(max_updates=20), behavior=BehaviorConfig(max_updates=50))
