"""Every method of `AUGMENTERS` keeps the contract, is saved, kept as a recipe, and works from the command line."""

import dataclasses
from typing import Any

import minari
import numpy as np
import pytest
from gymnasium import spaces
from minari.data_collector import EpisodeBuffer
from typer.testing import CliRunner

from oat_gym import AUGMENTERS, AugmentedDataset, Augmenter, Compose, Function, Mixture, cli
from oat_gym.checks import check_augmenter
from oat_gym.episodes import content_hash
from oat_gym.errors import ConfigurationError
from tests.conftest import install_dataset

QUICK: dict[str, Any] = {
    "max_updates": 10,
    "embedding_iterations": 10,
    "supervised_iterations": 10,
    "joint_iterations": 5,
    "n_clusters": 3,
    "length": 6,
}
"""Settings that make a method quick, whichever has them: short training, no search, short windows."""


def quick(settings: Any) -> Any:
    """Return a configuration with the settings of `QUICK` wherever it has a field of their name."""
    changes: dict[str, Any] = {}
    for field in dataclasses.fields(settings):
        value = getattr(settings, field.name)
        if field.name in QUICK:
            changes[field.name] = QUICK[field.name]
        elif dataclasses.is_dataclass(value):
            changes[field.name] = quick(value)
    return dataclasses.replace(settings, **changes)


@pytest.fixture(params=sorted(AUGMENTERS))
def method(request: pytest.FixtureRequest) -> Augmenter:
    return quick(AUGMENTERS[request.param]())


def test_names_are_the_keys() -> None:
    assert {name: cls.name for name, cls in AUGMENTERS.items()} == {name: name for name in AUGMENTERS}


def test_the_contract_is_kept(method: Augmenter) -> None:
    report = check_augmenter(method, limit=6)
    assert {name for name, _ in report.skipped} <= {"own-dataset", "alignment"}
    assert {name for name, _ in report.expected_failed} <= set(type(method).expected_failures)


@pytest.mark.filterwarnings("ignore::oat_gym.errors.AugmentationWarning")
def test_it_is_saved_and_kept_as_a_recipe(method: Augmenter, walk_dataset: minari.MinariDataset) -> None:
    data = AugmentedDataset(walk_dataset, method, factor=2, seed=3)
    saved = data.save("test/saved-v0")
    assert content_hash(saved) == content_hash(data)
    recipe = data.save("test/recipe-v0", lazy=True)
    assert isinstance(recipe, AugmentedDataset)
    assert recipe.augmenter == method
    assert content_hash(recipe) == content_hash(data)


@pytest.mark.filterwarnings("ignore::oat_gym.errors.AugmentationWarning")
def test_the_command_line_takes_it(
    method: Augmenter, walk_dataset: minari.MinariDataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(AUGMENTERS, method.name, lambda: method)
    arguments = ["augment", "test/walks-v0", "--augmenter", method.name, "--factor", "2"]
    result = CliRunner().invoke(cli.app, arguments)
    assert result.exit_code == 0, result.output
    assert "12 real + 12 synthetic episodes" in result.output
    assert len(minari.load_dataset(f"test/walks-{method.name}-v0")) == 24


def soften(episode: minari.EpisodeData, rng: np.random.Generator) -> minari.EpisodeData:
    episode.rewards[:] *= rng.uniform(0.5, 1.0)
    return episode


@pytest.mark.filterwarnings("ignore::oat_gym.errors.AugmentationWarning")
def test_it_is_composed_and_mixed(method: Augmenter, walk_dataset: minari.MinariDataset) -> None:
    for made in (Compose((method, AUGMENTERS["jittering"]())), Mixture((AUGMENTERS["scaling"](), method))):
        data = AugmentedDataset(walk_dataset, made, factor=2, seed=3)
        recipe = data.save(f"test/{made.name}-v0", lazy=True)
        assert content_hash(recipe) == content_hash(data)
        assert [len(episode.rewards) for episode in data] == list(data.storage.lengths(range(len(data))))
    with pytest.raises(
        ConfigurationError, match=r"methods of oat_gym.AUGMENTERS \(oat, [^)]*, dgw\), alone or in Compose"
    ):
        data = AugmentedDataset(walk_dataset, Compose((method, Function(soften))), factor=2)
        data.save("test/function-v0", lazy=True)


def shuffle_keys(episode: minari.EpisodeData, rng: np.random.Generator) -> minari.EpisodeData:
    observations = dict(reversed(episode.observations.items()))
    return dataclasses.replace(episode, observations=observations)


def dict_episode(number: int, steps: int) -> EpisodeBuffer:
    """Return an episode whose observation's keys are in no alphabetical order."""
    rng = np.random.default_rng(number)
    last = np.arange(steps) == steps - 1
    return EpisodeBuffer(
        observations={"z": rng.normal(size=(steps + 1, 2)), "a": rng.integers(0, 3, steps + 1)},
        actions=rng.normal(size=(steps, 1)),
        rewards=rng.normal(size=steps),
        terminations=last,
        truncations=np.zeros(steps, dtype=bool),
    )


@pytest.mark.parametrize("name", ["vae", "vae-mdp", "dgw", "function"])
def test_the_keys_of_a_dict_are_stored_in_one_order(name: str) -> None:
    """Arrow and Parquet write episodes of two orders of keys, and then cannot read them."""
    # by keywords, which keeps this order; the source's storage reads another one
    space = spaces.Dict(z=spaces.Box(-9, 9, (2,), dtype=np.float64), a=spaces.Discrete(3))
    buffers = [dict_episode(number, 12 + number) for number in range(6)]
    real = install_dataset("test/keys-v0", buffers, space, spaces.Box(-9, 9, (1,), dtype=np.float64))
    method = Function(shuffle_keys) if name == "function" else quick(AUGMENTERS[name]())
    data = AugmentedDataset(real, method, factor=2)
    assert content_hash(data.save("test/saved-v0", data_format="arrow")) == content_hash(data)


@pytest.mark.filterwarnings("ignore::oat_gym.errors.AugmentationWarning")
def test_real_numbers_are_not_cut_where_integers_were_recorded(method: Augmenter) -> None:
    """Gymnasium's Box of floats takes integers too, so that a dataset may hold such."""
    rng = np.random.default_rng(0)
    buffers = [
        EpisodeBuffer(
            observations=rng.integers(-5, 6, (21 + number, 2)).astype(np.int32),
            actions=rng.integers(-1, 2, (20 + number, 1)).astype(np.int16),
            rewards=rng.normal(size=20 + number),
            terminations=np.zeros(20 + number, dtype=bool),
            truncations=np.arange(20 + number) == 19 + number,
        )
        for number in range(6)
    ]
    boxes = spaces.Box(-10, 10, (2,), dtype=np.float64), spaces.Box(-2, 2, (1,), dtype=np.float32)
    data = AugmentedDataset(install_dataset("test/whole-v0", buffers, *boxes), method, factor=2)
    if method.name == "permutation":  # recorded rows, as they are
        assert data[6].observations.dtype == np.int32
        return
    generated = np.concatenate([data[j].observations[:-1][data.provenance(j).mask] for j in range(6, 12)])
    assert generated.dtype == np.float64
    assert (generated != np.rint(generated)).any()
    assert data[6].actions.dtype == np.float32
