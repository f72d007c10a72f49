"""The server's side of a TCP connection: order of checks, slots, late replies, silence, and any split of the stream."""

import struct
import sys
import tracemalloc
from collections.abc import Awaitable, Callable
from typing import Any

import pytest
from examples import examples
from hypothesis import given, settings
from hypothesis import strategies as st
from message_strategies import any_request

from busway.codes import ExceptionCode
from busway.framing.mbap import MbapFrame, MbapReceiver, encode_mbap
from busway.pdu.exception_response import ExceptionResponse
from busway.pdu.functions import STANDARD, AnyRequest
from busway.pdu.message import Message
from busway.pdu.read_items import ReadHoldingRegisters
from busway.pdu.unknown_functions import OpaqueReply
from busway.server.device import Device
from busway.server.device_responder import DeviceResponder
from busway.server.table_declaration import Cells
from busway.session.diagnostic_counters import LineDiagnostics
from busway.session.responder import (
    LATER,
    SILENCE,
    ClientIdentity,
    Deferral,
    Refusal,
    RequestContext,
    ResponderAnswer,
    ServedUnit,
)
from busway.session.server_pipeline import RequestPipeline
from busway.session.server_transaction_slots import ServerTransactionSlots
from busway.session.tcp_server import TcpServerSession

READ = bytes.fromhex("03 0000 0001")
ANSWER = ReadHoldingRegisters.Reply(b"\x00\x07")


class Scripted:
    """A handler that does what the test says and keeps what it was asked."""

    functions = STANDARD

    def __init__(
        self, act: Callable[[RequestContext, AnyRequest], ResponderAnswer] = lambda context, request: ANSWER
    ) -> None:
        self.act = act
        self.generation = 0
        self.asked: list[tuple[RequestContext, AnyRequest]] = []
        self.device: Device | None = None
        self.looked_up: list[int] = []

    def serves(self, unit: int) -> ServedUnit | None:
        self.looked_up.append(unit)
        return ServedUnit(unit, self.device)

    def answer(self, context: RequestContext, request: AnyRequest) -> ResponderAnswer:
        self.asked.append((context, request))
        return self.act(context, request)


class Peer:
    """A client at the other end of a session."""

    def __init__(
        self, handler: Any, *, slots: ServerTransactionSlots | None = None, changes_allowed: bool = True
    ) -> None:
        self.slots = slots or ServerTransactionSlots(16)
        self.diagnostics = LineDiagnostics(changes_allowed=changes_allowed)
        self.late: list[bytes] = []
        self.session = TcpServerSession(
            RequestPipeline(handler),
            diagnostics=self.diagnostics,
            slots=self.slots,
            deliver=self.late.append,
            client=ClientIdentity(peer="192.0.2.9:40000", listener="tcp://127.0.0.1:502", role="operator"),
        )
        self.transaction = 0

    def send(self, *pdus: bytes, unit: int = 1) -> list[bytes]:
        """Send requests in one segment; the PDUs of the answers that leave at once."""
        stream = b""
        for pdu in pdus:
            self.transaction += 1
            stream += encode_mbap(self.transaction, unit, pdu)
        return [frame.pdu for frame in self.feed(stream)]

    def feed(self, stream: bytes) -> list[MbapFrame]:
        return MbapReceiver().receive(b"".join(self.session.receive(stream, len(stream))))

    def arrived(self) -> list[MbapFrame]:
        """The late replies since the last call."""
        frames = MbapReceiver().receive(b"".join(self.late))
        self.late.clear()
        return frames


def later(context: RequestContext, request: AnyRequest) -> ResponderAnswer:
    return LATER


def test_a_session_that_was_never_asked_keeps_no_containers() -> None:
    pipeline, diagnostics, slots = RequestPipeline(Scripted()), LineDiagnostics(), ServerTransactionSlots(16)
    client = ClientIdentity()
    late: list[bytes] = []
    deliver = late.append

    def session() -> TcpServerSession:
        return TcpServerSession(pipeline, diagnostics=diagnostics, slots=slots, deliver=deliver, client=client)

    first = session()
    tracemalloc.start()
    try:
        kept = [session() for _ in range(1000)]
        size = tracemalloc.get_traced_memory()[0] / len(kept)
    finally:
        tracemalloc.stop()
    assert size < sys.getsizeof(first) + 32, size  # itself, its place in the list, and what the collector keeps of it


