"""What the series methods share: a source as series of [s, a, r] rows, and changed rows as episodes again.

Jittering, scaling, SPAWNER and DGW come from time-series classification and see an episode of T steps as T rows
[s_t, a_t, r_t], z-scored over the data. The T+1-th state is transformed with the others, so that the next state of
step t is `observations[t+1]` in a synthetic episode as in a recorded one. Nothing is z-scored and scaled back: what a
method adds is added to the recorded values, so that what it leaves alone stays as it was to the last bit.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from minari import EpisodeData

from oat_gym.episodes import BoolArray, IntArray
from oat_gym.errors import ConfigurationError
from oat_gym.source import Source
from oat_gym.spaces import Batch, FlatSpace, FloatMatrix, Layout, get_leaf, in_dtype_of, map_tree

_CONSTANT = 1e-10  # a column whose spread is below this share of its size is constant up to rounding
_KEPT_SERIES = 512


@dataclass(frozen=True)
class Columns:
    """One episode as matrices: `states` (T+1, state width), `actions` (T, action width), `rewards` (T, 1)."""

    states: FloatMatrix
    actions: FloatMatrix
    rewards: FloatMatrix


@dataclass(frozen=True)
class Scale:
    """Mean and standard deviation of each column over the data; spread 0 for constant and for one-hot columns."""

    mean: npt.NDArray[np.float64]
    spread: npt.NDArray[np.float64]

    @classmethod
    def of(cls, rows: FloatMatrix, layout: Layout) -> Scale:
        """Return the scale of an (n, width) matrix."""
        spread = rows.std(axis=0)
        spread[spread <= _CONSTANT * np.abs(rows).max(axis=0)] = 0.0
        for start, stop in layout.categorical:
            spread[start:stop] = 0.0
        return cls(rows.mean(axis=0), spread)


_REWARD = Layout(1, (0,), ())


class Series:
    """A source as series.

    Attributes:
        source: the source.
        layouts: the meaning of the columns of states, actions and rewards.
        scales: their means and spreads, states over all T+1 of each episode.

    Raises:
        UnsupportedSpaceError: for spaces that no feature matrix holds.
        InvalidDataError: if a value is NaN or infinite.
    """

    def __init__(self, source: Source) -> None:
        self.source = source
        self._flats = source.flat_observations, source.flat_actions
        self.layouts = self._flats[0].layout, self._flats[1].layout, _REWARD
        everything = [self.columns(i) for i in range(len(source))]
        parts = zip(*((one.states, one.actions, one.rewards) for one in everything), strict=True)
        joined = [np.concatenate(part) for part in parts]
        if not all(np.isfinite(rows).all() for rows in joined):
            for read in (source.state_matrices, source.action_matrices, source.rewards):
                read()  # one of them raises and says where it is
        self.scales = tuple(Scale.of(rows, layout) for rows, layout in zip(joined, self.layouts, strict=True))
        self._rows: dict[int, FloatMatrix] = {}

    def columns(self, i: int) -> Columns:
        """Return the recorded values of episode `i`."""
        episode = self.source.episodes[i]
        return Columns(
            self._flats[0].flatten(episode.observations),
            self._flats[1].flatten(episode.actions),
            np.asarray(episode.rewards, dtype=np.float64)[:, None],
        )

    def rows(self, i: int) -> FloatMatrix:
        """Return the (T, D) rows [s, a, r] of episode `i` in units of standard deviations; shared, not to be changed.

        They are not centred, which no distance sees. One-hot columns are 0 or 1, constant ones 0.
        """
        if i not in self._rows:
            made = self._make_rows(i)
            if len(self._rows) >= _KEPT_SERIES:
                self._rows.clear()
            self._rows[i] = made
            return made
        return self._rows[i]

    def _make_rows(self, i: int) -> FloatMatrix:
        columns = self.columns(i)
        parts = (columns.states[:-1], columns.actions, columns.rewards)
        joined = zip(parts, self.scales, self.layouts, strict=True)
        return np.concatenate([part * _per_spread(scale, layout) for part, scale, layout in joined], axis=1)

    def altered(self, i: int, new: Columns) -> EpisodeData:
        """Return episode `i` with the values of `new`, of the same length, where they differ from the recorded ones.

        All else, infos included, is a copy to the last bit. Changed values are clipped to the spaces.
        """
        episode, old, spaces = self.source.episodes[i], self.columns(i), self._flats
        return EpisodeData(
            id=i,
            observations=_altered(spaces[0], episode.observations, old.states, new.states),
            actions=_altered(spaces[1], episode.actions, old.actions, new.actions),
            rewards=_rewards_like(new.rewards, episode.rewards),
            terminations=episode.terminations.copy(),
            truncations=episode.truncations.copy(),
            infos=copy.deepcopy(episode.infos),
        )

    def rebuilt(self, i: int, new: Columns, rows: IntArray) -> EpisodeData:
        """Return an episode of the values of `new`, clipped to the spaces, with the ending of episode `i`.

        `rows` is the recorded step of each new one: infos are taken from there (see `take_infos`).
        """
        episode, spaces = self.source.episodes[i], self._flats
        return EpisodeData(
            id=i,
            observations=map_tree(in_dtype_of, episode.observations, spaces[0].unflatten(new.states)),
            actions=map_tree(in_dtype_of, episode.actions, spaces[1].unflatten(new.actions)),
            rewards=_rewards_like(new.rewards, episode.rewards),
            terminations=_ending_of(episode.terminations, len(rows)),
            truncations=_ending_of(episode.truncations, len(rows)),
            infos=take_infos(episode.infos, len(episode.rewards), rows),
        )


def take_infos(infos: Any, length: int, steps: IntArray) -> Any:
    """Return infos for new steps that come from recorded `steps`, of an episode of `length` steps.

    Infos with a row for each of the T steps give the rows of `steps`; those with T+1 rows (one for each observation)
    also the row after the last of them. Anything else is copied. No memory is shared.
    """
    observed = np.append(steps, steps[-1] + 1)

    def take(leaf: Any) -> Any:
        n = len(leaf) if isinstance(leaf, list) or (isinstance(leaf, np.ndarray) and leaf.ndim) else -1
        if n not in (length, length + 1):
            return copy.deepcopy(leaf)
        rows = steps if n == length else observed
        # one deepcopy for each row: a row of objects that stands twice must not be shared between the two
        if isinstance(leaf, list):
            return [copy.deepcopy(leaf[row]) for row in rows]
        if leaf.dtype != object:
            return leaf[rows]
        taken = np.empty((len(rows), *leaf.shape[1:]), dtype=object)
        for new, row in enumerate(rows):
            taken[new] = copy.deepcopy(leaf[row])
        return taken

    return map_tree(take, infos)


def take_rows(batch: Batch, rows: IntArray) -> Batch:
    """Return the given rows of every leaf of a batch, as a copy; lists of strings (Text) are leaves too."""
    return map_tree(lambda leaf: [leaf[row] for row in rows] if isinstance(leaf, list) else leaf[rows], batch)


def check_labels(labels: tuple[int, ...] | None) -> None:
    """Raise `ConfigurationError` unless the setting `labels` is None or a tuple of integers."""
    whole = isinstance(labels, tuple) and all(isinstance(one, int) and not isinstance(one, bool) for one in labels)
    if labels is not None and not whole:
        raise ConfigurationError(
            "labels must be a tuple of integers, the class of each source episode in order, or None (classes by "
            f"median return); got {labels!r}. Of an array: tuple(labels.tolist())."
        )


def check_series(source: Source, labels: tuple[int, ...] | None) -> None:
    """Raise where a space is not modelled or there is not one label for each episode; reads no episode."""
    source.flat_observations  # noqa: B018  (raises for a space that is not modelled)
    source.flat_actions  # noqa: B018
    if labels is not None and len(labels) != len(source):
        raise ConfigurationError(
            f"labels has {len(labels)} classes and the source {len(source)} episodes; one for each is needed, in the "
            "order of the (filtered) dataset that is augmented."
        )


def episode_classes(source: Source, labels: tuple[int, ...] | None) -> IntArray:
    """Return the class of each episode, (N,): the user's, else 1 where the return is above the median and 0 elsewhere.

    Where nothing is above the median (over half of the episodes share the best return), 1 is "at the median".
    """
    if labels is not None:
        return np.array(labels, dtype=np.int64)
    returns = np.array([rewards.sum() for rewards in source.rewards()])
    above = returns > np.median(returns)
    return (above if above.any() else returns >= np.median(returns)).astype(np.int64)


def has_ended(source: Source) -> BoolArray:
    """Return whether each episode ends by termination, (N,)."""
    return np.array([bool(episode.terminations[-1]) for episode in source.episodes])


def check_number(name: str, value: float, *, low: float = 0.0, high: float = np.inf) -> None:
    """Raise `ConfigurationError` unless `value` is a finite number in [low, high]."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high or value == np.inf:
        limits = f"at least {low:g}" if high == np.inf else f"{low:g} to {high:g}"
        raise ConfigurationError(f"{name} must be a finite number of {limits}, got {value!r}.")


