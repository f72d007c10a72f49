"""The interface of responders, which answer the requests of a server, and what they get with each request.

Knows no device, policy or gateway.

1. `Responder.answer` returns the reply or an awaitable of it, or `LATER` (the responder calls `RequestContext.reply`
   once, later), `SILENCE` (the request gets no reply), or a `Forwarding`, which the session begins. It raises `Refusal`
   for a reply with that exception code.
2. `Responder.serves` returns whether a unit is served, with its device where that is in this process. Requests to such
   a device may take the fast path and are not passed to `answer` then (`busway.session.pipeline`).
"""

from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any, Final, Protocol

from ..codes import LAST_SERIAL_UNIT
from ..pdu.fast_answers import DirectModel
from ..pdu.functions import AnyRequest, FunctionTable
from ..pdu.general import ExceptionResponse
from ..pdu.message import Message
from ..pdu.model import Refusal
from .diagnostics import CommunicationState


class Deferral(Enum):
    """What a responder returns instead of a reply: `LATER` (it follows) or `SILENCE` (there is none)."""

    LATER = "later"
    SILENCE = "silence"


LATER: Final = Deferral.LATER
"""The responder will call `RequestContext.reply` exactly once."""
SILENCE: Final = Deferral.SILENCE
"""No reply is sent."""

Replaced = tuple[bytes | None, ...]
"""What a write replaces, an element for each range: items in wire order, or None where they do not exist."""


class ClientIdentity:
    """Who sent a request: the client's address, its certificate and the listener that it uses.

    Attributes:
        peer: ``host:port`` of the client, or the name of a serial line.
        listener: URL of the listener.
        role: role of the client's certificate; None without one.
        is_priority: whether the client is a priority host.
        listener_names: further URLs that rules may use for the listener: as it was configured, and every
            address that it is bound to.
        audit_text: how audit lines name the client; filled in by what writes them.
    """

    __slots__ = ("audit_text", "is_priority", "listener", "listener_names", "peer", "role")

    def __init__(
        self,
        peer: str = "",
        listener: str = "",
        role: str | None = None,
        is_priority: bool = False,
        listener_names: tuple[str, ...] = (),
    ) -> None:
        self.peer: str = peer
        self.listener: str = listener
        self.role: str | None = role
        self.is_priority: bool = is_priority
        self.listener_names: tuple[str, ...] = listener_names
        self.audit_text: str = ""


_UNKNOWN: Final = ClientIdentity()


class Judged:
    """The authorizer's decision about a request, with the rule behind it.

    Attributes:
        rule: name of the rule that permits or denies the request.
        is_denied: whether it is refused.
        is_write: whether the responder is to show what the request replaces, and the audit log records it.
        check: called with what the request replaces; may raise `Refusal`. None permits every value.
        replaced: the values that the request replaces; None if not known.
    """

    __slots__ = ("check", "is_denied", "is_write", "replaced", "rule")

    def __init__(self, rule: str, *, is_denied: bool = False, is_write: bool = False) -> None:
        self.rule: str = rule
        self.is_denied: bool = is_denied
        self.is_write: bool = is_write
        self.check: Callable[[Replaced], None] | None = None
        self.replaced: Replaced | None = None


