"""to_torch: the right values in every kind of batch, reproducible order, exact resumption, columns on disk."""

import doctest
import json
import os
import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from gymnasium import spaces
from minari.data_collector import EpisodeBuffer

from oat_gym import OAT, AugmentedDataset, Function, MiningConfig
from oat_gym.errors import (
    ConfigurationError,
    DatasetNotFoundError,
    InvalidDataError,
    SaveError,
    UnsupportedSpaceError,
)
from oat_gym.generation import BehaviorConfig, VAEMDPConfig
from oat_gym.io import _loader, _loader_config, _memory_map
from oat_gym.io import torch as loaders
from oat_gym.io.d4rl import write_d4rl
from oat_gym.io.torch import to_torch
from tests.conftest import install_dataset

LENGTHS = (3, 1, 6, 4)


def shifted(episode, rng):
    episode.rewards[:] += 0.5
    episode.observations["position"][:] += rng.integers(1, 9) / 16
    return episode


@pytest.fixture
def augmented(make_dataset):
    return AugmentedDataset(make_dataset(LENGTHS), Function(shifted), count=6, seed=1)


def joined(batches):
    """All batches as one, each field in the order of (episode, step)."""
    batches = list(batches)
    order = np.lexsort([torch.cat([b.step for b in batches]), torch.cat([b.episode for b in batches])])

    def join(*parts):
        if isinstance(parts[0], dict):
            return {key: join(*(part[key] for part in parts)) for key in parts[0]}
        return torch.cat(parts)[order].numpy()

    return {name: join(*(getattr(batch, name) for batch in batches)) for name in batches[0]._fields}


def same(a, b):
    """Whether two batches are equal to the last bit."""
    leaves = [torch.utils._pytree.tree_leaves(tuple(batch)) for batch in (a, b)]
    return len(leaves[0]) == len(leaves[1]) and all(
        x.dtype == y.dtype and torch.equal(x, y) for x, y in zip(*leaves, strict=True)
    )


def all_same(first, second):
    first, second = list(first), list(second)
    return len(first) == len(second) > 0 and all(same(a, b) for a, b in zip(first, second, strict=True))


def assert_transitions(batch, columns):
    names = ("rewards", "terminated", "truncated", "episode", "step", "synthetic")
    for name in names:
        np.testing.assert_array_equal(batch[name], getattr(columns, name), err_msg=name)
    np.testing.assert_array_equal(batch["actions"], columns.actions)
    for name in ("observations", "next_observations"):
        for key, values in getattr(columns, name).items():
            np.testing.assert_array_equal(batch[name][key], values, err_msg=f"{name} {key}")


