"""The contract of a Minari dataset, and of an augmented one, as checks that anyone can run."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from minari import MinariDataset

from oat_gym.checks._access import ACCESS_CHECKS
from oat_gym.checks._augmented import AUGMENTED_CHECKS, UNTOUCHED, source_files
from oat_gym.checks._compare import difference, saved_infos_difference
from oat_gym.checks._content import CONTENT_CHECKS
from oat_gym.checks._subject import Subject, spread
from oat_gym.checks.report import Broken, Check, NotApplicable, Report, run_checks
from oat_gym.dataset import AugmentedDataset
from oat_gym.errors import ConfigurationError, InvalidDataError
from oat_gym.export import DATA_FORMATS, INFOS_ROWS, DataFormat, write_dataset
from oat_gym.provenance import Provenance
from oat_gym.serialization import source_metadata


def saving(subject: Subject) -> int:
    """What is stored in Minari's formats and read back is what was iterated."""
    if not subject.formats:
        raise NotApplicable("no formats were given to save in")
    for data_format in subject.formats:
        with tempfile.TemporaryDirectory(prefix="oat_gym-check-") as folder:
            path = Path(folder) / "data"
            path.mkdir()
            _expect_saved(subject, path, data_format)
    return len(subject.formats) * len(subject.episodes)


def _expect_saved(subject: Subject, path: Path, data_format: DataFormat) -> None:
    dataset, storage = subject.dataset, subject.dataset.storage
    write_dataset(
        path,
        dataset.id,
        zip(subject.episodes, storage.get_episode_metadata(subject.numbers), strict=True),
        like=source_metadata(dataset),
        spaces=(dataset.observation_space, dataset.action_space),
        data_format=data_format,
    )
    saved = MinariDataset(path)
    kept = list(saved.storage.get_episode_metadata(range(len(saved))))
    for got, expected, metadata in zip(saved, subject.episodes, kept, strict=True):
        fields = ("observations", "actions", "rewards", "terminations", "truncations")
        wanted = expected
        if data_format != "hdf5" and expected.rewards.dtype.kind in "biu":  # `write_dataset` says why
            wanted = replace(expected, rewards=expected.rewards.astype(np.float64))
        found = difference(got, wanted, fields)
        if found:
            raise Broken(f"episode {expected.id} saved as {data_format} comes back changed: {found}")
        found = saved_infos_difference(got.infos, expected.infos, metadata.get(INFOS_ROWS))
        if found:
            raise Broken(f"episode {expected.id} saved as {data_format} comes back with other infos: {found}")
    for place, metadata in enumerate(kept):
        origin = Provenance.from_metadata(subject.metadata[place], place)
        if Provenance.from_metadata(metadata, place) != origin:
            raise Broken(f"episode {subject.numbers[place]} saved as {data_format} loses its provenance {origin}")


SAVING: Check[Subject] = Check("saving", "what is saved is what was iterated", saving, ("determinism", "t-plus-one"))
CHECKS: tuple[Check[Subject], ...] = (*CONTENT_CHECKS, *ACCESS_CHECKS, *AUGMENTED_CHECKS, SAVING, UNTOUCHED)
"""Every check, in the order in which they are run."""


def check_dataset(
    dataset: MinariDataset,
    *,
    source: MinariDataset | None = None,
    limit: int | None = None,
    formats: tuple[DataFormat, ...] = (),
) -> Report:
    """Hold the contract of a Minari dataset, and of an augmented one where it is one, against `dataset`.

    The rules are in `CHECKS`. Nothing is changed: draws are made on copies, and files are written to temporary
    folders only. Synthetic episodes are read, so that a dataset that is not fitted is fitted.

    Args:
        dataset: a `minari.MinariDataset` of any kind.
        source: what an augmented dataset is compared with; the source that it names itself by default.
        limit: how many episodes to look at, evenly spread; all by default.
        formats: also save the episodes in these storage formats, in a temporary folder, and read them back.

    Returns:
        The report of the checks that passed, with the number of things that each looked at, and of those that had
        nothing to look at, with the reason.

    Raises:
        ChecksFailed: (a `ConformanceError`) listing every check that failed, with the first thing that broke it.
        ConfigurationError: for a limit below 1, an unknown format, or something that is no Minari dataset.
        InvalidDataError: for a dataset without episodes.

    >>> import oat_gym
    >>> data = oat_gym.AugmentedDataset("oat_gym/maze2d-umaze-v0", factor=1)
    >>> check_dataset(data, limit=2).counts["real-episodes"]
    2
    """
    if not isinstance(dataset, MinariDataset):
        raise ConfigurationError(f"check_dataset takes a minari.MinariDataset, got a {type(dataset).__name__}.")
    if limit is not None and limit < 1:
        raise ConfigurationError(f"limit must be at least 1, or None for every episode, got {limit!r}.")
    if not set(formats) <= set(DATA_FORMATS):
        raise ConfigurationError(f"formats must be among {', '.join(DATA_FORMATS)}, got {formats!r}.")
    if not len(dataset.episode_indices):
        raise InvalidDataError(f"The dataset {dataset.id!r} (or this view of it) has no episodes to check.")
    if source is None and isinstance(dataset, AugmentedDataset) and dataset.storage.synthesis is not None:
        source = dataset.source
    positions = spread(len(dataset.episode_indices), limit)
    subject = Subject(dataset, source, positions, source_files(dataset), tuple(formats))
    return run_checks(f"{type(dataset).__name__} {dataset.id}", subject, CHECKS)
