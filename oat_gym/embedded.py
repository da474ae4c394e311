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
    folder = EMBEDDED[dataset_id]
    package = Path(__file__).parent
    places = (package / "_data" / folder / "data", package.parent / "datasets" / folder / "data")
    for place in places:
        if place.is_dir():
            return place
    raise DatasetNotFoundError(
        f"The embedded dataset {dataset_id!r} is missing from this installation ({places[0]}): reinstall oat-gym."
    )
