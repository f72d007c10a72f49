"""PDUs taken apart: every field with its place and value, also of PDUs that are broken."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from busway.pdu.describe import Description, Part, describe_reply, describe_request
from busway.pdu.diagnostics import ReportServerId
from busway.pdu.exception_response import ExceptionResponse
from busway.pdu.read_items import ReadCoils


def rows(description: Description) -> list[tuple[int, str, str, str, str]]:
    """The parts, in a form that reads well in a test."""
    return [(part.offset, part.data.hex(" "), part.name, part.text, part.problem) for part in description.parts]


def test_a_request_has_its_fields_in_order() -> None:
    description = describe_request(bytes.fromhex("03 00 6B 00 03"))
    assert description.title == "3 (read holding registers), request"
    assert rows(description) == [
        (0, "03", "function", "3 (read holding registers)", ""),
        (1, "00 6b", "address", "107, holding register 4x108", ""),
        (3, "00 03", "count", "3", ""),
    ]
    assert description.problems == ()
    assert description.message is not None


def test_a_reply_shows_its_registers() -> None:
    description = describe_reply(bytes.fromhex("03 06 02 2B 00 00 00 64"))
    assert rows(description)[1:] == [
        (1, "06", "byte count", "6", ""),
        (2, "02 2b 00 00 00 64", "data", "555 0 100", ""),
    ]


def test_a_reply_of_bits_shows_as_many_as_were_asked() -> None:
    reply = bytes.fromhex("01 01 05")
    assert describe_reply(reply).parts[-1].text == "on off on off off off off off"
    assert describe_reply(reply, request=ReadCoils(0, 3)).parts[-1].text == "on off on"


def test_a_written_coil_is_on_or_off() -> None:
    assert describe_request(bytes.fromhex("05 00 AC FF 00")).parts[-1].text == "on"


def test_masks_are_shown_bit_by_bit() -> None:
    assert describe_request(bytes.fromhex("16 00 04 00 F2 00 25")).parts[2].text == "0b0000000011110010"


def test_an_exception_is_named() -> None:
    description = describe_reply(bytes.fromhex("83 02"))
    assert description.title == "3 (read holding registers), exception"
    assert "illegal data address" in description.parts[1].text
    assert isinstance(description.message, ExceptionResponse)


def test_an_exception_with_the_mei_type_between_shows_both() -> None:
    description = describe_reply(bytes.fromhex("AB 0E 02"))
    assert rows(description)[1] == (1, "0e", "MEI type", "14 (read device identification)", "")
    assert rows(description)[2][:3] == (2, "02", "exception code")
    assert "illegal data address" in description.parts[2].text
    assert description.problems == ()
    assert description.message == ExceptionResponse(43, 2)


def test_a_sub_function_is_named() -> None:
    parts = describe_request(bytes.fromhex("08 00 0B 00 00")).parts
    assert (parts[1].name, parts[1].text) == ("sub-function", "11 (bus message count)")


def test_identification_objects_are_parts_of_their_own() -> None:
    description = describe_reply(bytes.fromhex("2B 0E 01 01 00 00 02 00 03 61 62 63 01 01 78"))
    assert rows(description)[-2:] == [
        (7, "00 03 61 62 63", "object 1", "VendorName: abc", ""),
        (12, "01 01 78", "object 2", "ProductCode: x", ""),
    ]


def test_file_groups_are_parts_of_their_own() -> None:
    description = describe_request(bytes.fromhex("14 0E 06 00 04 00 01 00 02 06 00 03 00 09 00 02"))
    assert [part.text for part in description.parts[2:]] == [
        "file 4, record 1, count 2",
        "file 3, record 9, count 2",
    ]


def test_an_unknown_function_is_bytes() -> None:
    description = describe_request(bytes.fromhex("41 AA BB"))
    assert not description.is_known
    assert rows(description)[1] == (1, "aa bb", "data", "", "")
    assert description.problems == ()


@pytest.mark.parametrize(
    ("pdu", "name", "problem"),
    [
        ("03 00", "address", "1 of 2 bytes are missing"),
        ("03 00 00 00 7E", "count", "126 where 1…125 can be"),
        ("03 00 00 00 01 00", "surplus", "1 byte too many"),
        ("05 00 00 12 34", "value", "1234 where 0000 or FF00 can be"),
        ("10 00 00 00 01 04 00 01", "byte count", "announces 4 bytes, and 2 follow"),
        ("10 00 00 00 01 03 00 01 02", "byte count", "3 is no multiple of 2"),
        ("14 07 05 00 04 00 01 00 02", "group 1", "reference type 5 where 6 is required"),
        ("14 05 06 00 04 00 01", "group 1", "5 bytes where a group has 7"),
    ],
)
def test_of_a_broken_request_the_field_at_fault_is_named(pdu: str, name: str, problem: str) -> None:
    description = describe_request(bytes.fromhex(pdu))
    assert description.message is None
    assert description.problems
    assert (name, problem) in [(part.name, part.problem) for part in description.parts]


def test_a_sub_function_that_is_cut_off_is_said() -> None:
    assert describe_request(bytes.fromhex("08 00")).problems == ("the sub-function is missing",)


def test_a_rule_across_fields_is_said_of_the_whole() -> None:
    description = describe_request(bytes.fromhex("10 00 00 00 02 02 00 01"))
    assert description.problems == ("byte count 2 does not fit 2 registers",)


@pytest.mark.parametrize(
    ("pdu", "name", "problem"),
    [
        ("03 06 00 01", "byte count", "announces 6 bytes, and 2 follow"),
        ("83", "exception code", "is cut off"),
        ("83 02 03", "surplus", "1 byte too many"),
        ("2B 0E 01 01 00 00 01 00 09 61", "object 1", "the object is cut off"),
    ],
)
def test_of_a_broken_reply_the_field_at_fault_is_named(pdu: str, name: str, problem: str) -> None:
    description = describe_reply(bytes.fromhex(pdu))
    assert (name, problem) in [(part.name, part.problem) for part in description.parts]


def test_no_function_code_is_0_and_none_of_a_request_has_the_exception_bit() -> None:
    assert describe_request(b"\x00\x01").problems
    assert describe_request(b"\x83\x01").problems
    assert describe_reply(b"\x00\x01").problems
    assert describe_request(b"").problems
    assert describe_reply(b"").problems


@given(
    st.one_of(
        st.binary(max_size=60),
        st.builds(bytes.__add__, st.sampled_from([bytes((code,)) for code in range(50)]), st.binary(max_size=40)),
    )
)
def test_whatever_the_bytes_are_the_parts_hold_all_of_them(pdu: bytes) -> None:
    for description in (describe_request(pdu), describe_reply(pdu)):
        assert b"".join(part.data for part in description.parts) == pdu
        assert (description.message is None) == bool(description.problems)
        at = 0
        for part in description.parts:
            assert isinstance(part, Part)
            assert part.offset == at
            at += len(part.data)


def test_a_reply_that_a_device_defines_is_bytes() -> None:
    pdu = ReportServerId.Reply(b"abc\xff").encode()
    assert rows(describe_reply(pdu))[-1] == (2, "61 62 63 ff", "data", "", "")
