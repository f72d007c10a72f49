"""`on_state` and `disconnect` of both interfaces: what is told, and what a disconnected link does next."""

import asyncio
import logging
import threading

import pytest
from handlers import ScriptedHandler, later
from waiting import until

import busway
from busway.client.state_observers import StateObservers
from busway.session.reconnect import ConnectionState

ANY_PORT = "tcp://127.0.0.1:0"


def test_a_callback_is_told_each_change_once_until_it_is_removed() -> None:
    told: list[tuple[str, str]] = []
    observers = StateObservers(ConnectionState.DOWN)
    remove = observers.add(lambda state, reason: told.append((state, reason)))
    for state in (ConnectionState.DOWN, ConnectionState.CONNECTING, ConnectionState.UP, ConnectionState.UP):
        observers.notify(state, state.value[:2])
    remove()
    remove()
    observers.notify(ConnectionState.DOWN, "")
    assert told == [("connecting", "co"), ("up", "up")]


def test_one_function_registered_twice_is_told_twice_and_each_removal_removes_one() -> None:
    told: list[str] = []

    def note(state: str, reason: str) -> None:
        told.append(state)

    observers = StateObservers(ConnectionState.DOWN)
    remove, _ = observers.add(note), observers.add(note)
    observers.notify(ConnectionState.CONNECTING, "")
    remove()
    remove()
    observers.notify(ConnectionState.UP, "")
    assert told == ["connecting", "connecting", "up"]


def test_an_error_of_a_callback_is_logged_and_the_others_are_told(caplog: pytest.LogCaptureFixture) -> None:
    told: list[str] = []
    observers = StateObservers(ConnectionState.DOWN)
    observers.add(lambda state, reason: 1 // 0)  # type: ignore[arg-type, return-value]
    observers.add(lambda state, reason: told.append(state))
    with caplog.at_level(logging.ERROR, logger="busway.client"):
        observers.notify(ConnectionState.CONNECTING, "")
    assert told == ["connecting"]
    assert "on_state" in caplog.text


async def test_an_asyncio_link_tells_its_states_and_a_disconnected_one_connects_again() -> None:
    device = busway.Device(holding_registers=[7])
    told: list[tuple[str, str]] = []
    async with busway.serve(ANY_PORT, units={1: device}) as server, busway.open(server.endpoints[0]) as link:
        link.on_state(lambda state, reason: told.append((state, reason)))
        unit = link.unit(1)
        assert await unit.read("4x1") == 7
        await link.disconnect()
        assert not link.is_connected
        await link.disconnect()
        assert await unit.read("4x1") == 7
        assert [state for state, _ in told] == ["connecting", "up", "down", "connecting", "up"]
        assert told[2] == ("down", "the program disconnected it")
    assert told[-1][0] == "down"


async def test_disconnecting_an_asyncio_link_ends_calls_in_flight_as_a_loss_does() -> None:
    handler = ScriptedHandler(later)
    async with (
        busway.serve(ANY_PORT, responder=handler) as server,
        busway.open(server.endpoints[0], retries=0, timeout=60) as link,
    ):
        read = asyncio.create_task(link.unit(1).read("4x1"))
        await until(lambda: len(handler.contexts) == 1)
        await link.disconnect()
        with pytest.raises(busway.LinkDown) as caught:
            await read
        assert caught.value.sent
        write = asyncio.create_task(link.unit(1).write("4x1", 1))
        await until(lambda: len(handler.contexts) == 2)
        await link.disconnect()
        with pytest.raises(busway.WriteOutcomeUnknown):
            await write


async def test_an_attempt_to_connect_is_given_up_and_its_caller_gets_an_error() -> None:
    async with busway.open("tcp://127.0.0.1:9", connect_delay=0, retries=0) as link:
        with pytest.raises(busway.LinkDown):
            await link.connect()
        await link.disconnect()
        assert link.state != "up"


def test_a_blocking_link_tells_its_states_and_a_disconnected_one_connects_again() -> None:
    device = busway.Device(holding_registers=[7])
    told: list[str] = []
    with (
        busway.serve_in_thread(ANY_PORT, units={1: device}) as server,
        busway.connect(server.endpoints[0], shared=False) as link,
    ):
        remove = link.on_state(lambda state, reason: told.append(state))
        unit = link.unit(1)
        assert unit.read("4x1") == 7
        link.disconnect()
        assert not link.is_connected
        assert unit.read("4x1") == 7
        remove()
        link.disconnect()
    assert told == ["connecting", "up", "down", "connecting", "up"]


def test_disconnecting_a_blocking_link_from_another_thread_ends_its_call() -> None:
    handler = ScriptedHandler(later)
    ended: list[BaseException] = []

    def read(link: busway.BlockingLink) -> None:
        try:
            link.unit(1).read("4x1")
        except busway.ModbusError as error:
            ended.append(error)

    with (
        busway.serve_in_thread(ANY_PORT, responder=handler) as server,
        busway.connect(server.endpoints[0], shared=False, retries=0, timeout=60) as link,
    ):
        reader = threading.Thread(target=read, args=(link,))
        reader.start()
        while not handler.contexts and reader.is_alive():
            reader.join(0.01)
        link.disconnect()
        reader.join(60)
        assert not reader.is_alive()
    assert [type(error) for error in ended] == [busway.LinkDown]


def test_a_link_that_only_selects_has_no_connection_of_its_own() -> None:
    with busway.connect("tcp://127.0.0.1:9", select="first") as link:
        with pytest.raises(busway.InvalidRequest, match="no connection of its own"):
            link.disconnect()
        with pytest.raises(busway.InvalidRequest, match="no connection of its own"):
            link.on_state(print)
