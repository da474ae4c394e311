"""`oat-gym augment`: any method on any dataset, saved as a Minari dataset."""

from __future__ import annotations

from typing import Annotated, Any

import typer
from minari.storage import get_dataset_path

from oat_gym.augmenters import AUGMENTERS
from oat_gym.cli._output import prepare_folder
from oat_gym.cli._shared import Dataset, Factor, Seed, configure, length_advice, open_source, out
from oat_gym.dataset import AugmentedDataset
from oat_gym.errors import ConfigurationError
from oat_gym.export import DATA_FORMATS, check_dataset_id
from oat_gym.progress import progress_bar
from oat_gym.report import real_episodes

Method = Annotated[str, typer.Option("--augmenter", help=f"One of {', '.join(AUGMENTERS)}.")]
Length = Annotated[
    str | None, typer.Option("--length", help='Steps of a sub-trajectory (W), or "auto"; for methods that stitch.')
]
Top = Annotated[int | None, typer.Option("--top", help="How many PST sets to use, the best supported first.")]


def augment(
    dataset: Dataset,
    augmenter: Method = "oat",
    factor: Factor = 10,
    dataset_id: Annotated[str | None, typer.Option("--out", help="Id of the new dataset; NAME-AUGMENTER-v0.")] = None,
    data_format: Annotated[str, typer.Option("--format", help=f"One of {', '.join(DATA_FORMATS)}.")] = "hdf5",
    lazy: Annotated[bool, typer.Option(help="Store a recipe of a few kB in place of the episodes.")] = False,
    seed: Seed = 0,
    length: Length = None,
    top: Top = None,
) -> None:
    """Augment DATASET and save the result as a Minari dataset."""
    source = open_source(dataset)
    target = dataset_id or f"{source.spec.namespace or 'oat_gym'}/{source.spec.dataset_name}-{augmenter}-v0"
    method = configure(augmenter, length=length, top=top)
    with length_advice("Use --length {length}" + (" or --length auto." if augmenter == "oat" else ".")):
        data = AugmentedDataset(source, method, factor=factor, seed=seed)
        check_dataset_id(target)
        chosen = _data_format(data_format)
        prepare_folder(get_dataset_path().resolve(), option="Minari's folder of datasets, MINARI_DATASETS_PATH,")
        if not lazy:
            with progress_bar() as progress:
                data.fit(progress=progress)
    saved = data.save(target, data_format=chosen, lazy=lazy)
    kind = "real" if len(real_episodes(source)) == len(source) else "of the source"
    out.print(f"{target}: {len(source)} {kind} + {len(data) - len(source)} synthetic episodes.")
    out.print(f"Stored in {saved.storage.data_path}; load it with minari.load_dataset({target!r}).")


def _data_format(name: str) -> Any:
    if name not in DATA_FORMATS:
        raise ConfigurationError(f"--format must be one of {', '.join(DATA_FORMATS)}, got {name!r}.")
    return name
