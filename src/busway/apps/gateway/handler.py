"""One listener of a gateway: each request to the upstream that its route names, or to the gateway itself.

Knows routes, upstreams and the gateway's own unit; knows no bytes (Messaging on TCP/IP V1.0b §4.4.2, T32).

1. A write to unit 0 goes to all upstreams of the listener that take broadcasts, and is answered once it was sent. An
   upstream takes it only where a route lets the listener write so to each of its units, and the policy the client:
   all of them will hear it.
2. What no route takes on 0 and on the own unit is the gateway's; on any other unit there is no path: 0A. A serial
   listener is silent there, because it never hears of those units (`ListenerHandler.serial_units`).
3. A request that breaks a rule of its function is answered as any server would, and not forwarded: a serial line could
   not frame it. A function that is not known is forwarded unread.
"""

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from typing import Final

from ...codes import BROADCAST_UNIT, LAST_SERIAL_UNIT, TCP_DEVICE_UNIT, ExceptionCode
from ...errors import InvalidRequest
from ...pdu.direct import Answer
from ...pdu.functions import AnyRequest, FunctionTable
from ...pdu.general import ExceptionResponse, MalformedRequest
from ...pdu.message import Message, Request
from ...pdu.read_items import ReadBits, ReadRegisters
from ...session.forwarding import ForwardPlan, ForwardPlans
from ...session.handler import LATER, SILENCE, Deferral, Handler, Outcome, RequestContext
from .read_batches import ReadTarget, batch_plan
from .routes import ListenerRoutes, Route, RouteAction, Straddles
from .translation import echo, upstream_requests
from .upstream import Upstream

_NO_PATH: Final = ExceptionCode.GATEWAY_PATH_UNAVAILABLE


@dataclass(slots=True)
class GatewayListenerCounters:
    """What became of the requests of a listener that no upstream has counted.

    Attributes:
        no_route: requests for which there is no route.
        refused: requests that a route refuses.
        dropped: requests that a route drops.
        own: requests to the gateway itself.
        malformed: requests that broke a rule of their function.
        broadcasts: writes to all units.
    """

    no_route: int = 0
    refused: int = 0
    dropped: int = 0
    own: int = 0
    malformed: int = 0
    broadcasts: int = 0


RefusalOf = Callable[[RequestContext, AnyRequest, Collection[int], set[int]], int]
"""Client, request, units that it reaches and marks of what has counted it already → the exception code by which a
policy refuses it, 0 for none."""


def _no_refusal(context: RequestContext, request: AnyRequest, units: Collection[int], charged: set[int]) -> int:
    return 0


