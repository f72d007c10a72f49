"""Options of a serial port: its line settings, and how it is opened.

Knows the characters of a line and the wires that switch its direction; knows no port and no Modbus.

1. Even parity is the default (Serial Line V1.02 §2.5.1). Without the option for stop bits there is one with parity and
   two without, so that a character always has the same length.
2. A setting that has no effect together with the others is refused: users would believe that it works.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, ClassVar, Self

from ..errors import ConfigError
from ..framing.character_times import Parity, SerialTiming, stop_bits_for
from ..framing.echo import Echo
from ..values.caseless_enum import CaselessEnum
from .declaration import Alias, ByFraming, On, OneOf, Range, Strict, check
from .text import build_parameters

LOWEST_BAUD = 50
HIGHEST_BAUD = 12_000_000
"""The highest rate of the fastest USB adapters; the specification asks for 1200 to 115 200 and permits more."""

LONGEST_DIRECTION_DELAY = 1
"""Most seconds to wait at a switch of direction; the kernel's own mode permits 0.1, and refuses more at the opening."""
_DIRECTION_DELAY = Range(0, LONGEST_DIRECTION_DELAY, "seconds")


class Rs485(CaselessEnum):
    """Values of the option ``rs485``: what switches the direction of an RS-485 driver.

    Attributes:
        OFF: nothing in this computer: the adapter does it itself, or the line is RS-232 or 4-wire.
        KERNEL: the kernel's driver of the port, in its RS-485 mode, which is exact.
        RTS: this program, by the RTS wire; delays of the operating system are added.
        AUTOMATIC: the kernel if the port has that mode, RTS otherwise.
    """

    OFF = "off"
    KERNEL = "kernel"
    RTS = "rts"
    AUTOMATIC = "automatic"


@dataclass(frozen=True, slots=True, kw_only=True)
class SerialSettings:
    """The settings of one serial line (Serial Line V1.02 §2.5, §3.2)."""

    on: ClassVar[On] = On("serial")

    baud: Annotated[int, Range(LOWEST_BAUD, HIGHEST_BAUD), Alias("baudrate"), "bits per second."] = 19_200
    parity: Annotated[Parity, "even, odd or none."] = Parity.EVEN
    data_bits: Annotated[
        int, OneOf((7, 8)), Alias("bytesize"), ByFraming({"rtu": 8, "ascii": 7}), "bits of each character."
    ] = 8
    stop_bits: Annotated[
        int | None, OneOf((1, 2)), Alias("stopbits"), "None follows the rule (one with parity, two without)."
    ] = None
    rs485: Annotated[Rs485, "who switches the driver's direction."] = Rs485.OFF
    rts_on_send: Annotated[bool, "level of RTS while sending; it must differ from the level otherwise."] = True
    rts_after_send: Annotated[bool, "level of RTS while not sending."] = False
    delay_before_send: Annotated[float, _DIRECTION_DELAY, "seconds from switching to the first character."] = 0.0
    delay_after_send: Annotated[float, _DIRECTION_DELAY, "seconds from the last character to switching back."] = 0.0
    echo: Annotated[
        Echo,
        "whether the port receives what it sends: `on` removes that, `automatic` finds out from the first frames.",
    ] = Echo.OFF
    low_latency: Annotated[
        bool,
        "ask the driver to hand over received characters at once. Where there is no such flag, nothing happens.",
    ] = True
    exclusive: Annotated[
        bool, "whether the port is refused to others, and refused here while another program holds it."
    ] = True
    mark_errors: Annotated[
        bool,
        Strict("S14", True),
        "ask the system to mark characters with a parity or framing error and breaks, which are counted and reported",
        "with the data. Without it they look like any other character.",
    ] = True

    def __post_init__(self) -> None:
        check(self)
        for name in ("delay_before_send", "delay_after_send"):
            if getattr(self, name) and self.rs485 is Rs485.OFF:
                raise ConfigError("has no effect with rs485=off", key=name)
        if self.rts_on_send == self.rts_after_send:
            raise ConfigError("must differ from rts_on_send, or the direction is never switched", key="rts_after_send")

    @classmethod
    def from_options(cls, options: Mapping[str, object], *, binary: bool = True) -> Self:
        """Build the settings of a serial line from options of a URL or keywords.

        Args:
            options: values of the fields of this class, or their texts, by name; unknown names are refused.
            binary: whether the line carries bytes of any value, which need 8 data bits. If not (ASCII), 7 is the
                default.

        Raises:
            ConfigError: an option is invalid; the error has its name as key. Nothing was opened.
        """
        settings = build_parameters(cls, options, framing="rtu" if binary else "ascii")
        if binary and settings.data_bits != 8:
            raise ConfigError("must be 8: this framing sends bytes of any value", key="data_bits")
        return settings

    @property
    def stop_bits_on_line(self) -> int:
        """Stop bits of each character: ``stop_bits``, or if that is None one with parity and two without."""
        return stop_bits_for(self.parity) if self.stop_bits is None else self.stop_bits

    @property
    def character_bits(self) -> int:
        """Bits of one character on the line: start, data, parity, stop."""
        return 1 + self.data_bits + (self.parity is not Parity.NONE) + self.stop_bits_on_line

    @property
    def character_time(self) -> float:
        """Seconds that one character takes on the line."""
        return self.character_bits / self.baud

    @property
    def timing(self) -> SerialTiming:
        """Character time, t1.5 and t3.5 of a line with these settings, in seconds."""
        return SerialTiming.of_line(
            self.baud, data_bits=self.data_bits, parity=self.parity, stop_bits=self.stop_bits_on_line
        )

    def __str__(self) -> str:
        """The settings in the short form of data sheets, such as ``19200 8E1``."""
        return f"{self.baud} {self.data_bits}{self.parity.name[0]}{self.stop_bits_on_line}"


@dataclass(frozen=True, slots=True)
class OpeningParameters:
    """Options of opening a serial port, and of waiting for one that is missing."""

    on: ClassVar[On] = On("serial")

    port_wait: Annotated[
        float,
        Range(0, 3600, "seconds"),
        On("client"),
        "seconds that a request waits for a port that is not there; then it fails, and requests fail at once until the",
        "port has come.",
    ] = 1.0
    reopen_first: Annotated[
        float,
        Range(0.01, 60, "seconds"),
        "seconds until the second attempt to open a port that is not there; the pause doubles each time.",
    ] = 0.1
    reopen_most: Annotated[
        float, Range(0.01, 3600, "seconds"), "seconds that no pause between attempts to open a port is longer than."
    ] = 2.0
    precise_timing: Annotated[
        bool,
        On("client", "server"),
        "whether the last moments before a frame are waited for in a loop, which keeps a processor busy: 0.3 ms, or",
        "1.5 ms where the system has no timers that are exact to microseconds.",
    ] = False

    def __post_init__(self) -> None:
        check(self)
        if self.reopen_most < self.reopen_first:
            raise ConfigError(
                f"must be {self.reopen_first:g}…3600 seconds, not {self.reopen_most:g}", key="reopen_most"
            )


__all__ = ["HIGHEST_BAUD", "LOWEST_BAUD", "Echo", "OpeningParameters", "Parity", "Rs485", "SerialSettings"]
