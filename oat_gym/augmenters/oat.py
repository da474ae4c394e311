"""OAT: mine potential sub-trajectories, model each set by a VAE-MDP, stitch samples back (the paper's method)."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, ClassVar, Literal, get_args

import numpy as np
import numpy.typing as npt
from minari import MinariDataset

from oat_gym._rng import check_seed, derive
from oat_gym.augmenters.base import Augmenter, Sampler, Variation
from oat_gym.augmenters.spans import Occurrence, Placement, SpanSamples, place_spans, seam_jumps
from oat_gym.cache import Arrays
from oat_gym.errors import AugmentationWarning, ConfigurationError, InvalidDataError
from oat_gym.generation import (
    ActionPolicy,
    BehaviorConfig,
    BehaviorModel,
    FittedVAEMDP,
    Limits,
    Sequences,
    VAEMDPConfig,
    fit_behavior,
    fit_many,
)
from oat_gym.mining import MiningConfig, MiningResult, mine
from oat_gym.mining.state import mining_from_state, mining_to_state
from oat_gym.progress import ProgressCallback, silent
from oat_gym.source import Source
from oat_gym.spaces import Batch, FlatSpace
from oat_gym.stitching import Seam, Span, literal_next_states, stitch_into, stitchable_copy

Start = Literal["prior", "posterior"]
Actions = Literal["behavior", "recorded"]


@dataclass(frozen=True)
class OAT(Augmenter):
    """Offline policy evaluation with augmented trajectories (paper, section 2).

    Args:
        mining: TICC, support and PST sets (section 2.1); by default the number of clusters by silhouette, W = 20 and
            the set of the highest support.
        model: the VAE-MDP of each set (section 2.2, Eq. 1) and its training.
        behavior: the clone of the behaviour policy that acts in the roll-outs.
        start: where a roll-out starts: z_1 from the "prior" N(0, I), as in the paper, or from the "posterior"
            q(z_1|s_1) of the span that it replaces.
        actions: "behavior": sampled from the cloned policy, as in the paper; "recorded": those of the span replaced.
        policy: acts in the roll-outs in place of the clone, on batches of the dataset's spaces: an object with
            `sample(observations, *, rng)` and `log_prob(observations, actions)`. The result is not kept in the cache,
            since a policy has no fingerprint.
        observation_noise: draw states and rewards from their distributions, as in the paper, or (false) take their
            means: smoother states, since the paper's diagonal Gaussian p(s|z) adds independent noise to every step.
        seam: "contiguous" (Minari's form), "literal" (the paper's: tuples outside the span keep their own next state,
            visible in `transitions()`), or "matched" (of `candidates` samples the one with the least seam jump).
        candidates: how many samples "matched" chooses from.
        features: the keys of a Dict observation space that are mined; None takes the whole observation.
        times: the key of the infos that holds the time of each observation, for irregular data (MT-TICC); None: steps.

    >>> OAT().mining.length, OAT.preset("paper").model.max_updates
    (20, 100)
    """

    name: ClassVar[str] = "oat"
    mining: MiningConfig = field(default_factory=lambda: MiningConfig(n_clusters="auto"))
    model: VAEMDPConfig = field(default_factory=VAEMDPConfig)
    behavior: BehaviorConfig = field(default_factory=BehaviorConfig)
    start: Start = "prior"
    actions: Actions = "behavior"
    policy: ActionPolicy | None = None
    observation_noise: bool = True
    seam: Seam = "contiguous"
    candidates: int = 16
    features: tuple[str, ...] | None = None
    times: str | None = None

    def __post_init__(self) -> None:
        choices: dict[str, tuple[str, ...]] = {
            "start": get_args(Start),
            "actions": get_args(Actions),
            "seam": get_args(Seam),
        }
        for name, allowed in choices.items():
            if getattr(self, name) not in allowed:
                raise ConfigurationError(f"{name} must be one of {', '.join(allowed)}; got {getattr(self, name)!r}.")
        parts = {"mining": MiningConfig, "model": VAEMDPConfig, "behavior": BehaviorConfig}
        for name, kind in parts.items():
            if not isinstance(getattr(self, name), kind):
                raise ConfigurationError(f"{name} must be a {kind.__name__}, got {getattr(self, name)!r}.")
        if not isinstance(self.observation_noise, bool):
            raise ConfigurationError(f"observation_noise must be True or False, got {self.observation_noise!r}.")
        if self.policy is not None and not isinstance(self.policy, ActionPolicy):
            raise ConfigurationError(f"policy must have the methods sample and log_prob, got {self.policy!r}.")
        if self.times is not None and not isinstance(self.times, str):
            raise ConfigurationError(f"times must be a key of the infos or None, got {self.times!r}.")
        if isinstance(self.candidates, bool) or not isinstance(self.candidates, int) or self.candidates < 1:
            raise ConfigurationError(f"candidates must be an integer of at least 1, got {self.candidates!r}.")
        if self.features is not None and not (isinstance(self.features, tuple) and self.features):
            raise ConfigurationError(f"features must be a tuple of observation keys or None, got {self.features!r}.")

    @property
    def cacheable(self) -> bool:
        """False with a policy of the user's."""
        return self.policy is None

    @classmethod
    def preset(cls, preset: Literal["default", "paper"]) -> OAT:
        """Return a named configuration: "default", or "paper" (appendix B.2: literal seams, 100 updates of 4 spans)."""
        if preset == "default":
            return cls()
        return cls(model=VAEMDPConfig.from_preset(preset), seam="literal")

    def check(self, source: Source) -> None:
        """Raise where the spaces cannot be modelled or every episode is shorter than W."""
        source.flat_actions  # noqa: B018  (raises for a space that is not modelled)
        _feature_columns(self, source)
        width = self.mining.length
        if isinstance(width, int) and source.lengths.max() < width:
            raise InvalidDataError(
                f"No episode is as long as a sub-trajectory of {width} steps: the {len(source)} episodes have "
                f"{source.lengths.min()} to {source.lengths.max()} steps (median {np.median(source.lengths):g}). Use "
                f"OAT(mining=MiningConfig(length={max(1, int(np.median(source.lengths)) // 2)})) or length='auto'."
            )

    def fit(self, source: Source, *, seed: int, progress: ProgressCallback = silent) -> OATSampler:
        """Mine, clone the behaviour policy, and train one VAE-MDP for each PST set."""
        states, actions, rewards = source.state_matrices(), source.action_matrices(), source.rewards()
        mining = self._mine(source, seed=seed, progress=progress)
        if not mining.sets:
            raise InvalidDataError(
                f"No window reaches the support asked for, so there is nothing to augment.\n{mining!r}"
            )
        behavior = fit_behavior(
            np.concatenate([rows[:-1] for rows in states]),
            np.concatenate(actions),
            state_layout=source.flat_observations.layout,
            action_layout=source.flat_actions.layout,
            groups=np.repeat(np.arange(len(source)), source.lengths),
            bounds=source.flat_actions.bounds,
            config=self.behavior,
            rng=derive(seed, "behavior"),
            progress=progress,
        )
        sets = [
            Sequences(
                states=np.stack([states[i][t : t + mining.length + 1] for i, t in pst.occurrences]),
                actions=np.stack([actions[i][t : t + mining.length] for i, t in pst.occurrences]),
                rewards=np.stack([rewards[i][t : t + mining.length] for i, t in pst.occurrences]),
                groups=pst.occurrences[:, 0],
                name=f"PST set {g}",
            )
            for g, pst in enumerate(mining.sets)
        ]
        models = fit_many(
            sets,
            state_layout=source.flat_observations.layout,
            action_layout=source.flat_actions.layout,
            config=self.model,
            rng=derive(seed, "model"),
            progress=progress,
        )
        return OATSampler(self, source, seed, mining=mining, behavior=behavior, models=tuple(models))

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
        return mine(series, config=self.mining, times=times, rng=derive(seed, "mining"), progress=progress)

    def restore(self, source: Source, arrays: Arrays, value: Any, *, seed: int) -> OATSampler:
        """Return the sampler that `OATSampler.state` described; warns of episodes that it can only copy."""
        mining = mining_from_state(_with_prefix(arrays, "mining/"), value["mining"])
        _warn_of_copies(mining, len(source))
        behavior = BehaviorModel.from_arrays(_with_prefix(arrays, "behavior/"), config=self.behavior)
        models = [
            FittedVAEMDP.from_arrays(_with_prefix(arrays, f"model{g}/"), config=self.model, name=f"PST set {g}")
            for g in range(len(mining.sets))
        ]
        return OATSampler(self, source, seed, mining=mining, behavior=behavior, models=tuple(models))


