"""The blocking link among threads: one connection, one leader, and no thread waits longer than for its own call."""

import threading
import time
from collections.abc import Callable

import pytest
from handlers import HeldReplies, ScriptedHandler

import busway
from busway.client.connector import TcpConnector
from busway.testing import FaultyServer, faulty_server, known_device

AMPLE = 5.0
ANY_PORT = "tcp://127.0.0.1:0"


class Together:
    """Threads that run functions; what they raise is kept.

    Attributes:
        outcomes: what each gave or raised, by position.
    """

    def __init__(self, *functions: Callable[[], object]) -> None:
        self.outcomes: list[object] = [None] * len(functions)
        self.threads = [
            threading.Thread(target=self._run, args=(number, function)) for number, function in enumerate(functions)
        ]
        for thread in self.threads:
            thread.start()

    def _run(self, number: int, function: Callable[[], object]) -> None:
        try:
            self.outcomes[number] = function()
        except BaseException as error:
            self.outcomes[number] = error

    def join(self) -> list[object]:
        """Wait for all of them; their outcomes."""
        for thread in self.threads:
            thread.join(10)
            assert not thread.is_alive(), "a thread hangs"
        return self.outcomes


# --- threads on one link -------------------------------------------------------------------------


@pytest.mark.clause("T8")
@pytest.mark.parametrize("limit", [1, 4, 16])
def test_threads_share_one_connection_and_each_gets_its_own_data(limit: int) -> None:
    with (
        faulty_server(known_device(), "foreign-transaction", "dribble", piece=5, pause=0.0) as server,
        busway.connect(server.endpoint, timeout=AMPLE, max_transactions=limit) as link,
    ):

        def ask(first: int) -> list[int]:
            unit = link.unit(1)
            return [unit.read_holding_registers(address, count=1)[0] for address in range(first, first + 20)]

        outcomes = Together(*(lambda first=100 * number: ask(first) for number in range(8))).join()  # type: ignore[misc]
        assert outcomes == [list(range(100 * number, 100 * number + 20)) for number in range(8)]
        assert server.accepted == 1
        assert link.counters.timeouts == link.counters.retries == 0


def test_first_requests_of_many_threads_make_one_connection() -> None:
    with faulty_server(known_device()) as server, busway.connect(server.endpoint, timeout=AMPLE) as link:
        outcomes = Together(
            *(lambda number=number: link.unit(1).read_holding_registers(number, count=1) for number in range(16))  # type: ignore[misc]
        ).join()
        assert outcomes == [[number] for number in range(16)]
        assert server.accepted == 1


@pytest.mark.alone
def test_thread_that_waits_long_does_not_keep_others_from_their_replies_or_timeouts() -> None:
    held_replies = HeldReplies()
    with (
        busway.serve_in_thread(ANY_PORT, responder=ScriptedHandler(held_replies.decide)) as server,
        busway.connect(server.endpoints[0], max_transactions=4, retries=0) as link,
    ):
        unit = link.unit(1)
        long = Together(lambda: unit.read_holding_registers(1000, count=1, timeout=2.0))
        _until(lambda: link.counters.requests == 1)  # it leads now, and waits
        assert unit.read_holding_registers(5, count=1, timeout=AMPLE) == [5]
        begin = time.monotonic()
        with pytest.raises(busway.NoReply):
            unit.read_holding_registers(1001, count=1, timeout=0.05)
        assert time.monotonic() - begin < 0.4
        (outcome,) = long.join()
        assert isinstance(outcome, busway.NoReply)


def _until(condition: Callable[[], bool]) -> None:
    """Turn until another thread has come so far."""
    end = time.monotonic() + AMPLE
    while not condition():
        assert time.monotonic() < end, "it did not happen"


def test_when_the_leader_is_done_another_thread_takes_over() -> None:
    held_replies = HeldReplies()
    with (
        busway.serve_in_thread(ANY_PORT, responder=ScriptedHandler(held_replies.decide)) as server,
        busway.connect(server.endpoints[0], max_transactions=4, retries=0, recycle_after_timeouts=100) as link,
    ):
        unit = link.unit(1)
        leader = Together(lambda: unit.read_holding_registers(1000, count=1, timeout=0.1))
        _until(lambda: link.counters.requests == 1)
        others = Together(
            *(lambda number=number: unit.read_holding_registers(number, count=1, timeout=AMPLE) for number in range(6))  # type: ignore[misc]
        )
        assert others.join() == [[number] for number in range(6)]
        assert isinstance(leader.join()[0], busway.NoReply)


