"""Model-based estimation: the returns of policies in dynamics models that are learned from the data."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal, get_args

import numpy as np
import numpy.typing as npt

from oat_gym._rng import derive
from oat_gym.episodes import IntArray
from oat_gym.errors import ConfigurationError, EstimationWarning, TrainingError
from oat_gym.ope._fqe_fits import fit_tabular, is_tabular
from oat_gym.ope._model_autoregressive import AutoregressiveModel, fit_autoregressive
from oat_gym.ope._model_data import Moves, split
from oat_gym.ope._model_ensemble import EnsembleModel, fit_ensemble
from oat_gym.ope._model_rollout import DynamicsModel, GivenModel, Limits, RollOuts, roll_out
from oat_gym.ope._model_training import Fitting
from oat_gym.ope._q_function import value_scale
from oat_gym.ope._q_tabular import MAX_UNSUPPORTED, UNSUPPORTED
from oat_gym.ope.estimator import Diagnostics, Estimates, Estimator
from oat_gym.ope.problem import Problem

FloatArray = npt.NDArray[np.float64]
Kind = Literal["auto", "ensemble", "autoregressive", "tabular"]
HELD = 1024
"""Held-out steps that decide when training was best."""
MAX_ERROR = 0.9
"""Held-out error, in parts of that of predicting the mean, that passes without a warning."""
MAX_CLIPPED = 0.25
"""Largest share of steps that leave the data's range without a warning."""
MAX_CUT = 0.01
"""Largest bound of what cut roll-outs miss, in parts of the bound of values, without a warning."""


