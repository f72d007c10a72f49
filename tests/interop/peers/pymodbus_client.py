"""A Modbus client made of pymodbus, for the interop tests.

::

    pymodbus_client.py tcp HOST PORT UNIT
    pymodbus_client.py tls HOST PORT UNIT CERTIFICATE KEY AUTHORITY
    pymodbus_client.py rtu|ascii DEVICE BAUD UNIT      8 data bits, no parity, 2 stop bits

It understands the commands of ``conversation.py``; the names are those of the functions in the specification.
"""

import logging
import ssl
import sys
from collections.abc import Callable
from typing import Any

from conversation import Refused, converse
from pymodbus.client import ModbusSerialClient, ModbusTcpClient, ModbusTlsClient
from pymodbus.framer import FramerType
from pymodbus.pdu import ModbusPDU
from pymodbus.pdu.diag_message import DiagnosticBase
from pymodbus.pdu.file_message import FileRecord

Client = ModbusTcpClient | ModbusTlsClient | ModbusSerialClient

DIAGNOSTICS_WITHOUT_DATA = {
    0x02: "diag_read_diagnostic_register",
    0x0A: "diag_clear_counters",
    0x0B: "diag_read_bus_message_count",
    0x0C: "diag_read_bus_comm_error_count",
    0x0D: "diag_read_bus_exception_error_count",
    0x0E: "diag_read_device_message_count",
    0x0F: "diag_read_device_no_response_count",
    0x10: "diag_read_device_nak_count",
    0x11: "diag_read_device_busy_count",
    0x12: "diag_read_bus_char_overrun_count",
    0x14: "diag_clear_overrun_counter",
}


def checked(reply: ModbusPDU) -> Any:
    """The reply, unless it is an exception."""
    if reply.isError():
        raise Refused(reply.exception_code, str(reply))
    return reply


def words(data: bytes) -> list[int]:
    """Registers from wire bytes."""
    return [int.from_bytes(data[at : at + 2], "big") for at in range(0, len(data), 2)]


def wire(values: tuple[int, ...]) -> bytes:
    """Wire bytes from registers."""
    return b"".join(value.to_bytes(2, "big") for value in values)