# One request.


@pytest.mark.clause("T30")
@pytest.mark.clause("T24")
@pytest.mark.parametrize(("transaction", "unit"), [(0, 0), (1, 1), (0xFFFF, 255), (0x1501, 17)])
def test_an_answer_has_the_transaction_and_the_unit_of_its_request(transaction: int, unit: int) -> None:
    peer = Peer(Scripted())
    assert peer.session.receive(encode_mbap(transaction, unit, READ), 12) == [
        encode_mbap(transaction, unit, b"\x03\x02\x00\x07")
    ]


@pytest.mark.clause("T36")
def test_a_handler_learns_who_asks_and_on_which_listener() -> None:
    handler = Scripted()
    Peer(handler).send(READ, unit=9)
    ((context, request),) = handler.asked
    assert request == ReadHoldingRegisters(0, 1)
    assert (context.peer, context.listener, context.role) == ("192.0.2.9:40000", "tcp://127.0.0.1:502", "operator")
    assert (context.unit, context.function, context.transaction) == (9, 3, 1)


@pytest.mark.clause("A2")
@pytest.mark.clause("T28")
def test_function_0_is_answered_80_01_and_the_handler_is_not_asked() -> None:
    handler = Scripted()
    assert Peer(handler).send(b"\x00", b"\x00\x01\x02") == [b"\x80\x01", b"\x80\x01"]
    assert handler.asked == []


@pytest.mark.clause("A2")
@pytest.mark.parametrize("function", [0x80, 0x83, 0xAB, 0xFF])
def test_a_function_above_127_is_discarded_and_counted(function: int) -> None:
    handler = Scripted()
    peer = Peer(handler)
    assert peer.send(bytes((function, 2)), READ) == [ANSWER.encode()]
    assert (peer.session.discarded, peer.session.requests, len(handler.asked)) == (1, 1, 1)


@pytest.mark.clause("T28")
@pytest.mark.parametrize("protocol", [1, 0x0100, 0xFFFF])
def test_a_request_of_another_protocol_is_discarded_and_the_stream_goes_on(protocol: int) -> None:
    handler = Scripted()
    peer = Peer(handler, slots=ServerTransactionSlots(1))
    foreign = struct.pack(">HHHB", 7, protocol, 6, 1) + READ
    assert [frame.transaction for frame in peer.feed(foreign + encode_mbap(8, 1, READ))] == [8]
    assert (peer.session.discarded, len(handler.asked)) == (1, 1)


@pytest.mark.clause("T28")
@pytest.mark.parametrize("length", [0, 1, 255, 256, 0xFFFF])
@pytest.mark.parametrize("behind", [0, 1, 2, 300])
def test_a_length_that_cannot_be_ends_the_stream_after_what_came_before_it(length: int, behind: int) -> None:
    peer = Peer(Scripted())
    broken = struct.pack(">HHH", 9, 0, length) + bytes(behind)
    stream = encode_mbap(1, 1, READ) + encode_mbap(2, 1, READ) + broken
    assert [frame.transaction for frame in peer.feed(stream)] == [1, 2]
    assert peer.session.broken == f"length field {length}, where 2…254 can be"
    assert peer.feed(encode_mbap(3, 1, READ)) == []


@pytest.mark.clause("A1")
def test_the_longest_pdu_is_taken_and_a_byte_more_is_a_broken_stream() -> None:
    handler = Scripted(lambda context, request: OpaqueReply(0x41, bytes(252)))
    peer = Peer(handler)
    (answer,) = peer.session.receive(encode_mbap(1, 1, b"\x41" + bytes(252)), 260)
    assert len(answer) == 260
    peer.feed(struct.pack(">HHH", 2, 0, 255))
    assert peer.session.broken


