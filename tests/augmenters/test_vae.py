"""VAE of whole series: the ELBO against closed forms, masks, a known distribution, and the augmenter."""

from __future__ import annotations

import math
from collections.abc import Callable

import minari
import numpy as np
import pytest
import torch
from gymnasium import spaces
from minari.data_collector import EpisodeBuffer

import oat_gym.augmenters.vae as vae_module
from oat_gym import AugmentedDataset
from oat_gym.augmenters.vae import VAE
from oat_gym.checks import check_augmenter, check_dataset
from oat_gym.errors import ConfigurationError, InvalidDataError, TrainingError
from oat_gym.generation._layers import initial_weights, unpack
from oat_gym.generation.padded import PaddedSeries
from oat_gym.generation.vae import FittedVAE, VAEConfig, VAENetwork, initial_scales, series_normalizer, to_tensors
from oat_gym.generation.vae_training import fit_vae
from oat_gym.source import Source
from oat_gym.spaces import Layout
from tests.conftest import install_dataset

ONE = Layout(1, (0,), ())
MIXED = Layout(4, (0,), ((1, 4),))
TINY = VAEConfig(latent=3, encoder=(8,), max_updates=6, evaluate_every=3)


def mixed_series(lengths: list[int], *, seed: int = 0) -> PaddedSeries:
    """Return series with a real and a three-valued discrete state, and one action."""
    rng = np.random.default_rng(seed)
    states = [np.concatenate([rng.normal(size=(n + 1, 1)), np.eye(3)[rng.integers(3, size=n + 1)]], 1) for n in lengths]
    actions = [rng.normal(size=(n, 1)) for n in lengths]
    return PaddedSeries.of(
        states, actions, [rng.normal(size=n) for n in lengths], state_layout=MIXED, action_layout=ONE
    )


def network_and_weights(series: PaddedSeries) -> tuple[VAENetwork, torch.Tensor]:
    network = VAENetwork(series.state_layout, series.action_layout, series.rows.shape[1], TINY)
    flat = initial_weights(network.shapes, torch.Generator().manual_seed(0))[None]
    initial_scales(flat, network.shapes)
    return network, flat


def test_rows_and_masks_keep_the_rule_of_one_more_state() -> None:
    series = mixed_series([3, 1])
    assert series.rows.shape == (2, 4, 6)
    assert series.recorded_rows.tolist() == [[True] * 4, [True, True, False, False]]
    assert series.recorded[..., :4].sum((1, 2)).tolist() == [16, 8]
    assert series.recorded[..., 4:].sum((1, 2)).tolist() == [6, 2]
    assert series.layout == Layout(6, (0, 4, 5), ((1, 4),))
    with pytest.raises(InvalidDataError, match="T\\+1 states"):
        PaddedSeries.of([np.ones((3, 1))], [np.ones((3, 1))], [np.ones(3)], state_layout=ONE, action_layout=ONE)
    with pytest.raises(TrainingError, match="Episode 0"):
        PaddedSeries.of([np.full((2, 1), np.nan)], [np.ones((1, 1))], [np.ones(1)], state_layout=ONE, action_layout=ONE)


def test_the_elbo_of_a_network_of_zeros_is_its_closed_form() -> None:
    series = mixed_series([3, 1])
    network, flat = network_and_weights(series)
    flat.zero_()
    data = to_tensors(series, series_normalizer(series), "cpu")
    terms = network.terms(unpack(flat, network.shapes), data, torch.randn(1, 2, 3))
    posterior, scale = math.log(2) + 1e-3, math.log(2) + TINY.scale_floor  # softplus(0), above the floors
    kl = 3 * 0.5 * (posterior**2 - 1 - 2 * math.log(posterior))
    real = data.rows[..., [0, 4, 5]] * torch.stack((data.states, data.steps, data.steps), dim=-1)
    count = (data.states + 2 * data.steps).sum(1)
    expected = -0.5 * (real / scale).square().sum((1, 2)) - count * math.log(scale * math.sqrt(2 * math.pi))
    expected -= data.states.sum(1) * math.log(3)
    torch.testing.assert_close(terms.kl, torch.full((2,), kl))
    torch.testing.assert_close(terms.log_likelihood, expected)
    torch.testing.assert_close(terms.elbo, expected - kl)


