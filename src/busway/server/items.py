"""Items of a table: wire order ⇄ the numbers and states that an application and its hooks see.

Knows registers and bits; knows no store.
"""

from collections.abc import Sequence

from ..errors import InvalidRequest
from ..pdu.bits import pack_bits, unpack_bits
from ..pdu.read_items import unpack_registers
from ..pdu.write_items import pack_registers
from ..values.refusal import shown


def unpacked(data: bytes, count: int, *, bits: bool) -> list[int]:
    """Registers as ``int``, bits as ``bool``."""
    return list(unpack_bits(data, count)) if bits else unpack_registers(data)


def packed(values: Sequence[int], *, bits: bool) -> bytes:
    """Values in wire order; `InvalidRequest` where one does not fit."""
    if not bits:
        return pack_registers(values)
    for position, value in enumerate(values):
        # A text such as "off" would count as true.
        if not isinstance(value, int) or value not in (0, 1):
            raise InvalidRequest(f"value {position + 1} must be True or False, not {shown(value)}")
    return pack_bits([bool(value) for value in values])
