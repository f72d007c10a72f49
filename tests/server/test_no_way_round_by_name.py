"""Ways round a policy, one by one: the same bytes by other hands, on other ways, at other moments."""

import json
import struct
import time
from pathlib import Path
from typing import Any

import pytest
from foreign_servers import free_port
from policy_clients import PlainClient
from waiting import until

import busway
from busway import Policy, Rule
from busway.apps.service.configuration import parse_configuration
from busway.testing.line import PacedLine

ANY = "tcp://127.0.0.1:0"
MAY, MAY_NOT = "127.0.0.2", "127.0.0.3"
READ = b"\x03\x00\x00\x00\x04"
ZONE = Policy.of(
    Rule.of(name="zone", peers=[MAY], addresses="holding:10-19"),
    Rule.of(name="bits", peers=[MAY], addresses="coil:10-19"),
    default="deny",
)
"""What `MAY` may touch is 10…19; `MAY_NOT` may touch nothing."""

pytestmark = pytest.mark.clause("M6")


@pytest.fixture
def unused_port() -> int:
    """A port that nothing listens on."""
    return free_port()


def device() -> busway.Device:
    return busway.Device(holding_registers=[100 + n for n in range(40)], coils=40, input_registers=40)


def registers(first: int, *values: int) -> bytes:
    return b"\x10" + struct.pack(f">HHB{len(values)}H", first, len(values), 2 * len(values), *values)


def coils(first: int, count: int) -> bytes:
    size = (count + 7) // 8
    return b"\x0f" + struct.pack(">HHB", first, count, size) + b"\xff" * size


async def ask(client: PlainClient, *pdus: bytes, unit: int = 1) -> list[bytes]:
    """Send requests in one segment, all with one transaction; the replies in their order."""
    client.send(b"".join(client.frame(7, unit, pdu) for pdu in pdus))
    return [reply.pdu for reply in await client.receive(len(pdus))]


def denied(pdu: bytes, code: int = 1) -> bytes:
    return bytes((pdu[0] | 0x80, code))


def lines_of(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines()]


@pytest.mark.parametrize("warm", [False, True])
@pytest.mark.parametrize(
    ("inside", "beyond"),
    [
        (struct.pack(">BHH", 3, 10, 10), struct.pack(">BHH", 3, 10, 11)),
        (struct.pack(">BHH", 3, 10, 1), struct.pack(">BHH", 3, 9, 2)),
        (struct.pack(">BHH", 3, 19, 1), struct.pack(">BHH", 3, 20, 1)),
        (struct.pack(">BHH", 1, 10, 10), struct.pack(">BHH", 1, 11, 10)),
        (b"\x06\x00\x13\x00\x07", b"\x06\x00\x14\x00\x07"),
        (b"\x05\x00\x0a\xff\x00", b"\x05\x00\x09\xff\x00"),
        (registers(18, 1, 2), registers(19, 1, 2)),
        (registers(10, 1, 2), registers(9, 1, 2)),
        (coils(10, 10), coils(10, 11)),
        (coils(10, 10), coils(9, 11)),
        (b"\x16\x00\x13\x00\xff\x01\x00", b"\x16\x00\x14\x00\xff\x01\x00"),
        (b"\x17\x00\x0a\x00\x0a" + registers(19, 5)[1:], b"\x17\x00\x0a\x00\x0b" + registers(19, 5)[1:]),
        (b"\x17\x00\x13\x00\x01" + registers(18, 5, 6)[1:], b"\x17\x00\x13\x00\x01" + registers(19, 5, 6)[1:]),
    ],
)
async def test_a_request_that_ends_one_item_beyond_its_zone_is_denied_whole(
    inside: bytes, beyond: bytes, warm: bool
) -> None:
    served = device()
    async with busway.serve(ANY, units={1: served}, policy=ZONE) as server:
        first, other = [await PlainClient.dial(server.endpoints[0], host) for host in (MAY, MAY_NOT)]
        if warm:
            assert set(await ask(first, *[inside] * 20)) == {(await ask(first, inside))[0]}
        before = list(served.holding_registers), list(served.coils)
        assert await ask(first, beyond, beyond) == [denied(beyond)] * 2
        assert await ask(other, inside, beyond) == [denied(inside), denied(beyond)]
        assert (list(served.holding_registers), list(served.coils)) == before
        (reply,) = await ask(first, inside)
        assert not reply[0] & 0x80
        first.close()
        other.close()


