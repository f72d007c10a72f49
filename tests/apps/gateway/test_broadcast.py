"""Writes to unit 0: which lines hear them, which must not, and what the client is told."""

import asyncio
import contextlib
from collections.abc import AsyncIterator

import pytest
from handlers import ScriptedHandler
from scripted_peer import ScriptedPeer
from waiting import until

import busway
from busway.access.rules import AccessKind, Policy, Rule
from busway.access.rules import Action as Judged
from busway.apps.gateway.gateway import Gateway
from busway.apps.gateway.gateway_plan import GatewayListener, GatewayPlan, UpstreamSettings
from busway.apps.gateway.routes import AddressRange, Route, RouteAction, RoutingTable
from busway.codes import Table
from busway.framing.mbap import encode_mbap
from busway.pdu.functions import AnyRequest
from busway.server.listener import Listener

ANY_PORT = "tcp://127.0.0.1:0"
LISTENER = GatewayListener("office", Listener(ANY_PORT))
OTHERS = frozenset(range(1, 248))

pytestmark = pytest.mark.clause("T32")


class Bus:
    """A line over a network (RTU frames in TCP) with units 1 and 2, which keeps what was written on it."""

    def __init__(self) -> None:
        self.devices = {
            unit: busway.Device(holding_registers=[100 * unit + n for n in range(100)], coils=50) for unit in (1, 2)
        }
        self.url = ""

    def registers(self, first: int, count: int) -> list[list[int]]:
        """What both hold."""
        return [list(device.holding_registers[first : first + count]) for device in self.devices.values()]


@contextlib.asynccontextmanager
async def bus() -> AsyncIterator[Bus]:
    made = Bus()
    async with busway.serve("rtu+tcp://127.0.0.1:0", units=made.devices) as server:
        made.url = server.endpoints[0]
        yield made


@contextlib.asynccontextmanager
async def gateway(
    *routes: Route,
    lines: dict[str, str],
    listener: GatewayListener = LISTENER,
    own_unit: int | None = 255,
    **options: object,
) -> AsyncIterator[tuple[Gateway, busway.AsyncLink]]:
    settings = tuple(
        UpstreamSettings.of(name, url, **({"turnaround_delay": 0.01} if url.startswith("rtu") else {}), **options)
        for name, url in lines.items()
    )
    plan = GatewayPlan(listeners=(listener,), upstreams=settings, table=RoutingTable(routes), own_unit=own_unit)
    async with Gateway(plan) as made:
        endpoint = made.endpoints[0]
        calls = {"max_transactions": 4} if endpoint.startswith("tcp") else {}
        async with busway.open(endpoint, timeout=3.0, retries=0, **calls) as link:
            yield made, link


async def refusal(asked: object) -> int:
    with pytest.raises(busway.ExceptionReply) as error:
        await asked  # type: ignore[misc]
    return error.value.code


async def test_every_write_that_may_be_broadcast_is_echoed_as_a_device_would_answer_it() -> None:
    async with bus() as line, gateway(Route(upstream="line", units=OTHERS), lines={"line": line.url}) as (_, link):
        all_units = link.unit(0)
        await all_units.write_single_register(0, 7)
        await all_units.write_multiple_registers(1, [8, 9])
        await all_units.write_single_coil(3, True)
        await all_units.write_multiple_coils(4, [True, False, True])
        await all_units.mask_write_register(0, and_mask=0x00FF, or_mask=0x100)
        assert line.registers(0, 3) == [[0x107, 8, 9]] * 2
        for device in line.devices.values():
            assert list(device.coils[3:7]) == [True, True, False, True]


async def test_the_echo_comes_after_the_broadcast_was_sent_and_the_turnaround_is_over() -> None:
    async with (
        bus() as line,
        gateway(Route(upstream="line", units=OTHERS), lines={"line": line.url}) as (made, link),
    ):
        asked = asyncio.create_task(link.unit(0).write_single_register(5, 55))
        await until(lambda: made.open_requests == 1)
        read = asyncio.create_task(link.unit(2).read_holding_registers(5, count=1))
        await asked
        assert line.registers(5, 1) == [[55], [55]]
        assert await read == [55]


