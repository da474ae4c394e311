"""DICE: values from the ratio of a policy's discounted state-action occupancy to that of the data."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Literal, get_args

import numpy as np
import numpy.typing as npt

from oat_gym.episodes import IntArray
from oat_gym.errors import ConfigurationError, EstimationWarning
from oat_gym.ope._dice_data import counted
from oat_gym.ope._dice_tabular import tabular_ratios
from oat_gym.ope._dice_training import Objective, train_ratios
from oat_gym.ope._dice_value import ratio_diagnostics, ratio_values, time_alive
from oat_gym.ope._fqe_fits import is_tabular
from oat_gym.ope._q_data import QData
from oat_gym.ope._q_function import value_scale
from oat_gym.ope._q_tabular import MAX_UNSUPPORTED, UNSUPPORTED
from oat_gym.ope.estimator import Diagnostics, Estimates, Estimator
from oat_gym.ope.problem import Problem

FloatArray = npt.NDArray[np.float64]
Approximation = Literal["auto", "network", "tabular"]
Preset = Literal["bestdice", "dualdice", "gendice"]
Flags = tuple[float, float, bool, bool, bool]
PRESETS: dict[Preset, Flags] = {
    "bestdice": (0.0, 1.0, False, True, True),
    "dualdice": (0.0, 1.0, True, False, False),
    "gendice": (1.0, 0.0, True, True, True),
}
"""primal, dual, zero_reward, normalise and positive of each preset."""
TITLES: dict[Preset, str] = {"bestdice": "BestDICE", "dualdice": "DualDICE", "gendice": "GenDICE"}
MIN_EFFECTIVE = 10.0
"""Effective numbers of steps under this are warned of."""
MAX_LATE_CHANGE = 0.05
"""Largest change over the second half of the updates, of the value or of a twentieth of the rewards' range."""


