"""OAT end to end on small data; its parts are tested in tests/mining and tests/generation."""

import dataclasses
import subprocess
import sys

import minari
import numpy as np
import pytest
from gymnasium import spaces
from minari.data_collector import EpisodeBuffer

import oat_gym
from oat_gym import OAT, AugmentedDataset, MiningConfig
from oat_gym.augmenters import oat, stitched
from oat_gym.episodes import content_hash
from oat_gym.errors import AugmentationWarning, ConfigurationError, InvalidDataError, UnsupportedSpaceError
from oat_gym.generation import BehaviorConfig, VAEMDPConfig
from oat_gym.generation.sampling import FittedVAEMDP
from oat_gym.mining import count_tdss
from oat_gym.source import Source
from tests.conftest import install_dataset, walks


@pytest.fixture
def fitted(walk_dataset: minari.MinariDataset, tiny_oat: OAT) -> AugmentedDataset:
    return AugmentedDataset(walk_dataset, tiny_oat, factor=4, seed=0).fit()


def test_episodes_are_their_source_to_the_last_bit_outside_spans(fitted: AugmentedDataset) -> None:
    assert len(fitted) == 48
    changed = 0
    for number in range(12, 48):
        origin, episode = fitted.provenance(number), fitted[number]
        source, mask = fitted[origin.source], origin.mask
        assert origin.source == number % 12
        state_mask = np.append(mask, False)
        for name in ("observations", "actions", "rewards"):
            rows = state_mask if name == "observations" else mask
            before, after = getattr(source, name), getattr(episode, name)
            assert after.dtype == before.dtype
            np.testing.assert_array_equal(after[~rows], before[~rows])
            changed += (after[rows] != before[rows]).sum()
        for name in ("terminations", "truncations"):
            np.testing.assert_array_equal(getattr(episode, name), getattr(source, name))
    assert changed > 36 * 6


def test_spans_are_where_the_mined_windows_are(fitted: AugmentedDataset) -> None:
    mining = fitted.mining
    for number in range(12, 48):
        for span in fitted.provenance(number).spans:
            labels = mining.labels[number % 12][span.start : span.stop]
            assert tuple(labels) == mining.sets[span.pst_set].labels
            assert span.seam[0] >= 0
            assert span.sample is not None


def test_generated_values_lie_in_the_spaces(fitted: AugmentedDataset) -> None:
    for episode in fitted[12:]:
        assert all(fitted.observation_space.contains(row) for row in episode.observations)
        assert all(fitted.action_space.contains(row) for row in episode.actions)
        assert np.isfinite(episode.rewards).all()


def test_variations_of_an_episode_differ(fitted: AugmentedDataset) -> None:
    assert not np.array_equal(fitted[12].rewards, fitted[24].rewards)


