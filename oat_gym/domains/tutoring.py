"""Tutoring: the log of a real reinforcement-learning tutor (SmartPrimer), and simulated students.

The paper's log is private. `tutoring-smartprimer` is a real one, of another tutor, with the probability that every
action had; the true values of policies are not known, but what students achieved is (`outcomes`). `tutor-sim` is a
simulation of the paper's task, where values are known (`oat_gym.domains.tutor_sim`).
"""

from __future__ import annotations

import csv
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import minari
import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from oat_gym.domains import tutor_sim
from oat_gym.domains._data import converted, find_file
from oat_gym.domains.dqn import DQN, EVALUATION_EPSILON, QNetwork
from oat_gym.domains.task import Task
from oat_gym.domains.tutor_outcomes import Outcome, mean_and_error, outcomes
from oat_gym.domains.tutor_policies import ConstantPolicy, RecordedPolicy
from oat_gym.embedded import embedded_file
from oat_gym.errors import InvalidDataError
from oat_gym.io.tables import episodes_from_table
from oat_gym.io.writing import DatasetCard, dataset_from_episodes
from oat_gym.ope.policies import UniformPolicy
from oat_gym.ope.policy import Policy

DATASET_ID = "oat_gym/tutoring-smartprimer-v0"
FILE = "tutoring/smartprimer/smartprimer_offline_with_probabilities_numeric.csv"
FEATURES = (
    "grade_norm",
    "pre-score_norm",
    "stage_norm",
    "failed_attempts_norm",
    "pos_norm",
    "neg_norm",
    "hel_norm",
    "anxiety_norm",
)
"""The observation's columns, as the tutor's policy saw them, normalised to about [-1, 1]."""
ACTIONS = ("hint", "nothing", "encourage", "question")
"""What action 0, 1, 2 and 3 mean."""
PROBABILITY_FLOOR = 0.0005
"""The log rounds probabilities to 3 decimals: a printed 0.000 of an action that was taken is read as half a unit."""

_VERSION = 1  # raise it when the conversion changes
_HOW_TO_GET = (
    f"Set OAT_GYM_DATA to a folder that holds {FILE}, or pass path= to the file (from StanfordAI4HI/SmartPrimer_Gym, "
    "commit 12f379e)."
)
_DESCRIPTION = (
    "Decisions of SmartPrimer's adaptive tutor (StanfordAI4HI/SmartPrimer_Gym, commit 12f379e, MIT): 178 students, 859 "
    "decisions; actions hint, nothing, encourage, question. A session's end is a termination: its last reward holds "
    "the outcome (about the adjusted learning gain, or -8 where the student did not finish). The observation after the "
    "last decision was not recorded; the last one is repeated there. infos: `probabilities` as logged (3 decimals), "
    "`log_prob` of the action taken (logged 0.000 read as 0.0005), `user_id` and `action_number` of the log."
)


def smartprimer(path: str | os.PathLike[str] | None = None) -> minari.MinariDataset:
    """Return the SmartPrimer log: 178 students (episodes) and 859 decisions, 1 to 28 each.

    Observations are the 8 features of `FEATURES`, actions are `Discrete(4)` (`ACTIONS`). The session ends with its last
    decision, so that step terminates, and the observation that follows it, which was not recorded, repeats the last
    one. `infos["log_prob"]` is the log of the logged probability of the action taken, `infos["probabilities"]` has all
    four as logged, to 3 decimals. Two of the 859 taken actions are logged with 0.000; their `log_prob` is that of
    `PROBABILITY_FLOOR`. Episodes come in the order of the students' ids (`infos["user_id"]`). Converted once, into the
    cache (OAT_GYM_CACHE).

    Args:
        path: the .csv file, or a folder that holds it.

    Raises:
        DatasetNotFoundError: if the data is not there; the message says how to get it.
        InvalidDataError: if the file does not hold what is expected.
    """
    source = find_file(FILE, path=path, how_to_get=_HOW_TO_GET)

    return converted("tutoring-smartprimer", source, version=_VERSION, write=lambda folder: _convert(source, folder))


def _convert(source: Path, folder: Path) -> minari.MinariDataset:
    episodes = episodes_from_table(
        _read_log(source),
        episode="user_id",
        order="action_number",
        consecutive=True,
        observations=FEATURES,
        action="action",
        reward="reward",
        propensity="propensity",
        infos=("user_id", "action_number", *(f"p_{name}" for name in ACTIONS)),
    )
    for episode in episodes:
        assert episode.infos is not None
        columns = [episode.infos.pop(f"p_{name}") for name in ACTIONS]
        episode.infos["probabilities"] = np.stack(columns, axis=1)
    return dataset_from_episodes(
        episodes,
        directory=folder,
        card=DatasetCard(
            dataset_id=DATASET_ID,
            description=_DESCRIPTION,
            author="StanfordAI4HI (SmartPrimer)",
            algorithm_name="the tutor that was online, a learned stochastic policy",
        ),
        observation_space=_observation_space(),
        action_space=spaces.Discrete(len(ACTIONS)),
    )


