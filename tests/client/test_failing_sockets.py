"""A socket that fails at every operation in turn, in every way: what belongs to a connection dies with it.

Of each call: it ends in time, with a reply or an error of the library that is true; no byte of it leaves after that;
no write is executed twice; and what reaches the device are whole requests, but for the last of a connection.
"""

import asyncio
import random
import socket
import struct
import threading
import time
from collections.abc import Callable, Coroutine, Iterator, Sequence
from contextlib import suppress
from itertools import count
from typing import Any

import pytest
from failing_sockets import UNANSWERED, Fault, Wire, WireConnector, connected_by
from hypothesis import given
from hypothesis import strategies as st
from waiting import wait_until

import busway
from busway.pdu.message import Message, Request

ENDPOINT = "tcp://127.0.0.1:9"
SHORT = 0.03
"""Seconds that an attempt may take: so long a run waits where a socket is stuck."""
IN_TIME = 10.0
"""Seconds for a whole run, whatever fails in it: far more than all its timeouts."""

OPTIONS: dict[str, dict[str, Any]] = {
    "one transaction": {"max_transactions": 1},
    "several transactions": {"max_transactions": 4},
    "a segment for each request": {"max_transactions": 4, "single_adu_segments": True},
    "a deadline": {"max_transactions": 4, "deadline": SHORT / 2, "single_adu_segments": True},
    "held per request": {"max_transactions": 4, "hold": "request"},
}
USUAL: dict[str, Any] = {
    "shared": False,
    "timeout": SHORT,
    "reconnect_first": 0.001,
    "reconnect_most": 0.002,
    "connect_timeout": 1.0,
}


class Run:
    """Calls of one run, and whether what became of each is true.

    Attributes:
        wire: what they go over.
        outcomes: replies and errors by the number of their request.
    """

    def __init__(self, wire: Wire) -> None:
        self.wire = wire
        self.outcomes: dict[int, Any] = {}
        self._numbers = count(1)
        self._writes: set[int] = set()
        self._lock = threading.Lock()

    def requests(self, kinds: str) -> tuple[list[Request], list[int]]:
        """Requests with their numbers: ``w`` is a write, ``r`` a read."""
        with self._lock:
            numbers = [next(self._numbers) for _ in kinds]
            self._writes.update(number for number, kind in zip(numbers, kinds, strict=True) if kind == "w")
        requests: list[Request] = [
            busway.WriteSingleRegister(0, number) if kind == "w" else busway.ReadHoldingRegisters(number, 1)
            for number, kind in zip(numbers, kinds, strict=True)
        ]
        return requests, numbers

    def ended(self, numbers: Sequence[int], outcomes: Sequence[Any]) -> None:
        """A call has ended, with one outcome for each of its requests."""
        self.wire.end(*numbers)
        assert len(numbers) == len(outcomes)
        self.outcomes.update(zip(numbers, outcomes, strict=True))

    def check(self) -> None:
        """Nothing was said that is not true."""
        wire = self.wire
        assert not wire.late, f"left after their calls had ended: {wire.late}"
        assert not wire.broken, f"no request: {wire.broken}"
        assert max(wire.executed.values(), default=0) <= 1, wire.executed
        for number, outcome in self.outcomes.items():
            if number in self._writes:
                self._check_write(number, outcome)
            else:
                self._check_read(number, outcome)

    def _check_write(self, number: int, outcome: Any) -> None:
        executed = self.wire.executed[number]
        if isinstance(outcome, Message):
            assert executed == 1
        elif not isinstance(outcome, busway.WriteOutcomeUnknown | asyncio.CancelledError):
            assert isinstance(outcome, busway.ModbusError), repr(outcome)
            assert not executed
            assert number not in self.wire.touched, f"a part left, and its call ended as {outcome!r}"

    def _check_read(self, number: int, outcome: Any) -> None:
        if isinstance(outcome, busway.ReadHoldingRegisters.Reply):
            assert outcome.registers == [number]
        else:
            assert isinstance(outcome, busway.LinkDown | busway.NoReply | asyncio.CancelledError), repr(outcome)


def one_after_the_other(run: Run, link: busway.BlockingLink) -> None:
    """Calls of a thread."""
    unit = link.unit(1)
    for kinds in ("w", "r", "rwrwrr", "w", "rrrr", "r"):
        requests, numbers = run.requests(kinds)
        outcomes: Sequence[Any]
        try:
            outcomes = unit.execute_many(requests, return_errors=True)
        except Exception as error:
            outcomes = [error] * len(numbers)
        run.ended(numbers, outcomes)


async def call(run: Run, link: busway.AsyncLink, kinds: str) -> None:
    """A call of a coroutine."""
    requests, numbers = run.requests(kinds)
    outcomes: Sequence[Any]
    try:
        outcomes = await link.unit(1).execute_many(requests, return_errors=True)
    except (Exception, asyncio.CancelledError) as error:
        outcomes = [error] * len(numbers)
    run.ended(numbers, outcomes)


