"""A device to check without sockets and in virtual time: busway's own responder behind a faulty conversation.

Every wait of a run moves a clock by hand, so that hours cost nothing and a busy machine changes nothing.
"""

from random import Random

import busway
from busway.apps.check.check import Items, Target
from busway.codes import Table
from busway.errors import LinkDown
from busway.faults.applied_faults import Faults
from busway.faults.clock import FakeClock
from busway.faults.fault import Carrier, Contact, Exchange
from busway.faults.faulty_conversation import FaultyConversation
from busway.faults.profiles import FAULT_PROFILES
from busway.framing.ascii import encode_ascii
from busway.framing.lrc import lrc
from busway.framing.mbap import FrameKind, MbapReceiver
from busway.framing.rtu import encode_rtu
from busway.pdu.functions import STANDARD
from busway.server.device_responder import DeviceResponder
from busway.session.diagnostic_counters import CommunicationState
from busway.session.responder import RequestContext
from busway.session.server_pipeline import RequestPipeline

UNIT = 3
SIZE = 1000


def new_device() -> busway.Device:
    """A device that has everything that checks ask for."""
    return busway.Device(
        holding_registers=list(range(SIZE)),
        input_registers=SIZE,
        coils=[number % 2 == 0 for number in range(SIZE)],
        discrete_inputs=SIZE,
        identification={0: "busway", 1: "checked", 2: "1.0"},
        files={1: [1, 2, 3]},
        fifos={0: [1]},
    )


def target_of(framing: str, unit: int = UNIT) -> Target:
    """What is checked: the probe, and eight registers and coils to write."""
    return Target(
        framing,
        framing == "mbap",
        unit,
        Items(Table.HOLDING_REGISTERS, 0, 1),
        Items(Table.HOLDING_REGISTERS, 100, 8),
        Items(Table.COILS, 100, 8),
    )


class VirtualDialer:
    """Opens connections to a device in this process, whose time stands still between two waits."""

    def __init__(self, framing: str, device: busway.Device | None = None, unit: int = UNIT) -> None:
        self.framing = framing
        self.has_connections = framing == "mbap"
        self.device = device or new_device()
        self.unit = unit
        self.faults = Faults()
        self.clock = FakeClock()
        self.open_connections = 0
        self.is_dead = False
        state = CommunicationState()
        self.state = state
        self.pipeline = RequestPipeline(DeviceResponder({unit: self.device}))

    def add(self, name: str, **parameters: object) -> None:
        """Let the device misbehave."""
        self.faults.add(FAULT_PROFILES.named(name)(**parameters))

    def now(self) -> float:
        return self.clock.now()

    def sleep(self, seconds: float) -> None:
        self.clock.advance(seconds)

    def open(self) -> "VirtualWire":
        if self.is_dead:
            raise LinkDown("the device is dead")
        return VirtualWire(self)

    def answer(self, unit: int, pdu: bytes) -> bytes:
        """The device's own reply; empty for none."""
        if self.is_dead or pdu[0] & 0x80:
            return b""
        context = RequestContext(unit=unit, function=pdu[0], diagnostics=self.state)
        outcome = self.pipeline.answer(context, pdu, [])
        return outcome.encode() if hasattr(outcome, "encode") else b""


class VirtualWire:
    """One connection, or the line."""

    def __init__(self, dialer: VirtualDialer) -> None:
        self._dialer = dialer
        carriers = {Carrier.TCP, Carrier.CONNECTION} if dialer.framing == "mbap" else {Carrier.SERIAL}
        contact = Contact(dialer.now(), dialer.open_connections, carriers=frozenset(carriers))
        self._talk = FaultyConversation(dialer.faults, contact, dialer.framing)
        self._stream = MbapReceiver()
        self._kept = b""
        self._ended = False
        self._ready: list[bytes] = []
        dialer.open_connections += 1

    def close(self) -> None:
        self._dialer.open_connections -= 1
        self._ended = True

    def send(self, data: bytes) -> None:
        if self._is_over():
            raise LinkDown("the device closed the connection")
        for transaction, unit, pdu, adu in self._requests(data):
            self._execute(transaction, unit, pdu, adu)

    def receive(self, timeout: float) -> bytes | None:
        until = self._dialer.now() + timeout
        while True:
            if self._ready:
                return self._ready.pop(0)
            if self._ended:
                return None
            self._ready += self._talk.tick(self._dialer.now())
            if self._ready:
                continue
            if self._talk.closed or self._stream.broken:
                self._ended = True
                continue
            due = self._talk.deadline(self._dialer.now())
            if self._dialer.now() >= until:
                return b""
            self._dialer.sleep(max(min(until, due if due is not None else until) - self._dialer.now(), 0))

    def _is_over(self) -> bool:
        self._ready += self._talk.tick(self._dialer.now())
        return self._ended or self._talk.closed or self._stream.broken

    def _requests(self, data: bytes) -> list[tuple[int, int, bytes, bytes]]:
        """The frames in what was sent; on a line one write is one frame, or the rest of one."""
        if self._dialer.framing == "mbap":
            frames = self._stream.receive(data)
            return [(one.transaction, one.unit, one.pdu, data) for one in frames if one.kind is FrameKind.FRAME]
        if self._dialer.framing == "rtu":
            whole = len(data) >= 4 and encode_rtu(data[0], data[1:-2]) == data and len(data) <= 256
            return [(0, data[0], data[1:-2], data)] if whole else []
        text = data[data.rfind(b":") :] if b":" in data else b""
        try:
            content = bytes.fromhex(text[1:-2].decode("ascii"))
        except ValueError:
            return []
        whole = text.endswith(b"\r\n") and len(content) >= 3 and not lrc(content) and len(text) <= 513
        is_same = whole and encode_ascii(content[0], content[1:-1]) == text
        return [(0, content[0], content[1:-1], text)] if is_same else []

    def _execute(self, transaction: int, unit: int, pdu: bytes, adu: bytes) -> None:
        dialer = self._dialer
        is_broadcast = unit == 0 and dialer.framing != "mbap"
        if pdu[0] & 0x80:
            return
        exchange = Exchange(
            self._talk.contact,
            transaction,
            unit,
            pdu,
            STANDARD.decode_request(pdu),
            dialer.now(),
            Random(1),
            adu,
            is_broadcast,
        )
        if dialer.is_dead or (dialer.framing != "mbap" and unit not in (0, dialer.unit)):
            return
        struck = self._talk.strike(exchange)
        answer = self._talk.asked(struck)
        if answer is None:
            answer = dialer.answer(dialer.unit if is_broadcast else unit, pdu)
        self._talk.answered(exchange, struck, answer, dialer.now())
