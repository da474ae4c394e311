"""TimeGAN: the layers against torch, the losses against their definitions, masks, phases, and the augmenter."""

from __future__ import annotations

from collections.abc import Callable

import minari
import numpy as np
import pytest
import torch
from gymnasium import spaces
from minari.data_collector import EpisodeBuffer

from oat_gym import AugmentedDataset
from oat_gym.augmenters.timegan import MIN_EPISODES, TimeGAN
from oat_gym.checks import check_augmenter, check_dataset
from oat_gym.errors import ConfigurationError, InvalidDataError, TrainingError
from oat_gym.generation import _timegan_losses as losses
from oat_gym.generation._gru import gru, gru_shapes
from oat_gym.generation._layers import initial_weights, unpack
from oat_gym.generation.timegan import FittedTimeGAN, TimeGANConfig, TimeGANNetworks
from oat_gym.generation.timegan_training import _Training, fit_timegan, scaled_and_filled
from oat_gym.source import Source
from tests.conftest import install_dataset

TINY = TimeGANConfig(hidden=6, layers=2, embedding_iterations=4, supervised_iterations=3, joint_iterations=3)


def sines(count: int, length: int = 10, width: int = 2, *, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    frequency, phase = (rng.uniform(0, 0.5, size=(count, 1, width)) for _ in range(2))
    return np.sin(frequency * np.arange(length)[:, None] + phase)


def unequal(rows: np.ndarray, lengths: list[int]) -> np.ndarray:
    """Return a mask of series of so many rows whose last row lacks its last column, as an episode's does."""
    recorded = np.repeat(np.arange(rows.shape[1])[None, :, None] < np.array(lengths)[:, None, None], rows.shape[2], 2)
    for i, length in enumerate(lengths):
        recorded[i, length - 1, -1] = False
    return recorded


def unequal_training(rows: np.ndarray) -> _Training:
    recorded = unequal(rows, [6, 9, 2, 4])
    training = _Training(rows, recorded, TINY, np.random.default_rng(0))
    training.rng, training.noise = np.random.default_rng(1), torch.Generator().manual_seed(1)
    return training


@pytest.mark.parametrize("layers", [1, 2, 3])
def test_gru_and_its_gradients_are_those_of_torch(layers: int) -> None:
    nodes, generator = 5, torch.Generator().manual_seed(layers)
    shapes = gru_shapes("net", 4, nodes, layers)
    flat = initial_weights(shapes, generator)
    flat = (flat + 0.1 * torch.randn(flat.shape, generator=generator)).double()[None].requires_grad_()
    x = torch.randn(7, 3, 4, generator=generator, dtype=torch.float64, requires_grad=True)
    weights = unpack(flat, shapes)
    ours = gru(weights, "net", x)
    packed = [
        weights[f"net.{layer}.{part}.{kind}"][0].t().squeeze()
        for layer in range(layers)
        for kind in ("weight", "bias")
        for part in ("below", "before")
    ]
    start = torch.zeros(layers, 3, nodes, dtype=torch.float64)
    theirs = torch.gru(x, start, packed, True, layers, 0.0, True, False, False)[0]
    direction = torch.randn(ours.shape, generator=generator, dtype=torch.float64)
    torch.testing.assert_close(ours, theirs)
    for mine, reference in zip(
        torch.autograd.grad((ours * direction).sum(), (flat, x)),
        torch.autograd.grad((theirs * direction).sum(), (flat, x)),
        strict=True,
    ):
        torch.testing.assert_close(mine, reference)


def test_losses_of_equal_lengths_are_the_originals() -> None:
    generator = torch.Generator().manual_seed(0)
    x, y = (torch.rand(5, 8, 3, generator=generator) for _ in range(2))
    entries, rows = torch.ones(5, 8, 3), torch.ones(5, 8)
    mse, bce = torch.nn.functional.mse_loss, torch.nn.functional.binary_cross_entropy_with_logits
    spread = ((x.var(1, correction=0) + 1e-6).sqrt() - (y.var(1, correction=0) + 1e-6).sqrt()).abs().mean()
    logits = x[..., 0] * 4 - 2
    torch.testing.assert_close(losses.recovery_loss(x, y, entries), mse(x, y))
    torch.testing.assert_close(losses.supervised_loss(x, y, rows), mse(x[1:], y[:-1]))
    torch.testing.assert_close(losses.moment_loss(x, y, entries), spread + (x.mean(1) - y.mean(1)).abs().mean())
    torch.testing.assert_close(losses.real_loss(logits, rows), bce(logits, torch.ones(5, 8)))
    torch.testing.assert_close(losses.fake_loss(logits, rows), bce(logits, torch.zeros(5, 8)))
    u, e, s, v = (torch.tensor(value) for value in (0.3, 0.5, 0.04, 0.2))
    assert float(losses.generator_loss(u, e, s, v, gamma=2.0)) == pytest.approx(0.3 + 2 * 0.5 + 100 * 0.2 + 100 * 0.2)
    assert float(losses.embedder_loss(s, e)) == pytest.approx(10 * 0.2 + 0.1 * 0.5)


def test_losses_of_unequal_lengths_count_each_recorded_value_once() -> None:
    generator = torch.Generator().manual_seed(0)
    x, y = (torch.rand(4, 3, 1, generator=generator) for _ in range(2))
    entries = torch.tensor([[1, 1, 1], [1, 1, 1], [1, 1, 0], [1, 0, 0]], dtype=torch.float32)[..., None]
    inside = [(t, n) for t in range(4) for n in range(3) if entries[t, n]]
    pairs = [(t, n) for t, n in inside if t]
    difference = torch.stack([(x[t, n] - y[t, n]).square() for t, n in inside]).mean()
    torch.testing.assert_close(losses.recovery_loss(x, y, entries), difference)
    step = torch.stack([(x[t, n] - y[t - 1, n]).square() for t, n in pairs]).mean()
    torch.testing.assert_close(losses.supervised_loss(x, y, entries[..., 0]), step)
    means = torch.tensor([(x[t, : 3 - max(0, t - 1)] - y[t, : 3 - max(0, t - 1)]).mean().abs() for t in range(4)])
    expected = (means * torch.tensor([3.0, 3.0, 2.0, 1.0])).sum() / 9
    spreads = torch.stack(
        [
            x[t, :n].var(correction=0).add(1e-6).sqrt() - y[t, :n].var(correction=0).add(1e-6).sqrt()
            for t, n in ((0, 3), (1, 3), (2, 2))
        ]
    ).abs()
    expected = expected + (spreads * torch.tensor([3.0, 3.0, 2.0])).sum() / 8
    torch.testing.assert_close(losses.moment_loss(x, y, entries), expected)


@pytest.mark.parametrize("name", ["embedding", "supervised", "generator", "embedder", "discriminator"])
def test_padding_changes_no_loss_and_no_gradient(name: str) -> None:
    groups = {"supervised": "generator", "generator": "generator", "discriminator": "discriminator"}
    group = groups.get(name, "autoencoder")
    results = []
    for filler in (0.0, 777.0):
        rows = sines(4, 9)
        training = unequal_training(np.where(unequal(rows, [6, 9, 2, 4]), rows, filler))
        flat = training.flats[group].requires_grad_()
        loss = getattr(training, f"{name}_loss")(
            unpack(flat, training.networks.shapes[group]), training.take(np.arange(4))
        )
        results.append((loss.detach(), torch.autograd.grad(loss, flat)[0]))
    assert torch.equal(results[0][0], results[1][0])
    assert torch.equal(results[0][1], results[1][1])


def test_more_padding_behind_all_series_changes_nothing() -> None:
    rows = sines(4, 9)
    recorded = unequal(rows, [6, 9, 2, 4])
    longer = np.pad(rows, ((0, 0), (0, 5), (0, 0))), np.pad(recorded, ((0, 0), (0, 5), (0, 0)))
    short, long = (fit_timegan(*data, config=TINY, rng=np.random.default_rng(0)) for data in ((rows, recorded), longer))
    for name, values in short.history.items():
        np.testing.assert_array_equal(values, long.history[name])


def test_the_last_row_carries_its_action_on_and_scales_by_recorded_values() -> None:
    rows = np.array([[[0.0, 5.0], [2.0, 7.0], [4.0, 99.0]], [[1.0, 5.0], [1.0, 99.0], [99.0, 99.0]]])
    recorded = np.array([[[1, 1], [1, 1], [1, 0]], [[1, 1], [1, 0], [0, 0]]], dtype=bool)
    scaled, low, high = scaled_and_filled(rows, recorded)
    assert low.tolist() == [0, 5]
    assert high.tolist() == [4, 7]
    assert scaled[0].tolist() == [[0, 0], [0.5, 1], [1, 1]]
    assert scaled[1].tolist() == [[0.25, 0], [0.25, 0], [0.25, 0]]


def test_each_phase_lowers_its_loss_and_outputs_differ() -> None:
    config = TimeGANConfig(
        hidden=12,
        layers=2,
        embedding_iterations=200,
        supervised_iterations=100,
        joint_iterations=50,
        learning_rate=3e-3,
    )
    real = sines(64)
    model = fit_timegan(real, config=config, rng=np.random.default_rng(0))
    for name, share in (("embedding", 0.75), ("supervised", 0.5), ("generator", 0.9)):
        losses_of = model.history[name]
        assert losses_of[-10:].mean() < share * losses_of[:10].mean(), name
    generated = model.sample(200, rng=np.random.default_rng(1))
    assert generated.std(axis=0).mean() > 0.05  # identical outputs would have no spread
    assert np.abs(real.mean(axis=0) - generated.mean(axis=0)).mean() < 0.15  # 0.5 from the middle of the range
    assert generated.min() >= real.min()
    assert generated.max() <= real.max()


@pytest.mark.parametrize(("threshold", "expected"), [(0.0, True), (1e9, False)])
def test_the_discriminator_is_updated_only_above_the_threshold(threshold: float, expected: bool) -> None:
    config = TimeGANConfig(
        hidden=6,
        layers=2,
        embedding_iterations=1,
        supervised_iterations=1,
        joint_iterations=1,
        discriminator_threshold=threshold,
    )
    training = _Training(sines(8), np.ones((8, 10, 2), dtype=bool), config, np.random.default_rng(0))
    before = training.flats["discriminator"].clone()
    model = training.run(None)
    assert torch.equal(before, training.flats["discriminator"]) is not expected
    assert model.history["discriminator_updated"].tolist() == [float(expected)]
    assert len(model.history["generator"]) == len(model.history["embedder"]) == 2  # two for one of the discriminator
    assert len(model.history["discriminator"]) == 1


def test_phases_update_their_own_networks_only() -> None:
    training = _Training(sines(8), np.ones((8, 10, 2), dtype=bool), TINY, np.random.default_rng(0))
    first = {group: flat.clone() for group, flat in training.flats.items()}
    training._phase("embedding", 2, None, "autoencoder", training.embedding_loss)
    assert not torch.equal(first["autoencoder"], training.flats["autoencoder"])
    assert torch.equal(first["generator"], training.flats["generator"])
    training._phase("supervised", 2, None, "generator", training.supervised_loss)
    old, new = (
        unpack(flat, training.networks.shapes["generator"])
        for flat in (first["generator"], training.flats["generator"])
    )
    for name in old:
        assert torch.equal(old[name], new[name]) is name.startswith("generator."), name
    assert torch.equal(first["discriminator"], training.flats["discriminator"])


@pytest.mark.parametrize("phase", ["embedding", "supervised", "joint"])
def test_divergence_names_the_phase(phase: str, monkeypatch: pytest.MonkeyPatch) -> None:
    method, width = {"embedding": ("recover", 2), "supervised": ("supervise", 6), "joint": ("discriminate", 1)}[phase]
    nothing = lambda self, weights, x: x[..., :width].squeeze(-1) * np.nan  # noqa: E731
    monkeypatch.setattr(TimeGANNetworks, method, nothing)
    with pytest.raises(TrainingError, match=f"in the {phase} phase"):
        fit_timegan(sines(8), config=TINY, rng=np.random.default_rng(0))


def test_a_restored_model_gives_the_same_bytes() -> None:
    model = fit_timegan(sines(8), config=TINY, rng=np.random.default_rng(0))
    again = FittedTimeGAN.from_arrays(model.to_arrays(), config=TINY)
    one, two = (m.sample(5, rng=np.random.default_rng(3)) for m in (model, again))
    assert one.tobytes() == two.tobytes()
    assert set(again.history) == set(model.history)


def test_unequal_lengths_and_one_step_episodes(make_dataset: Callable[..., minari.MinariDataset]) -> None:
    dataset = make_dataset([5, 1, 9, 3, 7, 1])
    state = torch.get_rng_state()
    data = AugmentedDataset(dataset, TimeGAN(model=TINY), factor=3, seed=0)
    assert len(data[16].rewards) == 7
    assert torch.equal(state, torch.get_rng_state())
    check_dataset(data)
    for number, synthetic in enumerate(data[6:18]):
        source = dataset[number % 6]
        assert len(synthetic.observations["mode"]) == len(source.rewards) + 1
        assert synthetic.observations["position"].dtype == source.observations["position"].dtype
        assert np.isin(synthetic.observations["mode"], (0, 1, 2)).all()
        np.testing.assert_array_equal(synthetic.terminations, source.terminations)
        assert data.provenance(6 + number).mask.all()
    assert not np.array_equal(data[6].rewards, data[12].rewards)


def test_any_order_and_any_process_give_the_same_bytes(make_dataset: Callable[..., minari.MinariDataset]) -> None:
    dataset = make_dataset([5, 1, 9, 3, 7])
    source, augmenter = Source(dataset), TimeGAN(model=TINY)
    sampler = augmenter.fit(source, seed=4)
    restored = augmenter.restore(source, *sampler.state(), seed=4)
    late = restored.generate(2)["rows"]
    assert sampler.generate(0)["rows"].tobytes() == restored.generate(0)["rows"].tobytes()
    assert sampler.generate(2)["rows"].tobytes() == late.tobytes()
    assert augmenter.fit(source, seed=5).generate(2)["rows"].tobytes() != late.tobytes()


def test_discrete_actions_and_a_constant_column(tmp_path: object) -> None:
    rng = np.random.default_rng(0)
    buffers = [
        EpisodeBuffer(
            observations=rng.integers(0, [3, 2], size=(n + 1, 2)),
            actions=rng.integers(0, 4, size=n),
            rewards=np.zeros(n),
            terminations=np.arange(n) == n - 1,
            truncations=np.zeros(n, dtype=bool),
        )
        for n in (4, 6, 1, 5, 3)
    ]
    dataset = install_dataset("test/codes-v0", buffers, spaces.MultiDiscrete([3, 2]), spaces.Discrete(4))
    data = AugmentedDataset(dataset, TimeGAN(model=TINY), count=5, seed=0)
    for episode in data[5:10]:
        assert all(row in spaces.MultiDiscrete([3, 2]) for row in episode.observations)
        assert all(action in spaces.Discrete(4) for action in episode.actions)
        assert not episode.rewards.any()  # a constant column stays what it is


def test_too_few_episodes_are_refused(make_dataset: Callable[..., minari.MinariDataset]) -> None:
    with pytest.raises(InvalidDataError, match=f"TimeGAN needs at least {MIN_EPISODES} episodes, got 2"):
        AugmentedDataset(make_dataset([5, 6]), TimeGAN(), factor=2, seed=0)
    with pytest.raises(InvalidDataError, match="N and L at least 2"):
        fit_timegan(sines(1), config=TINY, rng=np.random.default_rng(0))


@pytest.mark.parametrize(
    ("name", "value"),
    [("layers", 1), ("batch_size", 1), ("hidden", 0), ("gamma", -1.0), ("learning_rate", float("nan"))],
)
def test_settings_out_of_range_are_refused(name: str, value: float) -> None:
    with pytest.raises(ConfigurationError, match=name):
        TimeGANConfig(**{name: value})


def test_presets() -> None:
    paper = TimeGAN.preset("paper").model
    assert (paper.embedding_iterations, paper.joint_iterations, paper.batch_size) == (50_000, 50_000, 128)
    assert paper.learning_rate == 1e-3
    assert TimeGAN.preset("default") == TimeGAN()
    with pytest.raises(ConfigurationError, match="preset"):
        TimeGAN.preset("fast")  # type: ignore[arg-type]
    with pytest.raises(ConfigurationError, match="model"):
        TimeGAN(model=3)  # type: ignore[arg-type]


def test_the_contract_of_augmenters_is_kept() -> None:
    check_augmenter(TimeGAN(model=TINY))
