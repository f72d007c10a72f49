"""Waits of a blocking link until its socket or serial port is ready, or a time is over.

Knows descriptors; knows no session.
"""

import select
from typing import Final

from ..transport.serial.waiting import wait_ready
from .channel import Channel

_LONGEST_WAIT: Final = 0.25
"""Longest single wait at a serial port, in seconds: closing the port does not wake up a thread that waits at it."""


class PortReadiness:
    """Waits until a serial port is ready, for a caller that needs exact timing.

    A wait for a time ends ``spin`` seconds early; the caller waits for the rest in a busy loop.
    """

    def __init__(self, spin: float) -> None:
        self._spin = spin

    def wait(self, connection: Channel, seconds: float, writes: bool) -> bool:
        """Wait until bytes can be received, or with ``writes`` also until bytes can be sent. Returns whether they can.

        Returns True also if the port was lost: then the next call on it raises. Returns False if the time was over
        first, or if another thread closed the port. The wait ends ``spin`` seconds before ``seconds`` are over, and
        after 0.25 seconds at the latest.
        """
        if seconds > self._spin:
            seconds -= self._spin
        try:
            descriptor = connection.fileno()
            return bool(wait_ready([descriptor], [descriptor] if writes else [], min(seconds, _LONGEST_WAIT)))
        except (OSError, ValueError):
            return False  # another thread closed the port while this one was about to wait


class SocketReadiness:
    """Waits until one socket is ready: by ``poll``, or by ``select`` on systems that lack it.

    ``poll`` is preferred because it works with any number of open descriptors.
    """

    def __init__(self, connection: Channel) -> None:
        self._poll = select.poll() if hasattr(select, "poll") else None
        self._writes = False
        if self._poll is not None:
            self._poll.register(connection, select.POLLIN)

    def wait(self, connection: Channel, seconds: float, writes: bool) -> bool:
        """Wait until bytes can be received, or with ``writes`` also until bytes can be sent. Returns whether they can.

        Returns True also if the connection has ended or failed: then the next call on it raises. Returns False if
        ``seconds`` were over first, or if another thread closed the socket.
        """
        try:
            if self._poll is None:
                readable, writable, _ = select.select([connection], [connection] if writes else [], [], seconds)
                return bool(readable or writable)
            if writes != self._writes:
                self._writes = writes
                self._poll.modify(connection, select.POLLIN | (select.POLLOUT if writes else 0))
            return bool(self._poll.poll(seconds * 1000 + 0.5))
        except (OSError, ValueError):
            return False  # another thread closed the socket while this one was about to wait
