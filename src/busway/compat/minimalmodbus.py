"""The interface of minimalmodbus on busway's links: instruments on serial ports, their 14 methods and 9 exceptions.

Knows how values become registers by minimalmodbus' rules, and a port's settings; a link of busway does the
communication.

1. Settings are attributes of ``instrument.serial`` and of the instrument. Each call checks them: after a change the
   link is closed and another one opened.
2. Instruments created with the same name of a port share its settings and its link.
3. No request is repeated. A write without a reply raises `NoResponseError`, and may have been executed.
"""

import struct
import time
from collections.abc import Sequence
from typing import Any

from ..client.blocking import BlockingLink, connect
from ..codes import ExceptionCode
from ..errors import BadReply, ExceptionReply, ModbusError, NoReply
from ..options.endpoints import Endpoint
from ..pdu.read_items import ReadCoils, ReadDiscreteInputs, ReadHoldingRegisters, ReadInputRegisters
from ..pdu.write_items import WriteMultipleCoils, WriteMultipleRegisters, WriteSingleCoil, WriteSingleRegister

MODE_RTU = "rtu"
MODE_ASCII = "ascii"
BYTEORDER_BIG = 0
BYTEORDER_LITTLE = 1
BYTEORDER_BIG_SWAP = 2
BYTEORDER_LITTLE_SWAP = 3

__author__ = "The busway developers"
__version__ = "2.1.1"
"""The release of minimalmodbus whose behaviour these modules have."""

MOST_DECIMALS = 10
LAST_REGISTER = 0xFFFF
LAST_UNIT = 247
SHORTEST_TIMEOUT = 0.001
LONGEST_TIMEOUT = 3600.0
SIGNED = {1: "h", 2: "i", 4: "q"}
FLOATS = {2: "f", 4: "d"}


class InstrumentError(OSError):
    """Base of the exceptions of this module; minimalmodbus' name is ``ModbusException``."""


class SlaveReportedException(InstrumentError):
    """The device answered with an exception code; base of the classes for single codes."""


class SlaveDeviceBusyError(SlaveReportedException):
    """The device is busy (exception codes 05, 06)."""


class NegativeAcknowledgeError(SlaveReportedException):
    """The device cannot do what was asked (exception code 07)."""


class IllegalRequestError(SlaveReportedException):
    """The device does not know the function, address or value (exception codes 01, 02, 03)."""


class MasterReportedException(InstrumentError):
    """The serial port cannot be opened, or failed; base of the exceptions for a missing or invalid reply."""


class NoResponseError(MasterReportedException):
    """No reply came in time; the device may have executed a write."""


class LocalEchoError(MasterReportedException):
    """minimalmodbus' exception for a local echo that differs from the request; never raised here.

    Bytes that differ from the request are treated as a reply or as noise.
    """


class InvalidResponseError(MasterReportedException):
    """The reply breaks the protocol, or only a part of it was received."""


InstrumentError.__name__ = InstrumentError.__qualname__ = "ModbusException"
ModbusException = InstrumentError

REFUSALS: dict[int, type[SlaveReportedException]] = {
    ExceptionCode.ILLEGAL_FUNCTION: IllegalRequestError,
    ExceptionCode.ILLEGAL_DATA_ADDRESS: IllegalRequestError,
    ExceptionCode.ILLEGAL_DATA_VALUE: IllegalRequestError,
    ExceptionCode.ACKNOWLEDGE: SlaveDeviceBusyError,
    ExceptionCode.SERVER_DEVICE_BUSY: SlaveDeviceBusyError,
    0x07: NegativeAcknowledgeError,
}
"""The exception class for each exception code of a device; `SlaveReportedException` stands for the others."""


def exception_for(error: ModbusError) -> InstrumentError:
    """Create the exception of this module for an error of busway; the caller raises it.

    Its class follows from the exception code of the device (`REFUSALS`), or is `InvalidResponseError` for a bad or
    partial reply, `NoResponseError` for none, and `MasterReportedException` for anything else, such as a lost port.
    """
    cause = error.__cause__ if isinstance(error.__cause__, ModbusError) else error
    if isinstance(cause, ExceptionReply):
        return REFUSALS.get(cause.code, SlaveReportedException)(str(error))
    if isinstance(cause, BadReply) or (isinstance(cause, NoReply) and cause.kind == "partial"):
        return InvalidResponseError(str(error))
    if isinstance(cause, NoReply):
        return NoResponseError(f"No communication with the instrument (no answer): {error}")
    return MasterReportedException(str(error))


