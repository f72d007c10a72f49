"""Interfaces between the driver of a link and its connection, for asyncio transports and non-blocking sockets.

Knows names and their meaning; knows no transport and no conversation.
"""

from typing import Protocol


class LinkEnd(Protocol):
    """Interface of the asyncio driver as a serial port calls it when something happens."""

    def arrived(self, data: bytes) -> None:
        """Process bytes that the serial port has received."""

    def arrived_damaged(self, data: bytes, overrun: bool) -> None:
        """Process received bytes among which some have parity or framing errors or were lost by the port."""

    def connection_lost(self, exc: Exception | None) -> None:
        """Handle the end of the connection, with its error if there was one."""


class Channel(Protocol):
    """The connection of a blocking link: a non-blocking socket, or a serial port that behaves like one."""

    def fileno(self) -> int:
        """Return the file descriptor of the socket or port, for waiting until it is ready."""

    def recv_into(self, buffer: bytearray, /) -> int:
        """Receive bytes into a buffer and return their number, 0 at the end. Raises `BlockingIOError`, `OSError`."""

    def send(self, data: bytes, /) -> int:
        """Send as many bytes as the socket accepts and return their number. Raises `BlockingIOError`, `OSError`."""

    def close(self) -> None:
        """Close the socket or port."""
