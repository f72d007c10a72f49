"""The clients, requests, responses and errors of pymodbus on busway's links, against a server of our own."""

import asyncio
import inspect
import socket
import struct
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from typing import Any

import pytest

import busway
from busway.compat.pymodbus import FramerType, ModbusException, client, framer
from busway.compat.pymodbus.client import AsyncModbusTcpClient, ModbusSerialClient, ModbusTcpClient
from busway.compat.pymodbus.exceptions import (
    ConnectionException,
    MessageRegisterException,
    ModbusIOException,
    ParameterException,
)
from busway.compat.pymodbus.pdu import (
    ExceptionResponse,
    FileRecord,
    ModbusPDU,
    ReadCoilsResponse,
    ReadHoldingRegistersRequest,
    ReadHoldingRegistersResponse,
)

IDENTITY = {0: b"Acme", 1: b"PX-1", 2: b"2.5"}


def example() -> busway.Device:
    device = busway.Device(
        holding_registers=100,
        input_registers=[7, 8, 9],
        coils=[True, False, True],
        discrete_inputs=[False, True],
        identification=IDENTITY,
        files={4: {0: [1, 2, 3]}},
        fifos={40: [440, 4740]},
    )
    device.holding_registers[0:3] = [1, 2, 3]
    return device


@pytest.fixture
def device() -> busway.Device:
    return example()


@pytest.fixture
def port(device: busway.Device) -> Iterator[int]:
    with busway.serve_in_thread("tcp://127.0.0.1:0", units={1: device, 5: busway.Device(coils=1)}) as server:
        yield int(server.endpoints[0].rpartition(":")[2])


@pytest.fixture
def closed_port() -> Iterator[int]:
    """A port on which nothing listens, held so that no other test gets it."""
    with socket.socket() as held:
        held.bind(("127.0.0.1", 0))
        yield int(held.getsockname()[1])


@pytest.fixture
def pump(port: int) -> Iterator[ModbusTcpClient]:
    with ModbusTcpClient("127.0.0.1", port=port) as one:
        yield one


# --- data -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "arguments",
    [
        {"count": 2},
        {"count": 2, "slave": 1},
        {"count": 2, "unit": 1},
        {"count": 2, "device_id": 1},
    ],
)
def test_read_takes_the_unit_under_the_name_of_any_release(pump: ModbusTcpClient, arguments: dict[str, int]) -> None:
    response = pump.read_holding_registers(1, **arguments)
    assert type(response) is ReadHoldingRegistersResponse
    assert (response.registers, response.isError(), response.function_code) == ([2, 3], False, 3)
    assert (response.dev_id, response.slave_id, response.unit_id) == (1, 1, 1)


def test_count_and_unit_may_be_positional_and_count_is_one_if_left_out(pump: ModbusTcpClient) -> None:
    assert pump.read_input_registers(0, 3, 1).registers == [7, 8, 9]
    assert pump.read_input_registers(1).registers == [8]


def test_unknown_argument_is_a_type_error_that_names_it(pump: ModbusTcpClient) -> None:
    with pytest.raises(TypeError, match="'station'"):
        pump.read_coils(0, station=1)
    with pytest.raises(TypeError, match="'hots'"):
        ModbusTcpClient("127.0.0.1", hots="x")


def test_two_arguments_that_name_different_units_are_a_type_error_and_nothing_is_written(
    pump: ModbusTcpClient, device: busway.Device
) -> None:
    with pytest.raises(TypeError, match="slave, unit: these arguments name different units"):
        pump.write_register(3, 77, slave=1, unit=2)
    assert device.holding_registers[3] != 77
    assert not pump.write_register(3, 77, slave=1, unit=1).isError()
    assert device.holding_registers[3] == 77


def test_bits_of_a_response_are_filled_up_to_whole_bytes(pump: ModbusTcpClient) -> None:
    response = pump.read_coils(0, count=3)
    assert isinstance(response, ReadCoilsResponse)
    assert response.bits == [True, False, True, False, False, False, False, False]
    assert pump.read_discrete_inputs(0, count=2).bits[:2] == [False, True]


def test_writes_reach_the_device_and_their_responses_repeat_them(pump: ModbusTcpClient, device: busway.Device) -> None:
    assert pump.write_coil(1, 1).bits == [True]
    assert pump.write_register(10, 500).registers == [500]
    assert pump.write_register(11, b"\x01\x02").value == 0x0102
    assert pump.write_coils(0, [False, False]).count == 2
    assert pump.write_registers(12, [1, b"\x00\x02"]).count == 2
    assert pump.write_registers(14, 7).address == 14
    assert not pump.mask_write_register(address=10, and_mask=0xFF00, or_mask=1).isError()
    read = pump.readwrite_registers(read_address=10, read_count=5, write_address=13, values=[9])
    assert read.registers == [500 & 0xFF00 | 1, 0x0102, 1, 9, 7]
    assert list(device.coils[0:3]) == [False, False, True]


