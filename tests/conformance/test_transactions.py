"""Clauses T1, T11, T21 to T26, T31 and T37 from end to end: a real client, and a peer that sees every byte."""

import asyncio
import itertools
from typing import Any

import pytest
from handlers import HeldReplies, ScriptedHandler, registers
from scripted_peer import ScriptedPeer, echo_of, first_address
from waiting import until

import busway
from busway.framing.mbap import MbapFrame, encode_mbap

ANY_PORT = "tcp://127.0.0.1:0"


def frame_of(frame: MbapFrame, pdu: bytes, **changed: int) -> bytes:
    """An answer with a field of its header changed."""
    head = {"transaction": frame.transaction, "unit": frame.unit} | changed
    protocol = head.pop("protocol", 0)
    adu = bytearray(encode_mbap(head["transaction"], head["unit"], pdu))
    adu[2:4] = protocol.to_bytes(2, "big")
    return bytes(adu)


@pytest.mark.clause("T1")
async def test_a_request_arrives_as_the_indication_and_the_response_as_the_confirmation() -> None:
    request = busway.ReadHoldingRegisters(107, 3)
    response = registers(0x022B, 0x0000, 0x0064)
    indications = []

    def decide(context: busway.RequestContext, indication: object) -> busway.Message:
        indications.append(indication)
        return response

    async with (
        busway.serve(ANY_PORT, responder=ScriptedHandler(decide)) as server,
        busway.open(server.endpoints[0]) as link,
    ):
        confirmation = await link.unit(1).execute(request)
    assert indications == [request]
    assert confirmation == response


@pytest.mark.clause("T2", "T22")
async def test_each_field_of_a_request_header_is_what_the_guide_says() -> None:
    async with ScriptedPeer() as peer, busway.open(peer.endpoint) as link:
        await link.unit(9).read_holding_registers(4, count=1)
    (chunk,) = peer.chunks
    assert chunk[2:4] == b"\x00\x00"  # protocol
    assert chunk[4:6] == b"\x00\x06"  # length: unit and five bytes of PDU
    assert chunk[6] == 9  # unit
    assert chunk[7:] == b"\x03\x00\x04\x00\x01"  # register 5 of a manual is address 4


