"""The request and response objects of pymodbus: each request is converted to a message of busway.

Knows both kinds of objects; knows no connection. `ModbusPDU.to_request` returns the message to send,
`ModbusPDU.response` the response object for its reply.

1. Values are checked when busway's message is created: a wrong one raises `InvalidRequest` (a ``ValueError``) before
   any byte is sent.
2. An object of a class of the program itself, with ``function_code``, ``encode`` and ``decode``, is sent as the bytes
   that its ``encode`` returns.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, TypeVar

from ...client.operations import diagnostic_data, diagnostic_request
from ...codes import DiagnosticCode
from ...errors import InvalidRequest
from ...pdu.bits import as_state, unpack_bits
from ...pdu.diagnostics import GetCommEventCounter, GetCommEventLog, ReadExceptionStatus, ReportServerId
from ...pdu.encapsulated import ReadDeviceIdentification
from ...pdu.file_records import FileData, FileReference, ReadFileRecord, WriteFileRecord
from ...pdu.message import Request
from ...pdu.read_items import (
    ReadCoils,
    ReadDiscreteInputs,
    ReadFifoQueue,
    ReadHoldingRegisters,
    ReadInputRegisters,
)
from ...pdu.unknown_functions import OpaqueRequest
from ...pdu.write_items import (
    MaskWriteRegister,
    ReadWriteMultipleRegisters,
    WriteMultipleCoils,
    WriteMultipleRegisters,
    WriteSingleCoil,
    WriteSingleRegister,
    pack_registers,
)
from .constants import DeviceInformation, ModbusStatus
from .exceptions import ModbusException, ModbusIOException

Value = TypeVar("Value")

UNIT_NAMES = ("device_id", "slave", "unit", "dev_id", "slave_id", "unit_id")
"""The names that releases of pymodbus have for the unit."""
EXCEPTION_BIT = 0x80
RUNS = 0xFF
COIL_ON = 0xFF00
LAST_UNIT = 255


def unit_of(names: dict[str, Any], given: int | None = None) -> int:
    """Return the unit that the keyword arguments ``names`` of a call give (``device_id``, ``slave`` …).

    If they give none, return ``given``, or 1 if that is None.

    Raises:
        TypeError: an argument has another name, or two of them name different units.
    """
    named: int | None = None
    for name, value in names.items():
        if name not in UNIT_NAMES:
            raise TypeError(f"unexpected keyword argument {name!r}")
        if value is None:
            continue
        if named not in (None, value):
            raise TypeError(f"{', '.join(names)}: these arguments name different units")
        named = value
    if named is not None:
        return named
    return 1 if given is None else given


class ModbusPDU:
    """Base of all requests and responses.

    Attributes:
        function_code, sub_function_code: codes of the function; -1 for no sub-function.
        dev_id: the unit, 0…255; ``slave_id`` and ``unit_id`` return it too.
        transaction_id: kept for the program; it is not sent.
        address, count: address of the first item and number of items; 0 if there are none.
        registers, bits: the values; empty lists if there are none.
        status: status of a response, for functions that have one.
        exception_code: exception code of an exception response; 0 otherwise.

    Raises:
        ModbusIOException: the unit is outside 0…255.
    """

    function_code: int = 0
    sub_function_code: int = -1

    def __init__(
        self,
        dev_id: int = 1,
        transaction_id: int = 0,
        address: int = 0,
        count: int = 0,
        bits: Iterable[bool] | None = None,
        registers: Iterable[int] | None = None,
        status: int = 1,
        **names: Any,  # the unit under an older name
    ) -> None:
        self.dev_id: int = unit_of({name: value for name, value in names.items() if name != "skip_encode"}, dev_id)
        if not 0 <= self.dev_id <= LAST_UNIT:
            raise ModbusIOException(f"Invalid ID {self.dev_id}", self.function_code)
        self.transaction_id: int = transaction_id
        self.address: int = address
        self.bits: Sequence[bool] = list(bits or [])
        self.registers: Sequence[int] = list(registers or [])
        self.count: int = count or len(self.registers)
        self.status: int = status
        self.exception_code: int = 0
        self.retries: int = 0

    @property
    def slave_id(self) -> int:
        """The unit, by its name in releases before 3.9."""
        return self.dev_id

    @property
    def unit_id(self) -> int:
        """The unit, by its name in releases before 3.0."""
        return self.dev_id

    def fill(self, **values: Any) -> None:
        """Set several attributes of this object, given as keyword arguments."""
        for name, value in values.items():
            setattr(self, name, value)

    def isError(self) -> bool:
        """Whether this is an exception response."""
        return self.function_code > EXCEPTION_BIT

    def __str__(self) -> str:
        return (
            f"{type(self).__name__}(dev_id={self.dev_id}, transaction_id={self.transaction_id}, "
            f"address={self.address}, count={self.count}, bits={self.bits!s}, registers={self.registers!s}, "
            f"status={self.status!s}, retries={self.retries})"
        )

    def encode(self) -> bytes:
        """Return the bytes after the function code; classes of the program itself override this method."""
        return b""

    def decode(self, data: bytes) -> None:
        """Set the values from the bytes after the function code; classes of the program itself override this method."""

    def to_request(self) -> Request:
        """Return the message of busway for this request.

        Raises:
            InvalidRequest: a value is out of range; nothing was sent.
        """
        return OpaqueRequest(self.function_code, self.encode())

    def response(self, reply: Any, own: "dict[int, type[ModbusPDU]]") -> "ModbusPDU":
        """Return the response object for a reply message of busway.

        Args:
            reply: the reply.
            own: response classes that the program registered, by function code.

        Raises:
            ModbusIOException: no class is registered for the function. The request was executed: this is called after
                the reply came. Errors of the registered class itself are not caught.
        """
        kind = own.get(self.function_code)
        if kind is None:
            raise ModbusIOException(f"no class is registered for function {self.function_code}", self.function_code)
        response = kind()
        response.dev_id = self.dev_id
        response.decode(reply.encode()[1:])
        return response


ModbusRequest = ModbusPDU
ModbusResponse = ModbusPDU


class ExceptionResult(ModbusPDU):
    """An exception response of any function; pymodbus' name is ``ExceptionResponse``.

    Attributes:
        original_code: function code of the request.
        function_code: function code of the request with 0x80 added.
        exception_code: the exception code that the device sent.
    """

    def __init__(
        self, function_code: int, exception_code: int = 0, device_id: int = 1, transaction: int = 0, **names: Any
    ) -> None:
        super().__init__(device_id, transaction, **names)
        self.original_code: int = function_code & ~EXCEPTION_BIT
        self.fill(function_code=function_code | EXCEPTION_BIT, exception_code=exception_code)

    def __str__(self) -> str:
        return (
            f"ExceptionResponse(dev_id={self.dev_id}, function_code={self.function_code}, "
            f"exception_code={self.exception_code})"
        )


ExceptionResult.__name__ = ExceptionResult.__qualname__ = "ExceptionResponse"
ExceptionResponse = ExceptionResult


class KnownRequest(ModbusPDU):
    """Base of the requests of standard functions. ``responds`` is the class of their responses."""

    responds: ClassVar[type["KnownResponse"]]

    def response(self, reply: Any, own: dict[int, type[ModbusPDU]]) -> ModbusPDU:
        """Return the response object for a reply message of busway.

        Args:
            reply: the reply.
            own: classes that the program registered; not used, because a standard function has its own.
        """
        response = self.responds(dev_id=self.dev_id)
        response.take(reply)
        return response


class KnownResponse(ModbusPDU):
    """Base of the responses of standard functions; they get their values from busway's replies."""

    def take(self, reply: Any) -> None:
        """Set the values of this response from a reply message of busway for the same function."""