def check_count(name: str, value: int, *, low: int) -> None:
    """Raise `ConfigurationError` unless `value` is an integer of at least `low`."""
    if isinstance(value, bool) or not isinstance(value, int) or value < low:
        raise ConfigurationError(f"{name} must be an integer of at least {low}, got {value!r}.")


def _per_spread(scale: Scale, layout: Layout) -> npt.NDArray[np.float64]:
    varying = scale.spread > 0
    factor = np.where(varying, 1.0 / np.where(varying, scale.spread, 1.0), 0.0)
    for start, stop in layout.categorical:
        factor[start:stop] = 1.0
    # Rounded, so that a last bit of the sums above, which another processor may give, does not decide between paths.
    return factor.astype(np.float32).astype(np.float64)


def _altered(flat: FlatSpace, batch: Batch, old: FloatMatrix, new: FloatMatrix) -> Batch:
    made = map_tree(in_dtype_of, batch, flat.unflatten(new))
    unchanged = new == old
    for leaf in flat.leaves:
        target, recorded = get_leaf(made, leaf.path), get_leaf(batch, leaf.path)
        keep = unchanged[:, leaf.start : leaf.start + leaf.width]
        # Discrete parts are left alone by the methods that alter an episode.
        where = np.True_ if leaf.sizes else keep.reshape(target.shape)
        np.copyto(target, recorded, where=where, casting="unsafe")
    return made


def _rewards_like(rewards: FloatMatrix, recorded: npt.NDArray[Any]) -> npt.NDArray[Any]:
    return rewards[:, 0].astype(recorded.dtype if recorded.dtype.kind == "f" else np.float64)


def _ending_of(flags: npt.NDArray[Any], length: int) -> npt.NDArray[Any]:
    ending = np.zeros(length, dtype=flags.dtype)
    ending[-1] = flags[-1]
    return ending
