"""What holds for every method that rolls out VAE-MDPs, whatever it generates: TDA and VAEMDP, small and quick."""

import dataclasses
import json
import warnings
from collections.abc import Callable

import minari
import numpy as np
import pytest
from gymnasium import spaces
from minari.data_collector import EpisodeBuffer

import oat_gym
from oat_gym import OAT, TDA, VAEMDP, AugmentedDataset
from oat_gym.augmenters.generative import GenerativeAugmenter
from oat_gym.cache import canonical
from oat_gym.checks import check_augmenter, check_dataset
from oat_gym.episodes import content_hash
from oat_gym.errors import ConfigurationError, InvalidDataError, UnsupportedSpaceError
from oat_gym.generation import BehaviorConfig, VAEMDPConfig
from oat_gym.serialization import config_from_json
from oat_gym.source import Source
from tests.conftest import install_dataset, walks

QUICK = {"model": VAEMDPConfig(max_updates=20), "behavior": BehaviorConfig(max_updates=50)}
METHODS = [TDA(length=6, **QUICK), VAEMDP(**QUICK)]
pytestmark = pytest.mark.filterwarnings("ignore::oat_gym.errors.AugmentationWarning")  # too short for a window


@pytest.fixture(params=METHODS, ids=lambda augmenter: augmenter.name)
def augmenter(request: pytest.FixtureRequest) -> GenerativeAugmenter:
    return request.param


def test_what_is_restored_generates_the_same_bytes_in_any_order(
    walk_dataset: minari.MinariDataset, augmenter: GenerativeAugmenter
) -> None:
    source = Source(walk_dataset)
    fitted = augmenter.fit(source, seed=4)
    restored = augmenter.restore(Source(walk_dataset), *fitted.state(), seed=4)
    first = {k: fitted.generate(k) for k in (0, 1, 2)}
    second = {k: restored.generate(k) for k in (2, 0, 1)}
    for k, arrays in first.items():
        assert {name: value.tobytes() for name, value in arrays.items()} == {
            name: value.tobytes() for name, value in second[k].items()
        }
    i, k = 3, 1
    one, other = (s.variation(i, k, s.decode(s.generate(k))) for s in (fitted, restored))
    assert content_hash([one.episode]) == content_hash([other.episode])
    assert one.spans == other.spans


def test_seeds_and_variations_differ_and_fits_repeat(
    walk_dataset: minari.MinariDataset, augmenter: GenerativeAugmenter
) -> None:
    sources = Source(walk_dataset), Source(walk_dataset), Source(walk_dataset)
    one, same, other = (augmenter.fit(s, seed=seed).generate(0) for s, seed in zip(sources, (0, 0, 1), strict=True))
    assert all(one[name].tobytes() == same[name].tobytes() for name in one)
    reward = next(name for name in one if name.endswith("rewards"))
    assert not np.array_equal(one[reward], other[reward])
    data = AugmentedDataset(walk_dataset, augmenter, factor=3, seed=0)
    assert not np.array_equal(data[12].rewards, data[24].rewards)


def test_log_probabilities_are_those_of_the_generated_actions(
    walk_dataset: minari.MinariDataset, augmenter: GenerativeAugmenter
) -> None:
    data = AugmentedDataset(walk_dataset, augmenter, factor=2, seed=0)
    behavior = data.synthesis.sampler._learned.behavior  # type: ignore[attr-defined]
    for j in range(12):
        variation, mask = data.synthesis.variation(j), data.provenance(12 + j).mask
        assert variation.log_prob is not None
        np.testing.assert_array_equal(np.isfinite(variation.log_prob), mask)
        episode = variation.episode
        expected = behavior.log_prob(episode.observations[:-1].astype(float), episode.actions.astype(float))
        np.testing.assert_allclose(variation.log_prob[mask], expected[mask], rtol=1e-3, atol=1e-3)
    changed = augmenter.fit(Source(walk_dataset), seed=0)
    material = changed.decode(changed.generate(0))
    changed.variation(0, 0, material).log_prob[:] = 0.0  # type: ignore[index]  # a copy: the material stays
    again = changed.variation(0, 0, material).log_prob
    assert again is not None
    assert (again[np.isfinite(again)] != 0).any()


