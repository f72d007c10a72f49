"""``busway check``: checks a device against the specification, and reports where it differs.

The checks are `busway.apps.check`; here are their arguments, what is printed while they run, and the report files.
"""

import json
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import typer

from ..codes import LAST_SERIAL_UNIT, TABLE_SIZE, Table
from ..config.files.file_error import FileError
from ..errors import ConfigError
from ..safe_files import check_replaceable, read_safely, write_whole
from ..values.addresses import parse_address
from ..values.counts import counted
from .arguments import CAPTURE, QUIET, URL, VERBOSE, seconds, show_traffic, whole_number
from .exits import ExitCode
from .files import cannot_be_written, capturing
from .output import say

if TYPE_CHECKING:
    from ..apps.check.check import CheckResult, Items, Level, Target, TlsChange
    from ..apps.check.summary import Summary
    from ..apps.check.tls_wire import ClientCertificate

EXAMPLES = """\b
Examples:
  busway check tcp://10.0.0.5 --unit 1 --probe 3x1
  busway check rtu:///dev/ttyUSB0 --unit 5 --level diag --report html=check.html
  busway check tcp://10.0.0.5 --level write --scratch 4x101:8,0x1:8
  busway check tcp://10.0.0.5 --report json=now.json --baseline last.json

Nothing is written, except to what --scratch names; that is restored afterwards.
"""

_MOST_BASELINE = 64 << 20
_MOST = {Table.HOLDING_REGISTERS: 123, Table.COILS: 1968}
_CLASSES = {"mbap": ("tcp",), "rtu": ("basic", "regular"), "ascii": ("regular",)}


def check(
    url: str = URL,
    unit: str | None = typer.Option(
        None, "-u", "--unit", metavar="U", help="Unit identifier, 0…255; on TCP 255, on a line 1."
    ),
    level: str = typer.Option(
        "read", "--level", metavar="LEVEL", help="What may be done to the device: read, diag, write, disruptive."
    ),
    scratch: str | None = typer.Option(
        None, "--scratch", metavar="ITEMS", help="What may be written: 4x101:8, 4x101:8,0x1:8."
    ),
    probe: str = typer.Option("4x1", "--probe", metavar="ITEM", help="An item that can be read at any time: 4x1."),
    kind: str | None = typer.Option(None, "--class", metavar="CLASS", help="tcp, basic or regular (of a serial line)."),
    only: str | None = typer.Option(None, "--only", metavar="LIST", help="Only these clauses or checks: A10,T28."),
    report: str | None = typer.Option(
        None, "--report", metavar="FILES", help="Write reports: html=F,junit=F,json=F,md=F."
    ),
    baseline: str | None = typer.Option(
        None, "--baseline", metavar="FILE", help="A JSON report: what failed then does not fail now."
    ),
    certificates: str | None = typer.Option(
        None,
        "--certificates",
        metavar="FILES",
        help="Client certificates that the device must refuse: expired=CERT:KEY,revoked=C:K,denied=C:K,no-role=C:K.",
    ),
    timeout: str = typer.Option("1s", "--timeout", metavar="TIME", help="The longest wait for a reply: 1s."),
    quiet_time: str = typer.Option(
        "50ms", "--quiet-time", metavar="TIME", help="Silence behind a frame that may stay unanswered: 50ms."
    ),
    idle: str = typer.Option("2s", "--idle", metavar="TIME", help="How long checks of idle connections wait: 2s."),
    capture: str | None = CAPTURE,
    verbose: int = VERBOSE,
    quiet: bool = QUIET,
) -> int:
    """Check a device against the specification."""
    from ..apps.check.catalogue import checks_for
    from ..apps.check.check import Level, Outcome
    from ..apps.check.run import CheckRun, Pace
    from ..apps.check.summary import Summary
    from ..apps.check.wire import dialer_for
    from ..options.endpoints import parse_endpoint, require_host

    endpoint = parse_endpoint(url)
    require_host(endpoint)
    dialer = dialer_for(endpoint, certificates=_certificates(certificates, is_secure=endpoint.carrier == "tls"))
    chosen = _level(level)
    target = _target(dialer.framing, dialer.has_connections, unit, probe, scratch, kind)
    target = replace(target, is_secure=endpoint.carrier == "tls")
    if scratch is not None and chosen < Level.WRITE:
        raise ConfigError(f"goes with --level write or disruptive; level {level} writes nothing", key="--scratch")
    files = _report_files(report)
    before = {} if baseline is None else _baseline(baseline)
    checks = checks_for(target, chosen, [] if only is None else [name.strip() for name in only.split(",")])
    pace = Pace(
        seconds(timeout, "--timeout", high=60),
        seconds(quiet_time, "--quiet-time", high=10),
        seconds(idle, "--idle", high=3600),
    )
    show_traffic(verbose)
    made = len(checks) + any(check.writes for check in checks)  # restoring what they wrote is one more
    say(f"{counted(made, 'check')} of {endpoint.url}, unit {target.unit}, level {chosen.name.lower()}")
    if chosen >= Level.WRITE and scratch is None:
        say("no check of writes is made: --scratch 4x101:8,0x1:8 would name the items that may be written")
    results = []
    with capturing(capture):
        for result in CheckRun(dialer, target, pace).results(checks):
            results.append(result)
            if result.outcome in (Outcome.FAILED, Outcome.WARNED, Outcome.ABORTED):
                _show(result)
    summary = Summary(endpoint.url, target.unit, chosen.name.lower(), tuple(results), before)
    _conclude(summary)
    _write_reports(files, summary)
    if summary.is_aborted:
        return ExitCode.BROKEN
    return ExitCode.FAILED if summary.failures else ExitCode.DONE


