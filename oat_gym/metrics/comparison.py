"""The fidelity of one augmented dataset, and of several methods on one dataset."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from os import PathLike

from minari import MinariDataset

from oat_gym.augmenters import AUGMENTERS, Augmenter
from oat_gym.dataset import AugmentedDataset, find_source
from oat_gym.errors import ConfigurationError, OatGymError
from oat_gym.metrics.judge import LIMIT, Judge
from oat_gym.metrics.scores import Fidelity
from oat_gym.metrics.steps import read_steps
from oat_gym.progress import ProgressCallback, silent
from oat_gym.report import real_episodes
from oat_gym.synthesis import MAX_COUNT


def fidelity(data: MinariDataset, *, seed: int = 0, limit: int = LIMIT) -> Fidelity:
    """Return how like its real steps the generated steps of an augmented dataset are, in numbers.

    Generated steps are those that provenance marks; the recorded steps of stitched episodes count as neither. Real
    columns are z-scored by the real data, one-hot columns taken as they are.

    Args:
        data: an `AugmentedDataset` (fits first), or a dataset that was saved from one; views too, as long as they
            hold real episodes.
        seed: of the halves, samples, projections and models. The same seed gives the same numbers.
        limit: most steps of each half and of the generated data that distances, models and the classifier see. Time
            and memory grow with its square.

    Raises:
        InvalidDataError: if nothing was generated, there are fewer than 4 real episodes, or values are not finite.
        UnsupportedSpaceError: for spaces without a feature matrix.

    >>> from oat_gym import AugmentedDataset, Function
    >>> copying = Function(lambda episode, rng: episode)
    >>> data = AugmentedDataset("oat_gym/maze2d-umaze-v0", copying, count=250)
    >>> fidelity(data, limit=100).copies.value
    1.0
    """
    contents = read_steps(data)
    judge = Judge.of(data, contents, seed=seed, limit=limit)
    return judge.fidelity(contents.generated, contents.seams)


@dataclass(frozen=True)
class Comparison:
    """One method of a comparison: its name, its configuration, and its fidelity or the reason why it has none."""

    name: str
    augmenter: Augmenter
    fidelity: Fidelity | None
    reason: str | None


def compare(
    dataset: MinariDataset | str | PathLike[str],
    augmenters: Mapping[str, Augmenter] | None = None,
    *,
    factor: float = 10,
    seed: int = 0,
    limit: int = LIMIT,
    progress: ProgressCallback = silent,
) -> list[Comparison]:
    """Augment `dataset` by each method and return their fidelities, in the order given.

    A method that cannot work on the dataset is a `Comparison` with the reason. What is trained is kept in the cache,
    as always.

    Args:
        dataset: as `AugmentedDataset` takes it; of an augmented one the real episodes are used.
        augmenters: the configurations by name; every entry of `AUGMENTERS` with its defaults when None.
        factor: episodes in all, as a multiple of the source's; over 1.
        seed: of the methods, and of the measuring.
        limit: see `fidelity`.
        progress: called as progress(description, done, total), for the methods' own work too.

    Raises:
        ConfigurationError: for no augmenter, or a factor that is not over 1, so near to 1 that it makes no episode,
            or too large.
        InvalidDataError: for a dataset of fewer than 4 episodes.

    >>> from oat_gym import Function
    >>> rows = compare("oat_gym/maze2d-umaze-v0", {"copy": Function(lambda e, rng: e)}, factor=2, limit=100)
    >>> rows[0].name, rows[0].fidelity.copies.value
    ('copy', 1.0)
    """
    methods = {name: kind() for name, kind in AUGMENTERS.items()} if augmenters is None else dict(augmenters)
    if not methods:
        raise ConfigurationError("There is no augmenter to compare; give at least one.")
    if not 1 < factor < math.inf:
        raise ConfigurationError(f"factor must be over 1 (and finite), or nothing is generated; got {factor!r}.")
    source = real_episodes(dataset if isinstance(dataset, MinariDataset) else find_source(dataset))
    count = round((factor - 1) * len(source))
    if not 1 <= count <= MAX_COUNT:
        raise ConfigurationError(
            f"A factor of {factor!r} of {len(source)} episodes makes {count} more; 1 to {MAX_COUNT} can be compared."
        )
    judge = Judge.of(source, read_steps(source), seed=seed, limit=limit)
    rows: list[Comparison] = []
    for done, (name, augmenter) in enumerate(methods.items()):
        progress("Comparing", done, len(methods))
        try:
            data = AugmentedDataset(source, augmenter, count=count, seed=seed)
            data.fit(progress=_named(progress, name))
            contents = read_steps(data)
            rows.append(Comparison(name, augmenter, judge.fidelity(contents.generated, contents.seams), None))
        except OatGymError as error:
            rows.append(Comparison(name, augmenter, None, str(error)))
    progress("Comparing", len(methods), len(methods))
    return rows


def _named(progress: ProgressCallback, name: str) -> ProgressCallback:
    return lambda description, done, total: progress(f"{name}: {description}", done, total)
