"""TCP sockets: their parameters, and what their errors mean.

Knows sockets; knows no Modbus. The only place where an `OSError` of a network connection becomes ours.
"""

import contextlib
import errno
import socket
import struct
import sys
from dataclasses import dataclass
from typing import Any

from ..errors import ConfigError, LinkDown
from .serial.waiting import wait_ready

MIN_SOCKET_BUFFER = 900
"""Below this a request and its reply may not fit (Messaging on TCP/IP V1.0b §4.3.2)."""


@dataclass(frozen=True, slots=True)
class SocketParameters:
    """Parameters of a connection (Messaging on TCP/IP V1.0b §4.3.2).

    The guide names 2 hours, 75 seconds and 8 probes for keepalive, the defaults of many systems; they would keep a
    half-open connection for more than two hours, so ours are shorter.

    Attributes:
        connect_timeout: seconds until a connection that does not come about fails.
        keepalive: whether the system probes an idle peer.
        keepalive_idle, keepalive_interval, keepalive_count: seconds of idleness before the first probe, seconds
            between probes, and lost probes that end the connection.
        user_timeout: seconds that sent data may stay unacknowledged before the connection ends, where the system has
            it (Linux); None leaves it to the system. Linux ends a peer that lives and takes nothing for so long, too.
            With keepalive it is never longer than the probes take: see ``effective_user_timeout``.
        no_delay: whether small segments leave at once (TCP_NODELAY).
        receive_buffer, send_buffer: bytes, at least 900; None leaves them to the system.
        local_address: address to connect from; None lets the system choose. The port is always the system's choice,
            above 1024.
    """

    connect_timeout: float = 3.0
    keepalive: bool = True
    keepalive_idle: int = 60
    keepalive_interval: int = 10
    keepalive_count: int = 3
    user_timeout: float | None = 30.0
    no_delay: bool = True
    receive_buffer: int | None = None
    send_buffer: int | None = None
    local_address: str | None = None

    def __post_init__(self) -> None:
        for name, low, high in (
            ("connect_timeout", 0.01, 600),
            ("keepalive_idle", 1, 32_767),
            ("keepalive_interval", 1, 32_767),
            ("keepalive_count", 1, 127),
        ):
            if not low <= getattr(self, name) <= high:
                raise ConfigError(f"must be {low:g}…{high:g}, not {getattr(self, name):g}", key=name)
        if self.user_timeout is not None and not 0.1 <= self.user_timeout <= 3600:
            raise ConfigError(f"must be 0.1…3600, not {self.user_timeout:g}", key="user_timeout")
        for name in ("receive_buffer", "send_buffer"):
            size = getattr(self, name)
            if size is not None and not MIN_SOCKET_BUFFER <= size <= 1 << 30:
                raise ConfigError(f"must be at least {MIN_SOCKET_BUFFER} bytes, not {size}", key=name)

    def apply(self, connection: socket.socket) -> None:
        """Set the parameters on a connected socket; what the system does not have is left out."""
        if connection.family not in (socket.AF_INET, socket.AF_INET6):
            return
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, self.no_delay)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, self.keepalive)
        if self.keepalive:
            for name, value in (
                ("TCP_KEEPIDLE", self.keepalive_idle),
                ("TCP_KEEPINTVL", self.keepalive_interval),
                ("TCP_KEEPCNT", self.keepalive_count),
            ):
                _set_if_known(connection, name, value)
        if self.effective_user_timeout is not None:
            _set_if_known(connection, "TCP_USER_TIMEOUT", int(self.effective_user_timeout * 1000))
        self.apply_buffers(connection)

    @property
    def effective_user_timeout(self) -> float | None:
        """The user timeout as it is set, in seconds; None leaves it to the system.

        Linux asks it, and not the number of lost probes, when a probe is due on an idle connection: with 30 s, two
        probes of one second would end a half-open connection after 30 s. So it is over before the last probe's time is,
        and an idle half-open connection ends within idle + interval × count whatever the user timeout.
        """
        if self.user_timeout is None or not self.keepalive:
            return self.user_timeout
        probes = self.keepalive_idle + self.keepalive_interval * (self.keepalive_count - 0.5)
        return min(self.user_timeout, probes)

    def apply_buffers(self, connection: socket.socket) -> None:
        """Set the buffer sizes; on a listening socket its connections inherit them."""
        if self.receive_buffer is not None:
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, self.receive_buffer)
        if self.send_buffer is not None:
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, self.send_buffer)


def discard_on_close(connection: Any) -> None:
    """Let closing reset the connection: what the system still holds for a peer that takes nothing never leaves.

    Args:
        connection: a socket, what a transport gives for one, or None.
    """
    if connection is not None:
        with contextlib.suppress(OSError):  # it has ended already
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))


def takes_bytes(connection: Any) -> bool:
    """Whether the system takes bytes for a peer now; ``connection`` as in `discard_on_close`."""
    if connection is None:
        return False
    try:
        return bool(wait_ready([], [connection.fileno()], 0.0))
    except (OSError, ValueError):  # it has ended already
        return False


def peer_has_ended(connection: Any) -> bool:  # Any: a socket, or what a transport gives for one
    """Whether the other end has closed a connection, or its half of it, and nothing it sent is left to be read.

    Looks, and takes nothing. False where the system does not tell: it is Linux that does.
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
"""TCP_CLOSE and TCP_CLOSE_WAIT of the kernel's tcp_states.h: reset, or the peer's FIN is there."""


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


def network_reason(error: BaseException) -> str:
    """What a network error says, for an operator."""
    if isinstance(error, socket.gaierror):
        return f"the host name cannot be resolved ({error.strerror})"
    if isinstance(error, TimeoutError) and not getattr(error, "errno", None):
        return "no connection within the connect timeout"
    number = getattr(error, "errno", None)
    if number in _REASONS:
        return _REASONS[number]
    return str(error) or type(error).__name__


def link_down(error: BaseException, *, endpoint: str, sent: bool = False) -> LinkDown:
    """Our error for a network error, which stays its cause."""
    down = LinkDown(f"no connection: {network_reason(error)}", sent=sent, endpoint=endpoint)
    down.__cause__ = error
    return down
