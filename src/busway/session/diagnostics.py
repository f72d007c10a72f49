"""What functions 08, 11 and 12 tell: the counters, the event log and listen-only mode of one line or listener.

Knows when something is counted; knows no bytes and no port (Application Protocol V1.1b3 §6.8–§6.10, Serial Line
V1.02 appendix A).

1. Counters are 16 bit on the wire and wrap there; here they go on, so that a status can show the true number.
2. 01 answers before it restarts, except in listen-only mode, where it restarts without an answer. So it is done when
   the outcome of its request is reported, by `answered` or `kept_silent`. In listen-only mode nothing else is done.
3. On a network listener the sub-functions that change something (01, 03, 04, 0A, 14) are refused with 01 unless
   ``changes_allowed``: one packet could mute a server for everybody.
"""

from collections import deque
from dataclasses import dataclass, fields
from enum import IntFlag

from ..codes import DiagnosticCode, ExceptionCode
from ..pdu.model import Refusal

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
    """Bits of a receive event; 0x80 is always set."""

    RECEIVED = 0x80
    COMMUNICATION_ERROR = 0x02
    CHARACTER_OVERRUN = 0x10
    LISTEN_ONLY = 0x20
    BROADCAST = 0x40


class SendEvent(IntFlag):
    """Bits of a send event; 0x40 is always set."""

    SENT = 0x40
    READ_EXCEPTION = 0x01
    ABORT_EXCEPTION = 0x02
    BUSY_EXCEPTION = 0x04
    NAK_EXCEPTION = 0x08
    WRITE_TIMEOUT = 0x10
    LISTEN_ONLY = 0x20


_SEND_EVENT_OF_EXCEPTION = {
    1: SendEvent.READ_EXCEPTION,
    2: SendEvent.READ_EXCEPTION,
    3: SendEvent.READ_EXCEPTION,
    4: SendEvent.ABORT_EXCEPTION,
    5: SendEvent.BUSY_EXCEPTION,
    6: SendEvent.BUSY_EXCEPTION,
    7: SendEvent.NAK_EXCEPTION,
}
_PLAIN_EXCHANGE = bytes((SendEvent.SENT, ReceiveEvent.RECEIVED))


@dataclass(slots=True)
class Counters:
    """The diagnostic counters, named as the sub-functions 0B…12 name them."""

    bus_message_count: int = 0
    bus_communication_error_count: int = 0
    bus_exception_error_count: int = 0
    server_message_count: int = 0
    server_no_response_count: int = 0
    server_nak_count: int = 0
    server_busy_count: int = 0
    bus_character_overrun_count: int = 0

    def clear(self) -> None:
        """Set all of them to zero."""
        for field in fields(self):
            setattr(self, field.name, 0)


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


