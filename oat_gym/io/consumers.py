"""to_torchrl and to_d3rlpy: the replay buffers of other libraries, filled with the right values.

Both libraries are optional: neither is a dependency, and each is imported when its function is called.
"""

from __future__ import annotations

import importlib
import logging
from types import ModuleType
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from gymnasium import spaces

from oat_gym._rng import check_seed, derive, torch_generator
from oat_gym.errors import ConfigurationError, InvalidDataError, UnsupportedSpaceError
from oat_gym.io._columns import Columns, DataSource, Layout, columns_in_memory, open_source
from oat_gym.io._loader_config import check_count
from oat_gym.spaces import Batch, FlatSpace, map_tree

FLOAT32 = np.dtype(np.float32)

_log = logging.getLogger(__name__)


def to_torchrl(
    data: DataSource,
    *,
    batch_size: int = 256,
    slice_length: int | None = None,
    flat: bool = False,
    seed: int = 0,
) -> Any:
    """Return a `torchrl.data.TensorDictReplayBuffer` with every step of a Minari dataset, augmented or not, in order.

    Use it in place of TorchRL's `MinariExperienceReplay`, which in version 0.14 gives zeros for any dataset.

    Keys of the n rows: `observation` and `action` (nested as the spaces are, parts of tuples as "0", "1", ...),
    `("next", "observation")`, `("next", "reward")` (n, 1), `("next", "terminated" | "truncated" | "done")` (n, 1); the
    flags at the root (n, 1) describe the state before the step and are false. `episode`, `step` and `synthetic`
    (n,) say where a row is from. Floating-point values are float32. `done` is `terminated | truncated`; an episode
    whose last step has neither flag is marked truncated there, since its next row is another episode's.

    Args:
        data: a Minari dataset or a view of one, the id of an installed or embedded one, or the path of a D4RL HDF5
            file.
        batch_size: rows in a sample (`buffer.sample()`).
        slice_length: sample runs of this many steps of one episode (TorchRL's `SliceSampler`; shorter where the episode
            is) in place of single steps; it must divide `batch_size`.
        flat: observations and actions as one float matrix each (`oat_gym.spaces.FlatSpace`).
        seed: of the buffer's own generator; torch's global state is not touched.

    Raises:
        ImportError: if TorchRL is not installed.
        InvalidDataError: for a dataset without episodes.
        UnsupportedSpaceError: for Text and other spaces that no tensor holds.
        ConfigurationError: for a slice length that does not divide the batch size.
    """
    check_count("batch_size", batch_size)
    if slice_length is not None:
        check_count("slice_length", slice_length)
        if batch_size % slice_length:
            raise ConfigurationError(f"batch_size={batch_size} is not a multiple of slice_length={slice_length}.")
    generator = torch_generator(derive(check_seed(seed), "torchrl"))
    tensordict, torchrl = _optional("tensordict", "torchrl"), _optional("torchrl.data", "torchrl")
    columns = _columns(data, flat=flat)
    rows = tensordict.TensorDict(_torchrl_rows(columns), batch_size=[columns.n_steps])
    if slice_length is None:
        sampler = torchrl.RandomSampler()
    else:
        sampler = torchrl.SliceSampler(slice_len=slice_length, traj_key="episode", strict_length=False)
    buffer = torchrl.TensorDictReplayBuffer(
        storage=torchrl.LazyTensorStorage(columns.n_steps), sampler=sampler, batch_size=batch_size, generator=generator
    )
    buffer.extend(rows)
    return buffer


def to_d3rlpy(data: DataSource) -> Any:
    """Return a `d3rlpy.dataset.MDPDataset` of a Minari dataset, augmented or not: an episode for each of ours.

    Use it in place of d3rlpy's `get_minari`, which in version 2.8 joins T+1 observations of an episode to T actions, so
    that from the second episode on observations belong to other rows.

    Row t of an episode is (observations[t], actions[t], rewards[t]); `terminals` are terminations, `timeouts` the
    truncations of the last step. The format has no place for the last observation, so d3rlpy does not sample the last
    transition of a truncated episode, and leaves out a truncated episode of one step (the log says how many). An
    episode whose last step has neither flag ends in a timeout (d3rlpy would drop or join it); one with both is
    terminal. Box observations keep their shape, others become one float matrix (`oat_gym.spaces.FlatSpace`); discrete
    actions are counted from 0; floating-point values are float32.

    Raises:
        ImportError: if d3rlpy is not installed.
        InvalidDataError: for a dataset without episodes, for an end flag within an episode (d3rlpy would cut it there),
            and for literal seams (next states that are no observation have no place in the format).
        UnsupportedSpaceError: for actions that are neither Box nor Discrete, and for observations of no fixed size.
    """
    data = open_source(data)
    dataset, constants = _optional("d3rlpy.dataset", "d3rlpy"), _optional("d3rlpy.constants", "d3rlpy")
    columns = _columns(data, flat=False)
    steps = {name: column[:-1].numpy() for name, column in columns.steps.items()}
    _check_contiguous(steps)
    terminals, timeouts = _d3rlpy_ends(columns, steps)
    dropped = int((timeouts & (steps["step"] == 0)).sum())
    if dropped:
        _log.warning("d3rlpy leaves out %d truncated episodes of one step: it has no next state for them.", dropped)
    actions, size = _d3rlpy_actions(columns.actions, data.action_space)
    discrete = isinstance(data.action_space, spaces.Discrete)
    return dataset.MDPDataset(
        observations=_d3rlpy_observations(columns, data.observation_space),
        actions=actions,
        rewards=steps["rewards"].astype(np.float32),
        terminals=terminals.astype(np.float32),
        timeouts=timeouts.astype(np.float32),
        action_space=constants.ActionSpace.DISCRETE if discrete else constants.ActionSpace.CONTINUOUS,
        action_size=size,
    )


