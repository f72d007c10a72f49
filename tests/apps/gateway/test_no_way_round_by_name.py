"""Ways round the policy of a gateway, one by one: reads that are shared or remembered, other units, broadcasts."""

import asyncio
import contextlib
import json
import struct
from collections.abc import AsyncIterator, Sequence
from pathlib import Path
from typing import Any

import pytest
from foreign_servers import free_port
from plain_device import PlainDevice, RecordingServer
from policy_clients import PlainClient
from waiting import until

import busway
from busway import Policy, Rule
from busway.apps.gateway.configuration import parse_gateway
from busway.apps.gateway.gateway import Gateway
from busway.apps.gateway.gateway_plan import GatewayListener, GatewayPlan, UpstreamSettings
from busway.apps.gateway.routes import Route, RoutingTable
from busway.codes import Table
from busway.server.listener import Listener

ANY = "tcp://127.0.0.1:0"
MAY, MAY_NOT = "127.0.0.2", "127.0.0.3"
READ = b"\x03\x00\x00\x00\x04"
WRITE = b"\x06\x00\x01\x00\x07"
ONLY_ONE = Policy.of(Rule.of(name="may", peers=[MAY]), default="deny")

pytestmark = pytest.mark.clause("M6")


def denied(pdu: bytes, code: int = 1) -> bytes:
    return bytes((pdu[0] | 0x80, code))


@contextlib.asynccontextmanager
async def gateway(
    behind: str, *routes: Route, policy: Policy, listen: str = ANY, audit: busway.AuditLog | None = None, **options: Any
) -> AsyncIterator[tuple[Gateway, PlainClient, PlainClient]]:
    """A gateway, a client that may and one that may not."""
    lines = (UpstreamSettings.of("line", behind, turnaround_delay=0.01, **options),) if behind.startswith("rtu") else ()
    lines = lines or (UpstreamSettings.of("line", behind, **options),)
    plan = GatewayPlan((GatewayListener("all", Listener(listen)),), lines, RoutingTable(routes))
    async with Gateway(plan, policy=policy, audit=audit) as made:
        clients = [await PlainClient.dial(made.endpoints[0], host) for host in (MAY, MAY_NOT)]
        try:
            yield made, clients[0], clients[1]
        finally:
            for client in clients:
                client.close()


def send(client: PlainClient, pdu: bytes, unit: int = 1, times: int = 1) -> None:
    client.send(b"".join(client.frame(7, unit, pdu) for _ in range(times)))


async def ask(client: PlainClient, pdu: bytes, unit: int = 1, times: int = 1) -> list[bytes]:
    """Send the same request so often in one segment; the replies."""
    send(client, pdu, unit, times)
    return [reply.pdu for reply in await client.receive(times)]


def route(**options: Any) -> Route:
    return Route(upstream="line", **({"units": frozenset({1, 2})} | options))


@pytest.mark.parametrize("cache", [None, 60.0])
@pytest.mark.parametrize("share", [True, False])
async def test_a_read_in_flight_or_remembered_is_denied_to_who_may_not(cache: float | None, share: bool) -> None:
    async with (
        RecordingServer({1: PlainDevice()}) as behind,
        gateway(behind.url, route(cache=cache), policy=ONLY_ONE, share_reads=share) as (_, may, may_not),
    ):
        for _ in range(3):
            behind.hold()
            asked = len(behind.record)
            send(may, READ)
            await until(lambda asked=asked: len(behind.record) > asked or cache)
            assert await ask(may_not, READ, times=8) == [denied(READ)] * 8  # before the device has answered
            behind.release()
            assert (await may.receive())[0].pdu[0] == 3
            seen = len(behind.record)
            assert await ask(may_not, READ, times=8) == [denied(READ)] * 8
            assert await ask(may_not, struct.pack(">BHH", 3, 1, 2)) == [b"\x83\x01"]  # a part of it
            assert len(behind.record) == seen


