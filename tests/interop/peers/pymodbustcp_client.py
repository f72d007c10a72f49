"""A Modbus client made of pyModbusTCP, for the interop tests: ``pymodbustcp_client.py HOST PORT UNIT``.

It understands those commands of ``conversation.py`` for which pyModbusTCP has a function, and ``raw FUNCTION BYTE…``.
"""

import sys
from collections.abc import Callable
from typing import Any

from conversation import Refused, converse
from pyModbusTCP.client import ModbusClient


def commands_of(client: ModbusClient) -> dict[str, Callable[..., dict[str, Any]]]:
    """Every function that pyModbusTCP offers, as commands."""

    def checked(result: Any) -> Any:
        if result is None or result is False:
            raise Refused(client.last_except, client.last_except_as_txt or client.last_error_as_txt)
        return result

    def read(method: Callable[[int, int], Any]) -> Callable[[int, int], dict[str, Any]]:
        return lambda address, count: {"values": checked(method(address, count))}

    def done(result: Any) -> dict[str, Any]:
        checked(result)
        return {}

    def identification(level: int, object_id: int = 0) -> dict[str, Any]:
        reply = checked(client.read_device_identification(read_code=level, object_id=object_id))
        return {
            "objects": {str(number): value.hex() for number, value in reply.objects_by_id.items()},
            "conformity": reply.conformity_level,
        }

    return {
        "read_coils": read(client.read_coils),
        "read_discrete_inputs": read(client.read_discrete_inputs),
        "read_holding_registers": read(client.read_holding_registers),
        "read_input_registers": read(client.read_input_registers),
        "write_single_coil": lambda address, value: done(client.write_single_coil(address, bool(value))),
        "write_single_register": lambda address, value: done(client.write_single_register(address, value)),
        "write_multiple_coils": lambda address, *values: done(
            client.write_multiple_coils(address, [bool(value) for value in values])
        ),
        "write_multiple_registers": lambda address, *values: done(
            client.write_multiple_registers(address, list(values))
        ),
        "read_write_multiple_registers": lambda read_address, read_count, write_address, *values: {
            "values": checked(
                client.write_read_multiple_registers(write_address, list(values), read_address, read_count)
            )
        },
        "read_device_identification": identification,
        "raw": lambda *pdu: {"pdu": checked(client.custom_request(bytes(pdu))).hex()},
    }


def main() -> None:
    client = ModbusClient(host=sys.argv[1], port=int(sys.argv[2]), unit_id=int(sys.argv[3]), timeout=5.0)
    if not client.open():
        sys.exit("cannot connect")
    converse(commands_of(client))
    client.close()


main()
