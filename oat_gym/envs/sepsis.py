"""`oat_gym/Sepsis-v0`: a simulator of the paper's sepsis task (section 3.2, appendix D), its patients nobody's data.

At each event of a stay in hospital some attributes are measured, at irregular times, as in the real records (about 78%
of the 15 attributes are missing at an event); then antibiotics and oxygen assistance are given or not, until the next
event. Rewards are those of the stages of sepsis (`oat_gym.domains.sepsis_stages`): getting worse costs the penalties of
the stages that are entered, getting better gives them back. A patient who dies counts as in septic shock.

The course of the disease is hidden; `oat_gym.envs._sepsis_model` describes it and its sources. The distributions of
measured values, times and missing patterns are calibrated on real records. It is a test bed for methods: nothing that
is learnt in it may inform the treatment of a patient.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from oat_gym.envs._sepsis_space import ACTION_SPACE, OBSERVATION_SPACE
from oat_gym.envs._sepsis_ward import Ward
from oat_gym.errors import ConfigurationError, InvalidDataError

Observation = dict[str, npt.NDArray[Any]]
_KEYS = 2**63


class SepsisVectorEnv(VectorEnv[Observation, npt.NDArray[np.int64], npt.NDArray[Any]]):
    """Many patients at once; each is what `SepsisEnv` gives with its seed.

    Observations are `OBSERVATION_SPACE`, batched: `values` (n, 15) what is believed of each attribute, `recorded`
    (n, 15) what was measured at this event, `treatments` (n, 2) what is in effect. Actions are `antibiotics + 2 *
    oxygen`. An episode terminates with death, or with discharge after a number of events drawn from the real visits',
    but not in septic shock; after `horizon` events it is truncated. The step after an episode's end starts the next
    one, whatever the action (`AutoresetMode.NEXT_STEP`).

    infos: `time` (hours since the first event), `stage` (0 to 4), `died`.

    >>> envs = SepsisVectorEnv(num_envs=3)
    >>> observations, infos = envs.reset(seed=0)
    >>> observations["values"].shape, infos["time"].tolist()
    ((3, 15), [0.0, 0.0, 0.0])
    >>> observations, rewards, terminations, truncations, infos = envs.step(np.array([0, 1, 3]))
    >>> observations["treatments"].tolist()
    [[0, 0], [1, 0], [1, 1]]
    """

    def __init__(self, num_envs: int = 1, *, horizon: int = 1160, render_mode: None = None) -> None:
        """Make `num_envs` empty beds; `reset` fills them.

        Raises:
            ConfigurationError: for no beds, a horizon below 1, or a render mode (there is nothing to see).
        """
        if num_envs < 1:
            raise ConfigurationError(f"num_envs must be at least 1, got {num_envs}.")
        self._ward = Ward(num_envs, horizon=horizon)
        _check_render_mode(render_mode)
        self.num_envs = num_envs
        self.metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.NEXT_STEP}
        self.single_observation_space, self.single_action_space = OBSERVATION_SPACE, ACTION_SPACE
        self.observation_space = batch_space(OBSERVATION_SPACE, num_envs)
        self.action_space = batch_space(ACTION_SPACE, num_envs)
        self._streams: list[np.random.Generator] = []
        self._ended = np.ones(num_envs, dtype=bool)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Admit a new patient to every bed.

        Args:
            seed: one for each bed, or a number s that stands for s, s + 1, ...; `None`: go on from the last seeds.
            options: none are known.

        Raises:
            ConfigurationError: for a wrong number of seeds.
        """
        del options
        seeds = _seeds(seed, self.num_envs)
        self._streams = [
            self._streams[bed] if one is None and self._streams else seeding.np_random(one)[0]
            for bed, one in enumerate(seeds)
        ]
        everyone = np.ones(self.num_envs, dtype=bool)
        self._admit(everyone)
        self._ended[:] = False
        return self._ward.observations(), _with_masks(self._ward.infos(), everyone)

    def step(
        self, actions: npt.NDArray[np.int64]
    ) -> tuple[Observation, npt.NDArray[np.float64], npt.NDArray[np.bool_], npt.NDArray[np.bool_], dict[str, Any]]:
        """Treat every patient until their next event; beds whose episode has ended admit a new patient instead.

        Raises:
            ConfigurationError: before the first `reset`.
            InvalidDataError: for actions other than 0 to 3.
        """
        if not self._streams:
            raise ConfigurationError("Call reset before step.")
        taken = _checked(np.asarray(actions), self.num_envs)
        arriving = self._ended.copy()
        outcome = self._ward.treat(taken, ~arriving)
        self._admit(arriving)
        self._ended = outcome.terminated | outcome.truncated
        infos = _with_masks(self._ward.infos(), np.ones(self.num_envs, dtype=bool))
        return self._ward.observations(), outcome.rewards, outcome.terminated, outcome.truncated, infos

    def _admit(self, beds: npt.NDArray[np.bool_]) -> None:
        rows = np.flatnonzero(beds)
        self._ward.admit(rows, np.array([_key(self._streams[bed]) for bed in rows], dtype=np.uint64))


