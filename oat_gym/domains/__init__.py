"""The paper's domains: datasets, target policies and true values by name.

>>> from oat_gym import domains
>>> domains.load("maze2d-umaze").total_episodes
250
"""

from collections.abc import Callable

import minari

from oat_gym._ids import did_you_mean
from oat_gym.domains import adroit, maze2d, sepsis, sepsis_sim, sepsis_tabular, tutoring
from oat_gym.domains.task import Task
from oat_gym.domains.truth import Truth
from oat_gym.errors import ConfigurationError
from oat_gym.ope.policy import Policy
from oat_gym.spaces import Batch

DATASETS: dict[str, Callable[[], minari.MinariDataset]] = {
    **maze2d.DATASETS,
    **adroit.DATASETS,
    **sepsis.DATASETS,
    **sepsis_sim.DATASETS,
    **sepsis_tabular.DATASETS,
    **tutoring.DATASETS,
}
"""Name of each dataset and the function that opens it."""

TASKS: dict[str, Task] = {
    **maze2d.TASKS,
    **adroit.TASKS,
    **sepsis.TASKS,
    **sepsis_sim.TASKS,
    **sepsis_tabular.TASKS,
    **tutoring.TASKS,
}
"""Name of each task and what its datasets are evaluated with."""


def load(name: str) -> minari.MinariDataset:
    """Return the dataset of this name (one of `DATASETS`) as an ordinary Minari dataset.

    Raises:
        ConfigurationError: for an unknown name.
        DatasetNotFoundError: if the data is not on this machine; the message says how to get it.
    """
    if name not in DATASETS:
        raise ConfigurationError(
            f"There is no dataset named {name!r}.{did_you_mean(name, DATASETS)} "
            f"The names are {', '.join(sorted(DATASETS))}."
        )
    return DATASETS[name]()


def task(name: str) -> Task:
    """Return the task of this name (one of `TASKS`), or the task that a dataset of this name belongs to.

    Raises:
        ConfigurationError: for an unknown name.
    """
    if name in TASKS:
        return TASKS[name]
    for candidate in TASKS.values():
        if name in candidate.datasets:
            return candidate
    raise ConfigurationError(
        f"There is no task named {name!r}, nor one with such a dataset.{did_you_mean(name, (*TASKS, *DATASETS))} "
        f"The tasks are {', '.join(sorted(TASKS))}."
    )


def policies(name: str) -> dict[str, Policy]:
    """Return the target policies of a task, by name.

    Raises:
        ConfigurationError: for an unknown task.
        DatasetNotFoundError: if the policies' weights are not on this machine; the message says how to get them.
    """
    return task(name).policies()


def truth(name: str, gamma: float | None = None) -> Truth:
    """Return the true values of a task's target policies, at a discount (`None`: the task's usual one).

    Raises:
        ConfigurationError: for an unknown task, one whose true values nobody knows, or a discount that is not stored.
        DatasetNotFoundError: if what they are computed from is not on this machine.
    """
    found = task(name)
    if found.truth is None:
        raise ConfigurationError(f"Nobody knows the true values of {name!r}: its log is of real people.")
    return found.truth(found.gamma if gamma is None else gamma)


def initial_states(name: str, *, count: int = 200, seed: int = 0) -> Batch:
    """Return observations where a task's environment starts episodes, `count` of them.

    Raises:
        ConfigurationError: for an unknown task, one without an environment, or a count below 1.
    """
    found = task(name)
    if count < 1:
        raise ConfigurationError(f"count must be at least 1, got {count}.")
    if found.initial_states is None:
        raise ConfigurationError(f"{name!r} has no environment to start episodes in; use its data's first states.")
    return found.initial_states(count, seed)


__all__ = [
    "DATASETS",
    "TASKS",
    "Task",
    "Truth",
    "adroit",
    "initial_states",
    "load",
    "maze2d",
    "policies",
    "sepsis",
    "sepsis_sim",
    "sepsis_tabular",
    "task",
    "truth",
    "tutoring",
]
