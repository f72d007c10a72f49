"""Options of a client: the conversation over a link, and its connections (Messaging on TCP/IP V1.0b §4.2.1)."""

import math
from dataclasses import dataclass
from enum import Enum
from typing import Annotated, ClassVar

from ..errors import ConfigError
from ..pdu.wide_registers import NARROW, WIDEST
from .declaration import ByFraming, Mark, Name, On, Range, Strict, check

CLIENT_DEADLINE = 2.5
"""Default seconds within which a gateway answers a request: half a second less than the default ``timeout`` with MBAP.

They suffice for two attempts on a serial line, of one second each.
"""


class MismatchPolicy(Enum):
    """How a client treats a reply with another transaction identifier or unit than that of its request.

    Values of the options ``transaction_policy`` and ``unit_policy``. If ``transaction_policy`` is not STRICT, every
    timeout ends the connection, so that no late reply is taken for the next one.

    Attributes:
        STRICT: a reply with another transaction identifier is dropped and counted; a reply of another unit is a
            `BadReply`.
        AUTOMATIC: the reply is accepted if exactly one request is in flight and all else of the reply fits.
        IGNORE: a reply with another transaction identifier is taken for the reply to the only request in flight, and
            then checked like any other; a reply of another unit is accepted.
    """

    STRICT = "strict"
    AUTOMATIC = "automatic"
    IGNORE = "ignore"


class TransactionScope(Enum):
    """What a client's limit of requests in flight applies to: each connection, or all of a client.

    Attributes:
        CONNECTION: the limit applies to each connection.
        CLIENT: the limit applies to all connections of a client together: those of an event loop, or the blocking ones
            of the process.
    """

    CONNECTION = "connection"
    CLIENT = "client"


ONE_AT_A_TIME = On("mbap")
"""Mark of options about transactions: they have an effect with MBAP framing only, which has identifiers for them."""
ON_STREAMS = On("mbap tcp", "mbap tls")


@dataclass(frozen=True, slots=True)
class ClientParameters:
    """Options of a client: timeouts, retries, and how many requests it may have in flight."""

    on: ClassVar[On] = On("client")

    # Behind TCP, TLS and UDP there may be a gateway: it answers within `CLIENT_DEADLINE`, so that its client gets
    # exception 0A or 0B before its own timeout.
    timeout: Annotated[
        float,
        Range(0.001, 3600),
        ByFraming({"mbap": 3.0, "rtu": 1.0, "ascii": 1.0}),
        Mark.PER_CALL,
        "seconds from the last byte of a request to the last of its reply, per attempt. The default depends on the",
        "framing of the endpoint.",
    ] = 1.0
    retries: Annotated[
        int, Range(0, 100), Mark.PER_CALL, "further attempts of a read after a timeout or a lost connection."
    ] = 1
    write_retries: Annotated[
        int,
        Range(0, 100),
        "further attempts of a write that may have been executed. 0 unless every write is idempotent.",
    ] = 0
    deadline: Annotated[
        float | None,
        Range(0.001, 86_400),
        Mark.PER_CALL,
        "seconds a call may take in all, waiting in the queue included; None for no limit.",
    ] = None
    max_transactions: Annotated[
        int, Range(1, 16), ONE_AT_A_TIME, "NumberMaxOfClientTransaction: requests in flight."
    ] = 1
    scope: Annotated[
        TransactionScope,
        ONE_AT_A_TIME,
        Strict("T23", "client"),
        "whether that limit applies to each connection, or to all of the client together (Messaging on TCP/IP V1.0b",
        "§4.4.1.1): those of an event loop, or the blocking ones of the process.",
    ] = TransactionScope.CONNECTION
    queue: Annotated[int, Range(1, 65_536), "calls that may wait on a link; one more is refused with `Overloaded`."] = (
        64
    )
    transaction_policy: Annotated[
        MismatchPolicy, ONE_AT_A_TIME, Strict("T25", "strict"), "how replies that name another transaction are handled."
    ] = MismatchPolicy.STRICT
    unit_policy: Annotated[
        MismatchPolicy, ONE_AT_A_TIME, Strict("T25", "strict"), "how replies that name another unit are handled."
    ] = MismatchPolicy.STRICT
    recycle_after_timeouts: Annotated[
        int,
        Range(1, 1000),
        On("tcp", "tls", "udp"),
        "timeouts in a row, without any reply, after which the connection is closed and opened again; twice as many",
        "while only late replies come.",
    ] = 3
    recycle_after_foreign: Annotated[
        int,
        Range(1, 1000),
        ONE_AT_A_TIME,
        "replies of foreign transactions in a row after which the connection is closed and opened again.",
    ] = 16
    single_adu_segments: Annotated[
        bool,
        ON_STREAMS,
        Strict("T11", True),
        "whether each request leaves in a segment of its own, as Messaging on TCP/IP V1.0b §4.3.2 advises. Otherwise",
        "those of `execute_many` leave together, and with `max_transactions` above 1 all of one turn of the loop.",
    ] = False
    connect_delay: Annotated[float, Range(0, 60), "seconds to wait after connecting before the first request."] = 0.0
    request_gap: Annotated[float, Range(0, 60), "seconds from the end of a reply to the next request."] = 0.0
    register_width: Annotated[
        int,
        Range(NARROW, WIDEST),
        Mark.PER_CALL,
        "bytes of one register in replies to reads of registers, an even number. 2 is the rule; some devices have",
        "wider ones, and `Unit.read`, `Unit.read_holding_registers` and `Unit.read_input_registers` read them so.",
    ] = NARROW

    def __post_init__(self) -> None:
        check(self)
        if self.register_width % 2:
            raise ConfigError(f"must be even, not {self.register_width}", key="register_width")
        if self.transaction_policy is MismatchPolicy.IGNORE and self.max_transactions > 1:
            raise ConfigError("ignore goes with max_transactions 1 only", key="transaction_policy")


