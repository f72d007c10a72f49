"""Conversion between registers and integers, floats and binary-coded decimals.

Knows the three number formats and their ranges. Knows type names only to quote them in errors. The caller has checked
that the length of the data is a multiple of the value's size.

Rules:

1. A block of values is converted by one ``struct`` call, after at most a few byte swaps of the whole block. The common
   orders cost no more than the plain one.
2. A value that does not fit is refused; nothing is cut off. Only floats are rounded, to the nearest number that the
   format has (a very small one to zero); one that is too large is refused.
3. ``bool`` is not a number here, and a float is not an integer, not even ``3.0``.
4. Every bit pattern survives wire → value → wire, except NaNs where Python itself drops bits: float16 keeps only the
   sign, and a signalling float32 becomes quiet. float64 keeps all; float32 keeps the payload of a quiet NaN.
"""

import math
import operator
import re
import struct
from typing import Any, Final, SupportsFloat, SupportsIndex

from ..errors import BadReply
from .orders import ByteOrder, BytesLike, swapped
from .unfit_values import unfit

_WHOLE: Final = re.compile(r"([+-]?)(0[xX][0-9a-fA-F]{1,16}|0[bB][01]{1,64}|[0-9]{1,40})", re.ASCII)

# What struct raises for numbers too large, and what __float__ of foreign numbers may raise (a signalling Decimal).
_FLOAT_REFUSALS: Final = (struct.error, OverflowError, TypeError, ValueError)


def whole_number(text: str) -> int:
    """Return the integer for a text in decimal, ``0x…`` or ``0b…``, with an optional sign.

    Raises:
        ValueError: the text is no integer, or has more than 40 decimal, 16 hexadecimal or 64 binary digits.
    """
    match = _WHOLE.fullmatch(text)
    if match is None:
        raise ValueError(text)
    sign, digits = match.groups()
    base = {"0x": 16, "0b": 2}.get(digits[:2].lower(), 10)
    return -int(digits, base) if sign == "-" else int(digits, base)


def real_number(text: str) -> float:
    """Return the float for a text as Python writes it, ``inf`` and ``nan`` included.

    Raises:
        ValueError: the text is no number, or too large for a float.
    """
    if not text.isascii() or "_" in text:
        raise ValueError(text)
    number = float(text)
    # float() makes an infinity of 1e999 without a word.
    if math.isinf(number) and "inf" not in text.lower():
        raise ValueError(text)
    return number


def _integer(value: object) -> int | None:
    """Return the integer that a value is; None if it is none, as a ``bool`` is none here.

    Integers of other libraries (numpy) are welcome: they have ``__index__``, which floats and strings lack. Arrays of
    numpy have it too, and it refuses them.
    """
    if isinstance(value, bool):
        return None
    try:
        return operator.index(value)  # type: ignore[arg-type]
    except TypeError:
        return None


class _StructLayout:
    """Converts registers to numbers by a ``struct`` format letter, and back; swaps bytes if the byte order needs it."""

    def __init__(self, letter: str, order: ByteOrder) -> None:
        self.letter = letter
        self.size = order.size
        # struct reverses whole values for nothing, so only the rest of the swaps is left to do.
        self.prefix = "<" if order.is_reversed else ">"
        self.swaps = order.swaps[1:] if order.is_reversed else order.swaps

    def unpack(self, data: BytesLike) -> list[Any]:  # ints or floats, as the letter says
        """Return the numbers that registers in wire order hold."""
        count = len(data) // self.size
        if self.swaps:
            data = swapped(data, self.swaps)
        return list(struct.unpack(f"{self.prefix}{count}{self.letter}", data))

    def pack(self, values: list[object]) -> bytes:
        """Return the registers, in wire order, that hold these numbers.

        Raises ``struct.error`` or ``OverflowError`` if one does not fit.
        """
        packed = struct.pack(f"{self.prefix}{len(values)}{self.letter}", *values)
        return swapped(packed, self.swaps) if self.swaps else packed


class IntegerCodec:
    """Converts registers to signed or unsigned integers of 16, 32 or 64 bits, and back."""

    def __init__(self, name: str, letter: str, order: ByteOrder) -> None:
        bits = order.size * 8
        self._minimum = -(1 << bits - 1) if letter.islower() else 0
        self._maximum = self._minimum + (1 << bits) - 1
        self._name = name
        self._layout = _StructLayout(letter, order)
        self.expects: str = f"a whole number {self._minimum}…{self._maximum}"

    def decode(self, data: BytesLike) -> list[Any]:
        """Return the integers that registers in wire order hold."""
        return self._layout.unpack(data)

    def encode(self, values: list[object]) -> bytes:
        """Return the registers, in wire order, that hold these integers.

        Raises:
            InvalidRequest: a value is no integer, or out of range. Nothing was sent.
        """
        if set(map(type, values)) - {int}:
            self._refuse_strangers(values)
        try:
            return self._layout.pack(values)
        except (struct.error, OverflowError) as error:
            raise self._misfit(values) from error

    def parse(self, text: str) -> int:
        """Return the integer for a text in decimal, ``0x…`` or ``0b…``.

        Raises:
            ValueError: the text is no integer, or the integer is out of range.
        """
        number = whole_number(text)
        if not self._minimum <= number <= self._maximum:
            raise ValueError(text)
        return number

    def _refuse_strangers(self, values: list[object]) -> None:
        for index, value in enumerate(values):
            if _integer(value) is None:
                hint = "; round it first" if isinstance(value, float) and math.isfinite(value) else ""
                raise unfit(values, index, self._name, self.expects, hint)

    def _misfit(self, values: list[object]) -> Exception:
        for index, value in enumerate(values):
            number = _integer(value)
            if number is None or not self._minimum <= number <= self._maximum:
                return unfit(values, index, self._name, self.expects)
        raise AssertionError("struct refused integers that are in range")


