"""What the commands share: the application, the console, the options, and opening and configuring by name."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Generator
from typing import Annotated, Any

import typer
from minari import MinariDataset
from rich.console import Console

from oat_gym import domains
from oat_gym._ids import did_you_mean
from oat_gym.augmenters import AUGMENTERS, Augmenter
from oat_gym.dataset import find_source
from oat_gym.embedded import EMBEDDED
from oat_gym.errors import ConfigurationError, DatasetNotFoundError, InvalidDataError, ShortEpisodesError
from oat_gym.io.d4rl import is_d4rl_path
from oat_gym.mining import MiningConfig

app = typer.Typer(no_args_is_help=True, pretty_exceptions_enable=False, add_completion=False)
out = Console(highlight=False, soft_wrap=True)

Dataset = Annotated[
    str,
    typer.Argument(help="Id of a local Minari dataset, path of a D4RL file, or a name of ours such as maze2d-umaze."),
]
Factor = Annotated[float, typer.Option(help="Episodes in all, as a multiple of the source's.")]
Seed = Annotated[int, typer.Option(help="Seed of everything random.")]


def open_source(name: str) -> MinariDataset:
    """Return the dataset of a name: one of `oat_gym.domains.DATASETS`, a local Minari id, or a D4RL file.

    Raises:
        ConfigurationError, DatasetNotFoundError: for any other name; the message has the one that may be meant.
    """
    if name in domains.DATASETS:
        return domains.load(name)
    try:
        return find_source(name)
    except (ConfigurationError, DatasetNotFoundError) as error:
        near = did_you_mean(name, (*domains.DATASETS, *EMBEDDED))
        if not near and "/" not in name and not is_d4rl_path(name):
            near = f" The names are {', '.join(sorted(domains.DATASETS))}."
        raise type(error)(f"{error}{near}") from error


@contextlib.contextmanager
def length_advice(advice: str) -> Generator[None]:
    """Where no episode has room for a sub-trajectory, say `advice` (with a `{length}`) in place of a line of Python."""
    try:
        yield
    except ShortEpisodesError as error:
        if error.length < 1:
            raise
        raise InvalidDataError(f"{error.finding} {advice.format(length=error.length)}") from error


def check_choice(option: str, value: str, choices: tuple[str, ...]) -> None:
    """Raise `ConfigurationError` unless the value of an option is one of its choices."""
    if value not in choices:
        raise ConfigurationError(f"{option} must be one of {', '.join(choices)}, got {value!r}.")


def find_augmenter(name: str) -> Augmenter:
    """Return the augmenter of a name with its defaults; `ConfigurationError` for a name that is not there."""
    if name not in AUGMENTERS:
        raise ConfigurationError(f"There is no augmenter {name!r}; choose one of {', '.join(AUGMENTERS)}.")
    return AUGMENTERS[name]()


def configure(name: str, *, length: str | None = None, top: int | None = None) -> Augmenter:
    """Return the augmenter of a name, with `--length` and `--top` where they are given.

    Raises:
        ConfigurationError: for a name that is not there, a bad value, or an option that the method does not have.
    """
    augmenter = find_augmenter(name)
    given = {"length": None if length is None else parse_length(length), "top": top}
    for option, value in given.items():
        if value is not None:
            augmenter = _replace(augmenter, option, value)
    return augmenter


def parse_length(text: str) -> Any:
    """Return the value of `--length`: a number of steps or "auto"."""
    if text != "auto" and not (text.isascii() and text.isdecimal()):
        raise ConfigurationError(f'--length must be a number of steps or "auto", got {text!r}.')
    return "auto" if text == "auto" else int(text)


def _has(augmenter: Augmenter, option: str) -> bool:
    mining = getattr(augmenter, "mining", None)
    return isinstance(mining, MiningConfig) or option in {field.name for field in dataclasses.fields(augmenter)}


def _replace(augmenter: Augmenter, option: str, value: Any) -> Augmenter:
    if not _has(augmenter, option):
        others = [name for name, kind in AUGMENTERS.items() if _has(kind(), option)]
        raise ConfigurationError(
            f"--{option} is no option of the augmenter {augmenter.name!r}, only of {', '.join(others)}: leave it out."
        )
    mining = getattr(augmenter, "mining", None)
    if isinstance(mining, MiningConfig):
        changes: dict[str, Any] = {"mining": dataclasses.replace(mining, **{option: value})}
    else:
        changes = {option: value}
    return dataclasses.replace(augmenter, **changes)