@pytest.mark.alone
def test_call_beyond_the_bound_of_the_queue_is_refused() -> None:
    with (
        faulty_server(known_device(), "wedged") as server,
        busway.connect(server.endpoint, queue=2, timeout=0.3, retries=0, recycle_after_timeouts=100) as link,
    ):
        unit = link.unit(1)
        first = Together(lambda: unit.read_holding_registers(0, count=1))
        server.wait_until(lambda: len(server.requests) == 1)
        waiting = Together(*(lambda: unit.read_holding_registers(1, count=1, deadline=0.2) for _ in range(2)))
        _until(lambda: _queued(link) == 2)
        with pytest.raises(busway.Overloaded):
            unit.read_holding_registers(2, count=1)
        assert all(isinstance(one, busway.NoReply) for one in (*first.join(), *waiting.join()))
        assert len(server.requests) == 1


def test_a_call_that_finds_the_queue_full_is_not_cancelled_and_leaves_the_deadlines_of_others_alone() -> None:
    held_replies = HeldReplies()
    with (
        busway.serve_in_thread(ANY_PORT, responder=ScriptedHandler(held_replies.decide)) as server,
        busway.connect(server.endpoints[0], queue=1, timeout=AMPLE, retries=0) as link,
    ):
        unit = link.unit(1)
        first = Together(lambda: unit.read_holding_registers(1000, count=1, timeout=2.0))
        _until(lambda: link.counters.requests == 1)
        waiting = Together(lambda: unit.read_holding_registers(1, count=1, deadline=0.3))
        _until(lambda: _queued(link) == 1)
        with pytest.raises(busway.Overloaded):
            unit.read_holding_registers(2, count=1, deadline=AMPLE)
        assert link.counters.cancelled == 0
        began = time.monotonic()
        assert isinstance(waiting.join()[0], busway.NoReply)
        assert time.monotonic() - began < 1.5  # by its deadline, and not when the first had its timeout
        assert isinstance(first.join()[0], busway.NoReply)


def _queued(link: busway.BlockingLink) -> int:
    return link._link.session.queued


@pytest.mark.alone
def test_deadline_counts_the_time_in_the_queue() -> None:
    with (
        faulty_server(known_device(), "wedged") as server,
        busway.connect(server.endpoint, timeout=0.3, retries=0) as link,
    ):
        first = Together(lambda: link.unit(1).read_holding_registers(0, count=1))
        server.wait_until(lambda: len(server.requests) == 1)
        begin = time.monotonic()
        with pytest.raises(busway.NoReply, match="nothing was sent"):
            link.unit(1).write_single_register(1, 1, deadline=0.05)
        assert time.monotonic() - begin < 0.25
        first.join()
        assert len(server.requests) == 1


# --- ends ----------------------------------------------------------------------------------------


@pytest.mark.clause("T37")
def test_closing_a_link_wakes_the_threads_that_wait_at_once() -> None:
    with faulty_server(known_device(), "wedged") as server:
        link = busway.connect(server.endpoint, timeout=8, retries=0)
        waiting = Together(
            lambda: link.unit(1).read_holding_registers(0, count=1),
            lambda: link.unit(1).read_holding_registers(1, count=1),
        )
        server.wait_until(lambda: len(server.requests) == 1)
        _until(lambda: _queued(link) == 1)
        begin = time.monotonic()
        link.close()
        outcomes = waiting.join()
        assert time.monotonic() - begin < 2
        assert all(isinstance(one, busway.LinkDown) for one in outcomes)
        server.wait_until(lambda: server.connections == 0)


def test_interrupt_while_waiting_leaves_the_link_usable(monkeypatch: pytest.MonkeyPatch) -> None:
    with faulty_server(known_device()) as server, busway.connect(server.endpoint, timeout=AMPLE) as link:
        link.unit(1).read_holding_registers(0, count=1)
        with monkeypatch.context() as patch:
            patch.setattr("busway.client.blocking_link.SocketReadiness.wait", _interrupted)
            with pytest.raises(KeyboardInterrupt):
                link.unit(1).read_holding_registers(1, count=1)
        assert link.unit(1).read_holding_registers(2, count=1) == [2]
        assert link.counters.cancelled == 1
        assert link.counters.foreign_replies == 0


