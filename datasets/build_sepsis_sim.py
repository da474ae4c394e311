"""Build what belongs to sepsis-sim: the simulator's calibration, the target policies, and the card's pictures.

    python datasets/build_sepsis_sim.py calibrate --tables FOLDER   # oat_gym/envs/_sepsis_calibration.py
    python datasets/build_sepsis_sim.py train                       # datasets/sepsis-sim/policies
    python datasets/build_sepsis_sim.py describe --tables FOLDER    # the pictures and the tables of the card, printed

FOLDER holds the CLIF tables of the open MIMIC-IV demo (`oat_gym.domains.sepsis_clif` says where to get them). Summary
numbers are all that is kept of them. The same seed and library versions give the same bytes.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import minari
import numpy as np
import numpy.typing as npt

from oat_gym._rng import derive
from oat_gym.domains import pictures, sepsis, sepsis_sim
from oat_gym.domains._sepsis_clinician import Clinician
from oat_gym.domains.sepsis_attributes import NAMES
from oat_gym.domains.sepsis_belief import current_values, last_known
from oat_gym.domains.sepsis_stages import STAGES, pressure_shock, stages
from oat_gym.domains.sepsis_tables import find_tables
from oat_gym.domains.sepsis_visits import Visit, read_visits
from oat_gym.envs import _sepsis_calibration as table
from oat_gym.envs._sepsis_ward import Ward

FloatArray = npt.NDArray[np.float64]

VALUE_LEVELS = (0.001, 0.01, 0.05, 0.1, 0.25, 0.4, 0.5, 0.6, 0.75, 0.9, 0.95, 0.99, 0.999)
COUNT_LEVELS = (0.0, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.98, 0.99, 1.0)
KINDS, STARTS, ITERATIONS = 6, 8, 200
ROUNDS, PATIENTS = 4, 600
OUT = Path(__file__).parent / "sepsis-sim"
MODULE = Path(__file__).parents[1] / "oat_gym" / "envs" / "_sepsis_calibration.py"
ACTION_NAMES = ("none", "antibiotics", "oxygen", "both")
STYLES = ({"color": "#444444", "label": "real"}, {"color": "#d1495b", "label": "simulated", "linestyle": "--"})
SKEWED = ("white_cells", "platelets", "lactate", "creatinine", "urea_nitrogen", "bilirubin", "arterial_oxygen")
HEADER = '''"""Marginals of the 83 visits of the open MIMIC-IV demo with suspected infection (CLIF): summary numbers.

