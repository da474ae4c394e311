"""Where the steps of an episode come from, and its form as Minari episode metadata."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from oat_gym.episodes import BoolArray
from oat_gym.lazy_metadata import LazyMetadata
from oat_gym.stitching import Span, spans_mask

METADATA_KEYS = ("synthetic", "source", "variation", "spans", "pst_sets", "samples", "seams")
"""The keys of episode metadata that are ours."""


@dataclass(frozen=True)
class Provenance:
    """The origin of one episode.

    `source` is the id (`episode.id`) of the episode it was made from, itself where it is real; -1 where that episode is
    not in the dataset, because a view was augmented or saved. A view has the ids of the whole. `variation` is the
    number of the variation (None where it is real), `spans` the generated steps, `length` its number of steps T.

    >>> Provenance(synthetic=True, source=3, variation=0, spans=(Span(1, 3),), length=4).mask.tolist()
    [False, True, True, False]
    """

    synthetic: bool
    source: int
    variation: int | None
    spans: tuple[Span, ...]
    length: int

    @property
    def mask(self) -> BoolArray:
        """T booleans, true where the step was generated."""
        return spans_mask(self.spans, self.length)

    def to_metadata(self) -> dict[str, Any]:
        """Return the metadata keys that every Minari storage format can hold."""
        spans = self.spans
        seams = [span.seam or (np.nan, np.nan) for span in spans]
        return {
            "synthetic": self.synthetic,
            "source": self.source,
            "variation": -1 if self.variation is None else self.variation,
            "spans": np.array([(span.start, span.stop) for span in spans], dtype=np.int64).reshape(-1, 2),
            "pst_sets": np.array([-1 if s.pst_set is None else s.pst_set for s in spans], dtype=np.int64),
            "samples": np.array([-1 if s.sample is None else s.sample for s in spans], dtype=np.int64),
            "seams": np.array(seams, dtype=np.float64).reshape(-1, 2),
        }

    @classmethod
    def from_metadata(cls, metadata: Mapping[str, Any], number: int) -> Provenance:
        """Return the provenance of episode `number` from its metadata; without our keys the episode is real."""
        length = int(metadata["total_steps"])
        if not has_provenance(metadata):
            return cls(False, number, None, (), length)
        rows = zip(
            np.asarray(metadata["spans"], dtype=np.int64).reshape(-1, 2),
            np.asarray(metadata["pst_sets"], dtype=np.int64),
            np.asarray(metadata["samples"], dtype=np.int64),
            np.asarray(metadata["seams"], dtype=np.float64).reshape(-1, 2),
            strict=True,
        )
        spans = tuple(
            Span(int(a), int(b), _known(pst), _known(sample), None if np.isnan(seam).any() else _pair(seam))
            for (a, b), pst, sample, seam in rows
        )
        variation = _known(metadata["variation"])
        return cls(bool(metadata["synthetic"]), int(metadata["source"]), variation, spans, length)


def has_provenance(metadata: Mapping[str, Any]) -> bool:
    """Whether episode metadata holds a provenance: all our keys, since users have keys called "source" too."""
    return isinstance(metadata, LazyMetadata) or all(key in metadata for key in METADATA_KEYS)


def renumbered(metadata: Iterable[Mapping[str, Any]], ids: npt.NDArray[np.integer[Any]]) -> Iterator[dict[str, Any]]:
    """Yield the metadata of the episodes `ids` with sources that are places among them, for a copy that counts anew."""
    places = {int(number): place for place, number in reversed(list(enumerate(ids)))}
    for place, part in enumerate(metadata):
        if not has_provenance(part):
            yield dict(part)
            continue
        source = places.get(int(part["source"]), -1) if part["synthetic"] else place
        yield dict(part) | {"source": source}


def merge_spans(old: tuple[Span, ...], new: tuple[Span, ...], *, length: int) -> tuple[Span, ...]:
    """Return the generated spans of an episode of `length` steps whose `new` spans were put over one with `old` ones.

    What the old ones had beyond the new length is gone.

    >>> [(span.start, span.stop) for span in merge_spans((Span(0, 9),), (Span(2, 4),), length=6)]
    [(0, 6), (2, 4)]
    """
    inside = [replace(span, stop=min(span.stop, length)) for span in old if span.start < length]
    covered = set[int]().union(*(range(span.start, span.stop) for span in new)) if new else set[int]()
    kept = [span for span in inside if not covered.issuperset(range(span.start, span.stop))]
    return tuple(sorted((*kept, *new), key=lambda span: (span.start, span.stop)))


def _known(value: Any) -> int | None:
    return int(value) if value >= 0 else None


def _pair(seam: Any) -> tuple[float, float]:
    return float(seam[0]), float(seam[1])
