"""``busway status``: shows the status of a running server or gateway, over its control socket.

1. Without an argument the running programs of this user are found: one is shown in full, several are listed. Collectors
   have no control socket: the address of their page is printed, and the command that shows more.
2. A status indicator is a word; on a terminal it has a colour, too (S19: steady is *on*, blinking is *flashing*).
3. All entries of the program's status are shown, also those that this command does not know; numbers that are zero and
   empty texts are left out.
"""

import sys
from collections.abc import Iterator
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import typer

from ..errors import LinkDown, ModbusError
from .arguments import seconds
from .exits import ExitCode
from .output import print_aligned, print_json, warn
from .signals import stop_flag

if TYPE_CHECKING:
    from ..apps.control.client import Running
    from .status_view import StatusSection

EXAMPLES = """\b
Examples:
  busway status
  busway status 4711
  busway status /run/plant/control.sock --watch 2s
  busway status http://127.0.0.1:4711 --json

Programs are asked over the socket that they make at their start (--control). Of collectors the pages are named, which
show their status.
"""

_WHOLE = ("listener", "connection", "process", "page")
"""Headings of the columns whose cells are never wrapped, also on a narrow terminal."""


def status(
    where: str | None = typer.Argument(
        None, metavar="[PATH|URL|PID]", help="What to ask: a socket, a URL on loopback, a process ID."
    ),
    as_json: bool = typer.Option(False, "--json", help="Print all that is told as one JSON object."),
    watch: str | None = typer.Option(None, "--watch", metavar="TIME", help="Ask again and again: 2s. Ends by Ctrl-C."),
) -> int:
    """Show the status of a running server or gateway, and name the pages of collectors."""
    if watch is None:
        _show(_ask(where), as_json=as_json)
        return ExitCode.DONE
    _watch(where, seconds(watch, "--watch", low=0.1), as_json=as_json)
    return ExitCode.DONE


def _ask(where: str | None) -> list[dict[str, Any]]:
    """Return the status of the program that ``where`` names; None for ``where``: of all running programs of this user.

    Each is the JSON object of a control service; for a collector, the fields of `RunningCollector`.

    Raises:
        LinkDown: there is no such program, or none at all.
        NoReply, BadReply: the only program does not answer in time, or not as a control service.
        ConfigError: ``where`` is invalid.
    """
    from ..apps.collector.running_notes import find_collectors
    from ..apps.control.addresses import control_directories
    from ..apps.control.client import ask, find_one, find_running

    directories = control_directories()
    collectors = [asdict(each) for each in find_collectors(*directories)]
    if where is not None:
        named = [each for each in collectors if str(each["pid"]) == where]
        return named or [ask(find_one(where, *directories))]
    running = find_running(*directories)
    if not running and not collectors:
        raise LinkDown(
            "no server, gateway or collector of yours is running, or none with a control socket", kind="missing"
        )
    if len(running) == 1:
        return [ask(running[0]), *collectors]
    return [*_tellers(running), *collectors]


def _tellers(running: "list[Running]") -> Iterator[dict[str, Any]]:
    """Yield the status of each running program that answers; for each that does not, print a warning."""
    from ..apps.control.client import ask

    for one in running:
        try:
            yield {"control": str(one), **ask(one)}
        except ModbusError as error:
            warn(str(error))


def _show(told: list[dict[str, Any]], *, as_json: bool) -> None:
    if as_json:
        for one in told:
            print_json(one)
        sys.stdout.flush()
        return
    sections = _sections(told)
    if sys.stdout.isatty():
        from rich.console import Console

        Console().print(_coloured(sections))
    else:
        _print_plain(sections)


def _watch(where: str | None, period: float, *, as_json: bool) -> None:
    """Print the status of running programs every ``period`` seconds until a signal comes.

    If the first attempt fails, the error is raised; later errors are printed, and watching goes on.
    """
    with stop_flag() as stop:
        told = _ask(where)
        if as_json or not sys.stdout.isatty():
            while True:
                _show(told, as_json=as_json)
                told = []
                while not told:
                    if stop.wait(period):
                        return
                    told = _ask_again(where)
                if not as_json:
                    print()
        from rich.live import Live

        with Live(_coloured(_sections(told)), auto_refresh=False, screen=True) as live:
            while not stop.wait(period):
                told = _ask_again(where) or told
                live.update(_coloured(_sections(told)), refresh=True)


def _ask_again(where: str | None) -> list[dict[str, Any]]:
    try:
        return _ask(where)
    except ModbusError as error:
        warn(str(error))
        return []


def _sections(told: list[dict[str, Any]]) -> "list[StatusSection]":
    from .status_view import collector_sections, list_of_programs, sections_of

    collectors = [one for one in told if "status" not in one]
    programs = [one for one in told if "status" in one]
    sections = sections_of(programs[0]) if len(programs) == 1 else [list_of_programs(programs)] if programs else []
    return sections + collector_sections(collectors)


def _print_plain(sections: "list[StatusSection]") -> None:
    for number, section in enumerate(sections):
        if number:
            print()
        if section.title:
            print(section.title)
        rows = [section.columns, *section.rows] if section.columns else section.rows
        print_aligned(rows)


def _coloured(sections: "list[StatusSection]") -> Any:  # something that rich can print
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

    parts: list[Any] = []
    for section in sections:
        if parts:
            parts.append(Text())
        if section.title:
            parts.append(Text(section.title, style="bold"))
        if section.rows:
            table = Table(
                *section.columns, box=None, show_header=bool(section.columns), header_style="dim", pad_edge=False
            )
            for column in table.columns:
                column.no_wrap = column.header in _WHOLE
            for row in section.rows:
                table.add_row(*(Text(cell, style=section.style_of(index, cell)) for index, cell in enumerate(row)))
            parts.append(table)
    return Group(*parts)
