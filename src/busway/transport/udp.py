"""UDP sockets of clients, for asyncio and for blocking links.

Knows sockets; knows no Modbus. The user of a socket says which datagrams are whole; others are dropped and counted.

1. A lost datagram is not sent again: callers that wait for an answer have a timeout.
2. An ICMP error (no listener at the other end) ends nothing: the next datagram may be answered, and any host can send
   such a message.
3. A client takes datagrams from the address it sends to alone.
"""

import asyncio
import contextlib
import socket
from collections.abc import Callable
from typing import Any, cast

from ..options.sockets import SocketParameters
from .tcp import link_down, set_buffers

MAX_DATAGRAM = 2048
"""More than any frame: what is longer is cut by the system, and is then no whole frame."""


class DatagramConnection(asyncio.DatagramProtocol):
    """A client's UDP socket under asyncio, with the methods of a stream transport. Created by `open_datagram`.

    Attributes:
        dropped: datagrams that were not whole.
    """

    def __init__(self, whole: Callable[[bytes], bool], received: Callable[[bytes], None]) -> None:
        self._whole = whole
        self._received = received
        self._transport: asyncio.DatagramTransport | None = None
        self.dropped: int = 0

    # What asyncio calls.

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Keep the transport of the opened UDP socket, for sending."""
        self._transport = cast(asyncio.DatagramTransport, transport)  # uvloop's is of no such class

    def datagram_received(self, data: bytes, addr: Any) -> None:  # Any: of whatever family
        """Pass on a received datagram if it is a whole frame; otherwise count it as dropped."""
        if self._whole(data):
            self._received(data)
        else:
            self.dropped += 1

    def error_received(self, exc: Exception) -> None:
        """Ignore an error of the socket, such as a refused port (rule 2)."""

    # What a link calls.

    def write(self, data: bytes) -> None:
        """Send one frame as a UDP datagram."""
        if self._transport is not None:
            self._transport.sendto(data)

    def close(self) -> None:
        """Close the UDP socket."""
        if self._transport is not None:
            self._transport.close()

    def abort(self) -> None:
        """Close the UDP socket at once."""
        if self._transport is not None:
            self._transport.abort()

    def get_write_buffer_size(self) -> int:
        """Number of bytes in datagrams that the system has not accepted yet."""
        transport: Any = self._transport  # each loop's has it, although the abstract class does not
        return 0 if transport is None else int(transport.get_write_buffer_size())

    def get_extra_info(self, name: str) -> Any:  # Any: as the transport has it
        """Return a detail of the UDP transport, such as its socket."""
        return None if self._transport is None else self._transport.get_extra_info(name)

    def is_closing(self) -> bool:
        """Whether the UDP socket is closed."""
        return self._transport is None or self._transport.is_closing()


async def open_datagram(
    host: str,
    port: int,
    parameters: SocketParameters,
    *,
    endpoint: str,
    whole: Callable[[bytes], bool],
    received: Callable[[bytes], None],
) -> DatagramConnection:
    """Open a client's UDP socket to ``host:port``; ``received`` gets the datagrams that ``whole`` accepts.

    Raises:
        LinkDown: the name cannot be resolved, or no socket be had. Nothing was sent.
    """
    loop = asyncio.get_running_loop()
    try:
        async with asyncio.timeout(parameters.connect_timeout):
            transport, connection = await loop.create_datagram_endpoint(
                lambda: DatagramConnection(whole, received),
                remote_addr=(host, port),
                local_addr=(parameters.local_address, 0) if parameters.local_address else None,
            )
    except (OSError, ValueError) as error:
        raise link_down(error, endpoint=endpoint) from error
    set_buffers(transport.get_extra_info("socket"), parameters)
    return connection


class BlockingDatagramSocket:
    """A client's UDP socket for blocking programs, with the methods of a stream socket.

    Attributes:
        dropped: datagrams that were not whole.
    """

    def __init__(
        self, host: str, port: int, parameters: SocketParameters, *, endpoint: str, whole: Callable[[bytes], bool]
    ) -> None:
        """Open the UDP socket; arguments and errors as of `open_datagram`."""
        self._whole = whole
        self.dropped: int = 0
        try:
            family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
            self._socket = socket.socket(family, kind, protocol)
        except OSError as error:
            raise link_down(error, endpoint=endpoint) from error
        try:
            self._socket.setblocking(False)
            set_buffers(self._socket, parameters)
            if parameters.local_address:
                self._socket.bind((parameters.local_address, 0))
            self._socket.connect(address)
        except (OSError, ValueError) as error:
            self._socket.close()
            raise link_down(error, endpoint=endpoint) from error

    def fileno(self) -> int:
        """Return the file descriptor of the UDP socket, for waiting until it is ready."""
        return self._socket.fileno()

    def recv_into(self, buffer: bytearray) -> int:
        """Receive the next datagram that is a whole frame. Raises `BlockingIOError` if there is none."""
        while True:
            try:
                data = self._socket.recv(MAX_DATAGRAM)
            except ConnectionRefusedError:
                continue
            if self._whole(data):
                buffer[: len(data)] = data
                return len(data)
            self.dropped += 1

    def send(self, data: bytes) -> int:
        """Send one frame as a UDP datagram."""
        with contextlib.suppress(ConnectionRefusedError):
            self._socket.send(data)
            return len(data)
        # That was about an earlier one.
        with contextlib.suppress(ConnectionRefusedError):
            self._socket.send(data)
        return len(data)

    def close(self) -> None:
        """Close the UDP socket."""
        self._socket.close()
