"""A client gets exactly the values of its own transactions, whatever replies come, in whatever order and pieces.

Two sessions get the same bytes: one recognises replies by their first bytes, also many at once; the requests of the
other have a check of their own, so each reply is decoded. Requests ask for the same, so only identifiers tell which
reply is whose: replies differ in their data, which begin with a number of their own.
"""

import struct
from collections.abc import Sequence
from dataclasses import asdict
from itertools import count
from random import Random
from typing import Any

import pytest
from conversations import ClientWire

from busway.errors import BadReply, ModbusError
from busway.framing.mbap import MbapFrame, encode_mbap
from busway.pdu.malformed_pdu import MalformedPdu
from busway.pdu.message import Message, Request
from busway.pdu.read_items import ReadCoils, ReadHoldingRegisters, ReadInputRegisters
from busway.pdu.write_items import ReadWriteMultipleRegisters, WriteSingleRegister
from busway.session.call import Call

SEEDS = range(40)
STEPS = 12


def with_check(kind: Any) -> Any:
    """The same request with a check of its replies, so that they are decoded."""
    return type(f"Checked{kind.__name__}", (kind,), {"__slots__": (), "check_reply": lambda self, reply: None})


KINDS: dict[str, Any] = {
    kind.__name__: (kind, with_check(kind))
    for kind in (ReadHoldingRegisters, ReadInputRegisters, ReadCoils, ReadWriteMultipleRegisters, WriteSingleRegister)
}
SHAPES: Sequence[tuple[str, tuple[Any, ...]]] = (
    ("ReadHoldingRegisters", (5, 4)),
    ("ReadHoldingRegisters", (5, 4)),
    ("ReadHoldingRegisters", (5, 125)),
    ("ReadInputRegisters", (5, 4)),
    ("ReadCoils", (5, 60)),
    ("ReadWriteMultipleRegisters", (5, 4, 9, 1, b"\x00\x07")),
    ("WriteSingleRegister", (5, 7)),
)


def build(shape: tuple[str, tuple[Any, ...]], *, checked: bool) -> Request:
    """One request object."""
    name, arguments = shape
    request: Request = KINDS[name][checked](*arguments)
    return request


def size_of(pdu: bytes) -> int:
    """Data bytes of the right reply to a request that reads."""
    items = int.from_bytes(pdu[3:5], "big")
    return (items + 7) // 8 if pdu[0] == 1 else 2 * items


