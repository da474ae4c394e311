"""`oat-gym inspect`: what a dataset holds, and what mining finds in it."""

from __future__ import annotations

from typing import Annotated

import typer

from oat_gym.augmenters.oat import OAT
from oat_gym.cli._shared import Dataset, Seed, open_source, out, parse_length
from oat_gym.cli._tables import print_mining, print_summary
from oat_gym.dataset import AugmentedDataset
from oat_gym.errors import ShortEpisodesError
from oat_gym.mining import MiningConfig
from oat_gym.progress import progress_bar
from oat_gym.report import real_episodes, summarize


def inspect(
    dataset: Dataset,
    mine: Annotated[bool, typer.Option(help="Also mine the dataset: clusters, supports and PST sets.")] = True,
    seed: Seed = 0,
    length: Annotated[str, typer.Option(help='Steps of a sub-trajectory (W), or "auto".')] = "20",
    top: Annotated[int, typer.Option(help="How many PST sets to show, the best supported first.")] = 5,
) -> None:
    """Show spaces, lengths, returns, supports, PST sets and seam jumps of DATASET, real or augmented."""
    config = MiningConfig(n_clusters="auto", length=parse_length(length), top=top)
    data = open_source(dataset)
    print_summary(summarize(data))
    if isinstance(data, AugmentedDataset) and data.synthesis.count and data.synthesis.sampler.mining is not None:
        print_mining(data.mining, len(data.source))
    elif mine:
        real = real_episodes(data)
        try:
            with progress_bar() as progress:
                result = OAT(mining=config).mine(real, seed=seed, progress=progress)
        except ShortEpisodesError as error:  # the summary is what was asked for, and stands
            advice = f"Use --length {error.length}." if error.length else error.advice
            out.print(f"Not mined. {error.finding} {advice}", markup=False)
            return
        print_mining(result, len(real))
