"""Describes a PDU for people: every field with its offset, its value and what is wrong with it.

Knows the declarations of functions and how to show them; sends and executes nothing. ``decode`` stops at the first
error. A description goes on: it shows all fields that are there, and names each rule that is broken.

1. Nothing raises, whatever the bytes are.
2. A description has no problems exactly if ``decode`` of the message class accepts the PDU. A problem that belongs to
   no single field is listed for the whole PDU.
"""

from collections.abc import Iterator
from dataclasses import dataclass, fields
from typing import Any, Final

from ..codes import PDU_LIMIT, DiagnosticCode, FunctionCode, MeiType, Table, exception_meaning, function_name
from ..values import Address, format_address, printable
from ..values.counts import counted
from .bits import unpack_bits
from .encapsulated import OBJECT_NAMES, IdentificationObject
from .fields import FixedField, RepeatedField, RestLength
from .functions import STANDARD, FunctionTable
from .malformed_pdu import MalformedPdu
from .malformed_request import MalformedRequest
from .message import Message, Request
from .read_items import ReadFifoQueue, unpack_registers
from .write_items import WriteSingleCoil

_MOST_VALUES: Final = 24
"""Most values of a block that are shown; of a longer block their number is added."""


@dataclass(frozen=True, slots=True)
class Part:
    """One field of a PDU in a description for people.

    Attributes:
        offset: offset of its first byte in the PDU; the function code has 0.
        data: its bytes; fewer than the field needs if the PDU is cut off.
        name: the specification's name of the field; ``data`` for undecoded bytes, ``surplus`` for bytes too many.
        text: its value in words; empty if the bytes need no explanation.
        problem: what is wrong with the field; empty if nothing is.
    """

    offset: int
    data: bytes
    name: str
    text: str = ""
    problem: str = ""


@dataclass(frozen=True, slots=True)
class Description:
    """A description of a PDU for people: its function and all its fields.

    Attributes:
        title: function and direction, ``3 (read holding registers), request``; ``…, exception`` for an exception.
        parts: the fields in their order; together they hold all bytes.
        problems: what is wrong with the PDU and its parts, in order; empty if the PDU is valid.
        message: the decoded request, reply or exception; None if the PDU is not valid.
        is_known: whether the table of functions has the function and sub-function; always True for an exception reply,
            always False for an empty PDU.
    """

    title: str
    parts: tuple[Part, ...]
    problems: tuple[str, ...]
    message: Message | None
    is_known: bool = True


def describe_request(pdu: bytes, functions: FunctionTable = STANDARD) -> Description:
    """Describe the bytes of a request PDU for people, field by field; never raises.

    Args:
        pdu: the bytes, function code first; any bytes are accepted.
        functions: the functions that are known.
    """
    if not pdu:
        return _empty("request")
    kind = functions.find(pdu, 0, len(pdu))
    decoded = functions.decode_request(pdu) if pdu[0] < 0x80 and len(pdu) <= PDU_LIMIT else None
    problem = decoded.reason if isinstance(decoded, MalformedRequest) else _too_long(pdu)
    if pdu[0] == 0 or pdu[0] >= 0x80:
        problem = f"a request has a function code 1…127, not {pdu[0]}"
    message = None if problem or isinstance(decoded, MalformedRequest) else decoded
    return _described(pdu, kind, kind, "request", message, problem)


def describe_reply(pdu: bytes, functions: FunctionTable = STANDARD, *, request: Message | None = None) -> Description:
    """Describe the bytes of a reply PDU for people, field by field; never raises.

    Args:
        pdu: the bytes, function code first; any bytes are accepted.
        functions: the functions that are known.
        request: the request that was answered, whose ``count`` tells how many bits of a reply are data. None if it is
            not known: then all bits of the last byte are shown too.
    """
    if not pdu:
        return _empty("reply")
    problem = "a reply has a function code 1…127, or an exception, not 0" if pdu[0] == 0 else ""
    message: Message | None = None
    problem = problem or _too_long(pdu)
    try:
        message = None if problem else functions.decode_reply(pdu)
    except MalformedPdu as error:
        problem = error.reason
    if pdu[0] & 0x80:
        return _exception(pdu, problem, message)
    kind = functions.find(pdu, 0, len(pdu))
    return _described(pdu, kind, None if kind is None else kind.Reply, "reply", message, problem, request)


