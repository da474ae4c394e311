"""Metadata that is completed when it is looked at is a dictionary in every way that users touch it."""

from collections.abc import Callable
from typing import Any

import pytest

from oat_gym.lazy_metadata import LazyMetadata

WHOLE = {"total_steps": 3, "synthetic": True}


@pytest.mark.parametrize(
    "look",
    [
        dict,
        len,
        sorted,
        lambda metadata: list(reversed(metadata)),
        lambda metadata: metadata == WHOLE,
        lambda metadata: metadata != WHOLE,
        lambda metadata: metadata | {"more": 1},
        lambda metadata: {"more": 1} | metadata,
        lambda metadata: metadata.pop("synthetic"),
        lambda metadata: metadata.pop("missing", None),
        lambda metadata: metadata.popitem(),
        lambda metadata: metadata.setdefault("synthetic", False),
        lambda metadata: "synthetic" in metadata,
        lambda metadata: metadata.get("synthetic"),
        lambda metadata: list(metadata.items()),
        lambda metadata: metadata.copy(),
        repr,
    ],
)
def test_it_answers_as_the_whole_dictionary_does(look: Callable[[Any], Any]) -> None:
    assert look(LazyMetadata({"total_steps": 3}, lambda: {"synthetic": True})) == look(dict(WHOLE))


def test_what_is_known_is_told_without_the_rest() -> None:
    metadata = LazyMetadata({"total_steps": 3}, lambda: pytest.fail("asked for the rest"))
    assert metadata["total_steps"] == 3
    assert metadata.known_items() == [("total_steps", 3)]
    assert not metadata.is_complete
