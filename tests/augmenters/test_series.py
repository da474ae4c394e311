"""What holds for all series methods: spaces, endings, infos, memory, order of access, saving."""

import json
from collections.abc import Callable

import minari
import numpy as np
import pytest
from gymnasium import spaces
from minari.data_collector import EpisodeBuffer

import oat_gym
from oat_gym import DGW, SPAWNER, AugmentedDataset, Jittering, Permutation, Scaling
from oat_gym.augmenters.series import episode_classes, take_infos
from oat_gym.cache import canonical
from oat_gym.episodes import content_hash
from oat_gym.errors import AugmentationWarning, ConfigurationError, InvalidDataError, UnsupportedSpaceError
from oat_gym.serialization import config_from_json
from oat_gym.source import Source
from tests.conftest import install_dataset

# some of the small datasets have no two episodes of one kind for SPAWNER
pytestmark = pytest.mark.filterwarnings("ignore::oat_gym.errors.AugmentationWarning")

MakeDataset = Callable[..., minari.MinariDataset]
METHODS = [Permutation(), Jittering(), Scaling(), SPAWNER(), DGW()]
each_method = pytest.mark.parametrize("method", METHODS, ids=lambda method: method.name)

MIXED = spaces.Dict(
    goal=spaces.Tuple((spaces.Discrete(3, start=5), spaces.Box(-1, 1, (), np.float32))),
    pixel=spaces.Box(0, 255, (2, 2), np.uint8),
    switches=spaces.MultiBinary(2),
)
ACTIONS = spaces.Tuple((spaces.MultiDiscrete([2, 4]), spaces.Box(-1, 1, (2,), np.float64)))


def mixed_dataset(lengths: list[int], *, reward_dtype: type = np.float32) -> minari.MinariDataset:
    """Return episodes of random values in nested spaces; every third one ends by termination."""
    rng = np.random.default_rng(0)
    buffers = []
    for number, n in enumerate(lengths):
        last = np.arange(n) == n - 1
        observations = {
            "goal": (rng.integers(5, 8, n + 1), rng.uniform(-1, 1, n + 1).astype(np.float32)),
            "pixel": rng.integers(0, 256, (n + 1, 2, 2)).astype(np.uint8),
            "switches": rng.integers(0, 2, (n + 1, 2)).astype(np.int8),
        }
        actions = (np.stack([rng.integers(0, 2, n), rng.integers(0, 4, n)], axis=1), rng.uniform(-1, 1, (n, 2)))
        buffers.append(
            EpisodeBuffer(
                observations=observations,
                actions=actions,
                rewards=rng.integers(0, 9, n).astype(reward_dtype),
                terminations=last & (number % 3 == 0),
                truncations=last & (number % 3 > 0),
                infos={"step": np.arange(n)},
            )
        )
    return install_dataset("test/mixed-v0", buffers, MIXED, ACTIONS)


@each_method
def test_episodes_keep_to_nested_spaces_and_end_as_their_source(method: oat_gym.Augmenter) -> None:
    lengths = [9, 1, 12, 7, 2, 10, 1, 6, 8]
    real = mixed_dataset(lengths)
    data = AugmentedDataset(real, method, factor=3, seed=1)
    oat_gym.checks.check_dataset(data)
    for number in range(len(lengths), len(data)):
        episode, source = data[number], real[number % len(lengths)]
        assert len(episode.rewards) == data.storage.lengths([number])[0]
        assert episode.rewards.dtype == np.float32
        np.testing.assert_array_equal(episode.terminations[:-1], False)
        assert episode.terminations[-1] == source.terminations[-1]
        assert episode.truncations[-1] == source.truncations[-1]
        for t in range(len(episode.rewards) + 1):
            row = {
                "goal": (episode.observations["goal"][0][t], np.array(episode.observations["goal"][1][t])),
                "pixel": episode.observations["pixel"][t],
                "switches": episode.observations["switches"][t],
            }
            assert MIXED.contains(row), row
        assert all(ACTIONS.contains((a, b)) for a, b in zip(*episode.actions, strict=True))