@pytest.mark.parametrize("cache", [None, 60.0])
async def test_a_right_that_is_taken_away_holds_for_reads_that_were_planned_shared_or_remembered(
    cache: float | None,
) -> None:
    async with (
        RecordingServer({1: PlainDevice()}) as behind,
        gateway(behind.url, route(cache=cache), policy=Policy.allow_all()) as (made, may, may_not),
    ):
        for _ in range(3):
            for _ in range(40):
                assert denied(READ) not in await ask(may_not, READ, times=8)
            made.replace_policy(ONLY_ONE)
            seen = len(behind.record)
            assert await ask(may_not, READ, times=12) == [denied(READ)] * 12
            assert await ask(may_not, WRITE, times=2) == [denied(WRITE)] * 2
            assert len(behind.record) == seen
            assert denied(READ) not in await ask(may, READ, times=8)
            made.replace_policy(Policy.allow_all())


async def test_a_read_that_waits_for_anothers_is_answered_though_the_policy_changes_and_the_next_is_denied() -> None:
    async with (
        RecordingServer({1: PlainDevice()}) as behind,
        gateway(behind.url, route(), policy=Policy.allow_all()) as (made, may, other),
    ):
        behind.hold()
        send(may, READ)
        send(other, READ)
        await until(lambda: made.status().upstreams[0].counters.shared == 1)
        made.replace_policy(ONLY_ONE)
        send(other, READ)
        assert [(await other.receive())[0].pdu] == [denied(READ)]  # the later one, before the device answers
        behind.release()
        assert [(await client.receive())[0].pdu[0] for client in (may, other)] == [3, 3]


async def test_a_rule_of_the_gateway_and_one_of_the_server_behind_are_both_obeyed(tmp_path: Path) -> None:
    """The server sees unit 9 and addresses from 100 on; the gateway is asked for unit 1 and addresses from 0 on."""
    audit = busway.AuditLog(tmp_path / "audit.jsonl", interval=0, repeat_interval=0)
    served = busway.Device(holding_registers=200)
    inner = Policy.of(Rule.of(name="inner", action="deny", units=9, addresses="holding:105-106"), default="allow")
    outer = Policy.of(Rule.of(name="outer", action="deny", units=1, addresses="holding:3-4", code=2), default="allow")
    async with (
        busway.serve(ANY, units={9: served}, policy=inner) as server,
        gateway(
            server.endpoints[0],
            route(units=frozenset({1}), unit=9, shift=100, cache=60.0),
            policy=outer,
            audit=audit,
        ) as (_, one, other),
    ):
        for client in (one, other, one):
            seen = [(await ask(client, struct.pack(">BHH", 3, n, 1)))[0] for n in range(9)]
            assert [reply[1] if reply[0] & 0x80 else 0 for reply in seen] == [0, 0, 0, 2, 2, 1, 1, 0, 0]
            written = [(await ask(client, struct.pack(">BHH", 6, n, 7)))[0] for n in range(9)]
            assert [reply[1] if reply[0] & 0x80 else 0 for reply in written] == [0, 0, 0, 2, 2, 1, 1, 0, 0]
        assert [served.holding_registers[100 + n] for n in range(9)] == [7, 7, 7, 0, 0, 0, 0, 7, 7]
    audit.close()
    lines = [json.loads(line) for line in (tmp_path / "audit.jsonl").read_text().splitlines()]
    denials = [(line["address"], line["function"], line["rule"]) for line in lines if line["outcome"] == "denied"]
    assert sorted(denials) == sorted([(n, function, "outer") for n in (3, 4) for function in (3, 6)] * 3)
    refused = [(line["address"], line["rule"]) for line in lines if line["outcome"] == "exception"]
    assert sorted(refused) == sorted([(n, "default") for n in (5, 6)] * 3)  # by the server behind


