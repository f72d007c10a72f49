"""How long an unused connection is held: for ever, for some seconds, or as long as something is asked."""

import asyncio
import threading
from types import SimpleNamespace

import pytest
from client_kinds import CLIENT_KINDS, ClientKind
from handlers import ScriptedHandler, later, registers
from waiting import until

import busway
from busway.client.settings import link_settings
from busway.testing import FakeClock, FaultyServer, faulty_server, known_device

AMPLE = 5.0
ANY_PORT = "tcp://127.0.0.1:0"


@pytest.fixture(params=CLIENT_KINDS, ids=lambda via: via.name)
def via(request: pytest.FixtureRequest) -> ClientKind:
    found: ClientKind = request.param
    return found


# --- for ever ------------------------------------------------------------------------------------


@pytest.mark.clause("T7")
def test_a_connection_is_held_for_ever_unless_an_option_says_otherwise() -> None:
    management = link_settings("tcp://10.0.0.5", {}).management
    assert management.hold_seconds == float("inf")
    assert link_settings("tcp://10.0.0.5?hold=forever", {}).management == management


# --- per request ---------------------------------------------------------------------------------


@pytest.mark.clause("T6", "T7")
def test_held_per_request_a_connection_ends_with_each_call_and_that_is_no_loss(via: ClientKind) -> None:
    with faulty_server(known_device()) as server, via.link(server.endpoint, hold="request", timeout=AMPLE) as link:
        for number in (1, 2, 3):
            assert link.unit(1).read_holding_registers(number, count=1) == [number]
            link.breathe()
            server.wait_until(lambda: server.connections == 0)
            assert (server.accepted, link.state) == (number, "down")
        assert (link.counters.connections, link.counters.lost_connections) == (3, 0)


@pytest.mark.clause("T6")
def test_a_batch_is_one_use_of_a_connection(via: ClientKind) -> None:
    requests = [busway.ReadHoldingRegisters(address, 1) for address in range(20)]
    with faulty_server(known_device()) as server, via.link(f"{server.endpoint}?hold=request") as link:
        assert len(link.unit(1).execute_many(requests)) == 20
        assert link.unit(1).read("4x1", count=300, split=True) == list(range(300))
        assert server.accepted == 2


@pytest.mark.clause("T8")
@pytest.mark.parametrize("starve", [False, True])
def test_two_programs_share_a_device_that_takes_one_client(via: ClientKind, starve: bool) -> None:
    with (
        faulty_server(known_device(), "single-client", starve=starve) as server,
        via.link(server.endpoint, shared=False, hold="request", timeout=AMPLE) as ours,
        via.link(server.endpoint, shared=False, hold="request", timeout=AMPLE) as theirs,
    ):
        for address in range(5):
            for link in (ours, theirs):
                assert link.unit(1).read_holding_registers(address, count=1) == [address]
                link.breathe()
                server.wait_until(lambda: server.connections == 0)
        assert server.accepted == 10


def test_a_timeout_also_ends_a_connection_that_is_held_per_request(via: ClientKind) -> None:
    with (
        faulty_server(known_device(), "wedged") as server,
        via.link(server.endpoint, hold="request", timeout=0.03, retries=0) as link,
    ):
        for _ in range(3):
            with pytest.raises(busway.NoReply):
                link.unit(1).read_holding_registers(0, count=1)
            link.breathe()
            server.wait_until(lambda: server.connections == 0)
        assert server.accepted == 3
        assert link.counters.recycled == 0


@pytest.mark.clause("T5")
def test_a_connection_that_is_made_by_name_waits_for_its_first_request(via: ClientKind) -> None:
    with faulty_server(known_device()) as server, via.link(server.endpoint, hold="request") as link:
        link.connect()
        link.breathe()
        server.wait_until(lambda: server.accepted == 1)
        assert link.state == "up"
        assert link.unit(1).read_holding_registers(7, count=1) == [7]
        link.breathe()
        server.wait_until(lambda: server.connections == 0)
        assert server.accepted == 1


async def test_tasks_that_ask_together_use_one_connection_which_ends_with_the_last() -> None:
    handler = ScriptedHandler(later)
    async with (
        busway.serve(ANY_PORT, responder=handler) as server,
        busway.open(server.endpoints[0], hold="request", max_transactions=2, timeout=AMPLE) as link,
    ):
        reads = [asyncio.create_task(link.unit(1).read_holding_registers(address, count=1)) for address in range(3)]
        for number in range(3):
            await until(lambda number=number: len(handler.contexts) > number)  # type: ignore[misc]
            assert link.is_connected
            handler.contexts[number].reply(registers(number))
        assert await asyncio.gather(*reads) == [[0], [1], [2]]
        assert not link.is_connected
        assert link.counters.connections == 1


async def test_a_cancelled_request_holds_its_connection_until_its_reply_has_come() -> None:
    handler = ScriptedHandler(later)
    async with (
        busway.serve(ANY_PORT, responder=handler) as server,
        busway.open(server.endpoints[0], hold="request", timeout=AMPLE) as link,
    ):
        read = asyncio.create_task(link.unit(1).read_holding_registers(0, count=1))
        await until(lambda: handler.contexts)
        read.cancel()
        await asyncio.gather(read, return_exceptions=True)
        assert link.is_connected  # the device still works on it
        handler.contexts[0].reply(registers(1))
        await until(lambda: not link.is_connected)


async def test_a_connection_that_no_call_waits_for_any_more_ends_when_it_stands() -> None:
    async with FaultyServer(known_device()) as server, busway.open(server.endpoint, hold="request") as link:
        read = asyncio.create_task(link.unit(1).read_holding_registers(0, count=1))
        await asyncio.sleep(0)
        read.cancel()
        await asyncio.gather(read, return_exceptions=True)
        await server.until(lambda: server.accepted == 1 and server.connections == 0)
        assert not server.requests


