"""Interfaces between a link and its connection: asyncio transports and non-blocking channels.

Knows names and their meaning; knows no transport and no conversation.
"""

from typing import Protocol


class LinkEnd(Protocol):
    """The link's side of a connection under asyncio, for transports that are no `asyncio.Transport`."""

    def arrived(self, data: bytes) -> None:
        """Process bytes received on the connection."""

    def arrived_damaged(self, data: bytes, overrun: bool) -> None:
        """Process received bytes with parity or framing errors, or after which the port lost some."""

    def connection_lost(self, exc: Exception | None) -> None:
        """Handle the end of the connection."""


class Channel(Protocol):
    """A connection of a blocking link: a non-blocking socket, or an object that behaves like one."""

    def fileno(self) -> int:
        """The file descriptor of the channel, to wait for readiness."""

    def recv_into(self, buffer: bytearray, /) -> int:
        """Receive bytes into a buffer; 0 if the peer closed. Raises `BlockingIOError` if there are none, and
        `OSError`.
        """

    def send(self, data: bytes, /) -> int:
        """Send as many bytes as the channel accepts, and return their number. Raises `BlockingIOError`, `OSError`."""

    def close(self) -> None:
        """Close the connection of the channel."""
