"""Behaviour cloning: its settings, and maximum likelihood for several policies side by side."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from oat_gym._rng import torch_generator
from oat_gym.errors import ConfigurationError, TrainingError
from oat_gym.generation._layers import Adam, initial_weights, mlp, mlp_shapes, one_thread, unpack
from oat_gym.generation._tracker import BestTracker
from oat_gym.generation.config import check_hidden, check_integer, check_number
from oat_gym.generation.sequences import hold_out
from oat_gym.ope._densities import ActionHead
from oat_gym.progress import ProgressCallback

DENSITIES = ("auto", "gaussian", "censored", "tanh-gaussian", "mixture", "categorical")
_CHUNK = 1024  # rows of a network that are evaluated at a time: what is between the layers then stays in caches


@dataclass(frozen=True)
class BehaviorCloning:
    """Estimate the policy that recorded the data, by maximum likelihood with a held-out early stop.

    **Cross-fitting.** The real episodes are split into `folds` parts; the log-probability of a step comes from a
    network that saw neither its episode nor anything made from it. In-sample log-probabilities are too high, and
    importance ratios that use them too low.

    **Density.** Importance ratios compare a target policy with beta, so both must be densities of one kind.

    - `"gaussian"`: diagonal Gaussian of the action as recorded. Right where the data records what the policy chose
      before the environment clipped it (entries beyond the bounds tell), beside a target policy with a density.
    - `"tanh-gaussian"`: tanh of a Gaussian, inside the bounds, as DOPE has it: entries are read as no closer to a bound
      than 1e-4 of half the range, log standard deviations stay in [-5, 2]. For bounded actions; it has a density for
      clipped data too, though no density is right for entries that sit on a bound.
    - `"censored"`: a Gaussian that is clipped; entries on a bound have the probability that clipping puts there. The
      right one for actions that were recorded after clipping, *if the target policies count the same way*
      (`GaussianPolicy(..., censored=True)`, `load_dope_policies(..., censored=True)`).
    - `"mixture"`: `components` diagonal Gaussians, for demonstrations of several kinds.
    - `"categorical"`: for actions without real columns (Discrete, MultiDiscrete, MultiBinary).
    - `"auto"`: categorical without real columns; in `evaluate`, censored where every target policy counts that way;
      else the tanh-Gaussian where every real column is bounded and more than 0.1% of the entries sit exactly on a
      bound; else the Gaussian. What was chosen is in `BehaviorFit.density`.

    Discrete parts of mixed actions are categoricals in all of them.

    Attributes:
        density: see above.
        components: number of Gaussians of a mixture.
        folds: parts of the cross-fitting, at most as many as there are real episodes; 1: none, every network sees
            everything (DOPE's way).
        hidden: hidden layers (ReLU).
        learning_rate: Adam's learning rate.
        batch_size: steps in a minibatch.
        max_updates: most minibatch updates.
        patience: stop after so many updates without a better log-likelihood on held-out episodes; the best weights
            are kept.
        evaluate_every: updates between two looks at it.
        validation: share of a network's episodes that the early stop holds out.
        gradient_clip: largest norm of the gradient.
        scale_floor: least scale of a Gaussian, in standard deviations of the recorded actions.

    Raises:
        ConfigurationError: if a value is out of its range.

    >>> BehaviorCloning(density="mixture", components=3).folds
    5
    """

    density: Literal["auto", "gaussian", "censored", "tanh-gaussian", "mixture", "categorical"] = "auto"
    components: int = 5
    folds: int = 5
    hidden: tuple[int, ...] = (256, 256)
    learning_rate: float = 1e-3
    batch_size: int = 256
    max_updates: int = 2000
    patience: int = 300
    evaluate_every: int = 50
    validation: float = 0.1
    gradient_clip: float = 10.0
    scale_floor: float = 0.01

    def __post_init__(self) -> None:
        if self.density not in DENSITIES:
            raise ConfigurationError(f"density must be one of {', '.join(DENSITIES)}, got {self.density!r}.")
        for name in ("components", "folds", "batch_size", "max_updates", "patience", "evaluate_every"):
            check_integer(name, getattr(self, name), at_least=1)
        check_hidden("hidden", self.hidden)
        check_number("learning_rate", self.learning_rate, above=0.0)
        check_number("validation", self.validation, at_least=0.0, below=1.0)
        check_number("gradient_clip", self.gradient_clip, above=0.0)
        check_number("scale_floor", self.scale_floor, above=0.0)


@dataclass(frozen=True)
class Member:
    """What one network may learn from: its name, its rows (m,), the real episodes they go back to (m,), its stream."""

    name: str
    rows: npt.NDArray[np.int64]
    units: npt.NDArray[np.int64]
    rng: np.random.Generator


@dataclass(frozen=True)
class Networks:
    """K networks: weights (K, P), standardisation of the states (K, 1, D), and what the outputs mean."""

    weights: Tensor
    hidden: tuple[int, ...]
    center: Tensor
    scale: Tensor
    head: ActionHead

    @property
    def shapes(self) -> dict[str, tuple[int, int]]:
        """Shapes of one network's weights."""
        return mlp_shapes("policy", self.center.shape[-1], self.hidden, self.head.width)

    def member(self, number: int) -> Networks:
        """Return one network."""
        part = slice(number, number + 1)
        weights, center, scale = (x[part].clone() for x in (self.weights, self.center, self.scale))
        return Networks(weights, self.hidden, center, scale, self.head.member(number))

    def output(self, states: Tensor, weights: Tensor | None = None) -> Tensor:
        """Return outputs (K, m, outputs) for states (K, m, D) or (1, m, D)."""
        flat = self.weights if weights is None else weights
        return mlp(unpack(flat, self.shapes), "policy", (states - self.center) / self.scale)

    def log_prob(self, states: Tensor, actions: Tensor) -> npt.NDArray[np.float64]:
        """Return the log-likelihood (m,) of actions (m, A) in states (m, D) under the one network there is."""
        pairs = zip(states.split(_CHUNK), actions.split(_CHUNK), strict=True)
        with one_thread(), torch.no_grad():
            parts = [self.head.log_prob(self.output(some[None]), taken[None])[0] for some, taken in pairs]
        return torch.cat(parts).cpu().numpy().astype(np.float64)


def train(
    networks: Networks,
    states: Tensor,
    actions: Tensor,
    *,
    members: Sequence[Member],
    config: BehaviorCloning,
    progress: ProgressCallback,
) -> Networks:
    """Return the fitted networks; one member's result does not depend on the data of the others.

    Args:
        networks: one for each member, without weights.
        states: (n, D) float32.
        actions: (n, A) float32.
        members: what each may learn from.
        config: settings.
        progress: called as progress(description, done, total).

    Raises:
        TrainingError: if a network diverges; the message names it.
    """
    names = [f"Behaviour cloning, {member.name}" for member in members]
    held = [hold_out(m.units, share=config.validation, rng=m.rng, name=n) for m, n in zip(members, names, strict=True)]
    rows = _batches(members, held, config.batch_size)
    tested, share = _held_out(members, held)
    first = [initial_weights(networks.shapes, torch_generator(member.rng)) for member in members]
    flat = torch.stack(first).to(states.device)
    adam = Adam(
        flat, torch.full((len(members),), config.learning_rate, device=states.device), clip=config.gradient_clip
    )
    tracker = BestTracker(len(members), patience=config.patience)
    share = share.to(states.device)

    def score(flat: Tensor, rows: Tensor) -> Tensor:
        return networks.head.log_prob(networks.output(states[rows], flat), actions[rows])

    with one_thread():
        for update in range(1, config.max_updates + 1):
            flat = flat.detach().requires_grad_()
            likelihood = score(flat, next(rows)).mean(1)
            gradient = torch.autograd.grad(-likelihood.sum(), flat)[0]
            flat = flat.detach()
            adam.step(flat, gradient)
            if update % config.evaluate_every and update < config.max_updates:
                continue
            with torch.no_grad():
                scores = torch.cat([score(flat, some) for some in tested.split(_CHUNK, dim=1)], dim=1)
            held_out = (scores * share).sum(1)
            tracker.look(update, likelihood, held_out, flat)
            _check_finite(tracker, names, update)
            progress("cloning the behaviour policy", update, config.max_updates)
            if tracker.all_stopped:
                break
    progress("cloning the behaviour policy", config.max_updates, config.max_updates)
    return Networks(tracker.weights, networks.hidden, networks.center, networks.scale, networks.head)


def _check_finite(tracker: BestTracker, names: list[str], update: int) -> None:
    if not bool(tracker.finite.all()):
        lost = ", ".join(name for name, finite in zip(names, tracker.finite.tolist(), strict=True) if not finite)
        raise TrainingError(f"{lost}: training diverged after {update} updates. Lower learning_rate.")


def _batches(members: Sequence[Member], held: Sequence[npt.NDArray[np.bool_]], batch_size: int) -> Iterator[Tensor]:
    """Yield rows (K, batch size) without end; each member goes through its own rows in random orders."""
    queues = [member.rows[:0] for member in members]
    while True:
        batch: list[npt.NDArray[np.int64]] = []
        for number, (member, out) in enumerate(zip(members, held, strict=True)):
            while len(queues[number]) < batch_size:
                queues[number] = np.concatenate((queues[number], member.rng.permutation(member.rows[~out])))
            batch.append(queues[number][:batch_size])
            queues[number] = queues[number][batch_size:]
        yield torch.from_numpy(np.stack(batch))


def _held_out(members: Sequence[Member], held: Sequence[npt.NDArray[np.bool_]]) -> tuple[Tensor, Tensor]:
    """Return rows (K, m) that decide the early stop, padded, and their weights (K, m), which sum to 1.

    They are the held-out ones, or all where none are held out.
    """
    rows = [member.rows[out] if out.any() else member.rows for member, out in zip(members, held, strict=True)]
    longest = max(len(some) for some in rows)
    padded = np.stack([np.pad(some, (0, longest - len(some)), mode="edge") for some in rows])
    share = np.stack([np.pad(np.full(len(some), 1 / len(some)), (0, longest - len(some))) for some in rows])
    return torch.from_numpy(padded), torch.from_numpy(share.astype(np.float32))
