"""Random datasets of every space, dtype and info that Minari stores keep every invariant of `check_dataset`.

The default is a short run; `OAT_GYM_EXAMPLES=10000 python -m pytest tests/properties` makes a long one.
"""

import os
import tempfile
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import minari
import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import HealthCheck, Phase, event, given, settings
from hypothesis import strategies as st
from minari.data_collector import EpisodeBuffer

from oat_gym import AugmentedDataset, Augmenter, Function
from oat_gym._rng import derive
from oat_gym.augmenters.base import Sampler, Variation
from oat_gym.checks import check_dataset
from oat_gym.episodes import copy_episode
from oat_gym.spaces import iter_leaf_spaces, slice_tree
from oat_gym.stitching import Replacement, Span, stitch

EXAMPLES = int(os.environ.get("OAT_GYM_EXAMPLES", "40"))
FORMATS = ("hdf5", "arrow", "parquet")
TEXT = "abc xyz-09é"


# Augmenters ---------------------------------------------------------------------------------------------------------


def identity(episode: minari.EpisodeData, rng: np.random.Generator) -> minari.EpisodeData:
    return episode


def noisy_rewards(episode: minari.EpisodeData, rng: np.random.Generator) -> minari.EpisodeData:
    episode.rewards[:] = rng.permutation(episode.rewards)
    return episode


@dataclass(frozen=True)
class Splice(Augmenter):
    """Replaces a random span of an episode by its steps in reverse order: stitching without a model."""

    name: ClassVar[str] = "splice"

    @property
    def cacheable(self) -> bool:
        return False

    def fit(self, source: Any, *, seed: int, progress: Any = None) -> Sampler:
        return _SpliceSampler(source, seed)


class _SpliceSampler(Sampler):
    def __init__(self, source: Any, seed: int) -> None:
        self._source, self._seed = source, seed

    def variation(self, i: int, k: int, material: object) -> Variation:
        episode, rng = self._source.episodes[i], derive(self._seed, "splice", i, k)
        start, stop = sorted(rng.choice(len(episode.rewards) + 1, 2, replace=False).tolist())
        back = slice(stop, start - 1 if start else None, -1)
        replacement = Replacement(
            observations=slice_tree(episode.observations, back),
            actions=slice_tree(episode.actions, slice(start, stop)),
            rewards=episode.rewards[start:stop][::-1],
        )
        span = Span(start, stop, pst_set=0, sample=k, seam=(float(i), 0.5))
        return Variation(stitch(copy_episode(episode, number=i), span, replacement), (span,))


AUGMENTERS = (Function(identity), Function(noisy_rewards), Splice())


# Random datasets ----------------------------------------------------------------------------------------------------


@st.composite
def boxes(draw: st.DrawFn) -> spaces.Space:
    dtype = draw(
        st.sampled_from(["float32", "float64", "float16", "int8", "int16", "int32", "int64", "uint8", "uint16"])
    )
    shape = draw(st.sampled_from([(), (1,), (3,), (2, 2), (1, 2, 3)]))
    if dtype.startswith("float") and draw(st.booleans()):
        return spaces.Box(-np.inf, np.inf, shape, dtype=dtype)
    low, high = (0, 200) if dtype.startswith("u") else (-100, 100)
    return spaces.Box(low, high, shape, dtype=dtype)


leaves = st.one_of(
    boxes(),
    st.builds(spaces.Discrete, st.integers(1, 9), start=st.integers(-3, 3)),
    st.lists(st.integers(1, 5), min_size=1, max_size=4).map(spaces.MultiDiscrete),
    st.sampled_from([1, 4, (2, 3)]).map(spaces.MultiBinary),
    st.integers(1, 12).map(lambda n: spaces.Text(n, min_length=0, charset=TEXT)),
    st.just(spaces.Box(0, 255, (32, 32, 3), dtype=np.uint8)),
)
some_spaces = st.recursive(
    leaves,
    lambda children: st.one_of(
        st.dictionaries(st.sampled_from("abcde"), children, min_size=1, max_size=3).map(spaces.Dict),
        st.lists(children, min_size=1, max_size=3).map(spaces.Tuple),
    ),
    max_leaves=4,
)


def batch(space: spaces.Space, rows: int, rng: np.random.Generator) -> Any:  # noqa: PLR0911  (one for each space)
    if isinstance(space, spaces.Dict):
        return {key: batch(child, rows, rng) for key, child in space.spaces.items()}
    if isinstance(space, spaces.Tuple):
        return tuple(batch(child, rows, rng) for child in space.spaces)
    if isinstance(space, spaces.Text):
        lengths = rng.integers(space.min_length, space.max_length + 1, size=rows)
        return ["".join(rng.choice(list(TEXT), size=length)) for length in lengths]
    if isinstance(space, spaces.Discrete):
        return rng.integers(space.start, space.start + space.n, size=rows)
    if isinstance(space, spaces.MultiDiscrete):
        return rng.integers(0, space.nvec, size=(rows, *space.shape)).astype(space.dtype)
    if isinstance(space, spaces.MultiBinary):
        return rng.integers(0, 2, size=(rows, *space.shape)).astype(space.dtype)
    if np.issubdtype(space.dtype, np.integer):
        return rng.integers(space.low, space.high, size=(rows, *space.shape), endpoint=True, dtype=space.dtype)
    scale = 99 if np.isfinite(space.high).all() else 1e3
    return (scale * rng.uniform(-1, 1, size=(rows, *space.shape))).astype(space.dtype)


