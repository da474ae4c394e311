"""TDA: where its windows lie, and that all else is OAT's."""

import dataclasses
from collections.abc import Callable
from types import SimpleNamespace

import minari
import numpy as np
import pytest
from gymnasium import spaces
from scipy import stats

from oat_gym import OAT, TDA, AugmentedDataset, Compose, Function, Jittering, Mixture, Permutation
from oat_gym.episodes import content_hash
from oat_gym.errors import AugmentationWarning, ConfigurationError, InvalidDataError
from oat_gym.generation import BehaviorConfig, VAEMDPConfig
from oat_gym.mining.pst import PSTSet
from oat_gym.source import Source
from oat_gym.stitching import spans_mask
from tests.conftest import install_dataset, walks

QUICK = {"model": VAEMDPConfig(max_updates=20), "behavior": BehaviorConfig(max_updates=50)}


def _starts(lengths: list[int], width: int, *, seed: int = 0) -> np.ndarray:
    return TDA(length=width, ends="generated").windows(SimpleNamespace(lengths=np.array(lengths)), seed=seed).sets[0]  # type: ignore[arg-type]


def test_windows_are_uniform_over_all_first_steps() -> None:
    rows = _starts([9] * 4000, 6)
    np.testing.assert_array_equal(rows[:, 0], np.arange(4000))
    counts = np.bincount(rows[:, 1])
    assert len(counts) == 4  # first steps 0 to 3, the last window ends with the episode
    assert stats.chisquare(counts).pvalue > 1e-4


def test_windows_lie_inside_and_episodes_that_are_too_short_have_none() -> None:
    lengths = np.random.default_rng(0).integers(1, 30, 500)
    rows = _starts(lengths.tolist(), 12)
    np.testing.assert_array_equal(rows[:, 0], np.flatnonzero(lengths >= 12))
    assert (rows[:, 1] >= 0).all()
    assert (rows[:, 1] + 12 <= lengths[rows[:, 0]]).all()
    assert len(set(_starts([40] * 300, 12)[:, 1])) == 29


def test_the_window_of_an_episode_depends_on_the_seed_and_its_number_only() -> None:
    one, other = _starts([30] * 50, 5), _starts([8, *[30] * 49, 30], 5)
    np.testing.assert_array_equal(one[1:], other[1:50])
    assert not np.array_equal(one, _starts([30] * 50, 5, seed=1))


def test_with_the_same_windows_it_is_oat_to_the_last_bit(
    walk_dataset: minari.MinariDataset, tiny_oat: OAT, monkeypatch: pytest.MonkeyPatch
) -> None:
    tda = TDA(length=6, model=tiny_oat.model, behavior=tiny_oat.behavior, seam="matched", candidates=3)
    rows = tda.windows(Source(walk_dataset), seed=5).sets[0]
    mined = tiny_oat.mine(walk_dataset, seed=5)
    windows = PSTSet(labels=(0,) * 6, support=len(rows), occurrences=rows, all_occurrences=rows)
    planted = dataclasses.replace(mined, length=6, sets=(windows,))
    monkeypatch.setattr(OAT, "_mine", lambda *_, **__: planted)
    oat = AugmentedDataset(walk_dataset, dataclasses.replace(tiny_oat, seam="matched", candidates=3), factor=4, seed=5)
    data = AugmentedDataset(walk_dataset, tda, factor=4, seed=5)
    assert [data.provenance(i).spans for i in range(12, 48)] == [oat.provenance(i).spans for i in range(12, 48)]
    assert content_hash(data) == content_hash(oat)
    with pytest.raises(ConfigurationError, match="mine"):
        _ = data.mining


def test_outside_its_window_an_episode_is_its_source_to_the_last_bit(
    make_dataset: Callable[..., minari.MinariDataset],
) -> None:
    lengths = [9, 14, 11, 20]
    real = make_dataset(lengths)
    tda = TDA(length=5, **QUICK)
    data = AugmentedDataset(real, tda, factor=3, seed=1)
    starts = dict(tda.windows(Source(real), seed=1).sets[0].tolist())
    for number in range(4, 12):
        source, episode, origin = data[number % 4], data[number], data.provenance(number)
        assert [(span.start, span.stop) for span in origin.spans] == [(starts[number % 4], starts[number % 4] + 5)]
        mask = origin.mask
        assert mask.sum() == 5
        kept = ~np.append(mask, False)  # the state after the window is the recorded one
        for key in ("position", "mode"):
            assert episode.observations[key][kept].tobytes() == source.observations[key][kept].tobytes()
        assert episode.actions[~mask].tobytes() == source.actions[~mask].tobytes()
        assert episode.rewards[~mask].tobytes() == source.rewards[~mask].tobytes()
        assert (episode.observations["position"][~kept] != source.observations["position"][~kept]).any()
        np.testing.assert_array_equal(episode.terminations, source.terminations)
        np.testing.assert_array_equal(episode.infos["nested"]["twice"], source.infos["nested"]["twice"])