@pytest.mark.clause("T11")
@pytest.mark.parametrize(("single", "writes"), [(False, 1), (True, 4)])
async def test_requests_of_one_execute_many_leave_joined_or_one_by_one_by_option(
    single: bool, writes: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with (
        ScriptedPeer() as peer,
        busway.open(peer.endpoint, max_transactions=4, single_adu_segments=single) as link,
    ):
        await link.connect()
        sent: list[bytes] = []
        kind = type(link._link._transport)  # type: ignore[union-attr]
        write = kind.write
        monkeypatch.setattr(kind, "write", lambda transport, data: (sent.append(bytes(data)), write(transport, data)))
        requests = [busway.ReadHoldingRegisters(address, 1) for address in range(4)]
        replies = await link.unit(1).execute_many(requests)
        assert [reply.registers for reply in replies] == [[0], [1], [2], [3]]
        assert len(sent) == writes


@pytest.mark.clause("T11")
@pytest.mark.parametrize(
    ("options", "writes"),
    [({"max_transactions": 4}, [4, 4]), ({"max_transactions": 4, "single_adu_segments": True}, [1] * 8), ({}, [1] * 8)],
    ids=["several transactions", "a segment for each", "the default"],
)
async def test_requests_of_one_turn_leave_joined_where_several_transactions_were_chosen(
    options: dict[str, Any], writes: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    async with ScriptedPeer() as peer, busway.open(peer.endpoint, **options) as link:
        await link.connect()
        sent: list[int] = []
        kind = type(link._link._transport)  # type: ignore[union-attr]
        write = kind.write
        monkeypatch.setattr(
            kind, "write", lambda transport, data: (sent.append(len(data) // 12), write(transport, data))
        )
        unit = link.unit(1)
        replies = await asyncio.gather(*(unit.read_holding_registers(address, count=1) for address in range(8)))
        assert replies == [[address] for address in range(8)]
        assert sum(sent) == 8
        assert sent[0] == writes[0]
        if len(writes) == 8:
            assert sent == writes


@pytest.mark.clause("T21")
async def test_a_network_error_comes_back_as_a_negative_confirmation() -> None:
    async with (
        ScriptedPeer(lambda peer, frame: peer.writers[-1].transport.abort()) as peer,
        busway.open(peer.endpoint, retries=0) as link,
    ):
        with pytest.raises(busway.LinkDown) as caught:
            await link.unit(1).read_holding_registers(0, count=1)
        assert caught.value.sent
        with pytest.raises(busway.WriteOutcomeUnknown) as unknown:
            await link.unit(1).write_single_register(0, 1)
        assert isinstance(unknown.value.__cause__, busway.LinkDown)


@pytest.mark.clause("T21")
async def test_no_listener_at_the_destination_is_a_negative_confirmation_and_nothing_was_sent() -> None:
    async with ScriptedPeer() as peer:
        endpoint = peer.endpoint
    async with busway.open(endpoint) as link:
        with pytest.raises(busway.LinkDown) as caught:
            await link.unit(1).write_single_register(0, 1)
    assert not caught.value.sent


@pytest.mark.clause("T22", "T23")
async def test_sixteen_pending_transactions_have_sixteen_identifiers_and_the_seventeenth_waits() -> None:
    async with ScriptedPeer(lambda peer, frame: None) as peer, busway.open(peer.endpoint, max_transactions=16) as link:
        unit = link.unit(1)
        calls = [asyncio.create_task(unit.read_holding_registers(n, count=1, timeout=60)) for n in range(17)]
        await until(lambda: len(peer.frames) == 16)
        assert len({frame.transaction for frame in peer.frames}) == 16
        first = peer.frames[0]
        peer.writers[0].write(first_address(peer, first))
        await until(lambda: len(peer.frames) == 17)
        for frame in peer.frames[1:]:
            peer.writers[0].write(first_address(peer, frame))
        assert await asyncio.gather(*calls) == [[n] for n in range(17)]


@pytest.mark.clause("T22")
async def test_the_reply_of_an_expired_transaction_is_not_given_to_the_next_request() -> None:
    late: list[MbapFrame] = []

    def answer(peer: ScriptedPeer, frame: MbapFrame) -> bytes | None:
        if not late:
            late.append(frame)
            return None
        return echo_of(late[0], 111) + echo_of(frame, 222)  # the late one first

    async with ScriptedPeer(answer) as peer, busway.open(peer.endpoint, retries=0) as link:
        with pytest.raises(busway.NoReply):
            await link.unit(1).read_holding_registers(0, count=1, timeout=0.02)
        assert await link.unit(1).read_holding_registers(0, count=1) == [222]
        assert link.counters.late_replies == 1
    assert len({frame.transaction for frame in peer.frames}) == 2


@pytest.mark.clause("T23")
@pytest.mark.parametrize("number", [0, 17])
def test_a_number_of_transactions_outside_1_to_16_is_refused(number: int) -> None:
    with pytest.raises(busway.ConfigError, match=r"max_transactions.*1…16"):
        busway.connect("tcp://127.0.0.1:5020", max_transactions=number)


@pytest.mark.clause("T23", "T40")
async def test_calls_beyond_the_queue_are_refused_before_anything_is_sent() -> None:
    async with ScriptedPeer(lambda peer, frame: None) as peer, busway.open(peer.endpoint, queue=1) as link:
        unit = link.unit(1)
        await link.connect()
        calls = [asyncio.create_task(unit.read_holding_registers(n, count=1, timeout=60)) for n in range(2)]
        await until(lambda: len(peer.frames) == 1)
        with pytest.raises(busway.Overloaded):
            await unit.read_holding_registers(2, count=1)
        for call in calls:
            call.cancel()
        await asyncio.gather(*calls, return_exceptions=True)
    assert len(peer.frames) == 1


@pytest.mark.clause("T24")
@pytest.mark.parametrize(("number", "asked"), [(None, 255), (0, 0), (1, 1), (247, 247)])
async def test_the_unit_is_255_unless_named(number: int | None, asked: int) -> None:
    async with ScriptedPeer() as peer, busway.open(peer.endpoint) as link:
        await link.unit(number).read_holding_registers(0, count=1)
    assert [frame.unit for frame in peer.frames] == [asked]


@pytest.mark.clause("T24")
@pytest.mark.parametrize("asked", [0, 255])
async def test_asked_with_0_or_255_the_unit_of_the_reply_is_not_looked_at(asked: int) -> None:
    def answer(peer: ScriptedPeer, frame: MbapFrame) -> bytes:
        return frame_of(frame, b"\x03\x02\x00\x07", unit=1)

    async with ScriptedPeer(answer) as peer, busway.open(peer.endpoint) as link:
        assert await link.unit(asked).read_holding_registers(0, count=1) == [7]


@pytest.mark.clause("T25")
@pytest.mark.parametrize(
    ("pdu", "changed", "reason"),
    [
        (b"\x03\x02\x00\x07", {"protocol": 1}, "protocol identifier 1"),
        (b"\x04\x02\x00\x07", {}, "function 4 answers function 3"),
        (b"\x03\x04\x00\x07\x00\x08", {}, "6 bytes where 4 answer the request"),
        (b"\x03\x02\x00", {}, "byte"),
        (b"\x83", {}, ""),
        (b"\x03\x02\x00\x07", {"unit": 2}, "unit 2 answered where 1 was asked"),
    ],
)
async def test_what_does_not_fit_its_pending_transaction_is_a_negative_confirmation_with_the_reason(
    pdu: bytes, changed: dict[str, int], reason: str
) -> None:
    async with (
        ScriptedPeer(lambda peer, frame: frame_of(frame, pdu, **changed)) as peer,
        busway.open(peer.endpoint) as link,
    ):
        with pytest.raises(busway.BadReply) as caught:
            await link.unit(1).read_holding_registers(0, count=1)
    assert reason in caught.value.reason
    assert caught.value.raw


@pytest.mark.clause("T25")
async def test_a_reply_of_an_unknown_transaction_is_discarded_and_an_exception_is_a_confirmation() -> None:
    def answer(peer: ScriptedPeer, frame: MbapFrame) -> bytes:
        foreign = frame_of(frame, b"\x03\x02\x00\x01", transaction=frame.transaction ^ 0x8000)
        return foreign + frame_of(frame, b"\x83\x06")

    async with ScriptedPeer(answer) as peer, busway.open(peer.endpoint) as link:
        with pytest.raises(busway.ExceptionReply) as caught:
            await link.unit(1).read_holding_registers(0, count=1)
        assert caught.value.code == busway.ExceptionCode.SERVER_DEVICE_BUSY
        assert link.counters.foreign_replies == 1


@pytest.mark.clause("T26")
async def test_a_read_is_repeated_after_the_timeout_of_the_call_and_a_write_is_not() -> None:
    async with ScriptedPeer(lambda peer, frame: None) as peer, busway.open(peer.endpoint) as link:
        with pytest.raises(busway.NoReply) as silent:
            await link.unit(1).read_holding_registers(0, count=1, timeout=0.01, retries=2)
        assert silent.value.attempt == 3
        assert len(peer.frames) == 3
        with pytest.raises(busway.WriteOutcomeUnknown):
            await link.unit(1).write_single_register(0, 1, timeout=0.01, retries=2)
    assert [frame.pdu[0] for frame in peer.frames] == [3, 3, 3, 6]


@pytest.mark.clause("T31")
async def test_the_exceptions_of_the_guide_reach_the_application_with_their_code() -> None:
    codes = itertools.cycle([1, 2, 3, 4, 5, 6, 0x0A, 0x0B])

    def decide(context: busway.RequestContext, request: object) -> busway.Message:
        raise busway.Refusal(next(codes))

    async with (
        busway.serve(ANY_PORT, responder=ScriptedHandler(decide)) as server,
        busway.open(server.endpoints[0]) as link,
    ):
        requests = [busway.ReadHoldingRegisters(0, 1)] * 8
        outcomes = await link.unit(1).execute_many(requests, return_errors=True)
    assert [outcome.code for outcome in outcomes] == [1, 2, 3, 4, 5, 6, 0x0A, 0x0B]
    assert [outcome.from_gateway for outcome in outcomes] == [False] * 6 + [True] * 2


@pytest.mark.clause("T37")
async def test_a_connection_that_breaks_inside_a_transaction_ends_it_and_frees_what_both_sides_held() -> None:
    held_replies = HeldReplies()
    handler = ScriptedHandler(held_replies.decide)
    async with (
        busway.serve(ANY_PORT, responder=handler) as server,
        busway.open(server.endpoints[0], retries=0, shared=False) as link,
    ):
        call = asyncio.create_task(link.unit(1).read_holding_registers(1000, count=1))
        await until(lambda: handler.contexts)
        await link.close()
        with pytest.raises(busway.LinkDown):
            await call
        held_replies.opened.set()  # its reply goes nowhere
        await until(lambda: not server.status().connections)
        assert handler.contexts[0].replied
    assert not link.is_connected
