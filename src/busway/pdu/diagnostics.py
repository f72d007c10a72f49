"""Messages of functions 07, 08, 11, 12 and 17: status, identification and communication diagnostics of a server.

Function 08 has sub-functions, with a class for each (Application Protocol V1.1b3 §6.7–§6.10, §6.13).
"""

from typing import TYPE_CHECKING, ClassVar

from ..codes import DiagnosticCode, FunctionCode
from .device_interface import Context, DataModel
from .fields import RestLength, rest, rest_length, u8, u16
from .message import UNKNOWN_LENGTH, Message, ReplyMessage, Request


class ReadExceptionStatus(Request):
    """07 Read Exception Status: reads eight bits whose meaning the device defines (V1.1b3 §6.7)."""

    code: ClassVar[FunctionCode] = FunctionCode.READ_EXCEPTION_STATUS

    class Reply(ReplyMessage):
        """The reply of function 07: ``status``, eight bits as a number 0…255."""

        status: int = u8()

    def apply(self, model: DataModel, context: Context) -> Message:
        return self.Reply(model.exception_status())


class GetCommEventCounter(Request):
    """11 Get Comm Event Counter: reads status word and number of successful messages (V1.1b3 §6.9)."""

    code: ClassVar[FunctionCode] = FunctionCode.GET_COMM_EVENT_COUNTER

    class Reply(ReplyMessage):
        """The reply of function 11: status word and number of successful messages.

        Attributes:
            status: 0xFFFF while a program command runs, else 0.
            event_count: messages that the unit has executed without an exception, 0…65535.
        """

        status: int = u16()
        event_count: int = u16()

    def apply(self, model: DataModel, context: Context) -> Message:
        status, events = context.diagnostics.event_counter()
        return self.Reply(status, events & 0xFFFF)


class GetCommEventLog(Request):
    """12 Get Comm Event Log: reads status word, two message counts and up to 64 events (V1.1b3 §6.10)."""

    code: ClassVar[FunctionCode] = FunctionCode.GET_COMM_EVENT_LOG

    class Reply(ReplyMessage):
        """The reply of function 12: status word, counts, and events.

        Attributes:
            status: 0xFFFF while a program command runs, else 0.
            event_count: messages that the unit has executed without an exception, 0…65535.
            message_count: messages since the last restart or clear, as function 08/0B counts them, 0…65535.
            events: event bytes, the newest first, at most 64.
        """

        byte_count: ClassVar[RestLength] = rest_length(1, 6, 6 + 64)
        status: int = u16()
        event_count: int = u16()
        message_count: int = u16()
        events: bytes = rest(0, 64)

    def apply(self, model: DataModel, context: Context) -> Message:
        status, events, messages, log = context.diagnostics.event_log()
        return self.Reply(status, events & 0xFFFF, messages & 0xFFFF, log)


class ReportServerId(Request):
    """17 Report Server ID: reads device-specific data and a run indicator (Application Protocol V1.1b3 §6.13)."""

    code: ClassVar[FunctionCode] = FunctionCode.REPORT_SERVER_ID

    class Reply(ReplyMessage):
        """The reply of function 17, whose layout depends on the device; `ServerId.of` splits it.

        Attributes:
            data: identification, run indicator (00 off, FF on) and additional data, at most 251 bytes.
        """

        byte_count: ClassVar[RestLength] = rest_length(1, 0, 251)
        data: bytes = rest(0, 251)

    def apply(self, model: DataModel, context: Context) -> Message:
        return self.Reply(model.server_id())


class Diagnostic(Request):
    """Base class of the sub-functions of 08 Diagnostics with two bytes of data in request and reply (§6.8).

    Attributes:
        data: the two bytes; 00 00 if none are given.
        allowed: the values of ``data`` that this sub-function accepts; empty for any.
    """

    sub_width = 2
    data: bytes = rest(2, 2, default=b"\x00\x00")
    allowed: ClassVar[tuple[bytes, ...]] = (b"\x00\x00",)

    class Reply(ReplyMessage):
        """The reply of a sub-function of 08: ``data`` is a count, the register or what the request had, 2 bytes."""

        data: bytes = rest(2, 2)

        @property
        def value(self) -> int:
            """The two data bytes of the reply as a number 0…65535."""
            return int.from_bytes(self.data, "big")

    def validate(self) -> str | None:
        if self.allowed and self.data not in self.allowed:
            return f"data {self.data.hex(' ')} where sub-function {self.sub_code} has {self.allowed[0].hex(' ')}"
        return None

    def apply(self, model: DataModel, context: Context) -> Message:
        assert self.sub_code is not None
        return self.Reply(context.diagnostics.diagnose(self.sub_code, self.data))


class ReturnQueryData(Request):
    """08/00 Return Query Data: the reply repeats the data of the request (Application Protocol V1.1b3 §6.8.1).

    Attributes:
        data: 2…250 bytes, an even number; 00 00 if none are given.
    """

    code: ClassVar[FunctionCode] = FunctionCode.DIAGNOSTICS
    sub_code: ClassVar[DiagnosticCode] = DiagnosticCode.RETURN_QUERY_DATA
    sub_width = 2
    echoes = True
    data: bytes = rest(2, 250, 2, default=b"\x00\x00")

    if TYPE_CHECKING:  # made of the fields above when the class is

        class Reply(ReplyMessage):
            """The reply of function 08/00: ``data`` is that of the request."""

            data: bytes = rest(2, 250, 2)

    @classmethod
    def wire_length(cls, data: bytes, at: int, end: int) -> int:
        return UNKNOWN_LENGTH

    def apply(self, model: DataModel, context: Context) -> Message:
        context.diagnostics.diagnose(DiagnosticCode.RETURN_QUERY_DATA, self.data)
        return self