def test_it_fits_once_and_reads_the_cache_after(
    fitted: AugmentedDataset, walk_dataset: minari.MinariDataset, tiny_oat: OAT, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise AssertionError("trained again")

    monkeypatch.setattr(OAT, "fit", fail)
    again = AugmentedDataset(walk_dataset, tiny_oat, factor=4, seed=0)
    assert content_hash(again) == content_hash(fitted)
    assert repr(again.mining) == repr(fitted.mining)
    fewer = AugmentedDataset(walk_dataset, tiny_oat, factor=2, seed=0)  # the same model serves other factors
    assert content_hash(fewer) == content_hash(fitted[0:24])
    with pytest.raises(AssertionError, match="trained again"):
        AugmentedDataset(walk_dataset, tiny_oat, factor=2, seed=1).fit()


def test_the_same_seed_gives_the_same_bytes_in_another_process_and_order(
    fitted: AugmentedDataset, tmp_path_factory: pytest.TempPathFactory
) -> None:
    script = """
import os, sys
import torch
torch.set_num_threads(1)
import minari, oat_gym
from oat_gym.episodes import content_hash
from oat_gym.generation import BehaviorConfig, VAEMDPConfig
mining = oat_gym.MiningConfig(n_clusters=3, length=6, top=2, switch_penalty=5.0)
config = oat_gym.OAT(mining=mining, model=VAEMDPConfig(max_updates=20), behavior=BehaviorConfig(max_updates=50))
data = oat_gym.AugmentedDataset(minari.load_dataset("test/walks-v0"), config, factor=4, seed=0)
episodes = {int(e.id): e for e in data.iterate_episodes(range(47, -1, -1))}
print(content_hash(episodes[i] for i in range(48)))
"""
    environment = {**__import__("os").environ, "OAT_GYM_CACHE": str(tmp_path_factory.mktemp("another_cache"))}
    run = subprocess.run([sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=True)
    assert run.stdout.strip() == content_hash(fitted)


def test_literal_seams_show_in_transitions_only(walk_dataset: minari.MinariDataset, tiny_oat: OAT) -> None:
    contiguous = AugmentedDataset(walk_dataset, dataclasses.replace(tiny_oat, seam="contiguous"), factor=2)
    literal = AugmentedDataset(walk_dataset, dataclasses.replace(tiny_oat, seam="literal"), factor=2)
    assert content_hash(literal) == content_hash(contiguous)
    a, b = contiguous.transitions(), literal.transitions()
    np.testing.assert_array_equal(a.observations, b.observations)
    differs = (a.next_observations != b.next_observations).any(axis=1)
    expected = np.zeros(len(a), dtype=bool)
    offsets = np.cumsum([0, *(len(episode) for episode in literal)])
    for number in range(12, 24):
        source, origin = literal[number - 12], literal.provenance(number)
        for span in origin.spans:
            last = offsets[number] + span.stop - 1
            expected[last] = True
            if span.start and not origin.mask[span.start - 1]:
                expected[offsets[number] + span.start - 1] = True
                kept = b.next_observations[offsets[number] + span.start - 1]
                np.testing.assert_array_equal(kept, source.observations[span.start])
    np.testing.assert_array_equal(differs, expected)


def test_matched_seams_jump_less(walk_dataset: minari.MinariDataset, tiny_oat: OAT) -> None:
    def mean_jump(seam: str) -> float:
        form = dataclasses.replace(tiny_oat, start="prior", observation_noise=True, seam=seam)
        data = AugmentedDataset(walk_dataset, form, factor=3)
        return float(np.mean([sum(span.seam) for i in range(12, 36) for span in data.provenance(i).spans]))

    assert mean_jump("matched") < 0.7 * mean_jump("contiguous")


def test_many_samples_are_rolled_out_in_parts(
    walk_dataset: minari.MinariDataset, tiny_oat: OAT, monkeypatch: pytest.MonkeyPatch
) -> None:
    sampler = tiny_oat.fit(Source(walk_dataset), seed=0)
    sizes: list[int] = []
    drawn = FittedVAEMDP.sample
    monkeypatch.setattr(FittedVAEMDP, "sample", lambda self, n, **rest: sizes.append(n) or drawn(self, n, **rest))
    whole = sampler.generate(1)
    n_spans = len(whole["0/rows"])
    assert sizes[0] == n_spans * tiny_oat.candidates and n_spans > 4
    calls = len(sizes)  # one a set
    monkeypatch.setattr(stitched, "_AT_ONCE", 4 * tiny_oat.candidates)
    parts = sampler.generate(1)
    assert max(sizes[calls:]) == 4 * tiny_oat.candidates and sum(sizes[calls:]) == sum(sizes[:calls])
    assert {name: array.shape for name, array in parts.items()} == {name: array.shape for name, array in whole.items()}
    np.testing.assert_array_equal(parts["0/rows"], whole["0/rows"])
    assert len(np.unique(parts["0/actions"].reshape(n_spans, -1), axis=0)) == n_spans
    assert parts["0/seams"].mean() < 1.5 * whole["0/seams"].mean()  # each sample is in the place of its own span


def test_recorded_actions_are_kept(walk_dataset: minari.MinariDataset, tiny_oat: OAT) -> None:
    data = AugmentedDataset(walk_dataset, dataclasses.replace(tiny_oat, actions="recorded"), factor=2)
    for number in range(12, 24):
        np.testing.assert_allclose(data[number].actions, data[number - 12].actions, atol=1e-6)
        assert not np.array_equal(data[number].observations, data[number - 12].observations)


def test_dict_and_discrete_spaces(tiny_oat: OAT) -> None:
    rng = np.random.default_rng(0)
    buffers = [
        EpisodeBuffer(
            observations={"place": (np.arange(n + 1) * 3 // (n + 1)).astype(np.int64), "x": rng.random((n + 1, 1))},
            actions=rng.integers(0, 3, n),
            rewards=rng.random(n),
            terminations=np.arange(n) == n - 1,
            truncations=np.zeros(n, dtype=bool),
        )
        for n in (20, 13, 17, 25, 19, 22)
    ]
    space = spaces.Dict(place=spaces.Discrete(3), x=spaces.Box(0, 1, (1,), dtype=np.float64))
    real = install_dataset("test/discrete-v0", buffers, space, spaces.Discrete(3))
    data = AugmentedDataset(real, dataclasses.replace(tiny_oat, features=("place",)), factor=3)
    for episode in data:
        assert all(space.contains(step) for step in _steps(episode.observations))
        assert set(np.unique(episode.actions)) <= {0, 1, 2}
        assert episode.actions.dtype == np.int64
    assert any(data.provenance(i).spans for i in range(6, 18))
    with pytest.raises(ConfigurationError, match=r"features names 'speed'.*its keys are place, x"):
        AugmentedDataset(real, dataclasses.replace(tiny_oat, features=("speed",)), factor=3)


def _steps(batch: dict[str, np.ndarray]) -> list[dict[str, np.ndarray]]:
    return [{key: values[t] for key, values in batch.items()} for t in range(len(batch["x"]))]


def test_episodes_without_an_occurrence_are_copied_and_say_so(tiny_oat: OAT) -> None:
    box = spaces.Box(-100, 100, (2,))
    short = EpisodeBuffer(
        observations=np.zeros((2, 2), np.float32),
        actions=np.zeros((1, 2), np.float32),
        rewards=[0.0],
        terminations=[True],
        truncations=[False],
    )
    real = install_dataset("test/mixed-v0", [*walks(8, 24), short], box, spaces.Box(-1, 1, (2,)))
    data = AugmentedDataset(real, tiny_oat, factor=2)
    with pytest.warns(AugmentationWarning, match=r"1 of 9 episodes hold no window .* exact copies"):
        data.fit()
    assert data.provenance(17).spans == ()
    assert content_hash([data[17]]) == content_hash([data[8]])
    assert "1 of 9 series" in repr(data.mining)


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("field", ["observations", "actions", "rewards"])
def test_values_that_are_not_finite_are_found_before_any_work(field: str, value: float, tiny_oat: OAT) -> None:
    buffers = walks(4, 10)
    array = getattr(buffers[2], field)
    array[3] = value
    infinite = spaces.Box(-np.inf, np.inf, (2,))
    real = install_dataset("test/broken-v0", buffers, infinite, infinite)
    data = AugmentedDataset(real, tiny_oat, factor=2)
    with pytest.raises(InvalidDataError, match=f"{field[:-1]} at step 3 of episode 2 is {value}"):
        data.fit()


def test_episodes_that_are_all_too_short_get_a_clear_answer_at_once(walk_dataset: minari.MinariDataset) -> None:
    with pytest.raises(InvalidDataError, match=r"24 to 28 steps \(median 25.5\).*length='auto'"):
        AugmentedDataset(walk_dataset, OAT(mining=MiningConfig(length=29)), factor=2)


def test_spaces_that_are_not_modelled_are_refused_at_once_but_carried() -> None:
    image = spaces.Box(0, 255, (40, 40, 3), dtype=np.uint8)
    frames = np.zeros((3, 40, 40, 3), dtype=np.uint8)
    buffer = EpisodeBuffer(
        observations=frames,
        actions=np.zeros((2, 1), np.float32),
        rewards=[0.0, 0.0],
        terminations=[False, True],
        truncations=[False, False],
    )
    real = install_dataset("test/image-v0", [buffer], image, spaces.Box(-1, 1, (1,)))
    with pytest.raises(UnsupportedSpaceError, match=r"observation space Box\(0, 255, \(40, 40, 3\), uint8\)"):
        AugmentedDataset(real, OAT(), factor=2)
    assert AugmentedDataset(real, OAT(), count=0)[0].observations.shape == (3, 40, 40, 3)


@pytest.mark.parametrize(
    "settings",
    [
        {"start": "middle"},
        {"seam": "none"},
        {"actions": "mine"},
        {"candidates": 0},
        {"features": "x"},
        {"features": ()},
    ],
)
def test_bad_settings_are_named(settings: dict[str, object]) -> None:
    with pytest.raises(ConfigurationError, match=next(iter(settings))):
        OAT(**settings)


def test_presets_and_repr() -> None:
    paper = OAT.preset("paper")
    assert (paper.start, paper.observation_noise, paper.seam, paper.ends) == ("prior", True, "literal", "generated")
    default = OAT()
    assert OAT.preset("default") == default
    assert (default.start, default.observation_noise, default.seam) == ("posterior", False, "matched")
    assert paper.model == VAEMDPConfig.from_preset("paper")
    names = {"OAT": OAT, "MiningConfig": MiningConfig, "VAEMDPConfig": VAEMDPConfig}
    names["BehaviorConfig"] = type(paper.behavior)
    assert eval(repr(paper), names) == paper
    with pytest.raises(ConfigurationError, match="preset"):
        OAT.preset("best")
    assert oat_gym.AUGMENTERS["oat"] is OAT


def test_global_random_states_are_not_touched(walk_dataset: minari.MinariDataset, tiny_oat: OAT) -> None:
    import torch

    numpy_state, torch_state = np.random.get_state()[1].copy(), torch.get_rng_state()  # noqa: NPY002
    list(AugmentedDataset(walk_dataset, tiny_oat, factor=2))
    np.testing.assert_array_equal(np.random.get_state()[1], numpy_state)  # noqa: NPY002
    assert torch.equal(torch.get_rng_state(), torch_state)


class _Still:
    """A policy that never moves."""

    def sample(self, observations: np.ndarray, *, rng: np.random.Generator) -> np.ndarray:
        assert observations.dtype == np.float32
        return np.zeros((len(observations), 2), dtype=np.float32)

    def log_prob(self, observations: np.ndarray, actions: np.ndarray) -> np.ndarray:
        return np.zeros(len(observations))


def test_a_policy_of_the_users_acts_in_the_roll_outs(walk_dataset: minari.MinariDataset, tiny_oat: OAT) -> None:
    config = dataclasses.replace(tiny_oat, policy=_Still())
    data = AugmentedDataset(walk_dataset, config, factor=2)
    for number in range(12, 24):
        mask = data.provenance(number).mask
        assert (data[number].actions[mask] == 0).all()
    with pytest.raises(ConfigurationError, match="lazy=False"):
        data.save("test/policy-v0", lazy=True)
    with pytest.raises(ConfigurationError, match="policy"):
        OAT(policy=3)


def test_integer_rewards_become_floats_in_synthetic_episodes_only(tiny_oat: OAT) -> None:
    buffers = [dataclasses.replace(b, rewards=np.arange(len(b.rewards)) % 3) for b in walks(8, 24)]
    real = install_dataset("test/integers-v0", buffers, spaces.Box(-100, 100, (2,)), spaces.Box(-1, 1, (2,)))
    data = AugmentedDataset(real, tiny_oat, factor=2)
    assert data[0].rewards.dtype.kind == "i"
    episode, mask = data[8], data.provenance(8).mask
    assert episode.rewards.dtype == np.float64
    assert (episode.rewards[mask] != np.rint(episode.rewards[mask])).any()
    np.testing.assert_array_equal(episode.rewards[~mask], data[0].rewards[~mask])


def test_samples_are_numbered_once(walk_dataset: minari.MinariDataset, tiny_oat: OAT) -> None:
    data = AugmentedDataset(walk_dataset, tiny_oat, factor=5)
    found = [(span.pst_set, span.sample) for i in range(12, 60) for span in data.provenance(i).spans]
    assert len(found) == len(set(found)) > 48


def test_constant_features_and_episodes_of_one_step_are_modelled() -> None:
    buffers = [
        EpisodeBuffer(
            observations=np.array([[1.0, 7.0], [e, 7.0]], dtype=np.float32),
            actions=np.full((1, 1), e, dtype=np.float32),
            rewards=np.array([float(e)]),
            terminations=[True],
            truncations=[False],
        )
        for e in range(12)
    ]
    wide = spaces.Box(-100, 100, (2,)), spaces.Box(-100, 100, (1,))
    real = install_dataset("test/bandit-v0", buffers, *wide)
    config = OAT(
        mining=MiningConfig(n_clusters=2, length=1),
        model=VAEMDPConfig(max_updates=5),
        behavior=BehaviorConfig(max_updates=5),
        ends="generated",
    )
    for episode in AugmentedDataset(real, config, factor=2):
        np.testing.assert_array_equal(episode.observations[:, 1], 7)
        assert len(episode) == 1


@pytest.mark.parametrize("data_format", ["hdf5", "arrow"])
def test_times_are_those_of_their_steps_in_every_format(data_format: str) -> None:
    """Arrow cannot hold T rows of infos: `save` doubles the first, and gaps between times would move by a step."""
    buffers = [dataclasses.replace(b, infos={"hour": np.arange(len(b.rewards)) ** 2.0}) for b in walks(4, 9)]
    box = spaces.Box(-100, 100, (2,))
    real = AugmentedDataset(install_dataset("test/timed-v0", buffers, box, spaces.Box(-1, 1, (2,))), count=0)
    source = Source(real.save("test/copy-v0", data_format=data_format))
    for times, buffer in zip(oat._times(OAT(times="hour"), source) or (), buffers, strict=True):
        np.testing.assert_array_equal(times, buffer.infos["hour"])


def test_a_length_may_be_one_of_numpys_integers(walk_dataset: minari.MinariDataset, tiny_oat: OAT) -> None:
    config = dataclasses.replace(tiny_oat, mining=dataclasses.replace(tiny_oat.mining, length=np.int64(50)))
    with pytest.raises(InvalidDataError, match="No episode is as long as a sub-trajectory of 50 steps"):
        AugmentedDataset(walk_dataset, config)


@pytest.mark.shared_data
@pytest.mark.usefixtures("shared_data")
def test_ten_clusters_and_full_support_on_the_door_demonstrations() -> None:
    """The paper's own values for door-human (appendix B.2), with the default settings on the converted dataset."""
    mining = OAT().mine(oat_gym.domains.load("adroit-door-human"))
    assert mining.n_clusters == 10
    assert mining.sets[0].support == 25
    assert all(count_tdss(list(mining.labels), width).support.max() == 25 for width in (10, 20, 30, 40))


@pytest.mark.shared_data
@pytest.mark.usefixtures("shared_data")
def test_a_log_of_short_episodes_gets_a_clear_answer() -> None:
    tutoring = oat_gym.domains.load("tutoring-smartprimer")
    with pytest.raises(InvalidDataError, match=r"1 to \d+ steps \(median"):
        AugmentedDataset(tutoring, OAT(mining=MiningConfig(length=40)), factor=2)
    # W = 20 is possible for a few students only: the answer says for how many it is not.
    mining = OAT(mining=MiningConfig(n_clusters=4, length=20)).mine(tutoring)
    assert mining.n_too_short > 150
    assert f"{mining.n_too_short} of 178 series" in repr(mining)
    config = OAT(
        mining=MiningConfig(n_clusters=4), model=VAEMDPConfig(max_updates=5), behavior=BehaviorConfig(max_updates=5)
    )
    with pytest.warns(AugmentationWarning, match=r"1\d\d of 178 episodes hold no window .* exact copies"):
        AugmentedDataset(tutoring, config, factor=2).fit()
