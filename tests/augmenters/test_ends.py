"""Spans and the ends of episodes, and rewards that the data holds: the settings `ends` and `rewards`."""

from __future__ import annotations

import pickle
from dataclasses import replace

import minari
import numpy as np
import pytest
from gymnasium import spaces

from oat_gym import OAT, TDA, AugmentedDataset, MiningConfig
from oat_gym.augmenters.stitched import StitchingAugmenter
from oat_gym.errors import AugmentationWarning, ShortEpisodesError
from tests.conftest import install_dataset, walks

BOX = spaces.Box(-100, 100, (2,)), spaces.Box(-1, 1, (2,))


def ending(*, length: int = 12) -> minari.MinariDataset:
    """Return twelve episodes of 12 to 16 steps: those of even number terminate, for a reward of 1; others are 0."""
    buffers = []
    for number, buffer in enumerate(walks(12, length)):
        last = np.arange(len(buffer.rewards)) == len(buffer.rewards) - 1
        died = last & (number % 2 == 0)
        buffers.append(replace(buffer, rewards=died * 1.0, terminations=died, truncations=last & ~died))
    return install_dataset("test/ending-v0", buffers, *BOX)


@pytest.fixture
def forms(tiny_oat: OAT) -> list[StitchingAugmenter]:
    tda = TDA(length=11, model=tiny_oat.model, behavior=tiny_oat.behavior)
    one_label = MiningConfig(n_clusters=1, length=6)  # every window is of the one set
    return [replace(tiny_oat, mining=one_label), tda]


def test_a_recorded_end_stays_recorded(forms: list[StitchingAugmenter]) -> None:
    real = ending()
    for form in forms:
        data = AugmentedDataset(real, form, factor=4)
        reached = 0
        for number in range(12, 48):
            mask, source = data.provenance(number).mask, data[data.provenance(number).source]
            assert not mask[source.terminations].any()
            reached += int(mask[-1])  # a truncated episode has no end to keep
            if source.terminations[-1]:
                assert data[number].rewards[-1] == 1
                np.testing.assert_array_equal(data[number].observations[-1], source.observations[-1])
        assert reached


def test_in_the_papers_form_a_span_may_hold_the_end(forms: list[StitchingAugmenter]) -> None:
    real = ending()
    for form in forms:
        data = AugmentedDataset(real, replace(form, ends="generated"), factor=4)
        covered = [data.provenance(n).mask[-1] and data[n].terminations[-1] for n in range(12, 48)]
        assert any(covered)


def test_without_terminations_the_settings_are_one(walk_dataset: minari.MinariDataset, tiny_oat: OAT) -> None:
    one = AugmentedDataset(walk_dataset, tiny_oat, factor=2)
    other = AugmentedDataset(walk_dataset, replace(tiny_oat, ends="generated"), factor=2)
    for number in range(12, 24):
        np.testing.assert_array_equal(one[number].observations, other[number].observations)
        np.testing.assert_array_equal(one[number].rewards, other[number].rewards)


def test_labels_are_of_all_steps_and_mined_windows_of_the_usable_ones(tiny_oat: OAT) -> None:
    real = ending()
    whole, kept = replace(tiny_oat, ends="generated").mine(real), tiny_oat.mine(real)
    for one, other in zip(whole.labels, kept.labels, strict=True):
        np.testing.assert_array_equal(one, other)
    last = np.array([len(labels) for labels in kept.labels]) - (np.arange(12) % 2 == 0)
    assert kept.sets
    for pst in kept.sets:
        assert (pst.all_occurrences[:, 1] + 6 <= last[pst.all_occurrences[:, 0]]).all()


def test_an_episode_of_one_step_that_terminates_is_copied(forms: list[StitchingAugmenter]) -> None:
    walk = walks(12, 16)
    died = np.array([True])
    short = replace(
        walk[0],
        observations=np.zeros((2, 2), np.float32),
        actions=np.zeros((1, 2), np.float32),
        rewards=np.ones(1),
        terminations=died,
        truncations=~died,
    )
    real = install_dataset("test/one-step-v0", [short, *walk[1:]], *BOX)
    for form in forms:
        with pytest.warns(AugmentationWarning, match="exact copies"):
            data = AugmentedDataset(real, form, factor=2).fit()
        assert data[12].rewards.tolist() == [1.0]
        assert not data.provenance(12).mask.any()
        assert data.provenance(13).mask.any()


@pytest.mark.parametrize("form", [OAT(mining=MiningConfig(n_clusters=2, length=6)), TDA(length=6)])
def test_episodes_without_room_before_their_ends_are_named(form: StitchingAugmenter) -> None:
    buffers = []
    for buffer in walks(3, 6)[:1] * 3:
        died = np.arange(6) == 5
        buffers.append(replace(buffer, terminations=died, truncations=np.zeros(6, dtype=bool)))
    real = install_dataset("test/no-room-v0", buffers, *BOX)
    data = AugmentedDataset(real, form, factor=2)
    with pytest.raises(
        ShortEpisodesError, match=r"No episode has the 6 steps .* 5 to 5\. .*ends='generated'"
    ) as caught:
        data.fit()
    assert caught.value.length == 2
    assert str(pickle.loads(pickle.dumps(caught.value))) == str(caught.value)  # a worker process hands it on


def test_recorded_rewards_are_values_of_the_data(forms: list[StitchingAugmenter]) -> None:
    real = ending()
    for form in (replace(form, ends="generated") for form in forms):
        noisy = AugmentedDataset(real, form, factor=4)
        snapped = AugmentedDataset(real, replace(form, rewards="recorded"), factor=4)
        modelled = np.concatenate([noisy[n].rewards[noisy.provenance(n).mask] for n in range(12, 48)])
        chosen = np.concatenate([snapped[n].rewards[snapped.provenance(n).mask] for n in range(12, 48)])
        assert len(np.unique(modelled)) > 10
        assert set(np.unique(chosen)) <= {0.0, 1.0}
        np.testing.assert_array_equal(chosen, np.where(modelled > 0.5, 1.0, 0.0))


def test_where_outcomes_are_paid_at_ends_that_stay_nothing_is_paid_before(forms: list[StitchingAugmenter]) -> None:
    real = ending()
    for form in forms:
        data = AugmentedDataset(real, replace(form, observation_noise=True), factor=3)
        generated = np.concatenate([data[n].rewards[data.provenance(n).mask] for n in range(12, 36)])
        assert len(generated)
        assert (generated == 0).all()
