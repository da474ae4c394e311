"""Adroit datasets that the library makes: roll-outs of the expert, and of policies cloned from demonstrations."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from minari import EpisodeData, MinariDataset
from minari.data_collector import EpisodeBuffer

from oat_gym._rng import derive
from oat_gym.cache import fingerprint
from oat_gym.domains._data import converted
from oat_gym.domains.adroit_env import REQUIREMENTS, env_spec, make_env, make_vec_env
from oat_gym.domains.adroit_policies import expert_file, expert_policy
from oat_gym.domains.adroit_rewards import AdroitTask, adroit_task, d4rl_reward, reward_convention, stock_reward
from oat_gym.domains.rollout import Recording, roll_out
from oat_gym.domains.truth import installed_versions
from oat_gym.episodes import content_hash
from oat_gym.errors import ConfigurationError
from oat_gym.io.writing import DatasetCard, dataset_from_episodes, episode_buffer
from oat_gym.ope.behavior import fit_log_prob
from oat_gym.ope.cloning import BehaviorCloning
from oat_gym.ope.logged import Logged
from oat_gym.ope.policy import Policy
from oat_gym.spaces import map_tree

CLONING = BehaviorCloning(density="censored", folds=1, max_updates=4000)
"""How demonstrations are cloned: one network on all of them, its log-probabilities of the same kind as the expert's."""

_VERSION = 1  # raise it when what is made changes
_AT_ONCE = 10  # environments stepped together: part of what the random numbers depend on
_RECORDING = Recording(infos=("success", "stock_reward"), log_prob=True)
_REWARDS = (
    "`rewards` are D4RL's; infos['stock_reward'] has those of the installed environment, which differ by 0.2 times the "
    "distance from hand to object for door, hammer and relocate."
)


def expert_dataset(name: str, *, steps: int | None = None, seed: int = 0) -> MinariDataset:
    """Return roll-outs of a task's DAPG expert, which samples its actions; made once, into the cache (OAT_GYM_CACHE).

    Episodes last 100 (pen) or 200 steps and never terminate; the last is cut where the number of steps is reached.
    Actions are recorded as clipped to [-1, 1]. infos: `success`, `stock_reward` and `log_prob`, the expert's
    log-probability of the clipped action. Each episode's `seed` metadata resets the environment to its start, from
    which its actions replay it. Torch's MKL has other kernels for Intel's processors than for others, which round the
    expert's actions otherwise, so that they have other roll-outs; MKL_CBWR=COMPATIBLE and OPENBLAS_CORETYPE=Haswell in
    the environment even that.

    Args:
        name: the task.
        steps: number of steps; by default that of D4RL's human data.
        seed: of resets and actions.

    Raises:
        ConfigurationError: for an unknown task, or fewer than one step.
        DatasetNotFoundError: if the expert's weights are not there; the message says how to get them.
    """
    task, source = adroit_task(name), expert_file(name)
    steps = _steps(steps, task)

    def write(folder: Path) -> MinariDataset:
        episodes = record(expert_policy(name), task, steps=steps, seed=seed, level="expert")
        return _write(
            episodes,
            folder,
            task,
            level="expert",
            description=f"{len(episodes)} roll-outs of the DAPG expert (aravindr93/hand_dapg), its actions sampled.",
            algorithm="DAPG expert, sampled",
        )

    return converted(_key(task, "expert", steps=steps, seed=seed), source, version=_VERSION, write=write)


