"""The students of `oat_gym/Tutor-v0`: Bayesian knowledge tracing with an aptitude-treatment interaction.

Sources of the model and of the ranges of its parameters:

- Corbett and Anderson, "Knowledge tracing", User Modeling and User-Adapted Interaction 4, 1995: each principle is known
  or not; an unknown one is learned at an opportunity with P(T), and answers slip P(S) or are guessed P(G).
- Baker, Corbett and Aleven, "More accurate student modeling through contextual estimation of slip and guess
  probabilities", ITS 2008: P(G) at most 0.3 and P(S) at most 0.1.
- Yudelson, Koedinger and Gordon, "Individualized Bayesian knowledge tracing models", AIED 2013: prior knowledge and
  P(T) differ between students.
- Kalyuga, Ayres, Chandler and Sweller, "The expertise reversal effect", Educational Psychologist 38, 2003: novices
  learn more from worked examples, advanced students from solving problems themselves.

How P(T) depends on the action, and attention, are ours (`teaching`, `attention_after`), chosen so that the best action
differs by student and moment. Times are whole seconds, as in a log: every count is exact, so that a student alone and
the same student among thousands give the same numbers.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from oat_gym.errors import InvalidDataError

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

SOLVE, STUDY, TOGETHER = 0, 1, 2
ACTIONS = ("solve", "study", "together")
"""What action 0, 1 and 2 mean: problem solving (PS), worked example (WE), the two in turn (CPS, or FWE)."""

PRINCIPLES = (
    "complement",
    "addition",
    "exclusion",
    "conditional",
    "multiplication",
    "independence",
    "conditional_independence",
    "de_morgan",
    "total_probability",
    "bayes",
)
"""The knowledge components: principles of elementary probability, from easy to hard."""
EASE = np.array([-0.2, -0.3, -0.5, -0.8, -0.9, -1.0, -1.4, -1.4, -1.7, -2.0])
"""Log-odds that an average student knows each principle before tutoring."""

PROBLEMS: tuple[tuple[int, ...], ...] = (
    (0, 1, 0, 1),
    (1, 2, 1, 2, 0),
    (3, 4, 3, 4, 1),
    (5, 4, 5, 0, 5),
    (3, 4, 7, 7, 0, 2),
    (8, 3, 4, 8, 1, 8),
    (6, 5, 6, 3, 6, 4),
    (7, 5, 7, 2, 6, 0, 7),
    (9, 3, 8, 4, 9, 8, 9),
    (6, 8, 5, 8, 2, 6, 3),
    (9, 8, 9, 7, 4, 9, 1, 6),
    (9, 6, 8, 7, 5, 9, 8, 6),
)
"""The principle of each step of the twelve problems (Q-matrix), in the order that every student meets them."""
N_PROBLEMS, N_PRINCIPLES, MAX_STEPS = len(PROBLEMS), len(PRINCIPLES), max(map(len, PROBLEMS))

ISOMORPHIC = ((0,), (1,), (2,), (3,), (4,), (5,), (6,), (7,), (8,), (9,), (3, 4), (5, 0), (8, 3), (9, 8))
"""The principles of the 14 items that pre-test and post-test share in kind."""
POST_ITEMS = (*ISOMORPHIC, (7, 2, 5), (9, 8, 4), (6, 5, 3), (8, 6, 7), (9, 7, 1), (6, 8, 9))
"""The 20 items of the post-test; the last six need several principles."""

SLOWEST_STEP = 300
"""A step takes at most so many seconds."""


@dataclass(frozen=True)
class Students:
    """What is fixed about n students; every field is (n,).

    Attributes:
        learning: P(T) under teaching of strength 1.
        guess: P(G), 0.1 to 0.3.
        slip: P(S), 0.02 to 0.1.
        pace: factor on all times, 0.4 to 2.5.
        help_seeking: probability of asking for a hint after an error.
        restarting: probability of starting a problem again that goes badly.
    """

    learning: FloatArray
    guess: FloatArray
    slip: FloatArray
    pace: FloatArray
    help_seeking: FloatArray
    restarting: FloatArray


N_NORMALS = 5
N_UNIFORMS = 2 + N_PRINCIPLES


def draw_students(normals: FloatArray, uniforms: FloatArray) -> tuple[Students, BoolArray]:
    """Return n students and what they know, (n, K) booleans.

    Args:
        normals: (n, `N_NORMALS`) standard normal numbers: aptitude, learning, pace, help-seeking, restarting.
        uniforms: (n, `N_UNIFORMS`) numbers in [0, 1): guess, slip, and one a principle.
    """
    aptitude = normals[:, 0]
    students = Students(
        learning=sigmoid(-1.5 + 0.2 * aptitude + 0.5 * normals[:, 1]),
        guess=0.1 + 0.2 * uniforms[:, 0],
        slip=0.02 + 0.08 * uniforms[:, 1],
        pace=np.clip(np.exp(0.3 * normals[:, 2]), 0.4, 2.5),
        help_seeking=sigmoid(normals[:, 3]),
        restarting=sigmoid(-0.5 + normals[:, 4]),
    )
    return students, uniforms[:, 2:] < sigmoid(EASE + 1.2 * aptitude[:, None])


def teaching(action: IntArray, readiness: FloatArray) -> FloatArray:
    """Return the strength of teaching, (n,): the factor on P(T) of working on a problem in one of the three ways.

    Readiness is the share of the problem's steps that the student knows at its start. Worked examples are best below
    about 0.35, solving alone above about 0.55, working together between.

    >>> teaching(np.array([SOLVE, STUDY, TOGETHER]), np.zeros(3)).round(2).tolist()
    [0.1, 1.3, 0.45]
    >>> teaching(np.array([SOLVE, STUDY, TOGETHER]), np.ones(3)).round(2).tolist()
    [1.6, 0.1, 0.45]
    """
    solve, study = 0.1 + 1.5 * readiness, 1.3 - 1.2 * readiness
    together = 0.45 + 2.0 * readiness * (1.0 - readiness)
    return np.choose(action, (solve, study, together))


def attention_after(attention: FloatArray, action: IntArray, wrong_share: FloatArray) -> FloatArray:
    """Return the attention (n,), 0.4 to 1, after a problem: the factor on P(T) in the next one.

    Reading tires by 0.2, and so does failing on half of the answers or more; all else restores 0.2.
    """
    tiring = (action == STUDY) | (wrong_share >= 0.5)
    return np.clip(attention + np.where(tiring, -0.2, 0.2), 0.4, 1.0)


def answers_right(known: BoolArray, students: Students, uniforms: FloatArray) -> BoolArray:
    """Return whether first answers are right, (n,): 1 - P(S) where the principle is known, else P(G)."""
    return uniforms < np.where(known, 1.0 - students.slip, students.guess)


def score(items: tuple[tuple[int, ...], ...], known: BoolArray, students: Students, uniforms: FloatArray) -> FloatArray:
    """Return the share of right applications of each principle in a test, (n, items): partial credit for each item.

    Args:
        items: the principles of each item.
        known: (n, K) what the students know.
        students: the students.
        uniforms: (n, `n_applications(items)`) numbers in [0, 1).
    """
    credit = np.empty((len(known), len(items)))
    used = 0
    for number, item in enumerate(items):
        right = [
            answers_right(known[:, principle], students, uniforms[:, used + part])
            for part, principle in enumerate(item)
        ]
        credit[:, number] = np.mean(right, axis=0)
        used += len(item)
    return credit


def n_applications(items: tuple[tuple[int, ...], ...]) -> int:
    """Return how many principles a test asks for, counted with repetition."""
    return sum(map(len, items))


def normalized_learning_gain(pretest: FloatArray, posttest: FloatArray) -> FloatArray:
    """Return NLG = (posttest - pretest) / sqrt(1 - pretest) of scores in [0, 1] (the paper's appendix E.1).

    Raises:
        InvalidDataError: for scores outside [0, 1], or a pre-test of 1, which leaves nothing to gain.

    >>> normalized_learning_gain(np.array([0.75, 0.0]), np.array([1.0, 0.5])).tolist()
    [0.5, 0.5]
    """
    scores = np.stack([pretest, posttest])
    if not ((scores >= 0) & (scores <= 1)).all() or (np.asarray(pretest) == 1).any():
        raise InvalidDataError("Scores must be from 0 to 1, and below 1 in the pre-test.")
    return (posttest - pretest) / np.sqrt(1.0 - pretest)


def sigmoid(values: FloatArray) -> FloatArray:
    """Return 1 / (1 + exp(-x))."""
    return 1.0 / (1.0 + np.exp(-values))