@pytest.mark.clause("T31")
@pytest.mark.parametrize("code", [*ExceptionCode, 0x55])
def test_a_refusal_is_answered_with_its_code(code: int) -> None:
    def refuse(context: RequestContext, request: AnyRequest) -> ResponderAnswer:
        raise Refusal(code)

    peer = Peer(Scripted(refuse))
    assert peer.send(READ) == [bytes((0x83, code))]
    assert not peer.session.failures


@pytest.mark.clause("A20")
def test_a_handler_that_fails_is_answered_04_and_the_failure_is_kept_for_the_log() -> None:
    def fail(context: RequestContext, request: AnyRequest) -> ResponderAnswer:
        raise ZeroDivisionError("a bug")

    peer = Peer(Scripted(fail))
    assert peer.send(READ) == [b"\x83\x04"]
    (failure,) = peer.session.failures
    assert isinstance(failure.error, ZeroDivisionError)
    assert failure.context.function == 3


def test_silence_is_counted() -> None:
    peer = Peer(Scripted(lambda context, request: SILENCE))
    assert peer.send(READ) == []
    assert peer.diagnostics.counters.server_no_response_count == 1
    assert peer.session.waiting == 0


# Slots.


@pytest.mark.clause("T27")
def test_past_the_slots_a_request_is_answered_06_before_its_function_is_looked_at() -> None:
    handler = Scripted(later)
    peer = Peer(handler, slots=ServerTransactionSlots(2))
    assert peer.send(READ, READ, READ, b"\x00", b"\x41") == [b"\x83\x06", b"\x80\x06", b"\xc1\x06"]
    assert (len(handler.asked), peer.session.waiting, peer.session.refused_busy) == (2, 2, 3)
    assert peer.diagnostics.counters.server_busy_count == 3
    # What is no request of this protocol is discarded all the same.
    assert peer.feed(struct.pack(">HHHB", 7, 1, 6, 1) + READ) == []


@pytest.mark.clause("T27")
@pytest.mark.parametrize("limit", [1, 16])
def test_a_service_that_is_finished_within_its_call_holds_no_slot(limit: int) -> None:
    peer = Peer(Scripted(), slots=ServerTransactionSlots(limit))
    assert peer.send(*[READ] * 50) == [ANSWER.encode()] * 50
    assert peer.slots.used == 0


@pytest.mark.clause("T27")
def test_the_fast_path_needs_no_slot() -> None:
    handler = Scripted(later)
    handler.device = Device(input_registers=[9], functions=[4])
    peer = Peer(handler, slots=ServerTransactionSlots(1))
    assert peer.send(READ) == []
    assert peer.send(bytes.fromhex("04 0000 0001"), READ) == [b"\x04\x02\x00\x09", b"\x83\x06"]


@pytest.mark.clause("T27")
def test_slots_may_be_shared_by_all_connections_of_a_server() -> None:
    slots = ServerTransactionSlots(2)
    one, two = Peer(Scripted(later), slots=slots), Peer(Scripted(later), slots=slots)
    assert one.send(READ, READ) == []
    assert two.send(READ) == [b"\x83\x06"]
    one.session.close()
    assert slots.used == 0
    assert two.send(READ) == []


@pytest.mark.clause("T27")
def test_connections_that_are_given_the_same_limit_count_apart() -> None:
    slots = ServerTransactionSlots(1, of_each_connection=True)
    one, two = Peer(Scripted(later), slots=slots), Peer(Scripted(later), slots=slots)
    for _ in range(2):
        assert one.send(READ, READ) == [b"\x83\x06"]
        assert two.send(READ) == []
        for peer in (one, two):
            peer.session.close()
            assert peer.session.waiting == 0
        one, two = Peer(Scripted(later), slots=slots), Peer(Scripted(later), slots=slots)
    assert slots.used == 0


@pytest.mark.clause("T27")
def test_a_slot_is_free_again_once_the_late_reply_has_left() -> None:
    handler = Scripted(later)
    peer = Peer(handler, slots=ServerTransactionSlots(1))
    for transaction in range(1, 4):
        assert peer.send(READ) == []
        handler.asked[-1][0].reply(ANSWER)
        assert [frame.transaction for frame in peer.arrived()] == [transaction]
    assert peer.slots.used == 0


# Late replies.