class RequestContext:
    """Circumstances of one request: client, unit, listener; and the way to give its reply later.

    Attributes:
        client: who sent it; also as ``peer``, ``listener``, ``role`` and ``is_priority``.
        unit: the unit identifier asked, 0…255.
        function: the function code.
        transaction: the identifier of the request; 0 where the framing has none.
        diagnostics: counters, event log and mode of the unit asked.
        executed: for a broadcast, which goes to every unit of a line: ``id`` of each device that has executed it, so
            that a device with several units executes it once. None otherwise.
        gone: called if the client disconnects before its late reply; a responder that returned `LATER` may set it.
        judged: the authorizer's decision about the request; None without an authorizer.
    """

    __slots__ = (
        "_finish",
        "_watchers",
        "client",
        "diagnostics",
        "executed",
        "function",
        "gone",
        "judged",
        "transaction",
        "unit",
    )

    def __init__(
        self,
        *,
        unit: int,
        function: int,
        diagnostics: CommunicationState,
        client: ClientIdentity = _UNKNOWN,
        transaction: int = 0,
        finish: Callable[["RequestContext", Message | Deferral], None] | None = None,
    ) -> None:
        self.unit: int = unit
        self.function: int = function
        self.diagnostics: CommunicationState = diagnostics
        self.client: ClientIdentity = client
        self.transaction: int = transaction
        self.executed: set[int] | None = None
        self.gone: Callable[[], None] | None = None
        self.judged: Judged | None = None
        self._watchers: tuple[Callable[[Message | Deferral | None], None], ...] = ()
        self._finish = finish

    @property
    def peer(self) -> str:
        """The client's address as ``host:port``, or the name of a serial line."""
        return self.client.peer

    @property
    def listener(self) -> str:
        """URL of the listener that received the request."""
        return self.client.listener

    @property
    def role(self) -> str | None:
        """Role that the client's certificate names; None without one."""
        return self.client.role

    @property
    def is_priority(self) -> bool:
        """Whether the client is a priority host."""
        return self.client.is_priority

    def replacing(self, values: Replaced) -> None:
        """Report the old values that a write replaces; the responder calls it in one step with the write.

        There is one element for each range to be written, in the order of `Request.spans` (for file records, for each
        group). Raises `Refusal` where a rule forbids the write because of these values; then it is not executed.
        """
        judged = self.judged
        if judged is not None:
            judged.replaced = values
            if judged.check is not None:
                judged.check(values)

    def inside(self, finish: Callable[["RequestContext", Message | Deferral], None]) -> "RequestContext":
        """Return a context for a responder inside another one; its late reply is given to the function ``finish``."""
        made = RequestContext(
            unit=self.unit,
            function=self.function,
            diagnostics=self.diagnostics,
            client=self.client,
            transaction=self.transaction,
            finish=finish,
        )
        made.executed = self.executed
        made.judged = self.judged
        return made

    @property
    def replied(self) -> bool:
        """Whether the late reply to this request was given, or can no longer be given."""
        return self._finish is None

    def reply(self, reply: Message | Deferral) -> None:
        """Give the reply that `LATER` promised. A second reply, or one after the client left, is ignored."""
        finish, self._finish = self._finish, None
        if finish is not None:
            self.end(reply)
            finish(self, reply)

    def refuse(self, code: int) -> None:
        """Give an exception code as the late reply of this request."""
        self.reply(ExceptionResponse(self.function, code))

    def abandon(self) -> None:
        """Mark the request as abandoned by its client: no reply can be given, and the responder may stop working."""
        self._finish = None
        self.end(None)
        gone, self.gone = self.gone, None
        if gone is not None:
            gone()

    def watch(self, ended: Callable[[Message | Deferral | None], None]) -> None:
        """Register a function called once with the outcome: reply, `SILENCE`, or None if the client leaves before."""
        self._watchers = (*self._watchers, ended)

    def end(self, outcome: Message | Deferral | None) -> None:
        """Report the outcome of this request to its watchers, unless that was done before."""
        watchers, self._watchers = self._watchers, ()
        for ended in watchers:
            ended(outcome)


class ForwardingTarget(Protocol):
    """Interface of a unit on another server to which requests are forwarded."""

    def ask(self, asker: Any, tags: Sequence[Any], asked: Sequence[Any]) -> None:  # Any: of `Forwarding`, or of reads
        """Forward a request. ``asker`` gets the answer, possibly before this method returns."""


class ForwardedMessage(Protocol):
    """A request as it is sent to another server, with the translation of its reply for the client."""

    def of_data(self, data: bytes) -> Message:
        """Return the client's reply to a read, built from the data that the other server sent."""

    def client_reply(self, reply: Message) -> Message:
        """Return the client's reply, translated from the reply of the other server."""


