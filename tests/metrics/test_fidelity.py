"""Fidelity of datasets made for it: copies, noise, shuffled dynamics; and what cannot be measured."""

import dataclasses
import doctest

import minari
import numpy as np
import pytest
from gymnasium import spaces
from minari.data_collector import EpisodeBuffer

from oat_gym import OAT, AugmentedDataset, Function, metrics
from oat_gym.augmenters.base import Sampler, Variation
from oat_gym.errors import ConfigurationError, InvalidDataError
from oat_gym.metrics import METRICS, compare, comparison, distances, fidelity, neighbors
from oat_gym.metrics.judge import Judge
from oat_gym.metrics.steps import Scale, Steps, read_steps
from oat_gym.spaces import FlatSpace
from tests.conftest import install_dataset

BOX = spaces.Box(-np.inf, np.inf, (2,), dtype=np.float64)


def system(n, steps, *, seed, reward_noise=0.02):
    """Episodes of a noisy linear system under random actions: s' = 0.9 s + a, r = -|s|."""
    rng = np.random.default_rng(seed)
    buffers = []
    for _ in range(n):
        actions = rng.uniform(-1, 1, (steps, 2))
        states = [rng.normal(size=2)]
        for action in actions:
            states.append(0.9 * states[-1] + action + 0.05 * rng.normal(size=2))
        states = np.array(states)
        rewards = -np.linalg.norm(states[:-1], axis=1) + reward_noise * rng.normal(size=steps)
        buffers.append(
            EpisodeBuffer(
                observations=states,
                actions=actions,
                rewards=rewards,
                terminations=np.zeros(steps, dtype=bool),
                truncations=np.arange(steps) == steps - 1,
            )
        )
    return buffers


@pytest.fixture
def dataset():
    return install_dataset("test/system-v0", system(8, 12, seed=0), BOX, BOX)


def to_steps(buffers):
    """Return the steps of episodes, numbered from 0."""
    lengths = [len(buffer.rewards) for buffer in buffers]
    return Steps(
        states=np.concatenate([buffer.observations[:-1] for buffer in buffers]),
        actions=np.concatenate([buffer.actions for buffer in buffers]),
        rewards=np.concatenate([buffer.rewards for buffer in buffers]),
        next_states=np.concatenate([buffer.observations[1:] for buffer in buffers]),
        episodes=np.repeat(np.arange(len(buffers)), lengths),
        numbers=np.concatenate([np.arange(length) for length in lengths]),
    )


REAL = to_steps(system(30, 30, seed=0))
FLAT = FlatSpace.of(BOX)
NO_SEAMS = np.empty((0, 2))


@pytest.fixture(scope="module")
def judge():
    return Judge(REAL, observations=FLAT, actions=FLAT, limit=450)


def test_copies_are_as_real_data_and_known_as_copies(judge):
    found = judge.fidelity(REAL, NO_SEAMS)
    assert found.n_real == found.n_generated == 900
    assert found.copies == metrics.Score(1.0, 0.0)
    assert found.memorised.value == 1
    assert found.memorised.reference == pytest.approx(0.5, abs=0.01)
    assert found.nearest.value < 0.01
    assert found.dynamics.value == found.reward.value == 1
    assert found.roughness.value == pytest.approx(1, abs=0.1)
    assert found.discriminative.value < 0.05
    for name in ("marginal", "sliced", "coverage_lost", "coverage_gained"):
        assert found.score(name).value <= found.score(name).reference + 0.02, name
    assert found.seam_mean == found.seam_p95 == metrics.Score(None, None)


def test_new_real_episodes_give_the_reference(judge):
    """The best method there is: what it generates is new real data, so that all values are the references."""
    found = judge.fidelity(to_steps(system(30, 30, seed=1)), NO_SEAMS)
    tolerance = {"memorised": 0.1, "nearest": 0.15, "discriminative": 0.1, "dynamics": 0.1, "reward": 0.15}
    for name in METRICS:
        score = found.score(name)
        if score.value is not None:
            assert score.value == pytest.approx(score.reference, abs=tolerance.get(name, 0.08)), name
    assert found.copies.value == 0


def test_shuffled_outcomes_break_the_dynamics_and_nothing_of_the_marginals(judge):
    order = np.random.default_rng(0).permutation(len(REAL))
    shuffled = dataclasses.replace(REAL, next_states=REAL.next_states[order], rewards=REAL.rewards[order])
    found, copied = judge.fidelity(shuffled, NO_SEAMS), judge.fidelity(REAL, NO_SEAMS)
    assert found.dynamics.value > 4
    assert found.reward.value > 1.5
    assert found.roughness.value > 1.5
    assert found.discriminative.value > 0.3
    assert found.marginal.value == pytest.approx(copied.marginal.value, abs=0.02)