@pytest.mark.clause("T29")
@pytest.mark.clause("T30")
def test_late_replies_leave_in_any_order_each_as_it_was_asked() -> None:
    handler = Scripted(later)
    peer = Peer(handler)
    for unit in (5, 6, 7):
        peer.send(READ, unit=unit)
    for context, _ in reversed(handler.asked):
        context.reply(ReadHoldingRegisters.Reply(bytes((0, context.unit))))
    assert [(frame.transaction, frame.unit, frame.pdu[-1]) for frame in peer.arrived()] == [
        (3, 7, 7),
        (2, 6, 6),
        (1, 5, 5),
    ]
    assert peer.session.waiting == 0


@pytest.mark.clause("T29")
def test_a_request_has_one_answer_however_often_its_handler_gives_it() -> None:
    def eager(context: RequestContext, request: AnyRequest) -> ResponderAnswer:
        context.reply(ANSWER)
        context.refuse(4)
        return LATER

    def confused(context: RequestContext, request: AnyRequest) -> ResponderAnswer:
        context.reply(ANSWER)
        return ExceptionResponse(3, 4)

    def failing(context: RequestContext, request: AnyRequest) -> ResponderAnswer:
        context.reply(ANSWER)
        raise ValueError("too late")

    for act in (eager, confused, failing):
        peer = Peer(Scripted(act))
        assert peer.send(READ) == []
        assert [frame.pdu for frame in peer.arrived()] == [ANSWER.encode()]
        assert (peer.slots.used, peer.session.waiting) == (0, 0)


def test_a_late_reply_after_one_at_once_is_not_sent() -> None:
    handler = Scripted()
    peer = Peer(handler)
    assert peer.send(READ) == [ANSWER.encode()]
    context = handler.asked[0][0]
    assert context.replied
    context.reply(ANSWER)
    assert peer.arrived() == []


@pytest.mark.clause("T29")
def test_a_late_refusal_and_a_late_silence() -> None:
    handler = Scripted(later)
    peer = Peer(handler)
    peer.send(READ, READ)
    handler.asked[0][0].refuse(0x0B)
    handler.asked[1][0].reply(SILENCE)
    assert [frame.pdu for frame in peer.arrived()] == [b"\x83\x0b"]
    assert (peer.slots.used, peer.diagnostics.counters.server_no_response_count) == (0, 1)


@pytest.mark.clause("T30")
def test_a_client_that_has_gone_gets_nothing_and_its_slots_are_free() -> None:
    handler = Scripted(later)
    peer = Peer(handler, slots=ServerTransactionSlots(16))
    peer.send(READ, READ, READ)
    peer.session.close()
    assert peer.slots.used == 0
    for context, _ in handler.asked:
        assert context.replied
        context.reply(ANSWER)
    assert peer.arrived() == []
    assert peer.slots.used == 0
    assert peer.diagnostics.counters.server_no_response_count == 3
    peer.session.close()
    assert peer.slots.used == 0


@pytest.mark.clause("T29")
def test_an_awaitable_is_handed_to_the_driver_and_holds_a_slot() -> None:
    class Promise:
        def __await__(self) -> Any:
            return iter(())

    promise: Awaitable[Message] = Promise()
    peer = Peer(Scripted(lambda context, request: promise), slots=ServerTransactionSlots(1))
    assert peer.send(READ, READ) == [b"\x83\x06"]
    (deferred,) = peer.session.deferred
    assert deferred.awaitable is promise
    deferred.context.reply(ANSWER)
    assert [frame.transaction for frame in peer.arrived()] == [1]


# The fast path.


def test_a_unit_is_looked_up_once_until_the_responder_takes_it_back() -> None:
    handler = Scripted()
    handler.device = Device(holding_registers=[1])
    peer = Peer(handler)
    assert peer.send(READ, READ, READ) == [b"\x03\x02\x00\x01"] * 3
    looked_up = len(handler.looked_up)
    assert peer.send(READ, READ) == [b"\x03\x02\x00\x01"] * 2
    assert len(handler.looked_up) == looked_up
    peer.send(READ, unit=2)
    assert set(handler.looked_up) == {1, 2}
    assert handler.asked == []
    handler.device = None
    assert peer.send(READ) == [b"\x03\x02\x00\x01"]
    handler.generation += 1
    assert peer.send(READ) == [ANSWER.encode()]
    assert handler.looked_up[-1] == 1


