"""Labels and mining results as arrays and JSON, for the cache."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from oat_gym.mining.pst import Labelling, MiningResult, PSTSet

Arrays = dict[str, npt.NDArray[Any]]


def labelling_to_state(found: Labelling) -> tuple[Arrays, dict[str, Any]]:
    """Return (arrays, JSON value) that `labelling_from_state` turns back into an equal labelling."""
    scores = [[count, float(score)] for count, score in found.criterion_scores.items()]
    return _label_arrays(found.labels), {"n_clusters": found.n_clusters, "criterion_scores": scores}


def labelling_from_state(arrays: Arrays, value: dict[str, Any]) -> Labelling:
    """Return the labelling that `labelling_to_state` described."""
    return Labelling(_labels(arrays), value["n_clusters"], dict(map(tuple, value["criterion_scores"])))


def mining_to_state(result: MiningResult) -> tuple[Arrays, dict[str, Any]]:
    """Return (arrays, JSON value) that `mining_from_state` turns back into an equal result."""
    arrays = _label_arrays(result.labels) | {"supports": result.supports}
    for g, pst in enumerate(result.sets):
        arrays |= {f"set{g}/occurrences": pst.occurrences, f"set{g}/all_occurrences": pst.all_occurrences}
    value = {
        "n_clusters": result.n_clusters,
        "criterion": result.criterion,
        "criterion_scores": [[count, float(score)] for count, score in result.criterion_scores.items()],
        "length": result.length,
        "support_curve": [[width, int(support)] for width, support in result.support_curve.items()],
        "sets": [{"labels": pst.labels, "support": pst.support} for pst in result.sets],
        "n_too_short": result.n_too_short,
        "min_support": result.min_support,
    }
    return arrays, value


def mining_from_state(arrays: Arrays, value: dict[str, Any]) -> MiningResult:
    """Return the result that `mining_to_state` described."""
    sets = [
        PSTSet(
            labels=tuple(pst["labels"]),
            support=pst["support"],
            occurrences=arrays[f"set{g}/occurrences"],
            all_occurrences=arrays[f"set{g}/all_occurrences"],
        )
        for g, pst in enumerate(value["sets"])
    ]
    return MiningResult(
        labels=_labels(arrays),
        n_clusters=value["n_clusters"],
        criterion=value["criterion"],
        criterion_scores=dict(map(tuple, value["criterion_scores"])),
        length=value["length"],
        supports=arrays["supports"],
        support_curve=dict(map(tuple, value["support_curve"])),
        sets=tuple(sets),
        n_too_short=value["n_too_short"],
        min_support=value["min_support"],
    )


def _label_arrays(labels: tuple[npt.NDArray[np.int64], ...]) -> Arrays:
    return {"labels": np.concatenate(labels), "lengths": np.array([len(rows) for rows in labels])}


def _labels(arrays: Arrays) -> tuple[npt.NDArray[np.int64], ...]:
    return tuple(np.split(arrays["labels"], np.cumsum(arrays["lengths"])[:-1]))
