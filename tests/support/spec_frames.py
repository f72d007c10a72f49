"""Messages and their bytes as the MODBUS Application Protocol V1.1b3 prints them, at least one of every class.

Where the document prints something wrong, the comment says what holds.
"""

from dataclasses import dataclass

from busway.pdu.diagnostics import (
    ChangeAsciiDelimiter,
    ClearCounters,
    ClearOverrun,
    ForceListenOnly,
    GetCommEventCounter,
    GetCommEventLog,
    ReadExceptionStatus,
    ReportServerId,
    RestartCommunications,
    ReturnBusCharacterOverrunCount,
    ReturnBusCommunicationErrorCount,
    ReturnBusExceptionErrorCount,
    ReturnBusMessageCount,
    ReturnDiagnosticRegister,
    ReturnQueryData,
    ReturnServerBusyCount,
    ReturnServerMessageCount,
    ReturnServerNakCount,
    ReturnServerNoResponseCount,
)
from busway.pdu.encapsulated import CanopenGeneralReference, IdentificationObject, ReadDeviceIdentification
from busway.pdu.file_records import FileContent, FileData, FileReference, ReadFileRecord, WriteFileRecord
from busway.pdu.message import Message, Request
from busway.pdu.read_items import (
    ReadCoils,
    ReadDiscreteInputs,
    ReadFifoQueue,
    ReadHoldingRegisters,
    ReadInputRegisters,
)
from busway.pdu.write_items import (
    MaskWriteRegister,
    ReadWriteMultipleRegisters,
    WriteMultipleCoils,
    WriteMultipleRegisters,
    WriteSingleCoil,
    WriteSingleRegister,
)


@dataclass(frozen=True)
class Exchange:
    """A request, its reply, and the bytes of both."""

    request: Request
    request_hex: str
    reply: Message
    reply_hex: str

    @property
    def name(self) -> str:
        """A readable test id."""
        return f"{type(self.request).__name__} {self.request_hex}"


_DIAGNOSTIC_COUNTS = (
    (ReturnDiagnosticRegister, "02"),
    (ReturnBusMessageCount, "0B"),
    (ReturnBusCommunicationErrorCount, "0C"),
    (ReturnBusExceptionErrorCount, "0D"),
    (ReturnServerMessageCount, "0E"),
    (ReturnServerNoResponseCount, "0F"),
    (ReturnServerNakCount, "10"),
    (ReturnServerBusyCount, "11"),
    (ReturnBusCharacterOverrunCount, "12"),
)

