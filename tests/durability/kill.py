"""Kill a process (SIGKILL) while it fits, saves or exports, and check that nothing is lost and nothing is half there.

    python tests/durability/kill.py --kills 100 --seed 0 --what all           # at random moments
    python tests/durability/kill.py --kills 100 --seed 0 --what all --at steps  # before each change of the file system

After each kill: Minari lists and opens every dataset, those that were there before hold what they held, a target is
absent or complete, a cache item is absent or complete. Then the work is done again without a kill, and datasets and
cache must hold the same bytes as after a run that was never disturbed, with no temporary file or folder left.
Exits with status 1 at the first difference; else prints a JSON summary.
"""

from __future__ import annotations

import argparse
import json
import mmap
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import world
from minari.storage import get_dataset_path

Mark = Callable[[str], None]
FORMATS = ("hdf5", "arrow", "parquet")
RECIPE = "saved/recipe-v0"
WRITES = {"os.mkdir", "os.rename", "os.remove", "os.rmdir", "shutil.rmtree", "tempfile.mkdtemp"}


class DifferenceError(Exception):
    """The state after a kill is not one that is allowed."""


def fit(mark: Mark) -> None:
    """Mine, train and generate."""
    mark("fit: read")
    world.augmented().fit(progress=lambda description, done, total: mark(f"fit: {description}"))


def save(mark: Mark) -> None:
    """Save a recipe and the same dataset with its steps marked; the fit is in the cache."""
    for dataset_id, options in ((RECIPE, {"lazy": True}), ("saved/marked-v0", {"mark_steps": True})):
        mark(f"save: {dataset_id}")
        if not get_dataset_path(dataset_id).exists():
            world.augmented().save(dataset_id, **options)


def export(mark: Mark) -> None:
    """Save in each of Minari's formats; the fit is in the cache."""
    for data_format in FORMATS:
        mark(f"export: {data_format}")
        if not get_dataset_path(f"exported/{data_format}-v0").exists():
            world.augmented().save(f"exported/{data_format}-v0", data_format=data_format)


JOBS = {"fit": fit, "save": save, "export": export}


class Harness:
    """One world, the truth about it, and kills in copies of it."""

    def __init__(self, folder: Path, jobs: list[str]) -> None:
        self.folder = folder
        self.phase = mmap.mmap(-1, 64)  # shared with the workers: what they are doing
        world.build(folder / "start")
        self.old = world.ask(lambda: self._old_datasets(folder / "start"))
        self.truth: dict[str, Any] = {}
        self.seconds: dict[str, float] = {}
        self.steps: dict[str, int] = {}
        for job in dict.fromkeys(["fit", *jobs]):  # the others start from what it gives
            self._measure(job)

    def _measure(self, job: str) -> None:
        """Run a job undisturbed: its result is the truth, its duration the range of the kills."""
        place = self._fresh(job)
        begun = time.perf_counter()
        world.ask(lambda: self._work(place, job))
        self.seconds[job] = time.perf_counter() - begun
        self.truth[job] = world.ask(lambda: self._state(place))
        if world.leftovers(place):
            raise DifferenceError(f"An undisturbed {job} leaves {world.leftovers(place)}.")
        if job == "fit":
            shutil.copytree(place / "cache", self.folder / "fitted")
        place = self._fresh(job)
        self.steps[job] = world.ask(lambda: self._work(place, job, count_steps=True))

    def kill_after(self, job: str, seconds: float) -> str:
        """Kill a job after some seconds and check; return the phase it was in ("finished" where it had ended)."""
        place = self._fresh(job)
        pid = world.start(lambda: self._work(place, job))
        time.sleep(seconds)
        os.kill(pid, signal.SIGKILL)
        return self._judge(place, job, pid)

    def kill_at(self, job: str, step: int) -> str:
        """Kill a job just before its change number `step` of the file system, and check."""
        place = self._fresh(job)
        return self._judge(place, job, world.start(lambda: self._work(place, job, die_at=step)))

    def _judge(self, place: Path, job: str, pid: int) -> str:
        killed = os.WIFSIGNALED(os.waitpid(pid, 0)[1])
        phase = self.phase[:].rstrip(b"\0").decode() if killed else "finished"
        left = world.leftovers(place)
        world.ask(lambda: self._check_remains(place, job))
        world.ask(lambda: self._work(place, job))
        state = world.ask(lambda: self._state(place))
        if state != self.truth[job]:
            raise DifferenceError(f"{job}, killed in {phase!r}: {state} instead of {self.truth[job]}.")
        if world.leftovers(place):  # where all was in place already, nothing was saved again: the next save clears up
            world.ask(lambda: self._save_another(place))
        if world.leftovers(place):
            raise DifferenceError(f"{job}, killed in {phase!r}: the next run leaves {world.leftovers(place)}.")
        return phase + (" (left temporaries)" if left else "")

    def _fresh(self, job: str) -> Path:
        place = self.folder / "now"
        shutil.rmtree(place, ignore_errors=True)
        shutil.copytree(self.folder / "start", place)
        if job != "fit":
            shutil.copytree(self.folder / "fitted", place / "cache")
        return place

    def _work(self, place: Path, job: str, *, die_at: int | None = None, count_steps: bool = False) -> int:
        world.enter(place)
        tempfile.tempdir = None  # it may have been looked up already
        steps = [0]
        if die_at is not None or count_steps:
            _watch(place, steps, die_at)
        self.phase[:] = bytes(64)
        JOBS[job](self._mark)
        return steps[0]

    def _save_another(self, place: Path) -> None:
        world.enter(place)
        world.augmented().save("after/next-v0", lazy=True)

    def _mark(self, phase: str) -> None:
        self.phase[:] = phase.encode()[:64].ljust(64, b"\0")

    def _old_datasets(self, place: Path) -> dict[str, str]:
        world.enter(place)
        return {name: world.digest_dataset(name, real_only=True) for name in (world.SOURCE, *world.OLD)}

    def _check_remains(self, place: Path, job: str) -> None:
        if self._old_datasets(place) != self.old:
            raise DifferenceError("A dataset that was there before the kill has changed.")
        truth = self.truth[job]
        for name in set(world.listed()) - set(self.old):
            fitted = job != "fit"
            if not fitted or world.digest_dataset(name) != truth["datasets"][name]:
                raise DifferenceError(f"{name} is there, and not complete.")
        for path, digest in world.digest_cache(place).items():
            if truth["cache"].get(path) != digest:
                raise DifferenceError(f"The cache item {path} is there, and not what it should be.")

    def _state(self, place: Path) -> dict[str, Any]:
        world.enter(place)
        names = [name for name in world.listed() if name not in world.OLD]
        return {
            "cache": world.digest_cache(place),
            "datasets": {name: world.digest_dataset(name) for name in names},
            "old": self._old_datasets(place),
        }