def test_padding_changes_neither_loss_nor_gradient() -> None:
    series = mixed_series([5, 2, 1])
    padded = PaddedSeries(
        np.where(series.recorded, series.rows, 1e3), series.lengths, series.state_layout, series.action_layout
    )
    network, flat = network_and_weights(series)
    results: list[tuple[torch.Tensor, torch.Tensor]] = []
    for version in (series, padded):
        weights = flat.clone().requires_grad_()
        data = to_tensors(version, series_normalizer(version), "cpu")
        noise = torch.randn(1, 3, 3, generator=torch.Generator().manual_seed(0))
        elbo = network.terms(unpack(weights, network.shapes), data, noise).elbo.sum()
        results.append((elbo.detach(), torch.autograd.grad(elbo, weights)[0]))
    assert torch.equal(results[0][0], results[1][0])
    assert torch.equal(results[0][1], results[1][1])


def test_the_likelihood_reads_recorded_entries_only() -> None:
    series = mixed_series([3, 1])
    network, flat = network_and_weights(series)
    data, weights = to_tensors(series, series_normalizer(series), "cpu"), unpack(flat, network.shapes)
    z = torch.zeros(1, 2, 3)
    rows = data.rows.clone().requires_grad_()
    total = network.log_likelihood(weights, z, data._replace(rows=rows)).sum()
    read = torch.autograd.grad(total, rows)[0] != 0
    np.testing.assert_array_equal(read.numpy(), series.recorded)


def test_it_recovers_mean_and_covariance_of_a_gaussian_family() -> None:
    """Series m_t + u w_t + noise, u ~ N(0, 1): their covariance is w w' + noise variance."""
    rng = np.random.default_rng(0)
    mean, direction = np.array([1.0, -2.0, 0.5, 3.0, 0.0]), np.array([1.0, 0.5, -1.0, 0.2, 1.5])
    states = (mean + rng.normal(size=(400, 1)) * direction + 0.3 * rng.normal(size=(400, 5)))[..., None]
    actions, rewards = rng.normal(size=(400, 4, 1)), rng.normal(size=(400, 4))
    series = PaddedSeries.of(list(states), list(actions), list(rewards), state_layout=ONE, action_layout=ONE)
    config = VAEConfig(latent=2, encoder=(32,), learning_rate=3e-3, batch_size=100, max_updates=1200)
    model = fit_vae(series, config=config, rng=rng)
    drawn = model.sample(4000, rng=rng)[..., 0]
    covariance = np.outer(direction, direction) + 0.09 * np.eye(5)
    np.testing.assert_allclose(drawn.mean(0), mean, atol=0.25)
    np.testing.assert_allclose(np.cov(drawn.T), covariance, atol=0.4)
    smooth = model.sample(4000, rng=rng, observation_noise=False)[..., 0]
    assert (smooth.var(0) < drawn.var(0)).all()
    near = model.sample(400, rng=rng, start=series, observation_noise=False)[..., 0]
    assert np.corrcoef(near[:, 0], states[:, 0, 0])[0, 1] > 0.8  # the posterior start is a variation of its source
    assert abs(np.corrcoef(smooth[:400, 0], states[:, 0, 0])[0, 1]) < 0.3


def test_training_raises_the_elbo_and_keeps_the_best_weights() -> None:
    series = mixed_series([4, 6, 5, 4, 6, 3, 5, 6, 4, 5])
    config = VAEConfig(latent=2, encoder=(16,), max_updates=300, patience=60)
    history = fit_vae(series, config=config, rng=np.random.default_rng(0)).history
    assert history.train[-1] > history.train[0]
    best = history.updates[history.held_out.argmax()]
    assert history.updates[-1] - best <= 60 + config.evaluate_every


def test_a_restored_model_gives_the_same_bytes() -> None:
    model = fit_vae(mixed_series([4, 2, 6]), config=TINY, rng=np.random.default_rng(0))
    again = FittedVAE.from_arrays(model.to_arrays(), config=TINY)
    one, two = (m.sample(5, rng=np.random.default_rng(1)) for m in (model, again))
    assert one.tobytes() == two.tobytes()
    assert set(np.unique(one[..., 1:4])) == {0.0, 1.0}  # one-hots stay one-hots


