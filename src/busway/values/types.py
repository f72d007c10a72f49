"""Value types by name, such as ``float32``: how registers become values and back, in a byte order such as ``CDAB``.

Knows the names, how many registers each takes, and which codec works for it. The codecs (`numbers`, `texts`, `bits`)
know the formats. Nothing here knows addresses, messages or limits of a request.

================================  =========  ==================================================================
name (short form)                 registers  value
================================  =========  ==================================================================
``int16`` … ``int64`` (``i16``)   1, 2, 3, 4 ``int``, two's complement; 48 bits are there too
``uint16`` … ``uint64`` (``u16``) 1, 2, 3, 4 ``int``
``float16`` … ``float64`` (``f16``) 1, 2, 4  ``float``, IEEE 754
``bcd16`` ``bcd32`` ``bcd64``     1, 2, 4    ``int``, packed decimal digits: 4, 8, 16
``string:N``                      (N+1)//2   ``str`` of up to N bytes, N = 1…250
``bits``                          1          tuple of 16 ``bool``, least significant first
``bit:N``                         1          ``bool``, bit N = 0…15 (0 the least significant); rule 4
``int8:low`` ``uint8:high`` …     1          ``int``, half a register; rule 4
``field:N-M``                     1          ``int``, bits N…M of a register (``field:4-7:signed``); rule 4
``ipv4`` ``ipv6``                 2, 8       ``str``, ``192.168.1.20``
``eui48`` ``eui64``               3, 4       ``str``, ``00:1B:44:11:3A:B7``
``custom:FORMAT``                 as needed  tuple of numbers, as Python's ``struct`` has them: ``custom:>hHl``
================================  =========  ==================================================================

Strings take up to two more words: the encoding ``ascii`` (default), ``latin-1`` or ``utf-8``, and the padding ``nul``
(default) or ``space``: ``string:16:utf-8:space``. Behind them, ``low`` or ``high`` is for devices that put one
character into each register (then N registers), and ``upper`` makes capitals of small letters.

There is no ``float`` and no ``int``: devices differ in what they mean by it, so the number of bits is always written.

Rules:

1. A `ValueType` is compiled once and kept: frequent readers hold it or call `value_type` again.
2. Bytes are in wire order, as in the messages: each register high byte first, unless the order says otherwise.
3. A value of the caller that does not fit is `InvalidRequest`; bytes of a device that mean nothing are `BadReply`.
4. A part of a register cannot be encoded alone, as that would overwrite the other bits: `ValueType.encode` refuses it,
   and `ValueType.merge` writes it into the present register.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, Final, Generic, Protocol, TypeVar, overload

from ..codes import MAX_READ_REGISTERS
from ..errors import InvalidRequest
from .bits import BitCodec, BitsCodec, FieldCodec
from .counts import counted
from .custom import CustomCodec, custom_layout
from .names import FloatName, IntegerName, Order
from .network import NETWORK_TYPES, NetworkCodec, network_size
from .numbers import BcdCodec, FloatCodec, IntegerCodec, ThreeRegisterCodec
from .orders import ByteOrder, BytesLike, byte_order
from .texts import StringCodec
from .unfit_values import shown

_LONGEST_STRING: Final = MAX_READ_REGISTERS * 2
_ENCODINGS: Final = ("ascii", "latin-1", "utf-8")
_PADDINGS: Final = ("nul", "space")


class Codec(Protocol):
    """Interface of a converter between registers and the values of one type.

    The caller checks that the data for `decode` is a whole number of values.

    Attributes:
        expects: which values the type can hold, in words: ``a whole number 0…65535``.
    """

    expects: str

    # Any: which Python type comes follows from a name at run time, and a union would make every caller cast.
    def decode(self, data: BytesLike) -> list[Any]:
        """Return the values that registers in wire order hold. Raises `BadReply` if the bytes are no such value."""

    def encode(self, values: list[object]) -> bytes:
        """Return the registers, in wire order, that hold these values. Raises `InvalidRequest` if one does not fit."""

    def parse(self, text: str) -> Any:
        """Return the value for a text. Raises ``ValueError`` or `InvalidRequest` if the text is no such value."""


Value = TypeVar("Value")


@dataclass(frozen=True, slots=True)
class ValueType(Generic[Value]):
    """A value type with its byte order; converts registers to values and back. Created by `value_type`.

    Two value types are equal if their names and orders are equal.

    Attributes:
        name: the name in full, ``float32``, also if the type was asked for by its short form ``f32``.
        order: the order in letters for this type's size, ``CDAB``; ``AB`` or ``BA`` for types that only know the order
            of the two bytes of a register, such as texts.
        registers: number of registers that one value takes.
    """

    name: str
    order: str
    registers: int
    _codec: Codec = field(repr=False, compare=False)

    @property
    def expects(self) -> str:
        """Which values the type can hold, in words: ``a whole number 0…65535``."""
        return self._codec.expects

    def registers_for(self, count: int) -> int:
        """Return the number of registers that ``count`` values of this type occupy.

        Args:
            count: number of values, 1 or more.

        Raises:
            InvalidRequest: ``count`` is no integer above 0. Nothing was sent.
        """
        if isinstance(count, bool) or not isinstance(count, int) or count < 1:
            raise InvalidRequest(f"count is {shown(count)}, but it is a number of {self.name} values, 1 or more")
        return count * self.registers

    def decode(self, data: BytesLike) -> list[Value]:
        """Convert registers into values of this type.

        Args:
            data: bytes in wire order, two for each register, a whole number of values.

        Returns:
            The values, in the order of their registers; an empty list for no bytes.

        Raises:
            InvalidRequest: the length is no whole number of values.
            BadReply: the bytes are no value of this type: a BCD digit above 9, bytes outside the string's encoding.
        """
        size = 2 * self.registers
        if len(data) % size:
            came = counted(len(data), "byte", "is")
            raise InvalidRequest(f"{came} no whole number of {self.name} values of {size} bytes each")
        return self._codec.decode(data)

    def encode(self, values: Iterable[object]) -> bytes:
        """Return the registers, in wire order, that hold values of this type.

        Args:
            values: values as `decode` returns them; a single value is given as ``[value]``. Number types accept every
                integer, and float types every real number, that fits, also those of other libraries, but not ``bool``.
                The result for no values is no bytes.

        Raises:
            InvalidRequest: a value does not fit, the type is a part of a register (`merge` writes it), or ``values`` is
                a text, bytes or not iterable. Nothing was sent.
        """
        if isinstance(values, str | bytes | bytearray | memoryview) or not isinstance(values, Iterable):
            raise InvalidRequest(
                f"{shown(values)} is not a sequence of {self.name} values; a single one is given in a list"
            )
        return self._codec.encode(list(values))

    @property
    def is_part(self) -> bool:
        """Whether a value is a part of a register: ``bit``, ``field``, ``int8`` or ``uint8``.

        If True, `encode` refuses values, and `merge` writes one and keeps the rest of the register. False for texts
        with one character in each register: writing one overwrites the unused bytes too.
        """
        return isinstance(self._codec, BitCodec | FieldCodec)

    @property
    def bit_place(self) -> tuple[int, int] | None:
        """Position of the bit of a ``bit:N`` type in the register on the wire; None for other types.

        It is a pair: the number of the byte, 0 (the first) or 1, and the mask of the bit in that byte.
        """
        return self._codec.place if isinstance(self._codec, BitCodec) else None

    def merge(self, value: object, held: BytesLike) -> bytes:
        """Return the registers of one value, in wire order; bits that do not belong to the value stay as in ``held``.

        Args:
            value: one value, as `decode` returns it.
            held: the present ``2 * registers`` bytes of the registers, in wire order; ignored unless `is_part` is True.

        Raises:
            InvalidRequest: the value does not fit. Nothing was sent.
        """
        codec = self._codec
        return codec.merge(value, held) if isinstance(codec, BitCodec | FieldCodec) else self.encode([value])

    def parse(self, text: str) -> Value:
        """Return the value of this type for a text.

        Args:
            text: integers in decimal, ``0x…`` or ``0b…``; BCD in decimal only; floats as Python writes them, ``inf``
                and ``nan`` too; strings unchanged; ``bits`` as the register's number (``0b101`` sets bits 0 and 2);
                ``bit:N`` as on, off, true, false, 1, 0; network addresses as usual; ``custom`` as numbers separated by
                commas. Spaces around a text do not matter, except for strings.

        Raises:
            InvalidRequest: the text is no value of this type; names text, type and range. Nothing was sent.
        """
        try:
            value: Value = self._codec.parse(text if self.name.startswith("string") else text.strip())
            return value
        except InvalidRequest:
            raise
        except ValueError as error:
            raise InvalidRequest(f"{shown(text)} does not fit {self.name}, which takes {self.expects}") from error


@overload
def value_type(name: ValueType[Value], order: Order = "ABCD") -> ValueType[Value]: ...


@overload
def value_type(name: IntegerName, order: Order = "ABCD") -> ValueType[int]: ...


@overload
def value_type(name: FloatName, order: Order = "ABCD") -> ValueType[float]: ...


@overload
def value_type(name: str | ValueType[Any], order: str = "ABCD") -> ValueType[Any]: ...


def value_type(name: str | ValueType[Any], order: str = "ABCD") -> ValueType[Any]:
    """Return the value type with a given name and byte order, compiled once.

    Args:
        name: a name of the table in this file, such as ``float32``; capitals do not matter, except in the format of
            ``custom``. A `ValueType` keeps its own order if ``order`` is ``ABCD``.
        order: byte and register order; ``ABCD`` is the specification's. `busway.values.orders` has the others, and says
            how an order of another length than the type's is applied.

    Raises:
        InvalidRequest: there is no such type or order. Nothing was sent.
    """
    if isinstance(name, ValueType):
        return name if order == "ABCD" else _compiled(name.name, order)
    if not isinstance(name, str) or not isinstance(order, str):
        raise InvalidRequest(f"a type and an order are names, not {shown(name)} and {shown(order)}")
    return _compiled(name, order)


def decode(data: BytesLike, type: str | ValueType[Any], order: str = "ABCD", count: int | None = None) -> list[Any]:
    """Convert registers into a list of values of a type, like `ValueType.decode`.

    Args:
        data: bytes in wire order, two for each register.
        type: a name such as ``float32``, or a `ValueType`, which keeps its own order if ``order`` is ``ABCD``.
        order: byte and register order.
        count: number of values that the bytes must hold exactly; None for as many as there are.

    Raises:
        InvalidRequest: no such type or order, or the length is not that of ``count`` values.
        BadReply: the bytes are no value of the type.
    """
    wanted = value_type(type, order)
    if count is not None and len(data) != 2 * wanted.registers_for(count):
        raise InvalidRequest(
            f"{count} {wanted.name} values take {2 * wanted.registers_for(count)} bytes, but there are {len(data)}"
        )
    return wanted.decode(data)


def encode(values: Iterable[object], type: str | ValueType[Any], order: str = "ABCD") -> bytes:
    """Convert values of a type into registers, in wire order, like `ValueType.encode`.

    Args:
        values: values of the type, such as a list; a single value is given as ``[value]``.
        type: a name such as ``float32``, or a `ValueType`, which keeps its own order if ``order`` is ``ABCD``.
        order: byte and register order.

    Raises:
        InvalidRequest: no such type or order, or a value does not fit. Nothing was sent.
    """
    return value_type(type, order).encode(values)


def parse_value(text: str, type: str | ValueType[Any]) -> Any:
    """Return the value of a type for a text from a command line or a file, like `ValueType.parse`.

    Raises:
        InvalidRequest: no such type, or the text is no value of the type. Nothing was sent.
    """
    return value_type(type).parse(text)


_INTEGERS: Final = {"int16": "h", "uint16": "H", "int32": "i", "uint32": "I", "int64": "q", "uint64": "Q"}
_FLOATS: Final = {"float16": "e", "float32": "f", "float64": "d"}
_BCD: Final = ("bcd16", "bcd32", "bcd64")

_THREE_REGISTERS: Final = ("int48", "uint48")
_HALVES: Final = {"low": (0, 7), "high": (8, 15)}

TYPE_NAMES: Final = (
    *_INTEGERS,
    *_FLOATS,
    *_BCD,
    "string:N",
    "bits",
    "bit:N",
    *_THREE_REGISTERS,
    *(f"{name}:{half}" for name in ("int8", "uint8") for half in _HALVES),
    "field:N-M",
    *NETWORK_TYPES,
    "custom:FORMAT",
)
"""Names of all value types as they are written; capital letters stand for numbers or a format."""

_SHORT: Final = {
    "i16": "int16",
    "u16": "uint16",
    "i32": "int32",
    "u32": "uint32",
    "i64": "int64",
    "u64": "uint64",
    "f16": "float16",
    "f32": "float32",
    "f64": "float64",
}


@lru_cache(maxsize=512)
def _compiled(name: str, order: str) -> ValueType[Any]:
    key = name.strip().lower()
    key = _SHORT.get(key, key)
    kind, *words = key.split(":")
    if kind == "custom":
        return _custom(name.strip(), byte_order(order, 2))
    if key in _INTEGERS:
        return _number(key, order, lambda layout: IntegerCodec(key, _INTEGERS[key], layout))
    if key in _FLOATS:
        return _number(key, order, lambda layout: FloatCodec(key, _FLOATS[key], layout))
    if key in _BCD:
        return _number(key, order, lambda layout: BcdCodec(key, layout))
    if key in _THREE_REGISTERS:
        return _sized(key, order, 6, lambda layout: ThreeRegisterCodec(key, layout))
    if key in NETWORK_TYPES:
        return _network(key, order)
    in_register = byte_order(order, 2)
    if key == "bits":
        return ValueType(key, in_register.text, 1, BitsCodec(key, in_register))
    if kind == "bit":
        return _bit(name, words, in_register)
    if kind in ("int8", "uint8", "field"):
        return _field(name, kind, words, in_register)
    if kind == "string":
        return _string(name, words, in_register)
    raise InvalidRequest(f"unknown type {shown(name)}; there are {', '.join(TYPE_NAMES)}")


def _number(name: str, order: str, codec: Callable[[ByteOrder], Codec]) -> ValueType[Any]:
    return _sized(name, order, int(name[-2:]) // 8, codec)


def _sized(name: str, order: str, size: int, codec: Callable[[ByteOrder], Codec]) -> ValueType[Any]:
    layout = byte_order(order, size)
    return ValueType(name, layout.text, size // 2, codec(layout))


def _network(name: str, order: str) -> ValueType[Any]:
    size = network_size(name)
    if size > 8:
        in_register = byte_order(order, 2)
        return ValueType(name, in_register.text, size // 2, NetworkCodec(name, in_register))
    return _sized(name, order, size, lambda layout: NetworkCodec(name, layout))


def _custom(name: str, order: ByteOrder) -> ValueType[Any]:
    written = name.partition(":")[2]
    layout = custom_layout(name, written)
    canonical = f"custom:{written}"
    return ValueType(canonical, order.text, layout.size // 2, CustomCodec(canonical, layout, order))


def _field(name: str, kind: str, words: list[str], order: ByteOrder) -> ValueType[Any]:
    """Return the value type for a part of a register: ``int8:low``, ``field:4-7``, ``field:4-7:signed``.

    Args:
        name: the type as it was written, for errors.
        kind: ``int8``, ``uint8`` or ``field``.
        words: the words after the kind, which colons separate.
        order: order of the two bytes of the register.

    Raises:
        InvalidRequest: there is no such part.
    """
    if kind != "field":
        if len(words) != 1 or words[0] not in _HALVES:
            raise InvalidRequest(
                f"unknown type {shown(name)}; half a register is {kind}:low or {kind}:high;"
                f" there are {', '.join(TYPE_NAMES)}"
            )
        low, high = _HALVES[words[0]]
        canonical, signed = f"{kind}:{words[0]}", kind == "int8"
    else:
        first, _, last = words[0].partition("-") if words else ("", "", "")
        least, most = _ascii_number(first), _ascii_number(last)
        if least is None or most is None or not least <= most <= 15 or words[1:] not in ([], ["signed"]):
            raise InvalidRequest(f"type {shown(name)} does not say which bits of the register: field:4-7, field:0-15")
        low, high, signed = least, most, len(words) == 2
        canonical = f"field:{low}-{high}" + (":signed" if signed else "")
    return ValueType(canonical, order.text, 1, FieldCodec(canonical, low, high, order, signed=signed))


def _bit(name: str, words: list[str], order: ByteOrder) -> ValueType[Any]:
    bit = _ascii_number(words[0]) if len(words) == 1 else None
    if bit is None or bit > 15:
        raise InvalidRequest(f"type {shown(name)} does not say which bit of the register: bit:0 … bit:15")
    canonical = f"bit:{bit}"
    return ValueType(canonical, order.text, 1, BitCodec(canonical, bit, order))


def _string(name: str, words: list[str], order: ByteOrder) -> ValueType[Any]:
    length = _ascii_number(words[0]) if words else None
    if length is None or not 1 <= length <= _LONGEST_STRING:
        raise InvalidRequest(f"type {shown(name)} needs a length in bytes, string:1 … string:{_LONGEST_STRING}")
    options = words[1:]
    encoding = options.pop(0) if options and options[0] in _ENCODINGS else _ENCODINGS[0]
    padding = options.pop(0) if options and options[0] in _PADDINGS else _PADDINGS[0]
    half = options.pop(0) if options and options[0] in _HALVES else ""
    upper = bool(options) and options[0] == "upper"
    if options[upper:]:
        raise InvalidRequest(
            f"type {shown(name)} goes on with {shown(options[upper])}; after the length come an encoding"
            f" ({', '.join(_ENCODINGS)}), a padding ({', '.join(_PADDINGS)}), low or high, and upper"
        )
    if half and length > MAX_READ_REGISTERS:
        raise InvalidRequest(f"type {shown(name)} takes {length} registers, and one read has {MAX_READ_REGISTERS}")
    chosen = [word for word, usual in ((encoding, _ENCODINGS[0]), (padding, _PADDINGS[0])) if word != usual]
    chosen += [word for word in (half, "upper" if upper else "") if word]
    canonical = ":".join(["string", str(length), *chosen])
    codec = StringCodec(canonical, length, encoding, padding, order, half=half, upper=upper)
    return ValueType(canonical, order.text, length if half else (length + 1) // 2, codec)


def _ascii_number(text: str) -> int | None:
    return int(text) if text.isascii() and text.isdecimal() and len(text) <= 4 else None