class Forwarding:
    """A request that a gateway forwards to one or more targets, with the client that waits for its answer.

    The session begins it: ``ask`` of each target, with `ALONE`. When all have answered, the client gets the reply.

    Args:
        context: the request.
        asks: the requests to each target.
        reply: answers the request unless a target refuses it; None for the reply of the only target.

    Attributes:
        asks: as above.
        peer, is_priority: the client.
        batches: the batches with its requests, which add and remove themselves.
    """

    __slots__ = ("_context", "_left", "_reply", "asks", "batches", "is_priority", "peer")

    def __init__(
        self,
        context: RequestContext,
        asks: tuple[tuple[ForwardingTarget, ForwardedMessage], ...],
        reply: Message | Deferral | None = None,
    ) -> None:
        client = context.client
        self.peer: str = client.peer
        self.is_priority: bool = client.is_priority
        self.asks: tuple[tuple[ForwardingTarget, ForwardedMessage], ...] = asks
        self.batches: dict[Any, None] = {}  # Any: batches are the gateway's
        self._context = context
        self._left = len(asks)
        self._reply = reply
        context.gone = self._client_gone

    def answer(self, tags: Sequence[None], asked: Sequence[ForwardedMessage], data: Sequence[bytes]) -> None:
        """Answer the client with data that were read upstream."""
        self._answered(asked[0].of_data(data[0]))

    def reply(self, tag: None, asked: ForwardedMessage, reply: Message) -> None:
        """Answer the client with the reply of the server to which the request was forwarded."""
        self._answered(asked.client_reply(reply))

    def refuse(self, tag: None, asked: ForwardedMessage, code: int) -> None:
        """Answer the client of a forwarded request with an exception code."""
        self._reply = None
        self._answered(ExceptionResponse(self._context.function, code))

    def send(self) -> None:
        """Do nothing: the answer to a single request was sent when it was given."""

    def _answered(self, reply: Message) -> None:
        if self._reply is None:
            self._reply = reply
        self._left -= 1
        if not self._left:
            self._context.gone = None
            self._context.reply(self._reply)

    def _client_gone(self) -> None:
        for batch in list(self.batches):
            batch.asker_gone(self)


ALONE: Final = (None,)
"""The tag of a request that is forwarded by itself."""
Outcome = Message | Awaitable[Message] | Deferral | Forwarding


class DirectDevice(DirectModel, Protocol):
    """Interface of a device in this process whose memory can be read and written without the responder, for speed."""

    def enabled(self, code: int) -> bool:
        """Whether the device offers the function with this code."""


@dataclass(frozen=True, slots=True)
class ServedUnit:
    """A unit for which a responder answers, with its device if that can be used directly, for speed.

    Attributes:
        unit: the unit as which its device is configured; the first where a sole device has several.
        device: the device, if it is one of this process: then `Responder.answer` calls `RequestContext.replacing`
            before it executes a write.
        is_direct: whether requests may reach the device by the fast path.
        units: all units as which its device is configured; ``unit`` alone where nothing is said. Rules about any of
            them hold, also where the device answers as yet others, such as 0 and 255: a client denied on unit 1 must
            not reach the same device by another unit.
    """

    unit: int
    device: DirectDevice | None = None
    is_direct: bool = True
    units: frozenset[int] = frozenset()

    def __post_init__(self) -> None:
        if not self.units:
            object.__setattr__(self, "units", frozenset((self.unit,)))


class Responder(Protocol):
    """Interface of the object that answers a server's requests: devices, or a gateway."""

    @property
    def functions(self) -> FunctionTable:
        """The table of function codes, with their messages, that the responder knows."""

    @property
    def generation(self) -> int:
        """A number that changes when earlier results of `serves`, or answers compiled from them, are out of date."""

    def serves(self, unit: int) -> ServedUnit | None:
        """Return the unit that answers requests to ``unit``, 0…255; None if there is none."""

    def answer(self, context: RequestContext, request: AnyRequest) -> Outcome:
        """Return the reply to a request, or `LATER` or `SILENCE`. Requests to unknown units come here too (rule 1)."""


class SerialUnits:
    """The units 1…247 for which a responder answers on a serial line; follows changes of its configuration."""

    def __init__(self, responder: Responder) -> None:
        self._responder = responder
        self._renew()

    def __contains__(self, unit: object) -> bool:
        if self._generation != self._responder.generation:
            self._renew()
        return unit in self._units

    def _renew(self) -> None:
        self._generation = self._responder.generation
        served = {unit: self._responder.serves(unit) for unit in range(1, LAST_SERIAL_UNIT + 1)}
        self._units = frozenset(unit for unit, one in served.items() if one is not None and one.unit == unit)


__all__ = [
    "ALONE",
    "LATER",
    "SILENCE",
    "ClientIdentity",
    "Deferral",
    "DirectDevice",
    "ForwardedMessage",
    "Forwarding",
    "ForwardingTarget",
    "Judged",
    "Outcome",
    "Refusal",
    "Replaced",
    "RequestContext",
    "Responder",
    "SerialUnits",
    "ServedUnit",
]