def test_rewards_and_states_are_told_apart(judge):
    noise = np.random.default_rng(0).normal(size=len(REAL))
    found = judge.fidelity(dataclasses.replace(REAL, rewards=REAL.rewards + 3 * noise), NO_SEAMS)
    assert found.reward.value > 3
    assert found.dynamics.value == 1


def test_shifted_data_is_far_gains_ground_and_loses_all(judge):
    shifted = dataclasses.replace(REAL, states=REAL.states + 100, next_states=REAL.next_states + 100)
    found = judge.fidelity(shifted, NO_SEAMS)
    spread = REAL.states.std(axis=0)
    assert found.marginal.value == pytest.approx(2 * (100 / spread).sum() / 7, rel=0.03)  # s and s', of 7 columns
    assert found.coverage_gained.value == found.coverage_lost.value == 1
    assert found.discriminative.value == pytest.approx(0.5, abs=0.01)
    assert found.mmd.value > 0.5
    assert found.memorised.value == 0
    assert found.nearest.value > 10
    assert found.roughness.value == pytest.approx(1, abs=0.1)  # a shift alone changes no s' - s


def test_roughness_is_the_ratio_of_the_steps(judge):
    changes = REAL.next_states - REAL.states
    for factor in (0.5, 3.0):
        rough = dataclasses.replace(REAL, next_states=REAL.states + factor * changes)
        assert judge.fidelity(rough, NO_SEAMS).roughness.value == pytest.approx(factor, rel=0.1)


def test_half_of_the_real_ground_is_lost_and_all_new_ground_is_old(judge):
    half = REAL.take(REAL.states[:, 0] > np.median(REAL.states[:, 0]))
    every = np.tile(np.arange(len(half)), 2)
    # all places of the real data, with states of one half of the space
    kept = half.take(every[: len(REAL)])
    kept = dataclasses.replace(kept, episodes=REAL.episodes, numbers=REAL.numbers)
    found = judge.fidelity(kept, NO_SEAMS)
    assert found.coverage_lost.value == pytest.approx(0.4, abs=0.15)
    assert found.coverage_gained.value < found.coverage_gained.reference + 0.05


def test_a_judge_scores_several_methods_as_one_each(judge):
    first = judge.fidelity(REAL, NO_SEAMS)
    judge.fidelity(dataclasses.replace(REAL, rewards=REAL.rewards + 1), np.array([[0.1, 0.3]]))
    assert judge.fidelity(REAL, NO_SEAMS) == first


def test_parts_of_episodes_are_compared_with_the_real_steps_in_their_place(judge):
    """Copies of the first steps, which lie near the origin: measured against all steps they would be far away."""
    first = REAL.take(REAL.numbers < 6)
    found = judge.fidelity(first, NO_SEAMS)
    assert found.marginal.value < 0.8 * found.marginal.reference + 0.02
    assert found.coverage_lost.value <= found.coverage_lost.reference
    assert found.discriminative.value < 0.08
    moved = dataclasses.replace(REAL.take(REAL.numbers >= 24), numbers=first.numbers, episodes=first.episodes)
    assert judge.fidelity(moved, NO_SEAMS).marginal.value > found.marginal.value


def test_seams_are_means_and_quantiles_beside_real_steps(judge):
    seams = np.random.default_rng(0).exponential(size=(50, 2))
    found = judge.fidelity(REAL, seams)
    assert found.seam_mean.value == pytest.approx(seams.mean())
    assert found.seam_p95.value == pytest.approx(np.quantile(seams, 0.95))
    sizes = judge.scale.sizes(REAL)
    assert found.seam_mean.reference == pytest.approx(sizes.mean())
    assert found.seam_p95.reference == pytest.approx(np.quantile(sizes, 0.95))


def changed(dataset, change, **settings):
    """Return the fidelity of one variation an episode, made by `change(episode, rng)`."""

    def function(episode, rng):
        change(episode, rng)
        return episode

    return fidelity(AugmentedDataset(dataset, Function(function), factor=2), limit=100, **settings)


def test_the_same_seed_gives_the_same_numbers(dataset):
    def jitter(episode, rng):
        episode.observations[:] += 0.1 * rng.normal(size=episode.observations.shape)

    state = np.random.get_state()[1].copy()  # noqa: NPY002
    first, second = changed(dataset, jitter, seed=3), changed(dataset, jitter, seed=3)
    assert first == second
    assert first != changed(dataset, jitter, seed=4)
    np.testing.assert_array_equal(state, np.random.get_state()[1])  # noqa: NPY002


