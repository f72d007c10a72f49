"""``busway counters``: shows the diagnostic counters of a device, read over Modbus.

1. Diagnostic counters (function 08, sub-functions 0B…12) and diagnostic register (02), event counter (11), event log
   (12), exception status (07). Nothing is cleared and nothing is written.
2. Each function that a device refuses is named on stderr. It is an error only if the device refuses all of them.
3. A device that does not answer is not asked ten times: the first question without a reply ends the command.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from ..codes import DiagnosticCode
from ..errors import ExceptionReply
from .arguments import CAPTURE, JSON, RETRIES, TIMEOUT, UNIT, URL, VERBOSE, opened_unit
from .exits import ExitCode
from .files import capturing
from .output import print_aligned, print_json, warn

if TYPE_CHECKING:
    from ..client.blocking import BlockingUnit

EXAMPLES = """\b
Examples:
  busway counters rtu:///dev/ttyUSB0 --unit 3
  busway counters tcp://10.0.0.5 --json
"""

COUNTERS: tuple[tuple[DiagnosticCode, str], ...] = (
    (DiagnosticCode.BUS_MESSAGE_COUNT, "frames seen on the line, whatever unit"),
    (DiagnosticCode.BUS_COMMUNICATION_ERROR_COUNT, "damaged frames seen on the line"),
    (DiagnosticCode.BUS_EXCEPTION_ERROR_COUNT, "exceptions answered"),
    (DiagnosticCode.SERVER_MESSAGE_COUNT, "requests for this unit, broadcasts included"),
    (DiagnosticCode.SERVER_NO_RESPONSE_COUNT, "of those, not answered"),
    (DiagnosticCode.SERVER_NAK_COUNT, "answered with a negative acknowledge"),
    (DiagnosticCode.SERVER_BUSY_COUNT, "answered with busy"),
    (DiagnosticCode.BUS_CHARACTER_OVERRUN_COUNT, "frames lost because characters came too fast"),
    (DiagnosticCode.RETURN_DIAGNOSTIC_REGISTER, "16 bits that the device defines"),
)
"""The sub-functions of function 08 that are read, each with what it counts (Application Protocol V1.1b3 §6.8.1)."""

_RECEIVE_EVENT, _SEND_EVENT = 0x80, 0x40
_Bits = tuple[tuple[int, str], ...]
_RECEIVED: _Bits = (
    (0x02, "communication error"),
    (0x10, "character overrun"),
    (0x20, "in listen-only mode"),
    (0x40, "broadcast"),
)
_SENT: _Bits = (
    (0x01, "exception 1…3"),
    (0x02, "exception 4"),
    (0x04, "exception 5 or 6"),
    (0x08, "exception 7"),
    (0x10, "write timeout"),
    (0x20, "in listen-only mode"),
)
_OTHER_EVENTS = {0x00: "communication restarted", 0x04: "listen-only mode entered"}


@dataclass(frozen=True, slots=True)
class Fact:
    """One value of a device's diagnostics (functions 08, 11, 12, 07), with its name.

    Attributes:
        function: function code, with the sub-function in hexadecimal if there is one: ``08/0B``, ``11``.
        name: the specification's name of the value, with underscores: ``bus_message_count``.
        value: the number; for the event log a list of event bytes, the newest first.
        meaning: what the value counts, in words; may be empty.
    """

    function: str
    name: str
    value: Any  # a number or a list of numbers
    meaning: str


def counters(
    url: str = URL,
    unit: str | None = UNIT,
    as_json: bool = JSON,
    timeout: str | None = TIMEOUT,
    retries: str | None = RETRIES,
    capture: str | None = CAPTURE,
    verbose: int = VERBOSE,
) -> int:
    """Read the counters of a device (functions 08, 11, 12 and 07)."""
    facts: list[Fact] = []
    refusals: list[ExceptionReply] = []
    with (
        capturing(capture),
        opened_unit(url, unit=unit, timeout=timeout, retries=retries, verbose=verbose) as asked,
    ):
        for function, name, ask in _questions():
            try:
                facts += ask(asked)
            except ExceptionReply as error:
                if error.from_gateway:
                    raise
                refusals.append(error)
                warn(f"{function} ({name.replace('_', ' ')}) is not offered: exception {error.code:02X}")
    if not facts:
        raise refusals[0]
    _show(facts, as_json=as_json)
    return ExitCode.DONE


def _questions() -> list[tuple[str, str, Callable[["BlockingUnit"], list[Fact]]]]:
    """Return the diagnostics to read, in order: function code, name, and a function that reads them from a unit."""
    questions: list[tuple[str, str, Callable[[BlockingUnit], list[Fact]]]] = []
    for code, meaning in COUNTERS:
        function, name = f"08/{code:02X}", code.name.lower().removeprefix("return_")

        def ask(
            unit: "BlockingUnit",
            code: DiagnosticCode = code,
            function: str = function,
            name: str = name,
            meaning: str = meaning,
        ) -> list[Fact]:
            return [Fact(function, name, int.from_bytes(unit.diagnostics(code), "big"), meaning)]

        questions.append((function, name, ask))
    questions.append(("11", "event_counter", _event_counter))
    questions.append(("12", "event_log", _event_log))
    questions.append(("07", "exception_status", _exception_status))
    return questions


def _event_counter(unit: "BlockingUnit") -> list[Fact]:
    reply = unit.get_comm_event_counter()
    return [
        Fact("11", "status", reply.status, _status_text(reply.status)),
        Fact("11", "event_count", reply.event_count, "requests done without exception"),
    ]


def _event_log(unit: "BlockingUnit") -> list[Fact]:
    reply = unit.get_comm_event_log()
    return [
        Fact("12", "message_count", reply.message_count, "frames processed since the last restart"),
        Fact("12", "events", list(reply.events), "the newest first"),
    ]


def _exception_status(unit: "BlockingUnit") -> list[Fact]:
    return [Fact("07", "exception_status", unit.read_exception_status(), "8 bits that the device defines")]


def _status_text(status: int) -> str:
    return {0: "no program command runs", 0xFFFF: "a program command runs"}.get(status, "")


def event_text(event: int) -> str:
    """Return in words what an event byte of the event log (function 12) means (Application Protocol V1.1b3 §6.10)."""
    if event in _OTHER_EVENTS:
        return _OTHER_EVENTS[event]
    if event & _RECEIVE_EVENT:
        kind, bits = "received", _RECEIVED
    elif event & _SEND_EVENT:
        kind, bits = "sent", _SENT
    else:
        return "an event outside the specification"
    said = [words for bit, words in bits if event & bit]
    return f"{kind}: {', '.join(said)}" if said else kind


def _show(facts: list[Fact], *, as_json: bool) -> None:
    if as_json:
        for fact in facts:
            said: dict[str, Any] = {"function": fact.function, "name": fact.name, "value": fact.value}
            if isinstance(fact.value, list):
                said["events"] = [event_text(event) for event in fact.value]
            print_json(said)
        return
    numbers = [fact for fact in facts if not isinstance(fact.value, list)]
    widest = max(len(_number(fact)) for fact in numbers) if numbers else 0
    print_aligned(
        [[fact.function, fact.name.replace("_", " "), _number(fact).rjust(widest), fact.meaning] for fact in numbers]
    )
    for fact in facts:
        if isinstance(fact.value, list):
            print(f"\n{len(fact.value)} events, {fact.meaning}" if fact.value else "\nno events")
            print_aligned([[f"{event:02X}", event_text(event)] for event in fact.value])


def _number(fact: Fact) -> str:
    """Return the value of a fact as text: status words in hexadecimal, 8 status bits in binary, counts in decimal."""
    if fact.name in ("status", "diagnostic_register"):
        return f"0x{fact.value:04X}"
    return f"0b{fact.value:08b}" if fact.name == "exception_status" else str(fact.value)
