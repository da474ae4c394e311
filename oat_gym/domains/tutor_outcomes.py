"""What SmartPrimer's students achieved, by condition: the check that on-policy values come out right."""

from __future__ import annotations

import csv
import os
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from oat_gym.domains._data import find_file
from oat_gym.errors import InvalidDataError

FloatArray = npt.NDArray[np.float64]

FILE = "tutoring/smartprimer/rlbot_results_by_condition.csv"
CONDITIONS = {"control": "Online A", "rl": "Online D"}
"""Our names of the conditions, and the file's."""
UNFINISHED = -8.0
"""What the log's reward gives a student who did not finish."""
HOW_TO_GET = (
    f"Set OAT_GYM_DATA to a folder that holds {FILE}, or pass path= to the file (from StanfordAI4HI/SmartPrimer_Gym, "
    "commit 12f379e)."
)


@dataclass(frozen=True, eq=False)
class Outcome:
    """The students of one condition; every array is (n,).

    Attributes:
        user_id: the log's numbers of the students.
        completed: whether the student finished.
        pretest: score before, 0 to 8.
        gain: post-test minus pre-test.
        adjusted_gain: the gain as the study counts it (never negative).
    """

    user_id: npt.NDArray[np.int64]
    completed: npt.NDArray[np.bool_]
    pretest: FloatArray
    gain: FloatArray
    adjusted_gain: FloatArray

    def __len__(self) -> int:
        """Return the number of students."""
        return len(self.user_id)

    @property
    def returns(self) -> FloatArray:
        """What the log's last reward is about: the adjusted gain, or `UNFINISHED`."""
        return np.where(self.completed, self.adjusted_gain, UNFINISHED)

    def of(self, user_ids: npt.ArrayLike) -> Outcome:
        """Return the outcomes of the students with these numbers, in their order.

        Raises:
            InvalidDataError: if one is not in this condition.
        """
        place = {int(user): row for row, user in enumerate(self.user_id)}
        wanted = [int(user) for user in np.asarray(user_ids)]
        missing = [user for user in wanted if user not in place]
        if missing:
            raise InvalidDataError(
                f"Students {missing[:5]} are not in this condition ({len(missing)} of {len(wanted)})."
            )
        rows = [place[user] for user in wanted]
        return Outcome(
            self.user_id[rows], self.completed[rows], self.pretest[rows], self.gain[rows], self.adjusted_gain[rows]
        )


def outcomes(path: str | os.PathLike[str] | None = None) -> dict[str, Outcome]:
    """Return the students' outcomes by condition: 69 "control" students, 269 "rl" students.

    Args:
        path: the .csv file, or a folder that holds it.

    Raises:
        DatasetNotFoundError: if the data is not there; the message says how to get it.
        InvalidDataError: if the file does not hold what is expected.

    >>> {name: len(group) for name, group in outcomes().items()}  # doctest: +SKIP
    {'control': 69, 'rl': 269}
    """
    source = find_file(FILE, path=path, how_to_get=HOW_TO_GET)
    with source.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    if any(None in row.values() for row in rows):
        raise InvalidDataError(f"{source} has a row that lacks columns, as in a file that was cut. {HOW_TO_GET}")
    try:
        found = {name: _group([row for row in rows if row["Condition"] == code]) for name, code in CONDITIONS.items()}
    except (KeyError, ValueError) as error:
        raise InvalidDataError(f"{source} is not the table of outcomes ({error}). {HOW_TO_GET}") from error
    empty = [name for name, group in found.items() if not len(group)]
    if empty:
        raise InvalidDataError(f"{source} holds no student of the condition {empty[0]!r}. {HOW_TO_GET}")
    return found


def mean_and_error(values: FloatArray) -> tuple[float, float]:
    """Return the mean of independent values and its standard error.

    >>> mean_and_error(np.array([1.0, 3.0]))
    (2.0, 1.0)
    """
    return float(values.mean()), float(values.std(ddof=1) / len(values) ** 0.5)


def _group(rows: list[dict[str, str]]) -> Outcome:
    def column(name: str) -> FloatArray:
        return np.array([float(row[name]) for row in rows])

    return Outcome(
        user_id=column("UserID").astype(np.int64),
        completed=np.array([row["Complete"] == "Y" for row in rows]),
        pretest=column("Pre"),
        gain=column("ImprovementAbsolute"),
        adjusted_gain=column("ImprovementAdjusted"),
    )
