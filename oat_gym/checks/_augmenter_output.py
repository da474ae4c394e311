"""Checks of what an augmenter makes: it runs, keeps its promises, and leaves everything else alone."""

from __future__ import annotations

import itertools
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from minari import EpisodeData

from oat_gym.augmenters.base import Variation
from oat_gym.checks._compare import FIELDS, difference, shared_leaf, tree_difference
from oat_gym.checks._probe import leaf_outside, places_of, row_bytes
from oat_gym.checks._trial import VARIATIONS, Trial, Trials, Variations, restored, run_trial
from oat_gym.checks.report import Broken, Check, NotApplicable
from oat_gym.episodes import check_episode
from oat_gym.errors import ConfigurationError, InvalidDataError, OatGymError
from oat_gym.spaces import Batch
from oat_gym.stitching import spans_mask

MOST_EPISODES = 16
"""How many episodes of a dataset are compared pair by pair."""


def runs_on(name: str, trials: Trials) -> int:
    """Every variation is a sound episode."""
    if name not in trials.probes:
        raise NotApplicable("no dataset was given")
    try:
        trial = trials.first(name)
    except ConfigurationError as error:
        if "own" in trials.probes and name != "own":
            raise NotApplicable(f"its settings are for other data than this: {error}") from error
        raise
    for k, i, made in each(trial.variations):
        if not isinstance(made, Variation) or not isinstance(made.episode, EpisodeData):
            raise Broken(f"variation {k} of episode {i} is a {type(made).__name__}, expected a Variation of an episode")
        try:
            check_episode(made.episode, trial.source.observation_space, trial.source.action_space)
        except InvalidDataError as error:
            raise Broken(f"variation {k}: {error}") from error
    return VARIATIONS * len(trial.source)


def one_step(trials: Trials) -> int:
    """Data of one-step episodes is augmented, or refused by an `OatGymError` that says why."""
    try:
        trial = run_trial(trials.augmenter, trials.one_step.dataset, seed=trials.seed)
    except OatGymError:
        return 1
    for _, _, made in each(trial.variations):
        check_episode(made.episode, trial.source.observation_space, trial.source.action_space)
    return len(trial.source)


def lengths(trials: Trials) -> int:
    """Each variation has the number of steps that was announced before the fit."""
    count = 0
    for name, trial in _each_trial(trials):
        for k, i, made in each(trial.variations):
            got, said = len(made.episode.rewards), trial.announced[k, i]
            if not np.issubdtype(trial.announced.dtype, np.integer) or got != said:
                raise Broken(f"{name}: variation {k} of episode {i} has {got} steps, and {said!r} were announced")
            count += 1
    return count


def random_state(trials: Trials) -> int:
    """The global random states of Python, NumPy and torch stay as they are."""
    done = _each_trial(trials)
    for name, trial in done:
        if trial.moved:
            raise Broken(f"{name}: the global random state of {', '.join(trial.moved)} was moved")
    return 3 * len(done)


def source_unchanged(trials: Trials) -> int:
    """The episodes of the source hold the same bytes afterwards."""
    done = _each_trial(trials)
    for name, trial in done:
        if trial.source_changed:
            raise Broken(f"{name}: the episodes of the source were changed")
    return sum(len(trial.source) for _, trial in done)


def determinism(trials: Trials) -> int:
    """A new fit with the same seed gives the same, asked for in another order."""
    count = 0
    for name, trial in _each_trial(trials):
        dataset = trial.source.dataset
        again = run_trial(trials.augmenter, dataset, seed=trials.seed, backwards=True)
        _expect_same(trial.variations, again.variations, f"{name}: a second fit, asked for from the last to the first,")
        count += 2 * VARIATIONS * len(trial.source)
    return count


def restoring(trials: Trials) -> int:
    """A sampler restored from its state, with stored material, gives the same."""
    count = 0
    for name, trial in _each_trial(trials):
        with tempfile.TemporaryDirectory(prefix="oat_gym-check-") as folder:
            variations = restored(trials.augmenter, trial, Path(folder))
        _expect_same(trial.variations, variations, f"{name}: a restored sampler")
        count += VARIATIONS * len(trial.source)
    return count


