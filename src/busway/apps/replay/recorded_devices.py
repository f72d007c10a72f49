"""What the units of a capture hold and refuse, and a simulation file that answers as they did.

Knows exchanges and simulation files; writes no file.

1. Each item has the first value that was read or written in the capture, so that the requests of the capture, sent
   again in their order, get the same replies. If the caller asks for it, each item has the last value instead.
2. Items that were never read or written do not exist: the simulator refuses them with 02. A function that a unit always
   refused with 01 does not exist. All other exceptions of the device become faults of the file, for their function and
   for the items that this function never returned or accepted.
3. Units that never answered are left out. If the capture has requests to them without a reply, and none was answered by
   a gateway for them, the file makes the simulator silent for units that it does not have; else it answers them with
   0B.
4. What a file cannot express becomes a remark: functions without items, values that changed by themselves, requests
   that were both answered and refused.
5. At most `MOST_ITEMS` and `MOST_REQUESTS` of all units together are recorded; a remark tells if there were more.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from statistics import median
from typing import Any, Final

from ...codes import TABLE_SIZE, ExceptionCode, FunctionCode, Table, function_name
from ...config.files.device import OBJECT_NUMBERS
from ...config.files.fault_sections import FaultSection
from ...config.files.simulation import SimulatedUnitSection
from ...errors import ConfigError
from ...pdu.bits import unpack_bits
from ...pdu.diagnostics import ReadExceptionStatus, ReportServerId
from ...pdu.encapsulated import ReadDeviceIdentification
from ...pdu.functions import STANDARD
from ...pdu.message import Request, Span
from ...pdu.read_items import ReadBits, ReadRegisters, unpack_registers
from ...pdu.write_items import (
    MaskWriteRegister,
    ReadWriteMultipleRegisters,
    WriteMultipleCoils,
    WriteMultipleRegisters,
    WriteSingleCoil,
    WriteSingleRegister,
)
from ...values import Address, format_address
from ...values.counts import counted
from ..simulator.device_text import device_text, written
from ..simulator.recorded_tables import item_keys
from .exchanges import CapturedExchange, TroubleKind
from .item_ranges import ItemRanges

MOST_ITEMS: Final = 1_000_000
MOST_REQUESTS: Final = 100_000
_MOST_TIMES: Final = 10_000
"""Number of response times, the first ones, from which the median of a unit is computed."""
_NOT_THERE: Final = frozenset((ExceptionCode.GATEWAY_PATH_UNAVAILABLE, ExceptionCode.GATEWAY_TARGET_FAILED_TO_RESPOND))
_KEPT: Final = frozenset(
    (
        *range(1, 8),
        FunctionCode.DIAGNOSTICS,
        FunctionCode.WRITE_MULTIPLE_COILS,
        FunctionCode.WRITE_MULTIPLE_REGISTERS,
        FunctionCode.REPORT_SERVER_ID,
        FunctionCode.MASK_WRITE_REGISTER,
        FunctionCode.READ_WRITE_MULTIPLE_REGISTERS,
        FunctionCode.ENCAPSULATED_INTERFACE,
    )
)
"""Function codes that the simulator answers from the contents of the file; the answers of others are not recorded."""

_INDIVIDUAL: Final = 0x80
"""Bit of a conformity level (function 43/14) that means: single objects can be read. The simulator always has it."""

_Asked = tuple[int, tuple[Span, ...]]


@dataclass(slots=True)
class RecordedFile:
    """A simulation file made from a capture.

    Attributes:
        text: the text of the file.
        server: the server that the file simulates: address and port, or name of a serial line.
        units: numbers of the units in the file.
        remarks: differences between the simulation and the devices of the capture, one sentence each.
    """

    text: str
    server: str
    units: list[int]
    remarks: list[str] = field(default_factory=list)


class RecordedDevices:
    """Collects what the devices of a capture answered, exchange by exchange, and makes simulation files from it."""

    def __init__(self) -> None:
        self._servers: dict[str, dict[int, _RecordedUnit]] = {}
        self._hosts: dict[str, str] = {}  # of servers with an address; a serial line has none
        self._limits = _Limits()

    def add(self, exchange: CapturedExchange) -> None:
        """Record the values, the exception and the response time of one exchange.

        Broadcasts, replies without a request and bytes that are no frame are ignored.
        """
        if exchange.unit is None or exchange.asked is None or exchange.is_broadcast:
            return
        channel = exchange.channel
        units = self._servers.get(channel.server_text)
        if units is None:
            units = self._servers[channel.server_text] = {}
            if channel.server is not None:
                self._hosts[channel.server_text] = str(channel.server.address)
        unit = units.get(exchange.unit)
        if unit is None:
            unit = units[exchange.unit] = _RecordedUnit(exchange.unit, self._limits)
        unit.add(exchange)

    def file(self, server: str | None = None, *, last: bool = False, delays: bool = False) -> RecordedFile:
        """Return a simulation file that answers as one server of the capture did.

        Args:
            server: address of the server, with or without its port, or name of a serial line; None if only one server
                answered.
            last: True: items have their last value in the capture; False: their first.
            delays: whether replies are delayed by the median response time of their unit.

        Raises:
            ConfigError: no unit of the server answered; or several servers are possible, which the message lists.
        """
        name, units = self._chosen(server)
        there = [unit for _, unit in sorted(units.items()) if unit.is_there]
        remarks = [remark for unit in there for remark in unit.remarks()]
        if self._limits.is_reached:
            remarks.append("the capture has more items or requests than are recorded")
        sections = [SimulatedUnitSection.model_validate(unit.keys(last=last)) for unit in there]
        absent = [unit for _, unit in sorted(units.items()) if not unit.is_there]
        silent = [unit.number for unit in absent if unit.unanswered and not unit.refusals]
        if silent:
            remarks.append(f"left out, they did not answer: units {', '.join(map(str, silent))}")
        head = [f"Recorded from a capture of {name}.", *remarks]
        text = device_text(sections, remarks=head, compact=True)
        if silent and len(silent) == len(absent):
            text += '\n[server]\nunlisted = "silence"\n'
        for unit in there:
            for fault in unit.faults(delays=delays):
                FaultSection.model_validate(fault)
                lines = [f"{key} = {written(value)}" for key, value in fault.items()]
                text += "\n" + "\n".join(["[[fault]]", *lines]) + "\n"
        return RecordedFile(text, name, [unit.number for unit in there], remarks)

    def _chosen(self, server: str | None) -> "tuple[str, dict[int, _RecordedUnit]]":
        there = {name: units for name, units in self._servers.items() if any(unit.is_there for unit in units.values())}
        if server is not None:
            found = {name: units for name, units in there.items() if server in (name, self._hosts.get(name))}
            if not found:
                raise ConfigError(f"no unit of {server} answered; those who did: {_listed(there)}", key="--server")
            there = found
        if not there:
            raise ConfigError("no unit answered in this capture, so there is nothing to simulate", key="--simulate")
        if len(there) > 1:
            raise ConfigError(f"there are several: {_listed(there)}", key="--server")
        return next(iter(there.items()))


def _listed(names: Sequence[str] | dict[str, Any]) -> str:
    shown = sorted(names)
    return ", ".join(shown[:10]) + (f" and {len(shown) - 10} more" if len(shown) > 10 else "") or "none"


@dataclass(slots=True)
class _Limits:
    """Counts the items and requests that are recorded for all units together, and refuses those beyond the limits.

    Attributes:
        items: number of items recorded so far.
        requests: number of different requests recorded so far.
        is_reached: whether something was not recorded because of a limit.
    """

    items: int = 0
    requests: int = 0
    is_reached: bool = False

    def has_room(self, *, items: int = 0, requests: int = 0) -> bool:
        """Count further items and requests and return True; if they exceed a limit, count nothing and return False."""
        if self.items + items > MOST_ITEMS or self.requests + requests > MOST_REQUESTS:
            self.is_reached = True
            return False
        self.items += items
        self.requests += requests
        return True


class _RecordedUnit:
    """What one unit of a capture holds and refuses.

    Attributes:
        number: its unit identifier.
        answered: number of normal replies.
        unanswered: number of requests that the unit left without a reply.
        refusals: how often each exception code was the reply, by function code and items of the request.
    """

    def __init__(self, number: int, limits: _Limits) -> None:
        self.number = number
        self.answered = 0
        self.unanswered = 0
        self.refusals: dict[_Asked, Counter[int]] = {}
        self._limits = limits
        self._first: dict[Table, dict[int, int]] = {table: {} for table in Table}
        self._last: dict[Table, dict[int, int]] = {table: {} for table in Table}
        self._changed: set[tuple[Table, int]] = set()
        self._given: dict[int, dict[Table, ItemRanges]] = {}  # what each function gave
        self._accepted: set[_Asked] = set()
        self._objects: dict[int, bytes] = {}
        self._conformity = _INDIVIDUAL
        self._server_id: bytes | None = None
        self._status: int | None = None
        self._other: set[int] = set()
        self._times: list[float] = []

    @property
    def is_there(self) -> bool:
        """Whether the unit itself ever answered; exceptions 0A and 0B come from a gateway and do not count."""
        return self.answered > 0 or any(code not in _NOT_THERE for codes in self.refusals.values() for code in codes)

    def add(self, exchange: CapturedExchange) -> None:
        """Record one exchange with a request to this unit.

        A reply that is malformed, of another unit or function, or does not fit its request is ignored, and so is a
        request beyond the end of a table. Where `_Limits` has no room, nothing new is recorded.
        """
        asked, request = exchange.asked, exchange.request
        assert asked is not None
        if exchange.answered is None:
            self.unanswered += any(trouble.kind is TroubleKind.NO_REPLY for trouble in exchange.troubles)
            return
        if exchange.reply is None or any(trouble.kind is TroubleKind.WRONG_UNIT for trouble in exchange.troubles):
            return
        if exchange.seconds is not None and len(self._times) < _MOST_TIMES:
            self._times.append(exchange.seconds)
        spans = request.spans() if isinstance(request, Request) else ()
        if any(span.address + span.count > TABLE_SIZE for span in spans):
            return  # beyond the table, where there is nothing on the simulator either
        key = asked.pdu[0], spans
        if exchange.exception is not None:
            is_request = isinstance(request, Request) or asked.pdu[0] not in STANDARD
            if is_request and (key in self.refusals or self._limits.has_room(requests=1)):
                self.refusals.setdefault(key, Counter())[exchange.exception] += 1
            return
        self.answered += 1
        if key not in self._accepted and self._limits.has_room(requests=1):
            self._accepted.add(key)
        for span in spans:
            tables = self._given.setdefault(asked.pdu[0], {})
            tables.setdefault(span.table, ItemRanges()).add(span.address, span.count)
        if isinstance(request, Request):
            self._take(request, exchange.reply)
        if asked.pdu[0] not in _KEPT:
            self._other.add(asked.pdu[0])

    # Values.

    def _take(self, request: Request, reply: Any) -> None:  # Any: the reply class of the request
        match request:
            case ReadBits(reads=touch) if touch is not None:
                self._read(touch.table, request.address, [int(bit) for bit in reply.bits(request.count)])
            case ReadRegisters(reads=touch) if touch is not None:
                self._read(touch.table, request.address, unpack_registers(reply.data))
            case WriteSingleCoil():
                self._write(Table.COILS, request.address, [int(request.value != 0)])
            case WriteSingleRegister():
                self._write(Table.HOLDING_REGISTERS, request.address, [request.value])
            case WriteMultipleCoils():
                bits = [int(bit) for bit in unpack_bits(request.data, request.count)]
                self._write(Table.COILS, request.address, bits)
            case WriteMultipleRegisters():
                self._write(Table.HOLDING_REGISTERS, request.address, unpack_registers(request.data))
            case ReadWriteMultipleRegisters():
                self._write(Table.HOLDING_REGISTERS, request.write_address, unpack_registers(request.data))
                self._read(Table.HOLDING_REGISTERS, request.read_address, unpack_registers(reply.data))
            case MaskWriteRegister():
                self._mask(request)
            case ReadDeviceIdentification():
                self._objects |= {each.number: each.value for each in reply.objects}
                self._conformity = reply.conformity
            case ReportServerId():
                self._server_id = reply.data
            case ReadExceptionStatus():
                self._status = reply.status
            case _:
                pass

    def _read(self, table: Table, address: int, values: Sequence[int]) -> None:
        last = self._last[table]
        for offset, value in enumerate(values, address):
            if last.get(offset, value) != value:
                self._changed.add((table, offset))
        self._write(table, address, values)

    def _write(self, table: Table, address: int, values: Sequence[int]) -> None:
        first, last = self._first[table], self._last[table]
        for offset, value in enumerate(values, address):
            if offset not in first:
                if not self._limits.has_room(items=1):
                    return
                first[offset] = value
            last[offset] = value

    def _mask(self, request: MaskWriteRegister) -> None:
        known = self._last[Table.HOLDING_REGISTERS].get(request.address)
        if known is not None:
            value = known & request.and_mask | request.or_mask & ~request.and_mask & 0xFFFF
            self._write(Table.HOLDING_REGISTERS, request.address, [value])

    # The file.

    def keys(self, *, last: bool) -> dict[str, Any]:  # what TOML has
        """Return the contents of the unit's ``[[unit]]`` table in a simulation file.

        ``last``: with the last value of each item in the capture, otherwise with the first.
        """
        keys: dict[str, Any] = {"unit": self.number}
        if self._objects:
            names = {number: name for name, number in OBJECT_NUMBERS.items()}
            keys["identification"] = {
                names.get(number, f"0x{number:02X}"): {"hex": value.hex()}
                for number, value in sorted(self._objects.items())
            }
        if self._server_id is not None:
            keys["server_id"] = {"hex": self._server_id.hex()}
        if self._status is not None:
            keys["exception_status"] = self._status
        missing = self._missing_functions()
        if missing:
            keys["functions"] = sorted(set(STANDARD.codes()) - missing)
        tables = self._last if last else self._first
        return keys | item_keys({table: items for table, items in tables.items() if items})

    def _missing_functions(self) -> set[int]:
        """Return the function codes that the unit always answered with exception 01: it does not have them."""
        refused = {
            function for (function, _), codes in self.refusals.items() if ExceptionCode.ILLEGAL_FUNCTION in codes
        }
        known = {function for function, _ in self._accepted}
        known |= {
            function for (function, _), codes in self.refusals.items() if set(codes) != {ExceptionCode.ILLEGAL_FUNCTION}
        }
        return refused - known

    def faults(self, *, delays: bool) -> Iterator[dict[str, Any]]:  # what TOML has
        """Yield ``[[fault]]`` tables that make the simulated unit refuse what the unit of the capture refused.

        With ``delays`` one more follows, which delays the replies by the median response time of the unit.
        """
        wanted: dict[tuple[int, int], dict[Table, ItemRanges]] = {}
        for function, code, spans in self._unlike():
            tables = wanted.setdefault((function, code), {})
            for span in spans:
                tables.setdefault(span.table, ItemRanges()).add(span.address, span.count)
        for (function, code), tables in wanted.items():
            fault: dict[str, Any] = {
                "name": f"unit {self.number}, function {function}, exception {code:02X}",
                "fault_profile": "odd-exception",
                "units": self.number,
                "functions": function,
            }
            if tables:
                fault["addresses"] = [_range(table, *ends) for table, ranges in tables.items() for ends in ranges]
            yield fault | {"parameters": {"code": code}}
        if delays and self._times:
            delay = float(f"{median(self._times):.3g}")
            name = f"unit {self.number}, typical delay"
            yield {"name": name, "fault_profile": "late", "units": self.number, "parameters": {"delay": delay}}

    def _unlike(self) -> Iterator[tuple[int, int, list[Span]]]:
        """Yield the exceptions that the simulated unit would not give by itself, so that they need a fault.

        Each is (function code, most frequent exception code, refused items that this function never read or wrote). The
        last is empty for a function without items.
        """
        missing = self._missing_functions()
        for (function, spans), codes in self.refusals.items():
            code = codes.most_common(1)[0][0]
            if function in missing or (function, spans) in self._accepted or function not in STANDARD:
                continue
            if code == ExceptionCode.ILLEGAL_DATA_ADDRESS and not all(map(self._has, spans)):
                continue
            never = [part for span in spans for part in self._never_given(function, span)]
            if never or not spans:
                yield function, code, never

    def _has(self, span: Span) -> bool:
        return all(offset in self._first[span.table] for offset in range(span.address, span.address + span.count))

    def _never_given(self, function: int, span: Span) -> Iterator[Span]:
        """Yield the parts of a refused range of items that this function has never read or written successfully."""
        at, end = span.address, span.address + span.count
        for first, behind in self._given.get(function, {}).get(span.table, ()):
            if at < first < end:
                yield Span(span.table, at, first - at, span.writes)
            if first < end and behind > at:
                at = behind
        if at < end:
            yield Span(span.table, at, end - at, span.writes)

    def remarks(self) -> Iterator[str]:
        """Yield a sentence for each way in which the simulated unit differs from the unit of the capture."""
        of = f"unit {self.number}"
        if self._changed:
            yield f"{of}: {counted(len(self._changed), 'item')} changed; the file has one value of each"
        for function in sorted(self._other):
            yield f"{of}: function {function_name(function)} was answered and is not recorded"
        if not self._conformity & _INDIVIDUAL:
            yield f"{of}: conformity level {self._conformity:02X}; that of the simulator offers single objects too"
        both = [key for key in self.refusals if key in self._accepted]
        if both:
            yield f"{of}: answered and also refused, now answered: {counted(len(both), 'request')}"
        missing = self._missing_functions()
        for (function, spans), codes in self.refusals.items():
            if len(codes) > 1:
                yield f"{of}: {function_name(function)} was refused with several codes; the file has the most frequent"
            code = codes.most_common(1)[0][0]
            hidden = spans and not any(part for span in spans for part in self._never_given(function, span))
            if (
                hidden
                and function not in missing
                and (function, spans) not in self._accepted
                and all(map(self._has, spans))
            ):
                yield f"{of}: exception {code:02X} to {function_name(function)}, for items that it gave elsewhere"


def _range(table: Table, first: int, end: int) -> str:
    text = format_address(Address(table, first))
    return text if end == first + 1 else f"{text}-{format_address(Address(table, end - 1))}"
