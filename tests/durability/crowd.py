"""Several processes at one thing: a fit, a fit whose holder is killed, a save under one id. Prints a JSON summary.

    python tests/durability/crowd.py --processes 8

One trains and the others read; a killed holder of the lock does not stop the next; one save wins, and the others get
`DatasetExistsError`.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import world
from minari.storage import get_dataset_path

import oat_gym
from oat_gym.augmenters.oat import OAT
from oat_gym.episodes import content_hash
from oat_gym.errors import DatasetExistsError


@dataclass(frozen=True)
class Counted(OAT):
    """OAT that writes a line into the world's log whenever it trains, and may be told to hang there."""

    def fit(self, source: Any, *, seed: int, progress: Any = None) -> Any:
        """Train, and say so."""
        with (Path(os.environ["TMPDIR"]) / "trained").open("a") as log:
            log.write(f"{os.getpid()}\n")
        if os.environ.get("HANG"):
            time.sleep(600)
        return super().fit(source, seed=seed, progress=lambda *_: None)


def counted() -> oat_gym.AugmentedDataset:
    """Return the world's dataset by the counted method."""
    return oat_gym.AugmentedDataset(world.SOURCE, Counted(**vars(world.CONFIG)), factor=3, seed=1)


def trained(place: Path) -> int:
    """Return how often a process has trained."""
    log = place / "tmp" / "trained"
    return len(log.read_text().split()) if log.exists() else 0


def fit_together(place: Path, processes: int) -> dict[str, Any]:
    """Let all fit at once; return how many trained, the cache entries, and the digests of what each then holds."""

    def work() -> None:
        while not (place / "go").exists():
            time.sleep(0.005)
        data = counted()
        (place / f"digest-{os.getpid()}").write_text(content_hash(data[index] for index in range(len(data))))

    pids = [world.start(work) for _ in range(processes)]
    with world.ended(pids):
        (place / "go").touch()
        statuses = [os.waitpid(pid, 0)[1] for pid in pids]
    digests = {path.read_text() for path in place.glob("digest-*")}
    entries = {path.parent for path in (place / "cache").rglob("*.safetensors")}
    return {
        "trained": trained(place),
        "failed": sum(map(bool, statuses)),
        "entries": len(entries),
        "same": len(digests),
    }


def kill_the_holder(place: Path) -> dict[str, Any]:
    """Kill a process that trains while another waits; return how many began to train, and how the other ended."""
    os.environ["HANG"] = "1"
    holder = world.start(lambda: counted().fit())
    while not trained(place):
        time.sleep(0.005)
    del os.environ["HANG"]
    waiter = world.start(lambda: counted().fit())
    with world.ended([holder, waiter]):
        time.sleep(0.5)
        before = trained(place)
        os.kill(holder, signal.SIGKILL)
        os.waitpid(holder, 0)
        status = os.waitpid(waiter, 0)[1]
    return {"before": before, "trained": trained(place), "failed": int(status != 0)}


def save_together(place: Path, processes: int) -> dict[str, Any]:
    """Let all save different data under one id; return how they ended, and whether the result is the winner's."""

    def work(seed: int) -> str:
        data = oat_gym.AugmentedDataset(world.SOURCE, oat_gym.Function(_louder), factor=3, seed=seed)
        own = content_hash(data[index] for index in range(len(data)))
        while not (place / "save").exists():
            time.sleep(0.001)
        try:
            data.save("race/same-v0", data_format=("hdf5", "arrow")[seed % 2])
        except DatasetExistsError:
            return "exists"
        (place / "winner").write_text(own)
        return "saved"

    ends = [os.pipe() for _ in range(processes)]
    pids = [world.start(lambda seed=seed: work(seed), output=writing) for seed, (_, writing) in enumerate(ends)]
    with world.ended(pids):
        time.sleep(1.0)  # all are ready by then; that none starts earlier is all that matters
        (place / "save").touch()
        for pid in pids:
            os.waitpid(pid, 0)
    results = Counter(_read(*end) for end in ends)

    def check() -> bool:
        kept = oat_gym.AugmentedDataset("race/same-v0", oat_gym.Function(_louder), count=0)
        return content_hash(kept[index] for index in range(len(kept))) == (place / "winner").read_text()

    return {**results, "winner": world.ask(check), "path": str(get_dataset_path("race/same-v0").relative_to(place))}


def _read(reading: int, writing: int) -> str:
    os.close(writing)
    with os.fdopen(reading) as pipe:
        return json.loads(pipe.read() or '"failed"')


def _louder(episode: Any, rng: Any) -> Any:
    episode.rewards[:] += rng.normal(size=len(episode.rewards))
    return episode


def run(folder: Path, *, processes: int) -> dict[str, Any]:
    """Play all scenes, each in a fresh world, and return what happened."""
    world.build(folder / "start")
    scenes = {
        "fit": lambda place: fit_together(place, processes),
        "holder": kill_the_holder,
        "save": lambda place: save_together(place, processes),
    }
    summary: dict[str, Any] = {}
    for name, scene in scenes.items():
        place = folder / name
        shutil.copytree(folder / "start", place)
        world.enter(place)
        summary[name] = {**scene(place), "left": world.leftovers(place)}
    return summary


def main() -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--processes", type=int, default=8, help="how many at once (8)")
    processes: int = parser.parse_args().processes
    with tempfile.TemporaryDirectory() as folder:
        print(json.dumps(run(Path(folder), processes=processes), indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
