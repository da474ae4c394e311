"""Behaviour cloning: the policy beta(a|s) that recorded the data, by maximum likelihood."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from oat_gym._rng import torch_generator
from oat_gym.errors import InvalidDataError, TrainingError
from oat_gym.generation._layers import Adam, initial_weights, mlp, mlp_shapes, one_thread, unpack
from oat_gym.generation._tracker import BestTracker
from oat_gym.generation.config import BehaviorConfig
from oat_gym.generation.distributions import Gaussian, MixedHead, censored_log_prob, gaussian_log_prob, noise_like
from oat_gym.generation.limits import Bounds
from oat_gym.generation.normalizer import Normalizer, layout_from_arrays, layout_to_arrays
from oat_gym.generation.sequences import hold_out
from oat_gym.spaces import FloatMatrix, Layout

_logger = logging.getLogger(__name__)
FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class PolicyHead:
    """The distribution of an action in its own units: a `MixedHead` in z-scored units, perhaps censored.

    Attributes:
        mixed: the distribution in z-scored units.
        normalizer: of the actions.
        bounds: see `BehaviorModel`.
    """

    mixed: MixedHead
    normalizer: Normalizer
    bounds: Bounds | None

    def gaussian(self, output: Tensor) -> Gaussian:
        """Return the Gaussian of the real action columns, before clipping."""
        mean, scale = self._tensors((self.normalizer.mean, self.normalizer.scale), output.device)
        gaussian = self.mixed.gaussian(output)
        return Gaussian(gaussian.mean * scale + mean, gaussian.scale * scale)

    def log_prob(self, output: Tensor, actions: Tensor) -> Tensor:
        """Return the log-likelihood (...) of actions (..., width) under a network's output."""
        total = self.mixed.categorical_log_prob(output, actions)
        if not self.mixed.layout.continuous:
            return total
        gaussian, values = self.gaussian(output), self.mixed.continuous(actions)
        if self.bounds is None:
            return total + gaussian_log_prob(gaussian, values).sum(-1)
        return total + censored_log_prob(gaussian, values, *self._tensors(self.bounds, output.device)).sum(-1)

    def sample(self, output: Tensor, generator: torch.Generator) -> FloatMatrix:
        """Return actions (n, width) drawn for outputs (n, outputs), clipped to the bounds."""
        layout = self.mixed.layout
        actions = np.zeros((len(output), layout.width))
        if layout.continuous:
            mean, scale = self.gaussian(output)
            actions[:, list(layout.continuous)] = (mean + scale * noise_like(mean, generator)).cpu().numpy()
        if layout.categorical:
            columns = [column for start, stop in layout.categorical for column in range(start, stop)]
            actions[:, columns] = self.mixed.sample_categories(output, generator).cpu().numpy()
        return actions if self.bounds is None else np.clip(actions, *self.bounds)

    def _tensors(self, arrays: tuple[FloatArray, FloatArray], device: torch.device) -> tuple[Tensor, Tensor]:
        columns = list(self.mixed.layout.continuous)
        first, second = (torch.from_numpy(array[columns].astype(np.float32)).to(device) for array in arrays)
        return first, second