def cloned_dataset(
    name: str,
    demonstrations: MinariDataset,
    *,
    level: str,
    steps: int | None = None,
    seed: int = 0,
    cloning: BehaviorCloning = CLONING,
) -> MinariDataset:
    """Return half demonstrations, half roll-outs of a policy cloned from them, as D4RL's `cloned` data is made.

    The policy is cloned from all demonstrations and samples its actions. Whole demonstrations come first,
    in order, as many as fit into half the steps; the roll-outs fill the rest. (D4RL repeats its demonstrations to fill
    a million steps; at the size of the human data none has to be repeated or cut.) infos are those that both halves
    have: `stock_reward`, and `log_prob` and `success` where the demonstrations have them; metadata `demonstrations` is
    the number of demonstrations. Made once, into the cache (OAT_GYM_CACHE).

    Args:
        name: the task.
        demonstrations: the dataset to clone.
        level: what the dataset is called, "cloned" or "cloned-from-expert".
        steps: number of steps; by default that of D4RL's human data.
        seed: of cloning, resets and actions.
        cloning: how the demonstrations are cloned.

    Raises:
        ConfigurationError: for an unknown task, or a number of steps whose half holds no demonstration.
    """
    task = adroit_task(name)
    steps = _steps(steps, task)
    source = demonstrations.storage.data_path / "metadata.json"

    def write(folder: Path) -> MinariDataset:
        recorded = [demonstration_buffer(episode, task) for episode in demonstrations.iterate_episodes()]
        kept = _fitting(recorded, steps // 2)
        taken = sum(map(len, kept))
        policy = clone(recorded, task, cloning, seed=seed)
        made = record(policy, task, steps=steps - taken, seed=seed, level=level)
        return _write(
            [*kept, *made],
            folder,
            task,
            level=level,
            description=(
                f"{len(kept)} demonstrations of {demonstrations.id} ({taken} steps), then {len(made)} roll-outs of a "
                "policy cloned from all of its demonstrations, its actions sampled."
            ),
            algorithm="demonstrations and behaviour cloning",
            extra={"demonstrations": len(kept), "demonstrations_from": demonstrations.id},
        )

    content = content_hash(demonstrations.iterate_episodes())
    key = _key(task, level, steps=steps, seed=seed, content=content, cloning=cloning, torch=torch.__version__)
    return converted(key, source, version=_VERSION, write=write)


def clone(
    episodes: Sequence[EpisodeBuffer], task: AdroitTask, cloning: BehaviorCloning = CLONING, *, seed: int
) -> Policy:
    """Return the policy cloned from episodes in the environment's spaces."""
    with tempfile.TemporaryDirectory() as folder:
        dataset = _write(episodes, Path(folder) / "dataset", task, level="demonstrations", description="", algorithm="")
        logged = Logged.of(dataset)
    return fit_log_prob(logged, config=cloning, seed=seed, episodes=np.ones(len(logged), dtype=bool)).policy()


def record(policy: Policy, task: AdroitTask, *, steps: int, seed: int, level: str) -> tuple[EpisodeBuffer, ...]:
    """Return roll-outs of a policy with `steps` steps together; the last is cut and truncated where that is reached.

    Resets depend on `seed` and `level`, so that the roll-outs of a clone do not start where its demonstrations do.
    """
    count = -(-steps // task.horizon)
    seeds: list[int] = derive(seed, "adroit data", task.name, level).integers(0, 2**31 - 1, size=count).tolist()
    envs = make_vec_env(task.name, min(_AT_ONCE, count))
    try:
        longest = min(task.horizon, steps)
        made = roll_out(envs, policy, seeds=seeds, horizon=longest, policy_seed=seed, record=_RECORDING)
    finally:
        envs.close()
    *whole, last = made.episodes
    return (*whole, _cut(last, steps - len(whole) * task.horizon))


def demonstration_buffer(episode: EpisodeData, task: AdroitTask) -> EpisodeBuffer:
    """Return a demonstration as roll-outs are recorded: clipped actions, D4RL's rewards, the stock ones in infos."""
    following = np.asarray(episode.observations, dtype=np.float64)[1:]
    rewards = np.asarray(episode.rewards, dtype=np.float64)
    infos = {name: _of_steps(rows, len(rewards)) for name, rows in (episode.infos or {}).items() if _is_flat(rows)}
    if "stock_reward" not in infos:
        if reward_convention(rewards, following, task) == "stock":
            rewards = d4rl_reward(rewards, following, task)
        infos["stock_reward"] = stock_reward(rewards, following, task)
    return episode_buffer(
        observations=np.asarray(episode.observations, dtype=np.float64),
        actions=np.clip(episode.actions, -1.0, 1.0).astype(np.float32),
        rewards=rewards,
        terminations=episode.terminations,
        truncations=episode.truncations,
        infos=infos,
    )


def _is_flat(rows: object) -> bool:
    return isinstance(rows, np.ndarray)


def _of_steps(rows: npt.NDArray[Any], steps: int) -> npt.NDArray[Any]:
    """Return an info's T rows, as `roll_out` records them: the reset's, which Minari has, is left out."""
    return rows[1:] if len(rows) == steps + 1 else rows


def _fitting(episodes: Sequence[EpisodeBuffer], steps: int) -> Sequence[EpisodeBuffer]:
    """Return the first episodes that have no more than `steps` steps together."""
    totals = np.cumsum([len(episode) for episode in episodes])
    fitting = int(np.searchsorted(totals, steps, side="right"))
    if not fitting:
        raise ConfigurationError(
            f"Half of the dataset is {steps} steps, and the first demonstration alone has {totals[0]}: raise steps."
        )
    return episodes[:fitting]


def _cut(episode: EpisodeBuffer, steps: int) -> EpisodeBuffer:
    if steps == len(episode):
        return episode
    return episode_buffer(
        observations=map_tree(lambda rows: rows[: steps + 1], episode.observations),
        actions=map_tree(lambda rows: rows[:steps], episode.actions),
        rewards=episode.rewards[:steps],
        terminations=episode.terminations[:steps],
        truncations=np.arange(steps) == steps - 1,
        infos={name: rows[:steps] for name, rows in (episode.infos or {}).items()},
        seed=episode.seed,
    )


def _steps(steps: int | None, task: AdroitTask) -> int:
    chosen = task.human_steps if steps is None else steps
    if chosen < 1:
        raise ConfigurationError(f"steps must be at least 1, got {steps}.")
    return chosen


def _key(task: AdroitTask, level: str, **settings: object) -> str:
    """Return what a dataset depends on beside the file that it is made from."""
    return fingerprint(task=task.name, level=level, versions=installed_versions(), **settings)


def _write(
    episodes: Sequence[EpisodeBuffer],
    folder: Path,
    task: AdroitTask,
    *,
    level: str,
    description: str,
    algorithm: str,
    extra: dict[str, Any] | None = None,
) -> MinariDataset:
    """Write episodes with the infos that all of them have."""
    shared = set[str].intersection(*(set(episode.infos or {}) for episode in episodes))
    infos = [{key: (episode.infos or {})[key] for key in sorted(shared)} for episode in episodes]
    spec, env = env_spec(task.name), make_env(task.name)
    env.close()
    return dataset_from_episodes(
        [replace(episode, infos=rows) for episode, rows in zip(episodes, infos, strict=True)],
        directory=folder,
        card=DatasetCard(
            dataset_id=f"oat_gym/{task.name}-{level}-v0",
            description=f"{description} {_REWARDS}",
            author="The oat_gym developers",
            algorithm_name=algorithm,
            env_spec=spec,
            eval_env_spec=spec,
            requirements=REQUIREMENTS,
            extra=extra or {},
        ),
        observation_space=env.observation_space,
        action_space=env.action_space,
    )
