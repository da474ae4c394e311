"""A domain with exact values, small enough for tests: a point on a line that policies pull towards 1.

x' = x + 0.5 a + noise, reward x, ten steps; a policy of gain g takes a = g (1 - x) plus noise. The mean of x follows
m' = m + 0.5 g (1 - m), so that the value is a sum of ten known numbers.
"""

from __future__ import annotations

import atexit
import shutil
import tempfile
import warnings
from functools import partial
from pathlib import Path

import minari
import numpy as np
from gymnasium import spaces
from minari.data_collector import EpisodeBuffer

from oat_gym import ope
from oat_gym.benchmark.budget import Budget
from oat_gym.benchmark.protocol import Catalog, Suite
from oat_gym.domains import Task, Truth
from oat_gym.domains.truth import exact_truth
from oat_gym.io.writing import DatasetCard, dataset_from_episodes

GAMMA, STEPS = 0.9, 10
GAINS = {"none": 0.0, "weak": 0.2, "fair": 0.5, "good": 0.8, "strong": 1.1, "best": 1.5}
ACTIONS = spaces.Box(-10.0, 10.0, (1,), np.float64)
STATES = spaces.Box(-20.0, 20.0, (2,), np.float64)


def _pull(gain: float, states: np.ndarray) -> np.ndarray:
    return gain * (1.0 - np.asarray(states)[:, :1])


def policies() -> dict[str, ope.Policy]:
    return {name: ope.GaussianPolicy(partial(_pull, gain), 0.4, ACTIONS) for name, gain in GAINS.items()}


def truth(gamma: float) -> Truth:
    values = {}
    for name, gain in GAINS.items():
        mean, value = 0.0, 0.0
        for t in range(STEPS):
            mean += 0.5 * gain * (1.0 - mean)
            value += gamma**t * mean
        values[name] = value
    return exact_truth(values, gamma=gamma, horizon=STEPS, command="closed form")


def initial_states(count: int, seed: int) -> np.ndarray:
    return np.zeros((count, 2))


def _episode(number: int) -> EpisodeBuffer:
    rng = np.random.default_rng(number)
    states, actions = [np.zeros(2)], []
    for _ in range(STEPS):
        action = _pull(0.5, states[-1][None])[0] + 0.4 * rng.normal(size=1)
        actions.append(action)
        x = states[-1][0] + 0.5 * action[0] + 0.05 * rng.normal()
        states.append(np.array([x, rng.normal()]))
    done = np.arange(STEPS) == STEPS - 1
    return EpisodeBuffer(
        observations=np.array(states),
        actions=np.array(actions),
        rewards=np.array(states)[1:, 0],
        terminations=np.zeros(STEPS, dtype=bool),
        truncations=done,
    )


def _write(folder: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        dataset_from_episodes(
            [_episode(number) for number in range(12)],
            directory=folder,
            card=DatasetCard(dataset_id="test/line-v0", description="a point on a line", author="tests"),
            observation_space=STATES,
            action_space=ACTIONS,
        )


def real_policies() -> dict[str, ope.Policy]:
    return {name: policy for name, policy in policies().items() if name in ("weak", "good")}


def absent() -> minari.MinariDataset:
    from oat_gym.errors import DatasetNotFoundError

    raise DatasetNotFoundError("D4RL/line/human-v2 is not here: run `minari download D4RL/line/human-v2`.")


def curves(dataset: minari.MinariDataset, targets: dict[str, ope.Policy]) -> dict[str, ope.AgreementCurve]:
    shares = np.linspace(0, 1, len(dataset))
    return {name: ope.agreement_curve(shares, shares < 0.5, kind="at-least") for name in targets}


def _catalog() -> Catalog:
    folder = Path(tempfile.mkdtemp(prefix="oat-gym-tiny-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    _write(folder / "line")
    opened = partial(minari.MinariDataset, folder / "line" / "data")  # other processes can open it
    return Catalog(
        datasets={"line": opened, "line-logs": opened, "line-human": absent},
        tasks={
            "line": Task(
                ("line", "line-human"), policies, truth, initial_states, gamma=GAMMA, horizon=STEPS, paper="door"
            ),
            "logs": Task(("line-logs",), real_policies, gamma=GAMMA, horizon=STEPS),
        },
        curves={"line-logs": ("a fall", curves)},
    )


CATALOG = _catalog()
SUITE = Suite("line", ("line", "line-human"), "a point on a line")
_LINEAR = ope.FQE(approximation="linear")
BUDGET = Budget(
    "tiny",
    (("fqe", _LINEAR), ("is", ope.ImportanceSampling())),
    ope.BehaviorCloning(hidden=(8,), max_updates=20, evaluate_every=10, folds=2),
    quick=True,
)
