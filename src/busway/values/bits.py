"""Conversion between registers and bits: a register as sixteen bits, and single bits or bit fields of it.

Knows that bit 0 is the least significant (Application Protocol V1.1b3 §4.2 has registers big-endian). Coils and
discrete inputs are bits already and need nothing from here but `parse_bit`.
"""

from typing import Any, Final

from ..errors import InvalidRequest
from .numbers import whole_number
from .orders import ByteOrder, BytesLike, swapped
from .unfit_values import shown, unfit

_STATES: Final = {"on": True, "true": True, "1": True, "off": False, "false": False, "0": False}

# The eight bits of each byte, least significant first: a register becomes two look-ups.
_BITS: Final = tuple(tuple(bool(byte >> bit & 1) for bit in range(8)) for byte in range(256))


def parse_bit(text: str) -> bool:
    """Return the bool for a text: ``on``, ``true``, ``1`` or ``off``, ``false``, ``0``; capitals do not matter.

    Raises:
        InvalidRequest: the text is none of these. Nothing was sent.
    """
    state = _STATES.get(text.strip().lower())
    if state is None:
        raise InvalidRequest(f"{shown(text)} is not a state, which is one of {', '.join(_STATES)}")
    return state


class BitsCodec:
    """Converts each register to a tuple of sixteen ``bool``, least significant first, and back."""

    def __init__(self, name: str, order: ByteOrder) -> None:
        self._name = name
        self._swaps = order.swaps
        self.expects = "sixteen of True and False, the least significant bit first"

    def decode(self, data: BytesLike) -> list[Any]:
        """Return each register as a tuple of sixteen ``bool``, least significant bit first."""
        whole = swapped(data, self._swaps)
        return [_BITS[low] + _BITS[high] for high, low in zip(whole[::2], whole[1::2], strict=True)]

    def encode(self, values: list[object]) -> bytes:
        """Return the registers, in wire order, that hold sequences of sixteen states, least significant bit first.

        Args:
            values: a tuple or list of ``bool``, or of the integers 0 and 1, for each register.

        Raises:
            InvalidRequest: a value is no tuple or list of sixteen states. Nothing was sent.
        """
        registers = bytearray()
        for index, value in enumerate(values):
            if not isinstance(value, tuple | list) or len(value) != 16:
                raise unfit(values, index, self._name, self.expects)
            if any(not isinstance(state, int) or state not in (0, 1) for state in value):
                raise unfit(values, index, self._name, self.expects)
            registers += sum(state << bit for bit, state in enumerate(value)).to_bytes(2, "big")
        return swapped(registers, self._swaps)

    def parse(self, text: str) -> tuple[bool, ...]:
        """Return the sixteen bits of a number given as text: ``0b101``, ``0x5`` and ``5`` set the bits 0 and 2.

        Raises:
            ValueError: the text is no number 0…65535.
        """
        number = whole_number(text)
        if not 0 <= number <= 0xFFFF:
            raise ValueError(text)
        return _BITS[number & 0xFF] + _BITS[number >> 8]


