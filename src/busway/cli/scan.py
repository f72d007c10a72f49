"""``busway scan``: which units answer on a line, or behind an address.

1. Each unit is asked for one holding register. Whatever answers is there, also with an exception or a damaged reply; a
   gateway that says 0A or 0B says that nobody is. Nothing is ever written.
2. A line is listened to first. Where others talk, nothing is sent unless ``--force`` says so: two masters disturb each
   other.
3. The wait for a unit is learnt from the answers (`session.adaptive_timeout`). If one comes late, those who were given
   less time are asked again.
4. What answers is asked who it is (43/14, 17).
5. ``--baud`` and ``--parity`` try several settings of a line, one after the other.
"""

import contextlib
import re
import sys
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import typer

from ..codes import LAST_SERIAL_UNIT, TCP_DEVICE_UNIT
from ..errors import BadReply, ConfigError, ExceptionReply, LinkDown, ModbusError, NoReply
from ..options.endpoints import Endpoint, parse_endpoint
from ..pdu.encapsulated import OBJECT_NAMES
from ..session.adaptive_timeout import AdaptiveTimeout, floor_for
from .arguments import CAPTURE, JSON, VERBOSE, seconds, show_traffic, whole_number
from .exits import ExitCode
from .files import capturing
from .output import print_json, say, shown_value

if TYPE_CHECKING:
    from ..client.blocking import BlockingLink

EXAMPLES = """\b
Examples:
  busway scan rtu:///dev/ttyUSB0
  busway scan rtu:///dev/ttyUSB0 --units 1-32 --baud 9600,19200 --parity even,none
  busway scan tcp://10.0.0.5 --units 1-10,255 --json

A line is listened to first; where others talk, nothing is sent. Nothing is ever written.
"""

LISTEN_SECONDS = 2.0
MANY = 10
"""So many units that all answer alike are one device that does not look at the unit."""


def scan(
    url: str = typer.Argument(..., metavar="URL", help="rtu:///dev/ttyUSB0, ascii:///dev/ttyS1, tcp://10.0.0.5."),
    units: str | None = typer.Option(None, "--units", metavar="RANGE", help="1-247 by default; 1-10,20,30-40."),
    baud: str | None = typer.Option(None, "--baud", metavar="LIST", help="Try these rates: 9600,19200,38400."),
    parity: str | None = typer.Option(None, "--parity", metavar="LIST", help="Try these parities: even,none,odd."),
    timeout: str = typer.Option(
        "1s", "--timeout", metavar="TIME", help="The longest wait for a unit; it is shortened by what is learnt."
    ),
    patient: bool = typer.Option(False, "--patient", help="Never wait less than --timeout."),
    listen: str = typer.Option(f"{LISTEN_SECONDS:g}s", "--listen", metavar="TIME", help="Listen so long at first."),
    force: bool = typer.Option(False, "--force", help="Do not listen, ask even where another master talks."),
    names: bool = typer.Option(True, "--identify/--no-identify", help="Ask who answers what it is (43/14, 17)."),
    as_json: bool = JSON,
    capture: str | None = CAPTURE,
    verbose: int = VERBOSE,
) -> int:
    """Find the units that answer."""
    endpoint = parse_endpoint(url)
    settings = list(_settings(endpoint, baud, parity))
    asked = _units(units, is_line=endpoint.framing != "mbap")
    longest = seconds(timeout, "--timeout", low=0.001, high=60)
    quiet = seconds(listen, "--listen", low=0.01, high=3600)
    show_traffic(verbose)
    found = 0
    with capturing(capture):
        if not force:
            _refuse_busy_line(settings[0], quiet)
        for each in settings:
            one = _Scan(each, asked, longest, learns=not patient, names=names, as_json=as_json)
            found += one.run()
    return ExitCode.DONE if found else ExitCode.NO_REPLY


# What is asked, and where.


def _units(text: str | None, *, is_line: bool) -> list[int]:
    """The units of ``--units``, ascending. Unit 0 is nobody's on a line."""
    if text is None:
        return [*range(1, LAST_SERIAL_UNIT + 1), *([] if is_line else [TCP_DEVICE_UNIT])]
    low, high = (1, LAST_SERIAL_UNIT) if is_line else (0, 255)
    found: set[int] = set()
    for part in text.split(","):
        first, dash, last = part.strip().partition("-")
        begin = whole_number(first, "--units", low, high)
        end = whole_number(last, "--units", low, high) if dash else begin
        if end < begin:
            raise ConfigError(f"{part.strip()} ends before it begins", key="--units")
        found.update(range(begin, end + 1))
    return sorted(found)


