"""Messages of functions 05, 06, 15, 16, 22 and 23, which write coils and holding registers."""

import re
import struct
from collections.abc import Iterable
from typing import TYPE_CHECKING, ClassVar, Final, Self, cast

from ..codes import (
    MAX_READ_REGISTERS,
    MAX_READ_WRITE_WRITE_REGISTERS,
    MAX_WRITE_BITS,
    MAX_WRITE_REGISTERS,
    TABLE_SIZE,
    FunctionCode,
    Table,
)
from ..errors import InvalidRequest
from ..values.counts import counted
from .bits import as_state, as_states, listed, pack_bits
from .compiler import as_integer
from .device_interface import Context, DataModel
from .fast_answers import (
    DirectModel,
    FastAnswer,
    RegisterBlock,
    mask_write_register,
    read_write_registers,
    write_coil,
    write_coils,
    write_register,
    write_registers,
)
from .fields import RestLength, rest, rest_length, u16
from .message import Message, ReplyMessage, Request, Touch
from .read_items import unpack_registers

COIL_ON = 0xFF00
COIL_OFF = 0x0000

_ZERO_OR_ONE: Final = re.compile(rb"\0[\0\1]")
"""Where packed registers may hold 0 or 1, which is also what True and False pack as."""


class WriteSingleCoil(Request):
    """05 Write Single Coil: sets a coil; ``value`` is 0xFF00 (on) or 0 (off) (Application Protocol V1.1b3 §6.5)."""

    code: ClassVar[FunctionCode] = FunctionCode.WRITE_SINGLE_COIL
    writes: ClassVar[Touch] = Touch(Table.COILS, count=None)
    broadcast = True
    echoes = True
    address: int = u16()
    value: int = u16(values=(COIL_OFF, COIL_ON))

    if TYPE_CHECKING:  # made of the fields above when the class is

        class Reply(ReplyMessage):
            """The reply of function 05: address and value of the coil, as in the request."""

            address: int = u16()
            value: int = u16()

    @classmethod
    def of(cls, address: int, value: bool) -> Self:
        """Create the request that switches the coil at ``address`` (0…65535) on (True or 1) or off (False or 0).

        Raises:
            InvalidRequest: the address is out of range, or ``value`` is anything else, such as the text ``"off"``.
                Nothing was sent.
        """
        return cls(address, COIL_ON if as_state("the value of a coil", value) else COIL_OFF)

    def apply(self, model: DataModel, context: Context) -> Message:
        model.check(Table.COILS, self.address, 1, True)
        model.write(Table.COILS, self.address, 1, b"\x01" if self.value else b"\x00", context)
        return self

    @classmethod
    def direct(cls, model: DirectModel) -> FastAnswer | None:
        block = model.plain_block(Table.COILS, writes=True)
        return None if block is None else write_coil(cls.code, block)


class WriteSingleRegister(Request):
    """06 Write Single Register: writes ``value``, 0…65535, to ``address`` (Application Protocol V1.1b3 §6.6)."""

    code: ClassVar[FunctionCode] = FunctionCode.WRITE_SINGLE_REGISTER
    writes: ClassVar[Touch] = Touch(Table.HOLDING_REGISTERS, count=None)
    broadcast = True
    echoes = True
    address: int = u16()
    value: int = u16()

    if TYPE_CHECKING:  # made of the fields above when the class is

        class Reply(ReplyMessage):
            """The reply of function 06: address and value of the register, as in the request."""

            address: int = u16()
            value: int = u16()

    def apply(self, model: DataModel, context: Context) -> Message:
        model.check(Table.HOLDING_REGISTERS, self.address, 1, True)
        model.write(Table.HOLDING_REGISTERS, self.address, 1, self.value.to_bytes(2, "big"), context)
        return self

    @classmethod
    def direct(cls, model: DirectModel) -> FastAnswer | None:
        block = model.plain_block(Table.HOLDING_REGISTERS, writes=True)
        return None if block is None else write_register(cls.code, block)


