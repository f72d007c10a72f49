"""Units behind one connection over TCP: one that is silent does not stall the others. In virtual time."""

import heapq
import statistics
from dataclasses import dataclass, field

import pytest

from busway.errors import NoReply, UnitSuspended
from busway.options.client import ClientParameters
from busway.options.lines import BreakerParameters
from busway.pdu.read_items import ReadHoldingRegisters
from busway.session.call import Call
from busway.session.tcp_client import TcpClientSession
from busway.session.unit_breaker import Breakers, BreakerState

DELAY = 0.0007
"""Seconds that a unit takes to answer."""


@dataclass
class Server:
    """Answers one request after the other, but for units that are silent."""

    silent: set[int] = field(default_factory=set)
    delay: float = DELAY
    asked: list[tuple[float, int]] = field(default_factory=list)

    def answers(self, adu: bytes, now: float) -> tuple[float, bytes] | None:
        self.asked.append((now, adu[6]))
        if adu[6] in self.silent:
            return None
        count = adu[11]
        pdu = bytes((3, 2 * count)) + bytes(2 * count)
        return now + self.delay, adu[:4] + (len(pdu) + 1).to_bytes(2, "big") + adu[6:7] + pdu


class Plant:
    """Clients that poll units of one server through one session, for as long as virtual time is let run."""

    def __init__(self, server: Server, *, transactions: int = 1, open_after: int = 3, timeout: float = 1.0) -> None:
        self.server = server
        self.now = 0.0
        parameters = ClientParameters(timeout=timeout, retries=1, max_transactions=transactions)
        self.session = TcpClientSession(parameters)
        self.breakers = Breakers(BreakerParameters(open_after=open_after), lambda: 0.0)
        self.session.watch_units(self.breakers)
        self.session.connected(0.0)
        self.waited: dict[int, list[float]] = {}
        self.ends: dict[int, list[object]] = {}
        self._replies: list[tuple[float, bytes]] = []
        self._polls: list[tuple[float, int]] = []

    def ask(self, unit: int, requests: int = 1) -> Call | None:
        """Ask a unit now; None if it was refused at once."""
        reads = [ReadHoldingRegisters(position, 1) for position in range(requests)]
        for read in reads:
            read.prepare()
        call = Call(unit, reads, False, self.session.parameters.timeout, 1, caller=unit)
        try:
            self.session.submit(call, self.now)
        except UnitSuspended as error:
            self.ends.setdefault(unit, []).append(error)
            return None
        self._pump()
        return call

    def poll(self, *units: int, every: float) -> None:
        """Let a client for each unit poll it, so many seconds after its last end."""
        self._every = every
        for unit in units:
            heapq.heappush(self._polls, (self.now, unit))

    def run(self, until: float) -> None:
        """Let time pass."""
        while True:
            times = [self._replies[0][0]] if self._replies else []
            times += [self._polls[0][0]] if self._polls else []
            deadline = self.session.deadline()
            times += [] if deadline is None else [deadline]
            if not times or min(times) > until:
                self.now = until
                return
            self.now = max(min(times), self.now)
            self._step()

    def _step(self) -> None:
        while self._replies and self._replies[0][0] <= self.now:
            _, reply = heapq.heappop(self._replies)
            self.session.receive(reply, len(reply), self.now)
        self.session.tick(self.now)
        while self._polls and self._polls[0][0] <= self.now:
            _, unit = heapq.heappop(self._polls)
            if self.ask(unit) is None:
                heapq.heappush(self._polls, (self.now + self._every, unit))
        self._pump()
        if self.session.recycle:
            self.session.disconnected(self.now, self.session.recycle)
            self.session.connected(self.now)
            self._pump()

    def _pump(self) -> None:
        for adus in self.session.transmit(self.now):
            at = 0
            while at < len(adus):
                end = at + 6 + int.from_bytes(adus[at + 4 : at + 6], "big")
                answer = self.server.answers(adus[at:end], self.now)
                if answer is not None:
                    heapq.heappush(self._replies, answer)
                at = end
        finished, self.session.finished[:] = self.session.finished[:], []
        for call in finished:
            self.waited.setdefault(call.unit, []).append(self.now - call.submitted)
            self.ends.setdefault(call.unit, []).extend(call.outcomes)
            heapq.heappush(self._polls, (self.now + self._every, call.unit))

    _every = 1e9