async def test_silence_is_an_option_and_the_write_is_made_all_the_same() -> None:
    listener = GatewayListener("office", Listener(ANY_PORT), silent_broadcasts=True)
    async with (
        bus() as line,
        gateway(Route(upstream="line", units=OTHERS), lines={"line": line.url}, listener=listener) as (made, link),
    ):
        asked = asyncio.create_task(link.unit(0).write_single_register(5, 55))
        await until(lambda: line.registers(5, 1) == [[55], [55]] and not made.open_requests)
        assert await link.unit(1).read_holding_registers(5, count=1) == [55]  # nothing else in between
        assert not asked.done()
        asked.cancel()


async def test_a_silent_listener_still_says_that_a_broadcast_was_not_sent() -> None:
    listener = GatewayListener("office", Listener(ANY_PORT), silent_broadcasts=True)
    async with gateway(
        Route(upstream="down", units=OTHERS), lines={"down": "rtu+tcp://127.0.0.1:1"}, listener=listener
    ) as (
        _,
        link,
    ):
        assert await refusal(link.unit(0).write_single_register(5, 55)) == 0x0A


async def test_several_lines_hear_it_each_once_and_lines_of_other_listeners_do_not() -> None:
    async with bus() as one, bus() as two, bus() as foreign:
        listeners = (LISTENER, GatewayListener("other", Listener(ANY_PORT)))
        plan = GatewayPlan(
            listeners=listeners,
            upstreams=tuple(
                UpstreamSettings.of(name, line.url, turnaround_delay=0.01)
                for name, line in {"one": one, "two": two, "foreign": foreign}.items()
            ),
            table=RoutingTable(
                (
                    Route(upstream="one", listeners=frozenset({"office"}), units=frozenset({1, 2})),
                    Route(upstream="two", listeners=frozenset({"office"}), units=frozenset({11, 12}), unit_offset=-10),
                    Route(upstream="foreign", listeners=frozenset({"other"})),
                )
            ),
        )
        async with Gateway(plan) as made, busway.open(made.endpoints[0], timeout=3) as link:
            await link.unit(0).write_single_register(5, 55)
            assert one.registers(5, 1) == two.registers(5, 1) == [[55], [55]]
            assert foreign.registers(5, 1) == [[105], [205]]
            assert [line.counters.broadcasts for line in made.status().upstreams] == [1, 1, 0]
            assert made.status().gateway_listeners[0].counters.broadcasts == 1


async def test_one_of_two_lines_that_is_down_is_told_and_the_other_hears_it() -> None:
    async with (
        bus() as line,
        gateway(
            Route(upstream="line", units=frozenset({1, 2})),
            Route(upstream="down", units=frozenset({3})),
            lines={"line": line.url, "down": "rtu+tcp://127.0.0.1:1"},
        ) as (_, link),
    ):
        assert await refusal(link.unit(0).write_single_register(5, 55)) == 0x0A
        assert line.registers(5, 1) == [[55], [55]]


async def test_a_server_on_tcp_hears_it_only_if_it_is_told_to() -> None:
    heard: list[int] = []

    def answer(context: busway.RequestContext, request: AnyRequest) -> busway.Message:
        heard.append(context.unit)
        assert isinstance(request, busway.WriteSingleRegister)
        return request

    async with busway.serve(ANY_PORT, responder=ScriptedHandler(answer)) as server:
        lines = {"tcp": server.endpoints[0]}
        async with gateway(Route(upstream="tcp", units=OTHERS), lines=lines) as (_, link):
            assert await refusal(link.unit(0).write_single_register(5, 55)) == 0x0A
        assert heard == []
        async with gateway(Route(upstream="tcp", units=OTHERS), lines=lines, broadcast=True) as (_, link):
            await link.unit(0).write_single_register(5, 55)
        assert heard == [0]


async def test_unit_0_of_a_server_on_tcp_is_written_where_a_route_says_so() -> None:
    device = busway.Device(holding_registers=10)
    async with (
        busway.serve(ANY_PORT, units={0: device}) as server,
        gateway(Route(upstream="tcp", units=frozenset({0})), lines={"tcp": server.endpoints[0]}) as (_, link),
    ):
        await link.unit(0).write_single_register(5, 55)
        assert await link.unit(0).read_holding_registers(5, count=1) == [55]