# Arguments.


def _level(text: str) -> "Level":
    from ..apps.check.check import Level

    names = {level.name.lower(): level for level in Level}
    if text not in names:
        raise ConfigError(f"one of {', '.join(names)} is needed, not {text!r}", key="--level")
    return names[text]


def _target(
    framing: str, has_connections: bool, unit: str | None, probe: str, scratch: str | None, kind: str | None
) -> "Target":
    from ..apps.check.check import Target

    if kind is not None and kind not in _CLASSES[framing]:
        raise ConfigError(f"{' or '.join(_CLASSES[framing])} goes with this URL, not {kind!r}", key="--class")
    low, high = (0, 255) if framing == "mbap" else (1, LAST_SERIAL_UNIT)
    number = (255 if framing == "mbap" else 1) if unit is None else whole_number(unit, "--unit", low, high)
    registers, coils = _scratch(scratch)
    return Target(framing, has_connections, number, _items(probe, "--probe", 1), registers, coils)


def _items(text: str, key: str, count: int) -> "Items":
    from ..apps.check.check import Items

    place = parse_address(text)
    if place.table is None or place.bit is not None:
        raise ConfigError(f"an item with its table is needed, such as 4x1 or 3x1, not {text!r}", key=key)
    if place.offset + count > TABLE_SIZE:
        raise ConfigError(f"{text} ends beyond the table", key=key)
    return Items(place.table, place.offset, count)


def _scratch(text: str | None) -> tuple["Items | None", "Items | None"]:
    """Return the registers and the coils that ``--scratch`` permits to write; None for each that it does not name.

    Raises:
        ConfigError: the text is not such as ``4x101:8,0x1:8``, names other tables, or names a table twice.
    """
    found: dict[Table, Items] = {}
    for part in [] if text is None else text.split(","):
        address, colon, size = part.strip().rpartition(":")
        if not colon:
            raise ConfigError(f"address and count are needed, such as 4x101:8, not {part.strip()!r}", key="--scratch")
        table = _items(address, "--scratch", 1).table
        if table not in _MOST:
            raise ConfigError(f"registers (4x) and coils (0x) can be written, not {part.strip()!r}", key="--scratch")
        if table in found:
            raise ConfigError(f"{table.label}s are named twice", key="--scratch")
        found[table] = _items(address, "--scratch", whole_number(size, "--scratch", 2, _MOST[table]))
    return found.get(Table.HOLDING_REGISTERS), found.get(Table.COILS)


