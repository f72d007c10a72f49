"""Local and remote address of a connection, for packets of a capture file.

Knows sockets and transports; knows no Modbus.
"""

import contextlib
import os
import socket
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class SocketAddresses:
    """Local and remote address of a connection.

    Attributes:
        local, peer: as ``getsockname`` and ``getpeername`` return them; None if unknown.
        is_datagram: whether it is a UDP socket.
    """

    local: object = None
    peer: object = None
    is_datagram: bool = False


def socket_addresses_of(carrier: object) -> SocketAddresses:
    """Return the addresses of a socket, of an asyncio transport, or of an object with the descriptor of a socket.

    Both are None if ``carrier`` has no socket, or is not connected. A `SocketAddresses` object is returned unchanged.
    """
    if isinstance(carrier, SocketAddresses):
        return carrier
    ask = getattr(carrier, "get_extra_info", None)
    asked: Any = ask("socket") if ask is not None else carrier  # sockets of asyncio share no base with the others
    with contextlib.suppress(OSError):
        if hasattr(asked, "getpeername"):
            return SocketAddresses(asked.getsockname(), asked.getpeername(), asked.type == socket.SOCK_DGRAM)
        if hasattr(asked, "fileno"):
            with socket.socket(fileno=os.dup(asked.fileno())) as own:
                return SocketAddresses(own.getsockname(), own.getpeername(), own.type == socket.SOCK_DGRAM)
    return SocketAddresses()
