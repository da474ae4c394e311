"""What a dataset holds, in numbers: for the command line and for reports."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from minari import MinariDataset

from oat_gym.errors import InvalidDataError
from oat_gym.provenance import Provenance


@dataclass(frozen=True)
class Spread:
    """Least value, quartiles and largest value of some numbers."""

    low: float
    first: float
    median: float
    third: float
    high: float

    @classmethod
    def of(cls, values: npt.NDArray[np.floating] | npt.NDArray[np.integer]) -> Spread:
        """Return the spread of one or more values."""
        return cls(*(float(q) for q in np.quantile(np.asarray(values, dtype=np.float64), [0, 0.25, 0.5, 0.75, 1])))

    def __str__(self) -> str:
        return f"{self.median:.4g} ({self.low:.4g} to {self.high:.4g}, quartiles {self.first:.4g} and {self.third:.4g})"


@dataclass(frozen=True)
class GroupSummary:
    """Real or synthetic episodes: their number, steps, lengths, undiscounted returns, and the share generated."""

    episodes: int
    steps: int
    generated_steps: int
    lengths: Spread
    returns: Spread
    entry_seams: Spread | None
    exit_seams: Spread | None
    without_span: int


@dataclass(frozen=True)
class DatasetSummary:
    """What `summarize` finds: the dataset's id and spaces, and its groups of episodes."""

    dataset_id: str
    observation_space: str
    action_space: str
    real: GroupSummary | None
    synthetic: GroupSummary | None


def summarize(dataset: MinariDataset) -> DatasetSummary:
    """Read a Minari dataset once and return its summary; synthetic episodes are told apart by their metadata.

    Raises:
        InvalidDataError: for a dataset without episodes.
    """
    if len(dataset) == 0:
        raise InvalidDataError(f"The dataset {dataset.id!r} has no episodes.")
    returns = np.array([np.sum(episode.rewards, dtype=np.float64) for episode in dataset.iterate_episodes()])
    metadata = dataset.storage.get_episode_metadata(dataset.episode_indices)
    origins = [Provenance.from_metadata(part, number) for number, part in enumerate(metadata)]
    synthetic = np.array([origin.synthetic for origin in origins])
    return DatasetSummary(
        dataset_id=dataset.id,
        observation_space=str(dataset.observation_space),
        action_space=str(dataset.action_space),
        real=_group(origins, returns, ~synthetic),
        synthetic=_group(origins, returns, synthetic),
    )


def real_episodes(dataset: MinariDataset) -> MinariDataset:
    """Return the view of the episodes that their metadata does not call synthetic."""
    metadata = dataset.storage.get_episode_metadata(dataset.episode_indices)
    kept = [not Provenance.from_metadata(part, number).synthetic for number, part in enumerate(metadata)]
    return MinariDataset(dataset.storage, episode_indices=np.asarray(dataset.episode_indices)[kept])


def _group(
    origins: list[Provenance], returns: npt.NDArray[np.float64], chosen: npt.NDArray[np.bool_]
) -> GroupSummary | None:
    members = [origin for origin, keep in zip(origins, chosen, strict=True) if keep]
    if not members:
        return None
    lengths = np.array([origin.length for origin in members])
    seams = np.array([span.seam for origin in members for span in origin.spans if span.seam is not None])
    return GroupSummary(
        episodes=len(members),
        steps=int(lengths.sum()),
        generated_steps=int(sum(origin.mask.sum() for origin in members)),
        lengths=Spread.of(lengths),
        returns=Spread.of(returns[chosen]),
        entry_seams=Spread.of(seams[:, 0]) if len(seams) else None,
        exit_seams=Spread.of(seams[:, 1]) if len(seams) else None,
        without_span=sum(not origin.spans for origin in members),
    )
