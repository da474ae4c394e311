"""The 142 features that the tutor of `oat_gym/Tutor-v0` sees, in the five groups of the paper's appendix E.1.

The paper gives the groups, their sizes and an example of each; the features themselves are ours. Each is computed from
what the tutor can record (`Session`), never from what a student really knows. A share or a mean of nothing is 0.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import chain

import numpy as np
import numpy.typing as npt

from oat_gym.envs._tutor_log import Session
from oat_gym.envs._tutor_model import (
    ACTIONS,
    EASE,
    ISOMORPHIC,
    N_PRINCIPLES,
    N_PROBLEMS,
    PRINCIPLES,
    PROBLEMS,
    SLOWEST_STEP,
    SOLVE,
    TOGETHER,
    FloatArray,
)


@dataclass(frozen=True)
class Desk:
    """What the tutor has before it when it decides on the next problem.

    Attributes:
        session: what was recorded.
        pretest: (n, items) credit for each item of the pre-test.
        reading_seconds: (n,) spent on the textbook.
        pretest_seconds: (n,) spent on the pre-test.
        done: number of problems behind the students.
    """

    session: Session
    pretest: FloatArray
    reading_seconds: FloatArray
    pretest_seconds: FloatArray
    done: int


Columns = dict[str, FloatArray]


def _per(sums: FloatArray, counts: FloatArray) -> FloatArray:
    """Return sums / counts, 0 where nothing was counted."""
    return np.divide(sums, counts, out=np.zeros(np.broadcast_shapes(sums.shape, counts.shape)), where=counts > 0)


def _named(prefix: str, names: tuple[str, ...], rows: FloatArray) -> Columns:
    return {f"{prefix}_{name}": row for name, row in zip(names, rows, strict=True)}


def autonomy(desk: Desk) -> Columns:
    """Return the 10 features on the work done by the student."""
    total, last = desk.session.total, desk.session.of_last
    return {
        "restarts": total("restarts"),
        "restarts_last": last("restarts"),
        "steps_alone": desk.session.by_action("elicited")[SOLVE],
        "steps_done": total("elicited"),
        "steps_done_last": last("elicited"),
        "done_share": _per(total("elicited"), total("steps")),
        "done_share_last": _per(last("elicited"), last("steps")),
        "retries": total("retries"),
        "retries_last": last("retries"),
        "retry_share": _per(total("retries"), total("wrong")),
    }


def temporal_situation(desk: Desk) -> Columns:
    """Return the 29 features on time, in seconds."""
    session = desk.session
    total, last = session.total, session.of_last
    by_action, steps = session.by_action("seconds"), session.by_action("steps")
    columns = {
        "reading_seconds": desk.reading_seconds,
        "pretest_seconds": desk.pretest_seconds,
        "session_seconds": total("seconds"),
        "last_seconds": last("seconds"),
        "seconds_per_problem": _per(total("seconds"), total("problems")),
        "seconds_per_step": _per(total("seconds"), total("steps")),
        "seconds_per_step_last": _per(last("seconds"), last("steps")),
        **_named("seconds", ACTIONS, by_action),
        **_named("seconds_per_step", ACTIONS, _per(by_action, steps)),
        **_named("time_share", ACTIONS, _per(by_action, total("seconds"))),
        "answering_seconds_each": _per(total("answering_seconds"), total("elicited")),
        "answering_seconds_each_last": _per(last("answering_seconds"), last("elicited")),
    }
    for name in ("answering", "correct", "wrong", "hint"):
        columns[f"{name}_seconds"] = total(f"{name}_seconds")
        columns[f"{name}_seconds_last"] = last(f"{name}_seconds")
    longest, shortest, longest_last = session.step_seconds
    return {**columns, "longest_step": longest, "shortest_step": shortest, "longest_step_last": longest_last}


def problem_solving(desk: Desk) -> Columns:
    """Return the 35 features on the next problem, and on what was done so far; no next problem gives zeros."""
    session, n = desk.session, len(desk.reading_seconds)
    seen, following = session.by("seen"), next_problem(desk.done)
    needs = np.isin(np.arange(N_PRINCIPLES), following)
    familiar = (seen[list(following)] > 0).sum(axis=0) if following else np.zeros(n)
    fixed = {
        "problems_done": desk.done,
        "difficulty": difficulty(following),
        "steps_next": len(following),
        "principles_next": len(set(following)),
        "difficulty_last": difficulty(PROBLEMS[desk.done - 1]) if desk.done else 0.0,
    }
    return {
        **{name: np.full(n, float(value)) for name, value in fixed.items()},
        **_named("needs", PRINCIPLES, np.repeat(needs[:, None].astype(np.float64), n, axis=1)),
        **_named("seen", PRINCIPLES, seen),
        "familiar_share": familiar / max(len(following), 1),
        **_named("problems", ACTIONS, session.by_action("problems")),
        **_named("last_was", ACTIONS, (np.arange(len(ACTIONS))[:, None] == session.action).astype(np.float64)),
        "same_in_a_row": session.repeated,
        "steps_told": session.total("steps") - session.total("elicited"),
        "steps": session.total("steps"),
    }


def performance(desk: Desk) -> Columns:
    """Return the 57 features on answers, right and wrong at first, and on the pre-test."""
    session = desk.session
    total, last = session.total, session.of_last
    correct, wrong = session.by("correct"), session.by("wrong")
    needed = sorted(set(next_problem(desk.done)))
    right_by, wrong_by = session.by_action("correct"), session.by_action("wrong")
    streak_right, streak_wrong, longest_right, _ = session.streaks
    return {
        "pretest_score": desk.pretest.mean(axis=1),
        **_named("pretest", PRINCIPLES, _pretest_by_principle(desk.pretest)),
        **_named("correct", PRINCIPLES, correct),
        **_named("wrong", PRINCIPLES, wrong),
        **_named("correct_share", PRINCIPLES, _per(correct, correct + wrong)),
        "correct": total("correct"),
        "wrong": total("wrong"),
        "correct_share": _per(total("correct"), total("elicited")),
        "correct_last": last("correct"),
        "wrong_last": last("wrong"),
        "correct_share_last": _per(last("correct"), last("elicited")),
        "correct_share_alone": _per(right_by[SOLVE], right_by[SOLVE] + wrong_by[SOLVE]),
        "correct_share_together": _per(right_by[TOGETHER], right_by[TOGETHER] + wrong_by[TOGETHER]),
        "correct_in_a_row": streak_right,
        "wrong_in_a_row": streak_wrong,
        "longest_correct_row": longest_right,
        "correct_share_needed": _per(correct[needed].sum(axis=0), (correct + wrong)[needed].sum(axis=0)),
        "perfect_problems": total("perfect"),
        "wrong_alone": wrong_by[SOLVE],
        "attempts_each": _per(total("attempts"), total("elicited")),
        "attempts_each_last": _per(last("attempts"), last("elicited")),
    }


def hint_usage(desk: Desk) -> Columns:
    """Return the 11 features on hints."""
    session = desk.session
    total, last, by_action = session.total, session.of_last, session.by_action("hints")
    needed = sorted(set(next_problem(desk.done)))
    return {
        "hints": total("hints"),
        "hints_last": last("hints"),
        "hints_per_problem": _per(total("hints"), total("problems")),
        "hints_per_step": _per(total("hints"), total("elicited")),
        "hints_per_step_last": _per(last("hints"), last("elicited")),
        "bottom_outs": total("bottom_outs"),
        "bottom_outs_last": last("bottom_outs"),
        "hints_alone": by_action[SOLVE],
        "hints_together": by_action[TOGETHER],
        "hints_needed": session.by("hints")[needed].sum(axis=0),
        "problems_without_hint": session.streaks[3],
    }


def next_problem(done: int) -> tuple[int, ...]:
    """Return the principles of the steps of the problem after `done` others, none after the last."""
    return PROBLEMS[done] if done < N_PROBLEMS else ()


def difficulty(problem: tuple[int, ...]) -> float:
    """Return the mean over a problem's steps of the probability that an average student does not know them."""
    return float((1.0 / (1.0 + np.exp(EASE[list(problem)]))).mean()) if problem else 0.0


