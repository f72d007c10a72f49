"""Byte orders, such as ``CDAB``: the order of bytes and registers inside a value of 16, 32, 48 or 64 bits.

The specification fixes the two bytes of a register (big-endian, Application Protocol V1.1b3 §4.2) and nothing more:
how a larger number lies in several registers is each maker's choice, and some swap the bytes of a register as well.

An order is written as letters, ``A`` the most significant byte, in the sequence in which the bytes are sent. This file
knows those names and how to bring a block of bytes into the order ``ABCD…``. It knows nothing about what the bytes
mean.

Rules:

1. An order is three independent facts, the bits of `ByteOrder.mask`:
   1 - the two bytes of each register are swapped, 2 - the two registers of each 32-bit half are swapped,
   4 - the two 32-bit halves are swapped. The byte at place ``i`` of the wire is byte ``i ^ mask`` of the value.
2. The order of a device may be given to every type of that device. A longer order says how its own smaller
   parts lie: for 16 bits ``CDAB`` is ``AB`` and ``DCBA`` is ``BA``. A shorter one is continued in the same sense:
   ``ABCD`` → ``ABCDEFGH``, ``CDAB`` → ``GHEFCDAB`` (all registers reversed), ``BADC`` → ``BADCFEHG``,
   ``DCBA`` → ``HGFEDCBA``; ``AB`` → ``ABCD``, ``BA`` → ``BADC``. ``CDABGHEF`` must be written in full.
3. Nothing is permuted value by value: a block is turned by whole-array byte swaps, and by exchanges of registers where
   a value has three of them.
4. A value of 48 bits has three registers. Two of them may be exchanged (``ABEFCD``, ``CDABEF``, and ``EFCDAB``, all
   registers reversed); the bytes of each may be swapped as well.
"""

from array import array
from dataclasses import dataclass
from typing import Final, TypeAlias

from ..errors import InvalidRequest

BytesLike: TypeAlias = bytes | bytearray | memoryview
"""Bytes in wire order: ``bytes``, ``bytearray`` or ``memoryview``."""

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

_EXCHANGES: Final = {0: "", 2: "02", 4: "01", 6: "12"}
"""Positions of the two of three registers that are exchanged, by ``mask & 6`` of a 48-bit order; empty for none."""


def _spelt_three(mask: int) -> str:
    registers = ["BA", "DC", "FE"] if mask & 1 else ["AB", "CD", "EF"]
    exchange = _EXCHANGES[mask & 6]
    if exchange:
        first, other = int(exchange[0]), int(exchange[1])
        registers[first], registers[other] = registers[other], registers[first]
    return "".join(registers)


_ORDERS.update({_spelt_three(mask): (6, mask) for mask in range(8)})

ORDERS: Final[dict[int, tuple[str, ...]]] = {
    bits: tuple(text for text, (size, _) in _ORDERS.items() if size * 8 == bits) for bits in (16, 32, 48, 64)
}
"""The names of the orders for values of 16, 32, 48 and 64 bits, by this number of bits, big-endian first."""


