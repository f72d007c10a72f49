"""What listeners do: who is answered, with which exception, who is kept silent, and clients that misbehave."""

import asyncio
import contextlib
import struct
from collections.abc import AsyncIterator
from typing import Any

import pytest
from faulty_line import faulty_line, value
from handlers import HeldReplies, ScriptedHandler
from handles import open_handles
from waiting import until

import busway
from busway.apps.gateway.gateway import Gateway
from busway.apps.gateway.gateway_plan import GatewayListener, GatewayPlan, UpstreamSettings
from busway.apps.gateway.routes import Route, RoutingTable
from busway.faults.clients import SLOW_LORIS
from busway.framing.rtu import encode_rtu
from busway.options.server import ListenerParameters, ServerParameters
from busway.server.listener import Listener
from busway.session.responder import ServedUnit

ANY_PORT = "tcp://127.0.0.1:0"
NETWORK_LISTENERS = ("tcp", "udp", "rtu+tcp", "ascii+tcp", "rtu+udp")
LINES = ("tcp", "udp", "rtu+tcp", "ascii+tcp", "rtu+udp")

pytestmark = pytest.mark.clause("T32")


def listener(scheme: str) -> GatewayListener:
    return GatewayListener("office", Listener(f"{scheme}://127.0.0.1:0"))


async def code_of(asked: Any) -> int:
    with pytest.raises(busway.ExceptionReply) as error:
        await asked
    return error.value.code


@contextlib.asynccontextmanager
async def gateway(
    scheme: str, *routes: Route, lines: dict[str, str], server: dict[str, Any] | None = None, **options: Any
) -> AsyncIterator[tuple[Gateway, busway.AsyncLink]]:
    settings = tuple(UpstreamSettings.of(name, url, **options) for name, url in lines.items())
    plan = GatewayPlan((listener(scheme),), settings, RoutingTable(routes), server=server or {})
    async with Gateway(plan) as made, busway.open(made.endpoints[0], timeout=3, retries=0) as link:
        yield made, link


def only(*units: int, line: str = "line") -> Route:
    return Route(upstream=line, units=frozenset(units))


# --- 0A, 0B, 06, silence -------------------------------------------------------------------------


@pytest.mark.clause("T31")
@pytest.mark.parametrize("scheme", NETWORK_LISTENERS)
@pytest.mark.parametrize("behind", LINES)
async def test_a_line_that_is_down_is_0a_and_one_that_does_not_answer_is_0b(scheme: str, behind: str) -> None:
    silent = ScriptedHandler(lambda context, request: busway.SILENCE)

    class Silent(ScriptedHandler):
        def serves(self, unit: int) -> ServedUnit | None:
            return ServedUnit(unit) if unit == 1 else None

    async with busway.serve(f"{behind}://127.0.0.1:0", responder=Silent(silent.decide)) as server:
        port = 9 if behind.endswith("udp") else 1
        async with gateway(
            scheme,
            only(1),
            only(2, line="down"),
            lines={"line": server.endpoints[0], "down": f"{behind}://127.0.0.1:{port}"},
            timeout=0.05,
            retries=0,
        ) as (made, link):
            assert await code_of(link.unit(1).read_holding_registers(0, count=1)) == 0x0B
            # Over UDP there is no connection that could be refused: who is not there does not answer.
            expected = (0x0A, 0x0B) if behind.endswith("udp") else (0x0A,)
            assert await code_of(link.unit(2).read_holding_registers(0, count=1)) in expected
            assert made.open_requests == 0


@pytest.mark.parametrize("scheme", ["rtu+tcp", "ascii+tcp", "rtu+udp"])
async def test_a_serial_listener_is_silent_for_units_that_it_does_not_route_and_for_the_gateway_itself(
    scheme: str,
) -> None:
    async with (
        busway.serve(ANY_PORT, units={3: busway.Device(holding_registers=[3])}) as server,
        gateway(scheme, only(3), lines={"line": server.endpoints[0]}) as (made, link),
    ):
        for unit in (1, 4, 247):
            with pytest.raises(busway.NoReply):
                await link.unit(unit).read_holding_registers(0, count=1, timeout=0.05)
        assert await link.unit(3).read_holding_registers(0, count=1) == [3]
        assert made.status().gateway_listeners[0].counters.no_route == 0
        assert made.status().upstreams[0].counters.forwarded == 1


