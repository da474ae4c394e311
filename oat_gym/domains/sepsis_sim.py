"""sepsis-sim: a log of the simulated ward `oat_gym/Sepsis-v0`, the paper's five target policies, and their true values.

The paper's records (section 3.2, appendix D) are private. Here a clinician's policy with known probabilities
(`Clinician`) treats 150 simulated patients. Target policies are networks trained by deep Q-learning at the paper's
five settings, on other patients of that clinician, each taking 5% random actions. Beside them stand policies that show
where these are: the clinician, one who looks less, and fixed treatments. `datasets/build_sepsis_sim.py` trains the
networks, `datasets/truth_sepsis_sim.py` rolls all of them out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import minari
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import VectorEnv
from minari.data_collector import EpisodeBuffer

from oat_gym._rng import reset_seeds
from oat_gym.domains._data import generated
from oat_gym.domains._sepsis_clinician import Clinician
from oat_gym.domains.dqn import QNetwork
from oat_gym.domains.rollout import Recording, roll_out
from oat_gym.domains.sepsis import GAMMA, TARGETS
from oat_gym.domains.task import Task
from oat_gym.domains.truth import Truth, read_truth
from oat_gym.embedded import embedded_file
from oat_gym.envs import SEPSIS_ID
from oat_gym.envs import register as register_environments
from oat_gym.envs._sepsis_space import ACTION_SPACE, OBSERVATION_SPACE
from oat_gym.io.writing import DatasetCard, dataset_from_episodes, episode_buffer
from oat_gym.ope.function_policy import FunctionPolicy
from oat_gym.ope.policies import EpsilonGreedyPolicy
from oat_gym.ope.policy import Policy
from oat_gym.spaces import Batch, tree_length

NAME = "sepsis-sim"
HORIZON = 1160
"""The paper's."""
VISITS = 150
TRAINING_VISITS = 600
TRAINING_SEED = 1_000_000
"""Of the patients that the networks are trained on; the dataset's begin at 0, those of the true values at 2,000,000."""

FIXED = {"no-treatment": 0, "antibiotics": 1, "oxygen": 2, "both-treatments": 3}
"""Name and action of the policies that do the same whatever they see, but for 5% random actions."""

_VERSION = 1  # raise it when the simulator, the clinician or what is recorded changes
_BEDS = 150
_DESCRIPTION = (
    "Simulated patients of oat_gym/Sepsis-v0 under a clinician's policy of known probabilities: irregular events, 15 "
    "sepsis-related attributes with about 78% missing, antibiotics x oxygen, rewards for the stages of sepsis. Nothing "
    "in it is a record of a person. infos: `time` (hours since admission) and `stage` (0 to 4) of each of the T + 1 "
    "events, `log_prob` of each of the T actions."
)


def load() -> minari.MinariDataset:
    """Return 150 visits of the simulated ward under the clinician's policy, made once, into the cache (OAT_GYM_CACHE).

    infos hold `time` (hours) and `stage`, T + 1 rows, and `log_prob` of the actions, T rows. The same versions of the
    libraries give the same bytes.
    """
    return visits_dataset(VISITS, seed=0)


def visits_dataset(visits: int, *, seed: int) -> minari.MinariDataset:
    """Return so many visits under the clinician's policy; visit v is the patient of `reset(seed=seed + v)`."""
    write = partial(write_visits, visits=visits, seed=seed)
    return generated(write, domain=NAME, visits=visits, seed=seed, version=_VERSION)


def write_visits(directory: Path, *, visits: int, seed: int) -> minari.MinariDataset:
    """Write so many visits under the clinician's policy into a new folder."""
    card = DatasetCard(
        dataset_id="oat_gym/sepsis-sim-v0",
        description=_DESCRIPTION,
        author="The oat_gym developers",
        algorithm_name=f"a clinician's stochastic policy, {Clinician()!r}",
        env_spec=EnvSpec(SEPSIS_ID, entry_point="oat_gym.envs.sepsis:SepsisEnv"),
    )
    seeds = range(seed, seed + visits)
    return dataset_from_episodes(
        record_visits(Clinician(), seeds=seeds, policy_seed=seed),
        directory=directory,
        card=card,
        observation_space=OBSERVATION_SPACE,
        action_space=ACTION_SPACE,
    )


