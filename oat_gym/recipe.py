"""Recipes: a few kB that describe an augmented dataset, and how a source is found again.

A recipe names its source by Minari id and content hash, never by a path, and its augmenter by its name in
`METHODS` and its settings; reading one runs no code but the package's own. A folder that someone else made is
checked before anything in it is followed (`check_folder`).
"""

from __future__ import annotations

import json
import pathlib
import re
from typing import Any

import h5py
import minari
import numpy as np
from minari import MinariDataset
from minari.dataset.minari_dataset import MinariDatasetSpec, parse_dataset_id
from minari.dataset.minari_storage import METADATA_FILE_NAME, MinariStorage
from minari.serialization import deserialize_space
from minari.storage import get_dataset_path

from oat_gym._ids import describe_ids
from oat_gym.augmenters import AUGMENTERS
from oat_gym.augmenters._parts import methods_in
from oat_gym.augmenters.base import Augmenter
from oat_gym.augmenters.compose import Compose
from oat_gym.augmenters.mixture import Mixture
from oat_gym.cache import FORMAT_VERSION, canonical, write_atomically
from oat_gym.embedded import EMBEDDED, embedded_path
from oat_gym.errors import ConfigurationError, DatasetNotFoundError, InvalidDataError, OatGymError, SourceChangedError
from oat_gym.provenance import METADATA_KEYS
from oat_gym.serialization import config_from_json, read_json, source_metadata
from oat_gym.source import Source
from oat_gym.synthesis import Synthesis

RECIPE_FILE = "recipe.json"
DATA_FORMAT = "oat"
APPENDED = "appended"
EPISODE_METADATA_FILE = "episode_metadata.json"
LIVE_RECIPE = {"live": True}
"""Stands in a temporary directory, which is of use only to the process that made it."""

METHODS: dict[str, type[Augmenter]] = {**AUGMENTERS, Compose.name: Compose, Mixture.name: Mixture}
"""What a recipe can name: every method, and what is made of them."""

_MAX_CHAIN = 16
_SHA256 = re.compile(r"[0-9a-f]{64}")
_METADATA_TYPES = {
    "total_episodes": int,
    "total_steps": int,
    "data_format": str,
    "observation_space": str,
    "action_space": str,
}
# What Minari, Gymnasium and h5py raise on files that are not what they expect.
_DAMAGE = (
    ArithmeticError,
    AssertionError,
    AttributeError,
    LookupError,
    MemoryError,
    OSError,
    RuntimeError,  # RecursionError and NotImplementedError are among them
    TypeError,
    ValueError,
)


def find_dataset(name: str) -> MinariDataset:
    """Return the dataset of a Minari id: from Minari's local datasets, or an embedded one.

    Raises:
        ConfigurationError: if it is no id.
        DatasetNotFoundError: if it is not on this machine; nothing is downloaded.
        InvalidDataError: if it is there and cannot be opened.
    """
    try:
        parse_dataset_id(name)  # also keeps "../" and absolute paths out
        data_path = get_dataset_path(name) / "data"
        exists = data_path.exists()
    except (OSError, TypeError, ValueError) as error:
        raise ConfigurationError(f"{name!r} is no dataset id: expected the form {describe_ids(name)}.") from error
    if exists:
        return _load(name, data_path)
    if name in EMBEDDED:
        return MinariDataset(embedded_path(name))
    raise DatasetNotFoundError(
        f"The dataset {name!r} is not on this machine. Get it with `minari download {name}`, set MINARI_DATASETS_PATH "
        f"to the folder that has it, or use an embedded one: {', '.join(EMBEDDED)}."
    )


def _load(name: str, data_path: pathlib.Path) -> MinariDataset:
    try:
        check_if_augmented(data_path)
        return minari.load_dataset(name)
    except OatGymError:
        raise
    except _DAMAGE as error:
        raise InvalidDataError(
            f"The dataset {name!r} at {data_path} cannot be opened ({type(error).__name__}: {error}). Restore it, or "
            f"get it again with `minari download {name}`."
        ) from error


