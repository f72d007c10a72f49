"""Options of client and server sessions, checked at construction."""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from types import MappingProxyType

from ..errors import ConfigError
from ..pdu.wide import NARROW, WIDEST


class MismatchPolicy(Enum):
    """What a client does with a reply whose transaction or unit is not the one asked.

    Attributes:
        STRICT: a foreign transaction is dropped and counted; a foreign unit is a broken reply.
        AUTOMATIC: taken if exactly one request is in flight and all else fits; every timeout ends the connection.
        IGNORE: taken for the one request in flight if function and length fit; every timeout ends the connection.
    """

    STRICT = "strict"
    AUTOMATIC = "automatic"
    IGNORE = "ignore"


class Scope(Enum):
    """Scope of a server's limit of transactions."""

    CONNECTION = "connection"
    SERVER = "server"


class TransactionScope(Enum):
    """Scope of a client's limit of transactions.

    Attributes:
        CONNECTION: the limit applies to each connection.
        CLIENT: it applies to all connections of a client together: those of an event loop, or the blocking ones of the
            process.
    """

    CONNECTION = "connection"
    CLIENT = "client"


TIMEOUT_BY_FRAMING: Mapping[str, float] = MappingProxyType({"mbap": 3.0, "rtu": 1.0, "ascii": 1.0})
"""The default of ``timeout``, by the framing of an endpoint. Behind TCP, TLS and UDP there may be a gateway: it answers
within `CLIENT_DEADLINE`, so that its client gets exception 0A or 0B before its own timeout."""
CLIENT_DEADLINE = 2.5
"""Default seconds within which a gateway answers a request: one second on a line and one more for the repetition, and
half a second less than its clients wait."""


def _within(key: str, value: float, low: float, high: float) -> None:
    if not low <= value <= high:
        raise ConfigError(f"must be {low:g}…{high:g}, not {value:g}", key=key)


@dataclass(frozen=True, slots=True)
class ClientParameters:
    """Options of a client session.

    Attributes:
        timeout: seconds from the last byte of a request to the last of its reply, per attempt. The default depends on
            the framing of the endpoint.
        retries: further attempts of a read after a timeout or a lost connection.
        write_retries: further attempts of a write that may have been executed. 0 unless every write is idempotent.
        deadline: seconds a call may take in all, waiting in the queue included; None for no limit.
        max_transactions: NumberMaxOfClientTransaction, 1…16 requests in flight.
        scope: whether that limit applies to each connection, or to all of the client together (Messaging on TCP/IP
            V1.0b §4.4.1.1): those of an event loop, or the blocking ones of the process.
        queue: calls that may wait on a link; one more is refused with `Overloaded`.
        transaction_policy, unit_policy: how replies that name another transaction or unit are handled.
        recycle_after_timeouts: timeouts in a row, without any reply, after which the connection is closed and opened
            again; twice as many while only late replies come.
        recycle_after_foreign: replies of foreign transactions in a row after which the connection is closed and opened
            again.
        join: whether requests made in one turn of the event loop leave in one segment instead of one each.
        single_adu_segments: whether even the requests of `execute_many` leave one by one, as Messaging on TCP/IP
            V1.0b §4.3.2 advises.
        connect_delay: seconds to wait after connecting before the first request.
        request_gap: seconds from the end of a reply to the next request.
        register_width: bytes of one register in replies to reads of registers, an even number 2…12. 2 is the rule;
            some devices have wider ones, and `Unit.read`, `Unit.read_holding_registers` and
            `Unit.read_input_registers` read them so.
    """

    timeout: float = TIMEOUT_BY_FRAMING["rtu"]
    retries: int = 1
    write_retries: int = 0
    deadline: float | None = None
    max_transactions: int = 1
    scope: TransactionScope = TransactionScope.CONNECTION
    queue: int = 64
    transaction_policy: MismatchPolicy = MismatchPolicy.STRICT
    unit_policy: MismatchPolicy = MismatchPolicy.STRICT
    recycle_after_timeouts: int = 3
    recycle_after_foreign: int = 16
    join: bool = False
    single_adu_segments: bool = False
    connect_delay: float = 0.0
    request_gap: float = 0.0
    register_width: int = NARROW

    def __post_init__(self) -> None:
        _within("timeout", self.timeout, 0.001, 3600)
        _within("retries", self.retries, 0, 100)
        _within("write_retries", self.write_retries, 0, 100)
        if self.deadline is not None:
            _within("deadline", self.deadline, 0.001, 86_400)
        _within("max_transactions", self.max_transactions, 1, 16)
        _within("queue", self.queue, 1, 65_536)
        _within("recycle_after_timeouts", self.recycle_after_timeouts, 1, 1000)
        _within("recycle_after_foreign", self.recycle_after_foreign, 1, 1000)
        _within("connect_delay", self.connect_delay, 0, 60)
        _within("request_gap", self.request_gap, 0, 60)
        _within("register_width", self.register_width, NARROW, WIDEST)
        if self.register_width % 2:
            raise ConfigError(f"must be even, not {self.register_width}", key="register_width")
        if not isinstance(self.scope, TransactionScope):
            raise ConfigError(f"must be connection or client, not {self.scope!r}", key="scope")
        for key in ("transaction_policy", "unit_policy"):
            if not isinstance(getattr(self, key), MismatchPolicy):
                allowed = ", ".join(policy.value for policy in MismatchPolicy)
                raise ConfigError(f"must be one of {allowed}, not {getattr(self, key)!r}", key=key)
        if self.join and self.single_adu_segments:
            raise ConfigError("does not go with single_adu_segments", key="join")
        if self.transaction_policy is MismatchPolicy.IGNORE and self.max_transactions > 1:
            raise ConfigError("ignore goes with max_transactions 1 only", key="transaction_policy")


@dataclass(frozen=True, slots=True)
class ServerParameters:
    """Options of a server session.

    Attributes:
        max_transactions: NumberMaxOfServerTransaction, 1…16 requests that may be waiting for a slow handler.
        scope: whether that limit applies to the server or to each connection.
        diagnostics_changes: whether sub-functions of 08 that change the listener (01, 03, 04, 0A, 14) are offered;
            None: on serial lines, but not over a network, where one packet could mute the server for all clients.
    """

    max_transactions: int = 16
    scope: Scope = Scope.CONNECTION
    diagnostics_changes: bool | None = None

    def __post_init__(self) -> None:
        _within("max_transactions", self.max_transactions, 1, 16)
        if not isinstance(self.scope, Scope):
            raise ConfigError(f"must be connection or server, not {self.scope!r}", key="scope")