@pytest.mark.parametrize("scheme", ["rtu+tcp", "ascii+tcp"])
async def test_the_gateway_itself_may_be_a_unit_of_a_serial_listener(scheme: str) -> None:
    plan = GatewayPlan(
        (listener(scheme),),
        (UpstreamSettings.of("line", "tcp://127.0.0.1:1"),),
        RoutingTable((only(3),)),
        own_unit=100,
        own_registers=True,
    )
    async with Gateway(plan) as made, busway.open(made.endpoints[0], timeout=3, retries=0) as link:
        assert await link.unit(100).read_input_registers(2, count=2) == [1, 1]
        assert (await link.unit(100).read_device_identification())[1] == b"gateway"


@pytest.mark.parametrize("scheme", ["tcp", "udp"])
@pytest.mark.parametrize("own", [True, False])  # whether the gateway is a device
@pytest.mark.parametrize("registers", [True, False])
async def test_255_and_anything_but_a_write_on_0_are_the_gateway_itself_or_no_path(
    scheme: str, own: bool, registers: bool
) -> None:
    plan = GatewayPlan(
        (listener(scheme),),
        (UpstreamSettings.of("line", "tcp://127.0.0.1:1"),),
        RoutingTable((only(3),)),
        own_unit=255 if own else None,
        own_registers=registers,
    )
    async with Gateway(plan) as made, busway.open(made.endpoints[0], timeout=3, retries=0) as link:
        for unit in (0, 255):
            if own:
                assert await link.unit(unit).diagnostics(0, b"\x12\x34") == b"\x12\x34"
                assert (await link.unit(unit).read_device_identification())[1] == b"gateway"
                if registers:
                    assert await link.unit(unit).read_input_registers(2, count=1) == [1]
                else:
                    assert await code_of(link.unit(unit).read_input_registers(2, count=1)) == 0x01
                assert await code_of(link.unit(unit).read_holding_registers(2, count=1)) == 0x01
                assert await code_of(link.unit(unit).read_coils(2, count=1)) == 0x01
                assert await code_of(link.unit(unit).read_discrete_inputs(2, count=1)) == 0x01
            else:
                assert await code_of(link.unit(unit).diagnostics(0, b"\x12\x34")) == 0x0A
                assert await code_of(link.unit(unit).read_input_registers(2, count=1)) == 0x0A
        assert await code_of(link.unit(0).write_single_register(2, 1)) == 0x0A  # no line hears it
        assert made.status().upstreams[0].counters.forwarded == 0


@pytest.mark.clause("T24")
@pytest.mark.parametrize("unit", [0, 255])
async def test_a_route_may_lead_the_units_of_a_device_on_tcp_to_one(unit: int) -> None:
    async with (
        busway.serve(ANY_PORT, units={unit: busway.Device(holding_registers=[9])}) as server,
        gateway("tcp", only(unit), lines={"line": server.endpoints[0]}) as (_, link),
    ):
        assert await link.unit(unit).read_holding_registers(0, count=1) == [9]


@pytest.mark.parametrize("unit", [0, 248, 255])
async def test_units_that_a_serial_line_has_not_are_no_path_there(unit: int) -> None:
    async with (
        busway.serve("rtu+tcp://127.0.0.1:0", units={1: busway.Device(holding_registers=[9])}) as server,
        gateway("tcp", only(1, unit), lines={"line": server.endpoints[0]}) as (_, link),
    ):
        assert await code_of(link.unit(unit).read_holding_registers(0, count=1)) == 0x0A
        assert await link.unit(1).read_holding_registers(0, count=1) == [9]


