"""`oat-gym demo`: the embedded Maze2D dataset, augmented and drawn."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from oat_gym import plots
from oat_gym.augmenters.oat import OAT
from oat_gym.cli._output import prepare_folder
from oat_gym.cli._shared import Factor, Seed, out
from oat_gym.cli._tables import print_mining
from oat_gym.dataset import AugmentedDataset
from oat_gym.domains import maze2d
from oat_gym.errors import ConfigurationError, DatasetExistsError
from oat_gym.export import check_dataset_id
from oat_gym.generation import VAEMDPConfig
from oat_gym.mining import MiningConfig
from oat_gym.progress import progress_bar
from oat_gym.recipe import find_dataset

DEMO_ID = "maze2d-umaze/oat-v0"
DEMO_CONFIG = OAT(
    mining=MiningConfig(n_clusters="auto", candidates=tuple(range(4, 11)), switch_penalty=20.0, top=3),
    model=VAEMDPConfig(max_updates=600),
    features=("achieved_goal",),
)
"""Three PST sets, as in the paper's Fig. 4, of clusters of places in the maze."""


def demo(
    folder: Annotated[Path, typer.Option("--out", help="Folder for the dataset and the picture.")] = Path(
        "oat-gym-demo"
    ),
    factor: Factor = 10,
    seed: Seed = 0,
) -> None:
    """Augment the embedded Maze2D-umaze dataset, save it, and draw the paper's Fig. 4.

    Everything is written to one folder; run it again and it is read from the cache.
    """
    os.environ["MINARI_DATASETS_PATH"] = str((folder / "datasets").resolve())
    data = AugmentedDataset(maze2d.umaze(), DEMO_CONFIG, factor=factor, seed=seed)
    if len(data) == len(data.source):
        raise ConfigurationError(f"The demo shows synthetic episodes: --factor must be more than 1, got {factor:g}.")
    prepare_folder(folder)
    saved = _saved_demo(data)
    with progress_bar() as progress:
        data.fit(progress=progress)
        if not saved:
            data.save(DEMO_ID)
        picture = folder / "figure4.png"
        progress("Drawing", 0, 1)
        draw_figure4(data, picture)
        progress("Drawing", 1, 1)
    print_mining(data.mining, len(data.source))
    out.print(f"{len(data.source)} real + {len(data) - len(data.source)} synthetic episodes, {data.total_steps} steps.")
    out.print(f"Picture: {picture}")
    out.print(f"Dataset: {DEMO_ID} in {folder / 'datasets'}. To load it:")
    out.print(f"  MINARI_DATASETS_PATH={folder / 'datasets'} minari show {DEMO_ID}")


def draw_figure4(data: AugmentedDataset, path: Path) -> None:
    """Draw the paper's Fig. 4 for an augmented Maze2D dataset: original and augmented trajectories, PST sets marked."""
    positions = [episode.observations["observation"][:, :2] for episode in data]
    n_real = len(data.source)
    sets = data.mining.sets
    marked: list[list[tuple[int, int, int]]] = [[] for _ in sets]
    for number in range(n_real, len(data)):
        for span in data.provenance(number).spans:
            if span.pst_set is not None:
                marked[span.pst_set].append((number, span.start, span.stop))
    width = data.mining.length
    plots.figure4(
        positions[:n_real],
        positions,
        maze=maze2d.UMAZE.walls(),
        spans=[[(int(i), int(t), int(t) + width) for i, t in pst.occurrences] for pst in sets],
        augmented_spans=marked,
        supports=[pst.support for pst in sets],
        path=path,
    )


def _saved_demo(data: AugmentedDataset) -> bool:
    """Return whether an earlier run saved the same dataset; another one in its place is an error."""
    try:
        check_dataset_id(DEMO_ID)
    except DatasetExistsError:
        if find_dataset(DEMO_ID).storage.metadata.get("oat_gym") != data.description():
            raise
        return True
    return False
