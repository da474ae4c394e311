import dataclasses

import numpy as np
import pytest
from minari import EpisodeData

from oat_gym.errors import ConfigurationError
from oat_gym.stitching import Replacement, Span, literal_next_states, spans_mask, stitch


def coded(length: int) -> EpisodeData:
    steps = np.arange(length + 1, dtype=np.float64)
    return EpisodeData(
        id=7,
        observations={"x": steps[:, None], "mode": (np.arange(length + 1), np.arange(length + 1) % 2)},
        actions=steps[:-1, None] + 0.5,
        rewards=steps[:-1] * 10,
        terminations=np.zeros(length, dtype=bool),
        truncations=np.arange(length) == length - 1,
        infos={"note": steps.copy()},
    )


def generated(width: int) -> Replacement:
    states = 100.0 + np.arange(width + 1)
    return Replacement(
        observations={"x": states[:, None], "mode": (states.astype(int), np.ones(width + 1, dtype=int))},
        actions=states[:-1, None] + 0.5,
        rewards=states[:-1] * 10,
    )


@pytest.mark.parametrize(("start", "stop"), [(0, 3), (2, 5), (4, 7), (0, 7), (3, 4)])
def test_inside_is_generated_and_outside_is_the_source_to_the_last_bit(start: int, stop: int) -> None:
    source, new = coded(7), generated(stop - start)
    episode = stitch(source, Span(start, stop), new)
    inside = spans_mask((Span(start, stop),), 7)
    states_inside = np.append(inside, False)  # the observation after the span is the recorded one
    np.testing.assert_array_equal(episode.rewards[~inside], source.rewards[~inside])
    np.testing.assert_array_equal(episode.actions[~inside], source.actions[~inside])
    np.testing.assert_array_equal(episode.observations["x"][~states_inside], source.observations["x"][~states_inside])
    np.testing.assert_array_equal(episode.observations["x"][states_inside, 0], 100 + np.arange(stop - start))
    np.testing.assert_array_equal(episode.observations["mode"][0][states_inside], 100 + np.arange(stop - start))
    np.testing.assert_array_equal(episode.rewards[inside], new.rewards)
    np.testing.assert_array_equal(episode.actions[inside], new.actions)
    for name in ("terminations", "truncations"):
        np.testing.assert_array_equal(getattr(episode, name), getattr(source, name))
    np.testing.assert_array_equal(episode.infos["note"], source.infos["note"])


def test_the_source_and_the_replacement_are_neither_changed_nor_shared() -> None:
    source, new = coded(5), generated(2)
    episode = stitch(source, Span(1, 3), new)
    episode.observations["x"][:] = -1
    episode.actions[:] = -1
    episode.rewards[:] = -1
    episode.truncations[:] = False
    episode.infos["note"][:] = -1
    for name in ("actions", "rewards", "truncations"):
        np.testing.assert_array_equal(getattr(source, name), getattr(coded(5), name))
    np.testing.assert_array_equal(source.observations["x"], coded(5).observations["x"])
    np.testing.assert_array_equal(source.infos["note"], coded(5).infos["note"])
    np.testing.assert_array_equal(new.rewards, generated(2).rewards)


def test_the_literal_seam_keeps_both_tuples_own_next_states() -> None:
    source, new = coded(6), generated(2)
    before, last = literal_next_states(source, Span(2, 4), new)
    assert {step: float(row["x"][0, 0]) for step, row in before.items()} == {1: 2.0}
    assert {step: float(row["x"][0, 0]) for step, row in last.items()} == {3: 102.0}
    assert literal_next_states(source, Span(0, 2), new)[0] == {}


@pytest.mark.parametrize(("span", "width"), [(Span(4, 8), 4), (Span(-1, 1), 2), (Span(2, 2), 1), (Span(1, 4), 2)])
def test_a_span_that_does_not_fit_is_an_error(span: Span, width: int) -> None:
    with pytest.raises(ConfigurationError, match="span"):
        stitch(coded(6), span, generated(width))


@pytest.mark.parametrize("steps", [1, 3, 5])
@pytest.mark.parametrize("part", ["observations", "actions", "rewards"])
def test_a_part_of_another_length_is_named_with_its_length(part: str, steps: int) -> None:
    right, other = generated(4 if part != "observations" else 6), generated(steps)
    wrong = dataclasses.replace(right, **{part: getattr(other, part)})
    expected, got = (7, steps + 1) if part == "observations" else (4, steps)
    with pytest.raises(ConfigurationError, match=f"takes {expected} {part}, got {got}"):
        stitch(coded(9), Span(1, expected - (part == "observations") + 1), wrong)
