"""Fitted Q evaluation: the policies' action values, from the Bellman equation on logged transitions."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal, get_args

import numpy as np

from oat_gym.errors import ConfigurationError, EstimationWarning
from oat_gym.ope._fqe_fits import NEEDS_TABLES, NetworkForm, fit_linear, fit_network, fit_tabular, is_tabular
from oat_gym.ope._fqe_training import Settings
from oat_gym.ope._q_data import QData, RewardScale
from oat_gym.ope._q_function import FittedQ, value_scale
from oat_gym.ope._q_tabular import MAX_UNSUPPORTED, UNSUPPORTED
from oat_gym.ope.estimator import Diagnostics, Estimates, Estimator
from oat_gym.ope.problem import Problem

Approximation = Literal["auto", "network", "tabular", "linear"]
MAX_CLIPPED = 0.1
"""Largest share of clipped targets that passes without a warning."""
MAX_LATE_CHANGE = 0.05
"""Largest change still to be expected, of the value or of a twentieth of the bounds' width."""


@dataclass(frozen=True)
class FQE(Estimator):
    """Fitted Q evaluation with squared loss (Le, Voloshin and Yue, 2019), for all policies, members and seeds at once.

    Q(s, a) is fitted to r + gamma E_{a'~pi} Q(s', a'), without the second term where s' is terminal (a truncated
    step keeps it); the estimate is the mean of E_{a~pi} Q(s0, a) over the initial states. With a horizon H the
    action values depend on the number h of remaining steps, Q_h = r + gamma E Q_{h-1} and Q_0 = 0, and the estimate is
    that of Q_H: fixed-horizon temporal differences (De Asis et al., 2020), which count exactly H rewards.

    Forms (`approximation`):

    - "network": a ReLU perceptron of z-scored (s, a), with a head for each discrete action. Its output u is a weighted
      mean of z-scored rewards: Q = u times the sum of discounts of the remaining steps (1 / (1 - gamma) without a
      horizon). With a horizon h is one more input, drawn uniformly from 1..H for each row of a minibatch; its target
      is (r + gamma c_{h-1} u_{h-1}) / c_h, of one size for all h. Targets are clipped to what the data's rewards
      allow. The target network follows by `tau` at each update and gives the estimate.
    - "tabular": discrete states and actions. The exact solution for the empirical model. In a state where the data
      does not hold all that a policy does, the policy is kept to the actions that it holds, their probabilities scaled
      up; where it holds none of them, the policy acts there as the data does (`unsupported_mass` says how often).
    - "linear": LSTD-Q in closed form on features of (s, a) (`degree`), with a block for each discrete action; with
      a horizon one least-squares fit for each h.
    - "auto": tabular where that is possible, else network.

    E_{a'~pi} is exact for discrete actions of known probabilities. A deterministic policy needs one action; of other
    policies `action_draws` are drawn for each next state, kept, and picked from at random (linear: averaged).

    Intervals: `bootstrap=False` resamples the initial states only, given the fit, which hides most of the error
    (diagnostic `interval_covers_training` is 0). `bootstrap=True` fits on resamples of the source episodes: all of
    them in closed form; network member m on resample m, and replicate b takes member b modulo the ensemble on the
    initial states of resample b.

    Diagnostics: `interval_covers_training`; of networks `td_error` (root mean square, last tenth of the updates,
    environment units), `share_clipped` (of targets, last tenth), `late_change` (of the value, last tenth of the
    updates), `ensemble_sd`; of tables `unsupported_mass`, the discounted probability of coming to a pair that the
    data does not hold. An `EstimationWarning` names the policies whose value has not settled, sits at the bounds or
    outside them, or is unsupported.

    Args:
        approximation: see above.
        hidden: units of the hidden layers.
        updates: gradient steps.
        batch_size: transitions of a minibatch.
        learning_rate: of AdamW.
        tau: share by which the target network moves at each update.
        weight_decay: share by which weights shrink at each update (of the update, not times the learning rate).
        ensemble: networks for each policy and seed; the estimate is their mean.
        bootstrap: see Intervals.
        action_draws: actions kept for a next state, see above.
        degree: 1 or 2, of the linear form's features.
        ridge: of the linear form, times the number of rows; 0: least-norm solution.

    >>> FQE().name, FQE(approximation="network", ensemble=5).name
    ('FQE', 'FQE network x5')
    """

    approximation: Approximation = "auto"
    hidden: tuple[int, ...] = (256, 256)
    updates: int = 15_000
    batch_size: int = 256
    learning_rate: float = 1e-3
    tau: float = 0.01
    weight_decay: float = 0.0
    ensemble: int = 1
    bootstrap: bool = False
    action_draws: int = 4
    degree: Literal[1, 2] = 1
    ridge: float = 1e-6
    family: ClassVar[str] = "FQE"

    def __post_init__(self) -> None:
        if self.approximation not in get_args(Approximation):
            names = ", ".join(get_args(Approximation))
            raise ConfigurationError(f"approximation must be one of {names}, got {self.approximation!r}.")
        if not self.hidden or min(self.hidden) < 1:
            raise ConfigurationError(f"hidden must hold one size of at least 1 a layer, got {self.hidden!r}.")
        for name in ("updates", "batch_size", "ensemble", "action_draws"):
            if getattr(self, name) < 1:
                raise ConfigurationError(f"{name} must be at least 1, got {getattr(self, name)!r}.")
        if not self.learning_rate > 0 or not 0 < self.tau <= 1 or not 0 <= self.weight_decay < 1:
            raise ConfigurationError(
                "learning_rate must be positive, tau in (0, 1] and weight_decay in [0, 1), got "
                f"{self.learning_rate!r}, {self.tau!r} and {self.weight_decay!r}."
            )
        if self.degree not in (1, 2) or not self.ridge >= 0:
            raise ConfigurationError(
                f"degree must be 1 or 2 and ridge not negative, got {self.degree!r} and {self.ridge!r}."
            )

    @classmethod
    def preset(cls, name: Literal["dope"]) -> FQE:
        """Return the settings of the DOPE benchmark's FQE-L2: a million updates, of hours on a CPU.

        Two things differ from its code: the bounds of targets hold 0 where episodes terminate (its bounds force a
        reward of 1 a step to be worth 1 / (1 - gamma) however soon the episode ends), and Adam's epsilon suits u.
        """
        if name != "dope":
            raise ConfigurationError(f"FQE has the preset 'dope', got {name!r}.")
        return cls(
            approximation="network", updates=1_000_000, learning_rate=3e-4, tau=0.005, weight_decay=1e-5, action_draws=1
        )

    @property
    def name(self) -> str:
        """The family, the form where it is chosen, the size of an ensemble, and whether it is bootstrapped."""
        parts = ["FQE"]
        parts += [] if self.approximation == "auto" else [self.approximation]
        parts += [f"x{self.ensemble}"] if self.ensemble > 1 else []
        return " ".join(parts + (["bootstrap"] if self.bootstrap else []))

    def form(self, problem: Problem) -> Literal["network", "tabular", "linear"]:
        """Return the form that "auto" stands for."""
        if self.approximation == "auto":
            return "tabular" if is_tabular(problem) else "network"
        return self.approximation

    def check(self, problem: Problem) -> None:
        """Raise `ConfigurationError` where the chosen form cannot be fitted."""
        form = self.form(problem)
        if form == "tabular" and not is_tabular(problem):
            raise ConfigurationError(NEEDS_TABLES)
        if form == "network" and self.bootstrap and not 2 <= self.ensemble <= len(problem.resamples):
            raise ConfigurationError(
                "bootstrap=True trains each member on its own resample: ensemble must be 2 to "
                f"{len(problem.resamples)}, the number of resamples, got {self.ensemble}."
            )

    def estimate(self, problem: Problem, *, seeds: tuple[int, ...]) -> tuple[Estimates, ...]:
        """Return the estimates of each seed; closed forms do not depend on it where expectations are exact."""
        return tuple(Estimates(f.values, f.replicates, f.diagnostics) for f in self.fit_q(problem, seeds=seeds))

    def fit_q(self, problem: Problem, *, seeds: Sequence[int]) -> tuple[FittedQ, ...]:
        """Return the action values of each seed, with their estimates, replicates and diagnostics.

        A problem is fitted once: doubly robust estimation in the same evaluation uses the same fits.

        Raises:
            ConfigurationError: where the chosen form cannot be fitted.
            InvalidDataError: where values have no solution.
            TrainingError: where training diverges.
        """
        self.check(problem)
        missing = [seed for seed in seeds if (self, seed) not in problem.shared]
        for seed, fit in zip(missing, self._fit(problem, missing), strict=True):
            problem.shared[self, seed] = fit
        fits: tuple[FittedQ, ...] = tuple(problem.shared[self, seed] for seed in seeds)
        _warn(problem, fits, self)
        return fits

    def _fit(self, problem: Problem, seeds: Sequence[int]) -> tuple[FittedQ, ...]:
        form = self.form(problem)
        if not seeds:
            return ()
        if form == "tabular":
            return (fit_tabular(problem, bootstrap=self.bootstrap),) * len(seeds)
        if form == "linear":
            return tuple(self._linear(problem, seed) for seed in seeds)
        return self._network(problem, seeds)

    def _network(self, problem: Problem, seeds: Sequence[int]) -> tuple[FittedQ, ...]:
        settings = Settings(self.updates, self.learning_rate, self.tau, self.weight_decay)
        form = NetworkForm(
            settings, self.hidden, self.batch_size, self.ensemble, self.bootstrap, self.action_draws, self.name
        )
        return fit_network(problem, form, seeds=seeds)

    def _linear(self, problem: Problem, seed: int) -> FittedQ:
        return fit_linear(
            problem,
            degree=self.degree,
            ridge=self.ridge,
            bootstrap=self.bootstrap,
            action_draws=self.action_draws,
            seed=seed,
        )


