"""The three forms of FQE, each from a problem to the fitted action values of all policies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from oat_gym._rng import derive, torch_generator
from oat_gym.episodes import IntArray
from oat_gym.errors import ConfigurationError, TrainingError
from oat_gym.ope import _q_linear as linear
from oat_gym.ope import _q_tabular as tabular
from oat_gym.ope._fqe_batch import Batches, Encoder
from oat_gym.ope._fqe_network import Architecture, Layers
from oat_gym.ope._fqe_training import Course, NetworkQ, QLook, Settings, Trainer, discount_totals
from oat_gym.ope._q_data import QData, RewardScale
from oat_gym.ope._q_function import Choices, FittedQ, action_choices, expected_q, value_scale
from oat_gym.ope.problem import Problem

FloatArray = npt.NDArray[np.float64]
INITIAL_DRAWS = 10
"""Actions that are averaged at an initial state, of stochastic policies without known probabilities."""


@dataclass(frozen=True)
class NetworkForm:
    """What the network form needs besides `Settings`; see `FQE`."""

    settings: Settings
    hidden: tuple[int, ...]
    batch_size: int
    ensemble: int
    bootstrap: bool
    action_draws: int
    name: str


def fit_network(problem: Problem, form: NetworkForm, *, seeds: Sequence[int]) -> tuple[FittedQ, ...]:
    """Train all policies, members and seeds in one computation.

    Raises:
        TrainingError: if a value is not finite; the message names the policy.
    """
    data = QData.of(problem)
    reward, encoder = RewardScale.of(data), Encoder.of(data, problem.horizon)
    trainer, batches = _trainer(problem, form, data, scaling=(reward, encoder), seeds=seeds)
    totals = discount_totals(problem.gamma, problem.horizon, value_scale(problem))
    n_policies = len(problem.policies)

    def function(layers: Layers) -> NetworkQ:
        return NetworkQ(layers, encoder, reward, totals, n_policies, problem.device)

    choices = initial_choices(problem, seed=0)
    look = QLook(function(trainer.target_layers), problem.initial_states, choices, _remaining(problem))
    course = trainer.run(batches, look, problem.progress, form.name)
    each = look.each().reshape(len(seeds), form.ensemble, n_policies, -1)
    _check_finite(problem, each)
    size = form.ensemble * n_policies
    return tuple(
        _network_result(
            problem,
            form,
            function([(w[k : k + size].clone(), b[k : k + size].clone()) for w, b in trainer.target_layers]),
            each[number],
            Course(course.values[:, k : k + size], course.td_error[k : k + size], course.clipped[k : k + size]),
        )
        for number, k in enumerate(range(0, len(seeds) * size, size))
    )


def _trainer(
    problem: Problem, form: NetworkForm, data: QData, *, scaling: tuple[RewardScale, Encoder], seeds: Sequence[int]
) -> tuple[Trainer, Batches]:
    reward, encoder = scaling
    streams = [(derive(seed, "fqe", member), member) for seed in seeds for member in range(form.ensemble)]
    counts = [problem.resamples[m % len(problem.resamples)] if form.bootstrap else None for _, m in streams]
    rngs = [rng for rng, _ in streams]
    # The cached actions are the same for all seeds, so that they are stored once.
    following = action_choices(problem, data.next_observations, draws=form.action_draws, rng=derive(0, "fqe actions"))
    trainer = Trainer(
        Architecture(encoder.inputs, form.hidden, encoder.heads),
        form.settings,
        reward,
        generators=[torch_generator(rng) for rng in rngs],
        n_policies=len(problem.policies),
        device=problem.device,
    )
    rows = [data.resampled_rows(own) for own in counts]
    batches = Batches(problem, data, reward, encoder, following, rngs=rngs, rows=rows, size=form.batch_size)
    return trainer, batches


def _network_result(
    problem: Problem, form: NetworkForm, function: NetworkQ, each: FloatArray, course: Course
) -> FittedQ:
    """`each` is V(s0), (E, P, M); the columns of `course` are this seed's E * P members."""
    n_policies, weights = each.shape[1], problem.initial_weights()
    by_member = each.mean(axis=2)
    if form.bootstrap:
        member = np.arange(len(weights)) % form.ensemble
        replicates = np.einsum("bpm,bm->pb", each[member], weights)
    else:
        replicates = each.mean(axis=0) @ weights.T
    looks = course.values.reshape(len(course.values), form.ensemble, n_policies).mean(axis=1)
    before = looks[max(len(looks) - 1 - max(len(looks) // 10, 1), 0)]
    td_error, clipped = (part.reshape(form.ensemble, n_policies) for part in (course.td_error, course.clipped))
    diagnostics = [
        {
            "td_error": float(np.sqrt(np.square(td_error[:, p]).mean())),
            "share_clipped": float(clipped[:, p].mean()),
            "late_change": float(looks[-1, p] - before[p]),
            "ensemble_sd": float(by_member[:, p].std(ddof=1)) if form.ensemble > 1 else float("nan"),
            "interval_covers_training": float(form.bootstrap),
        }
        for p in range(n_policies)
    ]
    return FittedQ(function, by_member.mean(axis=0), replicates, tuple(diagnostics))


def fit_tabular(problem: Problem, *, bootstrap: bool) -> FittedQ:
    """Solve the empirical model for every policy; with `bootstrap` that of every resample as well."""
    data, flat = QData.of(problem), problem.data.flat_observations
    table = problem.policy_probabilities(flat.unflatten(np.eye(flat.layout.width)))
    if table is None:
        raise ConfigurationError(NEEDS_TABLES)
    initial = problem.initial_states.argmax(axis=1)
    start = np.bincount(initial, minlength=table.shape[1]) / len(initial)
    model = _model(data, table.shape[1:], None)
    values = np.stack([_values(problem, model, policy) for policy in table])
    weights = problem.initial_weights()
    if bootstrap:
        replicates = np.empty((len(table), len(weights)))
        for b, counts in enumerate(problem.resamples):
            problem.progress("FQE tabular, resamples", b + 1, len(weights))
            resampled = _model(data, table.shape[1:], counts[data.unit])
            for p, policy in enumerate(table):
                replicates[p, b] = weights[b] @ _at_start(problem, _values(problem, resampled, policy))[initial]
    else:
        replicates = np.stack([weights @ _at_start(problem, v)[initial] for v in values])
    diagnostics = [
        {
            "unsupported_mass": tabular.unsupported_mass(model, policy, start, problem.gamma, problem.horizon),
            "interval_covers_training": float(bootstrap),
        }
        for policy in table
    ]
    means = np.stack([start @ _at_start(problem, v) for v in values])
    return FittedQ(tabular.TabularQ(model, values, problem.gamma), means, replicates, tuple(diagnostics))


def fit_linear(
    problem: Problem, *, degree: linear.Degree, ridge: float, bootstrap: bool, action_draws: int, seed: int
) -> FittedQ:
    """Solve for the linear action values of every policy; with `bootstrap` on every resample as well."""
    data, states = QData.of(problem), problem.data.flat_observations.layout
    features = linear.FeatureMap.of(
        data.states, data.actions, degree=degree, discrete=data.discrete, one_hot=not states.continuous
    )
    following = action_choices(problem, data.next_observations, draws=action_draws, rng=derive(seed, "fqe actions"))
    start, phi = initial_choices(problem, seed=seed), features(data.states, data.actions)
    weights, rows = problem.initial_weights(), len(data.rows)
    counts = [np.ones(rows), *(problem.resamples[:, data.unit] if bootstrap else ())]
    theta: list[FloatArray] = []
    replicates: list[FloatArray] = []
    for p in range(len(problem.policies)):
        problem.progress("FQE linear", p + 1, len(problem.policies))
        after = linear.masked(features.expected(data.next_states, following, p), data.terminated)
        first = features.expected(problem.initial_states, start, p)
        solved = [_solve(problem, phi, after, data.rewards, ridge=ridge, weights=w) for w in counts]
        theta.append(solved[0])
        ends = [first @ (t if problem.horizon is None else t[-1]) for t in solved]
        replicates.append(
            np.array([w @ v for w, v in zip(weights, ends[1:] if bootstrap else ends * len(weights), strict=True)])
        )
    function = linear.LinearQ(features, np.stack(theta))
    means = expected_q(function, problem.initial_states, start, _remaining(problem)).mean(axis=1)
    _check_finite(problem, means[None, None, :, None])
    covers = {"interval_covers_training": float(bootstrap)}
    return FittedQ(function, means, np.stack(replicates), tuple(covers for _ in theta))


NEEDS_TABLES = (
    "approximation='tabular' needs Discrete observations and actions and policies with `probabilities`: use "
    "'network' or 'linear', or ope.TabularPolicy."
)


def is_tabular(problem: Problem) -> bool:
    """Return whether the closed form applies: discrete states and actions, known probabilities."""
    layout = problem.data.flat_observations.layout
    return layout.categorical == ((0, layout.width),) and problem.policy_probabilities(problem.initial) is not None


def initial_choices(problem: Problem, *, seed: int) -> Choices:
    """Return the policies' actions in the initial states."""
    return action_choices(problem, problem.initial, draws=INITIAL_DRAWS, rng=derive(seed, "fqe initial actions"))


def _remaining(problem: Problem) -> IntArray | None:
    return None if problem.horizon is None else np.full(len(problem.initial_states), problem.horizon)


def _model(data: QData, shape: tuple[int, ...], weights: FloatArray | None) -> tabular.EmpiricalModel:
    states, actions, following = (x.argmax(axis=1) for x in (data.states, data.actions, data.next_states))
    return tabular.empirical_model(
        states, actions, data.rewards, following, data.terminated, weights=weights, shape=(shape[0], shape[1])
    )


def _values(problem: Problem, model: tabular.EmpiricalModel, policy: FloatArray) -> FloatArray:
    policy = tabular.supported_policy(model, policy)
    if problem.horizon is None:
        return tabular.infinite_values(model, policy, problem.gamma)
    return tabular.finite_values(model, policy, problem.gamma, problem.horizon)


def _at_start(problem: Problem, values: FloatArray) -> FloatArray:
    return values if problem.horizon is None else values[-1]


def _solve(
    problem: Problem, phi: FloatArray, after: FloatArray, rewards: FloatArray, *, ridge: float, weights: FloatArray
) -> FloatArray:
    if problem.horizon is None:
        return linear.infinite_weights(phi, after, rewards, gamma=problem.gamma, ridge=ridge, weights=weights)
    return linear.finite_weights(
        phi, after, rewards, gamma=problem.gamma, ridge=ridge, weights=weights, horizon=problem.horizon
    )


def _check_finite(problem: Problem, each: FloatArray) -> None:
    bad = ~np.isfinite(each).all(axis=(0, 1, 3))
    if bad.any():
        name = problem.policies.names[int(np.flatnonzero(bad)[0])]
        raise TrainingError(
            f"FQE diverged: the value of policy {name!r} is not finite. Lower learning_rate or tau, or check the data "
            "for extreme rewards and observations."
        )
