"""A client's conversation with a server that does whatever it likes: no reply is ever given to another request.

The register at an address holds the address, so a reply in the wrong hands shows. Every call ends; no place among
the requests in flight is ever lost.
"""

from conversations import ClientWire, answer_to, read
from examples import examples
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from busway.errors import LinkDown, ModbusError, Overloaded
from busway.framing.mbap import MbapFrame, encode_mbap
from busway.options.client import MismatchPolicy
from busway.pdu.message import Request
from busway.pdu.read_items import ReadHoldingRegisters
from busway.pdu.write_items import WriteSingleRegister
from busway.session.call import Call

READS = st.builds(read, st.integers(0, 500), st.integers(1, 2))
WRITES = st.builds(WriteSingleRegister, st.integers(0, 500), st.integers(0, 0xFFFF))
SHIFTS = st.sampled_from([1, 2, 3, 0xFFFF, 0x8000])


class Conversation(RuleBasedStateMachine):
    """Policy strict: the server may do anything but answer a request with the data of another under its name."""

    policy = MismatchPolicy.STRICT
    transactions = 4
    requests = st.lists(st.one_of(READS, WRITES), min_size=1, max_size=6)

    def __init__(self) -> None:
        super().__init__()
        self.wire = ClientWire(
            max_transactions=self.transactions, queue=12, transaction_policy=self.policy, recycle_after_foreign=6
        )
        self.connected = True
        self.calls: list[Call] = []
        self.cancelled: list[Call] = []
        self.frames: list[MbapFrame] = []
        self.stream = b""

    # The application.

    @rule(
        data=st.data(),
        unit=st.sampled_from([1, 2, 255]),
        caller=st.integers(0, 2),
        deadline=st.sampled_from([None, 0.3, 1.5]),
        retries=st.integers(0, 2),
    )
    def ask(self, data: st.DataObject, unit: int, caller: int, deadline: float | None, retries: int) -> None:
        requests: list[Request] = data.draw(self.requests)
        until = None if deadline is None else self.wire.now + deadline
        call = self.wire.call(requests, unit, caller=caller, deadline=until, retries=retries)
        try:
            self.wire.session.submit(call, self.wire.now)
        except Overloaded:
            return
        self.calls.append(call)
        self.transmit()

    @precondition(lambda self: self.calls)
    @rule(data=st.data())
    def cancel(self, data: st.DataObject) -> None:
        call = data.draw(st.sampled_from(self.calls))
        self.wire.session.cancel(call)
        self.cancelled.append(call)

    # The driver.

    @rule()
    def transmit(self) -> None:
        if self.wire.session.recycle:
            self.close()
            self.connect()
        elif self.connected:
            self.frames += self.wire.transmit()

    @rule(seconds=st.sampled_from([0.1, 0.4, 1.0]))
    def wait(self, seconds: float) -> None:
        self.wire.wait(seconds)
        self.transmit()

    @precondition(lambda self: self.connected)
    @rule()
    def close(self) -> None:
        self.wire.session.disconnected(self.wire.now, "the peer closed it")
        self.connected = False
        self.frames, self.stream = [], b""
        assert self.wire.session.in_flight == 0

    @precondition(lambda self: not self.connected)
    @rule()
    def connect(self) -> None:
        self.wire.session.connected(self.wire.now)
        self.connected = True

    @precondition(lambda self: not self.connected)
    @rule()
    def refuse_connection(self) -> None:
        self.wire.session.unreachable(self.wire.now, LinkDown("refused"))

    # The server.

    @precondition(lambda self: self.stream)
    @rule(size=st.sampled_from([1, 3, 8, 20, 500]))
    def deliver(self, size: int) -> None:
        arriving, self.stream = self.stream[:size], self.stream[size:]
        self.wire.feed(arriving)
        self.transmit()

    @precondition(lambda self: self.frames)
    @rule(data=st.data(), at_once=st.booleans())
    def answer(self, data: st.DataObject, at_once: bool) -> None:
        frame = self.chosen(data)
        self.say(frame, answer_to(frame))
        if at_once:
            self.deliver(len(self.stream))

    @precondition(lambda self: self.frames)
    @rule(data=st.data(), shift=SHIFTS)
    def answer_with_another_transaction(self, data: st.DataObject, shift: int) -> None:
        frame = self.chosen(data)
        self.say(frame, answer_to(frame), shift=shift)

    @precondition(lambda self: self.frames)
    @rule(data=st.data(), code=st.integers(1, 11))
    def answer_with_an_exception(self, data: st.DataObject, code: int) -> None:
        frame = self.chosen(data)
        self.say(frame, bytes((frame.pdu[0] | 0x80, code)))

    @precondition(lambda self: self.frames)
    @rule(
        data=st.data(), pdu=st.sampled_from([b"\x04\x02\x00\x01", b"\x03", b"\x83", b"\x03\x04\x00", b"\x06\x00\x01"])
    )
    def answer_with_nonsense(self, data: st.DataObject, pdu: bytes) -> None:
        self.say(self.chosen(data), pdu)

    @precondition(lambda self: self.frames)
    @rule(data=st.data())
    def answer_for_another_unit(self, data: st.DataObject) -> None:
        frame = self.chosen(data)
        self.stream += encode_mbap(frame.transaction, frame.unit ^ 3, answer_to(frame))

    @precondition(lambda self: self.frames)
    @rule(data=st.data())
    def answer_in_another_protocol(self, data: st.DataObject) -> None:
        frame = self.chosen(data)
        adu = encode_mbap(frame.transaction, frame.unit, answer_to(frame))
        self.stream += adu[:3] + b"\x01" + adu[4:]

    @rule(length=st.sampled_from([0, 1, 255, 0xFFFF]))
    def say_a_length_that_cannot_be(self, length: int) -> None:
        if self.connected:
            self.stream += b"\x00\x01\x00\x00" + length.to_bytes(2, "big")

    def chosen(self, data: st.DataObject) -> MbapFrame:
        return data.draw(st.sampled_from(self.frames))

    def say(self, frame: MbapFrame, pdu: bytes, *, shift: int = 0) -> None:
        self.stream += encode_mbap(frame.transaction + shift & 0xFFFF, frame.unit, pdu)

    # What holds whatever happens.

    @invariant()
    def no_place_is_lost(self) -> None:
        session = self.wire.session
        assert self.wire.places == self.transactions
        assert session.in_flight <= self.transactions
        assert session.queued <= 12 + self.transactions

    @invariant()
    def every_reply_is_that_of_its_request(self) -> None:
        for call in self.calls:
            assert call.open == sum(outcome is None for outcome in call.outcomes)
            for request, outcome in zip(call.requests, call.outcomes, strict=True):
                if isinstance(outcome, ReadHoldingRegisters.Reply):
                    assert isinstance(request, ReadHoldingRegisters)
                    assert outcome.registers == list(range(request.address, request.address + request.count))
                elif isinstance(outcome, WriteSingleRegister.Reply):
                    assert outcome.encode() == request.encode()
                else:
                    assert outcome is None or isinstance(outcome, ModbusError)

    @invariant()
    def the_next_deadline_is_known(self) -> None:
        session = self.wire.session
        deadline = session.deadline()
        assert session.in_flight == 0 or deadline is not None
        if deadline is not None:
            assert deadline > self.wire.now or self.recently(deadline)

    def recently(self, deadline: float) -> bool:
        """A deadline that was reached is dealt with by the next tick, which is due now."""
        self.wire.session.tick(self.wire.now)
        again = self.wire.session.deadline()
        return again is None or again > self.wire.now

    def teardown(self) -> None:
        """Where the server behaves again, every call ends, and nothing is left of them."""
        for _ in range(60):
            if not self.connected:
                self.connect()
            if self.wire.session.recycle:
                self.close()
                self.connect()
            for frame in self.wire.transmit():
                self.wire.reply(frame)
            self.wire.wait(0.2)
        for call in self.calls:
            assert call.ended
            assert call.open == 0 or call in self.cancelled
        assert self.wire.session.in_flight == self.wire.session.queued == 0
        assert self.wire.session.deadline() is None
        finished = self.wire.finished()
        assert len({id(call) for call in finished}) == len(finished), "no call ends twice"