EXCHANGES: tuple[Exchange, ...] = (
    # §6.1: coils 20…38
    Exchange(ReadCoils(19, 19), "01 00 13 00 13", ReadCoils.Reply(b"\xcd\x6b\x05"), "01 03 CD 6B 05"),
    # §6.2: discrete inputs 197…218
    Exchange(
        ReadDiscreteInputs(196, 22),
        "02 00 C4 00 16",
        ReadDiscreteInputs.Reply(b"\xac\xdb\x35"),
        "02 03 AC DB 35",
    ),
    # §6.3: registers 108…110
    Exchange(
        ReadHoldingRegisters(107, 3),
        "03 00 6B 00 03",
        ReadHoldingRegisters.Reply(bytes.fromhex("022B00000064")),
        "03 06 02 2B 00 00 00 64",
    ),
    # §6.4: input register 9
    Exchange(ReadInputRegisters(8, 1), "04 00 08 00 01", ReadInputRegisters.Reply(b"\x00\x0a"), "04 02 00 0A"),
    # §6.5: coil 173 on
    Exchange(WriteSingleCoil(172, 0xFF00), "05 00 AC FF 00", WriteSingleCoil.Reply(172, 0xFF00), "05 00 AC FF 00"),
    # the same coil off
    Exchange(WriteSingleCoil(172, 0), "05 00 AC 00 00", WriteSingleCoil.Reply(172, 0), "05 00 AC 00 00"),
    # §6.6: register 2 to 3
    Exchange(WriteSingleRegister(1, 3), "06 00 01 00 03", WriteSingleRegister.Reply(1, 3), "06 00 01 00 03"),
    # §6.7
    Exchange(ReadExceptionStatus(), "07", ReadExceptionStatus.Reply(0x6D), "07 6D"),
    # §6.8
    Exchange(ReturnQueryData(b"\xa5\x37"), "08 00 00 A5 37", ReturnQueryData.Reply(b"\xa5\x37"), "08 00 00 A5 37"),
    Exchange(
        RestartCommunications(b"\xff\x00"),
        "08 00 01 FF 00",
        RestartCommunications.Reply(b"\xff\x00"),
        "08 00 01 FF 00",
    ),
    # the delimiter becomes ";"
    Exchange(
        ChangeAsciiDelimiter(b"\x3b\x00"), "08 00 03 3B 00", ChangeAsciiDelimiter.Reply(b"\x3b\x00"), "08 00 03 3B 00"
    ),
    # never answered on the line, but its reply has a form all the same
    Exchange(ForceListenOnly(), "08 00 04 00 00", ForceListenOnly.Reply(b"\x00\x00"), "08 00 04 00 00"),
    Exchange(ClearCounters(), "08 00 0A 00 00", ClearCounters.Reply(b"\x00\x00"), "08 00 0A 00 00"),
    Exchange(ClearOverrun(), "08 00 14 00 00", ClearOverrun.Reply(b"\x00\x00"), "08 00 14 00 00"),
    *(
        Exchange(kind(), f"08 00 {code} 00 00", kind.Reply(b"\x01\x02"), f"08 00 {code} 01 02")
        for kind, code in _DIAGNOSTIC_COUNTS
    ),
    # §6.9
    Exchange(GetCommEventCounter(), "0B", GetCommEventCounter.Reply(0xFFFF, 0x0108), "0B FF FF 01 08"),
    # §6.10
    Exchange(
        GetCommEventLog(),
        "0C",
        GetCommEventLog.Reply(0, 0x0108, 0x0121, b"\x20\x00"),
        "0C 08 00 00 01 08 01 21 20 00",
    ),
    # §6.11: coils 20…29
    Exchange(
        WriteMultipleCoils(19, 10, b"\xcd\x01"),
        "0F 00 13 00 0A 02 CD 01",
        WriteMultipleCoils.Reply(19, 10),
        "0F 00 13 00 0A",
    ),
    # §6.12: registers 2 and 3
    Exchange(
        WriteMultipleRegisters(1, 2, b"\x00\x0a\x01\x02"),
        "10 00 01 00 02 04 00 0A 01 02",
        WriteMultipleRegisters.Reply(1, 2),
        "10 00 01 00 02",
    ),
    # §6.13 prints no example
    Exchange(ReportServerId(), "11", ReportServerId.Reply(b"\x2a\xff"), "11 02 2A FF"),
    # §6.14: two groups. The reply is printed with byte count 0E; 0C is what follows.
    Exchange(
        ReadFileRecord((FileReference(4, 1, 2), FileReference(3, 9, 2))),
        "14 0E 06 00 04 00 01 00 02 06 00 03 00 09 00 02",
        ReadFileRecord.Reply((FileContent(b"\x0d\xfe\x00\x20"), FileContent(b"\x33\xcd\x00\x40"))),
        "14 0C 05 06 0D FE 00 20 05 06 33 CD 00 40",
    ),
    # §6.15. The code of the request is printed as 14 in the table; 15 (hexadecimal) is what the function has.
    Exchange(
        WriteFileRecord((FileData(4, 7, b"\x06\xaf\x04\xbe\x10\x0d"),)),
        "15 0D 06 00 04 00 07 00 03 06 AF 04 BE 10 0D",
        WriteFileRecord.Reply((FileData(4, 7, b"\x06\xaf\x04\xbe\x10\x0d"),)),
        "15 0D 06 00 04 00 07 00 03 06 AF 04 BE 10 0D",
    ),
    # §6.16: register 5
    Exchange(
        MaskWriteRegister(4, 0xF2, 0x25),
        "16 00 04 00 F2 00 25",
        MaskWriteRegister.Reply(4, 0xF2, 0x25),
        "16 00 04 00 F2 00 25",
    ),
    # §6.17: six registers read, three written
    Exchange(
        ReadWriteMultipleRegisters(3, 6, 14, 3, b"\x00\xff\x00\xff\x00\xff"),
        "17 00 03 00 06 00 0E 00 03 06 00 FF 00 FF 00 FF",
        ReadWriteMultipleRegisters.Reply(bytes.fromhex("00FE0ACD00010003000D00FF")),
        "17 0C 00 FE 0A CD 00 01 00 03 00 0D 00 FF",
    ),
    # §6.18: the queue at 1246
    Exchange(
        ReadFifoQueue(1246),
        "18 04 DE",
        ReadFifoQueue.Reply(2, b"\x01\xb8\x12\x84"),
        "18 00 06 00 02 01 B8 12 84",
    ),
    # §6.20 leaves the rest to CANopen
    Exchange(CanopenGeneralReference(b"\x00\x01"), "2B 0D 00 01", CanopenGeneralReference.Reply(b"\x07"), "2B 0D 07"),
    # §6.21: basic objects in one reply, shortened
    Exchange(
        ReadDeviceIdentification(1, 0),
        "2B 0E 01 00",
        ReadDeviceIdentification.Reply(
            1,
            0x01,
            0x00,
            0x00,
            3,
            (
                IdentificationObject(0, b"Company"),
                IdentificationObject(1, b"Product"),
                IdentificationObject(2, b"V2.11"),
            ),
        ),
        "2B 0E 01 01 00 00 03 00 07 43 6F 6D 70 61 6E 79 01 07 50 72 6F 64 75 63 74 02 05 56 32 2E 31 31",
    ),
)