@each_method
def test_a_variation_is_a_function_of_seed_episode_and_number(method: oat_gym.Augmenter) -> None:
    real = mixed_dataset(list(range(31, 43)))
    first = AugmentedDataset(real, method, factor=3, seed=3)
    forwards = [content_hash([first[number]]) for number in range(36)]
    second = AugmentedDataset(real, method, factor=4, seed=3)
    backwards = {number: content_hash([second[number]]) for number in reversed(range(36))}
    assert forwards == [backwards[number] for number in range(36)]
    other = AugmentedDataset(real, method, factor=3, seed=4)
    assert forwards[:12] == [content_hash([other[number]]) for number in range(12)]
    assert sum(forwards[number] != content_hash([other[number]]) for number in range(12, 36)) > 9
    assert len(set(forwards[12:])) > 15


@each_method
def test_nothing_is_shared_with_the_source(method: oat_gym.Augmenter, make_dataset: MakeDataset) -> None:
    real = make_dataset([5, 9, 6, 7])
    data = AugmentedDataset(real, method, factor=2)
    before = content_hash(data)
    for number in range(4, 8):
        episode = data[number]
        leaves = [*episode.observations.values(), episode.actions, episode.rewards, episode.infos["nested"]["twice"]]
        leaves += [episode.terminations, episode.truncations, episode.infos["clock"]]
        for leaf in leaves:
            leaf[:] = 1
        for row in data.storage.variation(number).next_states.values():
            row["position"][:] = 1
    assert content_hash(data) == before


