"""The policies of the DOPE benchmark: weight files (npz) of Gaussian perceptrons.

DOPE (Fu et al., ICLR 2021) publishes 11 policies a task, snapshots of one training run. Its published returns are
those of the mean action, clipped to the action space.
"""

from __future__ import annotations

import os
import re
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from oat_gym.errors import ConfigurationError, DatasetNotFoundError, InvalidDataError
from oat_gym.ope.mlp_policy import Affine, MLPPolicy

_DISTRIBUTIONS = ("gaussian", "tanh_gaussian")
_NONLINEARITIES: dict[str, Literal["tanh", "relu"]] = {"tanh": "tanh", "relu": "relu"}
_FORM = (
    "A DOPE policy is an npz file with the arrays fc0.weight, fc0.bias, fc1.weight, ..., last_fc.weight, last_fc.bias, "
    "last_fc_log_std.weight, last_fc_log_std.bias, nonlinearity (tanh or relu) and output_distribution (gaussian or "
    "tanh_gaussian)."
)


def load_dope_policy(
    path: str | os.PathLike[str],
    *,
    action_space: spaces.Box | None = None,
    deterministic: bool = True,
    censored: bool = False,
) -> MLPPolicy:
    """Return the policy in a DOPE weight file; nothing in the file is unpickled.

    Args:
        path: the npz file.
        action_space: actions are clipped to it; `None`: the Box [-1, 1] of float32, which all DOPE tasks have.
        deterministic: the policy takes its mean action, as in DOPE's published returns; `log_prob` is that of the
            Gaussian with the file's standard deviations all the same.
        censored: see `MLPPolicy`.

    Raises:
        DatasetNotFoundError: if there is no such file.
        InvalidDataError: if it is damaged or not such a file.
        ConfigurationError: if the action space does not fit.
    """
    path = Path(path)
    arrays = _read(path)
    nonlinearity = _NONLINEARITIES.get(str(arrays["nonlinearity"]))
    distribution = str(arrays["output_distribution"])
    if nonlinearity is None or distribution not in _DISTRIBUTIONS:
        raise InvalidDataError(
            f"{path}: nonlinearity is {str(arrays['nonlinearity'])!r} and output_distribution {distribution!r}. {_FORM}"
        )
    n_hidden = sum(1 for name in arrays if re.fullmatch(r"fc\d+\.weight", name))
    layers = [_layer(arrays, name, path) for name in (*(f"fc{i}" for i in range(n_hidden)), "last_fc")]
    mean_layer = layers.pop()
    n_actions = mean_layer[0].shape[0]
    try:
        return MLPPolicy(
            hidden=tuple(layers),
            mean_layer=mean_layer,
            log_std_layer=_layer(arrays, "last_fc_log_std", path),
            nonlinearity=nonlinearity,
            action_space=spaces.Box(-1.0, 1.0, (n_actions,)) if action_space is None else action_space,
            squash=distribution == "tanh_gaussian",
            deterministic=deterministic,
            censored=censored,
        )
    except ConfigurationError as error:
        if action_space is not None and int(np.prod(action_space.shape)) != n_actions:
            raise
        raise InvalidDataError(f"{path}: {error} {_FORM}") from error


def load_dope_policies(
    folder: str | os.PathLike[str],
    *,
    action_space: spaces.Box | None = None,
    deterministic: bool = True,
    censored: bool = False,
) -> dict[str, MLPPolicy]:
    """Return the policies of all npz files in a folder by file name, numbers in natural order (..._2 before ..._10).

    Arguments and errors are those of `load_dope_policy`.
    """
    folder = Path(folder)
    files = sorted(folder.glob("*.npz"), key=lambda path: natural_order(path.stem))
    if not files:
        raise DatasetNotFoundError(f"There is no npz file in {folder}. Give the folder of one task's DOPE policies.")
    return {
        path.stem: load_dope_policy(path, action_space=action_space, deterministic=deterministic, censored=censored)
        for path in files
    }


def natural_order(name: str) -> tuple[tuple[str, int], ...]:
    """Return a key that sorts names by text and number parts.

    >>> sorted(["door_10", "door_2"], key=natural_order)
    ['door_2', 'door_10']
    """
    return tuple((text, int(digits or 0)) for text, digits in re.findall(r"(\D*)(\d*)", name))


def _read(path: Path) -> Mapping[str, npt.NDArray[Any]]:
    if not path.is_file():
        raise DatasetNotFoundError(f"There is no file {path}. {_FORM}")
    try:
        with path.open("rb") as stream:
            file = np.load(stream, allow_pickle=False)
            arrays = {name: file[name] for name in file.files} if isinstance(file, np.lib.npyio.NpzFile) else None
    except (ValueError, OSError, EOFError, KeyError, zipfile.BadZipFile) as error:
        raise InvalidDataError(f"{path} cannot be read as plain arrays ({error}). {_FORM}") from error
    if arrays is None:
        raise InvalidDataError(f"{path} holds a single array. {_FORM}")
    needed = ("last_fc", "last_fc_log_std")
    names = [f"{layer}.{part}" for layer in needed for part in ("weight", "bias")]
    missing = [name for name in (*names, "nonlinearity", "output_distribution") if name not in arrays]
    if missing:
        raise InvalidDataError(f"{path} lacks {', '.join(missing)}; it has {', '.join(arrays) or 'nothing'}. {_FORM}")
    return arrays


def _layer(arrays: Mapping[str, npt.NDArray[Any]], name: str, path: Path) -> Affine:
    parts = [f"{name}.weight", f"{name}.bias"]
    missing = [part for part in parts if part not in arrays]
    if missing:
        raise InvalidDataError(f"{path} lacks {', '.join(missing)}. {_FORM}")
    weight, bias = (arrays[part] for part in parts)
    for part, array in zip(parts, (weight, bias), strict=True):
        if not np.issubdtype(array.dtype, np.floating):
            raise InvalidDataError(f"{path}: {part} has dtype {array.dtype}, numbers are expected. {_FORM}")
    return weight, bias
