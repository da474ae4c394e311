"""Ratios of occupancies for discrete states and actions, exact in the empirical model."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from oat_gym.errors import InvalidDataError
from oat_gym.ope import _q_tabular as tabular
from oat_gym.ope._q_data import QData
from oat_gym.ope.problem import Problem

FloatArray = npt.NDArray[np.float64]


def discounted_visits(
    model: tabular.EmpiricalModel, policy: FloatArray, initial: FloatArray, gamma: float, horizon: int | None
) -> FloatArray:
    """Return d (S, A) = sum_t gamma^t P(s_t = s, a_t = a, not ended).

    It solves the flow equations d(s, a) = pi(a|s) (initial(s) + gamma sum P(s|s', a') d(s', a')); with a horizon it
    is the sum of its first `horizon` terms.

    Args:
        model: the empirical model.
        policy: (S, A) probabilities.
        initial: (S,) probabilities of the initial states.
        gamma: discount.
        horizon: number of steps H, or None.

    Raises:
        InvalidDataError: if there is none (gamma = 1, and the policy never ends).
    """
    chain = gamma * model.chain(policy)
    if horizon is not None:
        visits, now = np.zeros(len(initial)), initial
        for _ in range(horizon):
            visits, now = visits + now, now @ chain
        return visits[:, None] * policy
    matrix = np.eye(len(initial)) - chain.T
    try:
        visits = np.linalg.solve(matrix, initial)
    except np.linalg.LinAlgError:
        visits = np.full_like(initial, np.nan)
    if not np.isfinite(visits).all() or np.abs(matrix @ visits - initial).max() > 1e-6:
        raise InvalidDataError(
            "The ratios have no solution: with gamma = 1 the policy stays for ever in states of the data that never "
            "terminate. Give a horizon, or a gamma below 1."
        )
    return visits[:, None] * policy


class TabularRatios(NamedTuple):
    """What the flow equations give.

    Attributes:
        zeta: (P, n) ratios of the n training rows, of mean 1.
        mass: (P,) discounted time in pairs that these rows hold.
        unsupported: (P,) discounted probability of coming to a pair that they do not hold.
    """

    zeta: FloatArray
    mass: FloatArray
    unsupported: FloatArray


def tabular_ratios(problem: Problem, data: QData, table: FloatArray) -> TabularRatios:
    """Return the ratios of every policy; `table` is (P, S, A)."""
    states, actions, following = (x.argmax(axis=1) for x in (data.states, data.actions, data.next_states))
    shape = (table.shape[1], table.shape[2])
    model = tabular.empirical_model(states, actions, data.rewards, following, data.terminated, shape=shape)
    first = problem.initial_states.argmax(axis=1)
    initial = np.bincount(first, minlength=shape[0]) / len(first)
    pairs, share = states * shape[1] + actions, model.visits.ravel() / len(states)
    zeta, mass, unsupported = np.zeros((len(table), len(pairs))), np.zeros(len(table)), np.zeros(len(table))
    for p, policy in enumerate(table):
        own = tabular.supported_policy(model, policy)
        visits = discounted_visits(model, own, initial, problem.gamma, problem.horizon).ravel()
        mass[p] = visits.sum()
        ratio = np.divide(visits, share * mass[p], out=np.zeros_like(visits), where=(share > 0) & (mass[p] > 0))
        zeta[p] = ratio[pairs]
        unsupported[p] = tabular.unsupported_mass(model, policy, initial, problem.gamma, problem.horizon)
    return TabularRatios(zeta, mass, unsupported)
