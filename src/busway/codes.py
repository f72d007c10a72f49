"""Codes and limits of the specification: function, sub-function and exception codes, and sizes on the wire.

Knows numbers and the sections that define them; knows no message, and executes nothing.
"""

from enum import Enum, IntEnum
from typing import TYPE_CHECKING, Final

PDU_LIMIT: Final = 253
"""Largest number of bytes of a PDU, function code included (Application Protocol V1.1b3 §4.1)."""
TCP_ADU_LIMIT: Final = 260
"""Largest number of bytes of a frame on TCP: 7 of MBAP header, 253 of PDU (Messaging on TCP/IP V1.0b §3.1.3)."""
RTU_ADU_LIMIT: Final = 256
"""Largest number of bytes of an RTU frame: 1 of address, 253 of PDU, 2 of CRC (Serial Line V1.02 §2.5.1)."""
ASCII_ADU_LIMIT: Final = 513
"""Largest number of characters of an ASCII frame (Serial Line V1.02 §2.5.2).

They are ``:``, two hexadecimal digits for each byte of address, PDU and LRC, then CR LF.
"""

TABLE_SIZE: Final = 65_536
"""Number of addresses in each of the four tables, 0…65535 (Application Protocol V1.1b3 §4.3)."""

MAX_READ_BITS: Final = 2000
MAX_WRITE_BITS: Final = 1968
MAX_READ_REGISTERS: Final = 125
MAX_WRITE_REGISTERS: Final = 123
MAX_READ_WRITE_WRITE_REGISTERS: Final = 121
MAX_FIFO_REGISTERS: Final = 31
MAX_FILE_RECORD_NUMBER: Final = 9999

BROADCAST_UNIT: Final = 0
"""Unit identifier of a broadcast (Serial Line V1.02 §2.1).

Every server on the serial line executes the request, and none of them answers.
"""
TCP_DEVICE_UNIT: Final = 255
"""Unit identifier of a device that is itself on TCP, not behind a gateway (Messaging on TCP/IP V1.0b §4.4.1.2)."""
FIRST_SERIAL_UNIT: Final = 1
LAST_SERIAL_UNIT: Final = 247

DEFAULT_TCP_PORT: Final = 502
DEFAULT_TLS_PORT: Final = 802


class Table(Enum):
    """The four tables of a device: coils, discrete inputs, input and holding registers (V1.1b3 §4.3)."""

    COILS = "coils"
    DISCRETE_INPUTS = "discrete_inputs"
    INPUT_REGISTERS = "input_registers"
    HOLDING_REGISTERS = "holding_registers"

    if not TYPE_CHECKING:
        # Members are single objects, and the hash of Enum is written in Python: 0.1 µs at every look into a dictionary.
        __hash__ = object.__hash__

    @property
    def holds_bits(self) -> bool:
        """True if an item of the table is one bit (coils, discrete inputs), False if it is a 16-bit register."""
        return self in (Table.COILS, Table.DISCRETE_INPUTS)

    @property
    def is_writable(self) -> bool:
        """True for coils and holding registers, which Modbus functions can write; False for the tables of inputs."""
        return self in (Table.COILS, Table.HOLDING_REGISTERS)

    @property
    def label(self) -> str:
        """Name of one item of the table, with a space: ``holding register``, ``coil``."""
        return self.value.replace("_", " ").removesuffix("s")


class FunctionCode(IntEnum):
    """The public function codes (Application Protocol V1.1b3 §5.1)."""

    READ_COILS = 0x01
    READ_DISCRETE_INPUTS = 0x02
    READ_HOLDING_REGISTERS = 0x03
    READ_INPUT_REGISTERS = 0x04
    WRITE_SINGLE_COIL = 0x05
    WRITE_SINGLE_REGISTER = 0x06
    READ_EXCEPTION_STATUS = 0x07
    DIAGNOSTICS = 0x08
    GET_COMM_EVENT_COUNTER = 0x0B
    GET_COMM_EVENT_LOG = 0x0C
    WRITE_MULTIPLE_COILS = 0x0F
    WRITE_MULTIPLE_REGISTERS = 0x10
    REPORT_SERVER_ID = 0x11
    READ_FILE_RECORD = 0x14
    WRITE_FILE_RECORD = 0x15
    MASK_WRITE_REGISTER = 0x16
    READ_WRITE_MULTIPLE_REGISTERS = 0x17
    READ_FIFO_QUEUE = 0x18
    ENCAPSULATED_INTERFACE = 0x2B