@pytest.mark.parametrize("pdu", [READ, b"\x06\x00\x01\x00\x07", registers(0, 1, 2), b"\x01\x00\x00\x00\x08"])
async def test_what_one_client_has_asked_a_thousand_times_is_denied_to_the_next_and_the_other_way_round(
    pdu: bytes,
) -> None:
    policy = Policy.of(Rule.of(name="may", peers=[MAY]), default="deny")
    async with busway.serve(ANY, units={1: device()}, policy=policy) as server:
        first, other = [await PlainClient.dial(server.endpoints[0], host) for host in (MAY, MAY_NOT)]
        for _ in range(2):
            for _ in range(12):
                assert denied(pdu) not in await ask(first, *[pdu] * 100)
            for _ in range(12):
                assert await ask(other, *[pdu] * 100) == [denied(pdu)] * 100
        first.close()
        other.close()


@pytest.mark.parametrize("audited", [False, True])
@pytest.mark.parametrize("pdu", [READ, b"\x06\x00\x01\x00\x07", registers(0, 1, 2), b"\x16\x00\x01\xff\xff\x00\x00"])
async def test_a_right_that_is_taken_away_or_given_holds_for_the_next_bytes_of_an_open_connection(
    pdu: bytes, audited: bool, tmp_path: Path
) -> None:
    audit = busway.AuditLog(tmp_path / "audit.jsonl", interval=0) if audited else None
    async with busway.serve(ANY, units={1: device()}, policy=Policy.allow_all(), audit=audit) as server:
        client = await PlainClient.dial(server.endpoints[0], MAY)
        for _ in range(3):
            assert denied(pdu) not in await ask(client, *[pdu] * 300)
            server.replace_policy(Policy.of(Rule.of(name="no", action="deny", peers=[MAY]), default="allow"))
            assert await ask(client, *[pdu] * 300) == [denied(pdu)] * 300
            server.replace_policy(Policy.allow_all())
        client.close()
    if audit is not None:
        audit.close()


async def test_a_hook_that_replaces_the_policy_is_obeyed_by_the_rest_of_the_segment() -> None:
    served = device()
    async with busway.serve(ANY, units={1: served}, policy=Policy.allow_all()) as server:

        @served.on_write("coils", when="after")
        def lock(change: object) -> None:
            server.replace_policy(Policy.of(default="deny"))

        client = await PlainClient.dial(server.endpoints[0], MAY)
        write = b"\x06\x00\x05\x00\x63"
        assert (await ask(client, READ, READ, write))[0][:2] == b"\x03\x08"  # all of it is known now
        locking = b"\x05\x00\x01\xff\x00"
        replies = await ask(client, READ, locking, READ, write, b"\x04\x00\x00\x00\x01", READ)
        assert replies[1] == locking
        assert replies[2:] == [denied(READ), denied(write), b"\x84\x01", denied(READ)]
        client.close()


async def test_a_rate_counts_what_the_fast_path_has_answered_before_and_each_host_has_its_own() -> None:
    rule = Rule.of(name="slowly", rate=5)
    async with busway.serve(ANY, units={1: device()}, policy=Policy.allow_all()) as server:
        one, same, other = [await PlainClient.dial(server.endpoints[0], host) for host in (MAY, MAY, MAY_NOT)]
        for client in (one, same, other):
            assert denied(READ, 6) not in await ask(client, *[READ] * 400)
        server.replace_policy(Policy.of(rule, default="deny"))
        began = time.monotonic()
        replies = [*await ask(one, *[READ] * 40), *await ask(same, *[READ] * 40), *await ask(one, *[READ] * 40)]
        passed = time.monotonic() - began
        assert 5 <= 120 - replies.count(denied(READ, 6)) <= 5 + 5 * passed  # a second's worth, and what came back
        assert denied(READ, 6) not in await ask(other, *[READ] * 3)
        for client in (one, same, other):
            client.close()


