"""Compiling: when it happens, what it refuses to compile, and the short way to a reply."""

from typing import Any

import pytest

from busway.errors import InvalidRequest
from busway.pdu.compiler import as_bytes, as_integer, as_tuple, attribute_names
from busway.pdu.fields import repeated, rest, rest_length, u8, u16
from busway.pdu.file_records import FileReference, ReadFileRecord, WriteFileRecord
from busway.pdu.malformed_pdu import MalformedPdu
from busway.pdu.message import ReplyMessage, Request
from busway.pdu.read_items import ReadCoils, ReadFifoQueue, ReadHoldingRegisters
from busway.pdu.write_items import ReadWriteMultipleRegisters, WriteMultipleRegisters


def make_function() -> Any:
    """A class that was not used yet."""

    class Fresh(Request):
        code = 0x42
        value: int = u16()

        class Reply(ReplyMessage):
            byte_count = rest_length(1, 1, 4)
            data: bytes = rest(1, 4)

    return Fresh


@pytest.mark.parametrize(
    "first_use",
    [
        lambda kind: kind(5),
        lambda kind: kind(value=5),
        lambda kind: kind.decode(b"\x42\x00\x05"),
        lambda kind: kind.Reply.decode(b"\x42\x01\x05"),
        lambda kind: kind.Reply(b"\x05").encode(),
    ],
)
def test_codecs_are_compiled_at_whatever_is_used_first(first_use: Any) -> None:
    kind = make_function()
    first_use(kind)
    assert kind(5).encode() == b"\x42\x00\x05"
    assert kind.decode(b"\x42\x00\x05") == kind(5)
    assert kind.Reply.decode(b"\x42\x01\x05").data == b"\x05"


def test_a_subclass_inherits_the_codecs_of_its_base_whichever_is_used_first() -> None:
    base = make_function()

    class Named(base):
        """The same function under another name."""

    assert Named(3).encode() == b"\x42\x00\x03"
    assert base(3).encode() == b"\x42\x00\x03"
    assert type(Named.decode(b"\x42\x00\x03")) is Named


def test_attribute_names_leave_out_what_is_computed() -> None:
    assert attribute_names(WriteMultipleRegisters) == ("address", "count", "data")
    assert attribute_names(ReadHoldingRegisters.Reply) == ("data",)


def test_nothing_may_stand_behind_the_variable_part() -> None:
    with pytest.raises(TypeError, match="behind the variable field data"):

        class Wrong(Request):
            code = 0x43
            data: bytes = rest()
            late: int = u8()

            class Reply(ReplyMessage):
                """Nothing."""


def test_a_field_without_a_default_does_not_follow_one_that_has_it() -> None:
    with pytest.raises(TypeError, match=r"Wrong\.second needs a default, because first before it has one"):

        class Wrong(Request):
            code = 0x43
            first: int = u8(default=1)
            second: int = u8()

            class Reply(ReplyMessage):
                """Nothing."""


def test_there_is_one_length_at_most() -> None:
    with pytest.raises(TypeError, match=r"Wrong\.another is a second length"):

        class Wrong(Request):
            code = 0x43
            length = rest_length()
            another = rest_length()
            data: bytes = rest()

            class Reply(ReplyMessage):
                """Nothing."""


def test_the_layout_knows_where_the_length_stands() -> None:
    layout = WriteMultipleRegisters.layout
    assert (layout.head.size, layout.length_offset, layout.tail_name) == (6, 5, "data")
    assert layout.names == ("address", "count", "byte_count")
    assert ReadCoils.layout.length_at is None


def test_integers_bytes_and_tuples_are_taken_from_what_they_are_and_from_nothing_else() -> None:
    assert as_integer("count", 3) == 3
    assert as_bytes("data", bytearray(b"\x01")) == b"\x01"
    assert as_tuple("groups", [1, 2]) == (1, 2)
    with pytest.raises(InvalidRequest, match="count must be an integer, not 'x'"):
        as_integer("count", "x")
    with pytest.raises(InvalidRequest, match="count must be an integer, not False"):
        as_integer("count", False)
    with pytest.raises(InvalidRequest, match="file data must be bytes, not 2"):
        as_bytes("file_data", 2)
    with pytest.raises(InvalidRequest, match="groups must be a sequence, not 7"):
        as_tuple("groups", 7)


