"""Bits as the wire packs them: eight to a byte, the first item in the lowest bit (Application Protocol V1.1b3 §6.1).

Knows bytes and bools; knows no message.
"""

from collections.abc import Sequence

_BITS_OF_BYTE = tuple(tuple(bool(byte >> bit & 1) for bit in range(8)) for byte in range(256))


def pack_bits(values: Sequence[bool]) -> bytes:
    """The bytes that hold ``values``; unused bits of the last byte are zero."""
    packed = 0
    for position, value in enumerate(values):
        if value:
            packed |= 1 << position
    return packed.to_bytes((len(values) + 7) // 8, "little")


def unpack_bits(data: bytes, count: int) -> list[bool]:
    """The first ``count`` bits of ``data``; fewer if there are fewer."""
    found: list[bool] = []
    for byte in data:
        found += _BITS_OF_BYTE[byte]
    del found[count:]
    return found


def slice_bits(data: bytes | bytearray, first: int, count: int) -> bytes:
    """``count`` packed bits that start at bit ``first``, moved to the lowest bit; unused bits are zero."""
    shift = first & 7
    start = first >> 3
    if not shift and not count & 7:
        return bytes(data[start : start + (count >> 3)])
    whole = int.from_bytes(data[start : (first + count + 7) >> 3], "little") >> shift
    return (whole & (1 << count) - 1).to_bytes((count + 7) >> 3, "little")


def splice_bits(data: bytearray, first: int, count: int, packed: bytes) -> None:
    """Write ``count`` packed bits into ``data`` from bit ``first``, in one assignment."""
    start, end = first >> 3, (first + count + 7) >> 3
    shift = first & 7
    mask = ((1 << count) - 1) << shift
    new = (int.from_bytes(packed, "little") << shift) & mask
    old = int.from_bytes(data[start:end], "little") & ~mask
    data[start:end] = (old | new).to_bytes(end - start, "little")
