"""The behaviour policy beta(a|s): cloned with cross-fitting, logged in the data, or known to the user."""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from oat_gym._rng import derive, torch_generator
from oat_gym.episodes import BoolArray, IntArray
from oat_gym.errors import ConfigurationError, InvalidDataError
from oat_gym.generation._layers import one_thread
from oat_gym.generation.normalizer import Normalizer
from oat_gym.ope._densities import ActionHead, Density, standardizer
from oat_gym.ope.cloning import BehaviorCloning, Member, Networks, train
from oat_gym.ope.logged import Logged
from oat_gym.ope.policy import Policy
from oat_gym.progress import ProgressCallback, silent
from oat_gym.spaces import Batch, FlatSpace, Layout

_logger = logging.getLogger(__name__)
FloatArray = npt.NDArray[np.float64]
_ON_BOUNDS = 1e-3  # share of entries exactly on a bound from which actions count as recorded after clipping


@dataclass(frozen=True, eq=False)
class ClonedPolicy:
    """A fitted network as a policy on batches of the dataset's spaces.

    Attributes:
        network: one network.
        observations: flattening of the observation space.
        actions: flattening of the action space.
    """

    network: Networks
    observations: FlatSpace
    actions: FlatSpace

    def sample(self, observations: Batch, *, rng: np.random.Generator) -> Batch:
        """Return n actions drawn from beta(.|s), inside the bounds."""
        return self._draw(observations, torch_generator(rng))

    def mean(self, observations: Batch) -> Batch:
        """Return the n mean (of discrete parts: most probable) actions; for a tanh-Gaussian, the tanh of the mean."""
        return self._draw(observations, None)

    def log_prob(self, observations: Batch, actions: Batch) -> FloatArray:
        """Return log beta(a|s), (n,)."""
        return self.network.log_prob(self._tensor(observations), self._to_tensor(self.actions.flatten(actions)))

    def _draw(self, observations: Batch, generator: torch.Generator | None) -> Batch:
        with one_thread(), torch.no_grad():
            output = self.network.output(self._tensor(observations)[None])
            return self.actions.unflatten(self.network.head.sample(output, generator)[0].cpu().numpy())

    def _tensor(self, observations: Batch) -> Tensor:
        return self._to_tensor(self.observations.flatten(observations))

    def _to_tensor(self, matrix: FloatArray) -> Tensor:
        return torch.from_numpy(matrix.astype(np.float32)).to(self.network.weights.device)


@dataclass(frozen=True, eq=False)
class DiscreteClonedPolicy(ClonedPolicy):
    """A cloned policy over a `Discrete` action space, whose probabilities are known."""

    def probabilities(self, observations: Batch) -> FloatArray:
        """Return beta(a|s) of each action, (n, K)."""
        with one_thread(), torch.no_grad():
            output = self.network.output(self._tensor(observations)[None])[0]
            return output.double().softmax(-1).cpu().numpy()


@dataclass(frozen=True, eq=False)
class BehaviorFit:
    """What cloning gives.

    Attributes:
        log_prob: (n,) log beta(a|s) of every logged step, by a network that did not see the step's real episode.
        held_out_log_likelihood: mean of `log_prob` over the real steps that could be trained on, in the actions' units;
            with `folds=1` it is no held-out figure.
        density: the form chosen.
        fold: (N,) the fold of each real episode.
        folds: the networks, one a fold.
        everything: the network that was fitted on all of it.
    """

    log_prob: FloatArray
    held_out_log_likelihood: float
    density: Density
    fold: IntArray
    folds: tuple[ClonedPolicy, ...]
    everything: ClonedPolicy

    def policy(self) -> ClonedPolicy:
        """Return the policy fitted on all episodes, for roll-outs (a `DiscretePolicy` where actions are `Discrete`)."""
        return self.everything


