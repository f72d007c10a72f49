"""Outgoing TCP connections, from a chosen local address or interface (Messaging on TCP/IP V1.0b §4.3.3).

Knows sockets; knows no Modbus.

1. The addresses that a name has are tried one after the other; what the last one said is why there is no connection.
2. Connections of one event loop wait together, in an `EpollSet`, where the loop can have one: a poll of eight reads
   costs 28 µs of CPU so, and 33 with transports of asyncio.
3. An address in digits is used as it is: to ask the system for one costs a thread.
"""

import asyncio
import contextlib
import socket
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Final
from weakref import WeakValueDictionary

from .epoll.stream import EpollStream
from .epoll.watcher import EpollSet, can_watch

Found = Sequence[tuple[Any, ...]]  # what getaddrinfo gives: family, kind, protocol, name, address of whatever family

_epoll_sets: Final["WeakValueDictionary[asyncio.AbstractEventLoop, EpollSet]"] = WeakValueDictionary()
"""By loop. A epoll set lives as long as its connections, and keeps its loop no longer than that."""


async def open_stream(
    protocol: Callable[[], asyncio.BaseProtocol],
    host: str,
    port: int,
    *,
    local_address: str | None,
    interface: str | None,
    prepare: Callable[[socket.socket], None],
) -> asyncio.Transport:
    """Open a TCP connection for an asyncio protocol and return its transport.

    Args:
        protocol: makes its protocol, an `asyncio.BufferedProtocol`.
        host, port: where to.
        local_address: where from; None lets the system choose.
        interface: through which one; None leaves it to the routes of the system.
        prepare: sets the parameters of the connected socket. A peer that has gone by then is none of its business.

    Raises:
        OSError: no connection.
    """
    loop = asyncio.get_running_loop()
    waits_together = can_watch(loop)
    if not waits_together and interface is None:
        local = None if local_address is None else (local_address, 0)
        transport, _ = await loop.create_connection(protocol, host, port, local_addr=local)
        with contextlib.suppress(OSError):  # as below
            prepare(transport.get_extra_info("socket"))
        return transport
    connection = await _connected(host, port, local_address, interface)
    with contextlib.suppress(OSError):  # a peer that is gone already says so at the first read
        prepare(connection)
    if not waits_together:
        transport, _ = await loop.create_connection(protocol, sock=connection)
        return transport
    try:
        peer = connection.getpeername()
    except OSError:
        connection.close()
        raise
    stream = EpollStream(_epoll_set_of(loop), connection, protocol(), peer)
    stream.begin()
    return stream


def _epoll_set_of(loop: asyncio.AbstractEventLoop) -> EpollSet:
    epoll_set = _epoll_sets.get(loop)
    if epoll_set is None:
        epoll_set = _epoll_sets[loop] = EpollSet(loop)
    return epoll_set


async def _connected(host: str, port: int, local_address: str | None, interface: str | None) -> socket.socket:
    """Open a TCP connection and return its non-blocking socket. Raises `OSError`."""
    loop = asyncio.get_running_loop()
    try:
        found: Found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_NUMERICHOST)
    except socket.gaierror:
        found = await loop.getaddrinfo(host, port, type=socket.SOCK_STREAM)
    attempts = _Attempts(interface, local_address)
    for connection, address in attempts.towards(found):
        with attempts.noting_failure(connection):
            connection.setblocking(False)
            await loop.sock_connect(connection, _with_zone(address))
            return connection
    raise attempts.problem


def _with_zone(address: Any) -> Any:  # of whatever family
    """Append the zone of a link-local IPv6 address to its host, because uvloop ignores it otherwise."""
    if len(address) == 4 and address[3]:
        return f"{address[0]}%{address[3]}", address[1]
    return address


def dial_through(interface: str, host: str, port: int, local_address: str | None, timeout: float) -> socket.socket:
    """Open a TCP connection through a network interface and return its blocking socket. Raises `OSError`."""
    attempts = _Attempts(interface, local_address)
    for connection, address in attempts.towards(socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)):
        with attempts.noting_failure(connection):
            connection.settimeout(timeout)
            connection.connect(address)
            return connection
    raise attempts.problem


class _Attempts:
    """Attempts to connect to the addresses of one peer, one after the other.

    Attributes:
        problem: why the last one failed.
    """

    def __init__(self, interface: str | None, local_address: str | None) -> None:
        self._interface = interface
        self._local_address = local_address
        self.problem = OSError("the host has no address")

    def towards(self, found: Found) -> Iterator[tuple[socket.socket, Any]]:
        """Yield an unconnected socket, bound to the network interface, for each address of the peer."""
        for family, kind, protocol, _, address in found:
            try:
                connection = socket.socket(family, kind, protocol)
            except OSError as error:  # the name has an address of a family that this system does not have
                self.problem = error
                continue
            try:
                if self._interface is not None:
                    connection.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, self._interface.encode() + b"\0")
                if self._local_address is not None:
                    connection.bind((self._local_address, 0))
            except OSError as error:
                connection.close()
                self.problem = error
                continue
            yield connection, address

    @contextlib.contextmanager
    def noting_failure(self, connection: socket.socket) -> Iterator[None]:
        """Context manager that closes the socket if its block fails, and remembers an `OSError` as the reason."""
        with contextlib.ExitStack() as unless_connected:
            unless_connected.callback(connection.close)
            try:
                yield
            except OSError as error:
                self.problem = error
            else:
                unless_connected.pop_all()
