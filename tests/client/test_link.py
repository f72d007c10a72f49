"""The asyncio link where several things happen at once: sharing, queueing, cancelling, closing."""

import asyncio
import threading

import pytest
from handlers import HeldReplies, ScriptedHandler, later, registers
from waiting import until

import busway
from busway.testing import FaultyServer, faulty_server, known_device

ANY_PORT = "tcp://127.0.0.1:0"


def _reply(context: busway.RequestContext, value: int) -> None:
    context.reply(registers(value))


# --- several at once -----------------------------------------------------------------------------


@pytest.mark.clause("T9")
@pytest.mark.clause("T23")
async def test_requests_fill_the_connection_to_its_limit_and_replies_may_come_in_any_order() -> None:
    handler = ScriptedHandler(later)
    async with (
        busway.serve(ANY_PORT, responder=handler) as server,
        busway.open(server.endpoints[0], max_transactions=4, timeout=30) as link,
    ):
        unit = link.unit(1)
        reads = [asyncio.create_task(unit.read_holding_registers(address, count=1)) for address in range(6)]
        await until(lambda: len(handler.contexts) == 4)
        for _ in range(20):
            await asyncio.sleep(0)
        assert len(handler.contexts) == 4
        for position in (3, 1, 0, 2):
            _reply(handler.contexts[position], position)
        await until(lambda: len(handler.contexts) == 6)
        _reply(handler.contexts[5], 5)
        _reply(handler.contexts[4], 4)
        assert await asyncio.gather(*reads) == [[0], [1], [2], [3], [4], [5]]


async def test_call_beyond_the_bound_of_the_queue_is_refused_and_nothing_of_it_is_sent() -> None:
    handler = ScriptedHandler(later)
    async with (
        busway.serve(ANY_PORT, responder=handler) as server,
        busway.open(server.endpoints[0], queue=2, timeout=30) as link,
    ):
        await link.connect()  # while there is no connection, the first request waits in the queue too
        unit = link.unit(1)
        reads = [asyncio.create_task(unit.read_holding_registers(address, count=1)) for address in range(3)]
        await until(lambda: len(handler.contexts) == 1)
        with pytest.raises(busway.Overloaded) as caught:
            await unit.read_holding_registers(3, count=1)
        assert (caught.value.endpoint, caught.value.unit) == (server.endpoints[0], 1)
        assert link.counters.overloaded == 1
        for number in range(3):
            await until(lambda number=number: len(handler.contexts) == number + 1)  # type: ignore[misc]
            _reply(handler.contexts[number], number)
        assert await asyncio.gather(*reads) == [[0], [1], [2]]
        assert len(handler.contexts) == 3


async def test_write_of_a_task_goes_before_its_reads_of_other_units_and_tasks_take_turns() -> None:
    order: list[tuple[int, str]] = []
    first = asyncio.Event()
    handler = ScriptedHandler(later)
    async with (
        busway.serve(ANY_PORT, responder=handler) as server,
        busway.open(server.endpoints[0], timeout=30) as link,
    ):
        blocker = asyncio.create_task(link.unit(9).read_holding_registers(0, count=1))
        await until(lambda: len(handler.contexts) == 1)

        async def many(unit: int) -> None:
            requests = [busway.ReadHoldingRegisters(address, 1) for address in range(2)]
            await link.unit(unit).execute_many(requests)
            order.append((unit, "done"))
            first.set()

        tasks = [asyncio.create_task(many(unit)) for unit in (1, 2)]
        await asyncio.sleep(0)
        await asyncio.sleep(0)
        for number in range(5):
            await until(lambda number=number: len(handler.contexts) == number + 1)  # type: ignore[misc]
            _reply(handler.contexts[number], 0)
        await asyncio.gather(blocker, *tasks)
    assert [context.unit for context in handler.contexts] == [9, 1, 2, 1, 2]


# --- cancelling ----------------------------------------------------------------------------------


async def test_cancelled_request_in_flight_keeps_its_place_and_its_reply_is_given_to_no_call() -> None:
    handler = ScriptedHandler(later)
    async with (
        busway.serve(ANY_PORT, responder=handler) as server,
        busway.open(server.endpoints[0], timeout=30) as link,
    ):
        unit = link.unit(1)
        cancelled = asyncio.create_task(unit.read_holding_registers(111, count=1))
        await until(lambda: len(handler.contexts) == 1)
        cancelled.cancel()
        with pytest.raises(asyncio.CancelledError):
            await cancelled
        following = asyncio.create_task(unit.read_holding_registers(222, count=1))
        for _ in range(20):
            await asyncio.sleep(0)
        assert len(handler.contexts) == 1  # the device still works on the first one
        _reply(handler.contexts[0], 111)
        await until(lambda: len(handler.contexts) == 2)
        _reply(handler.contexts[1], 222)
        assert await following == [222]
        counters = link.counters
        assert (counters.cancelled, counters.foreign_replies, counters.late_replies) == (1, 0, 0)
        assert counters.connections == 1


