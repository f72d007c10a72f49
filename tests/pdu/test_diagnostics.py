"""Functions 07, 08, 11, 12 and 17: their data, and what they ask of the device and of its line."""

from typing import Any

import pytest
from recording_device import FakeContext, RecordingModel

from busway.errors import InvalidRequest
from busway.pdu.diagnostics import (
    ChangeAsciiDelimiter,
    Diagnostic,
    ForceListenOnly,
    GetCommEventCounter,
    GetCommEventLog,
    ReadExceptionStatus,
    ReportServerId,
    RestartCommunications,
    ReturnBusMessageCount,
    ReturnDiagnosticRegister,
    ReturnQueryData,
)
from busway.pdu.functions import STANDARD
from busway.pdu.malformed_pdu import MalformedPdu
from busway.pdu.malformed_request import MalformedRequest

SUB_FUNCTIONS = [kind for kind in STANDARD if kind.code == 8 and kind is not ReturnQueryData]


@pytest.mark.clause("A22")
def test_07_gives_the_eight_bits_of_the_device() -> None:
    assert ReadExceptionStatus().apply(RecordingModel(), FakeContext()).encode() == b"\x07\x6d"


@pytest.mark.clause("A22")
@pytest.mark.parametrize("size", [0, 1, 251])
def test_17_gives_what_the_device_says_of_itself(size: int) -> None:
    model = RecordingModel()
    model.id = bytes(size)
    assert ReportServerId().apply(model, FakeContext()).encode() == bytes((0x11, size)) + bytes(size)


def test_17_gives_no_more_than_fits() -> None:
    with pytest.raises(InvalidRequest, match="data must have 0…251 bytes, not 252"):
        ReportServerId.Reply(bytes(252))


@pytest.mark.clause("A23")
def test_11_gives_status_and_count_of_the_line() -> None:
    context = FakeContext()
    assert GetCommEventCounter().apply(RecordingModel(), context).encode() == bytes.fromhex("0B 0000 0000")
    context.diagnostics.program_command_running = True
    for _ in range(3):
        context.diagnostics.received()
        context.diagnostics.answered()
    assert GetCommEventCounter().apply(RecordingModel(), context).encode() == bytes.fromhex("0B FFFF 0003")


@pytest.mark.clause("A23")
def test_11_and_12_count_on_16_bits() -> None:
    class Busy:
        def event_counter(self) -> tuple[int, int]:
            return 0, 0x1_0002

        def event_log(self) -> tuple[int, int, int, bytes]:
            return 0, 0x1_0002, 0x2_0003, b"\x40"

    context: Any = FakeContext(diagnostics=Busy())  # type: ignore[arg-type]
    assert GetCommEventCounter().apply(RecordingModel(), context).encode() == bytes.fromhex("0B 0000 0002")
    assert GetCommEventLog().apply(RecordingModel(), context).encode() == bytes.fromhex("0C 07 0000 0002 0003 40")


@pytest.mark.clause("A23")
def test_12_gives_up_to_64_events() -> None:
    full = GetCommEventLog.Reply(0, 1, 2, bytes(64))
    assert full.encode()[1] == 70
    with pytest.raises(InvalidRequest, match="events must have 0…64 bytes, not 65"):
        GetCommEventLog.Reply(0, 1, 2, bytes(65))
    with pytest.raises(MalformedPdu):
        GetCommEventLog.Reply.decode(b"\x0c\x47" + bytes(71))


@pytest.mark.clause("S17")
@pytest.mark.parametrize("data", [b"\xa5\x37", bytes(250), b"\x00\x00"])
def test_08_00_gives_back_what_it_got(data: bytes) -> None:
    request = ReturnQueryData(data)
    assert request.apply(RecordingModel(), FakeContext()).encode() == b"\x08\x00\x00" + data


@pytest.mark.parametrize("size", [0, 1, 3, 252])
def test_08_00_has_whole_words(size: int) -> None:
    with pytest.raises(InvalidRequest, match="data must have"):
        ReturnQueryData(bytes(size))


@pytest.mark.clause("S17")
@pytest.mark.parametrize("kind", SUB_FUNCTIONS, ids=lambda kind: kind.__name__)
def test_a_sub_function_has_two_bytes_of_data_that_it_allows(kind: Any) -> None:
    for size in (0, 1, 3, 4):
        with pytest.raises(InvalidRequest, match="data must have 2…2 bytes"):
            kind(bytes(size))
        request = STANDARD.decode_request(b"\x08" + kind.sub_code.to_bytes(2, "big") + bytes(size))
        assert isinstance(request, MalformedRequest)
        assert request.code == 3
    with pytest.raises(InvalidRequest, match="data"):
        kind(b"\x12\x34")


@pytest.mark.clause("S17")
def test_08_01_takes_0000_and_ff00() -> None:
    assert RestartCommunications().data == b"\x00\x00"
    assert RestartCommunications(b"\xff\x00").data == b"\xff\x00"
    with pytest.raises(InvalidRequest, match="data ff ff where sub-function 1 has 00 00"):
        RestartCommunications(b"\xff\xff")


@pytest.mark.clause("S12")
def test_08_03_takes_an_ascii_character_and_a_zero() -> None:
    context = FakeContext()
    assert ChangeAsciiDelimiter(b"\x3b\x00").apply(RecordingModel(), context).encode() == bytes.fromhex("08 0003 3B00")
    assert context.diagnostics.line.ascii_delimiter == 0x3B
    for data in (b"\x3b\x01", b"\x80\x00"):
        with pytest.raises(InvalidRequest, match="data must be an ASCII character and a zero"):
            ChangeAsciiDelimiter(data)


@pytest.mark.clause("S16")
def test_a_counter_comes_back_as_a_number() -> None:
    context = FakeContext()
    context.diagnostics.received()
    reply = ReturnBusMessageCount().apply(RecordingModel(), context)
    assert isinstance(reply, Diagnostic.Reply)
    assert reply.value == 1
    assert reply.encode() == bytes.fromhex("08 000B 0001")
    context.diagnostics.diagnostic_register = 0x1234
    assert ReturnDiagnosticRegister().apply(RecordingModel(), context).encode() == bytes.fromhex("08 0002 1234")


@pytest.mark.clause("S17")
def test_every_sub_function_of_the_table_is_done_by_the_line() -> None:
    for kind in SUB_FUNCTIONS:
        reply = kind().apply(RecordingModel(), FakeContext())
        assert reply.encode()[:3] == b"\x08" + kind.sub_code.to_bytes(2, "big")
    context = FakeContext()
    ForceListenOnly().apply(RecordingModel(), context)
    assert context.diagnostics.listen_only
