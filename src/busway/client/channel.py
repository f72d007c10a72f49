"""Interfaces between the driver of a link and its connection, for asyncio transports and non-blocking sockets.

Knows names and their meaning; knows no transport and no conversation.
"""

from typing import Protocol


class LinkEnd(Protocol):
    """Interface of the object to which a serial port or UDP socket of an asyncio link reports events.

    The events are received bytes and the end of the connection.
    """

    def arrived(self, data: bytes) -> None:
        """Process bytes that were received without errors."""

    def arrived_damaged(self, data: bytes, overrun: bool) -> None:
        """Process received bytes of which some have parity or framing errors, or between which some were lost.

        ``overrun``: whether the driver of the port reported lost characters.
        """

    def connection_lost(self, exc: Exception | None) -> None:
        """Handle the end of the connection; ``exc`` is the error that ended it, None if there was none."""


class Channel(Protocol):
    """The connection of a blocking link: a non-blocking socket, or a serial port that behaves like one."""

    def fileno(self) -> int:
        """Return the file descriptor of the socket or port, for waiting until it is ready."""

    def recv_into(self, buffer: bytearray, /) -> int:
        """Receive bytes into ``buffer`` and return their number; 0: the peer closed the connection.

        Raises:
            BlockingIOError: no bytes have been received.
            OSError: the connection failed.
        """

    def send(self, data: bytes, /) -> int:
        """Send as many bytes as the system accepts at once, and return their number.

        Raises:
            BlockingIOError: none is accepted now.
            OSError: the connection failed.
        """

    def close(self) -> None:
        """Close the socket or port."""
