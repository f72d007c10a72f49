"""The results of a run: counts, comparison with an earlier run, and whether the device passed.

Knows results; knows no device and prints nothing.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from ...errors import ConfigError
from .check import CheckResult, Outcome

SCHEMA: Final = 1


@dataclass(frozen=True, slots=True)
class Summary:
    """All results of one run of checks against a device, and the outcomes of an earlier run to compare them with.

    Attributes:
        endpoint: URL of the device.
        unit: identifier of the unit that was checked.
        level: name of the highest level of the checks, in lower case: ``read``.
        results: the result of each check, in the order in which they ran.
        baseline: outcome of each check of the earlier run (a value of `Outcome`), by the check's name; empty if there
            is no earlier run to compare with.
    """

    endpoint: str
    unit: int
    level: str
    results: tuple[CheckResult, ...]
    baseline: Mapping[str, str]

    @property
    def counts(self) -> dict[Outcome, int]:
        """The number of checks with each outcome; outcomes that no check has are 0."""
        counted = Counter(one.outcome for one in self.results)
        return {outcome: counted[outcome] for outcome in Outcome}

    @property
    def failures(self) -> tuple[CheckResult, ...]:
        """The results that make the run a failure: checks that failed now and had not failed in the earlier run."""
        return tuple(
            one
            for one in self.results
            if one.outcome is Outcome.FAILED and self.baseline.get(one.check.id) != Outcome.FAILED.value
        )

    @property
    def is_aborted(self) -> bool:
        """Whether a check was aborted, because the device stopped answering during the run."""
        return any(one.outcome is Outcome.ABORTED for one in self.results)

    @property
    def changes(self) -> tuple[tuple[str, str, str], ...]:
        """The checks whose outcome differs from the earlier run: name, outcome then, outcome now (words of `Outcome`).

        Checks that only one of the runs has are left out.
        """
        return tuple(
            (one.check.id, self.baseline[one.check.id], one.outcome.value)
            for one in self.results
            if self.baseline.get(one.check.id, one.outcome.value) != one.outcome.value
        )


def baseline_of(report: Any, name: str) -> dict[str, str]:
    """Return the outcomes in the JSON report of an earlier run, as values of `Outcome`, by the name of the check.

    Args:
        report: the decoded JSON.
        name: name of the report's file, for errors.

    Raises:
        ConfigError: the JSON is no report of `busway check`, has another schema version, or has a check without name or
            outcome.
    """
    checks = report.get("checks") if isinstance(report, dict) else None
    if not isinstance(checks, list) or report.get("schema") != SCHEMA:
        raise ConfigError(f"{name} is no report that `busway check --report json=FILE` wrote", key="--baseline")
    found = {}
    for one in checks:
        if not isinstance(one, dict) or not isinstance(one.get("id"), str) or not isinstance(one.get("outcome"), str):
            raise ConfigError(f"{name} has a check without id or outcome", key="--baseline")
        found[one["id"]] = one["outcome"]
    return found


def by_clause(results: Sequence[CheckResult]) -> dict[str, list[CheckResult]]:
    """Return results grouped by clause, the groups in the order of their first result."""
    groups: dict[str, list[CheckResult]] = {}
    for one in results:
        groups.setdefault(one.check.clause, []).append(one)
    return groups
