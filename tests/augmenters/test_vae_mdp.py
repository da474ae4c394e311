"""VAEMDP: masks, ends, and that every step is generated and goes to its own episode."""

import dataclasses
from collections.abc import Callable
from typing import Any

import minari
import numpy as np
import pytest
from gymnasium import spaces
from minari.data_collector import EpisodeBuffer

from oat_gym import VAEMDP, AugmentedDataset
from oat_gym._rng import derive
from oat_gym.augmenters import vae_mdp
from oat_gym.augmenters.generative import Matrices
from oat_gym.augmenters.vae_mdp import draw_in_proportion, length_log_likelihood, whole_episodes
from oat_gym.episodes import content_hash
from oat_gym.errors import ConfigurationError
from oat_gym.generation import BehaviorConfig, FittedVAEMDP, Samples, VAEMDPConfig, fit_many
from oat_gym.source import Source
from oat_gym.spaces import Layout
from tests.conftest import install_dataset

QUICK = {"model": VAEMDPConfig(max_updates=20), "behavior": BehaviorConfig(max_updates=50)}


def test_the_likelihood_of_a_length_sums_to_one_and_is_the_product() -> None:
    rng = np.random.default_rng(0)
    logits = np.repeat(rng.normal(size=(1, 6)), 7, axis=0)
    p = 1 / (1 + np.exp(-logits[0]))
    lengths = np.array([1, 2, 3, 4, 5, 6, 6])
    terminated = np.array([True] * 6 + [False])  # all that can happen: an end after 1 to 6 steps, or none
    likelihood = np.exp(length_log_likelihood(logits, lengths, terminated))
    np.testing.assert_allclose(likelihood[2], (1 - p[0]) * (1 - p[1]) * p[2])
    np.testing.assert_allclose(likelihood[-1], np.prod(1 - p))
    np.testing.assert_allclose(likelihood.sum(), 1)
    extreme = length_log_likelihood(np.full((2, 3), 800.0), np.array([3, 3]), np.array([True, False]))
    np.testing.assert_allclose(extreme, [-1600, -2400])


def test_candidates_are_drawn_in_proportion_to_their_weights() -> None:
    weights = np.array([0.1, 0.6, 0.3])
    drawn = draw_in_proportion(np.log(np.tile(weights, (20_000, 1))) - 900, rng=np.random.default_rng(0))
    np.testing.assert_allclose(np.bincount(drawn) / 20_000, weights, atol=0.02)


def test_padding_has_no_part_in_the_fit() -> None:
    rng = np.random.default_rng(0)
    lengths = (1, 7, 4, 5, 2, 6)
    data = Matrices(
        [rng.normal(size=(n + 1, 2)) for n in lengths],
        [rng.normal(size=(n, 1)) for n in lengths],
        [rng.normal(size=n) for n in lengths],
    )
    padded = whole_episodes(data, terminated=np.array([True, False, True, True, False, True]))
    np.testing.assert_array_equal(padded.recorded.sum(axis=1), lengths)
    assert padded.terminal is not None
    assert np.argwhere(padded.terminal).tolist() == [[0, 0], [2, 3], [3, 4], [5, 5]]
    other = dataclasses.replace(
        padded,
        states=np.where(padded.recorded_states[..., None], padded.states, 1e6),
        actions=np.where(padded.recorded[..., None], padded.actions, -1e6),
        rewards=np.where(padded.recorded, padded.rewards, np.nan),
    )
    changed = dataclasses.replace(padded, states=padded.states + 0.1 * (np.arange(6) == 1)[:, None, None])

    def weights(sequences: Any) -> bytes:
        one, two = Layout(1, (0,), ()), Layout(2, (0, 1), ())
        config, rng = VAEMDPConfig(max_updates=8, evaluate_every=4), derive(0)
        model = fit_many([sequences], state_layout=two, action_layout=one, config=config, rng=rng)[0]
        return b"".join(weight.numpy().tobytes() for weight in model.weights.values())

    assert weights(other) == weights(padded)
    assert weights(changed) != weights(padded)


GOAL = 3


def _corridors(n: int = 120, most: int = 10) -> minari.MinariDataset:
    """Return walks from cell 0, a step on with probability 1/2, that terminate in cell 3 or are cut at `most`."""
    rng = np.random.default_rng(0)
    buffers: list[EpisodeBuffer] = []
    for _ in range(n):
        moves = rng.integers(0, 2, most)
        cells = np.append(0, np.cumsum(moves))
        arrives = (cells == GOAL).any()
        steps = int(np.argmax(cells == GOAL)) if arrives else most
        last = np.arange(steps) == steps - 1
        buffers.append(
            EpisodeBuffer(
                observations=cells[: steps + 1],
                actions=moves[:steps],
                rewards=np.zeros(steps),
                terminations=last & arrives,
                truncations=last & ~arrives,
            )
        )
    return install_dataset("test/corridors-v0", buffers, spaces.Discrete(GOAL + 1), spaces.Discrete(2))


