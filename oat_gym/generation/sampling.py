"""A trained VAE-MDP and its roll-outs (paper appendix A.2, the generative process)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from oat_gym._rng import torch_generator
from oat_gym.errors import ConfigurationError, InvalidDataError, TrainingError
from oat_gym.generation._layers import mlp, one_thread
from oat_gym.generation.config import VAEMDPConfig
from oat_gym.generation.distributions import noise_like
from oat_gym.generation.limits import Limits
from oat_gym.generation.normalizer import Normalizer, layout_from_arrays, layout_to_arrays
from oat_gym.generation.policy import ActionPolicy
from oat_gym.generation.vae_mdp import VAEMDPNetwork
from oat_gym.spaces import FloatMatrix, Layout

FloatArray = npt.NDArray[np.float64]


class History(NamedTuple):
    """How training went: three arrays with one entry for each look at the held-out part.

    `updates` made so far; `train` and `held_out` ELBO of a sequence, in z-scored units (nats). `held_out` is NaN
    throughout if nothing was held out.
    """

    updates: npt.NDArray[np.int64]
    train: FloatArray
    held_out: FloatArray


@dataclass(frozen=True)
class Samples:
    """Generated spans, in the data's units, one-hot blocks as one-hot.

    Attributes:
        states: (n, W+1, state width).
        actions: (n, W, action width).
        rewards: (n, W); `rewards[:, t]` comes with `states[:, t+1]`.
        log_prob: (n, W) log beta(a_t|s_t) under the policy of the roll-out; NaN if recorded actions were replayed
            without a policy.
        lengths: (n,) number of steps until the sampled end; W for a model without an end head. Steps behind it are
            to be cut off.
        end_logits: (n, W) logit of p(end|z_{t+1}), that the episode ends with step t; minus infinity for a model
            without an end head.
    """

    states: FloatArray
    actions: FloatArray
    rewards: FloatArray
    log_prob: FloatArray
    lengths: npt.NDArray[np.int64]
    end_logits: FloatArray


@dataclass(frozen=True)
class FittedVAEMDP:
    """A trained VAE-MDP. Made by `fit_vae_mdp` or `fit_many`; see there for an example.

    Attributes:
        network: architecture.
        weights: weights by name, with a leading axis of one.
        normalizers: of states, actions and rewards.
        limits: the training spans' range, widened by `config.range_margin`.
        steps: W.
        learning_rate: the one that was chosen.
        history: training and held-out ELBO.
        name: how messages call it.
    """

    network: VAEMDPNetwork
    weights: Mapping[str, Tensor]
    normalizers: tuple[Normalizer, Normalizer, Normalizer]
    limits: Limits
    steps: int
    learning_rate: float
    history: History
    name: str

    def sample(
        self,
        count: int,
        *,
        rng: np.random.Generator,
        policy: ActionPolicy | None = None,
        actions: npt.NDArray[np.floating[Any]] | None = None,
        start: Literal["prior", "posterior"] = "prior",
        start_states: npt.NDArray[np.floating[Any]] | None = None,
        limits: Limits | None = None,
        observation_noise: bool = True,
        steps: int | None = None,
    ) -> Samples:
        """Roll out `count` new spans: z_1, then s_t ~ p(s_t|z_t), a_t ~ beta(a_t|s_t), z_{t+1} ~ p(.|z_t, a_t), ...

        The same `rng` state and arguments give the same bytes on one machine; another `count` gives other noise.

        Args:
            count: number of spans n.
            rng: source of all randomness.
            policy: chooses actions from generated states. Its log-probability is kept with each sample.
            actions: (n, W, action width) recorded actions to replay instead; with a policy too, it only scores them.
            start: `"prior"`, z_1 ~ N(0, I) (the paper); or `"posterior"`, z_1 ~ q(z_1|s_1) of `start_states`.
            start_states: (n, state width), for `start="posterior"`.
            limits: generated real values are clipped to these; by default to the training spans' widened range. State
                columns and rewards that are constant in the training spans stay so in either case.
            observation_noise: draw states, rewards and ends from their distributions (the paper); if false, take
                means and most likely categories. Latent states and actions are drawn in either case.
            steps: roll out so many steps in place of W: the same as the first ones of a longer roll-out.

        Raises:
            ConfigurationError: if neither a policy nor actions are given, or `start` and `start_states` disagree.
            InvalidDataError: if an array's shape is wrong, or a policy returns wrong or non-finite actions.
            TrainingError: if a generated value is not finite; the message names the set.
        """
        steps = self.steps if steps is None else steps
        self._check_arguments(count, steps, policy=policy, actions=actions, start=start, start_states=start_states)
        generator = torch_generator(rng)
        with one_thread(), torch.no_grad():
            roll = _RollOut(
                self,
                generator if observation_noise else None,
                self.limits if limits is None else limits.holding(self.limits),
            )
            z = self._start(count, generator, start_states)
            carry = self.network.first_carry(z)
            states, chosen, rewards, scores, ends, logits = [roll.state(z)], [], [], [], [], []
            for step in range(steps):
                recorded = None if actions is None else actions[:, step]
                action, score = roll.action(states[-1], policy, recorded, rng)
                gaussian, carry = self.network.transition(self.weights, z, self._normalized(1, action), carry)
                z = gaussian.mean + gaussian.scale * noise_like(gaussian.mean, generator)
                states.append(roll.state(z))
                chosen.append(action)
                rewards.append(roll.reward(z))
                scores.append(score)
                logit = roll.end_logit(z)
                logits.append(logit.numpy().astype(np.float64))
                ends.append(roll.end(logit))
        return self._finished(states, chosen, rewards, scores, ends=ends, logits=logits)

    def to_arrays(self) -> dict[str, npt.NDArray[Any]]:
        """Return everything but the configuration and the name as named arrays, to store without pickle."""
        arrays = {f"weight.{name}": weight.detach().cpu().numpy().copy() for name, weight in self.weights.items()}
        for what, normalizer in zip(("state", "action", "reward"), self.normalizers, strict=True):
            arrays |= normalizer.to_arrays(f"normalizer.{what}")
        arrays |= layout_to_arrays(self.network.state_layout, "layout.state")
        arrays |= layout_to_arrays(self.network.action_layout, "layout.action")
        arrays |= self.limits.to_arrays("limits")
        arrays |= {f"history.{name}": np.array(values) for name, values in self.history._asdict().items()}
        return arrays | {"steps": np.array([self.steps]), "learning_rate": np.array([self.learning_rate])}

    @classmethod
    def from_arrays(
        cls, arrays: Mapping[str, npt.NDArray[Any]], *, config: VAEMDPConfig, name: str = "PST set 0"
    ) -> FittedVAEMDP:
        """Return the model whose arrays `to_arrays` gave; its samples are the same byte for byte."""
        state_layout, action_layout = (layout_from_arrays(arrays, f"layout.{what}") for what in ("state", "action"))
        weights = {
            key.removeprefix("weight."): torch.tensor(value, device=config.device)
            for key, value in arrays.items()
            if key.startswith("weight.")
        }
        network = VAEMDPNetwork(
            state_layout, action_layout, config, ends=any(key.startswith("decoder.end") for key in weights)
        )
        state, action, reward = (
            Normalizer.from_arrays(arrays, f"normalizer.{what}") for what in ("state", "action", "reward")
        )
        return cls(
            network=network,
            weights={key: weights[key] for key in network.shapes},
            normalizers=(state, action, reward),
            limits=Limits.from_arrays(arrays, "limits"),
            steps=int(arrays["steps"][0]),
            learning_rate=float(arrays["learning_rate"][0]),
            history=History(*(np.array(arrays[f"history.{what}"]) for what in ("updates", "train", "held_out"))),
            name=name,
        )

    def _start(
        self, count: int, generator: torch.Generator, start_states: npt.NDArray[np.floating[Any]] | None
    ) -> Tensor:
        """Return z_1, (1, n, latent)."""
        noise = torch.randn((1, count, self.network.config.latent), generator=generator, dtype=torch.float32)
        noise = noise.to(self.network.config.device)
        if start_states is None:
            return noise
        gaussian = self.network.start(self.weights, self._normalized(0, start_states))
        return gaussian.mean + gaussian.scale * noise

    def _normalized(self, part: int, values: npt.NDArray[np.floating[Any]]) -> Tensor:
        """Return (1, n, width) z-scores of states (part 0) or actions (part 1)."""
        scores = self.normalizers[part].normalize(values)
        return torch.from_numpy(scores.astype(np.float32))[None].to(self.network.config.device)

    def _check_arguments(
        self,
        count: int,
        steps: int,
        *,
        policy: ActionPolicy | None,
        actions: npt.NDArray[np.floating[Any]] | None,
        start: str,
        start_states: npt.NDArray[np.floating[Any]] | None,
    ) -> None:
        if count < 1:
            raise ConfigurationError(f"count must be at least 1, got {count}.")
        if not 1 <= steps <= self.steps:
            raise ConfigurationError(f"steps must be 1 to {self.steps}, as long as what was trained on; got {steps}.")
        if policy is None and actions is None:
            raise ConfigurationError("A roll-out needs a policy that chooses actions, or recorded actions to replay.")
        if start not in ("prior", "posterior") or (start == "posterior") != (start_states is not None):
            raise ConfigurationError(
                f'start must be "prior" without start_states or "posterior" with them, got {start!r} '
                f"{'without' if start_states is None else 'with'} start_states."
            )
        shapes = {
            "actions": (actions, (count, steps, self.network.action_layout.width)),
            "start_states": (start_states, (count, self.network.state_layout.width)),
        }
        for what, (values, shape) in shapes.items():
            if values is not None and (values.shape != shape or not np.isfinite(values).all()):
                raise InvalidDataError(f"{what} must be finite, of shape {shape}; got shape {values.shape}.")

    def _finished(
        self,
        states: list[FloatMatrix],
        actions: list[FloatMatrix],
        rewards: list[FloatArray],
        scores: list[FloatArray],
        *,
        ends: list[npt.NDArray[np.bool_]],
        logits: list[FloatArray],
    ) -> Samples:
        ended = np.stack(ends, axis=1)
        lengths = np.where(ended.any(axis=1), ended.argmax(axis=1) + 1, len(ends)).astype(np.int64)
        samples = Samples(
            states=np.stack(states, axis=1),
            actions=np.stack(actions, axis=1),
            rewards=np.stack(rewards, axis=1),
            log_prob=np.stack(scores, axis=1),
            lengths=lengths,
            end_logits=np.stack(logits, axis=1),
        )
        for what, values in (("state", samples.states), ("action", samples.actions), ("reward", samples.rewards)):
            if not np.isfinite(values).all():
                raise TrainingError(
                    f"{self.name}: a generated {what} is not finite, so the model is of no use. Train with a lower "
                    "learning_rate or gradient_clip, or look for outliers in the data."
                )
        return samples


@dataclass(frozen=True)
class _RollOut:
    """Draws the observable parts of one time step, in the data's units and within limits."""

    model: FittedVAEMDP
    generator: torch.Generator | None
    limits: Limits

    def state(self, z: Tensor) -> FloatMatrix:
        """Return s_t ~ p(s_t|z_t), (n, state width)."""
        network, weights = self.model.network, self.model.weights
        drawn = network.state_head.sample(mlp(weights, "decoder.state", z), self.generator)[0]
        values = self.model.normalizers[0].denormalize(drawn.cpu().numpy())
        return self.limits.clip_states(values, network.state_layout)

    def reward(self, z: Tensor) -> FloatArray:
        """Return r_{t-1} ~ p(r_{t-1}|z_t), (n,)."""
        output = mlp(self.model.weights, "decoder.reward", z)
        drawn = self.model.network.reward_head.sample(output, self.generator)[0]
        return np.clip(self.model.normalizers[2].denormalize(drawn.cpu().numpy())[:, 0], *self.limits.rewards)

    def end_logit(self, z: Tensor) -> Tensor:
        """Return the logit of p(end|z_t), (n,); minus infinity without an end head."""
        if not self.model.network.ends:
            return torch.full((z.shape[1],), -torch.inf)
        return mlp(self.model.weights, "decoder.end", z)[0, :, 0].cpu()

    def end(self, logit: Tensor) -> npt.NDArray[np.bool_]:
        """Return whether the episode ends here, (n,)."""
        if not self.model.network.ends:
            return np.zeros(len(logit), dtype=bool)
        probability = logit.sigmoid()
        if self.generator is None:
            return (probability > 0.5).numpy()
        return (torch.rand(probability.shape, generator=self.generator, dtype=torch.float32) < probability).numpy()

    def action(
        self,
        states: FloatMatrix,
        policy: ActionPolicy | None,
        recorded: npt.NDArray[np.floating[Any]] | None,
        rng: np.random.Generator,
    ) -> tuple[FloatMatrix, FloatArray]:
        """Return the actions taken in `states` and their log-probability; recorded ones are replayed unclipped."""
        layout: Layout = self.model.network.action_layout
        if recorded is not None:
            actions = np.array(recorded, dtype=np.float64)
        else:
            assert policy is not None  # checked by the caller
            chosen = np.asarray(policy.sample(states.copy(), rng=rng), dtype=np.float64)
            if chosen.shape != (len(states), layout.width) or not np.isfinite(chosen).all():
                raise InvalidDataError(
                    f"The policy must return finite actions of shape {(len(states), layout.width)} (flat features, "
                    f"discrete parts one-hot); got shape {chosen.shape}."
                )
            actions = self.limits.clip_actions(chosen, layout)
        if policy is None:
            return actions, np.full(len(states), np.nan)
        return actions, np.asarray(policy.log_prob(states.copy(), actions.copy()), dtype=np.float64)