def _settings(endpoint: Endpoint, baud: str | None, parity: str | None) -> Iterator[Endpoint]:
    """The endpoint with each combination of rate and parity; checked before anything is sent."""
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
    """Listen to a line; raise `ConfigError` where somebody talks. Nothing was sent."""
    if endpoint.framing == "mbap" or endpoint.carrier not in ("serial", "tcp"):
        return
    from ..observe.listening import Listening, line_to_hear

    with Listening(line_to_hear(_for_listening(endpoint))) as listening:
        say(f"listening to {endpoint.url} for {listen:g} s, whether others talk there")
        until = time.monotonic() + listen
        while time.monotonic() < until and not listening.bytes_heard:
            listening.hear(until)
        if listening.bytes_heard:
            raise ConfigError(
                "the line is busy: somebody talks on it, and would be disturbed; nothing was sent."
                " --force asks all the same, busway sniff shows who it is",
                key=endpoint.url,
            )


def _for_listening(endpoint: Endpoint) -> Endpoint:
    """The endpoint without the options that only a conversation has."""
    from ..options.text import option_names
    from ..session.line_framing import FramingParameters
    from ..transport.serial.settings import SerialSettings
    from ..transport.tcp import SocketParameters

    port = SerialSettings if endpoint.carrier == "serial" else SocketParameters
    taken = {*option_names(FramingParameters), *option_names(port)}
    return replace(endpoint, options={name: text for name, text in endpoint.options.items() if name in taken})


# Asking.


@dataclass(slots=True)
class Present:
    """A unit that answers.

    Attributes:
        unit: its number.
        answer: how it answered, in words.
        seconds: until it did.
        objects: device identification (43/14) by number; empty if it has none.
        server_id: what function 17 gave; empty if nothing.
    """

    unit: int
    answer: str
    seconds: float
    objects: dict[int, bytes] = field(default_factory=dict)
    server_id: bytes = b""

    @property
    def identity(self) -> tuple[object, ...]:
        """What two units have in common that are one device."""
        return self.answer, tuple(self.objects.items()), self.server_id

    @property
    def words(self) -> str:
        """Who it is."""
        said = [_text(value) for value in self.objects.values()]
        if self.server_id:
            said.append(f"server id {self.server_id.hex(' ')}" + _printable(self.server_id))
        return " ".join(said)