def test_stitched_episodes_count_their_spans_only_and_their_seams(walk_dataset, tiny_oat):
    data = AugmentedDataset(walk_dataset, tiny_oat, factor=3)
    found = fidelity(data, limit=60)
    masks = [data.provenance(number).mask for number in range(len(walk_dataset), len(data))]
    assert found.n_generated == sum(int(mask.sum()) for mask in masks) < sum(len(mask) for mask in masks)
    jumps = [jump for n in range(12, 36) for span in data.provenance(n).spans for jump in span.seam]
    assert found.seam_mean.value == pytest.approx(np.mean(jumps))


def test_a_saved_dataset_gives_the_numbers_of_the_augmented_one(walk_dataset, tiny_oat):
    data = AugmentedDataset(walk_dataset, tiny_oat, factor=2)
    saved = data.save("test/walks-saved-v0")
    assert fidelity(minari.load_dataset(saved.id), limit=100) == fidelity(data, limit=100)


def test_variations_of_variations_belong_to_the_real_episode(walk_dataset):
    copying = Function(lambda episode, rng: episode)
    twice = AugmentedDataset(AugmentedDataset(walk_dataset, copying, factor=2), copying, factor=2)
    contents = read_steps(twice)
    assert len(np.unique(contents.real.episodes)) == 12
    assert set(contents.generated.episodes) == set(contents.real.episodes)
    steps = contents.generated
    for number in range(12):
        mine = steps.take(steps.episodes == number)
        np.testing.assert_array_equal(mine.states[: len(walk_dataset[number])], walk_dataset[number].observations[:-1])


def test_a_view_without_the_episodes_that_others_were_made_from(walk_dataset):
    """What was made from episodes that the view leaves out was seen by neither half's model, so both score it."""
    data = AugmentedDataset(walk_dataset, Function(lambda episode, rng: episode), factor=2)
    found = fidelity(data.filter_episodes(lambda episode: episode.id < 5 or episode.id >= 18), limit=100)
    assert 0.5 < found.dynamics.value < 2
    assert 0.5 < found.reward.value < 2


def test_literal_seams_keep_their_own_next_states(walk_dataset, tiny_oat):
    data = AugmentedDataset(walk_dataset, dataclasses.replace(tiny_oat, seam="literal"), factor=2)
    columns = data.transitions(flat=True)
    np.testing.assert_array_equal(read_steps(data).generated.next_states, columns.next_observations[columns.synthetic])


def one_step(discrete):
    rng = np.random.default_rng(0)
    space = spaces.Discrete(3) if discrete else spaces.Box(-9, 9, (1,), dtype=np.float64)
    buffers = []
    for number in range(16):
        values = rng.integers(3, size=2) if discrete else rng.normal(size=(2, 1))
        buffers.append(
            EpisodeBuffer(
                observations=values,
                actions=rng.integers(2, size=1),
                rewards=np.array([float(number % 2)]),
                terminations=np.array([True]),
                truncations=np.array([False]),
            )
        )
    return install_dataset("test/one-v0", buffers, space, spaces.Discrete(2))


@pytest.mark.parametrize("discrete", [True, False])
def test_discrete_spaces_and_episodes_of_one_step(discrete):
    found = changed(one_step(discrete), lambda episode, rng: None)
    assert found.n_real == 16
    assert found.copies.value == 1
    assert all(np.isfinite(v) for name in METRICS if (v := found.score(name).value) is not None)
    if discrete:  # equal steps lie in other episodes too: a copy of one is nothing memorised
        assert found.copies.reference > 0.2


def test_a_constant_reward_gives_ratio_one_and_another_one_shows():
    judge = Judge(dataclasses.replace(REAL, rewards=np.zeros(900)), observations=FLAT, actions=FLAT, limit=100)
    assert judge.fidelity(judge.real, NO_SEAMS).reward.value == pytest.approx(1)
    assert judge.fidelity(dataclasses.replace(REAL, rewards=np.ones(900)), NO_SEAMS).reward.value > 100


def test_one_source_episode_leaves_nothing_for_a_classifier(dataset):
    data = AugmentedDataset(dataset, Function(lambda episode, rng: episode), count=1)
    found = fidelity(data, limit=60)
    assert found.n_generated == 12
    assert found.discriminative.value is None
    assert found.dynamics.value is not None


