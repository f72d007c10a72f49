"""A gateway as its clients see it, over real sockets and ports."""

import asyncio
import contextlib
import os
from collections.abc import AsyncIterator
from dataclasses import replace
from pathlib import Path

import pytest
from handlers import HeldReplies, ScriptedHandler
from scripted_peer import ScriptedPeer, first_address
from waiting import until
from whole_frames import line_of_whole_frames

import busway
from busway.apps.gateway.gateway import Gateway
from busway.apps.gateway.gateway_plan import GatewayListener, GatewayPlan, UpstreamSettings, simple_plan
from busway.apps.gateway.routes import ALL_UNITS, AddressRange, Route, RouteAction, RoutingTable
from busway.codes import Table
from busway.errors import ConfigError
from busway.framing.mbap import MbapFrame
from busway.framing.rtu import encode_rtu
from busway.options.server import ServerParameters
from busway.pdu.unknown_functions import OpaqueRequest
from busway.server.listener import Listener
from busway.server.server import Server
from busway.server.tcp import settle
from busway.testing.certificates import CertificateStore

ANY_PORT = "tcp://127.0.0.1:0"
LISTENER = GatewayListener("office", Listener(ANY_PORT))
BAUD = 115_200


def device(first: int = 0) -> busway.Device:
    return busway.Device(holding_registers=[first + n for n in range(300)], coils=[n % 3 == 0 for n in range(300)])


def plan(*routes: Route, lines: dict[str, str], listener: GatewayListener = LISTENER, **options: object) -> GatewayPlan:
    settings = tuple(UpstreamSettings.of(name, url, **options) for name, url in lines.items())
    return GatewayPlan(listeners=(listener,), upstreams=settings, table=RoutingTable(routes))


@contextlib.asynccontextmanager
async def through(made: GatewayPlan, **options: object) -> AsyncIterator[tuple[Gateway, busway.AsyncLink]]:
    async with Gateway(made) as gateway, busway.open(gateway.endpoints[0], **options) as link:
        yield gateway, link


async def code_of(asked: object) -> int:
    """The exception code that an awaitable ends with."""
    with pytest.raises(busway.ExceptionReply) as error:
        await asked  # type: ignore[misc]
    return error.value.code


@pytest.mark.clause("T32")
async def test_requests_of_all_functions_reach_the_device_and_its_answers_come_back() -> None:
    async with (
        busway.serve(ANY_PORT, units={1: device(), 2: device(1000)}) as server,
        through(simple_plan([ANY_PORT], server.endpoints[0])) as (_, link),
    ):
        one, two = link.unit(1), link.unit(2)
        assert await one.read_holding_registers(5, count=3) == [5, 6, 7]
        assert await two.read_holding_registers(5, count=3) == [1005, 1006, 1007]
        assert await one.read_coils(0, count=4) == [True, False, False, True]
        await one.write_multiple_registers(10, [7, 8])
        await one.write_single_coil(1, True)
        await one.mask_write_register(11, and_mask=0, or_mask=0xFF)
        assert await one.read_write_multiple_registers(10, count=2, write_address=10, values=[9]) == [9, 0xFF]
        assert await one.diagnostics(0, b"\x12\x34") == b"\x12\x34"
        assert await code_of(one.read_holding_registers(299, count=2)) == 2
        assert await code_of(one.execute(OpaqueRequest(0x41, b"abc"))) == 1


@pytest.mark.clause("T32")
async def test_an_unknown_function_is_forwarded_unread() -> None:
    def answer(context: busway.RequestContext, request: object) -> busway.Message:
        assert isinstance(request, OpaqueRequest)
        return OpaqueRequest(request.function, request.data[::-1])

    async with (
        busway.serve(ANY_PORT, responder=ScriptedHandler(answer)) as server,
        through(simple_plan([ANY_PORT], server.endpoints[0])) as (_, link),
    ):
        reply = await link.unit(9).execute(OpaqueRequest(0x65, b"abc"))
        assert reply.encode() == b"\x65cba"


