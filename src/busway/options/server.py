"""Options of a server: its units, its sessions, and the limits and timeouts of its connections."""

from dataclasses import dataclass
from enum import Enum
from typing import Annotated, Final

from ..errors import ConfigError
from .declaration import Name, On, Range, Strict, check
from .networks import Networks

NO_NETWORKS: Final = Networks()
"""An empty set of networks, for no priority hosts."""
_SLOTS = Range(1, 1_000_000)
_STREAMS = On("tcp", "tls")
_MBAP_STREAMS = On("mbap tcp", "tls")
"""Mark of the times of a request; RTU and ASCII framing have times of their own."""


class Scope(Enum):
    """Values of the option ``scope``: whether ``max_transactions`` is for each connection or for the whole server."""

    CONNECTION = "connection"
    SERVER = "server"


class UnitPolicy(Enum):
    """Values of the option ``unit_policy``: which unit identifiers a TCP server answers.

    Attributes:
        LISTED: those of its devices.
        ANY: all of them; the server has one device, which answers requests to every unit.
    """

    LISTED = "listed"
    ANY = "any"


class UnlistedUnit(Enum):
    """Values of the option ``unlisted``: how a server answers a network request for a unit that it does not have.

    Attributes:
        EXCEPTION: with exception 0B.
        SILENCE: it does not answer.
    """

    EXCEPTION = "exception"
    SILENCE = "silence"


@dataclass(frozen=True, slots=True)
class UnitParameters:
    """Options of a server's units, and of its listener on the standard port."""

    standard_port: Annotated[
        bool | None,
        Strict("T3", True, adaptable=True),
        "whether to listen on 502 beside each other TCP port of the same address (Messaging on TCP/IP V1.0b §4.2.1);",
        "None leaves it to the rule of `Server`.",
    ] = None
    unit_policy: Annotated[
        UnitPolicy, "`listed` (others get exception 0B) or `any` (the sole device answers every unit)."
    ] = UnitPolicy.LISTED
    unlisted: Annotated[
        UnlistedUnit, Strict("T24", "silence"), "what a unit that is not listed gets: `exception` (0B) or `silence`."
    ] = UnlistedUnit.EXCEPTION

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True, slots=True)
class ServerParameters:
    """Options of a server: how many requests it processes at once, and how it answers."""

    max_transactions: Annotated[
        int, Range(1, 16), "NumberMaxOfServerTransaction: requests that may be waiting for a slow responder."
    ] = 16
    scope: Annotated[
        Scope, Strict("T27", "server"), "whether that limit applies to the server or to each connection."
    ] = Scope.CONNECTION
    diagnostics_changes: Annotated[
        bool | None,
        Strict("S17", True),
        "whether sub-functions of 08 that change the listener (01, 03, 04, 0A, 14) are offered; None: on serial lines,",
        "but not over a network, where one packet could mute the server for all clients.",
    ] = None

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True, slots=True)
class ListenerParameters:
    """Limits and timeouts of the connections of a listener.

    The timeouts and ``request_rate`` do not apply to connections of priority hosts; ``write_buffer`` does.
    """

    backlog: Annotated[
        int, Range(1, 65_535), _STREAMS, "connections that the system may hold before they are accepted."
    ] = 1024
    priority: Annotated[
        Networks,
        "addresses and networks of the priority hosts. Their connections make room only for those of priority hosts.",
    ] = NO_NETWORKS
    max_priority_connections: Annotated[int, Range(0, 1_000_000), "connection slots for them."] = 8
    max_priority_per_host: Annotated[int | None, _SLOTS, "of these, slots for one host; None is half of them."] = None
    max_connections: Annotated[
        int, _SLOTS, "slots for all others; the next new connection takes that of the oldest unused one."
    ] = 56
    max_per_host: Annotated[
        int | None, _SLOTS, "of these, slots for one host; its next connection replaces its oldest. None for all."
    ] = None
    shared_slots: Annotated[
        bool,
        "whether all listeners of a server over TCP and TLS that have no limits of their own share these slots;",
        "otherwise each has as many.",
    ] = False
    write_buffer: Annotated[
        int,
        Range(1024, 1 << 30),
        "bytes of replies that may wait for a client that does not take them; beyond, nothing more is read from it",
        "until no more than a quarter of that is left.",
    ] = 65_536
    write_timeout: Annotated[
        float | None,
        Range(0.001, 86_400),
        _STREAMS,
        "seconds for which a client may take none of its replies, until it is closed. None for ever.",
    ] = 60.0
    single_adu_segments: Annotated[
        bool,
        _STREAMS,
        Strict("T11", True),
        "whether each reply is written by itself, as Messaging on TCP/IP V1.0b §4.3.2 advises; otherwise replies to",
        "requests that arrived together leave together.",
    ] = False
    header_timeout: Annotated[
        float | None,
        Range(0.001, 3600),
        _MBAP_STREAMS,
        "seconds from the first byte of a request to the last of its header (7 bytes).",
    ] = 5.0
    frame_timeout: Annotated[
        float | None,
        Range(0.001, 3600),
        _MBAP_STREAMS,
        "seconds from the first byte of a request to its last; a client that begins one and falls silent is closed",
        "then, so that it does not hold a slot for ever. None waits for ever.",
    ] = 10.0
    idle_timeout: Annotated[
        float | None,
        Range(0.001, 31_536_000),
        _STREAMS,
        "seconds for which a connection may be unused; it is closed then, up to a sixteenth late. None for ever.",
    ] = None
    request_rate: Annotated[
        float | None,
        Range(0.001, 1e9),
        "requests a second that one host may send to the listener, over all its connections together; what is over the",
        "rate is slowed down, and over UDP dropped. None for any number.",
    ] = None
    answer_half_closed: Annotated[
        bool,
        _STREAMS,
        "whether a client that has ended its half of the connection still gets the replies it waits for; otherwise it",
        "is taken to have gone, as most clients have that close.",
    ] = True
    interface: Annotated[
        str | None,
        Name("the name of an interface"),
        "name of the network interface to listen on, and no other; None for all (Linux).",
    ] = None

    def __post_init__(self) -> None:
        check(self)
        for key, pool in (
            ("max_priority_per_host", "max_priority_connections"),
            ("max_per_host", "max_connections"),
        ):
            limit, slots = getattr(self, key), getattr(self, pool)
            if limit is not None and limit > slots:
                raise ConfigError(f"does not fit {pool}, which is {slots}: {limit}", key=key)
        if self.priority and not self.max_priority_connections:
            raise ConfigError("there are no priority slots for them: max_priority_connections is 0", key="priority")