class FloatCodec:
    """Converts registers to IEEE 754 numbers of 16, 32 or 64 bits, infinities and NaN included, and back."""

    def __init__(self, name: str, letter: str, order: ByteOrder) -> None:
        largest = {2: "65504", 4: "3.4028234663852886e+38", 8: "1.7976931348623157e+308"}[order.size]
        self._name = name
        self._layout = _StructLayout(letter, order)
        self.expects: str = f"a number -{largest}…{largest}, inf or nan"

    def decode(self, data: BytesLike) -> list[Any]:
        """Return the floats that registers in wire order hold."""
        return self._layout.unpack(data)

    def encode(self, values: list[object]) -> bytes:
        """Return the registers, in wire order, that hold these numbers, each rounded to the nearest representable one.

        Raises:
            InvalidRequest: a value is no number, or too large. Nothing was sent.
        """
        if set(map(type, values)) - {float, int}:
            self._refuse_strangers(values)
        try:
            return self._layout.pack(values)
        except _FLOAT_REFUSALS as error:
            raise self._misfit(values) from error

    def parse(self, text: str) -> float:
        """Return the float for a text as Python writes it, ``inf`` and ``nan`` included.

        Raises:
            ValueError: the text is no number, or too large for the type.
        """
        number = real_number(text)
        try:
            self._layout.pack([number])
        except OverflowError as error:
            raise ValueError(text) from error
        return number

    def _refuse_strangers(self, values: list[object]) -> None:
        for index, value in enumerate(values):
            if isinstance(value, bool) or not isinstance(value, SupportsFloat | SupportsIndex):
                raise unfit(values, index, self._name, self.expects)

    def _misfit(self, values: list[object]) -> Exception:
        for index, value in enumerate(values):
            try:
                self._layout.pack([value])
            except _FLOAT_REFUSALS:
                return unfit(values, index, self._name, self.expects)
        raise AssertionError("struct refused numbers that it takes one by one")


class ThreeRegisterCodec:
    """Converts registers to signed or unsigned integers of 48 bits, for which ``struct`` has no format, and back."""

    def __init__(self, name: str, order: ByteOrder) -> None:
        self._signed = not name.startswith("u")
        self._minimum = -(1 << 47) if self._signed else 0
        self._maximum = self._minimum + (1 << 48) - 1
        self._name = name
        self._swaps = order.swaps
        self.expects: str = f"a whole number {self._minimum}…{self._maximum}"

    def decode(self, data: BytesLike) -> list[Any]:
        """Return the integers that registers in wire order hold."""
        whole = swapped(data, self._swaps)
        return [int.from_bytes(whole[at : at + 6], "big", signed=self._signed) for at in range(0, len(whole), 6)]

    def encode(self, values: list[object]) -> bytes:
        """Return the registers, in wire order, that hold these integers.

        Raises:
            InvalidRequest: a value is no integer, or out of range. Nothing was sent.
        """
        parts = []
        for index, value in enumerate(values):
            number = _integer(value)
            if number is None or not self._minimum <= number <= self._maximum:
                raise unfit(values, index, self._name, self.expects)
            parts.append(number.to_bytes(6, "big", signed=self._signed))
        return swapped(b"".join(parts), self._swaps)

    def parse(self, text: str) -> int:
        """Return the integer for a text in decimal, ``0x…`` or ``0b…``. Raises ``ValueError`` if it does not fit."""
        number = whole_number(text)
        if not self._minimum <= number <= self._maximum:
            raise ValueError(text)
        return number


class BcdCodec:
    """Converts registers that hold unsigned binary-coded decimals, four digits in each, to integers, and back."""

    def __init__(self, name: str, order: ByteOrder) -> None:
        self._digits = order.size * 2
        self._maximum = 10**self._digits - 1
        self._name = name
        self._swaps = order.swaps
        self.expects: str = f"a whole number 0…{self._maximum}, in decimal"

    def decode(self, data: BytesLike) -> list[Any]:
        """Return the numbers that registers of binary-coded decimals in wire order hold.

        Raises:
            BadReply: a digit is above 9; ``raw`` holds the bytes of all values.
        """
        digits = self._digits
        text = swapped(data, self._swaps).hex()
        if text and not text.isdecimal():
            place = next(place for place, digit in enumerate(text) if digit > "9") // digits
            value = text[place * digits : (place + 1) * digits].upper()
            raise BadReply(
                f"value {place} of the block reads {value}, which is no {self._name}: its digits are 0…9",
                kind="value",
                raw=bytes(data),
            )
        return [int(text[start : start + digits]) for start in range(0, len(text), digits)]

    def encode(self, values: list[object]) -> bytes:
        """Return the registers, in wire order, that hold these numbers as binary-coded decimals.

        Raises:
            InvalidRequest: a value is no integer, negative, or has too many digits. Nothing was sent.
        """
        parts = []
        for index, value in enumerate(values):
            number = _integer(value)
            if number is None or not 0 <= number <= self._maximum:
                raise unfit(values, index, self._name, self.expects)
            parts.append(f"{number:0{self._digits}d}")
        return swapped(bytes.fromhex("".join(parts)), self._swaps)

    def parse(self, text: str) -> int:
        """Return the number for a text of decimal digits, with an optional ``+``.

        Raises:
            ValueError: the text is no such number, or the number has more digits than the type. Hexadecimal such as
                ``0x12`` is refused: it could mean 12 or 18.
        """
        number = whole_number(text)
        if not text.lstrip("+").isdecimal() or number > self._maximum:
            raise ValueError(text)
        return number