# --- bits -------------------------------------------------------------------------------------------------------------


class ReadCoilsResponse(KnownResponse):
    """Response of function 01, read coils: their states in ``bits``, filled up to whole bytes."""

    function_code: int = 1

    def take(self, reply: Any) -> None:
        self.fill(bits=unpack_bits(reply.data, 8 * len(reply.data)))

    def getBit(self, address: int) -> bool:
        """Return the bit at the position ``address`` in the response, from 0 on."""
        return self.bits[address]


class ReadDiscreteInputsResponse(ReadCoilsResponse):
    """Response of function 02, read discrete inputs: their states in ``bits``, filled up to whole bytes."""

    function_code: int = 2


class ReadCoilsRequest(KnownRequest):
    """Request of function 01: read ``count`` coils from ``address`` on."""

    function_code: int = 1
    responds: ClassVar[type[KnownResponse]] = ReadCoilsResponse

    def __init__(
        self, address: int = 0, count: int = 1, dev_id: int = 1, transaction_id: int = 0, **names: Any
    ) -> None:
        super().__init__(dev_id, transaction_id, address, count, **names)

    def to_request(self) -> Request:
        return ReadCoils(self.address, self.count)


class ReadDiscreteInputsRequest(ReadCoilsRequest):
    """Request of function 02: read ``count`` discrete inputs from ``address`` on."""

    function_code: int = 2
    responds: ClassVar[type[KnownResponse]] = ReadDiscreteInputsResponse

    def to_request(self) -> Request:
        return ReadDiscreteInputs(self.address, self.count)


