"""Two finite models of sepsis with exact values: ICU-Sepsis, and Oberst and Sontag's simulator as a table.

ICU-Sepsis (Choudhary et al., "ICU-Sepsis: a benchmark MDP built from real medical data", RLC 2024) has 716 states,
clusters of MIMIC-III patients, and 25 actions, five levels of fluids by five of vasopressors. Surviving earns 1.
Oberst and Sontag's process ("Counterfactual off-policy evaluation with Gumbel-max structural causal models", ICML
2019) has 1,440 states of eight categories and 8 actions, antibiotics x ventilation x vasopressors. Discharge earns 1,
death -1.

Each is there twice: `icu-sepsis` and `sepsis-mdp` observe the number of the state, which tabular estimators take, and
`icu-sepsis-features` and `sepsis-mdp-features` observe what the state stands for, which methods that model states need
(the 47 features of the centres; the eight categories). The episodes are the same.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache, partial
from importlib import metadata
from pathlib import Path
from typing import Any, Literal, get_args

import minari
import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from oat_gym._rng import derive
from oat_gym.domains import _tabular_view as views
from oat_gym.domains._data import converted, find_file
from oat_gym.domains._tabular import (
    FloatArray,
    IntArray,
    TabularMDP,
    mixture,
    optimal_policy,
    policy_value,
    sample_episodes,
)
from oat_gym.domains.task import Task
from oat_gym.domains.truth import Truth, exact_truth
from oat_gym.errors import ConfigurationError, DatasetNotFoundError, InvalidDataError
from oat_gym.io.writing import DatasetCard, dataset_from_episodes
from oat_gym.ope.policies import draw
from oat_gym.ope.policy import Policy
from oat_gym.spaces import Batch

Model = Literal["icu-sepsis", "sepsis-mdp"]

ICU_FILE = "sepsis/icu_sepsis/dynamics.npz"
MDP_FILE = "sepsis/sepsis_sim/oberst_sontag_sepsis_mdp_sparse.npz"
GAMMA = 0.995
"""The discount that "optimal" and "worst" policies are optimal and worst for."""

CATEGORIES = (
    "diabetes",
    "heart rate",
    "systolic pressure",
    "oxygen",
    "glucose",
    "antibiotics",
    "vasopressors",
    "ventilation",
)
"""What the eight numbers of a `sepsis-mdp-features` observation mean."""
SIZES = (2, 3, 3, 2, 5, 2, 2, 2)
"""Number of levels of each of `CATEGORIES`: low, normal, high; low, normal (oxygen); five (glucose); no, yes."""

_VERSION = 1  # raise it when the logs change
_DEATH, _SURVIVAL, _STATES = 713, 714, 716  # of ICU-Sepsis; 715 follows both
_PATIENTS, _LONGEST = 150, 200
_SOFT = {"icu-sepsis": 0.9, "sepsis-mdp": 0.75}  # share of the first part in the behaviour policy, the rest uniform
_ICU_HELP = (
    f"Install it (`pip install icu-sepsis`; it is read, not imported), or set OAT_GYM_DATA to a folder that holds "
    f"{ICU_FILE}, or pass path= to the file dynamics.npz of icu-sepsis 2."
)
_MDP_HELP = (
    f"Set OAT_GYM_DATA to a folder that holds {MDP_FILE}, or pass path= to the file (made from the matrices of "
    "clinicalml/gumbel-max-scm, diab_txr_mats-replication.pkl, as arrays without pickle: shape, tx_idx, tx_val)."
)


@dataclass(frozen=True, eq=False)
class SepsisModel:
    """A finite model of sepsis and its policies, tables (S, A) of probabilities.

    Attributes:
        mdp: the process.
        behavior: the policy that the logs follow.
        targets: the policies to evaluate.
        features: how states are shown as features.
    """

    mdp: TabularMDP
    behavior: FloatArray
    targets: Mapping[str, FloatArray]
    features: views.View

    def view(self, features: bool) -> views.View:
        """Return how states are shown."""
        return self.features if features else views.numbers(self.mdp.n_states)


def sepsis_model(name: Model, path: str | os.PathLike[str] | None = None) -> SepsisModel:
    """Return "icu-sepsis" or "sepsis-mdp", read from its published matrices.

    Args:
        name: which.
        path: the .npz file, or a folder that holds it; `None`: the data folder, or an installed `icu-sepsis`.

    Raises:
        ConfigurationError: for another name.
        DatasetNotFoundError: if the file is not there; the message says how to get it.
        InvalidDataError: if it does not hold what is expected.
    """
    if name not in get_args(Model):
        raise ConfigurationError(f"The tabular models are {', '.join(get_args(Model))}; got {name!r}.")
    source = _source(name, path)
    return _read(name, source, source.stat().st_mtime_ns)


def sepsis_log(
    name: Model, *, features: bool = False, path: str | os.PathLike[str] | None = None
) -> minari.MinariDataset:
    """Return 150 patients of a finite sepsis model under its behaviour policy, as a Minari dataset.

    infos hold `log_prob`, the behaviour policy's log-probability of the action taken, and `state`. An episode
    terminates with death, survival or discharge; after 200 steps it is truncated. Made once, into the cache
    (OAT_GYM_CACHE); the same file gives the same bytes.

    Args:
        name: "icu-sepsis" (behaviour: the clinicians' policy of MIMIC-III, with one action in ten uniform) or
            "sepsis-mdp" (the optimal policy, with one action in four uniform).
        features: observe what states stand for, not their numbers.
        path: as in `sepsis_model`.

    Raises:
        DatasetNotFoundError, InvalidDataError: as in `sepsis_model`.
    """
    title = f"{name}-features" if features else name
    return converted(title, _source(name, path), version=_VERSION, write=partial(_write, name, features, path))


def _write(name: Model, features: bool, path: str | os.PathLike[str] | None, folder: Path) -> minari.MinariDataset:
    model = sepsis_model(name, path)
    view = model.view(features)
    episodes = sample_episodes(
        model.mdp, model.behavior, episodes=_PATIENTS, horizon=_LONGEST, seed=0, observe=view.observe
    )
    first = "the clinicians' policy" if name == "icu-sepsis" else f"the optimal policy at gamma {GAMMA}"
    title = f"{name}-features" if features else name
    card = DatasetCard(
        dataset_id=f"oat_gym/{title}-v0",
        description=f"{_PATIENTS} simulated patients of {_ORIGIN[name]}. Nothing in it is a record of a person.",
        author="The oat_gym developers",
        algorithm_name=f"{first} with probability {_SOFT[name]} at each step, else a uniform action",
    )
    return dataset_from_episodes(
        episodes,
        directory=folder,
        card=card,
        observation_space=view.space,
        action_space=spaces.Discrete(model.mdp.n_actions),
    )


_ORIGIN: dict[str, str] = {
    "icu-sepsis": "ICU-Sepsis 2 (716 states, 25 actions, estimated from MIMIC-III; PyPI icu-sepsis, MIT)",
    "sepsis-mdp": "Oberst and Sontag's sepsis simulator as a table (1,440 states, 8 actions; "
    "clinicalml/gumbel-max-scm, MIT)",
}


def _source(name: Model, path: str | os.PathLike[str] | None) -> Path:
    if name != "icu-sepsis":
        return find_file(MDP_FILE, path=path, how_to_get=_MDP_HELP)
    try:
        return find_file(ICU_FILE, path=path, how_to_get=_ICU_HELP)
    except DatasetNotFoundError:
        installed = None if path is not None else _installed("icu-sepsis", "icu_sepsis/envs/assets/dynamics.npz")
        if installed is None:
            raise
        return installed


def _installed(distribution: str, file: str) -> Path | None:
    """Return a file of an installed distribution, without importing it; `None` where it is not there."""
    try:
        found = Path(str(metadata.distribution(distribution).locate_file(file)))
    except metadata.PackageNotFoundError:
        return None
    return found if found.is_file() else None


@cache
def _read(name: Model, source: Path, modified: int) -> SepsisModel:
    """Read and solve a model once; `modified` makes a changed file another one."""
    return _read_icu(source) if name == "icu-sepsis" else _read_mdp(source)


def _read_icu(source: Path) -> SepsisModel:
    arrays = _arrays(source, ("tx_mat", "d_0", "expert_policy", "state_cluster_centers"), _ICU_HELP)
    if arrays["tx_mat"].shape != (_STATES, 25, _STATES):
        raise InvalidDataError(f"{source} has transitions of shape {arrays['tx_mat'].shape}, not (716, 25, 716).")
    states = np.arange(_STATES)
    reward = (states == _SURVIVAL).astype(np.float64)
    mdp = TabularMDP.from_dense(arrays["tx_mat"], reward, arrays["d_0"], states >= _DEATH)
    uniform = np.full((_STATES, 25), 1 / 25)
    clinicians = np.where(mdp.terminal[:, None], uniform, arrays["expert_policy"])  # published with rows of zeros there
    best, worst = optimal_policy(mdp, gamma=GAMMA), optimal_policy(mdp, gamma=GAMMA, sign=-1.0)
    return SepsisModel(
        mdp=mdp,
        behavior=mixture(clinicians, uniform, _SOFT["icu-sepsis"]),
        targets={
            "optimal": best,
            "optimal-clinicians": mixture(best, clinicians, 0.5),
            "clinicians": clinicians,
            "uniform": uniform,
            "worst-clinicians": mixture(worst, clinicians, 0.5),
            "worst": worst,
        },
        features=views.centres(np.asarray(arrays["state_cluster_centers"], dtype=np.float64), known=_DEATH),
    )


def _read_mdp(source: Path) -> SepsisModel:
    arrays = _arrays(source, ("shape", "tx_idx", "tx_val"), _MDP_HELP)
    if tuple(arrays["shape"]) != (2, 8, 720, 720):
        raise InvalidDataError(f"{source} has transitions of shape {tuple(arrays['shape'])}, not (2, 8, 720, 720).")
    mdp = _mdp(arrays["tx_idx"].astype(np.int64), arrays["tx_val"].astype(np.float64))
    uniform = np.full((mdp.n_states, 8), 1 / 8)
    best = optimal_policy(mdp, gamma=GAMMA)

    def always(action: int) -> FloatArray:
        return np.tile(np.eye(8)[action], (mdp.n_states, 1))

    return SepsisModel(
        mdp=mdp,
        behavior=mixture(best, uniform, _SOFT["sepsis-mdp"]),
        targets={
            "optimal": best,
            "optimal-noisy": mixture(best, uniform, 0.9),
            "all-treatments": always(7),
            "antibiotics": always(4),
            "no-treatment": always(0),
            "uniform": uniform,
        },
        features=views.categories(SIZES),
    )


def _mdp(index: IntArray, probability: FloatArray) -> TabularMDP:
    """Return the process of sparse transitions; `index` (4, m) is diabetes, action, state and next state."""
    diabetes, action, state, following = index
    source, target = (diabetes * 720 + state) * 8 + action, diabetes * 720 + following
    order = np.lexsort((target, source))
    reward, initial = _ends_and_starts()
    return TabularMDP(
        n_actions=8,
        source=source[order],
        target=target[order],
        probability=probability[order],
        reward=reward,
        initial=initial,
        terminal=reward != 0.0,
    )


def _ends_and_starts() -> tuple[FloatArray, FloatArray]:
    """Return rewards and initial probabilities (1440,) by the simulator's rules.

    Three or more of heart rate, pressure, oxygen and glucose off normal: death. All normal and no treatment: discharge.
    Nobody starts under treatment or at an end; a fifth of the patients has diabetes.
    """
    levels = np.stack(np.unravel_index(np.arange(np.prod(SIZES)), SIZES))
    normal = np.array([1, 1, 1, 2])[:, None]
    abnormal, treated = (levels[1:5] != normal).sum(axis=0), levels[5:].any(axis=0)
    reward = np.where(abnormal >= 3, -1.0, np.where((abnormal == 0) & ~treated, 1.0, 0.0))
    diabetes = levels[0]
    glucose = np.array([[0.05, 0.15, 0.6, 0.15, 0.05], [0.01, 0.05, 0.15, 0.6, 0.19]])[diabetes, levels[4]]
    three = np.array([0.25, 0.5, 0.25])
    start = three[levels[1]] * three[levels[2]] * np.array([0.2, 0.8])[levels[3]] * glucose
    initial = start * (~treated & (reward == 0.0))
    share = np.array([0.8, 0.2]) / np.bincount(diabetes, initial)
    return reward, initial * share[diabetes]


def _arrays(source: Path, names: tuple[str, ...], how_to_get: str) -> dict[str, npt.NDArray[Any]]:
    with np.load(source, allow_pickle=False) as file:
        missing = [name for name in names if name not in file.files]
        if missing:
            raise InvalidDataError(f"{source} lacks the arrays {missing}; it has {sorted(file.files)}. {how_to_get}")
        return {name: file[name] for name in names}


def _policies(name: Model, features: bool) -> dict[str, Policy]:
    model = sepsis_model(name)
    view = model.view(features)
    return {target: view.policy(table) for target, table in model.targets.items()}


def _truth(name: Model, gamma: float) -> Truth:
    model = sepsis_model(name)
    return exact_truth(
        {target: policy_value(model.mdp, table, gamma=gamma) for target, table in model.targets.items()},
        gamma=gamma,
        horizon=None,
        command=f'oat_gym.domains.truth("{name}", gamma={gamma})',
        note=f"Exact: a linear solve in {_ORIGIN[name]}.",
    )


def _initial_states(name: Model, features: bool, count: int, seed: int) -> Batch:
    model = sepsis_model(name)
    chances = np.broadcast_to(model.mdp.initial, (count, model.mdp.n_states))
    return model.view(features).observe(draw(chances, derive(seed, "initial states")))


def _task(name: Model, features: bool, title: str) -> Task:
    return Task(
        datasets=(title,),
        policies=partial(_policies, name, features),
        truth=partial(_truth, name),
        initial_states=partial(_initial_states, name, features),
        gamma=GAMMA,
    )


_TITLES: dict[str, tuple[Model, bool]] = {
    "icu-sepsis": ("icu-sepsis", False),
    "icu-sepsis-features": ("icu-sepsis", True),
    "sepsis-mdp": ("sepsis-mdp", False),
    "sepsis-mdp-features": ("sepsis-mdp", True),
}

DATASETS: dict[str, Callable[[], minari.MinariDataset]] = {
    title: partial(sepsis_log, name, features=features) for title, (name, features) in _TITLES.items()
}
"""Name of each dataset and the function that opens it."""

TASKS: dict[str, Task] = {title: _task(name, features, title) for title, (name, features) in _TITLES.items()}
"""Name of each task and what its datasets are evaluated with."""
