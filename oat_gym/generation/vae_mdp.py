"""The VAE-MDP: a sequential variational autoencoder of state-action-reward spans (paper section 2.2, appendix A.2).

Latent states z_t form a Markov chain driven by actions; states and rewards are decoded from them:

    z_1 ~ N(0, I),  z_t ~ p(z_t | h_t) with h_t = f(h_{t-1}, z_{t-1}, a_{t-1}),
    s_t ~ p(s_t | z_t),  r_{t-1} ~ p(r_{t-1} | z_t)

A span of W steps has W+1 states here, so that its last step has its own next state and its own reward: in the
paper's indices the sums of Eq. 1 run to zeta + W.

Axes: K members (networks trained side by side), time, N sequences, features. Values are z-scores.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from oat_gym.generation._layers import Weights, linear, lstm_shapes, lstm_step, mlp, mlp_shapes
from oat_gym.generation.config import DISCRETE_WARMUP, VAEMDPConfig
from oat_gym.generation.distributions import (
    Gaussian,
    MixedHead,
    bernoulli_log_prob,
    gaussian_from,
    gaussian_kl,
)
from oat_gym.spaces import Layout

LATENT_FLOOR = 1e-3
"""Least scale of the latent Gaussians."""

REWARD_LAYOUT = Layout(1, (0,), ())
"""A reward is one real column."""


class Batch(NamedTuple):
    """Spans of W steps.

    Attributes:
        states: (K, W+1, N, state width).
        actions: (K, W, N, action width).
        rewards: (K, W, N, 1).
        mask: (K, W, N), 1 for recorded steps and 0 for padding after the end.
        terminal: (K, W, N), 1 for the step that ended the episode; read only by a network with an end head.
    """

    states: Tensor
    actions: Tensor
    rewards: Tensor
    mask: Tensor
    terminal: Tensor


class Terms(NamedTuple):
    """The terms of Eq. 1 for each sequence, (K, N) each, summed over recorded time steps."""

    states: Tensor
    rewards: Tensor
    end: Tensor
    kl: Tensor

    def elbo(self, kl_weight: float = 1.0) -> Tensor:
        """Return the evidence lower bound of each sequence, (K, N); Eq. 1 is minus its mean."""
        return self.states + self.rewards + self.end - kl_weight * self.kl


class Carry(NamedTuple):
    """What the decoder's LSTM takes from one step to the next: hidden and cell state, (K, N, nodes) each."""

    hidden: Tensor
    cell: Tensor


