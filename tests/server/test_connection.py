"""One accepted connection, and the management of many: order, slots, limits, back-pressure, ends."""

import asyncio
import contextlib
import socket
import struct
from typing import Any
from urllib.parse import urlsplit

import pytest
from handlers import HeldReplies, ScriptedHandler, address_of, later, registers
from handles import open_handles
from waiting import set_forward, until

import busway
from busway.framing.ascii import encode_ascii
from busway.framing.received import FrameOrDamage
from busway.framing.rtu import encode_rtu
from busway.pdu.functions import AnyRequest
from busway.server.connection import ServerConnection
from busway.server.turns import Turns
from busway.session.responder import ResponderAnswer
from busway.session.serial_server import SerialServerSession
from busway.testing import SLOW_LORIS, golden_adu, misbehaving_client

pytestmark = pytest.mark.usefixtures("transport")

ANY_PORT = "tcp://127.0.0.1:0"


def _port(server: busway.Server) -> int:
    port = urlsplit(server.endpoints[0]).port
    assert port is not None
    return port


def _question(address: int, transaction: int = 1) -> bytes:
    return golden_adu(busway.ReadHoldingRegisters(address, 1).encode(), transaction=transaction)


def _answer(value: int, transaction: int = 1) -> bytes:
    return golden_adu(registers(value).encode(), transaction=transaction)


def _busy(transaction: int) -> bytes:
    return golden_adu(b"\x83\x06", transaction=transaction)


def _vanish(writer: asyncio.StreamWriter) -> None:
    """End a connection as a crash does: with a reset, not with the end of a stream."""
    connection = writer.transport.get_extra_info("socket")
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    writer.transport.abort()


async def _close(writer: asyncio.StreamWriter) -> None:
    writer.close()
    await writer.wait_closed()


# --- handlers: at once, awaited, later -----------------------------------------------------------


@pytest.mark.clause("T29")
@pytest.mark.parametrize("way", ["at once", "awaited", "later", "later, before it returns"])
async def test_reply_carries_unit_and_transaction_of_its_request_whichever_way_it_is_given(way: str) -> None:
    async def answer(address: int) -> busway.Message:
        return registers(address)

    def decide(context: busway.RequestContext, request: AnyRequest) -> ResponderAnswer:
        address = address_of(request)
        if way == "at once":
            return registers(address)
        if way == "awaited":
            return answer(address)
        if way == "later":
            asyncio.get_running_loop().call_soon(context.reply, registers(address))
        else:
            context.reply(registers(address))
        return busway.LATER

    async with busway.serve(ANY_PORT, responder=ScriptedHandler(decide)) as server:
        reader, writer = await asyncio.open_connection("127.0.0.1", _port(server))
        writer.write(golden_adu(busway.ReadHoldingRegisters(5, 1).encode(), transaction=0xABCD, unit=77))
        assert await reader.readexactly(11) == golden_adu(registers(5).encode(), transaction=0xABCD, unit=77)
        await _close(writer)


@pytest.mark.clause("T29")
async def test_later_reply_given_twice_is_sent_once() -> None:
    handler = ScriptedHandler(later)
    async with busway.serve(ANY_PORT, responder=handler) as server:
        reader, writer = await asyncio.open_connection("127.0.0.1", _port(server))
        writer.write(_question(1, 1) + _question(2, 2))
        await until(lambda: len(handler.contexts) == 2)
        first, second = handler.contexts
        first.reply(registers(1))
        assert first.replied
        first.reply(registers(9))
        second.refuse(busway.ExceptionCode.ACKNOWLEDGE)
        expected = _answer(1, 1) + golden_adu(b"\x83\x05", transaction=2)
        assert await reader.readexactly(len(expected)) == expected
        await _close(writer)


