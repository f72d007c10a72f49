"""Makes constructor, encoder and decoder of a message class from its declared fields, once for each class.

Knows how fields lie on the wire and how to write the source of a codec; knows no function.

The functions are generated as source and compiled, as `dataclasses` does: a request costs 0.6 µs to build and encode
this way, and several times that when a loop interprets its fields for every message.
"""

import operator
import struct
from dataclasses import dataclass
from typing import Any

from ..codes import PDU_LIMIT, TABLE_SIZE
from ..errors import InvalidRequest
from ..values.counts import counted
from .fields import NO_DEFAULT, Field, FixedField, RepeatedField, RestField, RestLength
from .malformed_pdu import MalformedPdu


@dataclass(frozen=True, slots=True)
class Layout:
    """How a message class is laid out in bytes: a fixed head as one `struct.Struct`, then an optional variable part.

    Attributes:
        head: packs and unpacks the function code, the sub-code if there is one, and all fixed fields.
        names, fields: the fixed fields in wire order, byte counts included.
        tail: the field of variable length that ends the message; None without one.
        tail_name: its name; empty without one.
    """

    head: struct.Struct
    names: tuple[str, ...]
    fields: tuple[Field, ...]
    length_at: int | None
    """Index among ``fields`` of the `RestLength`; None without one."""
    length_offset: int
    """Byte offset in the PDU of the `RestLength`; 0 without one."""
    tail: RestField | RepeatedField | None
    tail_name: str


def attribute_names(cls: Any) -> tuple[str, ...]:
    """Return the attribute names of a message class, in wire order: all declared fields except byte counts."""
    return tuple(name for name, field in cls.declared.items() if not isinstance(field, RestLength))


def as_integer(name: str, value: object) -> int:
    """Return the value of an integer field as ``int``.

    Raises:
        InvalidRequest: the value is no integer, or a ``bool``; the message names the field.
    """
    if isinstance(value, bool):
        raise InvalidRequest(f"{name} must be an integer, not {value}")
    try:
        return operator.index(value)  # type: ignore[arg-type]
    except TypeError:
        raise InvalidRequest(f"{name} must be an integer, not {value!r}") from None


def as_bytes(name: str, value: object) -> bytes:
    """Return the value of a field of bytes as ``bytes``.

    Raises:
        InvalidRequest: the value is not bytes, bytearray or memoryview; the message names the field. Numbers are
            refused too: ``bytes(2)`` would be 00 00.
    """
    if isinstance(value, bytes | bytearray | memoryview):
        return bytes(value)
    raise InvalidRequest(f"{name.replace('_', ' ')} must be bytes, not {value!r}")


def as_tuple(name: str, value: object) -> tuple[Any, ...]:  # of whatever `_check_tail` looks at next
    """Return the value of a field of several items as a tuple.

    Raises:
        InvalidRequest: the value cannot be iterated over; the message names the field.
    """
    try:
        return tuple(value)  # type: ignore[arg-type]
    except TypeError:
        raise InvalidRequest(f"{name.replace('_', ' ')} must be a sequence, not {value!r}") from None


def compile_message(cls: Any) -> None:  # Any: the attributes it sets are what makes the class a message
    """Prepare a message class; its constructor, ``encode`` and ``decode`` are compiled when one of them is first used.

    Sets ``layout``, and ``is_write`` to True if the class declares ``writes``. A ``decode`` that the class defines
    itself is kept. Nothing is compiled at import, because all 40 classes take 40 ms and most commands use only a few.

    Args:
        cls: a message class with its declared fields.

    Raises:
        TypeError: the declared fields cannot form a message.
    """
    cls.layout = _layout(cls)
    if getattr(cls, "writes", None) is not None:
        cls.is_write = True
    cls.codecs_pending = True
    cls.__init__ = _first_init
    cls.encode = _first_encode
    cls.decodes_itself = "decode" in cls.__dict__
    if not cls.decodes_itself:
        cls.decode = classmethod(_first_decode)


def _first_init(self: Any, *arguments: Any, **named: Any) -> None:
    _compile_pending(type(self))
    self.__init__(*arguments, **named)


def _first_encode(self: Any) -> Any:
    _compile_pending(type(self))
    return self.encode()


def _first_decode(cls: Any, pdu: bytes) -> Any:
    _compile_pending(cls)
    return cls.decode(pdu)


