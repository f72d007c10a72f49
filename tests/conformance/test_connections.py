"""Clauses T3, T5 to T10, T16, T17, T38 and T41 from end to end: when connections come and go, and whose they are."""

import asyncio
import contextlib
import socket
import threading
from urllib.parse import urlsplit

import pytest
from scripted_peer import ScriptedPeer, echo_of
from waiting import until

import busway
from busway.framing.mbap import MbapFrame

ANY_PORT = "tcp://127.0.0.1:0"


def device() -> busway.Device:
    return busway.Device(holding_registers=10)


@pytest.mark.clause("T3")
def test_502_is_meant_where_a_url_names_no_port() -> None:
    assert busway.parse_endpoint("tcp://10.0.0.5").port == 502
    assert busway.parse_endpoint("tcp://10.0.0.5:5020").port == 5020


@pytest.mark.clause("T5", "T41")
async def test_explicit_management_gives_each_user_a_connection_that_is_opened_and_closed_when_he_says_so() -> None:
    async with ScriptedPeer() as peer:
        first, second = busway.open(peer.endpoint, shared=False), busway.open(peer.endpoint, shared=False)
        assert not peer.writers
        await first.connect()
        await second.connect()
        await until(lambda: len(peer.writers) == 2)
        assert first.is_connected
        await first.close()
        await until(lambda: peer.ended == 1)
        assert await second.unit(1).read_holding_registers(3, count=1) == [3]
        await second.close()
        await until(lambda: peer.ended == 2)


@pytest.mark.clause("T6", "T38")
async def test_automatic_management_connects_at_the_first_need_and_closes_with_the_last_user() -> None:
    async with ScriptedPeer() as peer:
        async with busway.open(peer.endpoint) as first:
            assert not first.is_connected
            async with busway.open(peer.endpoint) as second:
                await second.unit(1).read_holding_registers(0, count=1)
            await first.unit(1).read_holding_registers(0, count=1)
            assert peer.ended == 0
        await until(lambda: peer.ended == 1)
        assert len(peer.writers) == 1
        with pytest.raises(busway.LinkClosed, match="closed"):
            await first.unit(1).read_holding_registers(0, count=1)
    assert len(peer.frames) == 2


@pytest.mark.clause("T7")
async def test_a_connection_stays_open_between_transactions_and_a_close_by_the_server_is_no_error() -> None:
    async with ScriptedPeer(close_after=2) as peer, busway.open(peer.endpoint, retries=0) as link:
        for connections in (1, 1, 2, 2, 3):
            assert await link.unit(1).read_holding_registers(5, count=1) == [5]
            assert len(peer.writers) == connections
            if len(peer.frames) % 2 == 0:
                await until(lambda: not link.is_connected)


