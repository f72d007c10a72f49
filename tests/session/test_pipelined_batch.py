"""Pipelined batches: they end as requests in flight one by one do, and are packed once."""

from dataclasses import asdict
from typing import Any

import pytest
from conversations import ClientWire, answer_to, read
from hypothesis import given
from hypothesis import strategies as st

from busway.errors import ExceptionReply, ModbusError
from busway.framing.mbap import MbapFrame, encode_mbap
from busway.pdu.message import Request
from busway.pdu.read_items import ReadCoils, ReadHoldingRegisters, ReadInputRegisters
from busway.pdu.write_items import WriteSingleRegister
from busway.session.call import Call
from busway.session.pipelined_batch import packed_batch

REQUESTS = st.lists(
    st.one_of(
        st.builds(read, st.integers(0, 500), st.integers(1, 125)),
        st.builds(ReadInputRegisters, st.integers(0, 500), st.integers(1, 3)),
        st.builds(WriteSingleRegister, st.integers(0, 9), st.integers(0, 9)),
    ),
    min_size=2,
    max_size=20,
)


def reply_to(frame: MbapFrame) -> bytes:
    pdu = answer_to(frame)
    if frame.pdu[0] == 4:
        pdu = bytes((4, 2 * frame.pdu[4])) + bytes(range(2 * frame.pdu[4]))
    return pdu


def faulty(kind: str, frame: MbapFrame) -> bytes:
    """What a device says to a frame."""
    pdu = reply_to(frame)
    if kind == "exception":
        pdu = bytes((frame.pdu[0] | 0x80, 2))
    elif kind == "short":
        pdu = pdu[:-1]
    elif kind == "nothing but a function":
        pdu = pdu[:1]
    elif kind == "late":
        return encode_mbap(frame.transaction + 7 & 0xFFFF, frame.unit, pdu)
    elif kind == "unit":
        return encode_mbap(frame.transaction, frame.unit ^ 3, pdu)
    return encode_mbap(frame.transaction, frame.unit, pdu)


def seen(outcome: Any) -> object:
    if isinstance(outcome, ModbusError):
        return type(outcome), outcome.args, outcome.raw, outcome.attempt
    return outcome


@given(
    requests=REQUESTS,
    places=st.integers(1, 16),
    first=st.integers(0, 0xFFFF),
    data=st.data(),
)
def test_a_batch_ends_the_same_whether_its_requests_fly_together_or_each_by_itself(
    requests: list[Request], places: int, first: int, data: st.DataObject
) -> None:
    together, single = (
        ClientWire(max_transactions=places, first_transaction=first, single_adu_segments=split, retries=1)
        for split in (False, True)
    )
    calls = [wire.ask(*requests) for wire in (together, single)]
    frames: list[MbapFrame] = []
    for _ in range(data.draw(st.integers(1, 6))):
        new = together.transmit()
        assert new == single.transmit()
        frames += new
        step = data.draw(st.sampled_from(["in order", "any order", "a part", "odd", "time", "lost", "cancel"]))
        stream = b""
        if step == "odd" and frames:
            at = data.draw(st.integers(0, len(frames) - 1))
            kinds = ["exception", "short", "late", "unit", "nothing but a function", "twice"]
            kind = data.draw(st.sampled_from(kinds))
            before, frame, frames = frames[:at], frames[at], frames[at + 1 :]
            stream = b"".join(faulty("", one) for one in before) + faulty(kind, frame) * (1 + (kind == "twice"))
        elif step in ("in order", "any order", "a part"):
            taken = frames if step != "any order" else data.draw(st.permutations(frames))
            stream = b"".join(faulty("", one) for one in taken)
            frames = []
            if step == "a part":
                stream = stream[: data.draw(st.integers(0, len(stream)))]
        pieces = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=3)))
        for wire, call in zip((together, single), calls, strict=True):
            for begin, end in zip([0, *pieces], [*pieces, len(stream)], strict=True):
                if begin < end:
                    wire.feed(stream[begin:end])
            if step == "time":
                wire.wait(0.6)
            elif step == "lost":
                wire.reconnect()
            elif step == "cancel":
                wire.session.cancel(call)
            if wire.session.recycle:
                wire.reconnect(wire.session.recycle)
        if step == "lost":
            frames = []
        assert together.session.deadline() == single.session.deadline()
        assert together.session.in_flight == single.session.in_flight
        assert together.places == single.places == places
        assert asdict(together.session.counters) == asdict(single.session.counters)
        assert [seen(one) for one in calls[0].outcomes] == [seen(one) for one in calls[1].outcomes]
        assert calls[0].open == calls[1].open


