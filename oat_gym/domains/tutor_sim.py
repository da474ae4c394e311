"""tutor-sim: logs of the simulated tutor `oat_gym/Tutor-v0`, the paper's four target policies, and their true values.

The paper's tutoring log (1,307 students, 142 features, 12 problems) is private. Here the expert policy of the paper,
which picks actions at random, teaches as many simulated students. Target policies are that expert and three networks
trained by deep Q-learning at the paper's learning rates, on an expert log of other students.
`datasets/build_tutoring.py` trains them, `datasets/truth_tutor_sim.py` rolls them out.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import minari
import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from minari.data_collector import EpisodeBuffer

from oat_gym._rng import reset_seeds
from oat_gym.domains._data import generated
from oat_gym.domains.dqn import DQN, QNetwork
from oat_gym.domains.rollout import Recording, RollOuts, roll_out
from oat_gym.domains.task import Task
from oat_gym.domains.truth import Truth, read_truth
from oat_gym.embedded import embedded_file
from oat_gym.envs import TUTOR_ID, tutor
from oat_gym.io.writing import DatasetCard, dataset_from_episodes
from oat_gym.ope.policies import UniformPolicy
from oat_gym.ope.policy import Policy
from oat_gym.spaces import Batch

STUDENTS = 1307
"""As many students as the paper's log has."""
SMALL = 178
"""As many as the SmartPrimer log has."""
HORIZON = 12
GAMMA = 0.9
"""The paper's discount in e-learning (its appendix A)."""
LEARNING_RATES = ("1e-3", "1e-4", "1e-5")
"""Of the paper's three networks."""
TRAINING_SEED = 1
"""Of the students whose log the networks are trained on; the datasets have seed 0."""
_VERSION = 1  # raise it when the simulator or what is recorded of it changes

_DESCRIPTION = (
    "Simulated students and oat_gym/Tutor-v0: 142 features of a log, twelve problems, actions solve, study and "
    "together at random (the paper's expert policy), normalised learning gain as the reward of the last step. Nobody's "
    "data: the student model is Bayesian knowledge tracing with parameters from the literature. infos: `log_prob` of "
    "the action taken, `time` of each decision (seconds since the first problem began)."
)


def tutor_sim(students: int = STUDENTS, *, seed: int = 0) -> minari.MinariDataset:
    """Return the log of simulated students under the expert policy: 12 steps each, terminated by the post-test.

    Observations are the 142 features of `oat_gym.envs._tutor_features.FEATURES`, float32; actions are `Discrete(3)`.
    Made once, into the cache (OAT_GYM_CACHE); 36 MB for 1,307 students.

    Args:
        students: number of episodes.
        seed: of students and actions.
    """
    write = partial(_write, students, seed)
    return generated(write, domain="tutor-sim", students=students, seed=seed, version=_VERSION)


def _write(students: int, seed: int, folder: Path) -> minari.MinariDataset:
    spec = EnvSpec(TUTOR_ID, entry_point="oat_gym.envs.tutor:TutorEnv")
    return dataset_from_episodes(
        expert_episodes(students, seed=seed),
        directory=folder,
        card=DatasetCard(
            dataset_id="oat_gym/tutor-sim-v0" if students == STUDENTS else f"oat_gym/tutor-sim-{students}-v0",
            description=_DESCRIPTION,
            author="The oat_gym developers",
            algorithm_name="uniformly random (the paper's expert policy)",
            env_spec=spec,
        ),
        observation_space=tutor.observation_space(),
        action_space=action_space(),
    )


def expert_episodes(students: int, *, seed: int) -> list[EpisodeBuffer]:
    """Return one episode of each student under the expert policy."""
    record = Recording(infos=("time",), log_prob=True)
    episodes = roll_outs(expert(), episodes=students, seed=seed, record=record).episodes
    for episode in episodes:
        assert episode.infos is not None
        after = episode.infos["time"]  # the environment says when a step ended: the next decision's time
        episode.infos["time"] = np.concatenate([np.zeros(1), after[:-1]])
    return list(episodes)


def roll_outs(policy: Policy, *, episodes: int, seed: int, record: Recording | None = None) -> RollOuts:
    """Return episodes of a policy; a seed stands for the same students whatever the policy, apart from its actions."""
    students = np.random.SeedSequence(seed).generate_state(episodes)
    envs = tutor.TutorVectorEnv(min(episodes, 1000))
    seeds = [int(student) for student in students]
    return roll_out(envs, policy, seeds=seeds, horizon=HORIZON, policy_seed=seed, record=record)


def action_space() -> spaces.Discrete:
    """Return the space of the three actions."""
    return spaces.Discrete(len(tutor.ACTIONS))


def expert() -> UniformPolicy:
    """Return the paper's expert policy, which picks actions at random."""
    return UniformPolicy(action_space())


def train_policy(learning_rate: str, dataset: minari.MinariDataset) -> QNetwork:
    """Return the network that a learning rate (of `LEARNING_RATES`) stands for, trained on an expert log."""
    return DQN(learning_rate=float(learning_rate)).fit(dataset, seed=0)


def policies() -> dict[str, Policy]:
    """Return the four target policies: the expert, and the networks with 5% of random actions.

    Raises:
        DatasetNotFoundError: if the installation lacks the networks.
    """
    space = tutor.observation_space()
    found: dict[str, Policy] = {"expert": expert()}
    for rate in LEARNING_RATES:
        path = embedded_file(f"tutor-sim/policies/dqn-{rate}.safetensors")
        found[f"dqn-{rate}"] = QNetwork.load(path, observation_space=space, action_space=action_space()).softened()
    return found


def truth(gamma: float = GAMMA) -> Truth:
    """Return the values of the target policies by roll-outs."""
    return read_truth("tutor-sim", gamma=gamma)


def initial_states(count: int, seed: int) -> Batch:
    """Return the first observations of `count` new students."""
    return tutor.TutorVectorEnv(count).reset(seed=reset_seeds(count, seed, "tutor-sim resets"))[0]


DATASETS: dict[str, Callable[[], minari.MinariDataset]] = {
    "tutor-sim": tutor_sim,
    f"tutor-sim-{SMALL}": partial(tutor_sim, SMALL),
}
"""Name of each dataset and the function that opens it."""

TASKS: dict[str, Task] = {
    "tutor-sim": Task(
        datasets=tuple(DATASETS),
        policies=policies,
        truth=truth,
        initial_states=initial_states,
        gamma=GAMMA,
        horizon=HORIZON,
        paper="tutoring",
    )
}
"""Name of each task and what its datasets are evaluated with."""
