"""Checks whether a datagram is exactly one whole frame.

Knows bytes; knows no socket. A frame is never continued in a second datagram, so the caller drops any other datagram.
"""

from collections.abc import Callable
from typing import Final

from ..codes import ASCII_ADU_LIMIT, RTU_ADU_LIMIT
from ..pdu.functions import STANDARD
from .crc import crc16
from .lengths import SHORTEST, lengths_of
from .mbap import HEADER_SIZE, MAX_LENGTH, MIN_LENGTH
from .received import Direction

_SHORTEST_ASCII: Final = 9
"""Fewest characters of an ASCII frame: colon, unit, function code, LRC, CR, delimiter."""


def is_whole_mbap(data: bytes) -> bool:
    """Return True if a datagram is exactly one MBAP frame, by its length field (Messaging on TCP/IP V1.0b §3.1.3).

    The protocol identifier is not checked. False for less than 8 bytes: unit and function code must be there.
    """
    if len(data) <= HEADER_SIZE:
        return False
    length = data[4] << 8 | data[5]
    return MIN_LENGTH <= length <= MAX_LENGTH and len(data) == 6 + length


def is_whole_rtu(data: bytes) -> bool:
    """Return True if a datagram is exactly one RTU frame: the CRC over all of it is right (Serial Line V1.02 §2.5.1).

    False outside 4…256 bytes, and if a shorter frame, found by function code and CRC, is followed by zero bytes: these
    leave the CRC right.
    """
    if not SHORTEST <= len(data) <= RTU_ADU_LIMIT or crc16(data):
        return False
    lengths, shown = lengths_of(STANDARD), bytearray(data)
    for direction in (Direction.REQUEST, Direction.REPLY):
        length = lengths.length(direction, shown, 0, len(shown))
        if SHORTEST <= length < len(data) and crc16(data[:length]) == 0:
            return False
    return True


def is_whole_ascii(data: bytes) -> bool:
    """Return True if a datagram is exactly one ASCII frame: one colon, at its start; CR and the delimiter at its end.

    The delimiter can be any character but a colon. Digits and LRC are not checked (Serial Line V1.02 §2.5.2).
    """
    return (
        _SHORTEST_ASCII <= len(data) <= ASCII_ADU_LIMIT
        and data[:1] == b":"
        and data.rfind(b":") == 0
        and data.find(b"\r") == len(data) - 2
    )


WHOLE: Final[dict[str, Callable[[bytes], bool]]] = {
    "mbap": is_whole_mbap,
    "rtu": is_whole_rtu,
    "ascii": is_whole_ascii,
}
"""By framing (``mbap``, ``rtu``, ``ascii``), the function that tells whether a datagram is exactly one whole frame."""
