"""TDA: temporal data augmentation by random windows, in the place of OAT's mined ones."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from oat_gym._rng import derive
from oat_gym.augmenters.generative import Learned, Matrices, learn
from oat_gym.augmenters.stitched import StitchedSampler, StitchingAugmenter, Windows, check_length
from oat_gym.cache import Arrays
from oat_gym.generation.config import check_integer
from oat_gym.progress import ProgressCallback, silent
from oat_gym.source import Source


@dataclass(frozen=True)
class TDA(StitchingAugmenter):
    """One random window of each trajectory is modelled and replaced; otherwise OAT (paper, section 3.1).

    Park et al., "SURF: Semi-supervised Reward Learning with Data Augmentation for Feedback-efficient Preference-based
    Reinforcement Learning", ICLR 2022 (github.com/alinlab/SURF, `reward_model_semi_dataaug.py`), learn rewards from
    random crops of the segments that people compare. OAT's paper compares OPE, where no reward is learnt: there the
    crops take the place of mined windows, so that the comparison isolates mining. A window of `length` steps is drawn
    uniformly from each trajectory when the method is fitted, one VAE-MDP is trained on all windows, and every variation
    of a trajectory gets another sample in the place of its window. Trajectories shorter than `length` have none: they
    are copied, with a warning.

    Args:
        length: W, the steps of a window.
        model: see `OAT`, as `behavior`, `start`, `actions`, `policy`, `observation_noise`, `seam`, `candidates`, `ends`
            and `rewards`.

    >>> TDA().length, TDA.preset("paper").seam
    (20, 'literal')
    """

    name: ClassVar[str] = "tda"
    length: int = 20

    def __post_init__(self) -> None:
        super().__post_init__()
        check_integer("length", self.length, at_least=1)

    def check(self, source: Source) -> None:
        """Raise where the spaces cannot be modelled or every episode is shorter than W."""
        super().check(source)
        check_length(source.lengths, self.length, advice="Use TDA(length={half}).")

    def windows(self, source: Source, *, seed: int) -> Windows:
        """Return the window of each episode that has room for one, its first step uniform over all that it can be."""
        self.check_room(source, self.length)
        usable = self.usable(source)
        rows = [
            (i, int(derive(seed, "window", i).integers(steps - self.length + 1)))
            for i, steps in enumerate(usable.tolist())
            if steps >= self.length
        ]
        return Windows(self.length, (np.array(rows, dtype=np.int64),), ("the random windows",))

    def fit(self, source: Source, *, seed: int, progress: ProgressCallback = silent) -> StitchedSampler:
        """Draw the windows, clone the behaviour policy, and train one VAE-MDP on all windows."""
        data, windows = Matrices.of(source), self.windows(source, seed=seed)
        learned = learn(self, source, data, windows.sequences(data), seed=seed, progress=progress)
        return TDASampler(self, source, seed, windows=windows, learned=learned)

    def restore(self, source: Source, arrays: Arrays, value: Any, *, seed: int) -> StitchedSampler:
        """Return the sampler that `StitchedSampler.state` described."""
        windows = self.windows(source, seed=seed)
        learned = Learned.from_arrays(arrays, config=self, names=windows.names)
        return TDASampler(self, source, seed, windows=windows, learned=learned)


class TDASampler(StitchedSampler):
    """A fitted TDA."""

    @property
    def notes(self) -> tuple[str, ...]:
        """Of episodes that can only be copied."""
        reason = f"have no window of W={self.windows.length} steps that may be replaced"
        return self.windows.notes(len(self._source), reason=reason, advice="A smaller length reaches more episodes.")
