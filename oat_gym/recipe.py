"""Recipes: a few kB that describe an augmented dataset, and how a source is found again.

A recipe names its source by Minari id and content hash, never by a path, and its augmenter by its name in
`AUGMENTERS` and its settings; reading one runs no code but the package's own.
"""

from __future__ import annotations

import json
import pathlib
from typing import Any

import minari
import numpy as np
from minari import MinariDataset
from minari.dataset.minari_dataset import parse_dataset_id
from minari.storage import get_dataset_path

from oat_gym.augmenters import AUGMENTERS
from oat_gym.cache import FORMAT_VERSION, canonical
from oat_gym.embedded import EMBEDDED, embedded_path
from oat_gym.errors import ConfigurationError, DatasetNotFoundError, InvalidDataError, OatGymError
from oat_gym.serialization import config_from_json
from oat_gym.source import Source
from oat_gym.synthesis import Synthesis

RECIPE_FILE = "recipe.json"
LIVE_RECIPE = {"live": True}
"""Stands in a temporary directory, which is of use only to the process that made it."""


def find_dataset(name: str) -> MinariDataset:
    """Return the dataset of a Minari id: from Minari's local datasets, or an embedded one.

    Raises:
        DatasetNotFoundError: if it is not on this machine; nothing is downloaded.
    """
    try:
        parse_dataset_id(name)  # also keeps "../" and absolute paths out
    except (TypeError, ValueError) as error:
        raise ConfigurationError(f"{name!r} is no dataset id of the form namespace/name-v0.") from error
    if (get_dataset_path(name) / "data").exists():
        return minari.load_dataset(name)
    if name in EMBEDDED:
        return MinariDataset(embedded_path(name))
    raise DatasetNotFoundError(
        f"The dataset {name!r} is not on this machine. Get it with `minari download {name}`, set MINARI_DATASETS_PATH "
        f"to the folder that has it, or use an embedded one: {', '.join(EMBEDDED)}."
    )


def write_recipe(synthesis: Synthesis) -> bytes:
    """Return the recipe of a plan as JSON bytes.

    Raises:
        ConfigurationError: if another machine could not follow it: a source without a dataset of its own on disk, or
            an augmenter that is the user's own code.
    """
    augmenter, dataset = synthesis.augmenter, synthesis.source.dataset
    if AUGMENTERS.get(augmenter.name) is not type(augmenter):
        raise ConfigurationError(
            f"A recipe names a method of oat_gym.AUGMENTERS ({', '.join(AUGMENTERS)}), and {augmenter!r} is not one: "
            "save the episodes themselves (lazy=False)."
        )
    try:
        found = find_dataset(dataset.id)
    except DatasetNotFoundError as error:
        raise ConfigurationError(f"The source of a recipe must be an installed dataset: {error}") from error
    if found.storage.data_path.resolve() != pathlib.Path(dataset.storage.data_path).resolve():
        raise ConfigurationError(
            f"The source calls itself {dataset.id!r} but is another dataset than the installed one of that id. Save "
            "it under an id of its own first, or save the episodes themselves (lazy=False)."
        )
    everything = np.array_equal(synthesis.source.ids, np.arange(found.storage.total_episodes))
    recipe = {
        "format": FORMAT_VERSION,
        "source": {
            "id": dataset.id,
            "episodes": None if everything else synthesis.source.ids.tolist(),
            "content": synthesis.source.fingerprint,
        },
        "augmenter": {"name": augmenter.name, "settings": canonical(augmenter)},
        "count": synthesis.count,
        "seed": synthesis.seed,
    }
    return json.dumps(recipe, indent=1).encode()


def open_recipe(data_path: pathlib.Path) -> Synthesis | None:
    """Return the plan that a dataset directory describes; None where it has none (all its episodes were appended).

    Raises:
        InvalidDataError: for a recipe that is damaged, of a newer format, or of another process.
        DatasetNotFoundError: if the source is not on this machine.
    """
    path = data_path / RECIPE_FILE
    if not path.exists():
        return None
    try:
        recipe: Any = json.loads(path.read_text())
        if recipe == LIVE_RECIPE:
            raise InvalidDataError(
                f"{data_path} belongs to an augmented dataset in the memory of another process. Save it there with "
                "data.save(dataset_id) and load it by its id."
            )
        if recipe["format"] != FORMAT_VERSION:
            raise InvalidDataError(
                f"{path} has format {recipe['format']!r}; this version reads {FORMAT_VERSION}: update oat_gym."
            )
        return _plan_of(recipe, path)
    except OatGymError:
        raise
    except (KeyError, TypeError, AttributeError, json.JSONDecodeError, UnicodeDecodeError) as error:
        raise InvalidDataError(f"{path} is damaged or no recipe of oat_gym: {error!r}.") from error


def _plan_of(recipe: dict[str, Any], path: pathlib.Path) -> Synthesis:
    name = recipe["augmenter"]["name"]
    if name not in AUGMENTERS:
        raise InvalidDataError(f"{path} names the augmenter {name!r}; known are {', '.join(AUGMENTERS)}.")
    augmenter = config_from_json(AUGMENTERS[name], recipe["augmenter"]["settings"])
    dataset = find_dataset(str(recipe["source"]["id"]))
    episodes = recipe["source"]["episodes"]
    if episodes is not None:
        indices = np.asarray(episodes, dtype=np.int64)
        if indices.ndim != 1 or not np.isin(indices, np.arange(dataset.storage.total_episodes)).all():
            raise InvalidDataError(f"{path} names episodes that {dataset.id!r} does not have.")
        dataset = MinariDataset(dataset.storage, episode_indices=indices)
    source = Source(dataset, expected_fingerprint=str(recipe["source"]["content"]))
    return Synthesis(source, augmenter, count=recipe["count"], seed=recipe["seed"])