@pytest.mark.clause("T27")
@pytest.mark.parametrize("behind", ["tcp", "rtu+tcp"])
async def test_slots_of_the_listener_exhausted_are_06_and_what_waits_is_answered(behind: str) -> None:
    async with faulty_line(behind, timeout=5) as line:
        plan = line.gateway.plan
        own = GatewayPlan(
            plan.listeners, plan.upstreams, plan.table, server={"parameters": ServerParameters(max_transactions=2)}
        )
        line.add("late", delay=0.1)
        async with Gateway(own) as made, busway.open(made.endpoints[0], max_transactions=5, timeout=5) as link:
            asked = [link.unit(1).read_holding_registers(n, count=2) for n in range(5)]
            found = await asyncio.gather(*asked, return_exceptions=True)
            codes = [one.code for one in found if isinstance(one, busway.ExceptionReply)]
            assert codes == [6, 6, 6]
            assert found[:2] == [[value(1, 0), value(1, 1)], [value(1, 1), value(1, 2)]]


async def test_a_malformed_request_is_refused_by_the_gateway_and_never_forwarded() -> None:
    async with faulty_line("rtu+tcp") as line, busway.open(line.endpoint) as link:
        host, port = line.endpoint.removeprefix("tcp://").split(":")
        reader, writer = await asyncio.open_connection(host, int(port))
        for pdu, expected in (
            ("03 0000 0000", "83 03"),  # none
            ("03 0000 007E", "83 03"),  # 126
            ("10 0000 0002 04 0001", "90 03"),  # fewer bytes than promised
            ("06 0000", "86 03"),  # too short
            ("05 0000 1234", "85 03"),  # neither on nor off
        ):
            data = bytes.fromhex(pdu)
            writer.write(struct.pack(">HHHB", 7, 0, len(data) + 1, 1) + data)
            head = await reader.readexactly(7)
            assert await reader.readexactly(struct.unpack(">H", head[4:6])[0] - 1) == bytes.fromhex(expected)
        writer.close()
        assert await link.unit(1).read_holding_registers(0, count=1) == [1000]
        status = line.gateway.status()
        assert (status.gateway_listeners[0].counters.malformed, status.upstreams[0].counters.forwarded) == (5, 1)


async def test_a_request_across_the_end_of_the_addresses_is_left_to_the_device() -> None:
    async with faulty_line("tcp") as line, busway.open(line.endpoint) as link:
        assert await code_of(link.unit(1).execute(busway.ReadHoldingRegisters(399, 2))) == 2
        assert line.gateway.status().upstreams[0].counters.exceptions == 1


# --- clients that misbehave ----------------------------------------------------------------------


async def test_a_slow_loris_frees_its_place_and_disturbs_no_other() -> None:
    before = open_handles()
    async with faulty_line("tcp") as line:
        plan = line.gateway.plan
        limits = ListenerParameters(max_connections=3, frame_timeout=0.1)
        own = GatewayPlan(
            (GatewayListener("office", Listener(ANY_PORT, limits=limits)),), plan.upstreams, plan.table, own_unit=None
        )
        async with Gateway(own) as made:
            host, port = made.endpoints[0].removeprefix("tcp://").split(":")
            waiting = []
            for size in (3, 8):
                reader, writer = await asyncio.open_connection(host, int(port))
                writer.write(SLOW_LORIS.make(size=size))
                waiting.append((reader, writer))
            async with busway.open(made.endpoints[0], timeout=5) as link:
                assert await link.unit(1).read_holding_registers(3, count=1) == [1003]
                for reader, writer in waiting:
                    assert await reader.read(1) == b""  # closed
                    writer.close()
                assert await link.unit(2).read_holding_registers(3, count=1) == [2003]
                assert len(made.status().connections) == 1
            assert made.status().upstreams[0].counters.forwarded == 2
    await until(lambda: open_handles() == before)