@dataclass(frozen=True)
class DICE(Estimator):
    """Stationary distribution correction, self-normalised: the rewards of single steps, weighted by zeta = d_pi / d_D.

    Restarts make episodes that end fit the theory. Let tau be the probability that a step of the policy's discounted
    occupancy d is the last of its episode: it terminates, or is the H-th of a horizon of H steps (the number of
    remaining steps is then part of the state, and data beyond the horizon is left out). If after such a step the next
    one is (s0, a0), s0 an initial state and a0 ~ pi, the occupancy of the alive steps, normalised to one, satisfies

        d = (1 - gamma) mu0 pi + gamma P_restart' d

    since its flow equation has the sources mu0 pi / M and M = 1 + gamma M (1 - tau), so that 1 / M = (1 - gamma) +
    gamma tau, the second part being what restarts add. Hence E_D[zeta] = 1 whether or not episodes end, for gamma = 1
    too, and with M = 1 / (1 - gamma + gamma tau) steps alive, V = M E_D[zeta r] / E_D[zeta] and tau = E_D[zeta done] /
    E_D[zeta]. Where no step terminates, M is known and taken as it is. Truncated steps are ordinary ones.

    Forms (`approximation`):

    - "network": two ReLU perceptrons, nu and zeta, of z-scored (s, a) (a head for each discrete action), with
      simultaneous gradient descent and ascent on the regularised Lagrangian (Yang et al., 2020, equation 12), averages
      being over the data:

          min over nu and lambda, max over zeta, of (1 - gamma) E[nu(s0, a0)] + lambda + primal E[nu^2] / 2
            + E[zeta (r + gamma nu(s', a') - nu(s, a) - lambda)] - dual E[zeta^2] / 2

      `zero_reward` drops r, `normalise` keeps lambda. Rewards are z-scored (a constant moves no ratio, since the
      restarted process never ends). zeta is the mean of ten looks in the second half of the updates, which damps the
      rotation around a saddle point.
    - "tabular": discrete states and actions. The flow equations of the empirical model, solved exactly: all presets
      agree. With a horizon zeta(s, a) is of all H steps together, and data beyond it helps to estimate the model.
      Pairs that the data does not hold are treated as in tabular `FQE`.
    - "auto": tabular where that is possible, else network.

    The ratios are to the steps that they are trained on, and those steps are averaged: both are the part "training" of
    `use_augmented`, and "weights" has no meaning here. (Ratios to real and synthetic steps together, averaged over the
    real ones, would be biased wherever the synthetic ones are distributed in another way.)

    Intervals resample the source episodes with zeta held fixed, which hides the error of training (diagnostic
    `interval_covers_training` is 0).

    Diagnostics: `mean_ratio` (before normalisation), `effective_sample_size` (Kish, in steps), `largest_weight` (share
    of one step), `time_alive` (M), `interval_covers_training`; of networks `late_change` (of the value, from the third
    to the last quarter of the updates), of tables `unsupported_mass`. An `EstimationWarning` names the policies whose
    value is not to be trusted.

    Args:
        approximation: see above.
        primal: weight of E[nu^2] / 2.
        dual: weight of E[zeta^2] / 2.
        zero_reward: leave the reward out of the Lagrangian; the ratios do not depend on it, training does.
        normalise: constrain E[zeta] = 1 by lambda.
        positive: zeta is a softplus (the original squares), else any number.
        hidden: units of the hidden layers.
        updates: gradient steps; the original takes 100,000 with batches of 2,048.
        batch_size: transitions of a minibatch.
        nu_rate: learning rate of Adam for nu and lambda.
        zeta_rate: learning rate of Adam for zeta.
        action_draws: actions kept for a next state, of stochastic policies without known probabilities.

    >>> DICE().name, DICE.preset("gendice").name, DICE(dual=0.5, approximation="network").name
    ('DICE BestDICE', 'DICE GenDICE', 'DICE network')
    """

    approximation: Approximation = "auto"
    primal: float = 0.0
    dual: float = 1.0
    zero_reward: bool = False
    normalise: bool = True
    positive: bool = True
    hidden: tuple[int, ...] = (64, 64)
    updates: int = 10_000
    batch_size: int = 256
    nu_rate: float = 3e-4
    zeta_rate: float = 3e-3
    action_draws: int = 4
    family: ClassVar[str] = "DICE"

    def __post_init__(self) -> None:
        if self.approximation not in get_args(Approximation):
            names = ", ".join(get_args(Approximation))
            raise ConfigurationError(f"approximation must be one of {names}, got {self.approximation!r}.")
        if not self.primal >= 0 or not self.dual >= 0 or not self.primal + self.dual > 0:
            raise ConfigurationError(
                f"primal and dual must not be negative, and one positive, got {self.primal!r} and {self.dual!r}."
            )
        if not self.hidden or min(self.hidden) < 1:
            raise ConfigurationError(f"hidden must hold one size of at least 1 a layer, got {self.hidden!r}.")
        for name in ("updates", "batch_size", "action_draws"):
            if getattr(self, name) < 1:
                raise ConfigurationError(f"{name} must be at least 1, got {getattr(self, name)!r}.")
        if not self.nu_rate > 0 or not self.zeta_rate > 0:
            raise ConfigurationError(
                f"nu_rate and zeta_rate must be positive, got {self.nu_rate!r} and {self.zeta_rate!r}."
            )

    @classmethod
    def preset(cls, name: Preset, *, original: bool = False) -> DICE:
        """Return the flags of a published method, as Yang et al. (2020, section 4) place it in the family.

        "dualdice" (Nachum et al., 2019), "gendice" (Zhang et al., 2020), "bestdice" (Yang et al., 2020; the default).
        GenDICE, which regularises nu and not zeta, gets equal learning rates of 1e-3; the others settle with a nu that
        is ten times slower than zeta.

        Args:
            name: the method.
            original: also the size of the original's training: 100,000 updates of batches of 2,048 at learning rates
                of 1e-4 (hours on a CPU).
        """
        if name not in PRESETS:
            raise ConfigurationError(f"DICE has the presets {', '.join(PRESETS)}, got {name!r}.")
        primal, dual, zero_reward, normalise, positive = PRESETS[name]
        chosen = cls(primal=primal, dual=dual, zero_reward=zero_reward, normalise=normalise, positive=positive)
        if original:
            return replace(chosen, updates=100_000, batch_size=2_048, nu_rate=1e-4, zeta_rate=1e-4, action_draws=1)
        return replace(chosen, nu_rate=1e-3, zeta_rate=1e-3) if name == "gendice" else chosen

    @property
    def name(self) -> str:
        """The family, the preset whose flags these are (if any), and the form where it is chosen."""
        flags = (self.primal, self.dual, self.zero_reward, self.normalise, self.positive)
        parts = ["DICE", *(TITLES[preset] for preset, own in PRESETS.items() if own == flags)]
        return " ".join(parts + ([] if self.approximation == "auto" else [self.approximation]))

    def form(self, problem: Problem) -> Literal["network", "tabular"]:
        """Return the form that "auto" stands for."""
        if self.approximation == "auto":
            return "tabular" if is_tabular(problem) else "network"
        return self.approximation

    def check(self, problem: Problem) -> None:
        """Raise `ConfigurationError` where the chosen form cannot be fitted."""
        form = self.form(problem)
        if form == "tabular" and not is_tabular(problem):
            raise ConfigurationError(
                "approximation='tabular' needs Discrete observations and actions and policies with `probabilities`: "
                "use 'network', or ope.TabularPolicy."
            )
        if form == "network" and problem.gamma == 1.0 and not self.normalise:
            raise ConfigurationError("With gamma=1 the ratios are known up to a factor: use normalise=True.")

    def estimate(self, problem: Problem, *, seeds: tuple[int, ...]) -> tuple[Estimates, ...]:
        """Return the estimates of each seed; tables do not depend on it.

        Raises:
            ConfigurationError: where the chosen form cannot be fitted.
            InvalidDataError: where there is no step to weight, or ratios have no solution.
            TrainingError: where training diverges.
        """
        self.check(problem)
        if self.form(problem) == "tabular":
            found = (self._tabular(problem),) * len(seeds)
        else:
            found = self._network(problem, seeds)
        _warn(problem, found, self.name)
        return found

    def _tabular(self, problem: Problem) -> Estimates:
        data, flat = QData.of(problem), problem.data.flat_observations
        table = problem.policy_probabilities(flat.unflatten(np.eye(flat.layout.width)))
        if table is None:
            raise ConfigurationError("approximation='tabular' needs policies with `probabilities`.")
        ratios = tabular_ratios(problem, data, table)
        values, replicates = ratio_values(problem, ratios.zeta, data.rows, mass=ratios.mass)
        values, replicates = (np.where(ratios.mass[:, None] > 0, x, 0.0) for x in (values[:, None], replicates))
        extra = [
            {"time_alive": float(m), "unsupported_mass": float(u)}
            for m, u in zip(ratios.mass, ratios.unsupported, strict=True)
        ]
        return Estimates(values[:, 0], replicates, _merged(ratio_diagnostics(ratios.zeta), extra))

    def _network(self, problem: Problem, seeds: Sequence[int]) -> tuple[Estimates, ...]:
        rows = counted(problem, problem.rows("training"))
        objective = Objective(
            primal=self.primal,
            dual=self.dual,
            reward=not self.zero_reward,
            normalise=self.normalise,
            positive=self.positive,
            hidden=self.hidden,
            updates=self.updates,
            batch_size=self.batch_size,
            nu_rate=self.nu_rate,
            zeta_rate=self.zeta_rate,
            action_draws=self.action_draws,
        )
        trained = train_ratios(problem, objective, rows, seeds=seeds, name=self.name)
        halves = zip(trained.earlier, trained.later, strict=True)
        return tuple(_network_estimates(problem, earlier, later, rows) for earlier, later in halves)


