"""to_torch: batches of transitions, windows or padded episodes, as fast as an index into tensors."""

from __future__ import annotations

from os import PathLike
from pathlib import Path

import numpy as np
import torch

from oat_gym._rng import check_seed
from oat_gym.errors import ConfigurationError
from oat_gym.io._batches import TorchBatch
from oat_gym.io._columns import DataSource, Layout, columns_in_memory, open_source
from oat_gym.io._loader import TorchLoader
from oat_gym.io._loader_config import Kind, LoaderConfig, Sampling
from oat_gym.io._memory_map import columns_on_disk

__all__ = ["Kind", "LoaderConfig", "Sampling", "TorchBatch", "TorchLoader", "to_torch"]

DTYPES = {torch.float16: np.dtype(np.float16), torch.float32: np.dtype(np.float32), torch.float64: np.dtype(np.float64)}


def to_torch(
    data: DataSource,
    *,
    kind: Kind = "transitions",
    batch_size: int = 256,
    sampling: Sampling = "shuffle",
    length: int | None = None,
    stride: int | None = None,
    real_fraction: float | None = None,
    synthetic_weight: float | None = None,
    drop_last: bool = False,
    flat: bool = False,
    dtype: torch.dtype | None = torch.float32,
    device: str | torch.device | None = None,
    pin_memory: bool = False,
    memory_map: str | PathLike[str] | None = None,
    seed: int = 0,
) -> TorchLoader:
    """Return a loader of torch batches of a Minari dataset, augmented or not; it is fitted and read now.

    Args:
        data: a Minari dataset or a view of one, the id of an installed or embedded one, or the path of a D4RL HDF5
            file. Infos are not loaded.
        kind: "transitions"; "windows" of `length` consecutive steps of one episode (one starts at every `stride`-th
            step and one at the end of each episode; a shorter episode is one padded window); or whole "episodes",
            padded to the longest of their batch. See `TorchBatch` for fields, shapes and masks.
        batch_size: the number B of transitions, windows or episodes in a batch.
        sampling: "shuffle" (each item once an epoch, another order each epoch), "replacement" (as many draws as there
            are items) or "sequential".
        length: steps L of a window.
        stride: steps between the starts of windows, 1 by default and at most `length`.
        real_fraction: the expected share of real items in a batch drawn with replacement. A transition is synthetic
            where it was generated (the untouched steps of a stitched episode are real ones), a window or an
            episode where any of its steps was.
        synthetic_weight: the same by weight: a synthetic item is drawn this many times as often as a real one.
        drop_last: leave out the last batch of an epoch where it is not full.
        flat: observations and actions as one float matrix each (`oat_gym.spaces.FlatSpace`), not nested as the spaces.
        dtype: what floating-point values become (float16, float32 or float64; None: as stored). Others keep their type.
        device: where the batches are. Without `memory_map` the whole dataset is kept there.
        pin_memory: give batches in pinned host memory, to copy with `batch.to(device, non_blocking=True)`; with
            `memory_map` and `device`, the loader makes that copy itself.
        memory_map: a folder for the columns, for data larger than memory. They are written once for each content of the
            dataset, atomically, and checked against a digest on opening.
        seed: the same seed gives the same batches; NumPy's and torch's global random states are not touched.

    Raises:
        InvalidDataError: for a dataset or view without episodes; for weights that leave nothing to draw.
        ConfigurationError: for settings that cannot work together.
        UnsupportedSpaceError: for Text and other spaces that no tensor holds.
        DatasetNotFoundError: for an id or a path that is not on this machine.
        SaveError: if `memory_map` cannot be written, or its disk is full.

    >>> loader = to_torch("oat_gym/maze2d-umaze-v0", batch_size=64, seed=0)
    >>> batch = next(iter(loader))
    >>> batch.rewards.shape, batch.observations["observation"].shape
    (torch.Size([64]), torch.Size([64, 4]))
    """
    config = LoaderConfig(
        kind, batch_size, sampling, length, stride, real_fraction, synthetic_weight, drop_last, check_seed(seed)
    )
    target = _check_device(device, pin_memory=pin_memory, memory_mapped=memory_map is not None)
    if dtype is not None and dtype not in DTYPES:
        raise ConfigurationError(f"dtype must be torch.float16, float32, float64 or None, got {dtype!r}.")
    data = open_source(data)
    layout = Layout(data.observation_space, data.action_space, flat, None if dtype is None else DTYPES[dtype])
    layout.check()
    on_disk = memory_map is not None
    columns = columns_on_disk(data, layout, Path(memory_map)) if on_disk else columns_in_memory(data, layout)
    return TorchLoader(
        columns, config, device=target, pin_memory=pin_memory, keep_on_device=not on_disk and not pin_memory
    )


def _check_device(device: str | torch.device | None, *, pin_memory: bool, memory_mapped: bool) -> torch.device:
    try:
        target = torch.device("cpu" if device is None else device)
    except RuntimeError as error:
        raise ConfigurationError(f"device={device!r} is no torch device: {error}") from error
    if target.type == "cuda" and not torch.cuda.is_available():
        raise ConfigurationError(f"device={device!r}: torch finds no CUDA device here. Use device='cpu'.")
    if pin_memory and not torch.cuda.is_available():
        raise ConfigurationError("pin_memory=True: torch finds no CUDA device here to copy to. Leave it out.")
    if pin_memory and target.type != "cpu" and not memory_mapped:
        raise ConfigurationError(
            f"pin_memory=True with device={device!r}: without memory_map the data is on the device already."
        )
    return torch.empty(0, device=target).device  # with its index, as the tensors there have it