@pytest.mark.parametrize("scheme", ["tcp", "rtu+tcp", "ascii+tcp"])
async def test_requests_that_come_in_drops_are_put_together(scheme: str) -> None:
    async with faulty_line("tcp", listener=f"{scheme}://127.0.0.1:0") as line:
        host, port = line.endpoint.rpartition("://")[2].split(":")
        reader, writer = await asyncio.open_connection(host, int(port))
        asked, expected = {
            "tcp": (bytes.fromhex("0007 0000 0006 01 03 0005 0001"), bytes.fromhex("0007 0000 0005 01 03 02 03ED")),
            "rtu+tcp": (encode_rtu(1, bytes.fromhex("03 0005 0001")), encode_rtu(1, bytes.fromhex("03 02 03ED"))),
            "ascii+tcp": (b":010300050001F6\r\n", b":01030203ED0A\r\n"),
        }[scheme]
        for at in range(len(asked)):
            writer.write(asked[at : at + 1])
            await writer.drain()
            await asyncio.sleep(0)
        assert await reader.readexactly(len(expected)) == expected
        writer.close()


async def test_glued_requests_are_all_answered_to_their_transactions_and_units() -> None:
    async with faulty_line("rtu+tcp") as line:
        host, port = line.endpoint.removeprefix("tcp://").split(":")
        reader, writer = await asyncio.open_connection(host, int(port))
        asked = {number: (1 + number % 2, 3 * number) for number in range(16)}
        writer.write(
            b"".join(
                struct.pack(">HHHBBHH", transaction, 0, 6, unit, 3, address, 1)
                for transaction, (unit, address) in asked.items()
            )
        )
        while asked:
            transaction, _, _, unit, _, _, found = struct.unpack(">HHHBBBH", await reader.readexactly(11))
            assert asked.pop(transaction) == (unit, found - 1000 * unit)
        writer.close()


@pytest.mark.parametrize(
    "junk",
    [
        bytes.fromhex("0001 0001 0006 01 03 0000 0001"),  # another protocol
        bytes.fromhex("0001 0000 0000 01 03"),  # a length outside of the limits
        bytes.fromhex("0001 0000 FFFF 01 03"),
        b"GET / HTTP/1.1\r\n\r\n",
        bytes(300),
    ],
)
async def test_foreign_traffic_reaches_no_line_and_disturbs_no_client(junk: bytes) -> None:
    async with faulty_line("tcp") as line, busway.open(line.endpoint) as link:
        assert await link.unit(1).read_holding_registers(3, count=1) == [1003]
        host, port = line.endpoint.removeprefix("tcp://").split(":")
        _, writer = await asyncio.open_connection(host, int(port))
        writer.write(junk)
        await writer.drain()
        assert await link.unit(2).read_holding_registers(3, count=1) == [2003]
        writer.close()
        assert line.gateway.status().upstreams[0].counters.forwarded == 2


async def test_two_requests_on_a_serial_listener_the_first_is_given_up_by_its_master() -> None:
    """A master that speaks again has given up; the late answer to its first request is not sent any more."""
    held_replies = HeldReplies()
    async with contextlib.AsyncExitStack() as stack:
        server = await stack.enter_async_context(busway.serve(ANY_PORT, responder=ScriptedHandler(held_replies.decide)))
        lines = {"line": server.endpoints[0]}
        made, _ = await stack.enter_async_context(gateway("rtu+tcp", only(1), lines=lines, timeout=5))
        host, port = made.endpoints[0].rpartition("://")[2].split(":")
        reader, writer = await asyncio.open_connection(host, int(port))
        writer.write(encode_rtu(1, bytes.fromhex("03 0400 0001")))
        await until(lambda: made.open_requests == 1)
        writer.write(encode_rtu(1, bytes.fromhex("03 0005 0001")))
        await until(lambda: made.status().upstreams[0].counters.abandoned == 1)
        held_replies.opened.set()
        expected = encode_rtu(1, bytes.fromhex("03 02 0005"))
        assert await reader.readexactly(len(expected)) == expected
        writer.close()
