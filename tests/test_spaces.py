import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st

from oat_gym.errors import InvalidDataError, UnsupportedSpaceError
from oat_gym.spaces import FlatSpace, concatenate_trees, copy_tree, slice_tree, tree_length

LEAVES = st.sampled_from(
    [
        spaces.Box(-2, 3, (2, 2)),
        spaces.Box(-5, 5, (3,), dtype=np.int32),
        spaces.Box(-np.inf, np.inf, (), dtype=np.float64),
        spaces.Discrete(4, start=-1),
        spaces.MultiDiscrete([2, 5]),
        spaces.MultiDiscrete([[2, 3], [4, 5]]),
        spaces.MultiBinary(3),
        spaces.MultiBinary((2, 2)),
    ]
)
SPACES = st.recursive(
    LEAVES,
    lambda inner: st.one_of(
        st.lists(inner, min_size=1, max_size=3).map(spaces.Tuple),
        st.dictionaries(st.sampled_from("abc"), inner, min_size=1, max_size=3).map(spaces.Dict),
    ),
    max_leaves=5,
)


def batch_of(space: spaces.Space, n: int) -> object:
    """Return n samples in Minari's form."""
    if isinstance(space, spaces.Dict):
        return {key: batch_of(child, n) for key, child in space.spaces.items()}
    if isinstance(space, spaces.Tuple):
        return tuple(batch_of(child, n) for child in space.spaces)
    return np.stack([np.asarray(space.sample(), dtype=space.dtype) for _ in range(n)])


def assert_same(left: object, right: object) -> None:
    if isinstance(left, dict):
        assert left.keys() == right.keys()
        for key in left:
            assert_same(left[key], right[key])
    elif isinstance(left, tuple):
        for a, b in zip(left, right, strict=True):
            assert_same(a, b)
    else:
        assert left.dtype == right.dtype
        np.testing.assert_array_equal(left, right)


@given(SPACES, st.integers(1, 6), st.integers(0, 99))
def test_flattening_and_back_gives_the_same_batch(space: spaces.Space, n: int, seed: int) -> None:
    space.seed(seed)
    batch = batch_of(space, n)
    flat = FlatSpace.of(space)
    matrix = flat.flatten(batch)
    assert matrix.shape == (n, flat.layout.width)
    assert_same(flat.unflatten(matrix), batch)


@given(SPACES, st.integers(0, 99))
def test_any_matrix_gives_values_inside_the_space(space: spaces.Space, seed: int) -> None:
    flat = FlatSpace.of(space)
    matrix = np.random.default_rng(seed).normal(scale=10, size=(5, flat.layout.width))
    batch = flat.unflatten(matrix)
    for row in range(5):
        value = slice_tree(batch, slice(row, row + 1))
        assert space.contains(_one(space, value))


def _one(space: spaces.Space, batch: object) -> object:
    if isinstance(space, spaces.Dict):
        return {key: _one(child, batch[key]) for key, child in space.spaces.items()}
    if isinstance(space, spaces.Tuple):
        return tuple(_one(child, part) for child, part in zip(space.spaces, batch, strict=True))
    return np.asarray(batch[0])


@given(SPACES)
def test_columns_are_covered_once_and_one_hot_blocks_sum_to_one(space: spaces.Space) -> None:
    flat = FlatSpace.of(space)
    layout = flat.layout
    blocks = [column for start, stop in layout.categorical for column in range(start, stop)]
    assert sorted([*layout.continuous, *blocks]) == list(range(layout.width))
    matrix = flat.flatten(batch_of(space, 4))
    for start, stop in layout.categorical:
        np.testing.assert_array_equal(matrix[:, start:stop].sum(axis=1), 1)


def test_bounds_are_those_of_the_boxes() -> None:
    flat = FlatSpace.of(spaces.Tuple((spaces.Box(-1, 2, (2,)), spaces.Discrete(2))))
    low, high = flat.bounds
    assert low.tolist() == [-1, -1, 0, 0]
    assert high.tolist() == [2, 2, 1, 1]


@pytest.mark.parametrize(
    "space", [spaces.Text(5), spaces.Box(0, 255, (64, 64, 3), dtype=np.uint8), spaces.Sequence(spaces.Discrete(2))]
)
def test_spaces_that_are_not_modelled_are_named(space: spaces.Space) -> None:
    with pytest.raises(UnsupportedSpaceError, match=r"The observation space .*count=0"):
        FlatSpace.of(space, "observation space")


def test_a_discrete_value_outside_its_space_is_an_error() -> None:
    with pytest.raises(InvalidDataError, match="Step 1 holds the value 7"):
        FlatSpace.of(spaces.Discrete(3)).flatten(np.array([0, 7]))


def test_trees_of_text_are_joined_sliced_and_copied() -> None:
    tree = {"words": ["a", "b", "c"], "x": (np.arange(3),)}
    joined = concatenate_trees([tree, slice_tree(tree, slice(1, None))])
    assert joined["words"] == ["a", "b", "c", "b", "c"]
    assert joined["x"][0].tolist() == [0, 1, 2, 1, 2]
    assert tree_length(joined) == 5
    copy = copy_tree(tree)
    copy["x"][0][:] = 9
    copy["words"][0] = "z"
    assert tree["x"][0].tolist() == [0, 1, 2]
    assert tree["words"][0] == "a"