class SepsisEnv(gym.Env[Observation, np.int64]):
    """One patient at a time; see `SepsisVectorEnv` for observations, actions, rewards and ends.

    >>> env = SepsisEnv()
    >>> observation, info = env.reset(seed=0)
    >>> observation["values"].shape, info["time"], env.action_space
    ((15,), 0.0, Discrete(4))
    """

    metadata = {"render_modes": []}  # noqa: RUF012 (Gymnasium's own annotation)

    def __init__(self, *, horizon: int = 1160, render_mode: None = None) -> None:
        """Make an empty bed; `reset` fills it.

        Raises:
            ConfigurationError: for a horizon below 1, or a render mode (there is nothing to see).
        """
        self._ward = Ward(1, horizon=horizon)
        _check_render_mode(render_mode)
        self.observation_space: spaces.Space[Any] = OBSERVATION_SPACE
        self.action_space = ACTION_SPACE
        self._going_on = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Admit a new patient."""
        super().reset(seed=seed, options=options)
        self._ward.admit(np.zeros(1, dtype=np.int64), np.array([_key(self.np_random)], dtype=np.uint64))
        self._going_on = True
        return self._first()

    def step(self, action: np.int64) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Treat the patient until the next event.

        Raises:
            ConfigurationError: after the episode's end, and before the first `reset`.
            InvalidDataError: for an action other than 0 to 3.
        """
        if not self._going_on:
            raise ConfigurationError("The episode has ended or not begun: call reset.")
        outcome = self._ward.treat(_checked(np.asarray([action]), 1), np.ones(1, dtype=bool))
        terminated, truncated = bool(outcome.terminated[0]), bool(outcome.truncated[0])
        self._going_on = not (terminated or truncated)
        observation, info = self._first()
        return observation, float(outcome.rewards[0]), terminated, truncated, info

    def _first(self) -> tuple[Observation, dict[str, Any]]:
        observation = {name: rows[0] for name, rows in self._ward.observations().items()}
        return observation, {name: rows[0].item() for name, rows in self._ward.infos().items()}


def _key(stream: np.random.Generator) -> int:
    return int(stream.integers(0, _KEYS))


def _check_render_mode(render_mode: object) -> None:
    if render_mode is not None:
        raise ConfigurationError(f"oat_gym/Sepsis-v0 draws no pictures: render_mode must be None, got {render_mode!r}.")


def _seeds(seed: int | Sequence[int | None] | None, count: int) -> list[int | None]:
    if seed is None:
        return [None] * count
    if isinstance(seed, int | np.integer):
        return [int(seed) + bed for bed in range(count)]
    if len(seed) != count:
        raise ConfigurationError(f"{count} environments take a number or {count} seeds, got {len(seed)}.")
    return [None if one is None else int(one) for one in seed]


def _checked(actions: npt.NDArray[Any], count: int) -> npt.NDArray[np.int64]:
    if actions.shape != (count,) or actions.dtype.kind not in "iu":
        raise InvalidDataError(
            f"{count} whole numbers are expected as actions, got {actions.dtype} of shape {actions.shape}."
        )
    if actions.min() < 0 or actions.max() > 3:
        raise InvalidDataError(f"Actions go from 0 to 3 (antibiotics + 2 * oxygen), got {actions.tolist()}.")
    return actions.astype(np.int64)


def _with_masks(infos: dict[str, npt.NDArray[Any]], present: npt.NDArray[np.bool_]) -> dict[str, Any]:
    """Return infos in Gymnasium's vector form: beside each array, which environments gave a value."""
    return infos | {f"_{name}": present.copy() for name in infos}