def test_what_cannot_be_measured_is_refused(dataset):
    copying = Function(lambda episode, rng: episode)
    with pytest.raises(InvalidDataError, match="0 steps were generated"):
        fidelity(AugmentedDataset(dataset, count=0))
    few = install_dataset("test/few-v0", system(3, 10, seed=0), BOX, BOX)
    with pytest.raises(InvalidDataError, match="There are 3 real episodes and fidelity needs 4"):
        fidelity(AugmentedDataset(few, copying, factor=2))
    whole = AugmentedDataset(dataset, copying, factor=2)
    generated = whole.filter_episodes(lambda episode: episode.id >= 8)
    with pytest.raises(InvalidDataError, match="There are 0 real episodes"):
        fidelity(generated)
    with pytest.raises(ConfigurationError, match="limit must be"):
        fidelity(whole, limit=1)
    with pytest.raises(ConfigurationError, match="seed must be"):
        fidelity(whole, seed=-1)

    def spoil(episode, rng):
        episode.rewards[3] = np.nan

    with pytest.raises(InvalidDataError, match=r"Step 3 of episode 8 has rewards that are not finite"):
        changed(dataset, spoil)


class Silent(Sampler):
    """Marks no step as generated."""

    def __init__(self, source):
        self.source = source

    def variation(self, i, k, material):
        return Variation(self.source.episodes[i], ())


@dataclasses.dataclass(frozen=True)
class Nothing(Function):
    def fit(self, source, *, seed, progress=None):
        return Silent(source)


def test_compare_gives_a_row_a_method_and_the_reason_of_those_that_fail(dataset):
    seen = []
    methods = {
        "copy": Function(lambda episode, rng: episode),
        "nothing": Nothing(lambda episode, rng: episode),
        "too-long": dataclasses.replace(OAT(), mining=dataclasses.replace(OAT().mining, length=1000)),
    }
    rows = compare(
        dataset, methods, factor=2, limit=60, progress=lambda what, done, total: seen.append((what, done, total))
    )
    assert [row.name for row in rows] == list(methods)
    assert rows[0].fidelity == fidelity(AugmentedDataset(dataset, methods["copy"], factor=2), limit=60)
    assert rows[0].reason is None
    assert rows[1].fidelity is None
    assert "0 steps were generated" in rows[1].reason
    assert "No episode is as long" in rows[2].reason
    assert seen[0] == ("Comparing", 0, 3)
    assert seen[-1] == ("Comparing", 3, 3)


def test_compare_of_an_augmented_dataset_uses_its_real_episodes(dataset):
    copying = {"copy": Function(lambda episode, rng: episode)}
    augmented = AugmentedDataset(dataset, copying["copy"], factor=3)
    assert compare(augmented, copying, factor=2, limit=60)[0] == compare(dataset, copying, factor=2, limit=60)[0]


def test_compare_refuses_nothing_to_compare(dataset):
    with pytest.raises(ConfigurationError, match="no augmenter"):
        compare(dataset, {})
    for factor in (1, 0.5, float("nan"), float("inf")):
        with pytest.raises(ConfigurationError, match="factor must be over 1"):
            compare(dataset, None, factor=factor)
    with pytest.raises(ConfigurationError, match="makes 0 more"):
        compare(dataset, None, factor=1.01)
    with pytest.raises(ConfigurationError, match="1 to 10000000 can be compared"):
        compare(dataset, None, factor=1e30)


def test_units_are_standard_deviations_and_one_hot_columns_stay():
    flat = FlatSpace.of(spaces.Dict(a=spaces.Box(-9, 9, (2,), dtype=np.float64), b=spaces.Discrete(2)))
    rng = np.random.default_rng(0)
    states = np.hstack((rng.normal(5, 3, (500, 1)), np.full((500, 1), 0.1), np.eye(2)[rng.integers(2, size=500)]))
    steps = Steps(states, states[:, :1], states[:, 0], states + 1, np.arange(500), np.zeros(500, dtype=np.int64))
    scale = Scale.of(steps, observations=flat, actions=FlatSpace.of(spaces.Box(-9, 9, (1,))))
    inputs = scale.inputs(steps)
    np.testing.assert_allclose(inputs[:, [0, 4]].std(axis=0), 1)
    np.testing.assert_allclose(inputs[:, 1], 0, atol=1e-12)
    np.testing.assert_array_equal(inputs[:, 2:4], states[:, 2:])
    spread = states[:, 0].std()
    np.testing.assert_allclose(scale.sizes(steps), np.sqrt((1 / spread**2 + 3) / 4))


def test_rows_and_metrics_have_every_score(dataset):
    found = changed(dataset, lambda episode, rng: None)
    row = found.to_row()
    assert list(row)[:4] == ["n_real", "n_generated", "coverage_gained", "coverage_gained_reference"]
    assert len(row) == 2 + 2 * len(METRICS)
    assert set(METRICS) == {field.name for field in dataclasses.fields(found)} - {"n_real", "n_generated"}
    with pytest.raises(ConfigurationError, match="no metric 'magic'"):
        found.score("magic")


@pytest.mark.parametrize("module", [metrics, comparison, distances, neighbors])
def test_examples_in_docstrings(module):
    assert doctest.testmod(module).failed == 0
