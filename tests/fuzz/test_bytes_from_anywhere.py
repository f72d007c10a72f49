"""Whatever bytes arrive: no error but ours, no hang, and time that grows with the bytes and not with their square.

The bounds are hypothesis's own number of examples; what is measured is the processor time of this process.
"""

import struct
import time
from collections.abc import Callable

import pytest
from conversations import ClientWire, read
from examples import examples
from hypothesis import example, given, settings
from hypothesis import strategies as st

from busway.codes import PDU_LIMIT
from busway.framing.mbap import FrameKind, MbapReceiver, encode_mbap
from busway.pdu.functions import STANDARD
from busway.pdu.malformed_pdu import MalformedPdu
from busway.pdu.malformed_request import MalformedRequest
from busway.pdu.message import Message
from busway.pdu.write_items import WriteSingleRegister
from busway.server.device import Device
from busway.server.device_responder import DeviceResponder
from busway.session.diagnostic_counters import LineDiagnostics
from busway.session.server_pipeline import RequestPipeline
from busway.session.server_transaction_slots import ServerTransactionSlots
from busway.session.tcp_server import TcpServerSession

PDUS = st.one_of(
    st.binary(min_size=1, max_size=PDU_LIMIT),
    # a known function, a sub-function that may be known, and anything behind it
    st.builds(
        lambda code, sub, rest: (bytes((code,)) + sub + rest)[:PDU_LIMIT],
        st.sampled_from(STANDARD.codes()),
        st.sampled_from(
            [b"", b"\x00\x00", b"\x00\x01", b"\x00\x0a", b"\x0e", b"\x0d", b"\x06", b"\x07\x06", b"\x09\x06"]
        ),
        st.binary(max_size=252),
    ),
)
FRAMES = st.builds(
    lambda transaction, protocol, length, unit, pdu: (
        struct.pack(">HHHB", transaction, protocol, len(pdu) + 1 if length is None else length, unit) + pdu
    ),
    st.integers(0, 0xFFFF),
    st.sampled_from([0, 0, 0, 0, 1, 0xFFFF]),
    st.sampled_from([None, None, None, None, None, 0, 1, 2, 254, 255]),
    st.integers(0, 255),
    PDUS,
)
STREAMS = st.lists(st.one_of(FRAMES, st.binary(max_size=40)), max_size=8).map(b"".join)
CUTS = st.integers(1, 600)


@given(PDUS)
@settings(max_examples=examples(600))
def test_any_pdu_is_a_request_of_ours_with_the_same_bytes(pdu: bytes) -> None:
    if pdu[0] > 0x7F:
        return
    request = STANDARD.decode_request(pdu)
    assert request.encode() == pdu
    if not isinstance(request, MalformedRequest):
        request.spans()
        request.reply_shape()
        repr(request)


@given(PDUS)
@example(b"")
@settings(max_examples=examples(600))
def test_any_pdu_is_a_reply_of_ours_or_malformed(pdu: bytes) -> None:
    try:
        reply = STANDARD.decode_reply(pdu)
    except MalformedPdu:
        return
    assert isinstance(reply, Message)
    assert reply.encode() == pdu or pdu[0] == 0xAB
    repr(reply)


@given(st.binary(max_size=300), st.integers(0, 300))
@settings(max_examples=examples(300))
def test_the_length_rule_gives_a_length_or_says_why_not(data: bytes, at: int) -> None:
    for rule in (STANDARD.request_length, STANDARD.reply_length):
        length = rule(data, at, len(data))
        assert length >= -1


@given(STREAMS, CUTS)
@settings(max_examples=examples(300))
def test_a_receiver_takes_any_stream_and_keeps_at_most_a_frame(stream: bytes, cut: int) -> None:
    receiver = MbapReceiver()
    frames = []
    for at in range(0, len(stream), cut):
        frames += receiver.receive(stream[at : at + cut])
        assert len(receiver.unfinished) < 260
    assert all(frame.kind is not FrameKind.BROKEN for frame in frames[:-1])


@given(STREAMS, CUTS)
@settings(max_examples=examples(300))
def test_a_server_takes_any_stream(stream: bytes, cut: int) -> None:
    device = Device(
        holding_registers=100, coils=100, input_registers=10, discrete_inputs=10, files={1: 20}, fifos={3: [1, 2]}
    )
    late: list[bytes] = []
    session = TcpServerSession(
        RequestPipeline(DeviceResponder({1: device})),
        diagnostics=LineDiagnostics(changes_allowed=True),
        slots=ServerTransactionSlots(4),
        deliver=late.append,
    )
    for at in range(0, len(stream), cut):
        part = bytearray(stream[at : at + cut])
        for answer in session.receive(part, len(part)):
            (frame,) = MbapReceiver().receive(answer)
            assert frame.kind is FrameKind.FRAME
            STANDARD.decode_reply(frame.pdu)
    assert not session.failures
    session.close()


