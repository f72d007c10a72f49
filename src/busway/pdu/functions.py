"""The table of functions: which request and reply class belongs to a function code and sub-code.

Knows the list of classes; everything else about a function is in its class.

1. A table is immutable and passed to its users; there is no global registry. `STANDARD` holds the functions of
   the specification, ``STANDARD.with_functions(Mine)`` a new table with one more.
2. A function that is not in the table decodes to `OpaqueRequest` and `OpaqueReply`, bytes kept, so that a gateway
   forwards what it does not understand.
"""

from collections.abc import Iterator

from ..codes import ExceptionCode, FunctionCode, MeiType
from . import diagnostics, encapsulated, file_records, read_items, write_items
from .exception_response import decode_exception
from .malformed_pdu import MalformedPdu
from .malformed_request import MalformedRequest
from .message import NEED_MORE, UNKNOWN_LENGTH, Message, Request
from .unknown_functions import OpaqueReply, OpaqueRequest

AnyRequest = Request | OpaqueRequest | MalformedRequest


class FunctionTable:
    """Immutable table of request classes by function code and sub-code; decodes requests and replies.

    Iterating yields the classes; ``code in table`` tells whether any class has the function code.

    Args:
        functions: request classes.

    Raises:
        ValueError: two functions have the same code, a code is not 1…127, or sub-codes of a function differ in width.
    """

    __slots__ = ("_by_code", "_by_sub_code", "_sub_width")

    def __init__(self, *functions: type[Request]) -> None:
        self._by_code: dict[int, type[Request]] = {}
        self._by_sub_code: dict[tuple[int, int], type[Request]] = {}
        self._sub_width: dict[int, int] = {}
        for function in functions:
            self._add(function)

    def _add(self, function: type[Request]) -> None:
        code = function.code
        if not 1 <= code <= 127:
            raise ValueError(f"{function.__name__}: a function code is 1…127, not {code}")
        if function.sub_code is None:
            taken = code in self._by_code or code in self._sub_width
            self._by_code[code] = function
        else:
            taken = code in self._by_code or (code, function.sub_code) in self._by_sub_code
            if self._sub_width.setdefault(code, function.sub_width) != function.sub_width:
                raise ValueError(f"{function.__name__}: the sub-codes of function {code} differ in width")
            self._by_sub_code[code, function.sub_code] = function
        if taken:
            raise ValueError(f"{function.__name__}: function {code} is in the table already")

    def with_functions(self, *functions: type[Request]) -> "FunctionTable":
        """Return a new table that has the functions of this one and ``functions``; this one stays as it is.

        Raises:
            ValueError: two functions have the same code, a code is not 1…127, or sub-codes of a function differ in
                width.
        """
        return FunctionTable(*self, *functions)

    def __iter__(self) -> Iterator[type[Request]]:
        yield from self._by_code.values()
        yield from self._by_sub_code.values()

    def __contains__(self, code: int) -> bool:
        return code in self._by_code or code in self._sub_width

    def codes(self) -> tuple[int, ...]:
        """Return all function codes in the table, ascending, each once."""
        return tuple(sorted({*self._by_code, *self._sub_width}))

    def find(self, data: bytes | bytearray, at: int, end: int) -> type[Request] | None:
        """Return the request class of the function whose request or reply PDU starts at ``at`` in ``data[:end]``.

        None if the function or its sub-code is not in the table, the PDU is an exception reply, or the sub-code is cut
        off. At least one byte must be there.
        """
        code = data[at]
        found = self._by_code.get(code)
        if found is None and code in self._sub_width:
            width = self._sub_width[code]
            if end - at > width:
                found = self._by_sub_code.get((code, int.from_bytes(data[at + 1 : at + 1 + width], "big")))
        return found

    def decode_request(self, pdu: bytes) -> AnyRequest:
        """Decode a request PDU; an invalid one is returned as an object too, and raises nothing.

        Args:
            pdu: 1 byte or more, the first a function code below 0x80.

        Returns:
            An object of the function's request class; `OpaqueRequest` if function or sub-function is not in the table;
            `MalformedRequest` if the bytes break a rule of the function, or are more than any PDU has.
        """
        kind = self.find(pdu, 0, len(pdu))
        if kind is None:
            width = self._sub_width.get(pdu[0])
            if width is not None and len(pdu) <= width:
                # The function is known and its sub-code is cut off: a wrong length, not an unknown function.
                first = next(one for (code, _), one in self._by_sub_code.items() if code == pdu[0])
                return MalformedRequest(
                    pdu[0], first, bytes(pdu), "the sub-function is missing", ExceptionCode.ILLEGAL_DATA_VALUE
                )
            kind = OpaqueRequest
        try:
            return kind.decode(pdu)
        except MalformedPdu as error:
            return MalformedRequest(pdu[0], kind, bytes(pdu), error.reason, error.code)

    def decode_reply(self, pdu: bytes) -> Message:
        """Decode a reply PDU to an object of its function's ``Reply`` class, or to an `ExceptionResponse`.

        It becomes an `OpaqueReply` if the function or sub-function is not in the table. Whether it is the reply to a
        particular request is not checked (`Request.accept` does).

        Args:
            pdu: at most 253 bytes, function code first.

        Raises:
            MalformedPdu: there are no bytes, more than any PDU has, or they are no valid reply of the function.
        """
        if not pdu:
            raise MalformedPdu("an empty PDU")
        if pdu[0] & 0x80:
            return decode_exception(pdu)
        kind = self.find(pdu, 0, len(pdu))
        if kind is not None:
            return kind.Reply.decode(pdu)
        if len(pdu) <= self._sub_width.get(pdu[0], 0):
            raise MalformedPdu("the sub-function is missing")
        return OpaqueReply.decode(pdu)

    def request_length(self, data: bytes, at: int, end: int) -> int:
        """Return the length in bytes of the request PDU that starts at ``at`` of ``data[:end]``, for RTU frames.

        `NEED_MORE` means that more bytes are needed to tell, `UNKNOWN_LENGTH` that the content never tells it.
        """
        return self._length(data, at, end, reply=False)

    def reply_length(self, data: bytes, at: int, end: int) -> int:
        """Return the length in bytes of the reply PDU that starts at ``at`` of ``data[:end]``, for RTU frames.

        Also for an exception reply. `NEED_MORE` means that more bytes are needed to tell, `UNKNOWN_LENGTH` that the
        content never tells it.
        """
        if at < end and data[at] & 0x80:
            return _exception_length(data, at, end)
        return self._length(data, at, end, reply=True)

    def _length(self, data: bytes, at: int, end: int, *, reply: bool) -> int:
        if at >= end:
            return NEED_MORE
        kind = self.find(data, at, end)
        if kind is None:
            width = self._sub_width.get(data[at])
            return NEED_MORE if width is not None and end - at <= width else UNKNOWN_LENGTH
        return kind.Reply.wire_length(data, at, end) if reply else kind.wire_length(data, at, end)


