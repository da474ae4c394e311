"""AugmentedDataset: a Minari dataset of real episodes followed by generated ones."""

from __future__ import annotations

import importlib.metadata
import shutil
import warnings
from collections.abc import Callable, Sequence
from os import PathLike
from pathlib import Path
from typing import Any, overload

import numpy as np
import numpy.typing as npt
from minari import EpisodeData, MinariDataset
from minari.storage import local

from oat_gym.augmenters import Augmenter
from oat_gym.augmenters.oat import OAT
from oat_gym.cache import canonical
from oat_gym.episodes import Transitions, collect_transitions
from oat_gym.errors import AugmentationWarning, ConfigurationError, InvalidDataError
from oat_gym.export import (
    DATA_FORMATS,
    DataFormat,
    check_dataset_id,
    check_length,
    new_dataset_folder,
    write_dataset,
)
from oat_gym.io.d4rl import is_d4rl_path, read_d4rl
from oat_gym.mining import MiningResult
from oat_gym.progress import ProgressCallback
from oat_gym.provenance import Provenance, renumbered
from oat_gym.recipe import (
    APPENDED,
    EPISODE_METADATA_FILE,
    RECIPE_FILE,
    check_if_augmented,
    find_dataset,
    write_metadata,
    write_recipe,
)
from oat_gym.serialization import source_metadata
from oat_gym.source import Source
from oat_gym.spaces import FlatSpace
from oat_gym.storage import AugmentedStorage, register
from oat_gym.synthesis import Synthesis