@pytest.mark.clause("T31")
@pytest.mark.clause("T32")
async def test_what_cannot_be_asked_is_0a_and_what_does_not_answer_is_0b() -> None:
    async with ScriptedPeer(lambda peer, frame: None) as silent:
        made = plan(
            Route(upstream="silent", units=frozenset({1})),
            Route(upstream="down", units=frozenset({2})),
            lines={"silent": silent.endpoint + "?timeout=0.05", "down": "tcp://127.0.0.1:1"},
            retries=0,
        )
        async with through(made) as (gateway, link):
            assert await code_of(link.unit(3).read_holding_registers(0, count=1)) == 0x0A
            assert await code_of(link.unit(2).read_holding_registers(0, count=1)) == 0x0A
            assert await code_of(link.unit(1).read_holding_registers(0, count=1)) == 0x0B
            with pytest.raises(busway.WriteOutcomeUnknown):  # a client of ours takes 0B to a write for what it is
                await link.unit(1).write_single_register(0, 1)
            status = gateway.status()
            assert status.gateway_listeners[0].counters.no_route == 1
            assert [line.counters.no_answer for line in status.upstreams] == [2, 0]
            assert [line.counters.no_path for line in status.upstreams] == [0, 1]


@pytest.mark.clause("T32")
async def test_a_full_queue_of_a_line_is_0a_at_once() -> None:
    def only_address_100(peer: ScriptedPeer, frame: MbapFrame) -> bytes | None:
        return first_address(peer, frame) if frame.pdu[2] == 100 else None

    async with ScriptedPeer(only_address_100) as silent:
        made = simple_plan([ANY_PORT], silent.endpoint, queue=2, timeout=0.3, retries=0, share_reads=False)
        async with through(made, max_transactions=8, timeout=5) as (_, link):
            assert await link.unit(1).read_holding_registers(100, count=1) == [100]
            asked = [code_of(link.unit(1).read_holding_registers(n, count=1)) for n in range(6)]
            assert sorted(await asyncio.gather(*asked)) == [0x0A] * 3 + [0x0B] * 3


@pytest.mark.clause("T27")
@pytest.mark.clause("T32")
async def test_transaction_slots_of_the_listener_exhausted_are_06() -> None:
    async with ScriptedPeer(lambda peer, frame: None) as silent:
        made = simple_plan([ANY_PORT], silent.endpoint, timeout=0.2, retries=0, share_reads=False)
        made = GatewayPlan(
            made.listeners, made.upstreams, made.table, server={"parameters": ServerParameters(max_transactions=2)}
        )
        async with through(made, max_transactions=4, timeout=5) as (_, link):
            asked = [code_of(link.unit(1).read_holding_registers(n, count=1)) for n in range(4)]
            assert sorted(await asyncio.gather(*asked)) == [6, 6, 0x0B, 0x0B]


@pytest.mark.clause("T32")
async def test_the_gateway_itself_answers_on_unit_255_and_on_0() -> None:
    made = plan(Route(upstream="line", units=frozenset({1})), lines={"line": "tcp://127.0.0.1:1"})
    made = replace(made, own_registers=True)
    async with through(made) as (_, link):
        assert (await link.unit(255).read_device_identification())[1] == b"gateway"
        assert (await link.unit(0).read_device_identification())[0] == b"busway"
        await code_of(link.unit(1).read_holding_registers(0, count=1))
        uptime, listeners, lines = await link.unit(255).read_input_registers(1, count=3)
        assert (uptime < 60, listeners, lines) == (True, 1, 1)
        assert await link.unit(255).read("3x113", "uint32") == 1  # requests of the first line answered 0A


@pytest.mark.clause("T32")
async def test_without_an_own_unit_255_is_no_path() -> None:
    made = plan(Route(upstream="line", units=frozenset({1})), lines={"line": "tcp://127.0.0.1:1"})
    made = GatewayPlan(made.listeners, made.upstreams, made.table, own_unit=None)
    async with through(made) as (_, link):
        assert await code_of(link.unit(255).read_device_identification()) == 0x0A


async def test_routes_renumber_shift_split_refuse_and_drop() -> None:
    async with busway.serve(ANY_PORT, units={5: device()}) as server:
        made = plan(
            Route(units=frozenset({1}), functions=frozenset({6, 16}), action=RouteAction.REFUSE, code=3),
            Route(units=frozenset({1}), addresses=AddressRange(Table.COILS, 0, 10), action=RouteAction.DROP),
            Route(upstream="line", units=frozenset({1}), unit=5, shift=100, max_registers=7, max_bits=9),
            Route(upstream="line", units=frozenset({105}), unit_offset=-100),
            lines={"line": server.endpoints[0]},
        )
        async with through(made, timeout=5, retries=0) as (_, link):
            one = link.unit(1)
            assert await one.read_holding_registers(3, count=50) == list(range(103, 153))
            assert await one.read_coils(20, count=40) == [(n + 100) % 3 == 0 for n in range(20, 60)]
            assert await code_of(one.write_single_register(0, 1)) == 3
            with pytest.raises(busway.NoReply):
                await one.execute(busway.ReadCoils(0, 2), timeout=0.2)
            assert await code_of(one.read_coils(8, count=4)) == 2
            await one.mask_write_register(3, and_mask=0, or_mask=7)
            assert await link.unit(105).read_holding_registers(103, count=1) == [7]
            assert await code_of(one.read_holding_registers(65_500, count=5)) == 2


