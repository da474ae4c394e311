"""Checks of what augmentation must keep: the real episodes, everything outside the spans, provenance, the source."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from typing import Any

import numpy as np
from minari import EpisodeData, MinariDataset

from oat_gym.checks._compare import difference, tree_difference
from oat_gym.checks._subject import FileState, Subject
from oat_gym.checks.report import Broken, Check, NotApplicable
from oat_gym.dataset import AugmentedDataset
from oat_gym.episodes import Transitions, next_states, states
from oat_gym.provenance import METADATA_KEYS, Provenance
from oat_gym.spaces import Batch, map_tree, tree_length


def plan(subject: Subject) -> int:
    """The storage holds the source's episodes, the synthetic ones asked for, and those appended."""
    storage, synthesis = subject.augmented.storage, subject.augmented.synthesis
    if storage.n_real != len(synthesis.source.ids):
        raise Broken(f"{storage.n_real} real episodes for a source of {len(synthesis.source.ids)}")
    if storage.total_episodes < storage.n_real + synthesis.count:
        raise Broken(
            f"{storage.total_episodes} episodes in all, expected {storage.n_real} real and {synthesis.count} synthetic"
        )
    return int(storage.total_episodes)


def real_episodes(subject: Subject) -> int:
    """Real episodes are the source's to the last bit, infos included."""
    count = 0
    for _, episode, original in _planned(subject, synthetic=False):
        found = difference(episode, original)
        if found:
            raise Broken(f"real episode {episode.id} is not the source's: {found}")
        count += 1
    return count


def outside_spans(subject: Subject) -> int:
    """A synthetic episode is its source wherever its mask is false."""
    rows = 0
    for position, episode, original in _planned(subject, synthetic=True):
        mask = subject.augmented.provenance(position).mask
        if mask.all():
            continue
        if len(episode.rewards) != len(original.rewards):
            raise Broken(
                f"episode {episode.id} has {len(episode.rewards)} steps where its source has {len(original.rewards)}, "
                "and part of it counts as recorded"
            )
        kept = np.flatnonzero(~mask)
        parts = {"observations": np.append(kept, len(mask)) if not mask[-1] else kept}
        for name in ("observations", "actions", "rewards", "terminations", "truncations"):
            chosen = parts.get(name, kept)
            wanted = getattr(original, name)
            if name == "rewards" and wanted.dtype.kind in "biu" and episode.rewards.dtype == np.float64:
                wanted = wanted.astype(np.float64)  # what stitching makes of whole rewards: generated ones are not
            found = tree_difference(_rows(getattr(episode, name), chosen), _rows(wanted, chosen), name)
            if found:
                raise Broken(f"episode {episode.id} differs from its source outside its spans: {found}")
        rows += len(kept)
    return rows


def _rows(batch: Batch, rows: Any) -> Batch:
    return map_tree(lambda leaf: leaf[rows] if isinstance(leaf, np.ndarray) else [leaf[row] for row in rows], batch)


def infos_kept(subject: Subject) -> int:
    """A synthetic episode of which a part counts as recorded has its source's infos; every one has their keys."""
    count = 0
    for position, episode, original in _planned(subject, synthetic=True):
        got, expected = episode.infos or {}, original.infos or {}
        made_whole = subject.augmented.provenance(position).mask.all()
        if made_whole or len(episode.rewards) != len(original.rewards):
            if got.keys() != expected.keys():
                raise Broken(f"episode {episode.id} has the infos {sorted(got)}, its source {sorted(expected)}")
        else:
            found = tree_difference(got, expected, "infos")
            if found:
                raise Broken(f"episode {episode.id} has not the infos of its source: {found}")
        count += 1
    return count