def test_text_is_no_state_of_a_coil_and_nothing_is_sent(pump: ModbusTcpClient, device: busway.Device) -> None:
    with pytest.raises(busway.InvalidRequest, match="off"):
        pump.write_coil(1, "off")
    assert list(device.coils[0:3]) == [True, False, True]


def test_files_queues_and_identification(pump: ModbusTcpClient) -> None:
    assert pump.read_fifo_queue(address=40).values == [440, 4740]
    assert pump.write_file_record([FileRecord(4, 1, b"\x00\x07")]).records[0].record_data == b"\x00\x07"
    assert pump.read_file_record([FileRecord(4, 0, record_length=6)]).records[0].record_data == b"\0\1\0\7\0\3"
    found = pump.read_device_information(read_code=1)
    assert (found.information, found.more_follows) == (IDENTITY, 0)


def test_diagnostics(pump: ModbusTcpClient) -> None:
    assert pump.diag_query_data(b"ping").message == b"ping"
    assert pump.diag_read_bus_message_count().message >= 1
    assert pump.diag_read_slave_message_count(slave=1).message >= 1
    assert pump.diag_read_iop_overrun_count().exception_code in (1, 3)
    assert pump.read_exception_status().status == 0
    assert pump.diag_get_comm_event_counter().status is True
    assert pump.diag_get_comm_event_log().event_count >= 0
    assert isinstance(pump.report_device_id().identifier, bytes)
    assert not hasattr(pump, "diag_everything")


# --- errors -----------------------------------------------------------------------------------------------------------


def test_exception_of_the_device_is_a_response_that_is_an_error(pump: ModbusTcpClient) -> None:
    response = pump.read_holding_registers(99, count=2)
    assert isinstance(response, ExceptionResponse)
    assert (response.isError(), response.function_code, response.exception_code) == (True, 0x83, 2)
    assert type(response).__name__ == "ExceptionResponse"
    assert pump.read_coils(0, slave=9).exception_code == 0x0B


def test_value_out_of_range_is_a_value_error_before_anything_is_sent(pump: ModbusTcpClient) -> None:
    for wrong in ({"count": 0}, {"count": 126}):
        with pytest.raises(ValueError, match="count"):
            pump.read_holding_registers(0, **wrong)
    with pytest.raises(ModbusIOException, match="Invalid ID"):
        pump.read_holding_registers(0, slave=300)


def test_no_connection_is_false_from_connect_and_an_exception_from_a_call(closed_port: int) -> None:
    one = ModbusTcpClient("127.0.0.1", port=closed_port, timeout=1, reconnect_delay=0)
    assert (one.connect(), one.connected, one.is_socket_open(), one.socket) == (False, False, False, None)
    with pytest.raises(ConnectionException) as caught:
        one.read_coils(0)
    assert isinstance(caught.value, ModbusException)
    assert str(caught.value).startswith("Modbus Error: [Connection] ")
    one.close()


class SilentServer:
    """Takes one connection, answers nothing, and keeps the function codes of the requests that came."""

    def __init__(self) -> None:
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        self._heard = b""
        self._thread = threading.Thread(target=self._hear)
        self._thread.start()

    def _hear(self) -> None:
        connection, _ = self._listener.accept()
        with connection:
            while data := connection.recv(4096):
                self._heard += data

    def functions(self) -> list[int]:
        """What was asked, when the client has closed."""
        self._thread.join(60)
        self._listener.close()
        found, rest = [], self._heard
        while rest:
            length = 6 + int.from_bytes(rest[4:6], "big")
            found.append(rest[7])
            rest = rest[length:]
        return found


def impatient(port: int, **options: int) -> ModbusTcpClient:
    """A client that waits for answers for a short time, but to connect as long as it takes."""
    one = ModbusTcpClient("127.0.0.1", port=port, timeout=0.05, **options)
    one._options["connect_timeout"] = 60.0
    return one


@pytest.mark.parametrize(
    ("call", "options", "asked"),
    [
        (lambda one: one.read_coils(0), {"retries": 1}, [1, 1]),
        (lambda one: one.read_coils(0), {"retries": 0}, [1]),
        (lambda one: one.write_register(0, 1), {"retries": 1}, [6]),
        (lambda one: one.write_register(0, 1), {"retries": 0, "write_retries": 1}, [6, 6]),
    ],
)
def test_silence_is_an_io_exception_and_only_reads_are_repeated_unless_asked(
    call: Callable[[ModbusTcpClient], Any], options: dict[str, int], asked: list[int]
) -> None:
    server = SilentServer()
    one = impatient(server.port, **options)
    with pytest.raises(ModbusIOException) as caught:
        call(one)
    one.close()
    assert server.functions() == asked
    assert (caught.value.fcode, caught.value.dev_id) == (asked[0], 1)


