"""The calls that all clients of pymodbus share, and the conversion of registers. Knows requests; knows no connection.

Each call creates a request of `pdu` and passes it to ``execute``, which a client defines: that of blocking clients
returns the response, that of asyncio clients an awaitable of it. The unit is ``device_id``, ``slave`` or ``unit``, 1 if
none is named.
"""

import enum
import struct
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any

from ...pdu.bits import pack_bits, unpack_bits
from .exceptions import ModbusException
from .pdu import (
    SUB_FUNCTIONS,
    DiagnosticBase,
    FileRecord,
    GetCommEventCounterRequest,
    GetCommEventLogRequest,
    MaskWriteRegisterRequest,
    ModbusPDU,
    ReadCoilsRequest,
    ReadDeviceInformationRequest,
    ReadDiscreteInputsRequest,
    ReadExceptionStatusRequest,
    ReadFifoQueueRequest,
    ReadFileRecordRequest,
    ReadHoldingRegistersRequest,
    ReadInputRegistersRequest,
    ReadWriteMultipleRegistersRequest,
    ReportDeviceIdRequest,
    WriteFileRecordRequest,
    WriteMultipleCoilsRequest,
    WriteMultipleRegistersRequest,
    WriteSingleCoilRequest,
    WriteSingleRegisterRequest,
)

BITS_OF_REGISTER = 16


class RegisterDataType(enum.Enum):
    """Types of values in registers: each with its struct code, and the number of registers of one value.

    0 registers: all registers together are one value.
    """

    INT16 = ("h", 1)
    UINT16 = ("H", 1)
    INT32 = ("i", 2)
    UINT32 = ("I", 2)
    INT64 = ("q", 4)
    UINT64 = ("Q", 4)
    FLOAT32 = ("f", 2)
    FLOAT64 = ("d", 4)
    STRING = ("s", 0)
    BITS = ("bits", 0)