@pytest.mark.parametrize("asked", [0, 255])
async def test_what_a_rule_says_of_the_own_unit_holds_for_unit_0_too(asked: int, tmp_path: Path) -> None:
    audit = busway.AuditLog(tmp_path / "audit.jsonl", interval=0, repeat_interval=0)
    policy = Policy.of(Rule.of(name="own", action="deny", units=255, peers=[MAY_NOT]), default="allow")
    async with gateway("tcp://127.0.0.1:1", route(), policy=policy, audit=audit) as (_, may, may_not):
        for pdu in (b"\x11", b"\x2b\x0e\x01\x00", b"\x08\x00\x0b\x00\x00"):
            assert (await ask(may, pdu, asked))[0][0] == pdu[0]
            assert await ask(may_not, pdu, asked) == [denied(pdu)]
    audit.close()
    lines = [json.loads(line) for line in (tmp_path / "audit.jsonl").read_text().splitlines()]
    assert [(line["outcome"], line["rule"], line["unit"]) for line in lines if line["outcome"] == "denied"] == [
        ("denied", "own", asked)
    ] * 3


@pytest.mark.parametrize("named", [0, 1, 2])
async def test_a_broadcast_that_one_unit_may_not_hear_is_denied_counted_and_recorded_as_any_request(
    named: int, tmp_path: Path
) -> None:
    audit = busway.AuditLog(tmp_path / "audit.jsonl", interval=0, repeat_interval=0)
    devices = {unit: busway.Device(holding_registers=10) for unit in (1, 2)}
    policy = Policy.of(Rule.of(name="hands off", action="deny", units=named, peers=[MAY_NOT]), default="allow")
    async with (
        busway.serve("rtu+tcp://127.0.0.1:0", units=devices) as line,
        gateway(line.endpoints[0], route(), policy=policy, audit=audit) as (made, may, may_not),
    ):
        for _ in range(2):
            assert await ask(may_not, WRITE, 0) == [denied(WRITE)]
            assert [device.holding_registers[1] for device in devices.values()] == [0, 0]
        assert await ask(may, WRITE, 0) == [WRITE]
        assert [device.holding_registers[1] for device in devices.values()] == [7, 7]
        refusals = [dict(server.status().refusals) for server in made.servers]
        assert refusals == [{"hands off": 2}]
    audit.close()
    lines = [json.loads(line) for line in (tmp_path / "audit.jsonl").read_text().splitlines()]
    assert [(line["outcome"], line["rule"], line["code"]) for line in lines] == [
        ("denied", "hands off", 1),
        ("denied", "hands off", 1),
        ("done", "default", None),
    ]


async def test_a_broadcast_that_one_of_two_lines_may_not_hear_is_heard_by_neither() -> None:
    devices = {unit: busway.Device(holding_registers=10) for unit in (1, 2)}
    policy = Policy.of(Rule.of(name="hands off", action="deny", units=2), default="allow")
    async with (
        busway.serve("rtu+tcp://127.0.0.1:0", units={1: devices[1]}) as one,
        busway.serve("rtu+tcp://127.0.0.1:0", units={2: devices[2]}) as two,
    ):
        lines = {"one": one.endpoints[0], "two": two.endpoints[0]}
        plan = GatewayPlan(
            (GatewayListener("all", Listener(ANY)),),
            tuple(UpstreamSettings.of(name, url, turnaround_delay=0.01) for name, url in lines.items()),
            RoutingTable(tuple(Route(upstream=name, units=frozenset({n})) for n, name in enumerate(lines, 1))),
        )
        async with Gateway(plan, policy=policy) as made:
            client = await PlainClient.dial(made.endpoints[0], MAY)
            assert await ask(client, WRITE, 0) == [denied(WRITE)]
            assert (await ask(client, READ, 1))[0][0] == 3
            assert [device.holding_registers[1] for device in devices.values()] == [0, 0]
            client.close()


