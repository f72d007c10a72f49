"""The order of bytes and registers inside a value of 16, 32 or 64 bits.

The specification fixes the two bytes of a register (big-endian, Application Protocol V1.1b3 §4.2) and nothing more:
how a larger number lies in several registers is each maker's choice, and some swap the bytes of a register as well.

An order is written as letters, ``A`` the most significant byte, in the sequence in which the bytes travel. This file
knows those names and how to bring a block of bytes into the order ``ABCD…``. It knows nothing about what the bytes
mean.

Rules:

1. An order is three independent facts, the bits of `ByteOrder.mask`:
   1 - the two bytes of each register are swapped, 2 - the two registers of each 32-bit half are swapped,
   4 - the two 32-bit halves are swapped. The byte at place ``i`` of the wire is byte ``i ^ mask`` of the value.
2. Whoever has one order per device may give it to every type of that device. A longer order says how its own smaller
   parts lie: for 16 bits ``CDAB`` is ``AB`` and ``DCBA`` is ``BA``. A shorter one is continued in the same sense:
   ``ABCD`` → ``ABCDEFGH``, ``CDAB`` → ``GHEFCDAB`` (all registers reversed), ``BADC`` → ``BADCFEHG``,
   ``DCBA`` → ``HGFEDCBA``; ``AB`` → ``ABCD``, ``BA`` → ``BADC``. Who needs ``CDABGHEF`` writes it in full.
3. Nothing is permuted value by value: a block is turned by whole-array byte swaps.
"""

from array import array
from dataclasses import dataclass
from typing import Final, TypeAlias

from ..errors import InvalidRequest

Wire: TypeAlias = bytes | bytearray | memoryview
"""Bytes in wire order, in whatever holds them."""

_LETTERS: Final = "ABCDEFGH"
_REGISTERS_REVERSED: Final = 2 | 4

_WORDS: Final[dict[str, int]] = {
    "BIG": 0,
    "LITTLE": 1 | 2 | 4,
    "WORD-SWAPPED": _REGISTERS_REVERSED,
    "BYTE-SWAPPED": 1,
}


def _spelt(size: int, mask: int) -> str:
    return "".join(_LETTERS[place ^ mask] for place in range(size))


# Two orders for 16 bits, four for 32. For 64 bits three swaps make eight. Six are in everyday use: the four that
# treat the value as a whole (ABCDEFGH, GHEFCDAB, BADCFEHG, HGFEDCBA), and CDABGHEF and DCBAHGFE of devices that put a
# double into two 32-bit items of their own order, high item first. The last two, EFGHABCD and FEHGBADC (low item
# first), are what drivers with separate "first word low" and "first double word low" switches produce; since they
# are the same three facts, they are taken too.
_ORDERS: Final[dict[str, tuple[int, int]]] = {
    _spelt(size, mask): (size, mask) for size in (2, 4, 8) for mask in range(size)
}

ORDERS: Final[dict[int, tuple[str, ...]]] = {
    bits: tuple(text for text, (size, _) in _ORDERS.items() if size * 8 == bits) for bits in (16, 32, 64)
}
"""The orders that exist for values of 16, 32 and 64 bits, big-endian first."""


@dataclass(frozen=True, slots=True)
class ByteOrder:
    """How the bytes of one value of ``size`` bytes lie on the wire; got from `byte_order`.

    Attributes:
        size: bytes of a value: 2, 4 or 8.
        mask: rule 1 of this file, 0…size - 1.
    """

    size: int
    mask: int

    @property
    def text(self) -> str:
        """The order in letters, one for each byte: ``CDAB``."""
        return _spelt(self.size, self.mask)

    @property
    def swaps(self) -> tuple[str, ...]:
        """Array type codes whose byte swaps, one after the other, turn the wire into big-endian values and back."""
        widths: list[str] = []
        rest = self.mask
        # Reversing the bytes of each group of 8, 4 or 2 is an exclusive or with 7, 3 or 1.
        for width, type_code in ((8, "Q"), (4, "I"), (2, "H")):
            if rest & (width >> 1):
                widths.append(type_code)
                rest ^= width - 1
        return tuple(widths)

    @property
    def is_reversed(self) -> bool:
        """Whether the first of `swaps` reverses whole values, which reading them as little-endian does as well."""
        return bool(self.mask & (self.size >> 1))


def byte_order(text: str, size: int) -> ByteOrder:
    """The order that a name stands for, for values of a given size.

    Args:
        text: letters (``AB``, ``CDAB``, ``GHEFCDAB``, …) or ``big``, ``little``, ``word-swapped`` (registers
            reversed, bytes in each as usual), ``byte-swapped`` (registers as usual, bytes in each swapped).
            Capitals do not matter. Letters for another size are taken as rule 2 of this file says.
        size: bytes of a value: 2, 4 or 8.

    Raises:
        InvalidRequest: no such order. Nothing was sent.
    """
    if not isinstance(text, str):
        raise InvalidRequest(f"an order is text such as 'CDAB', not {type(text).__name__}")
    key = text.strip().upper().replace("_", "-")
    if key in _WORDS:
        return ByteOrder(size, _WORDS[key] & (size - 1))
    if key not in _ORDERS:
        raise InvalidRequest(
            f"unknown order {text!r}; for {size * 8} bits there are {', '.join(ORDERS[size * 8])},"
            " and the words big, little, word-swapped, byte-swapped"
        )
    given_size, mask = _ORDERS[key]
    if given_size == 4 and mask & 2:
        mask |= _REGISTERS_REVERSED
    return ByteOrder(size, mask & (size - 1))


def swapped(data: Wire, swaps: tuple[str, ...]) -> bytes:
    """``data`` after the given byte swaps, each over the whole block; its length is a multiple of the value's size."""
    for type_code in swaps:
        items = array(type_code)
        items.frombytes(data)
        items.byteswap()
        data = items.tobytes()
    return bytes(data)