@dataclass(frozen=True)
class ModelBased(Estimator):
    """Returns of each policy in learned models of the process, from the initial states.

    The models do not depend on the policies: they are fitted once for all, the members and seeds in one computation,
    and keep the weights of the least error on held-out episodes (real ones and what was made from them). States and
    rewards of roll-outs are clipped to the range of the training data. Where episodes terminate, the probability of
    going on is learned, and a roll-out counts for that fraction from then on. Truncations are no ends.

    Forms (`kind`):

    - "ensemble": for each member ReLU networks of (s, a) give the mean state change, the mean reward, and the
      probability of going on, as in the DOPE benchmark. Continuous states then move deterministically (noise that
      matters to the value is missed: use "autoregressive"); discrete state variables are drawn. State changes are
      fitted to the steps after which the episode goes on.
    - "autoregressive" (Zhang et al., 2021): p(s'|s, a) is a product over the state variables of Gaussians (categorical
      distributions), each given (s, a) and the variables before it, and drawn one after another; reward (its mean) and
      continuation are given (s, a, s'). One network for each variable.
    - "tabular": discrete states and actions. The empirical model, solved exactly: the values that a model of counts
      gives by roll-outs without end, and those of tabular FQE, with its rule for pairs that the data does not hold.
    - "auto": tabular where that is possible, else ensemble.

    A roll-out takes the horizon's steps. Without one it ends when gamma^t times the probability of being alive is
    below `tolerance`, or after `max_steps`; what it then misses is at most `truncation_bound`.

    Intervals: `bootstrap=False` resamples the initial states only, given the models (diagnostic
    `interval_covers_training` is 0). `bootstrap=True` trains member m on resample m of the source episodes; replicate b
    takes member b modulo the ensemble on the initial states of resample b.

    Diagnostics: `held_out_state_error`, `held_out_reward_error` (mean squared one-step error over the variance, mean
    over columns: 1 for predicting the mean), `share_clipped` (of steps whose state left the range), `ensemble_sd` (of
    the members' values), `truncation_bound` (environment units), `interval_covers_training`; of tables
    `unsupported_mass`. An `EstimationWarning` names the policies whose value is not to be trusted.

    Args:
        kind: see above.
        hidden: units of the hidden layers.
        updates: gradient steps of each network.
        batch_size: transitions of a minibatch.
        learning_rate: of AdamW at the start; it falls linearly to zero.
        weight_decay: of AdamW.
        ensemble: members; the estimate is their mean.
        bootstrap: see Intervals.
        rollouts: for each member, policy and initial state.
        held_out: share of the real episodes that, with what was made from them, decides when training was best.
        max_steps: of a roll-out without a horizon.
        tolerance: see above.
        max_starts: with more initial states, as many as this are drawn.
        model: a model to use instead of learning one (`step(states, actions, rng=rng)` on feature matrices).

    >>> ModelBased().name, ModelBased.preset("autoregressive").name
    ('MB', 'MB autoregressive x1')
    """

    kind: Kind = "auto"
    hidden: tuple[int, ...] = (128, 128)
    updates: int = 4_000
    batch_size: int = 256
    learning_rate: float = 1e-3
    weight_decay: float = 1e-5
    ensemble: int = 5
    bootstrap: bool = False
    rollouts: int = 1
    held_out: float = 0.1
    max_steps: int = 2_000
    tolerance: float = 1e-3
    max_starts: int = 1_000
    model: DynamicsModel | None = None
    family: ClassVar[str] = "MB"

    def __post_init__(self) -> None:
        if self.kind not in get_args(Kind):
            raise ConfigurationError(f"kind must be one of {', '.join(get_args(Kind))}, got {self.kind!r}.")
        if not self.hidden or min(self.hidden) < 1:
            raise ConfigurationError(f"hidden must hold one size of at least 1 a layer, got {self.hidden!r}.")
        for name in ("updates", "batch_size", "ensemble", "rollouts", "max_steps", "max_starts"):
            if getattr(self, name) < 1:
                raise ConfigurationError(f"{name} must be at least 1, got {getattr(self, name)!r}.")
        if not self.learning_rate > 0 or not self.weight_decay >= 0 or not self.tolerance > 0:
            raise ConfigurationError(
                "learning_rate and tolerance must be positive and weight_decay not negative, got "
                f"{self.learning_rate!r}, {self.tolerance!r} and {self.weight_decay!r}."
            )
        if not 0 < self.held_out < 1:
            raise ConfigurationError(f"held_out must be a share between 0 and 1, got {self.held_out!r}.")
        if self.model is not None and not callable(getattr(self.model, "step", None)):
            raise ConfigurationError(f"model must have step(states, actions, *, rng), got {self.model!r}.")

    @classmethod
    def preset(cls, name: Literal["dope", "autoregressive"]) -> ModelBased:
        """Return published settings.

        "dope": the DOPE benchmark's model, one network with four layers of 256 and 100,000 updates at 3e-4.
        "autoregressive": Zhang et al. (2021), one network of 64 and 64 units for each state variable, kept small since
        there are as many networks as variables.
        """
        if name == "dope":
            return cls(
                kind="ensemble", hidden=(256,) * 4, updates=100_000, learning_rate=3e-4, weight_decay=1e-5, ensemble=1
            )
        if name != "autoregressive":
            raise ConfigurationError(f"ModelBased has the presets 'dope' and 'autoregressive', got {name!r}.")
        return cls(kind="autoregressive", hidden=(64, 64), ensemble=1, rollouts=5)

    @property
    def name(self) -> str:
        """The family, the kind where it is chosen, the size of an ensemble where it is not 5, and the bootstrap."""
        if self.model is not None:
            return "MB given model"
        parts = ["MB"] + ([] if self.kind == "auto" else [self.kind])
        parts += [f"x{self.ensemble}"] if self.ensemble != 5 else []
        return " ".join(parts + (["bootstrap"] if self.bootstrap else []))

    def form(self, problem: Problem) -> Literal["ensemble", "autoregressive", "tabular"]:
        """Return the kind that "auto" stands for."""
        if self.kind == "auto":
            return "tabular" if is_tabular(problem) and self.model is None else "ensemble"
        return self.kind

    def check(self, problem: Problem) -> None:
        """Raise `ConfigurationError` where the chosen kind cannot be fitted."""
        form = self.form(problem)
        if form == "tabular" and not is_tabular(problem):
            raise ConfigurationError(
                "kind='tabular' needs Discrete observations and actions and policies with `probabilities`: use "
                "'ensemble' or 'autoregressive', or ope.TabularPolicy."
            )
        learns = form != "tabular" and self.model is None
        if learns and self.bootstrap and not 2 <= self.ensemble <= len(problem.resamples):
            raise ConfigurationError(
                "bootstrap=True trains each member on its own resample: ensemble must be 2 to "
                f"{len(problem.resamples)}, the number of resamples, got {self.ensemble}."
            )

    def estimate(self, problem: Problem, *, seeds: tuple[int, ...]) -> tuple[Estimates, ...]:
        """Return the estimates of each seed; tables do not depend on it.

        Raises:
            ConfigurationError: where the chosen kind cannot be fitted.
            InvalidDataError: where there is nothing to learn from, values have no solution, or a policy returns actions
                that are not finite.
            TrainingError: where training diverges.
        """
        self.check(problem)
        if self.model is not None:
            given = GivenModel(self.model, problem.data.flat_observations.layout.width)
            found = tuple(self._rolled(problem, given, seed) for seed in seeds)
        elif self.form(problem) == "tabular":
            fitted = fit_tabular(problem, bootstrap=self.bootstrap)
            found = (Estimates(fitted.values, fitted.replicates, fitted.diagnostics),) * len(seeds)
        else:
            problem.policy_actions(problem.initial, rng=derive(0, "model check"))  # raises for NaN, before training
            models = self.fit(problem, seeds=seeds)
            found = tuple(self._rolled(problem, model, seed) for model, seed in zip(models, seeds, strict=True))
        _warn(problem, found, self.name)
        return found

    def fit(self, problem: Problem, *, seeds: Sequence[int]) -> tuple[EnsembleModel | AutoregressiveModel, ...]:
        """Return the models of each seed, fitted to the training steps.

        Raises:
            InvalidDataError: where there is nothing to learn from.
            TrainingError: where training diverges.
        """
        moves = Moves.of(problem)
        parts = split(
            problem,
            moves,
            seeds=seeds,
            ensemble=self.ensemble,
            bootstrap=self.bootstrap,
            share=self.held_out,
            size=HELD,
        )
        fitting = Fitting(
            self.hidden,
            self.updates,
            self.batch_size,
            self.learning_rate,
            self.weight_decay,
            self.ensemble,
            problem.device,
            problem.progress,
            self.name,
        )
        if self.form(problem) == "autoregressive":
            return fit_autoregressive(moves, parts, fitting, seeds=seeds)
        return fit_ensemble(moves, parts, fitting, seeds=seeds)

    def _rolled(
        self, problem: Problem, model: EnsembleModel | AutoregressiveModel | GivenModel, seed: int
    ) -> Estimates:
        """Return the estimates of one seed by roll-outs."""
        chosen = _chosen_starts(problem, self.max_starts)
        limits = Limits(self.rollouts, self.max_steps, self.tolerance)
        rolled = roll_out(problem, model, problem.initial_states[chosen], limits, seed=seed)
        bootstrap = self.bootstrap and not isinstance(model, GivenModel)
        replicates = _replicates(problem, rolled.values, chosen, bootstrap=bootstrap)
        errors = {} if isinstance(model, GivenModel) else _errors(model)
        common = errors | {"interval_covers_training": float(bootstrap)}
        found = tuple({**own, **common} for own in _diagnostics(problem, rolled))
        values = rolled.values.mean(axis=(0, 2))
        if not np.isfinite(values).all():
            policy = problem.policies.names[int(np.flatnonzero(~np.isfinite(values))[0])]
            raise TrainingError(f"{self.name}: the value of policy {policy!r} is not finite. Lower learning_rate.")
        return Estimates(values, replicates, found)


