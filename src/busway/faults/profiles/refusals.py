"""Fault profiles of devices that refuse valid requests, or answer with unusual exceptions."""

from collections.abc import Callable
from typing import Annotated

from ...codes import ExceptionCode, FunctionCode
from ...options.declaration import Range
from ..fault import SILENCE, Exchange, Fault
from ..profile import SECONDS, FaultProfile

_Code = Annotated[int, Range(0, 255), "exception code"]
_SINGLE = frozenset({FunctionCode.WRITE_SINGLE_COIL, FunctionCode.WRITE_SINGLE_REGISTER})
_MULTIPLE = frozenset({FunctionCode.WRITE_MULTIPLE_COILS, FunctionCode.WRITE_MULTIPLE_REGISTERS})


def _refused(exchange: Exchange, code: int) -> bytes:
    return bytes((exchange.function | 0x80, code))


def _max_block(
    items: Annotated[int, Range(0, 2000), "most items of one request"] = 50,
    code: _Code = ExceptionCode.ILLEGAL_DATA_VALUE,
) -> Fault:
    def asked(exchange: Exchange) -> bytes | None:
        return _refused(exchange, code) if any(one.count > items for one in exchange.spans) else None

    return Fault(asked=asked)


def _hole(
    address: Annotated[int, Range(0, 0xFFFF), "the missing item, 0-based, in every table"] = 0,
    code: _Code = ExceptionCode.ILLEGAL_DATA_ADDRESS,
) -> Fault:
    def asked(exchange: Exchange) -> bytes | None:
        touched = any(one.address <= address < one.address + one.count for one in exchange.spans)
        return _refused(exchange, code) if touched else None

    return Fault(asked=asked)


def _busy(
    seconds: Annotated[float | None, SECONDS, "seconds from the first request on; nothing for ever"] = 60.0,
) -> Fault:
    since: list[float] = []

    def asked(exchange: Exchange) -> bytes | None:
        if not since:
            since.append(exchange.now)
        over = seconds is not None and exchange.now - since[0] >= seconds
        return None if over else _refused(exchange, ExceptionCode.SERVER_DEVICE_BUSY)

    return Fault(asked=asked)


def _odd_exception(
    code: _Code = 0x63,
    size: Annotated[int, Range(1, 253), "bytes of the PDU; 2 is what it should be"] = 2,
) -> Fault:
    def asked(exchange: Exchange) -> bytes | None:
        return (_refused(exchange, code) + bytes(max(size - 2, 0)))[:size]

    return Fault(asked=asked)


def _without(functions: frozenset[FunctionCode]) -> Callable[..., Fault]:
    def make(
        refuses: Annotated[bool, "the others are answered with exception 01, instead of not at all"] = False,
    ) -> Fault:
        def asked(exchange: Exchange) -> bytes | None:
            if exchange.function not in functions:
                return None
            return _refused(exchange, ExceptionCode.ILLEGAL_FUNCTION) if refuses else SILENCE

        return Fault(asked=asked)

    return make


MAX_BLOCK = FaultProfile(
    "max-block",
    "refuses more than some items in one request, or more than one",
    ("telegraf#16873", "telegraf#12071"),
    "passes the exception on; requests are split only where that is asked for",
    _max_block,
)
HOLE = FaultProfile(
    "hole",
    "one missing item fails the whole block",
    ("hass-victron#465",),
    "passes exception 02 for the block on",
    _hole,
)
BUSY = FaultProfile(
    "busy",
    "answers exception 06 for some time",
    ("core#51103",),
    "passes the exception on, and serves other units meanwhile",
    _busy,
)
ODD_EXCEPTION = FaultProfile(
    "odd-exception",
    "an exception with an unknown code or a wrong length",
    ("digitalpetri/modbus#123",),
    "ends with `ExceptionReply` or `BadReply`, and never with a crash",
    _odd_exception,
)
FC6_ONLY = FaultProfile(
    "fc6-only",
    "takes the functions that write one item (05, 06) and ignores those for several (15, 16)",
    ("ioBroker.modbus#811",),
    'writes with `function="single"`',
    _without(_MULTIPLE),
)
FC16_ONLY = FaultProfile(
    "fc16-only",
    "takes the functions that write several items (15, 16) and ignores those for one (05, 06)",
    ("ioBroker.modbus#811",),
    'writes with `function="multiple"`',
    _without(_SINGLE),
)
