"""The four Adroit tasks, and the two rewards that are in use for three of them.

The `-v1` environments of gymnasium-robotics since 1.2.1 *add* 0.1 times the distance from hand to object, which pays
the hand for staying away; D4RL, whose data, policies and published returns everybody uses, subtracts it (repaired
upstream in `-v2`, Gymnasium-Robotics pull request 220). The pen's reward has no such term and is the same in both.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

import numpy as np
import numpy.typing as npt

from oat_gym.errors import ConfigurationError

FloatArray = npt.NDArray[np.float64]
Columns = tuple[int, int]
Convention = Literal["d4rl", "stock", "unknown"]

_WEIGHT = 0.1  # of the distance from hand to object, in both rewards
_HINGE, _OPEN = 28, 1.57  # column of the door's angle in the observation, and the angle of an open door (radians)
_BALL_TO_TARGET = (36, 39)  # columns of the vector between ball and target
_UNSEEN = 0.03  # the largest cost of velocities, which are not observed, in the door's human data


class RewardWarning(UserWarning):
    """Data carries another reward than the true values of its task count."""


@dataclass(frozen=True)
class AdroitTask:
    """What tells one Adroit task from another. Columns are those of the observation, (first, after the last).

    Attributes:
        name: "pen", "door", "hammer" or "relocate".
        env_id: the environment in gymnasium-robotics.
        horizon: number of steps of an episode in D4RL (gymnasium-robotics registers 200 for the pen too).
        human_steps: number of rows of D4RL's human data: the paper's data has this size at every level.
        hand: columns of the hand's position or, where `held` is None, of the vector between hand and object; None
            where the reward counts no such distance.
        held: columns of the position of the object that the hand goes to.
    """

    name: str
    env_id: str
    horizon: int
    human_steps: int
    hand: Columns | None = None
    held: Columns | None = None


ADROIT = MappingProxyType(
    {
        "pen": AdroitTask("pen", "AdroitHandPen-v1", 100, 5000),
        "door": AdroitTask("door", "AdroitHandDoor-v1", 200, 6729, hand=(35, 38)),
        "hammer": AdroitTask("hammer", "AdroitHandHammer-v1", 200, 11310, hand=(33, 36), held=(36, 39)),
        "relocate": AdroitTask("relocate", "AdroitHandRelocate-v1", 200, 9942, hand=(30, 33)),
    }
)
"""The four tasks by name."""


def adroit_task(name: str) -> AdroitTask:
    """Return the task of this name.

    Raises:
        ConfigurationError: for an unknown name.
    """
    if name not in ADROIT:
        raise ConfigurationError(f"There is no Adroit task {name!r}; the tasks are {', '.join(ADROIT)}.")
    return ADROIT[name]


def hand_to_object(observations: npt.ArrayLike, task: AdroitTask) -> FloatArray:
    """Return the distance in metres from hand to object that the reward counts, (...), of observations (..., D).

    It is 0 for the pen, whose reward has no such term.

    >>> hand_to_object(np.r_[np.zeros(35), 3.0, 4.0, 0.0, 1.0], ADROIT["door"]).item()
    5.0
    """
    rows = np.asarray(observations, dtype=np.float64)
    if task.hand is None:
        return np.zeros(rows.shape[:-1])
    vector = rows[..., slice(*task.hand)]
    if task.held is not None:
        vector = vector - rows[..., slice(*task.held)]
    return np.linalg.norm(vector, axis=-1)


def d4rl_reward(stock: npt.ArrayLike, following: npt.ArrayLike, task: AdroitTask) -> FloatArray:
    """Return D4RL's rewards of steps, (...).

    Args:
        stock: (...) what the `-v1` environment gave.
        following: (..., D) the observations *after* the steps.
        task: the task.
    """
    return np.asarray(stock, dtype=np.float64) - 2 * _WEIGHT * hand_to_object(following, task)


def stock_reward(d4rl: npt.ArrayLike, following: npt.ArrayLike, task: AdroitTask) -> FloatArray:
    """Return the `-v1` environment's rewards of steps with D4RL's rewards `d4rl`: the inverse of `d4rl_reward`."""
    return np.asarray(d4rl, dtype=np.float64) + 2 * _WEIGHT * hand_to_object(following, task)


def reward_convention(rewards: npt.ArrayLike, following: npt.ArrayLike, task: AdroitTask) -> Convention:
    """Return which of the two rewards data carries, "d4rl" or "stock".

    The door's reward (but for a velocity cost below 0.03) and the ball's can be computed from the observations. The
    hammer's cannot ("unknown"); the pen's is the same in both ("d4rl").

    Args:
        rewards: (n,) of steps.
        following: (n, D) the observations after them.
        task: the task.
    """
    rows = np.asarray(following, dtype=np.float64)
    if task.name == "pen":
        return "d4rl"
    if task.name == "hammer":
        return "unknown"
    rest = _rest_of_door(rows) if task.name == "door" else _rest_of_relocate(rows)
    distance = _WEIGHT * hand_to_object(rows, task)
    unexplained = np.asarray(rewards, dtype=np.float64) - rest
    subtracted, added = np.abs(unexplained + distance), np.abs(unexplained - distance)
    explained = np.minimum(subtracted, added) < _UNSEEN
    votes = int(np.sign(added - subtracted)[explained].sum())
    return "unknown" if votes == 0 else "d4rl" if votes > 0 else "stock"


def _rest_of_door(rows: FloatArray) -> FloatArray:
    """Return the door's reward without distance and velocity cost."""
    angle = rows[:, _HINGE]
    return -0.1 * (angle - _OPEN) ** 2 + 2.0 * (angle > 0.2) + 8.0 * (angle > 1.0) + 10.0 * (angle > 1.35)


def _rest_of_relocate(rows: FloatArray) -> FloatArray:
    """Return the ball's reward without the distance, for steps with the ball on the table.

    What lifting it adds cannot be computed (its height is not observed); such steps are explained by neither sign.
    """
    to_target = np.linalg.norm(rows[:, slice(*_BALL_TO_TARGET)], axis=1)
    return 10.0 * (to_target < 0.1) + 20.0 * (to_target < 0.05)
