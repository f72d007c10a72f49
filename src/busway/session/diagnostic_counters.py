"""The diagnostic counters of a server's units, with event log and listen-only mode: what functions 08, 11 and 12 read.

Knows when something is counted; knows no bytes and no port (Application Protocol V1.1b3 §6.8–§6.10, Serial Line
V1.02 appendix A).

1. Several units on one port are several devices to a master. Each has counters, an event log and a mode of its own;
   restart, clear and listen-only mode concern the unit addressed. What every device of a line hears is counted once,
   for the line: messages, damaged frames and overruns. Each unit counts these from its own last restart or clear on.
2. Counters are 16 bit on the wire and wrap there; here they do not wrap, so that a status can show the true number.
3. A receive event is stored when a message comes in, a send event when its processing ends, answered or not (§6.10).
4. A restart (08/01) is carried out after its reply was sent. In listen-only mode there is no reply. In both cases the
   session reports the end of the request, by `answered` or `kept_silent`, which carries out the restart. In listen-only
   mode nothing else is executed.
5. On a network listener the sub-functions that change something (01, 03, 04, 0A, 14) are refused with 01 unless
   ``changes_allowed``: one packet could mute a server for all clients.
6. The ASCII delimiter is the port's: sub-function 03 changes it for all units of the line.
"""

from collections import Counter, deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields, replace
from enum import IntFlag

from ..codes import DiagnosticCode, ExceptionCode
from ..pdu.device_interface import Refusal

EVENT_LOG_SIZE = 64

EVENT_RESTARTED = 0x00
EVENT_ENTERED_LISTEN_ONLY = 0x04

_CHANGES = frozenset(
    {
        DiagnosticCode.RESTART_COMMUNICATIONS,
        DiagnosticCode.CHANGE_ASCII_DELIMITER,
        DiagnosticCode.FORCE_LISTEN_ONLY,
        DiagnosticCode.CLEAR_COUNTERS,
        DiagnosticCode.CLEAR_OVERRUN,
    }
)


class ReceiveEvent(IntFlag):
    """Bits of a receive event in the event log that function 12 reads; 0x80 is always set."""

    RECEIVED = 0x80
    COMMUNICATION_ERROR = 0x02
    CHARACTER_OVERRUN = 0x10
    LISTEN_ONLY = 0x20
    BROADCAST = 0x40


class SendEvent(IntFlag):
    """Bits of a send event in the event log that function 12 reads; 0x40 is always set."""

    SENT = 0x40
    READ_EXCEPTION = 0x01
    ABORT_EXCEPTION = 0x02
    BUSY_EXCEPTION = 0x04
    NAK_EXCEPTION = 0x08
    WRITE_TIMEOUT = 0x10
    LISTEN_ONLY = 0x20


_SEND_EVENT_OF_EXCEPTION: dict[int, int] = {
    1: SendEvent.READ_EXCEPTION,
    2: SendEvent.READ_EXCEPTION,
    3: SendEvent.READ_EXCEPTION,
    4: SendEvent.ABORT_EXCEPTION,
    5: SendEvent.BUSY_EXCEPTION,
    6: SendEvent.BUSY_EXCEPTION,
    7: SendEvent.NAK_EXCEPTION,
}
# The events of most messages, as plain numbers: an operation of a flag takes 0.3 µs.
_RECEIVED = int(ReceiveEvent.RECEIVED)
_RECEIVED_MUTED = int(ReceiveEvent.RECEIVED | ReceiveEvent.LISTEN_ONLY)
_SENT = int(SendEvent.SENT)
_SENT_MUTED = int(SendEvent.SENT | SendEvent.LISTEN_ONLY)
_PLAIN_EXCHANGE = bytes((_SENT, _RECEIVED))


@dataclass(slots=True)
class DiagnosticCounters:
    """The eight diagnostic counters of function 08, named as its sub-functions 0B…12."""

    bus_message_count: int = 0
    bus_communication_error_count: int = 0
    bus_exception_error_count: int = 0
    server_message_count: int = 0
    server_no_response_count: int = 0
    server_nak_count: int = 0
    server_busy_count: int = 0
    bus_character_overrun_count: int = 0


