"""Clause T4: each component of the guide's architecture is used here by itself (Messaging on TCP/IP V1.0b §4.1).

Each test takes one of them and gives it what stands around it by hand. What they load says the rest: none of them
brings another one along.
"""

import asyncio
import socket
import subprocess
import sys
from dataclasses import dataclass

import pytest
from handlers import ScriptedHandler

import busway
from busway.access.access_request import AccessRequest
from busway.access.rates import Rates
from busway.access.rule_evaluation import decision_of
from busway.codes import Table
from busway.options.client import ClientParameters
from busway.options.sockets import SocketParameters
from busway.pdu.message import Message
from busway.pdu.read_items import ReadHoldingRegisters
from busway.pdu.write_items import WriteSingleRegister
from busway.server.connection_slots import ConnectionSlots, SlotLimits, SlotPool
from busway.server.device import Device
from busway.server.device_responder import DeviceResponder
from busway.session.call import Call
from busway.session.diagnostic_counters import CommunicationState, LineDiagnostics
from busway.session.responder import RequestContext
from busway.session.server_pipeline import RequestPipeline
from busway.session.server_transaction_slots import ServerTransactionSlots
from busway.session.tcp_client import TcpClientSession
from busway.session.tcp_server import TcpServerSession
from busway.transport.tcp import configure

pytestmark = pytest.mark.clause("T4")

QUESTION = bytes.fromhex("0001 0000 0006 01 03 0000 0002")
ANSWER = bytes.fromhex("0001 0000 0007 01 03 04 0007 0008")


def test_the_client_alone_makes_bytes_of_calls_and_confirmations_of_bytes() -> None:
    client = TcpClientSession(ClientParameters())
    client.connected(0.0)
    call = Call(1, [ReadHoldingRegisters(0, 2)], is_write=False, timeout=1.0, retries=0)
    client.submit(call, 0.0)
    (sent,) = client.transmit(0.0)
    assert sent[2:] == QUESTION[2:]
    client.receive(sent[:2] + ANSWER[2:], len(ANSWER), 0.5)
    assert call.outcomes == [ReadHoldingRegisters.Reply(bytes.fromhex("0007 0008"))]


def test_the_server_alone_makes_answers_of_indications() -> None:
    server = TcpServerSession(
        RequestPipeline(
            ScriptedHandler(lambda context, request: ReadHoldingRegisters.Reply(bytes.fromhex("0007 0008")))
        ),
        diagnostics=LineDiagnostics(),
        slots=ServerTransactionSlots(1),
        deliver=lambda adu: None,
    )
    assert b"".join(server.receive(QUESTION, len(QUESTION))) == ANSWER


def test_the_back_end_interface_alone_executes_requests_on_any_data() -> None:
    device = Device(holding_registers=[7, 8])
    handler = DeviceResponder({1: device})
    context = RequestContext(unit=1, function=6, diagnostics=CommunicationState())
    reply = handler.answer(context, WriteSingleRegister(0, 9))
    assert isinstance(reply, Message)
    assert reply.encode() == bytes.fromhex("06 0000 0009")
    assert device.read("4x1") == 9
    assert device.peek(Table.HOLDING_REGISTERS, 0, 2) == bytes.fromhex("0009 0008")


async def test_the_client_interface_alone_talks_to_a_server_that_is_not_ours() -> None:
    async def answer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        question = await reader.readexactly(len(QUESTION))
        writer.write(question[:2] + ANSWER[2:])
        await reader.read()
        writer.close()

    stranger = await asyncio.start_server(answer, "127.0.0.1", 0)
    async with stranger:
        port = stranger.sockets[0].getsockname()[1]
        async with busway.open(f"tcp://127.0.0.1:{port}") as link:
            assert await link.unit(1).read_holding_registers(0, count=2) == [7, 8]


