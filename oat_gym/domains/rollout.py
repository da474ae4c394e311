"""Roll-outs of policies in vectorised environments: for true values, and for datasets made by policies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium.vector import AutoresetMode, VectorEnv
from minari.data_collector import EpisodeBuffer

from oat_gym._rng import derive
from oat_gym.errors import ConfigurationError, InvalidDataError
from oat_gym.io.writing import episode_buffer
from oat_gym.ope.policy import Policy
from oat_gym.spaces import Batch, copy_tree, map_tree

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class RollOuts:
    """What a policy earned in n episodes.

    Attributes:
        rewards: (n, horizon) float64, 0 after an episode's end.
        lengths: (n,) number of steps of each.
        terminated: (n,) whether the environment ended it (else time was up).
        episodes: the episodes themselves, where they were recorded.
    """

    rewards: FloatArray
    lengths: npt.NDArray[np.int64]
    terminated: npt.NDArray[np.bool_]
    episodes: tuple[EpisodeBuffer, ...] = ()


@dataclass(frozen=True)
class Recording:
    """What to keep of each episode, beside observations, actions, rewards and ends.

    Attributes:
        infos: names of the environment's infos that become infos of the step (T rows).
        log_prob: keep `infos["log_prob"]`, the policy's log-probability of the action taken.
    """

    infos: tuple[str, ...] = ()
    log_prob: bool = False


def roll_out(
    envs: VectorEnv[Any, Any, Any],
    policy: Policy,
    *,
    seeds: Sequence[int],
    horizon: int,
    policy_seed: int = 0,
    record: Recording | None = None,
) -> RollOuts:
    """Return one episode for each seed, `envs.num_envs` at a time.

    Episode e starts from `reset(seed=seeds[e])`, so that policies meet the same initial states. An episode's actions
    depend on its place in a batch only through the policy's random numbers, which a batch draws together.

    Args:
        envs: a vector environment (an ended one is ignored until the next batch).
        policy: acts by `sample`.
        seeds: seed of each episode's reset.
        horizon: episodes that have not ended after so many steps are truncated there.
        policy_seed: seed of the policy's random numbers.
        record: what to keep of the episodes; `None`: rewards only.

    Raises:
        ConfigurationError: for a horizon below 1, no seeds, other autoreset modes than next-step, or infos
            to record that the environment does not give.
        InvalidDataError: if the policy gives actions that are not finite.
    """
    if horizon < 1 or not len(seeds):
        raise ConfigurationError(f"roll_out takes seeds and a horizon of at least 1; got {len(seeds)} and {horizon}.")
    mode = envs.metadata.get("autoreset_mode", AutoresetMode.NEXT_STEP)
    if mode != AutoresetMode.NEXT_STEP:  # within the ending step: its observation is lost; never: it cannot be stepped
        raise ConfigurationError(f"roll_out needs environments with next-step autoreset, got {mode}.")
    whole = [int(seed) for seed in seeds]  # Gymnasium refuses NumPy's integers
    batches = [whole[start : start + envs.num_envs] for start in range(0, len(whole), envs.num_envs)]
    parts = [
        _batch(envs, policy, batch, horizon=horizon, rng=derive(policy_seed, "roll-out", number), record=record)
        for number, batch in enumerate(batches)
    ]
    return RollOuts(
        rewards=np.concatenate([part.rewards for part in parts]),
        lengths=np.concatenate([part.lengths for part in parts]),
        terminated=np.concatenate([part.terminated for part in parts]),
        episodes=tuple(episode for part in parts for episode in part.episodes),
    )


def _batch(
    envs: VectorEnv[Any, Any, Any],
    policy: Policy,
    seeds: list[int],
    *,
    horizon: int,
    rng: np.random.Generator,
    record: Recording | None,
) -> RollOuts:
    n, total = len(seeds), envs.num_envs
    of_each: Any = seeds + seeds[:1] * (total - n)  # one seed an environment, which VectorEnv's annotation leaves out
    observations, _ = envs.reset(seed=of_each)
    rewards, alive = np.zeros((total, horizon)), np.arange(total) < n
    lengths, terminated = np.zeros(total, dtype=np.int64), np.zeros(total, dtype=bool)
    tape = _Tape(record, observations) if record else None
    for step in range(horizon):
        actions = _actions(policy, observations, envs.single_action_space, rng)
        if tape:
            tape.act(policy, observations, actions)
        following, reward, ends, cuts, infos = envs.step(actions)
        rewards[alive, step] = reward[alive]
        lengths += alive
        terminated |= alive & ends
        if tape:
            tape.see(following, infos, alive)
        alive = alive & ~ends & ~cuts
        observations = following
        if not alive.any():
            break
    episodes = tape.episodes(rewards, lengths[:n], terminated, seeds) if tape else ()
    return RollOuts(rewards[:n], lengths[:n], terminated[:n], episodes)


def _actions(policy: Policy, observations: Batch, space: gym.Space[Any], rng: np.random.Generator) -> Batch:
    actions = policy.sample(observations, rng=rng)
    if isinstance(space, gym.spaces.Box):
        actions = np.asarray(actions).astype(space.dtype)
        if not np.isfinite(actions).all():
            raise InvalidDataError("The policy gave actions that are not finite.")
    return actions


class _Tape:
    """Everything that a batch of environments went through, step by step."""

    def __init__(self, record: Recording, observations: Batch) -> None:
        self.record = record
        self.observations = [copy_tree(observations)]
        self.actions: list[Batch] = []
        self.infos: dict[str, list[Any]] = {name: [] for name in record.infos}
        if record.log_prob:
            self.infos["log_prob"] = []

    def act(self, policy: Policy, observations: Batch, actions: Batch) -> None:
        """Keep the actions, before a step in which an environment may write over them or the observations."""
        self.actions.append(copy_tree(actions))
        if self.record.log_prob:
            self.infos["log_prob"].append(np.array(policy.log_prob(observations, actions)))

    def see(self, following: Batch, infos: dict[str, Any], alive: npt.NDArray[np.bool_]) -> None:
        """Keep what a step led to; `alive` are the environments whose episodes it belongs to."""
        self.observations.append(copy_tree(following))
        for name in self.record.infos:
            given = infos.get(
                f"_{name}", np.ones_like(alive)
            )  # a mask of the environments that gave it, where there is one
            if name not in infos or not given[alive].all():
                raise ConfigurationError(f"The environment's infos lack {name!r} in a step; they have {sorted(infos)}.")
            if isinstance(infos[name], dict):
                raise ConfigurationError(f"The environment's info {name!r} is nested; name infos that are arrays.")
            self.infos[name].append(np.array(infos[name]))

    def episodes(
        self, rewards: FloatArray, lengths: npt.NDArray[np.int64], terminated: npt.NDArray[np.bool_], seeds: list[int]
    ) -> tuple[EpisodeBuffer, ...]:
        observations = map_tree(lambda *rows: np.stack(rows), self.observations[0], *self.observations[1:])
        actions = map_tree(lambda *rows: np.stack(rows), self.actions[0], *self.actions[1:])
        infos = {name: np.stack(rows) for name, rows in self.infos.items()}

        def cut(number: int, steps: int) -> EpisodeBuffer:
            last = np.arange(steps) == steps - 1
            return episode_buffer(
                observations=map_tree(lambda leaf: leaf[: steps + 1, number].copy(), observations),
                actions=map_tree(lambda leaf: leaf[:steps, number].copy(), actions),
                rewards=rewards[number, :steps].copy(),
                terminations=last & terminated[number],
                truncations=last & ~terminated[number],
                infos={name: rows[:steps, number].copy() for name, rows in infos.items()} or None,
                seed=seeds[number],
            )

        return tuple(cut(number, int(steps)) for number, steps in enumerate(lengths))
