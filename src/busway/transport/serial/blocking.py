"""A serial port for blocking programs: read, write, drain, close.

Knows `serialx` and the descriptor under it; knows no Modbus and starts no thread.

1. A wait may be given in microseconds and is kept as exactly as the system can: gaps between frames are short.
2. A port that vanishes ends every call with `LinkDown`; only `close` closes the descriptor.
"""

import contextlib
import os
import time
from typing import TYPE_CHECKING, Self

from ...errors import LinkDown
from ...extras import require
from ...options.ports import SerialSettings
from .device import OpenDevice, descriptor_of, opening_arguments
from .driver_counters import DriverCounters
from .errors import opening_failed, port_lost
from .ioctl import Ioctl, system_ioctl
from .ports import is_pseudo_terminal, resolve_port
from .rs485 import DriverDirection
from .waiting import wait_ready

if TYPE_CHECKING:
    from serialx import BaseSerial

READ_SIZE = 4096
"""Most bytes that one read returns: as many as the system's own buffer holds."""

STUCK_AFTER = 5.0
"""Seconds after which a port that accepts no more bytes counts as lost: its buffer empties within one second."""


class BlockingSerialPort:
    """An open serial port for blocking use by one thread at a time.

    Attributes:
        port: the name that it was opened with.
        path: the device path of that name.
        settings: baud rate, parity and the other settings of the line.
        pseudo_terminal: whether it is a pseudo-terminal, which passes bytes on at once and not with the line's speed.
    """

    def __init__(self, port: str, settings: SerialSettings, *, ioctl: Ioctl = system_ioctl) -> None:
        """Open the serial port.

        Args:
            port: a path, a name under by-id, or a USB identity (see `resolve_port`).
            settings: baud rate, parity and the other settings of the line.
            ioctl: function that calls the port's driver; a test may replace it.

        Raises:
            LinkDown: the port is missing, another program holds it (the message names it), or this user may not open
                it.
            ConfigError: it is no serial port, does not accept these settings, or `serialx` is not installed.
        """
        require("serialx", "a serial port")
        import serialx

        self.port = port
        self.path: str = resolve_port(port)
        self.settings = settings
        self.pseudo_terminal: bool = is_pseudo_terminal(self.path)
        self._serial: BaseSerial | None = None
        try:
            opened = serialx.serial_for_url(
                self.path, **opening_arguments(settings, pseudo_terminal=self.pseudo_terminal)
            )
        except (OSError, serialx.SerialException) as error:
            raise opening_failed(error, port=self.path, settings=str(settings)) from error
        try:
            opened.open()
            self._descriptor = descriptor_of(opened)
            self._device = OpenDevice(self._descriptor, settings, ioctl)
        except (OSError, serialx.SerialException) as error:
            opened.close()
            raise opening_failed(error, port=self.path, settings=str(settings)) from error
        except BaseException:
            opened.close()
            raise
        self._serial = opened

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def is_open(self) -> bool:
        """Whether the serial port is open."""
        return self._serial is not None

    @property
    def sent_at(self) -> float:
        """Time at which the last written character has left or will have left (``time.monotonic``); 0 at first."""
        return self._device.end_of_sending.until

    def fileno(self) -> int:
        """Return the file descriptor of the port. Raises `LinkDown` if it is closed or has none on this system."""
        self._opened()
        if self._descriptor is None:
            raise LinkDown(f"{self.path} has no descriptor to wait at on this system", kind="local")
        return self._descriptor

    def still_sending(self) -> float | None:
        """Return the earliest time at which the last written character can have left (``time.monotonic``).

        None if no written character is in the port any more, or if the system does not tell how many are. Raises
        `LinkDown` if the port vanished or is closed.
        """
        self._opened()
        try:
            held = self._device.held()
        except OSError as error:
            raise port_lost(error, port=self.path, sent=True) from error
        return self._device.end_of_sending.still_held(held, time.monotonic()) if held else None

    def read(self, timeout: float | None) -> tuple[bytes, int]:
        """Return received bytes; if there are none, wait for them for up to ``timeout`` seconds.

        Args:
            timeout: seconds; 0 does not wait, None waits for ever.

        Returns:
            The bytes, and how many of them the port marked as damaged. No bytes when the time is over, or if only the
            beginning of a damage mark has come so far.

        Raises:
            LinkDown: the port vanished, or is closed.
        """
        opened = self._opened()
        try:
            if self._descriptor is None:
                buffer = bytearray(READ_SIZE)
                count = opened.readinto(buffer, timeout=timeout)
                data = bytes(buffer[:count])
            else:
                if not wait_ready([self._descriptor], [], timeout):
                    return b"", 0
                data = os.read(self._descriptor, READ_SIZE)
                if not data:
                    raise port_lost(None, port=self.path)
        except BlockingIOError:
            return b"", 0
        except LinkDown:
            raise
        except OSError as error:
            raise port_lost(error, port=self.path) from error
        received = self._device.unmarked(data)
        return received.data, received.errors

    def write(self, data: bytes) -> float:
        """Write bytes to the serial port.

        Returns as soon as the port has accepted them, while they are still being sent. If this program switches RTS, it
        returns after they have left the line, because RTS has to be switched back then.

        Returns:
            When the last character will have left (``time.monotonic``).

        Raises:
            LinkDown: the port vanished or is closed, or accepted no bytes for 5 seconds; bytes may have gone out.
        """
        opened = self._opened()
        by_hand = self._device.direction is DriverDirection.RTS
        try:
            if by_hand:
                self._device.turn_to_sending()
                _sleep_until(time.monotonic() + self.settings.delay_before_send)
            started = time.monotonic()
            if self._descriptor is None:
                opened.write(data)
            else:
                self._write_whole(self._descriptor, data)
            until = self._device.end_of_sending.written(len(data), started)
            if by_hand:
                until = self.drain()
                _sleep_until(until + self.settings.delay_after_send)
                self._device.turn_to_receiving()
        except BaseException as error:
            if by_hand:  # at the sending level it would keep all others from sending
                with contextlib.suppress(OSError):
                    self._device.turn_to_receiving()
            if isinstance(error, OSError) and not isinstance(error, LinkDown):
                raise port_lost(error, port=self.path, sent=True) from error
            raise
        return until

    def drain(self, timeout: float | None = None) -> float:
        """Wait until the last written character has left the serial port.

        Args:
            timeout: seconds; None waits for ever, also for a driver that is stuck.

        Returns:
            When it left (``time.monotonic``).

        Raises:
            LinkDown: the port vanished or is closed, or the time is over; the bytes may have gone out.
        """
        self._opened()
        end_of_sending = self._device.end_of_sending
        limit = None if timeout is None else time.monotonic() + timeout
        try:
            while True:
                now = time.monotonic()
                if now >= end_of_sending.until:
                    held = self._device.held()
                    if not held:
                        return end_of_sending.until
                    end_of_sending.still_held(held, now)
                if limit is not None and now >= limit:
                    raise LinkDown(f"{self.path} did not send within {timeout:g} s", kind="timeout", sent=True)
                _sleep_until(end_of_sending.until if limit is None else min(end_of_sending.until, limit))
        except LinkDown:
            raise
        except OSError as error:
            raise port_lost(error, port=self.path, sent=True) from error

    def counters(self) -> DriverCounters | None:
        """Return the error counters of the port's driver; None if it keeps none.

        Raises `LinkDown` if the port vanished or is closed.
        """
        self._opened()
        try:
            return self._device.counters()
        except OSError as error:
            raise port_lost(error, port=self.path) from error

    def close(self) -> None:
        """Close the serial port. A second call does nothing."""
        opened, self._serial = self._serial, None
        if opened is None:
            return
        try:
            self._device.release()
        finally:
            with contextlib.suppress(OSError):  # the descriptor is closed all the same; the port had vanished
                opened.close()

    def _write_whole(self, descriptor: int, data: bytes) -> None:
        left = memoryview(data)
        while left:
            try:
                left = left[os.write(descriptor, left) :]
            except BlockingIOError:
                if not wait_ready([], [descriptor], STUCK_AFTER):
                    raise LinkDown(
                        f"{self.path} has taken no bytes for {STUCK_AFTER:g} s", kind="timeout", sent=True
                    ) from None

    def _opened(self) -> "BaseSerial":
        if self._serial is None:
            raise LinkDown(f"{self.path} is closed", kind="closed")
        return self._serial


def _sleep_until(when: float) -> None:
    pause = when - time.monotonic()
    if pause > 0:
        time.sleep(pause)
