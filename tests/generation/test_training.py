"""Training: the bound rises, splits respect episodes, presets do what they say, failures name the set."""

import dataclasses
import logging

import numpy as np
import pytest
import torch

from oat_gym.errors import ConfigurationError, InvalidDataError, TrainingError
from oat_gym.generation import PAPER_LEARNING_RATES, Sequences, VAEMDPConfig, fit_many, fit_vae_mdp
from oat_gym.generation import training as training_module
from oat_gym.generation._layers import one_thread
from oat_gym.generation._tracker import BestTracker
from oat_gym.generation.sequences import hold_out
from oat_gym.generation.vae_mdp import VAEMDPNetwork
from oat_gym.spaces import Layout


def fit(kit, spans, config, seed=0, **settings):
    layouts = {"state_layout": kit.real(spans[0].shape[-1]), "action_layout": kit.real(spans[1].shape[-1])}
    return fit_vae_mdp(*spans, config=config, rng=np.random.default_rng(seed), **layouts, **settings)


def test_the_elbo_rises(kit):
    spans, _, _ = kit.linear_gaussian(np.random.default_rng(0), 60, 5)
    history = fit(kit, spans, dataclasses.replace(kit.tiny, max_updates=200, learning_rate=3e-3)).history
    assert history.updates.tolist() == list(range(5, 201, 5))
    assert history.held_out[-1] > history.held_out[0] + 2
    assert history.train[-1] > history.train[0] + 2


def test_early_stopping_goes_back_to_the_best_weights(kit):
    # Pure noise cannot be learnt from 8 spans: the held-out bound falls while the training bound rises.
    spans = kit.random_spans(np.random.default_rng(0), m=10)
    config = VAEMDPConfig(max_updates=400, patience=60, learning_rate=1e-2, evaluate_every=10)
    model = fit(kit, spans, config)
    best = model.history.updates[model.history.held_out.argmax()]
    assert model.history.updates[-1] < 400
    assert model.history.updates[-1] == best + 60
    stopped_there = dataclasses.replace(config, max_updates=int(best), patience=None)
    again = fit(kit, spans, stopped_there)
    assert all(torch.equal(model.weights[name], again.weights[name]) for name in model.weights)


def test_the_paper_preset_makes_100_updates_of_4_and_picks_from_the_grid(kit, monkeypatch):
    sizes = []
    original = training_module._Stream.minibatch

    def counted(self):
        chosen = original(self)
        sizes.append(len(chosen))
        return chosen

    monkeypatch.setattr(training_module._Stream, "minibatch", counted)
    spans = kit.random_spans(np.random.default_rng(0), m=25, steps=2)
    model = fit(kit, spans, VAEMDPConfig.from_preset("paper"))
    assert sizes == [4] * 100
    assert model.history.updates[-1] == 100
    held_out = {}
    for rate in PAPER_LEARNING_RATES:
        one = dataclasses.replace(VAEMDPConfig.from_preset("paper"), learning_rate_grid=(rate,))
        held_out[rate] = fit(kit, spans, one).history.held_out[-1]
    assert model.learning_rate == max(held_out, key=held_out.get)
    assert model.history.held_out[-1] == pytest.approx(held_out[model.learning_rate], rel=1e-3)


def test_sets_trained_together_get_the_models_they_get_alone(kit):
    rng = np.random.default_rng(0)
    sets = [Sequences(*kit.random_spans(rng, m=m), name=f"set {m}") for m in (7, 12, 30)]
    layouts = {"state_layout": kit.real(3), "action_layout": kit.real(2)}
    config = dataclasses.replace(kit.tiny, batch_size=8)
    together = fit_many(sets, config=config, rng=np.random.default_rng(4), **layouts)
    for model, spans, stream in zip(together, sets, np.random.default_rng(4).spawn(3), strict=True):
        data = training_module._prepare(spans, model.network, stream)
        alone = training_module._Training(model.network, [spans], [data], [stream]).run(None)[0]
        assert model.name == spans.name
        np.testing.assert_allclose(model.history.held_out, alone.history.held_out, rtol=1e-4)


def test_padding_of_shorter_spans_has_no_effect(kit):
    rng = np.random.default_rng(0)
    spans = kit.random_spans(rng, m=10, steps=5)
    mask = np.ones((10, 5), dtype=bool)
    mask[::2, 3:] = False
    filled = [x.copy() for x in spans]
    filled[0][::2, 4:], filled[1][::2, 3:], filled[2][::2, 3:] = np.nan, 1e9, np.inf
    one, other = fit(kit, spans, kit.tiny, mask=mask), fit(kit, filled, kit.tiny, mask=mask)
    assert all(torch.equal(one.weights[name], other.weights[name]) for name in one.weights)


def test_held_out_rows_are_whole_groups():
    groups = np.repeat(np.arange(10), [1, 5, 2, 2, 2, 3, 3, 1, 4, 2])
    held = hold_out(groups, share=0.2, rng=np.random.default_rng(0), name="x")
    assert len(np.unique(groups[held])) == 2
    assert not set(groups[held]) & set(groups[~held])
    assert not hold_out(groups, share=0.0, rng=np.random.default_rng(0), name="x").any()


def test_few_groups_are_told_about(kit, caplog):
    spans = kit.random_spans(np.random.default_rng(0), m=12)
    with caplog.at_level(logging.WARNING):
        model = fit(kit, spans, kit.tiny, groups=np.repeat(np.arange(4), 3), name="PST set 9")
    assert "PST set 9 comes from 4 source episodes" in caplog.text
    assert np.isnan(model.history.held_out).all()
    assert np.isfinite(model.history.train).all()