async def at_once(run: Run, link: busway.AsyncLink) -> None:
    """Calls of coroutines, some of them at once."""
    for calls in (("w",), ("r", "w", "rwrr", "w"), ("rrrr", "r", "w")):
        await asyncio.gather(*[call(run, link, kinds) for kinds in calls])


async def cancelled(run: Run, link: busway.AsyncLink) -> None:
    """Calls of which some are cancelled: before they begin to leave, while they leave, and while they wait."""
    for turns in (0, 1, 2, 3, 4, 6):
        tasks = [asyncio.create_task(call(run, link, kinds)) for kinds in ("w", "rwr", "w", "r")]
        for _ in range(turns):
            await asyncio.sleep(0)
        tasks[0].cancel()
        tasks[1].cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


Program = Callable[[Run, dict[str, Any]], None]


def blocking(run: Run, options: dict[str, Any]) -> None:
    """A run of the blocking driver."""
    with connected_by(WireConnector(run.wire)), busway.connect(ENDPOINT, **USUAL, **options) as link:
        one_after_the_other(run, link)
        session = link._link.session  # type: ignore[union-attr]
        assert (session.in_flight, session.queued) == (0, 0)


def with_asyncio(
    program: Callable[[Run, busway.AsyncLink], Coroutine[Any, Any, None]], *, plain: bool = False
) -> Program:
    """Runs of the asyncio driver; ``plain``: over a transport of asyncio, and not of ours."""

    def run_it(run: Run, options: dict[str, Any]) -> None:
        async def opened() -> None:
            loop = asyncio.get_running_loop()
            loop.set_exception_handler(lambda _, context: unheard.append(context))
            async with busway.open(ENDPOINT, **USUAL, **options) as link, asyncio.timeout(IN_TIME):
                await program(run, link)

        unheard: list[Any] = []
        if plain:  # transports of asyncio lose a socket that cannot be closed
            faults = run.wire.faults.items()
            run.wire.faults = {number: fault for number, fault in faults if fault is not Fault.CLOSE_FAILS}
        with connected_by(WireConnector(run.wire, plain=plain)):
            asyncio.run(opened())
        assert not unheard

    return run_it


PROGRAMS: dict[str, Program] = {
    "blocking": blocking,
    "asyncio": with_asyncio(at_once),
    "asyncio, its own transport": with_asyncio(at_once, plain=True),
    "asyncio, cancelled": with_asyncio(cancelled),
}


def tried(program: Program, faults: dict[int, Fault], options: dict[str, Any]) -> Wire:
    """A run with faults; what it did."""
    wire = Wire(faults)
    run = Run(wire)
    began = time.monotonic()
    try:
        program(run, options)
    finally:
        wire.close()
    assert time.monotonic() - began < IN_TIME
    run.check()
    return wire


def schedules(program: Program, options: dict[str, Any]) -> Iterator[tuple[int, Fault]]:
    """Every fault at every operation of a run."""
    for number, operation in enumerate(tried(program, {}, options).operations):
        for fault in Fault:
            if fault.operation == operation:
                yield number, fault


@pytest.mark.parametrize("options", list(OPTIONS))
@pytest.mark.parametrize("program", list(PROGRAMS))
def test_whatever_fails_at_whichever_operation_no_byte_outlives_its_call(program: str, options: str) -> None:
    for number, fault in schedules(PROGRAMS[program], OPTIONS[options]):
        try:
            tried(PROGRAMS[program], {number: fault}, OPTIONS[options])
        except AssertionError as error:
            error.add_note(f"operation {number}: {fault}")
            raise


@pytest.mark.parametrize("program", list(PROGRAMS))
@given(
    faults=st.dictionaries(st.integers(0, 40), st.sampled_from(list(Fault)), max_size=8),
    options=st.sampled_from(list(OPTIONS)),
)
def test_of_several_failures_none_lets_a_byte_outlive_its_call(
    program: str, faults: dict[int, Fault], options: str
) -> None:
    tried(PROGRAMS[program], faults, OPTIONS[options])


