"""Running a list of checks and telling what they found."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

from oat_gym.errors import ConformanceError

SubjectT = TypeVar("SubjectT")


class Broken(Exception):  # noqa: N818  (a finding, caught by `run_checks`, and not an error of the package)
    """Raised by a check that found its rule broken; the message says where."""


class NotApplicable(Exception):  # noqa: N818
    """Raised by a check that has nothing to look at; the message says why."""


@dataclass(frozen=True)
class Check(Generic[SubjectT]):
    """One rule: `function(subject)` returns how many things it looked at, or raises `Broken`.

    Where a check of `needs` did not pass, this one is not run: its finding would only repeat the other's.
    """

    name: str
    rule: str
    function: Callable[[SubjectT], int]
    needs: tuple[str, ...] = ()


@dataclass(frozen=True)
class Report:
    """What the checks found: (name, count) of those that passed, (name, message) of the others.

    >>> report = Report("demo", passed=(("ids", 3),), skipped=(), failed=())
    >>> report.counts
    {'ids': 3}
    >>> print(report)
    demo: 1 check passed on 3 items
    """

    subject: str
    passed: tuple[tuple[str, int], ...]
    skipped: tuple[tuple[str, str], ...]
    failed: tuple[tuple[str, str], ...]

    @property
    def counts(self) -> dict[str, int]:
        """The number of things that each passed check looked at."""
        return dict(self.passed)

    def __str__(self) -> str:
        items = sum(count for _, count in self.passed)
        plural = "" if len(self.passed) == 1 else "s"
        lines = [f"{self.subject}: {len(self.passed)} check{plural} passed on {items} items"]
        lines += [f"  not run {name}: {reason}" for name, reason in self.skipped]
        lines += [f"  FAILED {name}: {message}" for name, message in self.failed]
        return "\n".join(lines)


class ChecksFailed(ConformanceError):  # noqa: N818  (an error by its base: ConformanceError)
    """At least one check failed; `report` has all findings, and the message lists them."""

    def __init__(self, report: Report) -> None:
        super().__init__(str(report))
        self.report = report


def run_checks(subject_name: str, subject: SubjectT, checks: Sequence[Check[SubjectT]]) -> Report:
    """Run every check and return the report.

    Raises:
        ChecksFailed: if one failed, after all of them were run.
    """
    passed: list[tuple[str, int]] = []
    skipped: list[tuple[str, str]] = []
    failed: list[tuple[str, str]] = []
    for check in checks:
        missing = [name for name in check.needs if name in dict(failed) or name in dict(skipped)]
        if missing:
            reason = dict(skipped).get(missing[0], f"it builds on {missing[0]!r}, which failed")
            skipped.append((check.name, reason))
            continue
        try:
            passed.append((check.name, check.function(subject)))
        except NotApplicable as reason:
            skipped.append((check.name, str(reason)))
        except Broken as finding:
            failed.append((check.name, f"{finding} ({check.rule})"))
        except Exception as error:  # what a dataset raises while it is checked is a finding, not our error
            failed.append((check.name, f"it raised {type(error).__name__}: {error} ({check.rule})"))
    report = Report(subject_name, tuple(passed), tuple(skipped), tuple(failed))
    if failed:
        raise ChecksFailed(report)
    return report
