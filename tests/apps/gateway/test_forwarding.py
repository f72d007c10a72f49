"""Reads that clients ask together are forwarded as batches: the answers of the generic path, each on arrival."""

import asyncio
import gc
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import pytest
from authorizing import AuthorizedPipeline
from examples import examples
from hypothesis import given, settings
from hypothesis import strategies as st

import busway
from busway.apps.gateway.forwarding import Forwarder
from busway.apps.gateway.router import ListenerRouter
from busway.apps.gateway.routes import AddressRange, ListenerRoutes, Route, RouteAction
from busway.apps.gateway.upstream import Upstream
from busway.client.settings import link_settings
from busway.codes import Table
from busway.framing.mbap import MbapReceiver, encode_mbap
from busway.pdu.functions import AnyRequest, FunctionTable
from busway.pdu.message import Touch
from busway.pdu.read_items import ReadRegisters
from busway.session.call import Call
from busway.session.diagnostic_counters import LineDiagnostics
from busway.session.forwarded_reads import ReadForwarder
from busway.session.responder import ClientIdentity, RequestContext, ResponderAnswer, ServedUnit
from busway.session.server_pipeline import RequestPipeline
from busway.session.server_transaction_slots import ServerTransactionSlots
from busway.session.tcp_client import TcpClientSession
from busway.session.tcp_server import TcpServerSession

SIZE = 500
"""Registers of the device; each holds its address."""


def read(address: int, count: int = 1, function: int = 3) -> bytes:
    return struct.pack(">BHH", function, address, count)


def write(address: int) -> bytes:
    return struct.pack(">BHH", 6, address, address)