@dataclass(frozen=True, slots=True)
class ByteOrder:
    """The order in which the bytes of a value of ``size`` bytes are sent; created by `byte_order`.

    Attributes:
        size: bytes of a value: 2, 4, 6 or 8.
        mask: which parts are swapped, as the sum of 1 (bytes of each register), 2 and 4 (registers; rules 1 and 4 of
            this file): 0 for ``ABCD``, 2 for ``CDAB``.
    """

    size: int
    mask: int

    @property
    def text(self) -> str:
        """The byte order in letters, one for each byte: ``CDAB``."""
        return _spelt_three(self.mask) if self.size == 6 else _spelt(self.size, self.mask)

    @property
    def swaps(self) -> tuple[str, ...]:
        """The swaps that `swapped` applies, in sequence, to turn values from wire order to big-endian order, or back.

        Each swap is the type code of an `array` whose items are byte-swapped (``H``, ``I`` or ``Q``), or two digits:
        which two of three registers are exchanged, such as ``02`` for the first and the last. Empty for ``ABCD``.
        """
        if self.size == 6:
            return tuple(each for each in ("H" if self.mask & 1 else "", _EXCHANGES[self.mask & 6]) if each)
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
        """Whether the first of `swaps` reverses all bytes of a value; `struct` can then read it as little-endian."""
        return self.size != 6 and bool(self.mask & (self.size >> 1))

    @property
    def registers(self) -> tuple[int, ...]:
        """The position on the wire, from 0, of each register of a value: ``(1, 0)`` for ``CDAB``.

        The most significant register is the first in the tuple.
        """
        if self.size == 6:
            return tuple("ABCDEF".index(self.text[2 * place]) // 2 for place in range(3))
        return tuple(place ^ (self.mask >> 1) for place in range(self.size // 2))


def byte_order(text: str, size: int) -> ByteOrder:
    """Return the byte order that a name such as ``big`` or ``CDAB`` means for values of a given size.

    Args:
        text: letters (``AB``, ``CDAB``, ``GHEFCDAB``, …) or ``big``, ``little``, ``word-swapped`` (registers reversed,
            bytes in each as usual), ``byte-swapped`` (registers as usual, bytes in each swapped). Capitals do not
            matter. Letters for another size are adapted by rule 2 of this file.
        size: bytes of a value: 2, 4, 6 or 8.

    Raises:
        InvalidRequest: there is no such order, or it says nothing about values of this size. Nothing was sent.
    """
    if not isinstance(text, str):
        raise InvalidRequest(f"an order is text such as 'CDAB', not {type(text).__name__}")
    key = text.strip().upper().replace("_", "-")
    if key in _WORDS:
        return ByteOrder(size, _WORDS[key] & (3 if size == 6 else size - 1))
    if key not in _ORDERS:
        raise InvalidRequest(
            f"unknown order {text!r}; for {size * 8} bits there are {', '.join(ORDERS[size * 8])},"
            " and the words big, little, word-swapped, byte-swapped"
        )
    given_size, mask = _ORDERS[key]
    if size == given_size:
        return ByteOrder(size, mask)
    if 6 in (size, given_size) and size != 2:
        return ByteOrder(size, _between_three_and_others(key, size, given_size, mask))
    if given_size == 4 and mask & 2:
        mask |= _REGISTERS_REVERSED
    return ByteOrder(size, mask & (size - 1))


def _between_three_and_others(text: str, size: int, given_size: int, mask: int) -> int:
    """Return the mask for values of ``size`` bytes, given the mask of the same order for ``given_size`` bytes.

    Used if one of the two sizes is 6 (three registers); then the masks are not simply related.

    Args:
        text: the order as written, for errors.
        size: size that is wanted, in bytes.
        given_size: size that the order is written for, in bytes.
        mask: the mask for ``given_size``.

    Raises:
        InvalidRequest: the order cannot be applied to the other size.
    """
    halves_agree = given_size != 8 or bool(mask & 2) == bool(mask & 4)
    if (given_size == 6 and mask & 4) or not halves_agree:
        raise InvalidRequest(f"order {text} is for {given_size * 8} bits and says nothing of {size * 8}")
    return (mask & 3) if size == 6 or not mask & 2 else (mask & 1 | _REGISTERS_REVERSED) & (size - 1)


def swapped(data: BytesLike, swaps: tuple[str, ...]) -> bytes:
    """Return a copy of ``data`` with the swaps of a `ByteOrder` applied to all its values; a second call undoes them.

    Args:
        data: bytes, a whole number of values of the order's size.
        swaps: the swaps, in sequence, as `ByteOrder.swaps` gives them.
    """
    for swap in swaps:
        if len(swap) == 2:
            data = _exchanged(data, int(swap[0]), int(swap[1]))
            continue
        items = array(swap)
        items.frombytes(data)
        items.byteswap()
        data = items.tobytes()
    return bytes(data)


def _exchanged(data: BytesLike, first: int, other: int) -> bytes:
    """Return values of three registers each, with the registers at positions ``first`` and ``other`` exchanged."""
    items = array("H")
    items.frombytes(data)
    items[first::3], items[other::3] = items[other::3], items[first::3]
    return items.tobytes()
