"""A small world for the durability scripts: a dataset to augment, older results of every kind, and forked workers.

The scripts fork their workers from one process that has imported everything and done the work once, so that a worker
costs what its work costs. They run with one thread each: a process with worker threads must not
fork.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import signal
import sys
import tempfile
import traceback
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import minari
import numpy as np
import torch
from gymnasium import spaces
from minari.data_collector import EpisodeBuffer
from threadpoolctl import threadpool_limits

import oat_gym
from oat_gym.augmenters.oat import OAT
from oat_gym.episodes import content_hash
from oat_gym.generation import BehaviorConfig, VAEMDPConfig
from oat_gym.mining import MiningConfig

SOURCE = "test/walks-v0"
OLD = ("old/exported-v0", "old/recipe-v0")
CONFIG = OAT(
    mining=MiningConfig(n_clusters=3, length=6, top=2, switch_penalty=5.0),
    model=VAEMDPConfig(max_updates=20),
    behavior=BehaviorConfig(max_updates=50),
)


def augmented(*, seed: int = 1) -> oat_gym.AugmentedDataset:
    """Return the dataset that the workers make: 12 real and 24 synthetic episodes."""
    return oat_gym.AugmentedDataset(SOURCE, CONFIG, factor=3, seed=seed)


def enter(folder: Path) -> None:
    """Make `folder` the place of this process's datasets, cache and temporary files."""
    os.environ["MINARI_DATASETS_PATH"] = str(folder / "minari")
    os.environ["OAT_GYM_CACHE"] = str(folder / "cache")
    (folder / "tmp").mkdir(parents=True, exist_ok=True)
    os.environ["TMPDIR"] = str(folder / "tmp")
    tempfile.tempdir = None  # it may have been looked up already


def build(folder: Path) -> None:
    """Make the source, an older export and an older recipe; what they need stays out of the cache."""
    torch.set_num_threads(1)
    threadpool_limits(1)
    enter(folder)
    rng = np.random.default_rng(0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        minari.create_dataset_from_buffers(
            SOURCE,
            [_walk(rng, 24 + number % 5) for number in range(12)],
            observation_space=spaces.Box(-100, 100, (2,)),
            action_space=spaces.Box(-1, 1, (2,)),
            author="tests",
        )
    older = augmented(seed=7)
    older.save(OLD[0])
    older.save(OLD[1], lazy=True)
    shutil.rmtree(folder / "cache")


def _walk(rng: np.random.Generator, steps: int) -> EpisodeBuffer:
    phase = np.arange(steps) < steps // 2
    actions = np.where(phase[:, None], (1.0, 0.0), (0.0, -1.0)) * 0.2 + 0.05 * rng.normal(size=(steps, 2))
    states = np.concatenate([np.zeros((1, 2)), np.cumsum(actions, axis=0)])
    return EpisodeBuffer(
        observations=states.astype(np.float32),
        actions=actions.astype(np.float32),
        rewards=-np.linalg.norm(states[1:], axis=1),
        terminations=np.zeros(steps, dtype=bool),
        truncations=np.arange(steps) == steps - 1,
    )


def digest_dataset(dataset_id: str, *, real_only: bool = False) -> str:
    """Return a digest of all that a saved dataset holds; of its real episodes only where the rest needs training."""
    dataset = minari.load_dataset(dataset_id)
    digest = hashlib.sha256()
    for path in sorted(dataset.storage.data_path.glob("*.json")):
        digest.update(json.dumps(json.loads(path.read_text()), sort_keys=True).encode())
    digest.update(repr((len(dataset), dataset.total_steps)).encode())
    number = 12 if real_only and isinstance(dataset, oat_gym.AugmentedDataset) else len(dataset)
    digest.update(content_hash(dataset[index] for index in range(number)).encode())
    return digest.hexdigest()


def digest_cache(folder: Path) -> dict[str, str]:
    """Return the digest of each item in the cache, by its path."""
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted((folder / "cache").rglob("*.safetensors"))
        if not path.name.startswith(".")
    }


def leftovers(folder: Path) -> list[str]:
    """Return what an interrupted process left: hidden files and folders among the datasets and in the cache."""
    found = [path for part in ("minari", "cache") for path in (folder / part).rglob(".*")]
    return sorted(str(path.relative_to(folder)) for path in found)


def listed() -> list[str]:
    """Return the ids of the datasets that Minari lists; a misconfigured one is an error."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return list(minari.list_local_datasets())


def start(work: Callable[[], Any], *, output: int | None = None) -> int:
    """Fork a worker that does `work`, writes its result as JSON to `output`, and exits; return its process id."""
    pid = os.fork()
    if pid:
        return pid
    status = 1
    try:
        result = work()
        if output is not None:
            with os.fdopen(output, "w") as pipe:
                json.dump(result, pipe)
        status = 0
    except BaseException:  # a worker must end here, whatever happens in it
        traceback.print_exc()
        sys.stderr.flush()
    finally:
        os._exit(status)


def ask(work: Callable[[], Any]) -> Any:
    """Do `work` in a forked worker and return its result; the parent opens no file and starts no thread.

    Raises:
        RuntimeError: if the worker fails.
    """
    reading, writing = os.pipe()
    pid = start(work, output=writing)
    os.close(writing)
    with os.fdopen(reading) as pipe:
        text = pipe.read()
    if os.waitpid(pid, 0)[1] != 0:
        raise RuntimeError("A worker failed; what it printed is above.")
    return json.loads(text)


@contextmanager
def ended(pids: list[int]) -> Iterator[None]:
    """Kill the workers that are still there when the block is left by an error."""
    try:
        yield
    except BaseException:
        for pid in pids:
            os.kill(pid, signal.SIGKILL)
        raise