class WriteSingleCoilResponse(KnownResponse):
    """Response of function 05, write single coil: repeats ``address`` and the state, in ``bits`` and ``value``."""

    function_code: int = 5

    def take(self, reply: Any) -> None:
        self.fill(address=reply.address, bits=[reply.value == COIL_ON])

    @property
    def value(self) -> bool:
        """The state that was written."""
        return bool(self.bits[0])


class WriteSingleCoilRequest(KnownRequest):
    """Request of function 05: write one coil. Its state is ``bits``, or the older argument ``value``."""

    function_code: int = 5
    responds: ClassVar[type[KnownResponse]] = WriteSingleCoilResponse

    def __init__(
        self,
        address: int = 0,
        bits: Iterable[bool] | bool | None = None,
        dev_id: int = 1,
        transaction_id: int = 0,
        **names: Any,
    ) -> None:
        values = names.pop("value", False) if bits is None else bits
        states: list[Any] = list(values) if isinstance(values, list | tuple) else [values]  # checked by `state`
        super().__init__(dev_id, transaction_id, address, bits=states, **names)

    def to_request(self) -> Request:
        return WriteSingleCoil.of(self.address, state(first(self.bits)))


class WriteMultipleCoilsResponse(KnownResponse):
    """Response of function 15, write multiple coils: ``address`` and ``count`` of the coils that were written."""

    function_code: int = 15

    def take(self, reply: Any) -> None:
        self.fill(address=reply.address, count=reply.count)


class WriteMultipleCoilsRequest(KnownRequest):
    """Request of function 15: write coils from ``address`` on. States: ``bits``, or the older argument ``values``."""

    function_code: int = 15
    responds: ClassVar[type[KnownResponse]] = WriteMultipleCoilsResponse

    def __init__(
        self,
        address: int = 0,
        bits: Iterable[bool] | bool | None = None,
        dev_id: int = 1,
        transaction_id: int = 0,
        **names: Any,
    ) -> None:
        values = names.pop("values", ()) if bits is None else bits
        states = list(values) if isinstance(values, Iterable) else [values]
        super().__init__(dev_id, transaction_id, address, len(states), bits=states, **names)

    def to_request(self) -> Request:
        return WriteMultipleCoils.of(self.address, [state(value) for value in self.bits])


def first(values: Sequence[Value]) -> Value:
    """Return the value that a request for a single coil or register writes: the first of its values.

    Raises:
        InvalidRequest: there is none.
    """
    if not values:
        raise InvalidRequest("there is no value to write")
    return values[0]


def state(value: object) -> bool:
    """Return a coil's state for a value that pymodbus accepts, such as a number: 0 is False, all others are True.

    Raises:
        InvalidRequest: the value is no state, such as a text.
    """
    return bool(value) if isinstance(value, int) else as_state("value", value)


# --- registers --------------------------------------------------------------------------------------------------------


class ReadHoldingRegistersResponse(KnownResponse):
    """Response of function 03, read holding registers: their values in ``registers``."""

    function_code: int = 3

    def take(self, reply: Any) -> None:
        self.fill(registers=reply.registers)

    def getRegister(self, index: int) -> int:
        """Return the register at the position ``index`` in the response, from 0 on."""
        return self.registers[index]


class ReadInputRegistersResponse(ReadHoldingRegistersResponse):
    """Response of function 04, read input registers: their values in ``registers``."""

    function_code: int = 4


class ReadWriteMultipleRegistersResponse(ReadHoldingRegistersResponse):
    """Response of function 23, read/write multiple registers: the values that were read in ``registers``."""

    function_code: int = 23


class ReadHoldingRegistersRequest(KnownRequest):
    """Request of function 03: read ``count`` holding registers from ``address`` on."""

    function_code: int = 3
    responds: ClassVar[type[KnownResponse]] = ReadHoldingRegistersResponse

    def __init__(
        self, address: int = 0, count: int = 1, dev_id: int = 1, transaction_id: int = 0, **names: Any
    ) -> None:
        super().__init__(dev_id, transaction_id, address, count, **names)

    def to_request(self) -> Request:
        return ReadHoldingRegisters(self.address, self.count)