@dataclass(eq=False)
class PoolMember:
    """A connection as connection management sees one, without a socket."""

    host: str
    is_priority: bool = False
    pool: SlotPool = SlotPool.OTHER
    last_used: float = 0.0
    is_busy: bool = False
    received: int = 12
    has_ended: bool = False


def test_connection_management_alone_says_who_has_a_place_and_who_makes_room() -> None:
    places: ConnectionSlots[PoolMember] = ConnectionSlots(SlotLimits(priority=1, other=1, priority_per_host=1))
    priority, old, new = (
        PoolMember("10.0.0.1", is_priority=True),
        PoolMember("10.0.0.2"),
        PoolMember("10.0.0.3", last_used=1.0),
    )
    assert places.admit(priority).accepted
    assert places.admit(old).evicted is None
    assert places.admit(new).evicted is old
    assert (priority.pool, places.count(SlotPool.OTHER)) == (SlotPool.PRIORITY, 1)


def test_access_control_alone_says_who_may_connect_and_who_may_ask() -> None:
    assert busway.AddressList(allow=["10.0.0.0/8"])("10.0.0.7")
    assert not busway.AddressList(allow=["10.0.0.0/8"])("192.0.2.1")
    policy = busway.Policy.read_only()
    for request, allowed in ((ReadHoldingRegisters(0, 2), True), (WriteSingleRegister(0, 1), False)):
        assert decision_of(policy, AccessRequest.of(request, unit=1, peer="10.0.0.7")).allowed is allowed


def test_parameters_of_the_stack_alone_are_set_on_any_socket() -> None:
    with (
        socket.create_server(("127.0.0.1", 0)) as listener,
        socket.create_connection(listener.getsockname()) as dialled,
    ):
        configure(dialled, SocketParameters(keepalive_idle=71))
        assert dialled.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE)
        assert dialled.getsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE) == 71


def test_flow_control_alone_counts_transactions_and_rates() -> None:
    slots = ServerTransactionSlots(1)
    waiting = ScriptedHandler(lambda context, request: busway.LATER)
    first, second = (
        TcpServerSession(RequestPipeline(waiting), diagnostics=LineDiagnostics(), slots=slots, deliver=lambda adu: None)
        for _ in range(2)
    )
    assert first.receive(QUESTION, len(QUESTION)) == []
    busy = bytes.fromhex("0001 0000 0003 01 83 06")
    assert b"".join(second.receive(QUESTION, len(QUESTION))) == busy
    rates = Rates(2.0)
    assert [rates.allows("10.0.0.7", 0.0) for _ in range(3)] == [True, True, False]


@pytest.mark.parametrize(
    ("module", "strangers"),
    [
        ("busway.session.tcp_client", {"busway.client", "busway.server", "socket", "asyncio"}),
        ("busway.session.tcp_server", {"busway.client", "busway.server", "socket", "asyncio"}),
        ("busway.session.responder", {"busway.client", "busway.server", "socket", "asyncio"}),
        ("busway.access.rules", {"busway.client", "busway.server", "socket", "asyncio"}),
        ("busway.access.addresses", {"busway.client", "busway.server", "socket", "asyncio"}),
        (
            "busway.server.connection_slots",
            {"busway.client", "busway.server.connection_management", "busway.session", "asyncio"},
        ),
        ("busway.access.rates", {"busway.client", "busway.server.connection_management", "busway.session", "asyncio"}),
        ("busway.server.device_responder", {"busway.client", "busway.server.connection_management", "socket"}),
        ("busway.transport.tcp", {"busway.client", "busway.server", "busway.session", "asyncio"}),
        ("busway.client.aio", {"busway.server"}),
        ("busway.server.server", {"busway.client"}),
    ],
)
def test_no_component_brings_another_one_along(module: str, strangers: set[str]) -> None:
    look = f"import sys, {module}; print(*sys.modules)"
    loaded = set(
        subprocess.run([sys.executable, "-c", look], capture_output=True, text=True, check=True).stdout.split()
    )
    assert not loaded & strangers