class InstrumentPort:
    """A serial port's settings by pyserial's names, and the link that was opened with them.

    Settings can be changed at any time; they apply from the next call of an instrument on.

    Attributes:
        port: name of the port.
        baudrate: bit/s.
        parity: ``N``, ``E`` or ``O``.
        bytesize: data bits, 7 or 8.
        stopbits: stop bits, 1 or 2.
        timeout: seconds that a reply may take, at least 0.001; None for an hour.
        write_timeout: has no effect.
    """

    def __init__(
        self,
        port: str,
        baudrate: int = 19200,
        parity: str = "N",
        bytesize: int = 8,
        stopbits: float = 1,
        timeout: float | None = 0.05,
        write_timeout: float | None = 2.0,
    ) -> None:
        self.port: str = port
        self.baudrate: int = baudrate
        self.parity: str = parity
        self.bytesize: int = bytesize
        self.stopbits: float = stopbits
        self.timeout: float | None = timeout
        self.write_timeout: float | None = write_timeout
        self._link: BlockingLink | None = None
        self._opened_with: dict[str, Any] | None = None

    def __repr__(self) -> str:
        return (
            f"InstrumentPort(port={self.port!r}, baudrate={self.baudrate}, bytesize={self.bytesize}, "
            f"parity={self.parity!r}, stopbits={self.stopbits}, timeout={self.timeout})"
        )

    @property
    def is_open(self) -> bool:
        """Whether the serial port is open now."""
        return self._link is not None and self._link.is_connected

    def open(self) -> None:
        """Do nothing: each call of an instrument opens the port if it is not open."""

    def close(self) -> None:
        """Close the serial port; the next call of an instrument opens it again."""
        link, self._link = self._link, None
        if link is not None:
            link.close()

    def link(self, mode: str, local_echo: bool) -> BlockingLink:
        """Return the link with the current settings; a link with other settings is closed and replaced.

        The port is opened by the link's first request.

        Args:
            mode: ``rtu`` or ``ascii``.
            local_echo: whether the port receives what it sends.

        Raises:
            ConfigError: a setting has a value that no link accepts.
        """
        # `Any`: the options of a link, chosen by name
        options: dict[str, Any] = {
            "baud": self.baudrate,
            "parity": self.parity,
            "data_bits": self.bytesize,
            "stop_bits": int(self.stopbits),
            "echo": "on" if local_echo else "off",
        }
        wanted = {"mode": mode, "port": self.port, **options}
        if self._link is None or wanted != self._opened_with:
            self.close()
            endpoint = Endpoint(mode, path=self.port)
            self._link = connect(endpoint, shared=False, retries=0, open_after=0, **options)
            self._opened_with = wanted
        return self._link


_ports: dict[str, InstrumentPort] = {}


def _port_for(port: Any) -> InstrumentPort:
    """Return the settings object of a port. Calls with the same name return the same object.

    If ``port`` is an object of pyserial, return a new object with a copy of its settings, and close ``port``, because a
    serial port has one user.
    """
    if isinstance(port, str):
        return _ports.setdefault(port, InstrumentPort(port))
    if not isinstance(getattr(port, "port", None), str):
        raise MasterReportedException("Failed to initialise serial port: a name or a serial.Serial with one is needed")
    settings = ("baudrate", "parity", "bytesize", "stopbits", "timeout", "write_timeout")
    made = InstrumentPort(port.port, **{name: getattr(port, name) for name in settings})
    port.close()
    return made


