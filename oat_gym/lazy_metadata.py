"""Episode metadata whose provenance is made when it is first looked at.

The length of a synthetic episode is known before anything is trained, and Minari asks its metadata for it: a split, or
an augmented dataset that is augmented again, must not train only to count steps.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any


class LazyMetadata(dict[str, Any]):
    """A dictionary that holds `known` at once and what `rest()` gives as soon as anything else is asked of it.

    >>> metadata = LazyMetadata({"total_steps": 3}, lambda: {"synthetic": True})
    >>> metadata["total_steps"], metadata.is_complete, metadata["synthetic"], metadata.is_complete
    (3, False, True, True)
    """

    def __init__(self, known: Mapping[str, Any], rest: Callable[[], Mapping[str, Any]]) -> None:
        super().__init__(known)
        self._rest: Callable[[], Mapping[str, Any]] | None = rest

    @property
    def is_complete(self) -> bool:
        """Whether `rest` was called."""
        return self._rest is None

    def known_items(self) -> list[tuple[str, Any]]:
        """Return what is there now, without asking for the rest."""
        return list(super().items())

    def complete(self) -> LazyMetadata:
        """Ask for the rest, and return the dictionary."""
        if self._rest is not None:
            rest, self._rest = self._rest, None
            for key, value in rest().items():
                super().setdefault(key, value)
        return self

    def __missing__(self, key: str) -> Any:
        if self.is_complete:
            raise KeyError(key)
        return self.complete()[key]

    def __iter__(self) -> Iterator[str]:
        return super(LazyMetadata, self.complete()).__iter__()

    def __len__(self) -> int:
        return super(LazyMetadata, self.complete()).__len__()

    def __contains__(self, key: object) -> bool:
        return super().__contains__(key) or super(LazyMetadata, self.complete()).__contains__(key)

    def __eq__(self, other: object) -> bool:
        return super(LazyMetadata, self.complete()).__eq__(other)

    def __ne__(self, other: object) -> bool:
        return not self == other

    __hash__ = None  # pyright: ignore[reportAssignmentType]  (as of every dict)

    def __reversed__(self) -> Iterator[str]:
        return super(LazyMetadata, self.complete()).__reversed__()

    def __repr__(self) -> str:
        return super(LazyMetadata, self.complete()).__repr__()

    def __or__(self, other: Any) -> dict[str, Any]:
        return dict(self.items()) | other

    def __ror__(self, other: Any) -> dict[str, Any]:
        return other | dict(self.items())

    def __reduce__(self) -> tuple[Any, ...]:
        return dict, (dict(self.items()),)

    def get(self, key: str, default: Any = None) -> Any:
        """Return the value of `key`, or `default`."""
        try:
            return self[key]
        except KeyError:
            return default

    def pop(self, key: str, *default: Any) -> Any:
        """Remove `key` and return its value, or `default` where it is not there."""
        return super(LazyMetadata, self.complete()).pop(key, *default)

    def popitem(self) -> tuple[str, Any]:
        """Remove and return the last (key, value) pair."""
        return super(LazyMetadata, self.complete()).popitem()

    def setdefault(self, key: str, default: Any = None) -> Any:
        """Return the value of `key`, which becomes `default` where it is not there."""
        return super(LazyMetadata, self.complete()).setdefault(key, default)

    def keys(self) -> Any:
        """Return the keys."""
        return super(LazyMetadata, self.complete()).keys()

    def items(self) -> Any:
        """Return the (key, value) pairs."""
        return super(LazyMetadata, self.complete()).items()

    def values(self) -> Any:
        """Return the values."""
        return super(LazyMetadata, self.complete()).values()

    def copy(self) -> dict[str, Any]:
        """Return an ordinary dictionary of all of it."""
        return dict(self.items())
