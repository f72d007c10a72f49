"""Units that never answer do not stall those that do: a gateway's line in virtual time.

The listener's handler, the line and the master's session are the real ones; the wire and the clock are not.
"""

from dataclasses import dataclass, field
from typing import Any

import pytest
from virtual_bus import Bus, MasterEnd

import busway
from busway.apps.gateway.forwarding import Forwarder
from busway.apps.gateway.router import ListenerRouter
from busway.apps.gateway.routes import ListenerRoutes, Route
from busway.apps.gateway.upstream import Upstream
from busway.options.client import ClientParameters
from busway.pdu.exception_response import ExceptionResponse
from busway.pdu.message import Message
from busway.session.call import Call
from busway.session.diagnostic_counters import CommunicationState
from busway.session.responder import ALONE, ClientIdentity, Deferral, Forwarding, RequestContext

UNITS = range(1, 11)
CLIENTS = 4
WARM_UP = 10.0
MEASURED = 40.0
THINKS = 0.05
"""Seconds from an exception to a client's next request to that unit."""


class VirtualLink:
    """What a line needs of a link, on a bus in virtual time."""

    def __init__(self, master: MasterEnd) -> None:
        self.session = master.session
        self._master = master
        master.session.serve_units_in_turn()

    def now(self) -> float:
        """The clock of the bus."""
        return self._master.bus.now

    def begin(self, call: Call, now: float) -> None:
        """As `Link.begin`."""
        self._master.begin(call)

    def give_up(self, call: Call) -> None:
        """As `Link.give_up`."""
        self.session.cancel(call)


@dataclass
class Pollers:
    """Clients that each ask every unit again as soon as it has answered.

    Attributes:
        due: when the next request is, after an exception: time, client, unit.
        answers: by unit, those that came after `WARM_UP`.
        slowest: seconds that a healthy unit's answer took after `WARM_UP`.
    """

    bus: Bus
    handler: ListenerRouter
    port: Any = None
    due: list[tuple[float, int, int]] = field(default_factory=list)
    answers: dict[int, int] = field(default_factory=dict)
    slowest: float = 0.0
    asked: int = 0

    def ask(self, client: int, unit: int) -> None:
        self.asked += 1
        begun = self.bus.now
        request = busway.ReadHoldingRegisters((self.asked * 7) % 900, 10)

        def finish(context: RequestContext, reply: Message | Deferral) -> None:
            self.done(client, unit, reply, begun)

        context = RequestContext(
            unit=unit,
            function=3,
            diagnostics=CommunicationState(),
            finish=finish,
            client=ClientIdentity(peer=f"client {client}"),
        )
        outcome = self.handler.answer(context, request)
        if isinstance(outcome, Forwarding):
            for target, asked in outcome.asks:
                target.ask(outcome, ALONE, (asked,))
        else:
            assert isinstance(outcome, Message)
            self.done(client, unit, outcome, begun)

    def done(self, client: int, unit: int, reply: object, begun: float) -> None:
        if isinstance(reply, ExceptionResponse):
            assert reply.exception == 0x0B
            self.due.append((self.bus.now + THINKS, client, unit))
            return
        if self.bus.now > WARM_UP:
            self.answers[unit] = self.answers.get(unit, 0) + 1
            self.slowest = max(self.slowest, self.bus.now - begun)
        self.due.append((self.bus.now, client, unit))

    # An end of the bus that hears nothing.

    def hear(self, data: bytes, errors: int, now: float) -> None:
        raise AssertionError("nothing is heard here")

    def deadline(self) -> float | None:
        return min((one[0] for one in self.due), default=None)

    def act(self, now: float) -> None:
        due = [one for one in self.due if one[0] <= now]
        self.due = [one for one in self.due if one[0] > now]
        for _, client, unit in due:
            self.ask(client, unit)


class _Nothing:
    """A port at which nothing is heard."""

    class _Read:
        data = b""
        errors = 0

    def read(self) -> "_Nothing._Read":
        return self._Read()


def polled(dead: frozenset[int], *, asked: range = UNITS, timeout: float = 0.5) -> Pollers:
    """A minute on a line of 9600 baud, of which the dead units never answer."""
    bus = Bus(2, 9600)
    master = bus.master(parameters=ClientParameters(timeout=timeout, retries=1, queue=1000))
    bus.servers({unit: busway.Device(holding_registers=1000) for unit in UNITS if unit not in dead})
    line = Upstream("line", busway.client.settings.link_settings("rtu:///dev/bus", {"timeout": timeout}))
    line.links.append(VirtualLink(master))  # type: ignore[arg-type]  # instead of a port
    handler = ListenerRouter("office", busway.STANDARD)
    handler.follow(ListenerRoutes([Route(upstream="line", units=frozenset(UNITS))]), {"line": Forwarder(line)})
    pollers = Pollers(bus, handler, port=_Nothing())
    bus.ends.append(pollers)
    for client in range(CLIENTS):
        for unit in asked:
            pollers.due.append((0.0, client, unit))
    bus.run(WARM_UP + MEASURED)
    return pollers


@pytest.mark.clause("T32")
def test_three_dead_units_of_ten_leave_the_others_nineteen_twentieths_of_the_line() -> None:
    dead = frozenset({2, 5, 9})
    without = polled(frozenset(), asked=range(1, 8))  # seven units and nothing else to do
    alive = polled(dead)
    assert sum(alive.answers.values()) >= 0.95 * sum(without.answers.values())
    counts = [alive.answers[unit] for unit in UNITS if unit not in dead]
    assert max(counts) - min(counts) <= 0.05 * max(counts)  # each of them its share
    assert not dead & set(alive.answers)
    assert alive.slowest < without.slowest + 1.2  # one probe, at its longest, and nothing more


@pytest.mark.clause("T32")
def test_a_line_without_dead_units_gives_each_its_share() -> None:
    found = polled(frozenset())
    assert max(found.answers.values()) - min(found.answers.values()) <= CLIENTS
