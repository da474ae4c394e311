"""`oat_gym/Tutor-v0`: a simulator of the intelligent tutor of the paper's section 3.2 and appendix E.

A student of elementary probability reads a textbook, takes a pre-test, works through twelve problems and takes a
post-test. Before each problem the tutor decides whether the student solves it, studies its solution, or works on it
together with the tutor. The reward is 0 until the last problem, which gives the normalised learning gain.

The paper's own data are private; nothing here is fitted to them. See `oat_gym.envs._tutor_model` for the student model
and its sources.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from oat_gym.envs._tutor_features import FEATURE_GROUPS, FEATURES, Desk, describe, observe, upper_bound
from oat_gym.envs._tutor_log import N_DRAWS, Session, record, work_through
from oat_gym.envs._tutor_model import (
    ACTIONS,
    ISOMORPHIC,
    N_NORMALS,
    N_PROBLEMS,
    N_UNIFORMS,
    POST_ITEMS,
    PROBLEMS,
    BoolArray,
    FloatArray,
    IntArray,
    Students,
    attention_after,
    draw_students,
    n_applications,
    normalized_learning_gain,
    score,
)
from oat_gym.errors import ConfigurationError, InvalidDataError

Array = npt.NDArray[Any]
Observations = npt.NDArray[np.float32]
HIGHEST_PRETEST = 1.0 - 0.5 / len(ISOMORPHIC)
"""A pre-test without a mistake counts as half an item short of full marks, since the gain divides by what is left."""
_STEPS = sum(map(len, PROBLEMS))
_PARTS = (N_UNIFORMS, 2, n_applications(ISOMORPHIC), n_applications(POST_ITEMS), _STEPS * N_DRAWS)
"""Uniform numbers of an episode: the student, reading and pre-test time, both tests, every step of every problem."""


@dataclass(frozen=True)
class Outcome:
    """What n students bring back from a problem.

    Attributes:
        observations: (n, 142) before the next problem.
        rewards: (n,) the normalised learning gain after the last problem, 0 before.
        done: whether it was the last one.
        seconds: (n,) since the start of the first problem.
        mastery: (n,) share of the principles that are known, which no tutor sees.
        pretest: (n,) score of the pre-test.
        posttest: (n,) score of the post-test; 0 before it was taken.
    """

    observations: Observations
    rewards: FloatArray
    done: bool
    seconds: FloatArray
    mastery: FloatArray
    pretest: FloatArray
    posttest: FloatArray


class Classroom:
    """n students who work through the twelve problems in step; both environments are made of it."""

    def __init__(self, rngs: Sequence[np.random.Generator]) -> None:
        """Draw n students, everything by chance that will happen to them included, one from each generator."""
        normals, (personal, times, pre, post, steps) = _draw(rngs)
        self._students, self._known = draw_students(normals, personal)
        self._draws, self._post = steps, post
        seconds = np.rint(np.array([1800.0, 900.0])[:, None] * self._students.pace * (0.5 + times.T))
        pretest = score(ISOMORPHIC, self._known, self._students, pre)
        self._attention = np.ones(len(rngs))
        self._desk = Desk(Session.empty(len(rngs)), pretest, seconds[0], seconds[1], done=0)

    @property
    def students(self) -> Students:
        """The students."""
        return self._students

    @property
    def known(self) -> BoolArray:
        """(n, K) which principles they know."""
        return self._known.copy()

    @property
    def done(self) -> bool:
        """Whether all problems are done."""
        return self._desk.done == N_PROBLEMS

    def features(self) -> dict[str, dict[str, FloatArray]]:
        """Return the features by group and name."""
        return describe(self._desk)

    def outcome(self) -> Outcome:
        """Return where the students are."""
        pretest = np.minimum(self._desk.pretest.mean(axis=1), HIGHEST_PRETEST)
        posttest, rewards = np.zeros_like(pretest), np.zeros_like(pretest)
        if self.done:
            posttest = score(POST_ITEMS, self._known, self._students, self._post).mean(axis=1)
            rewards = normalized_learning_gain(pretest, posttest)
        return Outcome(
            observations=observe(self._desk),
            rewards=rewards,
            done=self.done,
            seconds=self._desk.session.total("seconds"),
            mastery=self._known.mean(axis=1),
            pretest=pretest,
            posttest=posttest,
        )

    def work(self, action: IntArray) -> None:
        """Let every student work on the next problem in one of the three ways; `action` is (n,)."""
        desk = self._desk
        problem = PROBLEMS[desk.done]
        first = sum(map(len, PROBLEMS[: desk.done])) * N_DRAWS
        draws = self._draws[:, first : first + len(problem) * N_DRAWS].reshape(-1, len(problem), N_DRAWS)
        work, self._known = work_through(
            problem, action, students=self._students, known=self._known, attention=self._attention, draws=draws
        )
        session = record(desk.session, work, action)
        wrong = session.of_last("wrong") / np.maximum(session.of_last("elicited"), 1.0)
        self._attention = attention_after(self._attention, action, wrong)
        self._desk = Desk(session, desk.pretest, desk.reading_seconds, desk.pretest_seconds, desk.done + 1)


def _draw(rngs: Sequence[np.random.Generator]) -> tuple[FloatArray, list[FloatArray]]:
    """Return standard normal numbers (n, `N_NORMALS`) and the uniform `_PARTS`, each student's from one generator."""
    normals, uniforms = np.empty((len(rngs), N_NORMALS)), np.empty((len(rngs), sum(_PARTS)))
    for number, rng in enumerate(rngs):
        rng.standard_normal(out=normals[number])
        rng.random(out=uniforms[number])
    return normals, np.split(uniforms, np.cumsum(_PARTS)[:-1], axis=1)