def _discrete_dataset() -> minari.MinariDataset:
    rng = np.random.default_rng(0)
    buffers = [
        EpisodeBuffer(
            observations={
                "place": (np.arange(n + 1) * 3 // (n + 1)).astype(np.int64) + 5,
                "x": rng.random((n + 1, 1, 2)),
                "flags": rng.integers(0, 2, (n + 1, 2), dtype=np.int8),
            },
            actions=np.stack([rng.integers(0, 3, n), rng.integers(0, 2, n)], axis=1),
            rewards=rng.integers(0, 2, n),
            terminations=(np.arange(n) == n - 1) & (n % 2 == 0),
            truncations=(np.arange(n) == n - 1) & (n % 2 == 1),
        )
        for n in (20, 1, 13, 17, 1, 2, 25, 19, 22)
    ]
    observations = spaces.Dict(
        place=spaces.Discrete(3, start=5), x=spaces.Box(0, 1, (1, 2), dtype=np.float64), flags=spaces.MultiBinary(2)
    )
    return install_dataset("test/discrete-v0", buffers, observations, spaces.MultiDiscrete([3, 2]))


def test_every_kind_of_space_unequal_lengths_and_episodes_of_one_step(augmenter: GenerativeAugmenter) -> None:
    real = _discrete_dataset()
    data = AugmentedDataset(real, augmenter, factor=3, seed=0)
    check_dataset(data)
    for number, episode in enumerate(data):
        assert len(episode) == len(data[number % 9])
        for t in range(len(episode) + 1):
            assert data.observation_space.contains({key: values[t] for key, values in episode.observations.items()})
        assert all(data.action_space.contains(action) for action in episode.actions)
    assert len({episode.actions.tobytes() for episode in data[9:]}) > 9


def test_it_keeps_the_contract_of_an_augmenter(augmenter: GenerativeAugmenter) -> None:
    config = dataclasses.replace(augmenter, model=VAEMDPConfig(max_updates=5), behavior=BehaviorConfig(max_updates=5))
    report = check_augmenter(dataclasses.replace(config, length=4) if isinstance(config, TDA) else config)
    assert len(report.passed) > 15


def test_a_discrete_action_space(augmenter: GenerativeAugmenter) -> None:
    buffers = [dataclasses.replace(b, actions=(b.actions[:, 0] > 0).astype(np.int64) - 1) for b in walks(6, 12)]
    real = install_dataset("test/turns-v0", buffers, spaces.Box(-100, 100, (2,)), spaces.Discrete(2, start=-1))
    data = AugmentedDataset(real, augmenter, factor=2)
    assert {int(action) for episode in data[6:] for action in episode.actions} <= {-1, 0}
    assert data[6].actions.dtype == np.int64


def test_saved_as_a_dataset_and_as_a_recipe(walk_dataset: minari.MinariDataset, augmenter: GenerativeAugmenter) -> None:
    data = AugmentedDataset(walk_dataset, augmenter, factor=3, seed=2)
    expected = content_hash(data)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        data.save("test/saved-v0")
        data.save("test/recipe-v0", lazy=True)
    assert content_hash(minari.load_dataset("test/saved-v0")) == expected
    opened = minari.load_dataset("test/recipe-v0")
    assert content_hash(opened) == expected
    mask = data.provenance(20).mask
    np.testing.assert_array_equal(AugmentedDataset(opened, factor=1)[20].rewards[mask], data[20].rewards[mask])


def test_settings_come_back_from_json_and_repr(augmenter: GenerativeAugmenter) -> None:
    settings = json.loads(json.dumps(canonical(augmenter)))
    assert config_from_json(type(augmenter), settings) == augmenter
    names = {kind.__name__: kind for kind in (TDA, VAEMDP, VAEMDPConfig, BehaviorConfig)}
    assert eval(repr(augmenter), names) == augmenter
    assert oat_gym.AUGMENTERS[augmenter.name] is type(augmenter)
    assert getattr(oat_gym, type(augmenter).__name__) is type(augmenter)
    oat_gym.AUGMENTERS[augmenter.name]()


@pytest.mark.parametrize("method", [TDA, VAEMDP, OAT])
def test_presets(method: type[GenerativeAugmenter]) -> None:
    paper = method.preset("paper")
    assert type(paper) is method
    assert paper.model == VAEMDPConfig.from_preset("paper")
    assert method.preset("default") == method()
    with pytest.raises(ConfigurationError, match="preset"):
        method.preset("best")  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "settings",
    [
        {"start": "middle"},
        {"model": 3},
        {"behavior": None},
        {"observation_noise": 1},
        {"policy": 3},
        {"candidates": 0},
        {"candidates": True},
    ],
)
@pytest.mark.parametrize("method", [TDA, VAEMDP])
def test_bad_settings_are_named(method: type[GenerativeAugmenter], settings: dict[str, object]) -> None:
    with pytest.raises(ConfigurationError, match=next(iter(settings))):
        method(**settings)  # type: ignore[arg-type]


