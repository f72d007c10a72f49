"""Operations of a unit, such as reading values, as generators that yield requests and receive replies, without IO.

Knows which requests an operation needs and how its result is computed; knows no link. The asyncio and the blocking
interface both run these generators. A generator yields a list of requests to send together. The caller passes the list
of their replies back into it with ``send``, in the same order. The generator may yield again; its return value is the
result of the operation.
"""

import contextlib
from collections.abc import Generator, Sequence
from typing import Any, Literal

from ..codes import MAX_READ_BITS, MAX_WRITE_BITS, MAX_WRITE_REGISTERS, FunctionCode, Table
from ..errors import BadReply, InvalidRequest, ModbusError
from ..pdu.bits import as_state, as_states, is_several, listed
from ..pdu.compiler import as_integer
from ..pdu.encapsulated import EXTENDED, INDIVIDUAL, ReadDeviceIdentification
from ..pdu.functions import STANDARD
from ..pdu.malformed_request import MalformedRequest
from ..pdu.message import Message, Request
from ..pdu.read_items import (
    ReadBits,
    ReadCoils,
    ReadDiscreteInputs,
    ReadHoldingRegisters,
    ReadInputRegisters,
    ReadRegisters,
)
from ..pdu.unknown_functions import OpaqueReply
from ..pdu.wide_registers import MAX_DATA, NARROW, wide
from ..pdu.write_items import (
    MaskWriteRegister,
    WriteMultipleCoils,
    WriteMultipleRegisters,
    WriteSingleCoil,
    WriteSingleRegister,
)
from ..values import Address, ValueType, parse_address, value_type

Operation = Generator[Sequence[Request], Sequence[Message], Any]
WriteFunctionChoice = Literal["auto", "single", "multiple"]

LEVELS = {"basic": 1, "regular": 2, "extended": EXTENDED}


