"""When RTS is switched on an RS-485 port under asyncio: to sending before a frame, and back after its last character.

Knows the delays around a switch (``delay_before_send``, ``delay_after_send``) and asyncio; the open port sets the
signal (`rs485`). In blocking programs ``BlockingSerialPort.write`` waits and switches by itself.

1. RTS goes back only when the driver holds no character any more, and ``delay_after_send`` is over.
2. A frame that is written before that is sent at once: RTS stays at sending.
3. A port that is closed while it sends is switched back: at the sending level it would keep all others from sending.
"""

import asyncio
import contextlib
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

from ...options.ports import SerialSettings
from .device import OpenDevice
from .errors import port_lost

if TYPE_CHECKING:
    from serialx import BaseSerialTransport

SETTLING_POLL = 0.0005
"""Seconds between two checks whether the last character has left, if RTS must be switched back at once."""


class RtsSwitchingSender:
    """Sends frames on an RS-485 port: switches RTS to sending before each frame and back after it, with delays.

    Args:
        loop: the event loop of the connection.
        transport: where the bytes are written.
        device: the open port, whose direction is switched.
        settings: the settings of the line, with ``delay_before_send`` and ``delay_after_send``.
        gone: called with the error of a port that vanishes while the loop sends or switches.
    """

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        transport: "BaseSerialTransport",
        device: OpenDevice,
        settings: SerialSettings,
        gone: Callable[[OSError], None],
    ) -> None:
        self._loop = loop
        self._transport = transport
        self._device = device
        self._settings = settings
        self._gone = gone
        self._outbox = bytearray()
        self._timer: asyncio.TimerHandle | None = None
        self._sending = False

    @property
    def waiting(self) -> int:
        """Number of bytes not sent yet because the delay before sending is not over."""
        return len(self._outbox)

    def write(self, data: bytes, path: str) -> float:
        """Switch RTS to sending, unless it is, and write bytes; they wait until the delay before sending is over.

        Returns:
            When the last character will have left (``time.monotonic``).

        Raises:
            LinkDown: the port, which has the path ``path``, vanished; none of these bytes were sent.
        """
        now = time.monotonic()
        delay = 0.0
        try:
            if not self._sending:
                self._device.turn_to_sending()
                self._sending = True
                delay = self._settings.delay_before_send
                self._timer = self._loop.call_later(delay, self._send)
                if delay:
                    self._outbox += data
                else:
                    self._transport.write(data)
            elif self._outbox:
                self._outbox += data
            else:
                self._transport.write(data)
        except OSError as error:
            raise port_lost(error, port=path) from error
        return self._device.end_of_sending.written(len(data), now + delay)

    def _send(self) -> None:
        """Write the waiting bytes to the port, when the delay before sending is over."""
        data = bytes(self._outbox)
        self._outbox.clear()
        try:
            self._transport.write(data)
        except OSError as error:
            self._gone(error)
            return
        self._look_again(self._device.end_of_sending.still_held(len(data), time.monotonic()))

    def _look_again(self, when: float) -> None:
        self._timer = self._loop.call_later(max(when - time.monotonic(), SETTLING_POLL), self._look)

    def _look(self) -> None:
        now = time.monotonic()
        try:
            until = self._device.end_of_sending.still_held(
                self._transport.get_write_buffer_size() + self._device.held(), now
            )
            if until > now:
                self._look_again(until)
                return
            back_at = until + self._settings.delay_after_send
            if back_at > now:
                self._look_again(back_at)
                return
            self._device.turn_to_receiving()
        except OSError as error:
            self._gone(error)
            return
        self._sending = False

    def stop(self) -> None:
        """Stop sending, because the port is closed; RTS is switched back if a frame was on its way."""
        if self._timer is not None:
            self._timer.cancel()
        if self._sending:
            self._sending = False
            with contextlib.suppress(OSError):  # the port has vanished
                self._device.turn_to_receiving()