class ListenerHandler:
    """The handler of one listener.

    Attributes:
        refusal_of: what a policy around it says of single units that hear a broadcast.

    Args:
        name: what routes call the listener.
        functions: the table of functions; what is not in it is forwarded unread.
        own: what answers for the gateway itself; None where it is no device.
        own_unit: its unit identifier.
        deadline: seconds after which a client of this listener has given up; None if that is not known.
        silent_broadcasts: whether a broadcast gets no answer.
    """

    def __init__(
        self,
        name: str,
        functions: FunctionTable,
        *,
        own: Handler | None = None,
        own_unit: int = TCP_DEVICE_UNIT,
        deadline: float | None = None,
        silent_broadcasts: bool = False,
    ) -> None:
        self.name = name
        self.functions = functions
        self.generation = 0
        self.counters = GatewayListenerCounters()
        self.deadline = deadline
        self.silent_broadcasts = silent_broadcasts
        self._own = own
        self._own_unit = own_unit
        self.refusal_of: RefusalOf = _no_refusal
        self._routes = ListenerRoutes(())
        self._upstreams: Mapping[str, Upstream] = {}
        self._serial_units: set[int] = set()
        self._plans = ForwardPlans()
        self._ways: dict[tuple[str, int, float | None], ReadTarget] = {}

    def follow(self, routes: ListenerRoutes, upstreams: Mapping[str, Upstream]) -> None:
        """Route by these from now on; what is on its way stays there."""
        self._routes = routes
        self._upstreams = upstreams
        self._plans = ForwardPlans()
        self._ways = {}
        # The same set for ever: listeners hold it as a live view.
        self._serial_units.clear()
        self._serial_units.update(unit for unit in routes.units if 1 <= unit <= LAST_SERIAL_UNIT)
        if self._own is not None and self._own_unit <= LAST_SERIAL_UNIT:
            self._serial_units.add(self._own_unit)
        self.generation += 1

    @property
    def serial_units(self) -> set[int]:
        """The units that are answered where the listener is a serial line."""
        return self._serial_units

    def direct(self, context: RequestContext) -> Mapping[int, Answer]:
        """There is no short road: every answer comes from an upstream."""
        return {}

    def forward_plans(self, context: RequestContext) -> ForwardPlans:
        """What is known of the reads that clients ask together; all clients of a listener have the same rights."""
        return self._plans

    def forward_plan(self, context: RequestContext, pdu: bytes) -> ForwardPlan | None:
        """What becomes of a read, where it goes to a server on TCP as one request and is not remembered."""
        request = self.functions.decode_request(pdu)
        if not isinstance(request, ReadRegisters | ReadBits) or request.take is None:  # None: it looks at its reply
            return None
        found = self._routes.find(context.unit, request)
        if not isinstance(found, Route) or found.action is not RouteAction.FORWARD or found.cache is not None:
            return None
        upstream = self._upstreams.get(found.upstream)
        if upstream is None or not upstream.takes_batches:
            return None
        try:
            sent = upstream_requests(request, found)
        except InvalidRequest:
            return None
        if len(sent) > 1:
            return None
        (asked,) = sent
        assert isinstance(asked, ReadRegisters | ReadBits)
        unit = found.upstream_unit(context.unit)
        key = upstream.name, unit, found.timeout
        way = self._ways.get(key)
        if way is None:
            way = self._ways[key] = ReadTarget(self, upstream, unit, found.timeout)
        return batch_plan(way, context.unit, asked)

    def handle(self, context: RequestContext, request: AnyRequest) -> Outcome:
        """Forward, answer for the gateway itself, or say why not."""
        if isinstance(request, MalformedRequest):
            self.counters.malformed += 1
            return ExceptionResponse(context.function, request.code)
        unit = context.unit
        if context.executed is not None:
            return self._part_of_broadcast(context, context.executed, request)
        if unit == BROADCAST_UNIT and request.broadcast:
            return self._broadcast(context, request)
        found = self._routes.find(unit, request)
        if isinstance(found, Route):
            if found.action is not RouteAction.FORWARD:
                return self._not_forwarded(context, found)
            upstream = self._upstreams.get(found.upstream)
            if upstream is not None:  # or it was taken out of the configuration a moment ago
                return upstream.forward(context, request, found, deadline=self.deadline)
            found = None
        if found is None and self._own is not None and unit in (self._own_unit, BROADCAST_UNIT):
            self.counters.own += 1
            return self._own.handle(context, request)
        return self._no_route(context, found)

    def _no_route(self, context: RequestContext, found: Straddles | None) -> Outcome:
        self.counters.no_route += 1
        code = _NO_PATH if found is None else ExceptionCode.ILLEGAL_DATA_ADDRESS
        return ExceptionResponse(context.function, code)

    def _not_forwarded(self, context: RequestContext, route: Route) -> Outcome:
        if route.action is RouteAction.REFUSE:
            self.counters.refused += 1
            return ExceptionResponse(context.function, route.code)
        self.counters.dropped += 1
        return SILENCE

    def _broadcast(self, context: RequestContext, request: Request) -> Outcome:
        """A write to unit 0 that came over a network."""
        self.counters.broadcasts += 1
        own = self._routes.find(BROADCAST_UNIT, request)
        if isinstance(own, Route) and own.action is not RouteAction.FORWARD:
            return self._not_forwarded(context, own)
        charged: set[int] = set()
        ways = [
            way
            for upstream in self._takers()
            if (way := self._way_to_all(context, upstream, request, charged)) is not None
        ]
        if not ways:
            if isinstance(own, Route) and own.upstream in self._upstreams:
                return self._upstreams[own.upstream].forward(context, request, own, deadline=self.deadline)
            return self._no_route(context, None)
        rest = _Rest(context, None if self.silent_broadcasts else echo(request))
        parts = [(way, rest.part()) for way in ways]
        for way, part in parts:
            outcome = self._refused(part, way) if isinstance(way, int) else self._to_all(part, request, way)
            if outcome is not LATER:
                rest.one_done(part, outcome)
        return LATER

    def _part_of_broadcast(self, context: RequestContext, executed: set[int], request: Request) -> Outcome:
        """A broadcast of a serial listener, which comes once per unit: an upstream that takes broadcasts gets one.

        A server on a network gets one for each unit that a route names, and one to unit 0 where the route names none:
        247 requests of which most have no device would keep it busy for minutes.
        """
        found = self._routes.find(context.unit, request)
        if not isinstance(found, Route) or found.action is not RouteAction.FORWARD:
            return SILENCE
        upstream = self._upstreams.get(found.upstream)
        if upstream is None:
            return SILENCE
        if not upstream.takes_broadcasts and not found.names_no_units:
            return upstream.forward(context, request, found, deadline=self.deadline)
        if id(upstream) not in executed:
            executed.add(id(upstream))
            self.counters.broadcasts += 1
            way = self._way_to_all(context, upstream, request, executed)
            if isinstance(way, Route):
                self._to_all(context, request, way)
            elif way is not None:
                self._refused(context, way)
        return SILENCE

    def _takers(self) -> list[Upstream]:
        """The upstreams of this listener that take broadcasts."""
        upstreams = [self._upstreams[name] for name in self._routes.upstreams if name in self._upstreams]
        return [upstream for upstream in upstreams if upstream.takes_broadcasts]

    def _way_to_all(
        self, context: RequestContext, upstream: Upstream, request: Request, charged: set[int]
    ) -> Route | int | None:
        """How a write reaches all units of an upstream; the exception code, if one of them must not be written so.

        Every unit on the upstream hears it: what is refused for one of them is refused for all, and all must want it
        under the same address. None where it is not for that upstream at all. ``charged`` as of `RefusalOf`.
        """
        ways: set[Route] = set()
        refused = 0  # by the words of a route
        unreached = False
        units: list[int] = []
        for unit in self._routes.units_to(upstream.name):
            found = self._routes.find(unit, request)
            if isinstance(found, Straddles):
                refused = refused or ExceptionCode.ILLEGAL_DATA_ADDRESS
            elif found is not None and found.action is RouteAction.REFUSE:
                refused = refused or found.code
            elif found is None or found.upstream != upstream.name:
                unreached = True
            else:
                units.append(unit)
                ways.add(_for_all_units(found))
        if refused or not ways:
            return refused or None
        if unreached or len(ways) > 1:
            return _NO_PATH
        return self.refusal_of(context, request, units, charged) or ways.pop()

    def _to_all(self, context: RequestContext, request: Request, way: Route) -> Message | Deferral:
        return self._upstreams[way.upstream].broadcast(context, request, way, deadline=self.deadline)

    def _refused(self, context: RequestContext, code: int) -> Message:
        self.counters.refused += 1
        return ExceptionResponse(context.function, code)


