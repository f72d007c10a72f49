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
