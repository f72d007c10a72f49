"""The gateway between programs that are not ours: their clients in front, their serial servers behind.

Each foreign serial server stands on a line of its own; the lines are units 1, 2 and 3 of one gateway in front of them.
"""

import asyncio
import re
import shutil
import subprocess
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import foreign
import pytest
from serial_peers import UNIT, new_line, start_server, url_of

from busway.apps.gateway.gateway import Gateway
from busway.apps.gateway.gateway_plan import GatewayListener, GatewayPlan, UpstreamSettings
from busway.apps.gateway.routes import Route, RoutingTable
from busway.server.listener import Listener

SERVERS = {1: "libmodbus-rtu", 2: "pymodbus-rtu", 3: "pymodbus-ascii"}
CLIENTS = {
    "libmodbus": lambda port, unit: foreign.c_peer("libmodbus_client", "tcp", "127.0.0.1", port, unit),
    "pymodbus": lambda port, unit: foreign.python_peer("pymodbus_client.py", "tcp", "127.0.0.1", port, unit),
}
CONTENT = foreign.CONTENT


@contextmanager
def running(plan: GatewayPlan) -> Iterator[int]:
    """The port of a gateway that runs in a thread of its own."""
    ready = threading.Event()
    ends: dict[str, object] = {}

    async def serve() -> None:
        stop = asyncio.Event()
        async with Gateway(plan) as gateway:
            ends.update(loop=asyncio.get_running_loop(), stop=stop, port=int(gateway.endpoints[0].rpartition(":")[2]))
            ready.set()
            await stop.wait()

    thread = threading.Thread(target=asyncio.run, args=(serve(),))
    thread.start()
    assert ready.wait(10)
    try:
        yield ends["port"]  # type: ignore[misc]
    finally:
        ends["loop"].call_soon_threadsafe(ends["stop"].set)  # type: ignore[attr-defined]
        thread.join()


@pytest.fixture(scope="module")
def gateway_port() -> Iterator[int]:
    with ExitStack() as stack:
        lines = []
        for unit, kind in SERVERS.items():
            wire = stack.enter_context(new_line())
            stack.enter_context(start_server(kind, wire.paths[1]))
            lines.append(UpstreamSettings.of(f"line {unit}", url_of(kind.split("-")[1], wire.paths[0]), timeout=2.0))
        plan = GatewayPlan(
            listeners=(GatewayListener("office", Listener("tcp://127.0.0.1:0")),),
            upstreams=tuple(lines),
            table=RoutingTable(
                tuple(Route(upstream=f"line {unit}", units=frozenset({unit}), unit=UNIT) for unit in SERVERS)
            ),
        )
        yield stack.enter_context(running(plan))


@pytest.fixture(scope="module", params=CLIENTS)
def client_kind(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(scope="module", params=SERVERS, ids=SERVERS.get)
def client(client_kind: str, gateway_port: int, request: pytest.FixtureRequest) -> Iterator[foreign.Program]:
    with CLIENTS[client_kind](gateway_port, request.param) as program:
        yield program


@pytest.mark.clause("T32")
@pytest.mark.parametrize("table", CONTENT)
@pytest.mark.parametrize(("address", "count"), [(0, 1), (17, 16), (3, 125)])
def test_a_foreign_client_reads_a_foreign_server(client: foreign.Program, table: str, address: int, count: int) -> None:
    assert client.ask(f"read_{table} {address} {count}")["values"] == CONTENT[table][address : address + count]


def test_what_a_foreign_client_writes_is_what_it_reads(client: foreign.Program) -> None:
    assert client.ask("write_single_coil 500 1")["ok"]
    assert client.ask("write_multiple_coils 501 1 0 1")["ok"]
    assert client.ask("read_coils 500 4")["values"] == [True, True, False, True]
    assert client.ask("write_single_register 500 4711")["ok"]
    assert client.ask("write_multiple_registers 501 1 2 3")["ok"]
    assert client.ask("read_holding_registers 500 4")["values"] == [4711, 1, 2, 3]
    assert client.ask("read_write_multiple_registers 500 2 501 9")["values"] == [4711, 9]


def test_an_exception_of_the_foreign_server_comes_through(client: foreign.Program) -> None:
    answer = client.ask("read_holding_registers 990 11")
    assert (answer["ok"], answer["exception"]) == (False, 2)


@pytest.mark.parametrize("client_name", CLIENTS)
def test_a_unit_without_a_route_is_told_to_a_foreign_client(client_name: str, gateway_port: int) -> None:
    with CLIENTS[client_name](gateway_port, 9) as program:
        answer = program.ask("read_holding_registers 0 1")
        assert (answer["ok"], answer["exception"]) == (False, 0x0A)


@pytest.mark.parametrize("unit", SERVERS)
def test_mbpoll_polls_through_the_gateway(unit: int, gateway_port: int) -> None:
    program = shutil.which("mbpoll")
    if program is None:
        foreign.missing("no mbpoll (Debian: mbpoll)")
    command = [program, "-m", "tcp", "-p", str(gateway_port), "-a", str(unit), "-0", "-1", "-o", "5", "-t", "4"]
    finished = subprocess.run(
        [*command, "-r", "7", "-c", "10", "127.0.0.1"],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=foreign.LIMIT,
        check=False,
    )
    assert finished.returncode == 0, finished.stderr
    found = [int(value) for value in re.findall(r"^\[\d+\]:\s+(\d+)", finished.stdout, re.MULTILINE)]
    assert found == CONTENT["holding_registers"][7:17]