class Server:
    """A server that answers what it likes.

    Attributes:
        first: the first right reply that was sent for each identifier, while it may count.
    """

    def __init__(self, random: Random) -> None:
        self._random = random
        self._numbers = count(1)
        self.asked: list[MbapFrame] = []
        self.owed: list[MbapFrame] = []

    def pdu_for(self, frame: MbapFrame) -> bytes:
        """A right reply with a number of its own."""
        if frame.pdu[0] == 6:
            return frame.pdu
        size = size_of(frame.pdu)
        data = struct.pack(">Q", next(self._numbers) << 16 | frame.transaction)
        return bytes((frame.pdu[0], size)) + (data * (size // 8 + 1))[:size]

    def says(self) -> list[bytes]:
        """The frames of one moment."""
        random = self._random
        owed, self.owed = self.owed, []
        kind = random.random()
        if kind < 0.4:  # all in order
            return [self._right(frame) for frame in owed]
        if kind < 0.55:
            random.shuffle(owed)
            return [self._right(frame) for frame in owed]
        said: list[bytes] = []
        for frame in owed:
            choice = random.random()
            if choice < 0.5:
                said.append(self._right(frame))
            elif choice < 0.6:
                self.owed.append(frame)  # later, perhaps too late
            elif choice < 0.65:
                said += [self._right(frame), self._right(frame)]  # twice, with other data
            elif choice < 0.7 and self.asked:
                earlier = random.choice(self.asked)
                said += [encode_mbap(earlier.transaction, frame.unit, self.pdu_for(frame)), self._right(frame)]
            elif choice < 0.74:
                said.append(
                    encode_mbap(frame.transaction, frame.unit, bytes((frame.pdu[0] | 0x80, random.choice((2, 6, 11)))))
                )
            elif choice < 0.97:
                said.append(self._odd(frame))
            # else never
        return said

    def _right(self, frame: MbapFrame) -> bytes:
        return encode_mbap(frame.transaction, frame.unit, self.pdu_for(frame))

    def _odd(self, frame: MbapFrame) -> bytes:
        """A reply that looks the same in most of its first bytes."""
        random, pdu = self._random, self.pdu_for(frame)
        return random.choice(
            (
                encode_mbap(frame.transaction, frame.unit, pdu[:-1]),
                encode_mbap(frame.transaction, frame.unit, pdu[:-2]),
                encode_mbap(frame.transaction, frame.unit, pdu[:1] + bytes((pdu[1] + 2 & 0xFF,)) + pdu[2:]),
                encode_mbap(frame.transaction, frame.unit, (pdu + b"\0\0")[:253]),
                encode_mbap(frame.transaction, frame.unit ^ 1, pdu),
                encode_mbap(frame.transaction, frame.unit, bytes((pdu[0] ^ 7,)) + pdu[1:]),
                encode_mbap(frame.transaction ^ 0x100, frame.unit, pdu),
                encode_mbap(frame.transaction, frame.unit, pdu[:1]),
                encode_mbap(frame.transaction, frame.unit, pdu[:2]),
                self._right(frame)[:2] + b"\x00\x01" + self._right(frame)[4:],
            )
        )


def seen(outcome: Any) -> object:
    """What a caller sees of an outcome, by value."""
    if isinstance(outcome, ModbusError):
        return type(outcome), outcome.args, outcome.raw
    return outcome if outcome is None else (outcome.code, outcome.encode())


def own_value(outcome: Message, frame: MbapFrame, rights: dict[int, list[bytes]]) -> bool:
    """Whether a reply is the first right one with the identifier of its request."""
    return bool(rights.get(frame.transaction)) and rights[frame.transaction][0] == outcome.encode()


def is_right(frame: MbapFrame, adu: bytes) -> bool:
    """Whether a frame is a reply of the unit, the function and the length that were asked."""
    if adu[2:4] != b"\0\0" or adu[6] != frame.unit or int.from_bytes(adu[:2], "big") != frame.transaction:
        return False
    pdu = adu[7:]
    if frame.pdu[0] == 6:
        return pdu == frame.pdu
    return pdu[:2] == bytes((frame.pdu[0], size_of(frame.pdu))) and len(pdu) == 2 + size_of(frame.pdu)


def run(seed: int, steps: int = STEPS) -> int:
    """One conversation; returns how many values were read."""
    random = Random(seed)
    places = random.choice((1, 2, 5, 16))
    first = random.choice((0, 0xFF00, 0xF000))
    fast, decoding = (ClientWire(max_transactions=places, first_transaction=first, retries=0) for _ in range(2))
    clients = (fast, decoding)
    server = Server(random)
    calls: list[tuple[Call, Call]] = []
    frames: list[MbapFrame] = []
    rights: dict[int, list[bytes]] = {}  # by identifier, what has come for it while nothing else had
    known: dict[tuple[int, int], object] = {}
    for step in range(steps):
        for _ in range(random.randint(0, 2)):
            shapes = [random.choice(SHAPES)] * random.randint(1, 9)
            if random.random() < 0.3:
                shapes = [random.choice(SHAPES) for _ in shapes]
            calls.append(
                tuple(  # type: ignore[arg-type]
                    wire.ask(*(build(shape, checked=wire is decoding) for shape in shapes)) for wire in clients
                )
            )
        sent = fast.transmit()
        assert decoding.transmit() == sent
        frames += sent
        server.owed += sent
        said = server.says()
        server.asked += sent
        for adu in said:
            transaction = int.from_bytes(adu[:2], "big")
            mine = [frame for frame in frames if frame.transaction == transaction]
            rights.setdefault(transaction, [])
            rights[transaction] += [adu[7:] for frame in mine[-1:] if is_right(frame, adu)]
        stream = b"".join(said)
        cuts = sorted(random.randint(0, len(stream)) for _ in range(random.choice((0, 0, 1, 3))))
        for begin, end in zip([0, *cuts], [*cuts, len(stream)], strict=True):
            for wire in clients:
                buffer = bytearray(stream[begin:end] + stream[:30])  # what lies behind did not come
                wire.session.receive(buffer, end - begin, wire.now)
                buffer[:] = b"\xee" * len(buffer)  # it is used again
        if random.random() < 0.3:
            for wire in clients:
                wire.wait(1.1)
        assert fast.session.recycle == decoding.session.recycle
        if fast.session.recycle or random.random() < 0.05:
            server.owed.clear()
            for wire in clients:
                wire.reconnect()
        about = f"seed {seed}, step {step}: {[adu.hex(' ') for adu in said]}"
        assert asdict(fast.session.counters) == asdict(decoding.session.counters), about
        assert fast.session.in_flight == decoding.session.in_flight, about
        requests = iter(frames)
        for number, (one, other) in enumerate(calls):
            for position, outcomes in enumerate(zip(one.outcomes, other.outcomes, strict=True)):
                outcome = outcomes[0]
                assert seen(outcome) == seen(outcomes[1]), about
                frame = next(requests, None)  # requests leave in the order in which they were asked, each once
                if isinstance(outcome, Message):
                    assert frame is not None
                    assert own_value(outcome, frame, rights), about
                if outcome is not None:
                    assert known.setdefault((number, position), seen(outcome)) == seen(outcome), about
    return sum(isinstance(outcome, Message) for one, _ in calls for outcome in one.outcomes)


def test_each_request_gets_the_first_right_reply_with_its_identifier_and_no_other() -> None:
    assert sum(map(run, SEEDS)) > 10 * len(SEEDS)


class Low(ReadHoldingRegisters):
    """A read of registers that never hold more than 9."""

    def check_reply(self, reply: Any) -> str | None:
        return None if max(reply.registers) < 10 else "more than 9"


class OwnLow(Low):
    """The same with a function code of its own."""

    code = 0x41


class Accepting(ReadHoldingRegisters):
    """A read that looks at its reply itself."""

    def accept(self, pdu: bytes) -> Message:
        reply = super().accept(pdu)
        if pdu[-1] > 9:
            raise MalformedPdu("more than 9")
        return reply


class OwnAccepting(Accepting):
    """The same with a function code of its own."""

    code = 0x42


@pytest.mark.parametrize("kind", [Low, OwnLow, Accepting, OwnAccepting])
@pytest.mark.parametrize("together", [1, 3])
def test_a_check_that_a_derived_request_makes_of_its_reply_is_made(kind: Any, together: int) -> None:
    wire = ClientWire(max_transactions=8)
    good, bad = (wire.ask(*[kind(0, 2) for _ in range(together)]) for _ in range(2))
    for number, frame in enumerate(wire.transmit()):
        wire.reply(frame, struct.pack(">BBHH", kind.code, 4, 8, 9 + number // together))
    assert [outcome.registers for outcome in good.outcomes if isinstance(outcome, kind.Reply)] == [[8, 9]] * together
    assert [isinstance(one, BadReply) and "more than 9" in str(one) for one in bad.outcomes] == [True] * together


def test_a_reply_class_that_a_derived_request_declares_is_what_its_caller_gets() -> None:
    class Scaled(ReadHoldingRegisters):
        """A read of tenths."""

        class Reply(ReadHoldingRegisters.Reply):
            """The registers."""

            @property
            def tenths(self) -> list[float]:
                return [register / 10 for register in self.registers]

    wire = ClientWire(max_transactions=8)
    calls = wire.ask(Scaled(0, 1)), wire.ask(Scaled(0, 1), Scaled(0, 1))
    for frame in wire.transmit():
        wire.reply(frame, bytes.fromhex("03 02 0019"))
    assert [outcome.tenths for call in calls for outcome in call.outcomes if isinstance(outcome, Scaled.Reply)] == [
        [2.5]
    ] * 3