def _observation_space() -> spaces.Box:
    high = np.ones(len(FEATURES))
    high[FEATURES.index("failed_attempts_norm")] = np.inf  # attempts / 10 - 1: no upper bound
    return spaces.Box(-np.ones(len(FEATURES)), high, dtype=np.float64)


def _read_log(source: Path) -> dict[str, npt.NDArray[Any]]:
    """Return the numeric columns of the log, and the probability of the action taken as `propensity`."""
    names = ("user_id", "action_number", *FEATURES, "action", "reward", *(f"p_{name}" for name in ACTIONS))
    with source.open(newline="", encoding="utf-8") as file:
        reader = csv.DictReader(file)
        missing = [name for name in names if name not in (reader.fieldnames or ())]
        if missing:
            raise InvalidDataError(f"{source} lacks the columns {missing}; it has {reader.fieldnames}. {_HOW_TO_GET}")
        rows = list(reader)
    try:
        table = {name: np.array([float(row[name]) for row in rows]) for name in names}
    except (TypeError, ValueError) as error:  # a row that was cut has None
        raise InvalidDataError(f"{source} holds a value that is not a number: {error}.") from error
    whole = {name: _whole(table[name], name, source) for name in ("user_id", "action_number", "action")}
    return {**table, **whole, "propensity": _taken_probability(table, source)}


def _whole(values: npt.NDArray[np.float64], name: str, source: Path) -> npt.NDArray[np.int64]:
    if not (np.isfinite(values) & (values == np.round(values))).all():
        raise InvalidDataError(f"{source}: the column {name} must hold whole numbers only. {_HOW_TO_GET}")
    return values.astype(np.int64)


def _taken_probability(table: dict[str, npt.NDArray[np.float64]], source: Path) -> npt.NDArray[np.float64]:
    action = table["action"].astype(np.int64)
    if not np.isin(action, np.arange(len(ACTIONS))).all():
        raise InvalidDataError(f"{source} has actions {np.unique(action).tolist()}; expected 0 to {len(ACTIONS) - 1}.")
    probabilities = np.stack([table[f"p_{name}"] for name in ACTIONS], axis=1)
    if not ((probabilities >= 0) & (probabilities <= 1)).all():
        raise InvalidDataError(f"{source} has probabilities of actions outside 0 to 1. {_HOW_TO_GET}")
    taken = probabilities[np.arange(len(action)), action]
    return np.maximum(taken, PROBABILITY_FLOOR)


def train_policy(dataset: minari.MinariDataset) -> QNetwork:
    """Return the network of the task's policy "dqn", trained on the log at the paper's default settings."""
    return DQN().fit(dataset, seed=0)


def policies() -> dict[str, Policy]:
    """Return the target policies of the log: the tutor itself as logged, a DQN, uniform, and one for each action.

    The DQN and the four that prefer an action take another one with probability 0.05 in all, as Mnih et al. evaluate.

    Raises:
        DatasetNotFoundError: if the log is not there ("logged" is made of it), or the installation lacks the network.
    """
    space, epsilon = spaces.Discrete(len(ACTIONS)), EVALUATION_EPSILON
    path = embedded_file("tutoring-smartprimer/policies/dqn.safetensors")
    network = QNetwork.load(path, observation_space=_observation_space(), action_space=space)
    constant = {
        name: ConstantPolicy.mostly(action, n_actions=len(ACTIONS), epsilon=epsilon)
        for action, name in enumerate(ACTIONS)
    }
    return {
        "logged": RecordedPolicy.of(smartprimer()),
        "dqn": network.softened(epsilon),
        "uniform": UniformPolicy(space),
        **constant,
    }


DATASETS: dict[str, Callable[[], minari.MinariDataset]] = {
    "tutoring-smartprimer": smartprimer,
    **tutor_sim.DATASETS,
}
"""Name of each dataset and the function that opens it."""

TASKS: dict[str, Task] = {
    "tutoring-smartprimer": Task(
        datasets=("tutoring-smartprimer",), policies=policies, gamma=tutor_sim.GAMMA, paper="tutoring"
    ),
    **tutor_sim.TASKS,
}
"""Name of each task and what its datasets are evaluated with; nobody knows true values of the real log."""

__all__ = [
    "ACTIONS",
    "DATASETS",
    "FEATURES",
    "TASKS",
    "Outcome",
    "mean_and_error",
    "outcomes",
    "policies",
    "smartprimer",
    "train_policy",
]
