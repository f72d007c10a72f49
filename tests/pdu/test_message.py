"""What every message has in common: frozen values, ranges, shapes of replies."""

import copy
import pickle
from typing import Any

import pytest
from spec_frames import EXCHANGES, Exchange

from busway.codes import Table
from busway.errors import InvalidRequest
from busway.pdu.encapsulated import ReadDeviceIdentification
from busway.pdu.file_records import FileReference, ReadFileRecord, WriteFileRecord
from busway.pdu.functions import STANDARD
from busway.pdu.malformed_pdu import MalformedPdu
from busway.pdu.message import UNKNOWN_LENGTH, Message, ReplyMessage, Request, Span
from busway.pdu.read_items import ReadCoils, ReadFifoQueue, ReadHoldingRegisters, ReadInputRegisters
from busway.pdu.write_items import (
    MaskWriteRegister,
    ReadWriteMultipleRegisters,
    WriteMultipleCoils,
    WriteMultipleRegisters,
    WriteSingleCoil,
    WriteSingleRegister,
)


@pytest.mark.parametrize("exchange", EXCHANGES, ids=lambda exchange: exchange.name)
def test_a_message_is_a_frozen_value(exchange: Exchange) -> None:
    for message in (exchange.request, exchange.reply):
        for name in message.values():
            with pytest.raises(AttributeError, match="is frozen"):
                setattr(message, name, 1)
            with pytest.raises(AttributeError, match="is frozen"):
                delattr(message, name)
        with pytest.raises(AttributeError):
            message.anything_else = 1  # type: ignore[attr-defined]
        assert not hasattr(message, "__dict__")
        assert copy.copy(message) is message
        assert copy.deepcopy(message) is message
        assert pickle.loads(pickle.dumps(message)) == message
        assert {message: 1}[type(message).decode(message.encode())] == 1


def test_messages_of_different_functions_differ_though_their_fields_agree() -> None:
    assert ReadHoldingRegisters(1, 2) != ReadInputRegisters(1, 2)
    assert ReadHoldingRegisters(1, 2) != ReadHoldingRegisters(1, 3)
    assert WriteSingleRegister(1, 2) != WriteSingleRegister.Reply(1, 2)
    assert ReadHoldingRegisters(1, 2) != "03"


def test_a_message_is_shown_with_its_fields() -> None:
    assert repr(ReadHoldingRegisters(10, 2)) == "ReadHoldingRegisters(address=10, count=2)"
    assert repr(ReadHoldingRegisters.Reply(b"\x00\x01")) == "Reply(data='00 01')"


def test_a_request_that_was_sent_is_still_the_same_value() -> None:
    request = ReadHoldingRegisters(10, 2)
    same = ReadHoldingRegisters(10, 2)
    assert request.prepare() == b"\x03\x00\x0a\x00\x02"
    assert request == same
    assert hash(request) == hash(same)
    assert pickle.loads(pickle.dumps(request)) == same
    assert request.values() == {"address": 10, "count": 2}


@pytest.mark.clause("A4")
@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda: ReadCoils(65_535, 2), "2 coils from address 65535 end beyond address 65535"),
        (lambda: ReadHoldingRegisters(65_412, 125), "125 holding registers from address 65412 end beyond"),
        (lambda: WriteMultipleRegisters.of(65_535, [1, 2]), "2 holding registers from address 65535"),
        (lambda: WriteMultipleCoils.of(65_535, [True, True]), "2 coils from address 65535"),
        (lambda: ReadWriteMultipleRegisters.of(65_535, 2, 0, [1]), "2 holding registers from address 65535"),
        (lambda: ReadWriteMultipleRegisters.of(0, 2, 65_535, [1, 2]), "2 holding registers from address 65535"),
        (lambda: ReadCoils(65_536, 1), "address must be 0…65535, not 65536"),
        (lambda: ReadCoils(-1, 1), "address must be 0…65535, not -1"),
    ],
)
def test_a_range_beyond_the_table_cannot_be_asked_for(make: Any, sentence: str) -> None:
    with pytest.raises(InvalidRequest, match=sentence):
        make()


@pytest.mark.clause("A4")
def test_the_last_item_of_a_table_can_be_asked_for() -> None:
    assert ReadCoils(65_535, 1).encode() == bytes.fromhex("01 FFFF 0001")
    assert WriteMultipleRegisters.of(65_413, [0] * 123).spans() == (Span(Table.HOLDING_REGISTERS, 65_413, 123, True),)


@pytest.mark.clause("A7")
def test_a_received_range_beyond_the_table_is_decoded_because_it_is_answered_02() -> None:
    request = ReadCoils.decode(bytes.fromhex("01 FFFF 0002"))
    assert request.spans() == (Span(Table.COILS, 65_535, 2, False),)
    # Such a request is a value like any other.
    assert pickle.loads(pickle.dumps(request)) == request


@pytest.mark.parametrize(
    ("request_", "spans"),
    [
        (ReadCoils(3, 5), (Span(Table.COILS, 3, 5, False),)),
        (ReadInputRegisters(3, 5), (Span(Table.INPUT_REGISTERS, 3, 5, False),)),
        (WriteSingleCoil(7, 0), (Span(Table.COILS, 7, 1, True),)),
        (WriteSingleRegister(7, 0), (Span(Table.HOLDING_REGISTERS, 7, 1, True),)),
        (WriteMultipleCoils.of(7, [True] * 9), (Span(Table.COILS, 7, 9, True),)),
        (WriteMultipleRegisters.of(7, [1, 2]), (Span(Table.HOLDING_REGISTERS, 7, 2, True),)),
        (
            MaskWriteRegister(4, 0, 0),
            (Span(Table.HOLDING_REGISTERS, 4, 1, True), Span(Table.HOLDING_REGISTERS, 4, 1, False)),
        ),
        # what is written comes before what is read
        (
            ReadWriteMultipleRegisters.of(10, 6, 20, [1, 2, 3]),
            (Span(Table.HOLDING_REGISTERS, 20, 3, True), Span(Table.HOLDING_REGISTERS, 10, 6, False)),
        ),
        (ReadFifoQueue(9), (Span(Table.HOLDING_REGISTERS, 9, 1, False),)),
        (ReadFileRecord((FileReference(1, 2, 3),)), ()),
        (WriteFileRecord.of(1, 2, [3]), ()),
        (ReadDeviceIdentification(), ()),
    ],
)
def test_a_request_names_the_ranges_it_touches(request_: Request, spans: tuple[Span, ...]) -> None:
    assert request_.spans() == spans