class BitCodec:
    """Converts one bit of each register to ``bool``; its number 0…15 is fixed for the codec."""

    def __init__(self, name: str, bit: int, order: ByteOrder) -> None:
        self._name = name
        self._bit = bit
        self._swaps = order.swaps
        self.expects: str = f"one of {', '.join(_STATES)}"

    @property
    def place(self) -> tuple[int, int]:
        """Position of the bit in the register on the wire: byte 0 (the first) or 1, and the mask in that byte."""
        is_low = self._bit < 8
        return int(is_low is not bool(self._swaps)), 1 << (self._bit & 7)

    def decode(self, data: BytesLike) -> list[Any]:
        """Return the state of the codec's bit in each register as ``bool``."""
        whole = swapped(data, self._swaps)
        column = whole[1::2] if self._bit < 8 else whole[::2]
        position = self._bit & 7
        return [_BITS[byte][position] for byte in column]

    def encode(self, values: list[object]) -> bytes:
        """Raise `InvalidRequest`: one bit cannot be written without the other bits of its register; use `merge`.

        Raises:
            InvalidRequest: always; the message gives the masks of a mask write. Nothing was sent.
        """
        # The masks are for the register as the device sees it: with swapped bytes the bit lies in the other byte.
        wire_bit = self._bit ^ 8 if self._swaps else self._bit
        raise InvalidRequest(
            f"{self._name} cannot be written: the register's other bits would be overwritten; use a mask write"
            f" (function 22) with AND mask 0x{0xFFFF ^ 1 << wire_bit:04X} and OR mask 0x{1 << wire_bit:04X}"
            " to set it, 0x0000 to clear it"
        )

    def parse(self, text: str) -> bool:
        """Return the bool for ``on``, ``true``, ``1`` or ``off``, ``false``, ``0``; capitals do not matter.

        Raises ``ValueError`` for other texts.
        """
        if text.lower() not in _STATES:
            raise ValueError(text)
        return _STATES[text.lower()]

    def merge(self, value: object, held: BytesLike) -> bytes:
        """Return the register, in wire order, with the codec's bit set or cleared, and its other bits unchanged.

        Args:
            value: True, False, 1 or 0.
            held: the two present bytes of the register, in wire order.

        Raises:
            InvalidRequest: ``value`` is not True, False, 1 or 0. Nothing was sent.
        """
        if value not in (True, False):
            raise unfit([value], 0, self._name, self.expects)
        number = int.from_bytes(swapped(held, self._swaps), "big")
        number = number & ~(1 << self._bit) | int(bool(value)) << self._bit
        return swapped(number.to_bytes(2, "big"), self._swaps)


class FieldCodec:
    """Converts adjacent bits of each register to a number: half a register, or a field of a status word.

    Args:
        name: name of the value type, for errors.
        low, high: the lowest and highest of the bits, 0 (least significant)…15.
        order: order of the two bytes of a register.
        signed: whether the bits are a number in two's complement.
    """

    def __init__(self, name: str, low: int, high: int, order: ByteOrder, *, signed: bool) -> None:
        self._name = name
        self._low = low
        self._mask = (1 << high - low + 1) - 1
        self._sign = 1 << high - low if signed else 0
        self._swaps = order.swaps
        self._minimum = -self._sign
        self._maximum = self._mask - self._sign
        self.expects: str = f"a whole number {self._minimum}…{self._maximum}"

    def decode(self, data: BytesLike) -> list[Any]:
        """Return the number that the codec's bits hold in each register; with a sign if the codec is signed."""
        whole = swapped(data, self._swaps)
        low, mask, sign = self._low, self._mask, self._sign
        return [
            (((whole[at] << 8 | whole[at + 1]) >> low & mask) ^ sign) - sign for at in range(0, len(whole), 2)
        ]  # x ^ sign - sign extends the sign

    def encode(self, values: list[object]) -> bytes:
        """Raise `InvalidRequest`: a bit field cannot be written without the other bits of its register; use `merge`.

        Raises:
            InvalidRequest: always. Nothing was sent.
        """
        raise InvalidRequest(f"{self._name} cannot be written alone: the register's other bits would be overwritten")

    def merge(self, value: object, held: BytesLike) -> bytes:
        """Return the register, in wire order, with a number in the codec's bits, and its other bits unchanged.

        Args:
            value: the number, an ``int``.
            held: the two present bytes of the register, in wire order.

        Raises:
            InvalidRequest: the value is no integer, or does not fit into the bits. Nothing was sent.
        """
        if isinstance(value, bool) or not isinstance(value, int) or not self._minimum <= value <= self._maximum:
            raise unfit([value], 0, self._name, self.expects)
        number = int.from_bytes(swapped(held, self._swaps), "big")
        number = number & ~(self._mask << self._low) | (value & self._mask) << self._low
        return swapped(number.to_bytes(2, "big"), self._swaps)

    def parse(self, text: str) -> int:
        """Return the number for a text in decimal, ``0x…`` or ``0b…``. Raises ``ValueError`` if it does not fit."""
        number = whole_number(text)
        if not self._minimum <= number <= self._maximum:
            raise ValueError(text)
        return number
