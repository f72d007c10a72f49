"""UDP sockets of clients, for asyncio and for blocking links.

Knows sockets; knows no Modbus. The caller passes a function that tells which datagrams are whole frames; others are
dropped and counted.

1. A lost datagram is not sent again: callers that wait for an answer have a timeout.
2. An ICMP error (nothing listens at the peer's port) does not end the connection: the next datagram may be answered,
   and any host can send such a message.
3. A client receives datagrams only from the address to which it sends.
"""

import asyncio
import contextlib
import socket
from collections.abc import Callable
from typing import Any, cast

from ..errors import LinkDown
from ..options.sockets import SocketParameters
from .local_end import connect_failure
from .tcp import set_buffers

MAX_DATAGRAM = 2048
"""Most bytes of one datagram that are received, more than any frame has; the system drops the rest of a longer one."""


class DatagramConnection(asyncio.DatagramProtocol):
    """A client's UDP socket under asyncio, with the methods of a stream transport. Created by `open_datagram`.

    Attributes:
        dropped: number of datagrams that were dropped because they are not one whole frame.
    """

    def __init__(self, whole: Callable[[bytes], bool], received: Callable[[bytes], None]) -> None:
        self._whole = whole
        self._received = received
        self._transport: asyncio.DatagramTransport | None = None
        self.dropped: int = 0

    # What asyncio calls.

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Store the transport of the opened UDP socket, for sending."""
        self._transport = cast(asyncio.DatagramTransport, transport)  # uvloop's is of no such class

    def datagram_received(self, data: bytes, addr: Any) -> None:  # Any: of whatever family
        """Pass on a received datagram if it is a whole frame; otherwise count it as dropped."""
        if self._whole(data):
            self._received(data)
        else:
            self.dropped += 1

    def error_received(self, exc: Exception) -> None:
        """Ignore an error that the network reports, such as a refused port: the next datagram may be answered."""

    # What a link calls.

    def write(self, data: bytes) -> None:
        """Send one frame as a UDP datagram; if the system is busy, it waits in the transport."""
        if self._transport is not None:
            self._transport.sendto(data)

    def close(self) -> None:
        """Close the UDP socket after the datagrams that wait are sent."""
        if self._transport is not None:
            self._transport.close()

    def abort(self) -> None:
        """Close the UDP socket at once; datagrams that wait are dropped."""
        if self._transport is not None:
            self._transport.abort()

    def get_write_buffer_size(self) -> int:
        """Return the number of bytes in datagrams that the system has not accepted yet."""
        transport: Any = self._transport  # each loop's has it, although the abstract class does not
        return 0 if transport is None else int(transport.get_write_buffer_size())

    def get_extra_info(self, name: str) -> Any:  # Any: as the transport has it
        """Return a detail of the UDP transport, such as ``socket``; None if the transport does not have it."""
        return None if self._transport is None else self._transport.get_extra_info(name)

    def is_closing(self) -> bool:
        """Whether the UDP socket is closed or about to be."""
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
    """Open a client's UDP socket to a host and port, under asyncio. Nothing is sent.

    Args:
        host: host name or address of the peer.
        port: its UDP port.
        parameters: buffer sizes, local address, and the time allowed to resolve the name.
        endpoint: URL of the peer, for the error.
        whole: returns whether a datagram is one whole frame.
        received: called with each datagram that is.

    Raises:
        LinkDown: the name cannot be resolved, or no socket can be opened.
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
        raise _failure(error, endpoint, host, parameters) from error
    set_buffers(transport.get_extra_info("socket"), parameters)
    return connection


class BlockingDatagramSocket:
    """A client's UDP socket for blocking programs, with the methods of a non-blocking stream socket.

    Attributes:
        dropped: number of datagrams that were dropped because they are not one whole frame.
    """

    def __init__(
        self, host: str, port: int, parameters: SocketParameters, *, endpoint: str, whole: Callable[[bytes], bool]
    ) -> None:
        """Open the UDP socket; arguments and errors are those of `open_datagram`.

        Resolving the host name blocks, without a limit of its own.
        """
        self._whole = whole
        self.dropped: int = 0
        try:
            family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
            self._socket = socket.socket(family, kind, protocol)
        except OSError as error:
            raise _failure(error, endpoint, host, parameters) from error
        try:
            self._socket.setblocking(False)
            set_buffers(self._socket, parameters)
            if parameters.local_address:
                self._socket.bind((parameters.local_address, 0))
            self._socket.connect(address)
        except (OSError, ValueError) as error:
            self._socket.close()
            raise _failure(error, endpoint, host, parameters) from error

    def fileno(self) -> int:
        """Return the file descriptor of the UDP socket, for waiting until it is ready."""
        return self._socket.fileno()

    def recv_into(self, buffer: bytearray) -> int:
        """Receive the next datagram that is a whole frame into ``buffer``, and return its size in bytes.

        ``buffer`` must have at least `MAX_DATAGRAM` bytes. Raises `BlockingIOError` if no such datagram has been
        received.
        """
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
        """Send one frame as a UDP datagram, and return its size in bytes.

        Raises `OSError` if the system does not accept it, but not if nothing listens at the peer's port.
        """
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


def _failure(error: BaseException, endpoint: str, host: str, parameters: SocketParameters) -> LinkDown:
    return connect_failure(error, endpoint=endpoint, host=host, local_address=parameters.local_address)
