"""The cost of reads in seconds on the wire: a base for each request, and a part for each register or bit.

Knows characters, silences and response times; knows no clock, no device and no plan.

1. A read of n registers takes ``base + per_register · n`` seconds. On RTU the base is 13 characters, two silences and
   the device's response time; a register is two characters.
2. The price of a register is fixed by the line. The base differs from device to device and is learnt.
3. Behind a TCP gateway the numbers of its line hold, because the gateway waits for them.
"""

from dataclasses import dataclass, replace
from typing import Final, Literal

from ...codes import Table
from ...framing.character_times import Parity, SerialTiming

RESPONSE_TIME: Final = 0.010
"""Assumed seconds between the last character of a request and the first of its reply, used until learnt."""
ROUND_TRIP: Final = 0.005
"""Assumed seconds that a read over a network takes, used until learnt."""
NETWORK_REGISTER: Final = 0.16e-6
"""Seconds that a register takes over a network: two bytes at 100 Mbit/s. Not zero, so that of two plans with equally
many reads the one with fewer registers is cheaper."""

_RTU_CHARACTERS: Final = 13  # request: unit, function, address 2, count 2, CRC 2; reply: unit, function, length, CRC 2
_ASCII_CHARACTERS: Final = 28  # request: ':', 7 bytes in 14, CR LF; reply: ':', 4 bytes in 8, CR LF


@dataclass(frozen=True, slots=True)
class ReadCost:
    """How many seconds reads of one device take: a base for each request, and a part for each register or bit.

    Attributes:
        base: seconds that each read takes whatever its width, above 0.
        per_register: seconds that each register adds, above 0.
        per_bit: seconds that each coil or discrete input adds, above 0.

    Raises:
        ValueError: a cost is not above 0.
    """

    base: float
    per_register: float
    per_bit: float

    def __post_init__(self) -> None:
        if not (self.base > 0 and self.per_register > 0 and self.per_bit > 0):
            raise ValueError(f"costs are above 0, not {self.base}, {self.per_register} and {self.per_bit}")

    def per_item(self, table: Table) -> float:
        """Return the seconds that one register or bit of a table adds to a read."""
        return self.per_bit if table.holds_bits else self.per_register

    def of(self, table: Table, width: int) -> float:
        """Return the seconds that a read of ``width`` registers or bits of a table takes."""
        return self.base + self.per_item(table) * width

    def with_base(self, base: float) -> "ReadCost":
        """Return a copy with another base (seconds for each request), such as for another device on the same line."""
        return replace(self, base=base)


def line_cost(
    timing: SerialTiming,
    framing: Literal["rtu", "ascii"] = "rtu",
    *,
    response_time: float = RESPONSE_TIME,
    gap: float = 0.0,
) -> ReadCost:
    """Return what reads on a serial line cost, in seconds: per request, per register and per bit.

    Args:
        timing: how long characters and silences take on the line.
        framing: RTU has two silences for each read; ASCII has none, and twice the characters for each byte.
        response_time: seconds between the end of a request and the beginning of the device's reply.
        gap: least seconds between a reply and the next request. On RTU it replaces a shorter silence; on ASCII it is
            added.
    """
    if framing == "ascii":
        return ReadCost(
            timing.duration(_ASCII_CHARACTERS) + gap + response_time, timing.duration(4), timing.duration(2) / 8
        )
    silences = timing.t3_5 + max(timing.t3_5, gap)
    return ReadCost(
        timing.duration(_RTU_CHARACTERS) + silences + response_time, timing.duration(2), timing.duration(1) / 8
    )


def network_cost(round_trip: float = ROUND_TRIP) -> ReadCost:
    """Return what reads over a network cost: ``round_trip`` seconds each, and very little for each register or bit."""
    return ReadCost(round_trip, NETWORK_REGISTER, NETWORK_REGISTER / 16)


def baud_cost(baud: int, *, parity: Parity = Parity.EVEN, response_time: float = RESPONSE_TIME) -> ReadCost:
    """Return what reads on an RTU line of ``baud`` bit/s cost, whether the line is local or behind a gateway.

    Args:
        baud: speed of the line, bit/s.
        parity: parity of its characters.
        response_time: seconds between the end of a request and the beginning of the device's reply.
    """
    return line_cost(SerialTiming.of_line(baud, parity=parity), response_time=response_time)