class ModbusClientMixin:
    """The calls of all clients. Each returns what ``execute`` returns: a response, or an awaitable of one.

    Arguments of all calls: ``device_id`` (or ``slave``, ``unit``) is the unit, 0…255; with ``no_response_expected`` a
    missing reply is no error, and the result is None. Addresses are 0-based. If the device refuses a request, the
    response's ``isError()`` is True. A value that cannot be sent raises ``ValueError``.
    """

    DATATYPE: type[RegisterDataType] = RegisterDataType

    def execute(self, no_response_expected: bool, request: ModbusPDU) -> Any:
        """Send a request, and return the response or an awaitable of it; clients define it.

        Args:
            no_response_expected: True: a missing reply is no error, and the result is None, unless the device answers
                with an exception. False: the response is returned.
            request: a request of `pdu`, or one of a class of the program itself.
        """
        raise NotImplementedError

    def _ask(self, kind: Callable[..., ModbusPDU], names: dict[str, Any], *given: Any) -> Any:
        silent = names.pop("no_response_expected", False)
        return self.execute(silent, kind(*given, **names))

    # --- data ---------------------------------------------------------------------------------------------------------

    def read_coils(self, address: int, count: int = 1, device_id: int = 1, **names: Any) -> Any:
        """Read coils, function 01; the response has them in ``.bits``, filled up to whole bytes."""
        return self._ask(ReadCoilsRequest, names, address, count, device_id)

    def read_discrete_inputs(self, address: int, count: int = 1, device_id: int = 1, **names: Any) -> Any:
        """Read discrete inputs, function 02; the response has them in ``.bits``, filled up to whole bytes."""
        return self._ask(ReadDiscreteInputsRequest, names, address, count, device_id)

    def read_holding_registers(self, address: int, count: int = 1, device_id: int = 1, **names: Any) -> Any:
        """Read holding registers, function 03; the response has them in ``.registers``."""
        return self._ask(ReadHoldingRegistersRequest, names, address, count, device_id)

    def read_input_registers(self, address: int, count: int = 1, device_id: int = 1, **names: Any) -> Any:
        """Read input registers, function 04; the response has them in ``.registers``."""
        return self._ask(ReadInputRegistersRequest, names, address, count, device_id)

    def write_coil(self, address: int, value: bool, device_id: int = 1, **names: Any) -> Any:
        """Write one coil, function 05; the response repeats ``address`` and the state, in ``.bits`` and ``.value``."""
        return self._ask(WriteSingleCoilRequest, names, address, value, device_id)

    def write_register(self, address: int, value: int | bytes, device_id: int = 1, **names: Any) -> Any:
        """Write one holding register, function 06; the response repeats ``address`` and ``value``.

        ``value`` is a number 0…65535, or two bytes, the higher first.
        """
        return self._ask(WriteSingleRegisterRequest, names, address, value, device_id)

    def write_coils(self, address: int, values: Iterable[bool] | bool, device_id: int = 1, **names: Any) -> Any:
        """Write coils from ``address`` on, function 15; one value alone is one coil.

        The response has ``address`` and ``count``.
        """
        return self._ask(WriteMultipleCoilsRequest, names, address, values, device_id)

    def write_registers(
        self, address: int, values: Iterable[int | bytes] | int, device_id: int = 1, **names: Any
    ) -> Any:
        """Write holding registers from ``address`` on, function 16; one value alone is one register.

        Each value is a number 0…65535, or two bytes, the higher first. The response has ``address`` and ``count``.
        """
        return self._ask(WriteMultipleRegistersRequest, names, address, values, device_id)

    def mask_write_register(
        self, address: int = 0, and_mask: int = 0xFFFF, or_mask: int = 0, device_id: int = 1, **names: Any
    ) -> Any:
        """Change bits of a holding register, function 22.

        Its new value is (old AND ``and_mask``) OR (``or_mask`` AND NOT ``and_mask``).
        """
        return self._ask(MaskWriteRegisterRequest, names, address, and_mask, or_mask, device_id)

    def readwrite_registers(
        self,
        read_address: int = 0,
        read_count: int = 0,
        write_address: int = 0,
        address: int | None = None,
        values: Iterable[int] | int | None = None,
        device_id: int = 1,
        **names: Any,
    ) -> Any:
        """Write holding registers, then read some, function 23; the response has those read in ``.registers``.

        ``values`` (or ``write_registers``), numbers 0…65535, are written from ``write_address`` on. ``address``, if
        given and not 0, replaces ``read_address`` and ``write_address``.
        """
        if address:
            read_address = write_address = address
        values = names.pop("write_registers", values)
        return self._ask(
            ReadWriteMultipleRegistersRequest, names, read_address, read_count, write_address, values, device_id
        )

    def read_fifo_queue(self, address: int = 0, device_id: int = 1, **names: Any) -> Any:
        """Read a FIFO queue, function 24; the response has its registers in ``.values``."""
        return self._ask(ReadFifoQueueRequest, names, address, device_id)

    def read_file_record(self, records: Sequence[FileRecord], device_id: int = 1, **names: Any) -> Any:
        """Read parts of files, function 20; each of ``records`` names a part, with its ``record_length``.

        The response has a `FileRecord` with ``record_data`` for each in ``.records``, in the order of ``records``.
        """
        return self._ask(ReadFileRecordRequest, names, records, device_id)

    def write_file_record(self, records: Sequence[FileRecord], device_id: int = 1, **names: Any) -> Any:
        """Write parts of files, function 21: the ``record_data`` of each record; the response repeats ``.records``."""
        return self._ask(WriteFileRecordRequest, names, records, device_id)

    # --- identification and diagnostics -------------------------------------------------------------------------------

    def read_device_information(
        self, read_code: int | None = None, object_id: int = 0, device_id: int = 1, **names: Any
    ) -> Any:
        """Read identification objects, function 43/14; the response has them in ``.information``, by number.

        ``read_code`` is the level, 1…4 (`DeviceInformation`); None: 1, basic. ``object_id`` is the first object to
        read.

        One request is sent. If the response has ``more_follows``, another call with its ``next_object_id`` continues.
        """
        return self._ask(ReadDeviceInformationRequest, names, read_code, object_id, device_id)

    def read_exception_status(self, device_id: int = 1, **names: Any) -> Any:
        """Read eight status bits of the device, function 07; the response has them in ``.status``."""
        return self._ask(ReadExceptionStatusRequest, names, device_id)

    def diag_get_comm_event_counter(self, device_id: int = 1, **names: Any) -> Any:
        """Read the counter of events, function 11; the response has it in ``.count``, and ``.status``."""
        return self._ask(GetCommEventCounterRequest, names, device_id)

    def diag_get_comm_event_log(self, device_id: int = 1, **names: Any) -> Any:
        """Read the log of communication events, function 12; the response has it in ``.events``, the newest first.

        It also has ``.status``, ``.event_count`` and ``.message_count``.
        """
        return self._ask(GetCommEventLogRequest, names, device_id)

    def report_device_id(self, device_id: int = 1, **names: Any) -> Any:
        """Read the server ID of the device, function 17; the response has it in ``.identifier``."""
        return self._ask(ReportDeviceIdRequest, names, device_id)

    report_slave_id = report_device_id

    def __getattr__(self, name: str) -> Any:
        """Return the method ``diag_…`` for a sub-function of function 08, such as ``diag_query_data``.

        Its arguments are the data, if the sub-function has any, and ``device_id``; the response has the returned data
        in ``.message``. Other names raise ``AttributeError``.
        """
        wanted = name.removeprefix("diag_").replace("_slave_", "_device_")  # as before 3.10
        code = SUB_FUNCTIONS.get(wanted) if name.startswith("diag_") else None
        if code is None:
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
        return partial(self._diagnose, code)

    def _diagnose(self, code: int, data: Any = None, device_id: int = 1, **names: Any) -> Any:
        for other in ("msg", "toggle", "delimiter"):
            data = names.pop(other, data)
        if isinstance(data, bool):  # the option of sub-function 01: whether the event log is cleared too
            data = 0xFF00 if data else 0
        return self._ask(DiagnosticBase, {"sub_function": code, **names}, 0 if data is None else data, device_id)

    # --- conversion ---------------------------------------------------------------------------------------------------

    @classmethod
    def convert_from_registers(
        cls,
        registers: Sequence[int],
        data_type: RegisterDataType,
        word_order: str = "big",
        string_encoding: str = "utf-8",
    ) -> Any:
        """Return the value in registers: a number, a list of numbers unless there is one, a text, or a list of bits.

        Args:
            registers: the registers, as a response has them.
            data_type: a member of ``DATATYPE``.
            word_order: ``little``: the lowest register of a value comes first; any other text: the highest.
            string_encoding: encoding of a text, whose zero bytes at the end are left out.

        Raises:
            TypeError: ``data_type`` is no member of ``DATATYPE``.
            ModbusException: the registers are no whole number of values.
            UnicodeDecodeError: the bytes are no text in that encoding.
        """
        code, width = checked(data_type)
        if len(registers) % (width or 1):
            raise ModbusException(f"Registers illegal size ({len(registers)}) expected multiple of {width}!")
        data = struct.pack(f">{len(registers)}H", *in_word_order(registers, width, word_order))
        if data_type is RegisterDataType.STRING:
            return data.rstrip(b"\0").decode(string_encoding)
        if data_type is RegisterDataType.BITS:
            return unpack_bits(data, 8 * len(data))
        values = list(struct.unpack(f">{len(registers) // width}{code}", data))
        return values[0] if len(values) == 1 else values

    @classmethod
    def convert_to_registers(
        cls, value: Any, data_type: RegisterDataType, word_order: str = "big", string_encoding: str = "utf-8"
    ) -> list[int]:
        """Return the registers of a number, a list of numbers, a text or bits; opposite of `convert_from_registers`.

        A zero byte or zero bits fill up the last register of a text or of bits.

        Raises:
            TypeError: ``data_type`` is no member of ``DATATYPE``, or is STRING or BITS and ``value`` no text or list.
            struct.error: a value is no number of the type, or out of its range.
        """
        code, width = checked(data_type)
        if data_type is RegisterDataType.BITS:
            if not isinstance(value, list):
                raise TypeError(f"Value should be list of bool but is {type(value)}.")
            data = pack_bits(value + [False] * (-len(value) % BITS_OF_REGISTER))
        elif data_type is RegisterDataType.STRING:
            if not isinstance(value, str):
                raise TypeError(f"Value should be string but is {type(value)}.")
            data = value.encode(string_encoding)
            data += bytes(len(data) % 2)
        else:
            values = value if isinstance(value, list) else [value]
            data = struct.pack(f">{len(values)}{code}", *values)
        return in_word_order(struct.unpack(f">{len(data) // 2}H", data), width, word_order)


def checked(data_type: RegisterDataType) -> tuple[str, int]:
    """Return the struct code of a data type, and the number of registers of one value (0: all registers are one value).

    Raises:
        TypeError: it is no member of `RegisterDataType`.
    """
    if not isinstance(data_type, RegisterDataType):
        raise TypeError("Illegal data_type, please use <client>.DATATYPE!")
    return data_type.value


def in_word_order(registers: Sequence[int], width: int, word_order: str) -> list[int]:
    """Return registers in ``word_order``: for ``little`` those of each value are reversed, otherwise unchanged.

    ``width`` is the number of registers of a value; 0: all registers are one value.
    """
    if word_order != "little":
        return list(registers)
    step = width or len(registers) or 1
    return [one for at in range(0, len(registers), step) for one in reversed(registers[at : at + step])]