def test_a_number_as_data_is_no_run_of_zeros() -> None:
    with pytest.raises(InvalidRequest, match="data must be bytes, not 2"):
        WriteMultipleRegisters(0, 1, 2)  # type: ignore[arg-type]


def test_a_group_of_another_kind_is_refused() -> None:
    with pytest.raises(InvalidRequest, match="groups holds FileReference, not FileData"):
        WriteFileRecord((FileReference(1, 1, 1),))  # type: ignore[arg-type]
    with pytest.raises(InvalidRequest, match="groups must be a sequence"):
        ReadFileRecord(FileReference(1, 1, 1))  # type: ignore[arg-type]
    with pytest.raises(InvalidRequest, match=r"groups must have 1…35 items, not 0"):
        ReadFileRecord(())


def test_the_short_way_exists_where_the_rest_of_a_reply_is_data() -> None:
    assert ReadHoldingRegisters(0, 1).take(b"\x12\x34") == ReadHoldingRegisters.Reply(b"\x12\x34")
    assert ReadCoils(0, 1).take(b"\x01") == ReadCoils.Reply(b"\x01")
    assert ReadWriteMultipleRegisters.of(0, 1, 0, [1]).take(b"\x00\x01").data == b"\x00\x01"
    # 24 has a rule across its fields, 16 an echo, 20 groups to compare: the long way.
    for kind in (ReadFifoQueue, ReadFileRecord):
        assert kind.take is None
        assert kind.take_all is None


def test_the_short_way_makes_several_replies_at_once() -> None:
    data = (b"\x12\x34", b"", b"\x56\x78\x9a\xbc")
    assert ReadHoldingRegisters.take_all(data) == [ReadHoldingRegisters.take(one) for one in data]
    assert ReadCoils.take_all(()) == []


def test_a_message_that_would_not_fit_a_pdu_cannot_be_built() -> None:
    class Long(Request):
        code = 0x44
        first: int = u8()
        data: bytes = rest(0, 252)

        class Reply(ReplyMessage):
            """Nothing."""

    assert len(Long(0, bytes(251)).encode()) == 253
    with pytest.raises(InvalidRequest, match="the PDU would have 254 bytes; at most 253 fit"):
        Long(0, bytes(252))
    with pytest.raises(MalformedPdu, match="254 bytes where a PDU has at most 253"):
        Long.decode(b"\x44" + bytes(253))


def test_an_item_that_knows_its_exception_code_keeps_it() -> None:
    class Picky:
        @classmethod
        def decode_from(cls, data: bytes, at: int) -> tuple[Any, int]:
            raise MalformedPdu("not this", 2)

        def encode(self) -> bytes:
            return b"\x00"

    class Groups(Request):
        code = 0x45
        groups: tuple[Picky, ...] = repeated(Picky)

        class Reply(ReplyMessage):
            """Nothing."""

    with pytest.raises(MalformedPdu, match="groups, item 1: not this") as caught:
        Groups.decode(b"\x45\x00")
    assert caught.value.code == 2


class Padded(Request):
    """A function whose byte count has limits that its bytes alone do not keep."""

    code = 0x42
    byte_count = rest_length(1, 4, 8, 2)
    data: bytes = rest(0, 100)

    class Reply(ReplyMessage):
        data: bytes = rest()


@pytest.mark.parametrize("size", [0, 2, 5, 10])
def test_a_byte_count_outside_its_limits_is_neither_built_nor_received(size: int) -> None:
    with pytest.raises(InvalidRequest, match=f"byte count must be 4…8, a multiple of 2, not {size}"):
        Padded(bytes(size))
    with pytest.raises(MalformedPdu, match=f"byte count must be 4…8, a multiple of 2, not {size}"):
        Padded.decode(bytes((0x42, size)) + bytes(size))