@dataclass(frozen=True)
class BehaviorModel:
    """A cloned policy on flat features: diagonal Gaussian for real action columns, categorical for one-hot blocks.

    Mean and scale depend on the state. With `bounds`, an action is a Gaussian that the environment clips: entries on
    a bound carry the probability mass that clipping puts there (a plain density is wrong for them, and human or
    expert actions often sit on a bound or exceed it). Without bounds, the density is the plain Gaussian one.

    Attributes:
        state_layout: columns of a state.
        action_layout: columns of an action.
        config: architecture.
        weights: weights by name, with a leading axis of one.
        states: normaliser of the states.
        actions: normaliser of the actions.
        bounds: (low, high) of the action columns, or `None`.
        held_out: log-likelihood of a held-out transition, in the actions' units; NaN if none was held out.
    """

    state_layout: Layout
    action_layout: Layout
    config: BehaviorConfig
    weights: Mapping[str, Tensor]
    states: Normalizer
    actions: Normalizer
    bounds: Bounds | None
    held_out: float

    def sample(self, observations: npt.NDArray[np.floating[Any]], *, rng: np.random.Generator) -> FloatMatrix:
        """Return one action (n, action width) for each observation (n, state width), clipped to the bounds."""
        with one_thread(), torch.no_grad():
            return self.head.sample(self._output(observations)[0], torch_generator(rng))

    def log_prob(
        self, observations: npt.NDArray[np.floating[Any]], actions: npt.NDArray[np.floating[Any]]
    ) -> FloatArray:
        """Return log beta(a|s), shape (n,), in the actions' own units."""
        with one_thread(), torch.no_grad():
            values = torch.from_numpy(np.asarray(actions, dtype=np.float32))[None].to(self.config.device)
            return self.head.log_prob(self._output(observations), values)[0].cpu().numpy().astype(np.float64)

    def to_arrays(self) -> dict[str, npt.NDArray[Any]]:
        """Return everything but the configuration as named arrays, to store without pickle."""
        arrays = {f"weight.{name}": weight.detach().cpu().numpy().copy() for name, weight in self.weights.items()}
        arrays |= self.states.to_arrays("normalizer.state") | self.actions.to_arrays("normalizer.action")
        arrays |= layout_to_arrays(self.state_layout, "layout.state")
        arrays |= layout_to_arrays(self.action_layout, "layout.action")
        arrays |= {} if self.bounds is None else {"bounds": np.stack(self.bounds)}
        return arrays | {"held_out": np.array([self.held_out])}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, npt.NDArray[Any]], *, config: BehaviorConfig) -> BehaviorModel:
        """Return the model whose arrays `to_arrays` gave; it samples the same bytes."""
        state_layout = layout_from_arrays(arrays, "layout.state")
        action_layout = layout_from_arrays(arrays, "layout.action")
        shapes = _shapes(state_layout, action_layout, config)
        return cls(
            state_layout=state_layout,
            action_layout=action_layout,
            config=config,
            weights={name: torch.tensor(arrays[f"weight.{name}"], device=config.device) for name in shapes},
            states=Normalizer.from_arrays(arrays, "normalizer.state"),
            actions=Normalizer.from_arrays(arrays, "normalizer.action"),
            bounds=(np.array(arrays["bounds"][0]), np.array(arrays["bounds"][1])) if "bounds" in arrays else None,
            held_out=float(arrays["held_out"][0]),
        )

    @property
    def head(self) -> PolicyHead:
        """The form of beta(a|s)."""
        return PolicyHead(MixedHead(self.action_layout, self.config.scale_floor), self.actions, self.bounds)

    def _output(self, observations: npt.NDArray[np.floating[Any]]) -> Tensor:
        scores = torch.from_numpy(self.states.normalize(observations).astype(np.float32))
        return mlp(self.weights, "policy", scores[None].to(self.config.device))


