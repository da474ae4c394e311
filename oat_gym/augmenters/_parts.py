"""What the augmenters made of other augmenters share: validation, seeds, arrays under prefixes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from oat_gym._rng import derive
from oat_gym.augmenters.base import Augmenter
from oat_gym.cache import Arrays
from oat_gym.errors import ConfigurationError


def check_parts(name: str, parts: object) -> None:
    """Raise `ConfigurationError` unless `parts` is a tuple of at least one augmenter."""
    if not isinstance(parts, tuple):
        raise ConfigurationError(f"{name} takes a tuple of augmenters, got {parts!r}.")
    if not parts:
        raise ConfigurationError(f"{name} takes at least one augmenter, got an empty tuple.")
    for part in parts:
        if not isinstance(part, Augmenter):
            raise ConfigurationError(f"{name} takes instances of oat_gym.Augmenter such as OAT(), got {part!r}.")


def part_seed(seed: int, name: str, number: int) -> int:
    """Return the seed of a part: that of the whole for the first one, so that a whole of one part is that part."""
    return int(derive(seed, name, number).integers(2**63)) if number else seed


def methods_in(augmenter: Augmenter) -> Iterator[Augmenter]:
    """Yield an augmenter and all those that it is made of.

    >>> from oat_gym import OAT, Compose
    >>> [method.name for method in methods_in(Compose((OAT(), OAT())))]
    ['compose', 'oat', 'oat']
    """
    yield augmenter
    for part in getattr(augmenter, "augmenters", ()):
        yield from methods_in(part)


def joined_failures(parts: Sequence[Augmenter]) -> Mapping[str, str]:
    """Return what any part is expected to fail, which the whole may fail, with the name of the first part with it."""
    failures: dict[str, str] = {}
    for part in parts:
        for check, reason in part.expected_failures.items():
            failures.setdefault(check, f"{part.name}: {reason}")
    return failures


def zero_strengths(parts: Sequence[Augmenter]) -> tuple[Augmenter, ...] | None:
    """Return the parts at zero strength; None where one of them has no such."""
    zeros = [zero for part in parts if (zero := part.at_zero_strength) is not None]
    return tuple(zeros) if len(zeros) == len(parts) else None


def with_prefix(prefix: str, arrays: Arrays) -> Arrays:
    """Return the arrays with `prefix` before their names."""
    return {prefix + name: array for name, array in arrays.items()}


def under_prefix(prefix: str, arrays: Arrays) -> Arrays:
    """Return the arrays whose names begin with `prefix`, without it."""
    return {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}