@pytest.mark.parametrize("sampling", ["shuffle", "sequential"])
def test_an_epoch_of_transitions_is_the_columns_of_the_dataset(augmented, sampling):
    loader = to_torch(augmented, batch_size=5, sampling=sampling, dtype=None)
    batches = list(loader)
    assert len(batches) == len(loader) == -(-augmented.total_steps // 5)
    assert_transitions(joined(batches), augmented.transitions())


def test_values_code_episode_and_step_of_a_plain_dataset(make_dataset):
    batch = joined(to_torch(make_dataset(LENGTHS), batch_size=4, seed=2))
    codes = 1000.0 * batch["episode"] + batch["step"]
    np.testing.assert_array_equal(batch["observations"]["position"][:, 0], codes)
    np.testing.assert_array_equal(batch["next_observations"]["position"][:, 0], codes + 1)
    np.testing.assert_array_equal(batch["actions"][:, 0], codes + 0.25)
    np.testing.assert_array_equal(batch["rewards"], codes)
    last = batch["step"] == np.array(LENGTHS)[batch["episode"]] - 1
    np.testing.assert_array_equal(batch["terminated"] | batch["truncated"], last)
    np.testing.assert_array_equal(batch["terminated"], last & (batch["episode"] % 2 == 0))
    assert batch["mask"].all()
    assert not batch["synthetic"].any()


def test_a_view_counts_its_own_episodes(augmented):
    view = augmented.filter_episodes(lambda episode: len(episode.rewards) > 3)
    assert_transitions(joined(to_torch(view, batch_size=3, dtype=None)), view.transitions())


def test_a_saved_dataset_keeps_what_was_generated(augmented):
    saved = augmented.save("test/saved-v0")
    assert_transitions(joined(to_torch(saved, batch_size=7, dtype=None)), augmented.transitions())


def test_literal_seams_keep_their_own_next_state(walk_dataset, tmp_path):
    mining = MiningConfig(n_clusters=3, length=6, top=2, switch_penalty=5.0)
    model, behavior = VAEMDPConfig(max_updates=5), BehaviorConfig(max_updates=5)
    data = AugmentedDataset(walk_dataset, OAT(mining=mining, model=model, behavior=behavior, seam="literal"), count=6)
    columns = data.transitions()
    contiguous = np.concatenate([episode.observations[1:] for episode in data])
    assert (columns.next_observations != contiguous).any()
    for folder in (None, tmp_path):
        batch = joined(to_torch(data, batch_size=50, dtype=None, memory_map=folder))
        np.testing.assert_array_equal(batch["next_observations"], columns.next_observations)
        np.testing.assert_array_equal(batch["observations"], columns.observations)
    for settings in ({"kind": "episodes"}, {"kind": "windows", "length": 100}):
        batch = next(iter(to_torch(data, sampling="sequential", **settings)))
        np.testing.assert_array_equal(batch.next_observations[batch.mask].numpy(), columns.next_observations)
        for number, episode in enumerate(data):
            found = batch.observations[number, : len(episode.rewards) + 1].numpy()
            np.testing.assert_array_equal(found, episode.observations)


def test_each_epoch_has_every_item_once_in_another_order(augmented):
    loader = to_torch(augmented, batch_size=4)
    epochs = [torch.cat([b.episode * 100 + b.step for b in loader]) for _ in range(3)]
    for epoch in epochs:
        assert len(epoch.unique()) == len(epoch) == augmented.total_steps
    assert not torch.equal(epochs[0], epochs[1])
    assert not torch.equal(epochs[1], epochs[2])


def test_the_seed_settles_the_order(augmented):
    one, two = (to_torch(augmented, batch_size=4, seed=5) for _ in range(2))
    for _ in range(2):
        assert all_same(one, two)
    assert not all_same(to_torch(augmented, batch_size=4, seed=5), to_torch(augmented, batch_size=4, seed=6))


def test_drop_last_leaves_out_the_rest(make_dataset):
    data = make_dataset(LENGTHS)
    assert [len(batch.rewards) for batch in to_torch(data, batch_size=4)] == [4, 4, 4, 2]
    assert [len(batch.rewards) for batch in to_torch(data, batch_size=4, drop_last=True)] == [4, 4, 4]
    with pytest.raises(InvalidDataError, match="leaves no batch"):
        to_torch(data, batch_size=15, drop_last=True)


def test_draws_with_replacement_are_uniform(make_dataset):
    data = make_dataset(LENGTHS)
    loader = to_torch(data, batch_size=14, sampling="replacement", seed=0)
    rows = torch.cat([b.episode * 10 + b.step for b in loader.batches(1000)])
    _, counts = rows.unique(return_counts=True)
    assert len(counts) == 14
    # 14,000 draws of 14 rows: 1,000 each, with a standard deviation of 30.5; 5 of them is beyond chance.
    assert (counts - 1000).abs().max() < 5 * 30.5


@pytest.mark.parametrize("kind", ["transitions", "episodes", "windows"])
def test_weights_settle_the_share_of_real_items(augmented, kind):
    settings = {"kind": kind, "sampling": "replacement", "batch_size": 50, "seed": 1}
    if kind == "windows":
        settings["length"] = 2

    def real_share(**weights):
        loader = to_torch(augmented, **settings, **weights)
        flags = [b.synthetic.reshape(len(b.synthetic), -1).any(1) for b in loader.batches(400)]
        flags = torch.cat(flags)
        return 1 - flags.double().mean().item(), len(flags)

    plain = to_torch(augmented, **settings)
    n_synthetic = int(plain._items.synthetic.sum())
    n_real = plain.n_items - n_synthetic
    assert n_synthetic > 0 < n_real
    assert real_share(real_fraction=1.0)[0] == 1
    assert real_share(real_fraction=0)[0] == 0
    expected = {
        "real_fraction": (0.25, 0.25),
        "synthetic_weight": (3, n_real / (n_real + 3 * n_synthetic)),
    }
    for name, (value, share) in expected.items():
        found, draws = real_share(**{name: value})
        assert abs(found - share) < 5 * np.sqrt(share * (1 - share) / draws), name
    assert real_share(synthetic_weight=0)[0] == 1


def test_weights_that_leave_nothing_are_errors(make_dataset):
    data = make_dataset(LENGTHS)
    with pytest.raises(InvalidDataError, match="ask for synthetic transitions, and there are none"):
        to_torch(data, sampling="replacement", real_fraction=0.5)
    assert len(next(iter(to_torch(data, sampling="replacement", real_fraction=1.0))).rewards)
    every = AugmentedDataset(data, Function(shifted), count=4)
    view = every.filter_episodes(lambda episode: episode.id >= 4)
    with pytest.raises(InvalidDataError, match="ask for real transitions"):
        to_torch(view, sampling="replacement", real_fraction=0.5)


def check_sequences(batch, data, windows):
    """Compare a batch with (episode, start, stop) of the dataset, padding included."""
    for number, (e, start, stop) in enumerate(windows):
        episode, size = data[e], stop - start
        expected = torch.arange(batch.mask.shape[1]) < size
        assert torch.equal(batch.mask[number], expected)
        states = batch.observations["position"][number]
        np.testing.assert_array_equal(states[: size + 1], episode.observations["position"][start : stop + 1])
        assert not states[size + 1 :].any()
        after = batch.next_observations["position"][number]
        np.testing.assert_array_equal(after[:size], episode.observations["position"][start + 1 : stop + 1])
        np.testing.assert_array_equal(batch.actions[number][:size], episode.actions[start:stop])
        np.testing.assert_array_equal(batch.rewards[number][:size], episode.rewards[start:stop])
        np.testing.assert_array_equal(batch.terminated[number][:size], episode.terminations[start:stop])
        np.testing.assert_array_equal(batch.step[number][:size], np.arange(start, stop))
        assert (batch.episode[number][:size] == e).all()
        for name in ("actions", "rewards", "terminated", "truncated", "synthetic"):
            assert not getattr(batch, name)[number][size:].any(), name
        assert not after[size:].any()
        assert (batch.episode[number][size:] == -1).all()
        assert (batch.step[number][size:] == -1).all()


def windows_by_hand(lengths, length, stride):
    found = []
    for e, steps in enumerate(lengths):
        starts = [s for s in range(0, steps, stride) if s + length <= steps]
        if not starts or starts[-1] + length < steps:
            starts.append(max(steps - length, 0))
        found += [(e, s, min(s + length, steps)) for s in starts]
    return found


@pytest.mark.parametrize(("length", "stride"), [(1, 1), (2, 1), (3, 2), (3, 3), (4, 3), (9, 4)])
def test_windows_are_runs_of_one_episode(make_dataset, length, stride):
    data = make_dataset((*LENGTHS, 11))
    expected = windows_by_hand((*LENGTHS, 11), length, stride)
    loader = to_torch(data, kind="windows", length=length, stride=stride, sampling="sequential", dtype=None)
    batch = next(iter(loader))
    assert loader.n_items == len(expected)
    assert batch.rewards.shape == (len(expected), length)
    assert batch.observations["position"].shape == (len(expected), length + 1, 2)
    check_sequences(batch, data, expected)
    covered = set(zip(batch.episode[batch.mask].tolist(), batch.step[batch.mask].tolist(), strict=True))
    assert len(covered) == data.total_steps


def test_episodes_are_padded_to_the_longest_of_their_batch(augmented):
    loader = to_torch(augmented, kind="episodes", batch_size=3, sampling="sequential", dtype=None)
    lengths = [len(episode.rewards) for episode in augmented]
    for number, batch in enumerate(loader):
        numbers = range(3 * number, min(3 * number + 3, len(augmented)))
        assert batch.mask.shape == (len(numbers), max(lengths[n] for n in numbers))
        check_sequences(batch, augmented, [(n, 0, lengths[n]) for n in numbers])


@pytest.mark.parametrize(
    "settings",
    [
        {"batch_size": 4},
        {"batch_size": 4, "sampling": "replacement", "real_fraction": 0.4},
        {"batch_size": 2, "kind": "windows", "length": 3, "stride": 2},
        {"batch_size": 3, "kind": "episodes", "drop_last": True},
    ],
)
def test_a_state_goes_on_in_mid_epoch(augmented, settings, tmp_path):
    whole = to_torch(augmented, seed=9, **settings)
    epochs = [list(whole) for _ in range(3)]
    for stop in (1, len(whole) - 1, len(whole)):
        first = to_torch(augmented, seed=9, **settings)
        list(first)
        iterator = iter(first)
        for _ in range(stop):
            next(iterator)
        state = json.loads(json.dumps(first.state_dict()))
        second = to_torch(augmented, seed=9, memory_map=tmp_path, **settings)
        second.load_state_dict(state)
        rest = [*epochs[1][stop:], *epochs[2]]
        assert all_same(second.batches(len(rest)), rest), stop
        second.load_state_dict(state)
        assert all_same(second, epochs[1][stop:] or epochs[2])
        assert all_same(iterator, epochs[1][stop:]) or stop == len(whole)
        assert not list(iterator)


def test_batches_go_over_epochs(augmented):
    loader = to_torch(augmented, batch_size=8)
    reference = to_torch(augmented, batch_size=8)
    expected = [batch for _ in range(4) for batch in reference]
    assert all_same([*loader.batches(3), *loader.batches(len(expected) - 3)], expected)
    with pytest.raises(ConfigurationError, match="count must be"):
        loader.batches(0)


def test_the_order_of_an_epoch_is_drawn_once(augmented, monkeypatch):
    loader = to_torch(augmented, batch_size=4)
    drawn = []
    draw = loader._order
    monkeypatch.setattr(loader, "_order", lambda epoch: drawn.append(epoch) or draw(epoch))
    taken = [next(loader.batches(1)) for _ in range(len(loader) + 2)]
    assert drawn == [0, 1]
    assert all_same(taken, to_torch(augmented, batch_size=4).batches(len(loader) + 2))


@pytest.mark.parametrize(("epoch", "batch"), [(-1, 0), (0, -1), (0, 99), (0, None), ("1", 0), (True, 0)])
def test_a_state_of_no_place_is_refused(augmented, epoch, batch):
    loader = to_torch(augmented, batch_size=5)
    last = len(loader) - 1
    with pytest.raises(ConfigurationError, match=f"names batch {batch!r} of epoch {epoch!r}; expected"):
        loader.load_state_dict(loader.state_dict() | {"epoch": epoch, "batch": batch})
    loader.load_state_dict(loader.state_dict() | {"epoch": 2, "batch": last})
    assert len(list(loader)) == 1


def test_a_full_disk_is_a_clear_error(augmented, tmp_path):
    augmented.fit()
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (50, hard))
    try:
        with pytest.raises(SaveError, match=r"could not be kept in .*columns .*Free some space.* memory_map"):
            to_torch(augmented, memory_map=tmp_path / "columns")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert all_same(to_torch(augmented, memory_map=tmp_path / "columns"), to_torch(augmented))
    (tmp_path / "taken").write_text("mine")
    with pytest.raises(SaveError, match=r"could not be kept in .*taken"):
        to_torch(augmented, memory_map=tmp_path / "taken")