@pytest.mark.parametrize("seed", range(20))
def test_of_eight_threads_none_leaves_a_byte_to_a_later_connection(seed: int) -> None:
    chance = random.Random(seed)
    wire = Wire({number: chance.choice(list(Fault)) for number in range(400) if chance.random() < 0.2})
    run = Run(wire)
    with (
        connected_by(WireConnector(wire)),
        busway.connect(ENDPOINT, max_transactions=8, **USUAL) as link,
    ):
        threads = [threading.Thread(target=one_after_the_other, args=(run, link)) for _ in range(8)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(IN_TIME)
            assert not thread.is_alive()
    wire.close()
    run.check()
    assert len(run.outcomes) == 8 * len("wrrwrwrrwrrrrr")


def test_what_a_thread_could_not_send_leaves_while_another_one_waits_for_its_reply() -> None:
    wire = Wire({})
    with (
        connected_by(WireConnector(wire)),
        busway.connect(ENDPOINT, max_transactions=2, shared=False, timeout=IN_TIME, retries=0) as link,
    ):
        unit = link.unit(1)
        unit.write_single_register(0, 1)
        waiting = threading.Thread(target=suppressed, args=(unit.read_holding_registers, UNANSWERED))
        waiting.start()
        wait_until(lambda: UNANSWERED in wire.touched)
        wire.faults = {len(wire.operations): Fault.BLOCKED}
        began = time.monotonic()
        unit.write_single_register(0, 2)
        assert time.monotonic() - began < IN_TIME / 2
        assert wire.operations.count("send") == 4  # of which one was refused
        link.close()
        waiting.join(IN_TIME)
        assert not waiting.is_alive()
    wire.close()


def suppressed(read: Callable[..., Any], address: int) -> None:
    """A read that may fail."""
    with suppress(busway.ModbusError):
        read(address, count=1)


def test_connecting_by_name_does_not_wait_for_the_call_of_another_thread() -> None:
    wire = Wire({})
    with (
        connected_by(WireConnector(wire)),
        busway.connect(ENDPOINT, shared=False, timeout=IN_TIME, retries=0) as link,
    ):
        waiting = threading.Thread(target=suppressed, args=(link.unit(1).read_holding_registers, UNANSWERED))
        waiting.start()
        wait_until(lambda: UNANSWERED in wire.touched)
        began = time.monotonic()
        link.connect()
        assert time.monotonic() - began < IN_TIME / 2
        assert link.is_connected
        link.close()
        waiting.join(IN_TIME)
        assert not waiting.is_alive()
    wire.close()


async def test_requests_of_one_turn_leave_before_those_that_a_reply_of_the_same_turn_makes_room_for() -> None:
    wire = Wire({})
    with connected_by(WireConnector(wire)):
        async with busway.open(ENDPOINT, max_transactions=2, shared=False, timeout=IN_TIME) as link:
            unit = link.unit(1)
            await unit.write_single_register(0, 1)
            first = asyncio.create_task(unit.write_single_register(0, 2))
            for _ in range(2):
                await asyncio.sleep(0)
            assert list(wire.touched) == [1, 2]  # and its reply comes in the turn in which the others are asked for
            await asyncio.gather(first, *[asyncio.create_task(unit.write_single_register(0, n)) for n in (3, 4)])
    wire.close()
    assert list(wire.touched) == [1, 2, 3, 4]


# --- over a network ------------------------------------------------------------------------------


class ResettingServer:
    """A device that resets its connections at random, with what it has executed.

    Attributes:
        executed: for each write the times at which it was executed, by its value.
    """

    def __init__(self, seed: int) -> None:
        self.executed: dict[int, list[float]] = {}
        self._chance = random.Random(seed)
        self._listening = socket.create_server(("127.0.0.1", 0))
        self.endpoint = f"tcp://127.0.0.1:{self._listening.getsockname()[1]}"
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        while True:
            try:
                connection, _ = self._listening.accept()
            except OSError:
                return
            with connection, suppress(OSError):
                self._converse(connection)

    def _converse(self, connection: socket.socket) -> None:
        connection.settimeout(IN_TIME)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        while True:
            frame = connection.recv(12, socket.MSG_WAITALL)
            if len(frame) < 12 or self._chance.random() < 0.1:
                return
            self.executed.setdefault(int.from_bytes(frame[10:12], "big"), []).append(time.monotonic())
            connection.sendall(frame)

    def close(self) -> None:
        """Serve no more; the connections of clients must be closed by then."""
        self._listening.shutdown(socket.SHUT_RDWR)
        self._thread.join(IN_TIME)
        self._listening.close()


def test_a_server_that_resets_at_random_executes_no_write_after_its_call_has_ended() -> None:
    server = ResettingServer(seed=1)
    values = count(1)
    ended: dict[int, float] = {}
    odd: list[Exception] = []

    def write(link: busway.BlockingLink) -> None:
        unit = link.unit(1)
        for _ in range(100):
            value = next(values)
            try:
                unit.write_single_register(0, value)
            except busway.ModbusError:
                time.sleep(0.001)  # until the next connection may be made
            except Exception as error:
                odd.append(error)
            ended[value] = time.monotonic()

    try:
        with busway.connect(
            server.endpoint, max_transactions=8, reconnect_first=0.001, reconnect_most=0.002, timeout=IN_TIME
        ) as link:
            threads = [threading.Thread(target=write, args=(link,)) for _ in range(8)]
            for thread in threads:
                thread.start()
            for thread in threads:
                thread.join(3 * IN_TIME)
                assert not thread.is_alive()
    finally:
        server.close()
    assert [value for value, times in server.executed.items() if times[-1] > ended[value]] == []
    assert [value for value, times in server.executed.items() if len(times) > 1] == []
    assert odd == []
    assert len(server.executed) > 100
