"""Checks shared by the asyncio and the blocking interface: unit numbers, settings of a shared link, refused calls.

Knows defaults and checks; knows no link and does no IO.
"""

from collections.abc import Mapping, Sequence

from ..codes import LAST_SERIAL_UNIT, TCP_DEVICE_UNIT, ExceptionCode
from ..errors import ConfigError, ExceptionReply, InvalidRequest, LinkClosed, ModbusError, NoReply, WriteOutcomeUnknown
from ..options.endpoints import Endpoint
from ..pdu.compiler import as_integer
from ..pdu.message import Request
from ..session.call_tracker import ClientCounters, function_of
from ..session.reconnect import ConnectionState
from .settings import CALL_DEFAULTS, LinkSettings

SHOWN_STATE = {state.value: state.value for state in ConnectionState} | {
    ConnectionState.UP.value: "connected",
    ConnectionState.DOWN.value: "not connected",
}
"""The words for the states of a connection in the ``repr`` of a link, by state."""


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


def refused(refusal: ModbusError, requests: Sequence[Request]) -> list[ModbusError]:
    """Return one error for each request of a call that was refused before anything was sent, in order.

    Each is a copy of ``refusal``, the error of the call, with the request's function and its first address, which is
    None for a request without one.
    """
    errors = []
    for request in requests:
        error = type(refusal).__new__(type(refusal), *refusal.args)
        error.__dict__.update(vars(refusal))
        error.__cause__ = refusal.__cause__
        spans = request.spans()
        error.function = function_of(request)
        error.address = spans[0].address if spans else None
        errors.append(error)
    return errors


def closed_error(settings: LinkSettings) -> LinkClosed:
    """Return the error for a call on a link that the program has closed."""
    return LinkClosed("this link was closed by its user; nothing was sent", endpoint=settings.endpoint.url)


def no_connection_of_its_own(settings: LinkSettings) -> InvalidRequest:
    """Return the error for managing the connection of a link opened with ``select``, which has none of its own."""
    return InvalidRequest("a link opened with select has no connection of its own", endpoint=settings.endpoint.url)


def check_same(held: LinkSettings, wanted: LinkSettings) -> None:
    """Raise `ConfigError` if a further user of a shared link asks for connection settings that the link does not have.

    ``held``: the settings of the link; ``wanted``: those of the further user.
    """
    different = held.differs(wanted)
    if different:
        raise ConfigError(
            f"{held.endpoint.url} is open already with another {different}; shared=False gives a connection of its own",
            key=different,
        )


def check_selected(settings: LinkSettings, options: Mapping[str, object]) -> None:
    """Raise `ConfigError` if a link with ``select`` gets options of a connection, which would have no effect.

    ``options`` are those given by keyword; the options in the URL are in ``settings``.
    """
    context = () if settings.ssl_context is None else ("ssl_context",)
    for name in (*settings.endpoint.options, *options, *context):
        if name not in CALL_DEFAULTS:
            raise ConfigError(
                f"has no effect with select: the connection is another link's; only {', '.join(CALL_DEFAULTS)} may "
                "stand there",
                key=name,
            )