@given(STREAMS, CUTS, st.integers(0, 4))
@settings(max_examples=examples(300))
def test_a_client_takes_any_stream(stream: bytes, cut: int, in_flight: int) -> None:
    wire = ClientWire(max_transactions=4, retries=0)
    calls = [wire.ask(read(number), WriteSingleRegister(number, 1), caller=number) for number in range(in_flight)]
    frames = wire.transmit()
    # Let some of it bear the identifiers that are awaited.
    stream = b"".join(frame.transaction.to_bytes(2, "big") + stream[:40] for frame in frames) + stream
    for at in range(0, len(stream), cut):
        wire.feed(stream[at : at + cut])
    for _ in range(10):
        wire.wait(2.0)
        if wire.session.recycle:
            wire.reconnect()
        wire.transmit()
    assert all(call.ended for call in calls)
    assert wire.places == 4


# Time.

GOOD = encode_mbap(7, 1, bytes.fromhex("03 0000 000A"))
MATERIAL = {
    "good requests": GOOD,
    "unknown functions": encode_mbap(7, 1, b"\x41"),
    "exceptions": encode_mbap(7, 1, b"\x83\x02"),
    "foreign protocol": struct.pack(">HHHB", 7, 9, 2, 1) + b"\x03",
    "shortest frames": encode_mbap(7, 1, b"\x00"),
    "longest frames": encode_mbap(7, 1, b"\x14" + b"\xf5" + b"\x06\x00\x01\x00\x00\x00\x01" * 35),
}


def server(stream: bytes, cut: int) -> None:
    session = TcpServerSession(
        RequestPipeline(DeviceResponder({1: Device(holding_registers=100)})),
        diagnostics=LineDiagnostics(),
        slots=ServerTransactionSlots(4),
        deliver=lambda adu: None,
    )
    for at in range(0, len(stream), cut):
        session.receive(stream[at : at + cut], len(stream[at : at + cut]))


def client(stream: bytes, cut: int) -> None:
    wire = ClientWire(recycle_after_foreign=1000)
    wire.ask(read())
    wire.transmit()
    for at in range(0, len(stream), cut):
        wire.feed(stream[at : at + cut])


def receiver(stream: bytes, cut: int) -> None:
    one = MbapReceiver()
    for at in range(0, len(stream), cut):
        one.receive(stream[at : at + cut])


def seconds(work: Callable[[bytes, int], None], stream: bytes, cut: int) -> float:
    """The least of several runs: what else the machine does only adds."""
    best = 1e9
    for _ in range(3):
        began = time.process_time()
        work(stream, cut)
        best = min(best, time.process_time() - began)
    return best


@pytest.mark.parametrize("work", [server, client, receiver], ids=lambda work: work.__name__)
@pytest.mark.parametrize("material", MATERIAL)
@pytest.mark.parametrize("cut", [1 << 20, 5], ids=["in one piece", "dribbling"])
@pytest.mark.real_time
def test_time_grows_with_the_bytes(work: Callable[[bytes, int], None], material: str, cut: int) -> None:
    frame = MATERIAL[material]
    small = frame * (24_000 // len(frame))
    work(small, cut)
    ratio = seconds(work, small * 4, cut) / max(seconds(work, small, cut), 1e-4)
    assert ratio < 12, "four times the bytes cost about four times the time; squares would cost sixteen"


@pytest.mark.parametrize("direction", ["request", "reply"])
@pytest.mark.real_time
def test_time_to_decode_grows_with_the_items(direction: str) -> None:
    few, many = (
        (b"\x14\x31" + bytes.fromhex("06000100000001") * 7, b"\x14\xf5" + bytes.fromhex("06000100000001") * 35)
        if direction == "request"
        else (
            b"\x2b\x0e\x03\x83\x00\x00\x18" + b"\x00\x00" * 24,
            b"\x2b\x0e\x03\x83\x00\x00\x78" + b"\x00\x00" * 120,
        )
    )
    decode = STANDARD.decode_request if direction == "request" else STANDARD.decode_reply

    def work(pdu: bytes, times: int) -> None:
        for _ in range(times):
            decode(pdu)

    work(many, 1)
    assert seconds(work, many, 200) / max(seconds(work, few, 200), 1e-4) < 15