def test_silence_that_is_expected_is_none() -> None:
    server = SilentServer()
    with impatient(server.port, retries=0) as one:
        assert one.write_register(0, 1, no_response_expected=True) is None
    assert server.functions() == [6]


# --- messages of the program itself, and what is traced ---------------------------------------------------------------


class OwnRequest(ModbusPDU):
    """Function 65 of a program: a number that comes back one greater."""

    function_code = 65

    def __init__(self, number: int = 0, **names: Any) -> None:
        super().__init__(**names)
        self.number = number

    def encode(self) -> bytes:
        return struct.pack(">H", self.number)

    def decode(self, data: bytes) -> None:
        (self.number,) = struct.unpack(">H", data)


class Increment(busway.Request):
    """The same function on our server."""

    code = 65
    number: int = busway.u16()

    class Reply(busway.ReplyMessage):
        """One more."""

        number: int = busway.u16()

    def apply(self, model: Any, context: Any) -> busway.Message:
        return self.Reply(self.number + 1)


def test_function_of_the_program_itself_is_sent_as_it_encodes_and_answered_by_what_it_registered() -> None:
    functions = busway.STANDARD.with_functions(Increment)
    with (
        busway.serve_in_thread("tcp://127.0.0.1:0", units={1: busway.Device()}, functions=functions) as server,
        ModbusTcpClient("127.0.0.1", port=int(server.endpoints[0].rpartition(":")[2])) as one,
    ):
        with pytest.raises(ModbusIOException, match="registered"):
            one.execute(False, OwnRequest(41, dev_id=1))
        one.register(OwnRequest)
        assert one.execute(False, OwnRequest(41, dev_id=1)).number == 42
        assert one.execute(OwnRequest(1, slave=1)).number == 2  # as before 3.8
        with pytest.raises(MessageRegisterException):
            one.register(int)  # type: ignore[arg-type]


def test_request_objects_are_sent_by_execute_and_traces_see_both_ways(port: int) -> None:
    seen: list[tuple[bool, str]] = []
    connections: list[bool] = []

    def trace(sending: bool, pdu: ModbusPDU) -> ModbusPDU:
        seen.append((sending, type(pdu).__name__))
        return pdu

    with ModbusTcpClient("127.0.0.1", port=port, trace_pdu=trace, trace_connect=connections.append) as one:
        assert one.execute(False, ReadHoldingRegistersRequest(address=0, count=1, dev_id=1)).registers == [1]
        assert one.read_coils(99).isError()
    assert seen == [
        (True, "ReadHoldingRegistersRequest"),
        (False, "ReadHoldingRegistersResponse"),
        (True, "ReadCoilsRequest"),
        (False, "ExceptionResponse"),
    ]
    assert connections == [True, False]


# --- connections ------------------------------------------------------------------------------------------------------


def test_blocking_client_connects_by_itself_and_again_after_close(port: int) -> None:
    one = ModbusTcpClient("localhost", port=port)
    assert not one.connected
    assert one.read_coils(0).bits[0]
    assert (one.connected, one.connect()) == (True, True)
    one.close()
    assert not one.connected
    assert one.read_coils(0).bits[0]
    one.close()
    one.close()


async def test_asyncio_client_reads_closes_and_connects_again(port: int) -> None:
    one = AsyncModbusTcpClient("127.0.0.1", port=port)
    with pytest.raises(ConnectionException):
        await one.read_coils(0)
    assert await one.connect()
    assert await one.connect()
    first, second = await asyncio.gather(one.read_holding_registers(0, count=2), one.read_coils(0, slave=9))
    assert (first.registers, second.exception_code) == ([1, 2], 0x0B)
    one.close()
    assert not one.connected
    assert await one.connect()
    assert (await one.diag_query_data(b"ab")).message == b"ab"
    async with one:
        assert (await one.read_holding_registers(2)).registers == [3]
    assert not one.connected


async def test_asyncio_client_says_false_where_nothing_listens(closed_port: int) -> None:
    one = AsyncModbusTcpClient("127.0.0.1", port=closed_port, timeout=1)
    assert not await one.connect()
    async with one:
        assert not one.connected


LEAVES_AT_ONCE = """
import asyncio, sys
from busway.compat.pymodbus.client import AsyncModbusTcpClient

async def main():
    client = AsyncModbusTcpClient("127.0.0.1", port=int(sys.argv[1]))
    await client.connect()
    client.close()

asyncio.run(main())
print("left")
"""