def variations_differ(trials: Trials) -> int:
    """Two variations of the same episodes are not all the same."""
    done = _each_trial(trials)
    for name, trial in done:
        if _same(trial.variations[0], trial.variations[1]):
            raise Broken(f"{name}: variations 0 and 1 of every episode are the same")
    return len(done)


def seeds_differ(trials: Trials) -> int:
    """Another seed gives something else."""
    name, trial = _each_trial(trials)[0]
    other = run_trial(trials.augmenter, trial.source.dataset, seed=trials.seed + 1)
    if all(_same(*pair) for pair in zip(trial.variations, other.variations, strict=True)):
        raise Broken(f"{name}: the seeds {trials.seed} and {trials.seed + 1} give the same episodes")
    return 1


def memory(trials: Trials) -> int:
    """A variation shares no memory with the source, with another one, or with itself made again."""
    count = 0
    for name, trial in _each_trial(trials):
        shown = range(min(len(trial.source), MOST_EPISODES))
        material = trial.sampler.decode(trial.arrays[0])
        again = [trial.sampler.variation(i, 0, material).episode for i in shown]
        owners = {f"episode {i} of the source": trial.source.episodes[i] for i in shown}
        owners |= {f"variation {k} of episode {i}": made.episode for k, i, made in each(trial.variations) if i in shown}
        owners |= {f"variation 0 of episode {i}, made again": episode for i, episode in zip(shown, again, strict=True)}
        found = _shared(owners)
        if found:
            raise Broken(f"{name}: {found}")
        count += len(owners)
    return count


def _shared(owners: dict[str, EpisodeData]) -> str | None:
    arrays = [(owner, part) for owner, episode in owners.items() for part in _arrays(episode)]
    for (owner, part), (other, another) in itertools.combinations(arrays, 2):
        if other != owner and np.may_share_memory(part, another) and np.shares_memory(part, another):
            return f"{other} shares memory with {owner}"
    for (owner, episode), (other, another) in itertools.combinations(owners.items(), 2):
        for name in FIELDS:  # dictionaries and lists, which are no arrays
            where = shared_leaf(getattr(episode, name), getattr(another, name), name)
            if where:
                return f"{other} shares {where} with {owner}"
    return None


def _arrays(episode: EpisodeData) -> Iterator[np.ndarray[Any, Any]]:
    for name in FIELDS:
        yield from _leaves(getattr(episode, name))


def _leaves(tree: Batch) -> Iterator[np.ndarray[Any, Any]]:
    if isinstance(tree, dict | tuple):
        for part in tree.values() if isinstance(tree, dict) else tree:
            yield from _leaves(part)
    elif isinstance(tree, np.ndarray) and tree.size:
        yield tree


def in_spaces(trials: Trials) -> int:
    """Every observation and action is in its space, and every reward finite."""
    count = 0
    for name, trial in _each_trial(trials):
        for k, i, made in each(trial.variations):
            episode, where = made.episode, f"{name}: variation {k} of episode {i}:"
            for what, space in (
                ("observations", trial.source.observation_space),
                ("actions", trial.source.action_space),
            ):
                outside = leaf_outside(getattr(episode, what), space)
                if outside:
                    raise Broken(f"{where} {what}{outside}")
            if not np.isfinite(episode.rewards).all():
                raise Broken(f"{where} a reward is not finite")
            count += 1
    return count


def flags(trials: Trials) -> int:
    """Only the last step ends an episode; it ends where all of the source do, and no termination is invented."""
    count = 0
    for name, trial in _each_trial(trials):
        terminates = any(episode.terminations.any() for episode in trial.source.episodes)
        all_end = all(episode.terminations[-1] | episode.truncations[-1] for episode in trial.source.episodes)
        for k, i, made in each(trial.variations):
            where, ends = f"{name}: variation {k} of episode {i}", made.episode.terminations | made.episode.truncations
            if ends[:-1].any():
                raise Broken(f"{where} has a flag set at step {int(np.flatnonzero(ends)[0])} of {len(ends)}")
            if made.episode.terminations.any() and not terminates:
                raise Broken(f"{where} terminates, and no episode of the source does")
            if all_end and not ends[-1]:
                raise Broken(f"{where} does not end, and every episode of the source does")
            count += 1
    return count


