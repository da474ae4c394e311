"""From ratios of occupancies to values: the self-normalised average of rewards, times the discounted time alive."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from oat_gym.episodes import IntArray
from oat_gym.ope._dice_data import ends
from oat_gym.ope.estimator import Diagnostics
from oat_gym.ope.problem import Problem

FloatArray = npt.NDArray[np.float64]


def ratio_values(
    problem: Problem, zeta: FloatArray, rows: IntArray, *, mass: FloatArray | None
) -> tuple[FloatArray, FloatArray]:
    """Return values (P,) and replicates (P, B) with the ratios held fixed.

    V = M E[zeta r] / E[zeta]. The discounted time alive M is `mass`, or 1 / (1 - gamma + gamma tau) with
    tau = E[zeta done] / E[zeta], the share of steps after which the process restarts.

    Args:
        problem: gives rewards, ends and resamples.
        zeta: (P, n) ratios of the n rows.
        rows: (n,) rows of the data.
        mass: (P,) M where it is known.
    """
    unit = problem.data.unit[problem.data.steps.episode[rows]]
    rewards, done = problem.data.steps.rewards[rows].astype(np.float64), ends(problem, rows)
    size = problem.resamples.shape[1]
    values, replicates = np.empty(len(zeta)), np.empty((len(zeta), len(problem.resamples)))
    for p, ratio in enumerate(zeta):
        each = np.stack([np.bincount(unit, ratio * x, minlength=size) for x in (rewards, np.ones(len(rows)), done)])
        known = None if mass is None else float(mass[p])
        values[p] = _value(each.sum(axis=1), problem.gamma, known)
        replicates[p] = _value(each @ problem.resamples.T, problem.gamma, known)
    return values, replicates


def time_alive(problem: Problem, zeta: FloatArray, rows: IntArray) -> FloatArray:
    """Return M = 1 / (1 - gamma + gamma tau), (P,), the expected discounted number of steps, from the ratios (P, n)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        tau = zeta @ ends(problem, rows) / zeta.sum(axis=1)
        return 1.0 / (1.0 - problem.gamma + problem.gamma * tau)


def _value(sums: FloatArray, gamma: float, mass: float | None) -> FloatArray:
    """Return values from sums (3, ...) of zeta r, zeta and zeta done; not finite where the weights sum to zero."""
    earned, weight, done = sums
    with np.errstate(divide="ignore", invalid="ignore"):
        if mass is not None:
            return mass * earned / weight
        return earned / ((1.0 - gamma) * weight + gamma * done)


def ratio_diagnostics(zeta: FloatArray) -> list[Diagnostics]:
    """Return for each policy the mean ratio, Kish's effective number of steps, and the largest share of one step."""
    found: list[Diagnostics] = []
    for ratio in zeta:
        total, squares = float(ratio.sum()), float(np.square(ratio).sum())
        size = total**2 / squares if squares else 0.0
        largest = float(np.abs(ratio).max() / abs(total)) if total else float("nan")
        found.append({"mean_ratio": float(ratio.mean()), "effective_sample_size": size, "largest_weight": largest})
    return found