def test_interrupt_while_connecting_leaves_the_link_usable(monkeypatch: pytest.MonkeyPatch) -> None:
    with faulty_server(known_device()) as server, busway.connect(server.endpoint, timeout=AMPLE) as link:
        with monkeypatch.context() as patch:
            patch.setattr(TcpConnector, "dial", _interrupted)
            with pytest.raises(KeyboardInterrupt):
                link.unit(1).read_holding_registers(1, count=1)
        assert link.unit(1).read_holding_registers(2, count=1, deadline=AMPLE) == [2]
        assert [one.pdu[2] for one in server.requests] == [2]


def _interrupted(*arguments: object) -> bool:
    raise KeyboardInterrupt


# --- sharing -------------------------------------------------------------------------------------


@pytest.mark.clause("T8")
def test_links_of_one_process_share_a_connection_until_the_last_is_closed() -> None:
    with faulty_server(known_device()) as server:
        first = busway.connect(server.endpoint)
        second = busway.connect(server.endpoint)
        assert first.unit(1).read_holding_registers(1, count=1) == [1]
        assert second.unit(1).read_holding_registers(2, count=1) == [2]
        first.close()
        assert second.unit(1).read_holding_registers(3, count=1) == [3]
        assert (server.accepted, server.connections) == (1, 1)
        second.close()
        server.wait_until(lambda: server.connections == 0)


@pytest.mark.clause("T5")
def test_links_that_are_not_shared_have_a_connection_each() -> None:
    with (
        faulty_server(known_device()) as server,
        busway.connect(server.endpoint, shared=False) as first,
        busway.connect(server.endpoint, shared=False) as second,
    ):
        for link in (first, second):
            link.unit(1).read_holding_registers(1, count=1)
        assert server.connections == 2


@pytest.mark.clause("T8")
def test_other_settings_of_the_connection_are_refused_by_name_and_those_of_calls_are_not() -> None:
    with faulty_server(known_device()) as server, busway.connect(server.endpoint, max_transactions=2) as link:
        for name, value in (("max_transactions", 3), ("connect_timeout", 1.0), ("request_gap", 0.1)):
            options = {"max_transactions": 2, name: value}
            with pytest.raises(busway.ConfigError, match="open already") as caught:
                busway.connect(server.endpoint, **options)
            assert caught.value.key == name
        with busway.connect(server.endpoint, max_transactions=2, timeout=9, retries=7) as other:
            assert other.unit(1).read_holding_registers(1, count=1) == [1]
        assert link.unit(1).read_holding_registers(1, count=1) == [1]
        assert server.accepted == 1


async def test_blocking_and_asyncio_links_have_a_connection_each() -> None:
    async with FaultyServer(known_device()) as server, busway.open(server.endpoint) as link:
        await link.unit(1).read_holding_registers(1, count=1)
        blocking = busway.connect(server.endpoint)
        blocking.close()
        assert server.accepted == 1


def test_a_call_goes_on_as_soon_as_the_connection_that_another_thread_makes_by_name_is_there(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    dial, may_connect, is_connecting = TcpConnector.dial, threading.Event(), threading.Event()

    def slow_dial(connector: TcpConnector) -> object:
        is_connecting.set()
        may_connect.wait(10)
        return dial(connector)

    monkeypatch.setattr(TcpConnector, "dial", slow_dial)
    monkeypatch.setattr("busway.client.blocking_link._LOOK", 30.0)  # so nothing but the wakeup helps
    read: list[list[int]] = []
    with faulty_server(known_device()) as server, busway.connect(server.endpoint, timeout=60.0) as link:
        connecting = threading.Thread(target=link.connect, daemon=True)
        connecting.start()
        assert is_connecting.wait(10)
        reading = threading.Thread(
            target=lambda: read.append(link.unit(1).read_holding_registers(7, count=1)), daemon=True
        )
        reading.start()
        while not any(each.queued for each in busway.local_connections()):
            time.sleep(0.001)
        may_connect.set()
        for thread in (connecting, reading):
            thread.join(10)
    assert read == [[7]]