def read_values(
    address: int | str | Address,
    kind: str | ValueType[Any] | None,
    order: str,
    count: int | None,
    split: bool,
    width: int = NARROW,
) -> Operation:
    """Read values from an address, as a generator of requests. Its result is a list; one value if ``count`` is None.

    Args:
        address: where the first value is, in any notation that names its table. With a bit (``4x1.3``) each value is
            this bit of one register, as a bool, and ``kind`` is ignored.
        kind: type of the values; None: unsigned integers of one register. Must be None for coils and discrete inputs.
        order: order of bytes and registers in values, such as ``ABCD``.
        count: number of values; None: one.
        split: whether several requests may be used if one cannot hold all values.
        width: bytes of one register in replies, an even number 2…12; more than 2 only for special devices. If a value
            is smaller than a register, each register has one value, in its last bytes.

    Raises:
        InvalidRequest: an argument is invalid or too large. Nothing was sent.
        BadReply: bytes of a reply are no value of the type.
    """
    place = place_of(address)
    number = 1 if count is None else count
    if number < 1:
        raise InvalidRequest(f"count must be at least 1, not {number}")
    if place.table in (Table.COILS, Table.DISCRETE_INPUTS):
        if kind is not None:
            raise InvalidRequest(f"{place}: a {place.table.label} is one bit and has no type {kind}")
        requests = _pieces(place, number, MAX_READ_BITS, split)
        replies = yield requests
        found: list[Any] = []
        for request, reply in zip(requests, replies, strict=True):
            assert isinstance(reply, ReadCoils.Reply | ReadDiscreteInputs.Reply)
            assert isinstance(request, ReadCoils | ReadDiscreteInputs)
            found += reply.bits(request.count)
    else:
        if place.bit is not None:
            kind = f"bit:{place.bit}"
        form = value_type(kind if kind is not None else _natural_type(place, width), order)
        size = 2 * form.registers_for(number)
        apart = width > 2 * form.registers_for(1)  # one value in each register
        registers = number if apart else -(-size // width)
        requests = _pieces(place, registers, MAX_DATA // width, split, width)
        replies = yield requests
        data = b""
        for reply in replies:
            assert isinstance(reply, ReadHoldingRegisters.Reply | ReadInputRegisters.Reply)
            data += reply.data
        if apart:
            low = width - size // number
            data = b"".join(data[at + low : at + width] for at in range(0, len(data), width))
        found = form.decode(data[:size])
    return found[0] if count is None else found


def write_values(
    address: int | str | Address,
    values: Any,
    kind: str | ValueType[Any] | None,
    order: str,
    function: WriteFunctionChoice,
) -> Operation:
    """Write one value or several to an address with one request, as a generator of requests. Its result is None.

    Args:
        address: where the first value goes, in any notation that names its table. With a bit (``4x1.3``), ``values`` is
            one bool, which a mask write (function 22) writes, whatever ``kind``, ``order`` and ``function`` are.
        values: one value, or an iterable of values for consecutive addresses.
        kind: type of the values; None: ``uint16``. Must be None for coils.
        order: order of bytes and registers in values, such as ``ABCD``.
        function: ``single`` (05, 06), ``multiple`` (15, 16), or ``auto``: single for one coil or register, else
            multiple.

    Raises:
        InvalidRequest: an argument is invalid or too large, there is no value, the values need more than one register
            with ``single``, or the table is read-only. Nothing was sent.
    """
    if function not in ("auto", "single", "multiple"):
        raise InvalidRequest(f"function must be auto, single or multiple, not {function!r}")
    place = place_of(address)
    if place.table is None or not place.table.is_writable:
        raise InvalidRequest(f"{place}: {place.table.label if place.table else 'table'}s are read-only")
    several = is_several(values)
    items = listed(values, "values") if several else [values]
    if not items:
        raise InvalidRequest(f"{place}: no value to write")
    request: Request
    if place.table is Table.COILS:
        if kind is not None:
            raise InvalidRequest(f"{place}: a coil is one bit and has no type {kind}")
        items = as_states(items)
        _check_single(place, len(items), MAX_WRITE_BITS, function)
        if function == "multiple" or len(items) > 1:
            request = WriteMultipleCoils.of(place.offset, items)
        else:
            request = WriteSingleCoil.of(place.offset, items[0])
    elif place.bit is not None:
        if several:
            raise InvalidRequest(f"{place}: one bit is written with True or False")
        bit = 1 << place.bit
        request = MaskWriteRegister(place.offset, 0xFFFF & ~bit, bit if as_state(str(place), items[0]) else 0)
    else:
        data = value_type(kind if kind is not None else "uint16", order).encode(items)
        registers = len(data) // 2
        _check_single(place, registers, MAX_WRITE_REGISTERS, function)
        if function == "multiple" or registers > 1:
            request = WriteMultipleRegisters(place.offset, registers, data)
        else:
            request = WriteSingleRegister(place.offset, int.from_bytes(data, "big"))
    yield (request,)


def read_identification(level: str, object_id: int | None) -> Operation:
    """Read identification objects (43/14), as a generator of requests. Its result is a dict of bytes by object number.

    Args:
        level: ``basic``, ``regular`` or ``extended``: the objects to read; ignored if ``object_id`` is given.
        object_id: the only object to read, 0…255; None for all of the level.

    Raises:
        InvalidRequest: ``level`` is none of the three, or ``object_id`` is out of range. Nothing was sent.
        BadReply: a reply says that more objects follow, but the next one that it names does not come after the object
            with which the reply was asked to begin.
    """
    if object_id is not None:
        code, start = INDIVIDUAL, object_id
    elif level in LEVELS:
        code, start = LEVELS[level], 0
    else:
        raise InvalidRequest(f"level must be one of {', '.join(LEVELS)}, not {level!r}")
    objects: dict[int, bytes] = {}
    while True:
        (reply,) = yield (ReadDeviceIdentification(code, start),)
        assert isinstance(reply, ReadDeviceIdentification.Reply)
        objects.update((one.number, one.value) for one in reply.objects)
        if not reply.more_follows:
            return objects
        if reply.next_object <= start:
            raise BadReply(
                f"more objects are said to follow from {reply.next_object} on, after {start}",
                kind="content",
                raw=reply.encode(),
            )
        start = reply.next_object


def place_of(address: int | str | Address) -> Address:
    """Parse a data address such as ``4x101``, which must name its table. Raises `InvalidRequest`."""
    place = parse_address(address)
    if place.table is None:
        raise InvalidRequest(f"address {address} names no table; {_hint_of_number(place)}")
    return place


def _hint_of_number(place: Address) -> str:
    """Return a text for an error message: how to write an address that was given as a number without a table."""
    offset = place.offset
    with contextlib.suppress(InvalidRequest):
        meant = parse_address(str(offset))
        assert meant.table is not None
        return f"write '{offset}' for {meant.table.label} {meant.number}, or 'holding:{offset}' for offset {offset}"
    return f"write for example '4x{offset + 1}' or 'holding:{offset}'"


READ: dict[Table, type[ReadBits] | type[ReadRegisters]] = {
    Table.COILS: ReadCoils,
    Table.DISCRETE_INPUTS: ReadDiscreteInputs,
    Table.HOLDING_REGISTERS: ReadHoldingRegisters,
    Table.INPUT_REGISTERS: ReadInputRegisters,
}


def _natural_type(place: Address, width: int) -> str:
    """Return the type that is used if the user gives none: an unsigned integer of one register of ``width`` bytes.

    Raises `InvalidRequest` unless ``width`` is 2, 4 or 8.
    """
    if width not in (2, 4, 8):
        raise InvalidRequest(f"{place}: a register of {width} bytes is no number by itself; name a type")
    return f"uint{8 * width}"


def _pieces(place: Address, items: int, limit: int, split: bool, width: int = NARROW) -> list[Request]:
    assert place.table is not None
    if items > limit and not split:
        raise InvalidRequest(
            f"{place}: {items} {place.table.label}s are more than the {limit} of one request; "
            "ask for fewer, or let it be split"
        )
    if place.offset + items > 65_536:
        raise InvalidRequest(f"{place}: {items} {place.table.label}s end beyond the last one, 65536")
    kind = READ[place.table]
    if issubclass(kind, ReadRegisters):
        kind = wide(kind, width)
    return [kind(place.offset + done, min(limit, items - done)) for done in range(0, items, limit)]


def _check_single(place: Address, items: int, limit: int, function: WriteFunctionChoice) -> None:
    if function == "single" and items > 1:
        raise InvalidRequest(f"{place}: {items} items cannot be written with a function for one")
    if items > limit:
        assert place.table is not None
        raise InvalidRequest(f"{place}: {items} {place.table.label}s are more than the {limit} of one request")


def diagnostic_request(sub_function: int, data: bytes) -> Request:
    """Return a request of function 08 with any sub-function, 0…65535, and the bytes after it as its data.

    Raises:
        InvalidRequest: the sub-function is out of range, or is a standard one that cannot have such data.
    """
    if not 0 <= as_integer("sub-function", sub_function) <= 0xFFFF:
        raise InvalidRequest(f"sub-function must be 0…65535, not {sub_function}")
    pdu = bytes((FunctionCode.DIAGNOSTICS,)) + sub_function.to_bytes(2, "big") + bytes(data)
    request = STANDARD.decode_request(pdu)
    if isinstance(request, MalformedRequest):
        raise InvalidRequest(f"sub-function {sub_function}: {request.reason}")
    return request


def diagnostic_data(reply: Message) -> bytes:
    """Return the data of a reply to function 08: the bytes after the sub-function."""
    data: bytes = reply.values()["data"]
    return data[2:] if isinstance(reply, OpaqueReply) else data


def errors_among(outcomes: Sequence[Any]) -> list[ModbusError]:
    """Return the errors among the outcomes of a call, in their order.

    As a rule there is none, which the few types among the outcomes show more quickly than each outcome.
    """
    if not any(issubclass(kind, ModbusError) for kind in set(map(type, outcomes))):
        return []
    return [outcome for outcome in outcomes if isinstance(outcome, ModbusError)]
