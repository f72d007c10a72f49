"""The vocabulary of declarations: what a field is, and what a constructor does with values outside its limits."""

import pytest

from busway.errors import InvalidRequest
from busway.pdu.fields import (
    NO_DEFAULT,
    FixedField,
    RepeatedField,
    RestField,
    RestLength,
    repeated,
    rest,
    rest_length,
    u8,
    u16,
)
from busway.pdu.file_records import FileReference
from busway.pdu.malformed_pdu import MalformedPdu
from busway.pdu.message import ReplyMessage, Request


class Everything(Request):
    """One field of each kind of integer, a length and bytes."""

    code = 0x41
    small: int = u8(2, 9)
    large: int = u16(1, 500, default=7)
    choice: int = u8(values=(1, 3), default=1)
    following = rest_length(1, 0, 8, 2)
    payload_data: bytes = rest(0, 8, 2, default=b"")

    class Reply(ReplyMessage):
        """Nothing."""


def test_a_field_holds_its_declaration() -> None:
    assert u8(1, 2) == FixedField(1, 1, 2, None, NO_DEFAULT)
    assert u16(values=[5, 6], default=5) == FixedField(2, 0, 0xFFFF, (5, 6), 5)
    assert rest_length(2, 4, 10, 2) == RestLength(2, 4, 10, 2)
    assert rest(1, 5) == RestField(1, 5, 1, NO_DEFAULT)
    assert repeated(FileReference, 1, 3) == RepeatedField(FileReference, 1, 3, NO_DEFAULT)
    assert (u8().format, u16().format, rest_length(1).format, rest_length(2).format) == ("B", "H", "B", "H")
    assert repr(NO_DEFAULT) == "<no default>"


def test_fields_stand_on_the_wire_in_the_order_of_their_declaration() -> None:
    #                                                       small large choice length data
    message = Everything(2, 0x0102, 3, b"\xaa\xbb")
    assert message.encode() == bytes.fromhex("41 02 0102 03 02 AABB")
    assert message.values() == {"small": 2, "large": 0x0102, "choice": 3, "payload_data": b"\xaa\xbb"}
    assert Everything(9).encode() == bytes.fromhex("41 09 0007 01 00")


@pytest.mark.parametrize(
    ("values", "sentence"),
    [
        ({"small": 1}, "small must be 2…9, not 1"),
        ({"small": 10}, "small must be 2…9, not 10"),
        ({"large": 0}, "large must be 1…500, not 0"),
        ({"large": 501}, "large must be 1…500, not 501"),
        ({"large": -1}, "large must be 1…500, not -1"),
        ({"choice": 2}, "choice must be one of 1, 3, not 2"),
        ({"payload_data": b"\x00"}, "payload data must have a multiple of 2 bytes, not 1"),
        ({"payload_data": bytes(10)}, "payload data must have 0…8 bytes, not 10"),
        ({"small": "5"}, "small must be an integer, not '5'"),
        ({"small": 2.0}, "small must be an integer, not 2.0"),
        ({"small": True}, "small must be an integer, not True"),
        ({"small": None}, "small must be an integer, not None"),
        ({"payload_data": 4}, "payload data must be bytes, not 4"),
        ({"payload_data": [1, 2]}, r"payload data must be bytes, not \[1, 2\]"),
        ({"payload_data": "ab"}, "payload data must be bytes, not 'ab'"),
    ],
)
def test_a_value_outside_the_limits_is_refused_by_name(values: dict[str, object], sentence: str) -> None:
    with pytest.raises(InvalidRequest, match=sentence):
        Everything(**{"small": 2, "large": 1, "choice": 1, **values})  # type: ignore[arg-type]


@pytest.mark.parametrize("payload", [bytearray(b"\x01\x02"), memoryview(b"\x01\x02")])
def test_bytes_of_any_kind_become_bytes(payload: object) -> None:
    message = Everything(2, 1, 1, payload)  # type: ignore[arg-type]
    assert message.payload_data == b"\x01\x02"
    assert type(message.payload_data) is bytes


class Whole:
    """An integer of another type, as numeric libraries have them."""

    def __index__(self) -> int:
        return 5


def test_an_integer_of_another_type_becomes_an_int() -> None:
    message = Everything(Whole(), 1, 1)  # type: ignore[arg-type]
    assert message.small == 5
    assert type(message.small) is int


@pytest.mark.parametrize(
    ("wire", "reason"),
    [
        ("41 01 0001 01 00", "small must be 2…9, not 1"),
        ("41 02 0000 01 00", "large must be 1…500, not 0"),
        ("41 02 0001 02 00", "choice must be one of 1, 3, not 2"),
        ("41 02 0001 01 02 01", "following 2 where 1 byte follows"),
        ("41 02 0001 01 00 01", "following 0 where 1 byte follows"),
        ("41 02 0001 01 01 01", "following must be 0…8, a multiple of 2, not 1"),
        ("41 02 0001 01", "5 bytes where this function has at least 6"),
        ("42 02 0001 01 00", "function 66 where 65 is expected"),
    ],
)
def test_received_bytes_outside_the_limits_are_malformed_with_the_field_named(wire: str, reason: str) -> None:
    with pytest.raises(MalformedPdu) as caught:
        Everything.decode(bytes.fromhex(wire))
    assert caught.value.reason == reason
    assert caught.value.code == 3


def test_a_reply_without_fields_is_its_function_code_alone() -> None:
    assert Everything.Reply().encode() == b"\x41"
    assert Everything.Reply.decode(b"\x41") == Everything.Reply()
    with pytest.raises(MalformedPdu, match="2 bytes where this function has 1"):
        Everything.Reply.decode(b"\x41\x00")