def _report_files(text: str | None) -> "list[tuple[str, Callable[[Summary], str]]]":
    """Return the path of each report that ``--report`` asks for, with the function that formats it.

    Raises:
        ConfigError: the text is not a list such as ``html=FILE,json=FILE``, a folder is missing or no file can be made
            in it, or a file exists that is no report of the same form.
    """
    import tempfile  # here: it takes 10 ms

    from ..apps.check.reports import REPORT_BEGINNINGS, REPORTS

    files = []
    for part in [] if text is None else text.split(","):
        name, sign, path = part.strip().partition("=")
        if name not in REPORTS or not sign or not path:
            raise ConfigError(
                f"{', '.join(REPORTS)}, each with =FILE, are needed, not {part.strip()!r}", key="--report"
            )
        begin = REPORT_BEGINNINGS[name]
        whole = check_replaceable(path, is_ours=partial(_begins_with, begin), kind=f"{name} report of busway check")
        if not os.path.isdir(os.path.dirname(whole)):
            raise ConfigError("cannot be written: there is no such folder", file=path)
        try:
            with tempfile.TemporaryFile(dir=os.path.dirname(whole)):
                pass
        except OSError as error:
            raise cannot_be_written(path, error) from error
        files.append((whole, REPORTS[name]))
    return files


def _write_reports(files: "Sequence[tuple[str, Callable[[Summary], str]]]", summary: "Summary") -> None:
    """Write all reports.

    Args:
        files: path of each report, with the function that formats it.
        summary: what they report.

    Raises:
        FileError: reports could not be written, with a problem for each; the others are written.
    """
    problems = []
    for path, form in files:
        try:
            write_whole(path, form(summary))
        except OSError as error:
            problems.append(cannot_be_written(path, error))
    if problems:
        raise FileError(problems)


def _begins_with(begin: bytes, head: bytes) -> bool:
    return head.startswith(begin)


def _certificates(text: str | None, *, is_secure: bool) -> "dict[TlsChange, ClientCertificate]":
    from ..apps.check.tls_wire import CERTIFICATES, ClientCertificate
    from ..options.tls import TlsParameters, Verify
    from ..transport.tls.context import client_context

    if text is None:
        return {}
    if not is_secure:
        raise ConfigError("certificates go with tls://", key="--certificates")
    found = {}
    for part in text.split(","):
        name, sign, paths = part.strip().partition("=")
        certificate, colon, key = paths.rpartition(":")
        if name not in CERTIFICATES or not sign or not colon or not certificate or not key:
            words = ", ".join(CERTIFICATES)
            raise ConfigError(
                f"{words}, each with =CERTIFICATE:KEY, are needed, not {part.strip()!r}", key="--certificates"
            )
        client_context(TlsParameters(certificate=certificate, key=key, verify=Verify.OFF_INSECURE))  # can it be read?
        found[CERTIFICATES[name]] = ClientCertificate(certificate, key)
    return found


def _baseline(path: str) -> Mapping[str, str]:
    from ..apps.check.summary import baseline_of

    try:
        return baseline_of(json.loads(read_safely(path, most=_MOST_BASELINE)), path)
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{path} is no JSON: {error}", key="--baseline") from error


# What is printed.


def _show(result: "CheckResult") -> None:
    from ..apps.check.reports import line_of

    check = result.check
    print(f"{result.outcome.value:8} {check.clause:4} {check.id}: {check.says}")
    if result.reason:
        print(f"         {result.reason}")
    for one in result.evidence:
        print(f"         {line_of(one)}")
    sys.stdout.flush()


def _conclude(summary: "Summary") -> None:
    from ..apps.check.reports import counts_line

    for name, before, now in summary.changes:
        print(f"changed  {name}: {before} before, {now} now")
    print(f"{counted(len(summary.results), 'check')}: {counts_line(summary)}")
