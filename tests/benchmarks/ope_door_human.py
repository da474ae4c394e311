"""All families of estimators on the real door-human demonstrations, beside the paper's results without augmentation.

    python tests/benchmarks/ope_door_human.py run --out FOLDER [--cells fqe is ...] [--seeds 3] [--resets 200]
    python tests/benchmarks/ope_door_human.py tables --out FOLDER

The 11 DOPE policies, gamma 0.995; the truth is the mean over 50 episodes of 200 steps in AdroitHandDoor-v1 with mean
actions (`ground_truth_check.csv` of the data folder). A cell is one estimator, horizon and kind of initial states, all
seeds at once; it is a file of FOLDER, and a run goes on where it was stopped. `tables` writes `policies.csv`
(every value), `summary.csv`, `summary.md` and `values.png`.
"""

from __future__ import annotations

import argparse
import csv
import json
import platform
import subprocess
import time
import warnings
from pathlib import Path

import gymnasium as gym
import gymnasium_robotics
import numpy as np
import torch

from oat_gym import domains, ope
from oat_gym.cache import write_atomically
from oat_gym.domains._data import data_folder
from oat_gym.ope import metrics

GAMMA, HORIZON, TASK = 0.995, 200, "door"
CLIP = (-6.0, 2.0)
CENSORED = ope.BehaviorCloning(density="censored")

CELLS: dict[str, tuple[ope.Estimator, int | None, str, str]] = {
    # name: estimator, horizon, initial states, densities of behaviour and target policies
    "fqe": (ope.FQE(), HORIZON, "data", "dope"),
    "mb": (ope.ModelBased(), HORIZON, "data", "dope"),
    "mb-autoregressive": (ope.ModelBased.preset("autoregressive"), HORIZON, "data", "dope"),
    "is": (ope.ImportanceSampling(clip=CLIP), HORIZON, "data", "dope"),
    "is-unclipped": (ope.ImportanceSampling(), HORIZON, "data", "dope"),
    "is-censored": (ope.ImportanceSampling(clip=CLIP), HORIZON, "data", "censored"),
    "is-trajectory": (ope.ImportanceSampling(kind="trajectory", clip=CLIP), HORIZON, "data", "dope"),
    "dr": (ope.DoublyRobust(clip=CLIP), HORIZON, "data", "dope"),
    "dice-best": (ope.DICE(), HORIZON, "data", "dope"),
    "dice-dual": (ope.DICE.preset("dualdice"), HORIZON, "data", "dope"),
    "dice-gen": (ope.DICE.preset("gendice"), HORIZON, "data", "dope"),
    "fqe-endless": (ope.FQE(), None, "data", "dope"),
    "mb-endless": (ope.ModelBased(), None, "data", "dope"),
    "is-endless": (ope.ImportanceSampling(clip=CLIP), None, "data", "dope"),
    "dice-endless": (ope.DICE(), None, "data", "dope"),
    "fqe-reset": (ope.FQE(), HORIZON, "reset", "dope"),
    "mb-reset": (ope.ModelBased(), HORIZON, "reset", "dope"),
    "dice-reset": (ope.DICE(), HORIZON, "reset", "dope"),
}
PAPER = {  # tables 3 to 6, door, NoAug.: MAE, rank correlation, regret@1, regret@5
    "FQE": (389, 0.07, 0.05, 0.00),
    "MB": (403, 0.13, 0.44, 0.02),
    "IS": (870, 0.12, 0.45, 0.00),
    "DR": (379, 0.01, 0.05, 0.00),
    "DICE": (978, 0.61, 0.38, 0.00),
}
MAIN = {"FQE": "fqe", "MB": "mb", "IS": "is", "DR": "dr", "DICE": "dice-best"}


def reset_states(count: int) -> np.ndarray:
    """Return `count` first observations of AdroitHandDoor-v1, seeds 0, 1, ..."""
    gym.register_envs(gymnasium_robotics)
    env = gym.make("AdroitHandDoor-v1", max_episode_steps=HORIZON)
    states = np.stack([env.reset(seed=seed)[0] for seed in range(count)])
    env.close()
    return states


