"""TorchLoader: epochs of batches in a reproducible order, with a place to go on from."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from typing import Any

import numpy as np
import torch

from oat_gym._rng import derive
from oat_gym.cache import fingerprint
from oat_gym.episodes import BoolArray, IntArray
from oat_gym.errors import ConfigurationError, InvalidDataError
from oat_gym.io._batches import Items, TorchBatch, episode_items, gather, transition_items, window_items
from oat_gym.io._columns import Columns
from oat_gym.io._loader_config import LoaderConfig, check_count

STATE_VERSION = 1


class TorchLoader:
    """An iterable of `TorchBatch`, one epoch an iteration, that can stop and go on in mid-epoch.

    `len(loader)` is the number of batches of an epoch. Each `for batch in loader` is the next epoch; the order of epoch
    e depends on the seed and e only. `state_dict` tells the place after the last batch given out; after
    `load_state_dict` (in a new process, say) the next iteration goes on from there: the same remaining batches, to the
    last bit, and then the same epochs.

    Args:
        columns: the steps, in host memory; `to_torch` reads them.
        config: what is drawn, and how.
        device: where the batches are.
        pin_memory: give batches in pinned host memory, or copy them to `device` by way of it.
        keep_on_device: move all columns to `device` now; False gathers each batch on the host and moves that.

    >>> from oat_gym.io.torch import to_torch
    >>> loader = to_torch("oat_gym/maze2d-umaze-v0", batch_size=1000, seed=0)
    >>> for batch in loader:
    ...     state = loader.state_dict()
    ...     break
    >>> again = to_torch("oat_gym/maze2d-umaze-v0", batch_size=1000, seed=0)
    >>> again.load_state_dict(state)
    >>> len(list(again)) == len(loader) - 1
    True
    """

    def __init__(
        self,
        columns: Columns,
        config: LoaderConfig,
        *,
        device: torch.device,
        pin_memory: bool = False,
        keep_on_device: bool = True,
    ) -> None:
        self.config = config
        self.device = device
        self.pin_memory = pin_memory
        self._home = device if keep_on_device else torch.device("cpu")
        self._items = _make_items(columns, config).to(self._home)
        self.columns = columns.to(self._home)
        self._real_share = _real_share(self._items.synthetic, config)
        if not len(self):
            raise InvalidDataError(
                f"drop_last=True leaves no batch: {len(self._items)} items do not fill one of {config.batch_size}."
            )
        self._started = -1  # the last epoch that an iteration began
        self._next = (0, 0)  # epoch and batch that follow the last batch given out
        self._resume = False
        self._kept: tuple[int, torch.Tensor] | None = None  # the last epoch whose order was drawn, and that order

    def __len__(self) -> int:
        """Return the number of batches of an epoch."""
        whole, rest = divmod(len(self._items), self.config.batch_size)
        return whole + (1 if rest and not self.config.drop_last else 0)

    @property
    def n_items(self) -> int:
        """Number of transitions, windows or episodes that are drawn from."""
        return len(self._items)

    def __iter__(self) -> Iterator[TorchBatch]:
        """Return an iterator over the next epoch, or over what is left of the one that was loaded."""
        epoch, first = self._next if self._resume else (self._started + 1, 0)
        self._resume = False
        self._started = epoch
        self._next = (epoch, first)
        return self._epoch(epoch, first)

    def batches(self, count: int) -> Iterator[TorchBatch]:
        """Return an iterator over the next `count` batches, from where the last one ended, into further epochs too.

        Raises:
            ConfigurationError: for a count below 1.
        """
        check_count("count", count)
        return self._batches(count)

    def _batches(self, count: int) -> Iterator[TorchBatch]:
        while count:
            epoch, first = self._next
            self._started, self._resume = epoch, False
            for _, batch in zip(range(count), self._epoch(epoch, first), strict=False):
                count -= 1
                yield batch

    def state_dict(self) -> dict[str, Any]:
        """Return the place after the last batch given out, as JSON data of a few bytes."""
        epoch, batch = self._next
        return {"version": STATE_VERSION, "epoch": epoch, "batch": batch, "loader": self._fingerprint()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from `state`, which a loader of the same data and settings gave.

        Raises:
            ConfigurationError: if the state is of another version, other data or other settings, or names no place.
        """
        if state.get("version") != STATE_VERSION or state.get("loader") != self._fingerprint():
            raise ConfigurationError(
                "The state is not one of this loader: data, settings or library differ, so the remaining batches would "
                f"not be the same ones. Make the loader as it was when the state was saved; got {state!r}."
            )
        epoch, batch = state.get("epoch"), state.get("batch")
        if type(epoch) is not int or type(batch) is not int or epoch < 0 or not 0 <= batch < len(self):
            raise ConfigurationError(
                f"The state names batch {batch!r} of epoch {epoch!r}; expected an epoch of at least 0 and one of the "
                f"{len(self)} batches, counted from 0. Load a state that `state_dict` gave."
            )
        self._next = (epoch, batch)
        self._resume = True

    def _epoch(self, epoch: int, first: int) -> Iterator[TorchBatch]:
        order = self._order_of(epoch)
        size = self.config.batch_size
        for number in range(first, len(self)):
            batch = self._deliver(gather(self.columns, self._items, order[number * size : (number + 1) * size]))
            self._next = (epoch, number + 1) if number + 1 < len(self) else (epoch + 1, 0)
            yield batch

    def _order_of(self, epoch: int) -> torch.Tensor:
        if self._kept is None or self._kept[0] != epoch:
            self._kept = (epoch, torch.from_numpy(self._order(epoch)).to(self._home))
        return self._kept[1]

    def _order(self, epoch: int) -> IntArray:
        n = len(self._items)
        rng = derive(self.config.seed, "loader", epoch)
        if self.config.sampling == "sequential":
            return np.arange(n, dtype=np.int64)
        if self.config.sampling == "shuffle":
            return rng.permutation(n)
        if self._real_share is None:
            return rng.integers(n, size=n)
        return _weighted_draws(rng, self._items.synthetic, self._real_share)

    def _deliver(self, batch: TorchBatch) -> TorchBatch:
        if self.pin_memory:
            batch = batch.pin_memory()
        if self._home != self.device:
            batch = batch.to(self.device, non_blocking=self.pin_memory)
        return batch

    def _fingerprint(self) -> str:
        return fingerprint(columns=self.columns.digest, config=asdict(self.config))

    def __repr__(self) -> str:
        return f"TorchLoader({self.n_items} items, {len(self)} batches an epoch, {self.config!r})"


