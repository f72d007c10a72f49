"""The backend of modbus-connection: every operation, every error, what becomes of the link, and the page's example."""

import asyncio
import re
import socket
import ssl
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from handlers import ScriptedHandler, later
from modbus_connection import (
    ClientClosedError,
    ModbusConnectionError,
    ModbusError,
    ModbusExceptionError,
    ModbusSerialParams,
    ModbusTcpParams,
    ModbusTimeoutError,
    ModbusTlsParams,
    ModbusUdpParams,
    ModbusUnit,
)
from modbus_connection import IllegalDataAddressError as IllegalAddress
from modbus_connection._client import BaseModbusConnection
from waiting import until

import busway
from busway.integrations import modbus_connection as backend
from busway.testing import FaultyServer, known_device
from busway.testing.certificates import CertificateStore

ANY_PORT = "tcp://127.0.0.1:0"
PAGE = Path(__file__).parents[2] / "docs" / "how-to" / "modbus-connection.md"


def known() -> busway.Device:
    return busway.Device(
        holding_registers=[*range(100)],
        input_registers=[*range(1000, 1010)],
        coils=[True, False, True, *[False] * 20],
        discrete_inputs=[False, True],
        files={4: [7] * 10},
        fifos={3: [5, 6]},
        server_id=b"pump\xff",
        exception_status=0x55,
        identification={0: "Acme", 1: "P", 2: "1.0"},
    )


def port_of(server: busway.Server | FaultyServer) -> int:
    endpoint = server.endpoint if isinstance(server, FaultyServer) else server.endpoints[0]
    return int(endpoint.rpartition(":")[2])


async def test_every_operation_asks_the_device() -> None:
    async with busway.serve(ANY_PORT, units={1: known()}) as server:
        connection = await backend.connect_tcp("127.0.0.1", port=port_of(server))
        unit = connection.for_unit(1)
        assert isinstance(unit, ModbusUnit)
        assert await unit.read_holding_registers(2, 3) == [2, 3, 4]
        assert await unit.read_input_registers(0, 2) == [1000, 1001]
        assert await unit.read_coils(0, 3) == [True, False, True]
        assert await unit.read_discrete_inputs(0, 2) == [False, True]
        await unit.write_register(10, 77)
        await unit.write_registers(11, [78, 79])
        assert await unit.read_holding_registers(10, 3) == [77, 78, 79]
        await unit.write_coil(5, True)
        await unit.write_coils(6, [True, True])
        assert await unit.read_coils(5, 3) == [True, True, True]
        assert await unit.read_exception_status() == 0x55
        assert await unit.report_server_id() == b"pump"
        await unit.mask_write_register(10, 0, 0xFF)
        assert await unit.read_write_registers(10, 1, 20, [1]) == [0xFF]
        assert await unit.read_fifo_queue(3) == [5, 6]
        assert await unit.read_device_identification() == {0: b"Acme", 1: b"P", 2: b"1.0"}
        assert await unit.read_file_record(4, 0, 2) == [7, 7]
        await unit.write_file_record(4, 1, [9])
        assert await unit.read_file_record(4, 0, 2) == [7, 9]
        assert await unit.diagnostics(0, 0x1234) == 0x1234
        ready, count = await unit.get_comm_event_counter()
        assert ready
        assert count > 0
        assert isinstance(await unit.get_comm_event_log(), bytes)
        await connection.close()


async def test_an_exception_is_the_error_of_its_code_and_names_the_operation() -> None:
    async with busway.serve(ANY_PORT, units={1: known()}) as server:
        connection = await backend.connect_tcp("127.0.0.1", port=port_of(server))
        with pytest.raises(IllegalAddress, match=r"^read_holding_registers\(9999, 1\): ") as caught:
            await connection.for_unit(1).read_holding_registers(9999, 1)
        assert caught.value.exception_code == 2
        with pytest.raises(ModbusExceptionError, match="write_register"):
            await connection.for_unit(1).write_register(9999, 1)
        with pytest.raises(ValueError, match=r"^write_register\(0, 70000\): "):
            await connection.for_unit(1).write_register(0, 70000)
        with pytest.raises(ValueError, match=r"^diagnostics\(0, -1\): "):
            await connection.for_unit(1).diagnostics(0, -1)
        await connection.close()