class ForeignTransactions(Conversation):
    """Policy automatic, and a server that never gives back the identifier: each request is answered once or not.

    Nothing tells its replies apart but their order; that is why a timeout ends the connection.
    """

    policy = MismatchPolicy.AUTOMATIC
    transactions = 1
    requests = st.lists(st.builds(read, st.integers(0, 500)), min_size=1, max_size=2)
    """All alike, so that a late reply fits whatever is in flight by then."""

    # Its only vices are silence, lateness and the identifier: the rest of the repertoire would end the connection.
    answer_with_another_transaction = None
    answer_with_nonsense = None
    answer_for_another_unit = None
    answer_in_another_protocol = None
    say_a_length_that_cannot_be = None

    def chosen(self, data: st.DataObject) -> MbapFrame:
        frame = data.draw(st.sampled_from(self.frames))
        self.frames.remove(frame)
        return frame

    def say(self, frame: MbapFrame, pdu: bytes, *, shift: int = 0) -> None:
        self.stream += encode_mbap(0, frame.unit, pdu)


LIMITS = settings(
    max_examples=examples(120),
    stateful_step_count=50,
    deadline=None,
    suppress_health_check=[HealthCheck.filter_too_much],
)
TestConversation = Conversation.TestCase
TestConversation.settings = LIMITS
TestForeignTransactions = ForeignTransactions.TestCase
TestForeignTransactions.settings = LIMITS