class AugmentedDataset(MinariDataset):
    """A `minari.MinariDataset` whose first N episodes are those of `source`, and the rest generated from them.

    It is returned at once: mining and training happen when a synthetic episode is first read, or in `fit`, and are
    kept in the cache (`OAT_GYM_CACHE`), so that they happen once. Everything that reads a Minari dataset reads it.

    Args:
        source: a Minari dataset (an augmented or a filtered one too), the id of an installed or embedded one, or the
            path of a D4RL HDF5 file.
        augmenter: the method, `OAT()` by default; see `oat_gym.AUGMENTERS`.
        factor: how many times the episodes of the source the dataset has in all, at least 1 (10 by default).
        count: the number of synthetic episodes, in place of `factor`.
        seed: the same seed gives the same bytes, in any order of access and in any process.

    Raises:
        ConfigurationError: for a factor under 1, a negative count, or both given.
        InvalidDataError: for a source without episodes, or whose episodes are all too short for the method.
        UnsupportedSpaceError: for a space that the method does not model.

    >>> import minari
    >>> from oat_gym import OAT, AugmentedDataset
    >>> data = AugmentedDataset("oat_gym/maze2d-umaze-v0", OAT(), factor=10, seed=0)
    >>> len(data), data.is_fitted
    (2500, False)
    """

    def __init__(
        self,
        source: MinariDataset | str | PathLike[str],
        augmenter: Augmenter | None = None,
        *,
        factor: float | None = None,
        count: int | None = None,
        seed: int = 0,
    ) -> None:
        if isinstance(source, str | PathLike):
            source = find_source(source)
        if not isinstance(source, MinariDataset):
            raise ConfigurationError(
                "The source must be a Minari dataset, the id of one or the path of a D4RL file, got a "
                f"{type(source).__name__}. Make a dataset of episodes with oat_gym.io.writing.dataset_from_episodes, "
                "of a table with oat_gym.io.tables.episodes_from_table first."
            )
        if augmenter is None:
            augmenter = OAT()
        if not isinstance(augmenter, Augmenter):
            raise ConfigurationError(f"The augmenter must be an oat_gym.Augmenter such as OAT(), got {augmenter!r}.")
        plan = Source(source)
        count = _synthetic_count(len(plan), factor, count)
        super().__init__(AugmentedStorage.of(Synthesis(plan, augmenter, count=count, seed=seed)))

    @classmethod
    def open(cls, storage: AugmentedStorage, episode_indices: npt.NDArray[np.int64] | None = None) -> AugmentedDataset:
        """Return the dataset, or the view of it, that an augmented storage holds."""
        dataset = cls.__new__(cls)
        MinariDataset.__init__(dataset, storage, episode_indices)
        return dataset

    @property
    def storage(self) -> AugmentedStorage:
        """The storage, of Minari's interface."""
        if not isinstance(self._data, AugmentedStorage):
            raise ConfigurationError(f"An AugmentedDataset reads an AugmentedStorage, got {type(self._data).__name__}.")
        return self._data

    @property
    def synthesis(self) -> Synthesis:
        """The plan: source, augmenter, count and seed."""
        if self.storage.synthesis is None:
            raise InvalidDataError(f"The dataset {self.id!r} has no source: all its episodes were appended.")
        return self.storage.synthesis

    @property
    def augmenter(self) -> Augmenter:
        """The configuration of the method."""
        return self.synthesis.augmenter

    @property
    def source(self) -> MinariDataset:
        """The dataset that is augmented."""
        return self.synthesis.source.dataset

    @property
    def seed(self) -> int:
        """The seed of everything random in it."""
        return self.synthesis.seed

    @property
    def total_steps(self) -> int:
        """Number of steps of all episodes (of this view); known without training."""
        return int(self.storage.lengths(self.episode_indices).sum())

    @property
    def is_fitted(self) -> bool:
        """Whether synthetic episodes can be read without training first."""
        return self.synthesis.is_fitted

    def fit(self, *, progress: ProgressCallback | bool | None = None) -> AugmentedDataset:
        """Mine and train now, or read the result of an earlier run from the cache; return the dataset itself.

        `progress` is a callback (description, done, total), or whether to draw a bar on standard error (None: where
        that is a terminal).
        """
        self.synthesis.fit(progress)
        return self

    @property
    def mining(self) -> MiningResult:
        """Labels, supports and PST sets, for augmenters that mine; fits first.

        Raises:
            ConfigurationError: if the augmenter does not mine.
        """
        mining = self.synthesis.sampler.mining
        if mining is None:
            raise ConfigurationError(f"{self.augmenter.name!r} does not mine sub-trajectories; OAT does.")
        return mining

    def provenance(self, index: int) -> Provenance:
        """Return where episode `index` of this view comes from; fits first where it is synthetic."""
        return self.storage.provenance(int(self.episode_indices[index]))

    def transitions(self, *, flat: bool = False) -> Transitions:
        """Return all steps as columns (s, a, r, s', terminated, truncated, episode, step, synthetic).

        s' of step t is `observations[t+1]`, except at the seams of `OAT(seam="literal")`, where both tuples keep
        their own s' (paper, section 2.3). `flat=True` gives observations and actions as float feature matrices
        (`oat_gym.spaces.FlatSpace`) instead of batches of the spaces. `episode` counts in this view.
        """
        rows = (self._transition_parts(int(number)) for number in self.episode_indices)
        columns = collect_transitions(rows, range(len(self.episode_indices)))
        return _flatten(columns, self) if flat else columns

    def filter_episodes(self, condition: Callable[[EpisodeData], bool]) -> AugmentedDataset:
        """Return the view of the episodes for which `condition(episode)` is true."""
        kept = [bool(condition(episode)) for episode in self.iterate_episodes()]
        return self.open(self.storage, self.episode_indices[np.array(kept, dtype=bool)])

    @overload
    def __getitem__(self, idx: int) -> EpisodeData: ...
    @overload
    def __getitem__(self, idx: slice) -> list[EpisodeData]: ...
    def __getitem__(self, idx: int | slice) -> EpisodeData | list[EpisodeData]:
        """Return an episode, or the list of those in a slice."""
        if isinstance(idx, slice):
            return list(self.iterate_episodes(self.episode_indices[idx]))
        return next(self.iterate_episodes([self.episode_indices[idx]]))

    def __getitems__(self, indices: Sequence[int]) -> list[EpisodeData]:
        """Return several episodes at once (torch's loaders ask this way)."""
        return list(self.iterate_episodes(self.episode_indices[np.asarray(indices, dtype=np.int64)]))

    def save(
        self,
        dataset_id: str,
        *,
        data_format: DataFormat = "hdf5",
        lazy: bool = False,
        mark_steps: bool = False,
    ) -> MinariDataset:
        """Store this dataset (or this view) under `dataset_id` among Minari's local datasets and return it opened.

        HDF5 stores exactly what is iterated. Arrow and Parquet hold infos of T+1 rows only: infos of T rows get a copy
        of their first row before them there, and the episode's metadata has `infos_rows` = T; integers recorded for
        real numbers (rewards, spaces of floats) become floats. Next states other than `observations[t+1]` (literal
        seams, permuted segments) are kept in a recipe only: a warning tells of them.

        Args:
            dataset_id: (namespace/)name-v(version), free.
            data_format: Minari's storage format: "hdf5", "arrow" or "parquet".
            lazy: write a recipe of a few kB instead of the episodes: it needs its source installed where it is opened,
                and `import oat_gym` there before `minari.load_dataset`.
            mark_steps: also store `infos["synthetic"]`, true where a step was generated.

        Raises:
            DatasetExistsError: if there is a dataset of this id; before any work.
            InvalidDataError: for an episode of over 32,766 steps in Arrow or Parquet, which would cut it.
            ConfigurationError: for a malformed id or format, or for a recipe that could not be followed elsewhere.
        """
        check_dataset_id(dataset_id)
        if data_format not in DATA_FORMATS:
            raise ConfigurationError(f"data_format must be one of {', '.join(DATA_FORMATS)}, got {data_format!r}.")
        if lazy:
            return self._save_recipe(dataset_id, mark_steps=mark_steps)
        for number, length in enumerate(self.storage.lengths(self.episode_indices)):
            check_length(number, int(length), data_format)
        self._warn_of_lost_seams()
        like = source_metadata(self) | {"oat_gym": self.description()}
        metadata = self.storage.get_episode_metadata(self.episode_indices)
        with new_dataset_folder(dataset_id) as data_path:
            write_dataset(
                data_path,
                dataset_id,
                zip(self.iterate_episodes(), renumbered(metadata, self.episode_indices), strict=True),
                like=like,
                spaces=(self.observation_space, self.action_space),
                data_format=data_format,
                step_mask=_mask_of if mark_steps else None,
            )
        return find_dataset(dataset_id)

    def _warn_of_lost_seams(self) -> None:
        if any(self.storage.next_states(int(number)) for number in self.episode_indices):
            warnings.warn(
                "Some transitions (literal seams, permuted segments) have a next state of their own, which Minari's "
                "formats cannot hold: the saved dataset has observations[t+1] there, as its episodes do. Save with "
                "lazy=True to keep them for transitions(), to_torch and evaluate.",
                AugmentationWarning,
                stacklevel=3,
            )

    def _save_recipe(self, dataset_id: str, *, mark_steps: bool) -> MinariDataset:
        if mark_steps:
            raise ConfigurationError("mark_steps writes infos, and a recipe has none: save with lazy=False.")
        if not np.array_equal(self.episode_indices, np.arange(self.storage.total_episodes)):
            raise ConfigurationError("A recipe describes a whole augmented dataset, not a view: save with lazy=False.")
        recipe = write_recipe(self.synthesis)
        with new_dataset_folder(dataset_id) as data_path:
            (data_path / RECIPE_FILE).write_bytes(recipe)
            write_metadata(data_path, self.synthesis, dataset_id=dataset_id, totals=self.spec)
            for name in (APPENDED, EPISODE_METADATA_FILE):
                _copy(self.storage.data_path / name, data_path / name)
        return find_dataset(dataset_id)

    def description(self) -> dict[str, Any]:
        """Return what made this dataset, as JSON data; `save` keeps it in the metadata under "oat_gym"."""
        plan = self.synthesis
        try:
            settings = canonical(plan.augmenter)
        except TypeError:
            settings = repr(plan.augmenter)
        return {
            "version": importlib.metadata.version("oat-gym"),
            "source": plan.source.dataset.id,
            "augmenter": plan.augmenter.name,
            "settings": settings,
            "count": plan.count,
            "seed": plan.seed,
        }

    def _transition_parts(self, number: int) -> tuple[EpisodeData, Any, dict[int, Any]]:
        variation = self.storage.variation(number)
        mask = self.storage.provenance(number, variation).mask
        episode = next(self.iterate_episodes([number])) if variation is None else variation.episode
        return episode, mask, self.storage.next_states(number, variation)

    def __repr__(self) -> str:
        plan = self.synthesis
        view = "" if len(self) == self.storage.total_episodes else f", view of {len(self)}"
        state = "fitted" if self.is_fitted else "not fitted"
        return (
            f"AugmentedDataset({self.id!r}: {plan.n_real} real + {plan.count} synthetic episodes{view}, "
            f"{plan.augmenter!r}, seed={plan.seed}, {state})"
        )


