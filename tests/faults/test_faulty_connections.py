"""Faults on every kind of listener, while they are switched, by a clock of the test, and with other handlers around."""

import asyncio
import socket
import threading
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from played_devices import played

import busway
from busway.faults.switchboard import FaultSwitchboard
from busway.framing.ascii import encode_ascii
from busway.framing.mbap import encode_mbap
from busway.framing.rtu import encode_rtu
from busway.pdu.functions import AnyRequest
from busway.pdu.message import Message
from busway.pdu.read_items import ReadHoldingRegisters
from busway.server.device_responder import DeviceResponder
from busway.server.server import Server
from busway.session.responder import LATER, RequestContext, ResponderAnswer, ServedUnit
from busway.testing import FakeClock, Schedule, known_device
from busway.testing.certificates import CertificateStore

SCHEMES = ["tcp", "udp", "rtu+tcp", "ascii+tcp", "rtu+udp", "ascii+udp"]
TIMEOUT = 0.12
AMPLE = 5.0


@pytest.mark.parametrize("scheme", SCHEMES)
def test_faults_are_switched_on_and_off_over_every_transport(scheme: str) -> None:
    switchboard = FaultSwitchboard()
    switchboard.add("busy", functions={3}, items={busway.Table.HOLDING_REGISTERS: [(100, 200)]}, on=False)
    switchboard.add("late", units={2}, parameters={"delay": 0.02}, on=False)
    switchboard.add("wedged", functions={6}, on=False)
    with (
        played(switchboard, f"{scheme}://127.0.0.1:0") as endpoint,
        busway.connect(endpoint, timeout=AMPLE, retries=0) as link,
    ):
        one, two = link.unit(1), link.unit(2)
        assert one.read_holding_registers(100, count=1) == [100]
        switchboard.switch("busy", on=True)
        with pytest.raises(busway.ExceptionReply):
            one.read_holding_registers(99, count=2)
        assert one.read_holding_registers(99, count=1) == [99]
        assert one.read_input_registers(150, count=1) == [10_150]
        switchboard.switch("late", on=True)
        assert two.read_holding_registers(7, count=2) == [7, 8]
        switchboard.switch("wedged", on=True)
        with pytest.raises(busway.WriteOutcomeUnknown):
            one.write_single_register(1, 1, timeout=TIMEOUT)
        for name in ("busy", "late", "wedged"):
            switchboard.switch(name, on=False)
        assert one.read_holding_registers(100, count=1) == [100]
        one.write_single_register(1, 1)
        assert [fault.struck for fault in switchboard] == [1, 1, 1]


def test_connections_over_tls_misbehave_like_others(tmp_path: Path) -> None:
    store = CertificateStore(tmp_path)
    switchboard = FaultSwitchboard()
    switchboard.add("execute-then-drop")
    switchboard.add("dribble", parameters={"piece": 3})
    with (
        played(switchboard, f"tls://127.0.0.1:0?{store.server().query()}") as endpoint,
        busway.connect(endpoint, timeout=AMPLE, retries=0, **store.client().options()) as link,
    ):
        unit = link.unit(1)
        assert unit.read_holding_registers(7, count=2) == [7, 8]
        with pytest.raises(busway.WriteOutcomeUnknown):
            unit.write_single_register(1, 99)
        assert unit.read_holding_registers(1, count=1) == [99]
    assert switchboard.status("execute-then-drop").struck == 1


def _socket(endpoint: str) -> socket.socket:
    where = urlsplit(endpoint)
    made = socket.create_connection((where.hostname or "", where.port or 0), 5.0)
    made.settimeout(5.0)
    return made


def _received(client: socket.socket, size: int) -> bytes:
    found = b""
    while len(found) < size:
        more = client.recv(size - len(found))
        if not more:
            break
        found += more
    return found


PDU, ANSWER = bytes.fromhex("03 0005 0002"), bytes.fromhex("03 04 0005 0006")


def test_replies_leave_in_the_order_of_their_requests_even_when_only_some_are_late() -> None:
    switchboard = FaultSwitchboard()
    switchboard.add("late", units={2}, parameters={"delay": 0.05})
    with played(switchboard, "tcp://127.0.0.1:0") as endpoint, _socket(endpoint) as client:
        asked = [encode_mbap(number, unit, PDU) for number, unit in ((1, 1), (2, 2), (3, 1), (4, 2), (5, 1))]
        expected = [encode_mbap(number, unit, ANSWER) for number, unit in ((1, 1), (2, 2), (3, 1), (4, 2), (5, 1))]
        client.sendall(b"".join(asked))
        assert _received(client, sum(map(len, expected))) == b"".join(expected)
        switchboard.switch("late", on=False)
        client.sendall(b"".join(asked))
        assert _received(client, sum(map(len, expected))) == b"".join(expected)