def alignment(trials: Trials) -> int:
    """A step that counts as recorded has the observation, action and reward of its own episode and step."""
    coded = [(name, trial) for name, trial in _each_trial(trials) if trials.probes[name].coded]
    count = sum(_aligned_steps(name, trial) for name, trial in coded)
    if not count:
        raise NotApplicable("no step of a variation counts as recorded")
    return count


def _aligned_steps(name: str, trial: Trial) -> int:
    places, count = places_of(trial.source.episodes), 0
    for k, i, made in each(trial.variations):
        mask = spans_mask(made.spans, len(made.episode.rewards))
        for step in map(int, np.flatnonzero(~mask)):
            where = f"{name}: step {step} of variation {k} of episode {i} counts as recorded"
            place = places.get(row_bytes(made.episode.observations, step))
            if place != (i, step):
                whose = "none of the source's" if place is None else f"that of episode {place[0]}, step {place[1]}"
                raise Broken(f"{where}, and its observation is {whose}")
            for what in ("actions", "rewards"):
                original = getattr(trial.source.episodes[i], what)
                if row_bytes(getattr(made.episode, what), step) != row_bytes(original, step):
                    raise Broken(f"{where}, and its {what[:-1]} is not the one recorded with its observation")
            count += 1
    return count


def each(variations: Variations) -> Iterator[tuple[int, int, Variation]]:
    """Yield (k, i, variation k of episode i)."""
    return ((k, i, made) for k, row in enumerate(variations) for i, made in enumerate(row))


def _each_trial(trials: Trials) -> list[tuple[str, Trial]]:
    if not trials.done:
        raise NotApplicable("the augmenter ran on no dataset")
    return list(trials.done.items())


def _expect_same(expected: Variations, got: Variations, how: str) -> None:
    for (k, i, left), (_, _, right) in zip(each(expected), each(got), strict=True):
        found = _variation_difference(left, right)
        if found:
            raise Broken(f"{how} gives another variation {k} of episode {i}: {found}")


def _variation_difference(left: Variation, right: Variation) -> str | None:
    rest = [(getattr(left, f.name), getattr(right, f.name), f.name) for f in fields(left) if f.name != "episode"]
    return difference(left.episode, right.episode) or next(
        filter(None, (tree_difference(*part) for part in rest)), None
    )


def _same(left: tuple[Variation, ...], right: tuple[Variation, ...]) -> bool:
    return all(difference(a.episode, b.episode) is None for a, b in zip(left, right, strict=True))


def _runs(name: str) -> Callable[[Trials], int]:
    return partial(runs_on, name)


_RUNS = ("continuous", "discrete", "own-dataset")
_SOUND = ("source-unchanged",)
OUTPUT_CHECKS: tuple[Check[Trials], ...] = (
    Check("continuous", "it runs on Box spaces and unequal lengths", _runs("continuous")),
    Check("discrete", "it runs on Discrete, MultiDiscrete and Dict spaces", _runs("discrete")),
    Check("own-dataset", "it runs on the dataset given", _runs("own")),
    Check("one-step", "one-step episodes are augmented, or refused with a reason", one_step),
    Check("source-unchanged", "the source's bytes stay as they are", source_unchanged, (), _RUNS),
    Check("random-state", "global random states are not touched", random_state, (), _RUNS),
    Check("determinism", "the same seed gives the same in any order", determinism, ("random-state", *_SOUND)),
    Check("restoring", "a restored sampler is the same", restoring, ("determinism",)),
    Check("variations-differ", "variations are different", variations_differ, _SOUND),
    Check("seeds-differ", "seeds give different episodes", seeds_differ, ("determinism",)),
    Check("memory", "no memory is shared", memory, _SOUND),
    Check("lengths", "lengths are announced", lengths, _SOUND),
    Check("spaces", "values are in the spaces", in_spaces, _SOUND),
    Check("flags", "episodes end at their end, and none is invented", flags, _SOUND),
    Check("alignment", "recorded steps stay together and in their place", alignment, _SOUND),
)
