"""``busway scan``: finds the units that answer on a serial line, or behind an address.

`busway.client.scanning` sends the requests. With ``--baud`` and ``--parity`` several settings of a line are tried, one
after the other.
"""

import re
import sys
from collections.abc import Iterator
from dataclasses import replace

import typer

from ..client.scanning import LISTEN_SECONDS, FoundUnit, UnitScan, refuse_busy_line, units_to_ask
from ..codes import LAST_SERIAL_UNIT
from ..errors import ConfigError
from ..options.endpoints import Endpoint, parse_endpoint, require_host
from ..pdu.encapsulated import OBJECT_NAMES
from ..values.counts import counted
from .arguments import CAPTURE, JSON, QUIET, VERBOSE, seconds, show_traffic, whole_number
from .exits import ExitCode
from .files import capturing
from .output import print_json, say, shown_value, warn

EXAMPLES = """\b
Examples:
  busway scan rtu:///dev/ttyUSB0
  busway scan rtu:///dev/ttyUSB0 --units 1-32 --baud 9600,19200 --parity even,none
  busway scan tcp://10.0.0.5 --units 1-10,255 --json

A line is listened to first; where others talk, nothing is sent. Nothing is ever written.
"""

MANY = 10
"""If at least so many units were asked and all answer alike, they are taken for one device that ignores the unit."""


def scan(
    url: str = typer.Argument(..., metavar="URL", help="rtu:///dev/ttyUSB0, ascii:///dev/ttyS1, tcp://10.0.0.5."),
    units: str | None = typer.Option(
        None, "--units", metavar="RANGE", help="1-10,20,30-40; 1-247 if left out, on TCP 255 too."
    ),
    baud: str | None = typer.Option(None, "--baud", metavar="LIST", help="Try these rates: 9600,19200,38400."),
    parity: str | None = typer.Option(None, "--parity", metavar="LIST", help="Try these parities: even,none,odd."),
    timeout: str = typer.Option(
        "1s", "--timeout", metavar="TIME", help="The longest wait for a unit: 1s; it is shortened by what is learnt."
    ),
    patient: bool = typer.Option(False, "--patient", help="Never wait less than --timeout."),
    listen: str = typer.Option(
        f"{LISTEN_SECONDS:g}s", "--listen", metavar="TIME", help=f"Listen this long at first: {LISTEN_SECONDS:g}s."
    ),
    force: bool = typer.Option(False, "--force", help="Do not listen, ask even where another master talks."),
    names: bool = typer.Option(
        True, "--identify/--no-identify", help="Ask each unit that answers what it is (43/14, 17)."
    ),
    as_json: bool = JSON,
    capture: str | None = CAPTURE,
    verbose: int = VERBOSE,
    quiet: bool = QUIET,
) -> int:
    """Find the units that answer."""
    endpoint = parse_endpoint(url)
    require_host(endpoint)
    settings = list(_settings(endpoint, baud, parity))
    asked = _units(units, endpoint)
    longest = seconds(timeout, "--timeout", low=0.001, high=60)
    listening = seconds(listen, "--listen", low=0.01, high=3600)
    show_traffic(verbose)
    found = 0
    with capturing(capture):
        if not force:
            _refuse_busy_line(settings[0], listening)
        for each in settings:
            one = _Scan(each, asked, longest, learns=not patient, names=names, as_json=as_json)
            found += one.run()
    return ExitCode.DONE if found else ExitCode.NO_REPLY


# What is asked, and where.


def _units(text: str | None, endpoint: Endpoint) -> list[int]:
    """Return the unit identifiers that ``--units`` gives, ascending; without the option, 1…247 and on TCP 255.

    Raises:
        ConfigError: a unit is out of range, such as unit 0, the broadcast, on a serial line.
    """
    if text is None:
        return units_to_ask(endpoint, None)
    low, high = (1, LAST_SERIAL_UNIT) if endpoint.framing != "mbap" else (0, 255)
    found: set[int] = set()
    for part in text.split(","):
        first, dash, last = part.strip().partition("-")
        begin = whole_number(first, "--units", low, high)
        end = whole_number(last, "--units", low, high) if dash else begin
        if end < begin:
            raise ConfigError(f"{part.strip()} ends before it begins", key="--units")
        found.update(range(begin, end + 1))
    return units_to_ask(endpoint, found)


def _settings(endpoint: Endpoint, baud: str | None, parity: str | None) -> Iterator[Endpoint]:
    """Yield the endpoint once for each combination of baud rate and parity to try, with these settings.

    Without both options, that is the endpoint as it is.

    Raises:
        ConfigError: an option is given and the endpoint is no serial port, or a rate or parity is invalid.
    """
    from ..client.settings import link_settings

    for name, text in (("--baud", baud), ("--parity", parity)):
        if text is not None and endpoint.carrier != "serial":
            raise ConfigError(f"goes with a serial port, and {endpoint.url} is none", key=name)
        if text is not None and not re.fullmatch(r"\w+(\s*,\s*\w+)*", text.strip()):
            raise ConfigError(f"a list such as 9600,19200 or even,none is needed, not {text!r}", key=name)
    for rate in _listed(baud):
        for kind in _listed(parity):
            chosen = dict(endpoint.options)
            if rate is not None:
                chosen["baud"] = rate
            if kind is not None:
                chosen["parity"] = kind
            wanted = replace(endpoint, options=chosen)
            link_settings(wanted, {})
            yield wanted


def _listed(text: str | None) -> list[str | None]:
    return [None] if text is None else [each.strip() for each in text.split(",")]