@pytest.mark.parametrize("asked", [1, 2, 0, 255])
@pytest.mark.parametrize("named", [1, 2])
async def test_a_rule_about_one_unit_of_a_device_holds_for_all_units_that_it_is_listed_as(
    named: int, asked: int
) -> None:
    served, policy = device(), Policy.of(Rule.of(name="no", action="deny", units=named), default="allow")
    async with busway.serve(ANY, units={1: served, 2: served}, policy=policy) as server:
        client = await PlainClient.dial(server.endpoints[0], MAY)
        for pdu in (READ, b"\x06\x00\x01\x00\x07", b"\x16\x00\x01\xff\xff\x00\x00", b"\x11"):
            assert await ask(client, pdu, pdu, unit=asked) == [denied(pdu)] * 2
        client.close()


async def test_units_of_another_device_are_not_concerned() -> None:
    served, policy = device(), Policy.of(Rule.of(name="no", action="deny", units=2), default="allow")
    async with busway.serve(ANY, units={1: served, 2: served, 3: device()}, policy=policy) as server:
        client = await PlainClient.dial(server.endpoints[0], MAY)
        assert [(await ask(client, READ, unit=unit))[0][0] for unit in (1, 2, 3)] == [0x83, 0x83, 3]
        client.close()


@pytest.mark.parametrize("units", ["0", "1", "2", "0-2"])
async def test_a_broadcast_on_a_line_is_written_where_no_rule_denies_it_to_the_unit_or_to_unit_0(
    units: str, tmp_path: Path
) -> None:
    audit = busway.AuditLog(tmp_path / "audit.jsonl", interval=0, repeat_interval=0)
    both = {1: device(), 2: device()}
    rule = Rule.of(name="no", action="deny", units=units, functions=[6])
    policy = Policy.of(rule, default="allow")
    async with busway.serve("rtu+tcp://127.0.0.1:0", units=both, policy=policy, audit=audit) as server:
        client = await PlainClient.dial(server.endpoints[0], MAY)
        client.send(client.frame(0, 0, b"\x06\x00\x01\x00\x07"))
        await until(lambda: len(lines_of(tmp_path / "audit.jsonl")) == 2)
        client.close()
    audit.close()
    written = {unit for unit, served in both.items() if served.holding_registers[1] == 7}
    assert written == {"0": set(), "1": {2}, "2": {1}, "0-2": set()}[units]
    outcomes = {line["unit"]: line["outcome"] for line in lines_of(tmp_path / "audit.jsonl")}
    assert outcomes == {unit: "done" if unit in written else "denied" for unit in both}


async def test_a_right_to_unit_0_is_no_right_to_the_units_that_hear_it() -> None:
    served = device()
    policy = Policy.of(Rule.of(name="all", units=0), Rule.of(name="two", units=2), default="deny")
    async with busway.serve("rtu+tcp://127.0.0.1:0", units={1: served, 2: device()}, policy=policy) as server:
        client = await PlainClient.dial(server.endpoints[0], MAY)
        client.send(client.frame(0, 0, b"\x06\x00\x01\x00\x07"))
        assert (await ask(client, READ, unit=2))[0][0] == 3  # what came before it is done
        assert served.holding_registers[1] == 101
        client.close()


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost", "", "0.0.0.0"])
@pytest.mark.parametrize("scheme", ["tcp", "udp"])
async def test_a_rule_names_a_listener_as_it_was_configured_or_as_it_is_bound(
    scheme: str, host: str, unused_port: int
) -> None:
    url = f"{scheme}://{host}:{unused_port}"
    policy = Policy.of(Rule.of(name="no", action="deny", listeners=[url]), default="allow")
    async with busway.serve(url, ANY, units={1: device()}, policy=policy, standard_port=False) as server:
        inside = await PlainClient.dial(server.endpoints[-1], MAY)
        client = await PlainClient.dial(f"{scheme}://127.0.0.1:{unused_port}", MAY)
        assert await ask(client, READ) == [denied(READ)]
        assert (await ask(inside, READ))[0][0] == 3
        for bound in server.endpoints[:-1]:
            server.replace_policy(Policy.of(Rule.of(name="no", action="deny", listeners=[bound]), default="allow"))
            assert await ask(client, READ) == [denied(READ)]
        client.close()
        inside.close()