def provenance(subject: Subject) -> int:
    """Provenance names a source and spans inside the episode, and is what the metadata says."""
    dataset = subject.augmented
    for position, metadata in zip(subject.positions, subject.metadata, strict=True):
        number, origin = int(dataset.episode_indices[position]), dataset.provenance(position)
        if Provenance.from_metadata(metadata, number) != origin:
            raise Broken(f"episode {number}: the metadata gives {metadata}, provenance gives {origin}")
        made = dataset.storage.n_real <= number < dataset.storage.n_planned
        if made and not (origin.synthetic and origin.variation is not None):
            raise Broken(f"episode {number} was made and its provenance says that it is real: {origin}")
        if made and not 0 <= origin.source < dataset.storage.n_real:
            raise Broken(f"episode {number} names the source {origin.source} of {dataset.storage.n_real}")
        for span in origin.spans:
            if not 0 <= span.start < span.stop <= origin.length:
                raise Broken(f"episode {number} of {origin.length} steps has a span {span.start}:{span.stop}")
    return len(subject.positions)


def masks(subject: Subject) -> int:
    """A mask has one boolean for each step, and none is set in a real episode."""
    for position, episode in zip(subject.positions, subject.episodes, strict=True):
        origin = subject.augmented.provenance(position)
        if origin.mask.shape != (len(episode.rewards),) or origin.mask.dtype != np.bool_:
            raise Broken(f"the mask of episode {episode.id} has {len(origin.mask)} entries for {len(episode)} steps")
        if not origin.synthetic and origin.mask.any():
            raise Broken(f"episode {episode.id} is real and its mask marks {int(origin.mask.sum())} steps")
    return len(subject.positions)


def metadata_kept(subject: Subject) -> int:
    """Each episode has all metadata of its source: seed, options and the user's own keys."""
    dataset, count = subject.augmented, 0
    edited = dataset.storage.edited_metadata()
    for number, metadata in zip(subject.numbers, subject.metadata, strict=True):
        if number >= dataset.storage.n_planned:
            continue
        own = {"id", "total_steps", *METADATA_KEYS, *edited.get(str(number), {})}
        original = dataset.synthesis.source.metadata[_source_number(number, dataset)]
        for key in original.keys() - own:
            if key not in metadata:
                raise Broken(f"the metadata of episode {number} lacks {key!r} of its source")
            found = tree_difference(metadata[key], original[key], f"metadata[{key!r}]")
            if found:
                raise Broken(f"episode {number} has other metadata than its source: {found}")
            count += 1
    return count


def environment(subject: Subject) -> int:
    """Spaces, environments and scores are the source's."""
    dataset, source = subject.augmented, subject.source
    if source is None:
        raise NotApplicable("there is no source to compare with")
    for name in ("observation_space", "action_space", "env_spec"):
        if getattr(dataset, name) != getattr(source, name):
            raise Broken(f"{name} is {getattr(dataset, name)!r}, the source has {getattr(source, name)!r}")
    got, expected = dataset.storage.metadata, source.storage.metadata
    keys = ("eval_env_spec", "ref_min_score", "ref_max_score", "num_episodes_average_score", "requirements")
    for key in keys:
        if got.get(key) != expected.get(key):
            raise Broken(f"metadata[{key!r}] is {got.get(key)!r}, the source has {expected.get(key)!r}")
    return 3 + len(keys)


def transitions(subject: Subject) -> int:
    """The columns are the steps in order, and s' of step t is observations[t+1] (literal seams apart)."""
    view = copy.copy(subject.augmented)
    view.episode_indices = np.array(subject.numbers, dtype=np.int64)
    columns, start = view.transitions(), 0
    expected = sum(len(episode.rewards) for episode in subject.episodes)
    if len(columns) != expected:
        raise Broken(f"transitions() has {len(columns)} rows for {expected} steps")
    for place, episode in enumerate(subject.episodes):
        rows = np.arange(start, start + len(episode.rewards))
        _expect_rows(columns, rows, episode, place, view)
        start += len(rows)
    return start