class OATSampler(Sampler):
    """Variations of episodes by stitching (paper, section 2.3)."""

    def __init__(
        self,
        config: OAT,
        source: Source,
        seed: int,
        *,
        mining: MiningResult,
        behavior: BehaviorModel,
        models: tuple[FittedVAEMDP, ...],
    ) -> None:
        self._config = config
        self._source = source
        self._seed = seed
        self._mining = mining
        self._behavior = behavior
        self._models = models

    @property
    def mining(self) -> MiningResult:
        """Labels, supports and PST sets."""
        return self._mining

    @cached_property
    def _states(self) -> list[npt.NDArray[np.float64]]:
        return self._source.state_matrices()

    @cached_property
    def _scale(self) -> npt.NDArray[np.float64]:
        return np.concatenate(self._states).std(axis=0)

    def state(self) -> tuple[Arrays, Any]:
        """Return all that was learnt, as arrays and JSON."""
        arrays, value = mining_to_state(self._mining)
        parts = {"mining/": arrays, "behavior/": self._behavior.to_arrays()}
        parts |= {f"model{g}/": model.to_arrays() for g, model in enumerate(self._models)}
        joined = {prefix + name: array for prefix, part in parts.items() for name, array in part.items()}
        return joined, {"mining": value}

    def placements(self, k: int) -> list[Placement]:
        """Return where variation `k` of each source episode gets which PST set; spans never overlap."""
        occurrences = [pst.occurrences for pst in self._mining.sets]
        return [place_spans(occurrences, i, k, self._mining.length) for i in range(len(self._source))]

    def generate(self, k: int) -> Arrays:
        """Roll out, for variation `k`, one sample for each span that it places, a batch for each PST set."""
        arrays: Arrays = {}
        placements = self.placements(k)
        for g in range(len(self._models)):
            rows = [(i, start) for i, placement in enumerate(placements) for h, start in placement if h == g]
            if rows:
                arrays |= {f"{g}/{name}": array for name, array in self._roll_out(g, k, rows).items()}
        return arrays

    def _roll_out(self, g: int, k: int, rows: list[Occurrence]) -> Arrays:
        config, width = self._config, self._mining.length
        recorded = np.stack([self._states[i][start : start + width + 1] for i, start in rows])
        repeats = config.candidates if config.seam == "matched" else 1
        actions = None
        if config.actions == "recorded":
            matrices = self._action_matrices
            actions = np.stack([matrices[i][start : start + width] for i, start in rows]).repeat(repeats, axis=0)
        samples = self._models[g].sample(
            len(rows) * repeats,
            rng=derive(self._seed, "sample", g, k),
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
        return drawn | {"rows": np.array(rows), "seams": jumps[best]}

    @property
    def _policy(self) -> ActionPolicy:
        if self._config.policy is None:
            return self._behavior
        return _FlatPolicy(self._config.policy, self._source.flat_observations, self._source.flat_actions)

    @cached_property
    def _limits(self) -> Limits:
        """The range of all recorded values, wider by the model's margin and inside the spaces' bounds."""
        return Limits.of(
            np.concatenate(self._states),
            np.concatenate(self._action_matrices),
            np.concatenate(self._source.rewards()),
            margin=self._config.model.range_margin,
            state_bounds=self._source.flat_observations.bounds,
            action_bounds=self._source.flat_actions.bounds,
        )

    @cached_property
    def _action_matrices(self) -> list[npt.NDArray[np.float64]]:
        return self._source.action_matrices()

    def decode(self, arrays: Arrays) -> dict[int, SpanSamples]:
        """Return the samples of each PST set in the dataset's spaces."""
        spaces = self._source.flat_observations, self._source.flat_actions
        sets = {int(name.split("/")[0]) for name in arrays}
        return {g: SpanSamples.decode(_with_prefix(arrays, f"{g}/"), *spaces) for g in sorted(sets)}

    def variation(self, i: int, k: int, material: dict[int, SpanSamples]) -> Variation:
        """Stitch the samples of variation `k` into a copy of source episode `i`."""
        original = self._source.episodes[i]
        episode = stitchable_copy(original, number=i)
        spans: list[Span] = []
        before: dict[int, Batch] = {}
        last: dict[int, Batch] = {}
        for g, samples in material.items():
            if i not in samples.row_of:
                continue
            span, replacement = samples.replacement(i, pst_set=g, number=k * len(self._source) + i)
            stitch_into(episode, span, replacement)
            spans.append(span)
            if self._config.seam == "literal":
                kept, generated = literal_next_states(original, span, replacement)
                before |= kept
                last |= generated
        spans.sort(key=lambda span: span.start)
        return Variation(episode, tuple(spans), before | last)


@dataclass(frozen=True)
class _FlatPolicy:
    """A policy on batches of the dataset's spaces, as one on feature matrices."""

    policy: ActionPolicy
    observations: FlatSpace
    actions: FlatSpace

    def sample(
        self, observations: npt.NDArray[np.floating[Any]], *, rng: np.random.Generator
    ) -> npt.NDArray[np.floating[Any]]:
        return self.actions.flatten(self.policy.sample(self.observations.unflatten(observations), rng=rng))

    def log_prob(
        self, observations: npt.NDArray[np.floating[Any]], actions: npt.NDArray[np.floating[Any]]
    ) -> npt.NDArray[np.floating[Any]]:
        return self.policy.log_prob(self.observations.unflatten(observations), self.actions.unflatten(actions))


def _warn_of_copies(mining: MiningResult, n_source: int) -> None:
    with_pst = {int(i) for pst in mining.sets for i in pst.occurrences[:, 0]}
    if len(with_pst) < n_source:
        warnings.warn(
            f"{n_source - len(with_pst)} of {n_source} episodes hold no window of the PST sets (W={mining.length}; "
            f"{mining.n_too_short} episodes are shorter): their synthetic episodes are exact copies of them. A smaller "
            "length, fewer clusters or more sets (top) reach more episodes.",
            AugmentationWarning,
            stacklevel=2,
        )


def _with_prefix(arrays: Arrays, prefix: str) -> Arrays:
    return {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}


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
    if config.times is None:
        return None
    times: list[npt.NDArray[np.float64]] = []
    for number, (episode, length) in enumerate(zip(source.episodes, source.lengths, strict=True)):
        values = (episode.infos or {}).get(config.times)
        if values is None or len(values) < length:
            raise InvalidDataError(
                f"Episode {number} has no time for each of its {length} steps in infos[{config.times!r}]."
            )
        times.append(np.asarray(values, dtype=np.float64).reshape(len(values), -1)[:length, 0])
    return times