def test_divergence_is_an_error() -> None:
    with pytest.raises(TrainingError, match="diverged"):
        fit_vae(
            mixed_series([4] * 6),
            config=VAEConfig(learning_rate=1e30, max_updates=40),
            rng=np.random.default_rng(0),
        )


def test_unequal_lengths_and_one_step_episodes(make_dataset: Callable[..., minari.MinariDataset]) -> None:
    dataset = make_dataset([5, 1, 9, 3, 1])
    state = torch.get_rng_state()
    data = AugmentedDataset(dataset, VAE(model=TINY), factor=3, seed=0)
    assert len(data[12].rewards) == 9
    assert torch.equal(state, torch.get_rng_state())
    check_dataset(data)
    for number, synthetic in enumerate(data[5:15]):
        source = dataset[number % 5]
        assert len(synthetic.observations["mode"]) == len(source.rewards) + 1
        assert synthetic.observations["position"].dtype == source.observations["position"].dtype
        np.testing.assert_array_equal(synthetic.truncations, source.truncations)
        assert data.provenance(5 + number).mask.all()
    assert not np.array_equal(data[5].rewards, data[10].rewards)


@pytest.mark.parametrize("start", ["prior", "posterior"])
def test_any_order_and_any_process_give_the_same_bytes(
    make_dataset: Callable[..., minari.MinariDataset], start: str
) -> None:
    source, augmenter = Source(make_dataset([5, 1, 9, 3])), VAE(model=TINY, start=start)  # type: ignore[arg-type]
    sampler = augmenter.fit(source, seed=4)
    restored = augmenter.restore(source, *sampler.state(), seed=4)
    late = restored.generate(2)["rows"]
    assert sampler.generate(0)["rows"].tobytes() == restored.generate(0)["rows"].tobytes()
    assert sampler.generate(2)["rows"].tobytes() == late.tobytes()
    assert augmenter.fit(source, seed=5).generate(2)["rows"].tobytes() != late.tobytes()


def test_values_stay_in_the_spaces_and_in_the_range_of_the_data(tmp_path: object) -> None:
    rng = np.random.default_rng(0)
    buffers = [
        EpisodeBuffer(
            observations=rng.integers(0, [3, 2], size=(n + 1, 2)),
            actions=rng.uniform(0.9, 1.0, size=(n, 1)).astype(np.float32),
            rewards=rng.uniform(size=n),
            terminations=np.arange(n) == n - 1,
            truncations=np.zeros(n, dtype=bool),
        )
        for n in (4, 6, 1, 5)
    ]
    dataset = install_dataset("test/codes-v0", buffers, spaces.MultiDiscrete([3, 2]), spaces.Box(-1, 1, (1,)))
    data = AugmentedDataset(dataset, VAE(model=TINY), count=8, seed=0)
    for episode in data[4:12]:
        assert all(row in spaces.MultiDiscrete([3, 2]) for row in episode.observations)
        assert (episode.actions <= 1.0).all()
        assert (episode.actions >= 0.9 - 0.02).all()
        assert ((episode.rewards >= -0.2) & (episode.rewards <= 1.2)).all()


def test_what_cannot_work_is_refused(
    make_dataset: Callable[..., minari.MinariDataset], monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(InvalidDataError, match="at least 2 episodes, got 1"):
        AugmentedDataset(make_dataset([5]), VAE(), factor=2, seed=0)
    monkeypatch.setattr(vae_module, "MAX_WEIGHTS", 1000)
    with pytest.raises(InvalidDataError, match="episodes of 6 steps and 7 features"):
        VAE().check(Source(make_dataset([5, 6], dataset_id="test/longer-v0")))


@pytest.mark.parametrize("settings", [{"model": 3}, {"start": "middle"}, {"observation_noise": 1}])
def test_settings_of_the_wrong_kind_are_refused(settings: dict[str, object]) -> None:
    with pytest.raises(ConfigurationError, match=next(iter(settings))):
        VAE(**settings)  # type: ignore[arg-type]


@pytest.mark.parametrize(("name", "value"), [("latent", 0), ("encoder", ()), ("patience", 0), ("validation", 1.0)])
def test_numbers_out_of_range_are_refused(name: str, value: object) -> None:
    with pytest.raises(ConfigurationError, match=name):
        VAEConfig(**{name: value})  # type: ignore[arg-type]


def test_the_contract_of_augmenters_is_kept() -> None:
    check_augmenter(VAE(model=TINY))
