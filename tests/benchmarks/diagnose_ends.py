"""What augmentation does to the ends of episodes: how many last steps are generated, and with which rewards.

    python tests/benchmarks/diagnose_ends.py --out FOLDER [--datasets icu-sepsis-features,...]
        [--variants oat-paper,oat-cut,oat] [--seeds 0,1,2]

Settings, and so the trained models in the cache, are those of `oat-gym bench`. Writes `FOLDER/ends.csv`, a row for each
dataset, variant and seed (those that are there are not computed again), and `FOLDER/ends.md`, their means.
"""

from __future__ import annotations

import argparse
import csv
import io
import itertools
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
from minari import MinariDataset

from oat_gym import AugmentedDataset, domains
from oat_gym.benchmark.job import one_thread
from oat_gym.benchmark.measure import environment
from oat_gym.benchmark.variants import find_variant, fit_length
from oat_gym.cache import write_atomically
from oat_gym.source import Source

Row = dict[str, str]
COLUMNS = {
    "share_generated": "generated steps, %",
    "terminating": "episodes that terminate, %",
    "ends_generated": "of terminations, on a generated step, %",
    "end_reward": "reward there",
    "end_reward_recorded": "as recorded",
    "other_reward": "reward of other generated steps",
    "other_reward_recorded": "recorded in their place",
}
DATASETS = "icu-sepsis-features,sepsis-mdp-features,sepsis-sim,maze2d-umaze"


def ends(data: AugmentedDataset, n_real: int) -> dict[str, float]:
    """Return the numbers of `COLUMNS` for the synthetic episodes of a dataset; NaN where there is no such step."""
    parts = [_episode(data, number) for number in range(n_real, len(data))]
    mask, last, made, recorded = (np.concatenate([part[k] for part in parts]) for k in range(4))
    new, old = mask & last, mask & ~last
    return {
        "share_generated": 100 * float(mask.mean()),
        "terminating": 100 * float(last.sum()) / len(parts),
        "ends_generated": 100 * _mean(mask[last]),
        "end_reward": _mean(made[new]),
        "end_reward_recorded": _mean(recorded[new]),
        "other_reward": _mean(made[old]),
        "other_reward_recorded": _mean(recorded[old]),
    }


def _episode(data: AugmentedDataset, number: int) -> tuple[npt.NDArray[np.bool_], ...]:
    """Return for each step whether it is generated and whether it terminates, its reward, and the recorded one.

    Methods that make whole trajectories give them other lengths: then no recorded step stands for a generated one.
    """
    origin, episode = data.provenance(number), data[number]
    recorded = data[origin.source].rewards
    if len(recorded) != len(episode.rewards):
        recorded = np.full(len(episode.rewards), np.nan)
    return origin.mask, episode.terminations, episode.rewards, recorded


def _mean(values: npt.NDArray[np.generic]) -> float:
    known = np.asarray(values, dtype=np.float64)
    known = known[np.isfinite(known)]
    return float(known.mean()) if len(known) else float("nan")


def measure(name: str, real: MinariDataset, variant: str, seed: str) -> Row:
    """Return a row."""
    chosen = find_variant(variant)
    if chosen.augmenter is None:
        raise SystemExit("The variant 'none' generates nothing.")
    augmenter = fit_length(chosen.augmenter, Source(real).lengths)
    data = AugmentedDataset(real, augmenter, factor=chosen.factor, seed=int(seed))
    with one_thread():
        data.fit(progress=False)
        found = ends(data, len(real))
    commit = str(environment("cpu")["commit"])
    return {
        "dataset": name,
        "variant": variant,
        "seed": seed,
        **{k: f"{v:.6g}" for k, v in found.items()},
        "commit": commit,
    }


def write(out: Path, rows: Sequence[Row]) -> None:
    """Write the rows and their means over seeds."""
    text = io.StringIO()
    table = csv.DictWriter(text, fieldnames=list(rows[0]), lineterminator="\n")
    table.writeheader()
    table.writerows(rows)
    out.mkdir(parents=True, exist_ok=True)
    write_atomically(out / "ends.csv", text.getvalue().encode())
    lines = [
        "| dataset | variant | seeds | " + " | ".join(COLUMNS.values()) + " |",
        "|---|---|---|" + "---|" * len(COLUMNS),
    ]
    for dataset, variant in dict.fromkeys((row["dataset"], row["variant"]) for row in rows):
        mine = [row for row in rows if (row["dataset"], row["variant"]) == (dataset, variant)]
        means = [np.mean([float(row[column]) for row in mine]) for column in COLUMNS]
        cells = [f"{mean:.3g}" if np.isfinite(mean) else "" for mean in means]
        lines.append(f"| {dataset} | {variant} | {len(mine)} | " + " | ".join(cells) + " |")
    write_atomically(out / "ends.md", ("\n".join(lines) + "\n").encode())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--datasets", default=DATASETS)
    parser.add_argument("--variants", default="oat-paper,oat-cut,oat")
    parser.add_argument("--seeds", default="0,1,2")
    arguments = parser.parse_args()
    path = arguments.out / "ends.csv"
    rows: list[Row] = list(csv.DictReader(path.read_text().splitlines())) if path.exists() else []
    done = {(row["dataset"], row["variant"], row["seed"]) for row in rows}
    for name in arguments.datasets.split(","):
        real = domains.load(name)
        for key in itertools.product([name], arguments.variants.split(","), arguments.seeds.split(",")):
            if key not in done:
                rows.append(measure(name, real, *key[1:]))
                print(rows[-1], flush=True)
                write(arguments.out, rows)


if __name__ == "__main__":
    main()
