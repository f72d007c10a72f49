"""Messages of functions 20 and 21, which read and write records of files: a request has one or several groups.

A record is one 16-bit register. A file is 1…65535, a record 0…9999 (Application Protocol V1.1b3 §6.14, §6.15).
"""

import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Self

from ..codes import MAX_FILE_RECORD_NUMBER, PDU_LIMIT, ExceptionCode, FunctionCode
from ..errors import InvalidRequest
from ..values.counts import counted
from .compiler import as_integer
from .device_interface import Context, DataModel, Refusal
from .fields import RestLength, repeated, rest_length
from .malformed_pdu import MalformedPdu
from .message import Message, ReplyMessage, Request
from .read_items import unpack_registers
from .write_items import pack_registers

REFERENCE_TYPE = 6
_REFERENCE = struct.Struct(">BHHH")


def _check_word(name: str, value: int) -> None:
    if not 0 <= as_integer(name, value) <= 0xFFFF:
        raise InvalidRequest(f"{name} must be 0…65535, not {value}")


def _check_registers(data: bytes) -> None:
    if not isinstance(data, bytes) or len(data) % 2:
        raise InvalidRequest(f"data must be bytes, two for each register, not {data!r}")


def _check_reference(file: int, record: int) -> str | None:
    if not 1 <= file <= 0xFFFF:
        return f"file must be 1…65535, not {file}"
    if not 0 <= record <= MAX_FILE_RECORD_NUMBER:
        return f"record must be 0…{MAX_FILE_RECORD_NUMBER}, not {record}"
    return None


@dataclass(frozen=True, slots=True)
class FileReference:
    """One group of a request of function 20: registers of a file to read.

    Each number can be 0…65535, also one that no file or record has: `ReadFileRecord.of` refuses such a group, and a
    server answers it with exception 02. Other numbers raise `InvalidRequest`.

    Attributes:
        file: number of the file, 1…65535.
        record: number of the first record, 0…9999.
        count: number of registers.
    """

    file: int
    record: int
    count: int

    def __post_init__(self) -> None:
        _check_word("file", self.file)
        _check_word("record", self.record)
        _check_word("count", self.count)

    def encode(self) -> bytes:
        """Return the group's 7 bytes in a request of function 20: type 6, file, record, number of registers."""
        return _REFERENCE.pack(REFERENCE_TYPE, self.file, self.record, self.count)

    @classmethod
    def decode_from(cls, data: bytes, at: int) -> tuple[Self, int]:
        """Decode the group of a file read at offset ``at`` of ``data``; return the group and the offset after it.

        Raises:
            ValueError: the group is cut off.
            MalformedPdu: the reference type is not 6; its exception code is 02.
        """
        if at + 7 > len(data):
            raise ValueError(f"{counted(len(data) - at, 'byte')} where a group has 7")
        kind, file, record, count = _REFERENCE.unpack_from(data, at)
        if kind != REFERENCE_TYPE:
            raise MalformedPdu(f"reference type {kind} where 6 is required", ExceptionCode.ILLEGAL_DATA_ADDRESS)
        return cls(file, record, count), at + 7


@dataclass(frozen=True, slots=True)
class FileData:
    """One group of a request of function 21: registers to write to a file, from ``record`` on.

    Raises:
        InvalidRequest: a number is not 0…65535, or ``data`` is no bytes or an odd number of them.

    Attributes:
        file: number of the file, 1…65535.
        record: number of the first record, 0…9999.
        data: the registers, big-endian.
    """

    file: int
    record: int
    data: bytes

    def __post_init__(self) -> None:
        _check_word("file", self.file)
        _check_word("record", self.record)
        _check_registers(self.data)

    @property
    def count(self) -> int:
        """Number of registers that the group writes."""
        return len(self.data) // 2

    @property
    def registers(self) -> list[int]:
        """The registers that the group writes, as numbers 0…65535."""
        return unpack_registers(self.data)

    def encode(self) -> bytes:
        """Return the group's bytes in a request of function 21: reference type 6, file, record, length, data.

        The length is the number of registers.
        """
        return _REFERENCE.pack(REFERENCE_TYPE, self.file, self.record, self.count) + self.data

    @classmethod
    def decode_from(cls, data: bytes, at: int) -> tuple[Self, int]:
        """Decode the group of a file write at offset ``at`` of ``data``; return the group and the offset after it.

        Raises:
            ValueError: the group is cut off.
            MalformedPdu: the reference type is not 6; its exception code is 02.
        """
        reference, start = FileReference.decode_from(data, at)
        end = start + 2 * reference.count
        if end > len(data):
            raise ValueError(f"{counted(len(data) - start, 'byte')} of data where {2 * reference.count} are announced")
        return cls(reference.file, reference.record, data[start:end]), end