def _compile_pending(cls: Any) -> None:
    """Compile constructor, ``encode`` and ``decode`` of a message class, at the first use of one of them.

    For a class that was not prepared itself, because it inherits all its fields, its base class is compiled.
    """
    owner = next(one for one in cls.__mro__ if "codecs_pending" in one.__dict__)
    _compile_codecs(owner)


def _compile_codecs(cls: Any) -> None:
    """Generate and compile the constructor, ``encode`` and ``decode`` of a message class."""
    layout = cls.layout
    names = attribute_names(cls)
    self_coded = cls.self_coded
    namespace: dict[str, Any] = {
        "InvalidRequest": InvalidRequest,
        "MalformedPdu": MalformedPdu,
        "as_integer": as_integer,
        "as_bytes": as_bytes,
        "as_tuple": as_tuple,
        "pack": layout.head.pack,
        "unpack_from": layout.head.unpack_from,
        "new": cls.__new__,
        "layout": layout,
        "check_tail": _check_tail,
        "counted": counted,
        "decode_tail": _decode_tail,
        "encode_tail": _encode_tail,
        "out_of_range": _out_of_range,
        "LIMIT": PDU_LIMIT,
        "TABLE_SIZE": TABLE_SIZE,
    }
    for name in names:
        namespace[f"set_{name}"] = getattr(cls, name).__set__
        default = getattr(cls.declared[name], "default", NO_DEFAULT)
        if default is not NO_DEFAULT:
            namespace[f"default_{name}"] = default
    source = "\n".join(
        (_init_source(cls, names), _encode_source(cls, self_coded), _decode_source(cls, names, self_coded))
    )
    exec(compile(source, f"<codecs of {cls.__module__}.{cls.__qualname__}>", "exec"), namespace)
    cls.__init__ = namespace["__init__"]
    cls.__init__.__qualname__ = f"{cls.__qualname__}.__init__"
    cls.encode = namespace["encode"]
    cls.encode.__doc__ = "The PDU, function code first."
    if not cls.decodes_itself:
        namespace[
            "decode"
        ].__doc__ = "The message of a whole PDU. Raises `MalformedPdu` where a limit or length is broken."
        cls.decode = classmethod(namespace["decode"])


def _layout(cls: Any) -> Layout:
    letters = "" if cls.self_coded else "B"
    if cls.sub_code is not None:
        letters += {1: "B", 2: "H"}[cls.sub_width]
    names: list[str] = []
    fields: list[Field] = []
    length_at: int | None = None
    length_offset = 0
    tail: RestField | RepeatedField | None = None
    tail_name = ""
    optional = ""
    for name, field in cls.declared.items():
        if tail is not None:
            raise TypeError(f"{cls.__name__}.{name} stands behind the variable field {tail_name}")
        if not isinstance(field, RestLength):
            if field.default is not NO_DEFAULT:
                optional = name
            elif optional:
                raise TypeError(f"{cls.__name__}.{name} needs a default, because {optional} before it has one")
        elif length_at is not None:
            raise TypeError(f"{cls.__name__}.{name} is a second length")
        if isinstance(field, RestField | RepeatedField):
            tail, tail_name = field, name
            continue
        if isinstance(field, RestLength):
            length_at, length_offset = len(fields), struct.calcsize(">" + letters)
        letters += field.format
        names.append(name)
        fields.append(field)
    return Layout(struct.Struct(">" + letters), tuple(names), tuple(fields), length_at, length_offset, tail, tail_name)


def _init_source(cls: Any, names: tuple[str, ...]) -> str:
    parameters = ["self"]
    body = []
    for name in names:
        field = cls.declared[name]
        parameters.append(name if getattr(field, "default", NO_DEFAULT) is NO_DEFAULT else f"{name}=default_{name}")
        if isinstance(field, FixedField):
            body.append(f" if {name}.__class__ is not int: {name} = as_integer({name!r}, {name})")
            body.append(f" if {_range_test(name, field)}: raise InvalidRequest(out_of_range({name!r}, {name}, layout))")
        else:
            kind = "bytes" if isinstance(field, RestField) else "tuple"
            body.append(f" if {name}.__class__ is not {kind}: {name} = as_{kind}({name!r}, {name})")
            body.append(f" problem = check_tail(layout, {name})")
            body.append(" if problem: raise InvalidRequest(problem)")
        body.append(f" set_{name}(self, {name})")
    for touch in (getattr(cls, "reads", None), getattr(cls, "writes", None)):
        if touch is not None:
            count = "1" if touch.count is None else touch.count
            body.append(
                f" if {touch.address} + {count} > TABLE_SIZE: raise InvalidRequest("
                f"f'{{{count}}} {touch.table.label}s from address {{{touch.address}}} end beyond address 65535')"
            )
    if cls.has_rule:
        body += [" problem = self.validate()", " if problem: raise InvalidRequest(problem)"]
    if cls.layout.tail is not None:
        body += [" size = len(self.encode())", " if size > LIMIT: raise InvalidRequest(too_long(size))"]
        body += _length_test(cls.layout)
    return (
        f"def __init__({', '.join(parameters)}):\n"
        + "\n".join(body or [" pass"])
        + ("\ndef too_long(size): return f'the PDU would have {size} bytes; at most {LIMIT} fit'\n")
    )