async def test_two_hosts_by_udp_and_two_listeners_of_one_host_are_told_apart() -> None:
    policy = Policy.of(
        Rule.of(name="by udp", peers=[MAY], listeners=["udp://"]),
        Rule.of(name="by tcp", peers=[MAY_NOT], listeners=["tcp://"]),
        default="deny",
    )
    async with busway.serve(ANY, "udp://127.0.0.1:0", units={1: device()}, policy=policy) as server:
        by_tcp, by_udp = server.endpoints
        for _ in range(3):
            for endpoint, host, allowed in (
                (by_udp, MAY, True),
                (by_udp, MAY_NOT, False),
                (by_tcp, MAY, False),
                (by_tcp, MAY_NOT, True),
            ):
                client = await PlainClient.dial(endpoint, host)
                for _ in range(5):
                    assert ((await ask(client, READ))[0][0] == 3) is allowed
                client.close()


async def test_repeated_denials_are_all_in_the_audit_log_by_their_number(tmp_path: Path) -> None:
    audit = busway.AuditLog(tmp_path / "audit.jsonl", interval=0)
    policy = Policy.of(Rule.of(name="no", action="deny", peers=[MAY_NOT]), default="allow")
    async with busway.serve(ANY, units={1: device()}, policy=policy, audit=audit) as server:
        first, other = [await PlainClient.dial(server.endpoints[0], host) for host in (MAY, MAY_NOT)]
        for _ in range(10):
            await ask(first, *[READ] * 7)
            assert await ask(other, *[READ] * 7) == [denied(READ)] * 7
        first.close()
        other.close()
    audit.close()
    lines = lines_of(tmp_path / "audit.jsonl")
    assert {(line["outcome"], line["rule"], line["peer"].rpartition(":")[0]) for line in lines} == {
        ("denied", "no", MAY_NOT)
    }
    assert sum(line.get("repeated", 1) for line in lines) == 70


@pytest.mark.real_time
async def test_a_serial_line_beside_a_network_has_the_rights_of_a_line() -> None:
    policy = Policy.of(
        Rule.of(name="hosts", peers=["0.0.0.0/0"], action="read-only"),
        Rule.of(name="line", listeners=["rtu://"], addresses="holding:10-19"),
        default="deny",
    )
    served = device()
    with PacedLine(ports=2, baud=115_200) as line:
        near, far = (f"rtu://{path}?baud=115200" for path in line.paths)
        async with (
            busway.serve(ANY, far, units={1: served}, policy=policy) as server,
            busway.open(near, timeout=5) as link,
        ):
            client = await PlainClient.dial(server.endpoints[0], MAY)
            write = b"\x06\x00\x0a\x00\x07"
            for _ in range(3):
                assert await ask(client, write) == [denied(write)]
                assert served.holding_registers[10] != 7
                await link.unit(1).write_single_register(10, 7)
                assert served.holding_registers[10] == 7
                served.holding_registers[10] = 1
                assert (await ask(client, READ))[0][0] == 3
                with pytest.raises(busway.ExceptionReply, match="exception 01"):
                    await link.unit(1).read_holding_registers(0, count=4)
            client.close()


async def test_a_program_that_serves_a_file_obeys_its_policy_and_its_address_lists() -> None:
    configuration = parse_configuration(
        f"""
        listen = ["{ANY}"]
        [[unit]]
        unit = 1
        holding_registers = 10
        [policy]
        default = "deny"
        deny = ["127.0.0.4"]
        [[policy.rule]]
        peers = ["{MAY}"]
        """,
        "x.toml",
    )
    async with configuration.serve() as server:
        first, other = [await PlainClient.dial(server.endpoints[0], host) for host in (MAY, MAY_NOT)]
        assert (await ask(first, READ))[0][0] == 3
        assert await ask(other, READ) == [denied(READ)]
        stranger = await PlainClient.dial(server.endpoints[0], "127.0.0.4")
        await until(lambda: stranger.lost)
        first.close()
        other.close()
    async with configuration.serve(policy=None) as server:
        other = await PlainClient.dial(server.endpoints[0], MAY_NOT)
        assert (await ask(other, READ))[0][0] == 3
        other.close()
