"""What generated steps are like: errors by the simulator and by a model, seams, nearness to target policies, change.

    python tests/benchmarks/diagnose_steps.py run --out FOLDER [--datasets maze2d-umaze,adroit-door-human]
        [--variants oat-paper,oat,jittering] [--seeds 0,1,2]
    python tests/benchmarks/diagnose_steps.py tables --out FOLDER

DATASETS are names of `oat_gym.domains`, VARIANTS those of `oat_gym.benchmark.variants`, with the settings, and so the
trained models, of `oat-gym bench`. A row of `FOLDER/steps.csv` is one dataset, variant and seed; rows that are there
are not computed again. `tables` writes `FOLDER/steps.md` from them.
"""

from __future__ import annotations

import argparse
import csv
import io
import itertools
import time
import warnings
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import numpy.typing as npt
from minari import MinariDataset

from oat_gym import AugmentedDataset, domains
from oat_gym._rng import derive
from oat_gym.augmenters import Augmenter
from oat_gym.benchmark.job import one_thread
from oat_gym.benchmark.measure import environment
from oat_gym.benchmark.variants import NONE, VARIANTS, Variant, find_variant, fit_length, on_device
from oat_gym.cache import fingerprint, write_atomically
from oat_gym.domains import maze2d_d4rl
from oat_gym.domains.maze2d_env import open_maze
from oat_gym.domains.maze2d_layout import UMAZE
from oat_gym.errors import OatGymError
from oat_gym.metrics import nearest
from oat_gym.metrics.judge import Judge
from oat_gym.metrics.steps import Scale, Steps, read_steps
from oat_gym.ope.policy import PolicySet
from oat_gym.ope.problem import flatten_policies
from oat_gym.provenance import Provenance
from oat_gym.source import Source
from oat_gym.spaces import FlatSpace

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]
CATEGORY = 1e3
"""Distance between two categories of an action: more than between any two states."""
BLOCK = 10_000
"""Points whose distances are computed at a time."""


@dataclass(frozen=True)
class Limits:
    """Most steps that simulator and model judge, recorded states of the coverage, and points searched in each part."""

    steps: int = 2_000
    states: int = 500
    points: int = 200_000


Outcome = tuple[FloatArray, FloatArray, BoolArray]
"""What a simulator makes of n steps: states after them (n, 4), rewards (n,), and which began in a wall (n,)."""


def push(states: FloatArray, actions: FloatArray, goals: FloatArray) -> Outcome:
    """Return what PointMaze_UMaze does with forces (n, 2) in x, y and velocities (n, 4), and goals (n, 2)."""
    found, rewards = np.empty_like(states), np.empty(len(states))
    with open_maze() as env:
        env.reset(seed=0)
        point, reward = env.get_wrapper_attr("point_env"), env.get_wrapper_attr("compute_reward")
        for row, (state, action, goal) in enumerate(zip(states, actions, goals, strict=True)):
            point.data.qacc_warmstart[:] = 0  # what the step before left must not matter
            point.set_state(state[:2], state[2:])
            found[row] = point.step(action)[0]
            rewards[row] = float(reward(found[row, :2], goal, {}))
    return found, rewards, np.array([UMAZE.cell_of(state[:2]) not in UMAZE.free for state in states])


def push_d4rl(states: FloatArray, actions: FloatArray) -> Outcome:
    """Return the same in D4RL's frame."""
    forces = maze2d_d4rl.pointmaze_actions(actions).astype(np.float64)
    found, _, in_wall = push(maze2d_d4rl.pointmaze_states(states), forces, goals=np.zeros((len(states), 2)))
    found = maze2d_d4rl.d4rl_states(found)
    return found, maze2d_d4rl.d4rl_rewards(found), in_wall


Simulator = Callable[[FloatArray, FloatArray], Outcome]
SIMULATORS: dict[str, Simulator] = {
    "maze2d-umaze": lambda states, actions: push(states[:, 4:], actions, states[:, 2:4]),
    "maze2d-umaze-d4rl": push_d4rl,
}
"""The datasets whose observations hold the whole state of their environment, in the last four columns."""


