"""Reports of a run: Markdown, JSON, JUnit XML and HTML, each as one text.

Knows summaries; opens no file. Bytes of a device are shown as hexadecimal digits and in the dissector's words.
"""

import html
import json
from collections.abc import Callable, Mapping
from typing import Final
from xml.sax.saxutils import escape, quoteattr

from .check import CheckResult, Evidence, Outcome
from .clauses import CLAUSES
from .summary import SCHEMA, Summary, by_clause

_TOLD: Final = (Outcome.FAILED, Outcome.WARNED, Outcome.ABORTED)
"""Outcomes whose evidence (bytes sent and received) the Markdown and HTML reports show."""
_LONGEST_HEX: Final = 40


def hex_of(data: bytes) -> str:
    """Return bytes as spaced hexadecimal digits; of more than 40 bytes the first 40, followed by the total number."""
    shown = data[:_LONGEST_HEX].hex(" ")
    return shown if len(data) <= _LONGEST_HEX else f"{shown} … ({len(data)} bytes)"


def line_of(evidence: Evidence) -> str:
    """Return one piece of evidence as a line: ``->`` (sent) or ``<-`` (received), the bytes, and what they mean.

    The bytes are those of `hex_of`: the first 40, and the number of all. An event without bytes is ``--`` and its text.
    """
    if not evidence.data:
        return f"-- {evidence.words}"
    return f"{'->' if evidence.sent else '<-'} {hex_of(evidence.data)}   {evidence.words}"


def counts_line(summary: Summary) -> str:
    """Return how many checks had each outcome, as one line such as ``80 pass, 2 fail``."""
    return ", ".join(f"{count} {outcome.value}" for outcome, count in summary.counts.items() if count)


def markdown(summary: Summary) -> str:
    """Return the report as Markdown: a table of all checks, and the differences from the earlier run, if there is one.

    Failed, aborted and warned checks have a section with their reason and evidence.
    """
    lines = [
        f"# Check of {summary.endpoint}, unit {summary.unit}",
        "",
        f"Level {summary.level}: {counts_line(summary)}.",
        "",
        "| clause | check | is | outcome | what the device does if it passes |",
        "| --- | --- | --- | --- | --- |",
    ]
    for clause, results in by_clause(summary.results).items():
        for one in results:
            check = one.check
            lines.append(f"| {clause} | {check.id} | {check.word.value} | {one.outcome.value} | {check.says} |")
    for one in summary.results:
        if one.outcome in _TOLD:
            lines += [
                "",
                f"## {one.check.id}: {one.outcome.value}",
                "",
                f"{one.check.clause}, {CLAUSES[one.check.clause]}. {one.reason}.",
            ]
            if one.evidence:
                lines += ["", "```", *(line_of(each) for each in one.evidence), "```"]
    if summary.changes:
        lines += ["", "## Changes", "", "| check | before | now |", "| --- | --- | --- |"]
        lines += [f"| {name} | {before} | {now} |" for name, before, now in summary.changes]
    return "\n".join(lines) + "\n"


def as_json(summary: Summary) -> str:
    """Return the report as JSON text, with all evidence; `baseline_of` reads it to compare a later run with it."""
    report = {
        "schema": SCHEMA,
        "endpoint": summary.endpoint,
        "unit": summary.unit,
        "level": summary.level,
        "counts": {outcome.value: count for outcome, count in summary.counts.items()},
        "checks": [_json_of(one) for one in summary.results],
    }
    return json.dumps(report, indent=1, ensure_ascii=False) + "\n"


def _json_of(result: CheckResult) -> dict[str, object]:
    check = result.check
    return {
        "id": check.id,
        "clause": check.clause,
        "word": check.word.value,
        "level": check.level.name.lower(),
        "says": check.says,
        "outcome": result.outcome.value,
        "reason": result.reason,
        "evidence": [{"sent": one.sent, "bytes": one.data.hex(), "words": one.words} for one in result.evidence],
    }


