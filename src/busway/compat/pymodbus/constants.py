"""The constants of pymodbus that programs name. Knows no messages."""

import enum


class Endian(str, enum.Enum):
    """Order of bytes and of registers for the payload builder and decoder."""

    AUTO = "@"
    BIG = ">"
    LITTLE = "<"
    Auto = "@"
    Big = ">"
    Little = "<"


class ExcCodes(enum.IntEnum):
    """Exception codes under pymodbus' names (MODBUS Application Protocol V1.1b3 §7)."""

    ILLEGAL_FUNCTION = 0x01
    ILLEGAL_ADDRESS = 0x02
    ILLEGAL_VALUE = 0x03
    DEVICE_FAILURE = 0x04
    ACKNOWLEDGE = 0x05
    DEVICE_BUSY = 0x06
    NEGATIVE_ACKNOWLEDGE = 0x07
    MEMORY_PARITY_ERROR = 0x08
    GATEWAY_PATH_UNAVIABLE = 0x0A
    GATEWAY_NO_RESPONSE = 0x0B


class ModbusStatus(enum.IntEnum):
    """Special values in requests and replies: the status of functions 11 and 12, the coil states of function 05."""

    WAITING = 0xFFFF
    READY = 0x0000
    ON = 0xFF00
    OFF = 0x0000


class DeviceInformation(enum.IntEnum):
    """Levels of identification that function 43/14 reads (MODBUS Application Protocol V1.1b3 §6.21)."""

    BASIC = 0x01
    REGULAR = 0x02
    EXTENDED = 0x03
    SPECIFIC = 0x04


class MoreData(enum.IntEnum):
    """Values of ``more_follows`` in a response of function 43/14: whether another request would read more objects."""

    NOTHING = 0x00
    KEEP_READING = 0xFF


class Defaults:
    """Default settings of older releases of pymodbus, which programs read."""

    TcpPort = 502
    TlsPort = 802
    UdpPort = 502
    Baudrate = 19200
    Timeout = 3
    Retries = 3
    Slave = 1
    UnitId = 1
    Port = TcpPort