Written by `datasets/build_sepsis_sim.py calibrate`; quantiles, shares and probabilities, nothing of any one patient.
"""

'''
DOCS = {
    "VALUE_LEVELS": "Probabilities of the quantiles of values and scores.",
    "VALUE_QUANTILES": "(15, 13) quantiles of the recorded values, in the order of `sepsis_attributes.NAMES`.",
    "SCORE_QUANTILES": "(15, 13) quantiles of the simulator's scores where it measures, under the clinician's policy.",
    "COUNT_LEVELS": "Probabilities of the quantiles of hours between events and events a visit.",
    "HOURS_BETWEEN_EVENTS": "Quantiles of the hours between two events.",
    "EVENTS_PER_VISIT": "Quantiles of the events of a visit.",
    "KIND_SHARES": "Share of each kind of event.",
    "KIND_MEASURED": "(6, 15) probability that an event of a kind measures an attribute (a mixture fitted by EM).",
}


@dataclass(frozen=True)
class Kinds:
    """A mixture of Bernoulli patterns: weights (K,) and probabilities (K, 15)."""

    weights: FloatArray
    measured: FloatArray


def fit_kinds(patterns: FloatArray) -> Kinds:
    """Return the best of some EM fits of a mixture to missing patterns (n, 15) of zeros and ones."""
    rows, counts = np.unique(patterns, axis=0, return_counts=True)
    fits = [_fit_once(rows, counts / counts.sum(), derive(0, "kinds", start)) for start in range(STARTS)]
    best = max(fits, key=lambda fit: fit[0])[1]
    order = np.argsort(-best.weights)
    return Kinds(best.weights[order], best.measured[order])


def _fit_once(rows: FloatArray, share: FloatArray, rng: np.random.Generator) -> tuple[float, Kinds]:
    measured = np.clip(share @ rows * rng.uniform(0.2, 2.0, (KINDS, rows.shape[1])), 0.02, 0.9)
    weights, fit = np.full(KINDS, 1 / KINDS), -np.inf
    for _ in range(ITERATIONS):
        joint = np.log(weights) + rows @ np.log(measured).T + (1 - rows) @ np.log(1 - measured).T
        total = np.logaddexp.reduce(joint, axis=1, keepdims=True)
        fit, owned = float(share @ total[:, 0]), np.exp(joint - total) * share[:, None]
        weights = owned.sum(axis=0)
        measured = np.clip(owned.T @ rows / weights[:, None], 1e-4, 1 - 1e-4)
    return fit, Kinds(weights, measured)


def marginals(visits: list[Visit]) -> dict[str, FloatArray]:
    """Return the summary numbers of real visits."""
    recorded = np.concatenate([visit.recorded for visit in visits])
    kinds = fit_kinds((~np.isnan(recorded)).astype(np.float64))
    return {
        "VALUE_LEVELS": np.array(VALUE_LEVELS),
        "VALUE_QUANTILES": np.nanquantile(recorded, VALUE_LEVELS, axis=0).T,
        "COUNT_LEVELS": np.array(COUNT_LEVELS),
        "HOURS_BETWEEN_EVENTS": np.quantile(np.concatenate([np.diff(visit.hours) for visit in visits]), COUNT_LEVELS),
        "EVENTS_PER_VISIT": np.quantile([len(visit.hours) for visit in visits], COUNT_LEVELS),
        "KIND_SHARES": kinds.weights,
        "KIND_MEASURED": kinds.measured,
    }


def write_module(numbers: dict[str, FloatArray]) -> None:
    """Write the calibration as a Python module."""
    text = HEADER
    for name, doc in DOCS.items():
        rounded = np.round(numbers[name], 4).tolist()
        value = tuple(tuple(row) if isinstance(row, list) else row for row in rounded)
        text += f'{name} = {value!r}\n"""{doc}"""\n\n'
    MODULE.write_text(text)
    subprocess.run([sys.executable, "-m", "ruff", "format", "-q", str(MODULE)], check=True)


def calibrate(tables: Path | None) -> None:
    """Write the calibration: marginals, then the scores' quantiles under the clinician's policy, in some rounds."""
    numbers = marginals(read_visits(find_tables(tables)))
    start = np.interp(VALUE_LEVELS, VALUE_LEVELS, np.linspace(-1.0, 3.0, len(VALUE_LEVELS)))
    numbers["SCORE_QUANTILES"] = np.tile(start, (len(NAMES), 1))
    write_module(numbers)
    for number in range(ROUNDS):  # values decide treatments, which decide scores: each round in a fresh interpreter
        command = f"import build_sepsis_sim as b; b.rescore({number})"
        subprocess.run([sys.executable, "-c", command], check=True, cwd=Path(__file__).parent)


def rescore(seed: int) -> None:
    """Replace the scores' quantiles by those of patients under the clinician's policy."""
    ward, clinician, rng = Ward(PATIENTS, horizon=1160), Clinician(), derive(seed, "calibration")
    ward.admit(np.arange(PATIENTS), rng.integers(0, 2**63, PATIENTS).astype(np.uint64))
    staying, parts = np.ones(PATIENTS, dtype=bool), []
    while staying.any():
        parts.append(np.where((ward.patients.ages == 0) & staying[:, None], ward.patients.scores, np.nan)[staying])
        outcome = ward.treat(clinician.sample(ward.observations(), rng=rng), staying)
        staying &= ~(outcome.terminated | outcome.truncated)
    scores = np.nanquantile(np.concatenate(parts), VALUE_LEVELS, axis=0).T
    numbers = {name: np.array(getattr(table, name)) for name in DOCS}
    write_module(numbers | {"SCORE_QUANTILES": scores})


@dataclass(frozen=True)
class Summary:
    """What real and simulated visits are compared by: arrays over all events, and one row a visit."""

    recorded: FloatArray
    gaps: FloatArray
    lengths: FloatArray
    hours: FloatArray
    stage: npt.NDArray[np.int64]
    last_stage: npt.NDArray[np.int64]
    shock: npt.NDArray[np.bool_]
    action: npt.NDArray[np.int64]


def real_summary(visits: list[Visit]) -> Summary:
    """Return the summary of real visits."""
    staged = [
        stages(
            current_values(last_known(visit.recorded, visit.hours)),
            pressure_shock(visit.recorded, visit.hours) | visit.vasopressor,
        )
        for visit in visits
    ]
    return Summary(
        recorded=np.concatenate([visit.recorded for visit in visits]),
        gaps=np.concatenate([np.diff(visit.hours) for visit in visits]),
        lengths=np.array([len(visit.hours) for visit in visits]),
        hours=np.array([visit.hours[-1] for visit in visits]),
        stage=np.concatenate(staged),
        last_stage=np.array([stage[-1] for stage in staged]),
        shock=np.array([stage.max() == 4 for stage in staged]),
        action=np.concatenate([visit.antibiotics + 2 * visit.oxygen.astype(np.int64) for visit in visits]),
    )


def simulated_summary(data: minari.MinariDataset) -> Summary:
    """Return the summary of simulated visits."""
    episodes = list(data)
    seen = [episode.observations for episode in episodes]
    hours = [np.asarray(episode.infos["time"]) for episode in episodes]
    staged = [np.asarray(episode.infos["stage"]) for episode in episodes]
    return Summary(
        recorded=np.concatenate([np.where(rows["recorded"] == 1, rows["values"], np.nan) for rows in seen]),
        gaps=np.concatenate([np.diff(times) for times in hours]),
        lengths=np.array([len(times) for times in hours]),
        hours=np.array([times[-1] for times in hours]),
        stage=np.concatenate(staged),
        last_stage=np.array([stage[-1] for stage in staged]),
        shock=np.array([stage.max() == 4 for stage in staged]),
        action=np.concatenate([episode.actions for episode in episodes]),
    )


def side_by_side(real: Summary, simulated: Summary) -> str:
    """Return the card's tables: each number of the real visits, and of the simulated ones after the slash."""
    both = (real, simulated)
    lines = ["| attribute | recorded at, % of events | 5% | 50% | 95% |", "|---|---|---|---|---|"]
    for column, name in enumerate(NAMES):
        known = [one.recorded[~np.isnan(one.recorded[:, column]), column] for one in both]
        shares = [100 * len(values) / len(one.recorded) for values, one in zip(known, both, strict=True)]
        cells = [_pair(shares, 1)] + [_pair([np.quantile(v, q) for v in known], 3) for q in (0.05, 0.5, 0.95)]
        lines.append(f"| {name.replace('_', ' ')} | {' | '.join(cells)} |")
    lines += ["", "| | real / simulated |", "|---|---|"]
    lines += [f"| missing, % | {_pair([100 * np.isnan(one.recorded).mean() for one in both], 3)} |"]
    for what, name in (("gaps", "hours between events"), ("lengths", "events a visit"), ("hours", "hours a visit")):
        cells = [_pair([np.quantile(getattr(one, what), q) for one in both], 3) for q in (0.25, 0.5, 0.75, 0.95)]
        lines.append(f"| {name}: quartiles, 95% | {', '.join(cells)} |")
    for what, names in (("stage", STAGES), ("last_stage", STAGES), ("action", ACTION_NAMES)):
        counts = [np.bincount(getattr(one, what), minlength=len(names)) for one in both]
        cells = [f"{n} {_pair([100 * c[k] / c.sum() for c in counts], 3)}" for k, n in enumerate(names)]
        lines.append(f"| {what.replace('_', ' ')}, % | {'; '.join(cells)} |")
    lines.append(f"| visits with septic shock, % | {_pair([100 * one.shock.mean() for one in both], 3)} |")
    return "\n".join(lines)


