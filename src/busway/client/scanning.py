"""Finding the units that answer on a line, or behind a server such as a gateway.

1. Each unit is asked for one holding register. A unit that answers in any way is present, also with an exception or a
   damaged reply; the exceptions 0A and 0B of a gateway mean that the unit is absent. Nothing is ever written.
2. A line is listened to first, and nothing is sent if there is traffic: two masters disturb each other.
3. The time to wait for a unit is learnt from the answers (`session.scan_timeout`). If an answer comes late, silent
   units that were given less than the full time are asked again.
4. A unit that answers is asked for its identification (43/14, 17).
"""

import contextlib
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final

from ..codes import LAST_SERIAL_UNIT, TCP_DEVICE_UNIT
from ..errors import BadReply, ConfigError, ExceptionReply, InvalidRequest, LinkDown, ModbusError, NoReply
from ..options.accepted_options import MONITORS, AcceptedOptions, canonical
from ..options.endpoints import Endpoint, parse_endpoint
from ..options.ports import SerialSettings
from ..pdu.compiler import as_integer
from ..pdu.read_items import ReadHoldingRegisters
from ..session.scan_timeout import ScanTimeout, floor_for
from .blocking import BlockingLink, connect
from .sessions import timing_of
from .settings import link_settings

LISTEN_SECONDS: Final = 2.0
"""Seconds that a scan listens to a line before it sends anything, by default."""


@dataclass(slots=True)
class FoundUnit:
    """A unit that answered a scan, and how it answered.

    Attributes:
        unit: unit identifier, 0…255.
        answer: how the unit answered, in words, such as ``answers`` or ``answers with exception 02``.
        seconds: seconds from the request to the answer.
        identification: identification objects (43/14, level basic) by number; empty if not asked for, or not answered.
        server_id: data of the reply to function 17; empty if not asked for, or not answered.
    """

    unit: int
    answer: str
    seconds: float
    identification: dict[int, bytes] = field(default_factory=dict)
    server_id: bytes = b""


def scan(
    url: str | Endpoint,
    units: Iterable[int] | None = None,
    *,
    timeout: float = 1.0,
    learn: bool = True,
    identify: bool = True,
    listen: float | None = LISTEN_SECONDS,
    **options: Any,  # those of `LinkOptions`, of which the timeout stands above
) -> list[FoundUnit]:
    """Find the units that answer on a line, or behind a server such as a gateway. Writes nothing.

    Each absent unit takes up to ``timeout`` seconds; with ``learn``, less after some units have answered.

    Args:
        url: the endpoint, as in `connect`.
        units: the units to ask, 1…247 on a line and 0…255 elsewhere; None asks 1…247, and 255 too on TCP, TLS and UDP.
        timeout: the longest wait for the answer of a unit, 0.001…60 seconds.
        learn: shorten the wait to a multiple of the slowest answer so far.
        identify: ask each unit that answers for its identification (43/14, 17).
        listen: seconds to listen to a line first; None: do not listen, and ask even if another master is active.
        options: as in `connect`; ``retries`` is ignored, because each unit is asked without retries.

    Returns:
        The units that answered, in the order of their answers: ascending, then those found when asked again.

    Raises:
        ConfigError: an invalid argument, or there is traffic on the line. Nothing was sent.
        LinkDown: no connection.
    """
    endpoint = parse_endpoint(url)
    asked = units_to_ask(endpoint, units)
    if not 0.001 <= timeout <= 60:
        raise ConfigError(f"must be 0.001…60 seconds, not {timeout:g}", key="timeout")
    if listen is not None:
        refuse_busy_line(endpoint, listen, options)
    return list(UnitScan(endpoint, asked, timeout, learn=learn, identify=identify, options=options).found())


def units_to_ask(endpoint: Endpoint, units: Iterable[int] | None) -> list[int]:
    """Return the units that a scan asks, ascending, each once.

    None for ``units`` gives 1…247, and 255 too on TCP, TLS and UDP with Modbus TCP framing.

    Raises:
        ConfigError: no unit is given, or one is no integer or out of range: 0…255, or 1…247 on a serial line (0 is the
            broadcast).
    """
    is_line = endpoint.framing != "mbap"
    if units is None:
        return [*range(1, LAST_SERIAL_UNIT + 1), *([] if is_line else [TCP_DEVICE_UNIT])]
    low, high = (1, LAST_SERIAL_UNIT) if is_line else (0, 255)
    try:
        found = sorted({as_integer("each", unit) for unit in units})
    except InvalidRequest as error:
        raise ConfigError(error.message, key="units") from None
    for unit in found:
        if not low <= unit <= high:
            raise ConfigError(f"must be {low}…{high}, not {unit}", key="units")
    if not found:
        raise ConfigError("at least one unit is needed", key="units")
    return found


