"""A Modbus client made of minimalmodbus, for the interop tests: ``minimalmodbus_client.py rtu|ascii DEVICE BAUD UNIT``.

8 data bits, no parity, 2 stop bits. It understands those commands of ``conversation.py`` whose functions the library
has; ``function_15`` and ``function_16`` write one value by the function for many. A broadcast is a write to unit 0.
"""

import sys
from collections.abc import Callable
from typing import Any

import minimalmodbus
from conversation import Refused, converse

WORDS_OF_CODE = {
    1: "illegal function",
    2: "illegal data address",
    3: "illegal data value",
    4: "device failure",
    6: "device busy",
}
"""The library puts the exception code into its sentences only."""

TIMEOUT = 1.0
"""Seconds. It waits for as many bytes as a normal reply has, so that an exception reply takes all of this."""


def refused(error: minimalmodbus.SlaveReportedException) -> Refused:
    """The error as an exception code; 0 for one that is not in the table."""
    sentence = str(error)
    return Refused(next((code for code, words in WORDS_OF_CODE.items() if words in sentence), 0), sentence)


def commands_of(instrument: minimalmodbus.Instrument) -> dict[str, Callable[..., dict[str, Any]]]:
    """Every function that minimalmodbus offers, as commands."""

    def done(method: Callable[..., None], *arguments: Any, **options: Any) -> dict[str, Any]:
        method(*arguments, **options)
        return {}

    def bits(function: int) -> Callable[[int, int], dict[str, Any]]:
        return lambda address, count: {
            "values": [bool(bit) for bit in instrument.read_bits(address, count, functioncode=function)]
        }

    def registers(function: int) -> Callable[[int, int], dict[str, Any]]:
        return lambda address, count: {"values": instrument.read_registers(address, count, functioncode=function)}

    def broadcast_register(address: int, value: int) -> dict[str, Any]:
        own, instrument.address = instrument.address, 0
        try:
            return done(instrument.write_register, address, value, functioncode=6)
        finally:
            instrument.address = own

    commands: dict[str, Callable[..., dict[str, Any]]] = {
        "read_coils": bits(1),
        "read_discrete_inputs": bits(2),
        "read_holding_registers": registers(3),
        "read_input_registers": registers(4),
        "write_single_coil": lambda address, value: done(instrument.write_bit, address, value, functioncode=5),
        "write_single_register": lambda address, value: done(instrument.write_register, address, value, functioncode=6),
        "function_15": lambda address, value: done(instrument.write_bit, address, value, functioncode=15),
        "function_16": lambda address, value: done(instrument.write_register, address, value, functioncode=16),
        "write_multiple_coils": lambda address, *values: done(instrument.write_bits, address, list(values)),
        "write_multiple_registers": lambda address, *values: done(instrument.write_registers, address, list(values)),
        "write_float": lambda address, value: done(instrument.write_float, address, float(value)),
        "read_float": lambda address: {"value": instrument.read_float(address)},
        "broadcast_register": broadcast_register,
    }

    def guarded(command: Callable[..., dict[str, Any]]) -> Callable[..., dict[str, Any]]:
        def run(*arguments: int) -> dict[str, Any]:
            try:
                return command(*arguments)
            except minimalmodbus.SlaveReportedException as error:
                raise refused(error) from error

        return run

    return {name: guarded(command) for name, command in commands.items()}


def main() -> None:
    mode, path, baud, unit = sys.argv[1:]
    instrument = minimalmodbus.Instrument(path, int(unit), mode=mode)
    instrument.serial.baudrate = int(baud)
    instrument.serial.stopbits = 2
    instrument.serial.timeout = TIMEOUT
    converse(commands_of(instrument))
    instrument.serial.close()


main()