def test_the_end_head_picks_samples_that_end_when_they_must() -> None:
    """A walk arrives at its planned last step, not before, one time in seven; of 24 candidates most often one does."""
    source = Source(_corridors())
    model = VAEMDPConfig(max_updates=200, patience=None, learning_rate=0.02, encoder=(32,))
    settings = VAEMDP(model=model, behavior=BehaviorConfig(max_updates=50))
    state = settings.fit(source, seed=0).state()

    def share_that_fits(candidates: int) -> float:
        sampler = dataclasses.replace(settings, candidates=candidates).restore(source, *state, seed=0)
        material = sampler.decode(sampler.generate(0))
        fits: list[bool] = []
        for i in range(len(source)):
            episode = sampler.variation(i, 0, material).episode
            at_goal = episode.observations == GOAL
            ends = at_goal[-1] and not at_goal[:-1].any()
            fits.append(bool(ends if episode.terminations[-1] else not at_goal.any()))
        return float(np.mean(fits))

    assert share_that_fits(1) < 0.35
    assert share_that_fits(24) > 0.75


def test_every_step_is_generated_and_flags_and_infos_are_the_source(
    make_dataset: Callable[..., minari.MinariDataset],
) -> None:
    data = AugmentedDataset(make_dataset([6, 1, 9, 4]), VAEMDP(**QUICK), factor=3, seed=0)
    samples = set()
    for number in range(4, 12):
        episode, source, origin = data[number], data[number % 4], data.provenance(number)
        assert origin.mask.all()
        assert len(origin.mask) == len(source)
        samples.update(span.sample for span in origin.spans)
        position = episode.observations["position"]
        assert (position != source.observations["position"]).any(axis=1).all()  # the last state too
        assert position.dtype == np.float32
        assert (episode.rewards != source.rewards).all()
        for name in ("terminations", "truncations"):
            np.testing.assert_array_equal(getattr(episode, name), getattr(source, name))
        np.testing.assert_array_equal(episode.infos["clock"], source.infos["clock"])
        assert not np.shares_memory(episode.rewards, source.rewards)
    assert samples == set(range(8))


@pytest.mark.parametrize("values", [1, 500, 10**9])
def test_what_is_generated_for_an_episode_goes_to_that_episode(
    make_dataset: Callable[..., minari.MinariDataset], monkeypatch: pytest.MonkeyPatch, values: int
) -> None:
    """With roll-outs that stay at their first state, every row tells its episode; batches of any size."""

    def stay(model: FittedVAEMDP, count: int, *, start_states: np.ndarray, steps: int, **_: object) -> Samples:
        states = start_states[:, None].repeat(steps + 1, axis=1)
        step = np.arange(steps) + np.zeros((count, 1))
        zeros = np.zeros((count, steps))
        return Samples(states, states[:, 1:, 3:4], step, zeros, np.full(count, steps), zeros)  # behind the three modes

    monkeypatch.setattr(vae_mdp, "_BATCH_VALUES", values)
    real = make_dataset([3, 8, 1, 5, 8, 2])
    sampler = VAEMDP(start="posterior", candidates=3, **QUICK).fit(Source(real), seed=0)
    monkeypatch.setattr(FittedVAEMDP, "sample", stay)
    material = sampler.decode(sampler.generate(0))
    for i, source in enumerate(real):
        episode = sampler.variation(i, 0, material).episode
        assert (episode.observations["position"][:, 0] == 1000 * i).all()
        assert (episode.actions == 1000 * i).all()
        np.testing.assert_array_equal(episode.rewards, np.arange(len(source)))


def test_where_no_episode_terminates_candidates_change_nothing(walk_dataset: minari.MinariDataset) -> None:
    one, many = (AugmentedDataset(walk_dataset, VAEMDP(candidates=n, **QUICK), factor=2) for n in (1, 16))
    assert content_hash(one) == content_hash(many)


def test_a_single_episode_of_one_step_is_enough(make_dataset: Callable[..., minari.MinariDataset]) -> None:
    data = AugmentedDataset(make_dataset([1]), VAEMDP(**QUICK), factor=3)
    assert [len(episode) for episode in data] == [1, 1, 1]
    assert data[1].terminations.all()


def test_a_shorter_roll_out_is_the_first_part_of_a_longer_one(walk_dataset: minari.MinariDataset) -> None:
    sampler = VAEMDP(**QUICK).fit(Source(walk_dataset), seed=0)
    model, policy = sampler._learned.models[0], sampler._learned.behavior
    long, short = (model.sample(4, rng=derive(0), policy=policy, steps=steps) for steps in (None, 7))
    assert long.rewards.shape == (4, 28)
    for name in ("actions", "rewards", "log_prob", "end_logits"):
        np.testing.assert_array_equal(getattr(short, name), getattr(long, name)[:, :7])
    np.testing.assert_array_equal(short.states, long.states[:, :8])
    with pytest.raises(ConfigurationError, match="steps must be 1 to 28"):
        model.sample(4, rng=derive(0), policy=policy, steps=29)
