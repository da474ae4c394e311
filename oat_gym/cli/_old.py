"""The command line `oat-gym`."""

from __future__ import annotations

import dataclasses
import logging
import os
import sys
import warnings
from pathlib import Path
from typing import Annotated, Any

import typer
from minari import MinariDataset
from rich.console import Console
from rich.table import Table

import oat_gym
from oat_gym import cache_tools, domains, plots
from oat_gym.augmenters import AUGMENTERS, Augmenter
from oat_gym.augmenters.oat import OAT
from oat_gym.dataset import AugmentedDataset, find_source
from oat_gym.domains import maze2d
from oat_gym.errors import ConfigurationError, DatasetExistsError, OatGymError
from oat_gym.export import DATA_FORMATS, check_dataset_id
from oat_gym.generation import VAEMDPConfig
from oat_gym.mining import MiningConfig, MiningResult
from oat_gym.progress import progress_bar
from oat_gym.recipe import find_dataset
from oat_gym.report import DatasetSummary, GroupSummary, real_episodes, summarize

app = typer.Typer(no_args_is_help=True, pretty_exceptions_enable=False, add_completion=False)
cache_app = typer.Typer(no_args_is_help=True, help="What the cache holds, and emptying it.")
app.add_typer(cache_app, name="cache")
_WRONG_USAGE: type[Exception] = next(c for c in typer.BadParameter.__mro__ if c.__name__ == "UsageError")
"""What wrong arguments raise; typer has no public name for it."""
out = Console(highlight=False, soft_wrap=True)

DEMO_ID = "maze2d-umaze/oat-v0"
DEMO_CONFIG = OAT(
    mining=MiningConfig(n_clusters="auto", candidates=tuple(range(4, 11)), switch_penalty=20.0, top=3),
    model=VAEMDPConfig(max_updates=600),
    start="posterior",
    features=("achieved_goal",),
)
"""Three PST sets, as in the paper's Fig. 4, of clusters of places in the maze; roll-outs start where the span does."""

_NAMES = ", ".join(domains.DATASETS)
Dataset = Annotated[str, typer.Argument(help=f"Id of a local Minari dataset, path of a D4RL file, or one of {_NAMES}.")]
Method = Annotated[str, typer.Option("--augmenter", help=f"One of {', '.join(AUGMENTERS)}.")]
Factor = Annotated[float, typer.Option(help="Episodes in all, as a multiple of the source's.")]
Seed = Annotated[int, typer.Option(help="Seed of everything random.")]
Length = Annotated[str, typer.Option("--length", help='Steps of a sub-trajectory (W), or "auto".')]
Top = Annotated[int, typer.Option("--top", help="How many PST sets to use, the best supported first.")]


def main() -> None:
    """Run the command line: status 0 when it went well, 2 with one line on bad input, 130 when interrupted."""
    logging.basicConfig(level=logging.WARNING, format="oat-gym: %(message)s", stream=sys.stderr)
    warnings.simplefilter("ignore", DeprecationWarning)
    warnings.showwarning = lambda message, *_: _complain(str(message))
    try:
        app(sys.argv[1:] or ["--help"], standalone_mode=False)
    except (OatGymError, OSError) as error:
        _complain(str(error))
        sys.exit(2)
    except _WRONG_USAGE as error:
        _complain(getattr(error, "format_message", error.__str__)())
        sys.exit(2)
    except KeyboardInterrupt:
        print("oat-gym: interrupted; what was finished is kept.", file=sys.stderr)
        sys.exit(130)


def _complain(message: str) -> None:
    print(f"oat-gym: {' '.join(message.split())}", file=sys.stderr)


@app.callback()
def about() -> None:
    """Make a small offline-RL dataset larger, in a way that helps off-policy evaluation."""


@app.command()
def version() -> None:
    """Print the version."""
    out.print(oat_gym.__version__)