@pytest.mark.parametrize("name", ["read_holding_registers", "write_register"])
async def test_silence_is_a_timeout_that_was_sent_once_and_keeps_the_link(name: str) -> None:
    handler = ScriptedHandler(later)
    async with busway.serve(ANY_PORT, responder=handler) as server:
        connection = await backend.connect_tcp("127.0.0.1", port=port_of(server), timeout=30)
        connection._timeout = 0.05  # only now: making the connection may take longer on a busy machine
        with pytest.raises(ModbusTimeoutError, match=name):
            await getattr(connection.for_unit(1), name)(0, 1)
        await until(lambda: len(handler.contexts) == 1)
        assert connection.connected
        await connection.close()


async def test_a_peer_that_goes_is_told_at_once_and_the_next_request_connects_again() -> None:
    lost: list[int] = []
    async with FaultyServer(known_device()) as server:
        connection = await backend.connect_tcp("127.0.0.1", port=port_of(server), timeout=30)
        unit = connection.for_unit(1)
        unit.on_connection_lost(lambda: lost.append(1))
        remove = unit.on_connection_lost(lambda: lost.append(2))
        remove()
        await unit.read_holding_registers(0, 1)
        server.drop_connections()
        await until(lambda: not connection.connected)
        assert lost == [1]
        await unit.read_holding_registers(0, 1)
        assert connection.connected
        await connection.close()
    assert lost == [1]


async def test_a_peer_that_is_not_there_is_a_connection_error_each_time() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))  # and does not listen
        connection = backend.ModbusConnection(ModbusTcpParams(host="127.0.0.1", port=taken.getsockname()[1]))
        for _ in range(3):
            with pytest.raises(ModbusConnectionError, match=r"could not connect to .*: nothing listens there"):
                await connection.for_unit(1).read_holding_registers(0, 1)
        await connection.close()


async def test_a_connection_that_is_dropped_or_closed_is_not_lost() -> None:
    lost: list[int] = []
    async with busway.serve(ANY_PORT, units={1: known()}) as server:
        connection = await backend.connect_tcp("127.0.0.1", port=port_of(server), timeout=30)
        connection.on_connection_lost(lambda: lost.append(1))
        unit = connection.for_unit(1)
        await unit.disconnect()
        assert not connection.connected
        assert not unit.connected
        assert await unit.read_holding_registers(1, 1) == [1]
        assert unit.connected
        await connection.close()
        await connection.close()
        with pytest.raises(ClientClosedError):
            await unit.read_holding_registers(1, 1)
    assert lost == []


async def test_a_request_in_flight_ends_when_the_connection_is_closed() -> None:
    handler = ScriptedHandler(later)
    async with busway.serve(ANY_PORT, responder=handler) as server:
        connection = await backend.connect_tcp("127.0.0.1", port=port_of(server), timeout=60)
        read = asyncio.create_task(connection.for_unit(1).read_holding_registers(0, 1))
        await until(lambda: len(handler.contexts) == 1)
        await connection.close()
        with pytest.raises(ModbusError, match=r"read_holding_registers\(0, 1\)"):
            await read


@pytest.mark.parametrize(
    ("serves", "params"),
    [
        ("udp", lambda port: ModbusUdpParams(host="127.0.0.1", port=port)),
        ("rtu+udp", lambda port: ModbusUdpParams(host="127.0.0.1", port=port, framer="rtu")),
        ("rtu+tcp", lambda port: ModbusSerialParams(device=f"socket://127.0.0.1:{port}")),
        ("ascii+tcp", lambda port: ModbusSerialParams(device=f"socket://127.0.0.1:{port}", framer="ascii")),
    ],
)
async def test_every_framing_over_a_network(serves: str, params: Callable[[int], Any]) -> None:
    async with busway.serve(f"{serves}://127.0.0.1:0", units={1: known()}) as server:
        connection = backend.ModbusConnection(params(port_of(server)), timeout=30)
        assert not connection.connected
        assert await connection.for_unit(1).read_holding_registers(7, 2) == [7, 8]
        await connection.close()


@pytest.mark.parametrize(
    ("params", "url"),
    [
        (ModbusSerialParams(device="/dev/ttyUSB0"), "rtu:///dev/ttyUSB0"),
        (ModbusSerialParams(device="/dev/ttyUSB0", framer="ascii", parity="E"), "ascii:///dev/ttyUSB0"),
        (ModbusTcpParams(host="::1"), "tcp://[::1]:502"),
        (ModbusTlsParams(host="10.0.0.5", verify=False), "tls://10.0.0.5:802"),
    ],
)
def test_parameters_become_an_endpoint_and_nothing_is_opened(params: Any, url: str) -> None:
    connection = backend.ModbusConnection(params)
    assert isinstance(connection, BaseModbusConnection)
    assert connection._link.endpoint.url == url


