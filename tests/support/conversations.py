"""A client's conversation with a clock and a wire that the test holds in its hands."""

from collections.abc import Sequence
from typing import Any

from busway.errors import ModbusError
from busway.framing.mbap import FrameKind, MbapFrame, MbapReceiver, encode_mbap
from busway.options.client import ClientParameters
from busway.pdu.message import Message, Request
from busway.pdu.read_items import ReadHoldingRegisters
from busway.session.call import Call
from busway.session.tcp_client import TcpClientSession


def read(address: int = 0, count: int = 1) -> ReadHoldingRegisters:
    """A read of holding registers."""
    return ReadHoldingRegisters(address, count)


def answer_to(frame: MbapFrame) -> bytes:
    """The PDU of a well-behaved device whose register at an address holds the address."""
    pdu = frame.pdu
    if pdu[0] == 3:
        first, count = int.from_bytes(pdu[1:3], "big"), int.from_bytes(pdu[3:5], "big")
        data = b"".join(address.to_bytes(2, "big") for address in range(first, first + count))
        return bytes((3, len(data))) + data
    return pdu[:5]  # 05, 06, 15 and 16


class ClientWire:
    """A session, the time, and what goes over the wire.

    Attributes:
        now: seconds.
        session: the session under test, connected unless told otherwise.
        sent: every ADU that left, whole.
    """

    def __init__(self, *, connected: bool = True, first_transaction: int = 0, **options: Any) -> None:
        self.now = 100.0
        self.session = TcpClientSession(
            ClientParameters(**options), endpoint="tcp://192.0.2.5:502", first_transaction=first_transaction
        )
        self.sent: list[MbapFrame] = []
        if connected:
            self.session.connected(self.now)

    # What the application does.

    def ask(self, *requests: Request, unit: int = 1, **options: Any) -> Call:
        """Submit one call."""
        call = self.call(requests, unit, **options)
        self.session.submit(call, self.now)
        return call

    def call(self, requests: Sequence[Request], unit: int = 1, **options: Any) -> Call:
        """A call that is not submitted yet."""
        parameters = self.session.parameters
        values: dict[str, Any] = {"timeout": parameters.timeout, "retries": parameters.retries, **options}
        return Call(unit, requests, is_write=any(one.is_write for one in requests), **values)

    # What the driver does.

    def transmit(self) -> list[MbapFrame]:
        """What leaves now, whole frames."""
        frames = MbapReceiver().receive(b"".join(self.session.transmit(self.now)))
        assert all(frame.kind is FrameKind.FRAME for frame in frames)
        self.sent += frames
        return frames

    def send_one(self) -> MbapFrame:
        """The one frame that leaves now."""
        (frame,) = self.transmit()
        return frame

    def feed(self, data: bytes) -> None:
        """Bytes arrive."""
        self.session.receive(data, len(data), self.now)

    def reply(self, frame: MbapFrame, pdu: bytes | None = None, *, unit: int | None = None, shift: int = 0) -> None:
        """The reply to a frame arrives: a good one unless told otherwise."""
        self.feed(
            encode_mbap(
                frame.transaction + shift & 0xFFFF,
                frame.unit if unit is None else unit,
                answer_to(frame) if pdu is None else pdu,
            )
        )

    def wait(self, seconds: float) -> None:
        """Time passes, and the session is told."""
        self.now += seconds
        self.session.tick(self.now)

    def finished(self) -> list[Call]:
        """The calls that ended since the last call."""
        found = self.session.finished[:]
        self.session.finished.clear()
        return found

    def run(self, call: Call, rounds: int = 100) -> list[Message | ModbusError | None]:
        """Let a well-behaved device answer until the call has ended."""
        for _ in range(rounds):
            for frame in self.transmit():
                self.reply(frame)
            if call.ended:
                break
        return call.outcomes

    def reconnect(self, reason: str = "the peer closed it") -> None:
        """The connection ends, and a new one stands."""
        self.session.disconnected(self.now, reason)
        self.session.connected(self.now)

    @property
    def places(self) -> int:
        """Places for requests in flight, taken and free: never more or fewer than ``max_transactions``."""
        return self.session.in_flight + len(self.session._free)
