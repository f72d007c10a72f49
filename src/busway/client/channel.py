"""Interfaces of a blocking link's connection.

Knows names and their meaning; knows no transport and no conversation.
"""

from typing import Protocol


class LinkEnd(Protocol):
    """The link's end of a connection under asyncio, for transports that are no `asyncio.Transport`."""

    def arrived(self, data: bytes) -> None:
        """Process received bytes."""

    def arrived_damaged(self, data: bytes, overrun: bool) -> None:
        """Process received bytes with errors that the port marked, or after which it lost some."""

    def connection_lost(self, exc: Exception | None) -> None:
        """Handle the end of the connection."""


class Channel(Protocol):
    """A connection of a blocking link: a non-blocking socket, or an object that behaves like one."""

    def fileno(self) -> int:
        """The descriptor, to wait for readiness."""

    def recv_into(self, buffer: bytearray, /) -> int:
        """Receive bytes; 0 if the peer closed. Raises `BlockingIOError` if there are none, and `OSError`."""

    def send(self, data: bytes, /) -> int:
        """Send as many bytes as are taken, and return their number. Raises `BlockingIOError`, `OSError`."""

    def close(self) -> None:
        """Close the connection."""