INFOS = ("none", "floats", "flags", "counts", "words", "matrix", "nested", "tall", "short")


def info(kind: str, rows: int, rng: np.random.Generator) -> Any:
    return {
        "floats": lambda: list(rng.normal(size=rows)),
        "flags": lambda: list(rng.random(rows) < 0.5),
        "counts": lambda: list(range(rows)),
        "words": lambda: [f"w{number}" for number in rng.integers(0, 99, size=rows)],
        "matrix": lambda: rng.normal(size=(rows, 2, 2)),
        "nested": lambda: {"x": rng.normal(size=(rows, 1)), "deeper": {"y": list(rng.normal(size=rows))}},
        "tall": lambda: rng.integers(0, 9, size=(rows, 3)).astype(np.int32),
        "short": lambda: list(rng.normal(size=rows)),
    }[kind]()


def info_rows(kind: str, length: int, data_format: str) -> int:
    """T rows (no row of the reset) for "short" infos, which Minari's arrow storage refuses; else T+1."""
    return length if kind == "short" and data_format == "hdf5" else length + 1


@dataclass(frozen=True)
class Recipe:
    observation_space: spaces.Space
    action_space: spaces.Space
    lengths: list[int]
    infos: list[str]
    data_format: str
    reward_dtype: str
    described: bool
    seed: int


recipes = st.builds(
    Recipe,
    observation_space=some_spaces,
    action_space=some_spaces,
    lengths=st.lists(st.integers(1, 50), min_size=1, max_size=40),
    infos=st.lists(st.sampled_from(INFOS[1:]), max_size=3, unique=True),
    data_format=st.sampled_from(FORMATS),
    reward_dtype=st.sampled_from(["float64", "float32", "int64"]),
    described=st.booleans(),
    seed=st.integers(0, 2**32 - 1),
)


def make(recipe: Recipe) -> minari.MinariDataset:
    rng = np.random.default_rng(recipe.seed)
    buffers = []
    for number, length in enumerate(recipe.lengths):
        last, terminates = np.arange(length) == length - 1, rng.random() < 0.5
        extra = {"seed": number, "options": {"level": {"row": number}, "goal": np.arange(3)}}
        buffers.append(
            EpisodeBuffer(
                observations=batch(recipe.observation_space, length + 1, rng),
                actions=batch(recipe.action_space, length, rng),
                rewards=rng.integers(-5, 5, size=length).astype(recipe.reward_dtype),
                terminations=last & terminates,
                truncations=last & (not terminates),
                infos={kind: info(kind, info_rows(kind, length, recipe.data_format), rng) for kind in recipe.infos},
                **(extra if recipe.described else {}),
            )
        )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return minari.create_dataset_from_buffers(
            "test/random-v0",
            buffers,
            observation_space=recipe.observation_space,
            action_space=recipe.action_space,
            data_format=recipe.data_format,
            # Minari's arrow storage cannot pad an image among the actions, which it must where it compresses them
            jpeg_encoding=bool(recipe.seed % 2) and not _has_image(recipe.action_space),
        )


def _has_image(space: spaces.Space) -> bool:
    return any(leaf.shape == (32, 32, 3) for _, leaf in iter_leaf_spaces(space))


@settings(
    phases=(Phase.generate, Phase.shrink) if EXAMPLES < 1000 else (Phase.generate,),
    max_examples=EXAMPLES,
    deadline=None,
    database=None,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture, HealthCheck.data_too_large],
)
@given(recipe=recipes, augmenter=st.sampled_from(AUGMENTERS), count=st.integers(0, 12), data=st.data())
def test_random_datasets_keep_every_invariant(
    recipe: Recipe, augmenter: Augmenter, count: int, data: st.DataObject, monkeypatch: pytest.MonkeyPatch
) -> None:
    event(f"format {recipe.data_format}")
    with tempfile.TemporaryDirectory() as folder:
        monkeypatch.setenv("MINARI_DATASETS_PATH", str(Path(folder) / "minari"))
        source = make(recipe)
        if data.draw(st.booleans(), label="a view"):
            source = source.filter_episodes(lambda episode: len(episode.rewards) % 3 != 0 or episode.id == 0)
        seed = data.draw(st.integers(0, 99), label="seed")
        augmented = AugmentedDataset(source, augmenter, count=count, seed=seed)
        if data.draw(st.integers(0, 4), label="twice") == 0:
            augmented = AugmentedDataset(augmented, augmenter, count=count, seed=seed)
        limit = data.draw(st.sampled_from([None, 3, 8]), label="limit")
        exported = data.draw(st.sampled_from([(), *((name,) for name in FORMATS)]), label="export")
        report = check_dataset(augmented, limit=limit, formats=exported)
        assert len(report.passed) >= 36
        assert {name for name, _ in report.skipped} <= {"saving"}
        event(f"{len(report.passed)} invariants passed")