def junit(summary: Summary) -> str:
    """Return the report as JUnit XML, one test case per check.

    Failed checks are failures, aborted ones errors, warned ones passed tests with output; undecided checks and those
    that are not offered are skipped.
    """
    counts = summary.counts
    skipped = counts[Outcome.NOT_OFFERED] + counts[Outcome.UNDECIDED]
    name = quoteattr(f"busway check {summary.endpoint} unit {summary.unit}")
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        f'<testsuite name={name} tests="{len(summary.results)}" failures="{counts[Outcome.FAILED]}"'
        f' errors="{counts[Outcome.ABORTED]}" skipped="{skipped}">',
    ]
    for one in summary.results:
        lines.append(f"  <testcase classname={quoteattr(one.check.clause)} name={quoteattr(one.check.id)}>")
        lines.append(f"    {_junit_outcome(one)}" if one.outcome is not Outcome.PASSED else "")
        lines.append("  </testcase>")
    return "\n".join(line for line in [*lines, "</testsuite>"] if line) + "\n"


def _junit_outcome(result: CheckResult) -> str:
    text = escape("\n".join([result.check.says, *(line_of(one) for one in result.evidence)]))
    message = quoteattr(result.reason or result.outcome.value)
    if result.outcome is Outcome.FAILED:
        return f"<failure message={message}>{text}</failure>"
    if result.outcome is Outcome.ABORTED:
        return f"<error message={message}>{text}</error>"
    if result.outcome is Outcome.WARNED:
        return f"<system-out>{escape('warning: ' + result.reason)}\n{text}</system-out>"
    return f"<skipped message={message}/>"


_STYLE: Final = (
    "body{font:16px/1.5 system-ui,sans-serif;max-width:70em;margin:2em auto;padding:0 1em;color-scheme:light dark}"
    "table{border-collapse:collapse}td,th{text-align:left;padding:.2em .8em .2em 0;vertical-align:top}"
    "pre{overflow-x:auto}"
)


def as_html(summary: Summary) -> str:
    """Return the report as one HTML page that has no scripts and loads nothing.

    It has a table of the checks of each clause; failed, warned and aborted checks show their bytes.
    """
    title = html.escape(f"Check of {summary.endpoint}, unit {summary.unit}")
    parts = [
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{title}</title>',
        f"<style>{_STYLE}</style></head>",
        f"<body><h1>{title}</h1>",
        f"<p>Level {html.escape(summary.level)}: {html.escape(counts_line(summary))}.</p>",
    ]
    for clause, results in by_clause(summary.results).items():
        parts.append(f"<h2>{clause}: {html.escape(CLAUSES[clause])}</h2>\n<table>")
        parts += [_html_row(one) for one in results]
        parts.append("</table>")
    return "\n".join([*parts, "</body></html>"]) + "\n"


def _html_row(result: CheckResult) -> str:
    check = result.check
    told = ""
    if result.reason:
        told = f"<br>{html.escape(result.reason)}"
    if result.outcome in _TOLD and result.evidence:
        lines = html.escape("\n".join(line_of(one) for one in result.evidence))
        told += f"<details><summary>bytes</summary><pre>{lines}</pre></details>"
    cells = (result.outcome.value, check.word.value, check.id)
    return (
        "<tr>"
        + "".join(f"<td>{html.escape(cell)}</td>" for cell in cells)
        + f"<td>{html.escape(check.says)}{told}</td></tr>"
    )


REPORTS: Final[Mapping[str, Callable[[Summary], str]]] = {
    "html": as_html,
    "junit": junit,
    "json": as_json,
    "md": markdown,
}
"""The function that formats a report, by the name of its form, which is the word before ``=`` in ``--report``."""

REPORT_BEGINNINGS: Final[Mapping[str, bytes]] = {
    "html": b'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>Check of ',
    "junit": b'<?xml version="1.0" encoding="UTF-8"?>\n<testsuite name=',
    "json": b'{\n "schema": ',
    "md": b"# Check of ",
}
"""The first bytes of a report, by the name of its form.

A file that begins with them is taken for an older report, and may be overwritten.
"""
