"""The server that misbehaves, as a fixture of tests."""

import asyncio
import errno
import socket
import threading

import pytest

import busway
from busway.testing import (
    FAULT_PROFILES,
    SLOW_LORIS,
    FakeClock,
    FaultyServer,
    faulty_server,
    known_device,
    misbehaving_client,
    simulated_device,
)


def test_worked_example_a_late_device_in_three_lines() -> None:
    with faulty_server(known_device(), "late", delay=0.2) as server:
        with busway.connect(server.endpoint, timeout=0.05, retries=0) as link, pytest.raises(busway.NoReply):
            link.unit(1).read_holding_registers(0, count=1)
        assert [one.function for one in server.requests] == [3]


async def test_server_lives_in_the_loop_of_an_asyncio_test() -> None:
    async with FaultyServer(known_device(), "dribble", "foreign-transaction", piece=4) as server:
        async with busway.open(server.endpoint) as link:
            assert await link.unit(1).read_holding_registers(3, count=2) == [3, 4]
            assert (server.accepted, server.connections) == (1, 1)
        await server.until(lambda: server.connections == 0)


def test_thread_and_sockets_are_gone_when_the_block_is_left() -> None:
    before = threading.active_count()
    with faulty_server(known_device()) as server:
        endpoint = server.endpoint
        client = socket.create_connection(("127.0.0.1", busway.parse_endpoint(endpoint).port or 0))
        server.wait_until(lambda: server.connections == 1)
    assert threading.active_count() == before
    with client:
        assert client.recv(1) == b""
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.1", busway.parse_endpoint(endpoint).port or 0))


def test_event_loop_that_cannot_be_had_is_an_error_of_the_test(monkeypatch: pytest.MonkeyPatch) -> None:
    def no_loop() -> asyncio.AbstractEventLoop:
        raise OSError(errno.EMFILE, "Too many open files")

    monkeypatch.setattr("asyncio.events.new_event_loop", no_loop)
    before = threading.active_count()
    with pytest.raises(OSError, match="Too many open files"), faulty_server(known_device()):
        raise AssertionError("a server without an event loop")
    with pytest.raises(OSError, match="Too many open files"), simulated_device({"4x1": 7}):
        raise AssertionError("a device without an event loop")
    assert threading.active_count() == before


def test_listener_that_cannot_be_had_is_an_error_of_the_test() -> None:
    with pytest.raises(OSError, match=r".+"), faulty_server(known_device(), host="192.0.2.1"):
        raise AssertionError("it listens on an address that is not here")


@pytest.mark.parametrize(
    ("names", "options", "key"),
    [(("lazy",), {}, "lazy"), (("late",), {"seconds": 1}, "seconds"), ((), {"delay": 1}, "delay")],
)
def test_unknown_name_or_option_is_refused(names: tuple[str, ...], options: dict[str, object], key: str) -> None:
    with pytest.raises(busway.ConfigError) as caught:
        FaultyServer(known_device(), *names, **options)
    assert caught.value.key == key


def test_fault_can_be_made_from_a_fault_profile_or_by_hand_and_options_go_to_those_that_have_them() -> None:
    server = FaultyServer(
        known_device(), FAULT_PROFILES["busy"](seconds=None), "late", "idle-close", delay=9, seconds=5
    )
    assert [one.name for one in server.faults] == ["busy", "late", "idle-close"]


def test_faults_are_switched_while_clients_are_connected() -> None:
    with faulty_server(known_device()) as server, busway.connect(server.endpoint) as link:
        unit = link.unit(1)
        busy = server.add("busy", functions={3}, addresses=range(100, 200))
        with pytest.raises(busway.ExceptionReply):
            unit.read_holding_registers(150, count=1)
        assert unit.read_holding_registers(50, count=1) == [50]
        busy.off()
        assert unit.read_holding_registers(150, count=1) == [150]
        with server.faults.during(FAULT_PROFILES["hole"](address=150)), pytest.raises(busway.ExceptionReply):
            unit.read_holding_registers(150, count=1)
        assert unit.read_holding_registers(150, count=1) == [150]


def test_time_of_a_server_can_be_a_clock_of_the_test() -> None:
    clock = FakeClock()
    with (
        faulty_server(known_device(), "late", clock=clock, delay=3600.0) as server,
        busway.connect(server.endpoint, timeout=10) as link,
    ):
        found: list[list[int]] = []
        asking = threading.Thread(target=lambda: found.append(link.unit(1).read_holding_registers(7, count=1)))
        asking.start()
        server.wait_until(lambda: len(server.requests) == 1)
        clock.advance(3600.0)
        asking.join()
        assert found == [[7]]


async def test_units_by_number_and_waiting_in_vain() -> None:
    async with FaultyServer({5: known_device()}) as server, busway.open(server.endpoint) as link:
        assert await link.unit(5).read_holding_registers(1, count=1) == [1]
        server.drop_connections()
        await server.until(lambda: server.connections == 0)
        assert await link.unit(5).read_holding_registers(2, count=1) == [2]


def test_slow_loris_sends_a_part_of_a_request() -> None:
    with faulty_server(known_device()) as server, misbehaving_client(server.endpoint, SLOW_LORIS, size=5) as client:
        client.sendall(bytes.fromhex("06 01 03 0000 0001"))
        assert client.recv(100) == bytes.fromhex("0001 0000 0005 01 03 02 0000")


def test_known_device_is_what_it_says() -> None:
    device = known_device(100)
    assert list(device.holding_registers) == list(range(100))
    assert device.input_registers[7] == 10_007
    assert (device.coils[4], device.coils[5]) == (True, False)
    assert [number for number in range(10) if device.discrete_inputs[number]] == [0, 3, 6, 9]
    with (
        busway.serve_in_thread("tcp://127.0.0.1:0", units=device) as server,
        busway.connect(server.endpoints[0]) as link,
    ):
        unit = link.unit(1)
        with pytest.raises(busway.ExceptionReply):
            unit.write_single_register(95, 1)
        assert unit.read_file_record(1, 40, count=2) == [40, 41]
        assert unit.read_fifo_queue(10) == [1, 2, 3]
        assert unit.read_device_identification("extended")[0x80] == b"\x01\x02"
        assert unit.read_exception_status() == 0x5A
        assert unit.report_server_id() == b"known\xff"