def _exception_length(data: bytes, at: int, end: int) -> int:
    """Return the length in bytes of the exception PDU at ``at``: 2, or 3 for the form ``AB 0E cc`` of some devices.

    That form, with the MEI type in the middle, is in the figure of Application Protocol V1.1b3 §6.21. `NEED_MORE` if
    too few bytes are there to tell.
    """
    if data[at] == FunctionCode.ENCAPSULATED_INTERFACE | 0x80:
        if end < at + 2:
            return NEED_MORE
        return 3 if data[at + 1] in tuple(MeiType) else 2
    return 2


STANDARD = FunctionTable(
    read_items.ReadCoils,
    read_items.ReadDiscreteInputs,
    read_items.ReadHoldingRegisters,
    read_items.ReadInputRegisters,
    write_items.WriteSingleCoil,
    write_items.WriteSingleRegister,
    diagnostics.ReadExceptionStatus,
    diagnostics.ReturnQueryData,
    diagnostics.RestartCommunications,
    diagnostics.ReturnDiagnosticRegister,
    diagnostics.ChangeAsciiDelimiter,
    diagnostics.ForceListenOnly,
    diagnostics.ClearCounters,
    diagnostics.ReturnBusMessageCount,
    diagnostics.ReturnBusCommunicationErrorCount,
    diagnostics.ReturnBusExceptionErrorCount,
    diagnostics.ReturnServerMessageCount,
    diagnostics.ReturnServerNoResponseCount,
    diagnostics.ReturnServerNakCount,
    diagnostics.ReturnServerBusyCount,
    diagnostics.ReturnBusCharacterOverrunCount,
    diagnostics.ClearOverrun,
    diagnostics.GetCommEventCounter,
    diagnostics.GetCommEventLog,
    write_items.WriteMultipleCoils,
    write_items.WriteMultipleRegisters,
    diagnostics.ReportServerId,
    file_records.ReadFileRecord,
    file_records.WriteFileRecord,
    write_items.MaskWriteRegister,
    write_items.ReadWriteMultipleRegisters,
    read_items.ReadFifoQueue,
    encapsulated.CanopenGeneralReference,
    encapsulated.ReadDeviceIdentification,
)
"""The table with all functions of the specification, which are used unless another table is given."""
