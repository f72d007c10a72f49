"""Times on a serial line: characters, t1.5, t3.5 and whole frames (Serial Line V1.02 §2.5.1.1).

Knows bits and seconds; knows no port.

1. A character has a start bit, its data bits, a parity bit or none, and its stop bits. Without parity a second stop
   bit takes the place of the parity bit, so that RTU characters have 11 bits and ASCII characters 10 (§2.5.1, §2.5.2).
2. Up to 19 200 bit/s, t1.5 and t3.5 are 1.5 and 3.5 character times; above, they are 750 µs and 1.75 ms. (The
   document prints t1.5 twice; the second is t3.5.)
"""

from dataclasses import dataclass
from typing import Final, Self

from ..values.caseless_enum import CaselessEnum

FIXED_ABOVE_BAUD: Final = 19_200
"""Rate in bit/s above which t1.5 and t3.5 are fixed."""
FIXED_T1_5: Final = 0.000_750
FIXED_T3_5: Final = 0.001_750
NETWORK_SILENCE: Final = 0.020
"""Seconds used as t3.5 for RTU over a network: longer than the delay between two segments on a LAN."""


class Parity(CaselessEnum):
    """The parity bit of characters: ``Parity("even")``; the first letter is accepted too, as on data sheets: ``E``."""

    EVEN = "even"
    ODD = "odd"
    NONE = "none"

    @classmethod
    def _missing_(cls, value: object) -> Self | None:
        if isinstance(value, str) and len(value) == 1:
            return next((one for one in cls if one.value[0] == value.lower()), None)
        return super()._missing_(value)


def stop_bits_for(parity: Parity) -> int:
    """Return the number of stop bits that the specification asks for: 2 without parity, 1 with it (§2.5.1)."""
    return 2 if parity is Parity.NONE else 1


def character_bits(data_bits: int = 8, parity: Parity = Parity.EVEN, stop_bits: float | None = None) -> float:
    """Return the number of bits of one character on the line, start, parity and stop bits included.

    Args:
        data_bits: 7 (ASCII) or 8 (RTU).
        parity: even by default.
        stop_bits: 1, 1.5 or 2; None for 2 without parity and 1 with it.

    Raises:
        ValueError: another number of data or stop bits.
    """
    if data_bits not in (7, 8):
        raise ValueError(f"a character has 7 or 8 data bits, not {data_bits}")
    stop = stop_bits_for(parity) if stop_bits is None else stop_bits
    if stop not in (1, 1.5, 2):
        raise ValueError(f"a character has 1, 1.5 or 2 stop bits, not {stop}")
    return 1 + data_bits + (parity is not Parity.NONE) + stop


@dataclass(frozen=True, slots=True)
class SerialTiming:
    """The times of one serial line, in seconds: character, t1.5 and t3.5.

    Attributes:
        character: duration of one character, start and stop bits included; 0 where characters have none (networks).
        t1_5: the longest gap inside a frame by the specification.
        t3_5: the shortest silence between two frames.

    Raises:
        ValueError: a negative time, or t1.5 above t3.5.
    """

    character: float
    t1_5: float
    t3_5: float

    def __post_init__(self) -> None:
        if self.character < 0 or not 0 <= self.t1_5 <= self.t3_5:
            raise ValueError(f"times of a line must be 0 ≤ t1.5 ≤ t3.5, not {self.t1_5} and {self.t3_5}")

    @classmethod
    def of_line(
        cls,
        baud: int = 19_200,
        *,
        data_bits: int = 8,
        parity: Parity = Parity.EVEN,
        stop_bits: float | None = None,
    ) -> "SerialTiming":
        """Return the times of a serial line of ``baud`` bit/s (1 and above); other arguments as in `character_bits`.

        Raises:
            ValueError: ``baud`` below 1, or another number of data or stop bits.
        """
        if baud < 1:
            raise ValueError(f"the rate of a line is 1 bit/s or more, not {baud}")
        character = character_bits(data_bits, parity, stop_bits) / baud
        if baud > FIXED_ABOVE_BAUD:
            return cls(character, FIXED_T1_5, FIXED_T3_5)
        return cls(character, 1.5 * character, 3.5 * character)

    @classmethod
    def of_network(cls, silence: float = NETWORK_SILENCE) -> "SerialTiming":
        """Return the times for RTU or ASCII over a network: t1.5 and t3.5 are ``silence`` seconds, characters 0.

        Raises:
            ValueError: ``silence`` is negative.
        """
        return cls(0.0, silence, silence)

    def duration(self, characters: int) -> float:
        """Return the seconds that ``characters`` characters take on the line without a gap; 0 over a network."""
        return characters * self.character
