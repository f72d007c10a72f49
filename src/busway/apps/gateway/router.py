"""The responder of one listener of a gateway: routes each request to an upstream or the gateway's own unit.

Knows routes, upstreams and the gateway's own unit; knows no bytes (Messaging on TCP/IP V1.0b §4.4.2, T32).

1. A write to unit 0 goes to all upstreams of the listener that take broadcasts, and is answered when it was sent. All
   units of an upstream receive it, so a route must permit the write for each of them. If the policy denies it for one
   unit of one upstream, no upstream gets it.
2. A request without a route gets 0A, unless it is for unit 0 or the gateway's own unit: then the own unit answers it.
   A serial listener does not answer for units without a route (`ListenerRouter.serves`).
3. A malformed request is answered here, as by any server: it could not be framed on a serial line. A request with an
   unknown function is forwarded unread.
"""

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final

from ...codes import BROADCAST_UNIT, TCP_DEVICE_UNIT, ExceptionCode
from ...errors import InvalidRequest
from ...pdu.exception_response import ExceptionResponse
from ...pdu.functions import AnyRequest, FunctionTable
from ...pdu.malformed_request import MalformedRequest
from ...pdu.message import Message, Request
from ...pdu.read_items import ReadBits, ReadRegisters
from ...pdu.wide_registers import MAX_DATA, NARROW
from ...session.forwarded_reads import PreparedForward
from ...session.responder import (
    SILENCE,
    Deferral,
    ForwardedMessage,
    Forwarding,
    ForwardingTarget,
    RequestContext,
    Responder,
    ResponderAnswer,
    ServedUnit,
)
from .forwarding import Forwarder, ForwardTarget
from .routes import ListenerRoutes, Route, RouteAction, Straddles
from .translation import Translated, echo

_NO_PATH: Final = ExceptionCode.GATEWAY_PATH_UNAVAILABLE


@dataclass(slots=True)
class GatewayListenerCounters:
    """Counters of a gateway's listener: requests that were not forwarded, and broadcasts.

    Attributes:
        no_route: requests refused because no route takes them (0A), or because only a part of their addresses is in the
            range of a route (02).
        refused: requests that a route refused, broadcasts once for each upstream; and requests that the policy refused
            here: broadcasts, requests that a route turns into broadcasts, requests to the own unit by unit 0.
        dropped: requests that a route dropped: they got no reply.
        own: requests that the gateway's own unit answered.
        malformed: requests that broke a rule of their function, such as a wrong length; answered with an exception.
        broadcasts: writes to all units, also refused ones. One from a serial line counts once for each upstream that
            gets it as one write.
    """

    no_route: int = 0
    refused: int = 0
    dropped: int = 0
    own: int = 0
    malformed: int = 0
    broadcasts: int = 0


RefusalOf = Callable[[RequestContext, AnyRequest, Collection[int], set[int]], int]
"""Function that returns the exception code with which the policy refuses a request to several units; 0 if permitted.

Its arguments: context of the request with its client, the request, the units that get it, and the ids of the rules with
a rate that have counted the request already.
"""


def _no_refusal(context: RequestContext, request: AnyRequest, units: Collection[int], charged: set[int]) -> int:
    return 0


