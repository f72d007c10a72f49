"""Outgoing TCP connections, from a chosen local address or interface (Messaging on TCP/IP V1.0b §4.3.3).

Knows sockets; knows no Modbus.

1. The addresses of a host name are tried one after the other; the error of the last one is raised if all fail.
2. All connections of one event loop are watched by one `EpollSet`, if the loop allows that: a poll of eight reads costs
   28 µs of CPU that way, and 33 µs with the transports of asyncio.
3. A numeric address is not resolved by the event loop, which would start a thread for that.
"""

import asyncio
import contextlib
import socket
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Final
from weakref import WeakValueDictionary

from .epoll.stream import EpollStream
from .epoll.watcher import EpollSet, can_watch

ResolvedAddresses = Sequence[tuple[Any, ...]]
"""What getaddrinfo returns: family, kind, protocol, name, and the address, whose type depends on the family."""

_epoll_sets: Final["WeakValueDictionary[asyncio.AbstractEventLoop, EpollSet]"] = WeakValueDictionary()
"""The epoll set of each event loop, for outgoing connections. It exists only as long as one of these connections, so it
does not keep the loop alive.
"""


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
        protocol: creates the protocol of the connection, an `asyncio.BufferedProtocol`; called once, before connecting.
        host: host name or address of the peer.
        port: its TCP port.
        local_address: local address to connect from; None lets the system choose.
        interface: name of the network interface to connect through; None leaves it to the routes of the system.
        prepare: called with the connected socket, to set its options; an `OSError` that it raises is ignored.

    Raises:
        OSError: the host name cannot be resolved, or no address of it can be connected to.
    """
    loop = asyncio.get_running_loop()
    made = protocol()  # first: if it fails, there is no socket to close yet
    waits_together = can_watch(loop)
    if not waits_together and interface is None:
        local = None if local_address is None else (local_address, 0)
        transport, _ = await loop.create_connection(lambda: made, host, port, local_addr=local)
        with contextlib.suppress(OSError):  # as below
            prepare(transport.get_extra_info("socket"))
        return transport
    connection = await _connected(host, port, local_address, interface)
    with contextlib.suppress(OSError):  # a peer that is gone already says so at the first read
        prepare(connection)
    if not waits_together:
        transport, _ = await loop.create_connection(lambda: made, sock=connection)
        return transport
    try:
        peer = connection.getpeername()
    except OSError:
        connection.close()
        raise
    stream = EpollStream(_epoll_set_of(loop), connection, made, peer)
    stream.begin()
    return stream


def _epoll_set_of(loop: asyncio.AbstractEventLoop) -> EpollSet:
    epoll_set = _epoll_sets.get(loop)
    if epoll_set is None:
        epoll_set = _epoll_sets[loop] = EpollSet(loop)
    return epoll_set


async def _connected(host: str, port: int, local_address: str | None, interface: str | None) -> socket.socket:
    """Open a TCP connection to the first address of ``host`` that accepts it; return its non-blocking socket.

    Raises the `OSError` of the last address if all fail.
    """
    loop = asyncio.get_running_loop()
    try:
        found: ResolvedAddresses = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_NUMERICHOST)
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
    """Return a link-local IPv6 address as (host, port) with its zone in the host, as uvloop needs it.

    Every other socket address is returned unchanged.
    """
    if len(address) == 4 and address[3]:
        return f"{address[0]}%{address[3]}", address[1]
    return address


def dial_through(interface: str, host: str, port: int, local_address: str | None, timeout: float) -> socket.socket:
    """Open a TCP connection through a network interface and return its blocking socket.

    Args:
        interface: name of the network interface.
        host: host name or address of the peer.
        port: its TCP port.
        local_address: local address to connect from; None lets the system choose.
        timeout: seconds allowed for each address of the host. The returned socket keeps it as the timeout of its calls.

    Raises:
        OSError: the host name cannot be resolved, or no address of it can be connected to.
    """
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
        problem: why the last attempt failed; before the first, that the host has no address.
    """

    def __init__(self, interface: str | None, local_address: str | None) -> None:
        self._interface = interface
        self._local_address = local_address
        self.problem = OSError("the host has no address")

    def towards(self, found: ResolvedAddresses) -> Iterator[tuple[socket.socket, Any]]:
        """Yield, for each usable address of the peer, a socket that is not connected yet, and the address.

        Interface and local address of the socket are set. Addresses for which that fails are left out. ``found`` are
        the peer's addresses, as ``getaddrinfo`` returns them.
        """
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
        """Return a context manager for a connection attempt: it closes the socket if its block raises.

        An `OSError` is stored in ``problem`` and not raised further; other exceptions are.
        """
        with contextlib.ExitStack() as unless_connected:
            unless_connected.callback(connection.close)
            try:
                yield
            except OSError as error:
                self.problem = error
            else:
                unless_connected.pop_all()
