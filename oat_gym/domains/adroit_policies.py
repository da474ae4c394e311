"""The policies of the Adroit tasks: DOPE's 11 target policies, and the DAPG experts that make data.

`log_prob` counts actions as the data records them, *after* clipping to [-1, 1]: an entry on a bound has the probability
that clipping puts there (`MLPPolicy.censored`). A behaviour policy of the same kind is `infos["log_prob"]` of the
`expert` and `cloned-from-expert` data, or `BehaviorCloning(density="censored")`.
"""

from __future__ import annotations

import os
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from oat_gym.domains._data import find_file
from oat_gym.domains.adroit_rewards import adroit_task
from oat_gym.errors import InvalidDataError
from oat_gym.ope.dope import load_dope_policies
from oat_gym.ope.mlp_policy import MLPPolicy
from oat_gym.ope.policy import Policy

_EXPERT_ARRAYS = (
    *(f"fc{layer}.{part}" for layer in range(3) for part in ("weight", "bias")),
    "log_std",
    *(f"{end}_{part}" for end in ("in", "out") for part in ("shift", "scale")),
)
_SCALE_FLOOR = 1e-8  # what mjrl adds to the inputs' scale


def dope_policies(name: str, *, path: str | os.PathLike[str] | None = None, censored: bool = True) -> dict[str, Policy]:
    """Return a task's 11 target policies, "door_dapg_0" (the worst) to "door_dapg_10"; they take their mean action.

    Args:
        name: the task.
        path: the folder that holds the npz files, or one of them; by default the data folder's.
        censored: see the module's text; False: the density before clipping, as DOPE has it.

    Raises:
        ConfigurationError: for an unknown task.
        DatasetNotFoundError: if the weights are not there; the message says how to get them.
    """
    file = f"robotics/dope_policies/{adroit_task(name).name}/{name}_dapg_0.npz"
    how = (
        f"The target policies are the weight files {name}_dapg_0.npz to {name}_dapg_10.npz of the DOPE benchmark "
        f"(google-research/deep_ope, Apache-2.0; as npz in paulpak58/data_augmented_ope, commit ad06511). Set "
        f"OAT_GYM_DATA to a folder that holds {file} and the others."
    )
    return {**load_dope_policies(find_file(file, path=path, how_to_get=how).parent, censored=censored)}


def expert_file(name: str, *, path: str | os.PathLike[str] | None = None) -> Path:
    """Return the weight file of a task's DAPG expert; arguments and errors as for `expert_policy`."""
    file = f"robotics/hand_dapg_expert/{adroit_task(name).name}_expert.npz"
    how = (
        f"It has the weights of dapg/policies/{name}-v0.pickle of aravindr93/hand_dapg (Apache-2.0) as plain arrays: "
        f"{', '.join(_EXPERT_ARRAYS)}. Set OAT_GYM_DATA to a folder that holds {file}."
    )
    return find_file(file, path=path, how_to_get=how)


def expert_policy(name: str, *, path: str | os.PathLike[str] | None = None) -> MLPPolicy:
    """Return the DAPG expert of a task (Rajeswaran et al. 2018), which acts by sampling its Gaussian.

    Args:
        name: the task.
        path: the npz file, or a folder that holds it; by default the data folder's.

    Raises:
        ConfigurationError: for an unknown task.
        DatasetNotFoundError: if the weights are not there; the message says how to get them.
        InvalidDataError: if the file does not hold what is expected.
    """
    source = expert_file(name, path=path)
    arrays = _read(source)
    first = arrays["fc0.weight"] / (arrays["in_scale"] + _SCALE_FLOOR)
    last, scale = arrays["fc2.weight"], arrays["out_scale"]
    return MLPPolicy(
        hidden=(
            (first, arrays["fc0.bias"] - first @ arrays["in_shift"]),
            (arrays["fc1.weight"], arrays["fc1.bias"]),
        ),
        mean_layer=(last * scale[:, None], arrays["fc2.bias"] * scale + arrays["out_shift"]),
        log_std_layer=(np.zeros_like(last), arrays["log_std"]),
        action_space=spaces.Box(-1.0, 1.0, (len(last),)),
        censored=True,
    )


def _read(source: Path) -> Mapping[str, npt.NDArray[Any]]:
    """Return the arrays of an expert's file as float64; nothing is unpickled."""
    try:
        with source.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            arrays = {name: file[name] for name in _EXPERT_ARRAYS if name in file}
    except (ValueError, OSError, EOFError, zipfile.BadZipFile) as error:
        raise InvalidDataError(f"{source} cannot be read as plain arrays ({error}).") from error
    missing = [name for name in _EXPERT_ARRAYS if name not in arrays]
    if missing:
        raise InvalidDataError(f"{source} lacks the arrays {', '.join(missing)} of a DAPG expert.")
    return {name: array.astype(np.float64) for name, array in arrays.items()}
