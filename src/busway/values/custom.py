"""Conversion of registers by a ``struct`` format: ``custom:>hHl`` is three numbers in four registers.

Knows which letters of ``struct`` are allowed; the bytes are those of the registers in wire order.
"""

import re
import struct
from typing import Any, Final

from ..errors import InvalidRequest
from .numbers import real_number, whole_number
from .orders import ByteOrder, BytesLike, swapped
from .unfit_values import shown, unfit

_FORMAT: Final = re.compile(r"([<>])((?:[0-9]{0,3}[bBhHiIlLqQefdx?])+)")
_MOST_BYTES: Final = 250


def custom_layout(name: str, written: str) -> struct.Struct:
    """Return the ``struct`` layout of the value type ``custom:FORMAT``.

    Args:
        name: the type as it was written, for errors.
        written: its FORMAT: the byte order ``<`` or ``>``, and letters such as ``hHl``, each with an optional count.

    Raises:
        InvalidRequest: the format is not supported or holds no number, or its size is odd, zero or above 250 bytes.
            Nothing was sent.
    """
    match = _FORMAT.fullmatch(written)
    if match is None:
        raise InvalidRequest(
            f"type {shown(name)} needs a byte order and letters of Python's struct, such as custom:>hHl;"
            " there are b B h H i I l L q Q e f d ? x"
        )
    try:
        layout = struct.Struct(written)
    except struct.error as error:
        raise InvalidRequest(f"type {shown(name)} cannot be: {error}") from None
    if not 0 < layout.size <= _MOST_BYTES or layout.size % 2:
        raise InvalidRequest(
            f"type {shown(name)} takes {layout.size} bytes; registers have an even number of them, 2…{_MOST_BYTES}"
        )
    if not layout.unpack(bytes(layout.size)):
        raise InvalidRequest(f"type {shown(name)} holds no number")
    return layout


class CustomCodec:
    """Converts registers to tuples of numbers by a ``struct`` format, and back."""

    def __init__(self, name: str, layout: struct.Struct, order: ByteOrder) -> None:
        self._name = name
        self._layout = layout
        self._swaps = order.swaps
        self._states = [isinstance(each, bool) for each in layout.unpack(bytes(layout.size))]
        hint = ", True or False for each ?" if any(self._states) else ""
        self.expects: str = f"{len(self._states)} numbers that fit {layout.format}{hint}"

    def decode(self, data: BytesLike) -> list[Any]:
        """Return the tuples that registers in wire order hold.

        Each tuple has all numbers of the format, with a ``bool`` for ``?`` and nothing for ``x``.
        """
        return list(self._layout.iter_unpack(swapped(data, self._swaps)))

    def encode(self, values: list[object]) -> bytes:
        """Return the registers, in wire order, that hold tuples or lists with all numbers of the format.

        A ``bool`` is no number; for ``?`` it is needed, or the integer 0 or 1.

        Raises:
            InvalidRequest: a value is no tuple or list, or does not fit the format. Nothing was sent.
        """
        parts = []
        for index, value in enumerate(values):
            if not isinstance(value, tuple | list) or not all(map(_suits, value, self._states)):
                raise unfit(values, index, self._name, self.expects)
            try:
                parts.append(self._layout.pack(*value))
            except (struct.error, OverflowError, TypeError, ValueError) as error:
                raise unfit(values, index, self._name, self.expects) from error
        return swapped(b"".join(parts), self._swaps)

    def parse(self, text: str) -> tuple[Any, ...]:
        """Return the tuple for a text of numbers separated by commas: ``1, -2, 3.5``; 1 and 0 are the states of ``?``.

        Raises:
            InvalidRequest: the numbers do not fit the format.
            ValueError: a part of the text is no number, or too large for a float.
        """
        numbers: list[int | float] = []
        for part in text.split(","):
            try:
                numbers.append(whole_number(part.strip()))
            except ValueError:
                numbers.append(real_number(part.strip()))
        self.encode([tuple(numbers)])
        return tuple(numbers)


def _suits(number: object, is_state: bool) -> bool:
    """Whether one number of a tuple is the state that ``?`` takes, or no ``bool`` where a number is needed."""
    if not is_state:
        return not isinstance(number, bool)
    return isinstance(number, int) and number in (0, 1)
