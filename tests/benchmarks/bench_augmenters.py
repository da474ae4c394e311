"""CPU time and peak memory of every augmenter with its defaults on one dataset, each in a process of its own.

    python tests/benchmarks/bench_augmenters.py [--dataset adroit-door-human] [--factor 10] [--only spawner,dgw]

DATASET is a name of `oat_gym.domains.load` or a Minari id. The time is that of `fit` and of reading all synthetic
episodes once, with an empty cache, without importing the package, opening the dataset, and compiling (each numba
kernel is called once before, on a handful of rows). `lengths` is what is spent before anything is generated. The
memory is the largest resident size of the process, of which `base` is what it had before the work began.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
import warnings

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")


def cpu_seconds() -> float:
    """CPU time of this process and of its ended children."""
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime


def peak_megabytes() -> float:
    """Largest resident size of this process."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def measure(name: str, dataset: str, factor: float) -> dict[str, float]:
    """Augment in this process; returns seconds, megabytes and counts."""
    import minari
    import numpy as np

    import oat_gym
    from oat_gym.dtw import dtw_path

    dtw_path(np.zeros((3, 2)), np.zeros((4, 2)), radius=1)
    real = minari.load_dataset(dataset) if "/" in dataset else oat_gym.domains.load(dataset)
    source = list(real)
    result = {"base_mb": peak_megabytes(), "n_real": len(source)}
    begin = cpu_seconds()
    data = oat_gym.AugmentedDataset(real, oat_gym.AUGMENTERS[name](), factor=factor, seed=0)
    result["steps"] = int(data.total_steps)
    result["lengths_s"] = cpu_seconds() - begin
    data.fit(progress=False)
    result["fit_s"] = cpu_seconds() - begin - result["lengths_s"]
    result["episodes"] = sum(1 for _ in data.iterate_episodes(range(len(source), len(data))))
    result["total_s"] = cpu_seconds() - begin
    return result | {"peak_mb": peak_megabytes()}


def run(name: str, dataset: str, factor: float) -> dict[str, float] | str:
    """Measure in a new process with an empty cache; a line of text where it failed."""
    command = [sys.executable, __file__, "--measure", name, "--dataset", dataset, "--factor", str(factor)]
    with tempfile.TemporaryDirectory() as cache:
        environment = os.environ | {"OAT_GYM_CACHE": cache}
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        return done.stderr.strip().splitlines()[-1]
    return json.loads(done.stdout.strip().splitlines()[-1])


def main() -> None:
    """Print a markdown table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--dataset", default="adroit-door-human")
    parser.add_argument("--factor", type=float, default=10)
    parser.add_argument("--only", help="names of AUGMENTERS, with commas between")
    parser.add_argument("--measure", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.measure:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            print(json.dumps(measure(args.measure, args.dataset, args.factor)))
        return
    import oat_gym

    names = args.only.split(",") if args.only else list(oat_gym.AUGMENTERS)
    print(f"{args.dataset}, factor {args.factor:g}\n")
    print("| augmenter | CPU s | of it lengths | of it fit | episodes | peak MB (base) |\n|---|---|---|---|---|---|")
    for name in names:
        got = run(name, args.dataset, args.factor)
        if isinstance(got, str):
            print(f"| {name} | failed: {got} |", flush=True)
            continue
        numbers = f"{got['total_s']:.2f} | {got['lengths_s']:.2f} | {got['fit_s']:.2f} | {got['episodes']}"
        print(f"| {name} | {numbers} | {got['peak_mb']:.0f} ({got['base_mb']:.0f}) |", flush=True)


if __name__ == "__main__":
    main()