@pytest.mark.clause("T7")
async def test_a_blocking_link_also_takes_a_close_by_the_server_quietly(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("busway.client.blocking_link._IDLE_SECONDS", 0.0)  # every pause is long enough to look
    async with ScriptedPeer(close_after=1) as peer:

        def work() -> list[int]:
            with busway.connect(peer.endpoint, retries=0) as link:
                found = link.unit(1).read_holding_registers(1, count=1)
                closed.wait(10)
                return found + link.unit(1).read_holding_registers(2, count=1)

        closed = threading.Event()
        working = asyncio.create_task(asyncio.to_thread(work))
        await until(lambda: peer.writers and peer.writers[0].is_closing())
        await peer.writers[0].wait_closed()
        closed.set()
        assert await working == [1, 2]
    assert len(peer.writers) == 2


@pytest.mark.clause("T8")
async def test_all_users_of_an_endpoint_share_one_connection() -> None:
    async with busway.serve(ANY_PORT, units={1: device()}) as server:

        async def use(address: int) -> list[int]:
            async with busway.open(server.endpoints[0]) as link:
                await meet.wait()
                return await link.unit(1).read_holding_registers(address, count=1)

        meet = asyncio.Barrier(5)
        await asyncio.gather(*(use(address) for address in range(5)))
        assert server.counters.accepted == 1


@pytest.mark.clause("T8")
def test_all_threads_of_a_process_share_one_connection() -> None:
    with busway.serve_in_thread(ANY_PORT, units={1: device()}) as server:
        meet = threading.Barrier(4)

        def use() -> None:
            with busway.connect(server.endpoints[0]) as link:
                meet.wait(10)
                link.unit(1).read_holding_registers(0, count=1)
                meet.wait(10)

        threads = [threading.Thread(target=use) for _ in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert server.status().counters.accepted == 1


@pytest.mark.clause("T9")
async def test_replies_in_another_order_are_matched_by_identifier_alone() -> None:
    held: list[MbapFrame] = []

    def answer(peer: ScriptedPeer, frame: MbapFrame) -> bytes | None:
        held.append(frame)
        if len(held) < 4:
            return None
        return b"".join(echo_of(one, int.from_bytes(one.pdu[1:3], "big")) for one in reversed(held))

    async with ScriptedPeer(answer) as peer, busway.open(peer.endpoint, max_transactions=4) as link:
        calls = (link.unit(1).read_holding_registers(address, count=1) for address in range(4))
        assert await asyncio.gather(*calls) == [[0], [1], [2], [3]]


@pytest.mark.clause("T10")
async def test_two_peers_that_are_client_and_server_of_each_other_have_one_connection_for_each_flow() -> None:
    async with (
        busway.serve(ANY_PORT, units={1: device()}) as left,
        busway.serve(ANY_PORT, units={1: device()}) as right,
        busway.open(right.endpoints[0]) as from_left,
        busway.open(left.endpoints[0]) as from_right,
    ):
        await from_left.unit(1).read_holding_registers(0, count=1)
        await from_right.unit(1).read_holding_registers(0, count=1)
        listening = {urlsplit(one.endpoints[0]).port for one in (left, right)}
        for server in (left, right):
            (connection,) = server.status().connections
            assert int(connection.peer.rsplit(":", 1)[1]) not in listening


@pytest.mark.clause("T16")
async def test_each_connection_leaves_from_a_port_of_its_own_above_1024_and_from_the_chosen_address() -> None:
    async with ScriptedPeer() as peer:
        links = [busway.open(peer.endpoint, shared=False, local_address="127.0.0.2") for _ in range(3)]
        for link in links:
            await link.connect()
        await until(lambda: len(peer.peers) == 3)
        for link in links:
            await link.close()
    assert {host for host, _ in peer.peers} == {"127.0.0.2"}
    ports = [port for _, port in peer.peers]
    assert len(set(ports)) == 3
    assert min(ports) > 1024


@pytest.mark.clause("T16", "T21")
async def test_a_local_address_that_this_host_has_not_is_an_error_that_says_so() -> None:
    async with ScriptedPeer() as peer, busway.open(peer.endpoint, local_address="192.0.2.1") as link:
        with pytest.raises(busway.LinkDown, match=r"local_address: .* is no address of this host"):
            await link.unit(1).read_holding_registers(0, count=1)


@pytest.mark.clause("T17")
async def test_the_client_closes_its_connection_when_its_work_is_done() -> None:
    async with ScriptedPeer() as peer:
        async with busway.open(peer.endpoint) as link:
            await link.unit(1).read_holding_registers(0, count=1)
        await until(lambda: peer.ended == 1)

        def work() -> None:
            with busway.connect(peer.endpoint) as blocking:
                blocking.unit(1).read_holding_registers(0, count=1)

        await asyncio.to_thread(work)
        await until(lambda: peer.ended == 2)


@pytest.mark.clause("T41")
async def test_with_automatic_management_there_is_one_connection_so_every_request_takes_the_oldest() -> None:
    async with ScriptedPeer() as peer, busway.open(peer.endpoint) as first, busway.open(peer.endpoint) as second:
        for link in (first, second, second, first):
            await link.unit(1).read_holding_registers(0, count=1)
        assert len(peer.writers) == 1


@pytest.mark.clause("T38")
@pytest.mark.parametrize("turns", range(6))
async def test_a_connection_that_is_accepted_while_the_server_stops_is_closed_with_it(turns: int) -> None:
    server = busway.serve(ANY_PORT, units={1: device()})
    await server.start()
    with socket.create_connection(("127.0.0.1", urlsplit(server.endpoints[0]).port or 0)) as client:
        for _ in range(turns):  # how far its acceptance has come
            await asyncio.sleep(0)
        await server.stop()
        client.settimeout(10)
        with contextlib.suppress(ConnectionResetError):
            assert client.recv(1) == b""