def fit_behavior(
    states: npt.NDArray[np.floating[Any]],
    actions: npt.NDArray[np.floating[Any]],
    *,
    state_layout: Layout,
    action_layout: Layout,
    config: BehaviorConfig,
    rng: np.random.Generator,
    groups: npt.NDArray[np.integer[Any]] | None = None,
    bounds: Bounds | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> BehaviorModel:
    """Clone the behaviour policy from all transitions of the source, with an early stop on held-out episodes.

    Args:
        states: (n, state width) flat features of the states in which actions were taken.
        actions: (n, action width) the actions.
        state_layout: columns of a state.
        action_layout: columns of an action.
        config: architecture and training.
        rng: source of all randomness.
        groups: (n,) episode of each transition; episodes are held out whole. `None`: single transitions are.
        bounds: (low, high) of the action columns, infinite where there are none: see `BehaviorModel`.
        progress: called as progress(description, done, total).

    Raises:
        InvalidDataError: if shapes do not agree.
        TrainingError: if the data is not finite, or training diverges.

    >>> rng = np.random.default_rng(0)
    >>> states = rng.normal(size=(200, 1))
    >>> one = Layout(1, (0,), ())
    >>> config = BehaviorConfig(max_updates=50)
    >>> model = fit_behavior(states, 2 * states, state_layout=one, action_layout=one, config=config, rng=rng)
    >>> model.sample(states[:5], rng=rng).shape
    (5, 1)
    """
    ids = np.arange(len(states)) if groups is None else groups
    _check(states, actions, ids, state_layout, action_layout)
    held = hold_out(ids, share=config.validation, rng=rng, name="The behaviour data")
    generator = torch_generator(rng)
    model = _untrained(states, actions, state_layout=state_layout, action_layout=action_layout, config=config)
    model = replace(model, bounds=None if bounds is None else (bounds[0].copy(), bounds[1].copy()))
    shapes = _shapes(state_layout, action_layout, config)
    with one_thread():
        flat = initial_weights(shapes, generator)[None].to(config.device)
        tracker = _train(model, flat, states, actions, held=held, rng=rng, progress=progress)
    weights = {name: weight.clone() for name, weight in unpack(tracker.weights, shapes).items()}
    score = float(tracker.score[0]) if held.any() else np.nan
    _logger.info("Behaviour policy: log-likelihood of a held-out transition %.3f.", score)
    return replace(model, weights=weights, held_out=score)


def _untrained(
    states: npt.NDArray[np.floating[Any]],
    actions: npt.NDArray[np.floating[Any]],
    *,
    state_layout: Layout,
    action_layout: Layout,
    config: BehaviorConfig,
) -> BehaviorModel:
    """Return a model without weights or bounds, whose normalisers fit the data."""
    return BehaviorModel(
        state_layout=state_layout,
        action_layout=action_layout,
        config=config,
        weights={},
        states=Normalizer.fit(np.asarray(states, np.float64), state_layout),
        actions=Normalizer.fit(np.asarray(actions, np.float64), action_layout),
        bounds=None,
        held_out=np.nan,
    )


def _train(
    model: BehaviorModel,
    flat: Tensor,
    raw_states: npt.NDArray[np.floating[Any]],
    raw_actions: npt.NDArray[np.floating[Any]],
    *,
    held: npt.NDArray[np.bool_],
    rng: np.random.Generator,
    progress: Callable[[str, int, int], None] | None,
) -> BestTracker:
    config, head = model.config, model.head
    shapes = _shapes(model.state_layout, model.action_layout, config)
    states = torch.from_numpy(model.states.normalize(raw_states).astype(np.float32)).to(config.device)
    actions = torch.from_numpy(np.asarray(raw_actions, dtype=np.float32)).to(config.device)
    train, tested = np.flatnonzero(~held), torch.from_numpy(np.flatnonzero(held))
    adam = Adam(flat, torch.tensor([config.learning_rate], device=config.device), clip=config.gradient_clip)
    tracker, queue, recent = BestTracker(1, patience=config.patience), train[:0], list[Tensor]()

    def score(flat: Tensor, rows: Tensor) -> Tensor:
        output = mlp(unpack(flat, shapes), "policy", states[rows][None])
        return head.log_prob(output, actions[rows][None]).mean(1)

    for update in range(1, config.max_updates + 1):
        if len(queue) < min(config.batch_size, len(train)):
            queue = np.concatenate((queue, rng.permutation(train)))
        rows, queue = torch.from_numpy(queue[: config.batch_size]), queue[config.batch_size :]
        flat = flat.detach().requires_grad_()
        likelihood = score(flat, rows)
        gradient = torch.autograd.grad(-likelihood.sum(), flat)[0]
        flat = flat.detach()
        adam.step(flat, gradient)
        recent.append(likelihood.detach())
        if update % config.evaluate_every and update < config.max_updates:
            continue
        mean = torch.stack(recent).mean(0)
        recent = []
        with torch.no_grad():
            tracker.look(update, mean, score(flat, tested) if len(tested) else mean, flat)
        if not bool(tracker.finite.all()):
            raise TrainingError(f"The behaviour policy: training diverged after {update} updates. Lower learning_rate.")
        if progress is not None:
            progress("cloning the behaviour policy", update, config.max_updates)
        if tracker.all_stopped:
            break
    if progress is not None:
        progress("cloning the behaviour policy", config.max_updates, config.max_updates)
    return tracker


def _shapes(state_layout: Layout, action_layout: Layout, config: BehaviorConfig) -> dict[str, tuple[int, int]]:
    outputs = MixedHead(action_layout, config.scale_floor).width
    return mlp_shapes("policy", state_layout.width, config.hidden, outputs)


def _check(
    states: npt.NDArray[np.floating[Any]],
    actions: npt.NDArray[np.floating[Any]],
    groups: npt.NDArray[np.integer[Any]],
    state_layout: Layout,
    action_layout: Layout,
) -> None:
    shapes = {"states": (len(groups), state_layout.width), "actions": (len(groups), action_layout.width)}
    for (what, shape), values in zip(shapes.items(), (states, actions), strict=True):
        if values.shape != shape or len(values) == 0:
            raise InvalidDataError(f"Behaviour cloning: {what} must have shape {shape}, got {values.shape}.")
        if not np.isfinite(values).all():
            row = int(np.argwhere(~np.isfinite(values).all(axis=1))[0, 0])
            raise TrainingError(f"Behaviour cloning: {what} of transition {row} are not finite. Drop or fill them.")