@pytest.mark.parametrize("apart", [False, True])
def test_writes_that_are_repeated_after_a_lost_connection_keep_their_order(apart: bool) -> None:
    wire = ClientWire(max_transactions=2, single_adu_segments=apart, retries=1)
    wire.ask(*(WriteSingleRegister(5, value) for value in (1, 2, 3)), idempotent=True)
    first, _ = wire.transmit()
    wire.feed(faulty("", first))
    wire.transmit()
    wire.reconnect()
    assert [frame.pdu[-1] for frame in wire.transmit()] == [2, 3]


def registers(call: Call) -> list[list[int]]:
    return [one.registers for one in call.outcomes if isinstance(one, ReadHoldingRegisters.Reply)]


def test_a_batch_that_nothing_holds_up_leaves_whole_without_the_queue() -> None:
    wire = ClientWire(max_transactions=4)
    call = wire.call([read(1), read(2), read(3)])
    adus = wire.session.send_now(call, wire.now)
    assert adus is not None
    assert len(adus) == 3 * 12
    assert (wire.session.in_flight, wire.session.queued, call.has_more) == (3, 0, False)
    assert wire.session.send_now(wire.call([read(4), read(5)]), wire.now) is None  # one place is free
    for number, at in enumerate(range(0, 36, 12)):
        wire.feed(encode_mbap(int.from_bytes(adus[at : at + 2], "big"), 1, bytes((3, 2, 0, 1 + number))))
    assert registers(call) == [[1], [2], [3]]
    assert wire.finished() == [call]


@pytest.mark.parametrize("options", [{"single_adu_segments": True}, {"request_gap": 0.1}])
def test_a_batch_whose_requests_are_to_leave_apart_is_not_sent_at_once(options: dict[str, Any]) -> None:
    wire = ClientWire(max_transactions=4, **options)
    assert wire.session.send_now(wire.call([read(1), read(2)]), wire.now) is None


def test_a_batch_with_a_write_takes_its_turn_in_the_queue() -> None:
    wire = ClientWire(max_transactions=4)
    assert wire.session.send_now(wire.call([read(1), WriteSingleRegister(1, 1)]), wire.now) is None


def test_identifiers_that_are_waited_for_no_longer_are_passed_over_by_a_batch() -> None:
    wire = ClientWire(max_transactions=16, recycle_after_timeouts=1000)
    used = {frame.transaction for frame in wire.transmit()}
    lost = wire.ask(*[read(one) for one in range(16)], retries=0)
    used |= {frame.transaction for frame in wire.transmit()}
    wire.wait(2.0)
    assert lost.ended
    assert wire.session.counters.timeouts == 16
    for _ in range(65_536 // 16 + 1):  # once around
        call = wire.ask(*[read(one) for one in range(16)])
        for frame in wire.transmit():
            assert frame.transaction not in used
            wire.reply(frame)
        assert call.ended
        assert call.error is None


def test_an_exception_ends_its_own_request_of_a_batch_only() -> None:
    wire = ClientWire(max_transactions=4)
    call = wire.ask(*[read(one) for one in range(4)])
    frames = wire.transmit()
    wire.feed(b"".join(faulty("exception" if one is frames[2] else "", one) for one in frames))
    assert [type(one) for one in call.outcomes].count(ReadHoldingRegisters.Reply) == 3
    assert isinstance(call.outcomes[2], ExceptionReply)
    assert wire.session.in_flight == 0


def test_the_same_requests_are_packed_once_and_others_anew() -> None:
    requests = [read(1), read(2), ReadCoils(3, 9)]
    packed = packed_batch(requests, 0, 3, 1)
    assert packed.fits
    assert packed.reply_sizes == (11, 11, 11)
    assert packed_batch(list(requests), 0, 3, 1) is packed
    assert packed_batch(requests, 0, 2, 1) is not packed
    requests[1] = read(3)
    assert packed_batch(requests, 0, 3, 1).encode((1, 2, 3))[20:22] == b"\x00\x03"
    assert packed_batch(requests, 0, 3, 2).encode((1, 2, 3))[6] == 2


def test_requests_whose_replies_are_not_known_by_their_first_bytes_do_not_fly_together() -> None:
    assert not packed_batch([read(1), WriteSingleRegister(1, 2)], 0, 2, 1).fits
