"""What the tutor of `oat_gym/Tutor-v0` records: one problem worked through, step by step, and the sums of a session."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from oat_gym.envs._tutor_model import (
    ACTIONS,
    N_PRINCIPLES,
    SLOWEST_STEP,
    SOLVE,
    TOGETHER,
    BoolArray,
    FloatArray,
    IntArray,
    Students,
    answers_right,
    teaching,
)

N_DRAWS = 6
"""Uniform numbers that a step takes: who does it, first answer, hint, second answer, learning, time."""

MEASURES = (
    "problems",
    "seconds",
    "steps",
    "elicited",
    "correct",
    "wrong",
    "attempts",
    "hints",
    "bottom_outs",
    "retries",
    "restarts",
    "answering_seconds",
    "correct_seconds",
    "wrong_seconds",
    "hint_seconds",
    "perfect",
)
"""What is counted in each problem."""
PER_PRINCIPLE = ("seen", "correct", "wrong", "hints")
"""What is counted for each principle."""


@dataclass(frozen=True)
class Work:
    """One problem worked through by n students; arrays are (n, S) over its S steps.

    Attributes:
        principles: (S,) the principle of each step.
        elicited: the student did the step (else the tutor told it).
        correct: the first answer was right (false where nothing was asked).
        attempts: number of answers.
        hints: number of hints; 3 where the last one, which gives the answer, was reached.
        seconds: whole seconds.
        hint_seconds: of these, reading hints.
        restarted: (n,) the student started the problem again.
    """

    principles: tuple[int, ...]
    elicited: BoolArray
    correct: BoolArray
    attempts: IntArray
    hints: IntArray
    seconds: IntArray
    hint_seconds: IntArray
    restarted: BoolArray


def work_through(
    principles: tuple[int, ...],
    action: IntArray,
    *,
    students: Students,
    known: BoolArray,
    attention: FloatArray,
    draws: FloatArray,
) -> tuple[Work, BoolArray]:
    """Return the record of a problem and what the students know after it, (n, K).

    Args:
        principles: (S,) the principle of each step.
        action: (n,) `SOLVE`, `STUDY` or `TOGETHER`: then the tutor elicits each step or tells it, by a fair coin.
        students: the students.
        known: (n, K) what they know before.
        attention: (n,) factor on learning; also on the time spent reading.
        draws: (n, S, `N_DRAWS`) numbers in [0, 1); who does the first step is free where the student
            solves alone, and decides on a restart there.
    """
    known = known.copy()
    probability = students.learning * attention * teaching(action, known[:, list(principles)].mean(axis=1))
    elicited = (action == SOLVE)[:, None] | ((action == TOGETHER)[:, None] & (draws[:, :, 0] < 0.5))
    correct, knew = np.zeros_like(elicited), np.zeros_like(elicited)
    for step, principle in enumerate(principles):
        knew[:, step] = known[:, principle]
        correct[:, step] = answers_right(known[:, principle], students, draws[:, step, 1])
        known[:, principle] |= draws[:, step, 4] < probability
    correct &= elicited
    wrong = elicited & ~correct
    asked = wrong & (draws[:, :, 2] < students.help_seeking[:, None])
    hints = np.where(asked, np.where(~knew & (draws[:, :, 3] < 0.5), 3, 1), 0)
    attempts = elicited + wrong * (1 + (~asked & (draws[:, :, 3] < 0.5)))
    seconds, hint_seconds = _seconds(
        elicited, attempts, hints, students=students, attention=attention, uniforms=draws[:, :, 5]
    )
    going_badly = (action == SOLVE) & (2 * wrong.sum(axis=1) >= len(principles))
    restarted = going_badly & (draws[:, 0, 0] < students.restarting)
    return Work(principles, elicited, correct, attempts, hints, seconds, hint_seconds, restarted), known


def _seconds(
    elicited: BoolArray,
    attempts: IntArray,
    hints: IntArray,
    *,
    students: Students,
    attention: FloatArray,
    uniforms: FloatArray,
) -> tuple[IntArray, IntArray]:
    """Return whole seconds of each step and of its hints: 25 an answer, 15 for reading a told step, 10 a hint."""
    factor = students.pace[:, None] * (0.5 + uniforms)
    hint_seconds = np.minimum(np.rint(10.0 * hints * factor), SLOWEST_STEP // 2)
    working = np.where(elicited, 25.0 * attempts, 15.0 * attention[:, None]) * factor
    seconds = np.clip(np.rint(working), 1, SLOWEST_STEP // 2) + hint_seconds
    return seconds.astype(np.int64), hint_seconds.astype(np.int64)


@dataclass(frozen=True)
class Session:
    """Everything that was recorded of n students so far.

    Attributes:
        totals: (`MEASURES`, actions, n) sums over the problems done in each of the three ways.
        last: (`MEASURES`, n) the last problem alone.
        by_principle: (`PER_PRINCIPLE`, K, n) sums over the steps of each principle.
        streaks: (4, n) right first answers in a row, wrong ones in a row, longest row of right ones, problems in a row
            without a hint.
        step_seconds: (3, n) longest and shortest step, and longest step of the last problem.
        action: (n,) the last action, -1 before the first.
        repeated: (n,) how many times in a row it was taken.
    """

    totals: FloatArray
    last: FloatArray
    by_principle: FloatArray
    streaks: FloatArray
    step_seconds: FloatArray
    action: IntArray
    repeated: FloatArray

    @classmethod
    def empty(cls, n: int) -> Session:
        """Return the record of n students who have done nothing yet."""
        return cls(
            totals=np.zeros((len(MEASURES), len(ACTIONS), n)),
            last=np.zeros((len(MEASURES), n)),
            by_principle=np.zeros((len(PER_PRINCIPLE), N_PRINCIPLES, n)),
            streaks=np.zeros((4, n)),
            step_seconds=np.zeros((3, n)),
            action=np.full(n, -1),
            repeated=np.zeros(n),
        )

    def total(self, measure: str) -> FloatArray:
        """Return the sum of a measure over all problems, (n,)."""
        return self.totals[MEASURES.index(measure)].sum(axis=0)

    def by_action(self, measure: str) -> FloatArray:
        """Return the sums of a measure over the problems done in each way, (actions, n)."""
        return self.totals[MEASURES.index(measure)]

    def of_last(self, measure: str) -> FloatArray:
        """Return a measure of the last problem, (n,)."""
        return self.last[MEASURES.index(measure)]

    def by(self, count: str) -> FloatArray:
        """Return a count for each principle, (K, n)."""
        return self.by_principle[PER_PRINCIPLE.index(count)]


def record(session: Session, work: Work, action: IntArray) -> Session:
    """Return the session with one more problem."""
    last = _measure(work)
    chosen = np.arange(len(ACTIONS))[:, None] == action
    longest = work.seconds.max(axis=1)
    before = session.step_seconds[1]
    shortest = work.seconds.min(axis=1)
    return Session(
        totals=session.totals + last[:, None] * chosen,
        last=last,
        by_principle=session.by_principle + _by_principle(work),
        streaks=_streaks(session.streaks, work),
        step_seconds=np.stack(
            [
                np.maximum(session.step_seconds[0], longest),
                np.where(session.action < 0, shortest, np.minimum(before, shortest)),
                longest,
            ]
        ),
        action=action.copy(),
        repeated=np.where(action == session.action, session.repeated + 1, 1),
    )


def _measure(work: Work) -> FloatArray:
    """Return the `MEASURES` of one problem, (measures, n)."""
    wrong = work.elicited & ~work.correct
    rows = {
        "problems": np.ones(len(wrong)),
        "seconds": work.seconds.sum(axis=1),
        "steps": np.full(len(wrong), wrong.shape[1]),
        "elicited": work.elicited.sum(axis=1),
        "correct": work.correct.sum(axis=1),
        "wrong": wrong.sum(axis=1),
        "attempts": work.attempts.sum(axis=1),
        "hints": work.hints.sum(axis=1),
        "bottom_outs": (work.hints == 3).sum(axis=1),
        "retries": (wrong & (work.hints == 0)).sum(axis=1),
        "restarts": work.restarted,
        "answering_seconds": (work.seconds * work.elicited).sum(axis=1),
        "correct_seconds": (work.seconds * work.correct).sum(axis=1),
        "wrong_seconds": (work.seconds * wrong).sum(axis=1),
        "hint_seconds": work.hint_seconds.sum(axis=1),
        "perfect": work.elicited.any(axis=1) & ~wrong.any(axis=1),
    }
    return np.stack([rows[name].astype(np.float64) for name in MEASURES])


def _by_principle(work: Work) -> FloatArray:
    added = np.zeros((len(PER_PRINCIPLE), N_PRINCIPLES, len(work.elicited)))
    for step, principle in enumerate(work.principles):
        correct = work.correct[:, step]
        added[0, principle] += 1
        added[1, principle] += correct
        added[2, principle] += work.elicited[:, step] & ~correct
        added[3, principle] += work.hints[:, step]
    return added


def _streaks(before: FloatArray, work: Work) -> FloatArray:
    right, wrong, longest, without = before.copy()
    for step in range(len(work.principles)):
        asked, correct = work.elicited[:, step], work.correct[:, step]
        right = np.where(asked, (right + 1) * correct, right)
        wrong = np.where(asked, (wrong + 1) * ~correct, wrong)
        longest = np.maximum(longest, right)
    without = np.where(work.hints.any(axis=1), 0, without + 1)
    return np.stack([right, wrong, longest, without])