class RestartCommunications(Diagnostic):
    """08/01 Restart Communications Option: clears the counters and ends listen-only mode (§6.8.1).

    With the data FF 00, instead of 00 00, the unit also clears its event log.
    """

    code: ClassVar[FunctionCode] = FunctionCode.DIAGNOSTICS
    sub_code: ClassVar[DiagnosticCode] = DiagnosticCode.RESTART_COMMUNICATIONS
    is_write = True
    allowed: ClassVar[tuple[bytes, ...]] = (b"\x00\x00", b"\xff\x00")


class ReturnDiagnosticRegister(Diagnostic):
    """08/02 Return Diagnostic Register: reads 16 bits whose meaning the device defines, the register (§6.8.1)."""

    code: ClassVar[FunctionCode] = FunctionCode.DIAGNOSTICS
    sub_code: ClassVar[DiagnosticCode] = DiagnosticCode.RETURN_DIAGNOSTIC_REGISTER


class ChangeAsciiDelimiter(Diagnostic):
    """08/03 Change ASCII Input Delimiter: sets the character that ends ASCII frames after CR (§6.8.1).

    The first data byte is the character, 00…7F, the second is 00.
    """

    code: ClassVar[FunctionCode] = FunctionCode.DIAGNOSTICS
    sub_code: ClassVar[DiagnosticCode] = DiagnosticCode.CHANGE_ASCII_DELIMITER
    is_write = True
    allowed: ClassVar[tuple[bytes, ...]] = ()

    def validate(self) -> str | None:
        return None if self.data[1] == 0 and self.data[0] < 0x80 else "data must be an ASCII character and a zero"


class ForceListenOnly(Diagnostic):
    """08/04 Force Listen Only Mode: the unit answers no request, not even this one, until a restart (§6.8.1)."""

    code: ClassVar[FunctionCode] = FunctionCode.DIAGNOSTICS
    sub_code: ClassVar[DiagnosticCode] = DiagnosticCode.FORCE_LISTEN_ONLY
    is_write = True


class ClearCounters(Diagnostic):
    """08/0A Clear Counters and Diagnostic Register: sets all diagnostic counters and the register to 0 (§6.8.1)."""

    code: ClassVar[FunctionCode] = FunctionCode.DIAGNOSTICS
    sub_code: ClassVar[DiagnosticCode] = DiagnosticCode.CLEAR_COUNTERS
    is_write = True


class ReturnBusMessageCount(Diagnostic):
    """08/0B Return Bus Message Count: asks how many messages to any unit were seen on the line (§6.8.1)."""

    code: ClassVar[FunctionCode] = FunctionCode.DIAGNOSTICS
    sub_code: ClassVar[DiagnosticCode] = DiagnosticCode.BUS_MESSAGE_COUNT


class ReturnBusCommunicationErrorCount(Diagnostic):
    """08/0C Return Bus Communication Error Count: asks how many damaged frames were seen on the line (§6.8.1)."""

    code: ClassVar[FunctionCode] = FunctionCode.DIAGNOSTICS
    sub_code: ClassVar[DiagnosticCode] = DiagnosticCode.BUS_COMMUNICATION_ERROR_COUNT


class ReturnBusExceptionErrorCount(Diagnostic):
    """08/0D Return Bus Exception Error Count: asks how many exception replies this unit has sent (§6.8.1)."""

    code: ClassVar[FunctionCode] = FunctionCode.DIAGNOSTICS
    sub_code: ClassVar[DiagnosticCode] = DiagnosticCode.BUS_EXCEPTION_ERROR_COUNT


class ReturnServerMessageCount(Diagnostic):
    """08/0E Return Server Message Count: asks how many messages and broadcasts this unit has received (§6.8.1)."""

    code: ClassVar[FunctionCode] = FunctionCode.DIAGNOSTICS
    sub_code: ClassVar[DiagnosticCode] = DiagnosticCode.SERVER_MESSAGE_COUNT


class ReturnServerNoResponseCount(Diagnostic):
    """08/0F Return Server No Response Count: asks how many messages this unit has not answered (§6.8.1)."""

    code: ClassVar[FunctionCode] = FunctionCode.DIAGNOSTICS
    sub_code: ClassVar[DiagnosticCode] = DiagnosticCode.SERVER_NO_RESPONSE_COUNT


class ReturnServerNakCount(Diagnostic):
    """08/10 Return Server NAK Count: asks how many replies with exception 07 this unit has sent (§6.8.1)."""

    code: ClassVar[FunctionCode] = FunctionCode.DIAGNOSTICS
    sub_code: ClassVar[DiagnosticCode] = DiagnosticCode.SERVER_NAK_COUNT


class ReturnServerBusyCount(Diagnostic):
    """08/11 Return Server Busy Count: asks how many replies with exception 06 this unit has sent (§6.8.1)."""

    code: ClassVar[FunctionCode] = FunctionCode.DIAGNOSTICS
    sub_code: ClassVar[DiagnosticCode] = DiagnosticCode.SERVER_BUSY_COUNT


class ReturnBusCharacterOverrunCount(Diagnostic):
    """08/12 Return Bus Character Overrun Count: asks how often characters came too fast to be received (§6.8.1)."""

    code: ClassVar[FunctionCode] = FunctionCode.DIAGNOSTICS
    sub_code: ClassVar[DiagnosticCode] = DiagnosticCode.BUS_CHARACTER_OVERRUN_COUNT


class ClearOverrun(Diagnostic):
    """08/14 Clear Overrun Counter and Flag: sets the count of 08/12 to 0 (§6.8.1)."""

    code: ClassVar[FunctionCode] = FunctionCode.DIAGNOSTICS
    sub_code: ClassVar[DiagnosticCode] = DiagnosticCode.CLEAR_OVERRUN
    is_write = True