def simulator_errors(simulator: Simulator, steps: Steps, scale: Scale, prefix: str) -> dict[str, float]:
    """Return errors of s' in sd of a real change, over steps and columns and of the median step, of r, and in walls."""
    next_states, rewards, in_wall = simulator(steps.states, steps.actions)
    each = root_mean_square((steps.next_states[:, -4:] - next_states) / scale.changes[1][-4:], axis=1)
    return {
        f"{prefix}_state": float(root_mean_square(each)),
        f"{prefix}_state_median": float(np.median(each)),
        f"{prefix}_reward": float(root_mean_square((steps.rewards - rewards) / scale.rewards[1])),
        f"{prefix}_in_wall": float(in_wall.mean()),
    }


def root_mean_square(values: FloatArray, axis: int | None = None) -> FloatArray:
    return np.sqrt(np.square(values).mean(axis=axis))


@dataclass(frozen=True)
class Targets:
    """Recorded states, what each of P target policies does there (P, n, A), and which of the A columns are one-hot."""

    steps: Steps
    actions: FloatArray
    discrete: BoolArray

    def distance(self, points: Steps, scale: Scale) -> float:
        """Return the median distance from (s, pi(s)) to the nearest step made from another episode.

        A discrete action must be the same: the distance is then that to the nearest state in which it was taken.
        """
        units = replace(scale, actions=(scale.actions[0], np.where(self.discrete, 1 / CATEGORY, scale.actions[1])))
        queries = np.concatenate([units.inputs(replace(self.steps, actions=each)) for each in self.actions])
        groups = np.tile(self.steps.episodes, len(self.actions))
        found = np.full(len(queries), np.inf)
        # In any order, so that every block has steps of several episodes.
        for rows in np.array_split(np.random.default_rng(0).permutation(len(points)), -(-len(points) // BLOCK)):
            block = points.take(rows)
            near = nearest(queries, units.inputs(block), query_groups=groups, point_groups=block.episodes)
            found = np.minimum(found, near)
        return float(np.median(found))


@dataclass(frozen=True)
class Subject:
    """A dataset with one seed, and what all variants are measured against."""

    real: MinariDataset
    policies: PolicySet
    simulator: Simulator | None = None
    seed: int = 0
    limits: Limits = Limits()

    @cached_property
    def steps(self) -> Steps:
        return read_steps(self.real).real

    @cached_property
    def spaces(self) -> tuple[FlatSpace, FlatSpace]:
        return FlatSpace.of(self.real.observation_space), FlatSpace.of(self.real.action_space)

    @cached_property
    def judge(self) -> Judge:
        observations, actions = self.spaces
        return Judge(self.steps, observations=observations, actions=actions, seed=self.seed, limit=self.limits.steps)

    @cached_property
    def targets(self) -> Targets:
        observations, actions = self.spaces
        chosen = self.steps.sample(self.limits.states, derive(self.seed, "diagnosis", "states"))
        means = self.policies.mean(observations.unflatten(chosen.states))
        discrete = np.isin(np.arange(actions.layout.width), actions.layout.continuous, invert=True)
        return Targets(chosen, flatten_policies(means, actions, len(self.policies)), discrete)

    @cached_property
    def levels(self) -> dict[str, float | None]:
        """What the real steps give themselves."""
        scale, recorded = self.judge.scale, replace(self.targets, actions=self.targets.steps.actions[None])
        near = {"recorded_near": recorded, "real_near": self.targets}
        found = {name: targets.distance(self.points(), scale) for name, targets in near.items()}
        return {"n_real": len(self.steps), **found, **self.simulated(self.steps, "check")}

    def simulated(self, steps: Steps, prefix: str) -> dict[str, float]:
        """Return the simulator's verdict on some of these steps, where there is a simulator."""
        some = steps.sample(self.limits.steps, derive(self.seed, "diagnosis", "simulated"))
        return simulator_errors(self.simulator, some, self.judge.scale, prefix) if self.simulator else {}

    def points(self, *generated: Steps) -> Steps:
        """Return the steps that neighbours are looked for in: the real ones, and generated ones where given."""
        rng = derive(self.seed, "diagnosis", "points")
        parts = [vars(part.sample(self.limits.points, rng)) for part in (self.steps, *generated)]
        return Steps(**{name: np.concatenate([part[name] for part in parts]) for name in parts[0]})


def diagnose(subject: Subject, augmenter: Augmenter, *, factor: float) -> dict[str, float | None]:
    """Return the numbers of one way of augmenting, by column."""
    data = AugmentedDataset(subject.real, augmenter, factor=factor, seed=subject.seed)
    data.fit(progress=False)
    contents = read_steps(data)
    generated, scale = contents.generated, subject.judge.scale
    scores = subject.judge.fidelity(generated, contents.seams)
    found: dict[str, float | None] = {**subject.levels, "n_generated": len(generated)}
    found["share_generated"] = len(generated) / float(data.synthesis.lengths[data.synthesis.n_real :].sum())
    found |= changes(subject.steps, generated.take(in_equal_lengths(data)), scale)
    found |= subject.simulated(generated, "simulator")
    found |= {"model_state": scores.dynamics.value, "model_reward": scores.reward.value}
    found |= {"seam": scores.seam_mean.value, "real_step": float(scale.sizes(subject.steps).mean())}
    real, both = subject.levels["real_near"], subject.targets.distance(subject.points(generated), scale)
    return found | {"both_near": both, "near_ratio": both / real if real else None}


def in_equal_lengths(data: AugmentedDataset) -> BoolArray:
    """Return, for each generated step in order, whether its episode is as long as the one it was made from."""
    plan = data.synthesis
    numbers = range(plan.n_real, plan.n_real + plan.count)
    parts = zip(data.storage.get_episode_metadata(numbers), numbers, strict=True)
    counts = [int(Provenance.from_metadata(metadata, number).mask.sum()) for metadata, number in parts]
    return np.repeat(plan.lengths[plan.n_real :] == plan.lengths[np.arange(plan.count) % plan.n_real], counts)


def changes(real: Steps, generated: Steps, scale: Scale) -> dict[str, float]:
    """Return root mean square differences, z-scored, to the recorded steps of the same episode and number."""
    if not len(generated):
        return {}
    stride = 1 + max(int(real.numbers.max()), int(generated.numbers.max()))
    here, there = (steps.episodes * stride + steps.numbers for steps in (real, generated))
    order = np.argsort(here)
    old = real.take(order[np.searchsorted(here, there, sorter=order)])
    rewards = (generated.rewards - old.rewards) / scale.rewards[1]
    rows, width = np.hstack((scale.inputs(generated) - scale.inputs(old), rewards[:, None])), real.states.shape[1]
    parts = {"": slice(None), "_state": slice(width), "_action": slice(width, -1), "_reward": slice(-1, None)}
    return {f"change{name}": float(root_mean_square(rows[:, part])) for name, part in parts.items()}


TABLES: dict[str, dict[str, str]] = {
    "What was generated": {
        "share_generated": "share of synthetic steps",
        "change": "change of (s, a, r)",
        "change_state": "of s",
        "change_action": "of a",
        "change_reward": "of r",
        "seam": "seam jump",
        "real_step": "a real step's change",
    },
    "Errors": {
        "simulator_state": "simulator: s'",
        "simulator_state_median": "s', median step",
        "simulator_reward": "simulator: r",
        "simulator_in_wall": "began in a wall",
        "check_state": "real steps: s'",
        "check_reward": "real steps: r",
        "model_state": "held-out model: s' (ratio)",
        "model_reward": "held-out model: r (ratio)",
    },
    "Nearness to the target policies": {
        "recorded_near": "(s, a) to real",
        "real_near": "(s, pi(s)) to real",
        "both_near": "to real and generated",
        "near_ratio": "ratio",
    },
}
"""Title of each table -> column of the CSV -> its heading."""
KEYS = ("dataset", "variant", "seed")
COLUMNS = (
    *(*KEYS, "n_real", "n_generated"),
    *(column for columns in TABLES.values() for column in columns),
    *("reason", "settings", *vars(Limits()), "cpu_seconds", "commit", "versions"),
)
Row = dict[str, str]


def read_rows(path: Path) -> dict[tuple[str, ...], Row]:
    """Return the rows of a CSV by dataset, variant and seed."""
    lines = path.read_text().splitlines() if path.exists() else []
    return {tuple(row[key] for key in KEYS): row for row in csv.DictReader(lines)}


def write_rows(path: Path, rows: Iterable[Row]) -> None:
    text = io.StringIO()
    writer = csv.DictWriter(text, fieldnames=COLUMNS, lineterminator="\n", restval="", extrasaction="ignore")
    writer.writeheader()
    writer.writerows(rows)
    write_atomically(path, text.getvalue().encode())


def run(out: Path, datasets: list[str], variants: list[Variant], seeds: list[int], limits: Limits) -> None:
    """Compute the rows that are not there."""
    out.mkdir(parents=True, exist_ok=True)
    path, where = out / "steps.csv", environment("cpu")
    versions = ", ".join(f"{name} {where[name]}" for name in ("python", "numpy", "scikit-learn", "torch", "minari"))
    told = {"commit": str(where["commit"]), "versions": versions, **{k: str(v) for k, v in vars(limits).items()}}
    for name, seed in itertools.product(datasets, seeds):
        policies = PolicySet.of(domains.policies(name))
        subject = Subject(domains.load(name), policies, SIMULATORS.get(name), seed, limits)
        for variant in variants:
            settings = fingerprint(variant=variant.description(), limits=limits)[:12]
            key = (name, variant.name, str(seed))
            if read_rows(path).get(key, {}).get("settings") == settings:
                continue
            with one_thread(), warnings.catch_warnings():
                warnings.simplefilter("ignore")
                row = measure(subject, variant)
            row |= dict(zip(KEYS, key, strict=True)) | {"settings": settings} | told
            write_rows(path, (read_rows(path) | {key: row}).values())
            print(*key, row["cpu_seconds"], "CPU s", row.get("reason", ""), flush=True)


def measure(subject: Subject, variant: Variant) -> Row:
    """Return the numbers of a row as text, or the reason why there are none."""
    begun = time.process_time()
    augmenter = variant.with_policies(dict(zip(subject.policies.names, subject.policies.policies, strict=True)))
    if augmenter is None:
        raise SystemExit(f"{variant.name!r} generates nothing.")
    augmenter = on_device(fit_length(augmenter, Source(subject.real).lengths), "cpu")
    try:
        found = diagnose(subject, augmenter, factor=variant.factor)
        row = {key: "" if value is None else f"{value:.6g}" for key, value in found.items()}
    except OatGymError as error:
        row = {"reason": str(error)}
    return row | {"cpu_seconds": f"{time.process_time() - begun:.1f}"}


NOTES = """
Mean over seeds ± standard deviation over seeds. "sd" is a standard deviation of the real data, column by column.

- *Change*: root mean square difference, in sd, to the recorded step of the same number in the source episode (only
  where a synthetic episode is as long as its source). *Seam jump*: mean jump where a generated span meets recorded
  steps, in sd of the states, root mean square over features, beside the mean size of a real step in the same units.
- *Simulator*: of at most {steps} generated steps the simulator is put into s and given a; the error of s' (position
  and velocity) in sd of a real one-step difference, of r in sd of real rewards: root mean square, which few steps that
  begin in walls can rule, and the median step's own. *Real steps*: the same of recorded steps, which checks all this.
  Without these columns: the environment cannot be put into the state of an observation alone (Adroit's holds no
  velocities of the hand's joints), so that the held-out model alone judges.
- *Held-out model*: error of s' - s, and of r, against regression trees fitted to the other half of the episodes, over
  that of real steps in the same place (`oat_gym.metrics.fidelity`); 1: as predictable as real steps.
- *Nearness*: of {states} recorded states s and each target policy's mean action, the median distance in z-scored
  (s, a) from (s, pi(s)) to the nearest step that is neither of s's episode nor made from it; *(s, a)* is the same for
  recorded actions, and a discrete action must be the same. Ratio 1: nothing comes nearer. Any more points are nearer
  points (compare with jittering), and what mixes episodes (SPAWNER, DGW) or learned from s's own is flattered. At most
  {points} real and as many generated steps are searched.
"""


def tables(out: Path) -> None:
    """Write the markdown tables of the rows that are there."""
    order = {name: number for number, name in enumerate(VARIANTS)}
    rows = list(read_rows(out / "steps.csv").values())
    rows.sort(key=lambda row: (order[row["variant"].partition("+")[0]], row["variant"], int(row["seed"])))
    if not rows:
        raise SystemExit(f"{out} holds no rows: run first.")
    found = {key: ",".join(dict.fromkeys(row[key] for row in rows)) for key in (*KEYS, "commit", "versions")}
    command = f"run --out FOLDER --datasets {found['dataset']} --variants {found['variant']} --seeds {found['seed']}"
    lines = ["# Generated steps", "", f"`python tests/benchmarks/diagnose_steps.py {command}`", ""]
    lines += [f"Seeds {found['seed']}; commit {found['commit'] or 'unknown'}; {found['versions']}; CPU."]
    lines += [NOTES.format(**{key: " or ".join(sorted({row[key] for row in rows})) for key in vars(Limits())})]
    for dataset in found["dataset"].split(","):
        lines += [f"## {dataset}", "", *_dataset([row for row in rows if row["dataset"] == dataset])]
    write_atomically(out / "steps.md", "\n".join(lines).encode())


def _dataset(rows: list[Row]) -> list[str]:
    lines: list[str] = []
    for title, columns in TABLES.items():
        shown = {column: heading for column, heading in columns.items() if any(row[column] for row in rows)}
        if shown:
            lines += [f"**{title}**", "", "| variant | seeds | " + " | ".join(shown.values()) + " |"]
            lines += ["|---|" + "---|" * (1 + len(shown))]
        for variant in dict.fromkeys(row["variant"] for row in rows if shown):
            mine = [row for row in rows if row["variant"] == variant]
            cells = [variant, str(sum(not row["reason"] for row in mine)), *(_cell(mine, column) for column in shown)]
            lines += ["| " + " | ".join(cells) + " |"]
        lines += [""] if shown else []
    failures = [f"- {row['variant']}, seed {row['seed']}: {row['reason']}" for row in rows if row["reason"]]
    return [*lines, *failures, *([""] if failures else [])]


def _cell(rows: list[Row], column: str) -> str:
    values = np.array([float(row[column]) for row in rows if row[column]])
    if not len(values):
        return ""
    return f"{values.mean():.3g}" + (f" ± {values.std(ddof=1):.2g}" if len(values) > 1 else "")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("run", "tables"))
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--datasets", default="maze2d-umaze,adroit-door-human")
    parser.add_argument("--variants", default=",".join(name for name in VARIANTS if name != NONE))
    parser.add_argument("--seeds", default="0,1,2")
    parser.add_argument("--steps", type=int, default=Limits.steps, help="most steps for simulator and model")
    parser.add_argument("--states", type=int, default=Limits.states, help="recorded states for the nearness")
    arguments = parser.parse_args()
    if arguments.what == "tables":
        return tables(arguments.out)
    variants = [find_variant(name) for name in arguments.variants.split(",")]
    seeds = [int(seed) for seed in arguments.seeds.split(",")]
    return run(arguments.out, arguments.datasets.split(","), variants, seeds, Limits(arguments.steps, arguments.states))


if __name__ == "__main__":
    main()