class WriteMultipleCoils(Request):
    """15 Write Multiple Coils: writes 1…1968 coils from ``address`` on (Application Protocol V1.1b3 §6.11).

    Attributes:
        address: the first coil, 0…65535.
        count: number of coils.
        data: their states, eight to a byte, the first in the lowest bit of the first byte.
    """

    code: ClassVar[FunctionCode] = FunctionCode.WRITE_MULTIPLE_COILS
    writes: ClassVar[Touch] = Touch(Table.COILS)
    broadcast = True
    address: int = u16()
    count: int = u16(1, MAX_WRITE_BITS)
    byte_count: ClassVar[RestLength] = rest_length(1, 1, MAX_WRITE_BITS // 8)
    data: bytes = rest(1, MAX_WRITE_BITS // 8)

    class Reply(ReplyMessage):
        """The reply of function 15: address and count of the coils that were written."""

        address: int = u16()
        count: int = u16(1, MAX_WRITE_BITS)

    @classmethod
    def of(cls, address: int, values: Iterable[bool]) -> Self:
        """Create the request that writes consecutive coils from ``address`` (0…65535) on.

        Args:
            address: the first coil.
            values: True, False, 1 or 0 for each coil; 1…1968 of them.

        Raises:
            InvalidRequest: a value is not True, False, 1 or 0, there are no values or too many, or the range is not
                within 0…65535. Nothing was sent.
        """
        states = as_states(values)
        return cls(address, len(states), pack_bits(states))

    def validate(self) -> str | None:
        if (self.count + 7) >> 3 != len(self.data):
            return f"byte count {len(self.data)} does not fit {counted(self.count, 'coil')}"
        return None

    def reply_shape(self) -> tuple[int, bytes]:
        return 5, self.encode()[:5]

    def apply(self, model: DataModel, context: Context) -> Message:
        model.check(Table.COILS, self.address, self.count, True)
        model.write(Table.COILS, self.address, self.count, self.data, context)
        return self.Reply(self.address, self.count)

    @classmethod
    def direct(cls, model: DirectModel) -> FastAnswer | None:
        block = model.plain_block(Table.COILS, writes=True)
        return None if block is None else write_coils(cls.code, MAX_WRITE_BITS, block)


class WriteMultipleRegisters(Request):
    """16 Write Multiple Registers: writes 1…123 registers from ``address`` on (Application Protocol V1.1b3 §6.12).

    Attributes:
        address: the first register, 0…65535.
        count: number of registers.
        data: the registers, big-endian.
    """

    code: ClassVar[FunctionCode] = FunctionCode.WRITE_MULTIPLE_REGISTERS
    writes: ClassVar[Touch] = Touch(Table.HOLDING_REGISTERS)
    broadcast = True
    address: int = u16()
    count: int = u16(1, MAX_WRITE_REGISTERS)
    byte_count: ClassVar[RestLength] = rest_length(1, 2, 2 * MAX_WRITE_REGISTERS, 2)
    data: bytes = rest(2, 2 * MAX_WRITE_REGISTERS, 2)

    class Reply(ReplyMessage):
        """The reply of function 16: address and count of the registers that were written."""

        address: int = u16()
        count: int = u16(1, MAX_WRITE_REGISTERS)

    @classmethod
    def of(cls, address: int, values: Iterable[int]) -> Self:
        """Create the request that writes consecutive holding registers from ``address`` on.

        Args:
            address: the first register, 0…65535.
            values: the registers, each 0…65535; 1…123 of them.

        Raises:
            InvalidRequest: a value is out of range, there are no values or too many, or the addresses are not within
                0…65535. Nothing was sent.
        """
        data = pack_registers(values)
        return cls(address, len(data) // 2, data)

    def validate(self) -> str | None:
        if 2 * self.count != len(self.data):
            return f"byte count {len(self.data)} does not fit {counted(self.count, 'register')}"
        return None

    def reply_shape(self) -> tuple[int, bytes]:
        return 5, self.encode()[:5]

    def apply(self, model: DataModel, context: Context) -> Message:
        model.check(Table.HOLDING_REGISTERS, self.address, self.count, True)
        model.write(Table.HOLDING_REGISTERS, self.address, self.count, self.data, context)
        return self.Reply(self.address, self.count)

    @classmethod
    def direct(cls, model: DirectModel) -> FastAnswer | None:
        block = model.plain_block(Table.HOLDING_REGISTERS, writes=True)
        return None if block is None else write_registers(cls.code, MAX_WRITE_REGISTERS, block)


class MaskWriteRegister(Request):
    """22 Mask Write Register: sets a register to (current AND and_mask) OR (or_mask AND NOT and_mask).

    MODBUS Application Protocol V1.1b3 §6.16. It counts as a write and so is not repeated automatically: between two
    executions another client can have written the register.

    Attributes:
        address: the register, 0…65535.
        and_mask: bits that keep their value, 0…65535.
        or_mask: values of the other bits, 0…65535.
    """

    code: ClassVar[FunctionCode] = FunctionCode.MASK_WRITE_REGISTER
    reads: ClassVar[Touch] = Touch(Table.HOLDING_REGISTERS, count=None)
    writes: ClassVar[Touch] = Touch(Table.HOLDING_REGISTERS, count=None)
    broadcast = True
    echoes = True
    address: int = u16()
    and_mask: int = u16()
    or_mask: int = u16()

    if TYPE_CHECKING:  # made of the fields above when the class is

        class Reply(ReplyMessage):
            """The reply of function 22: address and both masks, as in the request."""

            address: int = u16()
            and_mask: int = u16()
            or_mask: int = u16()

    def apply(self, model: DataModel, context: Context) -> Message:
        model.check(Table.HOLDING_REGISTERS, self.address, 1, True)
        current = int.from_bytes(model.read(Table.HOLDING_REGISTERS, self.address, 1, context), "big")
        new = current & self.and_mask | self.or_mask & ~self.and_mask
        model.write(Table.HOLDING_REGISTERS, self.address, 1, (new & 0xFFFF).to_bytes(2, "big"), context)
        return self

    @classmethod
    def direct(cls, model: DirectModel) -> FastAnswer | None:
        block = _read_and_written(model)
        return None if block is None else mask_write_register(cls.code, block)


class ReadWriteMultipleRegisters(Request):
    """23 Read/Write Multiple Registers: writes 1…121 registers, then reads 1…125 (V1.1b3 §6.17).

    Attributes:
        read_address, read_count: the first register to read, and how many.
        write_address, write_count: the first register to write, and how many.
        data: the registers to write, big-endian.
    """

    code: ClassVar[FunctionCode] = FunctionCode.READ_WRITE_MULTIPLE_REGISTERS
    reads: ClassVar[Touch] = Touch(Table.HOLDING_REGISTERS, "read_address", "read_count")
    writes: ClassVar[Touch] = Touch(Table.HOLDING_REGISTERS, "write_address", "write_count")
    read_address: int = u16()
    read_count: int = u16(1, MAX_READ_REGISTERS)
    write_address: int = u16()
    write_count: int = u16(1, MAX_READ_WRITE_WRITE_REGISTERS)
    byte_count: ClassVar[RestLength] = rest_length(1, 2, 2 * MAX_READ_WRITE_WRITE_REGISTERS, 2)
    data: bytes = rest(2, 2 * MAX_READ_WRITE_WRITE_REGISTERS, 2)

    class Reply(ReplyMessage):
        """The reply of function 23: ``data`` has the registers read after the write, big-endian."""

        byte_count: ClassVar[RestLength] = rest_length(1, 2, 2 * MAX_READ_REGISTERS, 2)
        data: bytes = rest(2, 2 * MAX_READ_REGISTERS, 2)

        @property
        def registers(self) -> list[int]:
            """The registers of the reply as numbers 0…65535."""
            return unpack_registers(self.data)

    @classmethod
    def of(cls, read_address: int, read_count: int, write_address: int, values: Iterable[int]) -> Self:
        """Create the request that writes holding registers and then, in the same request, reads holding registers.

        Args:
            read_address: the first register to read, 0…65535.
            read_count: number of registers to read, 1…125.
            write_address: the first register to write, 0…65535.
            values: the registers to write, each 0…65535; 1…121 of them.

        Raises:
            InvalidRequest: a number is out of range, there are no values or too many, or a range ends beyond address
                65535. Nothing was sent.
        """
        data = pack_registers(values)
        return cls(read_address, read_count, write_address, len(data) // 2, data)

    def validate(self) -> str | None:
        if 2 * self.write_count != len(self.data):
            return f"byte count {len(self.data)} does not fit {counted(self.write_count, 'register')}"
        return None

    def reply_shape(self) -> tuple[int, bytes]:
        return 2 + 2 * self.read_count, bytes((self.code, 2 * self.read_count))

    def apply(self, model: DataModel, context: Context) -> Message:
        model.check(Table.HOLDING_REGISTERS, self.write_address, self.write_count, True)
        model.check(Table.HOLDING_REGISTERS, self.read_address, self.read_count, False, context)
        model.write(Table.HOLDING_REGISTERS, self.write_address, self.write_count, self.data, context)
        return self.Reply(model.read(Table.HOLDING_REGISTERS, self.read_address, self.read_count, context))

    @classmethod
    def direct(cls, model: DirectModel) -> FastAnswer | None:
        block = _read_and_written(model)
        if block is None:
            return None
        return read_write_registers(cls.code, MAX_READ_REGISTERS, MAX_READ_WRITE_WRITE_REGISTERS, block)


def _read_and_written(model: DirectModel) -> RegisterBlock | None:
    """Return the memory of the holding registers for functions 22 and 23; None if they must take the generic path.

    They use it only if both reads and writes may access it directly.
    """
    block = model.plain_block(Table.HOLDING_REGISTERS, writes=True)
    if block is None or block is not model.plain_block(Table.HOLDING_REGISTERS, writes=False):
        return None
    return cast(RegisterBlock, block) if hasattr(block, "put_then_get") else None


def pack_registers(values: Iterable[int]) -> bytes:
    """Return numbers 0…65535 as big-endian registers, two bytes for each.

    Raises:
        InvalidRequest: a value is no integer 0…65535, and the message names the first such value; or ``values`` is a
            single number, a text, bytes, a set or a mapping, or has more than 65536 values. Nothing was sent.
    """
    if (values.__class__ is not list and values.__class__ is not tuple) or len(values) > TABLE_SIZE:
        values = listed(values, "registers")
    try:
        data = struct.pack(f">{len(values)}H", *values)
    except struct.error:
        _check_registers(values)
        raise
    # To look for the bytes first costs a tenth of asking each value for its type.
    if _ZERO_OR_ONE.search(data) and bool in map(type, values):
        _check_registers(values)
    return data


def _check_registers(values: Iterable[int]) -> None:
    """Raise `InvalidRequest` for the first value that is no integer 0…65535, if there is one."""
    for position, value in enumerate(values):
        if not 0 <= as_integer(f"value {position + 1}", value) <= 0xFFFF:
            raise InvalidRequest(f"value {position + 1} must be 0…65535, not {value}") from None