class _Scan:
    """All units behind one endpoint with one setting."""

    def __init__(
        self, endpoint: Endpoint, units: list[int], longest: float, *, learns: bool, names: bool, as_json: bool
    ) -> None:
        from ..client.blocking import connect
        from ..client.conversation import timing_of
        from ..client.settings import link_settings

        options: dict[str, Any] = {"timeout": longest, "retries": 0}  # fields of different types
        if endpoint.carrier != "serial":
            options["recycle_after_timeouts"] = 1000  # an address without a unit is no sign of a broken connection
        line = link_settings(endpoint, options).line
        self._port = None if line is None else line.port
        character = 0.0 if self._port is None else timing_of(self._port).character
        self._endpoint = endpoint
        self._units = units
        self._adaptive_timeout = AdaptiveTimeout(longest, floor_for(character), learns=learns)
        self._names = names
        self._as_json = as_json
        self._progress = _Progress(len(units))
        self._found: list[Present] = []
        self._waited: dict[int, float] = {}
        """Units that were silent, and how long they were given."""
        self._link: BlockingLink = connect(endpoint, shared=False, **options)

    @property
    def _where(self) -> str:
        return self._endpoint.url + (f", {self._port}" if self._port is not None else "")

    def run(self) -> int:
        """Ask all units; how many answer."""
        most = len(self._units) * self._adaptive_timeout.longest
        say(f"asking {len(self._units)} units of {self._where}, {_duration(most)} at most")
        with self._link:
            self._link.connect()
            try:
                self._ask(self._units)
                if self._adaptive_timeout.was_late:
                    self._ask(
                        [unit for unit, waited in self._waited.items() if waited < self._adaptive_timeout.timeout]
                    )
            finally:
                self._progress.clear()
            self._conclude()
        return len(self._found)

    def _ask(self, units: Iterable[int]) -> None:
        for unit in units:
            self._progress.show(unit, len(self._found))
            present = self._probe(unit)
            if present is None:
                continue
            if self._names:
                self._identify(present)
            self._found.append(present)
            self._progress.clear()
            self._report(present)

    def _probe(self, unit: int) -> Present | None:
        """Whether a unit answers, and how."""
        from ..pdu.read_items import ReadHoldingRegisters

        counters, timeout = self._link.counters, self._adaptive_timeout.timeout
        late_before = counters.late_replies
        began = time.monotonic()
        answer = ""
        try:
            self._link.unit(unit).execute(ReadHoldingRegisters(0, 1), timeout=timeout, retries=0)
            answer = "answers"
        except ExceptionReply as error:
            # Also a gateway's answer tells how long it takes to get one.
            answer = "" if error.from_gateway else f"answers with exception {error.code:02X}"
            self._adaptive_timeout.answered(time.monotonic() - began)
        except BadReply as error:
            answer = f"answers, but broken: {error.reason}"
        except NoReply as error:
            self._waited[unit] = timeout
            answer = "answers, but damaged" if error.kind == "partial" else ""
        except LinkDown:
            self._link.connect()  # some devices close the connection for a unit that they do not have
        took = time.monotonic() - began
        if counters.late_replies > late_before:
            self._adaptive_timeout.late()
        if not answer:
            return None
        if answer == "answers":
            self._adaptive_timeout.answered(took)
        return Present(unit, answer, took)

    def _identify(self, present: Present) -> None:
        unit = self._link.unit(present.unit)
        with contextlib.suppress(ModbusError):
            present.objects = dict(sorted(unit.read_device_identification("basic").items()))
        with contextlib.suppress(ModbusError):
            present.server_id = unit.report_server_id()

    # Showing.

    def _report(self, present: Present) -> None:
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
                        for number, value in present.objects.items()
                    },
                    "server_id": present.server_id.hex() or None,
                }
            )
        else:
            words = f"  {present.words}" if present.words else ""
            print(f"unit {present.unit:3}  {present.seconds * 1000:7.1f} ms  {present.answer}{words}")
        sys.stdout.flush()

    def _conclude(self) -> None:
        timeout = self._adaptive_timeout.timeout
        alike = len(self._found) == len(self._units) >= MANY and len({each.identity for each in self._found}) == 1
        if self._as_json:
            print_json(
                {
                    "kind": "summary",
                    "endpoint": self._endpoint.url,
                    "line": None if self._port is None else str(self._port),
                    "asked": len(self._units),
                    "found": [each.unit for each in self._found],
                    "slowest": round(self._adaptive_timeout.slowest, 6) if self._found else None,
                    "timeout": round(timeout, 3) if self._found else None,
                    "all_alike": alike,
                }
            )
            return
        if not self._found:
            say(f"nobody answers on {self._where}")
            return
        several = "unit answers" if len(self._found) == 1 else "units answer"
        print(f"{len(self._found)} {several} on {self._where}")
        print(f"the slowest took {self._adaptive_timeout.slowest * 1000:.0f} ms; a timeout of {timeout:.2f} s is safe")
        if alike:
            print("all of them answer alike: this is one device, which does not look at the unit")


class _Progress:
    """Where the scan stands, on one line of a terminal; nothing elsewhere."""

    def __init__(self, count: int) -> None:
        self._count = count
        self._asked = 0
        self._shown = False
        self._on = sys.stderr.isatty()

    def show(self, unit: int, found: int) -> None:
        """The next unit is asked."""
        self._asked += 1
        if self._on:
            words = f"unit {unit}, {self._asked} of {self._count}, {found} found"
            print(f"\r{words:60}", end="", file=sys.stderr, flush=True)
            self._shown = True

    def clear(self) -> None:
        """Make room for something else."""
        if self._shown:
            print(f"\r{'':60}\r", end="", file=sys.stderr, flush=True)
            self._shown = False


def _text(value: bytes) -> str:
    return shown_value(value.decode("utf-8", errors="backslashreplace"))


def _printable(data: bytes) -> str:
    """The readable part of a server id, in brackets, if there is one."""
    text = max(re.findall(r"[ -~]{3,}", data.decode("latin-1")), key=len, default="").strip()
    return f" ({text})" if text else ""


def _duration(time: float) -> str:
    if time < 1:
        return f"{time:.1f} s"
    minutes, rest = divmod(round(time), 60)
    return f"{minutes} min {rest} s" if minutes else f"{rest} s"