@pytest.mark.clause("T32")
@pytest.mark.real_time
async def test_a_write_to_unit_0_is_broadcast_to_the_serial_lines_and_echoed() -> None:
    with line_of_whole_frames(ports=3, baud=BAUD) as line:
        urls = [f"rtu://{path}?baud={BAUD}" for path in line.paths]
        one, two = device(), device()
        async with (
            busway.serve(urls[1], units={1: one}),
            busway.serve(urls[2], units={2: two}),
            through(simple_plan([ANY_PORT], urls[0])) as (gateway, link),
        ):
            await link.unit(0).write_multiple_registers(4, [71, 72])
            assert one.holding_registers[4:6] == two.holding_registers[4:6] == [71, 72]
            assert await link.unit(2).read_holding_registers(4, count=1) == [71]
            assert gateway.status().upstreams[0].counters.broadcasts == 1


@pytest.mark.clause("T32")
@pytest.mark.real_time
async def test_a_serial_listener_is_silent_for_units_that_it_does_not_route() -> None:
    with line_of_whole_frames(ports=2, baud=BAUD) as line:
        urls = [f"rtu://{path}?baud={BAUD}" for path in line.paths]
        async with busway.serve(ANY_PORT, units={3: device(300)}) as server:
            made = plan(
                Route(upstream="line", units=frozenset({3})),
                lines={"line": server.endpoints[0]},
                listener=GatewayListener("serial", Listener(urls[0])),
            )
            async with Gateway(made), busway.open(urls[1], timeout=5, retries=0) as link:
                assert await link.unit(3).read_holding_registers(1, count=2) == [301, 302]
                with pytest.raises(busway.NoReply):
                    await link.unit(4).execute(busway.ReadHoldingRegisters(1, 2), timeout=0.2)
                assert await link.unit(3).read_holding_registers(1, count=2) == [301, 302]


@pytest.mark.real_time
async def test_a_broadcast_of_a_serial_master_reaches_every_server_behind() -> None:
    with line_of_whole_frames(ports=2, baud=BAUD) as line:
        urls = [f"rtu://{path}?baud={BAUD}" for path in line.paths]
        one, two = device(), device()
        async with busway.serve(ANY_PORT, units={3: one, 4: two}) as server:
            made = plan(
                Route(upstream="line", units=frozenset({3, 4})),
                lines={"line": server.endpoints[0]},
                listener=GatewayListener("serial", Listener(urls[0])),
            )
            async with Gateway(made), busway.open(urls[1]) as link:
                await link.unit(0).write_single_register(9, 4711)
                await until(lambda: one.holding_registers[9] == two.holding_registers[9] == 4711)


async def test_identical_reads_in_flight_are_asked_once() -> None:
    held_replies = HeldReplies()
    async with busway.serve(ANY_PORT, responder=ScriptedHandler(held_replies.decide)) as server:
        made = simple_plan([ANY_PORT], server.endpoints[0], timeout=5)
        async with Gateway(made) as gateway, contextlib.AsyncExitStack() as stack:
            links = [
                await stack.enter_async_context(busway.open(gateway.endpoints[0], shared=False, timeout=5))
                for _ in range(5)
            ]
            asked = [asyncio.create_task(link.unit(1).read_holding_registers(1000, count=1)) for link in links]
            counters = gateway.status().upstreams[0].counters
            await until(lambda: counters.shared == 4)
            held_replies.opened.set()
            assert await asyncio.gather(*asked) == [[1000]] * 5
            assert (counters.forwarded, counters.answered) == (1, 1)


async def test_a_cached_range_is_answered_from_a_larger_block_until_a_write() -> None:
    behind = device()
    async with busway.serve(ANY_PORT, units={1: behind}) as server:
        made = plan(Route(upstream="line", cache=60.0), lines={"line": server.endpoints[0]})
        async with through(made) as (gateway, link):
            unit = link.unit(1)
            assert await unit.read_holding_registers(0, count=20) == list(range(20))
            behind.holding_registers[5] = 999  # by the device itself: may be seen later
            assert await unit.read_holding_registers(4, count=3) == [4, 5, 6]
            assert gateway.status().upstreams[0].counters.recalled == 1
            await unit.write_single_register(6, 888)
            assert await unit.read_holding_registers(4, count=3) == [4, 999, 888]


