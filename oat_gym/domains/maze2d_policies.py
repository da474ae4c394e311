"""The target policies of maze2d-umaze: eleven snapshots of a network that learns to walk the maze."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from oat_gym.cache import read_sealed, write_sealed
from oat_gym.embedded import embedded_file
from oat_gym.errors import CacheError, InvalidDataError
from oat_gym.ope.mlp_policy import Affine, MLPPolicy
from oat_gym.spaces import Batch

FloatArray = npt.NDArray[np.float64]

ACTION_SPACE = spaces.Box(-1.0, 1.0, (2,), np.float32)
NOISE = 0.3
"""Standard deviation of the policies' actions before clipping: the noise of the planner that made the data."""

NAMES = tuple(f"umaze-{number}" for number in range(11))
"""Names of the target policies, from the untrained network to the one that walks as the planner does."""

_LAYERS = ("fc0", "fc1", "last_fc")


def features(observations: Batch) -> FloatArray:
    """Return x, y, velocities and the goal's x, y of Dict observations of the maze, (n, 6).

    `achieved_goal` repeats the position and is left out.

    Raises:
        InvalidDataError: if they are not the maze's observations.
    """
    if not isinstance(observations, dict) or not {"observation", "desired_goal"} <= set(observations):
        raise InvalidDataError("The maze's policies take a dict of observation (n, 4) and desired_goal (n, 2).")
    return np.concatenate([observations["observation"], observations["desired_goal"]], axis=1)


def maze_policy(layers: Sequence[Affine]) -> MLPPolicy:
    """Return the Gaussian policy of a tanh network's layers, the last of which gives the mean force.

    Actions are drawn with a standard deviation of `NOISE` and clipped to [-1, 1]; `log_prob` is that of the clipped
    action, with the probability that clipping puts on the bounds.
    """
    *hidden, mean_layer = layers
    constant = (np.zeros_like(mean_layer[0]), np.full_like(mean_layer[1], np.log(NOISE)))
    return MLPPolicy(
        hidden=tuple(hidden),
        mean_layer=mean_layer,
        log_std_layer=constant,
        action_space=ACTION_SPACE,
        censored=True,
        features=features,
    )


def save_layers(path: Path, layers: Sequence[Affine]) -> None:
    """Write a policy's layers (weights as (outputs, inputs)) as one safetensors file of float32."""
    arrays: dict[str, npt.NDArray[np.float32]] = {}
    for name, (weight, bias) in zip(_LAYERS, layers, strict=True):
        arrays |= {f"{name}.weight": weight.astype(np.float32), f"{name}.bias": bias.astype(np.float32)}
    write_sealed(path, arrays, None)


def load_policy(path: Path) -> MLPPolicy:
    """Return the policy of a file that `save_layers` wrote.

    Raises:
        InvalidDataError: if the file is damaged or not such a file.
    """
    try:
        arrays, _ = read_sealed(path)
        return maze_policy([(arrays[f"{name}.weight"], arrays[f"{name}.bias"]) for name in _LAYERS])
    except (CacheError, KeyError) as error:
        raise InvalidDataError(f"{path} is not a whole file of a maze policy: {error}") from error


def umaze_policies() -> dict[str, MLPPolicy]:
    """Return the eleven target policies by name (`NAMES`).

    All are snapshots of one network while it learns the planner's actions (`datasets/train_maze2d_umaze.py`), in the
    order of training, and take the dataset's Dict observations.

    Raises:
        DatasetNotFoundError: if the installation lacks their files.

    >>> policies = umaze_policies()
    >>> len(policies), policies["umaze-10"].n_observations
    (11, 6)
    """
    return {name: load_policy(embedded_file(f"maze2d-umaze/policies/{name}.safetensors")) for name in NAMES}