def answer_of(pdu: bytes) -> bytes:
    """What the device answers."""
    function, address, count = struct.unpack(">BHH", pdu)
    if function == 6:
        return pdu
    if address + count > SIZE:
        return bytes((function | 0x80, 2))
    if function == 1:
        return bytes((1, (count + 7) // 8)) + bytes((count + 7) // 8)
    return bytes((function, 2 * count)) + struct.pack(f">{count}H", *range(address, address + count))


@dataclass
class WireTimer:
    """A timer in virtual time."""

    when: float
    callback: Callable[[], None]
    is_cancelled: bool = False

    def cancel(self) -> None:
        self.is_cancelled = True

    def ring(self) -> None:
        if not self.is_cancelled:
            self.callback()


class WireLink:
    """A link whose wire and clock are in the hands of the test.

    Attributes:
        asked: transaction, unit and PDU of what has left and is not answered yet.
        segments: how many requests each segment had.
    """

    def __init__(self, line: Upstream) -> None:
        self.session = TcpClientSession(line.settings.parameters)
        self.session.serve_units_in_turn()
        self.session.connected(0.0)
        self.asked: list[tuple[int, int, bytes]] = []
        self.segments: list[int] = []
        self.time = 0.0
        self.timers: list[WireTimer] = []
        self._line = line
        line.links.append(self)  # type: ignore[arg-type]  # instead of a connection

    def now(self) -> float:
        return self.time

    def begin(self, call: Call, now: float) -> None:
        adu = self.session.send_now(call, now)
        if adu is None:
            self.session.submit(call, now)
            self.pump()
        else:
            self._left(adu)

    def call_at(self, when: float, callback: Callable[[], None]) -> "WireTimer":
        timer = WireTimer(when, callback)
        self.timers.append(timer)
        return timer

    def give_up(self, call: Call) -> None:
        self.session.cancel(call)

    def pump(self) -> None:
        for segment in self.session.transmit(self.time):
            self._left(segment)

    def _left(self, segment: bytes) -> None:
        frames = MbapReceiver().receive(segment)
        self.segments.append(len(frames))
        self.asked += [(frame.transaction, frame.unit, frame.pdu) for frame in frames]

    def answer(self, *positions: int, together: bool = True) -> None:
        """Let the device answer some of what was asked (all, if none are named), in one segment or one by one."""
        chosen = [self.asked[position] for position in positions or range(len(self.asked))]
        adus = [encode_mbap(transaction, unit, answer_of(pdu)) for transaction, unit, pdu in chosen]
        self.asked = [one for one in self.asked if one not in chosen]
        for segment in [b"".join(adus)] if together else adus:
            self.session.receive(segment, len(segment), self.time)
            self._wake()
        self.pump()

    def wait(self, seconds: float) -> None:
        self.time += seconds
        due = [one for one in self.timers if one.when <= self.time]
        self.timers = [one for one in self.timers if one.when > self.time]
        for timer in due:
            timer.ring()
        self.session.tick(self.time)
        self._wake()
        self.pump()

    def lose(self) -> None:
        """The connection ends, with whatever is on its way, and there is another one at once."""
        self.asked.clear()
        self.session.disconnected(self.time, "the server closed it")
        self._wake()
        self.session.connected(self.time)
        self.pump()

    def _wake(self) -> None:
        finished = self.session.finished[:]
        self.session.finished.clear()
        for call in finished:
            call.owner.set_result(None)
        assert self._line.watch is not None
        self._line.watch(self.session)


class GenericPathOnly:
    """A handler that shows nothing but its generic path."""

    def __init__(self, inner: ListenerRouter) -> None:
        self.inner = inner
        self.functions: FunctionTable = inner.functions
        self.generation = 0

    def serves(self, unit: int) -> ServedUnit | None:
        return ServedUnit(unit)

    def answer(self, context: RequestContext, request: AnyRequest) -> ResponderAnswer:
        return self.inner.answer(context, request)


class Client:
    """A client of the gateway, by its conversation."""

    def __init__(self, handler: Any, name: str, *, slots: int = 16, is_priority: bool = False) -> None:
        self.slots = ServerTransactionSlots(slots)
        self.diagnostics = LineDiagnostics()
        self.writes: list[list[bytes]] = []
        self.session = TcpServerSession(
            handler,
            diagnostics=self.diagnostics,
            slots=self.slots,
            deliver=lambda adu: self.writes.append([adu]),
            deliver_together=self.writes.append,
            client=ClientIdentity(peer=name, is_priority=is_priority),
        )
        self.transaction = 0

    def ask(self, *pdus: bytes, unit: int = 1) -> None:
        """Requests in one segment."""
        stream = b""
        for pdu in pdus:
            self.transaction += 1
            stream += encode_mbap(self.transaction, unit, pdu)
        now = self.session.receive(stream, len(stream))
        if now:
            self.writes.append(now)

    def got(self) -> dict[int, bytes]:
        """The answers since the last look, by transaction; each came once."""
        frames = MbapReceiver().receive(b"".join(adu for adus in self.writes for adu in adus))
        self.writes.clear()
        found = {frame.transaction: frame.pdu for frame in frames}
        assert len(found) == len(frames)
        return found


class Plant:
    """A listener, a line and a device; clients come as they are asked for."""

    def __init__(
        self,
        *routes: Route,
        batches: bool = True,
        share_reads: bool = True,
        policy: busway.Policy | None = None,
        **options: Any,
    ) -> None:
        options = {"max_transactions": 16, "retries": 0, "queue": 200, **options}
        self.line = Upstream("line", link_settings("tcp://127.0.0.1:1", options))
        self.forwarder = Forwarder(self.line, share_reads=share_reads)
        self.link = WireLink(self.line)
        self.listener = ListenerRouter("office", busway.STANDARD)
        self.listener.follow(ListenerRoutes(routes or (Route(upstream="line"),)), {"line": self.forwarder})
        responder = self.listener if batches else GenericPathOnly(self.listener)
        self.handler: Any = RequestPipeline(responder) if policy is None else AuthorizedPipeline(responder, policy)

    def client(self, name: str, **options: Any) -> Client:
        return Client(self.handler, name, **options)


# Both roads.

ROUTES = [
    Route(action=RouteAction.REFUSE, code=4, addresses=AddressRange(Table.HOLDING_REGISTERS, 300, 310)),
    Route(upstream="line", units=frozenset({2}), unit=7, shift=20),
    Route(upstream="line", units=frozenset({3}), max_registers=3),
    Route(upstream="line", units=frozenset({4}), functions=frozenset({3}), timeout=0.3),
    Route(upstream="line", units=frozenset({1})),
]
PDUS = st.one_of(
    st.builds(read, st.integers(0, 12), st.integers(1, 4)),
    st.builds(read, st.sampled_from([295, 300, 305, 490, 65_520]), st.integers(1, 12)),
    st.builds(read, st.integers(0, 5), st.integers(1, 20), st.just(1)),
    st.builds(read, st.integers(0, 5), st.sampled_from([0, 126]), st.just(3)),
    st.builds(write, st.integers(0, 5)),
)
STEPS = st.one_of(
    st.tuples(st.just("ask"), st.integers(0, 2), st.integers(1, 5), st.lists(PDUS, min_size=1, max_size=6)),
    st.tuples(st.just("answer"), st.booleans(), st.integers(0, 5), st.just([])),
)


POLICY = busway.Policy.of(
    busway.Rule.of(name="all", peers=["10.0.0.1"]),
    busway.Rule.of(name="some", units="1-2", table="holding", addresses="0-7", action="allow"),
    busway.Rule.of(name="coils", functions=[1], action="allow"),
    default="deny",
)


@settings(max_examples=examples(200), deadline=None)
@given(st.lists(STEPS, max_size=14), st.booleans(), st.sampled_from([1, 3, 16]), st.sampled_from([None, POLICY]))
def test_every_client_gets_the_answers_of_the_generic_path(
    steps: list[tuple[Any, Any, Any, Any]], share_reads: bool, room: int, policy: busway.Policy | None
) -> None:
    found = []
    for batches in (True, False):
        plant = Plant(*ROUTES, batches=batches, share_reads=share_reads, max_transactions=room, policy=policy)
        clients = [plant.client(f"10.0.0.{number}:500", slots=200) for number in range(3)]
        for action, who, unit, pdus in steps:
            if action == "ask":
                clients[who].ask(*pdus, unit=unit)
            elif plant.link.asked:
                plant.link.answer(unit % len(plant.link.asked)) if who else plant.link.answer()
        while plant.link.asked:
            plant.link.answer(together=False)
        found.append([client.got() for client in clients])
        assert [len(got) for got in found[-1]] == [client.transaction for client in clients]
        assert [client.slots.used for client in clients] == [client.session.waiting for client in clients] == [0, 0, 0]
        assert (plant.forwarder.open_requests, plant.link.session.queued) == (0, 0)
        reads = clients[0].session._reads
        assert reads is None or not reads.batches
    assert found[0] == found[1]


TROUBLES = st.one_of(
    STEPS,
    st.tuples(st.sampled_from(["lose", "leave"]), st.integers(0, 2), st.just(0), st.just([])),
    st.tuples(st.just("wait"), st.sampled_from([0.3, 1.1]), st.just(0), st.just([])),
)


@settings(max_examples=examples(200), deadline=None)
@given(
    st.lists(TROUBLES, max_size=25),
    st.booleans(),
    st.sampled_from([1, 3, 16]),
    st.sampled_from([0, 2]),
    st.sampled_from([None, 0.5]),
    st.sampled_from([5, 200]),
)
def test_each_read_is_answered_once_and_nothing_is_left_whatever_happens_to_lines_and_clients(
    steps: list[tuple[Any, Any, Any, Any]],
    share_reads: bool,
    room: int,
    retries: int,
    deadline: float | None,
    queue: int,
) -> None:
    options = {"max_transactions": room, "retries": retries, "queue": queue, "recycle_after_timeouts": 1000}
    plant = Plant(share_reads=share_reads, **options)
    plant.listener.deadline = deadline
    clients = [plant.client(f"10.0.0.{number}:500") for number in range(3)]
    asked: list[dict[int, bytes]] = [{}, {}, {}]

    def look() -> None:
        for number, client in enumerate(clients):
            for transaction, answer in client.got().items():
                pdu = asked[number].pop(transaction)
                is_malformed = pdu[0] == 3 and pdu[3:] in (b"\0\0", b"\0\x7e")
                codes = (3, 6) if is_malformed else (6, 10, 11)
                assert answer in (answer_of(pdu), *(bytes((pdu[0] | 0x80, code)) for code in codes))
            assert client.slots.used == client.session.waiting == len(asked[number])

    for action, who, unit, pdus in steps:
        if action == "ask":
            asked[who].update(enumerate(pdus, clients[who].transaction + 1))
            clients[who].ask(*pdus, unit=5)
        elif action == "answer" and plant.link.asked:
            plant.link.answer(unit % len(plant.link.asked)) if who else plant.link.answer()
        elif action == "lose":
            plant.link.lose()
        elif action == "leave":
            clients[who].session.close()
            asked[who] = {}
            look()
            clients[who] = plant.client(f"10.0.0.{who}:501")
        elif action == "wait":
            plant.link.wait(who)
        look()
    while plant.link.asked:
        plant.link.answer(together=False)
    look()
    queued = plant.link.session.queue
    assert asked == [{}, {}, {}]
    assert (plant.forwarder.open_requests, queued.size, queued.waiting, len(queued.begun)) == (0, 0, 0, 0)
    assert not any(unit.reading or unit.open_writes for unit in plant.forwarder.cache._units.values())
    for client in clients:
        assert client.session._reads is not None
        assert not client.session._reads.batches


def test_what_comes_together_goes_behind_in_one_segment_and_comes_back_in_one() -> None:
    plant = Plant()
    client = plant.client("client")
    client.ask(*(read(address) for address in range(5)))  # each is new, and met for the first time
    plant.link.answer()
    client.got()
    plant.link.segments.clear()
    client.ask(*(read(address) for address in range(5)))
    plant.link.answer()
    assert plant.link.segments == [5]
    assert [len(adus) for adus in client.writes] == [5]
    assert list(client.got().values()) == [answer_of(read(address)) for address in range(5)]
    assert (plant.line.counters.forwarded, plant.line.counters.answered) == (10, 10)
    assert client.session.requests == client.diagnostics.counters.server_message_count == 10


@pytest.mark.parametrize("batches", [True, False])
def test_what_waits_for_its_answer_has_been_counted_as_received_and_the_log_says_when_what_was(batches: bool) -> None:
    plant = Plant(batches=batches)
    client = plant.client("client")
    state = client.diagnostics.of(1)
    for _ in range(2):
        state.restart(clear_log=True)
        client.ask(read(0), read(SIZE), read(1))
        assert (state.counters.bus_message_count, state.counters.server_message_count) == (3, 3)
        assert (state.event_count, state.message_count) == (0, 3)
        plant.link.answer()
        assert (state.counters.server_message_count, state.counters.bus_exception_error_count) == (3, 1)
        status, events, messages, log = state.event_log()
        assert (status, events, messages) == (0, 2, 3)
        assert (sorted(log[:3]), log[3:]) == ([0x40, 0x40, 0x41], bytes([0x80] * 3 + [0]))
    client.ask(read(0))
    client.session.close()
    assert (state.counters.server_message_count, state.counters.server_no_response_count) == (4, 1)


def test_a_server_that_takes_one_request_of_a_segment_gets_them_one_by_one() -> None:
    plant = Plant(single_adu_segments=True)
    client = plant.client("client")
    for _ in range(2):
        plant.link.segments.clear()
        client.ask(*(read(address) for address in range(5)))
        plant.link.answer(together=False)
        assert plant.link.segments == [1] * 5
        assert list(client.got().values()) == [answer_of(read(address)) for address in range(5)]


def test_no_read_waits_for_the_others_of_its_batch() -> None:
    plant = Plant()
    client = plant.client("client")
    for _ in range(2):
        client.ask(read(0), read(1), read(2))
        plant.link.answer(1)
        first = client.got()
        assert list(first.values()) == [answer_of(read(1))]
        assert (plant.forwarder.open_requests, client.slots.used) == (2, 2)
        plant.link.answer()
        assert list(client.got().values()) == [answer_of(read(0)), answer_of(read(2))]


def test_only_what_gets_no_reply_is_answered_0b() -> None:
    plant = Plant(timeout=1.0)
    client = plant.client("client")
    client.ask(read(0), read(1), read(2))
    plant.link.answer(0, 2)
    client.got()
    plant.link.wait(1.1)
    assert client.got() == {2: bytes((0x83, 0x0B))}
    assert (plant.forwarder.open_requests, client.slots.used, plant.line.counters.no_answer) == (0, 0, 1)


class ReadKnownValues(ReadRegisters):
    """03 of devices that answer 7 where they know no value."""

    code = 3
    reads = Touch(Table.HOLDING_REGISTERS)

    def check_reply(self, reply: Any) -> str | None:
        return "no value" if 7 in reply.registers else None


@pytest.mark.parametrize("batches", [True, False])
def test_a_reply_that_its_function_does_not_take_is_not_handed_on(batches: bool) -> None:
    plant = Plant(batches=batches)
    plant.listener.functions = FunctionTable(*(one for one in busway.STANDARD if one.code != 3), ReadKnownValues)
    responder = plant.handler.responder
    responder.functions = plant.listener.functions
    plant.handler = RequestPipeline(responder)
    client = plant.client("client")
    for _ in range(2):
        client.ask(read(7), read(8))
        plant.link.answer()
        assert sorted(client.got().values()) == sorted([bytes((0x83, 0x0B)), answer_of(read(8))])


def test_what_has_failed_for_good_does_not_wait_for_what_is_asked_again() -> None:
    plant = Plant(max_transactions=2, timeout=1.0, retries=1, recycle_after_timeouts=100)
    client = plant.client("client")
    for _ in range(2):
        client.ask(read(0), read(1), read(2))
        while plant.link.asked:
            plant.link.answer()
        client.got()
    client.ask(read(0), read(1), read(2))
    plant.link.answer(0)  # its place goes to the third one, half a second later
    plant.link.time += 0.5
    plant.link.pump()
    plant.link.wait(0.6)  # the second one is asked again
    assert list(client.got().values()) == [answer_of(read(0))]
    plant.link.wait(1.1)
    answers = client.got()
    plant.link.wait(1.1)
    answers |= client.got()
    assert list(answers.values()) == [bytes((0x83, 0x0B))] * 2
    assert plant.forwarder.open_requests == 0


def test_exceptions_of_the_device_go_through_each_in_its_place() -> None:
    plant = Plant()
    client = plant.client("client")
    client.ask(read(0), read(SIZE), read(1))
    plant.link.answer()
    assert client.got() == {1: answer_of(read(0)), 2: bytes((0x83, 2)), 3: answer_of(read(1))}
    assert plant.line.counters.exceptions == 1
    assert client.diagnostics.counters.bus_exception_error_count == 1


def test_a_read_without_a_slot_is_answered_06_and_the_next_one_has_the_slot_that_is_free_again() -> None:
    plant = Plant()
    client = plant.client("client", slots=2)
    client.ask(read(0), read(1), read(2), read(0))
    assert client.got() == {3: bytes((0x83, 6)), 4: bytes((0x83, 6))}
    plant.link.answer()
    client.ask(read(0), read(1), read(2))
    assert client.got() == {1: answer_of(read(0)), 2: answer_of(read(1)), 7: bytes((0x83, 6))}


def test_what_the_queue_cannot_take_is_0a_and_the_rest_is_asked() -> None:
    plant = Plant(max_transactions=1, queue=2)
    client = plant.client("client")
    for _ in range(2):
        client.ask(*(read(address) for address in range(6)))
        refused = client.got()
        assert list(refused.values()) == [bytes((0x83, 0x0A))] * 3
        while plant.link.asked:
            plant.link.answer()
        assert len(client.got()) == 3
    assert plant.line.counters.no_path == 6


def test_one_read_that_is_asked_again_takes_one_place_of_the_queue_and_not_those_of_its_batch() -> None:
    plant = Plant(queue=4, retries=1)
    one, two = plant.client("one"), plant.client("two")
    for _ in range(2):
        one.ask(*(read(address) for address in range(8)))
        plant.link.answer(*range(7))
        if one.transaction == 8:
            plant.link.answer()
    one.got()
    plant.link.asked.clear()
    session = plant.link.session
    session.disconnected(0.0, "the server closed it")
    assert session.queued == 1
    two.ask(read(20), read(21), read(22))
    assert two.got() == {}
    session.connected(0.0)
    plant.link.pump()
    plant.link.answer()
    assert (list(one.got().values()), len(two.got())) == ([answer_of(read(7))], 3)
    assert session.queued == 0


def test_reads_of_a_batch_that_are_asked_again_take_a_place_each() -> None:
    plant = Plant(retries=1, share_reads=False)
    client = plant.client("client")
    for _ in range(2):
        client.ask(*(read(address) for address in range(8)))
        plant.link.answer(0, 1, 2)
        if client.transaction == 8:
            plant.link.answer()
    plant.link.asked.clear()
    session = plant.link.session
    session.disconnected(0.0, "the server closed it")
    assert session.queued == session.queue.waiting == 5
    session.connected(0.0)
    plant.link.pump()
    assert session.queued == 0
    plant.link.answer()
    assert len(client.got()) == 16


def test_identical_reads_of_two_clients_are_asked_once_and_a_write_ends_the_sharing() -> None:
    plant = Plant()
    one, two = plant.client("one"), plant.client("two")
    one.ask(read(5), read(6))
    two.ask(read(6), read(5), read(5))
    assert len(plant.link.asked) == 2
    one.ask(write(5))
    two.ask(read(5))
    assert [pdu[0] for _, _, pdu in plant.link.asked] == [3, 3, 6, 3]
    plant.link.answer()
    assert one.got() == {1: answer_of(read(5)), 2: answer_of(read(6)), 3: write(5)}
    assert sorted(two.got()) == [1, 2, 3, 4]
    assert (plant.line.counters.shared, plant.forwarder.open_requests) == (3, 0)


def test_the_end_of_a_read_from_before_a_write_leaves_the_one_after_it_to_be_shared() -> None:
    plant = Plant()
    one, two = plant.client("one"), plant.client("two")
    one.ask(read(5))
    one.ask(write(5))
    plant.link.answer(1)
    one.ask(read(5))
    plant.link.answer(0)
    two.ask(read(5))
    assert plant.line.counters.shared == 1
    plant.link.answer()
    assert (sorted(one.got()), sorted(two.got())) == ([1, 2, 3], [1])


@pytest.mark.parametrize("first", [0, 1])
def test_reads_of_the_generic_path_and_of_batches_share_with_each_other(first: int) -> None:
    plant = Plant()
    responders = (plant.listener, GenericPathOnly(plant.listener))
    clients = [Client(RequestPipeline(responder), "client") for responder in responders]
    one, two = clients[first], clients[1 - first]
    one.ask(read(5), read(6))
    two.ask(read(6), read(5))
    assert len(plant.link.asked) == plant.line.counters.shared == 2
    plant.link.answer()
    assert list(one.got().values()) == [answer_of(read(5)), answer_of(read(6))]
    got = two.got()
    assert [got[1], got[2]] == [answer_of(read(6)), answer_of(read(5))]


def test_a_client_that_goes_away_takes_what_no_other_client_waits_for() -> None:
    plant = Plant(max_transactions=1)
    one, two = plant.client("one"), plant.client("two")
    one.ask(read(0))
    plant.link.answer()
    one.ask(read(0), read(1), read(2))
    two.ask(read(1))
    one.session.close()
    assert (one.slots.used, one.session.waiting) == (0, 0)
    while plant.link.asked:
        plant.link.answer()
    assert list(two.got().values()) == [answer_of(read(1))]
    two.ask(read(7), read(8))
    two.session.close()
    assert plant.forwarder.open_requests == 0
    while plant.link.asked:
        plant.link.answer()
    assert not two.writes
    assert plant.link.session.queued == plant.link.session.in_flight == 0


def test_a_client_that_shares_and_goes_away_leaves_the_first_one_its_answer() -> None:
    plant = Plant()
    one, two = plant.client("one"), plant.client("two")
    one.ask(read(0))
    two.ask(read(0))
    two.session.close()
    plant.link.answer()
    assert list(one.got().values()) == [answer_of(read(0))]
    assert (two.writes, plant.forwarder.open_requests) == ([], 0)


def test_new_routes_hold_from_the_next_request_on_and_what_is_on_its_way_is_answered() -> None:
    plant = Plant()
    client = plant.client("client")
    client.ask(read(0), read(1))
    plant.listener.follow(ListenerRoutes((Route(upstream="line", unit=9, shift=100),)), {"line": plant.forwarder})
    client.ask(read(0))
    assert [(unit, pdu) for _, unit, pdu in plant.link.asked] == [(1, read(0)), (1, read(1)), (9, read(100))]
    plant.link.answer()
    assert client.got() == {1: answer_of(read(0)), 2: answer_of(read(1)), 3: answer_of(read(100))}
    plant.listener.follow(ListenerRoutes(()), {})
    client.ask(read(0))
    assert client.got() == {4: bytes((0x83, 0x0A))}


def test_a_client_that_gives_up_soon_is_told_before_its_read_is_sent() -> None:
    plant = Plant(max_transactions=1, timeout=5.0)
    plant.listener.deadline = 1.0
    client = plant.client("client")
    client.ask(read(0), read(1))
    plant.link.wait(1.1)
    assert client.got() == {1: bytes((0x83, 0x0B)), 2: bytes((0x83, 0x0A))}


def test_a_muted_listener_answers_nothing_and_asks_nothing() -> None:
    plant = Plant()
    client = plant.client("client")
    client.ask(read(0))
    plant.link.answer()
    client.got()
    client.diagnostics.listen_only_units.add(1)
    client.ask(read(0))
    assert (client.got(), plant.link.asked) == ({}, [])


def test_reads_that_a_policy_permits_go_together_and_those_that_it_denies_go_nowhere() -> None:
    plant = Plant(policy=POLICY)
    client = plant.client("10.9.9.9:500")
    for _ in range(2):
        plant.link.segments.clear()
        client.ask(read(0), read(1), read(9), read(2), read(3))
        plant.link.answer()
        got = list(client.got().values())
        assert sorted(got) == sorted([bytes((0x83, 1)), *(answer_of(read(address)) for address in range(4))])
    assert plant.link.segments == [2, 2]
    plant.handler.replace_policy(busway.Policy.of(default="deny"))
    client.ask(read(0))
    assert list(client.got().values()) == [bytes((0x83, 1))]
    assert isinstance(plant.listener, ReadForwarder)
    assert not isinstance(GenericPathOnly(plant.listener), ReadForwarder)


# Turns.


@pytest.mark.parametrize("others", [1, 2, 5])
def test_a_flood_costs_another_client_at_most_one_burst_of_each_on_a_line_that_pipelines(others: int) -> None:
    plant = Plant(queue=1000)
    floods = [plant.client(f"flood {number}") for number in range(others)]
    polite = plant.client("polite")

    def flood() -> None:
        for number, client in enumerate(floods):
            free = client.slots.limit - client.slots.used
            client.ask(*(read(10 * number + at % 10) for at in range(free)))

    plant.forwarder.share_reads = False
    flood()
    for _ in range(8):
        plant.link.answer()
        flood()
        polite.ask(read(400))
        before = 0
        while not any(pdu == read(400) for _, _, pdu in plant.link.asked):
            before += len(plant.link.asked)
            plant.link.answer()
            flood()
        position = next(at for at, one in enumerate(plant.link.asked) if one[2] == read(400))
        # What was on the wire, and one burst of each of the others.
        assert before + position <= 16 + 8 * others
        plant.link.answer()
        flood()
        assert polite.got()


def test_where_replies_come_one_by_one_clients_take_turns_one_by_one() -> None:
    plant = Plant(max_transactions=1, share_reads=False)
    one, two = plant.client("one"), plant.client("two")
    one.ask(*(read(address) for address in range(6)))
    two.ask(*(read(address) for address in range(100, 104)))
    order = []
    while plant.link.asked:
        order += [struct.unpack(">H", pdu[1:3])[0] for _, _, pdu in plant.link.asked]
        plant.link.answer()
    assert order == [0, 1, 100, 2, 101, 3, 102, 4, 103, 5]  # the first one found the line free


@pytest.mark.parametrize("batches", [True, False])
def test_priority_host_waits_for_what_is_on_the_wire_and_no_place_is_taken_from_it(batches: bool) -> None:
    plant = Plant(batches=batches, share_reads=False, max_transactions=1, queue=10)
    host = plant.client("host", is_priority=True)
    floods = [plant.client(f"flood {number}") for number in range(5)]
    for _ in range(4):
        for number, client in enumerate(floods):
            client.ask(*(read(10 * number + at) for at in range(client.slots.limit - client.slots.used)))
        refused = [pdu for client in floods for pdu in client.got().values() if pdu == bytes((0x83, 0x0A))]
        assert refused  # the queue is full
        host.ask(read(400))
        plant.link.answer()
        assert [pdu for _, _, pdu in plant.link.asked] == [read(400)]
        plant.link.answer()
        assert list(host.got().values()) == [answer_of(read(400))]


@pytest.mark.parametrize("batches", [True, False])
def test_priority_host_shares_what_was_sent_and_not_what_waits_for_others(batches: bool) -> None:
    plant = Plant(batches=batches, max_transactions=1)
    one, host, other = plant.client("one"), plant.client("host", is_priority=True), plant.client("other")
    one.ask(read(0))
    one.ask(read(1))
    one.ask(read(2))
    host.ask(read(0), read(2))
    other.ask(read(2))
    assert plant.line.counters.shared == 2  # what is on the wire, and with the priority host's
    plant.link.answer()
    assert list(host.got().values()) == [answer_of(read(0))]
    assert [pdu for _, _, pdu in plant.link.asked] == [read(2)]
    plant.link.answer()
    assert list(host.got().values()) == list(other.got().values()) == [answer_of(read(2))]
    while plant.link.asked:
        plant.link.answer()
    assert sorted(one.got()) == [1, 2, 3]
    assert plant.forwarder.open_requests == 0


@pytest.mark.parametrize("batches", [True, False])
def test_what_was_answered_or_refused_leaves_no_work_to_the_collector_of_garbage(batches: bool) -> None:
    plant = Plant(batches=batches, share_reads=False, max_transactions=1, queue=2)
    client = plant.client("client")

    def some() -> None:
        for _ in range(20):
            client.ask(*(read(address) for address in range(6)))
            while plant.link.asked:
                plant.link.answer()
            assert len(client.got()) == 6

    some()
    gc.collect()
    gc.disable()
    try:
        some()
        assert gc.collect() < 20  # there were 2400 objects
    finally:
        gc.enable()
    assert plant.line.counters.no_path == 120


@pytest.mark.parametrize("batches", [True, False])
def test_shared_reads_leave_no_work_to_the_collector_of_garbage(batches: bool) -> None:
    plant = Plant(batches=batches)
    plant.listener.deadline = 2.5
    clients = [plant.client(f"client {number}") for number in range(3)]

    def some() -> None:
        for _ in range(20):
            for client in clients:
                client.ask(read(1))
            plant.link.answer()
            assert all(len(client.got()) == 1 for client in clients)
        plant.link.timers.clear()

    some()
    gc.collect()
    gc.disable()
    try:
        some()
        assert gc.collect() < 20  # there were hundreds of objects
    finally:
        gc.enable()
    assert plant.line.counters.shared == 80


async def test_all_who_wait_for_the_answers_are_told_at_once() -> None:
    plant = Plant()
    client = plant.client("10.0.0.1:500")
    for address in (1, 2):
        client.ask(read(address))
        waiting = [asyncio.create_task(plant.forwarder.wait_until_answered()) for _ in range(2)]
        await asyncio.sleep(0)
        assert not any(task.done() for task in waiting)
        plant.link.answer()
        done, late = await asyncio.wait(waiting, timeout=60)
        for task in late:
            task.cancel()
        assert (len(done), len(late)) == (2, 0)
    await plant.forwarder.wait_until_answered()
