"""The settings of a torch loader."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from oat_gym._rng import check_seed
from oat_gym.errors import ConfigurationError

Kind = Literal["transitions", "windows", "episodes"]
Sampling = Literal["shuffle", "replacement", "sequential"]


@dataclass(frozen=True)
class LoaderConfig:
    """What a `TorchLoader` draws, and how; see `to_torch` for the fields.

    >>> LoaderConfig(kind="windows", batch_size=32, length=10).stride
    1
    """

    kind: Kind = "transitions"
    batch_size: int = 256
    sampling: Sampling = "shuffle"
    length: int | None = None
    stride: int | None = None
    real_fraction: float | None = None
    synthetic_weight: float | None = None
    drop_last: bool = False
    seed: int = 0

    def __post_init__(self) -> None:
        for name, choices in (("kind", get_args(Kind)), ("sampling", get_args(Sampling))):
            if getattr(self, name) not in choices:
                raise ConfigurationError(f"{name} must be one of {', '.join(choices)}, got {getattr(self, name)!r}.")
        check_count("batch_size", self.batch_size)
        check_seed(self.seed)
        self._check_windows()
        self._check_weights()

    def _check_windows(self) -> None:
        if self.kind != "windows":
            for name in ("length", "stride"):
                if getattr(self, name) is not None:
                    raise ConfigurationError(f"{name} belongs to kind='windows'; kind={self.kind!r} has none.")
            return
        if self.length is None:
            raise ConfigurationError("kind='windows' needs length=, the number of steps of a window.")
        check_count("length", self.length)
        if self.stride is None:
            object.__setattr__(self, "stride", 1)
            return
        check_count("stride", self.stride)
        if self.stride > self.length:
            raise ConfigurationError(
                f"stride={self.stride} over length={self.length} would leave steps out of windows."
            )

    def _check_weights(self) -> None:
        if self.real_fraction is None and self.synthetic_weight is None:
            return
        if self.real_fraction is not None and self.synthetic_weight is not None:
            raise ConfigurationError("Give real_fraction or synthetic_weight, not both: each settles the other.")
        if self.sampling != "replacement":
            raise ConfigurationError(
                f"real_fraction and synthetic_weight need sampling='replacement', got {self.sampling!r}: an epoch "
                "without replacement has every item once."
            )
        if self.real_fraction is not None and not (_is_number(self.real_fraction) and 0 <= self.real_fraction <= 1):
            raise ConfigurationError(f"real_fraction must be a number from 0 to 1, got {self.real_fraction!r}.")
        weight = self.synthetic_weight
        if weight is not None and not (_is_number(weight) and 0 <= weight < np.inf):
            raise ConfigurationError(f"synthetic_weight must be a finite number of at least 0, got {weight!r}.")


def check_count(name: str, value: object) -> None:
    """Raise `ConfigurationError` unless `value` is an integer of at least 1."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 1:
        raise ConfigurationError(f"{name} must be an integer of at least 1, got {value!r}.")


def _is_number(value: object) -> bool:
    return isinstance(value, int | float | np.number) and not isinstance(value, bool)