def refuse_busy_line(
    endpoint: Endpoint,
    listen: float,
    options: Mapping[str, object] | None = None,
    *,
    hint: str = "listen=None asks all the same",
    begun: Callable[[], None] = lambda: None,
) -> None:
    """Listen to a line before a scan, and raise `ConfigError` if there is traffic. Sends nothing.

    Args:
        endpoint: the endpoint to be scanned. With Modbus TCP framing, and for a line over UDP, nothing is done.
        listen: the longest time to listen, in seconds; the first byte received ends it.
        options: options of the scan beside those of the endpoint, which they replace.
        hint: the end of the error message, which says how to scan in spite of it.
        begun: called without arguments when the line is open and listening begins.

    Raises:
        ConfigError: there is traffic, or an option is invalid.
        LinkDown: the line cannot be opened.
    """
    if endpoint.framing == "mbap" or endpoint.carrier not in ("serial", "tcp"):
        return
    from ..observe.sniffing import Listening, sniffed_line

    with Listening(sniffed_line(replace(endpoint, options={}), _for_listening(endpoint, options or {}))) as listening:
        begun()
        until = time.monotonic() + listen
        while time.monotonic() < until and not listening.bytes_heard:
            listening.hear(until)
        if listening.bytes_heard:
            raise ConfigError(
                f"the line is busy: there is traffic on it that would be disturbed; nothing was sent. {hint}",
                key=endpoint.url,
            )


def _for_listening(endpoint: Endpoint, options: Mapping[str, object]) -> dict[str, object]:
    """Return those options of a scan that listening to the line has too."""
    taken = AcceptedOptions.at(endpoint, "monitor", MONITORS).names
    given = {**canonical(endpoint.options), **canonical(options)}
    return {name: value for name, value in given.items() if name in taken}


class UnitScan:
    """A scan of the units behind one endpoint. Creating it sends nothing; `found` sends the requests.

    Args:
        endpoint: the line, or the server through which the units are reached.
        units: the units to ask, in this order.
        longest: the longest wait for the answer of a unit, in seconds.
        learn: whether the wait is shortened to a multiple of the slowest answer so far.
        identify: whether units that answer are asked for their identification.
        options: as in `connect`; ``timeout`` and ``retries`` are ignored.
        asking: called with the number of each unit before it is asked.

    Attributes:
        line: settings of the serial port, such as its baud rate; None over a network.
        scan_timeout: its ``timeout`` is the present wait for a unit in seconds, learnt from the answers so far.

    Raises:
        ConfigError: an option is invalid, or this process uses the serial port already.
    """

    def __init__(
        self,
        endpoint: Endpoint,
        units: Sequence[int],
        longest: float,
        *,
        learn: bool,
        identify: bool,
        options: Mapping[str, Any] | None = None,
        asking: Callable[[int], None] = lambda unit: None,
    ) -> None:
        chosen: dict[str, Any] = {**(options or {}), "timeout": longest, "retries": 0}  # fields of different types
        if endpoint.carrier != "serial":
            chosen["recycle_after_timeouts"] = 1000  # an address without a unit is no sign of a broken connection
        line = link_settings(endpoint, chosen).line
        self.line: SerialSettings | None = None if line is None else line.port
        character = 0.0 if self.line is None else timing_of(self.line).character
        self.scan_timeout: ScanTimeout = ScanTimeout(longest, floor_for(character), learns=learn)
        self._units = units
        self._identifies = identify
        self._asking = asking
        self._waited: dict[int, float] = {}
        """How many seconds each silent unit was given to answer, by unit."""
        self._link: BlockingLink = connect(endpoint, shared=False, **chosen)

    def found(self) -> Iterator[FoundUnit]:
        """Ask the units one after the other, and yield each one as soon as it has answered. Raises `LinkDown`.

        Units that do not answer are left out. If an answer came late, silent units that were given less than the full
        time are asked a second time. It can be used once: the link is closed at the end.
        """
        with self._link:
            self._link.connect()
            yield from self._ask(self._units)
            if self.scan_timeout.was_late:
                yield from self._ask(
                    [unit for unit, waited in self._waited.items() if waited < self.scan_timeout.timeout]
                )

    def _ask(self, units: Iterable[int]) -> Iterator[FoundUnit]:
        for unit in units:
            self._asking(unit)
            found = self._probe(unit)
            if found is None:
                continue
            if self._identifies:
                self._identify(found)
            yield found

    def _probe(self, unit: int) -> FoundUnit | None:
        """Ask a unit for one holding register; return it if it answered, even with an exception or a damaged reply.

        Returns None if there was no answer, if a gateway answered instead (exceptions 0A and 0B), or if the connection
        was closed; then a new one is opened. Raises `LinkDown` if that fails.
        """
        counters, timeout = self._link.counters, self.scan_timeout.timeout
        late_before = counters.late_replies
        began = time.monotonic()
        answer = ""
        try:
            self._link.unit(unit).execute(ReadHoldingRegisters(0, 1), timeout=timeout, retries=0)
            answer = "answers"
        except ExceptionReply as error:
            # Also a gateway's answer tells how long it takes to get one.
            answer = "" if error.from_gateway else f"answers with exception {error.code:02X}"
            self.scan_timeout.answered(time.monotonic() - began)
        except BadReply as error:
            answer = f"answers, but broken: {error.reason}"
        except NoReply as error:
            self._waited[unit] = timeout
            answer = "answers, but damaged" if error.kind == "partial" else ""
        except LinkDown:
            self._link.connect()  # some devices close the connection for a unit that they do not have
        took = time.monotonic() - began
        if counters.late_replies > late_before:
            self.scan_timeout.late()
        if not answer:
            return None
        if answer == "answers":
            self.scan_timeout.answered(took)
        return FoundUnit(unit, answer, took)

    def _identify(self, found: FoundUnit) -> None:
        unit = self._link.unit(found.unit)
        with contextlib.suppress(ModbusError):
            found.identification = dict(sorted(unit.read_device_identification("basic").items()))
        with contextlib.suppress(ModbusError):
            found.server_id = unit.report_server_id()
