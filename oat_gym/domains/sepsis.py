"""Sepsis: the target policies of the real visits, and how often septic shock came where treatment agreed with them.

Source: the paper, section 3.2 and appendix D. `sepsis_clif` has the data, `sepsis_stages` the rules.

>>> from oat_gym.domains import sepsis, sepsis_stages
>>> list(sepsis.TARGETS), sepsis_stages.STAGES[4]
(['dqn', 'dqn-lr-1e-4', 'dqn-lr-1e-5', 'dqn-seed-1', 'dqn-gamma-0.9'], 'septic shock')

For research on methods only: nothing here may inform the treatment of a patient.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Mapping

import minari
import numpy as np
import numpy.typing as npt
import torch

from oat_gym.cache import CacheEntry, fingerprint
from oat_gym.domains import dqn
from oat_gym.domains.dqn import DQN, QNetwork
from oat_gym.domains.sepsis_clif import ACTION_SPACE, OBSERVATION_SPACE, TRAIN_SHARE, VERSION, convert, train_test
from oat_gym.domains.sepsis_clif import DATASETS as _DATASETS
from oat_gym.domains.sepsis_stages import SHOCK
from oat_gym.domains.sepsis_tables import Tables, find_tables
from oat_gym.domains.task import Task
from oat_gym.ope.agreement import AgreementCurve, agreement_curve, agreement_rate
from oat_gym.ope.behavior import BehaviorFit, fit_log_prob
from oat_gym.ope.cloning import BehaviorCloning
from oat_gym.ope.logged import Logged
from oat_gym.ope.policy import Policy

logger = logging.getLogger(__name__)

GAMMA = 0.99
TARGETS: dict[str, tuple[DQN, int]] = {
    "dqn": (DQN(gamma=GAMMA), 0),
    "dqn-lr-1e-4": (DQN(learning_rate=1e-4, gamma=GAMMA), 0),
    "dqn-lr-1e-5": (DQN(learning_rate=1e-5, gamma=GAMMA), 0),
    "dqn-seed-1": (DQN(gamma=GAMMA), 1),
    "dqn-gamma-0.9": (DQN(gamma=0.9), 0),
}
"""Name of each target policy, its settings and its seed: the paper's five (appendix D.1)."""

_NETWORK = "network"


def policies(path: str | os.PathLike[str] | None = None) -> dict[str, Policy]:
    """Return the five target policies: DQNs trained on the training split, taking 5% random actions.

    They are trained at the first call (some 40 CPU seconds for the open demo) and kept in the cache, by the content of
    the data: weights that were learnt from patients are not part of the package, and those learnt from your tables stay
    with you.

    Args:
        path: the folder of CLIF tables, as `sepsis_clif` takes it.

    Raises:
        DatasetNotFoundError, ConfigurationError, InvalidDataError: as `sepsis_clif`.
    """
    tables = find_tables(path)
    content = tables.content()
    return {
        name: _network(tables, content, settings, seed=seed).softened() for name, (settings, seed) in TARGETS.items()
    }


def behavior(dataset: minari.MinariDataset, *, config: BehaviorCloning | None = None, seed: int = 0) -> BehaviorFit:
    """Return the cloned behaviour policy, cross-fitted by visits; `.policy()` gives it as a policy."""
    logged = Logged.of(dataset)
    everyone = np.ones(len(logged), dtype=bool)
    return fit_log_prob(logged, config=config or BehaviorCloning(), seed=seed, episodes=everyone)


def in_shock(dataset: minari.MinariDataset) -> npt.NDArray[np.bool_]:
    """Return whether each episode is ever in septic shock, (E,); of a synthetic one, whether its source is."""
    return np.array([(np.asarray(episode.infos["stage"]) == SHOCK).any() for episode in dataset], dtype=bool)


def shock_curves(dataset: minari.MinariDataset, targets: Mapping[str, Policy]) -> dict[str, AgreementCurve]:
    """Return the septic-shock rate among visits of at least some agreement with each policy (paper, appendix D.2).

    If a policy prevents shock, the curve should fall. It compares patients and not policies: the sickest are treated
    differently, and longer visits have more time to come into shock.
    """
    logged, event = Logged.of(dataset), in_shock(dataset)
    return {
        name: agreement_curve(agreement_rate(logged, policy), event, kind="at-least")
        for name, policy in targets.items()
    }


def _network(tables: Tables, content: str, settings: DQN, *, seed: int) -> QNetwork:
    """Return a network from the cache, trained on the training split where it is not there."""
    key = fingerprint(
        domain="sepsis-clif",
        content=content,
        version=VERSION,
        training=dqn.VERSION,
        share=TRAIN_SHARE,
        torch=torch.__version__,
        settings=settings,
        seed=seed,
    )
    entry = CacheEntry(key)
    with entry.lock():
        found = entry.read(_NETWORK)
        if found is not None:
            return QNetwork(found[0], OBSERVATION_SPACE, ACTION_SPACE)
        logger.info("training a target policy on the visits: %s, seed %d", settings, seed)
        network = settings.fit(train_test(convert(tables))[0], seed=seed)
        entry.write(_NETWORK, network.arrays, None)
    return network


DATASETS: dict[str, Callable[[], minari.MinariDataset]] = dict(_DATASETS)
"""Name of each dataset and the function that opens it."""

TASKS: dict[str, Task] = {
    "sepsis": Task(datasets=tuple(DATASETS), policies=policies, gamma=GAMMA, paper="sepsis"),
}
"""Name of each task and what its datasets are evaluated with: nobody knows the true values of policies on patients."""