def test_a_d4rl_file_is_a_source(tmp_path):
    box = spaces.Box(-1, 1, (2,))
    steps = 3
    buffer = EpisodeBuffer(
        observations=np.zeros((steps + 1, 2), dtype=np.float32),
        actions=np.zeros((steps, 2), dtype=np.float32),
        rewards=np.arange(steps, dtype=np.float64),
        terminations=np.zeros(steps, dtype=bool),
        truncations=np.arange(steps) == steps - 1,
    )
    data = install_dataset("test/flat-v0", [buffer, buffer], box, box)
    path = write_d4rl(data, tmp_path / "flat.hdf5")
    for source in (path, str(path), "test/flat-v0"):
        assert joined(to_torch(source))["rewards"].tolist() == [0, 1, 2, 0, 1, 2]
    with pytest.raises(DatasetNotFoundError, match="no file"):
        to_torch(tmp_path / "absent.hdf5")


def test_iterations_at_once_are_epochs_of_their_own(augmented):
    reference = to_torch(augmented, batch_size=4)
    first, second = list(reference), list(reference)
    loader = to_torch(augmented, batch_size=4)
    pairs = list(zip(loader, loader, strict=True))
    assert all_same((a for a, _ in pairs), first)
    assert all_same((b for _, b in pairs), second)