def _make_items(columns: Columns, config: LoaderConfig) -> Items:
    if config.kind == "transitions":
        return transition_items(columns)
    if config.length is None:
        return episode_items(columns)
    return window_items(columns, length=config.length, stride=config.stride or 1)


def _real_share(synthetic: BoolArray, config: LoaderConfig) -> float | None:
    """Return the probability that a draw is real, None where items are not weighted."""
    share, weight = config.real_fraction, config.synthetic_weight
    n_synthetic = int(synthetic.sum())
    n_real = len(synthetic) - n_synthetic
    if weight is not None:
        total = n_real + weight * n_synthetic
        share = n_real / total if total else 1.0
    if share is None:
        return None
    missing = "real" if share > 0 and not n_real else "synthetic" if share < 1 and not n_synthetic else None
    if missing:
        raise InvalidDataError(
            f"real_fraction={config.real_fraction}, synthetic_weight={weight} ask for {missing} {config.kind}, and "
            f"there are none ({n_real} real, {n_synthetic} synthetic). A window or episode with any generated step "
            "counts as synthetic."
        )
    return share


def _weighted_draws(rng: np.random.Generator, synthetic: BoolArray, real_share: float) -> IntArray:
    draws = np.empty(len(synthetic), dtype=np.int64)
    is_real = rng.random(len(synthetic)) < real_share
    for wanted, pool in ((is_real, np.flatnonzero(~synthetic)), (~is_real, np.flatnonzero(synthetic))):
        if wanted.any():
            draws[wanted] = pool[rng.integers(len(pool), size=int(wanted.sum()))]
    return draws