def truth() -> dict[str, float]:
    with (_data() / "ground_truth_check.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if row["task"] == TASK]
    return {f"{TASK}_dapg_{row['policy']}": float(row["ours_det_disc0.995"]) for row in rows}


def _data() -> Path:
    folder = data_folder()
    if folder is None:
        raise SystemExit("Set OAT_GYM_DATA to the folder that holds robotics/dope_policies.")
    return folder / "robotics" / "dope_policies"


def run_cell(name: str, seeds: int, resets: int) -> dict[str, object]:
    estimator, horizon, start, density = CELLS[name]
    data = domains.load("adroit-door-human")
    policies = ope.load_dope_policies(_data() / TASK, action_space=data.action_space, censored=density == "censored")
    begun = time.process_time()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        result = ope.evaluate(
            data,
            policies,
            [estimator],
            gamma=GAMMA,
            horizon=horizon,
            seeds=seeds,
            behavior=CENSORED if density == "censored" else "clone",
            initial_states=reset_states(resets) if start == "reset" else None,
        )
    diagnostics = [{k: v for k, v in row["diagnostics"].items() if k != "warnings"} for row in result.rows]
    rows = [row | {"diagnostics": part} for row, part in zip(result.rows, diagnostics, strict=True)]
    return {
        "cell": name,
        "estimator": repr(estimator),
        "family": estimator.family,
        "horizon": horizon,
        "initial": start,
        "density": density,
        "cpu_seconds": round(time.process_time() - begun, 1),
        "warnings": sorted({str(warning.message) for warning in caught}),
        "rows": rows,
        "versions": {"torch": torch.__version__, "numpy": np.__version__, "python": platform.python_version()},
        "commit": _commit(),
    }


def _commit() -> str:
    found = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False)
    return found.stdout.strip() or "unknown"


def run(out: Path, names: list[str], seeds: int, resets: int) -> None:
    out.mkdir(parents=True, exist_ok=True)
    for name in names:
        path = out / f"{name}.json"
        if path.exists():
            continue
        cell = run_cell(name, seeds, resets)
        write_atomically(path, json.dumps(cell, indent=1).encode())
        print(name, cell["cpu_seconds"], "CPU s", flush=True)


def summarize(cell: dict, true: dict[str, float]) -> dict[str, object]:
    """Return the mean and standard deviation over seeds of each metric, and those of the mean over seeds."""
    names, seeds = list(true), sorted({row["seed"] for row in cell["rows"]})
    known = np.array([true[name] for name in names])
    values = np.array(
        [[row["value"] for name in names for row in cell["rows"] if (row["policy"], row["seed"]) == (name, seed)]
         for seed in seeds]
    )  # fmt: skip

    def scores(v: np.ndarray) -> tuple[float, ...]:
        return (
            float(metrics.absolute_error(v, known).mean()),
            metrics.rank_correlation(v, known),
            metrics.regret_at_k(v, known, 1),
            metrics.regret_at_k(v, known, 5),
        )

    each, row = np.array([scores(v) for v in values]), {"cell": cell["cell"], "family": cell["family"]}
    for i, metric in enumerate(("mae", "rank", "regret1", "regret5")):
        row |= {metric: each[:, i].mean(), f"{metric}_sd": each[:, i].std(ddof=1)}
    average = scores(values.mean(axis=0))
    row |= dict(zip(("mae_of_mean", "rank_of_mean", "regret1_of_mean", "regret5_of_mean"), average, strict=True))
    row |= {"bias": float((values - known).mean()), "cpu_seconds": cell["cpu_seconds"], "seeds": len(seeds)}
    return row | {"horizon": cell["horizon"] or "none", "initial": cell["initial"], "density": cell["density"]}