def test_a_port_that_is_not_there_is_a_connection_error(tmp_path: Path) -> None:
    async def refused() -> None:
        connection = backend.ModbusConnection(ModbusSerialParams(device=str(tmp_path / "gone")), timeout=30)
        with pytest.raises(ModbusConnectionError, match="could not open serial port"):
            await connection.for_unit(1).read_holding_registers(0, 1)
        await connection.close()

    asyncio.run(refused())


async def test_each_request_to_a_port_that_is_not_there_looks_whether_it_has_come(tmp_path: Path) -> None:
    connection = backend.ModbusConnection(ModbusSerialParams(device=str(tmp_path / "gone")), timeout=30)
    states: list[str] = []
    connection._link.on_state(lambda state, reason: states.append(state))
    for _ in range(3):
        with pytest.raises(ModbusConnectionError, match="could not open serial port"):
            await connection.for_unit(1).read_holding_registers(0, 1)
    assert states.count("connecting") == 3
    await connection.close()


async def test_tls_trusts_and_shows_what_the_parameters_say(tmp_path: Path) -> None:
    store = CertificateStore(tmp_path)
    ours, theirs = store.client("operator", role="Operator"), store.server()
    shown = {"client_cert": str(ours.certificate), "client_key": str(ours.key)}
    async with busway.serve(f"tls://127.0.0.1:0?{theirs.query()}", units={1: known()}) as server:
        port = port_of(server)
        connection = await backend.connect_tls("localhost", port=port, verify=str(ours.authority), **shown, timeout=30)
        unit = connection.for_unit(1)
        assert await unit.read_holding_registers(7, 1) == [7]
        await unit.disconnect()
        assert await unit.read_holding_registers(8, 1) == [8]
        await connection.close()
        with pytest.raises(ModbusConnectionError, match="could not connect"):
            await backend.connect_tls("localhost", port=port, **shown, timeout=30)
        context = ssl.create_default_context(cafile=str(ours.authority))
        context.load_cert_chain(ours.certificate, ours.key)
        connection = await backend.connect_tls("localhost", port=port, sslctx=context, timeout=30)
        assert await connection.for_unit(1).read_holding_registers(7, 1) == [7]
        await connection.close()


@pytest.mark.parametrize("unit_id", [-1, 256])
def test_a_unit_that_cannot_be_is_refused_at_once(unit_id: int) -> None:
    with pytest.raises(ValueError, match="unit"):
        backend.ModbusConnection(ModbusTcpParams(host="127.0.0.1")).for_unit(unit_id)


def test_the_unit_must_be_given() -> None:
    with pytest.raises(ValueError, match="the unit is missing"):
        backend.ModbusConnection(ModbusTcpParams(host="127.0.0.1")).for_unit(None)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("timeout", "of_connecting", "of_requests"),
    [(-1, 0.01, 0.001), (0, 0.01, 0.001), (0.005, 0.01, 0.005), (5, 5, 5), (1e6, 600, 3600)],
)
def test_a_timeout_out_of_range_is_replaced_by_the_nearer_end(
    timeout: float, of_connecting: float, of_requests: float
) -> None:
    connection = backend.ModbusConnection(ModbusTcpParams(host="127.0.0.1"), timeout=timeout)
    assert connection._link._settings.sockets.connect_timeout == of_connecting
    assert connection._call_timeout() == of_requests


@pytest.mark.parametrize("host", ["h?timeout=1", "h/?x=1", "h#x", "h@127.0.0.1", "fe80::1]?x=1"])
async def test_a_host_cannot_bring_options_or_another_host(host: str) -> None:
    for connect in (backend.connect_tcp, backend.connect_udp, backend.connect_tls):
        with pytest.raises(ValueError, match="is no host name or address"):
            await connect(host)
    with pytest.raises(ValueError, match="is no host name or address"):
        await backend.connect_serial("socket://h?timeout=1")


@pytest.mark.parametrize("host", ["plc_7.hall-2.example", "10.0.0.5", "fe80::1%eth0"])
def test_hosts_are_named_as_they_are(host: str) -> None:
    endpoint = backend.ModbusConnection(ModbusTcpParams(host=host))._link._settings.endpoint
    assert endpoint.host == host


async def test_the_example_of_the_page_prints_what_it_says(capsys: pytest.CaptureFixture[str]) -> None:
    [example] = re.findall(r"^```\n(import asyncio\n.*?)^```$", PAGE.read_text("utf-8"), re.DOTALL | re.MULTILINE)
    names: dict[str, Any] = {}
    exec(example.replace("asyncio.run(main())", ""), names)
    await names["main"]()
    assert capsys.readouterr().out.splitlines() == re.findall(r"print\(.*\)  # (.+)$", example, re.MULTILINE)
