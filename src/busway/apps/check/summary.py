"""The results of a run: counts, comparison with an earlier run, and whether the device passed.

Knows results; knows no device and prints nothing.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from ...errors import ConfigError
from .check import Outcome, Result

SCHEMA: Final = 1


@dataclass(frozen=True, slots=True)
class Summary:
    """All results of one run of checks against a device, and the outcomes of an earlier run to compare them with.

    Attributes:
        endpoint: URL of the device.
        unit: identifier of the unit that was checked.
        level: name of the highest level of the checks.
        results: the result of each check, in the order in which they ran.
        baseline: outcomes of an earlier run, by the names of checks; empty for no comparison.
    """

    endpoint: str
    unit: int
    level: str
    results: tuple[Result, ...]
    baseline: Mapping[str, str]

    @property
    def counts(self) -> dict[Outcome, int]:
        """The number of checks with each outcome, 0 included."""
        counted = Counter(one.outcome for one in self.results)
        return {outcome: counted[outcome] for outcome in Outcome}

    @property
    def failures(self) -> tuple[Result, ...]:
        """The results for which the run counts as failed: failed checks that did not fail in the earlier run."""
        return tuple(
            one
            for one in self.results
            if one.outcome is Outcome.FAILED and self.baseline.get(one.check.id) != Outcome.FAILED.value
        )

    @property
    def is_aborted(self) -> bool:
        """Whether the device died during the run, so that checks could not be made."""
        return any(one.outcome is Outcome.ABORTED for one in self.results)

    @property
    def changes(self) -> tuple[tuple[str, str, str], ...]:
        """The checks of both runs whose outcome differs: name of the check, its outcome then and now."""
        return tuple(
            (one.check.id, self.baseline[one.check.id], one.outcome.value)
            for one in self.results
            if self.baseline.get(one.check.id, one.outcome.value) != one.outcome.value
        )


def baseline_of(report: Any, name: str) -> dict[str, str]:
    """Return the outcomes of an earlier run, by the names of checks, from its JSON report.

    Args:
        report: the decoded JSON.
        name: name of its file, for errors.

    Raises:
        ConfigError: the JSON is no report of `busway check`, or of another version.
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


def by_clause(results: Sequence[Result]) -> dict[str, list[Result]]:
    """Return results grouped by clause, the groups in the order of their first result."""
    groups: dict[str, list[Result]] = {}
    for one in results:
        groups.setdefault(one.check.clause, []).append(one)
    return groups