def test_what_the_fast_path_leaves_takes_the_long_one() -> None:
    handler = Scripted()
    handler.device = Device(input_registers=[1])
    assert Peer(handler).send(READ) == [ANSWER.encode()]
    assert len(handler.asked) == 1


def test_the_fast_path_does_not_grow_without_bound() -> None:
    pipeline = RequestPipeline(Scripted())
    client = ClientIdentity()
    fast = pipeline.fast_path(client)
    for unit in range(256):
        for function in range(1, 128):
            for length in (6, 8):
                fast.bind(struct.pack(">HHBB", 0, length, unit, function))
    assert len(fast.functions) <= 4096
    assert pipeline.fast_path(client) is fast


DEVICE_SIZE = 300


def device(*, short: bool) -> Device:
    made = Device(
        holding_registers=Cells(count=DEVICE_SIZE, values=list(range(100))),
        input_registers=list(range(50)),
        coils=[position % 3 == 0 for position in range(DEVICE_SIZE)],
        discrete_inputs=77,
    )
    if not short:  # a hook keeps a table off the fast path and changes nothing else
        for table in ("holding_registers", "input_registers", "coils", "discrete_inputs"):
            made.on_read(table, lambda access: None)
        for table in ("holding_registers", "coils"):
            made.on_write(table, lambda change: None)
    return made


def near(pdu: bytes, address: int) -> bytes:
    """The request moved to an address that the device is likely to have."""
    return pdu[:1] + address.to_bytes(2, "big") + pdu[3:] if pdu[0] in (1, 2, 3, 4, 5, 6, 15, 16) else pdu


@given(
    st.lists(
        st.one_of(
            st.builds(near, any_request().map(lambda request: request.encode()), st.integers(0, DEVICE_SIZE)),
            any_request().map(lambda request: request.encode()),
            st.binary(min_size=1, max_size=20).map(lambda data: bytes((data[0] & 0x7F,)) + data[1:]),
        ),
        min_size=1,
        max_size=8,
    )
)
@settings(max_examples=examples(200))
def test_short_and_generic_path_answer_alike_count_alike_and_leave_the_same_device(pdus: list[bytes]) -> None:
    devices = [device(short=True), device(short=False)]
    peers = [Peer(DeviceResponder({1: one})) for one in devices]
    assert peers[0].send(*pdus) == peers[1].send(*pdus)
    first, second = (peer.diagnostics.of(1) for peer in peers)
    assert first.counters == second.counters
    assert first.event_log() == second.event_log()
    assert peers[0].session.requests == peers[1].session.requests
    for one, other in zip(*[(list(made.holding_registers), list(made.coils)) for made in devices], strict=True):
        assert one == other


# The stream.


@given(st.data())
@settings(max_examples=examples(100))
def test_any_split_of_the_stream_gives_the_same_answers(data: st.DataObject) -> None:
    pdus = data.draw(st.lists(any_request().map(lambda request: request.encode()), min_size=1, max_size=6))
    stream = b"".join(
        encode_mbap(number, 1, pdu) if number % 4 != 3 else struct.pack(">HHHB", number, 5, 2, 1) + b"\x03"
        for number, pdu in enumerate(pdus)
    )
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=12)))
    whole = Peer(DeviceResponder({1: device(short=True)})).feed(stream)
    split = Peer(DeviceResponder({1: device(short=True)}))
    answers: list[MbapFrame] = []
    for start, end in zip([0, *cuts], [*cuts, len(stream)], strict=True):
        answers += split.feed(stream[start:end])
    assert answers == whole
    assert split.session.unfinished == 0


