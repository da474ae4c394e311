"""Logged data as the estimators read it: the steps of all episodes as columns, real and synthetic."""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from minari import EpisodeData, MinariDataset
from minari.dataset.minari_dataset import parse_dataset_id
from minari.dataset.minari_storage import MinariStorage
from minari.storage import get_dataset_path

from oat_gym.dataset import AugmentedDataset
from oat_gym.episodes import BoolArray, IntArray, Transitions, check_episode, collect_transitions
from oat_gym.errors import EstimationWarning, InvalidDataError
from oat_gym.provenance import Provenance
from oat_gym.spaces import Batch, FlatSpace, map_tree
from oat_gym.storage import AugmentedStorage

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Logged:
    """n steps of E episodes, episode by episode.

    Attributes:
        steps: the columns, observations and actions as batches of the spaces; `steps.episode` counts 0 to E-1.
        flat_observations: the flattening of the observation space.
        flat_actions: the flattening of the action space.
        offsets: (E+1,) first row of each episode, and n.
        unit: (E,) the real episode, 0 to N-1, that an episode is or was made from. A resample of the data draws
            units, so that augmented copies never count as independent.
        synthetic: (E,) whether the episode is a generated one.
        log_prob: (n,) log beta(a|s) as the data records it in `infos["log_prob"]`, NaN for generated steps, whose
            actions no recorded policy chose; `None` where the data does not record it.
    """

    steps: Transitions
    flat_observations: FlatSpace
    flat_actions: FlatSpace
    offsets: IntArray
    unit: IntArray
    synthetic: BoolArray
    log_prob: FloatArray | None = None

    @classmethod
    def of(cls, dataset: MinariDataset) -> Logged:
        """Read a dataset; synthetic episodes are known by their provenance, saved ones too.

        Raises:
            InvalidDataError: for a dataset without real episodes, or with values that are not finite.
            UnsupportedSpaceError: for spaces that have no feature matrix.

        Warns:
            EstimationWarning: for a dataset that Minari combined from augmented ones, which loses the provenance.
        """
        _warn_if_combined(dataset)
        metadata = dataset.storage.get_episode_metadata(dataset.episode_indices)
        origins = [
            Provenance.from_metadata(part, int(number))
            for number, part in zip(dataset.episode_indices, metadata, strict=True)
        ]
        synthetic = np.array([origin.synthetic for origin in origins], dtype=bool)
        if synthetic.all():
            raise InvalidDataError(f"The dataset {dataset.id!r} has no real episode, from which values are estimated.")
        steps = _steps(dataset, origins)
        lengths = np.bincount(steps.episode, minlength=len(origins))
        logged = cls(
            steps=steps,
            flat_observations=FlatSpace.of(dataset.observation_space, "observation space"),
            flat_actions=FlatSpace.of(dataset.action_space, "action space"),
            offsets=np.concatenate(([0], np.cumsum(lengths))).astype(np.int64),
            unit=_units(origins, dataset.episode_indices),
            synthetic=synthetic,
            log_prob=_recorded_log_prob(dataset, origins, steps.synthetic, lengths),
        )
        logged._check_finite()
        return logged

    def __len__(self) -> int:
        """Return the number of episodes, E."""
        return len(self.unit)

    @property
    def n_units(self) -> int:
        """Number of real episodes, N."""
        return int((~self.synthetic).sum())

    @property
    def lengths(self) -> IntArray:
        """(E,) steps of each episode."""
        return np.diff(self.offsets)

    @cached_property
    def states(self) -> FloatArray:
        """(n, D) features of the states."""
        return self.flat_observations.flatten(self.steps.observations)

    @cached_property
    def next_states(self) -> FloatArray:
        """(n, D) features of the next states."""
        return self.flat_observations.flatten(self.steps.next_observations)

    @cached_property
    def actions(self) -> FloatArray:
        """(n, A) features of the actions, clipped to the space's bounds as environments do with what they are given."""
        return np.clip(self.flat_actions.flatten(self.steps.actions), *self.flat_actions.bounds)

    def _check_finite(self) -> None:
        columns = {"observation": self.states, "action": self.actions, "reward": self.steps.rewards}
        for name, values in (columns | {"next observation": self.next_states}).items():
            bad = ~np.isfinite(values.reshape(len(values), -1)).all(axis=1)
            if bad.any():
                row = int(np.flatnonzero(bad)[0])
                raise InvalidDataError(
                    f"The {name} at step {self.steps.step[row]} of episode {self.steps.episode[row]} is "
                    f"{values[row]}: finite numbers are needed. Drop or repair the episode first (filter_episodes)."
                )

    def rows_of(self, episodes: BoolArray) -> IntArray:
        """Return the rows of the chosen episodes; `episodes` is (E,)."""
        return np.flatnonzero(episodes[self.steps.episode])

    def initial_observations(self, episodes: BoolArray) -> Batch:
        """Return the first observations of the chosen episodes, as a batch of the space."""
        first = self.offsets[:-1][episodes]
        return map_tree(lambda leaf: leaf[first], self.steps.observations)