def test_threads_that_ask_together_each_get_their_data() -> None:
    with (
        faulty_server(known_device()) as server,
        busway.connect(server.endpoint, hold="request", timeout=AMPLE) as link,
    ):
        found: dict[int, list[int]] = {}
        meet = threading.Barrier(4)

        def ask(address: int) -> None:
            meet.wait(10)
            for _ in range(20):
                found[address] = link.unit(1).read_holding_registers(address, count=1)

        threads = [threading.Thread(target=ask, args=(address,)) for address in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(10)
        assert found == {address: [address] for address in range(4)}
        server.wait_until(lambda: server.connections == 0)
        assert not link.is_connected


@pytest.mark.parametrize("scheme", ["rtu+tcp", "ascii+tcp", "udp", "rtu+udp"])
def test_it_holds_whatever_the_framing_and_a_broadcast_leaves_before_its_connection_ends(
    via: ClientKind, scheme: str
) -> None:
    device = busway.Device(holding_registers=10)
    with (
        busway.serve_in_thread(f"{scheme}://127.0.0.1:0", units={1: device}) as server,
        via.link(server.endpoints[0], hold="request", timeout=AMPLE) as link,
    ):
        for value in (7, 8):
            link.unit(1 if scheme == "udp" else 0).write_single_register(0, value)
            assert link.state == "down"
            assert link.unit(1).read_holding_registers(0, count=1) == [value]
        assert (link.state, link.counters.connections, link.counters.lost_connections) == ("down", 4, 0)


# --- for some seconds ----------------------------------------------------------------------------


@pytest.mark.clause("T6", "T7")
async def test_an_idle_connection_is_closed_by_the_timer_of_its_link_and_made_anew_at_the_next_need() -> None:
    loop = asyncio.get_running_loop()
    async with FaultyServer(known_device()) as server, busway.open(f"{server.endpoint}?hold=0.05") as link:
        for number in (1, 2):
            assert await link.unit(1).read_holding_registers(number, count=1) == [number]
            used = loop.time()
            assert link.is_connected
            await server.until(lambda: server.connections == 0)
            assert loop.time() - used >= 0.045
            assert (server.accepted, link.state) == (number, "down")
        assert link.counters.lost_connections == 0


async def test_a_connection_in_use_is_not_closed_however_long_the_device_takes() -> None:
    handler = ScriptedHandler(later)
    async with (
        busway.serve(ANY_PORT, responder=handler) as server,
        busway.open(server.endpoints[0], hold=0.02, timeout=AMPLE) as link,
    ):
        read = asyncio.create_task(link.unit(1).read_holding_registers(0, count=1))
        await until(lambda: handler.contexts)
        begin = asyncio.get_running_loop().time()
        await until(lambda: asyncio.get_running_loop().time() - begin > 0.06)
        assert link.is_connected
        handler.contexts[0].reply(registers(5))
        assert await read == [5]
        assert link.counters.connections == 1
        await until(lambda: not link.is_connected)


@pytest.mark.alone
async def test_each_use_begins_the_time_anew() -> None:
    loop = asyncio.get_running_loop()
    async with FaultyServer(known_device()) as server, busway.open(server.endpoint, hold=0.2, timeout=AMPLE) as link:
        begin = loop.time()
        while loop.time() - begin < 0.5:
            await link.unit(1).read_holding_registers(0, count=1)
        assert server.accepted == 1


async def test_a_connection_made_by_name_is_held_as_long_as_any_other() -> None:
    async with FaultyServer(known_device()) as server, busway.open(server.endpoint, hold=0.03) as link:
        await link.connect()
        assert link.is_connected
        await server.until(lambda: server.accepted == 1 and server.connections == 0)


@pytest.mark.clause("T6")
def test_a_blocking_link_closes_what_was_idle_too_long_at_its_next_call(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = FakeClock(1000.0)
    monkeypatch.setattr("busway.client.blocking_link.time", SimpleNamespace(monotonic=clock.now))
    with faulty_server(known_device()) as server, busway.connect(server.endpoint, hold=30, timeout=AMPLE) as link:
        for pause, accepted in ((0, 1), (29.9, 1), (29.9, 1), (30.0, 2), (3600.0, 3)):
            clock.advance(pause)
            assert link.unit(1).read_holding_registers(4, count=1) == [4]
            assert server.accepted == accepted
        server.wait_until(lambda: server.connections == 1)
        assert link.counters.lost_connections == 0


# --- options -------------------------------------------------------------------------------------


@pytest.mark.parametrize("hold", ["0", "-1", "0.001", "90000", "never", "", "nan"])
def test_a_hold_that_cannot_be_is_refused_by_name(hold: str) -> None:
    with pytest.raises(busway.ConfigError) as caught:
        busway.open(f"tcp://127.0.0.1?hold={hold}")
    assert caught.value.key == "hold"


@pytest.mark.parametrize("scheme", ["tcp", "udp", "rtu+tcp", "ascii+tcp", "rtu+udp", "ascii+udp"])
def test_every_link_over_a_network_has_the_option(scheme: str) -> None:
    assert link_settings(f"{scheme}://127.0.0.1:5020?hold=7", {}).management.hold_seconds == 7
    assert link_settings(f"{scheme}://127.0.0.1:5020", {"hold": "request"}).management.hold_seconds == 0


def test_a_serial_port_has_it_not() -> None:
    with pytest.raises(busway.ConfigError) as caught:
        busway.connect("rtu:///dev/ttyNone?hold=7")
    assert caught.value.key == "hold"
