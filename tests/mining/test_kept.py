"""Labels are found once for each series, settings and seed, and what the cache holds is what was found."""

from __future__ import annotations

from dataclasses import replace

import minari
import numpy as np
import pytest

from oat_gym import OAT, AugmentedDataset
from oat_gym._rng import derive
from oat_gym.cache import cache_folder
from oat_gym.errors import InvalidDataError
from oat_gym.mining import MiningConfig, kept, mine
from oat_gym.mining.kept import mine_once

CONFIG = MiningConfig(n_clusters=3, length=10, switch_penalty=10.0)


@pytest.fixture
def series() -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    return [np.concatenate([rng.normal(5 * k, 1.0, (15 + i, 2)) for k in range(3)]) for i in range(4)]


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """A list that grows by one each time series are labelled."""
    made: list[str] = []
    label = kept.label

    def counted(*args: object, **settings: object) -> object:
        made.append("labelled")
        return label(*args, **settings)  # type: ignore[arg-type]

    monkeypatch.setattr(kept, "label", counted)
    return made


def test_the_same_question_is_labelled_once(series: list[np.ndarray], calls: list[str]) -> None:
    first = mine_once(series, config=CONFIG, seed=0)
    again = mine_once([rows.copy() for rows in series], config=CONFIG, seed=0)
    assert len(calls) == 1
    assert repr(again) == repr(first)
    for one, other in zip(first.labels, again.labels, strict=True):
        np.testing.assert_array_equal(one, other)


def test_another_question_is_labelled_anew(series: list[np.ndarray], calls: list[str]) -> None:
    mine_once(series, config=CONFIG, seed=0)
    mine_once(series, config=CONFIG, seed=1)
    mine_once(series, config=replace(CONFIG, switch_penalty=5.0), seed=0)
    mine_once([*series[1:], series[0]], config=CONFIG, seed=0)
    mine_once(series, config=CONFIG, seed=0, times=[np.arange(len(rows), dtype=float) for rows in series])
    changed = [rows.copy() for rows in series]
    changed[2][3, 1] += 1e-9
    mine_once(changed, config=CONFIG, seed=0)
    assert len(calls) == 6


def test_windows_are_looked_for_in_the_same_labels(series: list[np.ndarray], calls: list[str]) -> None:
    for length in (5, 10, 15):
        config = replace(CONFIG, length=length, top=2)
        found = mine_once(series, config=config, seed=0)
        alone = mine(series, config=config, rng=derive(0, "mining"))
        assert repr(found) == repr(alone)
        for pst, other in zip(found.sets, alone.sets, strict=True):
            np.testing.assert_array_equal(pst.all_occurrences, other.all_occurrences)
    usable = [len(rows) - 20 for rows in series]
    short = mine_once(series, config=CONFIG, seed=0, usable=usable)
    assert all(
        (pst.all_occurrences[:, 1] + 10 <= np.array(usable)[pst.all_occurrences[:, 0]]).all() for pst in short.sets
    )
    assert len(calls) == 1
    with pytest.raises(InvalidDataError, match="W=10, but the series have 3 to 3 rows"):
        mine_once(series, config=CONFIG, seed=0, usable=[3] * 4)


def test_damaged_labels_are_found_again(series: list[np.ndarray], calls: list[str]) -> None:
    first = mine_once(series, config=CONFIG, seed=0)
    (path,) = cache_folder().rglob("labels.safetensors")
    good = path.read_bytes()
    path.write_bytes(good[: len(good) // 2])
    assert repr(mine_once(series, config=CONFIG, seed=0)) == repr(first)
    assert len(calls) == 2
    assert path.read_bytes() == good


def test_forms_of_oat_share_their_labels(walk_dataset: minari.MinariDataset, tiny_oat: OAT, calls: list[str]) -> None:
    plain = AugmentedDataset(walk_dataset, tiny_oat, factor=2, seed=0).fit()
    other = AugmentedDataset(
        walk_dataset, replace(tiny_oat, start="posterior", ends="generated"), factor=2, seed=0
    ).fit()
    assert repr(tiny_oat.mine(walk_dataset)) == repr(plain.mining) == repr(other.mining)
    assert len(calls) == 1