def median_of_others(silent: set[int], transactions: int) -> float:
    plant = Plant(Server(silent), transactions=transactions)
    plant.poll(1, 2, 3, 4, every=0.01)
    plant.run(10.0)  # within the first seconds the breaker opens
    plant.waited.clear()
    plant.run(25.0)
    return statistics.median(one for unit in (1, 2, 3) for one in plant.waited[unit])


@pytest.mark.parametrize("transactions", [1, 4])
def test_a_silent_unit_of_four_leaves_the_median_of_the_others_as_it_was(transactions: int) -> None:
    undisturbed = median_of_others(set(), transactions)
    disturbed = median_of_others({4}, transactions)
    print(f"{transactions} at once: {1000 * undisturbed:.2f} ms undisturbed, {1000 * disturbed:.2f} ms with one silent")
    assert disturbed <= 3 * undisturbed


def test_without_watching_units_the_others_wait_for_the_silent_one() -> None:
    plant = Plant(Server({4}), open_after=0)
    plant.poll(1, 2, 3, 4, every=0.01)
    plant.run(20.0)
    assert statistics.median(plant.waited[1]) > 0.3


def test_three_timeouts_open_the_breaker_and_what_waits_for_the_unit_fails_at_once() -> None:
    plant = Plant(Server({4}))
    calls = [plant.ask(4) for _ in range(3)]
    plant.run(3.0)
    assert plant.breakers.state(4) is BreakerState.OPEN
    first, second, third = ([type(one) for one in call.outcomes] for call in calls if call is not None)
    assert (first, second, third) == ([NoReply], [NoReply], [UnitSuspended])
    assert plant.ask(4) is None
    assert plant.session.queued == plant.session.in_flight == 0
    assert plant.session.counters.suspended == 2


def test_a_probe_is_one_request_that_waits_no_longer_than_twice_what_is_usual() -> None:
    server = Server({4})
    plant = Plant(server, transactions=4)
    plant.ask(1)
    plant.run(0.1)
    plant.ask(4, requests=3)
    plant.run(4.0)
    assert plant.breakers.state(4) is BreakerState.OPEN
    plant.run(10.0)
    before, server.asked[:] = len(server.asked), []
    assert before
    call = plant.ask(4, requests=3)
    plant.run(10.05)
    assert [unit for _, unit in server.asked] == [4]  # the others of the call are held
    assert plant.breakers.state(4) is BreakerState.PROBING
    plant.run(10.2)
    assert plant.breakers.state(4) is BreakerState.OPEN
    assert call is not None
    assert not call.open
    assert [unit for _, unit in server.asked] == [4]


def test_a_unit_that_answers_again_is_asked_as_before() -> None:
    server = Server({4})
    plant = Plant(server, transactions=4)
    plant.ask(4, requests=3)
    plant.run(4.0)
    server.silent.clear()
    plant.run(8.0)
    call = plant.ask(4, requests=3)
    plant.run(9.0)
    assert plant.breakers.state(4) is BreakerState.CLOSED
    assert call is not None
    assert [type(one).__name__ for one in call.outcomes] == ["Reply"] * 3


def test_a_late_reply_of_the_unit_closes_its_breaker() -> None:
    plant = Plant(Server(delay=1.5))
    for _ in range(2):
        plant.ask(4)
    plant.run(3.2)
    plant.run(6.0)
    assert plant.breakers.state(4) is BreakerState.CLOSED
    assert plant.session.counters.late_replies > 0


def test_a_call_that_ends_before_the_unit_could_answer_is_no_sign_that_it_is_silent() -> None:
    plant = Plant(Server({4}))
    plant.ask(1)
    plant.run(0.1)
    for _ in range(5):
        read = ReadHoldingRegisters(0, 1)
        call = Call(4, [read], False, 1.0, 1, caller=4, deadline=plant.now + 0.0005)
        plant.session.submit(call, plant.now)
        plant._pump()
        plant.run(plant.now + 0.001)
        assert call.ended
    assert plant.breakers.state(4) is BreakerState.CLOSED
    assert plant.ask(4) is not None