class CommunicationState:
    """Counters, event log and mode of one line or listener; what `busway.pdu.model.Diagnostics` asks for.

    Attributes:
        exchanged: requests that came in and were answered, all well, and are not in counters and log yet. Whoever
            answers many at once adds here, 30 ns instead of 600; every reading of the counters takes it in.
        arrived, departed: likewise, where the answers come later: requests that came in, and answers that went out,
            all well.
        listen_only: whether nothing is answered until a restart.
        program_command_running: whether the status word of 11 and 12 is FFFF.
        diagnostic_register: what sub-function 02 returns; the application sets it.
        ascii_delimiter: the character that ends an ASCII frame (sub-function 03), 0x0A by default.
        changes_allowed: whether the sub-functions that change something are offered.
    """

    __slots__ = (
        "_counters",
        "_event_count",
        "_log",
        "_message_count",
        "_restart_clears_log",
        "arrived",
        "ascii_delimiter",
        "changes_allowed",
        "departed",
        "diagnostic_register",
        "exchanged",
        "listen_only",
        "program_command_running",
    )

    def __init__(self, *, changes_allowed: bool = False) -> None:
        self._counters = Counters()
        self._event_count = 0
        self._message_count = 0
        self.exchanged = self.arrived = self.departed = 0
        self.listen_only = False
        self.program_command_running = False
        self.diagnostic_register = 0
        self.ascii_delimiter = 0x0A
        self.changes_allowed = changes_allowed
        self._log: deque[int] = deque(maxlen=EVENT_LOG_SIZE)
        self._restart_clears_log: bool | None = None  # None: no restart is asked for

    @property
    def counters(self) -> Counters:
        """The eight counters, up to date."""
        self._fold()
        return self._counters

    @property
    def event_count(self) -> int:
        """Successful messages since the last restart (function 11)."""
        self._fold()
        return self._event_count

    @event_count.setter
    def event_count(self, value: int) -> None:
        self._fold()
        self._event_count = value

    @property
    def message_count(self) -> int:
        """Messages seen since the last restart (function 12)."""
        self._fold()
        return self._message_count

    # What functions 08, 11 and 12 ask for.

    def diagnose(self, sub_code: int, data: bytes) -> bytes:
        """Do a sub-function of 08 and give the data of its reply. `Refusal` 01 where it is not offered."""
        if self.exchanged or self.arrived or self.departed:
            self._fold()
        if sub_code in _CHANGES and not self.changes_allowed:
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
            self.ascii_delimiter = data[0]
        elif sub_code == DiagnosticCode.FORCE_LISTEN_ONLY:
            self.listen_only = True
            self._log.appendleft(EVENT_ENTERED_LISTEN_ONLY)
        elif sub_code == DiagnosticCode.CLEAR_COUNTERS:
            # The counts of 11 and 12 are those "since its last restart, clear counters operation, or power-up" (§6.10).
            self._counters.clear()
            self._event_count = self._message_count = 0
            self.diagnostic_register = 0
        elif sub_code == DiagnosticCode.CLEAR_OVERRUN:
            self._counters.bus_character_overrun_count = 0
        elif sub_code != DiagnosticCode.RETURN_QUERY_DATA:
            raise Refusal(ExceptionCode.ILLEGAL_FUNCTION, f"there is no sub-function {sub_code}")
        return data

    def event_counter(self) -> tuple[int, int]:
        """Status word and number of successful messages."""
        return 0xFFFF if self.program_command_running else 0, self.event_count

    def event_log(self) -> tuple[int, int, int, bytes]:
        """Status word, event count, message count, and up to 64 event bytes, the newest first."""
        status, events = self.event_counter()
        return status, events, self.message_count, bytes(self._log)

    def restart(self, *, clear_log: bool = False) -> None:
        """Restart communications: counters cleared, listen-only mode left, the event log kept unless asked."""
        self._fold()
        self._counters.clear()
        self._event_count = self._message_count = 0
        self.listen_only = False
        self._restart_clears_log = None
        if clear_log:
            self._log.clear()
        self._log.appendleft(EVENT_RESTARTED)

    # What the conversation reports.

    def received(self, *, broadcast: bool = False) -> None:
        """A frame for this server came in, whole."""
        if self.exchanged or self.arrived or self.departed:
            self._fold()
        self._counters.bus_message_count += 1
        self._counters.server_message_count += 1
        self._message_count += 1
        event = ReceiveEvent.RECEIVED
        if broadcast:
            event |= ReceiveEvent.BROADCAST
        if self.listen_only:
            event |= ReceiveEvent.LISTEN_ONLY
        self._log.appendleft(event)

    def received_foreign(self) -> None:
        """A whole frame for another unit passed by."""
        if self.exchanged or self.arrived or self.departed:
            self._fold()
        self._counters.bus_message_count += 1

    def received_damaged(self, *, overrun: bool = False) -> None:
        """A damaged frame came in."""
        if self.exchanged or self.arrived or self.departed:
            self._fold()
        self._counters.bus_communication_error_count += 1
        event = ReceiveEvent.RECEIVED | ReceiveEvent.COMMUNICATION_ERROR
        if overrun:
            self._counters.bus_character_overrun_count += 1
            event |= ReceiveEvent.CHARACTER_OVERRUN
        self._log.appendleft(event)

    def answered(self, *, exception: int | None = None, counts: bool = True) -> None:
        """An answer goes out; ``counts`` is False for functions that leave the event counter alone (11)."""
        if self.exchanged or self.arrived or self.departed:
            self._fold()
        event = SendEvent.SENT
        if exception is None:
            if counts:
                self._event_count += 1
        else:
            self.failed(exception)
            event |= _SEND_EVENT_OF_EXCEPTION.get(exception, SendEvent(0))
        self._log.appendleft(event)
        if self._restart_clears_log is not None:
            self.restart(clear_log=self._restart_clears_log)

    def failed(self, exception: int) -> None:
        """A request, perhaps a broadcast, ended with an exception code."""
        if self.exchanged or self.arrived or self.departed:
            self._fold()
        if exception == ExceptionCode.SERVER_DEVICE_BUSY:
            self._counters.server_busy_count += 1
        elif exception == ExceptionCode.NEGATIVE_ACKNOWLEDGE:
            self._counters.server_nak_count += 1
        else:
            self._counters.bus_exception_error_count += 1

    def kept_silent(self) -> None:
        """A message for this server gets no answer."""
        if self.exchanged or self.arrived or self.departed:
            self._fold()
        self._counters.server_no_response_count += 1
        if self._restart_clears_log is not None:
            self.restart(clear_log=self._restart_clears_log)

    def _fold(self) -> None:
        """Take what `exchanged`, `arrived` and `departed` say into the counters and the log."""
        exchanged, arrived, departed = self.exchanged, self.arrived, self.departed
        self.exchanged = self.arrived = self.departed = 0
        came = exchanged + arrived
        counters = self._counters
        counters.bus_message_count += came
        counters.server_message_count += came
        self._message_count += came
        self._event_count += exchanged + departed
        log = self._log
        log.extendleft(_PLAIN_EXCHANGE[::-1] * min(exchanged, EVENT_LOG_SIZE // 2))
        log.extendleft(_PLAIN_EXCHANGE[1:] * min(arrived, EVENT_LOG_SIZE))
        log.extendleft(_PLAIN_EXCHANGE[:1] * min(departed, EVENT_LOG_SIZE))