_COUNTER_OF = {
    DiagnosticCode.BUS_MESSAGE_COUNT: "bus_message_count",
    DiagnosticCode.BUS_COMMUNICATION_ERROR_COUNT: "bus_communication_error_count",
    DiagnosticCode.BUS_EXCEPTION_ERROR_COUNT: "bus_exception_error_count",
    DiagnosticCode.SERVER_MESSAGE_COUNT: "server_message_count",
    DiagnosticCode.SERVER_NO_RESPONSE_COUNT: "server_no_response_count",
    DiagnosticCode.SERVER_NAK_COUNT: "server_nak_count",
    DiagnosticCode.SERVER_BUSY_COUNT: "server_busy_count",
    DiagnosticCode.BUS_CHARACTER_OVERRUN_COUNT: "bus_character_overrun_count",
}


@dataclass(slots=True)
class HeardCounters:
    """Counts of messages, damaged frames and overruns on a line, which all its devices hear, whatever the unit."""

    messages: int = 0
    damaged: int = 0
    overruns: int = 0


class LineDiagnostics:
    """The diagnostics of a line or listener: what all of its units hear, and a `CommunicationState` for each unit.

    Args:
        changes_allowed: whether the sub-functions of 08 that change something are offered.
        listed_unit: function from a unit number to the number under which its device is listed
            (`ListedUnits.listed_unit`). A device with several unit numbers then has one state. Left out, each number
            has its own state.

    Attributes:
        exchanged: by unit, number of requests answered without exception that are not yet in counters and log. A
            session that answers many at once adds here, which is much quicker than `CommunicationState.received` and
            `answered`. `fold` moves the numbers to counters and logs.
        arrived: by unit, number of received requests that are answered later, and are not yet in counters and log.
        departed: by unit, number of such later answers, without exception, that are not yet in counters and log.
        heard: what was heard since the start; call `fold` before you read it.
        requests: requests for own units since the start; a broadcast counts once. Never cleared. Call `fold` before you
            read it.
        listen_only_units: the units that answer nothing until they are restarted.
        ascii_delimiter: the character that ends an ASCII frame (sub-function 03), 0x0A by default.
        changes_allowed: as given.
    """

    __slots__ = (
        "_damage_log",
        "_listed_unit",
        "_states",
        "arrived",
        "ascii_delimiter",
        "changes_allowed",
        "departed",
        "exchanged",
        "heard",
        "listen_only_units",
        "requests",
    )

    def __init__(self, *, changes_allowed: bool = False, listed_unit: Callable[[int], int] | None = None) -> None:
        self.changes_allowed: bool = changes_allowed
        self.ascii_delimiter: int = 0x0A
        self.listen_only_units: set[int] = set()
        self.exchanged: Counter[int] = Counter()
        self.arrived: Counter[int] = Counter()
        self.departed: Counter[int] = Counter()
        self.heard: HeardCounters = HeardCounters()
        self.requests: int = 0
        self._listed_unit = listed_unit
        self._states: dict[int, CommunicationState] = {}
        # A unit that nothing was sent to yet has no state, but has heard the damaged frames like all others.
        self._damage_log: deque[int] = deque(maxlen=EVENT_LOG_SIZE)

    def of(self, unit: int) -> "CommunicationState":
        """Return the diagnostic state of the unit with this number, 0…255; created at the first use."""
        state = self._states.get(unit)
        if state is None:
            listed = unit if self._listed_unit is None else self._listed_unit(unit)
            state = self._states.get(listed)
            if state is None:
                state = self._states[listed] = CommunicationState(self, listed, self._damage_log)
            self._states[unit] = state
        return state

    def count_exchanged(self, units: bytes | bytearray) -> None:
        """Count requests that were answered at once without exception; ``units`` has the unit of each, 1 or more."""
        exchanged = self.exchanged
        first, answered = units[0], len(units)
        if units.count(first) == answered:
            exchanged[first] += answered
        else:
            for unit in units:
                exchanged[unit] += 1

    @property
    def counters(self) -> DiagnosticCounters:
        """Counters of the whole line: what was heard since the start, and the sums of the units' own counters.

        A unit's own counters begin at its last restart or clear. The object is new at each access.
        """
        self.fold()
        total = _with_heard(DiagnosticCounters(), self.heard, HeardCounters())
        for state in self._distinct():
            for name in _OWN_COUNTERS:
                setattr(total, name, getattr(total, name) + getattr(state.own, name))
        return total

    @property
    def event_count(self) -> int:
        """The sum of the event counts of all units (function 11)."""
        return sum(state.event_count for state in self._distinct())

    @property
    def listen_only(self) -> bool:
        """Whether any unit of the line is in listen-only mode."""
        return bool(self.listen_only_units)

    def received_foreign(self) -> None:
        """Count a complete message on the line that was addressed to another device."""
        self.heard.messages += 1

    def received_broadcast(self, units: Iterable[int]) -> None:
        """Count a received broadcast: once for the line, and once for each of ``units``."""
        self.fold()
        self.heard.messages += 1
        self.requests += 1
        for unit in units:
            self.of(unit).received_broadcast()

    def received_damaged(self, *, overrun: bool = False) -> None:
        """Count a damaged frame, and log it for every unit of the line, because all of them received it.

        ``overrun``: whether characters of it were lost in the port.
        """
        self.fold()
        self.heard.damaged += 1
        event = ReceiveEvent.RECEIVED | ReceiveEvent.COMMUNICATION_ERROR
        if overrun:
            self.heard.overruns += 1
            event |= ReceiveEvent.CHARACTER_OVERRUN
        self._damage_log.appendleft(event)
        for state in self._distinct():
            state.log_received(event)

    def fold(self) -> None:
        """Move the numbers in `exchanged`, `arrived` and `departed` to the counters and logs of their units.

        These three are empty afterwards. Call it before you read ``heard``, ``requests`` or `CommunicationState.own`;
        methods and properties that return counters call it themselves.
        """
        if not (self.exchanged or self.arrived or self.departed):
            return
        exchanged, arrived, departed = self.exchanged, self.arrived, self.departed
        self.exchanged, self.arrived, self.departed = Counter(), Counter(), Counter()
        came = sum(exchanged.values()) + sum(arrived.values())
        self.heard.messages += came
        self.requests += came
        for unit in {*exchanged, *arrived, *departed}:
            self.of(unit).take_many(exchanged[unit], arrived[unit], departed[unit])

    def _distinct(self) -> list["CommunicationState"]:
        """Return the diagnostic state of each device once, even if the device answers for several units."""
        return [state for unit, state in list(self._states.items()) if unit == state.unit]


