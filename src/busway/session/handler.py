"""The interface of request handlers, which server sessions call: one protocol of four members.

Knows no device, policy or gateway; those are handlers.

1. `Handler.handle` gives the reply, an awaitable of it, `LATER` (then `RequestContext.reply` is called once), or
   `SILENCE`. Raising `Refusal` answers with its exception code.
2. `Handler.direct` gives the fast path for a unit: function code → compiled answer. Functions missing there take the
   generic path. ``generation`` changes whenever an earlier result of ``direct`` is no longer valid.
"""

from collections.abc import Awaitable, Callable, Container, Mapping
from enum import Enum
from typing import Final, Protocol, runtime_checkable

from ..pdu.direct import Answer, ReadPlan
from ..pdu.functions import AnyRequest, FunctionTable
from ..pdu.general import ExceptionResponse
from ..pdu.message import Message, Request
from ..pdu.model import Refusal
from .diagnostics import CommunicationState


class Deferral(Enum):
    """The two outcomes of a handler that carry no reply: `LATER` and `SILENCE`."""

    LATER = "later"
    SILENCE = "silence"


LATER: Final = Deferral.LATER
"""The handler will call `RequestContext.reply` exactly once."""
SILENCE: Final = Deferral.SILENCE
"""No reply is sent."""

Outcome = Message | Awaitable[Message] | Deferral


class RequestContext:
    """The client, unit and listener of one request, and the way to give a late reply.

    Attributes:
        peer: ``host:port`` of the client, or the name of a serial line.
        listener: URL of the listener that received the request.
        role: role of the client's certificate; None without one.
        unit: the unit identifier asked, 0…255.
        transaction: the identifier of the request; 0 where the framing has none.
        diagnostics: counters, event log and mode of the unit asked.
        is_priority: whether the client is a priority host.
        executed: for a broadcast, which goes to every unit of a line: ``id`` of each device that has executed it, so
            that a device with several units executes it once. None otherwise.
        gone: called if the client disconnects before its late reply; a handler that returned `LATER` may set it.
    """

    __slots__ = (
        "_finish",
        "_gone_seen",
        "diagnostics",
        "executed",
        "function",
        "gone",
        "is_priority",
        "listener",
        "peer",
        "role",
        "transaction",
        "unit",
    )

    def __init__(
        self,
        *,
        unit: int,
        function: int,
        diagnostics: CommunicationState,
        peer: str = "",
        listener: str = "",
        role: str | None = None,
        transaction: int = 0,
        finish: Callable[["RequestContext", Message | Deferral], None] | None = None,
        is_priority: bool = False,
    ) -> None:
        self.unit: int = unit
        self.function: int = function
        self.diagnostics: CommunicationState = diagnostics
        self.peer: str = peer
        self.listener: str = listener
        self.role: str | None = role
        self.transaction: int = transaction
        self.is_priority: bool = is_priority
        self.executed: set[int] | None = None
        self.gone: Callable[[], None] | None = None
        self._gone_seen: tuple[Callable[[], None], ...] = ()
        self._finish = finish

    def abandon(self) -> None:
        """The client disconnected or gave up: no reply can be given any more, and work on it may stop."""
        self._finish = None
        watchers, self._gone_seen = self._gone_seen, ()
        for seen in watchers:
            seen()
        gone, self.gone = self.gone, None
        if gone is not None:
            gone()

    def watch(self, seen: Callable[[Message | Deferral], None], *, gone: Callable[[], None] | None = None) -> None:
        """Have ``seen`` called with the late reply just before it is sent; does nothing if none can be given any more.

        ``gone`` is called instead if the client disconnects first.
        """
        finish = self._finish
        if finish is None:
            return
        if gone is not None:
            self._gone_seen = (*self._gone_seen, gone)

        def finish_seen(context: RequestContext, reply: Message | Deferral) -> None:
            seen(reply)
            finish(context, reply)

        self._finish = finish_seen

    @property
    def replied(self) -> bool:
        """Whether the late reply was given, or cannot be given any more."""
        return self._finish is None

    def reply(self, reply: Message | Deferral) -> None:
        """Give the reply that `LATER` promised. Does nothing the second time, or after the client disconnected."""
        finish, self._finish = self._finish, None
        if finish is not None:
            finish(self, reply)

    def refuse(self, code: int) -> None:
        """Give an exception code as the late reply."""
        self.reply(ExceptionResponse(self.function, code))


class Handler(Protocol):
    """Answers requests."""

    @property
    def functions(self) -> FunctionTable:
        """The functions it decodes."""

    @property
    def generation(self) -> int:
        """A number that changes when earlier results of ``direct`` become invalid."""

    def direct(self, context: RequestContext) -> Mapping[int, Answer]:
        """The compiled answers by function code for unit, peer and role of ``context``; empty without a fast path."""

    def handle(self, context: RequestContext, request: AnyRequest) -> Outcome:
        """Answer any request: the generic path (rule 1)."""


@runtime_checkable
class ReadPlanner(Protocol):
    """A handler whose reads can be cached as plans (`busway.pdu.direct.ReadPlan`)."""

    def plans(self, context: RequestContext) -> dict[bytes, ReadPlan]:
        """The plans, for all units, that all clients with the same rights as ``context`` share."""

    def plan(self, context: RequestContext, pdu: bytes) -> ReadPlan | None:
        """The plan of a read that the fast path has just answered, or None if it cannot be cached."""


@runtime_checkable
class WriteObserver(Protocol):
    """A handler that reports the values a write replaces, atomically with the write."""

    def observe_write(
        self, context: RequestContext, request: Request, see: Callable[[tuple[bytes | None, ...]], None]
    ) -> Outcome:
        """As ``handle``, but call ``see`` with the current values just before the request is executed.

        ``see`` gets one element for each range to be written, in the order of `Request.spans` (for file records, for
        each group): the items in wire order, or None where they do not exist. Nothing else is executed in between.
        If ``see`` raises `Refusal`, the request is not executed. ``see`` is not called for requests refused earlier.
        """


@runtime_checkable
class UnitHolder(Protocol):
    """A handler that lists the units it answers for: a serial line needs that, because other devices share it."""

    @property
    def serial_units(self) -> Container[int]:
        """The units 1…247 that this handler answers for; it may be a live view."""


@runtime_checkable
class ListedUnits(Protocol):
    """A handler whose devices may answer as more units than the one they are configured as."""

    def listed_unit(self, unit: int) -> int:
        """The configured unit of the device that answers for ``unit``; often ``unit`` itself.

        Rights are checked for both: a client denied on unit 1 must not reach the same device by another unit.
        """


__all__ = [
    "LATER",
    "SILENCE",
    "Deferral",
    "Handler",
    "ListedUnits",
    "Outcome",
    "ReadPlanner",
    "Refusal",
    "RequestContext",
    "UnitHolder",
    "WriteObserver",
]
