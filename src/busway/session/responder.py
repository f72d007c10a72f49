"""The interface of responders, which answer the requests of a server, and what they get with each request.

Knows no device, policy or gateway.

1. `Responder.answer` returns the reply or an awaitable of it, or `LATER` (the responder calls `RequestContext.reply`
   once, later), `SILENCE` (the request gets no reply), or a `Forwarding`, whose requests the session sends. It raises
   `Refusal` for an exception reply with the code of the `Refusal`.
2. `Responder.serves` returns whether a unit is served, with its device if the device is in this process. Requests to
   such a device may take the fast path; then they are not passed to `answer` (`busway.session.server_pipeline`).
"""

from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any, Final, Protocol

from ..codes import LAST_SERIAL_UNIT
from ..options.networks import host_of_peer, peer_name
from ..pdu.device_interface import Refusal
from ..pdu.exception_response import ExceptionResponse
from ..pdu.fast_answers import DirectModel
from ..pdu.functions import AnyRequest, FunctionTable
from ..pdu.message import Message
from .diagnostic_counters import CommunicationState


class Deferral(Enum):
    """What a responder returns instead of a reply: `LATER` (the reply follows) or `SILENCE` (there is no reply)."""

    LATER = "later"
    SILENCE = "silence"


LATER: Final = Deferral.LATER
"""Returned by a responder that will call `RequestContext.reply` exactly once."""
SILENCE: Final = Deferral.SILENCE
"""Returned by a responder for a request that gets no reply."""

Replaced = tuple[bytes | None, ...]
"""The old values that a write replaces, one element for each range it writes.

An element has the items in wire order; it is None if they do not exist.
"""


class ClientIdentity:
    """Who sent a request: the client's address, the role in its certificate, and the listener that it uses.

    Attributes:
        listener: URL of the listener.
        role: role of the client's certificate; None without one.
        is_priority: whether the client is a priority host.
        listener_names: further URLs that access rules may use for the listener: its URL as configured, and one for
            every address that it is bound to.
        audit_text: text for the client in lines of the audit log; set by the audit log, empty before.
    """

    __slots__ = ("_peer", "audit_text", "is_priority", "listener", "listener_names", "role")

    def __init__(
        self,
        peer: str | tuple[object, ...] = "",
        listener: str = "",
        role: str | None = None,
        is_priority: bool = False,
        listener_names: tuple[str, ...] = (),
    ) -> None:
        self._peer = peer
        self.listener: str = listener
        self.role: str | None = role
        self.is_priority: bool = is_priority
        self.listener_names: tuple[str, ...] = listener_names
        self.audit_text: str = ""

    @property
    def peer(self) -> str:
        """``host:port`` of the client, or the name of a serial line."""
        peer = self._peer
        if isinstance(peer, tuple):  # made when it is needed: most connections never need a text of 64 bytes
            peer = self._peer = peer_name(peer)
        return peer

    @property
    def host(self) -> str:
        """The host of the client, or the name of a serial line, as access rules compare it (`host_of_peer`)."""
        peer = self._peer
        return host_of_peer(peer_name(peer) if isinstance(peer, tuple) else peer)


_UNKNOWN: Final = ClientIdentity()


class Judged:
    """The authorizer's decision about a request, and the rule that decided it.

    Attributes:
        rule: name of the rule that permits or denies the request.
        is_denied: whether the request is refused.
        is_write: whether the request is a write: then the responder reports the values it replaces
            (`RequestContext.replacing`), and the audit log records the write.
        check: function of the authorizer, called with the values that the request replaces; it raises `Refusal` to
            forbid the write. None: every value may be replaced.
        replaced: the values that the request replaces, set by `RequestContext.replacing`; None before that.
    """

    __slots__ = ("check", "is_denied", "is_write", "replaced", "rule")

    def __init__(self, rule: str, *, is_denied: bool = False, is_write: bool = False) -> None:
        self.rule: str = rule
        self.is_denied: bool = is_denied
        self.is_write: bool = is_write
        self.check: Callable[[Replaced], None] | None = None
        self.replaced: Replaced | None = None