def tables(out: Path) -> None:
    true = truth()
    cells = [json.loads((out / f"{name}.json").read_text()) for name in CELLS if (out / f"{name}.json").exists()]
    rows = [summarize(cell, true) for cell in cells]
    _write_csv(out / "summary.csv", rows)
    flat = [
        {"cell": cell["cell"], "true": round(true[row["policy"]], 1)}
        | {k: row[k] for k in ("policy", "seed", "value", "standard_error", "low", "high")}
        for cell in cells
        for row in cell["rows"]
    ]
    _write_csv(out / "policies.csv", flat)
    (out / "summary.md").write_text(_markdown(rows, cells))
    _draw(out / "values.png", cells, true)


def _write_csv(path: Path, rows: list[dict]) -> None:
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, fieldnames=list(rows[0]))
        writer.writeheader()
        writer.writerows({k: round(v, 4) if isinstance(v, float) else v for k, v in row.items()} for row in rows)


def _markdown(rows: list[dict], cells: list[dict]) -> str:
    by_cell, lines = {row["cell"]: row for row in rows}, []
    lines += ["| family | MAE | paper | rank | paper | regret@1 | paper | regret@5 | paper |", "|---|" + "---|" * 8]
    shown = [(family, by_cell[name]) for family, name in MAIN.items() if name in by_cell]
    for family, row in shown:
        parts = [f"{row[m]:.{d}f} ± {row[m + '_sd']:.{d}f} | {PAPER[family][i]}" for i, (m, d) in enumerate(_METRICS)]
        lines.append(f"| {family} | " + " | ".join(parts) + " |")
    if shown:
        means = [f"{np.nanmean([row[m] for _, row in shown]):.{d}f}" for m, d in _METRICS]
        paper = np.mean([PAPER[family] for family, _ in shown], axis=0)
        cells_of_mean = [f"{m} | {p:.{d}f}" for m, p, (_, d) in zip(means, paper, _METRICS, strict=True)]
        lines.append("| mean | " + " | ".join(cells_of_mean) + " |")
    lines += ["", "| cell | horizon | initial | MAE | MAE of the mean over seeds | rank | of the mean | bias | CPU s |"]
    lines += ["|---|" + "---|" * 8]
    for row in rows:
        lines.append(
            f"| {row['cell']} | {row['horizon']} | {row['initial']} | {row['mae']:.0f} ± {row['mae_sd']:.0f} "
            f"| {row['mae_of_mean']:.0f} | {row['rank']:.2f} ± {row['rank_sd']:.2f} | {row['rank_of_mean']:.2f} "
            f"| {row['bias']:+.0f} | {row['cpu_seconds']:.0f} |"
        )
    commits = ", ".join(sorted({cell["commit"] for cell in cells}))
    return "\n".join([*lines, "", f"Commits {commits}; {cells[0]['versions']}.", ""])


_METRICS = (("mae", 0), ("rank", 2), ("regret1", 2), ("regret5", 2))


def _draw(path: Path, cells: list[dict], true: dict[str, float]) -> None:
    import matplotlib.pyplot as plt

    shown = [cell for cell in cells if cell["cell"] in MAIN.values()]
    figure, axes = plt.subplots(1, len(shown), figsize=(3.1 * len(shown), 3.2), sharex=True, sharey=True)
    known = np.array(list(true.values()))
    for axis, cell in zip(np.atleast_1d(axes), shown, strict=True):
        axis.plot([known.min(), known.max()], [known.min(), known.max()], color="0.6", lw=1)
        for row in cell["rows"]:
            x = true[row["policy"]]
            axis.plot([x, x], [row["low"], row["high"]], color=f"C{row['seed']}", alpha=0.35, lw=1)
            axis.plot(x, row["value"], "o", ms=4, color=f"C{row['seed']}")
        axis.set_title(cell["cell"])
        axis.set_xlabel("true value")
    np.atleast_1d(axes)[0].set_ylabel("estimate (a colour for each seed)")
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    plt.close(figure)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("run", "tables"))
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--cells", nargs="+", choices=list(CELLS), default=list(CELLS))
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--resets", type=int, default=200)
    arguments = parser.parse_args()
    if arguments.what == "run":
        run(arguments.out, arguments.cells, arguments.seeds, arguments.resets)
    else:
        tables(arguments.out)