def _pretest_by_principle(credit: FloatArray) -> FloatArray:
    """Return the mean credit of the items that ask for each principle, (K, n)."""
    asks = [[number for number, item in enumerate(ISOMORPHIC) if k in item] for k in range(N_PRINCIPLES)]
    return np.stack([credit[:, items].mean(axis=1) for items in asks])


_GROUPS: dict[str, Callable[[Desk], Columns]] = {
    "autonomy": autonomy,
    "temporal situation": temporal_situation,
    "problem solving": problem_solving,
    "performance": performance,
    "hints": hint_usage,
}


_NOTHING = Desk(Session.empty(1), np.zeros((1, len(ISOMORPHIC))), np.zeros(1), np.zeros(1), done=0)
FEATURE_GROUPS: dict[str, tuple[str, ...]] = {group: tuple(columns(_NOTHING)) for group, columns in _GROUPS.items()}
"""The names of the features, by group, in the order of the observation."""
FEATURES = tuple(chain.from_iterable(FEATURE_GROUPS.values()))
"""The names of the 142 features."""


def describe(desk: Desk) -> dict[str, Columns]:
    """Return the features by group and name, each (n,)."""
    return {group: columns(desk) for group, columns in _GROUPS.items()}


def observe(desk: Desk) -> npt.NDArray[np.float32]:
    """Return the observations (n, 142)."""
    rows = list(chain.from_iterable(columns(desk).values() for columns in _GROUPS.values()))
    out = np.empty((len(desk.reading_seconds), len(rows)), dtype=np.float32)
    for number, row in enumerate(rows):
        out[:, number] = row
    return out


def upper_bound(name: str) -> float:
    """Return a bound that the feature of this name never exceeds."""
    most_steps = sum(map(len, PROBLEMS))
    if "seconds" in name or name.startswith(("longest_step", "shortest_step")):
        return float(most_steps * SLOWEST_STEP)
    if "share" in name or name.startswith(("pretest_", "needs_", "last_was_", "difficulty")):
        return 1.0
    return float(3 * most_steps)  # no count is larger than three hints in every step
