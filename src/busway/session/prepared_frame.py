"""The prepared answer to a read in an RTU frame over a network: everything of the reply but the data and their CRC.

Knows the reply frame and its CRC; knows no session and no rights. Imported only where RTU is used: the tables of the
CRC take 128 KB.
"""

from collections.abc import Callable
from typing import Final

from ..framing.crc import crc16, words_of
from ..pdu.fast_answers import Block, PreparedAnswer

_UNIT: Final = 4
"""Offset of the unit in the head of a `PreparedAnswer`, which begins after the transaction identifier."""


class PreparedFrame:
    """The prepared answer to one particular read of registers in an RTU frame.

    Args:
        prepared: the prepared answer to the same read on TCP.

    Attributes:
        head: the bytes of the reply before the data: unit, function code, byte count.
        state: the CRC of ``head``; that of the whole reply goes on from it.
        block: the registers of the device.
        part: slice of ``block.data`` that the reply contains.
        words: function that turns the data into words for `crc_of_words`.
    """

    __slots__ = ("block", "head", "part", "state", "words")

    def __init__(self, prepared: PreparedAnswer) -> None:
        self.head: bytes = prepared.head[_UNIT:]
        self.state: int = crc16(self.head)
        self.block: Block = prepared.block
        self.part: slice[int, int, None] = prepared.part
        self.words: Callable[[bytes | bytearray], tuple[int, ...]] = words_of((self.part.stop - self.part.start) // 2)
