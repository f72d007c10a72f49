"""Creates bound sockets for listeners, one for each address, on a named network interface if one is given.

Knows sockets; knows no Modbus and no event loop. Errors are left as the system raises them; the server adds which
listener could not be opened.

1. An empty host means every address, of IPv4 and of IPv6, and both get the same port. A family or address that the
   system does not have is left out if another one is left.
2. An IPv6 socket accepts IPv6 alone, so that an IPv4 client is always seen under its IPv4 address.
"""

import contextlib
import errno
import os
import socket
from collections.abc import Iterable
from typing import Any, Final

from ..errors import ConfigError

_NO_SUCH_FAMILY: Final = frozenset({errno.EAFNOSUPPORT, errno.EADDRNOTAVAIL, errno.EPROTONOSUPPORT})
_TRIES: Final = 16
"""Most attempts to find a port that is free for all addresses of a listener, if the system chooses the port."""


def bound_sockets(
    addresses: Iterable[tuple[Any, ...]], *, interface: str | None = None
) -> list[socket.socket]:  # Any: as getaddrinfo gives them
    """Return a bound, non-blocking socket for each address of a listener; not listening yet.

    Addresses that this system lacks, or whose family it lacks, are left out; if all are, the error is raised. With port
    0 the system chooses the port, the same for all sockets.

    Args:
        addresses: results of ``getaddrinfo``, all of one socket type and one port.
        interface: name of the only network interface to listen on; None for all.

    Raises:
        OSError: an address cannot be bound; then all sockets are closed again.
        ConfigError: this system cannot bind a socket to an interface.
    """
    if interface is not None and not hasattr(socket, "SO_BINDTODEVICE"):
        raise ConfigError("this system cannot bind a socket to an interface", key="interface")
    wanted = list(dict.fromkeys(addresses))
    for attempt in range(_TRIES):
        try:
            return _bound(wanted, interface)
        except OSError as error:
            if error.errno != errno.EADDRINUSE or wanted[0][4][1] or attempt == _TRIES - 1:
                raise
    raise AssertionError  # the last attempt has returned or raised


def _bound(wanted: list[tuple[Any, ...]], interface: str | None) -> list[socket.socket]:
    made: list[socket.socket] = []
    missing: OSError | None = None
    with contextlib.ExitStack() as undo:
        for family, kind, protocol, _, address in wanted:
            if made:
                address = (address[0], made[0].getsockname()[1], *address[2:])
            try:
                made.append(_one(socket.socket(family, kind, protocol), address, interface))
            except OSError as error:
                if error.errno not in _NO_SUCH_FAMILY:
                    raise
                missing = error
            else:
                undo.callback(made[-1].close)
        undo.pop_all()
    if not made and missing is not None:
        raise missing
    return made


def _one(made: socket.socket, address: Any, interface: str | None) -> socket.socket:  # Any: of whatever family
    try:
        _prepare(made, interface)
        made.bind(address)
    except BaseException:
        made.close()
        raise
    return made


def _prepare(one: socket.socket, interface: str | None) -> None:
    one.setblocking(False)
    if one.type == socket.SOCK_STREAM and os.name == "posix":
        # A port whose last connections are still dying away can be bound again. On Windows the option means more.
        one.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    if one.family == socket.AF_INET6:
        one.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
    if interface is not None:
        one.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, interface.encode() + b"\0")
