"""Mining is done once for each series, settings and seed, and what the cache holds is what was mined."""

from __future__ import annotations

from dataclasses import replace

import minari
import numpy as np
import pytest

from oat_gym import OAT, AugmentedDataset
from oat_gym.cache import cache_folder
from oat_gym.mining import MiningConfig, kept
from oat_gym.mining.kept import mine_once

CONFIG = MiningConfig(n_clusters=3, length=10, switch_penalty=10.0)


@pytest.fixture
def series() -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    return [np.concatenate([rng.normal(5 * k, 1.0, (15 + i, 2)) for k in range(3)]) for i in range(4)]


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """A list that grows by one each time something is mined."""
    made: list[str] = []
    mine = kept.mine

    def counted(*args: object, **settings: object) -> object:
        made.append("mined")
        return mine(*args, **settings)  # type: ignore[arg-type]

    monkeypatch.setattr(kept, "mine", counted)
    return made


def test_the_same_question_is_mined_once(series: list[np.ndarray], calls: list[str]) -> None:
    first = mine_once(series, config=CONFIG, seed=0)
    again = mine_once([rows.copy() for rows in series], config=CONFIG, seed=0)
    assert len(calls) == 1
    assert repr(again) == repr(first)
    for one, other in zip(first.labels, again.labels, strict=True):
        np.testing.assert_array_equal(one, other)


def test_another_question_is_mined_anew(series: list[np.ndarray], calls: list[str]) -> None:
    mine_once(series, config=CONFIG, seed=0)
    mine_once(series, config=CONFIG, seed=1)
    mine_once(series, config=replace(CONFIG, length=12), seed=0)
    mine_once([*series[1:], series[0]], config=CONFIG, seed=0)
    mine_once(series, config=CONFIG, seed=0, times=[np.arange(len(rows), dtype=float) for rows in series])
    changed = [rows.copy() for rows in series]
    changed[2][3, 1] += 1e-9
    mine_once(changed, config=CONFIG, seed=0)
    assert len(calls) == 6


def test_a_damaged_result_is_mined_again(series: list[np.ndarray], calls: list[str]) -> None:
    first = mine_once(series, config=CONFIG, seed=0)
    (path,) = cache_folder().rglob("mining.safetensors")
    good = path.read_bytes()
    path.write_bytes(good[: len(good) // 2])
    assert repr(mine_once(series, config=CONFIG, seed=0)) == repr(first)
    assert len(calls) == 2
    assert path.read_bytes() == good


def test_forms_of_oat_share_what_was_mined(walk_dataset: minari.MinariDataset, tiny_oat: OAT, calls: list[str]) -> None:
    plain = AugmentedDataset(walk_dataset, tiny_oat, factor=2, seed=0).fit()
    other = AugmentedDataset(walk_dataset, replace(tiny_oat, start="posterior"), factor=2, seed=0).fit()
    assert repr(tiny_oat.mine(walk_dataset)) == repr(plain.mining) == repr(other.mining)
    assert len(calls) == 1