def test_the_state_of_another_loader_is_refused(augmented, make_dataset):
    state = to_torch(augmented, batch_size=4).state_dict()
    others = [
        to_torch(augmented, batch_size=5),
        to_torch(augmented, batch_size=4, seed=1),
        to_torch(augmented, batch_size=4, dtype=torch.float64),
        to_torch(augmented.source, batch_size=4),
        to_torch(AugmentedDataset(augmented.source, Function(shifted), count=6, seed=2), batch_size=4),
    ]
    for loader in others:
        with pytest.raises(ConfigurationError, match="not one of this loader"):
            loader.load_state_dict(state)
    with pytest.raises(ConfigurationError, match="not one of this loader"):
        to_torch(augmented, batch_size=4).load_state_dict(state | {"version": 99})


def files_of(folder):
    return {path: path.read_bytes() for path in sorted(Path(folder).rglob("*")) if path.is_file()}


@pytest.mark.parametrize("flat", [False, True])
def test_columns_on_disk_give_the_same_batches_and_are_written_once(augmented, tmp_path, flat, monkeypatch):
    settings = {"kind": "windows", "length": 3, "flat": flat, "batch_size": 5}
    assert all_same(to_torch(augmented, memory_map=tmp_path, **settings), to_torch(augmented, **settings))
    before = files_of(tmp_path)
    monkeypatch.setattr(_memory_map, "_write", lambda *_: pytest.fail("written again"))
    again = to_torch(augmented, memory_map=str(tmp_path), **settings)
    assert all_same(again, to_torch(augmented, **settings))
    assert files_of(tmp_path) == before