@pytest.mark.clause("A20")
@pytest.mark.parametrize(
    ("failure", "code"),
    [
        (busway.Refusal(busway.ExceptionCode.ILLEGAL_DATA_ADDRESS), 2),
        (busway.Refusal(), 4),
        (ZeroDivisionError("a bug"), 4),
        (busway.LinkDown("the line behind is gone"), 4),
    ],
)
@pytest.mark.parametrize("awaited", [False, True])
async def test_handler_that_raises_is_answered_with_its_code_or_04(
    failure: Exception, code: int, awaited: bool, caplog: pytest.LogCaptureFixture
) -> None:
    async def fail() -> busway.Message:
        raise failure

    def decide(context: busway.RequestContext, request: AnyRequest) -> ResponderAnswer:
        if awaited:
            return fail()
        raise failure

    async with busway.serve(ANY_PORT, responder=ScriptedHandler(decide)) as server:
        async with busway.open(server.endpoints[0]) as link:
            with pytest.raises(busway.ExceptionReply) as caught:
                await link.unit(1).read_holding_registers(0, count=1)
        assert caught.value.code == code
    assert ("responder failed" in caplog.text) == (not isinstance(failure, busway.Refusal))


@pytest.mark.parametrize("result", [None, b"\x00\x01", busway.LATER])
async def test_an_awaitable_that_gives_no_reply_is_answered_04_and_logged(
    result: object, caplog: pytest.LogCaptureFixture
) -> None:
    async def forget() -> Any:
        return result

    handler = ScriptedHandler(lambda context, request: forget())
    async with (
        busway.serve(ANY_PORT, responder=handler) as server,
        busway.open(server.endpoints[0], timeout=5.0, retries=0) as link,
    ):
        with pytest.raises(busway.ExceptionReply) as caught:
            await link.unit(1).read_holding_registers(0, count=1)
    assert caught.value.code == 4
    assert f"the awaitable of a responder gave {result!r}, which is no reply" in caplog.text


async def test_an_awaitable_may_give_silence() -> None:
    async def keep_silent() -> Any:
        return busway.SILENCE

    handler = ScriptedHandler(lambda context, request: keep_silent())
    async with (
        busway.serve(ANY_PORT, responder=handler) as server,
        busway.open(server.endpoints[0], timeout=0.2, retries=0) as link,
    ):
        with pytest.raises(busway.NoReply):
            await link.unit(1).read_holding_registers(0, count=1)


async def test_failures_of_handlers_are_counted() -> None:
    def decide(context: busway.RequestContext, request: AnyRequest) -> ResponderAnswer:
        raise ZeroDivisionError

    async with busway.serve(ANY_PORT, responder=ScriptedHandler(decide)) as server:
        async with busway.open(server.endpoints[0]) as link:
            with pytest.raises(busway.ExceptionReply):
                await link.unit(1).read_holding_registers(0, count=1)
        assert server.counters.responder_failures == 1


async def test_silence_of_a_handler_sends_nothing_and_holds_no_slot() -> None:
    def decide(context: busway.RequestContext, request: AnyRequest) -> ResponderAnswer:
        return busway.SILENCE if address_of(request) else registers(0)

    async with busway.serve(ANY_PORT, responder=ScriptedHandler(decide), max_transactions=1) as server:
        reader, writer = await asyncio.open_connection("127.0.0.1", _port(server))
        writer.write(_question(1, 1) + _question(1, 2) + _question(0, 3))
        assert await reader.readexactly(11) == _answer(0, 3)
        await _close(writer)


# --- no connection waits for another -------------------------------------------------------------


@pytest.mark.clause("T29")
async def test_slow_handler_of_one_connection_delays_neither_another_nor_other_transactions_of_its_own() -> None:
    held_replies = HeldReplies()
    async with busway.serve(ANY_PORT, responder=ScriptedHandler(held_replies.decide)) as server:
        reader, writer = await asyncio.open_connection("127.0.0.1", _port(server))
        other_reader, other_writer = await asyncio.open_connection("127.0.0.1", _port(server))
        writer.write(_question(1000, 1) + _question(2, 2))
        other_writer.write(_question(3, 3))
        assert await reader.readexactly(11) == _answer(2, 2)
        assert await other_reader.readexactly(11) == _answer(3, 3)
        held_replies.opened.set()
        assert await reader.readexactly(11) == _answer(1000, 1)
        await _close(writer)
        await _close(other_writer)


# --- slots ---------------------------------------------------------------------------------------


