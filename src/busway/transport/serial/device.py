"""An open serial port apart from reading and writing: settings, damage marks, counters, RS-485 direction, release.

Knows what must be done to every port, whichever way it is used; `connection` and `blocking` move the bytes. Where
ports have no descriptors (Windows) `serialx` does all that is possible, and other functions report that they are not
available.
"""

import os
from typing import TYPE_CHECKING, Any

from ...options.ports import Parity, Rs485, SerialSettings
from .driver_counters import DriverCounters, read_counters
from .end_of_sending import EndOfSending, characters_held
from .ioctl import Ioctl, system_ioctl
from .lock import admit_others, refuse_others
from .marks import MarkDecoder, UnmarkedBytes, switch_marks_on
from .rs485 import DriverDirection, set_rts, settle_direction

if TYPE_CHECKING:
    from serialx import BaseSerial

_PARITY_LETTERS = {Parity.NONE: "N", Parity.EVEN: "E", Parity.ODD: "O"}


def opening_arguments(settings: SerialSettings, *, pseudo_terminal: bool) -> dict[str, Any]:
    """Return the keyword arguments with which `serialx` opens a port with these settings.

    A pseudo-terminal refuses parity and 7 data bits, so it is opened without them; the settings then only determine how
    long a character takes.
    """
    from serialx import PinState

    if settings.rs485 is Rs485.OFF:
        rts = PinState.HIGH  # many adapters feed themselves from it
    elif settings.rs485 is Rs485.KERNEL:
        rts = PinState.UNDEFINED  # the driver's own
    else:
        rts = PinState.convert(settings.rts_after_send)
    return {
        "baudrate": settings.baud,
        "parity": "N" if pseudo_terminal else _PARITY_LETTERS[settings.parity],
        "byte_size": 8 if pseudo_terminal else settings.data_bits,
        "stopbits": settings.stop_bits_on_line,
        "exclusive": settings.exclusive,
        "low_latency": settings.low_latency,
        "rts_on_open": rts,
    }


def descriptor_of(opened: "BaseSerial") -> int | None:
    """Return the file descriptor of an open serial port; None on systems whose ports have none."""
    return opened.fileno() if os.name == "posix" else None


class OpenDevice:
    """An open serial port without reading and writing: settings, RS-485 direction, counters, damage marks.

    Attributes:
        direction: what switches an RS-485 port between sending and receiving: nothing, its driver, or this program.
        end_of_sending: computes when written characters leave the port.
    """

    __slots__ = ("_descriptor", "_ioctl", "_marks", "_settings", "direction", "end_of_sending")

    def __init__(self, descriptor: int | None, settings: SerialSettings, ioctl: Ioctl = system_ioctl) -> None:
        """Lock a port that `serialx` has just opened, and set up its direction and damage marks, as the settings say.

        ``descriptor`` is None on systems whose ports have none; then nothing is locked or set up.

        Raises:
            OSError: the port is gone.
            ConfigError: the port does not have the RS-485 mode, delays or RTS levels that the settings ask for.
        """
        self._descriptor = descriptor
        self._settings = settings
        self._ioctl = ioctl
        self._marks: MarkDecoder | None = None
        self.direction: DriverDirection = DriverDirection.NONE
        self.end_of_sending: EndOfSending = EndOfSending(settings.character_time)
        if descriptor is None:
            return
        if settings.exclusive:
            refuse_others(descriptor, ioctl)
        self.direction = settle_direction(descriptor, settings, ioctl)
        if settings.mark_errors:
            switch_marks_on(descriptor)
            self._marks = MarkDecoder()

    def unmarked(self, data: bytes) -> UnmarkedBytes:
        """Return received bytes without the system's damage marks, and how many of the bytes were damaged."""
        return self._marks.feed(data) if self._marks is not None else UnmarkedBytes(data, 0)

    def held(self) -> int:
        """Return how many written characters are still in the port, as its driver tells; 0 without a descriptor.

        Raises `OSError` if the port is gone.
        """
        return 0 if self._descriptor is None else characters_held(self._descriptor, self._ioctl)

    def counters(self) -> DriverCounters | None:
        """Return the error counters of the driver; None if it keeps none. Raises `OSError` if the port is gone."""
        return None if self._descriptor is None else read_counters(self._descriptor, self._ioctl)

    def turn_to_sending(self) -> None:
        """Set the port's RTS signal to the level for sending on RS-485. Raises `OSError` if the port is gone."""
        if self._descriptor is not None:
            set_rts(self._descriptor, self._settings.rts_on_send, self._ioctl)

    def turn_to_receiving(self) -> None:
        """Set the port's RTS signal to the level for receiving on RS-485. Raises `OSError` if the port is gone."""
        if self._descriptor is not None:
            set_rts(self._descriptor, self._settings.rts_after_send, self._ioctl)

    def release(self) -> None:
        """Unlock the port for other programs, and stop using its descriptor.

        Call it before the descriptor is closed.
        """
        if self._descriptor is not None and self._settings.exclusive:
            admit_others(self._descriptor, self._ioctl)
        self.forget()

    def forget(self) -> None:
        """Stop using the port's descriptor, because it was closed: its number may soon belong to another file."""
        self._descriptor = None