def _warn_if_combined(dataset: MinariDataset) -> None:
    """Warn where a dataset was combined from augmented ones: `combine_datasets` drops what their episodes say.

    Only saved parts that are still on this machine are known to be augmented.
    """
    augmented: list[str] = []
    for name in dataset.storage.metadata.get("combined_datasets", ()):
        try:
            parse_dataset_id(name)  # also keeps "../" out
            metadata = MinariStorage.read_raw_metadata(get_dataset_path(name) / "data")
        except (OSError, TypeError, ValueError):
            continue
        augmented += [name] if "oat_gym" in metadata or metadata.get("data_format") == AugmentedStorage.FORMAT else []
    if augmented:
        warnings.warn(
            f"{dataset.id!r} was combined from augmented datasets ({', '.join(dict.fromkeys(augmented))}). Minari "
            "drops the provenance of their episodes, so that synthetic ones count as real and intervals are too "
            "narrow: combine the real data first, then augment.",
            EstimationWarning,
            stacklevel=3,
        )


def _steps(dataset: MinariDataset, origins: list[Provenance]) -> Transitions:
    if isinstance(dataset.storage, AugmentedStorage):  # Minari's own views of one are plain MinariDatasets
        return AugmentedDataset.open(dataset.storage, dataset.episode_indices).transitions()

    def checked(episodes: Iterable[EpisodeData]) -> Iterable[EpisodeData]:
        for episode in episodes:
            check_episode(episode, dataset.observation_space, dataset.action_space)
            yield episode

    parts = zip(checked(dataset.iterate_episodes()), (origin.mask for origin in origins), strict=True)
    return collect_transitions(((episode, mask, {}) for episode, mask in parts), range(len(origins)))


def _recorded_log_prob(
    dataset: MinariDataset, origins: list[Provenance], generated: BoolArray, lengths: IntArray
) -> FloatArray | None:
    """Join `infos["log_prob"]` of all episodes; an episode that was generated whole is not read again for it."""
    first = next(number for number, origin in enumerate(origins) if not origin.synthetic)
    if "log_prob" not in (next(iter(dataset.iterate_episodes([int(dataset.episode_indices[first])]))).infos or {}):
        return None
    result = np.full(len(generated), np.nan)
    stops = np.cumsum(lengths)
    rows = [slice(stop - length, stop) for stop, length in zip(stops, lengths, strict=True)]
    read = [number for number in range(len(rows)) if not generated[rows[number]].all()]
    indices = [int(dataset.episode_indices[number]) for number in read]
    for number, episode in zip(read, dataset.iterate_episodes(indices), strict=True):
        result[rows[number]] = np.where(generated[rows[number]], np.nan, _step_log_prob(episode))
    return result


def _step_log_prob(episode: EpisodeData) -> FloatArray:
    """Return (T,) log-probabilities; of T + 1 rows, as Minari's collector records, the first belongs to the reset."""
    length, recorded = len(episode.rewards), (episode.infos or {}).get("log_prob")
    raw = np.asarray([] if recorded is None else recorded, dtype=np.float64)
    values = raw.reshape(len(raw), -1)
    if len(values) not in (length, length + 1) or values.shape[1] != 1:
        raise InvalidDataError(
            f'Episode {episode.id} has infos["log_prob"] of shape {raw.shape}; one number for each of its '
            f"{length} steps is expected (or {length + 1}, the first one for the reset)."
        )
    return values[-length:, 0]


def _units(origins: list[Provenance], ids: npt.NDArray[np.integer]) -> IntArray:
    """Number the real episodes 0 to N-1 and give each synthetic one the number of the real one it goes back to."""
    origin_of = {int(index): origin for index, origin in zip(ids, origins, strict=True)}
    number_of = {index: n for n, index in enumerate(i for i, origin in origin_of.items() if not origin.synthetic)}

    def root(index: int) -> int:
        seen = [index]
        while (origin := origin_of[seen[-1]]).synthetic:  # an augmented dataset may have been augmented again
            if origin.source not in origin_of or origin.source in seen:
                raise InvalidDataError(
                    f"Episode {index} was made from episode {origin.source}, which is not in this view: evaluate the "
                    "whole dataset, or its real episodes only."
                )
            seen.append(origin.source)
        return seen[-1]

    return np.array([number_of[root(int(index))] for index in ids], dtype=np.int64)