class Instrument:
    """One device on a serial line, with the methods of minimalmodbus to read and write it.

    Args:
        port: name of the port; or a ``serial.Serial``, whose settings are copied and which is closed.
        slaveaddress: unit 1…247, or 0 to write to all units.
        mode: ``rtu`` or ``ascii``.
        close_port_after_each_call: whether the port is closed after each call.
        debug: has no effect; the log of ``busway.TRACE`` shows the traffic.

    Attributes:
        address, mode, close_port_after_each_call: as given; may be changed at any time.
        serial: settings of the port, by pyserial's names (`InstrumentPort`); may be changed at any time. Instruments
            created with the same name of a port share them.
        handle_local_echo: whether the port receives what it sends; False by default.
        debug, precalculate_read_size, clear_buffers_before_each_transaction: have no effect.

    Each method raises ``TypeError`` or ``ValueError`` for arguments that cannot be sent, and otherwise an
    `InstrumentError`; after a write that was not answered the device may have executed the write. Register addresses
    are 0…65535.
    """

    def __init__(
        self,
        port: Any,  # a name, or an object of pyserial
        slaveaddress: int,
        mode: str = MODE_RTU,
        close_port_after_each_call: bool = False,
        debug: bool = False,
    ) -> None:
        if mode not in (MODE_RTU, MODE_ASCII):
            raise ValueError(f"mode must be {MODE_RTU!r} or {MODE_ASCII!r}, not {mode!r}")
        self.address: int = slaveaddress
        self.mode: str = mode
        self.precalculate_read_size: bool = True
        self.debug: bool = debug
        self.clear_buffers_before_each_transaction: bool = True
        self.close_port_after_each_call: bool = close_port_after_each_call
        self.handle_local_echo: bool = False
        self.serial: InstrumentPort = _port_for(port)
        self._roundtrip: float | None = None

    def __repr__(self) -> str:
        return (
            f"{type(self).__module__}.{type(self).__name__}<id=0x{id(self):x}, address={self.address}, "
            f"mode={self.mode}, close_port_after_each_call={self.close_port_after_each_call}, "
            f"handle_local_echo={self.handle_local_echo}, serial={self.serial}>"
        )

    @property
    def roundtrip_time(self) -> float | None:
        """Seconds that the last call took, waiting in the queue of the line included; None before the first call."""
        return self._roundtrip

    def _ask(self, request: Any) -> Any:  # a request of any class, and its reply
        """Send a request of `busway.pdu`, with the present settings of port and instrument, and return its reply."""
        _whole("slaveaddress", self.address, 0, LAST_UNIT)
        timeout = LONGEST_TIMEOUT if self.serial.timeout is None else max(self.serial.timeout, SHORTEST_TIMEOUT)
        began = time.monotonic()
        try:
            unit = self.serial.link(self.mode, self.handle_local_echo).unit(self.address)
            return unit.execute(request, timeout=timeout)
        except ModbusError as error:
            if isinstance(error, ValueError):  # nothing was sent
                raise
            raise exception_for(error) from error
        finally:
            self._roundtrip = time.monotonic() - began
            if self.close_port_after_each_call:
                self.serial.close()

    # --- bits ---------------------------------------------------------------------------------------------------------

    def read_bit(self, registeraddress: int, functioncode: int = 2) -> int:
        """Return one bit, 0 or 1: a discrete input (function code 2) or a coil (1)."""
        return self.read_bits(registeraddress, 1, functioncode)[0]

    def read_bits(self, registeraddress: int, number_of_bits: int, functioncode: int = 2) -> list[int]:
        """Return bits, each 0 or 1: discrete inputs (function code 2) or coils (1), ``registeraddress`` first.

        1…2000 bits. If ``address`` of the instrument is 0 (broadcast), nothing can be read: ``ValueError`` is raised.
        """
        _one_of("functioncode", functioncode, (1, 2))
        kind = ReadCoils if functioncode == 1 else ReadDiscreteInputs
        reply = self._ask(kind(_address(registeraddress), number_of_bits))
        return [int(bit) for bit in reply.bits(number_of_bits)]

    def write_bit(self, registeraddress: int, value: int, functioncode: int = 5) -> None:
        """Write one coil, 0 or 1, by function code 5 or 15. ``value`` must be an int, not a bool."""
        _one_of("functioncode", functioncode, (5, 15))
        state = bool(_whole("value", value, 0, 1))
        if functioncode == 5:
            self._ask(WriteSingleCoil.of(_address(registeraddress), state))
        else:
            self._ask(WriteMultipleCoils.of(_address(registeraddress), [state]))

    def write_bits(self, registeraddress: int, values: Sequence[int]) -> None:
        """Write coils from ``registeraddress`` on, by function code 15. ``values``: a list or tuple of ints, 0 or 1."""
        states = [bool(_whole("value", value, 0, 1)) for value in _list(values)]
        self._ask(WriteMultipleCoils.of(_address(registeraddress), states))

    # --- registers ----------------------------------------------------------------------------------------------------

    def read_registers(self, registeraddress: int, number_of_registers: int, functioncode: int = 3) -> list[int]:
        """Return registers as numbers 0…65535: holding registers (function code 3) or input registers (4).

        1…125 registers, from ``registeraddress`` on.
        """
        _one_of("functioncode", functioncode, (3, 4))
        kind = ReadHoldingRegisters if functioncode == 3 else ReadInputRegisters
        found: list[int] = self._ask(kind(_address(registeraddress), number_of_registers)).registers
        return found

    def write_registers(self, registeraddress: int, values: Sequence[int]) -> None:
        """Write holding registers from ``registeraddress`` on, by function code 16.

        ``values`` is a list or tuple of ints, 0…65535.
        """
        registers = [_whole("value", value, 0, LAST_REGISTER) for value in _list(values)]
        self._ask(WriteMultipleRegisters.of(_address(registeraddress), registers))

    def read_register(
        self, registeraddress: int, number_of_decimals: int = 0, functioncode: int = 3, signed: bool = False
    ) -> int | float:
        """Return the number in one register, divided by 10 to the power of ``number_of_decimals`` (0…10).

        The result is an int if it is a whole number, else a float. ``functioncode``: 3 for a holding register, 4 for an
        input register. ``signed``: whether registers above 32767 are negative numbers (two's complement).
        """
        _whole("number_of_decimals", number_of_decimals, 0, MOST_DECIMALS)
        number = _decoded(self.read_registers(registeraddress, 1, functioncode), _integer_code(1, signed))
        value = number / 10**number_of_decimals if number_of_decimals else number
        return int(value) if int(value) == value else value

    def write_register(
        self,
        registeraddress: int,
        value: float,
        number_of_decimals: int = 0,
        functioncode: int = 16,
        signed: bool = False,
    ) -> None:
        """Write a number to one holding register, by function code 16 or 6.

        ``value`` is multiplied by 10 to the power of ``number_of_decimals`` (0…10), and decimals left after that are
        cut off. ``signed``: whether the register holds -32768…32767 (two's complement) instead of 0…65535.
        """
        _one_of("functioncode", functioncode, (6, 16))
        _whole("number_of_decimals", number_of_decimals, 0, MOST_DECIMALS)
        number = int(float(_number("value", value)) * 10**number_of_decimals)
        (register,) = _encoded(number, _integer_code(1, signed))
        if functioncode == 6:
            self._ask(WriteSingleRegister(_address(registeraddress), register))
        else:
            self._ask(WriteMultipleRegisters.of(_address(registeraddress), [register]))

    def read_long(
        self,
        registeraddress: int,
        functioncode: int = 3,
        signed: bool = False,
        byteorder: int = BYTEORDER_BIG,
        number_of_registers: int = 2,
    ) -> int:
        """Return the whole number in two or four registers; holding registers by default.

        ``functioncode``: 3 for holding registers, 4 for input registers. ``signed``: whether it is a number in two's
        complement, which can be negative. ``byteorder`` is one of the ``BYTEORDER_…`` constants.
        """
        _one_of("number_of_registers", number_of_registers, (2, 4))
        registers = self.read_registers(registeraddress, number_of_registers, functioncode)
        return int(_decoded(registers, _integer_code(number_of_registers, signed), byteorder))

    def write_long(
        self,
        registeraddress: int,
        value: int,
        signed: bool = False,
        byteorder: int = BYTEORDER_BIG,
        number_of_registers: int = 2,
    ) -> None:
        """Write a whole number to two or four holding registers, by function code 16.

        ``signed``: whether it is written in two's complement, so that it can be negative. ``byteorder`` is one of the
        ``BYTEORDER_…`` constants.
        """
        _one_of("number_of_registers", number_of_registers, (2, 4))
        number = _whole("value", value, -(1 << 63), (1 << 64) - 1)
        self.write_registers(registeraddress, _encoded(number, _integer_code(number_of_registers, signed), byteorder))

    def read_float(
        self,
        registeraddress: int,
        functioncode: int = 3,
        number_of_registers: int = 2,
        byteorder: int = BYTEORDER_BIG,
    ) -> float:
        """Return the float (IEEE 754) in two or four registers; holding registers by default.

        ``functioncode``: 3 for holding registers, 4 for input registers. ``byteorder`` is one of the ``BYTEORDER_…``
        constants.
        """
        _one_of("number_of_registers", number_of_registers, tuple(FLOATS))
        registers = self.read_registers(registeraddress, number_of_registers, functioncode)
        return float(_decoded(registers, FLOATS[number_of_registers], byteorder))

    def write_float(
        self, registeraddress: int, value: float, number_of_registers: int = 2, byteorder: int = BYTEORDER_BIG
    ) -> None:
        """Write a float to two or four holding registers, by function code 16.

        ``byteorder`` is one of the ``BYTEORDER_…`` constants.
        """
        _one_of("number_of_registers", number_of_registers, tuple(FLOATS))
        self.write_registers(
            registeraddress, _encoded(float(_number("value", value)), FLOATS[number_of_registers], byteorder)
        )

    def read_string(self, registeraddress: int, number_of_registers: int = 16, functioncode: int = 3) -> str:
        """Return a text of two ASCII characters for each register; zeros and spaces at its end are kept.

        ``functioncode``: 3 for holding registers, 4 for input registers. Raises ``ValueError`` if a byte is not ASCII.
        """
        registers = self.read_registers(registeraddress, number_of_registers, functioncode)
        return struct.pack(f">{len(registers)}H", *registers).decode("ascii")

    def write_string(self, registeraddress: int, textstring: str, number_of_registers: int = 16) -> None:
        """Write an ASCII text to ``number_of_registers`` (1…123) holding registers, by function code 16.

        Two characters fit into a register; the rest of the registers is filled with spaces.

        Raises:
            ValueError: the text is empty, too long or not ASCII, or another argument is out of range. Nothing was sent.
            TypeError: an argument has the wrong type. Nothing was sent.
            InstrumentError: the device refused the write, or there was no valid reply.
        """
        if not isinstance(textstring, str):
            raise TypeError(f"The textstring should be a string, not {textstring!r}")
        if not textstring:
            raise ValueError("The textstring has no characters; at least one is needed")
        size = 2 * _whole("number_of_registers", number_of_registers, 1, 123)
        data = textstring.encode("ascii").ljust(size)
        if len(data) > size:
            raise ValueError(
                f"The textstring has {len(data)} characters; {size} fit into {number_of_registers} registers"
            )
        self.write_registers(registeraddress, struct.unpack(f">{number_of_registers}H", data))