def _length_test(layout: Layout) -> list[str]:
    """Return the source lines of a constructor that check the byte count; there, ``size`` is the length of the PDU.

    No lines if the message has no byte count, or if the limits of its tail keep the byte count within its limits.
    """
    if layout.length_at is None:
        return []
    name, field, tail = layout.names[layout.length_at], layout.fields[layout.length_at], layout.tail
    assert isinstance(field, RestLength)
    offset = layout.length_offset + field.width
    if isinstance(tail, RestField):
        fixed = layout.head.size - offset
        is_in_step = field.step == 1 or not (tail.step % field.step or (fixed + tail.low) % field.step)
        if is_in_step and field.low <= fixed + tail.low and fixed + tail.high <= field.high:
            return []
    test = " or ".join(_limits(f"size - {offset}", field))
    return [f" if {test}: raise InvalidRequest(out_of_range({name!r}, size - {offset}, layout))"] if test else []


def _limits(value: str, field: RestLength) -> list[str]:
    """Return the texts of Python expressions, each true if a byte count, the expression ``value``, breaks a limit."""
    found = []
    if field.low:
        found.append(f"{value} < {field.low}")
    if field.high < 0xFFFF:
        found.append(f"{value} > {field.high}")
    if field.step > 1:
        found.append(f"({value}) % {field.step}")
    return found


def _encode_source(cls: Any, self_coded: bool) -> str:
    layout: Layout = cls.layout
    arguments = [] if self_coded else [str(cls.code)]
    if cls.sub_code is not None:
        arguments.append(str(cls.sub_code))
    for name, field in zip(layout.names, layout.fields, strict=True):
        if isinstance(field, RestLength):
            fixed = layout.head.size - layout.length_offset - field.width
            arguments.append(f"{fixed} + len(tail)" if layout.tail else str(fixed))
        elif self_coded and name == "function" and cls.exception_bit:
            arguments.append("self.function | 0x80")
        else:
            arguments.append(f"self.{name}")
    lines = ["def encode(self):"]
    if layout.tail is None:
        lines.append(f" return pack({', '.join(arguments)})")
    else:
        get = f"self.{layout.tail_name}"
        lines.append(f" tail = {get if isinstance(layout.tail, RestField) else f'encode_tail({get})'}")
        lines.append(f" return pack({', '.join(arguments)}) + tail")
    return "\n".join(lines) + "\n"