def _chosen_starts(problem: Problem, limit: int) -> IntArray:
    """Return the initial states to roll out from, the same for all seeds."""
    n = len(problem.initial_states)
    return np.arange(n) if n <= limit else np.sort(derive(0, "model starts").permutation(n)[:limit])


def _replicates(problem: Problem, values: FloatArray, chosen: IntArray, *, bootstrap: bool) -> FloatArray:
    """Return (P, B) from values (E, P, M)."""
    weights = problem.initial_weights()[:, chosen]
    total = weights.sum(axis=1, keepdims=True)
    weights = np.divide(weights, total, out=np.full_like(weights, 1.0 / len(chosen)), where=total > 0)
    if bootstrap:
        return np.einsum("bpm,bm->pb", values[np.arange(len(weights)) % len(values)], weights)
    return values.mean(axis=0) @ weights.T


def _errors(model: EnsembleModel | AutoregressiveModel) -> dict[str, float]:
    return {"held_out_state_error": model.errors[0], "held_out_reward_error": model.errors[1]}


def _diagnostics(problem: Problem, rolled: RollOuts) -> list[Diagnostics]:
    rewards = problem.data.steps.rewards[problem.rows("training")]
    most = float(np.abs(rewards).max()) * (0.0 if problem.horizon is not None else value_scale(problem))
    members = rolled.values.mean(axis=2)
    spread = members.std(axis=0, ddof=1) if len(members) > 1 else np.full(members.shape[1], np.nan)
    return [
        {"share_clipped": float(share), "ensemble_sd": float(sd), "truncation_bound": float(left) * most}
        for share, sd, left in zip(rolled.clipped, spread, rolled.unfinished, strict=True)
    ]


def _warn(problem: Problem, found: Sequence[Estimates], name: str) -> None:
    """Warn of values that are not to be trusted, one warning for each reason."""
    most = float(np.abs(problem.data.steps.rewards).max()) * value_scale(problem)
    reasons = dict[str, set[str]]()

    def note(reason: str, policy: str) -> None:
        reasons.setdefault(reason, set()).add(policy)

    for estimates in found:
        for policy, own in zip(problem.policies.names, estimates.diagnostics, strict=True):
            if own.get("unsupported_mass", 0.0) > MAX_UNSUPPORTED:
                note(UNSUPPORTED, policy)
            if max(own.get("held_out_state_error", 0.0), own.get("held_out_reward_error", 0.0)) > MAX_ERROR:
                note("comes from a model that predicts held-out steps hardly better than a constant", policy)
            if own.get("share_clipped", 0.0) > MAX_CLIPPED:
                note("comes from roll-outs that leave the range of the data (share_clipped)", policy)
            if own.get("truncation_bound", 0.0) > MAX_CUT * most:
                note("misses what comes after the last step (truncation_bound): raise max_steps", policy)
    for reason, policies in reasons.items():
        chosen = ", ".join(p for p in problem.policies.names if p in policies)
        warnings.warn(f"{name}: the value of {chosen} {reason}.", EstimationWarning, stacklevel=4)
