"""Draw what OAT mines in a dataset: the course of some features in the windows of its best-supported PST set.

    python datasets/draw_mined.py maze2d-umaze sepsis-sim icu-sepsis-features sepsis-mdp-features

Each picture is `pst.png` beside the dataset's card. The other datasets' pictures come with their own build scripts.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from oat_gym import OAT, MiningConfig, domains
from oat_gym.domains import pictures
from oat_gym.domains.sepsis_attributes import NAMES
from oat_gym.domains.sepsis_tabular import CATEGORIES
from oat_gym.envs.sepsis import OBSERVATION_SPACE as SEPSIS_SPACE
from oat_gym.spaces import FlatSpace

HERE = Path(__file__).parent
"""Cards are in the folders beside this script."""


@dataclass(frozen=True)
class Drawing:
    """What is drawn of a dataset: columns of its observations by name, mined as its card says.

    Columns are those of the array, or of the flattened observation where it is a Dict.
    """

    folder: str
    columns: dict[str, int]
    augmenter: OAT


def columns_of(names: tuple[str, ...], first: int) -> dict[str, int]:
    """Return consecutive columns from `first` on, by name."""
    return {name: first + number for number, name in enumerate(names)}


DRAWINGS = {
    "maze2d-umaze": Drawing(
        "maze2d-umaze",
        columns_of(("achieved x", "achieved y", "desired x", "desired y", "x", "y", "velocity x", "velocity y"), 0),
        OAT(),
    ),
    "sepsis-sim": Drawing(
        "sepsis-sim", columns_of(NAMES, FlatSpace.of(SEPSIS_SPACE).layout.width - len(NAMES)), OAT(times="time")
    ),
    "icu-sepsis-features": Drawing(
        "icu-sepsis",
        columns_of(tuple(f"feature {number}" for number in range(10)), 0),
        OAT(mining=MiningConfig(n_clusters=10, length=5)),
    ),
    "sepsis-mdp-features": Drawing(
        "sepsis-mdp",
        columns_of(CATEGORIES, 0),
        OAT(mining=MiningConfig(n_clusters=10, length=10)),
    ),
}


def draw(name: str) -> None:
    """Mine a dataset, write its picture, and print the support."""
    drawing, data = DRAWINGS[name], domains.load(name)
    space, episodes = FlatSpace.of(data.observation_space), list(data)
    seen = [episode.observations for episode in episodes]
    tables = [table if isinstance(table, np.ndarray) else space.flatten(table) for table in seen]
    rows = [table[:, list(drawing.columns.values())].astype(np.float64) for table in tables]
    mining = drawing.augmenter.mine(data)
    best = mining.sets[0]
    windows = np.stack([rows[episode][start : start + best.length] for episode, start in best.occurrences])
    names = tuple(drawing.columns)
    pictures.windows(windows, np.concatenate(rows), names=names, path=HERE / drawing.folder / "pst.png")
    print(f"{name}: the best set of {best.length} steps is in {best.support} of {len(episodes)} episodes")


def main() -> None:
    """Read the command line and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("datasets", nargs="+", choices=sorted(DRAWINGS))
    for name in parser.parse_args().datasets:
        draw(name)


if __name__ == "__main__":
    main()
