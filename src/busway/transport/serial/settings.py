"""What a serial line is set to: one frozen value, checked when it is built.

Knows the characters of a line and the wires that switch its direction; knows no port and no Modbus.

1. Even parity is the default (Serial Line V1.02 §2.5.1). Stop bits follow by rule, one with parity and two without, so
   that a character keeps its length; who must can still say how many.
2. A setting that has no effect beside the others is refused: it would be believed to work.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

from ...errors import ConfigError
from ...framing.echo import Echo
from ...framing.timing import Parity, SerialTiming, stop_bits_for
from ...framing.word import Word
from ...options.text import build_parameters

LOWEST_BAUD = 50
HIGHEST_BAUD = 12_000_000
"""What the fastest USB adapters offer; the specification asks for 1200 to 115 200 and lets more be."""

LONGEST_DIRECTION_DELAY = 1.0
"""Seconds; the kernel's own mode takes 0.1 at most and says so when the port is opened."""


class Rs485(Word):
    """Who switches the direction of an RS-485 driver.

    OFF: nobody here; the adapter does it itself, or the line is RS-232 or 4-wire. KERNEL: the port's driver, in its
    RS-485 mode, which is exact. RTS: this program, by the RTS wire; the operating system's delays add to it.
    AUTOMATIC: the kernel where the port has that mode, RTS otherwise.
    """

    OFF = "off"
    KERNEL = "kernel"
    RTS = "rts"
    AUTOMATIC = "automatic"


@dataclass(frozen=True, slots=True, kw_only=True)
class SerialSettings:
    """The settings of one serial line (Serial Line V1.02 §2.5, §3.2).

    Attributes:
        baud: bits per second, 50…12 000 000.
        parity: even, odd or none.
        data_bits: bits of each character, 7 or 8.
        stop_bits: 1 or 2; None follows the rule (one with parity, two without).
        rs485: who switches the driver's direction.
        rts_on_send, rts_after_send: level of RTS while sending and otherwise; they must differ.
        delay_before_send: seconds from switching to the first character, 0…1.
        delay_after_send: seconds from the last character to switching back, 0…1.
        echo: whether the own characters come back. The port only carries this; who frames the bytes acts on it.
        low_latency: ask the driver to hand over received characters at once. Where there is no such flag, nothing
            happens.
        exclusive: whether the port is refused to others, and refused here while another program holds it.
        mark_errors: ask the system to mark characters with a parity or framing error and breaks, which are counted
            and reported with the data. Without it they look like any other character.
    """

    baud: int = 19_200
    parity: Parity = Parity.EVEN
    data_bits: int = 8
    stop_bits: int | None = None
    rs485: Rs485 = Rs485.OFF
    rts_on_send: bool = True
    rts_after_send: bool = False
    delay_before_send: float = 0.0
    delay_after_send: float = 0.0
    echo: Echo = Echo.OFF
    low_latency: bool = True
    exclusive: bool = True
    mark_errors: bool = True

    def __post_init__(self) -> None:
        if not LOWEST_BAUD <= self.baud <= HIGHEST_BAUD:
            raise ConfigError(f"must be {LOWEST_BAUD}…{HIGHEST_BAUD}, not {self.baud}", key="baud")
        if self.data_bits not in (7, 8):
            raise ConfigError(f"must be 7 or 8, not {self.data_bits}", key="data_bits")
        if self.stop_bits not in (None, 1, 2):
            raise ConfigError(f"must be 1 or 2, not {self.stop_bits}", key="stop_bits")
        for name in ("delay_before_send", "delay_after_send"):
            delay = getattr(self, name)
            if not 0.0 <= delay <= LONGEST_DIRECTION_DELAY:
                raise ConfigError(f"must be 0…{LONGEST_DIRECTION_DELAY:g} seconds, not {delay:g}", key=name)
            if delay and self.rs485 is Rs485.OFF:
                raise ConfigError("has no effect with rs485=off", key=name)
        if self.rts_on_send == self.rts_after_send:
            raise ConfigError("must differ from rts_on_send, or the direction is never switched", key="rts_after_send")

    @classmethod
    def from_options(cls, options: Mapping[str, object], *, binary: bool = True) -> Self:
        """The settings that options of a URL or keywords ask for.

        Args:
            options: names of the fields above, with values or their texts. Nothing else: an unknown name is refused.
            binary: whether the line carries bytes of any value, which need 8 data bits; a line of text takes 7 unless
                told otherwise.

        Raises:
            ConfigError: with the option at fault as its key. Nothing was opened.
        """
        chosen = dict(options)
        chosen.setdefault("data_bits", 8 if binary else 7)
        settings = build_parameters(cls, chosen)
        if binary and settings.data_bits != 8:
            raise ConfigError("must be 8: this framing sends bytes of any value", key="data_bits")
        return settings

    @property
    def stop_bits_on_line(self) -> int:
        """The stop bits that each character has, given or by rule."""
        return stop_bits_for(self.parity) if self.stop_bits is None else self.stop_bits

    @property
    def character_bits(self) -> int:
        """Bits of one character on the line: start, data, parity, stop."""
        return 1 + self.data_bits + (self.parity is not Parity.NONE) + self.stop_bits_on_line

    @property
    def character_time(self) -> float:
        """Seconds that one character takes."""
        return self.character_bits / self.baud

    @property
    def timing(self) -> SerialTiming:
        """Character time, t1.5 and t3.5."""
        return SerialTiming.of_line(
            self.baud, data_bits=self.data_bits, parity=self.parity, stop_bits=self.stop_bits_on_line
        )

    def __str__(self) -> str:
        """The short form that panels and data sheets use, as in ``19200 8E1``."""
        return f"{self.baud} {self.data_bits}{self.parity.name[0]}{self.stop_bits_on_line}"


__all__ = ["HIGHEST_BAUD", "LOWEST_BAUD", "Echo", "Parity", "Rs485", "SerialSettings"]