def observation_space() -> spaces.Box:
    """Return the space of one observation: 142 numbers, none negative."""
    high = np.array([upper_bound(name) for name in FEATURES], dtype=np.float32)
    return spaces.Box(np.zeros_like(high), high, dtype=np.float32)


class TutorEnv(gym.Env[Array, np.int64]):
    """One student and the tutor; an episode has 12 steps and then terminates.

    Observations are the 142 features of `FEATURES`; actions are 0 solve, 1 study, 2 together; the reward is the
    normalised learning gain, in the last step. `infos` have `time` (seconds since the first problem began), `mastery`
    (the share of principles that are known, which no tutor sees), `pretest`, and in the last step `posttest`.

    >>> import gymnasium, oat_gym.envs
    >>> env = gymnasium.make("oat_gym/Tutor-v0")
    >>> observation, info = env.reset(seed=0)
    >>> observation.shape, env.action_space
    ((142,), Discrete(3))
    """

    metadata = {"render_modes": []}  # noqa: RUF012  # Gymnasium declares it so

    def __init__(self) -> None:
        """Make the spaces."""
        self.observation_space = observation_space()
        self.action_space = spaces.Discrete(len(ACTIONS))
        self._classroom: Classroom | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Any]]:
        """Return the first observation of a new student; `options` have no effect."""
        super().reset(seed=seed, options=options)
        self._classroom = Classroom([self.np_random])
        outcome = self._classroom.outcome()
        return outcome.observations[0], _info(outcome)

    def step(self, action: np.int64 | int) -> tuple[Observations, float, bool, bool, dict[str, Any]]:
        """Let the student do the next problem.

        Raises:
            gymnasium.error.ResetNeeded: before the first reset and after the last problem.
            InvalidDataError: for another action than 0, 1 and 2.
        """
        if self._classroom is None or self._classroom.done:
            raise gym.error.ResetNeeded("Call reset before the first step, and after the last problem.")
        self._classroom.work(_checked(np.array([action]), 1))
        outcome = self._classroom.outcome()
        return outcome.observations[0], float(outcome.rewards[0]), outcome.done, False, _info(outcome)


