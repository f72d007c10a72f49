"""Options of network connections, of clients and servers (Messaging on TCP/IP V1.0b §4.3.2)."""

from dataclasses import dataclass
from typing import Annotated, ClassVar

from .declaration import On, Range, Strict, check

MIN_SOCKET_BUFFER = 900
"""Fewest bytes of a socket buffer: below, a request and its reply may not fit (Messaging on TCP/IP V1.0b §4.3.2)."""
_BUFFER = Range(MIN_SOCKET_BUFFER, 1 << 30, words=f"at least {MIN_SOCKET_BUFFER} bytes")
_STREAMS = On("tcp", "tls")
_DIALLED = On("client", "monitor tcp")
"""Mark of options about opening a connection: they have an effect for clients and TCP monitors, not for listeners."""


@dataclass(frozen=True, slots=True)
class SocketParameters:
    """Options of a TCP or UDP connection (Messaging on TCP/IP V1.0b §4.3.2).

    The guide suggests 2 hours, 75 seconds and 8 probes for keepalive, the defaults of many systems. With these a
    half-open connection lasts more than two hours, so the defaults here are shorter.
    """

    on: ClassVar[On] = On("tcp", "tls", "udp")

    connect_timeout: Annotated[
        float,
        Range(0.01, 600),
        _DIALLED,
        Strict("T19", 75.0, adaptable=True),
        "seconds until a connection that does not come about fails.",
    ] = 3.0
    keepalive: Annotated[bool, _STREAMS, Strict("T19", True), "whether the system probes an idle peer."] = True
    keepalive_idle: Annotated[
        int,
        Range(1, 32_767),
        _STREAMS,
        Strict("T19", 7200, adaptable=True),
        "seconds of idleness before the first probe.",
    ] = 60
    keepalive_interval: Annotated[
        int, Range(1, 32_767), _STREAMS, Strict("T19", 75, adaptable=True), "seconds between probes."
    ] = 10
    keepalive_count: Annotated[
        int, Range(1, 127), _STREAMS, Strict("T19", 8, adaptable=True), "lost probes that end the connection."
    ] = 3
    user_timeout: Annotated[
        float | None,
        Range(0.1, 3600),
        _STREAMS,
        "seconds that sent data may stay unacknowledged before the connection ends, where the system has it (Linux);",
        "None leaves it to the system. Linux ends a peer that lives and takes nothing for so long, too. With keepalive",
        "it is never longer than the probes take: see `effective_user_timeout`.",
    ] = 30.0
    no_delay: Annotated[bool, _STREAMS, Strict("T19", True), "whether small segments leave at once (TCP_NODELAY)."] = (
        True
    )
    receive_buffer: Annotated[int | None, _BUFFER, "bytes of the receive buffer; None leaves them to the system."] = (
        None
    )
    send_buffer: Annotated[
        int | None,
        _BUFFER,
        On("client", "server", "monitor tcp"),
        "bytes of the send buffer; None leaves them to the system.",
    ] = None
    local_address: Annotated[
        str | None,
        _DIALLED,
        "address to connect from; None lets the system choose. The port is always the system's choice, above 1024.",
    ] = None

    def __post_init__(self) -> None:
        check(self)

    @property
    def effective_user_timeout(self) -> float | None:
        """The TCP user timeout to set, in seconds: ``user_timeout`` or less; None for the system's default.

        When a keepalive probe is due, Linux ends an idle connection by the user timeout and not by the number of lost
        probes: with 30 s, two probes of one second would end a half-open connection only after 30 s. So with keepalive
        a value that is not None is always shorter than idle + interval × count, and an idle half-open connection ends
        within that time, however long ``user_timeout`` is.
        """
        if self.user_timeout is None or not self.keepalive:
            return self.user_timeout
        probes = self.keepalive_idle + self.keepalive_interval * (self.keepalive_count - 0.5)
        return min(self.user_timeout, probes)
