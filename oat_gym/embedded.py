"""The small datasets that come with the package, opened in place and never written to."""

from __future__ import annotations

from pathlib import Path

from oat_gym.errors import DatasetNotFoundError

EMBEDDED = {"oat_gym/maze2d-umaze-v0": "maze2d-umaze"}
"""Minari id of each embedded dataset, and its folder."""


def embedded_path(dataset_id: str) -> Path:
    """Return the data folder of an embedded dataset: in the installed package, or in a source checkout.

    Raises:
        DatasetNotFoundError: if the installation lacks it.
    """
    return embedded_file(f"{EMBEDDED[dataset_id]}/data")


def embedded_file(relative: str) -> Path:
    """Return a file or folder of `datasets/` (as "truth/adroit-door.json"): in the installed package, or a checkout.

    Raises:
        DatasetNotFoundError: if the installation lacks it.
    """
    package = Path(__file__).parent
    places = (package / "_data" / relative, package.parent / "datasets" / relative)
    for place in places:
        if place.exists():
            return place
    raise DatasetNotFoundError(f"{relative} is missing from this installation ({places[0]}): reinstall oat-gym.")