async def test_a_client_that_goes_away_takes_its_queued_requests_with_it() -> None:
    held_replies = HeldReplies()
    handler = ScriptedHandler(held_replies.decide)
    async with busway.serve(ANY_PORT, responder=handler) as server:
        made = simple_plan([ANY_PORT], server.endpoints[0], timeout=5, share_reads=False)
        async with Gateway(made) as gateway:
            leaving = busway.open(gateway.endpoints[0], max_transactions=8, timeout=5, shared=False)
            asked = [asyncio.create_task(leaving.unit(1).read_holding_registers(1000 + n, count=1)) for n in range(5)]
            await until(lambda: gateway.open_requests == 5 and handler.contexts)
            await leaving.close()
            await asyncio.gather(*asked, return_exceptions=True)
            await until(lambda: gateway.open_requests == 0)
            held_replies.opened.set()
            async with busway.open(gateway.endpoints[0], timeout=5) as link:
                assert await link.unit(1).read_holding_registers(1, count=1) == [1]
            assert gateway.status().upstreams[0].counters.abandoned == 5
            assert len(handler.contexts) == 2  # what was on the wire, and the other client's


async def test_draining_answers_what_was_asked_and_takes_nothing_new() -> None:
    held_replies = HeldReplies()
    async with busway.serve(ANY_PORT, responder=ScriptedHandler(held_replies.decide)) as server:
        gateway = Gateway(simple_plan([ANY_PORT], server.endpoints[0], timeout=5))
        await gateway.start()
        endpoint = gateway.endpoints[0]
        async with busway.open(endpoint, timeout=5) as link:
            asked = asyncio.create_task(link.unit(1).read_holding_registers(1000, count=1))
            await until(lambda: gateway.open_requests == 1)
            draining = asyncio.create_task(gateway.drain(5))
            await settle()
            await settle()  # the gateway settles too before it waits
            held_replies.opened.set()
            assert await asked == [1000]
            assert await draining == 0
        async with busway.open(endpoint, retries=0) as link:
            with pytest.raises(busway.LinkDown):
                await link.unit(1).read_holding_registers(1, count=1)


@pytest.mark.parametrize("scheme", ["udp", "rtu+udp", "rtu+tcp"])
async def test_draining_takes_nothing_new_from_any_network_listener(scheme: str) -> None:
    held_replies = HeldReplies()
    handler = ScriptedHandler(held_replies.decide)
    async with busway.serve(ANY_PORT, responder=handler) as server:
        gateway = Gateway(simple_plan([f"{scheme}://127.0.0.1:0"], server.endpoints[0], timeout=5, share_reads=False))
        await gateway.start()
        options = {"timeout": 5, "retries": 0, "shared": False}
        async with (
            busway.open(gateway.endpoints[0], **options) as link,
            busway.open(gateway.endpoints[0], **options) as late,
        ):
            await late.unit(1).read_holding_registers(1, count=1)
            asked = asyncio.create_task(link.unit(1).read_holding_registers(1000, count=1))
            await until(lambda: len(handler.contexts) == 2)
            draining = asyncio.create_task(gateway.drain(5))
            await settle()
            with pytest.raises(busway.NoReply):
                await late.unit(1).execute(busway.ReadHoldingRegisters(2, 1), timeout=0.1)
            held_replies.opened.set()
            assert await asked == [1000]
            assert await draining == 0
        assert len(handler.contexts) == 2


@pytest.mark.real_time
async def test_draining_takes_nothing_new_from_a_serial_listener() -> None:
    held_replies = HeldReplies()
    handler = ScriptedHandler(held_replies.decide)
    with line_of_whole_frames(ports=2, baud=BAUD) as line:
        urls = [f"rtu://{path}?baud={BAUD}" for path in line.paths]
        async with busway.serve(ANY_PORT, responder=handler) as server:
            gateway = Gateway(simple_plan([urls[0]], server.endpoints[0], timeout=5))
            await gateway.start()
            line.inject(encode_rtu(1, busway.ReadHoldingRegisters(1000, 1).encode()))
            await until(lambda: handler.contexts)
            draining = asyncio.create_task(gateway.drain(5))
            await settle()
            line.inject(encode_rtu(0, busway.WriteSingleRegister(1, 1).encode()))
            # Who speaks on the line has given up the first request, so draining may be over as soon as it is heard.
            await until(lambda: not gateway.open_requests or any(one.foreign for one in gateway.status().listeners))
            held_replies.opened.set()
            assert await draining == 0
        assert len(handler.contexts) == 1