def _watch(place: Path, steps: list[int], die_at: int | None) -> None:
    """Count the changes that this process makes to the file system below `place`, and die before number `die_at`."""

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        writes = event in WRITES or (event == "open" and isinstance(arguments[1], str) and arguments[1][:1] in "wxa")
        if not writes or not str(arguments[0]).startswith(str(place)):
            return
        if steps[0] == die_at:
            os.kill(os.getpid(), signal.SIGKILL)
        steps[0] += 1

    sys.addaudithook(hook)


def run(harness: Harness, *, kills: int, seed: int, what: str, at: str = "random") -> dict[str, Any]:
    """Kill `kills` times and return how many kills landed in which phase; a job that ended earlier does not count.

    Raises:
        DifferenceError: if anything is lost or half there.
    """
    chosen = list(JOBS) if what == "all" else [what]
    rng = random.Random(seed)
    phases: Counter[str] = Counter()
    missed = 0
    while (number := phases.total()) < kills:
        job = chosen[number % len(chosen)]
        if at == "random":
            moment = rng.uniform(0, harness.seconds[job])
            phase = harness.kill_after(job, moment)
        else:
            steps, turn = harness.steps[job], number // len(chosen)
            phase = harness.kill_at(job, turn % steps if kills >= steps * len(chosen) else rng.randrange(steps))
        if phase == "finished":
            missed += 1
            if at == "random":  # it is faster than it was when it was measured
                harness.seconds[job] = moment
            continue
        phases[phase] += 1
        print(f"{number + 1}/{kills} {phase}", file=sys.stderr, flush=True)
    seconds = {job: round(value, 3) for job, value in harness.seconds.items()}
    return {"kills": kills, "missed": missed, "seconds": seconds, "steps": harness.steps, "phases": dict(phases)}


def main() -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=100, help="how many kills (100)")
    parser.add_argument("--seed", type=int, default=0, help="of the moments (0)")
    parser.add_argument("--what", choices=[*JOBS, "all"], default="all", help="what is killed; all takes turns")
    parser.add_argument("--at", choices=["random", "steps"], default="random", help="random moments, or file changes")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        harness = Harness(Path(folder), list(JOBS) if options.what == "all" else [options.what])
        print(json.dumps(run(harness, **vars(options)), indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