def _network_estimates(problem: Problem, earlier: FloatArray, later: FloatArray, rows: IntArray) -> Estimates:
    """Return one seed's estimates from the ratios (P, n) of the earlier and later looks."""
    never_ends = not problem.data.steps.terminated[problem.rows("training")].any()
    mass = np.full(len(later), value_scale(problem)) if never_ends else None
    zeta = (earlier + later) / 2
    values, replicates = ratio_values(problem, zeta, rows, mass=mass)
    before, after = (ratio_values(problem, part, rows, mass=mass)[0] for part in (earlier, later))
    done = time_alive(problem, zeta, rows) if mass is None else mass
    extra = [
        {"time_alive": float(m), "late_change": float(change)} for m, change in zip(done, after - before, strict=True)
    ]
    return Estimates(values, replicates, _merged(ratio_diagnostics(zeta), extra))


def _merged(ratios: list[Diagnostics], extra: Sequence[Diagnostics]) -> tuple[Diagnostics, ...]:
    covers = {"interval_covers_training": 0.0}
    return tuple({**own, **more, **covers} for own, more in zip(ratios, extra, strict=True))


def _warn(problem: Problem, found: Sequence[Estimates], name: str) -> None:
    """Warn of values that are not to be trusted, one warning for each reason."""
    rewards = problem.data.steps.rewards[problem.rows("training")]
    width, reasons = float(np.ptp(rewards)), dict[str, set[str]]()

    def note(reason: str, policy: str) -> None:
        reasons.setdefault(reason, set()).add(policy)

    for estimates in found:
        for policy, value, own in zip(problem.policies.names, estimates.values, estimates.diagnostics, strict=True):
            least = width * own["time_alive"] / 20
            if own.get("unsupported_mass", 0.0) > MAX_UNSUPPORTED:
                note(UNSUPPORTED, policy)
            if abs(own.get("late_change", 0.0)) > MAX_LATE_CHANGE * max(abs(value), least) > 0:
                note("still changed in the second half of the updates (late_change): give more updates", policy)
            if own["effective_sample_size"] < MIN_EFFECTIVE:
                note(f"rests on an effective sample size of less than {MIN_EFFECTIVE:g} steps", policy)
            if not 0.5 <= own["mean_ratio"] <= 2.0:
                note("comes from ratios whose mean is far from 1 (mean_ratio): training has not converged", policy)
    for reason, policies in reasons.items():
        chosen = ", ".join(p for p in problem.policies.names if p in policies)
        warnings.warn(f"{name}: the value of {chosen} {reason}.", EstimationWarning, stacklevel=4)