class RequestContext:
    """What a responder gets with a request: client, unit and listener, and methods to reply later.

    Attributes:
        client: who sent the request; also as ``peer``, ``listener``, ``role`` and ``is_priority``.
        unit: the unit identifier asked, 0…255.
        function: the function code.
        transaction: the transaction identifier of the request; 0 where the framing has none.
        diagnostics: counters, event log and mode of the unit asked.
        executed: for a broadcast, which goes to every unit of a line: ``id`` of each device that has executed it, so
            that a device with several units executes it once. None for other requests.
        gone: function to call if the client disconnects before its late reply; a responder that returns `LATER` can
            set it. None: nothing is called.
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
        """Report the old values that a write replaces. For responders: call it under the lock of the write, before it.

        Does nothing without an authorizer.

        Args:
            values: for each range of `Request.spans`, for file records for each group, the old bytes in wire order, or
                None if the range does not exist.

        Raises:
            Refusal: a rule forbids the write because of these values: do not write then.
        """
        judged = self.judged
        if judged is not None:
            judged.replaced = values
            if judged.check is not None:
                judged.check(values)

    def inside(self, finish: Callable[["RequestContext", Message | Deferral], None]) -> "RequestContext":
        """Return a copy of this context, for a responder that passes the request on to another responder.

        A late reply given to the copy is passed to ``finish`` and not to the client.
        """
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
        """Whether the request has its reply, or has ended without one: then a late reply is ignored."""
        return self._finish is None

    def reply(self, reply: Message | Deferral) -> None:
        """Give the late reply to a request for which `LATER` was returned; `SILENCE` ends it without a reply.

        A second reply, or one after the client left, is ignored.
        """
        finish, self._finish = self._finish, None
        if finish is not None:
            self.end(reply)
            finish(self, reply)

    def refuse(self, code: int) -> None:
        """Give an exception code as the late reply of this request."""
        self.reply(ExceptionResponse(self.function, code))

    def abandon(self) -> None:
        """Mark the request as abandoned by its client: later replies are ignored, and ``gone`` is called if it is set.

        The functions registered with `watch` get the outcome None.
        """
        self._finish = None
        self.end(None)
        gone, self.gone = self.gone, None
        if gone is not None:
            gone()

    def watch(self, ended: Callable[[Message | Deferral | None], None]) -> None:
        """Register a function to be called once with the outcome of this request.

        The outcome is the reply, `SILENCE`, or None if the client disconnects first.
        """
        self._watchers = (*self._watchers, ended)

    def end(self, outcome: Message | Deferral | None) -> None:
        """Report the outcome of this request to the functions registered with `watch`; later calls do nothing."""
        watchers, self._watchers = self._watchers, ()
        for ended in watchers:
            ended(outcome)


class ForwardingTarget(Protocol):
    """Interface of a unit on another server to which requests are forwarded."""

    def ask(self, asker: Any, tags: Sequence[Any], asked: Sequence[Any]) -> None:  # Any: of `Forwarding`, or of reads
        """Forward the requests in ``asked``; the results are reported to ``asker``.

        For each request a method of ``asker`` is called, possibly before this method returns: ``answer`` with data (of
        several requests at once), ``reply`` with a message, or ``refuse`` with an exception code. It gets the request,
        and the element of ``tags`` at the same position, which identifies the request for ``asker``. After these calls
        ``send`` of ``asker`` is called.
        """


class ForwardedMessage(Protocol):
    """Interface of a request in the form in which it is sent to another server; translates the reply for the client."""

    def of_data(self, data: bytes) -> Message:
        """Return the client's reply to a read, built from the data that the other server sent."""

    def client_reply(self, reply: Message) -> Message:
        """Return the client's reply, translated from the reply of the other server."""


class Forwarding:
    """A request that a gateway forwards to one or more targets; it collects their answers and replies to the client.

    The session that gets it from `Responder.answer` calls ``ask`` of each target, with this object as ``asker``. Each
    target calls `answer`, `reply` or `refuse`. After the last of these calls the client gets the reply.

    Args:
        context: the request of the client.
        asks: each target with the request to it.
        reply: the client's reply unless a target refuses the request; None: the reply of the first target that answers.

    Attributes:
        asks: as given.
        peer, is_priority: the client's address, and whether it is a priority host.
        batches: the gateway's batches that contain its requests; they add and remove themselves.
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
        """Called by a target with the data that it has read: the client's reply is built from them.

        The sequences have one element each: None, the request, and its data.
        """
        self._answered(asked[0].of_data(data[0]))

    def reply(self, tag: None, asked: ForwardedMessage, reply: Message) -> None:
        """Called by a target with the reply of the other server, which is translated for the client."""
        self._answered(asked.client_reply(reply))

    def refuse(self, tag: None, asked: ForwardedMessage, code: int) -> None:
        """Called by a target that refused the request.

        After all targets have answered, the client gets an exception reply with this code, even if others accepted the
        request; of several codes, with the last one.
        """
        self._reply = None
        self._answered(ExceptionResponse(self._context.function, code))

    def send(self) -> None:
        """Do nothing: the client gets its only reply as soon as the last target has answered.

        Targets call this method of every asker after their answers, so that several answers can be sent together.
        """

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
"""The argument ``tags`` of `ForwardingTarget.ask` for a single request."""
ResponderAnswer = Message | Awaitable[Message] | Deferral | Forwarding


class DirectDevice(DirectModel, Protocol):
    """Interface of a device in this process whose memory can be read and written without the responder, for speed."""

    def enabled(self, code: int) -> bool:
        """Whether the device offers the function with this code."""


@dataclass(frozen=True, slots=True)
class ServedUnit:
    """A unit for which a responder answers, with its device if that can be used directly, for speed.

    Attributes:
        unit: the unit asked, if it is configured. For a number under which a sole device answers besides (0, 255, or
            any other), the first unit that is configured for the device.
        device: the device if it is in this process, else None. With a device, `Responder.answer` calls
            `RequestContext.replacing` before it executes a write.
        is_direct: whether requests may reach the device by the fast path.
        units: all configured units of its device; ``unit`` alone if left out. A rule about one of them holds for the
            device under every number, also where it answers as 0 and 255: a client denied on unit 1 must not reach the
            same device by another unit.
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

    def answer(self, context: RequestContext, request: AnyRequest) -> ResponderAnswer:
        """Return the reply to a request, or an object that stands for a later reply or for none.

        An awaitable of the reply: it is awaited. `LATER`: the responder calls `RequestContext.reply` once, later.
        `SILENCE`: there is no reply. A `Forwarding`: the session sends its requests to their targets. Called for
        requests to unknown units as well.

        Raises:
            Refusal: the client gets an exception reply with the code of the `Refusal`.
        """


class SerialUnits:
    """The units 1…247 that are configured at a responder, as a container for ``in``.

    A number under which a device only answers besides (unit policy ``any``) is not among them. Changes of the responder
    take effect at once.
    """

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
    "Refusal",
    "Replaced",
    "RequestContext",
    "Responder",
    "ResponderAnswer",
    "SerialUnits",
    "ServedUnit",
]