def find_source(name: str | PathLike[str]) -> MinariDataset:
    """Return the dataset that `name` names: the id of a local or embedded one, or the path of a D4RL HDF5 file.

    Raises:
        DatasetNotFoundError: if it is not on this machine; nothing is downloaded.
        ConfigurationError: if it is neither an id nor such a path.
    """
    return read_d4rl(Path(name)) if is_d4rl_path(name) else find_dataset(str(name))


def augment(
    source: MinariDataset | str | PathLike[str],
    augmenter: Augmenter | None = None,
    *,
    factor: float | None = None,
    count: int | None = None,
    seed: int = 0,
    progress: ProgressCallback | bool | None = None,
) -> AugmentedDataset:
    """Return a fitted `AugmentedDataset`: the constructor and `fit` in one call."""
    return AugmentedDataset(source, augmenter, factor=factor, count=count, seed=seed).fit(progress=progress)


def open_dataset(data_path: str | PathLike[str]) -> MinariDataset:
    """Return the dataset of a data folder: an `AugmentedDataset` where it holds a recipe, else a `MinariDataset`.

    Raises:
        InvalidDataError: for an augmented dataset's folder that is damaged or not to be trusted; before it is read.
    """
    check_if_augmented(Path(data_path))
    dataset = MinariDataset(data_path)
    if isinstance(dataset.storage, AugmentedStorage) and dataset.storage.synthesis is not None:
        return AugmentedDataset.open(dataset.storage)
    return dataset


