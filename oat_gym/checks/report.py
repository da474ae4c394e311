"""Running a list of checks and telling what they found."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
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

    Where a check of `needs` did not pass, or one of `after` failed, this one is not run: its finding would only repeat
    the other's.
    """

    name: str
    rule: str
    function: Callable[[SubjectT], int]
    needs: tuple[str, ...] = ()
    after: tuple[str, ...] = ()


@dataclass(frozen=True)
class Report:
    """What the checks found: (name, count) of those that passed, (name, message) of the others.

    `expected_failed` are those that were said beforehand to fail, each with the reason given and what was found.

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
    expected_failed: tuple[tuple[str, str], ...] = ()

    @property
    def counts(self) -> dict[str, int]:
        """The number of things that each passed check looked at."""
        return dict(self.passed)

    def __str__(self) -> str:
        items = sum(count for _, count in self.passed)
        plural = "" if len(self.passed) == 1 else "s"
        lines = [f"{self.subject}: {len(self.passed)} check{plural} passed on {items} items"]
        lines += [f"  not run {name}: {reason}" for name, reason in self.skipped]
        lines += [f"  failed as expected {name}: {message}" for name, message in self.expected_failed]
        lines += [f"  FAILED {name}: {message}" for name, message in self.failed]
        return "\n".join(lines)


class ChecksFailed(ConformanceError):  # noqa: N818  (an error by its base: ConformanceError)
    """At least one check failed; `report` has all findings, and the message lists them."""

    def __init__(self, report: Report) -> None:
        super().__init__(str(report))
        self.report = report


def run_checks(
    subject_name: str,
    subject: SubjectT,
    checks: Sequence[Check[SubjectT]],
    *,
    expected: Mapping[str, str] | None = None,
    may_pass: bool = False,
) -> Report:
    """Run every check and return the report.

    `expected` names checks that are to fail, each with the reason: one of them that is no check is a failure, and so
    is one that passes, unless `may_pass`.

    Raises:
        ChecksFailed: if one failed, after all of them were run.
    """
    passed, skipped, findings = _run_all(subject, checks)
    known = dict(expected or {})
    unknown = {name: reason for name, reason in known.items() if name not in {check.name for check in checks}}
    unexpected = () if may_pass else tuple(name for name in passed if name in known)
    failed = [
        *((name, finding) for name, finding in findings.items() if name not in known),
        *((name, f"it was expected to fail ({known[name]}) but passed") for name in unexpected),
        *((name, f"it was expected to fail ({why}), and no check has this name") for name, why in unknown.items()),
    ]
    report = Report(
        subject_name,
        passed=tuple((name, count) for name, count in passed.items() if name not in unexpected),
        skipped=tuple(skipped.items()),
        failed=tuple(failed),
        expected_failed=tuple((name, f"{known[name]} [{text}]") for name, text in findings.items() if name in known),
    )
    if failed:
        raise ChecksFailed(report)
    return report


def _run_all(
    subject: SubjectT, checks: Sequence[Check[SubjectT]]
) -> tuple[dict[str, int], dict[str, str], dict[str, str]]:
    """Return the counts of the checks that passed, why others were not run, and what the rest found."""
    passed: dict[str, int] = {}
    skipped: dict[str, str] = {}
    findings: dict[str, str] = {}
    for check in checks:
        missing = [name for name in check.needs if name in findings or name in skipped]
        missing += [name for name in check.after if name in findings]
        if missing:
            skipped[check.name] = skipped.get(missing[0], f"it builds on {missing[0]!r}, which failed")
            continue
        try:
            passed[check.name] = check.function(subject)
        except NotApplicable as reason:
            skipped[check.name] = str(reason)
        except Broken as finding:
            findings[check.name] = f"{finding} ({check.rule})"
        except Exception as error:  # what a subject raises while it is checked is a finding, not our error
            findings[check.name] = f"it raised {type(error).__name__}: {error} ({check.rule})"
    return passed, skipped, findings
