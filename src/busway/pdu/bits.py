"""Packing of bits on the wire: eight to a byte, the first item in the lowest bit (Application Protocol V1.1b3 §6.1).

Knows bytes and bools; knows no message.

The state of a bit is True or False, or the integer 0 or 1. Other values are refused: a text such as ``"off"`` would
count as true in Python, and switch on what its author wanted off.
"""

import operator
from collections.abc import Iterable, Mapping, Sequence, Set
from itertools import islice
from typing import Final, TypeVar

from ..errors import InvalidRequest

Value = TypeVar("Value")

_MOST: Final = 65_536
_SHOWN_CHARACTERS = 60
_number = int.from_bytes  # looked up once: it is called for each request with bits
_BITS_OF_BYTE = tuple(tuple(bool(byte >> bit & 1) for bit in range(8)) for byte in range(256))


def as_state(name: str, value: object) -> bool:
    """Return the state of a coil, given as bool or integer, as ``bool``.

    Args:
        name: what the value is, for the error message: ``value 3``.
        value: a ``bool``, an integer 0 or 1 of any type, or a boolean of numpy.

    Raises:
        InvalidRequest: the value is anything else. Nothing was sent.
    """
    if value.__class__ is bool:
        return bool(value)
    try:
        number = operator.index(value)  # type: ignore[arg-type]
    except TypeError:
        # numpy's boolean is no integer, and numpy is not imported only to ask for its type.
        kind = type(value)
        number = int(bool(value)) if kind.__module__ == "numpy" and kind.__name__ in ("bool", "bool_") else -1
    if number in (0, 1):
        return number == 1
    raise InvalidRequest(f"{name} must be True or False, not {_shown(value)}")


def as_states(values: Iterable[object]) -> list[bool]:
    """Return the states of several coils as a list of ``bool``, in order.

    Args:
        values: a state for each coil, as `as_state` takes it.

    Raises:
        InvalidRequest: ``values`` is a text, bytes, a set, a mapping or no iterable, or has more than 65536 values; or
            a value is no state, and the message names the first one. Nothing was sent.
    """
    states = listed(values, "states", "True and False")
    for position, value in enumerate(states):
        if value.__class__ is not bool:
            states[position] = as_state(f"value {position + 1}", value)
    return states  # type: ignore[return-value]  # each is a bool now


def listed(values: Iterable[Value], what: str, of: str = "values") -> list[Value]:
    """Return the values of an iterable as a list; single values and texts are refused.

    Args:
        values: an iterable in a definite order: a list, a range, a generator, an array; at most 65536 values.
        what, of: words for the error message, in the plural: what the values are, and what is allowed.

    Raises:
        InvalidRequest: ``values`` is a text, bytes, a set, a mapping or no iterable, or has more than 65536 values.
            Nothing was sent.
    """
    if not is_several(values):
        raise InvalidRequest(f"the {what} must be a sequence of {of}, not {_shown(values)}")
    try:
        found = list(islice(values, _MOST + 1))
    except TypeError as error:
        raise InvalidRequest(f"the {what} must be a sequence of {of}, not {_shown(values)}") from error
    if len(found) > _MOST:
        raise InvalidRequest(f"the {what} are more than the {_MOST} that a device has")
    return found


def is_several(values: object) -> bool:
    """Whether an object can be iterated over in a definite order: False for texts, bytes, sets and mappings.

    True for lists, arrays and generators, for example.
    """
    if isinstance(values, list | tuple):
        return True
    return isinstance(values, Iterable) and not isinstance(values, str | bytes | bytearray | memoryview | Set | Mapping)


def _shown(value: object) -> str:
    text = repr(value)
    return text if len(text) <= _SHOWN_CHARACTERS else f"{text[:_SHOWN_CHARACTERS]}…"


def pack_bits(values: Sequence[bool]) -> bytes:
    """Return states as bytes, eight in each, the first in the lowest bit of the first byte; unused bits are zero."""
    packed = 0
    for position, value in enumerate(values):
        if value:
            packed |= 1 << position
    return packed.to_bytes((len(values) + 7) // 8, "little")


def unpack_bits(data: bytes, count: int) -> list[bool]:
    """Return the first ``count`` bits of ``data`` as ``bool``, lowest bit first; fewer if ``data`` has fewer."""
    found: list[bool] = []
    for byte in data:
        found += _BITS_OF_BYTE[byte]
    del found[count:]
    return found


def slice_bits(data: bytes | bytearray, first: int, count: int) -> bytes:
    """Return ``count`` packed bits of ``data`` from bit ``first`` on as packed bits of their own.

    Bit ``first`` becomes the lowest bit of the first byte; unused bits of the last byte are zero.
    """
    shift = first & 7
    start = first >> 3
    if not shift and not count & 7:
        return bytes(data[start : start + (count >> 3)])
    whole = _number(data[start : (first + count + 7) >> 3], "little") >> shift
    return (whole & (1 << count) - 1).to_bytes((count + 7) >> 3, "little")


def splice_bits(data: bytearray, first: int, count: int, packed: bytes) -> None:
    """Overwrite ``count`` bits of ``data`` from bit ``first`` on with those of ``packed``, lowest bit first.

    The bytes of ``data`` are changed by a single slice assignment; its other bits and its length stay the same.
    """
    start, end = first >> 3, (first + count + 7) >> 3
    shift = first & 7
    old = _number(data[start:end], "little")
    changed = (old ^ _number(packed, "little") << shift) & ((1 << count) - 1 << shift)
    data[start:end] = (old ^ changed).to_bytes(end - start, "little")