@pytest.mark.parametrize(("scheme", "encode"), [("rtu+tcp", encode_rtu), ("ascii+tcp", encode_ascii)])
def test_echo_and_noise_are_bytes_around_good_frames(scheme: str, encode: object) -> None:
    assert callable(encode)
    switchboard = FaultSwitchboard()
    switchboard.add("leading-zero", parameters={"zeros": 3})
    switchboard.add("echo")
    with played(switchboard, f"{scheme}://127.0.0.1:0") as endpoint, _socket(endpoint) as client:
        client.sendall(encode(1, PDU))
        expected = encode(1, PDU) + bytes(3) + encode(1, ANSWER)
        assert _received(client, len(expected)) == expected


def test_silent_connection_is_closed_also_if_the_fault_was_switched_on_after_it_was_made() -> None:
    clock = FakeClock()
    switchboard = FaultSwitchboard(clock=clock)
    with played(switchboard, "tcp://127.0.0.1:0") as endpoint, _socket(endpoint) as client:
        client.sendall(encode_mbap(1, 1, PDU))
        assert _received(client, 13) == encode_mbap(1, 1, ANSWER)
        switchboard.add("close-if-silent", parameters={"seconds": 10})
        switchboard.add("idle-close", parameters={"seconds": 3600})
        clock.advance(1000.0)
        client.sendall(encode_mbap(2, 1, PDU))
        assert _received(client, 13) == encode_mbap(2, 1, ANSWER)  # it had spoken already
        clock.advance(3600.0)
        assert _received(client, 1) == b""
        with _socket(endpoint) as silent:
            # Its place on the switchboard is there as soon as another one, which came later, is answered.
            with _socket(endpoint) as other:
                other.sendall(encode_mbap(1, 1, PDU))
                assert _received(other, 13) == encode_mbap(1, 1, ANSWER)
            clock.advance(10.0)
            assert _received(silent, 1) == b""
    assert [fault.struck for fault in switchboard] == [1, 1]


def test_connection_in_use_is_not_idle_when_the_first_fault_is_switched_on_again() -> None:
    clock = FakeClock()
    switchboard = FaultSwitchboard(clock=clock)
    name = switchboard.add("idle-close", parameters={"seconds": 10})
    with played(switchboard, "tcp://127.0.0.1:0") as endpoint, _socket(endpoint) as client:

        def ask() -> None:
            client.sendall(encode_mbap(1, 1, PDU))
            assert _received(client, 13) == encode_mbap(1, 1, ANSWER)

        ask()
        switchboard.switch(name, on=False)
        for _ in range(4):
            clock.advance(8.0)
            ask()
        switchboard.switch(name, on=True)
        ask()
        clock.advance(9.0)
        ask()
    assert [fault.struck for fault in switchboard] == [0]


def test_idle_connection_is_closed_by_a_fault_that_begins_later() -> None:
    clock = FakeClock()
    switchboard = FaultSwitchboard(clock=clock)
    switchboard.add("idle-close", parameters={"seconds": 10}, schedule=Schedule(after=60.0))
    with played(switchboard, "tcp://127.0.0.1:0") as endpoint, _socket(endpoint) as client:
        client.sendall(encode_mbap(1, 1, PDU))
        assert _received(client, 13) == encode_mbap(1, 1, ANSWER)
        clock.advance(61.0)
        assert _received(client, 1) == b""


def test_late_by_an_hour_of_a_clock_that_a_test_moves() -> None:
    clock = FakeClock()
    switchboard = FaultSwitchboard(clock=clock)
    switchboard.add("late", parameters={"delay": 3600})
    with played(switchboard, "tcp://127.0.0.1:0") as endpoint, _socket(endpoint) as client:
        client.sendall(encode_mbap(7, 1, PDU))
        _until_heard(switchboard)
        clock.advance(3599.0)
        client.setblocking(False)
        with pytest.raises(BlockingIOError):
            client.recv(1)
        client.settimeout(5.0)
        clock.advance(1.0)
        assert _received(client, 13) == encode_mbap(7, 1, ANSWER)


def _until_heard(switchboard: FaultSwitchboard) -> None:
    """Wait until a request has been planned for."""
    pause = threading.Event()
    for _ in range(1000):
        if switchboard.tap.has_any_unsent:
            return
        pause.wait(0.005)
    raise AssertionError("the request did not come")