async def test_draining_ends_with_its_deadline_and_says_what_is_left() -> None:
    async with ScriptedPeer(lambda peer, frame: None) as silent:
        gateway = Gateway(simple_plan([ANY_PORT], silent.endpoint, timeout=30))
        await gateway.start()
        async with busway.open(gateway.endpoints[0], timeout=30) as link:
            asked = asyncio.create_task(link.unit(1).read_holding_registers(0, count=1))
            await until(lambda: gateway.open_requests == 1)
            assert await gateway.drain(0.05) == 1
            asked.cancel()


async def test_a_change_of_routes_keeps_the_connections() -> None:
    async with busway.serve(ANY_PORT, units={1: device(), 2: device(1000)}) as server:
        lines = {"line": server.endpoints[0]}
        before = plan(Route(upstream="line", units=frozenset({1})), lines=lines)
        async with through(before) as (gateway, link):
            assert await link.unit(1).read_holding_registers(0, count=1) == [0]
            assert await code_of(link.unit(2).read_holding_registers(0, count=1)) == 0x0A
            said = await gateway.change(plan(Route(upstream="line", units=ALL_UNITS), lines=lines))
            assert said == ["1 routes"]
            assert await link.unit(2).read_holding_registers(0, count=1) == [1000]
            assert link.counters.connections == 1
            assert server.status().counters.accepted == 1


async def test_a_changed_line_is_dialled_anew_and_the_old_one_closed() -> None:
    async with (
        busway.serve(ANY_PORT, units={1: device()}) as old,
        busway.serve(ANY_PORT, units={1: device(1000)}) as new,
        through(plan(Route(upstream="line"), lines={"line": old.endpoints[0]})) as (gateway, link),
    ):
        assert await link.unit(1).read_holding_registers(0, count=1) == [0]
        said = await gateway.change(plan(Route(upstream="line"), lines={"line": new.endpoints[0]}))
        assert said == ["link line changed"]
        assert await link.unit(1).read_holding_registers(0, count=1) == [1000]
        await until(lambda: not old.status().connections)


async def test_a_change_that_cannot_be_leaves_everything_as_it_was() -> None:
    async with busway.serve(ANY_PORT, units={1: device()}) as server:
        lines = {"line": server.endpoints[0]}
        async with through(plan(Route(upstream="line"), lines=lines)) as (gateway, link):
            assert await link.unit(1).read_holding_registers(0, count=1) == [0]
            worse = GatewayPlan(
                listeners=(LISTENER, GatewayListener("taken", Listener(server.endpoints[0]))),
                upstreams=gateway.plan.upstreams,
                table=gateway.plan.table,
            )
            with pytest.raises(busway.LinkDown):
                await gateway.change(worse)
            assert await link.unit(1).read_holding_registers(1, count=1) == [1]


async def test_a_policy_is_refused_by_a_gateway_without_rules_and_nothing_changes() -> None:
    async with busway.serve(ANY_PORT, units={1: device()}) as server:
        lines = {"line": server.endpoints[0]}
        async with through(plan(Route(upstream="line"), lines=lines)) as (gateway, _):
            before = gateway.plan
            more = replace(before, listeners=(LISTENER, GatewayListener("hall", Listener(ANY_PORT))))
            for policy in (busway.Policy.read_only(), busway.Policy.allow_all()):
                with pytest.raises(ConfigError, match="made without a policy") as caught:
                    await gateway.change(more, policy=policy)
                assert caught.value.key == "policy"
                with pytest.raises(ConfigError, match="made without a policy"):
                    gateway.replace_policy(policy)
            assert gateway.plan is before
            assert len(gateway.endpoints) == 1