@each_method
def test_infos_stay_with_their_rows(method: oat_gym.Augmenter, make_dataset: MakeDataset) -> None:
    real = make_dataset([5, 9, 6, 7])
    data = AugmentedDataset(real, method, factor=3, seed=2)
    for number in range(4, 12):
        episode, i = data[number], number % 4
        assert len(episode.infos["clock"]) == len(episode.rewards) + 1
        np.testing.assert_array_equal(np.asarray(episode.infos["clock"]) // 1000, i)
        np.testing.assert_array_equal(episode.infos["nested"]["twice"][:, 1], episode.infos["clock"])
        if method.name == "permutation":
            np.testing.assert_array_equal(episode.infos["clock"], episode.observations["position"][:, 0])


@each_method
@pytest.mark.parametrize("data_format", ["hdf5", "arrow", "parquet"])
def test_it_is_saved_and_loaded(method: oat_gym.Augmenter, data_format: str, make_dataset: MakeDataset) -> None:
    data = AugmentedDataset(make_dataset([5, 9, 6, 7]), method, factor=2, seed=2)
    data.save("test/saved-v0", data_format=data_format)
    loaded = minari.load_dataset("test/saved-v0")
    assert loaded.total_steps == data.total_steps
    for got, made in zip(loaded, data, strict=True):
        for name in ("actions", "rewards", "terminations", "truncations"):
            np.testing.assert_array_equal(getattr(got, name), getattr(made, name))
        np.testing.assert_array_equal(got.observations["position"], made.observations["position"])


@each_method
def test_a_recipe_gives_the_same_episodes(method: oat_gym.Augmenter, make_dataset: MakeDataset) -> None:
    data = AugmentedDataset(make_dataset([15, 19, 16, 17, 20, 14, 21, 23]), method, factor=3, seed=2)
    data.save("test/lazy-v0", lazy=True)
    again = minari.load_dataset("test/lazy-v0")
    assert isinstance(again, AugmentedDataset)
    assert content_hash(again) == content_hash(data)
    assert eval(repr(method), vars(oat_gym)) == method
    assert config_from_json(type(method), json.loads(json.dumps(canonical(method)))) == method
    assert oat_gym.AUGMENTERS[method.name] is type(method)


@pytest.mark.parametrize("method", [Jittering(), Scaling(), SPAWNER(), DGW()], ids=lambda method: method.name)
def test_integer_rewards_become_floats_and_text_is_refused(method: oat_gym.Augmenter) -> None:
    data = AugmentedDataset(mixed_dataset([4, 5, 6, 4, 5, 6], reward_dtype=np.int64), method, factor=2)
    assert data[7].rewards.dtype == np.float64
    text = [EpisodeBuffer(observations=["a"] * 3, actions=np.zeros((2, 1)), rewards=np.zeros(2),
                          terminations=np.zeros(2, bool), truncations=np.arange(2) == 1)] * 2  # fmt: skip
    real = install_dataset("test/text-v0", text, spaces.Text(4), spaces.Box(-1, 1, (1,), np.float64))
    with pytest.raises(UnsupportedSpaceError, match="Text"):
        AugmentedDataset(real, method)
    assert AugmentedDataset(real, Permutation(), factor=2)[2].observations == ["a"] * 3


@pytest.mark.parametrize("kind", [SPAWNER, DGW])
def test_labels_are_checked(kind: type, make_dataset: MakeDataset) -> None:
    real = make_dataset([5, 9, 6])
    with pytest.raises(ConfigurationError, match="tuple of integers"):
        kind(labels=[0, 1])
    with pytest.raises(ConfigurationError, match="tuple of integers"):
        kind(labels=(0, 1.5))
    with pytest.raises(ConfigurationError, match="2 classes and the source 3 episodes"):
        AugmentedDataset(real, kind(labels=(0, 1)))
    assert config_from_json(kind, json.loads(json.dumps(canonical(kind(labels=(0, 1)))))) == kind(labels=(0, 1))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Jittering(sigma=-1.0), "sigma must be"),
        (lambda: Scaling(sigma=float("nan")), "sigma must be"),
        (lambda: Scaling(sigma=float("inf")), "sigma must be"),
        (lambda: Permutation(max_segments=0), "max_segments must be"),
        (lambda: SPAWNER(band=1.5), "band must be"),
        (lambda: DGW(batch_size=1), "batch_size must be"),
        (lambda: DGW(slice_ratio=0.0), "slice_ratio must be"),
    ],
)
def test_settings_out_of_range_are_refused(make: Callable[[], object], message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        make()


def test_classes_are_by_median_return() -> None:
    def classes(rewards: list[float]) -> list[int]:
        box = spaces.Box(-1, 1, (1,))
        buffers = [
            EpisodeBuffer(observations=np.zeros((3, 1), np.float32), actions=np.zeros((2, 1), np.float32),
                          rewards=np.array([0.0, reward]), terminations=np.zeros(2, bool),
                          truncations=np.arange(2) == 1)
            for reward in rewards
        ]  # fmt: skip
        return episode_classes(Source(install_dataset(f"test/r{len(rewards)}-v0", buffers, box, box)), None).tolist()

    assert classes([3.0, 1.0, 2.0, 9.0]) == [1, 0, 0, 1]
    assert classes([1.0, 1.0, 0.0, 1.0, 0.0]) == [1, 1, 0, 1, 0]  # nothing is above the median, which is the best
    assert classes([2.0, 2.0, 2.0]) == [1, 1, 1]


def test_infos_of_any_shape_are_taken_by_row() -> None:
    steps = np.array([2, 0, 0])
    objects = np.array([{"a": 0}, {"a": 1}, {"a": 2}, {"a": 3}], dtype=object)
    infos = {"t": np.arange(3), "s": ["x", "y", "z", "w"], "one": np.array(7), "o": objects, "none": None}
    taken = take_infos(infos, 3, steps)
    assert taken["t"].tolist() == [2, 0, 0]
    assert taken["s"] == ["z", "x", "x", "y"]
    assert [part["a"] for part in taken["o"]] == [2, 0, 0, 1]
    assert taken["o"][1] is not taken["o"][2]
    assert taken["o"][1] is not objects[0]
    assert (taken["one"], taken["none"]) == (7, None)
    assert take_infos(None, 3, steps) is None


def test_spawner_without_partners_copies_and_tells(make_dataset: MakeDataset) -> None:
    real = make_dataset([5, 9, 6])  # the second one alone is truncated
    data = AugmentedDataset(real, SPAWNER(labels=(0, 0, 1)), factor=2)
    with pytest.warns(AugmentationWarning, match="3 of 3 episodes"):
        data.fit()
    assert content_hash(data[3:6]) == content_hash(real)
    assert not data.provenance(4).mask.any()
    with pytest.raises(InvalidDataError, match="at least 2"):
        AugmentedDataset(make_dataset([5], dataset_id="test/one-v0"), SPAWNER())
