"""A read that was asked before gets a prepared answer: the bytes of the generic path, whatever changes between."""

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from busway.pdu.device_interface import Refusal
from busway.server.device import Device
from busway.server.device_responder import DeviceResponder
from busway.server.hooks import Access
from busway.session.diagnostic_counters import LineDiagnostics
from busway.session.server_pipeline import RequestPipeline
from busway.session.server_transaction_slots import ServerTransactionSlots
from busway.session.tcp_server import TcpServerSession

SIZE = 200


def session_of(handler: DeviceResponder) -> TcpServerSession:
    return TcpServerSession(
        RequestPipeline(handler),
        diagnostics=LineDiagnostics(),
        slots=ServerTransactionSlots(16),
        deliver=lambda adu: None,
    )


def ask(session: TcpServerSession, *pdus: bytes, unit: int = 1) -> list[bytes]:
    """The replies to requests that arrive in one read, their headers checked."""
    stream = b"".join(struct.pack(">HHHB", number, 0, len(pdu) + 1, unit) + pdu for number, pdu in enumerate(pdus))
    replies = session.receive(bytearray(stream), len(stream))
    for number, adu in enumerate(replies):
        assert struct.unpack(">HHHB", adu[:7]) == (number, 0, len(adu) - 6, unit)
    return [adu[7:] for adu in replies]


def ask_units(session: TcpServerSession, *asked: tuple[int, bytes]) -> list[tuple[int, bytes]]:
    """The same of several units: unit and PDU of each request, and of each reply."""
    stream = b"".join(struct.pack(">HHHB", 0, 0, len(pdu) + 1, unit) + pdu for unit, pdu in asked)
    return [(adu[6], adu[7:]) for adu in session.receive(bytearray(stream), len(stream))]


def read(function: int, address: int, count: int) -> bytes:
    return struct.pack(">BHH", function, address, count)


reads = st.builds(read, st.sampled_from([3, 4]), st.integers(0, SIZE + 5), st.integers(0, 130))


@given(st.lists(reads, min_size=1, max_size=12))
def test_the_answer_that_is_prepared_equals_the_answer_of_the_generic_path(requests: list[bytes]) -> None:
    prepared = Device(holding_registers=list(range(SIZE)), input_registers=list(range(1000, 1000 + SIZE)))
    plain = Device(holding_registers=list(range(SIZE)), input_registers=list(range(1000, 1000 + SIZE)))
    for table in ("holding_registers", "input_registers"):
        plain.on_read(table, lambda access: None)  # a hook keeps a table off the fast path
    session = session_of(DeviceResponder({1: prepared}))
    expected = ask(session_of(DeviceResponder({1: plain})), *requests)
    assert ask(session, *requests) == expected
    assert ask(session, *requests) == expected


def test_a_prepared_answer_shows_what_is_written_after_it_was_made() -> None:
    device = Device(holding_registers=10)
    session = session_of(DeviceResponder({1: device}))
    ask(session, read(3, 2, 1))
    device.holding_registers[2] = 7
    assert ask(session, read(3, 2, 1)) == [bytes.fromhex("03 02 00 07")]
    with device.update():
        device.holding_registers[2] = 8
    assert ask(session, read(3, 2, 1)) == [bytes.fromhex("03 02 00 08")]
    assert ask(session, bytes.fromhex("06 0002 0009"), read(3, 2, 1))[1] == bytes.fromhex("03 02 00 09")


def test_a_hook_that_is_added_later_ends_the_prepared_answers() -> None:
    device = Device(holding_registers=10)
    session = session_of(DeviceResponder({1: device}))
    ask(session, read(3, 2, 1), read(3, 2, 1))

    @device.on_read("holding_registers")
    def refuse(access: Access) -> None:
        raise Refusal(6)

    assert ask(session, read(3, 2, 1)) == [bytes.fromhex("83 06")]


def test_prepared_answers_count_as_exchanges() -> None:
    device = Device(holding_registers=10)
    handler = DeviceResponder({1: device})
    diagnostics = LineDiagnostics()
    session = TcpServerSession(
        RequestPipeline(handler), diagnostics=diagnostics, slots=ServerTransactionSlots(16), deliver=lambda adu: None
    )
    ask(session, *[read(3, 2, 1)] * 5)
    assert diagnostics.counters.bus_message_count == diagnostics.event_count == session.requests == 5