@pytest.mark.parametrize("start", ["prior", "posterior"])
def test_a_policy_of_the_users_and_both_starts(
    walk_dataset: minari.MinariDataset, augmenter: GenerativeAugmenter, start: str
) -> None:
    class Still:
        def sample(self, observations: np.ndarray, *, rng: np.random.Generator) -> np.ndarray:
            assert observations.dtype == np.float32
            return np.zeros((len(observations), 2), dtype=np.float32)

        def log_prob(self, observations: np.ndarray, actions: np.ndarray) -> np.ndarray:
            return np.full(len(observations), -3.0)

    config = dataclasses.replace(augmenter, policy=Still(), start=start)
    data = AugmentedDataset(walk_dataset, config, factor=2)
    mask = data.provenance(12).mask
    assert mask.any()
    assert (data[12].actions[mask] == 0).all()
    assert (data.synthesis.variation(0).log_prob[mask] == -3).all()  # type: ignore[index]


def test_what_cannot_be_modelled_is_refused(
    augmenter: GenerativeAugmenter, make_dataset: Callable[..., minari.MinariDataset]
) -> None:
    frames = np.zeros((3, 40, 40, 3), dtype=np.uint8)
    image = EpisodeBuffer(
        observations=frames, actions=np.zeros((2, 1)), rewards=[0.0, 0.0], terminations=[0, 1], truncations=[0, 0]
    )
    space = spaces.Box(0, 255, (40, 40, 3), dtype=np.uint8)
    real = install_dataset("test/images-v0", [image], space, spaces.Box(-1, 1, (1,)))
    with pytest.raises(UnsupportedSpaceError, match="observation space"):
        AugmentedDataset(real, augmenter, factor=2)
    broken = walks(3, 10)
    broken[1].actions[4] = np.nan
    infinite = spaces.Box(-np.inf, np.inf, (2,))
    real = install_dataset("test/broken-v0", broken, infinite, infinite)
    with pytest.raises(InvalidDataError, match="action at step 4 of episode 1 is nan"):
        AugmentedDataset(real, augmenter, factor=2).fit()
    assert len(AugmentedDataset(make_dataset([9, 7, 8]), augmenter, factor=2)) == 6


def test_progress_is_reported_and_global_random_states_stay(
    walk_dataset: minari.MinariDataset, augmenter: GenerativeAugmenter
) -> None:
    import torch

    numpy_state, torch_state = np.random.get_state()[1].copy(), torch.get_rng_state()  # noqa: NPY002
    said: list[str] = []
    data = AugmentedDataset(walk_dataset, augmenter, factor=2, seed=9)
    data.fit(progress=lambda what, done, total: said.append(f"{what} {done <= total}"))
    list(data)
    assert any(line.startswith("cloning") for line in said)
    assert any(line.startswith("training") for line in said)
    assert all(line.endswith("True") for line in said)
    np.testing.assert_array_equal(np.random.get_state()[1], numpy_state)  # noqa: NPY002
    assert torch.equal(torch.get_rng_state(), torch_state)