@pytest.mark.parametrize(
    ("request_", "shape"),
    [
        (ReadCoils(0, 1), (3, b"\x01\x01")),
        (ReadCoils(0, 8), (3, b"\x01\x01")),
        (ReadCoils(0, 9), (4, b"\x01\x02")),
        (ReadCoils(0, 2000), (252, b"\x01\xfa")),
        (ReadHoldingRegisters(0, 1), (4, b"\x03\x02")),
        (ReadHoldingRegisters(0, 125), (252, b"\x03\xfa")),
        (WriteSingleRegister(1, 2), (5, b"\x06\x00\x01\x00\x02")),
        (WriteMultipleCoils.of(1, [True]), (5, b"\x0f\x00\x01\x00\x01")),
        (WriteMultipleRegisters.of(1, [9]), (5, b"\x10\x00\x01\x00\x01")),
        (ReadWriteMultipleRegisters.of(0, 3, 5, [1]), (8, b"\x17\x06")),
        (ReadFileRecord((FileReference(1, 2, 3), FileReference(1, 2, 1))), (14, b"\x14\x0c")),
        (ReadFifoQueue(0), (UNKNOWN_LENGTH, b"\x18")),
        (ReadDeviceIdentification(), (UNKNOWN_LENGTH, b"\x2b\x0e")),
    ],
)
def test_a_request_knows_length_and_beginning_of_its_reply(request_: Request, shape: tuple[int, bytes]) -> None:
    assert request_.reply_shape() == shape


@pytest.mark.parametrize(
    ("request_", "reply", "reason"),
    [
        (ReadHoldingRegisters(0, 2), "03 02 0001", "4 bytes where 6 answer the request"),
        (ReadHoldingRegisters(0, 2), "04 04 00010002", "function 4 where 3 is expected"),
        (ReadHoldingRegisters(0, 2), "03 04 0001", "byte count 4 where 2 bytes follow"),
        (ReadHoldingRegisters(0, 2), "03 03 000100", "byte count must be 2…250, a multiple of 2, not 3"),
        (WriteSingleRegister(1, 2), "06 0001 0003", "it begins 06 00 01 00 03 where 06 00 01 00 02 answers"),
        (WriteMultipleRegisters.of(1, [1, 2]), "10 0001 0001", "it begins 10 00 01 00 01 where 10 00 01 00 02"),
        (WriteMultipleCoils.of(1, [True]), "0f 0002 0001", "it begins 0f 00 02 00 01"),
        (MaskWriteRegister(1, 2, 3), "16 0001 0002 0004", "it begins 16"),
        (ReadFifoQueue(1), "18 0004 0002 0001", "FIFO count 2 where 1 registers follow"),
        (ReadDeviceIdentification(4, 1), "2b 0e 04 01 00 00 01 02 01 41", "object 1 was asked for alone"),
        (ReadFileRecord((FileReference(1, 2, 2),)), "14 06 03 06 0001 01 06", "groups of .1, 0. registers where .2."),
    ],
)
def test_a_reply_that_does_not_answer_the_request_is_malformed(request_: Request, reply: str, reason: str) -> None:
    request_.prepare()
    with pytest.raises(MalformedPdu, match=reason):
        request_.accept(bytes.fromhex(reply))


def test_what_is_a_write_is_known_of_every_function() -> None:
    writes = {kind.__name__ for kind in STANDARD if kind.is_write}
    assert writes == {
        "CanopenGeneralReference",
        "ChangeAsciiDelimiter",
        "ClearCounters",
        "ClearOverrun",
        "ForceListenOnly",
        "MaskWriteRegister",
        "ReadWriteMultipleRegisters",
        "RestartCommunications",
        "WriteFileRecord",
        "WriteMultipleCoils",
        "WriteMultipleRegisters",
        "WriteSingleCoil",
        "WriteSingleRegister",
    }


@pytest.mark.clause("S2")
def test_only_plain_writes_may_be_broadcast() -> None:
    assert {kind.__name__ for kind in STANDARD if kind.broadcast} == {
        "MaskWriteRegister",
        "WriteFileRecord",
        "WriteMultipleCoils",
        "WriteMultipleRegisters",
        "WriteSingleCoil",
        "WriteSingleRegister",
    }


def test_every_function_says_what_it_does_and_with_which_section() -> None:
    for kind in STANDARD:
        assert kind.__doc__
        assert "§" in kind.__doc__
        assert kind.Reply.__doc__
        assert issubclass(kind.Reply, ReplyMessage)
        assert kind.Reply.code == kind.code
        assert kind.apply is not Request.apply


def test_a_class_without_a_code_neither_encodes_nor_decodes() -> None:
    class Unfinished(Message):
        """Has no code."""

    with pytest.raises(TypeError, match="declares no code"):
        Unfinished().encode()
    with pytest.raises(TypeError, match="declares no code"):
        Unfinished.decode(b"\x01")