@pytest.mark.clause("S16")
def test_units_of_a_connection_count_their_own_by_every_path() -> None:
    units = {1: Device(holding_registers=10), 3: Device(holding_registers=10, coils=8)}
    diagnostics = LineDiagnostics(changes_allowed=True)
    session = TcpServerSession(
        RequestPipeline(DeviceResponder(units)),
        diagnostics=diagnostics,
        slots=ServerTransactionSlots(16),
        deliver=lambda adu: None,
    )
    write, longer, refused = (bytes.fromhex(one) for one in ("06 0000 0007", "10 0000 0001 02 0007", "03 0046 0001"))
    sent = [(1, read(3, 0, 1)), (3, read(3, 0, 1)), (3, write), (3, longer), (1, refused), (3, bytes.fromhex("07"))]
    for _ in range(3):  # the first time by the fast path, then by prepared answers
        ask_units(session, *sent)
        ask_units(session, *sent[:2])  # nothing but prepared reads
        ask_units(session, *sent[:1])
    first, third = diagnostics.of(1), diagnostics.of(3)
    assert (first.counters.server_message_count, first.counters.bus_exception_error_count) == (12, 3)
    assert (third.counters.server_message_count, third.counters.bus_exception_error_count) == (15, 0)
    assert (first.event_count, third.event_count) == (9, 15)
    assert first.counters.bus_message_count == third.counters.bus_message_count == session.requests == 27
    assert diagnostics.counters.server_message_count == 27
    ask_units(session, (3, bytes.fromhex("08 000a 0000")))
    assert (third.counters.bus_message_count, first.counters.bus_message_count) == (0, 28)


@pytest.mark.clause("S17")
def test_listen_only_mode_of_a_unit_leaves_the_other_units_of_its_listener_alone() -> None:
    units = {1: Device(holding_registers=10), 3: Device(holding_registers=10)}
    diagnostics = LineDiagnostics(changes_allowed=True)
    session = TcpServerSession(
        RequestPipeline(DeviceResponder(units)),
        diagnostics=diagnostics,
        slots=ServerTransactionSlots(16),
        deliver=lambda adu: None,
    )
    asked = [(unit, read(3, 0, 1)) for unit in (1, 3)]
    ask_units(session, *asked)
    answers = ask_units(session, *asked, (3, bytes.fromhex("08 0004 0000")), *asked)
    assert answers == [(unit, bytes.fromhex("03 02 0000")) for unit in (1, 3, 1)]
    assert ask_units(session, *asked) == [(1, bytes.fromhex("03 02 0000"))]
    assert ask_units(session, (3, bytes.fromhex("08 0001 0000")), *asked) == answers[:2]


def test_a_request_of_another_unit_is_not_answered_by_a_prepared_answer() -> None:
    one, two = Device(holding_registers=[1]), Device(holding_registers=[2])
    session = session_of(DeviceResponder({1: one, 2: two}))
    assert ask(session, read(3, 0, 1), read(3, 0, 1)) == [bytes.fromhex("03 02 00 01")] * 2
    assert ask(session, read(3, 0, 1), unit=2) == [bytes.fromhex("03 02 00 02")]


writes = st.builds(lambda address, value: struct.pack(">BHH", 6, address, value), st.integers(0, 12), st.integers(0, 9))
longer = st.just(bytes.fromhex("10 0001 0002 04 0007 0008"))
few_reads = st.builds(read, st.just(3), st.integers(0, 12), st.integers(0, 4))


@given(st.lists(st.one_of(few_reads, few_reads, writes, longer), min_size=1, max_size=12), st.data())
def test_reads_that_are_prepared_and_what_stands_between_them_are_answered_in_order(
    requests: list[bytes], data: st.DataObject
) -> None:
    quick, plain = Device(holding_registers=10), Device(holding_registers=10)
    plain.on_read("holding_registers", lambda access: None)
    plain.on_write("holding_registers", lambda change: None)
    session, careful = session_of(DeviceResponder({1: quick})), session_of(DeviceResponder({1: plain}))
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
    session = session_of(DeviceResponder({1: Device(holding_registers=10)}))
    one = struct.pack(">HHHB", 7, 0, 6, 1) + read(3, 2, 1)
    buffer = bytearray(one * 3)
    for _ in range(2):
        assert session.receive(buffer, len(one)) == [bytes.fromhex("0007 0000 0005 01 03 02 0000")]
    buffer.extend(b"!")  # the buffer is not held on to either


def test_a_prepared_read_gets_no_answer_from_a_listener_that_only_listens() -> None:
    diagnostics = LineDiagnostics(changes_allowed=True)
    handler = DeviceResponder({1: Device(holding_registers=10)})
    session = TcpServerSession(
        RequestPipeline(handler), diagnostics=diagnostics, slots=ServerTransactionSlots(16), deliver=lambda adu: None
    )
    ask(session, read(3, 2, 1), read(3, 2, 1))
    assert ask(session, bytes.fromhex("08 0004 0000"), read(3, 2, 1)) == []
    assert ask(session, read(3, 2, 1)) == []
    assert diagnostics.listen_only
    diagnostics.of(1).restart()
    assert ask(session, read(3, 2, 1)) == [bytes.fromhex("03 02 0000")]
