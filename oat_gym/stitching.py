"""Stitching: put a generated span in the place of a recorded one (paper, section 2.3). Pure functions."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from minari import EpisodeData

from oat_gym.episodes import BoolArray, copy_episode
from oat_gym.errors import ConfigurationError
from oat_gym.spaces import Batch, map_tree, slice_tree, tree_length

Seam = Literal["contiguous", "literal", "matched"]


@dataclass(frozen=True)
class Span:
    """Steps `start` to `stop` (exclusive) of an episode that were generated.

    `pst_set` is the number of the PST set it comes from and `sample` the number of the sample, where the method has
    them. `seam` holds the jumps at its two ends: the distance of the generated state to the recorded one that it
    replaces, root mean square over the features, in standard deviations of the data.
    """

    start: int
    stop: int
    pst_set: int | None = None
    sample: int | None = None
    seam: tuple[float, float] | None = None


@dataclass(frozen=True)
class Replacement:
    """What goes into a span of W steps: W+1 observations, W actions, W rewards, in the dataset's spaces."""

    observations: Batch
    actions: Batch
    rewards: npt.NDArray[Any]


def stitch(episode: EpisodeData, span: Span, replacement: Replacement) -> EpisodeData:
    """Return a copy of `episode` whose steps of `span` are the replacement's (paper, section 2.3).

    States, actions and rewards at start <= t < stop are generated; everything else, the observation at `stop`, the
    flags and the infos included, is the recorded one to the last bit. In Minari's form the step before the span then
    leads to the first generated state and the last generated step to the recorded state at `stop`: the "contiguous"
    seam. The paper's literal form, in which tuples keep their own s', is what `literal_next_states` gives.

    Raises:
        ConfigurationError: if the span lies outside the episode or the replacement has another length.
    """
    stitched = stitchable_copy(episode, number=episode.id)
    stitch_into(stitched, span, replacement)
    return stitched


def stitchable_copy(episode: EpisodeData, *, number: int) -> EpisodeData:
    """Return a copy that generated steps can go into: integer rewards become floats, which generated ones are."""
    stitched = copy_episode(episode, number=number)
    if stitched.rewards.dtype.kind in "biu":
        stitched = dataclasses.replace(stitched, rewards=stitched.rewards.astype(np.float64))
    return stitched


def stitch_into(episode: EpisodeData, span: Span, replacement: Replacement) -> None:
    """Do what `stitch` does in place, on an episode that `stitchable_copy` gave."""
    width = span.stop - span.start
    if not 0 <= span.start < span.stop <= len(episode.rewards):
        raise ConfigurationError(f"The span {span.start}:{span.stop} is not inside 0:{len(episode.rewards)}.")
    parts = {"observations": width + 1, "actions": width, "rewards": width}
    for name, expected in parts.items():
        length = tree_length(getattr(replacement, name))
        if length != expected:
            raise ConfigurationError(f"A span of {width} steps takes {expected} {name}, got {length}.")
    rows = slice(span.start, span.stop)

    def put(target: Any, values: Any) -> None:
        target[rows] = values[:width]

    map_tree(put, episode.observations, replacement.observations)
    map_tree(put, episode.actions, replacement.actions)
    episode.rewards[rows] = replacement.rewards


def literal_next_states(
    episode: EpisodeData, span: Span, replacement: Replacement
) -> tuple[dict[int, Batch], dict[int, Batch]]:
    """Return the next states in which the paper's literal stitching differs from `observations[t+1]`.

    First that of the step before the span, which keeps the recorded next state of `episode` (the source); then that
    of the last generated step, which is the generated one. Each is a batch of one row, keyed by its step.
    """
    generated = {span.stop - 1: slice_tree(replacement.observations, slice(-1, None))}
    if span.start == 0:
        return {}, generated
    return {span.start - 1: slice_tree(episode.observations, slice(span.start, span.start + 1))}, generated


def spans_mask(spans: tuple[Span, ...], length: int) -> BoolArray:
    """Return `length` booleans, true where a span lies."""
    mask = np.zeros(length, dtype=bool)
    for span in spans:
        mask[span.start : span.stop] = True
    return mask