# --- what a line must not hear -------------------------------------------------------------------


@pytest.mark.parametrize(
    "routes",
    [
        [Route(upstream="line", units=OTHERS, functions=frozenset({1, 2, 3, 4}))],
        [
            Route(units=OTHERS, functions=frozenset({5, 6, 15, 16, 22, 23}), action=RouteAction.REFUSE),
            Route(upstream="line", units=OTHERS),
        ],
        [
            Route(units=frozenset({0}), functions=frozenset({6}), action=RouteAction.REFUSE),
            Route(upstream="line", units=OTHERS),
        ],
        [
            Route(units=frozenset({2}), functions=frozenset({6}), action=RouteAction.REFUSE),
            Route(upstream="line", units=OTHERS),
        ],
        [
            Route(upstream="line", units=frozenset({1})),
            Route(upstream="line", units=frozenset({2}), functions=frozenset({3})),
        ],
        [Route(upstream="line", units=OTHERS, addresses=AddressRange(Table.HOLDING_REGISTERS, 0, 5))],
    ],
    ids=["reads only", "writes refused", "unit 0 refused", "one unit refused", "one unit reads only", "out of range"],
)
async def test_what_may_not_be_written_to_a_unit_is_not_written_to_all(routes: list[Route]) -> None:
    async with bus() as line, gateway(*routes, lines={"line": line.url}) as (_, link):
        assert await refusal(link.unit(0).write_single_register(5, 55)) in (0x01, 0x0A)
        assert line.registers(5, 1) == [[105], [205]]
        assert await link.unit(1).read_holding_registers(0, count=1) == [100]


async def test_a_dropped_broadcast_is_neither_sent_nor_answered() -> None:
    async with (
        bus() as line,
        gateway(
            Route(units=frozenset({0}), action=RouteAction.DROP),
            Route(upstream="line", units=OTHERS),
            lines={"line": line.url},
        ) as (made, link),
    ):
        asked = asyncio.create_task(link.unit(0).write_single_register(5, 55))
        await until(lambda: made.status().gateway_listeners[0].counters.dropped == 1)
        assert await link.unit(1).read_holding_registers(5, count=1) == [105]
        assert not asked.done()
        asked.cancel()


async def test_addresses_are_moved_and_long_writes_split_as_for_one_unit() -> None:
    route = Route(upstream="line", units=OTHERS, shift=10, max_registers=2, split_writes=True)
    async with bus() as line, gateway(route, lines={"line": line.url}) as (made, link):
        await link.unit(0).write_multiple_registers(5, [1, 2, 3, 4, 5])
        assert line.registers(15, 5) == [[1, 2, 3, 4, 5]] * 2
        assert line.registers(5, 5) == [[105 + n for n in range(5)], [205 + n for n in range(5)]]
        assert made.status().upstreams[0].links[0].counters.requests == 3
        assert await refusal(link.unit(0).write_single_register(65_530, 1)) == 2


async def test_units_that_want_it_under_different_addresses_cannot_be_written_at_once() -> None:
    async with (
        bus() as line,
        gateway(
            Route(upstream="line", units=frozenset({1})),
            Route(upstream="line", units=frozenset({2}), shift=10),
            lines={"line": line.url},
        ) as (_, link),
    ):
        assert await refusal(link.unit(0).write_single_register(5, 55)) == 0x0A
        assert line.registers(5, 1) == [[105], [205]]


async def test_a_route_may_lead_one_unit_to_all_of_a_line() -> None:
    async with (
        bus() as line,
        gateway(
            Route(upstream="line", units=frozenset({200}), unit=0),
            Route(upstream="line", units=frozenset({1, 2})),
            lines={"line": line.url},
        ) as (_, link),
    ):
        await link.unit(200).write_multiple_registers(5, [55, 56])
        await link.unit(200).write_single_register(7, 57)
        assert line.registers(5, 3) == [[55, 56, 57]] * 2
        assert await refusal(link.unit(200).read_holding_registers(5, count=1)) == 0x0A


