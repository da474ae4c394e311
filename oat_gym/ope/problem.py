"""One question for the estimators: data, policies, behaviour, discount and horizon, with what they all need of it."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from oat_gym.episodes import BoolArray, IntArray
from oat_gym.ope._policy_checks import check_finite_actions
from oat_gym.ope.logged import Logged
from oat_gym.ope.policy import PolicySet
from oat_gym.progress import ProgressCallback, silent
from oat_gym.spaces import Batch, FlatSpace, map_tree, tree_length

FloatArray = npt.NDArray[np.float64]
Part = Literal["training", "weights", "initial", "behavior"]
"""What synthetic episodes may be used for: training (value functions, models), the returns that are weighted, the
initial states, and cloning the behaviour policy."""


@dataclass(frozen=True)
class Problem:
    """What an estimator gets.

    Attributes:
        data: the logged steps.
        policies: the P target policies.
        gamma: discount, 0 < gamma <= 1 (1 only with a horizon or where every episode terminates).
        horizon: number of steps H whose rewards count; None: all, without end.
        initial: initial states, a batch of M observations.
        initial_unit: (M,) the real episode that each comes from; None where the user gave them.
        behavior: returns, for a seed, log beta(a|s) of every logged step, (n,); minus infinity is impossible in
            data. It does its work once for a seed.
        resamples: (B, N) how often each bootstrap resample of the data holds each real episode (rows sum to N).
        use_augmented: the parts that see synthetic episodes.
        device: torch device.
        progress: called as progress(description, done, total).
    """

    data: Logged
    policies: PolicySet
    gamma: float
    horizon: int | None
    initial: Batch
    initial_unit: IntArray | None
    behavior: Callable[[int], FloatArray]
    resamples: FloatArray
    use_augmented: frozenset[Part] = frozenset()
    device: str = "cpu"
    progress: ProgressCallback = silent
    shared: dict[Hashable, Any] = field(default_factory=dict[Hashable, Any], init=False, repr=False, compare=False)
    """Results of this very problem that several estimators use; a changed copy (`replace`) starts without any."""

    def episodes(self, part: Part) -> BoolArray:
        """Return (E,) booleans: the episodes that `part` of an estimator may see."""
        return np.ones(len(self.data), dtype=bool) if part in self.use_augmented else ~self.data.synthetic

    def rows(self, part: Part) -> IntArray:
        """Return the rows of the steps that `part` of an estimator may see."""
        return self.data.rows_of(self.episodes(part))

    @property
    def initial_states(self) -> FloatArray:
        """(M, D) features of the initial states."""
        return self.data.flat_observations.flatten(self.initial)

    def initial_weights(self) -> FloatArray:
        """Return (B, M): the weight of each initial state in each resample; rows sum to 1.

        Initial states that the user gave are the same in every resample.
        """
        if self.initial_unit is None:
            size = tree_length(self.initial)
            return np.full((len(self.resamples), size), 1.0 / size)
        counts = self.resamples[:, self.initial_unit]
        return counts / counts.sum(axis=1, keepdims=True)

    def target_log_prob(self) -> FloatArray:
        """Return log pi(a|s) of every logged step under every policy, (P, n); computed once."""
        if "target" not in self.shared:
            steps = self.data.steps
            self.shared["target"] = self.policies.log_prob(steps.observations, steps.actions)
        return self.shared["target"]

    def policy_actions(self, observations: Batch, *, rng: np.random.Generator) -> FloatArray:
        """Return features of one action of each policy, (P, n, A), drawn from it and clipped to the space.

        Raises:
            InvalidDataError: for a policy that returns actions which are not finite.
        """
        return self.policy_samples(observations, 1, rng=rng)[0]

    def policy_samples(self, observations: Batch, count: int, *, rng: np.random.Generator) -> FloatArray:
        """Return features of several actions of each policy, (count, P, n, A); see `policy_actions`."""
        drawn, n_policies = self.policies.samples(observations, count, rng=rng), len(self.policies)
        actions = np.empty((count, n_policies, tree_length(observations), self.data.flat_actions.layout.width))
        for j, into in enumerate(actions):
            one = map_tree(lambda leaf, j=j: leaf[:, j], drawn)
            into[:] = flatten_policies(one, self.data.flat_actions, n_policies)
            for name, own in zip(self.policies.names, into, strict=True):
                check_finite_actions(name, own)
        return actions

    def policy_probabilities(self, observations: Batch) -> FloatArray | None:
        """Return pi(a|s) of each action of a `Discrete` space, (P, n, K): exact expectations can be taken.

        The K actions have the one-hot features of the action space's flattening, in its order. None where actions are
        continuous or a policy does not know its probabilities.
        """
        layout = self.data.flat_actions.layout
        if layout.categorical != ((0, layout.width),):
            return None
        return self.policies.probabilities(observations)


def flatten_policies(actions: Batch, space: FlatSpace, n_policies: int) -> FloatArray:
    """Return (P, n, A) features of a batch of actions whose leaves are (P, n, ...), clipped to the bounds."""
    rows = [space.flatten(map_tree(lambda leaf, p=p: leaf[p], actions)) for p in range(n_policies)]
    return np.clip(np.stack(rows), *space.bounds)