class ReadInputRegistersRequest(ReadHoldingRegistersRequest):
    """Request of function 04: read ``count`` input registers from ``address`` on."""

    function_code: int = 4
    responds: ClassVar[type[KnownResponse]] = ReadInputRegistersResponse

    def to_request(self) -> Request:
        return ReadInputRegisters(self.address, self.count)


class WriteSingleRegisterResponse(KnownResponse):
    """Response of function 06, write single register: repeats ``address`` and ``value`` (also in ``registers``)."""

    function_code: int = 6

    def take(self, reply: Any) -> None:
        self.fill(address=reply.address, registers=[reply.value], count=1)

    @property
    def value(self) -> int:
        """The value that was written."""
        return self.registers[0]


class WriteSingleRegisterRequest(KnownRequest):
    """Request of function 06: write one holding register.

    Its value is ``registers``, or the older argument ``value``: a number, or two bytes of a payload builder.
    """

    function_code: int = 6
    responds: ClassVar[type[KnownResponse]] = WriteSingleRegisterResponse

    def __init__(
        self,
        address: int = 0,
        registers: Iterable[int] | bytes | int | None = None,
        dev_id: int = 1,
        transaction_id: int = 0,
        **names: Any,
    ) -> None:
        value = names.pop("value", 0) if registers is None else registers
        super().__init__(dev_id, transaction_id, address, registers=numbers(value), **names)

    def to_request(self) -> Request:
        return WriteSingleRegister(self.address, first(self.registers))


class WriteMultipleRegistersResponse(KnownResponse):
    """Response of function 16, write multiple registers: ``address`` and ``count`` of the written registers."""

    function_code: int = 16

    def take(self, reply: Any) -> None:
        self.fill(address=reply.address, count=reply.count)


class WriteMultipleRegistersRequest(KnownRequest):
    """Request of function 16: write holding registers from ``address`` on.

    Their values are ``registers``, or the older argument ``values``: numbers, or pairs of bytes of a payload builder.
    """

    function_code: int = 16
    responds: ClassVar[type[KnownResponse]] = WriteMultipleRegistersResponse

    def __init__(
        self,
        address: int = 0,
        registers: Iterable[int | bytes] | int | None = None,
        dev_id: int = 1,
        transaction_id: int = 0,
        **names: Any,
    ) -> None:
        values = names.pop("values", ()) if registers is None else registers
        super().__init__(dev_id, transaction_id, address, registers=numbers(values), **names)

    def to_request(self) -> Request:
        return WriteMultipleRegisters.of(self.address, self.registers)


def numbers(values: Any) -> list[int]:  # what programs pass: a number, two bytes, or a sequence of either
    """Return registers as a list of numbers, from one number, two bytes, or a sequence of either."""
    found = [values] if isinstance(values, int | bytes) else list(values)
    return [int.from_bytes(one, "big") if isinstance(one, bytes) else one for one in found]


class MaskWriteRegisterResponse(KnownResponse):
    """Response of function 22, mask write register: repeats ``address``, ``and_mask`` and ``or_mask``."""

    function_code: int = 22
    and_mask: int = 0xFFFF
    or_mask: int = 0

    def take(self, reply: Any) -> None:
        self.fill(address=reply.address, and_mask=reply.and_mask, or_mask=reply.or_mask)


class MaskWriteRegisterRequest(KnownRequest):
    """Request of function 22: set a register to (old AND ``and_mask``) OR (``or_mask`` AND NOT ``and_mask``)."""

    function_code: int = 22
    responds: ClassVar[type[KnownResponse]] = MaskWriteRegisterResponse

    def __init__(
        self,
        address: int = 0,
        and_mask: int = 0xFFFF,
        or_mask: int = 0,
        dev_id: int = 1,
        transaction_id: int = 0,
        **names: Any,
    ) -> None:
        super().__init__(dev_id, transaction_id, address, **names)
        self.and_mask: int = and_mask
        self.or_mask: int = or_mask

    def to_request(self) -> Request:
        return MaskWriteRegister(self.address, self.and_mask, self.or_mask)


