"""Fault profiles of clients: the bytes that a misbehaving client sends before it falls silent.

Knows bytes, and for `misbehaving_client` a socket; knows no server.
"""

import contextlib
import socket
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Final

from ..options.endpoints import parse_endpoint


@dataclass(frozen=True, slots=True)
class ClientFaultProfile:
    """A named way in which a Modbus client misbehaves, to test servers with.

    Attributes:
        name: name of the profile, as in the documentation.
        happens: what the client does, in words.
        seen_in: repositories and issues where such a client was reported.
        answer: the right reaction of a server, in words.
        make: function that returns the bytes sent before the silence; its keyword arguments are the parameters.
    """

    name: str
    happens: str
    seen_in: tuple[str, ...]
    answer: str
    make: Callable[..., bytes]


def _slow_loris(size: int = 3) -> bytes:
    """Return the first ``size`` bytes, 1…11, of a request of 12 bytes; a client that sends only these never ends it."""
    return bytes.fromhex("0001 0000 0006 01 03 0000 0001")[:size]


SLOW_LORIS: Final = ClientFaultProfile(
    "slow-loris",
    "sends half a header and waits",
    (),
    "frees the place after `frame_timeout`",
    _slow_loris,
)

CLIENT_FAULT_PROFILES: Final = {one.name: one for one in (SLOW_LORIS,)}
"""All fault profiles of clients, by name."""


@contextlib.contextmanager
def misbehaving_client(
    endpoint: str, fault_profile: ClientFaultProfile, **options: Any
) -> Iterator[socket.socket]:  # Any: what the fault profile takes
    """Context manager that connects to a server and sends the bytes of a client fault profile; yields the open socket.

    The connection is plain TCP, without TLS, and is closed at the end of the ``with`` block. Each operation of the
    socket has a timeout of 5 s.

    Args:
        endpoint: URL of the server, with host and port.
        fault_profile: the client fault profile, such as `SLOW_LORIS`.
        options: values for the parameters of the fault profile; parameters that are left out have their defaults.

    Raises:
        ConfigError: the URL is invalid.
        OSError: the connection cannot be made within 5 s, or breaks.
        TypeError: the fault profile has no such parameter.
    """
    where = parse_endpoint(endpoint)
    with socket.create_connection((where.host, where.port or 0), 5.0) as connection:
        connection.sendall(fault_profile.make(**options))
        yield connection