def _expect_rows(
    columns: Transitions, rows: np.ndarray[Any, Any], episode: EpisodeData, place: int, view: AugmentedDataset
) -> None:
    steps = np.arange(len(rows))
    variation = view.storage.variation(int(view.episode_indices[place]))
    seams = variation.next_states if variation else {}
    expected = {
        "observations": states(episode),
        "actions": episode.actions,
        # One column for all episodes: whole rewards become floats there where a generated episode has such.
        "rewards": episode.rewards.astype(columns.rewards.dtype, casting="safe"),
        "terminated": episode.terminations,
        "truncated": episode.truncations,
        "episode": np.full(len(rows), place),
        "step": steps,
        "synthetic": view.provenance(place).mask,
    }
    ordinary = np.array([step for step in steps if step not in seams], dtype=np.int64)
    checked = {name: (_rows(getattr(columns, name), rows), values) for name, values in expected.items()}
    checked["next_observations"] = (
        _rows(columns.next_observations, rows[ordinary]),
        _rows(next_states(episode), ordinary),
    )
    for name, (got, wanted) in checked.items():
        found = tree_difference(got, wanted, name)
        if found:
            raise Broken(f"the transitions of episode {episode.id} are not its steps: {found}")
    if tree_length(columns.next_observations) != len(columns):
        raise Broken(f"{tree_length(columns.next_observations)} next observations for {len(columns)} transitions")


def rebuilding(subject: Subject) -> int:
    """The same source, augmenter, count and seed give the same bytes again."""
    synthesis, n_planned = subject.augmented.synthesis, subject.augmented.storage.n_planned
    twin = AugmentedDataset(synthesis.source.view, synthesis.augmenter, count=synthesis.count, seed=synthesis.seed)
    planned = [(place, number) for place, number in enumerate(subject.numbers) if number < n_planned]
    for place, number in planned:
        subject.expect_equal(twin[number], place, "the dataset built again")
    return len(planned)


def source_untouched(subject: Subject) -> int:
    """Nothing that a dataset does writes to its source (looked at after all other checks)."""
    changed = set(subject.source_files) ^ set(source_files(subject.augmented))
    if changed:
        raise Broken(f"files of the source were written to: {sorted({file.path.name for file in changed})}")
    return len(subject.source_files)


def source_files(dataset: MinariDataset) -> tuple[FileState, ...]:
    """Return the state of each file of the source of an augmented dataset; none for another dataset."""
    if not isinstance(dataset, AugmentedDataset) or dataset.storage.synthesis is None:
        return ()
    files = sorted(path for path in dataset.source.storage.data_path.rglob("*") if path.is_file())
    return tuple(FileState(path, path.stat().st_size, path.stat().st_mtime_ns) for path in files)


def _planned(subject: Subject, *, synthetic: bool) -> Iterator[tuple[int, EpisodeData, EpisodeData]]:
    dataset = subject.augmented
    for position, episode, number in zip(subject.positions, subject.episodes, subject.numbers, strict=True):
        if number < dataset.storage.n_planned and (number >= dataset.storage.n_real) == synthetic:
            yield position, episode, subject.originals[_source_number(number, dataset)]


def _source_number(number: int, dataset: AugmentedDataset) -> int:
    n_real = dataset.storage.n_real
    return number if number < n_real else (number - n_real) % n_real


READ = ("readable", "ids", "determinism", "t-plus-one")
CONTENT = ("dtypes", "shapes", "spaces", "finite", "flags", "total-steps")
AUGMENTED_CHECKS: tuple[Check[Subject], ...] = (
    Check("plan", "real, synthetic and appended episodes add up", plan),
    Check("real-episodes", "real episodes are the source's to the last bit", real_episodes, (*READ, "plan")),
    Check("provenance", "provenance is that of the metadata", provenance, (*READ, "plan", "metadata-steps")),
    Check("masks", "a mask has one boolean for each step", masks, (*READ, "plan")),
    Check("outside-spans", "outside its spans an episode is its source", outside_spans, (*READ, "masks", "provenance")),
    Check("infos-kept", "infos keep the source's schema", infos_kept, (*READ, "plan", "masks")),
    Check("metadata-kept", "episode metadata survives", metadata_kept, (*READ, "plan")),
    Check("environment", "spaces, environments and scores are the source's", environment),
    Check("transitions", "transitions keep the T+1 rule", transitions, (*READ, "masks", *CONTENT)),
    Check("rebuilding", "the plan gives the same bytes again", rebuilding, (*READ, "plan")),
)
UNTOUCHED: Check[Subject] = Check("source-untouched", "the source is never written to", source_untouched)
