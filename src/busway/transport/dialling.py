"""Connections that leave through a named interface (Messaging on TCP/IP V1.0b §4.3.3: local address, interface).

Knows sockets; knows no Modbus. Needed only where an interface is named: the routes of the system decide otherwise.
"""

import asyncio
import socket
from collections.abc import Iterator, Sequence
from typing import Any

Found = Sequence[tuple[Any, ...]]  # what getaddrinfo gives: family, kind, protocol, name, address of whatever family


async def connect_through(interface: str, host: str, port: int, local_address: str | None) -> socket.socket:
    """A connected, non-blocking socket on an interface. Raises `OSError`."""
    loop = asyncio.get_running_loop()
    found = await loop.getaddrinfo(host, port, type=socket.SOCK_STREAM)
    attempts = _Attempts(interface, local_address)
    for connection, address in attempts.towards(found):
        try:
            connection.setblocking(False)
            await loop.sock_connect(connection, address)
        except OSError as error:
            connection.close()
            attempts.problem = error
        except BaseException:
            connection.close()
            raise
        else:
            return connection
    raise attempts.problem


def dial_through(interface: str, host: str, port: int, local_address: str | None, timeout: float) -> socket.socket:
    """A connected, blocking socket on an interface. Raises `OSError`."""
    attempts = _Attempts(interface, local_address)
    for connection, address in attempts.towards(socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)):
        try:
            connection.settimeout(timeout)
            connection.connect(address)
        except OSError as error:
            connection.close()
            attempts.problem = error
        except BaseException:
            connection.close()
            raise
        else:
            return connection
    raise attempts.problem


class _Attempts:
    """Sockets to try one after the other.

    Attributes:
        problem: why the last one failed.
    """

    def __init__(self, interface: str, local_address: str | None) -> None:
        self._interface = interface
        self._local_address = local_address
        self.problem = OSError("the host has no address")

    def towards(self, found: Found) -> Iterator[tuple[socket.socket, Any]]:
        """A socket for each address of the peer, on the interface and not yet connected."""
        for family, kind, protocol, _, address in found:
            connection = socket.socket(family, kind, protocol)
            try:
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, self._interface.encode() + b"\0")
                if self._local_address is not None:
                    connection.bind((self._local_address, 0))
            except OSError as error:
                connection.close()
                self.problem = error
                continue
            yield connection, address
