"""The bound sockets of a listener, their URLs, and whether other hosts can reach them.

Knows endpoints and sockets; knows no connection.
"""

import asyncio
import ipaddress
import socket
from urllib.parse import urlsplit

from ..transport.listening_sockets import bound_sockets
from .listener_settings import ListenerSettings


async def listening_sockets(loop: asyncio.AbstractEventLoop, settings: ListenerSettings) -> list[socket.socket]:
    """Open and bind the sockets of a listener's endpoint, one for each address of its host name.

    Raises:
        OSError: a socket cannot be opened or bound, or the host is not known; then none is bound.
        ConfigError: the listener is to use one network interface, and the system cannot do that.
    """
    endpoint = settings.endpoint
    addresses = await loop.getaddrinfo(
        endpoint.host or None,
        endpoint.port or 0,
        type=socket.SOCK_DGRAM if endpoint.carrier == "udp" else socket.SOCK_STREAM,
        flags=socket.AI_PASSIVE,
    )
    return bound_sockets(addresses, interface=settings.limits.interface)


def bound_name(scheme: str, bound: socket.socket) -> str:
    """Return the URL of a listener's bound socket, with its real port."""
    host, port = bound.getsockname()[:2]
    return f"{scheme}://[{host}]:{port}" if bound.family == socket.AF_INET6 else f"{scheme}://{host}:{port}"


def is_everywhere(url: str) -> bool:
    """Whether the host in the URL of a bound listener is ``0.0.0.0`` or ``::``, all addresses of this machine."""
    return urlsplit(url).hostname in ("0.0.0.0", "::")


def is_loopback(url: str) -> bool:
    """Whether the host in a listener's URL is a numeric loopback address (127.0.0.0/8, ``::1``); False for names."""
    host = urlsplit(url).hostname or ""
    try:
        return ipaddress.ip_address(host.partition("%")[0]).is_loopback
    except ValueError:
        return False