def _pair(values: Sequence[float], digits: int) -> str:
    return " / ".join(f"{value:.{digits}g}" if digits > 1 else f"{value:.1f}" for value in values)


def draw_marginals(real: Summary, simulated: Summary, path: Path) -> None:
    """Draw the quantile functions of the attributes, and of the hours between events, side by side."""
    from matplotlib.figure import Figure  # noqa: PLC0415 (slow to import)
    from matplotlib.ticker import NullFormatter  # noqa: PLC0415

    figure = Figure(figsize=(10, 5.6), dpi=100, layout="constrained")
    levels = np.linspace(0.005, 0.995, 100)
    panels = figure.subplots(3, 6).ravel()
    for column, (axes, name) in enumerate(zip(panels, NAMES, strict=False)):
        for one, style in ((real, STYLES[0]), (simulated, STYLES[1])):
            axes.plot(levels, np.nanquantile(one.recorded[:, column], levels), **style)
        axes.set_title(name.replace("_", " "), fontsize=8)
        if name in SKEWED:
            axes.set_yscale("log")
    for axes, what, title in zip(
        panels[15:], ("gaps", "lengths"), ("hours between events", "events a visit"), strict=False
    ):
        for one, style in ((real, STYLES[0]), (simulated, STYLES[1])):
            axes.plot(levels, np.quantile(getattr(one, what), levels), **style)
        axes.set_title(title, fontsize=8)
        axes.set_yscale("log")
    shares = [np.bincount(one.stage, minlength=5) / len(one.stage) for one in (real, simulated)]
    for shift, share, style in zip((-0.2, 0.2), shares, STYLES, strict=True):
        panels[17].bar(np.arange(5) + shift, share, 0.38, color=style["color"])
    panels[17].set_title("events by stage", fontsize=8)
    for axes in panels:
        axes.tick_params(labelsize=6)
        axes.yaxis.set_minor_formatter(NullFormatter())
        axes.spines[["top", "right"]].set_visible(False)
    panels[0].legend(fontsize=7, frameon=False)
    figure.supxlabel("probability (stage in the last panel)", fontsize=8)
    figure.savefig(path, metadata={"Software": None})


