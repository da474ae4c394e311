"""The second half of OAT, for any windows: one VAE-MDP for each set of windows, its samples stitched back."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, Self, get_args

import numpy as np
import numpy.typing as npt
from minari import EpisodeData

from oat_gym._rng import derive
from oat_gym.augmenters.base import Variation
from oat_gym.augmenters.generative import (
    GenerativeAugmenter,
    GenerativeSampler,
    Learned,
    Matrices,
    Start,
    check_choice,
    with_prefix,
)
from oat_gym.augmenters.spans import Occurrence, Placement, SpanSamples, place_spans, seam_jumps
from oat_gym.cache import Arrays
from oat_gym.episodes import IntArray
from oat_gym.errors import ShortEpisodesError
from oat_gym.generation import Sequences, VAEMDPConfig
from oat_gym.generation.config import check_integer
from oat_gym.source import Source
from oat_gym.spaces import Batch, map_tree, slice_tree
from oat_gym.stitching import Seam, Span, literal_next_states, stitch_into, stitchable_copy

FloatArray = npt.NDArray[np.float64]
_AT_ONCE = 8192
"""Samples that are rolled out together, which bounds the memory of a large dataset's."""
Actions = Literal["behavior", "recorded"]
Ends = Literal["generated", "recorded"]
Rewards = Literal["modelled", "recorded"]


@dataclass(frozen=True, kw_only=True)
class StitchingAugmenter(GenerativeAugmenter):
    """The settings of a method that replaces windows of episodes by samples; `OAT` says what they mean."""

    start: Start = "posterior"
    observation_noise: bool = False
    actions: Actions = "behavior"
    seam: Seam = "matched"
    candidates: int = 16
    ends: Ends = "recorded"
    rewards: Rewards = "modelled"

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choice("actions", self.actions, get_args(Actions))
        check_choice("seam", self.seam, get_args(Seam))
        check_integer("candidates", self.candidates, at_least=1)
        check_choice("ends", self.ends, get_args(Ends))
        check_choice("rewards", self.rewards, get_args(Rewards))

    def usable(self, source: Source) -> IntArray:
        """Return how many steps of each episode, from the first, spans may cover, (N,)."""
        if self.ends == "generated":
            return source.lengths
        terminated = [bool(episode.terminations[-1]) for episode in source.episodes]
        return source.lengths - np.array(terminated, dtype=np.int64)

    def check_room(self, source: Source, length: int) -> None:
        """Raise `ShortEpisodesError` unless spans of `length` steps may lie somewhere."""
        usable = self.usable(source)
        if usable.max() < length:
            raise ShortEpisodesError(
                f"No episode has the {length} steps of a sub-trajectory before the step in which it terminates, which "
                f"stays as recorded: the {len(usable)} episodes have {usable.min()} to {usable.max()}.",
                length=min(_half(usable), length - 1),
                advice="Use a shorter length, or ends='generated' to generate terminations as other steps are.",
            )

    @classmethod
    def preset(cls, preset: Literal["default", "paper"]) -> Self:
        """Return a named configuration: "default", or "paper" (section 2.2 and appendix B.2).

        The paper's: 100 updates of 4 spans, roll-outs from the prior, noisy steps, literal seams, generated ends. The
        number of OAT's clusters is chosen as in "default", by silhouettes that are told apart (`MiningConfig`), where
        the paper takes the highest of single fits.
        """
        if preset == "default":
            return cls()
        model = VAEMDPConfig.from_preset(preset)
        return cls(model=model, start="prior", observation_noise=True, seam="literal", ends="generated")