def test_batches_and_columns_cannot_change_the_disk(augmented, tmp_path):
    loader = to_torch(augmented, memory_map=tmp_path, batch_size=4)
    before = files_of(tmp_path)
    loader.columns.steps["rewards"][:] = 77
    next(iter(loader)).actions[:] = 77
    assert files_of(tmp_path) == before


def test_other_content_or_layout_has_other_columns(augmented, tmp_path):
    other = AugmentedDataset(augmented.source, Function(shifted), count=6, seed=2)
    for data, settings in ((augmented, {}), (other, {}), (augmented, {"flat": True}), (augmented, {"dtype": None})):
        assert all_same(to_torch(data, memory_map=tmp_path, **settings), to_torch(data, **settings))
    assert len([path for path in tmp_path.iterdir() if path.is_dir()]) == 4


def test_damaged_columns_are_written_again(augmented, tmp_path):
    to_torch(augmented, memory_map=tmp_path)
    whole = files_of(tmp_path)
    columns = [path for path in whole if path.suffix in (".bin", ".json")]
    assert len(columns) > 8
    for path in columns:
        for damaged in (whole[path][:-1], bytes([whole[path][0] ^ 1]) + whole[path][1:], None):
            path.unlink()
            if damaged is not None:
                path.write_bytes(damaged)
            assert all_same(to_torch(augmented, memory_map=tmp_path), to_torch(augmented))
            assert files_of(tmp_path) == whole


def test_an_interrupted_write_leaves_nothing_and_the_next_one_finishes(augmented, tmp_path, monkeypatch):
    to_torch(augmented, memory_map=tmp_path / "undisturbed")
    expected = sorted(path.name for path in (tmp_path / "undisturbed").iterdir())
    broken = tmp_path / "broken"
    with monkeypatch.context() as patch:
        patch.setattr(_memory_map, "write_atomically", lambda *_: (_ for _ in ()).throw(OSError("disk full")))
        with pytest.raises(OSError, match="disk full"):
            to_torch(augmented, memory_map=broken)
        assert not [path for path in broken.iterdir() if path.is_dir()]
    # what a killed process leaves behind
    key = next(name for name in expected if not name.startswith("."))
    (broken / f".{key}.partial").mkdir()
    (broken / f".{key}.partial" / "000.bin").write_bytes(b"half")
    assert all_same(to_torch(augmented, memory_map=broken), to_torch(augmented))
    assert sorted(path.name for path in broken.iterdir()) == expected