async def test_a_unit_whose_route_leads_to_all_of_a_line_is_no_way_to_one_that_may_not_be_written() -> None:
    devices = {unit: busway.Device(holding_registers=10) for unit in (1, 2)}
    policy = Policy.of(Rule.of(name="hands off", action="deny", units=2, peers=[MAY_NOT]), default="allow")
    async with (
        busway.serve("rtu+tcp://127.0.0.1:0", units=devices) as line,
        gateway(line.endpoints[0], route(units=frozenset({200}), unit=0), route(), policy=policy) as (_, may, may_not),
    ):
        assert await ask(may_not, WRITE, 200) == [denied(WRITE)]
        assert [device.holding_registers[1] for device in devices.values()] == [0, 0]
        assert await ask(may, WRITE, 200) == [WRITE]
        assert [device.holding_registers[1] for device in devices.values()] == [7, 7]


async def test_rates_are_counted_for_all_listeners_and_connections_of_a_host_and_for_each_host_by_itself() -> None:
    policy = Policy.of(Rule.of(name="slowly", rate=4), default="deny")
    async with RecordingServer({1: PlainDevice()}) as behind:
        plan = GatewayPlan(
            tuple(GatewayListener(f"listener {n}", Listener(ANY)) for n in range(2)),
            (UpstreamSettings.of("line", behind.url),),
            RoutingTable((route(cache=60.0),)),
        )
        async with Gateway(plan, policy=policy) as made:
            hosts = (MAY, MAY, MAY_NOT)
            clients = [await PlainClient.dial(made.endpoints[n % 2], host) for n, host in enumerate(hosts)]
            loop = asyncio.get_running_loop()
            began = loop.time()
            replies = [*await ask(clients[0], READ, times=6), *await ask(clients[1], READ, times=6)]
            permitted = sum(reply[0] == 3 for reply in replies)
            assert 4 <= permitted <= 4 + 4 * (loop.time() - began)
            assert [reply[0] for reply in await ask(clients[2], READ, times=4)] == [3] * 4
            for client in clients:
                client.close()


@pytest.mark.parametrize("named", [1, 2, 3])
async def test_a_serial_masters_broadcast_that_a_line_may_not_hear_is_recorded_as_denied_alone(
    named: int, tmp_path: Path
) -> None:
    audit = busway.AuditLog(tmp_path / "audit.jsonl", interval=0, repeat_interval=0)
    devices = {unit: busway.Device(holding_registers=10) for unit in (1, 2, 3)}
    policy = Policy.of(Rule.of(name="hands off", action="deny", units=named, functions=[6]), default="allow")
    async with (
        busway.serve("rtu+tcp://127.0.0.1:0", units=devices) as line,
        gateway(
            line.endpoints[0],
            route(units=frozenset({1, 2, 3})),
            policy=policy,
            audit=audit,
            listen="rtu+tcp://127.0.0.1:0",
        ) as (_, master, _),
    ):
        send(master, WRITE, 0)
        assert (await ask(master, READ))[0][:2] == b"\x03\x08"  # what came before it is done
        assert [device.holding_registers[1] for device in devices.values()] == [0, 0, 0]
    audit.close()
    lines = [json.loads(line) for line in (tmp_path / "audit.jsonl").read_text().splitlines()]
    assert {(line["outcome"], line["rule"]) for line in lines} == {("denied", "hands off")}
    assert named in {line["unit"] for line in lines}


async def test_a_rule_of_a_file_names_a_listener_on_every_address_by_its_name() -> None:
    port = free_port()
    async with RecordingServer({1: PlainDevice()}) as behind:
        configuration = parse_gateway(
            f"""
            [[listener]]
            name = "office"
            url = "tcp://:{port}"
            [[link]]
            name = "line"
            url = "{behind.url}"
            [policy]
            default = "allow"
            [[policy.rule]]
            action = "deny"
            listeners = ["office"]
            """,
            "x.toml",
        )
        async with configuration.serve(standard_port=False) as made:
            client = await PlainClient.dial(made.endpoints[0], MAY)
            assert await ask(client, READ) == [denied(READ)]
            assert not behind.record
            client.close()


# ---- functions of a user's own


