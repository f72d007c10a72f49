"""A read that was asked before is answered by its plan: the bytes of the long road, whatever changes between."""

import struct

from hypothesis import given
from hypothesis import strategies as st

from busway.pdu.model import Refusal
from busway.server.device import Device
from busway.server.hooks import Access
from busway.server.local import LocalHandler
from busway.session.diagnostics import CommunicationState
from busway.session.server import TcpServerSession, TransactionSlots

SIZE = 200


def session_of(handler: LocalHandler) -> TcpServerSession:
    return TcpServerSession(
        handler, diagnostics=CommunicationState(), slots=TransactionSlots(16), deliver=lambda adu: None
    )


def ask(session: TcpServerSession, *pdus: bytes, unit: int = 1) -> list[bytes]:
    """The replies to requests that arrive in one read, their headers checked."""
    stream = b"".join(struct.pack(">HHHB", number, 0, len(pdu) + 1, unit) + pdu for number, pdu in enumerate(pdus))
    replies = session.receive(bytearray(stream), len(stream))
    for number, adu in enumerate(replies):
        assert struct.unpack(">HHHB", adu[:7]) == (number, 0, len(adu) - 6, unit)
    return [adu[7:] for adu in replies]


def read(function: int, address: int, count: int) -> bytes:
    return struct.pack(">BHH", function, address, count)


reads = st.builds(read, st.sampled_from([3, 4]), st.integers(0, SIZE + 5), st.integers(0, 130))


@given(st.lists(reads, min_size=1, max_size=12))
def test_the_answer_from_a_plan_equals_the_answer_of_the_long_road(requests: list[bytes]) -> None:
    planned = Device(holding_registers=list(range(SIZE)), input_registers=list(range(1000, 1000 + SIZE)))
    plain = Device(holding_registers=list(range(SIZE)), input_registers=list(range(1000, 1000 + SIZE)))
    for table in ("holding_registers", "input_registers"):
        plain.on_read(table, lambda access: None)  # a hook keeps a table off the short road
    session = session_of(LocalHandler({1: planned}))
    expected = ask(session_of(LocalHandler({1: plain})), *requests)
    assert ask(session, *requests) == expected
    assert ask(session, *requests) == expected


def test_a_plan_shows_what_is_written_after_it_was_made() -> None:
    device = Device(holding_registers=10)
    session = session_of(LocalHandler({1: device}))
    ask(session, read(3, 2, 1))
    device.holding_registers[2] = 7
    assert ask(session, read(3, 2, 1)) == [bytes.fromhex("03 02 00 07")]
    with device.update():
        device.holding_registers[2] = 8
    assert ask(session, read(3, 2, 1)) == [bytes.fromhex("03 02 00 08")]
    assert ask(session, bytes.fromhex("06 0002 0009"), read(3, 2, 1))[1] == bytes.fromhex("03 02 00 09")


def test_a_hook_that_is_added_later_ends_the_plans() -> None:
    device = Device(holding_registers=10)
    session = session_of(LocalHandler({1: device}))
    ask(session, read(3, 2, 1), read(3, 2, 1))

    @device.on_read("holding_registers")
    def refuse(access: Access) -> None:
        raise Refusal(6)

    assert ask(session, read(3, 2, 1)) == [bytes.fromhex("83 06")]


def test_plans_count_as_exchanges() -> None:
    device = Device(holding_registers=10)
    handler = LocalHandler({1: device})
    diagnostics = CommunicationState()
    session = TcpServerSession(handler, diagnostics=diagnostics, slots=TransactionSlots(16), deliver=lambda adu: None)
    ask(session, *[read(3, 2, 1)] * 5)
    assert diagnostics.counters.bus_message_count == diagnostics.event_count == session.requests == 5


def test_a_request_of_another_unit_is_not_answered_by_a_plan() -> None:
    one, two = Device(holding_registers=[1]), Device(holding_registers=[2])
    session = session_of(LocalHandler({1: one, 2: two}))
    assert ask(session, read(3, 0, 1), read(3, 0, 1)) == [bytes.fromhex("03 02 00 01")] * 2
    assert ask(session, read(3, 0, 1), unit=2) == [bytes.fromhex("03 02 00 02")]


writes = st.builds(lambda address, value: struct.pack(">BHH", 6, address, value), st.integers(0, 12), st.integers(0, 9))
longer = st.just(bytes.fromhex("10 0001 0002 04 0007 0008"))
few_reads = st.builds(read, st.just(3), st.integers(0, 12), st.integers(0, 4))


@given(st.lists(st.one_of(few_reads, few_reads, writes, longer), min_size=1, max_size=12), st.data())
def test_reads_that_are_planned_and_whatever_stands_between_them_are_answered_in_order(
    requests: list[bytes], data: st.DataObject
) -> None:
    quick, plain = Device(holding_registers=10), Device(holding_registers=10)
    plain.on_read("holding_registers", lambda access: None)
    plain.on_write("holding_registers", lambda change: None)
    session, careful = session_of(LocalHandler({1: quick})), session_of(LocalHandler({1: plain}))
    for address in range(10):
        ask(session, read(3, address, 1), read(3, address, 2))
    expected = ask(careful, *requests)
    stream = b"".join(struct.pack(">HHHB", number, 0, len(pdu) + 1, 1) + pdu for number, pdu in enumerate(requests))
    cut = data.draw(st.integers(0, len(stream)))
    answers = [one for part in (stream[:cut], stream[cut:]) for one in session.receive(bytearray(part), len(part))]
    assert [one[7:] for one in answers] == expected
    assert session.unfinished == 0
    assert session.requests == 20 + len(requests)


def test_what_lies_behind_the_bytes_that_came_is_not_looked_at() -> None:
    session = session_of(LocalHandler({1: Device(holding_registers=10)}))
    one = struct.pack(">HHHB", 7, 0, 6, 1) + read(3, 2, 1)
    buffer = bytearray(one * 3)
    for _ in range(2):
        assert session.receive(buffer, len(one)) == [bytes.fromhex("0007 0000 0005 01 03 02 0000")]
    buffer.extend(b"!")  # nobody holds on to the buffer either


def test_a_planned_read_gets_no_answer_from_a_listener_that_only_listens() -> None:
    diagnostics = CommunicationState(changes_allowed=True)
    handler = LocalHandler({1: Device(holding_registers=10)})
    session = TcpServerSession(handler, diagnostics=diagnostics, slots=TransactionSlots(16), deliver=lambda adu: None)
    ask(session, read(3, 2, 1), read(3, 2, 1))
    assert ask(session, bytes.fromhex("08 0004 0000"), read(3, 2, 1)) == []
    assert ask(session, read(3, 2, 1)) == []
    assert diagnostics.listen_only
    diagnostics.listen_only = False
    assert ask(session, read(3, 2, 1)) == [bytes.fromhex("03 02 0000")]