class CommunicationState:
    """Counters, event log and mode of one unit, with the methods of `busway.pdu.device_interface.Diagnostics`.

    Args:
        line: the line or listener that the unit is on; if left out, the unit gets a line of its own.
        unit: the number of the unit, 0…255.
        heard_before: the first contents of the event log: events of damaged frames on the line, the newest first.
        changes_allowed: for a line of its own, as in `LineDiagnostics`; ignored if ``line`` is given.

    Attributes:
        line: as given, or the line of its own.
        unit: as given.
        own: the counters of what concerned this unit; those of what every unit hears are 0 here.
        program_command_running: whether the status word of functions 11 and 12 is FFFF.
        diagnostic_register: what sub-function 02 returns; the application sets it.
    """

    __slots__ = (
        "_event_count",
        "_heard_before",
        "_log",
        "_restart_clears_log",
        "diagnostic_register",
        "line",
        "own",
        "program_command_running",
        "unit",
    )

    def __init__(
        self,
        line: LineDiagnostics | None = None,
        unit: int = 1,
        heard_before: Iterable[int] = (),
        *,
        changes_allowed: bool = False,
    ) -> None:
        self.line: LineDiagnostics = LineDiagnostics(changes_allowed=changes_allowed) if line is None else line
        self.unit: int = unit
        self.own: DiagnosticCounters = DiagnosticCounters()
        self.program_command_running: bool = False
        self.diagnostic_register: int = 0
        self._event_count = 0
        self._heard_before = HeardCounters()
        self._log: deque[int] = deque(heard_before, maxlen=EVENT_LOG_SIZE)
        self._restart_clears_log: bool | None = None  # None: no restart is asked for

    @property
    def counters(self) -> DiagnosticCounters:
        """A copy of the eight diagnostic counters of the unit, up to date, since its last restart or clear."""
        self.line.fold()
        return _with_heard(self.own, self.line.heard, self._heard_before)

    @property
    def event_count(self) -> int:
        """Number of successful messages since the last restart or clear (function 11)."""
        self.line.fold()
        return self._event_count

    @property
    def message_count(self) -> int:
        """Number of messages heard since the last restart or clear (function 12), the count of 08/0B (§6.10)."""
        self.line.fold()
        return self.line.heard.messages - self._heard_before.messages

    @property
    def listen_only(self) -> bool:
        """Whether the unit is in listen-only mode: it answers nothing until a restart."""
        return self.unit in self.line.listen_only_units

    # What functions 08, 11 and 12 ask for.

    def diagnose(self, sub_code: int, data: bytes) -> bytes:
        """Execute sub-function ``sub_code`` of function 08 and return the data of its reply.

        A restart is only noted: `answered` or `kept_silent` carries it out.

        Raises:
            Refusal: with exception code 01: the sub-function is unknown or not allowed here, or the unit is in
                listen-only mode and the sub-function is not the restart.
        """
        self.line.fold()
        if sub_code in _CHANGES and not self.line.changes_allowed:
            raise Refusal(ExceptionCode.ILLEGAL_FUNCTION, "this listener does not take diagnostics that change it")
        if self.listen_only and sub_code != DiagnosticCode.RESTART_COMMUNICATIONS:
            raise Refusal(ExceptionCode.ILLEGAL_FUNCTION, "in listen-only mode only a restart is processed")
        if sub_code in _COUNTER_OF:
            count: int = getattr(self.counters, _COUNTER_OF[DiagnosticCode(sub_code)])
            return (count & 0xFFFF).to_bytes(2, "big")
        if sub_code == DiagnosticCode.RETURN_DIAGNOSTIC_REGISTER:
            return (self.diagnostic_register & 0xFFFF).to_bytes(2, "big")
        if sub_code == DiagnosticCode.RESTART_COMMUNICATIONS:
            self._restart_clears_log = data == b"\xff\x00"
        elif sub_code == DiagnosticCode.CHANGE_ASCII_DELIMITER:
            self.line.ascii_delimiter = data[0]
        elif sub_code == DiagnosticCode.FORCE_LISTEN_ONLY:
            self.line.listen_only_units.add(self.unit)
            self._log.appendleft(EVENT_ENTERED_LISTEN_ONLY)
        elif sub_code == DiagnosticCode.CLEAR_COUNTERS:
            self._clear()
            self.diagnostic_register = 0
        elif sub_code == DiagnosticCode.CLEAR_OVERRUN:
            self._heard_before = replace(self._heard_before, overruns=self.line.heard.overruns)
        elif sub_code != DiagnosticCode.RETURN_QUERY_DATA:
            raise Refusal(ExceptionCode.ILLEGAL_FUNCTION, f"there is no sub-function {sub_code}")
        return data

    def event_counter(self) -> tuple[int, int]:
        """Return status word (FFFF if a program command is running, else 0) and event count, for function 11."""
        return 0xFFFF if self.program_command_running else 0, self.event_count

    def event_log(self) -> tuple[int, int, int, bytes]:
        """Return status word as in `event_counter`, event count, message count, and the event bytes, for function 12.

        There are at most 64 event bytes, the newest first.
        """
        status, events = self.event_counter()
        return status, events, self.message_count, bytes(self._log)

    def restart(self, *, clear_log: bool = False) -> None:
        """Restart communications (08/01): clear the counters and leave listen-only mode.

        ``clear_log`` empties the event log too.
        """
        self._clear()
        self.line.listen_only_units.discard(self.unit)
        self._restart_clears_log = None
        if clear_log:
            self._log.clear()
        self._log.appendleft(EVENT_RESTARTED)

    # What the conversation reports.

    def received(self) -> None:
        """Count a complete message that was addressed to this unit alone."""
        line = self.line
        if line.exchanged or line.arrived or line.departed:
            line.fold()
        line.heard.messages += 1
        line.requests += 1
        self.own.server_message_count += 1
        muted = line.listen_only_units
        self._log.appendleft(_RECEIVED_MUTED if muted and self.unit in muted else _RECEIVED)

    def received_broadcast(self) -> None:
        """Count a broadcast for this unit; `LineDiagnostics.received_broadcast` calls it and counts for the line."""
        self.own.server_message_count += 1
        self.log_received(ReceiveEvent.RECEIVED | ReceiveEvent.BROADCAST)

    def log_received(self, event: int) -> None:
        """Log a receive event that concerns all units of the line, such as a damaged frame."""
        self._log.appendleft(event | ReceiveEvent.LISTEN_ONLY if self.listen_only else event)

    def answered(self, *, exception: int | None = None, counts: bool = True) -> None:
        """Count a reply of this unit, and carry out the restart that its request may have asked for.

        ``exception``: the exception code of the reply; None for a normal reply. ``counts``: whether a normal reply
        raises the event count; False for functions 11 and 12, which do not count themselves.
        """
        line = self.line
        if line.exchanged or line.arrived or line.departed:
            line.fold()
        event = _SENT
        if exception is not None:
            self.failed(exception)
            event |= _SEND_EVENT_OF_EXCEPTION.get(exception, 0)
        elif counts:
            self._event_count += 1
        if line.listen_only_units or self._restart_clears_log is not None:
            self._finish(event)
        else:
            self._log.appendleft(event)

    def failed(self, exception: int) -> None:
        """Count a request to this unit that ended with an exception code, even if no reply is sent, as to a broadcast.

        Code 06 counts as busy, 07 as NAK, every other as an exception. The event log is not changed.
        """
        if exception == ExceptionCode.SERVER_DEVICE_BUSY:
            self.own.server_busy_count += 1
        elif exception == ExceptionCode.NEGATIVE_ACKNOWLEDGE:
            self.own.server_nak_count += 1
        else:
            self.own.bus_exception_error_count += 1

    def kept_silent(self, *, executed: bool = False, write_failed: bool = False) -> None:
        """Count a message to this unit whose reply was not sent (08/0F), and carry out the restart that it asked for.

        ``executed``: whether it was a broadcast that was executed, which raises the event count too. ``write_failed``:
        whether there was a reply that the port did not accept; the event log then has a write timeout.
        """
        self.line.fold()
        self.own.server_no_response_count += 1
        if executed:
            self._event_count += 1
        self._finish(_SENT | SendEvent.WRITE_TIMEOUT if write_failed else _SENT)

    def take_many(self, exchanged: int, arrived: int, departed: int) -> None:
        """Count and log many messages of this unit at once.

        The arguments are the unit's numbers of `LineDiagnostics.exchanged`, `arrived` and `departed`.
        """
        self.own.server_message_count += exchanged + arrived
        self._event_count += exchanged + departed
        log = self._log
        log.extendleft(_PLAIN_EXCHANGE[::-1] * min(exchanged, EVENT_LOG_SIZE // 2))
        log.extendleft(_PLAIN_EXCHANGE[1:] * min(arrived, EVENT_LOG_SIZE))
        log.extendleft(_PLAIN_EXCHANGE[:1] * min(departed, EVENT_LOG_SIZE))

    def _finish(self, event: int) -> None:
        """Log the end of a message in the event log, and carry out the restart that it may have requested."""
        self._log.appendleft(event | _SENT_MUTED if self.unit in self.line.listen_only_units else event)
        if self._restart_clears_log is not None:
            self.restart(clear_log=self._restart_clears_log)

    def _clear(self) -> None:
        """Clear the unit's diagnostic counters, and the counts of functions 11 and 12 (§6.9, §6.10)."""
        self.line.fold()
        self._heard_before = replace(self.line.heard)
        self.own = DiagnosticCounters()
        self._event_count = 0


def _with_heard(own: DiagnosticCounters, heard: HeardCounters, before: HeardCounters) -> DiagnosticCounters:
    """Return a unit's own counters plus what was heard on its line since the counts ``before``."""
    return replace(
        own,
        bus_message_count=heard.messages - before.messages,
        bus_communication_error_count=heard.damaged - before.damaged,
        bus_character_overrun_count=heard.overruns - before.overruns,
    )


_OWN_COUNTERS = tuple(
    field.name
    for field in fields(DiagnosticCounters)
    if field.name not in {"bus_message_count", "bus_communication_error_count", "bus_character_overrun_count"}
)
