"""Small Markov decision processes with exact values, logs drawn from them, and the problems that estimators get.

Policies are tables (S, A) of probabilities. A step from state s by action a goes to s' with probability
`transitions[s, a, s']` and earns `rewards[s, a, s']`; an episode ends (terminates) when it reaches a terminal state.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from minari.data_collector import EpisodeBuffer

from oat_gym.episodes import Transitions
from oat_gym.ope.logged import Logged
from oat_gym.ope.policy import PolicySet
from oat_gym.ope.problem import Part, Problem
from oat_gym.spaces import FlatSpace

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class MDP:
    """transitions and rewards (S, A, S), initial (S,) probabilities, terminal (S,) booleans."""

    transitions: FloatArray
    rewards: FloatArray
    initial: FloatArray
    terminal: npt.NDArray[np.bool_]

    @property
    def n_states(self) -> int:
        return len(self.initial)

    @property
    def n_actions(self) -> int:
        return self.transitions.shape[1]

    @property
    def expected_rewards(self) -> FloatArray:
        """(S, A)."""
        return (self.transitions * self.rewards).sum(axis=2)

    @property
    def continuing(self) -> FloatArray:
        """(S, A, S) probability of going on to each state: zero into terminal states."""
        return self.transitions * ~self.terminal


@dataclass(frozen=True)
class Table:
    """A policy pi(a|s) from a table (S, A).

    Observations are state numbers, or with `features` (S, D) rows of them. (It meets `DiscretePolicy`.)
    """

    table: FloatArray
    features: FloatArray | None = None

    def states(self, observations: npt.NDArray[np.generic]) -> npt.NDArray[np.int64]:
        if self.features is None:
            return np.asarray(observations, dtype=np.int64)
        rows = np.asarray(observations, dtype=np.float64)
        return np.square(rows[:, None] - self.features[None]).sum(axis=2).argmin(axis=1)

    def probabilities(self, observations: npt.NDArray[np.generic]) -> FloatArray:
        return self.table[self.states(observations)]

    def log_prob(self, observations: npt.NDArray[np.generic], actions: npt.NDArray[np.generic]) -> FloatArray:
        with np.errstate(divide="ignore"):
            return np.log(self.table[self.states(observations), np.asarray(actions, dtype=np.int64)])

    def sample(self, observations: npt.NDArray[np.generic], *, rng: np.random.Generator) -> npt.NDArray[np.int64]:
        return draw(self.probabilities(observations), rng)

    def mean(self, observations: npt.NDArray[np.generic]) -> npt.NDArray[np.int64]:
        return self.probabilities(observations).argmax(axis=1)


@dataclass(frozen=True)
class Logs:
    """n episodes as padded arrays: states (n, T+1), actions and rewards (n, T); lengths and terminated are (n,)."""

    states: npt.NDArray[np.int64]
    actions: npt.NDArray[np.int64]
    rewards: FloatArray
    lengths: npt.NDArray[np.int64]
    terminated: npt.NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.lengths)

    @property
    def mask(self) -> npt.NDArray[np.bool_]:
        """(n, T): true at steps that happened."""
        return np.arange(self.actions.shape[1]) < self.lengths[:, None]

    def returns(self, gamma: float, horizon: int | None = None) -> FloatArray:
        """(n,) discounted returns."""
        steps = np.arange(self.actions.shape[1])
        counted = self.mask & (steps < (len(steps) if horizon is None else horizon))
        return (self.rewards * counted * gamma**steps).sum(axis=1)


def draw(probabilities: FloatArray, rng: np.random.Generator) -> npt.NDArray[np.int64]:
    """Return one draw for each row of (n, K) probabilities."""
    edges = probabilities.cumsum(axis=1)
    return (rng.random(len(edges))[:, None] * edges[:, -1:] >= edges).sum(axis=1).clip(max=edges.shape[1] - 1)


# --- processes -------------------------------------------------------------------------------------------------------


def chain(n: int = 4, *, slip: float = 0.2) -> MDP:
    """Return n states in a row and a terminal one at the end: action 1 goes right, 0 stays, each fails by `slip`.

    Going right costs 0.1, the last step right earns 1, staying earns nothing: termination depends on the action.
    """
    transitions, rewards = np.zeros((2, n + 1, 2, n + 1))
    for state in range(n):
        for action, success in ((0, slip), (1, 1 - slip)):  # probability of going right
            transitions[state, action, state + 1] = success
            transitions[state, action, state] = 1 - success
            rewards[state, action] = -0.1 * action
            rewards[state, action, state + 1] += float(state == n - 1)
    transitions[n, :, n] = 1.0
    return MDP(transitions, rewards, np.eye(n + 1)[0], np.arange(n + 1) == n)


def random_mdp(n_states: int = 6, n_actions: int = 3, *, n_terminal: int = 1, reach: int = 3, seed: int = 0) -> MDP:
    """Return a random process: each action leads to `reach` states (terminal ones among them), rewards are normal."""
    rng = np.random.default_rng(seed)
    transitions = np.zeros((n_states, n_actions, n_states))
    for state in range(n_states):
        for action in range(n_actions):
            to = rng.choice(n_states, size=reach, replace=False)
            transitions[state, action, to] = rng.dirichlet(np.ones(reach))
    terminal = np.arange(n_states) >= n_states - n_terminal
    transitions[terminal] = np.eye(n_states)[terminal][:, None]
    rewards = rng.normal(size=(n_states, n_actions, n_states))
    rewards[terminal] = 0.0
    initial = np.where(terminal, 0.0, rng.random(n_states) + 0.1)
    return MDP(transitions, rewards, initial / initial.sum(), terminal)


def random_policy(mdp: MDP, *, concentration: float = 1.0, seed: int = 0) -> FloatArray:
    """Return a random table (S, A); a higher concentration is closer to uniform."""
    rng = np.random.default_rng(seed)
    return rng.dirichlet(np.full(mdp.n_actions, concentration), size=mdp.n_states)


def mix(first: FloatArray, second: FloatArray, share: float) -> FloatArray:
    """Return the table that follows `first` with probability `share` at each step."""
    return share * first + (1 - share) * second


# --- exact values ----------------------------------------------------------------------------------------------------


def state_values(mdp: MDP, policy: FloatArray, gamma: float, horizon: int | None = None) -> FloatArray:
    """Return V (S,): of terminal states zero. Linear solve without end, backward recursion over `horizon` steps."""
    rewards = (policy * mdp.expected_rewards).sum(axis=1) * ~mdp.terminal
    step = np.einsum("sa,sat->st", policy, mdp.continuing) * ~mdp.terminal[:, None]
    if horizon is None:
        return np.linalg.solve(np.eye(mdp.n_states) - gamma * step, rewards)
    values = np.zeros(mdp.n_states)
    for _ in range(horizon):
        values = rewards + gamma * step @ values
    return values


def action_values(mdp: MDP, policy: FloatArray, gamma: float, horizon: int | None = None) -> FloatArray:
    """Return Q (S, A) with `horizon` steps to go (without end where None); of terminal states zero."""
    after = state_values(mdp, policy, gamma, None if horizon is None else horizon - 1)
    values = mdp.expected_rewards + gamma * mdp.continuing @ after
    return np.where(mdp.terminal[:, None], 0.0, values)


def value(mdp: MDP, policy: FloatArray, gamma: float, horizon: int | None = None) -> float:
    """Return the expected discounted return from the initial states."""
    return float(mdp.initial @ state_values(mdp, policy, gamma, horizon))


def occupancy(mdp: MDP, policy: FloatArray, gamma: float, horizon: int | None = None) -> FloatArray:
    """Return (S, A) expected discounted visits, sum_t gamma^t P(s_t = s, a_t = a, not ended); `value` is its product
    with the expected rewards. Terminal states have none."""
    step = np.einsum("sa,sat->st", policy, mdp.continuing)
    if horizon is None:
        visits = np.linalg.solve((np.eye(mdp.n_states) - gamma * step).T, mdp.initial)
    else:
        now, visits = mdp.initial, np.zeros(mdp.n_states)
        for t in range(horizon):
            visits, now = visits + gamma**t * now, now @ step
    return visits[:, None] * policy * ~mdp.terminal[:, None]


# --- logs and problems -----------------------------------------------------------------------------------------------


def sample_logs(
    mdp: MDP, policy: FloatArray, n: int, length: int | npt.NDArray[np.int64], rng: np.random.Generator
) -> Logs:
    """Draw n episodes under a table; one that is not terminal after `length` (or its own (n,) length) is truncated."""
    limits = np.broadcast_to(np.asarray(length, dtype=np.int64), (n,))
    total = int(limits.max())
    states = np.zeros((n, total + 1), dtype=np.int64)
    actions, rewards = np.zeros((n, total), dtype=np.int64), np.zeros((n, total))
    states[:, 0] = draw(np.broadcast_to(mdp.initial, (n, mdp.n_states)), rng)
    lengths, ended = limits.copy(), np.zeros(n, dtype=bool)
    for t in range(total):
        if (ended | (t >= limits)).all():
            break
        now = states[:, t]
        actions[:, t] = draw(policy[now], rng)
        states[:, t + 1] = draw(mdp.transitions[now, actions[:, t]], rng)
        alive = ~ended & (t < limits)
        rewards[:, t] = np.where(alive, mdp.rewards[now, actions[:, t], states[:, t + 1]], 0.0)
        ends = alive & mdp.terminal[states[:, t + 1]]
        lengths[ends], ended = t + 1, ended | ends
    return Logs(states, actions, rewards, lengths, ended)


def logged(logs: Logs, mdp: MDP, *, features: FloatArray | None = None) -> Logged:
    """Return logs as `Logged`, every episode real; observations are `Discrete(S)`, or rows of `features` (S, D)."""
    space = spaces.Discrete(mdp.n_states) if features is None else spaces.Box(-np.inf, np.inf, features.shape[1:])
    mask, n = logs.mask, len(logs)
    last = np.arange(mask.shape[1]) == logs.lengths[:, None] - 1

    def observed(states: npt.NDArray[np.int64]) -> npt.NDArray[np.generic]:
        return states[mask] if features is None else features[states[mask]]

    steps = Transitions(
        observations=observed(logs.states[:, :-1]),
        actions=logs.actions[mask],
        rewards=logs.rewards[mask],
        next_observations=observed(logs.states[:, 1:]),
        terminated=(last & logs.terminated[:, None])[mask],
        truncated=(last & ~logs.terminated[:, None])[mask],
        episode=np.repeat(np.arange(n), logs.lengths),
        step=np.broadcast_to(np.arange(mask.shape[1]), mask.shape)[mask],
        synthetic=np.zeros(int(mask.sum()), dtype=bool),
    )
    return Logged(
        steps=steps,
        flat_observations=FlatSpace.of(space, "observation space"),
        flat_actions=FlatSpace.of(spaces.Discrete(mdp.n_actions), "action space"),
        offsets=np.concatenate(([0], np.cumsum(logs.lengths))).astype(np.int64),
        unit=np.arange(n),
        synthetic=np.zeros(n, dtype=bool),
    )


def problem(
    logs: Logs,
    mdp: MDP,
    policies: Sequence[FloatArray],
    behavior: FloatArray | Callable[[int], FloatArray],
    *,
    gamma: float,
    horizon: int | None = None,
    n_resamples: int = 50,
    features: FloatArray | None = None,
    initial: npt.NDArray[np.int64] | None = None,
    use_augmented: frozenset[Part] = frozenset(),
    seed: int = 0,
) -> Problem:
    """Return a problem in memory: tables as policies, a table (or a function of the seed) as the behaviour policy.

    `initial` are state numbers that the user gives; by default the first states of the episodes.
    """
    data = logged(logs, mdp, features=features)
    steps, n = data.steps, len(logs)
    if callable(behavior):
        log_beta = behavior
    else:
        known = Table(behavior, features).log_prob(steps.observations, steps.actions)

        def log_beta(seed: int) -> FloatArray:
            return known

    first = logs.states[:, 0] if initial is None else np.asarray(initial)
    return Problem(
        data=data,
        policies=PolicySet.of([Table(table, features) for table in policies]),
        gamma=gamma,
        horizon=horizon,
        initial=first if features is None else features[first],
        initial_unit=np.arange(n) if initial is None else None,
        behavior=log_beta,
        resamples=np.random.default_rng(seed).multinomial(n, np.full(n, 1 / n), size=n_resamples).astype(np.float64),
        use_augmented=use_augmented,
    )


def buffers(logs: Logs) -> list[EpisodeBuffer]:
    """Return logs as Minari episodes (`Discrete` spaces); `tests.conftest.install_dataset` stores them."""
    episodes: list[EpisodeBuffer] = []
    for i, length in enumerate(logs.lengths):
        last = np.arange(length) == length - 1
        episodes.append(
            EpisodeBuffer(
                observations=logs.states[i, : length + 1],
                actions=logs.actions[i, :length],
                rewards=logs.rewards[i, :length],
                terminations=last & logs.terminated[i],
                truncations=last & ~logs.terminated[i],
            )
        )
    return episodes