async def test_place_of_a_cancelled_request_is_free_after_its_time() -> None:
    handler = ScriptedHandler(later)
    async with (
        busway.serve(ANY_PORT, responder=handler) as server,
        busway.open(server.endpoints[0], timeout=0.05) as link,
    ):
        unit = link.unit(1)
        cancelled = asyncio.create_task(unit.read_holding_registers(111, count=1))
        await until(lambda: len(handler.contexts) == 1)
        cancelled.cancel()
        following = asyncio.create_task(unit.read_holding_registers(222, count=1, timeout=10))
        await until(lambda: len(handler.contexts) == 2)
        _reply(handler.contexts[0], 111)  # late, and not for the request that is in flight now
        _reply(handler.contexts[1], 222)
        assert await following == [222]
        assert link.counters.late_replies == 1


async def test_cancelled_request_in_the_queue_is_never_sent() -> None:
    handler = ScriptedHandler(later)
    async with (
        busway.serve(ANY_PORT, responder=handler) as server,
        busway.open(server.endpoints[0], timeout=30) as link,
    ):
        unit = link.unit(1)
        reads = [asyncio.create_task(unit.read_holding_registers(address, count=1)) for address in range(3)]
        await until(lambda: len(handler.contexts) == 1)
        reads[1].cancel()
        await asyncio.sleep(0)
        _reply(handler.contexts[0], 0)
        await until(lambda: len(handler.contexts) == 2)
        _reply(handler.contexts[1], 2)
        assert await reads[0] == [0]
        assert await reads[2] == [2]
        assert len(handler.contexts) == 2
        assert link.counters.requests == 2


async def test_cancelled_batch_sends_no_more_and_later_calls_get_their_own_data() -> None:
    held_replies = HeldReplies()
    handler = ScriptedHandler(held_replies.decide)
    async with (
        busway.serve(ANY_PORT, responder=handler) as server,
        busway.open(server.endpoints[0], timeout=30, max_transactions=4) as link,
    ):
        unit = link.unit(1)
        requests = [busway.ReadHoldingRegisters(1000 + number, 1) for number in range(50)]
        batch = asyncio.create_task(unit.execute_many(requests))
        await until(lambda: len(handler.contexts) == 4)
        batch.cancel()
        with pytest.raises(asyncio.CancelledError):
            await batch
        held_replies.opened.set()
        assert await unit.read_holding_registers(7, count=1) == [7]
        assert len(handler.contexts) == 5


async def test_cancelling_while_the_connection_is_made_leaves_the_link_usable() -> None:
    async with FaultyServer(known_device()) as server, busway.open(server.endpoint) as link:
        cancelled = asyncio.create_task(link.unit(1).read_holding_registers(1, count=1))
        await asyncio.sleep(0)
        cancelled.cancel()
        with pytest.raises(asyncio.CancelledError):
            await cancelled
        assert await link.unit(1).read_holding_registers(2, count=1) == [2]
        assert [one.pdu[2] for one in server.requests] == [2]
        assert server.accepted == 1


async def test_thousand_cancellations_at_random_moments_never_bring_foreign_data() -> None:
    async with (
        FaultyServer(known_device(), seed=3) as server,
        busway.open(server.endpoint, max_transactions=3, timeout=5) as link,
    ):
        unit = link.unit(1)
        for number in range(1000):
            address = number % 900
            task = asyncio.create_task(unit.read_holding_registers(address, count=1))
            for _ in range(number % 7):
                await asyncio.sleep(0)
            task.cancel()
            outcome = (await asyncio.gather(task, return_exceptions=True))[0]
            assert isinstance(outcome, asyncio.CancelledError) or outcome == [address]
        assert await unit.read_holding_registers(5, count=1) == [5]
        assert link.counters.foreign_replies == link.counters.timeouts == 0


# --- deadlines -----------------------------------------------------------------------------------


async def test_deadline_counts_the_time_in_the_queue_and_what_was_not_sent_is_never_sent() -> None:
    handler = ScriptedHandler(later)
    async with (
        busway.serve(ANY_PORT, responder=handler) as server,
        busway.open(server.endpoints[0], timeout=30) as link,
    ):
        unit = link.unit(1)
        first = asyncio.create_task(unit.read_holding_registers(0, count=1))
        await until(lambda: len(handler.contexts) == 1)
        with pytest.raises(busway.NoReply, match="nothing was sent"):
            await unit.write_single_register(1, 1, deadline=0.05)
        _reply(handler.contexts[0], 0)
        assert await first == [0]
        assert len(handler.contexts) == 1


# --- sharing -------------------------------------------------------------------------------------


