"""A multi-drop bus in virtual time: masters, servers and misbehaving devices on one `VirtualLine`.

Knows when each of them has to be asked; what they say is their own. Hours pass in seconds, and every run is the same.

1. Ends hear what has passed when the line pauses, as one read; ``by_character`` gives them each character by itself.
2. At one moment all stations hear before one acts.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Collection, Container, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from busway.framing.character_times import SerialTiming
from busway.framing.echo import Echo
from busway.framing.frame_direction import LineRole
from busway.options.client import ClientParameters
from busway.options.lines import BreakerParameters, FramingParameters, SerialClientParameters
from busway.pdu.message import Message, Request
from busway.server.device import Device
from busway.server.device_responder import DeviceResponder
from busway.session.call import Call
from busway.session.diagnostic_counters import LineDiagnostics
from busway.session.line_framing import LineFraming, line_framing
from busway.session.responder import ClientIdentity, RequestContext, Responder, SerialUnits
from busway.session.serial_client import SerialClientSession
from busway.session.serial_server import FrameToSend, SerialServerSession
from busway.session.server_pipeline import RequestPipeline
from busway.testing.virtual_line import VirtualLine, VirtualPort


class End(Protocol):
    """A station at a port."""

    port: VirtualPort

    def hear(self, data: bytes, errors: int, now: float) -> None:
        """Characters have passed."""

    def deadline(self) -> float | None:
        """When `act` has something to do."""

    def act(self, now: float) -> None:
        """Do what is due."""


class Bus:
    """One line and who is at its ports."""

    def __init__(
        self,
        ports: int = 2,
        baud: int = 9600,
        *,
        framing: str = "rtu",
        echo: bool | Collection[int] = False,
        noise: float = 0.0,
        by_character: bool = False,
        seed: int = 1,
    ) -> None:
        self.framing = framing
        self.line = VirtualLine(
            ports, baud, data_bits=8 if framing == "rtu" else 7, echo=echo, noise=noise, seed=seed, tap_size=2_000_000
        )
        self.now = 0.0
        self.ends: list[End] = []
        self._by_character = by_character
        self._taken = 0

    @property
    def timing(self) -> SerialTiming:
        """The times of the line."""
        return self.line.settings.timing

    def master(
        self,
        *,
        parameters: ClientParameters | None = None,
        serial: SerialClientParameters | None = None,
        breaker: BreakerParameters | None = None,
        echo: Echo = Echo.OFF,
        framing: FramingParameters | None = None,
        jitter: Callable[[], float] | None = None,
    ) -> MasterEnd:
        """A master at the next port."""
        session = SerialClientSession(
            parameters or ClientParameters(),
            framing=line_framing(self.framing, LineRole.MASTER, self.timing, framing, echo=echo),
            jitter=jitter or random.Random(7).random,
            serial=serial,
            breaker=breaker,
            endpoint=f"{self.framing}:///dev/bus",
        )
        master = MasterEnd(self, self._port(), session)
        self.ends.append(master)
        session.connected(self.now)
        return master

    def servers(
        self,
        units: dict[int, Device] | None = None,
        *,
        responder: Responder | None = None,
        echo: Echo = Echo.OFF,
        framing: FramingParameters | None = None,
    ) -> ServerEnd:
        """Servers at the next port."""
        if responder is None:
            responder = DeviceResponder(units or {})
        serial_units = SerialUnits(responder)
        chosen = line_framing(self.framing, LineRole.SERVER, self.timing, framing, units=serial_units, echo=echo)
        server = ServerEnd(self._port(), responder, serial_units, chosen)
        self.ends.append(server)
        return server

    def device(self, behaviour: Behaviour) -> DeviceEnd:
        """A scripted device at the next port."""
        device = DeviceEnd(
            self._port(), line_framing(self.framing, LineRole.SERVER, self.timing, units=range(248)), behaviour
        )
        self.ends.append(device)
        return device

    def hear_late(self, end: End, lag: float) -> None:
        """Let a station hear everything ``lag`` seconds after the others, as slow adapters do."""
        self.ends[self.ends.index(end)] = LateEnd(end, lag)

    def _port(self) -> VirtualPort:
        port = self.line.ports[self._taken]
        self._taken += 1
        return port

    def run(self, seconds: float | None = None, *, until: Callable[[], bool] | None = None) -> None:
        """Let time pass: so many seconds, or until a condition holds (an hour at most)."""
        end = self.now + (3600.0 if seconds is None else seconds)
        while until is None or not until():
            heard = self.line.deadline() if self._by_character else self.line.pause_at()
            times = [time for time in (heard, *(one.deadline() for one in self.ends)) if time is not None]
            if not times or min(times) > end:
                assert until is None, "what was waited for did not come"
                self._step(end)
                return
            self._step(max(min(times), self.now))

    def _step(self, now: float) -> None:
        self.line.advance(now)
        self.now = now
        for one in self.ends:
            received = one.port.read()
            if received.data:
                one.hear(received.data, received.errors, now)
        for one in self.ends:
            due = one.deadline()
            if due is not None and due <= now:
                one.act(now)


@dataclass
class Question:
    """One demand and what became of it."""

    call: Call
    then: Callable[[Question], None] | None = None
    ended_at: float | None = None

    @property
    def done(self) -> bool:
        return self.call.ended

    @property
    def outcome(self) -> object:
        """The reply or the error."""
        assert self.call.ended, "it has not ended"
        return self.call.outcomes[0]


class MasterEnd:
    """A master, and the demands it was given."""

    def __init__(self, bus: Bus, port: VirtualPort, session: SerialClientSession) -> None:
        self.bus = bus
        self.port = port
        self.session = session
        self.sent: list[tuple[float, bytes]] = []
        self._calls: dict[int, Question] = {}

    def ask(
        self,
        unit: int,
        *requests: Request,
        timeout: float | None = None,
        retries: int | None = None,
        deadline: float | None = None,
        caller: object = None,
        idempotent: bool = False,
        then: Callable[[Question], None] | None = None,
    ) -> Question:
        """Give it a demand; ``then`` is called when it has ended."""
        parameters = self.session.parameters
        now = self.bus.now
        question = Question(
            Call(
                unit,
                requests,
                is_write=any(one.is_write for one in requests),
                timeout=parameters.timeout if timeout is None else timeout,
                retries=parameters.retries if retries is None else retries,
                idempotent=idempotent,
                caller=caller,
                deadline=None if deadline is None else now + deadline,
            )
        )
        question.then = then
        self._calls[id(question.call)] = question
        self.session.submit(question.call, now)
        self._pump(now)
        return question

    def begin(self, call: Call) -> None:
        """Give it a call of another owner, whose ``set_result`` is called when it has ended."""
        self.session.submit(call, self.bus.now)
        self._pump(self.bus.now)

    def get(self, unit: int, request: Request, **options: object) -> object:
        """Ask, and let time pass until the outcome is there."""
        question = self.ask(unit, request, **options)  # type: ignore[arg-type]
        self.bus.run(until=lambda: question.done)
        return question.outcome

    def hear(self, data: bytes, errors: int, now: float) -> None:
        if errors:
            self.session.receive_damaged(data, now)
        else:
            self.session.receive(data, len(data), now)
        self._pump(now)

    def deadline(self) -> float | None:
        return self.session.deadline()

    def act(self, now: float) -> None:
        self.session.tick(now)
        self._pump(now)

    def _pump(self, now: float) -> None:
        for frame in self.session.transmit(now):
            self.session.written(self.port.write(frame, now))
            self.sent.append((now, frame))
        finished = self.session.finished[:]
        self.session.finished.clear()
        for call in finished:
            if call.owner is not None:
                call.owner.set_result(None)
                continue
            question = self._calls.pop(id(call))
            question.ended_at = now
            if question.then is not None:
                question.then(question)


class ServerEnd:
    """The servers of one port, driven as `busway.server.serial_listener` does it."""

    def __init__(self, port: VirtualPort, responder: Responder, units: Container[int], framing: LineFraming) -> None:
        self.port = port
        self.diagnostics = LineDiagnostics(changes_allowed=True)
        self.sent: list[tuple[float, bytes]] = []
        self.port_has_gone = False
        self._pending: FrameToSend | None = None
        self.session = SerialServerSession(
            RequestPipeline(responder),
            units,
            framing=framing,
            diagnostics=self.diagnostics,
            deliver=self._late,
            client=ClientIdentity(peer="bus"),
        )

    def hear(self, data: bytes, errors: int, now: float) -> None:
        session = self.session
        pending = self._pending
        heard = session.requests + session.foreign + session.damaged_frames
        if errors:
            session.receive_damaged(data, now)
            emissions: list[FrameToSend] = []
        else:
            emissions = session.receive(data, now)
        if (
            pending is not None
            and self._pending is pending
            and session.requests + session.foreign + session.damaged_frames != heard
        ):
            self._pending = None
        self._take(emissions)

    def deadline(self) -> float | None:
        times = [self.session.deadline(), None if self._pending is None else self._pending.not_before]
        return min((time for time in times if time is not None), default=None)

    def act(self, now: float) -> None:
        self._take(self.session.tick(now))
        pending = self._pending
        if pending is not None and now >= pending.not_before:
            self._pending = None
            if self.port_has_gone:
                self.session.answer_lost()
                return
            self.session.answer_left()
            self.session.sent(pending.frame, self.port.write(pending.frame, now))
            self.sent.append((now, pending.frame))

    def _take(self, emissions: Sequence[FrameToSend]) -> None:
        if emissions:
            self._pending = emissions[-1]

    def _late(self, emission: FrameToSend) -> None:
        self._pending = emission


class LateEnd:
    """A station whose adapter passes on everything that it has heard some time later; it sends without a delay."""

    def __init__(self, end: End, lag: float) -> None:
        self.port = end.port
        self._end = end
        self._lag = lag
        self._kept: list[tuple[float, bytes, int]] = []

    def hear(self, data: bytes, errors: int, now: float) -> None:
        self._kept.append((now + self._lag, data, errors))

    def deadline(self) -> float | None:
        times = [self._kept[0][0] if self._kept else None, self._end.deadline()]
        return min((time for time in times if time is not None), default=None)

    def act(self, now: float) -> None:
        while self._kept and self._kept[0][0] <= now:
            _, data, errors = self._kept.pop(0)
            self._end.hear(data, errors, now)
        self._end.act(now)


Behaviour = Callable[[int, bytes, float], Sequence[tuple[float, bytes]]]
"""Unit, PDU and time of a request → what is sent, each after so many seconds."""


@dataclass
class DeviceEnd:
    """A device that does what a test says, whatever that is."""

    port: VirtualPort
    framing: LineFraming
    behaviour: Behaviour
    heard: list[tuple[float, int, bytes]] = field(default_factory=list)
    _due: list[tuple[float, bytes]] = field(default_factory=list)

    def hear(self, data: bytes, errors: int, now: float) -> None:
        for found in self.framing.receiver.receive(data, now):
            self._found(found, now)

    def _found(self, found: object, now: float) -> None:
        unit, pdu = getattr(found, "unit", None), getattr(found, "pdu", b"")
        if unit is None:
            return
        self.heard.append((now, unit, pdu))
        self._due += [(now + delay, frame) for delay, frame in self.behaviour(unit, pdu, now)]
        self._due.sort(key=lambda one: one[0])

    def deadline(self) -> float | None:
        times = [self.framing.receiver.deadline(), self._due[0][0] if self._due else None]
        return min((time for time in times if time is not None), default=None)

    def act(self, now: float) -> None:
        for found in self.framing.receiver.tick(now):
            self._found(found, now)
        while self._due and self._due[0][0] <= now:
            self.port.write(self._due.pop(0)[1], now)

    def frame(self, unit: int, pdu: bytes) -> bytes:
        """A frame of this line."""
        return self.framing.encode(unit, pdu)


def honest(units: dict[int, Device]) -> Callable[[int, bytes], bytes | None]:
    """What devices answer that do nothing wrong: unit and PDU of a request → PDU of the reply, None for others."""
    responder = DeviceResponder(units)
    diagnostics = LineDiagnostics(changes_allowed=True)

    def answer(unit: int, pdu: bytes) -> bytes | None:
        if unit not in SerialUnits(responder):
            return None
        context = RequestContext(unit=unit, function=pdu[0], diagnostics=diagnostics.of(unit))
        reply = responder.answer(context, responder.functions.decode_request(pdu))
        assert isinstance(reply, Message)
        return reply.encode()

    return answer


__all__ = ["Bus", "DeviceEnd", "MasterEnd", "Message", "Question", "ServerEnd", "honest"]
