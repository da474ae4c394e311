"""OAT: mine potential sub-trajectories, model each set by a VAE-MDP, stitch samples back (the paper's method)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
from minari import MinariDataset

from oat_gym._rng import check_seed
from oat_gym.augmenters.generative import Learned, Matrices, check_kind, learn, with_prefix
from oat_gym.augmenters.stitched import StitchedSampler, StitchingAugmenter, Windows, check_length
from oat_gym.cache import Arrays
from oat_gym.errors import ConfigurationError, InvalidDataError
from oat_gym.export import INFOS_ROWS
from oat_gym.mining import MiningConfig, MiningResult
from oat_gym.mining.kept import mine_once
from oat_gym.mining.state import mining_from_state, mining_to_state
from oat_gym.progress import ProgressCallback, silent
from oat_gym.source import Source


@dataclass(frozen=True)
class OAT(StitchingAugmenter):
    """Offline policy evaluation with augmented trajectories (paper, section 2).

    The defaults are the form whose generated steps are nearest to recorded ones and that estimated best of those tried
    (tests/benchmarks/results/benchmark); `OAT.preset("paper")` is the paper's.

    Args:
        mining: TICC, support and PST sets (section 2.1); by default the number of clusters by silhouette, W = 20 and
            the set of the highest support.
        model: the VAE-MDP of each set (section 2.2, Eq. 1) and its training.
        behavior: the clone of the behaviour policy that acts in the roll-outs.
        start: where a roll-out starts: z_1 from the "posterior" q(z_1|s_1) of the span that it replaces, or from the
            "prior" N(0, I), as in the paper.
        actions: "behavior": sampled from the cloned policy, as in the paper; "recorded": those of the span replaced.
        policy: acts in the roll-outs in place of the clone, on batches of the dataset's spaces: an object with
            `sample(observations, *, rng)` and `log_prob(observations, actions)`. The result is not kept in the cache,
            since a policy has no fingerprint.
        observation_noise: take the means of states and rewards (false), or draw them from their distributions, as in
            the paper, whose diagonal Gaussian p(s|z) adds independent noise to every step.
        seam: "matched" (of `candidates` samples the one with the least seam jump), "contiguous" (the first sample), or
            "literal" (the paper's: tuples outside the span keep their own next state, visible in `transitions()`).
        candidates: how many samples "matched" chooses from.
        ends: "recorded": no span holds the step in which an episode terminates, so that episodes end as they did, with
            their own last reward; "generated": one may, as in the paper, where nothing models terminations and an
            outcome that is paid at the end is replaced by an ordinary reward. Truncated episodes have no such step.
        rewards: "modelled": as p(r|z) gives them, as in the paper, or "recorded": the nearest reward that the data
            holds, so that rewards of a few values (0 but for the last step, stages) keep them.
        features: the keys of a Dict observation space that are mined; None takes the whole observation.
        times: the key of the infos that holds the time of each observation, for irregular data (MT-TICC); None: steps.

    >>> OAT().mining.length, OAT.preset("paper").model.max_updates
    (20, 100)
    """

    name: ClassVar[str] = "oat"
    mining: MiningConfig = field(default_factory=lambda: MiningConfig(n_clusters="auto"))
    features: tuple[str, ...] | None = field(default=None, kw_only=True)
    times: str | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_kind("mining", self.mining, MiningConfig)
        if self.times is not None and not isinstance(self.times, str):
            raise ConfigurationError(f"times must be a key of the infos or None, got {self.times!r}.")
        if self.features is not None and not (isinstance(self.features, tuple) and self.features):
            raise ConfigurationError(f"features must be a tuple of observation keys or None, got {self.features!r}.")

    def check(self, source: Source) -> None:
        """Raise where the spaces cannot be modelled or every episode is shorter than W."""
        super().check(source)
        _feature_columns(self, source)
        if isinstance(self.mining.length, int):
            advice = "Use length={half} in OAT(mining=MiningConfig(...)), or length='auto'."
            check_length(source.lengths, self.mining.length, advice=advice)

    def fit(self, source: Source, *, seed: int, progress: ProgressCallback = silent) -> OATSampler:
        """Mine, clone the behaviour policy, and train one VAE-MDP for each PST set."""
        data = Matrices.of(source)
        mining = self._mine(source, seed=seed, progress=progress)
        if not mining.sets:
            raise InvalidDataError(
                f"No window reaches the support asked for, so there is nothing to augment.\n{mining!r}"
            )
        sequences = _windows(mining).sequences(data)
        learned = learn(self, source, data, sequences, seed=seed, progress=progress)
        return OATSampler(self, source, seed, mining=mining, learned=learned)

    def mine(self, dataset: MinariDataset, *, seed: int = 0, progress: ProgressCallback = silent) -> MiningResult:
        """Mine a dataset and train nothing: what `AugmentedDataset.mining` would be with this seed.

        Raises:
            InvalidDataError: for an empty dataset, values that are not finite, or episodes that are all too short.
            UnsupportedSpaceError: for spaces that are not modelled.
        """
        source = Source(dataset)
        self.check(source)
        return self._mine(source, seed=check_seed(seed), progress=progress)

    def _mine(self, source: Source, *, seed: int, progress: ProgressCallback) -> MiningResult:
        columns, times = _feature_columns(self, source), _times(self, source)
        series = [rows[:-1][:, columns] for rows in source.state_matrices()]
        self.check_room(source, self.mining.length if isinstance(self.mining.length, int) else 1)
        usable = self.usable(source).tolist()
        return mine_once(series, config=self.mining, times=times, usable=usable, seed=seed, progress=progress)

    def restore(self, source: Source, arrays: Arrays, value: Any, *, seed: int) -> OATSampler:
        """Return the sampler that `OATSampler.state` described."""
        mining = mining_from_state(with_prefix(arrays, "mining/"), value["mining"])
        learned = Learned.from_arrays(arrays, config=self, names=_windows(mining).names)
        return OATSampler(self, source, seed, mining=mining, learned=learned)


class OATSampler(StitchedSampler):
    """A fitted OAT."""

    def __init__(self, config: OAT, source: Source, seed: int, *, mining: MiningResult, learned: Learned) -> None:
        super().__init__(config, source, seed, windows=_windows(mining), learned=learned)
        self._mining = mining

    @property
    def mining(self) -> MiningResult:
        """Labels, supports and PST sets."""
        return self._mining

    @property
    def notes(self) -> tuple[str, ...]:
        """Of episodes that can only be copied."""
        few = f"(W={self._mining.length}; {self._mining.n_too_short} episodes have too few steps)"
        return self.windows.notes(
            len(self._source),
            reason=f"hold no window of the PST sets {few}",
            advice="More sets (top), fewer clusters or a smaller length reach more episodes.",
        )

    def state(self) -> tuple[Arrays, Any]:
        """Return all that was mined and learnt, as arrays and JSON."""
        arrays, value = mining_to_state(self._mining)
        mined = {f"mining/{name}": array for name, array in arrays.items()}
        return mined | self._learned.to_arrays(), {"mining": value}


def _windows(mining: MiningResult) -> Windows:
    names = tuple(f"PST set {g}" for g in range(len(mining.sets)))
    return Windows(mining.length, tuple(pst.occurrences for pst in mining.sets), names)


def _feature_columns(config: OAT, source: Source) -> npt.NDArray[np.int64]:
    """Return the columns of the observation matrix that are mined."""
    flat = source.flat_observations
    if config.features is None:
        return np.arange(flat.layout.width)
    keys = {str(leaf.path[0]) for leaf in flat.leaves if leaf.path}
    unknown = sorted(set(config.features) - keys)
    if unknown:
        raise ConfigurationError(
            f"features names {', '.join(map(repr, unknown))}, which the observation space {source.observation_space} "
            f"does not have; its keys are {', '.join(sorted(keys)) or 'none (it is no Dict)'}."
        )
    chosen = [leaf for leaf in flat.leaves if str(leaf.path[0]) in config.features]
    return np.concatenate([np.arange(leaf.start, leaf.start + leaf.width) for leaf in chosen])


def _times(config: OAT, source: Source) -> Sequence[npt.NDArray[np.float64]] | None:
    """Return the times of the states that actions were taken in, (T_i,) each, or None.

    Arrow and Parquet, written by `AugmentedDataset.save`, hold the first of T times twice.
    """
    if config.times is None:
        return None
    times: list[npt.NDArray[np.float64]] = []
    for number, (episode, length) in enumerate(zip(source.episodes, source.lengths, strict=True)):
        values = (episode.infos or {}).get(config.times)
        if values is None or len(values) < length:
            raise InvalidDataError(
                f"Episode {number} has no time for each of its {length} steps in infos[{config.times!r}]."
            )
        rows = np.asarray(values, dtype=np.float64).reshape(len(values), -1)[:, 0]
        doubled = source.metadata[number].get(INFOS_ROWS) == length and len(rows) > length and rows[0] == rows[1]
        times.append(rows[1 : length + 1] if doubled else rows[:length])
    return times