class ListenerRouter:
    """The responder of one listener of a gateway: forwards each request by the routes, or answers it.

    Args:
        name: name of the listener in routes.
        functions: the table of functions; requests with other functions are forwarded unread.
        own: responder of the gateway's own unit; None without one.
        own_unit: unit identifier of the own unit, 0…255.
        deadline: seconds until each request is answered, if necessary with 0A or 0B; None for no limit.
        silent_broadcasts: whether a broadcast gets no reply.

    Attributes:
        generation: number that changes whenever other routes are used, so that compiled answers are dropped.
        counters: counters of requests that were not forwarded, and of broadcasts.
        refusal_of: function that returns the exception code with which the policy refuses a request to several units,
            0 if the policy permits it. Set by `Gateway`; permits everything until then.
    """

    def __init__(
        self,
        name: str,
        functions: FunctionTable,
        *,
        own: Responder | None = None,
        own_unit: int = TCP_DEVICE_UNIT,
        deadline: float | None = None,
        silent_broadcasts: bool = False,
    ) -> None:
        self.name = name
        self.functions = functions
        self.generation: int = 0
        self.counters: GatewayListenerCounters = GatewayListenerCounters()
        self.deadline = deadline
        self.silent_broadcasts = silent_broadcasts
        self._own = own
        self._own_unit = own_unit
        self.refusal_of: RefusalOf = _no_refusal
        self._routes = ListenerRoutes(())
        self._forwarders: Mapping[str, Forwarder] = {}
        self._served: dict[int, ServedUnit] = {}
        self._targets: dict[tuple[str, int, float | None], ForwardTarget] = {}

    def follow(self, routes: ListenerRoutes, forwarders: Mapping[str, Forwarder]) -> None:
        """Use other routes and forwarders from the next request on. Requests in progress are still answered.

        Args:
            routes: the routes of the listener.
            forwarders: the forwarder of each upstream, by its name.
        """
        self._routes = routes
        self._forwarders = forwarders
        self._targets = {}
        self._served = {unit: ServedUnit(unit) for unit in routes.units}
        if self._own is not None:
            self._served.setdefault(self._own_unit, ServedUnit(self._own_unit))
        self.generation += 1

    def serves(self, unit: int) -> ServedUnit | None:
        """Return the unit with this number if a route takes it or it is the gateway's own unit; else None."""
        return self._served.get(unit)

    def prepared_forward(self, context: RequestContext, pdu: bytes) -> PreparedForward | None:
        """Return how the fast path forwards reads with this PDU to the context's unit; None: use the generic path.

        The generic path is needed for other functions than reads; for reads that no route forwards, that are split, or
        whose shifted address does not exist; for routes with the option ``cache``; and for devices with registers wider
        than 16 bits.
        """
        request = self.functions.decode_request(pdu)
        if not isinstance(request, ReadRegisters | ReadBits) or request.take is None:
            return None
        found = self._routes.find(context.unit, request)
        forwarder = self._forwarder_of(found) if isinstance(found, Route) and found.cache is None else None
        if forwarder is None or forwarder.upstream.register_width != NARROW:
            return None
        assert isinstance(found, Route)
        try:
            requests = Translated(request, found).requests
        except InvalidRequest:
            return None
        if len(requests) > 1:
            return None
        asked = as_bytes(type(request)).decode(requests[0].encode())
        asked.prepare()
        return PreparedForward(self._target(forwarder, context.unit, found), context.unit, asked)

    def answer(self, context: RequestContext, request: AnyRequest) -> ResponderAnswer:
        """Return the outcome of a request: its reply, how it is forwarded, or silence.

        Requests that no route takes are answered by the gateway's own unit if they are for its number or for unit 0 (no
        broadcasts). Malformed requests, and other requests without a route, get an exception code. A request that its
        route refuses gets the route's code; one that it drops gets silence.
        """
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
            forwarder = self._forwarder_of(found)
            if forwarder is not None:
                if self._reaches_all(found, unit, request, forwarder):
                    code = self.refusal_of(context, request, self._routes.units_to(found.upstream), set())
                    if code:
                        return self._refused(context, code)
                return self._forward(context, request, found, forwarder)
            found = None
        if found is None and self._own is not None and unit in (self._own_unit, BROADCAST_UNIT):
            code = 0 if unit == self._own_unit else self.refusal_of(context, request, (self._own_unit,), set())
            if code:  # by unit 0 it is still the own unit, and what a rule says of that holds
                return self._refused(context, code)
            self.counters.own += 1
            return self._own.answer(context, request)
        return self._no_route(context, found)

    def _forwarder_of(self, route: Route) -> Forwarder | None:
        """Return the forwarder of a route's upstream; None if the route does not forward, or the upstream is gone."""
        return self._forwarders.get(route.upstream) if route.action is RouteAction.FORWARD else None

    @staticmethod
    def _reaches_all(route: Route, unit: int, request: Request, forwarder: Forwarder) -> bool:
        """Whether a route turns a request to one unit into a broadcast: it sends the request to the upstream's unit 0.

        False for requests that cannot be broadcast, such as reads, and for upstreams that take no broadcasts.
        """
        takes_it = request.broadcast and forwarder.upstream.takes_broadcasts
        return takes_it and route.upstream_unit(unit) == BROADCAST_UNIT

    def _target(self, forwarder: Forwarder, unit: int, route: Route) -> ForwardTarget:
        key = route.upstream, route.upstream_unit(unit), route.timeout
        target = self._targets.get(key)
        if target is None:
            target = self._targets[key] = ForwardTarget(forwarder, key[1], route.timeout, self.deadline)
        return target

    def _forward(
        self, context: RequestContext, request: Request, route: Route, forwarder: Forwarder
    ) -> Message | Forwarding:
        """Return how a request is forwarded by a route, or the reply if it need not or cannot be forwarded.

        A read is answered with remembered values if the route permits that and they are young enough. The reply is
        exception 02 if the shifted address does not exist, and 03 if the device's registers are wider than 16 bits and
        the registers asked for do not fit into one reply.

        ``forwarder`` is the forwarder of the route's upstream.
        """
        width = forwarder.upstream.register_width
        if width != NARROW and isinstance(request, ReadRegisters) and request.count * width > MAX_DATA:
            return ExceptionResponse(context.function, ExceptionCode.ILLEGAL_DATA_VALUE)
        try:
            asked = Translated(request, route, width)
        except InvalidRequest:
            return ExceptionResponse(context.function, ExceptionCode.ILLEGAL_DATA_ADDRESS)
        target = self._target(forwarder, context.unit, route)
        if asked.place is not None and route.cache is not None:
            data = forwarder.recall(target.unit, asked.place, route.cache)
            if data is not None:
                return asked.of_data(data)
        return Forwarding(context, ((target, asked),))

    def _no_route(self, context: RequestContext, found: Straddles | None) -> ResponderAnswer:
        self.counters.no_route += 1
        code = _NO_PATH if found is None else ExceptionCode.ILLEGAL_DATA_ADDRESS
        return ExceptionResponse(context.function, code)

    def _not_forwarded(self, context: RequestContext, route: Route) -> ResponderAnswer:
        if route.action is RouteAction.REFUSE:
            self.counters.refused += 1
            return ExceptionResponse(context.function, route.code)
        self.counters.dropped += 1
        return SILENCE

    def _broadcast(self, context: RequestContext, request: Request) -> ResponderAnswer:
        """Return the outcome of a write to unit 0 over a network, which goes to all upstreams that take broadcasts.

        A write that the policy denies for any unit goes to no upstream, and the client gets the exception code. A write
        that the routes refuse for one upstream goes to the others; the client gets the exception code all the same,
        also with ``silent_broadcasts``. If no upstream takes broadcasts, or no route leads this write to one that does,
        a route for unit 0 forwards the write like any request, to its own upstream; without such a route the client
        gets 0A. A route for unit 0 that refuses or drops the write decides alone.
        """
        self.counters.broadcasts += 1
        own = self._routes.find(BROADCAST_UNIT, request)
        if isinstance(own, Route) and own.action is not RouteAction.FORWARD:
            return self._not_forwarded(context, own)
        charged: set[int] = set()
        decisions: list[Route | int] = []
        for name in self._takers():
            decision = self._broadcast_route(context, name, request, charged)
            if isinstance(decision, int) and context.judged is not None and context.judged.is_denied:
                return self._refused(context, decision)
            if decision is not None:
                decisions.append(decision)
        if not decisions:
            forwarder = None if not isinstance(own, Route) else self._forwarder_of(own)
            if forwarder is not None and isinstance(own, Route):
                return self._forward(context, request, own, forwarder)
            return self._no_route(context, None)
        reply: Message | Deferral = SILENCE if self.silent_broadcasts else echo(request)
        asks: list[tuple[ForwardingTarget, ForwardedMessage]] = []
        for decision in decisions:
            if isinstance(decision, int):
                outcome: Message | Forwarding = self._refused(context, decision)
            else:
                outcome = self._forward(context, request, decision, self._forwarders[decision.upstream])
            if isinstance(outcome, Forwarding):
                asks += outcome.asks
            else:
                reply = outcome
        return Forwarding(context, tuple(asks), reply) if asks else reply

    def _part_of_broadcast(self, context: RequestContext, executed: set[int], request: Request) -> ResponderAnswer:
        """Return how a broadcast from a serial line is forwarded for one unit; silence if nothing is to be sent for it.

        Called for each unit that the listener serves. A broadcast on a serial line never gets a reply.

        An upstream that takes broadcasts gets one broadcast. Any other upstream, a server on a network, gets a write
        for each unit that a route names; if the route names none, one write to unit 0. Writes to all 247 units would
        mostly reach no device, and their timeouts would take minutes.

        Args:
            context: the unit and the client.
            executed: what this broadcast has done so far; this method adds to it: ``id()`` of each forwarder for which
                it was decided, ``-id()`` too if it was refused for that upstream, and ids of rules with a rate that
                have counted it.
            request: the write.
        """
        found = self._routes.find(context.unit, request)
        if not isinstance(found, Route) or found.action is not RouteAction.FORWARD:
            return SILENCE
        forwarder = self._forwarders.get(found.upstream)
        if forwarder is None:
            return SILENCE
        if not forwarder.upstream.takes_broadcasts and not found.names_no_units:
            return self._forward(context, request, found, forwarder)
        if id(forwarder) not in executed:
            executed.add(id(forwarder))
            self.counters.broadcasts += 1
            decision = self._broadcast_route(context, found.upstream, request, executed)
            if isinstance(decision, Route):
                outcome = self._forward(context, request, decision, forwarder)
                return outcome if isinstance(outcome, Forwarding) else SILENCE
            if decision is not None:
                self._refused(context, decision)
                executed.add(-id(forwarder))
        elif -id(forwarder) in executed:
            context.judged = None  # it was refused for all units of the line, and that is recorded
        return SILENCE

    def _takers(self) -> list[str]:
        """Return the names of the upstreams in this listener's routes that take broadcasts."""
        names = [name for name in self._routes.upstreams if name in self._forwarders]
        return [name for name in names if self._forwarders[name].upstream.takes_broadcasts]

    def _broadcast_route(
        self, context: RequestContext, upstream: str, request: Request, charged: set[int]
    ) -> Route | int | None:
        """Return the route for a broadcast to an upstream, or the exception code if the broadcast is refused.

        None if no route forwards this write to the upstream. Every unit of the upstream receives a broadcast, so the
        routes and the policy must permit the write for each of them. If only some units have a route for it, or their
        routes shift or split it differently, the code is 0A.

        Args:
            context: the client.
            upstream: name of the upstream.
            request: the write.
            charged: ids of the rules with a rate that have counted the broadcast already; ids are added.
        """
        routes: set[Route] = set()
        refused = 0  # by a route
        unreached = False
        units: list[int] = []
        for unit in self._routes.units_to(upstream):
            found = self._routes.find(unit, request)
            if isinstance(found, Straddles):
                refused = refused or ExceptionCode.ILLEGAL_DATA_ADDRESS
            elif found is not None and found.action is RouteAction.REFUSE:
                refused = refused or found.code
            elif found is None or found.upstream != upstream:
                unreached = True
            else:
                units.append(unit)
                routes.add(_for_all_units(found))
        if refused or not routes:
            return refused or None
        if unreached or len(routes) > 1:
            return _NO_PATH
        return self.refusal_of(context, request, units, charged) or routes.pop()

    def _refused(self, context: RequestContext, code: int) -> Message:
        self.counters.refused += 1
        return ExceptionResponse(context.function, code)


def _for_all_units(route: Route) -> Route:
    """Return a route to unit 0 of an upstream, for broadcasts, with the address shift and limits of ``route``."""
    return Route(
        upstream=route.upstream,
        unit=BROADCAST_UNIT,
        shift=route.shift,
        max_registers=route.max_registers,
        max_bits=route.max_bits,
        split_writes=route.split_writes,
    )


@lru_cache(maxsize=32)
def as_bytes(kind: type[ReadRegisters] | type[ReadBits]) -> Any:  # Any: a class of the same kind
    """Return a request class for the same read whose reply keeps the raw bytes; decoding them would take 0.4 µs."""
    return type(
        kind.__name__, (kind,), {"take": staticmethod(bytes), "take_all": staticmethod(list), "__doc__": kind.__doc__}
    )