@app.command()
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
    saved = _saved_demo(data)
    with progress_bar() as progress:
        data.fit(progress=progress)
        if not saved:
            data.save(DEMO_ID)
        picture = folder / "figure4.png"
        progress("Drawing", 0, 1)
        draw_figure4(data, picture)
        progress("Drawing", 1, 1)
    _print_mining(data.mining, len(data.source))
    out.print(f"{len(data.source)} real + {len(data) - len(data.source)} synthetic episodes, {data.total_steps} steps.")
    out.print(f"Picture: {picture}")
    out.print(f"Dataset: {DEMO_ID} in {folder / 'datasets'}. To load it:")
    out.print(f"  MINARI_DATASETS_PATH={folder / 'datasets'} minari show {DEMO_ID}")


@app.command()
def augment(
    dataset: Dataset,
    augmenter: Method = "oat",
    factor: Factor = 10,
    dataset_id: Annotated[str | None, typer.Option("--out", help="Id of the new dataset; NAME-AUGMENTER-v0.")] = None,
    data_format: Annotated[str, typer.Option("--format", help=f"One of {', '.join(DATA_FORMATS)}.")] = "hdf5",
    lazy: Annotated[bool, typer.Option(help="Store a recipe of a few kB in place of the episodes.")] = False,
    seed: Seed = 0,
    length: Length = "20",
    top: Top = 1,
) -> None:
    """Augment DATASET and save the result as a Minari dataset."""
    source = open_source(dataset)
    target = dataset_id or f"{source.spec.namespace or 'oat_gym'}/{source.spec.dataset_name}-{augmenter}-v0"
    data = AugmentedDataset(source, _configure(augmenter, length, top), factor=factor, seed=seed)
    check_dataset_id(target)
    chosen = _data_format(data_format)
    if not lazy:
        with progress_bar() as progress:
            data.fit(progress=progress)
    saved = data.save(target, data_format=chosen, lazy=lazy)
    out.print(f"{target}: {len(data.source)} real + {len(data) - len(data.source)} synthetic episodes.")
    out.print(f"Stored in {saved.storage.data_path}; load it with minari.load_dataset({target!r}).")


@app.command()
def inspect(
    dataset: Dataset,
    mine: Annotated[bool, typer.Option(help="Also mine the dataset: clusters, supports and PST sets.")] = True,
    seed: Seed = 0,
    length: Length = "20",
    top: Top = 5,
) -> None:
    """Show spaces, lengths, returns, supports, PST sets and seam jumps of DATASET, real or augmented."""
    data = open_source(dataset)
    _print_summary(summarize(data))
    if isinstance(data, AugmentedDataset) and data.synthesis.count and data.synthesis.sampler.mining is not None:
        _print_mining(data.mining, len(data.source))
    elif mine:
        real = real_episodes(data)
        with progress_bar() as progress:
            result = OAT(mining=_mining_config(length, top)).mine(real, seed=seed, progress=progress)
        _print_mining(result, len(real))


@cache_app.command("list")
def cache_list() -> None:
    """List what the cache holds, the longest unused first."""
    table = Table(box=None, pad_edge=False, header_style="")
    for column in ("kind", "MB", "last used", "entry"):
        table.add_column(column, justify="right" if column == "MB" else "left")
    items = cache_tools.list_entries()
    for item in items:
        kind = item.kind if item.is_current else f"{item.kind} (format {item.version}, left alone)"
        table.add_row(kind, f"{item.size / 1e6:.2f}", f"{item.last_used:%Y-%m-%d %H:%M}", item.key[:16])
    out.print(table)
    out.print(f"{len(items)} entries, {sum(item.size for item in items) / 1e6:.1f} MB in {cache_tools.folder()}")


@cache_app.command("clear")
def cache_clear(
    unused_days: Annotated[float, typer.Option(help="Only what was not used for so many days.")] = 0.0,
) -> None:
    """Delete the cache's entries; what is deleted is made again when it is next needed."""
    done = cache_tools.clear(unused_days=unused_days)
    out.print(f"Deleted {len(done.removed)} entries, {done.freed / 1e6:.1f} MB.")
    for item in done.in_use:
        out.print(f"Left {item.key[:16]}: another process uses it.")