@pytest.mark.parametrize("part", [0, 1, 2])
def test_missing_values_name_the_set(kit, part):
    spans = kit.random_spans(np.random.default_rng(0))
    spans[part][3, 2] = np.nan
    with pytest.raises(TrainingError, match=r"PST set 5: the (state|action|reward) at step 2 of span 3 is not finite"):
        fit(kit, spans, kit.tiny, name="PST set 5")


def test_divergence_names_the_set(kit):
    spans = kit.random_spans(np.random.default_rng(0))
    with pytest.raises(TrainingError, match="PST set 7: training diverged"):
        fit(kit, spans, dataclasses.replace(kit.tiny, learning_rate=1e30), name="PST set 7")


def test_a_grid_survives_a_rate_that_diverges(kit):
    spans = kit.random_spans(np.random.default_rng(0))
    model = fit(kit, spans, dataclasses.replace(kit.tiny, learning_rate_grid=(1e30, 1e-3)))
    assert model.learning_rate == 1e-3


def test_wrong_shapes_and_masks_are_refused(kit):
    s, a, r = kit.random_spans(np.random.default_rng(0))
    with pytest.raises(InvalidDataError, match=r"states must have shape \(12, 5, 3\)"):
        Sequences(s[:, :-1], a, r)
    with pytest.raises(InvalidDataError, match="rewards must have shape"):
        Sequences(s, a, r[:, :-1])
    with pytest.raises(InvalidDataError, match="groups must have shape"):
        Sequences(s, a, r, groups=np.zeros(3, dtype=int))
    hole = np.ones((12, 4), dtype=bool)
    hole[0, 1] = False
    with pytest.raises(InvalidDataError, match="true for one or more steps, then false"):
        Sequences(s, a, r, mask=hole)
    with pytest.raises(InvalidDataError, match="3 columns, their layout 2"):
        fit_vae_mdp(
            s, a, r, state_layout=kit.real(2), action_layout=kit.real(2), config=kit.tiny, rng=np.random.default_rng(0)
        )


@pytest.mark.parametrize(
    "setting",
    [
        {"latent": 0},
        {"encoder": ()},
        {"encoder": (8, -1)},
        {"learning_rate": -1.0},
        {"learning_rate_grid": ()},
        {"lr_decay": 1.1},
        {"validation": 1.0},
        {"scale_floor": 0.0},
        {"patience": 0},
        {"gradient_clip": float("nan")},
        {"range_margin": -0.1},
        {"batch_size": 2.5},
    ],
)
def test_settings_are_validated(setting):
    with pytest.raises(ConfigurationError, match=next(iter(setting))):
        VAEMDPConfig(**setting)


def test_an_unknown_preset_is_refused():
    with pytest.raises(ConfigurationError, match="preset"):
        VAEMDPConfig.from_preset("fast")


def test_progress_is_reported_to_the_end(kit):
    calls = []
    fit(kit, kit.random_spans(np.random.default_rng(0)), kit.tiny, progress=lambda *call: calls.append(call))
    assert calls[0] == ("training PST set 0", 5, 20)
    assert calls[-1][1:] == (20, 20)


def test_inputs_and_global_random_states_are_left_alone(kit):
    spans = kit.random_spans(np.random.default_rng(0))
    copies = [x.copy() for x in spans]
    numpy_state, torch_state, threads = np.random.get_state()[1].copy(), torch.get_rng_state(), torch.get_num_threads()  # noqa: NPY002
    model = fit(kit, spans, kit.tiny)
    model.sample(5, rng=np.random.default_rng(0), policy=kit.GaussianPolicy(width=2))
    assert all(np.array_equal(x, y) for x, y in zip(spans, copies, strict=True))
    assert np.array_equal(np.random.get_state()[1], numpy_state)  # noqa: NPY002
    assert torch.equal(torch.get_rng_state(), torch_state)
    assert torch.get_num_threads() == threads


def test_a_stopped_member_is_frozen():
    tracker = BestTracker(2, patience=2)
    scores = [(1, 1), (2, 0.5), (3, 0.4), (4, 9), (5, 9)]
    for update, score in enumerate(scores, start=1):
        tracker.look(update, torch.zeros(2), torch.tensor(score), torch.full((2, 3), float(update)))
    assert tracker.weights.tolist() == [[5.0] * 3, [1.0] * 3]
    assert tracker.score.tolist() == [5.0, 1.0]
    assert tracker.history(1, held_out=True)[0].tolist() == [1, 2, 3]


def test_kl_terms_come_in_slowly_for_discrete_states_only():
    discrete, real = Layout(2, (), ((0, 2),)), Layout(2, (0, 1), ())
    assert VAEMDPNetwork(discrete, real, VAEMDPConfig()).kl_warmup > 0
    assert VAEMDPNetwork(real, discrete, VAEMDPConfig()).kl_warmup == 0
    assert VAEMDPNetwork(discrete, real, VAEMDPConfig.from_preset("paper")).kl_warmup == 0
    assert VAEMDPNetwork(real, real, VAEMDPConfig(kl_warmup=7)).kl_warmup == 7


def test_the_number_of_threads_is_restored_by_the_last_block_that_ends():
    """Two datasets that are fitted in threads: the first to begin may end before the other."""
    before = torch.get_num_threads()
    torch.set_num_threads(before + 1)
    try:
        first, second = one_thread(), one_thread()
        first.__enter__()
        second.__enter__()
        first.__exit__(None, None, None)
        assert torch.get_num_threads() == 1
        second.__exit__(None, None, None)
        assert torch.get_num_threads() == before + 1
    finally:
        torch.set_num_threads(before)