@dataclass(frozen=True)
class VAEMDPNetwork:
    """The functions of a VAE-MDP; the weights are arguments, so that K members run as one.

    Attributes:
        state_layout: columns of a state.
        action_layout: columns of an action.
        config: sizes and scale floor.
        ends: whether there is a Bernoulli head p(end | z).
    """

    state_layout: Layout
    action_layout: Layout
    config: VAEMDPConfig
    ends: bool = False

    @property
    def kl_warmup(self) -> int:
        """Updates over which the weight of the KL terms rises from 0 to 1 in training."""
        if self.config.kl_warmup is not None:
            return self.config.kl_warmup
        return DISCRETE_WARMUP if self.state_layout.categorical else 0

    @property
    def state_head(self) -> MixedHead:
        """The form of p(s_t | z_t)."""
        return MixedHead(self.state_layout, self.config.scale_floor)

    @property
    def reward_head(self) -> MixedHead:
        """The form of p(r_{t-1} | z_t)."""
        return MixedHead(REWARD_LAYOUT, self.config.scale_floor)

    @property
    def shapes(self) -> dict[str, tuple[int, int]]:
        """Shape of each weight of one member."""
        c, state, action = self.config, self.state_layout.width, self.action_layout.width
        shapes = mlp_shapes("encoder.start", state, c.encoder, 2 * c.latent)
        shapes |= lstm_shapes("encoder.lstm", c.latent + action + state, c.lstm)
        shapes |= mlp_shapes("encoder.dense", c.lstm, (c.dense,), 2 * c.latent)
        shapes |= lstm_shapes("decoder.lstm", c.latent + action, c.lstm)
        shapes |= mlp_shapes("decoder.dense", c.lstm, (c.dense,), 2 * c.latent)
        shapes |= mlp_shapes("decoder.state", c.latent, c.encoder, self.state_head.width)
        shapes |= mlp_shapes("decoder.reward", c.latent, c.encoder, self.reward_head.width)
        return shapes | (mlp_shapes("decoder.end", c.latent, c.encoder, 1) if self.ends else {})

    def start(self, weights: Weights, states: Tensor) -> Gaussian:
        """Return q(z_1 | s_1) for first states (K, N, width)."""
        return gaussian_from(mlp(weights, "encoder.start", states), LATENT_FLOOR)

    def infer(self, weights: Weights, states: Tensor, actions: Tensor, noise: Tensor) -> tuple[Tensor, Gaussian]:
        """Return latent states drawn from the encoder, and its distributions.

        q(z_t | z_{t-1}, a_{t-1}, s_t) with h_t = f(h_{t-1}, z_{t-1}, a_{t-1}, s_t), h_1 = 0 (appendix A.2).

        Args:
            weights: weights by name.
            states: (K, W+1, N, state width).
            actions: (K, W, N, action width).
            noise: (K, W+1, N, latent) standard normal draws; one sample is taken, reparameterised.

        Returns:
            z of shape (K, W+1, N, latent) and the Gaussian of the same shape that each came from.
        """
        latent = self.config.latent
        weight = weights["encoder.lstm.input.weight"]
        # What does not depend on z goes through the LSTM's input weights for all time steps at once.
        known = torch.cat((actions, states[:, 1:]), dim=-1)
        outside = {"known.weight": weight[:, latent:], "known.bias": weights["encoder.lstm.input.bias"]}
        inputs = linear(outside, "known", known).unbind(1)
        inner = torch.cat((weight[:, :latent], weights["encoder.lstm.hidden.weight"]), dim=1)
        q = self.start(weights, states[:, 0])
        z = q.mean + q.scale * noise[:, 0]
        hidden = cell = z.new_zeros((*z.shape[:-1], self.config.lstm))
        drawn, means, scales = [z], [q.mean], [q.scale]
        for step, eps in zip(inputs, noise.unbind(1)[1:], strict=True):
            gates = torch.baddbmm(step, torch.cat((z, hidden), dim=-1), inner)
            hidden, cell = lstm_step(gates, cell)
            q = gaussian_from(mlp(weights, "encoder.dense", hidden), LATENT_FLOOR)
            z = torch.addcmul(q.mean, q.scale, eps)
            drawn.append(z)
            means.append(q.mean)
            scales.append(q.scale)
        return torch.stack(drawn, 1), Gaussian(torch.stack(means, 1), torch.stack(scales, 1))

    def transitions(self, weights: Weights, z: Tensor, actions: Tensor) -> Gaussian:
        """Return p(z_t | z_{t-1}, a_{t-1}) for t = 2 to W+1, (K, W, N, latent), from z (K, W+1, N, latent)."""
        inputs = linear(weights, "decoder.lstm.input", torch.cat((z[:, :-1], actions), dim=-1))
        carry = self.first_carry(z[:, 0])
        hidden: list[Tensor] = []
        for step in inputs.unbind(1):
            carry = self._advance(weights, step, carry)
            hidden.append(carry.hidden)
        return gaussian_from(mlp(weights, "decoder.dense", torch.stack(hidden, 1)), LATENT_FLOOR)

    def first_carry(self, z: Tensor) -> Carry:
        """Return the decoder's carry before the first transition: zeros."""
        zeros = z.new_zeros((*z.shape[:-1], self.config.lstm))
        return Carry(zeros, zeros)

    def transition(self, weights: Weights, z: Tensor, action: Tensor, carry: Carry) -> tuple[Gaussian, Carry]:
        """Return p(z_t | z_{t-1}, a_{t-1}) and the new carry, for one step of a roll-out; z is (K, N, latent)."""
        carry = self._advance(weights, linear(weights, "decoder.lstm.input", torch.cat((z, action), dim=-1)), carry)
        return gaussian_from(mlp(weights, "decoder.dense", carry.hidden), LATENT_FLOOR), carry

    def terms(self, weights: Weights, batch: Batch, noise: Tensor) -> Terms:
        """Return the terms of the evidence lower bound (Eq. 1), estimated with one draw of z from the encoder.

        Args:
            weights: weights by name.
            batch: spans; what lies in padded steps has no effect but must be finite.
            noise: (K, W+1, N, latent) standard normal draws.
        """
        z, q = self.infer(weights, batch.states, batch.actions, noise)
        p = self.transitions(weights, z, batch.actions)
        prior = Gaussian(torch.zeros_like(q.mean[:, :1]), torch.ones_like(q.scale[:, :1]))
        kl = gaussian_kl(q, Gaussian(torch.cat((prior.mean, p.mean), 1), torch.cat((prior.scale, p.scale), 1)))
        state = self.state_head.log_prob(mlp(weights, "decoder.state", z), batch.states)
        reward = self.reward_head.log_prob(mlp(weights, "decoder.reward", z[:, 1:]), batch.rewards)
        end = torch.zeros_like(reward)
        if self.ends:
            end = bernoulli_log_prob(mlp(weights, "decoder.end", z[:, 1:]).squeeze(-1), batch.terminal)
        states_mask = torch.cat((torch.ones_like(batch.mask[:, :1]), batch.mask), 1)
        return Terms(
            states=(state * states_mask).sum(1),
            rewards=(reward * batch.mask).sum(1),
            end=(end * batch.mask).sum(1),
            kl=(kl * states_mask).sum(1),
        )

    def _advance(self, weights: Weights, inputs: Tensor, carry: Carry) -> Carry:
        gates = torch.baddbmm(inputs, carry.hidden, weights["decoder.lstm.hidden.weight"])
        return Carry(*lstm_step(gates, carry.cell))