def _too_long(pdu: bytes) -> str:
    return f"{len(pdu)} bytes where a PDU has at most {PDU_LIMIT}" if len(pdu) > PDU_LIMIT else ""


def _empty(direction: str) -> Description:
    return Description(f"nothing, {direction}", (), ("a PDU has at least a function code",), None, is_known=False)


def _exception(pdu: bytes, problem: str, message: Message | None) -> Description:
    code = pdu[0] & 0x7F
    parts = [Part(0, pdu[:1], "function", f"{function_name(code)}, with the exception bit")]
    at = 1
    if message is not None and len(pdu) == 3:  # the form AB 0E cc, see `decode_exception`
        parts.append(Part(1, pdu[1:2], "MEI type", _sub_code_name(code, pdu[1:2])))
        at = 2
    if at < len(pdu):
        parts.append(Part(at, pdu[at : at + 1], "exception code", f"{pdu[at]:02X}, {exception_meaning(pdu[at])}"))
    else:
        parts.append(Part(at, b"", "exception code", problem="is cut off"))
    at += 1
    if at < len(pdu):
        parts.append(Part(at, pdu[at:], "surplus", problem=f"{counted(len(pdu) - at, 'byte')} too many"))
    return _finished(f"{function_name(code)}, exception", parts, problem, message, is_known=True)


def _described(
    pdu: bytes,
    request_kind: type[Request] | None,
    kind: type[Message] | None,
    direction: str,
    message: Message | None,
    problem: str,
    request: Message | None = None,
) -> Description:
    title = f"{function_name(pdu[0])}, {direction}"
    parts = [Part(0, pdu[:1], "function", function_name(pdu[0]))]
    if kind is None or request_kind is None:
        if len(pdu) > 1:
            parts.append(Part(1, pdu[1:], "data"))
        return _finished(title, parts, problem, message, is_known=False)
    shown = _Meaning(request_kind, direction == "request", request)
    parts += _field_parts(pdu, kind, shown)
    return _finished(title, parts, problem, message, is_known=True)


def _finished(title: str, parts: list[Part], problem: str, message: Message | None, *, is_known: bool) -> Description:
    problems = [f"{part.name}: {part.problem}" for part in parts if part.problem]
    if problem and not problems:
        problems = [problem]
    return Description(title, tuple(parts), tuple(problems), None if problems else message, is_known)


def _field_parts(pdu: bytes, kind: type[Message], shown: "_Meaning") -> Iterator[Part]:
    """Yield the fields of a PDU after its function code with their descriptions, as far as its bytes go.

    The last part is the first field that is cut off, or surplus bytes after the last field.
    """
    at = 1
    if kind.sub_code is not None:
        data = pdu[at : at + kind.sub_width]
        yield Part(at, data, "sub-function" if kind.sub_width == 2 else "MEI type", _sub_code_name(pdu[0], data))
        at += kind.sub_width
    for name, field in zip(kind.layout.names, kind.layout.fields, strict=True):
        assert isinstance(field, FixedField | RestLength)
        data = pdu[at : at + field.width]
        label = name.replace("_", " ")
        if len(data) < field.width:
            yield Part(at, data, label, problem=f"{field.width - len(data)} of {field.width} bytes are missing")
            return
        value = int.from_bytes(data, "big")
        at += field.width
        if isinstance(field, RestLength):
            yield Part(at - field.width, data, label, str(value), _length_problem(field, value, len(pdu) - at))
        else:
            yield Part(at - field.width, data, label, shown.number(name, value), _limit_problem(field, value))
    tail = kind.layout.tail
    rest = pdu[at:]
    if tail is None:
        if rest:
            yield Part(at, rest, "surplus", problem=f"{counted(len(rest), 'byte')} too many")
    elif isinstance(tail, RepeatedField):
        yield from _item_parts(pdu, at, tail, kind.layout.tail_name)
    else:
        label = kind.layout.tail_name.replace("_", " ")
        problem = ""
        if not tail.low <= len(rest) <= tail.high:
            problem = f"{counted(len(rest), 'byte')} where {tail.low}…{tail.high} can be"
        elif len(rest) % tail.step:
            problem = f"{counted(len(rest), 'byte')}, which is no multiple of {tail.step}"
        if rest or problem:
            yield Part(at, rest, label, shown.data(rest), problem)