def install() -> None:
    """Teach Minari about augmented datasets: the data format "oat", and their class in `minari.load_dataset`.

    `load_dataset` names the class that it returns in its module; that name is the only thing replaced.
    """
    register()
    local.MinariDataset = open_dataset  # pyright: ignore[reportAttributeAccessIssue]


def _synthetic_count(n_real: int, factor: float | None, count: int | None) -> int:
    if factor is not None and count is not None:
        raise ConfigurationError(f"Give factor or count, not both (got factor={factor!r}, count={count!r}).")
    if count is not None:
        return count
    factor = 10 if factor is None else factor
    if isinstance(factor, bool) or not isinstance(factor, int | float | np.number) or not 1 <= factor < np.inf:
        raise ConfigurationError(f"factor must be a number of at least 1 (1: no synthetic episode), got {factor!r}.")
    return round((factor - 1) * n_real)


def _flatten(columns: Transitions, dataset: MinariDataset) -> Transitions:
    observations = FlatSpace.of(dataset.observation_space, "observation space")
    actions = FlatSpace.of(dataset.action_space, "action space")
    fields: dict[str, Any] = vars(columns) | {
        "observations": observations.flatten(columns.observations),
        "next_observations": observations.flatten(columns.next_observations),
        "actions": actions.flatten(columns.actions),
    }
    return Transitions(**fields)


def _mask_of(metadata: dict[str, Any]) -> Any:
    return Provenance.from_metadata(metadata, 0).mask


def _copy(origin: Path, target: Path) -> None:
    if origin.is_dir():
        shutil.copytree(origin, target)
    elif origin.exists():
        shutil.copy2(origin, target)