def _for_all_units(route: Route) -> Route:
    """A route to all units of an upstream, that moves and splits as the one to one of them does."""
    return Route(
        upstream=route.upstream,
        unit=BROADCAST_UNIT,
        shift=route.shift,
        max_registers=route.max_registers,
        max_bits=route.max_bits,
        split_writes=route.split_writes,
    )


class _Rest:
    """Waits until a broadcast was sent on all upstreams; the worst of them is the answer."""

    __slots__ = ("_context", "_parts", "_reply")

    def __init__(self, context: RequestContext, reply: Message | None) -> None:
        self._context = context
        self._parts: list[RequestContext] = []
        self._reply: Message | Deferral = SILENCE if reply is None else reply
        context.gone = self.asker_gone

    def part(self) -> RequestContext:
        """Who asks one of the upstreams."""
        context = self._context
        part = RequestContext(
            unit=BROADCAST_UNIT,
            function=context.function,
            diagnostics=context.diagnostics,
            peer=context.peer,
            listener=context.listener,
            role=context.role,
            is_priority=context.is_priority,
            finish=self.one_done,
        )
        self._parts.append(part)
        return part

    def one_done(self, part: RequestContext, reply: Message | Deferral) -> None:
        """One upstream has sent it, or could not."""
        if isinstance(reply, ExceptionResponse):
            self._reply = reply
        self._parts.remove(part)
        if not self._parts:
            self._context.reply(self._reply)

    def asker_gone(self) -> None:
        """The client has gone: where the broadcast was not sent yet, it is not sent any more."""
        for part in self._parts:
            part.abandon()