class MeiType(IntEnum):
    """Sub-codes of function 43 (Application Protocol V1.1b3 §6.19)."""

    CANOPEN_GENERAL_REFERENCE = 0x0D
    READ_DEVICE_IDENTIFICATION = 0x0E


class DiagnosticCode(IntEnum):
    """Sub-functions of function 08 (Application Protocol V1.1b3 §6.8)."""

    RETURN_QUERY_DATA = 0x00
    RESTART_COMMUNICATIONS = 0x01
    RETURN_DIAGNOSTIC_REGISTER = 0x02
    CHANGE_ASCII_DELIMITER = 0x03
    FORCE_LISTEN_ONLY = 0x04
    CLEAR_COUNTERS = 0x0A
    BUS_MESSAGE_COUNT = 0x0B
    BUS_COMMUNICATION_ERROR_COUNT = 0x0C
    BUS_EXCEPTION_ERROR_COUNT = 0x0D
    SERVER_MESSAGE_COUNT = 0x0E
    SERVER_NO_RESPONSE_COUNT = 0x0F
    SERVER_NAK_COUNT = 0x10
    SERVER_BUSY_COUNT = 0x11
    BUS_CHARACTER_OVERRUN_COUNT = 0x12
    CLEAR_OVERRUN = 0x14


class ExceptionCode(IntEnum):
    """The exception codes of the specification (Application Protocol V1.1b3 §7), and 07 from the older PI-MBUS-300."""

    ILLEGAL_FUNCTION = 0x01
    ILLEGAL_DATA_ADDRESS = 0x02
    ILLEGAL_DATA_VALUE = 0x03
    SERVER_DEVICE_FAILURE = 0x04
    ACKNOWLEDGE = 0x05
    SERVER_DEVICE_BUSY = 0x06
    NEGATIVE_ACKNOWLEDGE = 0x07
    MEMORY_PARITY_ERROR = 0x08
    GATEWAY_PATH_UNAVAILABLE = 0x0A
    GATEWAY_TARGET_FAILED_TO_RESPOND = 0x0B


EXCEPTION_MEANING: Final[dict[int, str]] = {
    0x01: "illegal function: the device does not offer it or not to you, or is not configured",
    0x02: "illegal data address: an item in the range does not exist or may not be written",
    0x03: "illegal data value: a quantity or a length in the request is not allowed (the code is not about a value"
    " that is written, though some devices use it so)",
    0x04: "server device failure while executing",
    0x05: "acknowledge: the device accepted the request and needs time",
    0x06: "server device busy: the application decides on sending again",
    0x07: "negative acknowledge: the program function could not be performed",
    0x08: "memory parity error in the file area",
    0x0A: "gateway path unavailable: no route, or the line is down or overloaded",
    0x0B: "gateway target device failed to respond",
}


def exception_meaning(code: int) -> str:
    """Return the meaning of an exception code in words; for codes outside the specification, a text that says so."""
    return EXCEPTION_MEANING.get(code, "an exception code outside the specification")


def function_name(code: int) -> str:
    """Return a function code as text: ``3 (read holding registers)``, or ``65 (0x41)`` for a code without a name.

    Names have the public codes (`FunctionCode`).
    """
    try:
        return f"{code} ({FunctionCode(code).name.lower().replace('_', ' ')})"
    except ValueError:
        return f"{code} (0x{code:02X})"
