"""Messages of functions 01–04 and 24, which read the four tables and a queue of registers."""

import struct
from collections.abc import Callable
from functools import lru_cache
from typing import Any, ClassVar

from ..codes import MAX_FIFO_REGISTERS, MAX_READ_BITS, MAX_READ_REGISTERS, ExceptionCode, FunctionCode, Table
from .bits import unpack_bits
from .device_interface import Context, DataModel, Refusal
from .fast_answers import (
    DirectModel,
    FastAnswer,
    PreparedAnswer,
    prepare_answer,
    read_bits,
    read_registers,
)
from .fields import RestLength, rest, rest_length, u16
from .message import Message, ReplyMessage, Request, Touch


class ReadBits(Request):
    """Base class of the requests of functions 01 and 02, which read bits; a subclass declares code and table.

    Attributes:
        address: the first bit, 0…65535.
        count: number of bits, 1…2000.
    """

    address: int = u16()
    count: int = u16(1, MAX_READ_BITS)

    class Reply(ReplyMessage):
        """The reply of function 01 or 02: the bits that were read.

        Attributes:
            data: the bits, eight to a byte, the first in the lowest bit of the first byte. Unused bits of the last byte
                are zero by the specification; they are not checked.
        """

        byte_count: ClassVar[RestLength] = rest_length(1, 1, MAX_READ_BITS // 8)
        data: bytes = rest(1, MAX_READ_BITS // 8)

        def bits(self, count: int) -> list[bool]:
            """Return the first ``count`` bits of the reply as bools; pass the count of the request."""
            return unpack_bits(self.data, count)

    def reply_shape(self) -> tuple[int, bytes]:
        length = (self.count + 7) >> 3
        return 2 + length, bytes((self.code, length))

    def apply(self, model: DataModel, context: Context) -> Message:
        return self.Reply(_read(model, _table(type(self)), self.address, self.count, context))

    @classmethod
    def direct(cls, model: DirectModel) -> FastAnswer | None:
        block = model.plain_block(_table(cls), writes=False)
        return None if block is None else read_bits(cls.code, MAX_READ_BITS, block)


class ReadCoils(ReadBits):
    """01 Read Coils: reads ``count`` 1…2000 coils from ``address`` on (MODBUS Application Protocol V1.1b3 §6.1)."""

    code: ClassVar[FunctionCode] = FunctionCode.READ_COILS
    reads: ClassVar[Touch] = Touch(Table.COILS)


class ReadDiscreteInputs(ReadBits):
    """02 Read Discrete Inputs: reads ``count`` 1…2000 inputs from ``address`` on (Application Protocol V1.1b3 §6.2)."""

    code: ClassVar[FunctionCode] = FunctionCode.READ_DISCRETE_INPUTS
    reads: ClassVar[Touch] = Touch(Table.DISCRETE_INPUTS)


class ReadRegisters(Request):
    """Base class of the requests of functions 03 and 04, which read registers; a subclass declares code and table.

    Attributes:
        address: the first register, 0…65535.
        count: number of registers, 1…125.
    """

    address: int = u16()
    count: int = u16(1, MAX_READ_REGISTERS)

    class Reply(ReplyMessage):
        """The reply of function 03 or 04: the registers that were read.

        Attributes:
            data: the registers, big-endian.
        """

        byte_count: ClassVar[RestLength] = rest_length(1, 2, 2 * MAX_READ_REGISTERS, 2)
        data: bytes = rest(2, 2 * MAX_READ_REGISTERS, 2)

        @property
        def registers(self) -> list[int]:
            """The registers of the reply as numbers 0…65535."""
            data = self.data
            return list(_REGISTERS[len(data) >> 1](data))

    def reply_shape(self) -> tuple[int, bytes]:
        return 2 + 2 * self.count, bytes((self.code, 2 * self.count))

    def apply(self, model: DataModel, context: Context) -> Message:
        return self.Reply(_read(model, _table(type(self)), self.address, self.count, context))

    @classmethod
    def direct(cls, model: DirectModel) -> FastAnswer | None:
        block = model.plain_block(_table(cls), writes=False)
        return None if block is None else read_registers(cls.code, MAX_READ_REGISTERS, block)

    @classmethod
    def prepared_answer(cls, model: DirectModel, unit: int, pdu: bytes) -> PreparedAnswer | None:
        block = model.plain_block(_table(cls), writes=False)
        return None if block is None else prepare_answer(unit, pdu, MAX_READ_REGISTERS, block)


class ReadHoldingRegisters(ReadRegisters):
    """03 Read Holding Registers: reads ``count`` 1…125 from ``address`` on (Application Protocol V1.1b3 §6.3)."""

    code: ClassVar[FunctionCode] = FunctionCode.READ_HOLDING_REGISTERS
    reads: ClassVar[Touch] = Touch(Table.HOLDING_REGISTERS)


class ReadInputRegisters(ReadRegisters):
    """04 Read Input Registers: reads ``count`` 1…125 from ``address`` on (Application Protocol V1.1b3 §6.4)."""

    code: ClassVar[FunctionCode] = FunctionCode.READ_INPUT_REGISTERS
    reads: ClassVar[Touch] = Touch(Table.INPUT_REGISTERS)


class ReadFifoQueue(Request):
    """24 Read FIFO Queue: reads 0…31 registers of the queue at ``address`` (Application Protocol V1.1b3 §6.18).

    They stay in the queue. A device with more in its queue answers with exception 03.
    """

    code: ClassVar[FunctionCode] = FunctionCode.READ_FIFO_QUEUE
    reads: ClassVar[Touch] = Touch(Table.HOLDING_REGISTERS, count=None)
    address: int = u16()

    class Reply(ReplyMessage):
        """The reply of function 24: queued registers, the oldest first; they stay in the queue.

        Attributes:
            count: number of registers, 0…31.
            data: the registers, big-endian.
        """

        byte_count: ClassVar[RestLength] = rest_length(2, 2, 2 + 2 * MAX_FIFO_REGISTERS, 2)
        count: int = u16(0, MAX_FIFO_REGISTERS)
        data: bytes = rest(0, 2 * MAX_FIFO_REGISTERS, 2)

        def validate(self) -> str | None:
            if 2 * self.count != len(self.data):
                return f"FIFO count {self.count} where {len(self.data) // 2} registers follow"
            return None

        @property
        def registers(self) -> list[int]:
            """The queued registers as numbers 0…65535."""
            return unpack_registers(self.data)

    most: ClassVar[int] = MAX_FIFO_REGISTERS

    def apply(self, model: DataModel, context: Context) -> Message:
        data = model.read_fifo(self.address, context)
        if len(data) > 2 * self.most:
            raise Refusal(ExceptionCode.ILLEGAL_DATA_VALUE, f"the queue holds more than {self.most} registers")
        return self.Reply(len(data) // 2, data)


_REGISTERS = tuple(struct.Struct(f">{count}H").unpack for count in range(MAX_READ_REGISTERS + 2))
"""Functions that unpack big-endian registers from bytes; the index is their number, 0…126."""


def unpack_registers(data: bytes) -> list[int]:
    """Return the numbers 0…65535 that big-endian registers hold, one for every two bytes.

    Raises:
        struct.error: the number of bytes is odd.
    """
    count = len(data) >> 1
    if count < len(_REGISTERS):
        return list(_REGISTERS[count](data))
    return list(struct.unpack(f">{count}H", data))


def _table(function: type[Request]) -> Table:
    assert function.reads is not None
    return function.reads.table


def _read(model: DataModel, table: Table, address: int, count: int, context: Context) -> bytes:
    model.check(table, address, count, False)
    return model.read(table, address, count, context)


@lru_cache(maxsize=4096, typed=True)
def read_request(kind: Callable[[int, int], Request], address: int, count: int) -> Any:  # an instance of ``kind``
    """Return the request object that reads a range of items.

    The 4096 most recently used ones are cached: equal arguments give the same object, which is encoded only once.

    Args:
        kind: the request class.
        address: the first item, 0…65535.
        count: number of items.

    Raises:
        InvalidRequest: address or count is out of range, or the range ends beyond address 65535. Nothing was sent.
    """
    return kind(address, count)