class Promising:
    """Answers later: by an awaitable (reads), or by a call (writes); refuses to write 13."""

    def __init__(self) -> None:
        self._inner = DeviceResponder({1: known_device()})
        self.functions = self._inner.functions
        self.generation = 0

    def serves(self, unit: int) -> ServedUnit | None:
        return ServedUnit(unit)

    def answer(self, context: RequestContext, request: AnyRequest) -> ResponderAnswer:
        reply = self._inner.answer(context, request)
        assert isinstance(reply, Message)
        if context.function == 3:
            return self._awaited(reply)
        asyncio.get_running_loop().call_soon(context.reply, reply)
        return LATER

    async def _awaited(self, reply: Message) -> Message:
        await asyncio.sleep(0)
        if isinstance(reply, ReadHoldingRegisters.Reply) and reply.registers == [13]:
            raise busway.Refusal(4)
        return reply


async def test_answers_that_other_handlers_promise_come_later_and_misbehave_too() -> None:
    switchboard = FaultSwitchboard()
    switchboard.add("foreign-transaction", parameters={"distance": 1})
    server = Server(["tcp://127.0.0.1:0"], Promising())
    switchboard.attach(server)
    async with server:
        reader, writer = await asyncio.open_connection("127.0.0.1", urlsplit(server.endpoints[0]).port)
        for pdu, answer in (
            ("06 0001 0009", "06 0001 0009"),
            ("03 0007 0001", "03 02 0007"),
            ("03 000D 0001", "83 04"),
        ):
            writer.write(encode_mbap(5, 1, bytes.fromhex(pdu)))
            expected = encode_mbap(6, 1, bytes.fromhex(answer)) + encode_mbap(5, 1, bytes.fromhex(answer))
            assert await asyncio.wait_for(reader.readexactly(len(expected)), 60) == expected
        writer.close()
        await writer.wait_closed()
        (status,) = server.status().connections
        assert status.waiting == 0


async def test_policy_of_the_server_is_asked_too() -> None:
    switchboard = FaultSwitchboard()
    switchboard.add("late", parameters={"delay": 0.0})
    switchboard.add("wrong-echo")
    server = busway.serve("tcp://127.0.0.1:0", units=known_device(), policy=busway.Policy.read_only())
    switchboard.attach(server)
    async with server, busway.open(server.endpoints[0]) as link:
        unit = link.unit(1)
        assert await unit.read_holding_registers(7, count=1) == [7]
        with pytest.raises(busway.ExceptionReply) as caught:
            await unit.write_single_register(7, 1)
        assert caught.value.code == 1


async def test_nothing_is_in_the_way_while_no_fault_is_on() -> None:
    switchboard = FaultSwitchboard()
    name = switchboard.add("late", parameters={"delay": 0.0}, on=False)
    server = busway.serve("tcp://127.0.0.1:0", units=known_device())
    switchboard.attach(server)
    async with server, busway.open(server.endpoints[0]) as link:
        unit = link.unit(1)
        await unit.read_holding_registers(7, count=1)
        (faulty,) = switchboard.tap
        assert faulty.conversation.contact.last_received is None  # the request was not looked at
        switchboard.switch(name, on=True)
        await unit.read_holding_registers(7, count=1)
        assert faulty.conversation.contact.last_received is not None
        switchboard.switch(name, on=False)
        seen = faulty.conversation.contact.last_received
        await unit.read_holding_registers(7, count=1)
        assert faulty.conversation.contact.last_received == seen


async def test_running_server_cannot_be_attached_to() -> None:
    async with busway.serve("tcp://127.0.0.1:0", units=known_device()) as server:
        with pytest.raises(busway.ConfigError, match="a running server"):
            FaultSwitchboard().attach(server)
        with pytest.raises(busway.ConfigError, match="a running server"):
            server.use_tap(FaultSwitchboard().tap)


async def test_ways_are_forgotten_with_their_connections() -> None:
    switchboard = FaultSwitchboard()
    server = busway.serve("tcp://127.0.0.1:0", "udp://127.0.0.1:0", units=known_device())
    switchboard.attach(server)
    async with server:
        for endpoint in server.endpoints:
            async with busway.open(endpoint) as link:
                await link.unit(1).read_holding_registers(7, count=1)
        assert switchboard.tap.accepted == 2
    assert len(switchboard.tap) == 0


async def test_rules_for_a_unit_hold_by_whatever_name_its_device_is_asked() -> None:
    policy = busway.Policy.of(
        busway.Rule.of(name="not here", action="deny", units="1", access="write"), default="allow"
    )
    switchboard = FaultSwitchboard()
    server = busway.serve("tcp://127.0.0.1:0", units={1: known_device()}, policy=policy)
    switchboard.attach(server)
    async with server, busway.open(server.endpoints[0]) as link:
        for unit in (1, 0, 255):
            with pytest.raises(busway.ExceptionReply) as error:
                await link.unit(unit).write_single_register(0, 1)
            assert error.value.code == 1
