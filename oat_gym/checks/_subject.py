"""What the checks of a dataset look at: the dataset, its source where it has one, and the episodes read once."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import numpy.typing as npt
from minari import EpisodeData, MinariDataset

from oat_gym.checks._compare import difference
from oat_gym.checks.report import Broken, NotApplicable
from oat_gym.dataset import AugmentedDataset
from oat_gym.export import DataFormat


@dataclass(frozen=True)
class FileState:
    """A file, its size in bytes and when it was last written to (nanoseconds)."""

    path: Path
    size: int
    written: int


@dataclass(frozen=True)
class Subject:
    """A dataset under examination.

    `positions` are the places in its view that are looked at, `source_files` what the source's files were before, and
    `formats` the storage formats in which it is saved and read back.
    """

    dataset: MinariDataset
    source: MinariDataset | None
    positions: tuple[int, ...]
    source_files: tuple[FileState, ...] = ()
    formats: tuple[DataFormat, ...] = ()

    @property
    def numbers(self) -> list[int]:
        """The storage ids of the episodes looked at."""
        return [int(number) for number in self.dataset.episode_indices[list(self.positions)]]

    @cached_property
    def episodes(self) -> tuple[EpisodeData, ...]:
        """The episodes looked at, read once for all checks."""
        return tuple(self.dataset.iterate_episodes(self.numbers))

    @cached_property
    def metadata(self) -> tuple[dict[str, object], ...]:
        """The metadata of the episodes looked at."""
        return tuple(self.dataset.storage.get_episode_metadata(self.numbers))

    @property
    def augmented(self) -> AugmentedDataset:
        """The dataset, where it is one of ours with a plan."""
        if not isinstance(self.dataset, AugmentedDataset) or self.dataset.storage.synthesis is None:
            raise NotApplicable("the dataset is not an augmented one")
        return self.dataset

    @cached_property
    def originals(self) -> dict[int, EpisodeData]:
        """The episodes of the source that those looked at come from, by their number in the augmented dataset."""
        source, n_real = self._source(), self.augmented.storage.n_real
        planned = [number for number in self.numbers if number < self.augmented.storage.n_planned]
        wanted = sorted({number if number < n_real else (number - n_real) % n_real for number in planned})
        stored = source.storage.get_episodes([int(i) for i in self.augmented.synthesis.source.ids[wanted]])
        return {number: EpisodeData(**data) for number, data in zip(wanted, stored, strict=True)}

    def expect_equal(self, got: EpisodeData, position: int, how: str) -> None:
        """Raise `Broken` unless `got` is the episode at `position` of those looked at, its id included."""
        expected = self.episodes[position]
        if int(got.id) != int(expected.id):
            raise Broken(f"{how} gives episode {got.id} where iteration gives {expected.id}")
        found = difference(got, expected)
        if found:
            raise Broken(f"episode {expected.id}: {how} and iteration disagree, {found}")

    def _source(self) -> MinariDataset:
        if self.source is None:
            raise NotApplicable("there is no source to compare with")
        return self.source


def spread(total: int, limit: int | None) -> tuple[int, ...]:
    """Return at most `limit` positions of `total`, evenly spread, the first and the last among them."""
    if limit is None or total <= limit:
        return tuple(range(total))
    positions: npt.NDArray[np.int64] = np.unique(np.linspace(0, total - 1, limit).round().astype(np.int64))
    return tuple(int(position) for position in positions)