LONGEST_HOLD = 86_400
"""Most seconds for the option ``hold``, one day; for longer there is ``forever``."""


class Hold(Enum):
    """Values of the option ``hold`` other than seconds: how long an unused connection stays open.

    Attributes:
        FOREVER: until its last user closes the link, as Messaging on TCP/IP V1.0b §4.2.1.1 advises.
        REQUEST: until no request needs it; for devices that accept one client and are shared between programs.
    """

    FOREVER = "forever"
    REQUEST = "request"


class LinkSelection(Enum):
    """Which of several connections to one peer sends a request (Messaging on TCP/IP V1.0b §4.2.1.2).

    Attributes:
        FIRST: the connection of the link that was created first.
        OLDEST: the connection that has been open longest.
    """

    FIRST = "first"
    OLDEST = "oldest"


@dataclass(frozen=True, slots=True)
class ManagementParameters:
    """Options of a link's connections: how many, how long kept, which gets a request (TCP/IP V1.0b §4.2.1)."""

    on: ClassVar[On] = On("client tcp", "client tls", "client udp")

    hold: Annotated[
        float | Hold,
        Range(0.01, LONGEST_HOLD),
        "seconds that an unused connection is kept; `forever`, or `request`: until no request needs it.",
    ] = Hold.FOREVER
    reconnect_first: Annotated[
        float,
        Range(0.001, 3600),
        "seconds until the second attempt to connect to a peer that does not answer; the pause doubles each time.",
    ] = 0.1
    reconnect_most: Annotated[
        float, Range(0.001, 3600), "seconds that no pause between attempts to connect is longer than."
    ] = 5.0
    max_connections: Annotated[
        int,
        Range(1, 10_000),
        "links with a connection of their own (`shared=False`) to one endpoint, on an event loop or, blocking, in the",
        "process; one more is refused with `Overloaded`.",
    ] = 8
    interface: Annotated[
        str | None,
        Name("the name of an interface"),
        On("tcp"),
        "name of the network interface to connect through; None leaves it to the routes of the system. TCP only, and",
        "only on systems that support it (Linux).",
    ] = None

    def __post_init__(self) -> None:
        check(self)
        if self.reconnect_first > self.reconnect_most:
            raise ConfigError(
                f"must be at most reconnect_most, {self.reconnect_most:g}, not {self.reconnect_first:g}",
                key="reconnect_first",
            )

    @property
    def hold_seconds(self) -> float:
        """Seconds that an unused connection is kept: infinite for ``forever``, 0 for ``request``."""
        if isinstance(self.hold, Hold):
            return math.inf if self.hold is Hold.FOREVER else 0.0
        return self.hold


def selection(name: "str | LinkSelection | None") -> LinkSelection | None:
    """Return the `LinkSelection` named ``first`` or ``oldest``. None and a `LinkSelection` are returned unchanged.

    Raises:
        ConfigError: the name is another one; the error has the key ``select``.
    """
    if name is None or isinstance(name, LinkSelection):
        return name
    try:
        return LinkSelection(name)
    except ValueError:
        raise ConfigError(f"must be first or oldest, not {name!r}", key="select") from None