def _item_parts(pdu: bytes, at: int, tail: RepeatedField, name: str) -> Iterator[Part]:
    """Yield the items of a repeated field with their descriptions; bytes that are no item become one last part."""
    number = 0
    while at < len(pdu):
        number += 1
        label = f"{name.removesuffix('s').replace('_', ' ')} {number}"
        try:
            item, end = tail.item.decode_from(pdu, at)
        except (ValueError, IndexError) as error:
            yield Part(at, pdu[at:], label, problem=str(error))
            return
        yield Part(at, pdu[at:end], label, _item_text(item))
        at = end


def _item_text(item: Any) -> str:  # Any: items of user functions share no base
    if isinstance(item, IdentificationObject):
        name = OBJECT_NAMES.get(item.number, f"object 0x{item.number:02X}")
        return f"{name}: {printable(item.value.decode('utf-8', errors='backslashreplace'))}"
    values = {field.name: getattr(item, field.name) for field in fields(item)} if hasattr(item, "__slots__") else {}
    return ", ".join(
        f"{name} {_registers_text(value) if isinstance(value, bytes) else value}" for name, value in values.items()
    )


def _length_problem(field: RestLength, value: int, following: int) -> str:
    if value != following:
        return f"announces {counted(value, 'byte')}, and {following} follow"
    if not field.low <= value <= field.high:
        return f"{value} where {field.low}…{field.high} can be"
    return f"{value} is no multiple of {field.step}" if value % field.step else ""


def _limit_problem(field: FixedField, value: int) -> str:
    if field.values is not None:
        allowed = " or ".join(f"{one:0{2 * field.width}X}" for one in field.values)
        return "" if value in field.values else f"{value:0{2 * field.width}X} where {allowed} can be"
    return "" if field.low <= value <= field.high else f"{value} where {field.low}…{field.high} can be"


def _sub_code_name(code: int, data: bytes) -> str:
    number = int.from_bytes(data, "big")
    kinds: type[DiagnosticCode] | type[MeiType] = DiagnosticCode if code == FunctionCode.DIAGNOSTICS else MeiType
    try:
        return f"{number} ({kinds(number).name.lower().replace('_', ' ')})"
    except ValueError:
        return str(number)


class _Meaning:
    """Returns the values in a PDU as text for people: an address as ``16, holding register 4x17``, a bit as ``on``."""

    def __init__(self, kind: type[Request], is_request: bool, request: Message | None) -> None:
        self._kind = kind
        self._is_request = is_request
        self._request = request

    def number(self, name: str, value: int) -> str:
        """Return the text for the value of a field of fixed size: ``16, holding register 4x17`` for an address.

        A coil's value becomes ``on`` or ``off``, a mask binary digits, anything else a decimal number.
        """
        touch = next(
            (one for one in (self._kind.reads, self._kind.writes) if one is not None and one.address == name), None
        )
        if touch is not None and not issubclass(self._kind, ReadFifoQueue):
            return f"{value}, {touch.table.label} {format_address(Address(touch.table, value))}"
        if self._kind is WriteSingleCoil and name == "value":
            return {0xFF00: "on", 0: "off"}.get(value, f"{value:04X}")
        if name.endswith("mask"):
            return f"0b{value:016b}"
        return str(value)

    def data(self, data: bytes) -> str:
        """Return the text for the data at the end of a PDU: registers as numbers, bits as ``on`` and ``off``.

        Of more than 24 values the first 24 and their number are shown. Empty for data of other kinds.
        """
        touch = self._kind.writes if self._is_request else self._kind.reads
        if touch is None:
            return ""
        if touch.table in (Table.COILS, Table.DISCRETE_INPUTS):
            count = getattr(self._request, "count", 8 * len(data))
            bits = unpack_bits(data, min(count, 8 * len(data)))
            return _shortened(["on" if bit else "off" for bit in bits])
        return _registers_text(data)


def _registers_text(data: bytes) -> str:
    return "" if len(data) % 2 else _shortened([str(value) for value in unpack_registers(data)])


def _shortened(values: list[str]) -> str:
    more = f" … ({len(values)} in all)" if len(values) > _MOST_VALUES else ""
    return " ".join(values[:_MOST_VALUES]) + more
