"""The local connections of the process: listed, counted, limited, and not kept alive."""

import asyncio
import contextlib
import gc
import threading
import weakref
from collections.abc import Iterator

import pytest
from client_kinds import CLIENT_KINDS, ClientKind

import busway
from busway.client.open_connections import LOCAL, LocalConnections
from busway.testing import FaultyServer, faulty_server, known_device

AMPLE = 5.0


@pytest.fixture(params=CLIENT_KINDS, ids=lambda via: via.name)
def via(request: pytest.FixtureRequest) -> ClientKind:
    found: ClientKind = request.param
    return found


@pytest.fixture
def three_supported() -> Iterator[None]:
    """The process may have three local connections."""
    supported = LOCAL.supported
    busway.limit_local_connections(3)
    yield
    LOCAL.supported = supported


def status_at(endpoint: str) -> list[busway.LocalConnectionStatus]:
    """Of the links to an endpoint."""
    return [one for one in busway.local_connections() if one.endpoint == endpoint]


# --- status --------------------------------------------------------------------------------------


@pytest.mark.clause("T34")
def test_a_link_is_listed_from_its_first_need_until_it_is_closed_with_all_that_is_known_of_it(via: ClientKind) -> None:
    with faulty_server(known_device()) as server:
        with via.link(server.endpoint, timeout=AMPLE) as link:
            link.unit(1).read_holding_registers(0, count=10)
            (status,) = status_at(server.endpoint)
            assert (status.kind, status.shared, status.state, status.reason) == (via.name, True, "up", "")
            assert (status.sent_bytes, status.received_bytes) == (12, 29)
            assert (status.transactions, status.failures, status.connections) == (1, 0, 1)
            assert (status.in_flight, status.queued) == (0, 0)
            host, port = status.local.rsplit(":", 1)
            assert host == "127.0.0.1"
            assert int(port) > 1024
            assert status.age is not None
            assert status.idle is not None
            assert 0 <= status.idle <= status.age < AMPLE
            requests = [busway.ReadHoldingRegisters(address, 1) for address in range(10)]
            link.unit(1).execute_many(requests)
            (status,) = status_at(server.endpoint)
            assert (status.sent_bytes, status.received_bytes, status.transactions) == (12 + 120, 29 + 110, 11)
        assert not status_at(server.endpoint)


@pytest.mark.clause("T34")
def test_a_link_without_a_connection_tells_why(via: ClientKind) -> None:
    with faulty_server(known_device()) as server:
        endpoint = server.endpoint
    with via.link(endpoint) as link:
        with pytest.raises(busway.LinkDown):
            link.unit(1).read_holding_registers(0, count=1)
        (status,) = status_at(endpoint)
        assert (status.state, status.age, status.idle, status.local) == ("backing off", None, None, "")
        assert "nothing listens there" in status.reason


@pytest.mark.clause("T34")
def test_connections_of_both_kinds_are_counted_while_they_stand(via: ClientKind) -> None:
    before = LOCAL.count()
    with (
        faulty_server(known_device()) as server,
        via.link(server.endpoint) as first,
        via.link(server.endpoint, shared=False) as second,
    ):
        assert LOCAL.count() == before
        first.connect()
        assert LOCAL.count() == before + 1
        server.wait_until(lambda: server.accepted == 1)
        second.connect()
        server.wait_until(lambda: server.accepted == 2)
        if via.name == "asyncio":
            assert LOCAL.count() == before + 2
        second.call(second.real.close)
        assert LOCAL.count() == before + 1
    assert LOCAL.count() == before


def test_neither_registry_nor_pool_keeps_a_link_alive_that_its_user_has_forgotten() -> None:
    with faulty_server(known_device()) as server:
        link = busway.connect(server.endpoint, shared=False, max_connections=1)
        gone = weakref.ref(link._link)  # type: ignore[arg-type]
        del link
        gc.collect()
        assert gone() is None
        assert not status_at(server.endpoint)
        busway.connect(server.endpoint, shared=False, max_connections=1).close()