@pytest.mark.clause("T27")
async def test_request_beyond_the_limit_of_a_connection_is_answered_06_at_once_and_others_are_not() -> None:
    held_replies = HeldReplies()
    handler = ScriptedHandler(held_replies.decide)
    async with busway.serve(ANY_PORT, responder=handler, max_transactions=2) as server:
        reader, writer = await asyncio.open_connection("127.0.0.1", _port(server))
        other_reader, other_writer = await asyncio.open_connection("127.0.0.1", _port(server))
        writer.write(_question(1000, 1) + _question(1001, 2) + _question(1, 3))
        assert await reader.readexactly(9) == _busy(3)
        other_writer.write(_question(1, 4))
        assert await other_reader.readexactly(11) == _answer(1, 4)
        assert server.status().counters.refused_busy == 1
        held_replies.opened.set()
        replies = {await reader.readexactly(11), await reader.readexactly(11)}
        assert replies == {_answer(1000, 1), _answer(1001, 2)}
        writer.write(_question(5, 5))  # the slots are free again
        assert await reader.readexactly(11) == _answer(5, 5)
        await _close(writer)
        await _close(other_writer)


@pytest.mark.clause("T27")
async def test_limit_of_a_server_counts_over_its_connections_and_listeners() -> None:
    held_replies = HeldReplies()
    handler = ScriptedHandler(held_replies.decide)
    async with busway.serve(ANY_PORT, ANY_PORT, responder=handler, max_transactions=2, scope="server") as server:
        ports = [urlsplit(one).port for one in server.endpoints]
        connections = [await asyncio.open_connection("127.0.0.1", port) for port in (*ports, ports[0])]
        for number, (_, writer) in enumerate(connections[:2]):
            writer.write(_question(1000, number))
        await until(lambda: len(handler.contexts) == 2)
        reader, writer = connections[2]
        writer.write(_question(1, 9))
        assert await reader.readexactly(9) == _busy(9)
        held_replies.opened.set()
        for number, (one, _) in enumerate(connections[:2]):
            assert await one.readexactly(11) == _answer(1000, number)
        writer.write(_question(1, 10))
        assert await reader.readexactly(11) == _answer(1, 10)
        for _, one in connections:
            await _close(one)


@pytest.mark.clause("T27")
async def test_requests_that_are_answered_at_once_never_count_towards_the_limit() -> None:
    handler = ScriptedHandler(lambda context, request: registers(address_of(request)))
    async with busway.serve(ANY_PORT, responder=handler, max_transactions=1) as server:
        reader, writer = await asyncio.open_connection("127.0.0.1", _port(server))
        writer.write(b"".join(_question(number, number) for number in range(100)))
        expected = b"".join(_answer(number, number) for number in range(100))
        assert await reader.readexactly(len(expected)) == expected
        await _close(writer)


# --- ends ----------------------------------------------------------------------------------------


@pytest.mark.clause("T30")
async def test_reply_for_a_client_that_has_gone_is_dropped_and_its_slot_is_free() -> None:
    handler = ScriptedHandler(later)
    async with busway.serve(ANY_PORT, responder=handler, max_transactions=1, scope="server") as server:
        _, writer = await asyncio.open_connection("127.0.0.1", _port(server))
        writer.write(_question(1, 1))
        await until(lambda: handler.contexts)
        _vanish(writer)
        await until(lambda: server.counters.closed == 1)
        context = handler.contexts[0]
        assert context.replied  # no work on it is needed any more
        context.reply(registers(1))
        reader, writer = await asyncio.open_connection("127.0.0.1", _port(server))
        writer.write(_question(2, 2))
        await until(lambda: len(handler.contexts) == 2)
        handler.contexts[1].reply(registers(2))
        assert await reader.readexactly(11) == _answer(2, 2)
        await _close(writer)


@pytest.mark.clause("T30")
async def test_awaitable_of_a_client_that_has_gone_is_cancelled() -> None:
    ended = asyncio.Event()

    async def forever() -> busway.Message:
        try:
            await asyncio.get_running_loop().create_future()
        finally:
            ended.set()
        raise AssertionError

    handler = ScriptedHandler(lambda context, request: forever())
    async with busway.serve(ANY_PORT, responder=handler) as server:
        _, writer = await asyncio.open_connection("127.0.0.1", _port(server))
        writer.write(_question(1, 1))
        await until(lambda: handler.contexts)
        await asyncio.sleep(0)  # the task begins
        _vanish(writer)
        async with asyncio.timeout(60):
            await ended.wait()


