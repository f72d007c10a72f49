"""Servers and clients of pymodbus' names over TLS and serial ports: real handshakes, real ports."""

import asyncio
import threading
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager
from pathlib import Path
from typing import Any

import pytest
from whole_frames import line_of_whole_frames

import busway
from busway.compat.pymodbus import client as clients
from busway.compat.pymodbus import server as servers
from busway.compat.pymodbus.datastore import ModbusDeviceContext, ModbusSequentialDataBlock, ModbusServerContext
from busway.compat.pymodbus.exceptions import ConnectionException
from busway.testing.certificates import CertificateFiles, CertificateStore

FRAMERS = pytest.mark.parametrize("framer", ["rtu", "ascii"])


@pytest.fixture
def store(tmp_path: Path) -> CertificateStore:
    return CertificateStore(tmp_path)


def new_context() -> ModbusServerContext:
    block = ModbusSequentialDataBlock(1, [7, 8, 9, 10])
    return ModbusServerContext(devices={1: ModbusDeviceContext(hr=block)}, single=False)


def files_of(found: CertificateFiles) -> dict[str, Any]:
    return {
        "sslctx": clients.ModbusTlsClient.generate_ssl(str(found.certificate), str(found.key)),
        "authority": str(found.authority),
    }


async def listening(task: "asyncio.Task[None]") -> servers.ModbusBaseServer:
    """Return the server that a task has started; the function that it runs tells nothing."""
    while (server := servers.ModbusBaseServer.active_server) is None or not server._server.is_running:
        if task.done():
            await task
        await asyncio.sleep(0.001)
    return server


@asynccontextmanager
async def started(start: Callable[..., Any], **names: Any) -> AsyncIterator[servers.ModbusBaseServer]:
    """Serve a context by one of the functions that start a server; it ends by `ServerAsyncStop`."""
    task = asyncio.create_task(start(context=new_context(), **names))
    server = await listening(task)
    try:
        yield server
    finally:
        await servers.ServerAsyncStop()
        await task


def port_of(server: servers.ModbusBaseServer) -> int:
    return int(server.endpoints[0].partition("?")[0].rpartition(":")[2])


def reads_and_writes(client: Any) -> None:
    """Read what the context holds, write, and read it back, with the blocking client."""
    with client:
        assert client.connected
        assert client.read_holding_registers(0, count=4, device_id=1).registers == [7, 8, 9, 10]
        assert not client.write_register(1, 500, device_id=1).isError()
        assert client.read_holding_registers(1, count=1, device_id=1).registers == [500]
        assert client.read_holding_registers(4, count=1, device_id=1).isError()
    assert not client.connected


async def test_a_server_over_tls_serves_clients_with_certificates_and_verifies_them(store: CertificateStore) -> None:
    names = files_of(store.server())
    own = files_of(store.client())
    async with started(servers.StartAsyncTlsServer, address=("127.0.0.1", 0), **names) as server:
        port = port_of(server)
        await asyncio.to_thread(reads_and_writes, clients.ModbusTlsClient("127.0.0.1", port=port, timeout=60, **own))
        unverified = clients.ModbusTlsClient("127.0.0.1", port=port, timeout=60, sslctx=own["sslctx"])
        await asyncio.to_thread(reads_and_wrote, unverified)
        client = clients.AsyncModbusTlsClient("localhost", port=port, timeout=60, **own)
        async with client:
            found = await client.read_holding_registers(0, count=2, device_id=1)
            assert found.registers == [7, 500]


def reads_and_wrote(client: Any) -> None:
    with client:
        assert client.read_holding_registers(0, count=2, device_id=1).registers == [7, 500]


@pytest.mark.parametrize("wrong", ["no certificate", "a foreign certificate", "a foreign server"])
async def test_a_handshake_that_must_fail_is_no_connection(store: CertificateStore, wrong: str) -> None:
    served = store.server(authority=store.foreign) if wrong == "a foreign server" else store.server()
    own = files_of(store.client(authority=store.foreign if wrong == "a foreign certificate" else None))
    if wrong == "no certificate":
        own.pop("sslctx")
    async with started(servers.StartAsyncTlsServer, address=("127.0.0.1", 0), **files_of(served)) as server:
        client = clients.ModbusTlsClient("127.0.0.1", port=port_of(server), timeout=60, retries=0, **own)

        def asks() -> None:
            with client, pytest.raises(ConnectionException):
                client.read_holding_registers(0, count=1, device_id=1)

        await asyncio.to_thread(asks)
        assert not client.connected


def test_a_blocking_server_over_tls_is_stopped_from_another_thread(store: CertificateStore) -> None:
    names = files_of(store.server())
    serve = {"context": new_context(), "address": ("127.0.0.1", 0), **names}
    with in_thread(servers.StartTlsServer, serve) as server:
        own = files_of(store.client())
        reads_and_writes(clients.ModbusTlsClient("127.0.0.1", port=port_of(server), timeout=60, **own))


@contextmanager
def in_thread(start: Callable[..., Any], names: dict[str, Any]) -> Iterator[servers.ModbusBaseServer]:
    """Serve in a thread, as programs of pymodbus do; it ends by `ServerStop`."""
    thread = threading.Thread(target=lambda: start(**names), daemon=True)
    thread.start()
    pause = threading.Event()
    while (server := servers.ModbusBaseServer.active_server) is None or not server._server.is_running:
        assert thread.is_alive()
        pause.wait(0.001)
    try:
        yield server
    finally:
        servers.ServerStop()
        thread.join(60)
    assert not thread.is_alive()


# A frame that a busy machine cuts is damaged, so it is asked again: reads and, because that is said, writes.
ON_A_LINE: dict[str, Any] = {"baudrate": 115_200, "bytesize": 8, "parity": "N", "stopbits": 1}
PATIENT: dict[str, Any] = {"timeout": 2, "retries": 10, "write_retries": 10}


@FRAMERS
@pytest.mark.real_time
async def test_a_server_on_a_serial_port_serves_blocking_and_asyncio_clients(framer: str) -> None:
    with line_of_whole_frames(ports=2, baud=115_200, parity="none") as line:
        ours, theirs = line.paths
        async with started(servers.StartAsyncSerialServer, port=theirs, framer=framer, **ON_A_LINE):
            blocking = clients.ModbusSerialClient(ours, framer=framer, **ON_A_LINE, **PATIENT)
            await asyncio.to_thread(reads_and_writes, blocking)
            client = clients.AsyncModbusSerialClient(ours, framer=framer, **ON_A_LINE, **PATIENT)
            async with client:
                found = await client.read_holding_registers(0, count=2, device_id=1)
                assert found.registers == [7, 500]


@pytest.mark.real_time
def test_a_blocking_server_on_a_serial_port_is_stopped_from_another_thread() -> None:
    with line_of_whole_frames(ports=2, baud=115_200, parity="none") as line:
        ours, theirs = line.paths
        with in_thread(servers.StartSerialServer, {"context": new_context(), "port": theirs, **ON_A_LINE}):
            reads_and_writes(clients.ModbusSerialClient(ours, **ON_A_LINE, **PATIENT))
        with busway.connect(f"rtu://{theirs}?baud=115200&parity=none") as link:  # the port is free again
            link.connect()
