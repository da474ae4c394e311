"""Adroit: four tasks of a robot hand, each with human, cloned and expert data, DOPE's policies and their true values.

The paper's levels of human involvement are `human` (demonstrations only), `cloned` (half of them, half roll-outs of
a policy cloned from them) and `expert` (roll-outs of a trained policy), all with as many steps as D4RL's human data.
Where the demonstrations are not to be had, `cloned-from-expert` puts expert roll-outs in their place. True values count
D4RL's rewards, which the data carries, over 100 (pen) or 200 steps from the environment's resets.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import minari

from oat_gym.domains.adroit_data import cloned_dataset, expert_dataset
from oat_gym.domains.adroit_env import reset_observations
from oat_gym.domains.adroit_human import DATASET_ID, DEMONSTRATION_STEPS, FILE, door_human, human
from oat_gym.domains.adroit_policies import dope_policies
from oat_gym.domains.adroit_rewards import ADROIT
from oat_gym.domains.task import Task
from oat_gym.domains.truth import Truth, read_truth

LEVELS = ("human", "cloned", "expert", "cloned-from-expert")
"""What the four datasets of a task are called, after "adroit-TASK-"."""


def cloned(name: str) -> minari.MinariDataset:
    """Return half of a task's human demonstrations and as many steps of a policy cloned from them (`cloned_dataset`).

    Raises:
        ConfigurationError: for an unknown task.
        DatasetNotFoundError: if the demonstrations are not there; the message says how to get them.
    """
    return cloned_dataset(name, human(name), level="cloned")


def cloned_from_expert(name: str) -> minari.MinariDataset:
    """Return half of a task's expert roll-outs and as many steps of a policy cloned from them (`cloned_dataset`).

    Raises:
        ConfigurationError: for an unknown task.
        DatasetNotFoundError: if the expert's weights are not there; the message says how to get them.
    """
    return cloned_dataset(name, expert_dataset(name), level="cloned-from-expert")


def true_values(name: str, gamma: float) -> Truth:
    """Return the true values of a task's target policies at a discount, from roll-outs (`datasets/truth_adroit.py`).

    Raises:
        ConfigurationError: for a discount that is not stored.
        DatasetNotFoundError: if the installation lacks the file.
    """
    return read_truth(f"adroit-{name}", gamma=gamma)


def _task(name: str) -> Task:
    return Task(
        datasets=tuple(f"adroit-{name}-{level}" for level in LEVELS),
        policies=partial(dope_policies, name),
        truth=partial(true_values, name),
        initial_states=partial(reset_observations, name),
        gamma=0.995,
        horizon=ADROIT[name].horizon,
        paper=name,
    )


_OPENERS: dict[str, Callable[[str], minari.MinariDataset]] = {
    "human": human,
    "cloned": cloned,
    "expert": expert_dataset,
    "cloned-from-expert": cloned_from_expert,
}

DATASETS: dict[str, Callable[[], minari.MinariDataset]] = {
    f"adroit-{name}-{level}": partial(_OPENERS[level], name) for name in ADROIT for level in LEVELS
}
"""Name of each dataset and the function that opens it."""

TASKS: dict[str, Task] = {f"adroit-{name}": _task(name) for name in ADROIT}
"""Name of each task and what its datasets are evaluated with."""

__all__ = [
    "ADROIT",
    "DATASETS",
    "DATASET_ID",
    "DEMONSTRATION_STEPS",
    "FILE",
    "LEVELS",
    "TASKS",
    "cloned",
    "cloned_from_expert",
    "door_human",
    "dope_policies",
    "expert_dataset",
    "human",
    "true_values",
]