class ReadWriteMultipleRegistersRequest(KnownRequest):
    """Request of function 23: write holding registers, then read ``read_count`` of them from ``read_address`` on.

    ``write_registers`` are the values to write from ``write_address`` on.
    """

    function_code: int = 23
    responds: ClassVar[type[KnownResponse]] = ReadWriteMultipleRegistersResponse

    def __init__(
        self,
        read_address: int = 0,
        read_count: int = 0,
        write_address: int = 0,
        write_registers: Iterable[int] | int | None = None,
        dev_id: int = 1,
        transaction_id: int = 0,
        **names: Any,
    ) -> None:
        super().__init__(dev_id, transaction_id, **names)
        self.read_address: int = read_address
        self.read_count: int = read_count
        self.write_address: int = write_address
        self.write_registers: list[int] = numbers(() if write_registers is None else write_registers)

    def to_request(self) -> Request:
        return ReadWriteMultipleRegisters.of(
            self.read_address, self.read_count, self.write_address, self.write_registers
        )


class ReadFifoQueueResponse(KnownResponse):
    """Response of function 24, read FIFO queue: its registers in ``values`` and ``registers``, the oldest first."""

    function_code: int = 24

    values: Sequence[int] = ()

    def take(self, reply: Any) -> None:
        self.fill(registers=reply.registers, values=reply.registers)


class ReadFifoQueueRequest(KnownRequest):
    """Request of function 24: read the FIFO queue at ``address``."""

    function_code: int = 24
    responds: ClassVar[type[KnownResponse]] = ReadFifoQueueResponse

    def __init__(self, address: int = 0, dev_id: int = 1, transaction_id: int = 0, **names: Any) -> None:
        super().__init__(dev_id, transaction_id, address, **names)

    def to_request(self) -> Request:
        return ReadFifoQueue(self.address)


# --- files ------------------------------------------------------------------------------------------------------------


@dataclass
class FileRecord:
    """A part of a file: where it begins, and its data or its length.

    Attributes:
        file_number: number of the file.
        record_number: first register of the part in the file.
        record_data: the data; empty for a part to be read.
        record_length: length of the part; given in bytes and stored in registers, as in pymodbus.

    Raises:
        ModbusException: data and length are both given, or are no whole number of registers.
    """

    file_number: int = 0
    record_number: int = 0
    record_data: bytes = b""
    record_length: int = 0

    def __post_init__(self) -> None:
        if self.record_data and self.record_length:
            raise ModbusException("Use either record_data= or record_length=")
        length = self.record_length or len(self.record_data)
        if length % 2:
            raise ModbusException("length of record_data must be a multiple of 2")
        self.record_length = length // 2


class ReadFileRecordResponse(KnownResponse):
    """Response of function 20, read file record: ``records`` with their data, in the order of the request."""

    function_code: int = 20

    records: Sequence[FileRecord] = ()

    def take(self, reply: Any) -> None:
        self.records = [FileRecord(record_data=content.data) for content in reply.contents]


class ReadFileRecordRequest(KnownRequest):
    """Request of function 20: read parts of files, each given by a `FileRecord` with ``record_length``."""

    function_code: int = 20
    responds: ClassVar[type[KnownResponse]] = ReadFileRecordResponse

    def __init__(
        self, records: Iterable[FileRecord] | None = None, dev_id: int = 1, transaction_id: int = 0, **names: Any
    ) -> None:
        super().__init__(dev_id, transaction_id, **names)
        self.records: list[FileRecord] = list(records or [])

    def to_request(self) -> Request:
        return ReadFileRecord.of(
            [FileReference(one.file_number, one.record_number, one.record_length) for one in self.records]
        )


class WriteFileRecordResponse(KnownResponse):
    """Response of function 21, write file record: repeats the ``records`` of the request."""

    function_code: int = 21

    records: Sequence[FileRecord] = ()

    def take(self, reply: Any) -> None:
        self.records = [FileRecord(one.file, one.record, one.data) for one in reply.groups]


class WriteFileRecordRequest(KnownRequest):
    """Request of function 21: write parts of files, each given by a `FileRecord` with ``record_data``."""

    function_code: int = 21
    responds: ClassVar[type[KnownResponse]] = WriteFileRecordResponse

    def __init__(
        self, records: Iterable[FileRecord] | None = None, dev_id: int = 1, transaction_id: int = 0, **names: Any
    ) -> None:
        super().__init__(dev_id, transaction_id, **names)
        self.records: list[FileRecord] = list(records or [])

    def to_request(self) -> Request:
        return WriteFileRecord(
            tuple(FileData(one.file_number, one.record_number, one.record_data) for one in self.records)
        )