@dataclass(frozen=True, slots=True)
class FileContent:
    """One group of a reply of function 20: registers read from a file.

    Raises:
        InvalidRequest: ``data`` is no bytes, an odd number of them or more than 254.

    Attributes:
        data: the registers, big-endian; at most 127.
    """

    data: bytes

    def __post_init__(self) -> None:
        _check_registers(self.data)
        if len(self.data) > 254:
            raise InvalidRequest(f"data must have at most 254 bytes, not {len(self.data)}")

    @property
    def registers(self) -> list[int]:
        """The registers read from the file as numbers 0…65535."""
        return unpack_registers(self.data)

    def encode(self) -> bytes:
        """Return the group's bytes in a reply of function 20: number of bytes that follow, reference type 6, data."""
        return bytes((1 + len(self.data), REFERENCE_TYPE)) + self.data

    @classmethod
    def decode_from(cls, data: bytes, at: int) -> tuple[Self, int]:
        """Decode the group of a reply of function 20 at offset ``at`` of ``data``; return group and offset after it.

        Raises:
            ValueError: the length or the reference type is wrong, or the group is cut off.
        """
        end = at + 1 + data[at]
        if data[at] < 1 or not data[at] % 2 or end > len(data):
            raise ValueError(f"file response length {data[at]} where {counted(len(data) - at - 1, 'byte', 'follows')}")
        if data[at + 1] != REFERENCE_TYPE:
            raise ValueError(f"reference type {data[at + 1]} where 6 is required")
        return cls(data[at + 2 : end]), end


class ReadFileRecord(Request):
    """20 Read File Record: reads 1…35 groups of registers in one request (Application Protocol V1.1b3 §6.14).

    The reply must fit one PDU; a request with a longer one raises `InvalidRequest`, or `MalformedPdu` when received.
    """

    code: ClassVar[FunctionCode] = FunctionCode.READ_FILE_RECORD
    byte_count: ClassVar[RestLength] = rest_length(1, 0x07, 0xF5, 7)
    groups: tuple[FileReference, ...] = repeated(FileReference, 1, 35)

    class Reply(ReplyMessage):
        """The reply of function 20: the registers of each group (`FileContent`), in the order of the request."""

        byte_count: ClassVar[RestLength] = rest_length(1, 0x07 - 5, 0xFB)
        contents: tuple[FileContent, ...] = repeated(FileContent, 1, 35)

    @classmethod
    def of(cls, groups: Sequence[FileReference]) -> Self:
        """Create the request that reads ``groups``.

        Raises:
            InvalidRequest: a file is not 1…65535, a record not 0…9999, a group has no register, there are not 1…35
                groups, or the reply would be too long. Nothing was sent.
        """
        for group in groups:
            problem = _check_reference(group.file, group.record)
            if problem is not None:
                raise InvalidRequest(problem)
            if not group.count:
                raise InvalidRequest("count must be at least 1, not 0")
        return cls(tuple(groups))

    def validate(self) -> str | None:
        length = self.reply_length()
        if length > PDU_LIMIT:
            return f"the reply would have {length} bytes; at most {PDU_LIMIT} fit"
        return None

    def reply_length(self) -> int:
        """Return the number of bytes of the normal reply PDU to this request; the constructor allows at most 253."""
        return 2 + sum(2 + 2 * group.count for group in self.groups)

    def reply_shape(self) -> tuple[int, bytes]:
        length = self.reply_length()
        return length, bytes((self.code, length - 2))

    def check_reply(self, reply: Any) -> str | None:
        got = [len(content.data) // 2 for content in reply.contents]
        asked = [group.count for group in self.groups]
        return None if got == asked else f"groups of {got} registers where {asked} were asked"

    def apply(self, model: DataModel, context: Context) -> Message:
        contents = []
        for group in self.groups:
            if _check_reference(group.file, group.record) is not None:
                raise Refusal(ExceptionCode.ILLEGAL_DATA_ADDRESS)
            contents.append(FileContent(model.read_file(group.file, group.record, group.count, context)))
        return self.Reply(tuple(contents))


class WriteFileRecord(Request):
    """21 Write File Record: writes 1…27 groups of registers; the reply repeats the request (V1.1b3 §6.15)."""

    code: ClassVar[FunctionCode] = FunctionCode.WRITE_FILE_RECORD
    is_write = True
    broadcast = True
    echoes = True
    byte_count: ClassVar[RestLength] = rest_length(1, 0x09, 0xFB)
    groups: tuple[FileData, ...] = repeated(FileData, 1, 27)

    if TYPE_CHECKING:  # made of the fields above when the class is

        class Reply(ReplyMessage):
            """The reply of function 21: the groups of the request, repeated."""

            groups: tuple[FileData, ...] = repeated(FileData, 1, 27)

    @classmethod
    def of(cls, file: int, record: int, values: Iterable[int]) -> Self:
        """Create the request that writes registers to consecutive records of one file.

        Args:
            file: number of the file, 1…65535.
            record: number of the first record, 0…9999.
            values: the registers, each 0…65535; at most 122 fit one request.

        Raises:
            InvalidRequest: a number is out of range, or there are no values or too many for one request. Nothing was
                sent.
        """
        problem = _check_reference(file, record)
        if problem is not None:
            raise InvalidRequest(problem)
        data = pack_registers(values)
        if not data:
            raise InvalidRequest("values must have at least one register, not 0")
        return cls((FileData(file, record, data),))

    def apply(self, model: DataModel, context: Context) -> Message:
        for dry in (True, False):
            for group in self.groups:
                if _check_reference(group.file, group.record) is not None:
                    raise Refusal(ExceptionCode.ILLEGAL_DATA_ADDRESS)
                model.write_file(group.file, group.record, group.data, context, dry=dry)
        return self
