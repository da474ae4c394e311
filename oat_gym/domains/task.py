"""What belongs to a task: its target policies, their true values, and where episodes start."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from oat_gym.domains.truth import Truth
from oat_gym.ope.policy import Policy
from oat_gym.spaces import Batch


@dataclass(frozen=True)
class Task:
    """What the datasets of a task are evaluated with.

    Attributes:
        datasets: names of the task's datasets (`domains.DATASETS`).
        policies: () -> the target policies by name.
        truth: gamma -> their true values; `None` where nobody knows them (real patients and students).
        initial_states: (count, seed) -> observations where the environment starts episodes; `None` where the data's
            first states are the only ones.
        gamma: the discount that the task is usually evaluated at.
        horizon: number of steps that the true values count; `None` for endless.
        paper: name of the paper's task that this one repeats or stands in for, as "door" ("" for none).
        episodes_of: name of the task whose recorded episodes its datasets hold in another form ("": of no other), so
            that results of both are not independent.
    """

    datasets: tuple[str, ...]
    policies: Callable[[], dict[str, Policy]]
    truth: Callable[[float], Truth] | None = None
    initial_states: Callable[[int, int], Batch] | None = None
    gamma: float = 0.995
    horizon: int | None = None
    paper: str = ""
    episodes_of: str = ""
