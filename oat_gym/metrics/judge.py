"""The judge of generated steps: made once from the real steps of a dataset, used for every method."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from minari import MinariDataset

from oat_gym._rng import check_seed, derive
from oat_gym.errors import ConfigurationError, InvalidDataError
from oat_gym.metrics.models import DynamicsModel
from oat_gym.metrics.neighbors import copies, nearest, other_group_copies
from oat_gym.metrics.scores import Fidelity, Score
from oat_gym.metrics.steps import Contents, FloatArray, Scale, Steps, steps_in_place
from oat_gym.metrics.yardstick import Yardstick, halves, ratio
from oat_gym.spaces import FlatSpace, FloatMatrix

LEAST_EPISODES = 4
"""Real episodes needed: two in each half, since neighbours are looked for in other episodes."""
LIMIT = 3000
"""Most steps of a sample, by default: distances and models see no more of a half, or of the generated steps."""
SEARCHED = 20_000
"""Most real steps among which the nearest one is searched (for exact copies: all of them)."""


class Judge:
    """Scores generated steps against real ones; made once for a dataset, used for every method.

    Args:
        real: the real steps.
        observations: the flattening of the observation space.
        actions: the flattening of the action space.
        seed: of the halves, samples, projections and models; the same seed gives the same numbers.
        limit: most steps of a sample.

    Raises:
        InvalidDataError: for fewer than `LEAST_EPISODES` real episodes.
        ConfigurationError: for a limit under 2 or a bad seed.
    """

    def __init__(
        self, real: Steps, *, observations: FlatSpace, actions: FlatSpace, seed: int = 0, limit: int = LIMIT
    ) -> None:
        numbers = np.unique(real.episodes)
        if len(numbers) < LEAST_EPISODES:
            raise InvalidDataError(
                f"There are {len(numbers)} real episodes and fidelity needs {LEAST_EPISODES}: it is read against two "
                "halves of the real data, split by episode. A view that leaves the real episodes out has none."
            )
        if isinstance(limit, bool) or not isinstance(limit, int | np.integer) or limit < 2:
            raise ConfigurationError(f"limit must be an integer of at least 2, got {limit!r}.")
        self.real = real
        self.seed = check_seed(seed)
        self.limit = int(limit)
        self.scale = Scale.of(real, observations=observations, actions=actions)
        self._yardsticks: dict[bytes, Yardstick] = {}

    @classmethod
    def of(cls, dataset: MinariDataset, contents: Contents, *, seed: int, limit: int) -> Judge:
        """Return the judge of what was read from a dataset."""
        observations = FlatSpace.of(dataset.observation_space, "observation space")
        actions = FlatSpace.of(dataset.action_space, "action space")
        return cls(contents.real, observations=observations, actions=actions, seed=seed, limit=limit)

    def fidelity(self, generated: Steps, seams: FloatArray) -> Fidelity:
        """Return the scores of generated steps, whose spans have (n, 2) `seams`.

        Raises:
            InvalidDataError: for fewer than two generated steps.
        """
        if len(generated) < 2:
            raise InvalidDataError(
                f"{len(generated)} steps were generated and fidelity measures at least 2: the dataset was made with "
                "count=0, or nothing could be placed in its episodes."
            )
        scores = self._yardstick(generated).scores(generated)
        scores |= self._dynamics(generated) | self._seams(seams) | self._memorisation(generated)
        return Fidelity(n_real=len(self.real), n_generated=len(generated), **scores)

    def _yardstick(self, generated: Steps) -> Yardstick:
        """Return the yardstick of the real steps in the place of these; of all, if they are of too few episodes."""
        real = steps_in_place(self.real, generated)
        if len(np.unique(real.episodes)) < LEAST_EPISODES:
            real = self.real
        key = real.episodes.tobytes() + real.numbers.tobytes()
        if key not in self._yardsticks:
            self._yardsticks[key] = Yardstick(real, scale=self.scale, seed=self.seed, limit=self.limit)
        return self._yardsticks[key]

    @cached_property
    def _models(self) -> tuple[DynamicsModel, DynamicsModel]:
        """For each half of the real episodes, the model of its steps."""
        first, second = (
            DynamicsModel.fit(
                *self._regression(self.real.take(np.isin(self.real.episodes, members)), h),
                rng=derive(self.seed, "metrics", "dynamics", h),
            )
            for h, members in enumerate(halves(self.real, seed=self.seed))
        )
        return first, second

    def _regression(self, steps: Steps, h: int) -> tuple[FloatMatrix, FloatMatrix]:
        """Return inputs and outputs of at most `limit` of these steps."""
        sample = steps.sample(self.limit, derive(self.seed, "metrics", "regression", h))
        return self.scale.inputs(sample), self.scale.outcomes(sample)

    def _dynamics(self, generated: Steps) -> dict[str, Score]:
        """Score steps by the model of the half that they were not made from, beside the real ones in their place.

        What was made from episodes that are in neither half (a view that leaves them out) is scored by both models.
        """
        members = halves(self.real, seed=self.seed)
        states: list[float] = []
        rewards: list[float] = []
        for h, model in enumerate(self._models):
            theirs, held_out = (steps.take(~np.isin(steps.episodes, members[h])) for steps in (generated, self.real))
            if len(theirs):
                replaced = steps_in_place(held_out, theirs)
                usual = model.errors(*self._regression(replaced if len(replaced) else held_out, h))
                errors = model.errors(*self._regression(theirs, h))
                states.append(ratio(float(errors[:-1].mean()), float(usual[:-1].mean())))
                rewards.append(ratio(float(errors[-1]), float(usual[-1])))
        return {"dynamics": Score(float(np.mean(states)), 1.0), "reward": Score(float(np.mean(rewards)), 1.0)}

    def _seams(self, seams: FloatArray) -> dict[str, Score]:
        if not len(seams):
            return {"seam_mean": Score(None, None), "seam_p95": Score(None, None)}
        sizes = self.scale.sizes(self.real)
        return {
            "seam_mean": Score(float(seams.mean()), float(sizes.mean())),
            "seam_p95": Score(float(np.quantile(seams, 0.95)), float(np.quantile(sizes, 0.95))),
        }

    @cached_property
    def _searched(self) -> Steps:
        return self.real.sample(SEARCHED, derive(self.seed, "metrics", "searched"))

    @cached_property
    def _real_nearest(self) -> FloatArray:
        """Distances of a sample of real steps to the nearest step of another episode."""
        sample = self._searched.sample(self.limit, derive(self.seed, "metrics", "searching"))
        rows = [self.scale.rows(steps) for steps in (sample, self._searched)]
        return _round_off(nearest(*rows, query_groups=sample.episodes, point_groups=self._searched.episodes))

    def _memorisation(self, generated: Steps) -> dict[str, Score]:
        sample = generated.sample(self.limit, derive(self.seed, "metrics", "memorised"))
        found = _round_off(nearest(self.scale.rows(sample), self.scale.rows(self._searched)))
        typical = float(np.median(self._real_nearest))
        return {
            "memorised": Score(float((found < typical).mean()), float((self._real_nearest < typical).mean())),
            "nearest": Score(ratio(float(np.median(found)), typical), 1.0),
            "copies": Score(copies(self.scale.rows(generated), self.scale.rows(self.real)), self._real_copies),
        }

    @cached_property
    def _real_copies(self) -> float:
        return other_group_copies(self.scale.rows(self.real), self.real.episodes)


def _round_off(distances: FloatArray) -> FloatArray:
    """Return distances of which those that are 0 but for rounding are 0."""
    return np.where(distances < 1e-5, 0.0, distances)