def describe(tables: Path | None) -> None:
    """Draw the card's pictures, and print its tables."""
    real = real_summary(read_visits(find_tables(tables)))
    wide = simulated_summary(sepsis_sim.visits_dataset(sepsis_sim.TRAINING_VISITS, seed=sepsis_sim.TRAINING_SEED))
    draw_marginals(real, wide, OUT / "marginals.png")
    data = sepsis_sim.load()
    pictures.shares_over_time(
        [np.asarray(episode.infos["stage"]) for episode in data],
        [np.asarray(episode.infos["time"]) for episode in data],
        names=STAGES,
        until=14 * 24,
        path=OUT / "stages.png",
    )
    print(side_by_side(real, wide))
    returns = np.array([sepsis.GAMMA ** np.arange(len(e.rewards)) @ e.rewards for e in data])
    print(f"{len(data)} episodes, {data.total_steps} steps, mean discounted return {returns.mean():.2f}")


def train(out: Path) -> None:
    """Train the five networks on other patients of the clinician and write them to `out`."""
    data = sepsis_sim.visits_dataset(sepsis_sim.TRAINING_VISITS, seed=sepsis_sim.TRAINING_SEED)
    out.mkdir(parents=True, exist_ok=True)
    for name, (settings, seed) in sepsis.TARGETS.items():
        settings.fit(data, seed=seed).save(out / f"{name}.safetensors")
        print(f"trained {name}: {settings}", flush=True)


def main() -> None:
    """Read the command line and build."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=("calibrate", "train", "describe"))
    parser.add_argument("--tables", type=Path)
    options = parser.parse_args()
    if options.part == "calibrate":
        calibrate(options.tables)
    elif options.part == "train":
        train(OUT / "policies")
    else:
        describe(options.tables)


if __name__ == "__main__":
    main()