@dataclass(frozen=True)
class Windows:
    """The windows of `length` steps that are modelled and replaced.

    `sets[g]` is the (M_g, 2) array of (episode, first step) of set g, the sets in the order in which they are placed;
    `names` is how messages call them.
    """

    length: int
    sets: tuple[IntArray, ...]
    names: tuple[str, ...]

    def sequences(self, data: Matrices) -> list[Sequences]:
        """Return what the VAE-MDP of each set is trained on."""
        width = self.length
        return [
            Sequences(
                states=np.stack([data.states[i][t : t + width + 1] for i, t in rows]),
                actions=np.stack([data.actions[i][t : t + width] for i, t in rows]),
                rewards=np.stack([data.rewards[i][t : t + width] for i, t in rows]),
                groups=rows[:, 0],
                name=name,
            )
            for rows, name in zip(self.sets, self.names, strict=True)
        ]

    def placements(self, k: int, n_source: int) -> list[Placement]:
        """Return where variation `k` of each of `n_source` episodes gets which set; spans never overlap."""
        return [place_spans(self.sets, i, k, self.length) for i in range(n_source)]

    def notes(self, n_source: int, *, reason: str, advice: str) -> tuple[str, ...]:
        """Return what to say of episodes that hold no window, if there are any."""
        without = n_source - len(np.unique(np.concatenate([rows[:, 0] for rows in self.sets])))
        copies = "their synthetic episodes are exact copies of them"
        return (f"{without} of {n_source} episodes {reason}: {copies}. {advice}",) if without else ()


def check_length(lengths: IntArray, length: int, *, advice: str) -> None:
    """Raise `ShortEpisodesError` unless some episode has `length` steps; `advice` may name `{half}` the median."""
    if lengths.max() < length:
        raise ShortEpisodesError(
            f"No episode is as long as a sub-trajectory of {length} steps: the {len(lengths)} episodes have "
            f"{lengths.min()} to {lengths.max()} steps (median {np.median(lengths):g}).",
            length=_half(lengths),
            advice=advice.format(half=_half(lengths)),
        )


