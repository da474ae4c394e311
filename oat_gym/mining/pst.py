"""Mining potential sub-trajectories (PSTs): labels, support, and the sets of windows to be augmented (section 2.1)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from oat_gym.errors import ConfigurationError, InvalidDataError
from oat_gym.mining._selection import choose_clusters
from oat_gym.mining.support import TDSSTable, check_length, count_tdss, longest_length, support_curve
from oat_gym.mining.ticc import Initialisation, check_settings

Ints = NDArray[np.int64]
Progress = Callable[[str, int, int], None]


@dataclass(frozen=True, kw_only=True)
class MiningConfig:
    """The settings of `mine`.

    Attributes:
        n_clusters: the number of labels C, or `"auto"`: the best of `candidates` by `criterion`.
        candidates: the values of C that `"auto"` tries (the paper: 10 to 20).
        criterion: `"silhouette"` (the paper) or `"bic"`: -2 log-likelihood + non-zero parameters * log n.
        restarts: k-means starts from which `"auto"` fits each candidate. The silhouette is their mean; of the
            candidates that are not significantly worse than the best, the one with the fewest clusters wins.
        window: rows in a TICC window. sparsity, switch_penalty, max_iterations, init: see `TICC`.
        length: W, the length of a PST, or `"auto"`: the largest W whose best support is at least `auto_share` * N.
        auto_share: see `length`.
        min_support: the threshold xi of Definition 2.2: a count (int), a share of the sequences (float in (0, 1]), or
            None for no threshold.
        top: keep the `top` sets of best support (the paper uses 1), or None for all (then give `min_support`).
        distinct: leave out a set when more than half of its windows overlap those of better sets. A window moved by
            one row usually has the same support, so that without this the best few sets are one set over and over.
        aligned: count a window as the same only at the same position of its sequence.

    Raises:
        ConfigurationError: a setting that cannot work.

    >>> MiningConfig(length=10, top=2).length
    10
    """

    n_clusters: int | Literal["auto"] = 10
    candidates: tuple[int, ...] = tuple(range(10, 21))
    criterion: Literal["silhouette", "bic"] = "silhouette"
    restarts: int = 3
    window: int = 1
    sparsity: float = 0.11
    switch_penalty: float = 100.0
    max_iterations: int = 100
    init: Initialisation = "auto"
    length: int | Literal["auto"] = 20
    auto_share: float = 0.9
    min_support: float | None = None
    top: int | None = 1
    distinct: bool = True
    aligned: bool = False

    def __post_init__(self) -> None:
        if self.criterion not in ("silhouette", "bic"):
            raise ConfigurationError(f'criterion must be "silhouette" or "bic", got {self.criterion!r}.')
        if isinstance(self.restarts, bool) or not isinstance(self.restarts, int) or self.restarts < 1:
            raise ConfigurationError(f"restarts must be a positive integer, got {self.restarts!r}.")
        if len(self.candidates) == 0:
            raise ConfigurationError("candidates is empty; give at least one number of clusters.")
        for count in self.candidates if self.n_clusters == "auto" else (self.n_clusters,):
            check_settings(
                n_clusters=count,
                window=self.window,
                sparsity=self.sparsity,
                switch_penalty=self.switch_penalty,
                max_iterations=self.max_iterations,
                init=self.init,
            )
        if self.length != "auto":
            object.__setattr__(self, "length", check_length(self.length))  # NumPy's integers too
        if not 0 < self.auto_share <= 1:
            raise ConfigurationError(f"auto_share must lie in (0, 1], got {self.auto_share!r}.")
        self._check_selection()

    def _check_selection(self) -> None:
        if self.top is not None:
            if isinstance(self.top, bool) or not isinstance(self.top, int) or self.top < 1:
                raise ConfigurationError(f"top must be a positive integer or None, got {self.top!r}.")
        elif self.min_support is None:
            raise ConfigurationError("top=None keeps every window; give min_support (a count or a share) with it.")
        if self.min_support is None:
            return
        whole = isinstance(self.min_support, int) and not isinstance(self.min_support, bool)
        if not (self.min_support >= 1 if whole else 0 < self.min_support <= 1):
            raise ConfigurationError(
                f"min_support must be a count (an int of at least 1) or a share (a float in (0, 1]), "
                f"got {self.min_support!r}."
            )

    def threshold(self, n_sequences: int) -> int:
        """Return xi as a number of sequences."""
        if self.min_support is None:
            return 1
        if isinstance(self.min_support, int):
            return self.min_support
        return int(np.ceil(self.min_support * n_sequences - 1e-9))


@dataclass(frozen=True, eq=False)
class PSTSet:
    """One set of PSTs: all windows whose labels are the same TDSS.

    Attributes:
        labels: the TDSS, W labels.
        support: number of sequences that hold it.
        occurrences: (M, 2) sequence and start of windows that do not overlap, earliest first in each sequence.
        all_occurrences: (M', 2) all windows, overlapping ones included.
    """

    labels: tuple[int, ...]
    support: int
    occurrences: Ints
    all_occurrences: Ints = field(repr=False)

    @property
    def length(self) -> int:
        """W, the number of rows in a window."""
        return len(self.labels)

    @property
    def n_switches(self) -> int:
        """Number of places in the TDSS where the label changes."""
        return int((np.diff(self.labels) != 0).sum())

    def __repr__(self) -> str:
        cuts = np.flatnonzero(np.diff(self.labels)) + 1
        runs = [f"{run[0]}x{len(run)}" for run in np.split(np.array(self.labels), cuts)]
        return (
            f"PSTSet(length={self.length}, support={self.support}, occurrences={len(self.occurrences)} "
            f"(of {len(self.all_occurrences)} overlapping), labels={' '.join(runs)})"
        )


@dataclass(frozen=True, eq=False)
class MiningResult:
    """What `mine` found.

    Attributes:
        labels: one (T_i,) int64 array a series.
        n_clusters: C.
        criterion: the name of the criterion.
        criterion_scores: `{C: score}` of the candidates; empty where C was given. The silhouette is better high,
            BIC low.
        length: W.
        supports: (M,) support of every distinct TDSS of length W, from best to worst.
        support_curve: `{W: best support}`.
        sets: the PST sets: by support; ties by more label switches, fewer occurrences, earliest start, then labels.
        n_too_short: number of series with fewer than W rows; they hold no PST.
        min_support: xi, as a number of series.
    """

    labels: tuple[Ints, ...]
    n_clusters: int
    criterion: str
    criterion_scores: dict[int, float]
    length: int
    supports: Ints
    support_curve: dict[int, int]
    sets: tuple[PSTSet, ...]
    n_too_short: int
    min_support: int

    def __repr__(self) -> str:
        total = len(self.labels)
        lines = [f"MiningResult: {total} series, {self.n_clusters} clusters, W={self.length}"]
        if self.criterion_scores:
            scores = ", ".join(f"{count}: {score:.4g}" for count, score in self.criterion_scores.items())
            lines.append(f"  {self.criterion} by number of clusters: {scores}")
        lines.append("  best support by W: " + ", ".join(f"{w}: {s}" for w, s in self.support_curve.items()))
        if self.n_too_short:
            lines.append(f"  {self.n_too_short} of {total} series have fewer than {self.length} rows: no PST in them")
        if not self.sets:
            best = int(self.supports.max(initial=0))
            lines.append(f"  no window reaches the support of {self.min_support}; the best has {best}")
        lines += [f"  set {index}: {item!r}" for index, item in enumerate(self.sets)]
        return "\n".join(lines)


def mine(
    series: Sequence[ArrayLike],
    *,
    config: MiningConfig,
    rng: np.random.Generator,
    times: Sequence[ArrayLike] | None = None,
    usable: Sequence[int] | None = None,
    progress: Progress | None = None,
) -> MiningResult:
    """Label all rows with TICC, count the support of all windows, and select the sets of PSTs.

    Args:
        series: list of (T_i, D) arrays, for instance the states of each episode.
        config: the settings.
        rng: the source of the initialisations' seed and of the silhouette's sample.
        times: list of (T_i,) times, for MT-TICC's time-aware switching penalty.
        usable: how many rows of each series, from the first, windows may cover; None: all. All rows are labelled.
        progress: called as `progress(description, done, total)`.

    Raises:
        InvalidDataError: series that `TICC.fit` refuses; no series with W usable rows.
        ConfigurationError: more clusters than rows.

    >>> rng = np.random.default_rng(0)
    >>> series = [np.concatenate([rng.normal(0, 1, (30, 2)), rng.normal(5, 1, (30, 2))]) for _ in range(3)]
    >>> mine(series, config=MiningConfig(n_clusters=2, length=40, switch_penalty=10.0), rng=rng).sets[0].support
    3
    """
    check_long_enough(series_lengths(series) if usable is None else usable, config)
    found = label(series, config=config, rng=rng, times=times, progress=progress)
    return find_windows(found, config=config, usable=usable)


@dataclass(frozen=True, eq=False)
class Labelling:
    """The label of every row: the part of mining that takes long, whatever the windows that are then looked for.

    Attributes: see `MiningResult`.
    """

    labels: tuple[Ints, ...]
    n_clusters: int
    criterion_scores: dict[int, float]


def label(
    series: Sequence[ArrayLike],
    *,
    config: MiningConfig,
    rng: np.random.Generator,
    times: Sequence[ArrayLike] | None = None,
    progress: Progress | None = None,
) -> Labelling:
    """Return the labels of all rows, the first step of `mine`."""
    model, scores = choose_clusters(
        series,
        candidates=config.candidates if config.n_clusters == "auto" else (config.n_clusters,),
        criterion=config.criterion,
        settings=config,
        rng=rng,
        times=times,
        progress=progress,
    )
    return Labelling(tuple(model.labels_), model.n_clusters, scores)


def find_windows(found: Labelling, *, config: MiningConfig, usable: Sequence[int] | None = None) -> MiningResult:
    """Count the support of all windows in the usable rows and select the sets of PSTs, the second step of `mine`."""
    labels = found.labels
    if usable is not None:
        labels = tuple(rows[:count] for rows, count in zip(found.labels, usable, strict=True))
    length = _window_length(labels, config)
    curve = support_curve(labels, aligned=config.aligned)
    table = count_tdss(labels, length, aligned=config.aligned)
    curve[length] = int(table.support.max())
    xi = config.threshold(len(labels))
    return MiningResult(
        labels=found.labels,
        n_clusters=found.n_clusters,
        criterion=config.criterion,
        criterion_scores=found.criterion_scores,
        length=length,
        supports=np.sort(table.support)[::-1].copy(),
        support_curve=dict(sorted(curve.items())),
        sets=select_sets(labels, table, min_support=xi, top=config.top, distinct=config.distinct),
        n_too_short=int((table.lengths < length).sum()),
        min_support=xi,
    )


def _window_length(labels: Sequence[Ints], config: MiningConfig) -> int:
    """Return W: the given one, or for "auto" the largest that enough series share."""
    if config.length != "auto":
        return config.length
    wanted = int(np.ceil(config.auto_share * len(labels) - 1e-9))
    length = longest_length(labels, wanted, aligned=config.aligned)
    if length < 1:
        raise InvalidDataError(
            f'length="auto" looks for windows that {wanted} of the {len(labels)} series share (auto_share='
            f"{config.auto_share:g}), and not even single rows do. Lower auto_share, use fewer clusters, "
            "or give a length."
        )
    return length


def series_lengths(series: Sequence[ArrayLike]) -> list[int]:
    """Return the number of rows of each series."""
    return [len(np.atleast_1d(np.asarray(item))) for item in series]


def check_long_enough(lengths: Sequence[int], config: MiningConfig) -> None:
    """Raise `InvalidDataError` if W is given and no series has so many usable rows."""
    if config.length == "auto" or len(lengths) == 0 or max(lengths) >= config.length:
        return
    raise InvalidDataError(
        f"No series is as long as a PST: W={config.length}, but the series have {min(lengths)} to {max(lengths)} rows "
        f'to find it in (median {np.median(lengths):g}). Use length="auto" or a length of at most {max(lengths)}.'
    )


def select_sets(
    labels: Sequence[Ints], table: TDSSTable, *, min_support: int, top: int | None, distinct: bool = False
) -> tuple[PSTSet, ...]:
    """Return the PST sets of support >= `min_support`, at most `top` of them, in the order of `MiningResult.sets`.

    `distinct` leaves out sets that mostly overlap better ones (see `MiningConfig`).
    """
    cut = min_support
    if top is not None and len(table.support) > top and not distinct:
        cut = max(cut, int(np.partition(table.support, -top)[-top]))
    entries = np.flatnonzero(table.support >= cut)
    if len(entries) == 0:
        return ()
    windows = np.stack([labels[i][start : start + table.length] for i, start in table.first[entries]])
    sets: list[PSTSet] = []
    covered = [np.zeros(len(sequence), dtype=np.bool_) for sequence in labels]
    for k in _order(table, entries, windows):
        if top is not None and len(sets) == top:
            break
        candidate = _pst_set(table, int(entries[k]), windows[k])
        spans = [covered[i][start : start + table.length] for i, start in candidate.occurrences]
        if not distinct or 2 * sum(bool(span.any()) for span in spans) <= len(spans):
            sets.append(candidate)
            for span in spans:
                span[:] = True
    return tuple(sets)


def _order(table: TDSSTable, entries: Ints, windows: Ints) -> Ints:
    """Return the entries' order: support, more label switches, fewer occurrences, earliest start, labels."""
    position = np.arange(len(table.ids)) - np.repeat(np.cumsum(table.lengths) - table.lengths, table.lengths)
    earliest = np.full(len(table.support), np.iinfo(np.int64).max)
    np.minimum.at(earliest, table.ids[table.ids >= 0], position[table.ids >= 0])
    switches = (np.diff(windows, axis=1) != 0).sum(axis=1)
    keys = [-table.support[entries], -switches, table.occurrences[entries], earliest[entries], *windows.T]
    return np.lexsort(keys[::-1])


def _pst_set(table: TDSSTable, entry: int, window: Ints) -> PSTSet:
    places = table.windows_of(entry)
    return PSTSet(
        labels=tuple(int(label) for label in window),
        support=int(table.support[entry]),
        occurrences=thin(places, table.length),
        all_occurrences=places,
    )


def thin(occurrences: Ints, length: int) -> Ints:
    """Keep, in each sequence, the earliest window and then each next one that does not overlap the last one kept.

    >>> thin(np.array([[0, 1], [0, 2], [0, 4], [1, 0]]), 3).tolist()
    [[0, 1], [0, 4], [1, 0]]
    """
    kept: list[tuple[int, int]] = []
    for sequence, start in occurrences.tolist():
        if not kept or kept[-1][0] != sequence or start >= kept[-1][1] + length:
            kept.append((sequence, start))
    return np.array(kept, dtype=np.int64).reshape(-1, 2)
