"""Converts items of a table between wire order and the numbers and states that applications and hooks see.

Knows registers and bits; knows no memory.
"""

from collections.abc import Sequence

from ..pdu.bits import as_states, pack_bits, unpack_bits
from ..pdu.read_items import unpack_registers
from ..pdu.write_items import pack_registers


def unpacked(data: bytes, count: int, *, bits: bool) -> list[int]:
    """Return items in wire order as values: registers as ``int``, bits as ``bool``.

    ``count`` is the number of bits; for registers it is ignored, and all of ``data`` are returned.
    """
    return list(unpack_bits(data, count)) if bits else unpack_registers(data)


def packed(values: Sequence[int], *, bits: bool) -> bytes:
    """Return values of registers or bits in wire order. Raises `InvalidRequest` for a value that does not fit."""
    if not bits:
        return pack_registers(values)
    return pack_bits(as_states(values))
