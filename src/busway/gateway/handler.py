"""One front of a gateway: each request to the line that its route names, or to the gateway itself.

Knows routes, lines and the gateway's own unit; knows no bytes (Messaging on TCP/IP V1.0b §4.4.2, T32).

1. A write to unit 0 goes to all lines of the front that take broadcasts, and is answered once it was sent.
2. What no route takes on 0 and on the own unit is the gateway's; on any other unit there is no path: 0A. A serial
   front is silent there, because it never hears of those units (`FrontHandler.serial_units`).
3. A request that breaks a rule of its function is answered as any server would, and not forwarded: a serial line could
   not frame it. A function that is not known is forwarded unread.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from ..codes import BROADCAST_UNIT, LAST_SERIAL_UNIT, TCP_DEVICE_UNIT, ExceptionCode
from ..pdu.direct import Answer
from ..pdu.functions import AnyRequest, FunctionTable
from ..pdu.general import ExceptionResponse, MalformedRequest, OpaqueRequest
from ..pdu.message import Message, Request
from ..session.handler import LATER, SILENCE, Deferral, Handler, Outcome, RequestContext
from .lines import Line
from .routes import Action, FrontRoutes, Route, Straddles

_NO_PATH: Final = ExceptionCode.GATEWAY_PATH_UNAVAILABLE
_BROADCAST: Final = Route(line="all")
"""How a broadcast is translated: not at all."""


@dataclass(slots=True)
class FrontCounters:
    """What became of the requests of a front that no line has counted.

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


class FrontHandler:
    """The handler of one front.

    Args:
        name: what routes call the front.
        functions: the table of functions; what is not in it is forwarded unread.
        own: what answers for the gateway itself; None where it is no device.
        own_unit: its unit identifier.
        deadline: seconds after which a client of this front has given up; None if that is not known.
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
        self.counters = FrontCounters()
        self.deadline = deadline
        self.silent_broadcasts = silent_broadcasts
        self._own = own
        self._own_unit = own_unit
        self._routes = FrontRoutes(())
        self._lines: Mapping[str, Line] = {}
        self._serial_units: set[int] = set()

    def follow(self, routes: FrontRoutes, lines: Mapping[str, Line]) -> None:
        """Route by these from now on; what is on its way stays there."""
        self._routes = routes
        self._lines = lines
        # The same set for ever: listeners hold it as a live view.
        self._serial_units.clear()
        self._serial_units.update(unit for unit in routes.units if 1 <= unit <= LAST_SERIAL_UNIT)
        if self._own is not None and self._own_unit <= LAST_SERIAL_UNIT:
            self._serial_units.add(self._own_unit)
        self.generation += 1

    @property
    def serial_units(self) -> set[int]:
        """The units that are answered where the front is a serial line."""
        return self._serial_units

    def direct(self, context: RequestContext) -> Mapping[int, Answer]:
        """There is no short road: every answer comes from a line."""
        return {}

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
            if found.action is not Action.FORWARD:
                return self._not_forwarded(context, found)
            line = self._lines.get(found.line)
            if line is not None:  # or it was taken out of the configuration a moment ago
                return line.forward(context, request, found, deadline=self.deadline)
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
        if route.action is Action.REFUSE:
            self.counters.refused += 1
            return ExceptionResponse(context.function, route.code)
        self.counters.dropped += 1
        return SILENCE

    def _broadcast(self, context: RequestContext, request: Request) -> Outcome:
        """A write to unit 0 that came over a network."""
        self.counters.broadcasts += 1
        lines = [self._lines[name] for name in self._routes.lines if name in self._lines]
        takers = [line for line in lines if line.takes_broadcasts]
        if not takers:
            return self._no_route(context, None)
        rest = _Rest(context, len(takers), None if self.silent_broadcasts else _echo(request))
        for line in takers:
            part = RequestContext(
                unit=BROADCAST_UNIT,
                function=context.function,
                diagnostics=context.diagnostics,
                peer=context.peer,
                listener=context.listener,
                role=context.role,
                finish=rest.one_done,
            )
            if not line.broadcast(part, request, _BROADCAST):
                rest.one_done(part, ExceptionResponse(context.function, _NO_PATH))
        return LATER

    def _part_of_broadcast(self, context: RequestContext, executed: set[int], request: Request) -> Outcome:
        """A broadcast of a serial front, which comes once for every unit: a line that takes broadcasts gets one."""
        found = self._routes.find(context.unit, request)
        if not isinstance(found, Route) or found.action is not Action.FORWARD:
            return SILENCE
        line = self._lines.get(found.line)
        if line is None:
            return SILENCE
        if not line.takes_broadcasts:
            return line.forward(context, request, found, deadline=self.deadline)
        if id(line) not in executed:
            executed.add(id(line))
            line.broadcast(context, request, _BROADCAST)
        return SILENCE


class _Rest:
    """Waits until a broadcast was sent on all lines; the worst of them is the answer."""

    __slots__ = ("_context", "_left", "_reply")

    def __init__(self, context: RequestContext, lines: int, reply: Message | None) -> None:
        self._context = context
        self._left = lines
        self._reply: Message | Deferral = SILENCE if reply is None else reply

    def one_done(self, part: RequestContext, reply: Message | Deferral) -> None:
        """One line has sent it, or could not."""
        if isinstance(reply, ExceptionResponse):
            self._reply = reply
        self._left -= 1
        if not self._left:
            self._context.reply(self._reply)


def _echo(request: Request) -> Message:
    """What a device would have answered to a write."""
    if request.echoes or isinstance(request, OpaqueRequest):
        return request
    fields = request.values()
    return request.Reply(**{name: fields[name] for name in request.Reply.declared if name in fields})
