"""Eq. 1 recomputed term by term with torch.distributions and torch.nn, masks, and the stacked layers."""

import pytest
import torch
from torch import distributions as td
from torch.nn.functional import linear, softplus

from oat_gym.generation._layers import Adam, initial_weights, unpack
from oat_gym.generation.vae_mdp import Batch, VAEMDPNetwork
from oat_gym.spaces import Layout

STATES, ACTIONS = Layout(4, (0, 3), ((1, 3),)), Layout(2, (0, 1), ())


@pytest.fixture
def generator():
    return torch.Generator().manual_seed(11)


def make_batch(generator, members, steps, count):
    states = torch.randn((members, steps + 1, count, 4), generator=generator)
    codes = torch.randint(2, (members, steps + 1, count), generator=generator)
    states[..., 1:3] = torch.nn.functional.one_hot(codes, 2).float()
    actions = torch.randn((members, steps, count, 2), generator=generator)
    rewards = torch.randn((members, steps, count, 1), generator=generator)
    terminal = torch.zeros(members, steps, count)
    terminal[:, -1] = 1.0
    return Batch(states, actions, rewards, torch.ones(members, steps, count), terminal)


def make_weights(network, generator, members):
    flat = torch.stack([initial_weights(network.shapes, generator) for _ in range(members)])
    return unpack(flat + 0.1 * torch.randn(flat.shape, generator=generator), network.shapes)


def reference_elbo(weights, k, n, *, batch, noise, network):
    """Eq. 1 of one sequence, one time step after the other, from other building blocks."""

    def mlp(name, x):
        layers = sorted(key for key in weights if key.startswith(name + ".") and key.endswith("weight"))
        for index, key in enumerate(layers):
            x = linear(x, weights[key][k].T, weights[key.replace("weight", "bias")][k, 0])
            x = torch.relu(x) if index < len(layers) - 1 else x
        return x

    def normal(x, floor):
        mean, raw = x.chunk(2)
        return td.Normal(mean, softplus(raw) + floor)

    def lstm(name):
        nodes = network.config.lstm
        order = [*range(2 * nodes), *range(3 * nodes, 4 * nodes), *range(2 * nodes, 3 * nodes)]  # torch: i, f, g, o
        input_weight = weights[f"{name}.input.weight"][k].T[order]
        cell = torch.nn.utils.skip_init(torch.nn.LSTMCell, input_weight.shape[1], nodes)
        cell.weight_ih.data, cell.weight_hh.data = input_weight, weights[f"{name}.hidden.weight"][k].T[order]
        cell.bias_ih.data = weights[f"{name}.input.bias"][k, 0][order]
        cell.bias_hh.data = torch.zeros(4 * nodes)
        return cell

    def emit(z, s):
        out = mlp("decoder.state", z)
        gaussian = td.Normal(out[:2], softplus(out[2:4]) + network.config.scale_floor)
        categorical = td.Categorical(logits=out[4:])
        return gaussian.log_prob(s[[0, 3]]).sum() + categorical.log_prob(s[1:3].argmax())

    s, a, r = batch.states[k, :, n], batch.actions[k, :, n], batch.rewards[k, :, n, 0]
    encoder, decoder = lstm("encoder.lstm"), lstm("decoder.lstm")
    q = normal(mlp("encoder.start", s[0]), 1e-3)
    z = q.mean + q.stddev * noise[k, 0, n]
    total = emit(z, s[0]) - td.kl_divergence(q, td.Normal(0.0, 1.0)).sum()
    encoder_carry = decoder_carry = None
    for t in range(len(a)):
        decoder_carry = decoder(torch.cat((z, a[t])), decoder_carry)
        encoder_carry = encoder(torch.cat((z, a[t], s[t + 1])), encoder_carry)
        p = normal(mlp("decoder.dense", decoder_carry[0]), 1e-3)
        q = normal(mlp("encoder.dense", encoder_carry[0]), 1e-3)
        z = q.mean + q.stddev * noise[k, t + 1, n]
        total = total + emit(z, s[t + 1]) - td.kl_divergence(q, p).sum()
        total = total + normal(mlp("decoder.reward", z), network.config.scale_floor).log_prob(r[t]).sum()
        if network.ends:
            total = total + td.Bernoulli(logits=mlp("decoder.end", z)).log_prob(batch.terminal[k, t, n]).sum()
    return total


