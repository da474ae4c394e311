"""Sepsis visits from CLIF tables as a Minari dataset (paper, section 3.2 and appendix D)."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Literal, get_args

import minari
import numpy as np
from gymnasium import spaces
from minari.data_collector import EpisodeBuffer

from oat_gym.domains._data import converted
from oat_gym.domains.sepsis_attributes import ATTRIBUTES, HIGH, LOW, NAMES
from oat_gym.domains.sepsis_belief import believed_values, current_values, last_known
from oat_gym.domains.sepsis_stages import PENALTIES, STAGES, pressure_shock, rewards, stages
from oat_gym.domains.sepsis_tables import Tables, find_tables
from oat_gym.domains.sepsis_visits import Visit, read_visits
from oat_gym.errors import ConfigurationError, InvalidDataError
from oat_gym.io.writing import DatasetCard, dataset_from_episodes, episode_buffer

logger = logging.getLogger(__name__)

DATASET_ID = "oat_gym/sepsis-clif-v0"
ACTIONS = ("no treatment", "antibiotics", "oxygen", "antibiotics and oxygen")
"""What action 0 to 3 mean: antibiotics + 2 * oxygen, the treatments in effect after the event."""
TRAIN_SHARE = 0.8
"""Share of the patients whose visits are the training split."""
OBSERVATION_SPACE = spaces.Dict(
    recorded=spaces.MultiBinary(len(NAMES)),
    values=spaces.Box(LOW.astype(np.float32), HIGH.astype(np.float32), dtype=np.float32),
)
"""`values`: the 15 attributes in their units, imputed between measurements; `recorded`: 1 where one was measured."""
ACTION_SPACE = spaces.Discrete(len(ACTIONS))
Part = Literal["all", "train", "test"]
VERSION = 1
"""Of the conversion: raised when it changes."""

_DESCRIPTION = (
    "Hospital visits with suspected infection, from CLIF tables: irregular events, 15 sepsis-related attributes "
    "(imputed by belief, with missing indicators), antibiotics x oxygen as treatments in effect, and rewards for the "
    "stages infection, inflammation, organ failure and septic shock. infos: `time` (hours since the visit's first "
    "event), `stage` (0 to 4) and `patient` (a number in no order of time), one for each of the T + 1 events. For "
    "research on methods, not for treatment."
)


def sepsis_clif(path: str | os.PathLike[str] | None = None, *, part: Part = "all") -> minari.MinariDataset:
    """Return the visits with suspected infection of CLIF tables (`sepsis_visits` says which), an episode a visit.

    Without `path` it is MIMIC-IV's open demo: 83 visits of 70 patients, 21,595 events. A visit of N events gives
    T = N - 1 steps, since what the last event's treatment led to is not recorded. The last step terminates where the
    visit's discharge is recorded, death included, for nothing can be earned after it; otherwise it is truncated. The
    reward of a step is that of the change of stage until the next event (`sepsis_stages.rewards`). Converted once, into
    the cache (OAT_GYM_CACHE).

    `OAT(times="time")` mines it in real time; `features=("values",)` leaves the indicators out of the mining.

    Args:
        path: a folder of CLIF tables (`clif_vitals.parquet` ...).
        part: the split by patients: 80% of them for training, the others for testing; no patient is in both.

    Raises:
        DatasetNotFoundError: if the data is not there; the message says how to get it.
        ConfigurationError: without pyarrow (`pip install oat-gym[sepsis]`), or for another part.
        InvalidDataError: if the tables are not as CLIF defines them.
    """
    if part not in get_args(Part):
        raise ConfigurationError(f"part must be one of {', '.join(get_args(Part))}; got {part!r}.")
    dataset = convert(find_tables(path))
    return dataset if part == "all" else train_test(dataset)[part == "test"]


def train_test(dataset: minari.MinariDataset) -> tuple[minari.MinariDataset, minari.MinariDataset]:
    """Return the training and the test visits: 80% of the patients and the others.

    The paper splits by calendar; the dates of open records are shifted for each patient, so that they have no order.

    Raises:
        InvalidDataError: if the dataset has fewer than two patients.
    """
    numbers = np.unique([_patient(episode) for episode in dataset])
    if len(numbers) < 2:
        raise InvalidDataError(f"A split by patients needs two of them or more; the dataset has {len(numbers)}.")
    edge = numbers[int(np.clip(round(TRAIN_SHARE * len(numbers)), 1, len(numbers) - 1))]
    return (
        dataset.filter_episodes(lambda episode: _patient(episode) < edge),
        dataset.filter_episodes(lambda episode: _patient(episode) >= edge),
    )


def episode_of(visit: Visit) -> EpisodeBuffer:
    """Return a visit of two events or more as an episode in `OBSERVATION_SPACE` and `ACTION_SPACE`."""
    known = last_known(visit.recorded, visit.hours)
    shock = visit.vasopressor | pressure_shock(visit.recorded, visit.hours)
    stage = stages(current_values(known), shock)
    last = np.arange(len(stage) - 1) == len(stage) - 2
    values = np.clip(believed_values(known), LOW, HIGH).astype(np.float32)
    return episode_buffer(
        observations={"recorded": (~np.isnan(visit.recorded)).astype(np.int8), "values": values},
        actions=(visit.antibiotics + 2 * visit.oxygen.astype(np.int64))[:-1],
        rewards=rewards(stage),
        terminations=last & visit.ended,
        truncations=last & (not visit.ended),
        infos={"time": visit.hours, "stage": stage, "patient": np.full(len(stage), visit.patient)},
    )


def convert(tables: Tables) -> minari.MinariDataset:
    """Return all visits of some tables, from the cache where they were converted before."""
    name = f"sepsis-clif-{tables.content()}"
    return converted(name, tables.file("hospitalization"), version=VERSION, write=partial(_write, tables))


def _write(tables: Tables, directory: Path) -> minari.MinariDataset:
    visits = read_visits(tables)
    kept = [visit for visit in visits if len(visit.hours) > 1]
    if len(kept) < len(visits):
        logger.warning("%d visits of a single event were left out.", len(visits) - len(kept))
    if not kept:
        raise InvalidDataError(f"No visit of {tables.folder} has two events; a step goes from one event to the next.")
    return dataset_from_episodes(
        (episode_of(visit) for visit in kept),
        directory=directory,
        card=_card(left_out=len(visits) - len(kept)),
        observation_space=OBSERVATION_SPACE,
        action_space=ACTION_SPACE,
    )


def _card(*, left_out: int) -> DatasetCard:
    return DatasetCard(
        dataset_id=DATASET_ID,
        description=_DESCRIPTION,
        author="CLIF consortium (format), MIT Laboratory for Computational Physiology (open demo)",
        algorithm_name="clinicians",
        extra={
            "attributes": list(NAMES),
            "units": [attribute.unit for attribute in ATTRIBUTES],
            "actions": list(ACTIONS),
            "stages": list(STAGES),
            "penalties": list(PENALTIES),
            "visits_left_out": left_out,
        },
    )


def _patient(episode: minari.EpisodeData) -> int:
    return int(episode.infos["patient"][0])


DATASETS: dict[str, Callable[[], minari.MinariDataset]] = {
    "sepsis-clif": sepsis_clif,
    "sepsis-clif-train": partial(sepsis_clif, part="train"),
    "sepsis-clif-test": partial(sepsis_clif, part="test"),
}
"""Name of each dataset and the function that opens it."""