def commands_of(client: Client, unit: int) -> dict[str, Callable[..., dict[str, Any]]]:
    """Every function that pymodbus offers, as commands."""

    def bits(method: Callable[..., ModbusPDU]) -> Callable[[int, int], dict[str, Any]]:
        return lambda address, count: {
            "values": list(checked(method(address, count=count, device_id=unit)).bits)[:count]
        }

    def registers(method: Callable[..., ModbusPDU]) -> Callable[[int, int], dict[str, Any]]:
        return lambda address, count: {"values": list(checked(method(address, count=count, device_id=unit)).registers)}

    def done(reply: ModbusPDU) -> dict[str, Any]:
        checked(reply)
        return {}

    def diagnostics(sub_function: int, data: int = 0) -> dict[str, Any]:
        if sub_function == 0x00:
            reply = client.diag_query_data(data.to_bytes(2, "big"), device_id=unit)
        elif sub_function == 0x01:
            reply = client.diag_restart_communication(data == 0xFF00, device_id=unit)
        elif sub_function == 0x03:
            reply = client.diag_change_ascii_input_delimeter(delimiter=data, device_id=unit)
        else:
            reply = getattr(client, DIAGNOSTICS_WITHOUT_DATA[sub_function])(device_id=unit)
        answer: DiagnosticBase = checked(reply)
        message = answer.message
        return {"data": int.from_bytes(message, "big") if isinstance(message, bytes) else message}

    def event_counter() -> dict[str, Any]:
        reply = checked(client.diag_get_comm_event_counter(device_id=unit))
        return {"ready": bool(reply.status), "count": reply.count}

    def event_log() -> dict[str, Any]:
        reply = checked(client.diag_get_comm_event_log(device_id=unit))
        return {
            "ready": bool(reply.status),
            "event_count": reply.event_count,
            "message_count": reply.message_count,
            "events": list(reply.events),
        }

    def server_id() -> dict[str, Any]:
        reply = checked(client.report_device_id(device_id=unit))
        return {"identifier": reply.identifier.hex(), "running": bool(reply.status)}

    def file_read(file: int, record: int, count: int) -> dict[str, Any]:
        wanted = FileRecord(file_number=file, record_number=record, record_length=count * 2)
        reply = checked(client.read_file_record([wanted], device_id=unit))
        return {"values": words(reply.records[0].record_data)}

    def file_write(file: int, record: int, *values: int) -> dict[str, Any]:
        wanted = FileRecord(file_number=file, record_number=record, record_data=wire(values))
        return done(client.write_file_record([wanted], device_id=unit))

    def identification(level: int, object_id: int = 0) -> dict[str, Any]:
        reply = checked(client.read_device_information(read_code=level, object_id=object_id, device_id=unit))
        return {
            "objects": {str(key): value.hex() for key, value in reply.information.items()},
            "conformity": reply.conformity,
        }

    return {
        "read_coils": bits(client.read_coils),
        "read_discrete_inputs": bits(client.read_discrete_inputs),
        "read_holding_registers": registers(client.read_holding_registers),
        "read_input_registers": registers(client.read_input_registers),
        "write_single_coil": lambda address, value: done(client.write_coil(address, bool(value), device_id=unit)),
        "write_single_register": lambda address, value: done(client.write_register(address, value, device_id=unit)),
        "write_multiple_coils": lambda address, *values: done(
            client.write_coils(address, [bool(value) for value in values], device_id=unit)
        ),
        "write_multiple_registers": lambda address, *values: done(
            client.write_registers(address, list(values), device_id=unit)
        ),
        "mask_write_register": lambda address, and_mask, or_mask: done(
            client.mask_write_register(address=address, and_mask=and_mask, or_mask=or_mask, device_id=unit)
        ),
        "read_write_multiple_registers": lambda read_address, read_count, write_address, *values: {
            "values": list(
                checked(
                    client.readwrite_registers(
                        read_address=read_address,
                        read_count=read_count,
                        write_address=write_address,
                        values=list(values),
                        device_id=unit,
                    )
                ).registers
            )
        },
        "read_fifo_queue": lambda address: {
            "values": list(checked(client.read_fifo_queue(address=address, device_id=unit)).values)
        },
        "read_file_record": file_read,
        "write_file_record": file_write,
        "read_exception_status": lambda: {"status": checked(client.read_exception_status(device_id=unit)).status},
        "diagnostics": diagnostics,
        "get_comm_event_counter": event_counter,
        "get_comm_event_log": event_log,
        "report_server_id": server_id,
        "read_device_identification": identification,
    }


def client_of(words: list[str]) -> Client:
    """The client that the words of the command line ask for, not connected yet."""
    kind, where, number, _, *files = words
    if kind == "tcp":
        return ModbusTcpClient(where, port=int(number), timeout=5, retries=0)
    if kind == "tls":
        return ModbusTlsClient(where, port=int(number), sslctx=tls_context(*files), timeout=5, retries=0)
    return ModbusSerialClient(
        where, framer=FramerType(kind), baudrate=int(number), parity="N", stopbits=2, timeout=5, retries=0
    )


def tls_context(certificate: str, key: str, authority: str) -> ssl.SSLContext:
    """For the TLS client, which does not say the server's name, so that it cannot be checked."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname = False
    context.load_verify_locations(authority)
    context.load_cert_chain(certificate, key)
    return context


def main() -> None:
    logging.getLogger("pymodbus").setLevel(logging.CRITICAL)
    client = client_of(sys.argv[1:])
    if not client.connect():
        sys.exit("cannot connect")
    converse(commands_of(client, int(sys.argv[4])))
    client.close()


main()
