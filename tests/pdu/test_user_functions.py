"""A function of the user's own: one class and one entry in a table, and it is there everywhere."""

import pytest
from recording_device import FakeContext, RecordingModel

from busway.codes import Table
from busway.errors import InvalidRequest
from busway.pdu.device_interface import Context, DataModel
from busway.pdu.fields import rest, rest_length, u8, u16
from busway.pdu.functions import STANDARD
from busway.pdu.malformed_pdu import MalformedPdu
from busway.pdu.malformed_request import MalformedRequest
from busway.pdu.message import Message, ReplyMessage, Request, Touch


class ReadPressure(Request):
    """65 Read Pressure: ``count`` sensors from ``sensor`` on."""

    code = 0x41
    sensor: int = u8(0, 15)
    count: int = u8(1, 16, default=1)

    class Reply(ReplyMessage):
        """Pressures, big-endian."""

        byte_count = rest_length(1, 2, 32, 2)
        data: bytes = rest(2, 32, 2)

    def apply(self, model: DataModel, context: Context) -> Message:
        return self.Reply(model.read(Table.INPUT_REGISTERS, self.sensor, self.count, context))


class WriteSetpoint(Request):
    """66 Write Setpoint: names the range it touches, so limits, hooks and policies see it."""

    code = 0x42
    writes = Touch(Table.HOLDING_REGISTERS, count=None)
    echoes = True
    broadcast = True
    address: int = u16()
    value: int = u16(0, 1000)


class VendorDiagnostic(Request):
    """08/0x15: a sub-function that the standard leaves free."""

    code = 8
    sub_code = 0x15
    sub_width = 2
    operation: int = u16(3, 4)

    class Reply(ReplyMessage):
        """Data of the vendor."""

        byte_count = rest_length(2)
        data: bytes = rest()


MINE = STANDARD.with_functions(ReadPressure, WriteSetpoint, VendorDiagnostic)


@pytest.mark.clause("A8")
def test_a_user_function_has_both_codecs_in_both_directions() -> None:
    request = ReadPressure(3, 2)
    assert request.encode() == bytes.fromhex("41 03 02")
    assert MINE.decode_request(b"\x41\x03\x02") == request
    reply = MINE.decode_reply(bytes.fromhex("41 04 0001 0002"))
    assert reply == ReadPressure.Reply(b"\x00\x01\x00\x02")
    assert request.prepare() == b"\x41\x03\x02"
    assert request.accept(reply.encode()) == reply


@pytest.mark.clause("A8")
def test_a_user_function_has_its_limits_checked_on_both_sides() -> None:
    with pytest.raises(InvalidRequest, match="sensor must be 0…15, not 16"):
        ReadPressure(16)
    malformed = MINE.decode_request(b"\x41\x10\x01")
    assert isinstance(malformed, MalformedRequest)
    assert malformed.code == 3
    with pytest.raises(MalformedPdu):
        MINE.decode_reply(b"\x41\x03\x00\x01\x02")


@pytest.mark.clause("A8")
def test_a_user_function_has_its_length_told_for_rtu() -> None:
    assert MINE.request_length(b"\x41", 0, 1) == 3
    assert [MINE.reply_length(b"\x41\x04", 0, size) for size in (1, 2)] == [0, 6]
    assert MINE.reply_length(bytes.fromhex("08 0015 0004"), 0, 5) == 9


@pytest.mark.clause("A8")
def test_a_user_function_is_executed_on_a_device() -> None:
    model = RecordingModel()
    model.registers[6:10] = b"\x11\x22\x33\x44"
    assert ReadPressure(3, 2).apply(model, FakeContext()).encode() == bytes.fromhex("41 04 1122 3344")


def test_a_write_that_names_its_range_is_a_write_whose_echo_is_expected() -> None:
    request = WriteSetpoint(5, 100)
    assert WriteSetpoint.is_write
    assert [(span.address, span.count, span.writes) for span in request.spans()] == [(5, 1, True)]
    assert request.reply_shape() == (5, request.encode())
    assert MINE.decode_reply(request.encode()) == WriteSetpoint.Reply(5, 100)
    assert WriteSetpoint.Reply.__doc__ == "Repeats the fields of `WriteSetpoint`."


def test_a_sub_function_stands_beside_those_of_the_standard() -> None:
    assert MINE.decode_request(bytes.fromhex("08 0015 0003")) == VendorDiagnostic(3)
    assert MINE.decode_request(bytes.fromhex("08 0000 A537")) == STANDARD.decode_request(bytes.fromhex("08 0000 A537"))
    assert MINE.decode_reply(bytes.fromhex("08 0015 0002 0102")) == VendorDiagnostic.Reply(b"\x01\x02")
    assert 0x41 not in STANDARD
