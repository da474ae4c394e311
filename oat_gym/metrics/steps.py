"""The steps (s, a, r, s') of a dataset, real and generated apart, and the units in which they are compared."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from minari import EpisodeData, MinariDataset

from oat_gym.episodes import IntArray, collect_transitions
from oat_gym.errors import InvalidDataError
from oat_gym.provenance import Provenance
from oat_gym.spaces import Batch, FlatSpace, FloatMatrix
from oat_gym.storage import AugmentedStorage

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Steps:
    """n steps as feature matrices (`oat_gym.spaces.FlatSpace`), in the dataset's units.

    `states` and `next_states` are (n, S), `actions` (n, A), `rewards` (n,); `episodes` (n,) is the number of the real
    episode that a step belongs to, or that its episode was made from, `numbers` (n,) that of the step in its episode.
    """

    states: FloatMatrix
    actions: FloatMatrix
    rewards: FloatArray
    next_states: FloatMatrix
    episodes: IntArray
    numbers: IntArray

    def __len__(self) -> int:
        """Return the number of steps."""
        return len(self.rewards)

    def take(self, rows: npt.NDArray[Any]) -> Steps:
        """Return the steps of the given numbers, or where a mask is true."""
        return Steps(**{name: values[rows] for name, values in vars(self).items()})

    def sample(self, limit: int, rng: np.random.Generator) -> Steps:
        """Return `limit` steps drawn without replacement, in order; all of them where there are no more."""
        if len(self) <= limit:
            return self
        return self.take(np.sort(rng.choice(len(self), limit, replace=False)))


def steps_in_place(real: Steps, generated: Steps) -> Steps:
    """Return the real steps in whose place others were generated: of the same episode, with the same number.

    Of a stitching method these are the recorded steps that its spans replace; of one that makes whole episodes they
    are (about) all steps.
    """
    stride = 1 + max(int(real.numbers.max()), int(generated.numbers.max()))
    here, there = (steps.episodes * stride + steps.numbers for steps in (real, generated))
    return real.take(np.isin(here, there))


@dataclass(frozen=True)
class Contents:
    """What `read_steps` finds: real steps, generated steps, and the (n, 2) seam jumps at the ends of the spans."""

    real: Steps
    generated: Steps
    seams: FloatArray


def read_steps(dataset: MinariDataset) -> Contents:
    """Read a dataset once: the steps of its real episodes, and those of the others that were generated.

    The recorded steps of a stitched episode are neither. Generated steps are known by provenance, which
    `AugmentedDataset.save` keeps too. The next state of a step is that of `AugmentedDataset.transitions`.

    Raises:
        InvalidDataError: for a dataset without episodes, and values that are not finite.
        UnsupportedSpaceError: for spaces that have no feature matrix.
    """
    observations = FlatSpace.of(dataset.observation_space, "observation space")
    actions = FlatSpace.of(dataset.action_space, "action space")
    found: list[tuple[EpisodeData, npt.NDArray[np.bool_], dict[int, Batch]]] = []
    origins: list[Provenance] = []
    roots: list[int] = []
    known: dict[int, Provenance] = {}
    for number, episode, origin, overrides in _episodes(dataset):
        known[number] = origin
        found.append((episode, origin.mask, overrides))
        origins.append(origin)
        roots.append(_root(number, known))
    columns = collect_transitions(found, range(len(found)))
    steps = Steps(
        states=observations.flatten(columns.observations),
        actions=actions.flatten(columns.actions),
        rewards=np.asarray(columns.rewards, dtype=np.float64),
        next_states=observations.flatten(columns.next_observations),
        episodes=np.array(roots, dtype=np.int64)[columns.episode],
        numbers=columns.step,
    )
    _check_finite(steps, columns.episode)
    is_real = np.array([not origin.synthetic for origin in origins])[columns.episode]
    seams = [span.seam for origin in origins if origin.synthetic for span in origin.spans if span.seam is not None]
    return Contents(
        real=steps.take(is_real),
        generated=steps.take(columns.synthetic & ~is_real),
        seams=np.array(seams, dtype=np.float64).reshape(-1, 2),
    )


def _episodes(dataset: MinariDataset) -> Iterator[tuple[int, EpisodeData, Provenance, dict[int, Batch]]]:
    """Yield number, data, provenance and differing next states of each episode."""
    if isinstance(dataset.storage, AugmentedStorage):  # Minari's own views of one are plain MinariDatasets
        for number in map(int, dataset.episode_indices):
            variation = dataset.storage.variation(number)  # made once, for the provenance too
            origin = dataset.storage.provenance(number, variation)
            episode = next(iter(dataset.iterate_episodes([number]))) if variation is None else variation.episode
            yield number, episode, origin, dataset.storage.next_states(number, variation)
        return
    numbers = [int(number) for number in dataset.episode_indices]
    metadata = dataset.storage.get_episode_metadata(numbers)
    for number, part, episode in zip(numbers, metadata, dataset.iterate_episodes(numbers), strict=True):
        yield number, episode, Provenance.from_metadata(part, number), {}


def _root(number: int, known: dict[int, Provenance]) -> int:
    """Return the real episode that `number` was made from, over any number of augmentations; itself if unknown."""
    while number in known and known[number].synthetic and known[number].source >= 0:
        number = known[number].source
    return number


def _check_finite(steps: Steps, episodes: IntArray) -> None:
    for name in ("states", "actions", "rewards", "next_states"):
        values: FloatMatrix = getattr(steps, name).reshape(len(steps), -1)
        bad = ~np.isfinite(values).all(axis=1)
        if bad.any():
            row = int(np.argmax(bad))
            raise InvalidDataError(
                f"Step {steps.numbers[row]} of episode {episodes[row]} has {name} that are not finite: {values[row]}. "
                "Fidelity compares finite numbers: drop or repair the episode (filter_episodes)."
            )


@dataclass(frozen=True)
class Scale:
    """Units: real columns in standard deviations of the real data around its mean, one-hot columns as they are.

    Two categories are then as far apart as values that differ by 1.4 standard deviations. A column that never varies
    in the real data keeps its own unit. `states`, `actions`, `rewards` and `changes` (of s' - s) are (mean, scale).
    """

    states: tuple[FloatArray, FloatArray]
    actions: tuple[FloatArray, FloatArray]
    rewards: tuple[FloatArray, FloatArray]
    changes: tuple[FloatArray, FloatArray]

    @classmethod
    def of(cls, real: Steps, *, observations: FlatSpace, actions: FlatSpace) -> Scale:
        """Return the units of real steps."""
        discrete = _discrete(observations)
        none = np.zeros(1, dtype=bool)
        return cls(
            states=_mean_and_scale(real.states, discrete),
            actions=_mean_and_scale(real.actions, _discrete(actions)),
            rewards=_mean_and_scale(real.rewards[:, None], none),
            changes=_mean_and_scale(real.next_states - real.states, discrete),
        )

    def inputs(self, steps: Steps) -> FloatMatrix:
        """Return [s, a], (n, S + A)."""
        return np.hstack((_scaled(steps.states, self.states), _scaled(steps.actions, self.actions)))

    def rows(self, steps: Steps) -> FloatMatrix:
        """Return [s, a, r, s'], (n, 2S + A + 1)."""
        rewards = _scaled(steps.rewards[:, None], self.rewards)
        return np.hstack((self.inputs(steps), rewards, _scaled(steps.next_states, self.states)))

    def outcomes(self, steps: Steps) -> FloatMatrix:
        """Return [s' - s, r], (n, S + 1), in standard deviations of the real changes and rewards."""
        changes = _scaled(steps.next_states - steps.states, self.changes)
        return np.hstack((changes, _scaled(steps.rewards[:, None], self.rewards)))

    def sizes(self, steps: Steps) -> FloatArray:
        """Return the size of s' - s of each step, (n,): root mean square over the features, in standard deviations."""
        return np.sqrt((((steps.next_states - steps.states) / self.states[1]) ** 2).mean(axis=1))


def _discrete(space: FlatSpace) -> npt.NDArray[np.bool_]:
    mask = np.ones(space.layout.width, dtype=bool)
    mask[list(space.layout.continuous)] = False
    return mask


def _mean_and_scale(values: FloatMatrix, keep: npt.NDArray[np.bool_]) -> tuple[FloatArray, FloatArray]:
    mean, scale = values.mean(axis=0), values.std(axis=0)
    # What rounding makes of a constant column is no scale.
    constant = scale <= 1e-9 * (1 + np.abs(mean))
    return np.where(keep, 0.0, mean), np.where(keep | constant, 1.0, scale)


def _scaled(values: FloatMatrix, units: tuple[FloatArray, FloatArray]) -> FloatMatrix:
    mean, scale = units
    return (values - mean) / scale
