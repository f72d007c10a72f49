"""Interfaces of a blocking link's connection.

Knows names and their meaning; knows no transport and no conversation.
"""

from typing import Protocol


class LinkEnd(Protocol):
    """The link's end of a connection under asyncio, for transports that are no `asyncio.Transport`."""

    def arrived(self, data: bytes) -> None:
        """Bytes have come."""

    def arrived_damaged(self, data: bytes, overrun: bool) -> None:
        """Bytes have come among which the port marks errors, or after which it lost some."""

    def connection_lost(self, exc: Exception | None) -> None:
        """The connection has ended."""


class Channel(Protocol):
    """A connection of a blocking link: a non-blocking socket, or what behaves like one."""

    def fileno(self) -> int:
        """The descriptor to wait at."""

    def recv_into(self, buffer: bytearray, /) -> int:
        """Receive bytes; 0 if the peer closed. Raises `BlockingIOError` if there are none, and `OSError`."""

    def send(self, data: bytes, /) -> int:
        """Hand over as many bytes as can be taken. Raises `BlockingIOError`, `OSError`."""

    def close(self) -> None:
        """Close it."""
