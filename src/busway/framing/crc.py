"""CRC-16 of RTU frames (Serial Line V1.02 §2.5.1.2, §6.2.2).

Knows bytes; knows no frame and no time.

1. The polynomial is A001 (reflected), the preset FFFF; on the wire the low byte comes first. So the CRC of a whole
   frame, its two CRC bytes included, is 0: every check uses that.
2. Two bytes are processed in one step: the register has 16 bits, and one table of 65 536 entries moves it by 16.
3. A receiver that searches for a frame must not compute the CRC of every span anew. The CRC is linear: with the
   running states of the whole stream, one look-up in a table checks any span (`SpanCheck`).
"""

import struct
from array import array
from collections.abc import Callable, Iterable
from functools import cache
from typing import Final

PRESET: Final = 0xFFFF
_POLYNOMIAL: Final = 0xA001


def _moved_by_one_byte(state: int) -> int:
    for _ in range(8):
        state = state >> 1 ^ (_POLYNOMIAL if state & 1 else 0)
    return state


BYTE_TABLE: Final = [_moved_by_one_byte(byte) for byte in range(256)]
"""Table for the CRC register after one more byte, which is ``state >> 8 ^ BYTE_TABLE[(state ^ byte) & 0xFF]``."""


def _zero_byte(state: int) -> int:
    return state >> 8 ^ BYTE_TABLE[state & 0xFF]


def _word_table() -> "array[int]":
    """Return a table: for each of the 65 536 values of the CRC register, its value after two zero bytes.

    256 entries at a time are computed as one large integer, for speed.
    """
    low = [_zero_byte(_zero_byte(byte)) for byte in range(256)]
    high = [_zero_byte(_zero_byte(byte << 8)) for byte in range(256)]
    row = int.from_bytes(struct.pack("<256H", *low), "little")
    ones = int.from_bytes(struct.pack("<256H", *[1] * 256), "little")
    table = array("H", b"".join((row ^ number * ones).to_bytes(512, "little") for number in high))
    if array("H", b"\1\0")[0] != 1:  # a machine that keeps the high byte first
        table.byteswap()
    return table


_WORD_TABLE: Final = _word_table()


def crc16(data: bytes | bytearray, state: int = PRESET) -> int:
    """Return the CRC-16 of ``data``, 0…65535; 0 for a whole frame that ends with its CRC (Serial Line V1.02 §6.2.2).

    ``state`` is the CRC of the bytes before ``data``, to continue a computation.
    """
    state = crc_of_words(words_of(len(data) >> 1)(data), state)
    if len(data) & 1:
        state = state >> 8 ^ BYTE_TABLE[(state ^ data[-1]) & 0xFF]
    return state


def crc_of_words(words: Iterable[int], state: int) -> int:
    """Return the CRC-16 after ``words`` of two bytes each, low byte first; ``state`` is the CRC before them."""
    table = _WORD_TABLE
    for word in words:
        state = table[state ^ word]
    return state


@cache
def words_of(count: int) -> Callable[[bytes | bytearray], tuple[int, ...]]:
    """Return a function that takes the first ``count`` words out of bytes, for `crc_of_words`."""
    return struct.Struct(f"<{count}H").unpack_from


def crc_bytes(data: bytes | bytearray) -> bytes:
    """Return the two CRC bytes that follow ``data`` on the wire, low byte first."""
    return crc16(data).to_bytes(2, "little")


def running_states(data: Iterable[int], state: int = 0) -> list[int]:
    """Return the value of the CRC register, 0…65535, after each byte of ``data``; before the first it is ``state``."""
    table = BYTE_TABLE
    return [state := state >> 8 ^ table[(state ^ byte) & 0xFF] for byte in data]


class SpanCheck:
    """Test whether the CRC of a frame of one fixed length is right, from the CRC register before and after the frame.

    `span_check` creates it. The register is that of the whole stream, started with 0 (`running_states`), although the
    CRC of a frame starts with FFFF: the tables make up for the difference.

    Attributes:
        low, high: tables of 256 values. The CRC is right if ``low[before & 0xFF] ^ high[before >> 8] == after``, where
            ``before`` and ``after`` are the register before the first and after the last byte of the frame.
    """

    __slots__ = ("high", "low")

    def __init__(self, images: list[int]) -> None:
        # Read backwards, a table answers for the byte with all bits turned: that is the preset of ones.
        self.low: list[int] = _combinations(images[:8])[::-1]
        self.high: list[int] = _combinations(images[8:])[::-1]

    def fits(self, before: int, after: int) -> bool:
        """Whether the CRC of a frame is right, given the register (0…65535) before its first and after its last byte.

        The last two bytes of the frame are its CRC.
        """
        return self.low[before & 0xFF] ^ self.high[before >> 8] == after


@cache
def span_check(length: int) -> SpanCheck:
    """Return the CRC test for frames of ``length`` bytes, CRC included; computed at its first use, then cached."""
    return SpanCheck(_images(length))


@cache
def _images(length: int) -> list[int]:
    """Return 16 values: what the register becomes after ``length`` zero bytes if only bit 0, 1, … 15 was set before."""
    if length == 0:
        return [1 << bit for bit in range(16)]
    if length > 1:
        half, rest = _images(length >> 1), _images(length - (length >> 1))
        return [_apply(rest, image) for image in half]
    return [_zero_byte(1 << bit) for bit in range(16)]


def _apply(images: list[int], state: int) -> int:
    result = 0
    for bit in range(16):
        if state >> bit & 1:
            result ^= images[bit]
    return result


def _combinations(images: list[int]) -> list[int]:
    """Return a table of 256 values, one for each byte: the XOR of the ``images`` of the bits set in it.

    ``images`` has eight values, that of the lowest bit first.
    """
    values = [0]
    for image in images:
        values += [value ^ image for value in values]
    return values