def write_recipe(synthesis: Synthesis) -> bytes:
    """Return the recipe of a plan as JSON bytes.

    Raises:
        ConfigurationError: if another machine could not follow it: a source without a dataset of its own on disk, an
            augmenter that is the user's own code, or a setting that JSON does not give back.
    """
    augmenter, dataset = synthesis.augmenter, synthesis.source.dataset
    for method in reversed([*methods_in(augmenter)]):  # the parts before what is made of them
        if METHODS.get(method.name) is not type(method) or not method.cacheable:
            raise ConfigurationError(
                f"A recipe names methods of oat_gym.AUGMENTERS ({', '.join(AUGMENTERS)}), alone or in Compose and "
                f"Mixture, by settings that JSON holds, and {method!r} is not one: save the episodes themselves "
                "(lazy=False)."
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
    settings = canonical(augmenter)
    try:
        config_from_json(type(augmenter), json.loads(json.dumps(settings)), known=tuple(METHODS.values()))
    except InvalidDataError as error:
        raise ConfigurationError(f"{augmenter!r} cannot be kept in a recipe: {error}") from error
    everything = np.array_equal(synthesis.source.ids, np.arange(found.storage.total_episodes))
    recipe = {
        "format": FORMAT_VERSION,
        "source": {
            "id": dataset.id,
            "episodes": None if everything else synthesis.source.ids.tolist(),
            "content": synthesis.source.fingerprint,
            "metadata": synthesis.source.metadata_fingerprint,
        },
        "augmenter": {"name": augmenter.name, "settings": settings},
        "count": synthesis.count,
        "seed": synthesis.seed,
    }
    return json.dumps(recipe, indent=1).encode()


def write_metadata(
    path: pathlib.Path,
    synthesis: Synthesis,
    *,
    dataset_id: str | None = None,
    totals: MinariDatasetSpec | None = None,
) -> None:
    """Write `metadata.json` of an augmented dataset: the source's keys, with an id, totals and a format of its own."""
    dataset = synthesis.source.dataset
    metadata = source_metadata(dataset) | {
        "total_episodes": totals.total_episodes if totals else synthesis.n_real + synthesis.count,
        "total_steps": totals.total_steps if totals else int(synthesis.lengths.sum()),
        "data_format": DATA_FORMAT,
        "dataset_id": dataset_id or dataset.id,
        "dataset_size": dataset.storage.get_size(),
    }
    write_atomically(path / METADATA_FILE_NAME, json.dumps(metadata).encode())


def open_recipe(data_path: pathlib.Path) -> Synthesis | None:
    """Return the plan that a dataset directory describes; None where it has none (all its episodes were appended).

    Raises:
        InvalidDataError: for a recipe that is damaged, of a newer format, or of another process, and for a folder that
            `check_folder` refuses.
        DatasetNotFoundError: if the source is not on this machine.
    """
    check_folder(data_path)
    path = data_path / RECIPE_FILE
    if not path.exists():
        return None
    recipe = read_json(path)
    try:
        if recipe == LIVE_RECIPE:
            raise InvalidDataError(
                f"{data_path} belongs to an augmented dataset in the memory of another process. Save it there with "
                "data.save(dataset_id) and load it by its id."
            )
        if recipe["format"] != FORMAT_VERSION:
            raise InvalidDataError(
                f"{path} has format {recipe['format']!r}; this version reads {FORMAT_VERSION}: update oat_gym."
            )
        plan = _plan_of(recipe, path)
    except OatGymError:
        raise
    except _DAMAGE as error:
        raise InvalidDataError(f"{path} is damaged or no recipe of oat_gym: {error!r}.") from error
    _check_spaces(data_path, plan.source)
    return plan


def _plan_of(recipe: dict[str, Any], path: pathlib.Path) -> Synthesis:
    name, origin = recipe["augmenter"]["name"], recipe["source"]
    if not isinstance(name, str) or name not in METHODS:
        raise InvalidDataError(f"{path} names the augmenter {name!r}; known are {', '.join(METHODS)}.")
    for key in ("content", "metadata"):
        if not isinstance(origin[key], str) or not _SHA256.fullmatch(origin[key]):
            raise InvalidDataError(f"{path} gives {origin[key]!r} for the SHA-256 of its source's {key}.")
    augmenter = config_from_json(METHODS[name], recipe["augmenter"]["settings"], known=tuple(METHODS.values()))
    _check_chain(path)
    dataset, episodes = find_dataset(origin["id"]), origin["episodes"]
    if episodes is not None:
        total = dataset.storage.total_episodes
        if not isinstance(episodes, list) or not all(type(one) is int and 0 <= one < total for one in episodes):
            raise InvalidDataError(f"{path} names episodes that {dataset.id!r} does not have.")
        dataset = MinariDataset(dataset.storage, episode_indices=np.array(episodes, dtype=np.int64))
    source = Source(dataset, expected_fingerprint=origin["content"])
    if source.metadata_fingerprint != origin["metadata"]:
        raise SourceChangedError(
            f"The episode metadata (seeds, options, lengths) of {dataset.id!r} is no longer what the recipe at "
            f"{path} was made from. Restore that version, or augment the new one."
        )
    return Synthesis(source, augmenter, count=recipe["count"], seed=recipe["seed"])


def _check_chain(path: pathlib.Path) -> None:
    """Follow a recipe to its source, the source of that and so on, as long as they are recipes."""
    seen = [path.resolve()]
    while (following := _recipe_of_source(seen[-1])) is not None:
        if following in seen or len(seen) == _MAX_CHAIN:
            raise InvalidDataError(
                f"{path} is its own source, directly or through others, or has over {_MAX_CHAIN} recipes behind it."
            )
        seen.append(following)


def _recipe_of_source(path: pathlib.Path) -> pathlib.Path | None:
    origin = read_json(path)["source"]["id"]
    try:
        parse_dataset_id(origin)
        following = get_dataset_path(origin) / "data" / RECIPE_FILE
        return following.resolve() if following.exists() else None
    except (OSError, TypeError, ValueError):  # find_dataset says what is wrong with it
        return None


def check_if_augmented(data_path: pathlib.Path) -> None:
    """Do `check_folder` where the metadata says that the folder is an augmented dataset's."""
    if MinariStorage.read_raw_metadata(data_path).get("data_format") == DATA_FORMAT:
        check_folder(data_path)


def check_folder(data_path: pathlib.Path) -> None:
    """Check the folder of an augmented dataset before anything that it says is believed; reads no recipe.

    Raises:
        InvalidDataError: for a link (symbolic, or inside an HDF5 file), for metadata without spaces (Minari would make
            them by running the environment that the metadata names) or of wrong types, and for an appended part that
            does not have the episodes and steps that it claims.
    """
    for path in data_path.rglob("*"):
        if path.is_symlink():
            raise InvalidDataError(f"{path} is a link: a dataset's folder must hold its files itself.")
        if path.suffix == ".hdf5" and path.stat().st_size:
            _check_hdf5(path)
    metadata = _check_metadata(data_path)
    appended = data_path / APPENDED
    episodes = steps = 0
    if (appended / METADATA_FILE_NAME).exists():
        episodes, steps = _check_appended(appended, metadata)
    if not (data_path / RECIPE_FILE).exists() and (metadata["total_episodes"], metadata["total_steps"]) != (
        episodes,
        steps,
    ):
        raise InvalidDataError(
            f"The metadata at {data_path} says {metadata['total_episodes']} episodes and {metadata['total_steps']} "
            f"steps, and there are {episodes} and {steps}: it is damaged, or its {RECIPE_FILE} is missing."
        )
    edits = data_path / EPISODE_METADATA_FILE
    if edits.exists():
        _check_edits(edits, metadata["total_episodes"])


def _check_metadata(data_path: pathlib.Path) -> dict[str, Any]:
    path = data_path / METADATA_FILE_NAME
    metadata = read_json(path)
    for key, kind in _METADATA_TYPES.items():
        value: Any = metadata.get(key) if isinstance(metadata, dict) else None
        if type(value) is not kind or (isinstance(value, int) and value < 0):
            raise InvalidDataError(f"{path} is damaged: {key!r} is {value!r}, expected {kind.__name__}.")
    for key in ("observation_space", "action_space"):
        try:
            deserialize_space(metadata[key])
        except _DAMAGE as error:
            raise InvalidDataError(f"{path} is damaged: its {key!r} is no space ({error!r}).") from error
    return metadata


def _check_appended(appended: pathlib.Path, whole: dict[str, Any]) -> tuple[int, int]:
    """Return the episodes and steps of the appended part, counted; `whole` is the metadata of the dataset."""
    claimed = _check_metadata(appended)
    for key in ("observation_space", "action_space"):
        if deserialize_space(claimed[key]) != deserialize_space(whole[key]):
            raise InvalidDataError(f"{appended} has another {key} than the dataset it was added to.")
    if claimed["data_format"] not in ("hdf5", "arrow", "parquet"):
        raise InvalidDataError(f"{appended} has the format {claimed['data_format']!r}, which no appended part has.")
    total = claimed["total_episodes"]
    try:
        storage = MinariStorage.read(appended)
        steps = sum(int(part["total_steps"]) for part in storage.get_episode_metadata(range(total)))
    except _DAMAGE as error:
        raise InvalidDataError(f"{appended} is damaged: it lacks some of its {total} episodes ({error!r}).") from error
    if steps != claimed["total_steps"]:
        raise InvalidDataError(f"{appended} has {steps} steps where its metadata says {claimed['total_steps']}.")
    return total, steps


def _check_edits(path: pathlib.Path, total: int) -> None:
    edits = read_json(path)
    numbers = {str(number) for number in range(min(total, len(edits)))} if isinstance(edits, dict) else set[str]()
    for key, value in edits.items() if isinstance(edits, dict) else [("it", edits)]:
        known = key in numbers or (key.isascii() and key.isdecimal() and int(key) < total)
        if not known or not isinstance(value, dict) or {"id", "total_steps", *METADATA_KEYS} & value.keys():
            raise InvalidDataError(f"{path} is damaged: {key!r} names no episode of {total}, or no metadata of one.")


def _check_hdf5(path: pathlib.Path) -> None:
    def elsewhere(name: str, link: Any) -> str | None:
        """Return the name of what is not in the file itself; h5py stops there."""
        if not isinstance(link, h5py.HardLink):
            return name
        part = file[name]
        return name if isinstance(part, h5py.Dataset) and (part.external or part.is_virtual) else None

    try:
        with h5py.File(path, "r") as file:
            found = file.visititems_links(elsewhere)
    except _DAMAGE as error:
        raise InvalidDataError(f"{path} is damaged: {error}") from error
    if found is not None:
        raise InvalidDataError(f"{path} takes {found!r} from elsewhere by a link, which no Minari file does.")


def _check_spaces(data_path: pathlib.Path, source: Source) -> None:
    metadata = read_json(data_path / METADATA_FILE_NAME)
    for key, space in (("observation_space", source.observation_space), ("action_space", source.action_space)):
        if deserialize_space(metadata[key]) != space:
            raise InvalidDataError(
                f"The metadata at {data_path} gives another {key} than the source {source.dataset.id!r}, {space}: one "
                "of them was changed. Save the dataset again."
            )