@pytest.mark.clause("T8")
async def test_links_of_one_loop_to_one_endpoint_share_a_connection_until_the_last_is_closed() -> None:
    async with FaultyServer(known_device()) as server:
        first = busway.open(server.endpoint)
        second = busway.open(server.endpoint)
        assert await first.unit(1).read_holding_registers(1, count=1) == [1]
        assert await second.unit(2).read_holding_registers(2, count=1) == [2]
        assert server.accepted == 1
        await first.close()
        assert await second.unit(1).read_holding_registers(3, count=1) == [3]
        with pytest.raises(busway.LinkClosed):
            await first.unit(1).read_holding_registers(3, count=1)
        assert server.connections == 1
        await second.close()
        await server.until(lambda: server.connections == 0)
        assert server.accepted == 1


@pytest.mark.clause("T5")
async def test_links_that_are_not_shared_have_a_connection_each() -> None:
    async with FaultyServer(known_device()) as server:
        links = [busway.open(server.endpoint, shared=False) for _ in range(3)]
        for link in links:
            await link.unit(1).read_holding_registers(1, count=1)
        assert server.connections == 3
        for link in links:
            await link.close()
        await server.until(lambda: server.connections == 0)


@pytest.mark.clause("T8")
async def test_other_settings_of_the_connection_are_refused_by_name_and_those_of_calls_are_not() -> None:
    async with FaultyServer(known_device()) as server, busway.open(server.endpoint, max_transactions=2) as link:
        for name, value in (("max_transactions", 3), ("connect_timeout", 1.0), ("request_gap", 0.1)):
            options = {"max_transactions": 2, name: value}
            with pytest.raises(busway.ConfigError, match="open already") as caught:
                await busway.open(server.endpoint, **options).connect()
            assert caught.value.key == name
        other = busway.open(server.endpoint, max_transactions=2, timeout=9, retries=7, deadline=3)
        assert await other.unit(1).read_holding_registers(1, count=1) == [1]
        assert await link.unit(1).read_holding_registers(1, count=1) == [1]
        assert server.accepted == 1
        await other.close()


async def test_loops_of_other_threads_have_links_of_their_own() -> None:
    async with FaultyServer(known_device()) as server, busway.open(server.endpoint) as link:
        await link.unit(1).read_holding_registers(1, count=1)
        found: list[list[int]] = []

        async def elsewhere() -> None:
            async with busway.open(server.endpoint) as other:
                found.append(await other.unit(1).read_holding_registers(2, count=1))

        thread = threading.Thread(target=lambda: asyncio.run(elsewhere()))
        thread.start()
        await asyncio.to_thread(thread.join)
        assert found == [[2]]
        assert server.accepted == 2


# --- ends ----------------------------------------------------------------------------------------


@pytest.mark.clause("T37")
async def test_closing_a_link_ends_what_is_under_way_and_what_waits() -> None:
    handler = ScriptedHandler(later)
    async with busway.serve(ANY_PORT, responder=handler) as server:
        link = busway.open(server.endpoints[0], timeout=30)
        unit = link.unit(1)
        read = asyncio.create_task(unit.read_holding_registers(0, count=1))
        write = asyncio.create_task(unit.write_single_register(0, 1))
        await until(lambda: len(handler.contexts) == 1)
        await link.close()
        with pytest.raises(busway.LinkDown, match="closed"):
            await read
        with pytest.raises(busway.LinkDown, match="closed"):
            await write  # it was never sent
        _reply(handler.contexts[0], 0)
        await until(lambda: not server.status().connections)


async def test_closing_a_link_while_it_connects_ends_its_calls() -> None:
    async with FaultyServer(known_device()) as server:
        link = busway.open(server.endpoint)
        read = asyncio.create_task(link.unit(1).read_holding_registers(0, count=1))
        await asyncio.sleep(0)
        await link.close()
        with pytest.raises(busway.LinkDown):
            await read


async def test_caller_that_waits_for_a_connection_by_name_may_be_cancelled() -> None:
    async with FaultyServer(known_device()) as server, busway.open(server.endpoint) as link:
        connecting = asyncio.create_task(link.connect())
        await asyncio.sleep(0)
        connecting.cancel()
        with pytest.raises(asyncio.CancelledError):
            await connecting
        assert await link.unit(1).read_holding_registers(1, count=1) == [1]
        assert server.accepted == 1


async def _read_once(link: busway.AsyncLink) -> list[int]:
    async with link:
        return await link.unit(1).read_holding_registers(3, count=1)


def test_asyncio_link_may_be_made_before_its_loop_and_needs_one_when_it_is_used() -> None:
    with faulty_server(known_device()) as server:
        link = busway.open(server.endpoint)
        assert (link.is_connected, link.state, link.counters.requests) == (False, "down", 0)
        waiting = link.unit(1).read_holding_registers(3, count=1)
        with pytest.raises(busway.ConfigError, match="used in coroutines"):
            waiting.send(None)
        assert asyncio.run(_read_once(link)) == [3]
