"""NumberMaxOfClientTransaction for a whole client: one limit for all its links, shared in turn."""

import asyncio
import threading

import pytest
from handlers import ScriptedHandler, later, registers
from waiting import until

import busway
from busway.session.responder import ServedUnit
from busway.testing import faulty_server, known_device

AMPLE = 5.0
ANY_PORT = "tcp://127.0.0.1:0"


@pytest.mark.clause("T23")
@pytest.mark.parametrize("limit", [1, 2])
async def test_links_of_a_loop_have_one_limit_together_and_take_turns(limit: int) -> None:
    handlers = [ScriptedHandler(later), ScriptedHandler(later)]
    async with (
        busway.serve(ANY_PORT, responder=handlers[0]) as one,
        busway.serve(ANY_PORT, responder=handlers[1]) as two,
    ):
        links = [
            busway.open(server.endpoints[0], scope="client", max_transactions=limit, timeout=30)
            for server in (one, two)
        ]
        for link in links:
            await link.connect()
        reads = [
            asyncio.create_task(link.unit(1).read_holding_registers(address, count=1))
            for link in links
            for address in range(4)
        ]
        answered = [0, 0]
        order = []
        while sum(answered) < 8:
            open_now = min(limit, 8 - sum(answered))
            await until(lambda n=open_now: sum(len(one.contexts) for one in handlers) - sum(answered) == n)  # type: ignore[misc]
            number = next(at for at in (0, 1) if len(handlers[at].contexts) > answered[at])
            handlers[number].contexts[answered[number]].reply(registers(answered[number]))
            answered[number] += 1
            order.append(number)
        assert [values for (values,) in await asyncio.gather(*reads)] == [0, 1, 2, 3] * 2
        if limit == 1:
            assert order[1:7] in ([1, 0, 1, 0, 1, 0], [0, 1, 0, 1, 0, 1])
        for link in links:
            await link.close()


@pytest.mark.clause("T23")
async def test_a_timeout_and_a_closed_link_give_their_places_back() -> None:
    with faulty_server(known_device(), "wedged") as dead, faulty_server(known_device()) as alive:
        silent = busway.open(dead.endpoint, scope="client", timeout=0.05, retries=0)
        link = busway.open(alive.endpoint, scope="client", timeout=AMPLE)
        await link.connect()
        lost = asyncio.create_task(silent.unit(1).read_holding_registers(0, count=1))
        await until(lambda: dead.requests)
        assert await link.unit(1).read_holding_registers(5, count=1) == [5]
        assert isinstance((await asyncio.gather(lost, return_exceptions=True))[0], busway.NoReply)
        lost = asyncio.create_task(silent.unit(1).read_holding_registers(0, count=1, timeout=30))
        await until(lambda: len(dead.requests) == 2)
        waiting = asyncio.create_task(link.unit(1).read_holding_registers(6, count=1))
        await asyncio.sleep(0)
        await silent.close()
        assert await waiting == [6]
        assert isinstance((await asyncio.gather(lost, return_exceptions=True))[0], busway.LinkDown)
        await link.close()


class _Working:
    """A handler that knows how many requests are worked on at once, by all servers that have it."""

    functions = busway.STANDARD
    generation = 0

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._now = 0
        self.most = 0

    def serves(self, unit: int) -> ServedUnit | None:
        return ServedUnit(unit)

    async def answer(self, context: busway.RequestContext, request: object) -> busway.Message:
        with self._lock:
            self._now += 1
            self.most = max(self.most, self._now)
        await asyncio.sleep(0.002)  # what a device needs for it
        with self._lock:
            self._now -= 1
        return registers(request.address)  # type: ignore[attr-defined]


@pytest.mark.clause("T23")
def test_blocking_links_of_a_process_have_one_limit_together() -> None:
    handler = _Working()
    with (
        busway.serve_in_thread(ANY_PORT, responder=handler) as one,  # type: ignore[arg-type]
        busway.serve_in_thread(ANY_PORT, responder=handler) as two,  # type: ignore[arg-type]
        busway.connect(one.endpoints[0], scope="client", max_transactions=2, timeout=AMPLE) as first,
        busway.connect(two.endpoints[0], scope="client", max_transactions=2, timeout=AMPLE) as second,
    ):
        found: list[list[int]] = []

        def ask(link: busway.BlockingLink, base: int) -> None:
            for address in range(base, base + 10):
                found.append(link.unit(1).read_holding_registers(address, count=1))

        threads = [
            threading.Thread(target=ask, args=(link, 100 * number))
            for number, link in enumerate((first, second, first, second))
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(20)
            assert not thread.is_alive()
        assert sorted(value for (value,) in found) == [100 * base + n for base in range(4) for n in range(10)]
        assert handler.most == 2


@pytest.mark.clause("T23")
def test_blocking_links_wait_no_longer_for_a_place_than_the_one_before_them_takes() -> None:
    with (
        faulty_server(known_device(), "wedged") as dead,
        faulty_server(known_device()) as alive,
        busway.connect(dead.endpoint, scope="client", timeout=0.1, retries=0) as silent,
        busway.connect(alive.endpoint, scope="client", timeout=AMPLE) as link,
    ):
        link.connect()
        outcomes: list[object] = []

        def wait_in_vain() -> None:
            try:
                silent.unit(1).read_holding_registers(0, count=1)
            except busway.NoReply as error:
                outcomes.append(error)

        thread = threading.Thread(target=wait_in_vain)
        thread.start()
        dead.wait_until(lambda: dead.requests)
        assert link.unit(1).read_holding_registers(5, count=1) == [5]
        thread.join(10)
        assert len(outcomes) == 1


@pytest.mark.clause("T23")
async def test_a_client_has_one_limit_until_its_last_link_is_closed() -> None:
    with faulty_server(known_device()) as one, faulty_server(known_device()) as two:
        first = busway.open(one.endpoint, scope="client", max_transactions=2)
        await first.unit(1).read_holding_registers(0, count=1)
        with pytest.raises(busway.ConfigError, match="others are open with 2") as caught:
            await busway.open(two.endpoint, scope="client", max_transactions=3).connect()
        assert caught.value.key == "max_transactions"
        async with busway.open(two.endpoint, max_transactions=3) as free:  # its limit is its own
            await free.unit(1).read_holding_registers(0, count=1)
        await first.close()
        async with busway.open(two.endpoint, scope="client", max_transactions=3) as second:
            await second.unit(1).read_holding_registers(0, count=1)


@pytest.mark.parametrize("scope", ["server", "process", ""])
def test_a_scope_that_cannot_be_is_refused(scope: str) -> None:
    with pytest.raises(busway.ConfigError) as caught:
        busway.open("tcp://127.0.0.1", scope=scope)
    assert caught.value.key == "scope"