class Scale(busway.Request):
    """65: multiplies a register; it declares all that it touches."""

    code = 0x41
    is_write = True
    reads = busway.Touch(Table.HOLDING_REGISTERS, count=None)
    writes = busway.Touch(Table.HOLDING_REGISTERS, count=None)
    address: int = busway.u16()
    factor: int = busway.u16(1, 100)

    class Reply(busway.ReplyMessage):
        """The product."""

        value: int = busway.u16()


class Average(busway.Request):
    """66: a read."""

    code = 0x42
    reads = busway.Touch(Table.HOLDING_REGISTERS)
    address: int = busway.u16()
    count: int = busway.u16(1, 100)

    class Reply(busway.ReplyMessage):
        """The average."""

        value: int = busway.u16()


class Clear(busway.Request):
    """67: reads what it declares, and writes what it does not declare."""

    code = 0x43
    is_write = True
    reads = busway.Touch(Table.HOLDING_REGISTERS)
    address: int = busway.u16()
    count: int = busway.u16(1, 100)

    class Reply(busway.ReplyMessage):
        """What was there."""

        value: int = busway.u16()


class Mystery(busway.Request):
    """68: declares nothing."""

    code = 0x44
    address: int = busway.u16()
    count: int = busway.u16(1, 100)

    class Reply(busway.ReplyMessage):
        """Anything."""

        value: int = busway.u16()


OWN = busway.STANDARD.with_functions(Scale, Average, Clear, Mystery)
NOT_KNOWN = 0x45
GOOD = b"\x00\x01\x00\x02"
"""Holding registers 1 and 2, or register 1 twice as much."""
BROKEN = (b"", b"\x00\x01", b"\x00\x01\x00\x00", b"\x00\x01\xff\xff", b"\x00\x01\x00\x02\x00", b"\xff\xff\x00\x00")


@pytest.mark.parametrize(
    ("policy", "good", "broken"),
    [
        (Policy.allow_all(), (0, 0, 0, 0, 0), (3, 3, 3, 3, 0)),
        (Policy.read_only(), (1, 0, 1, 1, 1), (1, 3, 1, 1, 1)),
        # A broken request may mean any item: one that is denied, or one that none permits.
        (
            Policy.of(Rule.of(action="deny", addresses="holding:4", code=2), default="allow"),
            (0, 0, 0, 0, 0),
            (2, 2, 2, 3, 0),
        ),
        (Policy.of(Rule.of(addresses="holding:0-3")), (0, 0, 1, 1, 1), (1, 1, 1, 1, 1)),
        (
            Policy.of(Rule.of(action="deny", addresses="holding:1-2"), default="allow"),
            (1, 1, 1, 0, 0),
            (1, 1, 1, 3, 0),
        ),
        # What the function would write is not known, so it is in no limits.
        (Policy.of(Rule.of(table="holding", values=(0, 0xFFFF)), default="allow"), (1, 0, 0, 0, 0), (1, 3, 3, 3, 0)),
    ],
)
async def test_broken_requests_of_own_functions_are_judged_by_all_that_they_may_mean_and_go_nowhere(
    policy: Policy, good: Sequence[int], broken: Sequence[int]
) -> None:
    """Exception codes by function, 65 to 68 and one that is not known; 0: it was forwarded."""
    async with RecordingServer({1: PlainDevice()}) as behind:
        plan = GatewayPlan(
            (GatewayListener("all", Listener(ANY)),),
            (UpstreamSettings.of("line", behind.url, retries=0, write_retries=0),),
            RoutingTable((route(),)),
            functions=OWN,
        )
        async with Gateway(plan, policy=policy) as made:
            client = await PlainClient.dial(made.endpoints[0], MAY)
            for data, codes in ((GOOD, good), *((each, broken) for each in BROKEN), (GOOD, good)):
                for function, code in zip((0x41, 0x42, 0x43, 0x44, NOT_KNOWN), codes, strict=True):
                    seen = len(behind.record)
                    (reply,) = await ask(client, bytes((function,)) + data)
                    assert len(behind.record) == seen + (not code), (function, data, reply)
                    if code:
                        assert reply == bytes((function | 0x80, code)), data
            client.close()