def open_ward(beds: int = _BEDS) -> VectorEnv[Any, Any, Any]:
    """Return the simulator for so many patients at once."""
    register_environments()
    return gym.make_vec(SEPSIS_ID, num_envs=beds)


def record_visits(policy: Policy, *, seeds: Sequence[int], policy_seed: int) -> list[EpisodeBuffer]:
    """Return one visit for each seed, with `log_prob` of the actions, and time and stage of every event."""
    ward = open_ward()
    recording = Recording(infos=("time", "stage"), log_prob=True)
    result = roll_out(ward, policy, seeds=seeds, horizon=HORIZON, policy_seed=policy_seed, record=recording)
    first = _first_stages(seeds)
    return [_with_first(episode, stage) for episode, stage in zip(result.episodes, first, strict=True)]


def _first_stages(seeds: Sequence[int]) -> list[int]:
    ward = open_ward(len(seeds))
    of_each: Any = list(seeds)
    _, infos = ward.reset(seed=of_each)
    return infos["stage"].tolist()


def _with_first(episode: EpisodeBuffer, stage: int) -> EpisodeBuffer:
    """Return the episode with infos of its first event too, which happens at hour 0."""
    infos = dict(episode.infos or {})
    infos["time"] = np.concatenate(([0.0], infos["time"]))
    infos["stage"] = np.concatenate(([stage], infos["stage"]))
    return episode_buffer(
        observations=episode.observations,
        actions=episode.actions,
        rewards=np.asarray(episode.rewards),
        terminations=np.asarray(episode.terminations),
        truncations=np.asarray(episode.truncations),
        infos=infos,
        seed=episode.seed,
    )


def policies() -> dict[str, Policy]:
    """Return the target policies: the paper's five networks, the clinician, one who looks less, and fixed treatments.

    Raises:
        DatasetNotFoundError: if the installation lacks the networks.
    """
    networks: dict[str, Policy] = {name: network(name).softened() for name in TARGETS}
    plain: dict[str, Policy] = {"clinician": Clinician(), "inattentive": Clinician(attention=0.25)}
    return networks | plain | {name: always(action) for name, action in FIXED.items()}


def network(name: str) -> QNetwork:
    """Return one of the trained networks (`sepsis.TARGETS`: the paper's settings)."""
    file = embedded_file(f"sepsis-sim/policies/{name}.safetensors")
    return QNetwork.load(file, observation_space=OBSERVATION_SPACE, action_space=ACTION_SPACE)


def always(action: int, *, epsilon: float = 0.05) -> EpsilonGreedyPolicy:
    """Return the policy that takes one action, but for a share of random ones."""

    def same(observations: Batch) -> Batch:
        return np.full(tree_length(observations), action)

    return EpsilonGreedyPolicy(FunctionPolicy(same, ACTION_SPACE, batched=True), ACTION_SPACE, epsilon=epsilon)


def truth(gamma: float) -> Truth:
    """Return the stored true values (`datasets/truth/sepsis-sim.json`)."""
    return read_truth(NAME, gamma=gamma)


def initial_states(count: int, seed: int) -> Batch:
    """Return observations of `count` patients on admission."""
    of_each: Any = reset_seeds(count, seed, "sepsis-sim resets")
    return open_ward(count).reset(seed=of_each)[0]


DATASETS: dict[str, Callable[[], minari.MinariDataset]] = {NAME: load}
"""Name of each dataset and the function that opens it."""

TASKS: dict[str, Task] = {
    NAME: Task(
        datasets=(NAME,),
        policies=policies,
        truth=truth,
        initial_states=initial_states,
        gamma=GAMMA,
        horizon=HORIZON,
        paper="sepsis",
    )
}
"""Name of each task and what its datasets are evaluated with."""