def _optional(module: str, package: str) -> ModuleType:
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        raise ImportError(f"{package} is needed for this and is not installed: pip install {package}") from error


def _columns(data: DataSource, *, flat: bool) -> Columns:
    data = open_source(data)
    layout = Layout(data.observation_space, data.action_space, flat, FLOAT32)
    layout.check()
    return columns_in_memory(data, layout)


def _torchrl_rows(columns: Columns) -> dict[str, Any]:
    steps = {name: column[:-1] for name, column in columns.steps.items()}
    terminated = steps["terminated"]
    truncated = steps["truncated"] | (_last_steps(columns) & ~terminated)
    flags = {"terminated": terminated, "truncated": truncated, "done": terminated | truncated}
    return {
        "observation": _nested(_rows(columns.observations, steps["state_row"])),
        "action": _nested(map_tree(lambda leaf: leaf[:-1], columns.actions)),
        **{name: torch.zeros(columns.n_steps, 1, dtype=torch.bool) for name in flags},
        "next": {
            "observation": _nested(_rows(columns.observations, steps["next_row"])),
            "reward": steps["rewards"].float().unsqueeze(-1),
            **{name: flag.unsqueeze(-1) for name, flag in flags.items()},
        },
        **{name: steps[name] for name in ("episode", "step", "synthetic")},
    }


def _rows(tree: Batch, rows: torch.Tensor) -> Batch:
    return map_tree(lambda leaf: leaf.index_select(0, rows), tree)


def _nested(tree: Batch) -> Any:
    """Return a tree with dictionaries in place of tuples."""
    if isinstance(tree, tuple):
        return {str(number): _nested(part) for number, part in enumerate(tree)}
    return {key: _nested(part) for key, part in tree.items()} if isinstance(tree, dict) else tree


def _last_steps(columns: Columns) -> torch.Tensor:
    last = torch.zeros(columns.n_steps, dtype=torch.bool)
    last[torch.from_numpy(np.cumsum(columns.lengths) - 1)] = True
    return last


def _check_contiguous(steps: dict[str, npt.NDArray[Any]]) -> None:
    seams = np.flatnonzero(steps["next_row"] != steps["state_row"] + 1)
    if len(seams):
        raise InvalidDataError(
            f"{len(seams)} transitions, the first at step {steps['step'][seams[0]]} of episode "
            f"{steps['episode'][seams[0]]}, keep their own next state (literal seams, permuted segments), which "
            "d3rlpy's format cannot hold. Use seam='contiguous' or 'matched', another method, to_torch or to_torchrl."
        )


def _d3rlpy_ends(
    columns: Columns, steps: dict[str, npt.NDArray[Any]]
) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_]]:
    last = _last_steps(columns).numpy()
    terminals = steps["terminated"]
    within = np.flatnonzero((terminals | steps["truncated"]) & ~last)
    if len(within):
        raise InvalidDataError(
            f"Step {steps['step'][within[0]]} of episode {steps['episode'][within[0]]} has an end flag "
            "and is not its last one: d3rlpy would cut the episode there. Split or repair it first."
        )
    return terminals, last & ~terminals


def _d3rlpy_observations(columns: Columns, space: spaces.Space[Any]) -> npt.NDArray[Any]:
    states = _rows(columns.observations, columns.steps["state_row"][:-1])
    if isinstance(space, spaces.Box) and space.shape:
        return states.numpy()
    arrays = map_tree(lambda leaf: leaf.numpy(), states)
    return FlatSpace.of(space, "observation space").flatten(arrays).astype(np.float32)


def _d3rlpy_actions(actions: Batch, space: spaces.Space[Any]) -> tuple[npt.NDArray[Any], int]:
    """Return the (n, width) actions and d3rlpy's action size: their width, or the number of discrete actions."""
    if isinstance(space, spaces.Discrete):
        return (actions[:-1].numpy() - int(space.start)).reshape(-1, 1), int(space.n)
    if isinstance(space, spaces.Box):
        matrix = actions[:-1].numpy().reshape(len(actions) - 1, -1)
        return matrix, matrix.shape[1]
    raise UnsupportedSpaceError(f"d3rlpy takes Box or Discrete actions; the action space is {space}.")