@pytest.mark.clause("M6")
@pytest.mark.parametrize("scheme", ["tcp", "rtu+tcp"])
async def test_a_policy_that_keeps_a_client_from_one_unit_keeps_it_from_writing_to_all(scheme: str) -> None:
    rules = (Rule(name="hands off", action=Judged.DENY, units=frozenset({2}), functions=frozenset({(6, None)})),)
    policy = Policy(rules, default=Judged.ALLOW)
    async with bus() as line:
        plan = GatewayPlan(
            listeners=(GatewayListener("office", Listener(f"{scheme}://127.0.0.1:0")),),
            upstreams=(UpstreamSettings.of("line", line.url, turnaround_delay=0.01),),
            table=RoutingTable((Route(upstream="line", units=frozenset({1, 2})),)),
        )
        async with Gateway(plan, policy=policy) as made, busway.open(made.endpoints[0], timeout=3) as link:
            if scheme == "tcp":
                assert await refusal(link.unit(0).write_single_register(5, 55)) == 1
            else:
                await link.unit(0).write_single_register(5, 55)
                await until(lambda: made.status().gateway_listeners[0].counters.refused == 1)
            await link.unit(1).write_single_register(6, 66)
            assert line.registers(5, 2) == [[105, 66], [205, 206]]
            if scheme == "tcp":
                await link.unit(0).write_single_coil(5, True)
                assert [device.coils[5] for device in line.devices.values()] == [True, True]


@pytest.mark.clause("M6")
@pytest.mark.parametrize("scheme", ["tcp", "rtu+tcp"])
@pytest.mark.parametrize("units", [frozenset({2}), frozenset({1, 2}), None])
async def test_the_rate_of_a_rule_holds_for_broadcasts_each_of_which_counts_once(
    scheme: str, units: frozenset[int] | None
) -> None:
    rules = (Rule(name="slowly", action=Judged.ALLOW, units=units, rate=2.0, access=AccessKind.WRITE),)
    policy = Policy(rules, default=Judged.ALLOW)
    async with bus() as line:
        plan = GatewayPlan(
            listeners=(GatewayListener("office", Listener(f"{scheme}://127.0.0.1:0")),),
            upstreams=(UpstreamSettings.of("line", line.url, turnaround_delay=0.01),),
            table=RoutingTable((Route(upstream="line", units=frozenset({1, 2})),)),
        )
        async with Gateway(plan, policy=policy) as made, busway.open(made.endpoints[0], timeout=3) as link:
            for guard in made._running.values():
                assert guard.authorizer is not None
                guard.authorizer._clock = lambda: 0.0  # no time passes: two are allowed, and no third one
            all_units = link.unit(0)
            await all_units.write_single_register(5, 55)
            await all_units.write_single_register(6, 66)
            if scheme == "tcp":
                assert await refusal(all_units.write_single_register(7, 77)) == 6
            else:
                await all_units.write_single_register(7, 77)
                await until(lambda: made.status().upstreams[0].counters.broadcasts == 2)
                with pytest.raises(busway.ExceptionReply, match="exception 06"):
                    await link.unit(2).write_single_register(8, 88)
            assert line.registers(5, 3) == [[55, 66, 107], [55, 66, 207]]


# --- serial masters ------------------------------------------------------------------------------


async def test_a_serial_listener_reaches_serial_lines_once_and_servers_on_tcp_unit_by_unit() -> None:
    on_tcp = {unit: busway.Device(holding_registers=10) for unit in (5, 6)}
    heard: list[bytes] = []

    def answer(peer: ScriptedPeer, frame: object) -> bytes:
        heard.append(frame.pdu)  # type: ignore[attr-defined]
        return encode_mbap(frame.transaction, frame.unit, frame.pdu)  # type: ignore[attr-defined]

    listener = GatewayListener("office", Listener("rtu+tcp://127.0.0.1:0"))
    async with bus() as line, busway.serve(ANY_PORT, units=on_tcp) as server, ScriptedPeer(answer) as told:
        async with gateway(
            Route(upstream="line", units=frozenset({1, 2})),
            Route(upstream="tcp", units=frozenset({5, 6})),
            Route(upstream="told", units=frozenset({7}), functions=frozenset({3})),
            lines={"line": line.url, "tcp": server.endpoints[0], "told": told.endpoint},
            listener=listener,
        ) as (made, link):
            await link.unit(0).write_multiple_registers(3, [33, 34])
            await until(lambda: not made.open_requests and on_tcp[6].holding_registers[3] == 33)
            await until(lambda: line.registers(3, 2) == [[33, 34]] * 2)
            assert [list(one.holding_registers[3:5]) for one in on_tcp.values()] == [[33, 34]] * 2
            assert made.status().upstreams[0].links[0].counters.requests == 1
            assert await link.unit(5).read_holding_registers(3, count=1) == [33]  # and no unit has answered
            assert link.counters.foreign_replies == 0
        assert heard == []


