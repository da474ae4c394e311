"""Logs of two small decision processes with known values, and the problems that `check_estimator` poses with them."""

from __future__ import annotations

from dataclasses import replace
from typing import get_args

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from oat_gym.episodes import Transitions
from oat_gym.ope.logged import Logged
from oat_gym.ope.policies import TabularPolicy
from oat_gym.ope.policy import PolicySet
from oat_gym.ope.problem import Part, Problem
from oat_gym.spaces import FlatSpace

FloatArray = npt.NDArray[np.float64]
GAMMA = 0.9
N_EPISODES = 80
BEHAVIOR = TabularPolicy(np.full((3, 2), 0.5))
TARGETS = {
    "behaviour": BEHAVIOR,
    "left": TabularPolicy(np.tile([0.6, 0.4], (3, 1))),
    "right": TabularPolicy(np.tile([0.4, 0.6], (3, 1))),
}
FORWARD = (0.2, 0.8)  # probability that action 0 or 1 leads on
COST, PRIZE = -0.1, 1.0


def corridor_value() -> float:
    """Return the value of the behaviour policy from the corridor's initial states, by the linear equations."""
    on = float(np.mean(FORWARD))
    value = np.zeros(3)
    for state in (1, 0):  # V(s) = r(s) + gamma (on V(s+1) + (1-on) V(s))
        reward = COST / 2 + (PRIZE * on if state == 1 else 0.0)
        value[state] = (reward + GAMMA * on * value[state + 1]) / (1 - GAMMA * (1 - on))
    return float(value[:2].mean())


def corridor(rng: np.random.Generator) -> Logged:
    """Return episodes in two states in a row and a terminal one: action 1 mostly leads on and costs 0.1.

    The last step on earns 1. Every second episode starts in the second state; all terminate.
    """
    rows: list[tuple[int, int, float, int, bool, int, int]] = []
    for episode in range(N_EPISODES):
        state, step = episode % 2, 0
        while state < 2:
            action = int(rng.integers(2))
            after = state + int(rng.random() < FORWARD[action])
            reward = COST * action + (PRIZE if after == 2 else 0.0)
            rows.append((state, action, reward, after, after == 2, episode, step))
            state, step = after, step + 1
    columns = [np.array(column) for column in zip(*rows, strict=True)]
    return logged(*columns)


def loop(length: int, *, terminates: bool, reward: float = 1.0) -> Logged:
    """Return episodes that stay in state 0 for `length` steps of one reward, and end by termination or truncation.

    The state in which they end is state 0 again, so that an estimator which takes it for a state like others, or for
    an end like others, is found out: the value is that of `length` rewards, or of rewards without end.
    """
    n = N_EPISODES * length
    step = np.tile(np.arange(length), N_EPISODES)
    zeros, last = np.zeros(n, dtype=np.int64), step == length - 1
    episode = np.repeat(np.arange(N_EPISODES), length)
    data = logged(zeros, np.arange(n) % 2, np.full(n, reward), zeros, last, episode, step)
    if terminates:
        return data
    return replace(data, steps=replace(data.steps, terminated=np.zeros(n, dtype=bool), truncated=last))


def logged(*columns: npt.NDArray[np.generic]) -> Logged:
    """Return columns (state, action, reward, next state, terminated, episode, step) as real episodes."""
    states, actions, rewards, after, terminated, episode, step = columns
    n_episodes = int(np.asarray(episode, dtype=np.int64).max()) + 1
    lengths = np.bincount(np.asarray(episode, dtype=np.int64))
    steps = Transitions(
        observations=states.astype(np.int64),
        actions=actions.astype(np.int64),
        rewards=rewards.astype(np.float64),
        next_observations=after.astype(np.int64),
        terminated=terminated.astype(bool),
        truncated=np.zeros(len(states), dtype=bool),
        episode=episode.astype(np.int64),
        step=step.astype(np.int64),
        synthetic=np.zeros(len(states), dtype=bool),
    )
    return Logged(
        steps=steps,
        flat_observations=FlatSpace.of(spaces.Discrete(3), "observation space"),
        flat_actions=FlatSpace.of(spaces.Discrete(2), "action space"),
        offsets=np.concatenate(([0], np.cumsum(lengths))).astype(np.int64),
        unit=np.arange(n_episodes),
        synthetic=np.zeros(n_episodes, dtype=bool),
    )


def with_copies(data: Logged, copies: int, *, extra_reward: float = 0.0) -> Logged:
    """Return the data with synthetic copies of every episode, whose rewards are higher by `extra_reward`."""
    n = len(data)
    steps, total = data.steps, len(data.steps)
    new = np.arange(total * (copies + 1)) >= total

    def tile(column: npt.NDArray[np.generic]) -> npt.NDArray[np.generic]:
        return np.tile(column, copies + 1)

    names = ("observations", "actions", "next_observations", "terminated", "truncated", "step")
    columns = {name: tile(getattr(steps, name)) for name in names}
    shift = np.repeat(np.arange(copies + 1) * n, total)
    rewards = np.tile(steps.rewards, copies + 1) + extra_reward * new
    lengths = np.tile(data.lengths, copies + 1)
    return replace(
        data,
        steps=replace(
            steps, **columns, rewards=rewards, episode=np.tile(steps.episode, copies + 1) + shift, synthetic=new
        ),
        offsets=np.concatenate(([0], np.cumsum(lengths))).astype(np.int64),
        unit=np.tile(data.unit, copies + 1),
        synthetic=np.arange(n * (copies + 1)) >= n,
    )


def pose(
    data: Logged, names: tuple[str, ...] = tuple(TARGETS), *, horizon: int | None = None, everywhere: bool = False
) -> Problem:
    """Return the problem of evaluating the named policies; `everywhere`: synthetic episodes in all parts."""
    steps = data.steps
    log_beta = BEHAVIOR.log_prob(steps.observations, steps.actions)
    used = np.ones(len(data), dtype=bool) if everywhere else ~data.synthetic
    n = data.n_units
    counts = np.random.default_rng(0).multinomial(n, np.full(n, 1 / n), size=200)
    return Problem(
        data=data,
        policies=PolicySet.of({name: TARGETS[name] for name in names}),
        gamma=GAMMA,
        horizon=horizon,
        initial=data.initial_observations(used),
        initial_unit=data.unit[used],
        behavior=lambda seed: log_beta.copy(),
        resamples=counts.astype(np.float64),
        use_augmented=frozenset[Part](get_args(Part)) if everywhere else frozenset(),
    )