@pytest.mark.clause("T30")
async def test_slot_of_a_client_that_closed_is_free_as_soon_as_its_reply_is_there() -> None:
    handler = ScriptedHandler(later)
    async with busway.serve(ANY_PORT, responder=handler, max_transactions=1, scope="server") as server:
        _, writer = await asyncio.open_connection("127.0.0.1", _port(server))
        writer.write(_question(1, 1))
        await until(lambda: handler.contexts)
        await _close(writer)  # the server sees the end of a stream, as from a client that still listens
        handler.contexts[0].reply(registers(1))
        await until(lambda: server.counters.closed == 1)
        reader, writer = await asyncio.open_connection("127.0.0.1", _port(server))
        writer.write(_question(2, 2))
        await until(lambda: len(handler.contexts) == 2)
        handler.contexts[1].reply(registers(2))
        assert await reader.readexactly(11) == _answer(2, 2)
        await _close(writer)


@pytest.mark.clause("T30")
async def test_client_that_closes_its_half_still_gets_the_replies_to_come() -> None:
    handler = ScriptedHandler(later)
    async with busway.serve(ANY_PORT, responder=handler) as server:
        reader, writer = await asyncio.open_connection("127.0.0.1", _port(server))
        writer.write(_question(1, 1) + _question(2, 2))
        writer.write_eof()
        await until(lambda: len(handler.contexts) == 2)
        handler.contexts[1].reply(registers(2))
        assert await reader.readexactly(11) == _answer(2, 2)
        handler.contexts[0].reply(registers(1))
        assert await reader.read(-1) == _answer(1, 1)  # and the end of the stream
        await _close(writer)


@pytest.mark.clause("T30")
async def test_client_that_closes_its_half_still_gets_the_reply_that_was_given_in_the_same_turn() -> None:
    handler = ScriptedHandler(later)
    async with busway.serve(ANY_PORT, responder=handler) as server:
        loop = asyncio.get_running_loop()
        with socket.socket() as client:
            client.setblocking(False)
            await loop.sock_connect(client, ("127.0.0.1", _port(server)))
            await loop.sock_sendall(client, _question(1))
            await until(lambda: handler.contexts)

            def end_and_answer() -> None:
                client.shutdown(socket.SHUT_WR)
                # In the turn in which the server hears of the end, and before it does.
                loop.call_soon(handler.contexts[0].reply, registers(1))

            loop.call_soon(end_and_answer)
            async with asyncio.timeout(60):
                assert await loop.sock_recv(client, 100) == _answer(1)
                assert await loop.sock_recv(client, 100) == b""


@pytest.mark.clause("T29", "T30")
async def test_thousands_of_requests_at_once_are_answered_in_order_and_their_end_is_heard_behind_them() -> None:
    count = 3000
    async with busway.serve(
        ANY_PORT, responder=ScriptedHandler(lambda _, asked: registers(address_of(asked)))
    ) as server:
        reader, writer = await asyncio.open_connection("127.0.0.1", _port(server))
        writer.write(b"".join(_question(one, one) for one in range(count)))
        writer.write_eof()
        async with asyncio.timeout(30):
            assert await reader.read(-1) == b"".join(_answer(one, one) for one in range(count))
        await _close(writer)


@pytest.mark.clause("T29")
@pytest.mark.parametrize("scheme", ["rtu+tcp", "ascii+tcp"])
async def test_frames_of_a_line_that_come_by_the_hundred_are_answered_in_order(scheme: str) -> None:
    encode = {"rtu+tcp": encode_rtu, "ascii+tcp": encode_ascii}[scheme]
    device = busway.Device(holding_registers=list(range(300)))
    async with busway.serve(f"{scheme}://127.0.0.1:0", units={1: device}) as server:
        reader, writer = await asyncio.open_connection("127.0.0.1", _port(server))
        writer.write(b"".join(encode(1, busway.ReadHoldingRegisters(one, 1).encode()) for one in range(300)))
        expected = b"".join(encode(1, registers(one).encode()) for one in range(300))
        async with asyncio.timeout(30):
            assert await reader.readexactly(len(expected)) == expected
        await _close(writer)