def test_byte_by_byte_and_in_a_buffer_that_is_used_again() -> None:
    peer = Peer(DeviceResponder({1: device(short=True)}))
    stream = encode_mbap(1, 1, bytes.fromhex("10 0000 0001 02 1234")) + encode_mbap(2, 1, READ)
    buffer = bytearray(64)
    answers = []
    for byte in stream:
        buffer[:] = bytes(64)
        buffer[0] = byte
        answers += peer.session.receive(buffer, 1)
    assert answers == [encode_mbap(1, 1, bytes.fromhex("10 0000 0001")), encode_mbap(2, 1, b"\x03\x02\x12\x34")]


def test_an_unfinished_frame_is_known_to_be_one() -> None:
    peer = Peer(Scripted())
    peer.feed(encode_mbap(1, 1, READ)[:9])
    assert peer.session.unfinished == 9
    peer.feed(encode_mbap(1, 1, READ)[9:])
    assert peer.session.unfinished == 0


# Listen-only mode and counters.


@pytest.mark.clause("S17")
def test_in_listen_only_mode_nothing_is_answered_by_any_path_or_for_want_of_slots() -> None:
    handler = Scripted(later)
    handler.device = Device(input_registers=[9], functions=[4])
    slots = ServerTransactionSlots(1)
    peer = Peer(handler, slots=slots)
    short = bytes.fromhex("04 0000 0001")
    assert peer.send(short) == [b"\x04\x02\x00\x09"]
    peer.diagnostics.listen_only_units.add(1)
    assert peer.send(short, READ, b"\x00", short) == []
    assert handler.asked == []
    slots.used = 1
    assert peer.send(short, READ) == []
    slots.used = 0
    peer.diagnostics.of(1).restart()
    assert peer.send(short) == [b"\x04\x02\x00\x09"]


@pytest.mark.clause("S17")
def test_a_listener_is_muted_and_woken_in_the_middle_of_a_segment() -> None:
    peer = Peer(DeviceResponder({1: device(short=True)}))
    read, mute, wake = READ, bytes.fromhex("08 0004 0000"), bytes.fromhex("08 0001 0000")
    answers = peer.send(read, mute, read, read, wake, read)
    assert answers == [b"\x03\x02\x00\x00"] * 2


@pytest.mark.clause("S17")
@pytest.mark.parametrize("sub_code", ["01", "03", "04", "0A", "14"])
def test_what_changes_the_listener_is_refused_unless_switched_on(sub_code: str) -> None:
    data = "3B00" if sub_code == "03" else "0000"
    peer = Peer(DeviceResponder({1: device(short=True)}), changes_allowed=False)
    assert peer.send(bytes.fromhex(f"08 00{sub_code} {data}")) == [b"\x88\x01"]
    assert peer.send(READ) == [b"\x03\x02\x00\x00"]


@pytest.mark.clause("A23")
def test_the_event_counter_counts_what_was_answered_well_and_neither_exceptions_nor_polls() -> None:
    peer = Peer(DeviceResponder({1: device(short=True)}))
    peer.send(READ, READ, bytes.fromhex("06 0001 0002"))
    peer.send(bytes.fromhex("03 FFFF 0002"), b"\x41", b"\x0b", b"\x0c")
    assert peer.send(b"\x0b") == [bytes.fromhex("0B 0000 0003")]


@pytest.mark.clause("A23")
def test_the_event_log_shows_what_came_and_went_newest_first() -> None:
    peer = Peer(DeviceResponder({1: device(short=True)}))
    peer.send(READ, b"\x41")
    # received 12 itself, then sent exception 01 for 41, received 41, sent and received the read
    assert peer.send(b"\x0c") == [bytes.fromhex("0C 0B 0000 0001 0003 80 41 80 40 80")]


@pytest.mark.clause("S16")
def test_each_request_is_counted_where_the_flow_chart_says() -> None:
    peer = Peer(DeviceResponder({1: device(short=True)}))
    peer.send(READ, b"\x41", bytes.fromhex("03 0000 0000"), bytes.fromhex("03 FFFF 0002"))
    counters = peer.diagnostics.counters
    assert (counters.bus_message_count, counters.server_message_count) == (4, 4)
    assert (counters.bus_exception_error_count, counters.server_no_response_count) == (3, 0)
    assert (counters.server_nak_count, counters.server_busy_count) == (0, 0)