def _half(lengths: IntArray) -> int:
    """Return half of the median length, which leaves room in at least half of the episodes."""
    return max(1, int(np.median(lengths)) // 2)


class StitchedSampler(GenerativeSampler):
    """Rolls out the VAE-MDP of each set of windows and stitches its samples into copies of the source episodes."""

    def __init__(
        self, config: StitchingAugmenter, source: Source, seed: int, *, windows: Windows, learned: Learned
    ) -> None:
        super().__init__(config, source, seed, learned=learned)
        self._config = config
        self.windows = windows

    @cached_property
    def _scale(self) -> npt.NDArray[np.float64]:
        return np.concatenate(self._data.states).std(axis=0)

    @cached_property
    def _no_rows(self) -> tuple[Batch, Batch]:
        """Empty batches of observations and actions, in the dtypes in which they are generated."""
        flats = self._source.flat_observations, self._source.flat_actions
        observations, actions = (flat.unflatten(np.empty((0, flat.layout.width))) for flat in flats)
        return observations, actions

    def _with_room(self, episode: EpisodeData) -> EpisodeData:
        """Return the episode, integers recorded for a space of real numbers as such: else generated ones were cut."""
        observations, actions = self._no_rows
        return dataclasses.replace(
            episode,
            observations=map_tree(_with_room_for, episode.observations, observations),
            actions=map_tree(_with_room_for, episode.actions, actions),
        )

    def generate(self, k: int) -> Arrays:
        """Roll out, for variation `k`, one sample for each span that it places, a batch for each set."""
        arrays: Arrays = {}
        placements = self.windows.placements(k, len(self._source))
        for g in range(len(self.windows.sets)):
            rows = [(i, start) for i, placement in enumerate(placements) for h, start in placement if h == g]
            if rows:
                arrays |= {f"{g}/{name}": array for name, array in self._roll_out(g, k, rows).items()}
        return arrays

    def _roll_out(self, g: int, k: int, rows: list[Occurrence]) -> Arrays:
        repeats = self._config.candidates if self._config.seam == "matched" else 1
        size, rng = max(1, _AT_ONCE // repeats), derive(self._seed, "sample", g, k)
        parts = [self._sample(g, rows[at : at + size], repeats=repeats, rng=rng) for at in range(0, len(rows), size)]
        return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}

    def _sample(self, g: int, rows: list[Occurrence], *, repeats: int, rng: np.random.Generator) -> Arrays:
        """Roll out `repeats` samples for each of some spans and keep the one whose seams jump least."""
        config, data, width = self._config, self._data, self.windows.length
        recorded = np.stack([data.states[i][start : start + width + 1] for i, start in rows])
        actions = None
        if config.actions == "recorded":
            actions = np.stack([data.actions[i][start : start + width] for i, start in rows]).repeat(repeats, axis=0)
        samples = self._learned.models[g].sample(
            len(rows) * repeats,
            rng=rng,
            policy=self._policy,
            limits=self._limits,
            actions=actions,
            start=config.start,
            observation_noise=config.observation_noise,
            start_states=recorded[:, 0].repeat(repeats, axis=0) if config.start == "posterior" else None,
        )
        jumps = seam_jumps(samples.states, recorded.repeat(repeats, axis=0), self._scale)
        best = jumps.sum(axis=1).reshape(len(rows), repeats).argmin(axis=1) + np.arange(len(rows)) * repeats
        drawn = {name: getattr(samples, name)[best] for name in ("states", "actions", "rewards", "log_prob")}
        if config.rewards == "recorded":
            drawn["rewards"] = nearest(drawn["rewards"], np.concatenate(data.rewards))
        return drawn | {"rows": np.array(rows), "seams": jumps[best]}

    def decode(self, arrays: Arrays) -> dict[int, SpanSamples]:
        """Return the samples of each set in the dataset's spaces."""
        spaces = self._source.flat_observations, self._source.flat_actions
        sets = {int(name.split("/")[0]) for name in arrays}
        return {g: SpanSamples.decode(with_prefix(arrays, f"{g}/"), *spaces) for g in sorted(sets)}

    def variation(self, i: int, k: int, material: dict[int, SpanSamples]) -> Variation:
        """Stitch the samples of variation `k` into a copy of source episode `i`."""
        original = self._source.episodes[i]
        episode = self._with_room(stitchable_copy(original, number=i))
        log_prob = np.full(len(episode.rewards), np.nan)
        spans: list[Span] = []
        before: dict[int, Batch] = {}
        last: dict[int, Batch] = {}
        for g, samples in material.items():
            if i not in samples.row_of:
                continue
            span, replacement = samples.replacement(i, pst_set=g, number=k * len(self._source) + i)
            if self._config.actions == "recorded":  # as they are, beyond the space's bounds too
                taken = slice_tree(original.actions, slice(span.start, span.stop))
                replacement = dataclasses.replace(replacement, actions=taken)
            stitch_into(episode, span, replacement)
            log_prob[span.start : span.stop] = samples.log_prob[samples.row_of[i]]
            spans.append(span)
            if self._config.seam == "literal":
                kept, generated = literal_next_states(original, span, replacement)
                before |= kept
                last |= generated
        spans.sort(key=lambda span: span.start)
        return Variation(episode, tuple(spans), before | last, log_prob)


def nearest(values: FloatArray, recorded: FloatArray) -> FloatArray:
    """Return, for each of `values`, the nearest of the `recorded` (n,) numbers; of two as near the smaller.

    >>> nearest(np.array([[-3.0, 0.4, 0.6]]), np.array([1.0, 0.0, 0.0])).tolist()
    [[0.0, 0.0, 1.0]]
    """
    known = np.unique(recorded)
    return known[np.searchsorted((known[1:] + known[:-1]) / 2, values)]


def _with_room_for(recorded: npt.NDArray[Any], generated: npt.NDArray[Any]) -> npt.NDArray[Any]:
    fits = np.can_cast(generated.dtype, recorded.dtype, "same_kind")
    return recorded if fits else recorded.astype(generated.dtype)