def fit_log_prob(
    logged: Logged,
    *,
    config: BehaviorCloning,
    seed: int,
    episodes: BoolArray,
    device: str = "cpu",
    progress: ProgressCallback = silent,
) -> BehaviorFit:
    """Clone the behaviour policy and return the cross-fitted log-probability of every step.

    An episode and all that was made from it are one unit: no network is applied to a unit that it was trained on.

    Args:
        logged: the data.
        config: settings.
        seed: of folds, weights and batches.
        episodes: (E,) which episodes may be trained on.
        device: torch device.
        progress: called as progress(description, done, total).

    Raises:
        ConfigurationError: if the density does not fit the action space.
        InvalidDataError: if fewer than two real episodes are there to cross-fit.
        TrainingError: if training diverges.
    """
    density = choose_density(logged, config.density)
    fold = _assign_folds(logged, config.folds, episodes, seed)
    members = _members(logged, fold, episodes, seed)
    states = torch.from_numpy(logged.states.astype(np.float32)).to(device)
    actions = torch.from_numpy(logged.flat_actions.flatten(logged.steps.actions).astype(np.float32)).to(device)
    untrained = _untrained(logged, states, actions, members=members, density=density, config=config)
    networks = train(untrained, states, actions, members=members, config=config, progress=progress)
    policies = [_policy(networks.member(number), logged) for number in range(len(members))]
    fold_of_row = fold[logged.unit[logged.steps.episode]]
    log_prob = np.empty(len(states))
    for number, policy in enumerate(policies[:-1] or policies):
        rows = torch.from_numpy(np.flatnonzero(fold_of_row == number))
        log_prob[rows.numpy()] = policy.network.log_prob(states[rows], actions[rows])
    scored = logged.rows_of(episodes & ~logged.synthetic)
    held_out = float(log_prob[scored].mean())
    _logger.info("Behaviour policy (%s): log-likelihood of a held-out step %.3f.", density, held_out)
    return BehaviorFit(log_prob, held_out, density, fold, tuple(policies[:-1] or policies), policies[-1])


def choose_density(logged: Logged, wanted: str) -> Density:
    """Return the form that `BehaviorCloning.density` stands for on this data.

    Raises:
        ConfigurationError: if a density does not fit the action space.
    """
    columns = list(logged.flat_actions.layout.continuous)
    low, high = (bound[columns] for bound in logged.flat_actions.bounds)
    bounded = bool(np.isfinite(low).all() and np.isfinite(high).all())
    space = logged.flat_actions.space
    if wanted == "categorical" and columns:
        raise ConfigurationError(f'density="categorical" is for actions without real columns, got {space}.')
    if wanted == "tanh-gaussian" and columns and not bounded:
        raise ConfigurationError(f'density="tanh-gaussian" needs bounded actions, got {space}. Use "gaussian".')
    if not columns:
        return "categorical"
    for density in ("gaussian", "censored", "tanh-gaussian", "mixture"):
        if wanted == density:
            return density
    actions = logged.flat_actions.flatten(logged.steps.actions)[:, columns]
    on_bounds = float(((actions == low) | (actions == high)).mean())
    if bounded and on_bounds > _ON_BOUNDS:
        _logger.info("%.1f%% of the action entries sit on a bound: the tanh-Gaussian is used.", 100 * on_bounds)
        return "tanh-gaussian"
    return "gaussian"


def logged_log_prob(logged: Logged, *, episodes: BoolArray) -> FloatArray:
    """Return the recorded log beta(a|s) of every step, (n,): `infos["log_prob"]`, as SmartPrimer's log has it.

    Args:
        logged: the data.
        episodes: (E,) the episodes whose steps will be used; steps of others may be NaN.

    Raises:
        InvalidDataError: if the data does not record it, or not for every step that will be used.
    """
    if logged.log_prob is None:
        raise InvalidDataError(
            'behavior="logged" reads infos["log_prob"], which this dataset does not have. Use behavior="clone", or '
            "give the policy that recorded the data."
        )
    rows = logged.rows_of(episodes)
    bad = rows[~np.isfinite(logged.log_prob[rows])]
    if len(bad):
        row, steps = bad[0], logged.steps
        generated = " It was generated: no recorded policy chose its action." if steps.synthetic[row] else ""
        raise InvalidDataError(
            f'Step {steps.step[row]} of episode {steps.episode[row]} has infos["log_prob"] {logged.log_prob[row]} '
            f'({len(bad)} such steps).{generated} Use behavior="clone", or weight real episodes only.'
        )
    return logged.log_prob.copy()