def _decode_source(cls: Any, names: tuple[str, ...], self_coded: bool) -> str:
    layout: Layout = cls.layout
    size = layout.head.size
    targets = [] if self_coded else ["code_"]
    if cls.sub_code is not None:
        targets.append("sub_code_")
    targets += layout.names
    lines = ["def decode(cls, pdu):", " size = len(pdu)"]
    if layout.tail is None:
        lines.append(
            f" if size != {size}: raise MalformedPdu(counted(size, 'byte') + ' where this function has {size}')"
        )
    else:
        lines.append(
            f" if size < {size}: raise MalformedPdu(counted(size, 'byte') + ' where this function has at least {size}')"
        )
        lines.append(" if size > LIMIT: raise MalformedPdu(f'{size} bytes where a PDU has at most {LIMIT}')")
    lines.append(f" {', '.join(targets)}, = unpack_from(pdu)")
    if not self_coded:
        lines.append(f" if code_ != {cls.code}: raise MalformedPdu(f'function {{code_}} where {cls.code} is expected')")
    if cls.sub_code is not None:
        lines.append(
            f" if sub_code_ != {cls.sub_code}: raise MalformedPdu("
            f"f'sub-function {{sub_code_}} where {cls.sub_code} is expected')"
        )
    if cls.exception_bit:
        lines.append(" if function < 0x80: raise MalformedPdu(f'function {function} is no exception reply')")
        lines.append(" function &= 0x7F")
    for name, field in zip(layout.names, layout.fields, strict=True):
        if isinstance(field, RestLength):
            offset = layout.length_offset + field.width
            lines.append(
                f" if {name} != size - {offset}: raise MalformedPdu("
                f"f'{name.replace('_', ' ')} {{{name}}} where ' + counted(size - {offset}, 'byte', 'follows'))"
            )
            limits = _limits(name, field)
            if limits:
                lines.append(f" if {' or '.join(limits)}: raise MalformedPdu(out_of_range({name!r}, {name}, layout))")
        elif isinstance(field, FixedField):
            test = _range_test(name, field, received=True)
            if test:
                lines.append(f" if {test}: raise MalformedPdu(out_of_range({name!r}, {name}, layout))")
    if layout.tail is not None:
        lines.append(f" {layout.tail_name} = decode_tail(layout, bytes(pdu[{size}:]))")
    lines.append(" self = new(cls)")
    lines += [f" set_{name}(self, {name})" for name in names]
    if cls.has_rule:
        lines += [" problem = self.validate()", " if problem: raise MalformedPdu(problem)"]
    lines.append(" return self")
    return "\n".join(lines) + "\n"


def _range_test(name: str, field: FixedField, *, received: bool = False) -> str:
    """Return the text of a Python expression that is true if a field's value is out of range.

    Args:
        name: the name of the variable with the value.
        field: the field with its limits.
        received: whether the value was unpacked from bytes; then the text is empty if all values of the width are
            allowed.
    """
    if field.values is not None:
        return f"{name} not in {field.values}"
    whole = 0xFF if field.width == 1 else 0xFFFF
    if received and field.low == 0 and field.high == whole:
        return ""
    return f"not {field.low} <= {name} <= {field.high}"


def _out_of_range(name: str, value: int, layout: Layout) -> str:
    field = layout.fields[layout.names.index(name)]
    label = name.replace("_", " ")
    if isinstance(field, FixedField) and field.values is not None:
        allowed = ", ".join(f"0x{one:04X}" if field.width == 2 else str(one) for one in field.values)
        return f"{label} must be one of {allowed}, not {value}"
    assert isinstance(field, FixedField | RestLength)
    step = f", a multiple of {field.step}" if isinstance(field, RestLength) and field.step > 1 else ""
    return f"{label} must be {field.low}…{field.high}{step}, not {value}"


def _check_tail(layout: Layout, value: Any) -> str | None:
    tail = layout.tail
    label = layout.tail_name.replace("_", " ")
    if isinstance(tail, RestField):
        if not tail.low <= len(value) <= tail.high:
            return f"{label} must have {tail.low}…{tail.high} bytes, not {len(value)}"
        if len(value) % tail.step:
            return f"{label} must have a multiple of {tail.step} bytes, not {len(value)}"
        return None
    assert isinstance(tail, RepeatedField)
    if not tail.low <= len(value) <= tail.high:
        return f"{label} must have {tail.low}…{tail.high} items, not {len(value)}"
    return next(
        (
            f"{label} holds {type(one).__name__}, not {tail.item.__name__}"
            for one in value
            if not isinstance(one, tail.item)
        ),
        None,
    )


def _decode_tail(layout: Layout, data: bytes) -> Any:
    tail = layout.tail
    value: Any = data
    if isinstance(tail, RepeatedField):
        items: list[Any] = []
        at = 0
        while at < len(data):
            try:
                item, at = tail.item.decode_from(data, at)
            except MalformedPdu as error:
                # The item knows which exception code it earns.
                raise MalformedPdu(f"{layout.tail_name}, item {len(items) + 1}: {error}", error.code) from error
            except ValueError as error:
                raise MalformedPdu(f"{layout.tail_name}, item {len(items) + 1}: {error}") from error
            items.append(item)
        value = tuple(items)
    problem = _check_tail(layout, value)
    if problem is not None:
        raise MalformedPdu(problem)
    return value


def _encode_tail(items: tuple[Any, ...]) -> bytes:
    return b"".join([item.encode() for item in items])
