"""A serial port under asyncio: received bytes are passed to a function.

Knows asyncio and `serialx`; knows no Modbus.

1. Received bytes go to one callback, together with how many of them the port marked as damaged.
2. ``write`` does not wait. It returns the time at which the last character will have left, because silences on the line
   are measured from then.
3. If a port vanishes, the callback ``lost`` is called once, and the descriptor is closed. `open_when_there` can wait
   for the port to come back.
"""

import asyncio
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Self, cast

from ...errors import LinkDown
from ...extras import require
from ...options.ports import SerialSettings
from .device import OpenDevice, descriptor_of, opening_arguments
from .driver_counters import DriverCounters
from .errors import opening_failed, port_lost
from .ioctl import Ioctl, system_ioctl
from .ports import is_pseudo_terminal, resolve_port
from .rs485 import DriverDirection
from .rts_switching import RtsSwitchingSender

if TYPE_CHECKING:
    from serialx import BaseSerialTransport


class SerialConnection:
    """An open serial port, used from the event loop that opened it. Created by `open`.

    Attributes:
        port: the name that it was opened with.
        path: the device path of that name.
        settings: baud rate, parity and the other settings of the line.
        pseudo_terminal: whether it is a pseudo-terminal, which passes bytes on at once and not with the line's speed.
    """

    def __init__(
        self,
        port: str,
        path: str,
        settings: SerialSettings,
        received: Callable[[bytes, int], None],
        lost: Callable[[LinkDown], None],
        ioctl: Ioctl,
    ) -> None:
        self.port = port
        self.path = path
        self.settings = settings
        self.pseudo_terminal: bool = is_pseudo_terminal(path)
        self._received = received
        self._lost = lost
        self._ioctl = ioctl
        self._loop = asyncio.get_running_loop()
        self._transport: BaseSerialTransport | None = None
        self._device: OpenDevice | None = None
        self._sender: RtsSwitchingSender | None = None
        self._closed = self._loop.create_future()
        self._told = True  # nothing to tell before it is open

    @classmethod
    async def open(
        cls,
        port: str,
        settings: SerialSettings,
        *,
        received: Callable[[bytes, int], None],
        lost: Callable[[LinkDown], None],
        ioctl: Ioctl = system_ioctl,
    ) -> Self:
        """Open a serial port under asyncio.

        Args:
            port: a path, a name under by-id, or a USB identity (see `resolve_port`).
            settings: baud rate, parity and the other settings of the line.
            received: called with received bytes, and how many of them the port marked as damaged.
            lost: called once if the port vanishes; not after `close`.
            ioctl: function that calls the port's driver; a test may replace it.

        Raises:
            LinkDown: the port is missing, another program holds it (the message names it), or this user may not open
                it.
            ConfigError: it is no serial port, does not accept these settings, or `serialx` is not installed.
        """
        require("serialx", "a serial port")
        import serialx

        loop = asyncio.get_running_loop()
        path = await loop.run_in_executor(None, resolve_port, port)
        connection = cls(port, path, settings, received, lost, ioctl)
        try:
            await serialx.create_serial_connection(
                loop,
                lambda: _Events(connection),
                path,
                **opening_arguments(settings, pseudo_terminal=connection.pseudo_terminal),
            )
        except LinkDown:
            raise
        except (OSError, serialx.SerialException) as error:
            # Finding the holder reads many small files.
            raise await loop.run_in_executor(None, _opening_failed, error, path, settings) from error
        return connection

    @property
    def is_open(self) -> bool:
        """Whether the serial port is open."""
        return self._device is not None

    @property
    def sent_at(self) -> float:
        """Time at which the last written character has left or will have left the port (``time.monotonic``).

        0 before the first, and when the port is closed.
        """
        if self._device is None:
            return 0.0
        return self._device.end_of_sending.until

    def write(self, data: bytes) -> float:
        """Write bytes to the serial port, without waiting until they are sent.

        Returns:
            When the last character will have left, computed from the character time (``time.monotonic``). If this
            program switches RTS, the delay before sending is included.

        Raises:
            LinkDown: the port vanished or is closed; none of these bytes were sent.
        """
        transport, device = self._opened()
        if self._sender is not None:
            return self._sender.write(data, self.path)
        now = time.monotonic()
        try:
            transport.write(data)
        except OSError as error:
            raise port_lost(error, port=self.path) from error
        return device.end_of_sending.written(len(data), now)

    def held(self) -> int:
        """Return how many written characters have not left the port yet, as far as the system tells.

        Raises `LinkDown` if the port vanished or is closed.
        """
        transport, device = self._opened()
        waiting = transport.get_write_buffer_size()
        if self._sender is not None:
            waiting += self._sender.waiting
        try:
            return waiting + device.held()
        except OSError as error:
            raise port_lost(error, port=self.path, sent=True) from error

    def still_sending(self) -> float | None:
        """Return the earliest time at which the last written character can have left (``time.monotonic``).

        None if no written character is in the port any more, or if the system does not tell how many are. Raises
        `LinkDown` if the port vanished or is closed.
        """
        held = self.held()
        _, device = self._opened()
        return device.end_of_sending.still_held(held, time.monotonic()) if held else None

    async def drain(self) -> float:
        """Wait until the last written character has left. Returns the time of that (``time.monotonic``).

        Raises:
            LinkDown: the port is closed, or vanished meanwhile; the bytes may have gone out.
        """
        while True:
            _, device = self._opened()
            now = time.monotonic()
            if now >= device.end_of_sending.until:
                held = self.held()
                if not held:
                    return device.end_of_sending.until
                device.end_of_sending.still_held(held, now)
            await asyncio.sleep(max(device.end_of_sending.until - now, 0.0))

    def counters(self) -> DriverCounters | None:
        """Return the error counters of the port's driver; None if it keeps none.

        Raises `LinkDown` if the port vanished or is closed.
        """
        _, device = self._opened()
        try:
            return device.counters()
        except OSError as error:
            raise port_lost(error, port=self.path) from error

    def close(self) -> None:
        """Close the serial port; unsent bytes are dropped. A second call does nothing."""
        self._told = True
        if self._sender is not None:
            self._sender.stop()
        if self._device is not None:
            self._device.release()
            self._device = None
        if self._transport is not None:
            self._transport.abort()

    async def wait_closed(self) -> None:
        """Wait until the descriptor of the port is closed, after `close` or after the port vanished."""
        await asyncio.shield(self._closed)

    def _opened(self) -> "tuple[BaseSerialTransport, OpenDevice]":
        if self._transport is None or self._device is None:
            raise LinkDown(f"{self.path} is closed", kind="closed")
        return self._transport, self._device

    # What `serialx` tells, through `_Events`.

    def _made(self, transport: "BaseSerialTransport") -> None:
        device = OpenDevice(descriptor_of(transport.serial), self.settings, self._ioctl)
        self._transport = transport
        self._device = device
        self._told = False
        if device.direction is DriverDirection.RTS:
            self._sender = RtsSwitchingSender(self._loop, transport, device, self.settings, self._gone)

    def _arrived(self, data: bytes) -> None:
        if self._device is None:
            return
        received = self._device.unmarked(data)
        if received.data:
            self._received(received.data, received.errors)

    def _ended(self, error: Exception | None) -> None:
        if self._device is not None:
            self._device.forget()
            self._device = None
        if self._sender is not None:
            self._sender.stop()
        self._transport = None
        if not self._closed.done():
            self._closed.set_result(None)
        if not self._told:
            self._told = True
            self._lost(port_lost(error, port=self.path))

    def _gone(self, error: OSError) -> None:
        """Handle the loss of the port, which its driver has reported."""
        if self._told:
            return
        self.close()
        self._lost(port_lost(error, port=self.path, sent=True))


class _Events(asyncio.Protocol):
    """The asyncio protocol of a serial port: passes received bytes, and the port's end, to a `SerialConnection`."""

    def __init__(self, connection: SerialConnection) -> None:
        self._connection = connection

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._connection._made(cast("BaseSerialTransport", transport))

    def data_received(self, data: bytes) -> None:
        self._connection._arrived(data)

    def connection_lost(self, exc: Exception | None) -> None:
        self._connection._ended(exc)


def _opening_failed(error: Exception, path: str, settings: SerialSettings) -> Exception:
    return opening_failed(error, port=path, settings=str(settings))