@pytest.mark.clause("T29")
async def test_known_reads_in_rtu_that_wait_for_their_turn_are_answered_without_a_search_for_frames(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    searched: list[int] = []
    find = SerialServerSession.find

    def count(session: SerialServerSession, data: bytes, now: float) -> list[FrameOrDamage]:
        searched.append(len(data))
        return find(session, data, now)

    monkeypatch.setattr(SerialServerSession, "find", count)
    request = encode_rtu(1, busway.ReadHoldingRegisters(7, 1).encode())
    reply = encode_rtu(1, registers(7).encode())
    async with busway.serve("rtu+tcp://127.0.0.1:0", units={1: busway.Device(holding_registers=range(9))}) as server:
        reader, writer = await asyncio.open_connection("127.0.0.1", _port(server))
        async with asyncio.timeout(30):
            for count_of_requests in (1, 1000):
                writer.write(request * count_of_requests)
                assert await reader.readexactly(len(reply) * count_of_requests) == reply * count_of_requests
        await _close(writer)
    assert searched == [len(request)]


async def test_sixteen_requests_at_once_are_answered_with_one_write_and_no_turn_is_waited_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    written: list[int] = []
    write = ServerConnection._write

    def count(connection: ServerConnection, replies: list[bytes]) -> None:
        written.append(len(replies))
        write(connection, replies)

    monkeypatch.setattr(ServerConnection, "_write", count)
    monkeypatch.setattr(Turns, "wait", lambda turns, one: pytest.fail("a connection waits"))
    longest = busway.WriteMultipleRegisters(0, 123, bytes(246)).encode()
    async with busway.serve(ANY_PORT, units={1: busway.Device(holding_registers=123)}) as server:
        reader, writer = await asyncio.open_connection("127.0.0.1", _port(server))
        writer.write(b"".join(golden_adu(longest, transaction=one) for one in range(16)))
        await reader.readexactly(16 * 12)
        assert written == [16]
        await _close(writer)


async def test_who_asks_once_is_answered_before_what_another_has_asked_without_end() -> None:
    served: list[int] = []

    def decide(context: busway.RequestContext, request: AnyRequest) -> ResponderAnswer:
        served.append(address_of(request))
        return registers(0)

    async with busway.serve(ANY_PORT, responder=ScriptedHandler(decide)) as server:
        _, flood = await asyncio.open_connection("127.0.0.1", _port(server))
        reader, writer = await asyncio.open_connection("127.0.0.1", _port(server))
        flood.write(b"".join(_question(1) for _ in range(5000)))
        await until(lambda: served)
        writer.write(_question(2))
        await reader.readexactly(11)
        assert len(served) < 1000
        await _close(flood)
        await _close(writer)


@pytest.mark.clause("T30")
async def test_client_that_closes_its_half_is_closed_when_the_last_reply_turns_out_to_be_silence() -> None:
    handler = ScriptedHandler(later)
    async with busway.serve(ANY_PORT, responder=handler) as server:
        reader, writer = await asyncio.open_connection("127.0.0.1", _port(server))
        writer.write(_question(1, 1))
        writer.write_eof()
        await until(lambda: handler.contexts)
        await until(lambda: server.status().connections[0].waiting == 1)
        handler.contexts[0].reply(busway.SILENCE)
        async with asyncio.timeout(60):
            assert await reader.read(-1) == b""
        await _close(writer)


@pytest.mark.clause("T29")
async def test_reply_given_before_the_handler_returns_goes_out_before_what_breaks_the_stream_closes_it() -> None:
    def decide(context: busway.RequestContext, request: AnyRequest) -> ResponderAnswer:
        context.reply(registers(address_of(request)))
        return busway.LATER

    async with busway.serve(ANY_PORT, responder=ScriptedHandler(decide)) as server:
        reader, writer = await asyncio.open_connection("127.0.0.1", _port(server))
        writer.write(_question(5) + bytes.fromhex("0002 0000 0000 01 03"))  # a length of 0 is outside of the limits
        async with asyncio.timeout(60):
            assert await reader.read(-1) == _answer(5)
        await _close(writer)


# --- limits of connections -----------------------------------------------------------------------


@pytest.mark.clause("T12")
async def test_new_connection_beyond_the_limit_takes_the_place_of_the_connection_unused_longest() -> None:
    handler = ScriptedHandler(lambda context, request: registers(address_of(request)))
    async with busway.serve(ANY_PORT, responder=handler, max_connections=3) as server:
        connections = [await asyncio.open_connection("127.0.0.1", _port(server)) for _ in range(3)]
        for turn in (1, 0, 2):  # the second one is unused longest after this
            reader, writer = connections[turn]
            writer.write(_question(turn, turn))
            await reader.readexactly(11)
        new_connection = await asyncio.open_connection("127.0.0.1", _port(server))
        new_connection[1].write(_question(9, 9))
        assert await new_connection[0].readexactly(11) == _answer(9, 9)
        assert await connections[1][0].read(-1) == b""
        for turn in (0, 2):
            reader, writer = connections[turn]
            writer.write(_question(turn, turn))
            assert await reader.readexactly(11) == _answer(turn, turn)
        assert server.counters.evicted == 1
        assert len(server.status().connections) == 3
        for _, writer in (*connections, new_connection):
            await _close(writer)


@pytest.mark.clause("T12")
async def test_busy_connection_stays_while_an_idle_one_can_go_and_the_oldest_goes_when_all_are_busy() -> None:
    handler = ScriptedHandler(later)
    async with busway.serve(ANY_PORT, responder=handler, max_connections=2) as server:
        first = await asyncio.open_connection("127.0.0.1", _port(server))
        first[1].write(_question(1, 1))
        await until(lambda: len(handler.contexts) == 1)
        second = await asyncio.open_connection("127.0.0.1", _port(server))
        await until(lambda: len(server.status().connections) == 2)
        third = await asyncio.open_connection("127.0.0.1", _port(server))
        assert await second[0].read(-1) == b""
        third[1].write(_question(3, 3))
        await until(lambda: len(handler.contexts) == 2)
        fourth = await asyncio.open_connection("127.0.0.1", _port(server))
        with pytest.raises(ConnectionResetError):
            await _read_to_the_end(first[0])
        assert server.counters.evicted == 2
        for _, writer in (second, third, fourth):
            await _close(writer)
        first[1].transport.abort()


async def _read_to_the_end(reader: asyncio.StreamReader) -> None:
    if await reader.read(-1) == b"":
        raise ConnectionResetError


@pytest.mark.clause("T40")
async def test_three_hundred_connections_come_and_go_without_leaving_anything() -> None:
    async with busway.serve(ANY_PORT, units=busway.Device(holding_registers=10)) as server:
        await _ask_once(server)
        before = open_handles()
        for _ in range(300):
            await _ask_once(server)
        await until(lambda: server.counters.closed == 301)
        assert open_handles() <= before


async def _ask_once(server: busway.Server) -> None:
    async with busway.open(server.endpoints[0]) as link:
        await link.unit(1).read_holding_registers(0, count=1)


# --- clients that do not play along --------------------------------------------------------------


@pytest.mark.clause("T39")
async def test_nothing_more_is_read_from_a_client_that_does_not_take_its_replies() -> None:
    question = bytes.fromhex("0001 0000 0006 01 03 0000 007D")
    reply_size = 9 + 250
    device = busway.Device(holding_registers=1000)
    async with busway.serve(ANY_PORT, units=device, write_buffer=8192, send_buffer=8192, receive_buffer=8192) as server:
        with socket.socket() as client:
            client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 8192)
            client.connect(("127.0.0.1", _port(server)))
            client.setblocking(False)
            asked = await _ask_until_nothing_more_is_taken(client, question)
            assert server.counters.reading_paused == 1
            (connection,) = server.status().connections
            # What waits in the server is the answer to one receive call at most, however much was asked.
            assert connection.sent <= (65_536 // len(question) + 2) * reply_size * 3
            assert connection.received < asked * len(question)
            async with busway.open(server.endpoints[0]) as link:  # others are served meanwhile
                assert await link.unit(1).read_holding_registers(0, count=1) == [0]
            received = 0
            while received < asked * reply_size:
                received += len(await asyncio.get_running_loop().sock_recv(client, 65_536))
            assert received == asked * reply_size


async def _ask_until_nothing_more_is_taken(client: socket.socket, question: bytes) -> int:
    """Ask until neither the server nor the systems between take another byte; whole requests that were sent."""
    pending, sent_bytes, refused = b"", 0, 0
    while refused < 1000:
        if not pending:
            pending = 50 * question
        try:
            sent = client.send(pending)
        except BlockingIOError:
            refused += 1
            await asyncio.sleep(0)
            continue
        refused = 0
        pending = pending[sent:]
        sent_bytes += sent
        await asyncio.sleep(0)
    if sent_bytes % len(question):
        # The rest of the last request goes out when there is room again.
        rest = pending[: len(question) - sent_bytes % len(question)]
        asyncio.get_running_loop().call_soon(_send_rest, client, rest)
    return -(-sent_bytes // len(question))


def _send_rest(client: socket.socket, rest: bytes) -> None:
    with contextlib.suppress(BlockingIOError):
        rest = rest[client.send(rest) :]
    if rest:
        asyncio.get_running_loop().call_soon(_send_rest, client, rest)


async def test_place_of_a_client_that_began_a_frame_and_fell_silent_is_freed() -> None:
    async with busway.serve(ANY_PORT, units=busway.Device(holding_registers=10), frame_timeout=0.05) as server:
        for size in (1, 3, 7, 11):
            with misbehaving_client(server.endpoints[0], SLOW_LORIS, size=size) as client:
                client.setblocking(False)
                async with asyncio.timeout(60):
                    assert await asyncio.get_running_loop().sock_recv(client, 100) == b""
        await until(lambda: not server.status().connections)
        assert server.counters.frame_timeouts == 4


async def test_idle_connection_and_one_that_sends_whole_frames_in_pieces_outlive_the_frame_timeout(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    limits = {"frame_timeout": 12.0, "header_timeout": 12.0}
    async with busway.serve(ANY_PORT, units=busway.Device(holding_registers=10), **limits) as server:
        idle_reader, idle_writer = await asyncio.open_connection("127.0.0.1", _port(server))
        idle_writer.write(_question(0, 1))
        await idle_reader.readexactly(11)
        reader, writer = await asyncio.open_connection("127.0.0.1", _port(server))
        # Every segment ends inside a frame, so there is never a moment without an unfinished one.
        writer.write(_question(0, 0)[:5])
        for transaction in range(5):
            set_forward(monkeypatch, 5.0)
            writer.write(_question(0, transaction)[5:] + _question(0, transaction + 1)[:5])
            assert await reader.readexactly(11) == _answer(0, transaction)
        idle_writer.write(_question(0, 2))
        assert await idle_reader.readexactly(11) == _answer(0, 2)
        assert server.counters.frame_timeouts == 0
        set_forward(monkeypatch, 12.0)
        await until(lambda: server.counters.frame_timeouts == 1)  # so the clock was set forward for the server too
        await _close(idle_writer)
        await _close(writer)


# --- segments ------------------------------------------------------------------------------------


@pytest.mark.clause("T11")
@pytest.mark.parametrize("by_one", [False, True])
async def test_replies_to_requests_that_came_together_leave_together_or_one_by_one(by_one: bool) -> None:
    handler = ScriptedHandler(lambda context, request: registers(address_of(request)))
    server = busway.serve(ANY_PORT, responder=handler, single_adu_segments=by_one)
    await server.start()
    reader, writer = await asyncio.open_connection("127.0.0.1", _port(server))
    writer.write(_question(1, 1) + _question(2, 2))
    assert await reader.readexactly(22) == _answer(1, 1) + _answer(2, 2)
    assert server.status().connections[0].sent == 22
    await _close(writer)
    await server.stop()