def test_a_link_of_a_loop_that_has_ended_is_not_listed() -> None:
    with faulty_server(known_device()) as server:
        with asyncio.Runner() as runner:
            link = busway.open(server.endpoint)

            async def use() -> None:
                link._bound()

            runner.run(use())
            assert len(status_at(server.endpoint)) == 1
        assert not status_at(server.endpoint)


def test_it_may_be_read_from_any_thread_while_links_come_and_go() -> None:
    problems: list[BaseException] = []
    over = threading.Event()

    def read() -> None:
        try:
            while not over.is_set():
                busway.local_connections()
        except BaseException as error:
            problems.append(error)

    with faulty_server(known_device()) as server:
        reader = threading.Thread(target=read)
        reader.start()
        for number in range(50):
            with busway.connect(server.endpoint, timeout=AMPLE) as link:
                link.unit(1).read_holding_registers(number, count=1)
        over.set()
        reader.join(10)
    assert not problems


# --- limit ---------------------------------------------------------------------------------------


@pytest.mark.clause("T12", "T40")
@pytest.mark.usefixtures("three_supported")
async def test_past_the_limit_the_unused_connection_whose_last_use_is_longest_ago_makes_room() -> None:
    async with contextlib.AsyncExitStack() as stack:
        servers = [await stack.enter_async_context(FaultyServer(known_device())) for _ in range(4)]
        links = [busway.open(server.endpoint, timeout=AMPLE) for server in servers]
        for link in (*links[:3], links[0]):
            await link.unit(1).read_holding_registers(0, count=1)
        await links[3].unit(1).read_holding_registers(0, count=1)
        assert [link.is_connected for link in links] == [True, False, True, True]
        assert await links[1].unit(1).read_holding_registers(1, count=1) == [1]  # and takes the next oldest
        assert [link.is_connected for link in links] == [True, True, False, True]
        assert sum(link.counters.lost_connections for link in links) == 0
        for link in links:
            await link.close()


@pytest.mark.clause("T40", "T41")
@pytest.mark.usefixtures("three_supported")
async def test_connections_in_use_and_those_of_explicit_management_are_left_alone() -> None:
    async with FaultyServer(known_device(), "wedged") as busy, FaultyServer(known_device()) as other:
        explicit = [busway.open(other.endpoint, shared=False) for _ in range(2)]
        for link in explicit:
            await link.unit(1).read_holding_registers(0, count=1)
        async with busway.open(busy.endpoint, timeout=AMPLE) as waiting, busway.open(other.endpoint) as late:
            read = asyncio.create_task(waiting.unit(1).read_holding_registers(0, count=1))
            await busy.until(lambda: busy.requests)
            with pytest.raises(busway.LinkDown, match="all 3 of this process are in use") as caught:
                await late.unit(1).read_holding_registers(0, count=1)
            assert not caught.value.sent
            assert all(link.is_connected for link in explicit)
            read.cancel()
            await asyncio.gather(read, return_exceptions=True)
        for link in explicit:
            await link.close()


@pytest.mark.clause("T40")
@pytest.mark.usefixtures("three_supported")
def test_blocking_links_make_room_too() -> None:
    with contextlib.ExitStack() as stack:
        servers = [stack.enter_context(faulty_server(known_device())) for _ in range(4)]
        links = [busway.connect(server.endpoint, timeout=AMPLE) for server in servers]
        for link in links:
            assert link.unit(1).read_holding_registers(2, count=1) == [2]
        assert [link.is_connected for link in links] == [False, True, True, True]
        for link in links:
            link.close()


@pytest.mark.parametrize("supported", [0, -1, 65_536])
def test_a_limit_that_cannot_be_is_refused(supported: int) -> None:
    with pytest.raises(busway.ConfigError) as caught:
        LocalConnections().limit(supported)
    assert caught.value.key == "supported"
