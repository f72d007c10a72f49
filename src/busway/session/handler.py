"""What answers requests, seen from the conversation: one protocol of four members.

Knows the shape of a handler; knows no device, policy or gateway. Those are handlers.

1. `Handler.handle` gives the reply, an awaitable of it, `LATER` (then `RequestContext.reply` is called once), or
   `SILENCE`. Raising `Refusal` answers with its exception code.
2. `Handler.direct` offers the short road for a unit: function code → compiled answer. What it leaves out takes the
   long road. ``generation`` changes whenever an offer made earlier is no longer right.
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
    """The two outcomes that carry no reply."""

    LATER = "later"
    SILENCE = "silence"


LATER: Final = Deferral.LATER
"""The handler will call `RequestContext.reply` exactly once."""
SILENCE: Final = Deferral.SILENCE
"""No reply is sent."""

Outcome = Message | Awaitable[Message] | Deferral


class RequestContext:
    """Who asks, by which way; and where a late reply goes.

    Attributes:
        peer: ``host:port`` of the client, or the name of a serial line.
        listener: URL of the listener that the request came by.
        role: role of the client's certificate; None without one.
        unit: the unit identifier asked, 0…255.
        transaction: the identifier of the request; 0 where the framing has none.
        diagnostics: counters, event log and mode of the unit asked.
        executed: of a broadcast, which goes to every unit of a line: the ids of what has executed it, so that a device
            with several units does it once. None otherwise.
        gone: called if the client goes away while a late reply is awaited; whoever promised `LATER` may set it.
    """

    __slots__ = (
        "_finish",
        "_gone_seen",
        "diagnostics",
        "executed",
        "function",
        "gone",
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
    ) -> None:
        self.unit = unit
        self.function = function
        self.diagnostics = diagnostics
        self.peer = peer
        self.listener = listener
        self.role = role
        self.transaction = transaction
        self.executed: set[int] | None = None
        self.gone: Callable[[], None] | None = None
        self._gone_seen: tuple[Callable[[], None], ...] = ()
        self._finish = finish

    def abandon(self) -> None:
        """The client has gone, or has given up: no reply can be given any more, and who works on one may stop."""
        self._finish = None
        watchers, self._gone_seen = self._gone_seen, ()
        for seen in watchers:
            seen()
        gone, self.gone = self.gone, None
        if gone is not None:
            gone()

    def watch(self, seen: Callable[[Message | Deferral], None], *, gone: Callable[[], None] | None = None) -> None:
        """Have ``seen`` called with the late reply, just before it goes its way; not where none can be given.

        ``gone`` is called instead if the client goes away first.
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
        """Whether the late reply was given already, or can not be given any more."""
        return self._finish is None

    def reply(self, reply: Message | Deferral) -> None:
        """Give the reply that `LATER` promised; a second call does nothing. A client that has gone gets nothing."""
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
        """Changes when offers of ``direct`` end."""

    def direct(self, context: RequestContext) -> Mapping[int, Answer]:
        """The short road for the unit, peer and role of ``context``; empty where there is none."""

    def handle(self, context: RequestContext, request: AnyRequest) -> Outcome:
        """The long road."""


@runtime_checkable
class ReadPlanner(Protocol):
    """A handler that lets reads be planned (`busway.pdu.direct.ReadPlan`)."""

    def plans(self, context: RequestContext) -> dict[bytes, ReadPlan]:
        """The plans for whoever has the rights of ``context``, of all units; shared by all who have the same."""

    def plan(self, context: RequestContext, pdu: bytes) -> ReadPlan | None:
        """The plan of a read that was just answered by the short road, or None."""


@runtime_checkable
class WriteObserver(Protocol):
    """A handler that shows what a write replaces, and executes it in one step with the look at it."""

    def observe_write(
        self, context: RequestContext, request: Request, see: Callable[[tuple[bytes | None, ...]], None]
    ) -> Outcome:
        """As ``handle``; just before the request is executed, ``see`` is called with what it would replace.

        That is one element for each range that it writes, in the order of `Request.spans`, of file records for each
        group: the items in wire order, or None where they do not exist. Nothing else is executed between the look and
        the request. If ``see`` raises `Refusal`, the request is not executed. ``see`` is not called for what is refused
        before.
        """


@runtime_checkable
class UnitHolder(Protocol):
    """A handler that says which units it answers for: what a serial line needs, where nobody speaks for others."""

    @property
    def serial_units(self) -> Container[int]:
        """The units 1…247 that are its own; a live view is welcome."""


@runtime_checkable
class ListedUnits(Protocol):
    """A handler whose devices may answer to other units than those they are listed as."""

    def listed_unit(self, unit: int) -> int:
        """The unit as which the device is listed that answers for ``unit``; ``unit`` itself where that is so.

        Rights are asked for both: whoever may not write to unit 1 shall not do it by another name of the same device.
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