@pytest.mark.clause("A7")
def test_the_function_comes_before_its_lengths_and_these_before_its_address() -> None:
    made = device(short=True)
    made.functions = {3, 6}
    peer = Peer(DeviceResponder({1: made}))
    assert peer.send(
        bytes.fromhex("04 0000 0000"),  # not offered, and no quantity
        bytes.fromhex("04"),  # not offered, and cut off
        bytes.fromhex("03 FFFF 0000"),  # no quantity, and no such register
        bytes.fromhex("03 FFFF"),  # cut off, and no such register
        bytes.fromhex("03 FFFF 0002"),  # beyond the table
        bytes.fromhex("06 012C 0001"),  # no such register
    ) == [b"\x84\x01", b"\x84\x01", b"\x83\x03", b"\x83\x03", b"\x83\x02", b"\x86\x02"]


def test_deferral_has_the_two_outcomes_without_a_reply() -> None:
    assert set(Deferral) == {LATER, SILENCE}


# A share of what came.


def _shared(handler: Any, share: int | None) -> TcpServerSession:
    return TcpServerSession(
        RequestPipeline(handler),
        diagnostics=LineDiagnostics(changes_allowed=True),
        slots=ServerTransactionSlots(16),
        deliver=lambda adu: None,
        share=share,
    )


def _many(count: int) -> bytes:
    return b"".join(encode_mbap(one, 1, READ) for one in range(count))


def test_a_call_works_through_a_share_and_the_rest_waits_in_its_order() -> None:
    session = _shared(Scripted(), 16)
    stream = _many(40)
    answers = session.receive(stream, len(stream))
    assert (len(answers), len(session.rest), session.spent) == (16, 24 * 12, 16)
    answers += session.go_on()
    answers += session.go_on()
    assert [int.from_bytes(one[:2], "big") for one in answers] == list(range(40))
    assert (session.rest, session.unfinished, session.requests) == (b"", 0, 40)


def test_as_many_requests_as_the_share_leave_nothing_over() -> None:
    session = _shared(Scripted(), 16)
    assert len(session.receive(_many(16) + b"\0\1\0", 16 * 12 + 3)) == 16
    assert (session.rest, session.unfinished) == (b"", 3)


def test_what_is_put_off_is_worked_through_when_it_goes_on_behind_the_beginning_that_was_there() -> None:
    session = _shared(Scripted(), 16)
    stream = _many(3)
    assert len(session.receive(stream, 20)) == 1
    session.put_off(bytearray(stream[20:] + b"\xff"), 16)
    assert (session.unfinished, session.rest) == (0, stream[12:])
    assert len(session.go_on()) == 2
    assert (session.unfinished, session.rest) == (0, b"")


def test_length_that_cannot_be_ends_the_connection_only_behind_the_requests_that_came_before_it() -> None:
    session = _shared(Scripted(), 2)
    stream = _many(5) + bytes.fromhex("0009 0000 FFFF 01 03")
    answers = session.receive(stream, len(stream))
    while session.rest:
        assert not session.broken
        answers += session.go_on()
    assert len(answers) == 5
    assert session.broken


@given(
    st.lists(
        st.sampled_from([READ, b"\x03\0\0\0\0", b"\x41", b"\x06\0\0\0\1", b"\x81\1", b"\x08\0\4\0\0", b"\x08\0\1\0\0"]),
        max_size=40,
    ),
    st.lists(st.integers(1, 300), min_size=1, max_size=10),
    st.integers(1, 20),
)
def test_a_share_changes_no_byte_of_the_answers(pdus: list[bytes], cuts: list[int], share: int) -> None:
    stream = b"".join(encode_mbap(number, 1, pdu) for number, pdu in enumerate(pdus))

    def answers(share: int | None) -> bytes:
        session = _shared(DeviceResponder({1: Device(holding_registers=10)}), share)
        out, at, number = b"", 0, 0
        while at < len(stream):
            part = stream[at : at + cuts[number % len(cuts)]]
            out += b"".join(session.receive(part, len(part)))
            while session.rest:
                out += b"".join(session.go_on())
            at, number = at + len(part), number + 1
        return out

    assert answers(share) == answers(None)
