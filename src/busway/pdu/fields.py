"""The kinds of fields with which the messages of every function are declared.

Knows widths, limits and positions on the wire; knows no function and no byte of a particular message.

1. A message is: function code, perhaps a sub-code, then the declared fields in their order, big-endian (Application
   Protocol V1.1b3 §4.2).
2. Fixed fields (`u8`, `u16`) come first and `rest_length` can stand anywhere among them; at most one field of
   variable length (`rest`, `repeated`) ends the message.
3. Every byte count of the specification counts all that follows it, to the end of the PDU. That is why one kind of
   length field, `rest_length`, is enough for all of them.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol, Self

_WIDTHS = {1: "B", 2: "H"}


class _NoDefault:
    """Type of `NO_DEFAULT`, which marks a message field without a default."""

    def __repr__(self) -> str:
        return "<no default>"


NO_DEFAULT = _NoDefault()
"""Marks a message field without a default: the constructor of the message needs a value."""


@dataclass(frozen=True, slots=True)
class FixedField:
    """A message field for an unsigned integer of one or two bytes.

    Attributes:
        width: bytes on the wire, 1 or 2.
        low, high: smallest and largest value.
        values: the allowed values, instead of limits; None for the limits.
        default: value if the caller gives none; `NO_DEFAULT` if the caller must give one.
    """

    width: int
    low: int
    high: int
    values: tuple[int, ...] | None
    default: object

    @property
    def format(self) -> str:
        """The `struct` format letter for the field's one or two bytes."""
        return _WIDTHS[self.width]


@dataclass(frozen=True, slots=True)
class RestLength:
    """A message field with the number of bytes after it in the PDU: computed in encoding, checked in both directions.

    It is no attribute of the message.

    Attributes:
        width: bytes on the wire, 1 or 2.
        low, high: smallest and largest number of bytes.
        step: the number must be a multiple of this.
    """

    width: int
    low: int
    high: int
    step: int

    @property
    def format(self) -> str:
        """The `struct` format letter for the field's one or two bytes."""
        return _WIDTHS[self.width]


@dataclass(frozen=True, slots=True)
class RestField:
    """A message field of all bytes to the end of the message.

    Attributes:
        low, high: smallest and largest number of bytes.
        step: the number must be a multiple of this.
        default: value if the caller gives none; `NO_DEFAULT` if the caller must give one.
    """

    low: int
    high: int
    step: int
    default: object


class Item(Protocol):
    """Interface of one element of a repeated message field, which encodes and decodes itself."""

    @classmethod
    def decode_from(cls, data: bytes, at: int) -> tuple[Self, int]:
        """Decode one element at offset ``at`` of ``data``; return the element and the offset after it.

        Raises:
            ValueError: the bytes are no such element.
        """

    def encode(self) -> bytes:
        """Return the bytes of the element."""


@dataclass(frozen=True, slots=True)
class RepeatedField:
    """A message field that repeats items of one class to the end of the message.

    Attributes:
        item: class of the items; it has the methods of `Item`.
        low, high: smallest and largest number of items.
        default: value if the caller gives none; `NO_DEFAULT` if the caller must give one.
    """

    item: type[Any]  # any class with the two methods of Item; a Protocol type cannot be called through type[]
    low: int
    high: int
    default: object


VariableField = RestField | RepeatedField
Field = FixedField | RestLength | RestField | RepeatedField


# The functions below return Any because what they declare is read as the annotated type of the attribute
# (typing.dataclass_transform), as `dataclasses.field` does.


def u8(low: int = 0, high: int = 0xFF, *, values: Sequence[int] | None = None, default: object = NO_DEFAULT) -> Any:
    """Declare a message field of one byte with a value of ``low``…``high``, or one of ``values`` if they are given.

    Without ``default``, the constructor of the message needs a value.
    """
    return FixedField(1, low, high, tuple(values) if values is not None else None, default)


def u16(low: int = 0, high: int = 0xFFFF, *, values: Sequence[int] | None = None, default: object = NO_DEFAULT) -> Any:
    """Declare a message field of two bytes with a value of ``low``…``high``, or one of ``values`` if they are given.

    Without ``default``, the constructor of the message needs a value.
    """
    return FixedField(2, low, high, tuple(values) if values is not None else None, default)


def rest_length(width: int = 1, low: int = 0, high: int = 0xFFFF, step: int = 1) -> RestLength:
    """Declare a message field of ``width`` bytes (1 or 2) that holds the number of all bytes after it.

    It must be ``low``…``high`` and a multiple of ``step``, in messages that are received and that are built.
    """
    return RestLength(width, low, high, step)


def rest(low: int = 0, high: int = 252, step: int = 1, *, default: object = NO_DEFAULT) -> Any:
    """Declare a message field of all bytes to the end of the message; their number is limited.

    It is ``low``…``high``, and a multiple of ``step``. Without ``default``, the constructor of the message needs a
    value.
    """
    return RestField(low, high, step, default)


def repeated(item: type[Any], low: int = 1, high: int = 252, *, default: object = NO_DEFAULT) -> Any:
    """Declare a message field of ``low``…``high`` items of the class ``item``, to the end of the message.

    The class has the methods of `Item`. Without ``default``, the constructor of the message needs a value.
    """
    return RepeatedField(item, low, high, default)
