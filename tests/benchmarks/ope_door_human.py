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
import itertools
import json
import platform
import subprocess
import time
import warnings
from pathlib import Path
from typing import Literal

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
_KINDS: tuple[Literal["per-decision", "trajectory"], ...] = ("per-decision", "trajectory")
_FORMS: tuple[Literal["dr", "wdr"], ...] = ("wdr", "dr")

CELLS: dict[str, tuple[tuple[ope.Estimator, ...], int | None, str, str]] = {
    # name: estimators, horizon, initial states, densities of behaviour and target policies
    "is": (
        tuple(ope.ImportanceSampling(kind=kind, clip=clip) for kind in _KINDS for clip in (CLIP, None)),
        HORIZON,
        "data",
        "dope",
    ),
    "is-censored": ((ope.ImportanceSampling(clip=CLIP), ope.ImportanceSampling()), HORIZON, "data", "censored"),
    "is-endless": ((ope.ImportanceSampling(clip=CLIP),), None, "data", "dope"),
    "mb": ((ope.ModelBased(), ope.ModelBased.preset("autoregressive")), HORIZON, "data", "dope"),
    "mb-endless": ((ope.ModelBased(),), None, "data", "dope"),
    "mb-reset": ((ope.ModelBased(),), HORIZON, "reset", "dope"),
    "fqe": ((ope.FQE(), *(ope.DoublyRobust(kind=kind, clip=CLIP) for kind in _FORMS)), HORIZON, "data", "dope"),
    "dice": ((ope.DICE(),), HORIZON, "data", "dope"),
    "fqe-endless": ((ope.FQE(), ope.DoublyRobust(clip=CLIP)), None, "data", "dope"),
    "fqe-reset": ((ope.FQE(),), HORIZON, "reset", "dope"),
    "dice-others": ((ope.DICE.preset("dualdice"), ope.DICE.preset("gendice")), HORIZON, "data", "dope"),
    "dice-endless": ((ope.DICE(),), None, "data", "dope"),
}
PAPER = {  # tables 3 to 6, door, NoAug.: MAE, rank correlation, regret@1, regret@5
    "FQE": (389, 0.07, 0.05, 0.00),
    "MB": (403, 0.13, 0.44, 0.02),
    "IS": (870, 0.12, 0.45, 0.00),
    "DR": (379, 0.01, 0.05, 0.00),
    "DICE": (978, 0.61, 0.38, 0.00),
}
MAIN = {  # the estimator of each family that stands beside the paper's
    "FQE": ope.FQE(),
    "MB": ope.ModelBased(),
    "IS": ope.ImportanceSampling(clip=CLIP),
    "DR": ope.DoublyRobust(clip=CLIP),
    "DICE": ope.DICE(),
}
MAIN_CELLS = ("fqe", "mb", "is", "dice")


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