# --- identification and diagnostics -----------------------------------------------------------------------------------


class ReadDeviceInformationResponse(KnownResponse):
    """Response of function 43/14, read device identification: the objects in ``information``, by number.

    Several values of one object are a list. If ``more_follows``, a request from ``next_object_id`` on continues.
    """

    function_code: int = 43
    sub_function_code: int = 14

    read_code: int = DeviceInformation.BASIC
    conformity: int = 0
    more_follows: int = 0
    next_object_id: int = 0
    number_of_objects: int = 0

    def take(self, reply: Any) -> None:
        self.information: dict[int, Any] = {}
        for one in reply.objects:
            known = self.information.get(one.number)
            if known is None:
                self.information[one.number] = one.value
            else:  # several values of one object are a list
                self.information[one.number] = [*(known if isinstance(known, list) else [known]), one.value]
        self.fill(
            read_code=reply.level,
            conformity=reply.conformity,
            more_follows=reply.more_follows,
            next_object_id=reply.next_object,
            number_of_objects=reply.number_of_objects,
        )


class ReadDeviceInformationRequest(KnownRequest):
    """Request of function 43/14: read the identification objects of a level (``read_code``), from ``object_id`` on."""

    function_code: int = 43
    sub_function_code: int = 14
    responds: ClassVar[type[KnownResponse]] = ReadDeviceInformationResponse

    def __init__(
        self, read_code: int | None = None, object_id: int = 0, dev_id: int = 1, transaction_id: int = 0, **names: Any
    ) -> None:
        super().__init__(dev_id, transaction_id, **names)
        self.read_code: int = read_code or DeviceInformation.BASIC
        self.object_id: int = object_id

    def to_request(self) -> Request:
        return ReadDeviceIdentification(int(self.read_code), self.object_id)


class ReadExceptionStatusResponse(KnownResponse):
    """Response of function 07, read exception status: eight bits that the device defines, in ``status``."""

    function_code: int = 7

    def take(self, reply: Any) -> None:
        self.fill(status=reply.status)


class GetCommEventCounterResponse(KnownResponse):
    """Response of function 11, get comm event counter: the counter in ``count``.

    ``status`` is True if the device is ready, False while a program command is running.
    """

    function_code: int = 11

    def take(self, reply: Any) -> None:
        self.fill(status=reply.status == ModbusStatus.READY, count=reply.event_count)


class GetCommEventLogResponse(KnownResponse):
    """Response of function 12, get comm event log: the log in ``events``, the newest first, and its counters.

    ``status`` is True if the device is ready, False while a program command is running; ``event_count`` and
    ``message_count`` are its counters; ``events`` are numbers 0…255.
    """

    function_code: int = 12

    event_count: int = 0
    message_count: int = 0
    events: Sequence[int] = ()

    def take(self, reply: Any) -> None:
        self.fill(
            status=reply.status == ModbusStatus.READY,
            event_count=reply.event_count,
            message_count=reply.message_count,
            events=list(reply.events),
        )


class ReportDeviceIdResponse(KnownResponse):
    """Response of function 17, report server ID: its bytes in ``identifier``; ``status`` is whether the device runs.

    The last byte of the data is taken as the run indicator, FF if the device runs; ``identifier`` is the rest.
    ``byte_count`` is the number of bytes with it.
    """

    function_code: int = 17

    identifier: bytes = b""
    byte_count: int = 0

    def take(self, reply: Any) -> None:
        runs = reply.data[-1:] == bytes((RUNS,))
        self.fill(identifier=reply.data[:-1], byte_count=len(reply.data), status=runs)


class PlainRequest(KnownRequest):
    """Base of the requests without fields. ``message`` is the class of busway's message."""

    message: ClassVar[type[Request]]

    def __init__(self, dev_id: int = 1, transaction_id: int = 0, **names: Any) -> None:
        super().__init__(dev_id, transaction_id, **names)

    def to_request(self) -> Request:
        return self.message()


class ReadExceptionStatusRequest(PlainRequest):
    """Request of function 07: read eight status bits of the device."""

    function_code: int = 7
    responds: ClassVar[type[KnownResponse]] = ReadExceptionStatusResponse
    message: ClassVar[type[Request]] = ReadExceptionStatus