@pytest.mark.parametrize("when", ["before", "after"])
async def test_a_policy_that_is_replaced_while_a_listener_is_added_holds_at_the_new_one_too(
    when: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    start = Server.start

    async def start_slowly(server: Server) -> None:
        if when == "after":
            await start(server)
        gateway.replace_policy(busway.Policy.read_only())  # by another task of the program
        if when == "before":
            await start(server)

    async with busway.serve(ANY_PORT, units={1: device()}) as server:
        before = plan(Route(upstream="line"), lines={"line": server.endpoints[0]})
        async with Gateway(before, policy=busway.Policy.allow_all()) as gateway:
            monkeypatch.setattr(Server, "start", start_slowly)
            await gateway.change(
                replace(before, listeners=(*before.listeners, GatewayListener("new", Listener(ANY_PORT))))
            )
            for endpoint in gateway.endpoints:
                async with busway.open(endpoint) as link:
                    with pytest.raises(busway.ExceptionReply, match="exception 01"):
                        await link.unit(1).write_single_register(0, 1)


async def test_an_object_that_is_not_a_policy_is_refused_and_the_policy_before_holds() -> None:
    async with busway.serve(ANY_PORT, units={1: device()}) as server:
        before = plan(Route(upstream="line"), lines={"line": server.endpoints[0]})
        async with Gateway(before, policy=busway.Policy.read_only()) as gateway:
            with pytest.raises(ConfigError, match="must be a Policy"):
                gateway.replace_policy("allow")  # type: ignore[arg-type]
            await gateway.change(
                replace(before, listeners=(*before.listeners, GatewayListener("new", Listener(ANY_PORT))))
            )
            async with busway.open(gateway.endpoints[1]) as link:
                with pytest.raises(busway.ExceptionReply, match="exception 01"):
                    await link.unit(1).write_single_register(0, 1)


async def test_new_certificates_hold_for_each_listener_whose_files_can_be_used(tmp_path: Path) -> None:
    store = CertificateStore(tmp_path)
    files = {name: store.server(name) for name in ("first", "second", "third")}
    listeners = tuple(
        GatewayListener(name, Listener(f"tls://127.0.0.1:0?{each.query()}")) for name, each in files.items()
    )
    async with Gateway(GatewayPlan(listeners=listeners, upstreams=(), table=RoutingTable(()))) as gateway:
        for name in ("first", "third"):
            files[name].certificate.write_text("nothing")
        store.authority.server(["localhost"], name="newer").write(files["second"].certificate, files["second"].key)
        with pytest.raises(ConfigError, match=r"first\.pem: certificate"):
            gateway.reload_security()
        subjects = [each.security.subject for each in gateway.status().listeners if each.security is not None]
        assert subjects == ["CN=first", "CN=newer", "CN=third"]


async def test_several_connections_to_one_server_share_the_clients_and_keep_each_clients_order() -> None:
    async with busway.serve(ANY_PORT, units={1: device()}) as server:
        made = simple_plan([ANY_PORT], server.endpoints[0], connections=3, max_transactions=16)
        async with Gateway(made) as gateway, contextlib.AsyncExitStack() as stack:
            links = [
                await stack.enter_async_context(busway.open(gateway.endpoints[0], shared=False, max_transactions=16))
                for _ in range(6)
            ]
            for link in links:
                found = await asyncio.gather(*(link.unit(1).read_holding_registers(n, count=1) for n in range(40)))
                assert found == [[n] for n in range(40)]
            assert len(server.status().connections) == 3


@pytest.mark.skipif(not hasattr(os, "openpty"), reason="needs a pseudo-terminal")
async def test_a_start_that_an_upstream_fails_closes_the_upstreams_before_it(tmp_path: Path) -> None:
    master, slave = os.openpty()
    port = f"rtu://{os.ttyname(slave)}"
    lines = {"line": port, "far": f"tls://127.0.0.1:1?authority={tmp_path / 'none.pem'}"}
    gateway = Gateway(plan(Route(upstream="line"), lines=lines))
    try:
        with pytest.raises(ConfigError, match=r"none\.pem"):
            await gateway.start()
        assert not gateway.is_running
        assert gateway.status().upstreams == ()
        async with busway.open(port) as link:
            await link.connect()
    finally:
        os.close(slave)
        os.close(master)


@pytest.mark.parametrize(
    ("made", "sentence"),
    [
        (
            lambda: plan(Route(upstream="nowhere"), lines={"line": "tcp://127.0.0.1:1"}),
            "there is no line 'nowhere', but line",
        ),
        (lambda: GatewayPlan((), (), RoutingTable(())), "at least one listener"),
        (
            lambda: plan(Route(upstream="line", listeners=frozenset({"x"})), lines={"line": "tcp://127.0.0.1:1"}),
            "there is no listener 'x', but office",
        ),
    ],
)
def test_a_plan_that_does_not_fit_together_is_refused(made: object, sentence: str) -> None:
    with pytest.raises(busway.ConfigError, match=sentence):
        made()  # type: ignore[operator]
