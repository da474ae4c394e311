"""VAE-MDP on entire trajectories: OAT without mining and without stitching (the paper's ablation)."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from oat_gym._rng import derive
from oat_gym.augmenters.base import Variation
from oat_gym.augmenters.generative import GenerativeAugmenter, GenerativeSampler, Learned, Matrices, learn
from oat_gym.cache import Arrays
from oat_gym.episodes import BoolArray, IntArray
from oat_gym.generation import Samples, Sequences, VAEMDPConfig
from oat_gym.generation.config import check_integer
from oat_gym.progress import ProgressCallback, silent
from oat_gym.source import Source
from oat_gym.spaces import Batch, in_dtype_of, map_tree, slice_tree
from oat_gym.stitching import Span, stitchable_copy

_NAME = "the entire trajectories"
_BATCH_VALUES = 2**23
"""Most numbers that one batch of roll-outs holds, so that memory does not grow with the number of episodes."""

_logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class VAEMDP(GenerativeAugmenter):
    """A VAE-MDP (paper, section 2.2, Eq. 1) of entire trajectories; every step of a variation is generated.

    The paper's ablation without mining and stitching (section 3.1). Trajectories are padded to the longest one and
    masked, so that padding has no part in the fit, and where episodes terminate the model learns p(end|z_t).

    The length of a variation and its flags are those of its source episode, since a dataset must know them before
    anything is trained. Where the model knows ends, samples are made to fit them by sampling-importance-resampling: of
    `candidates` roll-outs one is drawn in proportion to the likelihood that it ends exactly there: the product of
    1 - p(end|z_t) over the steps before the last, times p(end|z_T) where the source terminates, or 1 - p(end|z_T)
    where it is truncated. So an episode that terminates ends in a state like a terminal one, and has none before.
    Infos are the source's.

    Args:
        candidates: roll-outs that each variation is drawn from; 1 takes any. No effect where no episode terminates.
        model: see `OAT`, as `behavior`, `start`, `policy` and `observation_noise`, of which the last three are the
            paper's by default (the prior, the clone, with noise). Training takes time in proportion
            to the longest trajectory, so the default is 500 updates, patience 100, in place of OAT's 1000 and 200: on
            the door demonstrations (25 of 222 to 299 steps) about 150 CPU seconds, with the best held-out ELBO at
            440 updates and little gain after 300.

    >>> VAEMDP().candidates, VAEMDP.preset("paper").model.batch_size
    (16, 4)
    """

    name: ClassVar[str] = "vae-mdp"
    model: VAEMDPConfig = field(default_factory=lambda: VAEMDPConfig(max_updates=500, patience=100), kw_only=True)
    candidates: int = field(default=16, kw_only=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_integer("candidates", self.candidates, at_least=1)

    def fit(self, source: Source, *, seed: int, progress: ProgressCallback = silent) -> VAEMDPSampler:
        """Clone the behaviour policy, and train one VAE-MDP on all trajectories."""
        data = Matrices.of(source)
        sequences = whole_episodes(data, terminated=_terminated(source))
        learned = learn(self, source, data, [sequences], seed=seed, progress=progress)
        return VAEMDPSampler(self, source, seed, learned=learned)

    def restore(self, source: Source, arrays: Arrays, value: Any, *, seed: int) -> VAEMDPSampler:
        """Return the sampler that `VAEMDPSampler.state` described."""
        learned = Learned.from_arrays(arrays, config=self, names=(_NAME,))
        return VAEMDPSampler(self, source, seed, learned=learned)


@dataclass(frozen=True)
class Rows:
    """One variation of all episodes, in the dataset's spaces, the episodes one after the other.

    `observations` has sum(T_i + 1) rows, `actions`, `rewards` and `log_prob` (of the actions) sum(T_i).
    """

    observations: Batch
    actions: Batch
    rewards: npt.NDArray[np.float64]
    log_prob: npt.NDArray[np.float64]


class VAEMDPSampler(GenerativeSampler):
    """A fitted VAE-MDP of entire trajectories."""

    def __init__(self, config: VAEMDP, source: Source, seed: int, *, learned: Learned) -> None:
        super().__init__(config, source, seed, learned=learned)
        self._config = config
        self._first = np.cumsum([0, *source.lengths])

    @property
    def _knows_ends(self) -> bool:
        return self._learned.models[0].network.ends

    def generate(self, k: int) -> Arrays:
        """Roll out variation `k` of every episode: `states`, `actions`, `rewards` and `log_prob`, joined along time."""
        lengths = self._source.lengths
        parts: dict[str, list[npt.NDArray[np.float64]]] = {}
        for number, episodes in enumerate(self._batches()):
            samples, chosen = self._roll_out(k, number, episodes)
            for name in ("states", "actions", "rewards", "log_prob"):
                part = parts.setdefault(name, [np.empty(0)] * len(lengths))
                values, extra = getattr(samples, name), int(name == "states")
                for i, row in zip(episodes, chosen, strict=True):
                    part[i] = values[row, : lengths[i] + extra].copy()
        return {name: np.concatenate(part) for name, part in parts.items()}

    def _batches(self) -> Iterator[IntArray]:
        """Give the episodes in batches of similar length, each small enough for memory."""
        order = np.argsort(-self._source.lengths, kind="stable")
        width = self._source.flat_observations.layout.width + self._source.flat_actions.layout.width + 3
        while len(order):
            one = int(self._source.lengths[order[0]] + 1) * width * (self._config.candidates if self._knows_ends else 1)
            size = max(1, _BATCH_VALUES // one)
            yield order[:size]
            order = order[size:]

    def _roll_out(self, k: int, number: int, episodes: IntArray) -> tuple[Samples, IntArray]:
        """Return the candidates of batch `number` of variation `k`, and the row chosen for each of its episodes."""
        config, lengths = self._config, self._source.lengths[episodes]
        repeats = config.candidates if self._knows_ends else 1
        starts = None
        if config.start == "posterior":
            starts = np.stack([self._data.states[i][0] for i in episodes]).repeat(repeats, axis=0)
        samples = self._learned.models[0].sample(
            len(episodes) * repeats,
            rng=derive(self._seed, "trajectories", k, number),
            policy=self._policy,
            limits=self._limits,
            start=config.start,
            start_states=starts,
            observation_noise=config.observation_noise,
            steps=int(lengths.max()),
        )
        rows = np.arange(len(episodes)) * repeats
        if repeats == 1:
            return samples, rows
        terminated = _terminated(self._source)[episodes]
        scores = length_log_likelihood(samples.end_logits, lengths.repeat(repeats), terminated.repeat(repeats))
        scores = scores.reshape(len(episodes), repeats)
        _logger.info("Variation %d: %s", k, _describe_weights(scores))
        return samples, rows + draw_in_proportion(scores, rng=derive(self._seed, "resample", k, number))

    def decode(self, arrays: Arrays) -> Rows:
        """Return the arrays of `generate` in the dataset's spaces."""
        return Rows(
            observations=self._source.flat_observations.unflatten(arrays["states"]),
            actions=self._source.flat_actions.unflatten(arrays["actions"]),
            rewards=arrays["rewards"],
            log_prob=arrays["log_prob"],
        )

    def variation(self, i: int, k: int, material: Rows) -> Variation:
        """Return generated observations, actions and rewards with the flags and infos of source episode `i`."""
        episode = stitchable_copy(self._source.episodes[i], number=i)
        steps = slice(int(self._first[i]), int(self._first[i + 1]))
        states = slice(steps.start + i, steps.stop + i + 1)  # each episode before has one state more than steps
        episode = dataclasses.replace(
            episode,
            observations=map_tree(in_dtype_of, episode.observations, slice_tree(material.observations, states)),
            actions=map_tree(in_dtype_of, episode.actions, slice_tree(material.actions, steps)),
            rewards=material.rewards[steps].astype(episode.rewards.dtype),
        )
        span = Span(0, len(episode.rewards), sample=k * len(self._source) + i)
        return Variation(episode, (span,), log_prob=material.log_prob[steps].copy())