# --- values -----------------------------------------------------------------------------------------------------------


def _integer_code(registers: int, signed: bool) -> str:
    if not isinstance(signed, bool):
        raise TypeError(f"signed must be True or False, not {signed!r}")
    return SIGNED[registers] if signed else SIGNED[registers].upper()


def _mark(byteorder: int) -> tuple[str, bool]:
    """Return ``<`` or ``>`` of `struct` for a byte order, and whether the bytes of each register are also swapped."""
    _whole("byteorder", byteorder, BYTEORDER_BIG, BYTEORDER_LITTLE_SWAP)
    is_little = byteorder in (BYTEORDER_LITTLE, BYTEORDER_LITTLE_SWAP)
    return "<" if is_little else ">", byteorder in (BYTEORDER_BIG_SWAP, BYTEORDER_LITTLE_SWAP)


def _decoded(registers: Sequence[int], code: str, byteorder: int = BYTEORDER_BIG) -> Any:  # as `code` says
    mark, is_swapped = _mark(byteorder)
    data = struct.pack(f"{'<' if is_swapped else '>'}{len(registers)}H", *registers)
    (value,) = struct.unpack(f"{mark}{code}", data)
    return value


def _encoded(value: float, code: str, byteorder: int = BYTEORDER_BIG) -> Sequence[int]:
    mark, is_swapped = _mark(byteorder)
    try:
        data = struct.pack(f"{mark}{code}", value)
    except (struct.error, OverflowError) as error:
        raise ValueError(f"The value {value!r} is out of range: {error}") from error
    return struct.unpack(f"{'<' if is_swapped else '>'}{len(data) // 2}H", data)


# --- checks -----------------------------------------------------------------------------------------------------------


def _address(registeraddress: int) -> int:
    return _whole("registeraddress", registeraddress, 0, LAST_REGISTER)


def _whole(name: str, value: Any, least: int, most: int) -> int:
    if not isinstance(value, int) or isinstance(value, bool):
        raise TypeError(f"The {name} must be an integer, not {value!r}")
    if not least <= value <= most:
        raise ValueError(f"The {name} must be {least}…{most}, not {value}")
    return value


def _number(name: str, value: Any) -> float:
    if not isinstance(value, int | float) or isinstance(value, bool):
        raise TypeError(f"The {name} must be a number, not {value!r}")
    return value


def _one_of(name: str, value: Any, allowed: tuple[int, ...]) -> None:
    if not isinstance(value, int):
        raise TypeError(f"The {name} must be an integer, not {value!r}")
    if value not in allowed:
        raise ValueError(f"The {name} must be {' or '.join(map(str, allowed))}, not {value}")


def _list(values: Any) -> Sequence[int]:
    if not isinstance(values, list | tuple):
        raise TypeError(f"The values must be a list, not {values!r}")
    if not values:
        raise ValueError("The list of values is empty")
    return values
