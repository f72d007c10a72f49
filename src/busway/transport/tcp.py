"""Sets the options of TCP sockets, and explains their errors.

Knows sockets; knows no Modbus. Here it is decided which kind of `LinkDown` an `OSError` of the network is, and in which
words it is explained.
"""

import contextlib
import errno
import socket
import struct
import sys
from typing import Any

from ..errors import LinkDown, LinkDownKind
from ..options.sockets import SocketParameters
from .serial.waiting import wait_ready


def configure(connection: socket.socket, parameters: SocketParameters) -> None:
    """Set the options of a connected TCP socket; those that the system does not know are left out.

    Does nothing to a socket that is neither IPv4 nor IPv6. Raises `OSError` if the system refuses an option.
    """
    if connection.family not in (socket.AF_INET, socket.AF_INET6):
        return
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, parameters.no_delay)
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, parameters.keepalive)
    if parameters.keepalive:
        for name, value in (
            ("TCP_KEEPIDLE", parameters.keepalive_idle),
            ("TCP_KEEPINTVL", parameters.keepalive_interval),
            ("TCP_KEEPCNT", parameters.keepalive_count),
        ):
            _set_if_known(connection, name, value)
    if parameters.effective_user_timeout is not None:
        _set_if_known(connection, "TCP_USER_TIMEOUT", int(parameters.effective_user_timeout * 1000))
    set_buffers(connection, parameters)


def set_buffers(connection: socket.socket, parameters: SocketParameters) -> None:
    """Set the buffer sizes of a socket, if the parameters give any.

    Connections that a listening socket accepts inherit its sizes.
    """
    if parameters.receive_buffer is not None:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, parameters.receive_buffer)
    if parameters.send_buffer is not None:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, parameters.send_buffer)


def discard_on_close(connection: Any) -> None:
    """Make closing reset the TCP connection, so that bytes which the peer has not received yet are dropped.

    Args:
        connection: a socket, or what ``get_extra_info("socket")`` of a transport returns. Does nothing for None.
    """
    if connection is not None:
        with contextlib.suppress(OSError):  # it has ended already
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))


def takes_bytes(connection: Any) -> bool:
    """Whether a TCP connection would accept bytes to send now.

    ``connection`` is a socket, or what ``get_extra_info("socket")`` of a transport returns. False for None, and for a
    socket that is closed.
    """
    if connection is None:
        return False
    try:
        return bool(wait_ready([], [connection.fileno()], 0.0))
    except (OSError, ValueError):  # it has ended already
        return False


def peer_has_ended(connection: Any) -> bool:  # Any: a socket, or what a transport gives for one
    """Whether the peer has closed the TCP connection or its sending side, and nothing is left to read.

    Reads no bytes. Only Linux tells this; on other systems it is always False.
    """
    if sys.platform != "linux":
        return False
    import fcntl
    import termios

    try:
        if connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 1)[0] not in _ENDED:
            return False
        unread = fcntl.ioctl(connection.fileno(), termios.FIONREAD, bytes(4))
    except (OSError, ValueError, AttributeError):  # it is closed already, or no socket of TCP
        return False
    return not any(unread)


_ENDED = frozenset({7, 8})
"""TCP_CLOSE and TCP_CLOSE_WAIT of the kernel's tcp_states.h: reset, or the peer's FIN was received."""


def _set_if_known(connection: socket.socket, name: str, value: int) -> None:
    option = getattr(socket, name, None)
    if option is not None:
        connection.setsockopt(socket.IPPROTO_TCP, option, value)


_REASONS = {
    errno.ECONNREFUSED: "nothing listens there (connection refused)",
    errno.ETIMEDOUT: "no answer from the network (timed out)",
    errno.EHOSTUNREACH: "the host cannot be reached",
    errno.ENETUNREACH: "the network cannot be reached",
    errno.ECONNRESET: "the peer reset the connection",
    errno.EPIPE: "the peer closed the connection",
    errno.EADDRNOTAVAIL: "the local address does not exist on this host",
    errno.EADDRINUSE: "the port is taken; another program listens there (address already in use)",
    errno.EACCES: "the system does not allow it (permission denied); ports below 1024 belong to privileged programs",
    errno.EMFILE: "this process has no file handles left",
}


_KINDS: dict[int, LinkDownKind] = {
    errno.ECONNREFUSED: "refused",
    errno.ETIMEDOUT: "timeout",
    errno.EHOSTUNREACH: "unreachable",
    errno.ENETUNREACH: "unreachable",
    errno.ENETDOWN: "unreachable",
    errno.ECONNRESET: "lost",
    errno.ECONNABORTED: "lost",
    errno.EPIPE: "lost",
    errno.ENOTCONN: "lost",
    errno.ENOENT: "missing",
    errno.EADDRINUSE: "taken",
    errno.EADDRNOTAVAIL: "local",
    errno.EACCES: "local",
    errno.EPERM: "local",
    errno.EMFILE: "local",
    errno.ENFILE: "local",
    errno.ENOBUFS: "local",
}
_TLS_ERRORS = frozenset({"SSLError", "TlsFailure"})
"""Names of the error classes of TLS; compared by name, so that a program without TLS does not import them."""


def network_kind(error: BaseException) -> LinkDownKind:
    """Return the kind of `LinkDown` for a network error, such as ``refused`` or ``timeout``; ``other`` if unknown."""
    if isinstance(error, socket.gaierror):
        return "unresolved"
    if any(one.__name__ in _TLS_ERRORS for one in type(error).__mro__):
        return "tls"
    number = getattr(error, "errno", None)
    if isinstance(error, TimeoutError) and not number:
        return "timeout"
    return _KINDS.get(number or 0, "other")


def network_reason(error: BaseException) -> str:
    """Return the reason of a network error in words for a log or message, such as "the host cannot be reached"."""
    if isinstance(error, socket.gaierror):
        return f"the host name cannot be resolved ({error.strerror})"
    if isinstance(error, TimeoutError) and not getattr(error, "errno", None):
        return "no connection within the connect timeout"
    number = getattr(error, "errno", None)
    if number in _REASONS:
        return _REASONS[number]
    return str(error) or type(error).__name__


def link_down(error: BaseException, *, endpoint: str, sent: bool = False) -> LinkDown:
    """Return a `LinkDown` for a network error, with that error as its cause.

    Args:
        error: the network error.
        endpoint: URL of the peer.
        sent: whether bytes of a request may have gone out.
    """
    down = LinkDown(f"no connection: {network_reason(error)}", kind=network_kind(error), sent=sent, endpoint=endpoint)
    down.__cause__ = error
    return down