def test_nothing_touches_the_global_random_states(augmented):
    states = np.random.get_state(legacy=False), torch.random.get_rng_state()  # noqa: NPY002
    for _ in to_torch(augmented, sampling="replacement", real_fraction=0.5).batches(3):
        pass
    list(to_torch(augmented, kind="episodes"))
    after = np.random.get_state(legacy=False), torch.random.get_rng_state()  # noqa: NPY002
    assert repr(states[0]) == repr(after[0])
    assert torch.equal(states[1], after[1])


def test_floats_are_cast_and_other_types_kept(make_dataset):
    data = make_dataset(LENGTHS)
    for dtype in (torch.float16, torch.float32, torch.float64):
        batch = next(iter(to_torch(data, dtype=dtype)))
        assert batch.rewards.dtype == batch.actions.dtype == batch.observations["position"].dtype == dtype
        assert batch.observations["mode"].dtype == torch.int64
    stored = next(iter(to_torch(data, dtype=None)))
    assert (stored.rewards.dtype, stored.actions.dtype) == (torch.float64, torch.float32)


def test_flat_is_the_feature_matrix(augmented):
    batch = joined(to_torch(augmented, flat=True, dtype=torch.float64))
    columns = augmented.transitions(flat=True)
    for name in ("observations", "actions", "next_observations"):
        np.testing.assert_array_equal(batch[name], getattr(columns, name))


def batch_of(space, n):
    if isinstance(space, spaces.Dict):
        return {key: batch_of(child, n) for key, child in space.spaces.items()}
    if isinstance(space, spaces.Tuple):
        return tuple(batch_of(child, n) for child in space.spaces)
    if isinstance(space, spaces.Text):
        return [space.sample() for _ in range(n)]
    return np.stack([np.asarray(space.sample(), dtype=space.dtype) for _ in range(n)])


def dataset_of(space, dataset_id="test/spaces-v0"):
    """Three episodes of samples of a space, with discrete actions."""
    space.seed(0)
    buffers = [
        EpisodeBuffer(
            observations=batch_of(space, steps + 1),
            actions=np.arange(steps) % 3,
            rewards=np.arange(steps, dtype=np.float64),
            terminations=np.zeros(steps, dtype=bool),
            truncations=np.arange(steps) == steps - 1,
        )
        for steps in (2, 4, 3)
    ]
    return install_dataset(dataset_id, buffers, space, spaces.Discrete(3))


def test_nested_spaces_come_as_nested_tensors(tmp_path):
    space = spaces.Dict(
        pair=spaces.Tuple([spaces.Discrete(4, start=-1), spaces.MultiDiscrete([3, 4])]),
        image=spaces.Box(0, 255, (4, 4, 3), np.uint8),
        bits=spaces.MultiBinary(3),
        large=spaces.Box(0, 60_000, (2,), np.uint16),
        scalar=spaces.Box(-1, 1, (), np.float64),
    )
    data = dataset_of(space)
    for folder in (None, tmp_path):
        batch = next(iter(to_torch(data, kind="episodes", sampling="sequential", dtype=None, memory_map=folder)))
        states = batch.observations
        assert isinstance(states["pair"], tuple)
        assert states["image"].dtype == torch.uint8
        assert states["large"].dtype == torch.int64
        assert states["scalar"].shape == (3, 5)
        for number, episode in enumerate(data):
            size = len(episode.rewards) + 1
            for key in ("image", "bits", "large", "scalar"):
                np.testing.assert_array_equal(states[key][number, :size], episode.observations[key])
            for part in range(2):
                np.testing.assert_array_equal(states["pair"][part][number, :size], episode.observations["pair"][part])


def test_text_is_refused_by_name():
    data = dataset_of(spaces.Dict(note=spaces.Text(5), x=spaces.Box(-1, 1, (2,))))
    for flat in (False, True):
        with pytest.raises(UnsupportedSpaceError, match="observation space holds Text"):
            to_torch(data, flat=flat)


def test_an_empty_view_is_an_error(augmented):
    nothing = augmented.filter_episodes(lambda episode: False)
    for data in (nothing, augmented.source.filter_episodes(lambda episode: False)):
        with pytest.raises(InvalidDataError, match="no episodes"):
            to_torch(data)


