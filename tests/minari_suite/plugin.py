"""A pytest plugin that runs Minari's own test-suite against oat_gym; see `run.py`.

Modes, by `--oat-gym-mode`: "baseline" changes nothing; "wrapped" hands each dataset that Minari's functions create or
load through `AugmentedDataset(..., count=0)` before a test sees it; "storage" adds the data format "oat" to the formats
that Minari's tests are parametrised with; "both" does both.
"""

import functools
from collections.abc import Callable

import pytest

MODES = ("baseline", "wrapped", "storage", "both")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--oat-gym-mode", choices=MODES, default="baseline")


def pytest_configure(config: pytest.Config) -> None:
    """Patch Minari before its test modules import names from it."""
    mode = config.getoption("--oat-gym-mode")
    if mode == "baseline":
        return
    from minari.dataset import _storages

    formats = _storages.get_storage_keys()
    import oat_gym  # noqa: F401  (registers the format "oat")

    if mode == "wrapped":
        _storages.get_storage_keys = lambda: formats
    if mode in ("wrapped", "both"):
        _wrap_creation()


def _wrap_creation() -> None:
    import minari
    from minari import utils
    from minari.storage import local

    for name in ("create_dataset_from_buffers", "combine_datasets"):
        wrapped = _wrapping(getattr(utils, name))
        setattr(utils, name, wrapped)
        setattr(minari, name, wrapped)
    local.load_dataset = minari.load_dataset = _wrapping(minari.load_dataset)
    minari.DataCollector.create_dataset = _wrapping(minari.DataCollector.create_dataset)


def _wrapping(create: Callable) -> Callable:
    from oat_gym import AugmentedDataset

    @functools.wraps(create)
    def created(*args: object, **kwargs: object) -> AugmentedDataset:
        return AugmentedDataset(create(*args, **kwargs), count=0)

    return created
