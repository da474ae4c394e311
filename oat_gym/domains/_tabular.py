"""Finite Markov decision processes: exact values by linear solve, optimal policies, and logs drawn from them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from minari.data_collector import EpisodeBuffer

from oat_gym._rng import derive
from oat_gym.errors import ConfigurationError, InvalidDataError
from oat_gym.io.writing import episode_buffer
from oat_gym.ope.policies import draw
from oat_gym.spaces import Batch

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
_ROUNDING = 1e-5  # how far published rows of probabilities are from 1
_BETTER = 1e-9  # an action replaces another only if it gains more: ties never make policy iteration go in circles


@dataclass(frozen=True, eq=False)
class TabularMDP:
    """A process of S states and A actions whose rewards are earned on arriving in a state.

    An episode terminates when it comes to a terminal state, whatever the table says of going on from there.

    Attributes:
        n_actions: A.
        source: (m,) pair s * A + a of each transition that can happen, ascending; every pair of a state that is not
            terminal has at least one.
        target: (m,) the state it leads to.
        probability: (m,) P(s'|s, a), which sum to 1 over a pair.
        reward: (S,) earned on arriving in each state.
        initial: (S,) probability that an episode starts there.
        terminal: (S,) booleans.

    Raises:
        InvalidDataError: for probabilities that do not sum to 1, pairs out of order, or starts in terminal states.

    A coin that is tossed until it shows heads, which pays 1:

    >>> coin = TabularMDP(n_actions=1, source=np.array([0, 0]), target=np.array([0, 1]),
    ...                   probability=np.array([0.5, 0.5]), reward=np.array([0.0, 1.0]),
    ...                   initial=np.array([1.0, 0.0]), terminal=np.array([False, True]))
    >>> round(policy_value(coin, np.ones((2, 1)), gamma=0.8), 4)  # 0.5 / (1 - 0.8 * 0.5)
    0.8333
    """

    n_actions: int
    source: IntArray
    target: IntArray
    probability: FloatArray
    reward: FloatArray
    initial: FloatArray
    terminal: npt.NDArray[np.bool_]

    def __post_init__(self) -> None:
        if (np.diff(self.source) < 0).any():
            raise InvalidDataError("Transitions must come in the order of their pairs (s, a).")
        sums = _sums(self.source, self.probability, self.n_states * self.n_actions)
        going = np.repeat(~self.terminal, self.n_actions)
        if (self.probability < 0).any() or (np.abs(sums[going] - 1.0) > _ROUNDING).any():
            raise InvalidDataError("Transition probabilities must sum to 1 in every state that is not terminal.")
        if abs(self.initial.sum() - 1.0) > _ROUNDING or self.initial[self.terminal].any():
            raise InvalidDataError("Initial probabilities must sum to 1 over the states that are not terminal.")

    @classmethod
    def from_dense(
        cls, transitions: npt.NDArray[np.floating], reward: FloatArray, initial: FloatArray, terminal: npt.ArrayLike
    ) -> TabularMDP:
        """Return the process of an (S, A, S) table of probabilities."""
        states, actions, targets = np.nonzero(transitions)
        return cls(
            n_actions=transitions.shape[1],
            source=states * transitions.shape[1] + actions,
            target=targets,
            probability=transitions[states, actions, targets].astype(np.float64),
            reward=np.asarray(reward, dtype=np.float64),
            initial=np.asarray(initial, dtype=np.float64),
            terminal=np.asarray(terminal, dtype=bool),
        )

    @property
    def n_states(self) -> int:
        """S."""
        return len(self.reward)

    @cached_property
    def going_on(self) -> FloatArray:
        """(m,) the probabilities without those from and into terminal states."""
        return self.probability * ~self.terminal[self.source // self.n_actions] * ~self.terminal[self.target]

    @cached_property
    def expected_reward(self) -> FloatArray:
        """(S, A) mean reward of each pair; 0 in terminal states."""
        earned = self.probability * self.reward[self.target] * ~self.terminal[self.source // self.n_actions]
        return self._sum(earned)

    def expect(self, values: FloatArray) -> FloatArray:
        """Return sum_s' P(s'|s, a) values(s') over the s' that are not terminal, (S, A)."""
        return self._sum(self.going_on * values[self.target])

    def chain(self, policy: FloatArray) -> FloatArray:
        """Return the (S, S) probabilities of going on from s to s' under a policy (S, A)."""
        index = self.source // self.n_actions * self.n_states + self.target
        parts = self.going_on * policy.ravel()[self.source]
        return _sums(index, parts, self.n_states**2).reshape(self.n_states, self.n_states)

    def step(self, states: IntArray, actions: IntArray, rng: np.random.Generator) -> IntArray:
        """Return the next states (n,), drawn by inverting the cumulative probabilities."""
        pairs = states * self.n_actions + actions
        found = np.searchsorted(self._edges, pairs + rng.random(len(pairs)), side="right")
        last = np.searchsorted(self.source, pairs, side="right") - 1
        return self.target[np.minimum(found, last)]

    @cached_property
    def _edges(self) -> FloatArray:
        """(m,) pair + cumulative probability within the pair: ascending, so that one search serves all pairs."""
        total = np.concatenate(([0.0], np.cumsum(self.probability)))
        first = np.searchsorted(self.source, self.source, side="left")
        return self.source.astype(np.float64) + np.minimum(total[1:] - total[first], 1.0)

    def _sum(self, parts: FloatArray) -> FloatArray:
        return _sums(self.source, parts, self.n_states * self.n_actions).reshape(self.n_states, self.n_actions)


def policy_value(mdp: TabularMDP, policy: FloatArray, *, gamma: float, horizon: int | None = None) -> float:
    """Return the expected discounted return from the initial states, exact to rounding.

    Args:
        mdp: the process.
        policy: (S, A) probabilities; rows of terminal states do not count.
        gamma: discount, in [0, 1]; with 1 and no horizon, every state must come to an end under the policy.
        horizon: number of steps that count; `None` for endless.

    Raises:
        ConfigurationError: for another discount.
    """
    return float(mdp.initial @ state_values(mdp, policy, gamma=gamma, horizon=horizon))


def state_values(mdp: TabularMDP, policy: FloatArray, *, gamma: float, horizon: int | None = None) -> FloatArray:
    """Return V(s), (S,): by a linear solve, or by backward recursion over `horizon` steps."""
    if not 0.0 <= gamma <= 1.0:
        raise ConfigurationError(f"gamma must be a number from 0 to 1, got {gamma!r}.")
    rewards, chain = (policy * mdp.expected_reward).sum(axis=1), mdp.chain(policy)
    if horizon is None:
        return np.linalg.solve(np.eye(mdp.n_states) - gamma * chain, rewards)
    values = np.zeros(mdp.n_states)
    for _ in range(horizon):
        values = rewards + gamma * chain @ values
    return values


def optimal_policy(mdp: TabularMDP, *, gamma: float, sign: float = 1.0) -> FloatArray:
    """Return the deterministic policy (S, A) of the largest value by policy iteration (of the smallest: `sign=-1`)."""
    rows = np.arange(mdp.n_states)
    chosen = np.zeros(mdp.n_states, dtype=np.int64)
    while True:
        policy = np.eye(mdp.n_actions)[chosen]
        values = state_values(mdp, policy, gamma=gamma)
        actions = sign * (mdp.expected_reward + gamma * mdp.expect(values))
        better = actions.max(axis=1) > actions[rows, chosen] + _BETTER
        if not better.any():
            return policy
        chosen = np.where(better, actions.argmax(axis=1), chosen)


def mixture(first: FloatArray, second: FloatArray, share: float) -> FloatArray:
    """Return the policy that follows `first` with probability `share` at each step, else `second`."""
    return share * first + (1.0 - share) * second


def sample_episodes(
    mdp: TabularMDP,
    policy: FloatArray,
    *,
    episodes: int,
    horizon: int,
    seed: int,
    observe: Callable[[IntArray], Batch],
) -> list[EpisodeBuffer]:
    """Return episodes drawn under a policy; one that has not terminated after `horizon` steps is truncated.

    infos hold `log_prob` (log pi(a|s) of the action taken) and `state` (the state acted in, its number), a row a step.

    Args:
        mdp: the process.
        policy: (S, A) probabilities.
        episodes: how many.
        horizon: the most steps of an episode.
        seed: of the random numbers; episode e has a stream of its own.
        observe: state numbers (T+1,) -> the observations that are recorded.
    """
    return [_episode(mdp, policy, horizon, derive(seed, "episode", number), observe) for number in range(episodes)]


def _episode(
    mdp: TabularMDP,
    policy: FloatArray,
    horizon: int,
    rng: np.random.Generator,
    observe: Callable[[IntArray], Batch],
) -> EpisodeBuffer:
    states = [int(draw(mdp.initial[None], rng)[0])]
    actions: list[int] = []
    while len(actions) < horizon and not mdp.terminal[states[-1]]:
        now = np.array(states[-1:])
        actions.append(int(draw(policy[now], rng)[0]))
        states.append(int(mdp.step(now, np.array(actions[-1:]), rng)[0]))
    visited, taken = np.array(states), np.array(actions)
    last = np.arange(len(taken)) == len(taken) - 1
    ended = bool(mdp.terminal[visited[-1]])
    return episode_buffer(
        observations=observe(visited),
        actions=taken,
        rewards=mdp.reward[visited[1:]],
        terminations=last & ended,
        truncations=last & (not ended),
        infos={"log_prob": np.log(policy[visited[:-1], taken]), "state": visited[:-1]},
    )


def _sums(index: IntArray, parts: FloatArray, size: int) -> FloatArray:
    return np.bincount(index, parts, minlength=size).astype(np.float64)