@dataclass(frozen=True)
class KnownBehavior:
    """The behaviour policy as the user knows it.

    >>> from oat_gym.ope import TabularPolicy
    >>> known = KnownBehavior(TabularPolicy([[0.5, 0.5]]))
    """

    policy: Policy

    def log_prob(self, logged: Logged, *, episodes: BoolArray | None = None) -> FloatArray:
        """Return log beta(a|s) of every logged step, (n,).

        Args:
            logged: the data.
            episodes: (E,) the episodes whose steps will be used, all by default; generated actions of others may be
                impossible.

        Raises:
            InvalidDataError: if the policy calls a logged action impossible: then it did not record the data; or if it
                does not give one number for each step.
        """
        steps = logged.steps
        values = np.asarray(self.policy.log_prob(steps.observations, steps.actions), dtype=np.float64)
        if values.shape != (len(steps),):
            raise InvalidDataError(
                f"The behaviour policy gives log-probabilities of shape {values.shape} for {len(steps)} steps."
            )
        rows = np.arange(len(steps)) if episodes is None else logged.rows_of(episodes)
        bad = rows[~np.isfinite(values[rows])]
        if len(bad):
            raise InvalidDataError(
                f"The behaviour policy gives step {steps.step[bad[0]]} of episode {steps.episode[bad[0]]} the "
                f"log-probability {values[bad[0]]} ({len(bad)} such steps): it cannot have recorded the data."
            )
        return values


def _assign_folds(logged: Logged, folds: int, episodes: BoolArray, seed: int) -> IntArray:
    """Return the fold of each real episode, (N,), parts of equal size."""
    if folds == 1:
        return np.zeros(logged.n_units, dtype=np.int64)
    chosen = np.unique(logged.unit[episodes])
    trainable = len(chosen)
    if trainable < 2:
        raise InvalidDataError(
            f"Cross-fitting the behaviour policy needs two or more real episodes, got {trainable}. With "
            "BehaviorCloning(folds=1) the log-probabilities come from the network's own training data."
        )
    if trainable < folds:
        _logger.info("Cross-fitting with %d folds, one a real episode, in place of %d.", trainable, folds)
    order = derive(seed, "behavior folds").permutation(logged.n_units)
    # those that may be trained on come first, so that every fold leaves some of them
    order = np.concatenate((order[np.isin(order, chosen)], order[~np.isin(order, chosen)]))
    fold = np.empty(logged.n_units, dtype=np.int64)
    fold[order] = np.arange(logged.n_units) % min(folds, trainable)
    return fold


def _members(logged: Logged, fold: IntArray, episodes: BoolArray, seed: int) -> list[Member]:
    """Return what the networks may see: all but one fold each, and everything."""
    units, rows = logged.unit[logged.steps.episode], logged.rows_of(episodes)
    n_folds = int(fold.max()) + 1
    members: list[Member] = []
    for number in range(n_folds if n_folds > 1 else 0):
        some = rows[fold[units[rows]] != number]
        members.append(Member(f"fold {number}", some, units[some], derive(seed, "behavior", number)))
    return [*members, Member("all episodes", rows, units[rows], derive(seed, "behavior", n_folds))]


def _untrained(
    logged: Logged,
    states: Tensor,
    actions: Tensor,
    *,
    members: list[Member],
    density: Density,
    config: BehaviorCloning,
) -> Networks:
    """Return networks without weights, each standardised by the rows that it may see."""
    layout, space = logged.flat_observations.layout, logged.flat_actions
    columns = list(space.layout.continuous)
    low, high = (torch.from_numpy(bound[columns].astype(np.float32)).to(states.device) for bound in space.bounds)
    seen = [torch.from_numpy(member.rows) for member in members]
    affine = [_standardizer_of_states(logged, layout, member.rows) for member in members]
    real = [standardizer(density, actions[rows][:, columns], low, high) for rows in seen] if columns else []
    empty = torch.zeros((len(members), 1, 0), device=states.device)
    center, scale = (torch.stack([pair[i] for pair in real])[:, None] if real else empty for i in (0, 1))
    head = ActionHead(space.layout, density, config.components, config.scale_floor, center, scale, low, high)
    mean, spread = (
        torch.from_numpy(np.stack([pair[i] for pair in affine])[:, None].astype(np.float32)).to(states.device)
        for i in (0, 1)
    )
    return Networks(torch.empty(0), config.hidden, mean, spread, head)


def _standardizer_of_states(logged: Logged, layout: Layout, rows: IntArray) -> tuple[FloatArray, FloatArray]:
    normalizer = Normalizer.fit(logged.states[rows], layout)
    return normalizer.mean, normalizer.scale


def _policy(network: Networks, logged: Logged) -> ClonedPolicy:
    layout = logged.flat_actions.layout
    kind = DiscreteClonedPolicy if layout.categorical == ((0, layout.width),) else ClonedPolicy
    return kind(network, logged.flat_observations, logged.flat_actions)