class GetCommEventCounterRequest(PlainRequest):
    """Request of function 11: read the counter of communication events."""

    function_code: int = 11
    responds: ClassVar[type[KnownResponse]] = GetCommEventCounterResponse
    message: ClassVar[type[Request]] = GetCommEventCounter


class GetCommEventLogRequest(PlainRequest):
    """Request of function 12: read the log of communication events."""

    function_code: int = 12
    responds: ClassVar[type[KnownResponse]] = GetCommEventLogResponse
    message: ClassVar[type[Request]] = GetCommEventLog


class ReportDeviceIdRequest(PlainRequest):
    """Request of function 17: read the server ID of the device."""

    function_code: int = 17
    responds: ClassVar[type[KnownResponse]] = ReportDeviceIdResponse
    message: ClassVar[type[Request]] = ReportServerId


class DiagnosticResponse(KnownResponse):
    """Response of function 08, diagnostics: the data in ``message``, as a number; for sub-function 00 as bytes."""

    function_code: int = 8
    message: Any = 0  # a number, or bytes

    def take(self, reply: Any) -> None:
        data = diagnostic_data(reply)
        repeats = self.sub_function_code == DiagnosticCode.RETURN_QUERY_DATA
        self.fill(message=data if repeats else int.from_bytes(data, "big"))


class DiagnosticBase(KnownRequest):
    """Request of function 08: diagnostics with a sub-function (``sub_function``) and its data, ``message``.

    The data are bytes, a number 0…65535, or a sequence of such numbers.
    """

    function_code: int = 8
    responds: ClassVar[type[KnownResponse]] = DiagnosticResponse

    def __init__(
        self,
        message: bytes | int | Sequence[int] = 0,
        dev_id: int = 1,
        transaction_id: int = 0,
        **names: Any,
    ) -> None:
        self.fill(sub_function_code=names.pop("sub_function", self.sub_function_code))
        super().__init__(dev_id, transaction_id, **names)
        self.message: bytes | int | Sequence[int] = message

    def to_request(self) -> Request:
        message = self.message
        if not isinstance(message, bytes):
            message = pack_registers([message] if isinstance(message, int) else message)
        return diagnostic_request(self.sub_function_code, message)

    def response(self, reply: Any, own: dict[int, type[ModbusPDU]]) -> ModbusPDU:
        """Return the response object for a reply message of busway.

        Args:
            reply: the reply.
            own: classes that the program registered; not used, because a standard function has its own.
        """
        response = DiagnosticResponse(dev_id=self.dev_id)
        response.sub_function_code = self.sub_function_code
        response.take(reply)
        return response


SUB_FUNCTIONS: dict[str, int] = {
    "query_data": DiagnosticCode.RETURN_QUERY_DATA,
    "restart_communication": DiagnosticCode.RESTART_COMMUNICATIONS,
    "read_diagnostic_register": DiagnosticCode.RETURN_DIAGNOSTIC_REGISTER,
    "change_ascii_input_delimeter": DiagnosticCode.CHANGE_ASCII_DELIMITER,
    "force_listen_only": DiagnosticCode.FORCE_LISTEN_ONLY,
    "clear_counters": DiagnosticCode.CLEAR_COUNTERS,
    "read_bus_message_count": DiagnosticCode.BUS_MESSAGE_COUNT,
    "read_bus_comm_error_count": DiagnosticCode.BUS_COMMUNICATION_ERROR_COUNT,
    "read_bus_exception_error_count": DiagnosticCode.BUS_EXCEPTION_ERROR_COUNT,
    "read_device_message_count": DiagnosticCode.SERVER_MESSAGE_COUNT,
    "read_device_no_response_count": DiagnosticCode.SERVER_NO_RESPONSE_COUNT,
    "read_device_nak_count": DiagnosticCode.SERVER_NAK_COUNT,
    "read_device_busy_count": DiagnosticCode.SERVER_BUSY_COUNT,
    "read_bus_char_overrun_count": DiagnosticCode.BUS_CHARACTER_OVERRUN_COUNT,
    "read_iop_overrun_count": 0x13,  # the specification keeps it reserved
    "clear_overrun_counter": DiagnosticCode.CLEAR_OVERRUN,
}
"""The sub-function codes of function 08, by the name after ``diag_`` of pymodbus' calls."""

__path__: list[str] = []
"""Empty: it makes this module a package for Python, so that `aliases` can serve names of modules below it."""