def whole_episodes(data: Matrices, *, terminated: BoolArray) -> Sequences:
    """Return all episodes as one set of sequences, padded with zeros behind their ends, which a mask tells.

    `terminated` (N,) says which episodes end in a terminal state; with none, no ends are learnt.
    """
    lengths = np.array([len(rewards) for rewards in data.rewards])
    steps = np.arange(lengths.max())
    last = steps == lengths[:, None] - 1
    return Sequences(
        states=_padded(data.states, len(steps) + 1),
        actions=_padded(data.actions, len(steps)),
        rewards=_padded(data.rewards, len(steps)),
        mask=steps < lengths[:, None],
        terminal=last & terminated[:, None] if terminated.any() else None,
        name=_NAME,
    )


def length_log_likelihood(
    end_logits: npt.NDArray[np.float64], lengths: IntArray, terminated: BoolArray
) -> npt.NDArray[np.float64]:
    """Return log p(n) of roll-outs: that they terminate with their last step, or have not terminated by then.

    Args:
        end_logits: (n, W) logit of p(end) after each step, of each roll-out.
        lengths: (n,) the steps of each, at most W.
        terminated: (n,) whether each is to terminate, or to be truncated.

    >>> even = np.zeros((2, 3))  # an end at every step with probability 1/2
    >>> np.exp(length_log_likelihood(even, np.array([3, 2]), np.array([True, False]))).round(6).tolist()
    [0.125, 0.25]
    """
    goes_on, ends = -np.logaddexp(0.0, end_logits), -np.logaddexp(0.0, -end_logits)
    inside = np.arange(end_logits.shape[1]) < (lengths - terminated)[:, None]
    last = ends[np.arange(len(lengths)), lengths - 1]
    return np.where(inside, goes_on, 0.0).sum(axis=1) + np.where(terminated, last, 0.0)


def draw_in_proportion(log_weights: npt.NDArray[np.float64], *, rng: np.random.Generator) -> IntArray:
    """Return one column of each row of (n, V) log-weights, drawn in proportion to the weights (Gumbel-max)."""
    return (log_weights + rng.gumbel(size=log_weights.shape)).argmax(axis=1)


def _describe_weights(scores: npt.NDArray[np.float64]) -> str:
    shares = np.exp(scores - np.logaddexp.reduce(scores, axis=1, keepdims=True))
    effective = float((1 / (shares**2).sum(axis=1)).mean())
    likelihood = float(np.exp(scores).mean())
    return (
        f"{scores.shape[1]} candidates end as planned with probability {likelihood:.3g}, worth {effective:.1f} draws."
    )


def _terminated(source: Source) -> BoolArray:
    return np.array([bool(episode.terminations[-1]) for episode in source.episodes])


def _padded(rows: list[npt.NDArray[np.float64]], length: int) -> npt.NDArray[np.float64]:
    padded = np.zeros((len(rows), length, *rows[0].shape[1:]))
    for row, values in zip(padded, rows, strict=True):
        row[: len(values)] = values
    return padded
