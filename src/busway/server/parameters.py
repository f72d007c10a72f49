"""Limits and timeouts of the connections of a listener; options of sockets are in `busway.transport.tcp`."""

from dataclasses import dataclass
from typing import Final

from ..access.networks import Networks
from ..errors import ConfigError
from .pools import PoolLimits

NOBODY: Final = Networks()
"""An empty list: no priority hosts."""


@dataclass(frozen=True, slots=True)
class ListenerParameters:
    """Limits and timeouts of the connections of a listener.

    None of the timeouts, nor ``request_rate``, touches a connection of a priority host.

    Attributes:
        backlog: connections that the system may hold before they are accepted.
        priority: addresses and networks of the priority hosts, whose connections are never closed by us.
        max_priority_connections: places for them.
        max_priority_per_remote: of these, places for one device; None is half of them.
        max_connections: places for all others; the next new connection takes that of the oldest unused one.
        max_per_remote: of these, places for one device; its next connection replaces its oldest. None for all.
        shared_slots: whether all listeners of a server over TCP and TLS that have no limits of their own share these
            places; otherwise each has as many.
        write_buffer: bytes of replies that may wait for a client that does not take them; beyond, nothing more is
            read from it until half of them have gone.
        write_timeout: seconds for which a client may take none of its replies, until it is closed. None for ever.
        single_adu_segments: whether each reply is written by itself, as Messaging on TCP/IP V1.0b §4.3.2 advises;
            otherwise replies to requests that arrived together leave together.
        header_timeout: seconds from the first byte of a request to the last of its header (7 bytes).
        frame_timeout: seconds from the first byte of a request to its last; a client that begins one and falls silent
            is closed then, so that it does not hold a place for ever. None waits for ever.
        idle_timeout: seconds for which a connection may be unused; it is closed then, up to a sixteenth late. None for
            ever.
        request_rate: requests a second that one device may make, by all its connections together; what is over the
            rate is slowed down, and over UDP dropped. None for any number.
        answer_half_closed: whether a client that has ended its half of the connection still gets the replies it waits
            for; otherwise it is taken to have gone, as most clients have that close.
        interface: name of the network interface to listen on, and no other; None for all (Linux).
    """

    backlog: int = 1024
    priority: Networks = NOBODY
    max_priority_connections: int = 8
    max_priority_per_remote: int | None = None
    max_connections: int = 56
    max_per_remote: int | None = None
    shared_slots: bool = False
    write_buffer: int = 65_536
    write_timeout: float | None = 60.0
    single_adu_segments: bool = False
    header_timeout: float | None = 5.0
    frame_timeout: float | None = 10.0
    idle_timeout: float | None = None
    request_rate: float | None = None
    answer_half_closed: bool = True
    interface: str | None = None

    def __post_init__(self) -> None:
        for key, low, high in (
            ("backlog", 1, 65_535),
            ("max_priority_connections", 0, 1_000_000),
            ("max_priority_per_remote", 1, 1_000_000),
            ("max_connections", 1, 1_000_000),
            ("max_per_remote", 1, 1_000_000),
            ("write_buffer", 1024, 1 << 30),
        ):
            value = getattr(self, key)
            if value is not None and not low <= value <= high:
                raise ConfigError(f"must be {low}…{high}, not {value}", key=key)
        for key, shortest, longest in (
            ("write_timeout", 0.001, 86_400),
            ("header_timeout", 0.001, 3600),
            ("frame_timeout", 0.001, 3600),
            ("idle_timeout", 0.001, 31_536_000),
            ("request_rate", 0.001, 1e9),
        ):
            seconds = getattr(self, key)
            if seconds is not None and not shortest <= seconds <= longest:
                raise ConfigError(f"must be {shortest:g}…{longest:g}, not {seconds:g}", key=key)
        for key, pool in (
            ("max_priority_per_remote", "max_priority_connections"),
            ("max_per_remote", "max_connections"),
        ):
            limit, places = getattr(self, key), getattr(self, pool)
            if limit is not None and limit > places:
                raise ConfigError(f"does not fit {pool}, which is {places}: {limit}", key=key)
        if self.priority and not self.max_priority_connections:
            raise ConfigError("there are no priority places for them: max_priority_connections is 0", key="priority")
        if self.interface == "":
            raise ConfigError("must be the name of an interface", key="interface")

    @property
    def pools(self) -> PoolLimits:
        """The limits of both pools."""
        return PoolLimits(
            priority=self.max_priority_connections,
            other=self.max_connections,
            priority_per_device=self.max_priority_per_remote or max(self.max_priority_connections // 2, 1),
            per_device=self.max_per_remote,
        )