def _warn(problem: Problem, fits: Sequence[FittedQ], fqe: FQE) -> None:
    """Warn of values that are not to be trusted, one warning for each reason."""
    reasons: dict[str, list[str]] = {}
    # tables have no bounds: they are exact, and with gamma = 1 there may be none
    tables = "unsupported_mass" in fits[0].diagnostics[0]
    bounds = (-np.inf, np.inf) if tables else RewardScale.of(QData.of(problem)).bounds(problem)
    for fit in fits:
        for policy, value, numbers in zip(problem.policies.names, fit.values, fit.diagnostics, strict=True):
            for reason in _reasons(problem, fqe, value, numbers, bounds=bounds):
                reasons.setdefault(reason, []).append(policy)
    for reason, policies in reasons.items():
        chosen = ", ".join(p for p in problem.policies.names if p in policies)
        warnings.warn(f"{fqe.name}: the value of {chosen} {reason}.", EstimationWarning, stacklevel=4)


def _reasons(
    problem: Problem, fqe: FQE, value: float, numbers: Diagnostics, *, bounds: tuple[float, float]
) -> list[str]:
    """Return what speaks against a value."""
    (low, high), found = bounds, list[str]()
    if numbers.get("unsupported_mass", 0.0) > MAX_UNSUPPORTED:
        found.append(UNSUPPORTED)
    if "late_change" in numbers:
        # The value comes nearer by 1/e in about (sum of discounts) / tau updates, each backup taking 1 / tau.
        ahead = max(1.0, 10 * value_scale(problem) / (fqe.tau * fqe.updates))
        if abs(numbers["late_change"]) * ahead > MAX_LATE_CHANGE * max(abs(value), (high - low) / 20) > 0:
            found.append("has not settled (late_change): give more updates, or a larger tau")
    if high > low and not low <= value <= high:
        found.append(f"lies outside what the data's rewards allow, {low:.6g} to {high:.6g}")
    elif high > low and numbers.get("share_clipped", 0.0) > MAX_CLIPPED:
        found.append(f"is at the bounds that the data's rewards allow, {low:.6g} to {high:.6g}")
    return found