@cache_app.command("path")
def cache_path() -> None:
    """Print the cache folder (set it by OAT_GYM_CACHE)."""
    out.print(str(cache_tools.folder()))


def open_source(name: str) -> MinariDataset:
    """Return the dataset of a name: one of `oat_gym.domains.DATASETS`, a local Minari id, or a D4RL file."""
    return domains.load(name) if name in domains.DATASETS else find_source(name)


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


def _configure(name: str, length: str, top: int) -> Augmenter:
    if name not in AUGMENTERS:
        raise ConfigurationError(f"There is no augmenter {name!r}; choose one of {', '.join(AUGMENTERS)}.")
    augmenter = AUGMENTERS[name]()
    if isinstance(augmenter, OAT):
        return dataclasses.replace(augmenter, mining=_mining_config(length, top))
    return augmenter


def _mining_config(length: str, top: int) -> MiningConfig:
    if length != "auto" and not length.isdecimal():
        raise ConfigurationError(f'--length must be a number of steps or "auto", got {length!r}.')
    return MiningConfig(n_clusters="auto", length="auto" if length == "auto" else int(length), top=top)


def _data_format(name: str) -> Any:
    if name not in DATA_FORMATS:
        raise ConfigurationError(f"--format must be one of {', '.join(DATA_FORMATS)}, got {name!r}.")
    return name


def _print_summary(summary: DatasetSummary) -> None:
    out.print(f"Dataset       {summary.dataset_id}")
    out.print(f"Observations  {summary.observation_space}")
    out.print(f"Actions       {summary.action_space}")
    table = Table(box=None, pad_edge=False, show_header=True, header_style="")
    table.add_column("")
    groups = {"real": summary.real, "synthetic": summary.synthetic}
    shown = {name: group for name, group in groups.items() if group is not None}
    for name in shown:
        table.add_column(name)
    for title, cells in _summary_rows(list(shown.values())):
        table.add_row(title, *cells)
    out.print(table)


def _summary_rows(groups: list[GroupSummary]) -> list[tuple[str, list[str]]]:
    rows = [
        ("episodes", [str(group.episodes) for group in groups]),
        ("steps", [str(group.steps) for group in groups]),
        ("length", [str(group.lengths) for group in groups]),
        ("return", [str(group.returns) for group in groups]),
    ]
    if any(group.generated_steps for group in groups):
        rows.append(("steps generated", [str(group.generated_steps) for group in groups]))
        rows.append(("no PST inside", [str(group.without_span) for group in groups]))
    for title, name in (("seam in (sd)", "entry_seams"), ("seam out (sd)", "exit_seams")):
        if any(getattr(group, name) for group in groups):
            rows.append((title, [str(getattr(group, name) or "") for group in groups]))
    return rows


def _print_mining(mining: MiningResult, n_episodes: int) -> None:
    out.print(f"Clusters: {mining.n_clusters}. Sub-trajectories of W = {mining.length} steps; support is the number of")
    out.print(f"episodes, of {n_episodes}, that contain the same sequence of clusters.")
    if mining.n_too_short:
        out.print(f"{mining.n_too_short} episodes have fewer than {mining.length} steps and hold no sub-trajectory.")
    table = Table(box=None, pad_edge=False, header_style="")
    for column in ("PST set", "support", "share", "occurrences", "clusters in order"):
        table.add_column(column, justify="left" if column.startswith("clusters") else "right")
    for number, pst in enumerate(mining.sets):
        share = f"{pst.support / n_episodes:.0%}"
        table.add_row(str(number), str(pst.support), share, str(len(pst.occurrences)), _runs(pst.labels))
    out.print(table)


def _runs(labels: Any) -> str:
    """Return a label sequence as runs: 3x12 7x8 is twelve times cluster 3, then eight times cluster 7."""
    runs: list[list[int]] = []
    for label in labels:
        if runs and runs[-1][0] == label:
            runs[-1][1] += 1
        else:
            runs.append([int(label), 1])
    return " ".join(f"{label}x{count}" for label, count in runs)
