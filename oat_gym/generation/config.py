"""Settings of the VAE-MDP and of behaviour cloning (paper appendix B.2)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from oat_gym.errors import ConfigurationError

PAPER_LEARNING_RATES = (1e-4, 3e-4, 5e-4, 7e-4, 3e-3)
"""The grid of learning rates that the paper searches (appendix B.2)."""

DISCRETE_WARMUP = 100
"""Updates over which the KL terms come in by default, where states are discrete."""

MIN_GROUPS = 5
"""Fewest source episodes from which some are held out; below it nothing is, and a warning is logged."""


@dataclass(frozen=True)
class VAEMDPConfig:
    """Architecture and training of a VAE-MDP; sizes are the paper's (appendix B.2).

    Attributes:
        latent: dimension of z.
        encoder: hidden layers of q(z_1|s_1) and of the heads p(s|z), p(r|z), p(end|z).
        lstm: nodes of the LSTM layers of q(z_t|z_{t-1}, a_{t-1}, s_t) and p(z_t|z_{t-1}, a_{t-1}).
        dense: nodes of the dense layer after each LSTM.
        learning_rate: Adam's first learning rate.
        learning_rate_grid: train once for each rate and keep the best held-out ELBO; replaces `learning_rate`.
        lr_decay: factor on the learning rate after every update.
        batch_size: sequences in a minibatch.
        max_updates: most minibatch updates.
        patience: stop after so many updates without a better held-out ELBO, and go back to the best weights;
            `None` runs all updates and keeps the last weights.
        evaluate_every: updates between two looks at the held-out ELBO.
        validation: share of the source episodes (groups) held out; at least one. With fewer than `MIN_GROUPS`
            groups nothing is held out, the training ELBO decides, and a warning is logged.
        gradient_clip: largest norm of the gradient of the loss (negative ELBO for each time step).
        scale_floor: least scale of the Gaussian heads, in standard deviations of the data.
        kl_warmup: updates over which the weight of the KL terms rises from 0 to 1; 0 is Eq. 1 from the start. `None`:
            `DISCRETE_WARMUP` where states have one-hot columns, since the latent states of discrete data
            otherwise collapse to the prior and forget the actions; 0 where they have none.
        range_margin: generated values may leave the data's range by this share of it.
        device: torch device to train and sample on.

    Raises:
        ConfigurationError: if a value is out of its range.

    >>> VAEMDPConfig.from_preset("paper").max_updates
    100
    """

    latent: int = 16
    encoder: tuple[int, ...] = (128, 64)
    lstm: int = 64
    dense: int = 64
    learning_rate: float = 3e-3
    learning_rate_grid: tuple[float, ...] | None = None
    lr_decay: float = 0.997
    batch_size: int = 32
    max_updates: int = 1000
    patience: int | None = 200
    evaluate_every: int = 20
    validation: float = 0.2
    gradient_clip: float = 10.0
    scale_floor: float = 0.05
    kl_warmup: int | None = None
    range_margin: float = 0.1
    device: str = "cpu"

    def __post_init__(self) -> None:
        for name in ("latent", "lstm", "dense", "batch_size", "max_updates", "evaluate_every"):
            check_integer(name, getattr(self, name), at_least=1)
        if self.kl_warmup is not None:
            check_integer("kl_warmup", self.kl_warmup, at_least=0)
        check_hidden("encoder", self.encoder)
        if self.patience is not None:
            check_integer("patience", self.patience, at_least=1)
        for rate in self.learning_rates:
            check_number("learning_rate", rate, above=0.0)
        if self.learning_rate_grid is not None and not self.learning_rate_grid:
            raise ConfigurationError("learning_rate_grid is empty; give at least one rate, or None.")
        check_number("lr_decay", self.lr_decay, above=0.0, at_most=1.0)
        check_number("validation", self.validation, at_least=0.0, below=1.0)
        check_number("gradient_clip", self.gradient_clip, above=0.0)
        check_number("scale_floor", self.scale_floor, above=0.0)
        check_number("range_margin", self.range_margin, at_least=0.0)

    @property
    def learning_rates(self) -> tuple[float, ...]:
        """The learning rates that are tried."""
        return (self.learning_rate,) if self.learning_rate_grid is None else self.learning_rate_grid

    @classmethod
    def from_preset(cls, preset: Literal["default", "paper"]) -> VAEMDPConfig:
        """Return a named configuration.

        `"paper"`: 100 updates of 4 sequences, the learning rate from a grid by held-out ELBO, no early stopping
        (appendix B.2, Adroit). `"default"`: trains until the held-out ELBO stops rising.

        Raises:
            ConfigurationError: for any other name.
        """
        if preset == "default":
            return cls()
        if preset == "paper":
            return cls(
                learning_rate_grid=PAPER_LEARNING_RATES, batch_size=4, max_updates=100, patience=None, kl_warmup=0
            )
        raise ConfigurationError(f'preset must be "default" or "paper", got {preset!r}.')


@dataclass(frozen=True)
class BehaviorConfig:
    """Behaviour cloning: a network for beta(a|s) fitted by maximum likelihood with a held-out early stop.

    Attributes:
        hidden: hidden layers (ReLU).
        learning_rate: Adam's learning rate.
        batch_size: transitions in a minibatch.
        max_updates: most minibatch updates.
        patience: stop after so many updates without a better held-out log-likelihood; the best weights are kept.
        evaluate_every: updates between two looks at the held-out log-likelihood.
        validation: share of the episodes (groups) held out; see `VAEMDPConfig.validation`.
        gradient_clip: largest norm of the gradient.
        scale_floor: least scale of a Gaussian action, in standard deviations of the recorded actions.
        device: torch device.

    Raises:
        ConfigurationError: if a value is out of its range.
    """

    hidden: tuple[int, ...] = (128, 64)
    learning_rate: float = 1e-3
    batch_size: int = 256
    max_updates: int = 3000
    patience: int = 500
    evaluate_every: int = 50
    validation: float = 0.1
    gradient_clip: float = 10.0
    scale_floor: float = 0.01
    device: str = "cpu"

    def __post_init__(self) -> None:
        for name in ("batch_size", "max_updates", "patience", "evaluate_every"):
            check_integer(name, getattr(self, name), at_least=1)
        check_hidden("hidden", self.hidden)
        check_number("learning_rate", self.learning_rate, above=0.0)
        check_number("validation", self.validation, at_least=0.0, below=1.0)
        check_number("gradient_clip", self.gradient_clip, above=0.0)
        check_number("scale_floor", self.scale_floor, above=0.0)


def check_integer(name: str, value: object, *, at_least: int) -> None:
    """Raise `ConfigurationError` unless `value` is an integer of at least `at_least`."""
    if isinstance(value, bool) or not isinstance(value, int) or value < at_least:
        raise ConfigurationError(f"{name} must be an integer of at least {at_least}, got {value!r}.")


def check_hidden(name: str, sizes: object) -> None:
    """Raise `ConfigurationError` unless `sizes` is a tuple of one or more positive integers."""
    if not isinstance(sizes, tuple) or not sizes:
        raise ConfigurationError(f"{name} must be a tuple of one or more layer sizes, got {sizes!r}.")
    for size in sizes:
        check_integer(f"each size in {name}", size, at_least=1)


def check_number(
    name: str,
    value: float,
    *,
    above: float | None = None,
    at_least: float | None = None,
    below: float | None = None,
    at_most: float | None = None,
) -> None:
    """Raise `ConfigurationError` unless `value` lies inside the given limits (NaN lies inside none)."""
    inside = (
        (above is None or value > above)
        and (at_least is None or value >= at_least)
        and (below is None or value < below)
        and (at_most is None or value <= at_most)
    )
    if not inside or not math.isfinite(value):
        limits = {"above": above, "at least": at_least, "below": below, "at most": at_most}
        wanted = " and ".join(f"{word} {limit:g}" for word, limit in limits.items() if limit is not None)
        raise ConfigurationError(f"{name} must be a finite number {wanted}, got {value!r}.")