def test_program_that_closes_and_leaves_the_loop_at_once_leaves_no_connection_behind(port: int) -> None:
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", LEAVES_AT_ONCE, str(port)],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert (done.stdout, done.stderr) == ("left\n", "")


@pytest.mark.parametrize(
    ("framing", "url"),
    [
        (None, "tcp://10.0.0.5:502"),
        (FramerType.SOCKET, "tcp://10.0.0.5:502"),
        ("rtu", "rtu+tcp://10.0.0.5:502"),
        (framer.FramerAscii, "ascii+tcp://10.0.0.5:502"),
        (framer.ModbusRtuFramer, "rtu+tcp://10.0.0.5:502"),
    ],
)
def test_framer_of_any_kind_names_the_framing(framing: object, url: str) -> None:
    assert ModbusTcpClient("10.0.0.5", framer=framing)._endpoint.url == url


def test_clients_of_every_carrier_have_the_endpoint_that_their_arguments_name() -> None:
    assert client.ModbusUdpClient("10.0.0.5", 5020)._endpoint.url == "udp://10.0.0.5:5020"
    assert client.ModbusTlsClient("10.0.0.5")._endpoint.url == "tls://10.0.0.5:802"
    assert client.AsyncModbusUdpClient("fe80::1")._endpoint.url == "udp://[fe80::1]:502"
    assert ModbusSerialClient("socket://10.0.0.5:4001")._endpoint.url == "rtu+tcp://10.0.0.5:4001"
    line = ModbusSerialClient(method="ascii", port="/dev/ttyS1", baudrate=9600, parity="E", bytesize=7, stopbits=1)
    assert line._endpoint.url == "ascii:///dev/ttyS1"
    assert (line._options["baud"], line._options["parity"], line._options["data_bits"]) == (9600, "E", 7)
    assert line.comm_params.baudrate == 9600
    with pytest.raises(TypeError, match="RTU/ASCII"):
        client.AsyncModbusSerialClient("/dev/ttyS1", framer=FramerType.SOCKET)
    with pytest.raises(ParameterException, match="framer must be"):
        ModbusTcpClient("10.0.0.5", framer="binary")


@pytest.mark.parametrize(
    ("made", "connects"),
    [
        (lambda port: ModbusTcpClient("127.0.0.1", port=port, framer="rtu", timeout=1), False),
        (lambda port: ModbusTcpClient("127.0.0.1", port=port, source_address=("127.0.0.1", 0), timeout=1), False),
        (lambda port: client.ModbusUdpClient("127.0.0.1", port=port, timeout=1), True),
        (lambda port: client.ModbusTlsClient("127.0.0.1", port=port, timeout=1), False),
        (lambda port: ModbusSerialClient("/dev/busway-none", timeout=1), False),
        (lambda port: ModbusSerialClient("/dev/busway-none", framer="ascii", handle_local_echo=True), False),
        (lambda port: ModbusSerialClient(f"socket://127.0.0.1:{port}", timeout=1), False),
    ],
)
def test_link_of_every_carrier_takes_the_options_of_its_client(
    made: Callable[[int], ModbusTcpClient], connects: bool, closed_port: int
) -> None:
    one = made(closed_port)
    assert one.connect() is connects
    one.close()


def test_tls_client_takes_files_and_refuses_what_it_cannot_use() -> None:
    files = client.ModbusTlsClient.generate_ssl(certfile="c.pem", keyfile="k.pem")
    one = client.ModbusTlsClient("10.0.0.5", sslctx=files, server_hostname="plc")
    assert {name: one._options[name] for name in ("certificate", "key", "server_name", "verify")} == {
        "certificate": "c.pem",
        "key": "k.pem",
        "server_name": "plc",
        "verify": "off-insecure",
    }
    with pytest.raises(ParameterException, match="password_file"):
        client.ModbusTlsClient.generate_ssl(password="secret")
    with pytest.raises(ParameterException, match="generate_ssl"):
        client.ModbusTlsClient("10.0.0.5", sslctx=object())


def test_blocking_and_asyncio_clients_take_the_same_arguments() -> None:
    for kind in ("Tcp", "Udp", "Serial", "Tls"):
        blocking, other = getattr(client, f"Modbus{kind}Client"), getattr(client, f"AsyncModbus{kind}Client")
        assert inspect.signature(blocking) == inspect.signature(other)


async def test_cancellation_of_a_close_that_waits_reaches_what_it_waits_in() -> None:
    seen: list[str] = []

    async def work() -> None:
        try:
            await asyncio.Event().wait()
        except asyncio.CancelledError:
            seen.append("cancelled")
            await asyncio.sleep(0)
            seen.append("cleaned up")
            raise

    task = client.begun(work())
    assert task is not None
    await asyncio.sleep(0)
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    assert seen == ["cancelled", "cleaned up"]
