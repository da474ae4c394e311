"""One run of an augmenter on a source, with what its checks have to know of it."""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from minari import MinariDataset

from oat_gym.augmenters.base import Augmenter, Sampler, Variation
from oat_gym.cache import Arrays, read_sealed, write_sealed
from oat_gym.checks._probe import Probe
from oat_gym.checks.report import Broken
from oat_gym.episodes import IntArray, content_hash
from oat_gym.progress import ProgressCallback, silent
from oat_gym.source import Source

VARIATIONS = 2
"""How many variations of each episode are looked at."""

Variations = tuple[tuple[Variation, ...], ...]


@dataclass(frozen=True)
class Trial:
    """A fitted augmenter and its variations: `variations[k][i]` is variation k of episode i.

    `announced` (VARIATIONS, N) is what `lengths` said before the fit, `arrays[k]` what `generate(k)` gave; `moved`
    names the global random states that were not left alone, and `source_changed` tells whether the source was.
    """

    source: Source
    seed: int
    sampler: Sampler
    announced: IntArray
    arrays: tuple[Arrays, ...]
    variations: Variations
    moved: tuple[str, ...]
    source_changed: bool


def run_trial(augmenter: Augmenter, dataset: MinariDataset, *, seed: int, backwards: bool = False) -> Trial:
    """Fit an augmenter to a dataset and make its variations, in order or from the last to the first."""
    source = Source(dataset)
    before, states = content_hash(source.episodes), global_states()
    augmenter.check(source)
    numbers = np.tile(np.arange(len(source)), VARIATIONS)
    order = np.repeat(np.arange(VARIATIONS), len(source))
    announced = np.asarray(augmenter.lengths(source, numbers, order, seed=seed))
    if announced.shape != numbers.shape:
        raise Broken(f"lengths of {len(numbers)} variations has shape {announced.shape}, expected {numbers.shape}")
    sampler = augmenter.fit(source, seed=seed, progress=silent)
    arrays, variations = make_all(sampler, len(source), backwards=backwards)
    now = global_states()
    return Trial(
        source=source,
        seed=seed,
        sampler=sampler,
        announced=announced.reshape(VARIATIONS, -1),
        arrays=arrays,
        variations=variations,
        moved=tuple(name for name in states if states[name] != now[name]),
        source_changed=content_hash(source.episodes) != before,
    )


def make_all(sampler: Sampler, n_source: int, *, backwards: bool = False) -> tuple[tuple[Arrays, ...], Variations]:
    """Return what is generated and made of it for each variation, asked for in either order."""
    numbers, order = list(range(n_source)), list(range(VARIATIONS))
    step = -1 if backwards else 1
    arrays: dict[int, Arrays] = {k: sampler.generate(k) for k in order[::step]}
    material = {k: sampler.decode(arrays[k]) for k in order[::step]}
    made = {(k, i): sampler.variation(i, k, material[k]) for k in order[::step] for i in numbers[::step]}
    return tuple(arrays[k] for k in order), tuple(tuple(made[k, i] for i in numbers) for k in order)


def restored(augmenter: Augmenter, trial: Trial, folder: Path) -> Variations:
    """Return the variations of a sampler that was restored from files, with material from files."""
    source = Source(trial.source.dataset)
    write_sealed(folder / "model", *trial.sampler.state())
    sampler = augmenter.restore(source, *read_sealed(folder / "model"), seed=trial.seed)
    variations: list[tuple[Variation, ...]] = []
    for k, arrays in enumerate(trial.arrays):
        write_sealed(folder / f"variation-{k}", arrays, None)
        material = sampler.decode(read_sealed(folder / f"variation-{k}")[0])
        variations.append(tuple(sampler.variation(i, k, material) for i in range(len(source))))
    return tuple(variations)


def global_states() -> dict[str, bytes]:
    """Return the global random states, by name."""
    kind, keys, *position = np.random.get_state()  # noqa: NPY002  (the one that is to stay untouched)
    return {
        "random": repr(random.getstate()).encode(),
        "numpy.random": np.asarray(keys).tobytes() + repr((kind, position)).encode(),
        "torch": torch.get_rng_state().numpy().tobytes(),
    }


@dataclass(frozen=True)
class FittedOnce(Augmenter):
    """An augmenter whose fits are remembered, and nothing of it kept on disk: for the checks of whole datasets.

    `fits` holds one sampler for each (content of the source, seed); it does not go with a pickle.
    """

    name: ClassVar[str] = "fitted-once"
    augmenters: tuple[Augmenter, ...]
    fits: dict[tuple[str, int], Sampler] = field(default_factory=dict[tuple[str, int], Sampler], compare=False)

    @property
    def cacheable(self) -> bool:
        """False, so that nothing reaches the disk."""
        return False

    def check(self, source: Source) -> None:
        """Do what the augmenter does."""
        self.augmenters[0].check(source)

    def lengths(self, source: Source, episodes: IntArray, variations: IntArray, *, seed: int) -> IntArray:
        """Return what the augmenter does."""
        return self.augmenters[0].lengths(source, episodes, variations, seed=seed)

    def fit(self, source: Source, *, seed: int, progress: ProgressCallback = silent) -> Sampler:
        """Return the sampler of an earlier fit to the same data, else of a new one."""
        key = source.fingerprint, seed
        if key not in self.fits:
            self.fits[key] = self.augmenters[0].fit(source, seed=seed, progress=progress)
        return self.fits[key]

    def __reduce__(self) -> tuple[Callable[..., FittedOnce], tuple[tuple[Augmenter, ...]]]:
        return FittedOnce, (self.augmenters,)


class Trials:
    """The runs of one augmenter, each made once, when a check first asks for it."""

    def __init__(
        self, augmenter: Augmenter, probes: Sequence[Probe], *, one_step: Probe, seed: int, limit: int | None
    ) -> None:
        self.augmenter = augmenter
        self.probes = {probe.name: probe for probe in probes}
        self.one_step = one_step
        self.seed = seed
        self.limit = limit
        self._done: dict[str, Trial] = {}

    def first(self, name: str) -> Trial:
        """Return the run on the probe of this name."""
        if name not in self._done:
            self._done[name] = run_trial(self.augmenter, self.probes[name].dataset, seed=self.seed)
        return self._done[name]

    @property
    def done(self) -> dict[str, Trial]:
        """The runs that went well so far, by the names of their probes."""
        return dict(self._done)