BAD = [
    ({"kind": "steps"}, "kind must be one of transitions, windows, episodes"),
    ({"sampling": "random"}, "sampling must be one of"),
    ({"batch_size": 0}, "batch_size must be an integer of at least 1"),
    ({"batch_size": 2.5}, "batch_size must be an integer"),
    ({"batch_size": True}, "batch_size must be an integer"),
    ({"seed": -1}, "seed must be a non-negative integer"),
    ({"kind": "windows"}, "needs length="),
    ({"kind": "windows", "length": 0}, "length must be an integer of at least 1"),
    ({"kind": "windows", "length": 3, "stride": 0}, "stride must be"),
    ({"kind": "windows", "length": 3, "stride": 4}, "would leave steps out"),
    ({"length": 3}, "length belongs to kind='windows'"),
    ({"kind": "episodes", "stride": 3}, "stride belongs to kind='windows'"),
    ({"real_fraction": 0.5}, "need sampling='replacement'"),
    ({"sampling": "replacement", "real_fraction": 1.5}, "real_fraction must be a number from 0 to 1"),
    ({"sampling": "replacement", "real_fraction": float("nan")}, "real_fraction must be"),
    ({"sampling": "replacement", "synthetic_weight": -1}, "synthetic_weight must be"),
    ({"sampling": "replacement", "synthetic_weight": float("inf")}, "synthetic_weight must be"),
    ({"sampling": "replacement", "synthetic_weight": 1, "real_fraction": 0.5}, "not both"),
    ({"dtype": torch.int64}, "dtype must be torch.float16"),
    ({"device": "nowhere"}, "is no torch device"),
    ({"device": "cuda"}, "finds no CUDA device"),
    ({"pin_memory": True}, "finds no CUDA device"),
]


@pytest.mark.parametrize(("settings", "message"), BAD)
def test_settings_that_cannot_work_are_errors(make_dataset, settings, message, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(ConfigurationError, match=message):
        to_torch(make_dataset(LENGTHS), **settings)


def test_what_is_no_dataset_is_an_error():
    with pytest.raises(ConfigurationError, match="A Minari dataset, the id of one, or the path"):
        to_torch([1, 2, 3])


def test_batches_move_to_a_device(make_dataset):
    # "meta" has shapes and no values: the one other device that every machine has
    batch = next(iter(to_torch(make_dataset(LENGTHS), batch_size=4, device="meta")))
    assert {leaf.device.type for leaf in torch.utils._pytree.tree_leaves(tuple(batch))} == {"meta"}
    moved = next(iter(to_torch(make_dataset(LENGTHS, dataset_id="test/b-v0"), batch_size=4))).to("meta")
    assert moved.observations["mode"].shape == batch.observations["mode"].shape == (4,)
    assert moved.mask.device.type == "meta"


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_pinned_and_on_a_cuda_device(augmented, tmp_path):
    reference = list(to_torch(augmented, batch_size=5))
    pinned = list(to_torch(augmented, batch_size=5, pin_memory=True))
    assert all(batch.rewards.is_pinned() and batch.observations["mode"].is_pinned() for batch in pinned)
    assert all_same(pinned, reference)
    for settings in ({}, {"memory_map": tmp_path}, {"memory_map": tmp_path, "pin_memory": True}):
        found = list(to_torch(augmented, batch_size=5, device="cuda", **settings))
        assert all(batch.rewards.device.type == "cuda" for batch in found)
        assert all_same((batch.to("cpu") for batch in found), reference)


def test_a_plain_dataloader_gives_the_same_batches_with_any_workers(tmp_path):
    environment = os.environ | {"MINARI_DATASETS_PATH": str(tmp_path), "OAT_GYM_CACHE": str(tmp_path / "cache")}
    script = Path(__file__).with_name("loader_workers.py")
    done = subprocess.run(
        [sys.executable, str(script), str(tmp_path)], capture_output=True, text=True, env=environment, check=False
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    other = found.pop("other seed")
    assert set(found) == {"fork/0", "fork/2", "fork/4", "spawn/2", "spawn/4"}
    assert len(set(found.values())) == 1, found
    assert other not in found.values()


@pytest.mark.parametrize("module", [loaders, _loader, _loader_config])
def test_examples_in_docstrings(module):
    result = doctest.testmod(module)
    assert result.attempted > 0 == result.failed