class TutorVectorEnv(VectorEnv[Array, Array, Array]):
    """Many students at once: the same episodes as as many `TutorEnv`, one by one, would give with the same seeds.

    Students stay in step, since every episode has 12 steps. As with Gymnasium's `SyncVectorEnv`, an int seed gives
    environment i the seed + i, and the step after the last one resets (`AutoresetMode.NEXT_STEP`).

    >>> import gymnasium, oat_gym.envs
    >>> envs = gymnasium.make_vec("oat_gym/Tutor-v0", num_envs=5)
    >>> envs.reset(seed=0)[0].shape
    (5, 142)
    """

    metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012

    def __init__(self, num_envs: int = 1) -> None:
        """Make the spaces.

        Raises:
            ConfigurationError: for less than one environment.
        """
        if isinstance(num_envs, bool) or not isinstance(num_envs, int) or num_envs < 1:
            raise ConfigurationError(f"num_envs must be a whole number of at least 1, got {num_envs!r}.")
        self.num_envs = num_envs
        self.single_observation_space = observation_space()
        self.single_action_space = spaces.Discrete(len(ACTIONS))
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._rngs: list[np.random.Generator] = []
        self._classroom: Classroom | None = None

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Any]]:
        """Return the first observations of new students, (n, 142); `options` have no effect.

        Raises:
            ConfigurationError: if `seed` is a sequence of another length than `num_envs`.
        """
        del options
        self._rngs = self._seeded(seed)
        return self._begin()

    def step(self, actions: Array) -> tuple[Array, Array, Array, Array, dict[str, Any]]:
        """Let every student do the next problem, or begin with new ones in the step after the last.

        Raises:
            gymnasium.error.ResetNeeded: before the first reset.
            InvalidDataError: for another action than 0, 1 and 2.
        """
        if self._classroom is None:
            raise gym.error.ResetNeeded("Call reset before the first step.")
        never = np.zeros(self.num_envs, dtype=bool)
        if self._classroom.done:
            observations, infos = self._begin()
            return observations, np.zeros(self.num_envs), never, never.copy(), infos
        self._classroom.work(_checked(actions, self.num_envs))
        outcome = self._classroom.outcome()
        return outcome.observations, outcome.rewards, never | outcome.done, never, _infos(outcome)

    def _begin(self) -> tuple[Observations, dict[str, Any]]:
        self._classroom = Classroom(self._rngs)
        outcome = self._classroom.outcome()
        return outcome.observations, _infos(outcome)

    def _seeded(self, seed: int | Sequence[int | None] | None) -> list[np.random.Generator]:
        n = self.num_envs
        if seed is None or isinstance(seed, int | np.integer):
            seeds = [None if seed is None else int(seed) + number for number in range(n)]
        else:
            seeds = [None if value is None else int(value) for value in seed]
        if len(seeds) != n:
            raise ConfigurationError(f"Got {len(seeds)} seeds for {n} environments; give one for each.")
        kept = self._rngs or [None] * n
        return [
            rng if value is None and rng is not None else seeding.np_random(value)[0]
            for value, rng in zip(seeds, kept, strict=True)
        ]


def _checked(actions: npt.ArrayLike, n: int) -> IntArray:
    codes = np.asarray(actions)
    if codes.shape != (n,) or codes.dtype.kind not in "iu" or not np.isin(codes, range(len(ACTIONS))).all():
        raise InvalidDataError(f"Actions must be {n} whole numbers from 0 to {len(ACTIONS) - 1}, got {actions!r}.")
    return codes.astype(np.int64)


def _infos(outcome: Outcome) -> dict[str, Any]:
    """Return Gymnasium's vector form of the infos: each with a mask of the environments that have it."""
    values = {"time": outcome.seconds, "mastery": outcome.mastery, "pretest": outcome.pretest}
    if outcome.done:
        values["posttest"] = outcome.posttest
    masks = {f"_{name}": np.ones(len(value), dtype=bool) for name, value in values.items()}
    return {**values, **masks}


def _info(outcome: Outcome) -> dict[str, Any]:
    return {name: float(value[0]) for name, value in _infos(outcome).items() if not name.startswith("_")}


__all__ = [
    "ACTIONS",
    "FEATURES",
    "FEATURE_GROUPS",
    "TutorEnv",
    "TutorVectorEnv",
    "normalized_learning_gain",
    "observation_space",
]
