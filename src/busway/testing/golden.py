"""Golden frames: requests and replies whose right bytes are known from the specification.

The exchanges follow the examples of MODBUS Application Protocol V1.1b3, chapter 6; its misprints are corrected.
"""

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True, slots=True)
class GoldenExchange:
    """One request PDU and the reply PDU that the specification gives for it.

    Attributes:
        name: what the request asks, in words.
        section: section of MODBUS Application Protocol V1.1b3.
        request, reply: PDUs, function code first.
    """

    name: str
    section: str
    request: bytes
    reply: bytes


def _exchange(name: str, section: str, request: str, reply: str) -> GoldenExchange:
    return GoldenExchange(name, section, bytes.fromhex(request), bytes.fromhex(reply))


GOLDEN_EXCHANGES: Final = (
    _exchange("coils 20…38", "6.1", "01 0013 0013", "01 03 CD6B05"),
    _exchange("discrete inputs 197…218", "6.2", "02 00C4 0016", "02 03 ACDB35"),
    _exchange("holding registers 108…110", "6.3", "03 006B 0003", "03 06 022B 0000 0064"),
    _exchange("input register 9", "6.4", "04 0008 0001", "04 02 000A"),
    _exchange("coil 173 on", "6.5", "05 00AC FF00", "05 00AC FF00"),
    _exchange("register 2 to 3", "6.6", "06 0001 0003", "06 0001 0003"),
    _exchange("exception status", "6.7", "07", "07 6D"),
    _exchange("query data A537 returned", "6.8", "08 0000 A537", "08 0000 A537"),
    _exchange("event counter 264", "6.9", "0B", "0B FFFF 0108"),
    _exchange("event log with two events", "6.10", "0C", "0C 08 0000 0108 0121 2000"),
    _exchange("coils 20…29 written", "6.11", "0F 0013 000A 02 CD01", "0F 0013 000A"),
    _exchange("registers 2…3 written", "6.12", "10 0001 0002 04 000A 0102", "10 0001 0002"),
    _exchange("server id", "6.13", "11", "11 02 2AFF"),
    _exchange(
        "two groups of file records",
        "6.14",
        "14 0E 06 0004 0001 0002 06 0003 0009 0002",
        "14 0C 05 06 0DFE 0020 05 06 33CD 0040",
    ),
    _exchange(
        "three file records written",
        "6.15",
        "15 0D 06 0004 0007 0003 06AF 04BE 100D",
        "15 0D 06 0004 0007 0003 06AF 04BE 100D",
    ),
    _exchange("register 5 masked", "6.16", "16 0004 00F2 0025", "16 0004 00F2 0025"),
    _exchange(
        "three registers written, six read",
        "6.17",
        "17 0003 0006 000E 0003 06 00FF 00FF 00FF",
        "17 0C 00FE 0ACD 0001 0003 000D 00FF",
    ),
    _exchange("queue with two registers", "6.18", "18 04DE", "18 0006 0002 01B8 1284"),
    _exchange(
        "basic identification",
        "6.21",
        "2B 0E 01 00",
        "2B 0E 01 01 00 00 03 00 16"
        + b"Company identification".hex()
        + "01 0D"
        + b"Product code ".hex()
        + "02 05"
        + b"V2.11".hex(),
    ),
)
"""Exchanges of the specification, one for each function."""

GOLDEN_EXCEPTIONS: Final = (
    _exchange("a coil that does not exist", "7", "01 04A1 0001", "81 02"),
    _exchange("a quantity of 0", "6.3", "03 006B 0000", "83 03"),
    _exchange("a function that is not there", "7", "41", "C1 01"),
)
"""Exchanges whose request is refused: the reply is an exception."""


def golden_adu(pdu: bytes, *, transaction: int = 1, unit: int = 1) -> bytes:
    """Return a PDU with an MBAP header, built without the code under test.

    Args:
        pdu: function code and data, 1…253 bytes.
        transaction: transaction identifier, 0…65535.
        unit: unit identifier, 0…255.
    """
    return transaction.to_bytes(2, "big") + bytes(2) + (len(pdu) + 1).to_bytes(2, "big") + bytes((unit,)) + pdu
