"""What links assume where the user gives nothing: the unit number and the settings of a serial port.

Knows the default unit and the ranges of units, and adds to an error the hint that something was assumed; knows no link.
"""

from ..codes import LAST_SERIAL_UNIT, TCP_DEVICE_UNIT, ExceptionCode
from ..errors import ExceptionReply, InvalidRequest, ModbusError, NoReply, WriteOutcomeUnknown
from ..options.endpoints import Endpoint
from ..pdu.compiler import as_integer
from ..session.client_counters import ClientCounters
from .settings import LinkSettings


def default_unit(endpoint: Endpoint, unit: int | None) -> int:
    """Return a unit number after checking it; for None the default, 255 (Messaging on TCP/IP V1.0b §4.4.1.2).

    Any unit 0…255 is valid with Modbus TCP framing. With RTU and ASCII framing, also over a network, there is no
    default, and units are 0…247 (Serial Line V1.02 §2.2).

    Raises:
        InvalidRequest: the unit is missing where it is required, or out of range. Nothing was sent.
    """
    if unit is None:
        if endpoint.framing != "mbap":
            raise InvalidRequest("a unit is needed on a serial line: link.unit(1)", endpoint=endpoint.url)
        return TCP_DEVICE_UNIT
    last = 255 if endpoint.framing == "mbap" else LAST_SERIAL_UNIT
    if not 0 <= as_integer("unit", unit) <= last:
        raise InvalidRequest(f"unit must be 0…{last}, not {unit}", endpoint=endpoint.url)
    return unit


def with_assumed_unit(outcome: object, unit: int) -> None:
    """Add to the message of an error the hint that ``unit`` was assumed, because the user gave none.

    Only to errors that another unit could avoid: those of a gateway (0A, 0B), no reply (`NoReply`,
    `WriteOutcomeUnknown`), and exception 01, because the default unit may be the gateway itself, which has no
    registers. Other errors, and replies, stay unchanged.
    """
    if isinstance(outcome, ExceptionReply):
        may_help = outcome.from_gateway or outcome.code == ExceptionCode.ILLEGAL_FUNCTION
    else:
        may_help = isinstance(outcome, NoReply | WriteOutcomeUnknown)
    if may_help:
        assert isinstance(outcome, ModbusError)
        outcome.message += f"; unit {unit} was assumed because none was named"


def with_assumed_line(outcome: object, settings: LinkSettings, counters: ClientCounters) -> None:
    """Add to the message of an error which settings of the serial port were assumed, because the user gave none.

    Only if nothing was received, or only damaged bytes, and no unit has answered with these settings so far. Other
    errors, and replies, stay unchanged.
    """
    assumed = "" if settings.line is None else settings.line.assumed
    if not assumed or counters.replies or counters.exceptions or counters.late_replies:
        return
    was_heard_of = isinstance(outcome, NoReply) and outcome.kind not in ("nothing", "partial")
    if isinstance(outcome, NoReply | WriteOutcomeUnknown) and not was_heard_of:
        outcome.message += f"; assumed, because not given: {assumed}"