async def test_a_serial_listener_whose_route_names_no_units_reaches_a_server_on_tcp_once() -> None:
    heard: list[int] = []

    def answer(context: busway.RequestContext, request: AnyRequest) -> busway.Message:
        heard.append(context.unit)
        assert isinstance(request, busway.WriteSingleRegister)
        return request

    listener = GatewayListener("office", Listener("rtu+tcp://127.0.0.1:0"))
    async with bus() as line, busway.serve(ANY_PORT, responder=ScriptedHandler(answer)) as server:
        async with gateway(
            Route(upstream="line", units=frozenset({1, 2})),
            Route(upstream="tcp"),
            lines={"line": line.url, "tcp": server.endpoints[0]},
            listener=listener,
        ) as (made, link):
            await link.unit(0).write_single_register(3, 33)
            await until(lambda: line.registers(3, 1) == [[33], [33]] and heard and not made.open_requests)
            await link.unit(9).write_single_register(3, 33)
        assert heard == [0, 9]


async def test_units_that_lead_elsewhere_do_not_keep_a_line_from_hearing_it() -> None:
    async with (
        bus() as one,
        bus() as two,
        gateway(
            Route(upstream="one", units=frozenset({1})),
            Route(upstream="two", units=OTHERS),
            lines={"one": one.url, "two": two.url},
        ) as (_, link),
    ):
        await link.unit(0).write_single_register(5, 55)
        assert one.registers(5, 1) == two.registers(5, 1) == [[55], [55]]


async def test_a_serial_listener_must_not_write_to_all_what_it_may_not_write_to_one() -> None:
    listener = GatewayListener("office", Listener("rtu+tcp://127.0.0.1:0"))
    async with (
        bus() as line,
        gateway(
            Route(upstream="line", units=frozenset({1})),
            Route(upstream="line", units=frozenset({2}), functions=frozenset({3})),
            lines={"line": line.url},
            listener=listener,
        ) as (made, link),
    ):
        await link.unit(0).write_single_register(3, 33)
        await until(lambda: made.status().gateway_listeners[0].counters.refused == 1)
        assert await link.unit(1).read_holding_registers(3, count=1) == [103]
        assert line.registers(3, 1) == [[103], [203]]


# --- clients that go away ------------------------------------------------------------------------


async def test_a_client_that_goes_away_takes_its_queued_broadcasts_with_it() -> None:
    async with bus() as line, ScriptedPeer(lambda peer, frame: None) as stuck:
        lines = {"line": line.url, "stuck": stuck.endpoint}
        plan = GatewayPlan(
            listeners=(LISTENER,),
            upstreams=(
                UpstreamSettings.of("line", lines["line"], turnaround_delay=0.01),
                UpstreamSettings.of("stuck", lines["stuck"], broadcast=True, timeout=5.0),
            ),
            table=RoutingTable(
                (Route(upstream="line", units=frozenset({1, 2})), Route(upstream="stuck", units=frozenset({3, 4})))
            ),
        )
        async with Gateway(plan) as made:
            leaving = busway.open(made.endpoints[0], max_transactions=8, timeout=5, shared=False)
            asked = [asyncio.create_task(leaving.unit(0).write_single_register(n, n)) for n in range(4)]
            await until(lambda: made.open_requests == 4 and len(stuck.frames) == 1 and line.registers(3, 1)[0] == [3])
            await leaving.close()
            await asyncio.gather(*asked, return_exceptions=True)
            await until(lambda: made.open_requests == 1)  # what is on the wire
            status = made.status().upstreams[1]
            assert (status.counters.abandoned, status.links[0].queued) == (4, 0)
            async with busway.open(made.endpoints[0], timeout=3) as link:
                assert await link.unit(1).read_holding_registers(3, count=1) == [3]
