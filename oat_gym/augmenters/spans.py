"""Where generated spans go, and the samples that go there: shared by the methods that stitch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from oat_gym.cache import Arrays
from oat_gym.episodes import IntArray
from oat_gym.spaces import Batch, FlatSpace, map_tree
from oat_gym.stitching import Replacement, Span

Occurrence = tuple[int, int]
"""(episode, first step)."""
Placement = tuple[Occurrence, ...]
"""The (PST set, first step) of each span placed in one episode."""


def place_spans(occurrences: Sequence[IntArray], i: int, k: int, width: int) -> Placement:
    """Return the spans that variation `k` of episode `i` gets: at most one of each PST set, never overlapping.

    `occurrences[g]` is the (M, 2) array of (episode, first step) of set g, the sets in order of support: the first
    set is placed first, and a later one takes the first of its occurrences that is still free. An episode with n
    occurrences of a set takes them in turn with k, so that ten variations do not all replace the same one.
    """
    placed: list[Occurrence] = []
    for g, rows in enumerate(occurrences):
        starts = rows[rows[:, 0] == i, 1]
        for start in np.roll(starts, -(k % max(len(starts), 1))):
            if all(abs(int(start) - other) >= width for _, other in placed):
                placed.append((g, int(start)))
                break
    return tuple(placed)


def seam_jumps(
    generated: npt.NDArray[np.floating], recorded: npt.NDArray[np.floating], scale: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    """Return (n, 2): how far the first and the last generated state are from the recorded ones in their place.

    `generated` and `recorded` are (n, W+1, D) feature matrices, `scale` (D,) the features' standard deviations over
    the data; the jump is the root mean square over the features that vary, in those units.
    """
    varying = scale > 0
    ends = (generated - recorded)[:, [0, -1]][..., varying] / scale[varying]
    return np.sqrt(np.mean(ends**2, axis=-1)) if varying.any() else np.zeros((len(generated), 2))


@dataclass(frozen=True)
class SpanSamples:
    """The samples of one PST set for one variation, in the dataset's spaces.

    Leaves of `observations` are (n, W+1, ...), of `actions` (n, W, ...); `rewards` and `log_prob` (the behaviour
    policy's, of the actions) are (n, W), `seams` (n, 2), `starts` (n,). `row_of` gives the row of an episode.
    """

    row_of: dict[int, int]
    starts: IntArray
    observations: Batch
    actions: Batch
    rewards: npt.NDArray[np.float64]
    log_prob: npt.NDArray[np.float64]
    seams: npt.NDArray[np.float64]

    @classmethod
    def decode(cls, arrays: Arrays, observations: FlatSpace, actions: FlatSpace) -> SpanSamples:
        """Return the samples of flat arrays `rows` (n, 2), `states`, `actions`, `rewards`, `log_prob` and `seams`."""
        rows = arrays["rows"]
        return cls(
            row_of={int(i): row for row, i in enumerate(rows[:, 0])},
            starts=rows[:, 1],
            observations=_unflatten(observations, arrays["states"]),
            actions=_unflatten(actions, arrays["actions"]),
            rewards=arrays["rewards"],
            log_prob=arrays["log_prob"],
            seams=arrays["seams"],
        )

    def replacement(self, i: int, *, pst_set: int, number: int) -> tuple[Span, Replacement]:
        """Return the span of episode `i`, its sample called `number`, and what goes into it (views of the samples)."""
        row = self.row_of[i]
        start, width = int(self.starts[row]), self.rewards.shape[1]
        seam = float(self.seams[row, 0]), float(self.seams[row, 1])
        span = Span(start, start + width, pst_set=pst_set, sample=number, seam=seam)
        parts = (map_tree(lambda leaf: leaf[row], batch) for batch in (self.observations, self.actions))
        return span, Replacement(*parts, rewards=self.rewards[row])


def _unflatten(space: FlatSpace, values: npt.NDArray[np.floating]) -> Batch:
    """Return (n, W, width) features as a batch whose leaves are (n, W, ...)."""
    n, width = values.shape[:2]
    batch = space.unflatten(values.reshape(n * width, -1))
    return map_tree(lambda leaf: leaf.reshape(n, width, *leaf.shape[1:]), batch)