def _refuse_busy_line(endpoint: Endpoint, listen: float) -> None:
    """Listen to a serial line for at most ``listen`` seconds before a scan; raise `ConfigError` if there is traffic.

    Nothing is sent. With Modbus TCP framing, and for a line over UDP, it returns at once: other traffic cannot be heard
    there. Raises `LinkDown` if the line cannot be opened.
    """
    refuse_busy_line(
        endpoint,
        listen,
        hint="--force asks all the same, busway sniff shows who it is",
        begun=lambda: say(f"listening to {endpoint.url} for {listen:g} s, whether others talk there"),
    )


# Asking.


def _identity(found: FoundUnit) -> tuple[object, ...]:
    """Return what identifies the device of a found unit; two units with equal results probably belong to one device.

    It consists of the kind of answer, the identification and the server id.
    """
    return found.answer, tuple(found.identification.items()), found.server_id


def _who(found: FoundUnit) -> str:
    """Return in words how a found unit identifies itself: its identification and server id; empty if it has neither."""
    said = [_text(value) for value in found.identification.values()]
    if found.server_id:
        said.append(f"server id {found.server_id.hex(' ')}" + _printable(found.server_id))
    return " ".join(said)


class _Scan:
    """A scan of all units behind one endpoint, with one baud rate and parity; prints what it finds."""

    def __init__(
        self, endpoint: Endpoint, units: list[int], longest: float, *, learns: bool, names: bool, as_json: bool
    ) -> None:
        self._scan = UnitScan(endpoint, units, longest, learn=learns, identify=names, asking=self._show)
        self._port = self._scan.line
        self._timeout = self._scan.scan_timeout
        self._endpoint = endpoint
        self._units = units
        self._as_json = as_json
        self._progress = _Progress(len(units))
        self._found: list[FoundUnit] = []

    @property
    def _where(self) -> str:
        return self._endpoint.url + (f", {self._port}" if self._port is not None else "")

    def run(self) -> int:
        """Ask all units behind the endpoint, print those that answer and a summary, and return how many answered."""
        most = len(self._units) * self._timeout.longest
        say(f"asking {counted(len(self._units), 'unit')} of {self._where}, {_duration(most)} at most")
        try:
            for present in self._scan.found():
                self._found.append(present)
                self._progress.clear()
                self._report(present)
        finally:
            self._progress.clear()
        self._conclude()
        return len(self._found)

    def _show(self, unit: int) -> None:
        self._progress.show(unit, len(self._found))

    # Showing.

    def _report(self, present: FoundUnit) -> None:
        if self._as_json:
            print_json(
                {
                    "kind": "unit",
                    "endpoint": self._endpoint.url,
                    "line": None if self._port is None else str(self._port),
                    "unit": present.unit,
                    "answer": present.answer,
                    "seconds": round(present.seconds, 6),
                    "identification": {
                        OBJECT_NAMES.get(number, f"object 0x{number:02X}"): _text(value)
                        for number, value in present.identification.items()
                    },
                    "server_id": present.server_id.hex() or None,
                }
            )
        else:
            words = f"  {who}" if (who := _who(present)) else ""
            print(f"unit {present.unit:3}  {present.seconds * 1000:7.1f} ms  {present.answer}{words}")
        sys.stdout.flush()

    def _conclude(self) -> None:
        timeout = self._timeout.timeout
        alike = len(self._found) == len(self._units) >= MANY and len({_identity(each) for each in self._found}) == 1
        if self._as_json:
            print_json(
                {
                    "kind": "summary",
                    "endpoint": self._endpoint.url,
                    "line": None if self._port is None else str(self._port),
                    "asked": len(self._units),
                    "found": [each.unit for each in self._found],
                    "slowest": round(self._timeout.slowest, 6) if self._found else None,
                    "timeout": round(timeout, 3) if self._found else None,
                    "all_alike": alike,
                }
            )
            return
        if not self._found:
            warn(f"no unit answered on {self._where}")
            return
        several = "unit answers" if len(self._found) == 1 else "units answer"
        print(f"{len(self._found)} {several} on {self._where}")
        print(f"the slowest took {self._timeout.slowest * 1000:.0f} ms; a timeout of {timeout:.2f} s is safe")
        if alike:
            print("all of them answer alike: this is one device, which does not look at the unit")


class _Progress:
    """Shows the progress of a scan on one line of stderr, if that is a terminal; elsewhere it shows nothing."""

    def __init__(self, count: int) -> None:
        self._count = count
        self._asked = 0
        self._shown = False
        self._on = sys.stderr.isatty()

    def show(self, unit: int, found: int) -> None:
        """Show which unit is asked next, and how many were found; to be called once for each unit."""
        self._asked += 1
        if self._on:
            words = f"unit {unit}, {self._asked} of {self._count}, {found} found"
            print(f"\r{words:60}", end="", file=sys.stderr, flush=True)
            self._shown = True

    def clear(self) -> None:
        """Clear the progress line, so that other text can be printed in its place."""
        if self._shown:
            print(f"\r{'':60}\r", end="", file=sys.stderr, flush=True)
            self._shown = False


def _text(value: bytes) -> str:
    return shown_value(value.decode("utf-8", errors="backslashreplace"))


def _printable(data: bytes) -> str:
    """Return the readable part of a server id as text to append: `` (TEXT)``, with the space and the brackets.

    TEXT is the longest run of at least three printable ASCII characters; without one, the result is empty.
    """
    text = max(re.findall(r"[ -~]{3,}", data.decode("latin-1")), key=len, default="").strip()
    return f" ({text})" if text else ""


def _duration(time: float) -> str:
    if time < 1:
        return f"{time:.1f} s"
    minutes, rest = divmod(round(time), 60)
    return f"{minutes} min {rest} s" if minutes else f"{rest} s"