@pytest.mark.parametrize("with_policy", [False, True])
def test_episodes_without_a_window_are_copied_and_it_says_so(
    make_dataset: Callable[..., minari.MinariDataset], with_policy: bool
) -> None:
    class Still:
        def sample(self, observations: dict[str, np.ndarray], *, rng: np.random.Generator) -> np.ndarray:
            return np.zeros((len(observations["mode"]), 1), dtype=np.float32)

        def log_prob(self, observations: dict[str, np.ndarray], actions: np.ndarray) -> np.ndarray:
            return np.zeros(len(actions))

    config = TDA(length=5, policy=Still() if with_policy else None, **QUICK)
    data = AugmentedDataset(make_dataset([9, 4, 1, 7]), config, factor=2)
    with pytest.warns(AugmentationWarning, match=r"2 of 4 episodes have no window of W=5 .* exact copies") as caught:
        data.fit()
    assert len(caught) == 1
    assert data.provenance(5).spans == ()
    assert content_hash([data[5], data[6]]) == content_hash([data[1], data[2]])
    log_prob = data.synthesis.variation(1).log_prob
    assert log_prob is not None
    assert np.isnan(log_prob).all()


def test_copies_are_told_of_where_a_function_of_the_user_is_a_part(
    make_dataset: Callable[..., minari.MinariDataset],
) -> None:
    tda, same = TDA(length=5, **QUICK), Function(lambda episode, rng: episode)
    real = make_dataset([9, 4, 1, 7])
    for method in (Mixture((tda, same)), Compose((tda, same)), Compose((same, tda)), Mixture((tda, Jittering()))):
        with pytest.warns(AugmentationWarning, match="2 of 4 episodes have no window of W=5") as caught:
            list(AugmentedDataset(real, method, factor=2))
        assert len([warning for warning in caught if "no window" in str(warning.message)]) == 1, method


def test_next_states_of_a_source_stay_in_the_steps_that_are_copied(
    make_dataset: Callable[..., minari.MinariDataset],
) -> None:
    source = AugmentedDataset(make_dataset([30] * 12), Permutation(), factor=2)
    data = AugmentedDataset(source, TDA(length=4, **QUICK), factor=2)
    kept = 0
    for number in range(12, 24):
        own, new = source.storage.next_states(number), data.storage.next_states(24 + number)
        generated = data.storage.variation(24 + number)
        assert generated is not None
        changed = spans_mask(generated.spans, 30)
        for t, row in own.items():
            assert (t in new) is not changed[t]
            if t in new:
                np.testing.assert_array_equal(new[t]["position"], row["position"])
                kept += 1
    assert kept >= 3


def test_recorded_actions_are_replayed_as_they_are_beyond_the_bounds_of_the_space() -> None:
    real = install_dataset("test/wild-v0", walks(8, 24), spaces.Box(-100, 100, (2,)), spaces.Box(-0.1, 0.1, (2,)))
    data = AugmentedDataset(real, TDA(length=6, actions="recorded", **QUICK), factor=2)
    assert any(np.abs(episode.actions).max() > 0.1 for episode in real)
    for number in range(8):
        np.testing.assert_array_equal(data[8 + number].actions, real[number].actions)
        assert data.provenance(8 + number).mask.any()


def test_episodes_that_are_all_too_short_get_a_clear_answer_at_once(
    make_dataset: Callable[..., minari.MinariDataset],
) -> None:
    with pytest.raises(InvalidDataError, match=r"4 to 9 steps \(median 7\).*Use TDA\(length=3\)"):
        AugmentedDataset(make_dataset([9, 4, 7]), TDA(length=10), factor=2)
    with pytest.raises(ConfigurationError, match="length must be an integer of at least 1"):
        TDA(length=0)
    assert TDA.preset("paper").seam == "literal"