def run_cell(name: str, seed: int, resets: int) -> dict[str, object]:
    estimators, horizon, start, density = CELLS[name]
    data = domains.load("adroit-door-human")
    policies = ope.load_dope_policies(_data() / TASK, action_space=data.action_space, censored=density == "censored")
    begun = time.process_time()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        result = ope.evaluate(
            data,
            policies,
            estimators,
            gamma=GAMMA,
            horizon=horizon,
            seeds=[seed],
            behavior=CENSORED if density == "censored" else "clone",
            initial_states=reset_states(resets) if start == "reset" else None,
        )
    diagnostics = [{k: v for k, v in row["diagnostics"].items() if k != "warnings"} for row in result.rows]
    rows = [row | {"diagnostics": part} for row, part in zip(result.rows, diagnostics, strict=True)]
    return {
        "cell": name,
        "estimators": {estimator.name: repr(estimator) for estimator in estimators},
        "seed": seed,
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
    for name, seed in itertools.product(names, range(seeds)):
        path = out / f"{name}-{seed}.json"
        if path.exists():
            continue
        cell = run_cell(name, seed, resets)
        write_atomically(path, json.dumps(cell, indent=1).encode())
        print(path.stem, cell["cpu_seconds"], "CPU s", flush=True)


def summarize(rows: list[dict], true: dict[str, float]) -> dict[str, object]:
    """Return mean and standard deviation over seeds of each metric, and those of the estimates averaged over seeds."""
    names, seeds = list(true), sorted({row["seed"] for row in rows})
    known, found = np.array(list(true.values())), {(row["seed"], row["policy"]): row["value"] for row in rows}
    values = np.array([[found[seed, name] for name in names] for seed in seeds])
    each = np.array([_scores(row, known) for row in values])
    spread = each.std(axis=0, ddof=1) if len(seeds) > 1 else np.full(each.shape[1], np.nan)
    numbers: dict[str, object] = {}
    for metric, mean, sd, together in zip(
        _METRICS, each.mean(axis=0), spread, _scores(values.mean(axis=0), known), strict=True
    ):
        numbers |= {metric: float(mean), f"{metric}_sd": float(sd), f"{metric}_of_mean": float(together)}
    return numbers | {"bias": float((values - known).mean()), "seeds": len(seeds)}


def _scores(values: np.ndarray, true: np.ndarray) -> tuple[float, float, float, float]:
    error, rank = metrics.absolute_error(values, true).mean(), metrics.rank_correlation(values, true)
    return float(error), rank, metrics.regret_at_k(values, true, 1), metrics.regret_at_k(values, true, 5)


def tables(out: Path) -> None:
    true = truth()
    cells = [json.loads(path.read_text()) for path in sorted(out.glob("*.json"))]
    groups: dict[tuple[str, str], list[dict]] = {}
    known = {(name, estimator.name) for name, cell in CELLS.items() for estimator in cell[0]}
    for name, row in ((cell["cell"], row) for cell in cells for row in cell["rows"]):
        if (name, row["estimator"]) not in known:
            continue
        groups.setdefault((name, row["estimator"]), []).append(row)
    setting = {cell["cell"]: {k: cell[k] for k in ("horizon", "initial", "density")} for cell in cells}
    order = sorted(groups, key=lambda key: list(CELLS).index(key[0]))
    rows = [{"cell": c, "estimator": e} | setting[c] | summarize(groups[c, e], true) for c, e in order]
    _write_csv(out / "summary.csv", rows)
    columns = ("policy", "seed", "value", "standard_error", "low", "high")
    flat = [
        {"cell": c, "estimator": e, "true": true[row["policy"]]} | {name: row[name] for name in columns}
        for c, e in order
        for row in groups[c, e]
    ]
    _write_csv(out / "policies.csv", flat)
    shown = {f: (c, e.name) for f, e in MAIN.items() for c in MAIN_CELLS if (c, e.name) in groups}
    (out / "summary.md").write_text(_markdown(rows, shown, cells))
    if shown:
        _draw(out / "values.png", {f"{f}: {key[1]}": groups[key] for f, key in shown.items()}, true)


def _write_csv(path: Path, rows: list[dict]) -> None:
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, fieldnames=list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows({k: round(v, 3) if isinstance(v, float) else v for k, v in row.items()} for row in rows)


def _markdown(rows: list[dict], shown: dict[str, tuple[str, str]], cells: list[dict]) -> str:
    by_key = {(row["cell"], row["estimator"]): row for row in rows}
    lines = ["| family | MAE | paper | rank | paper | regret@1 | paper | regret@5 | paper |", "|---|" + "---|" * 8]
    for family, key in shown.items():
        row = by_key[key]
        parts = [f"{_pm(row, m, d)} | {PAPER[family][i]}" for i, (m, d) in enumerate(_METRICS.items())]
        lines.append(f"| {family} | " + " | ".join(parts) + " |")
    if shown:
        ours = [np.nanmean([by_key[key][m] for key in shown.values()]) for m in _METRICS]
        paper = np.mean([PAPER[family] for family in shown], axis=0)
        parts = [f"{a:.{d}f} | {b:.{d}f}" for a, b, d in zip(ours, paper, _METRICS.values(), strict=True)]
        lines += ["| mean | " + " | ".join(parts) + " |"]
    lines += [""]
    head = ("cell", "estimator", "horizon", "start", "MAE", "rank", "regret@1", "bias", "MAE of the mean", "its rank")
    lines += ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for row in rows:
        texts = [row["cell"], row["estimator"], str(row["horizon"] or "none"), row["initial"]]
        texts += [_pm(row, "mae", 0), _pm(row, "rank", 2), _pm(row, "regret1", 2), f"{row['bias']:+.0f}"]
        texts += [f"{row['mae_of_mean']:.0f}", f"{row['rank_of_mean']:.2f}"]
        lines.append("| " + " | ".join(texts) + " |")
    cost: dict[str, float] = {}
    for part in cells:
        cost[part["cell"]] = cost.get(part["cell"], 0.0) + part["cpu_seconds"]
    spent = ", ".join(f"{name} {seconds:.0f}" for name, seconds in cost.items())
    commits = ", ".join(sorted({cell["commit"] for cell in cells}))
    versions = ", ".join(f"{name} {version}" for name, version in cells[0]["versions"].items())
    return "\n".join([*lines, "", f"CPU seconds, all seeds: {spent}. Commits {commits}; {versions}.", ""])


def _pm(row: dict, metric: str, digits: int) -> str:
    return f"{row[metric]:.{digits}f} ± {row[metric + '_sd']:.{digits}f}"


_METRICS = {"mae": 0, "rank": 2, "regret1": 2, "regret5": 2}
"""Digits that are shown of each."""


def _draw(path: Path, panels: dict[str, list[dict]], true: dict[str, float]) -> None:
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, len(panels), figsize=(3.0 * len(panels), 3.2), sharex=True, sharey=True)
    known = np.array(list(true.values()))
    for axis, (title, rows) in zip(np.atleast_1d(axes), panels.items(), strict=True):
        axis.plot([known.min(), known.max()], [known.min(), known.max()], color="0.6", lw=1)
        for row in rows:
            axis.plot([true[row["policy"]]] * 2, [row["low"], row["high"]], color=f"C{row['seed']}", alpha=0.35, lw=1)
            axis.plot(true[row["policy"]], row["value"], "o", ms=4, color=f"C{row['seed']}")
        axis.set_title(title, fontsize=9)
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