@pytest.mark.parametrize("ends", [False, True])
@pytest.mark.parametrize("steps", [1, 4])
def test_elbo_is_equation_1(kit, generator, ends, steps):
    network = VAEMDPNetwork(STATES, ACTIONS, kit.tiny, ends=ends)
    weights = make_weights(network, generator, 2)
    batch = make_batch(generator, 2, steps, 3)
    noise = torch.randn((2, steps + 1, 3, kit.tiny.latent), generator=generator)
    with torch.no_grad():
        elbo = network.terms(weights, batch, noise).elbo()
        expected = [
            [reference_elbo(weights, k, n, batch=batch, noise=noise, network=network) for n in range(3)]
            for k in range(2)
        ]
    torch.testing.assert_close(elbo, torch.tensor(expected), rtol=1e-4, atol=1e-4)


def test_padded_steps_change_nothing(kit, generator):
    network = VAEMDPNetwork(STATES, ACTIONS, kit.tiny, ends=True)
    weights = make_weights(network, generator, 1)
    batch = make_batch(generator, 1, 6, 3)
    noise = torch.randn((1, 7, 3, kit.tiny.latent), generator=generator)
    mask = batch.mask.clone()
    mask[:, 4:] = 0.0
    short = Batch(*(x[:, : 5 if i == 0 else 4] for i, x in enumerate(batch)))
    alone = network.terms(weights, short, noise[:, :5]).elbo()
    states, actions = batch.states.clone(), batch.actions.clone()
    states[:, 5:], actions[:, 4:] = 100.0, -7.0
    padded = batch._replace(states=states, actions=actions, mask=mask, terminal=torch.ones_like(mask) * batch.terminal)
    torch.testing.assert_close(network.terms(weights, padded, noise).elbo(), alone)
    assert not torch.allclose(network.terms(weights, batch, noise).elbo(), alone)


def test_a_step_of_a_roll_out_is_the_transition_of_the_elbo(kit, generator):
    network = VAEMDPNetwork(STATES, ACTIONS, kit.tiny)
    weights = make_weights(network, generator, 2)
    z, actions = torch.randn((2, 4, 5, 3), generator=generator), torch.randn((2, 3, 5, 2), generator=generator)
    at_once = network.transitions(weights, z, actions)
    carry = network.first_carry(z[:, 0])
    for t in range(3):
        gaussian, carry = network.transition(weights, z[:, t], actions[:, t], carry)
        torch.testing.assert_close(gaussian.mean, at_once.mean[:, t])
        torch.testing.assert_close(gaussian.scale, at_once.scale[:, t])


def test_members_do_not_see_each_other(kit, generator):
    network = VAEMDPNetwork(STATES, ACTIONS, kit.tiny)
    weights, batch = make_weights(network, generator, 3), make_batch(generator, 3, 4, 5)
    noise = torch.randn((3, 5, 5, kit.tiny.latent), generator=generator)
    together = network.terms(weights, batch, noise).elbo()
    alone = network.terms({k: w[1:2] for k, w in weights.items()}, Batch(*(x[1:2] for x in batch)), noise[1:2]).elbo()
    torch.testing.assert_close(together[1:2], alone)


def test_adam_is_torchs_adam_with_a_norm_limit_for_each_member(generator):
    start = torch.randn((2, 30), generator=generator)
    ours, rates = start.clone(), torch.tensor([1e-2, 3e-3])
    adam = Adam(ours, rates, clip=1.0, decay=0.9)
    theirs = [torch.nn.Parameter(row.clone()) for row in start]
    optimizers = [torch.optim.Adam([p], lr=float(rate)) for p, rate in zip(theirs, rates, strict=True)]
    decays = [torch.optim.lr_scheduler.ExponentialLR(o, 0.9) for o in optimizers]
    for step in range(20):
        gradient = torch.randn((2, 30), generator=generator) * (0.01 if step % 2 else 3.0)
        adam.step(ours, gradient)
        for row, p, optimizer, decay in zip(gradient, theirs, optimizers, decays, strict=True):
            p.grad = row.clone()
            torch.nn.utils.clip_grad_norm_([p], 1.0)
            optimizer.step()
            decay.step()
    torch.testing.assert_close(ours, torch.stack([p.detach() for p in theirs]), rtol=1e-4, atol=1e-5)
