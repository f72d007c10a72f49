"""The table of functions: what it finds, what it refuses to hold, and what it makes of what it does not know."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from busway.codes import DiagnosticCode, FunctionCode, MeiType
from busway.pdu.diagnostics import ReturnQueryData
from busway.pdu.exception_response import ExceptionResponse
from busway.pdu.fields import rest, u8
from busway.pdu.functions import STANDARD, FunctionTable
from busway.pdu.malformed_pdu import MalformedPdu
from busway.pdu.malformed_request import MalformedRequest
from busway.pdu.message import NEED_MORE, UNKNOWN_LENGTH, ReplyMessage, Request
from busway.pdu.read_items import ReadCoils, ReadHoldingRegisters
from busway.pdu.unknown_functions import OpaqueReply, OpaqueRequest


@pytest.mark.clause("A22")
def test_the_standard_table_holds_every_public_function_and_sub_function() -> None:
    assert STANDARD.codes() == tuple(FunctionCode)
    assert {kind.sub_code for kind in STANDARD if kind.code == 8} == set(DiagnosticCode)
    assert {kind.sub_code for kind in STANDARD if kind.code == 43} == set(MeiType)
    assert 3 in STANDARD
    assert 8 in STANDARD
    assert 9 not in STANDARD
    assert len(list(STANDARD)) == len(set(STANDARD)) == 34


def test_a_function_is_found_by_code_and_sub_code() -> None:
    assert STANDARD.find(b"\x03", 0, 1) is ReadHoldingRegisters
    assert STANDARD.find(b"\xff\x08\x00\x00", 1, 4) is ReturnQueryData
    assert STANDARD.find(b"\x08\x00", 0, 2) is None  # the sub-code is not whole yet
    assert STANDARD.find(b"\x08\x00\x00", 0, 2) is None  # nor does what stands behind the end belong to it
    assert STANDARD.find(b"\x08\x00\x05", 0, 3) is None
    assert STANDARD.find(b"\x2b\x0f", 0, 2) is None


@pytest.mark.clause("A2")
@pytest.mark.parametrize("pdu", [b"\x41\x01\x02", b"\x09", b"\x00", b"\x08\x00\x15\x00\x00", b"\x2b\x0f\x01", b"\x7f"])
def test_a_function_that_is_not_in_the_table_is_carried_as_bytes(pdu: bytes) -> None:
    request = STANDARD.decode_request(pdu)
    assert request == OpaqueRequest(pdu[0], pdu[1:])
    assert request.encode() == pdu
    assert STANDARD.decode_reply(pdu) == OpaqueReply(pdu[0], pdu[1:])


def test_what_is_longer_than_any_pdu_is_malformed_also_with_an_unknown_function() -> None:
    pdu = b"\x41" + bytes(253)
    with pytest.raises(MalformedPdu, match="254 bytes where a PDU has at most 253"):
        STANDARD.decode_reply(pdu)
    with pytest.raises(MalformedPdu, match="254 bytes where a PDU has at most 253"):
        OpaqueRequest(0x41, b"").accept(pdu)
    request = STANDARD.decode_request(pdu)
    assert isinstance(request, MalformedRequest)
    assert (request.kind, request.encode(), request.reason) == (
        OpaqueRequest,
        pdu,
        "254 bytes where a PDU has at most 253",
    )


def test_a_known_function_without_its_sub_code_is_a_wrong_length_and_not_an_unknown_function() -> None:
    for pdu in (b"\x08", b"\x08\x00", b"\x2b"):
        request = STANDARD.decode_request(pdu)
        assert isinstance(request, MalformedRequest)
        assert (request.function, request.code, request.reason) == (pdu[0], 3, "the sub-function is missing")
        with pytest.raises(MalformedPdu, match="the sub-function is missing"):
            STANDARD.decode_reply(pdu)


def test_a_request_that_breaks_a_rule_keeps_its_bytes_and_the_code_it_earns() -> None:
    pdu = bytes.fromhex("03 0000 007E")  # 126 registers
    request = STANDARD.decode_request(pdu)
    assert request == MalformedRequest(3, ReadHoldingRegisters, pdu, "count must be 1…125, not 126", 3)
    assert request.encode() == pdu


@pytest.mark.clause("A20")
@given(st.integers(0, 127), st.integers(0, 255))
def test_an_exception_reply_of_any_function_and_code_is_decoded(function: int, code: int) -> None:
    reply = STANDARD.decode_reply(bytes((function | 0x80, code)))
    assert reply == ExceptionResponse(function, code)


@pytest.mark.parametrize("pdu", [b"", b"\x83", b"\x83\x01\x02", b"\x83" + bytes(5)])
def test_an_exception_reply_of_another_length_is_malformed(pdu: bytes) -> None:
    with pytest.raises(MalformedPdu):
        STANDARD.decode_reply(pdu)


@pytest.mark.clause("A8")
def test_a_second_function_of_a_code_is_refused_by_name() -> None:
    class Again(Request):
        code = 3

        class Reply(ReplyMessage):
            """Nothing."""

    with pytest.raises(ValueError, match="Again: function 3 is in the table already"):
        STANDARD.with_functions(Again)
    with pytest.raises(ValueError, match="ReadCoils: function 1 is in the table already"):
        FunctionTable(ReadCoils, ReadCoils)


def test_a_plain_function_and_one_with_sub_codes_do_not_share_a_code() -> None:
    class Plain(Request):
        code = 8

        class Reply(ReplyMessage):
            """Nothing."""

    class Sub(Request):
        code = 3
        sub_code = 1
        sub_width = 1

        class Reply(ReplyMessage):
            """Nothing."""

    for one in (Plain, Sub):
        with pytest.raises(ValueError, match="is in the table already"):
            STANDARD.with_functions(one)


def test_sub_codes_of_one_function_have_one_width() -> None:
    class Narrow(Request):
        code = 8
        sub_code = 0x40
        sub_width = 1

        class Reply(ReplyMessage):
            """Nothing."""

    with pytest.raises(ValueError, match="Narrow: the sub-codes of function 8 differ in width"):
        STANDARD.with_functions(Narrow)


@pytest.mark.parametrize("code", [0, 128, -1, 300])
def test_a_code_outside_1_to_127_is_refused(code: int) -> None:
    class Odd(Request):
        """Gets its code from outside."""

    Odd.code = code
    with pytest.raises(ValueError, match=f"a function code is 1…127, not {code}"):
        FunctionTable(Odd)


@pytest.mark.clause("A8")
def test_a_table_is_never_changed_by_building_another() -> None:
    class Vendor(Request):
        code = 0x41
        data: bytes = rest()

        class Reply(ReplyMessage):
            data: bytes = rest()

    class VendorDiagnostic(Request):
        code = 8
        sub_code = 0x15
        sub_width = 2
        operation: int = u8()

        class Reply(ReplyMessage):
            """Nothing."""

    before = tuple(STANDARD)
    mine = STANDARD.with_functions(Vendor, VendorDiagnostic)
    assert tuple(STANDARD) == before
    assert set(mine) == {*before, Vendor, VendorDiagnostic}
    assert mine.decode_request(b"\x41\x07") == Vendor(b"\x07")
    assert mine.decode_request(b"\x08\x00\x15\x09") == VendorDiagnostic(9)
    assert mine.decode_reply(b"\x08\x00\x15") == VendorDiagnostic.Reply()
    assert STANDARD.decode_request(b"\x41\x07") == OpaqueRequest(0x41, b"\x07")


@pytest.mark.clause("S8")
def test_lengths_of_what_the_content_does_not_tell() -> None:
    for rule in (STANDARD.request_length, STANDARD.reply_length):
        assert rule(b"", 0, 0) == NEED_MORE
        assert rule(b"\x41\x00", 0, 2) == UNKNOWN_LENGTH
        assert rule(b"\x08", 0, 1) == NEED_MORE  # perhaps a sub-function that is known
        assert rule(b"\x08\x00", 0, 2) == NEED_MORE
        assert rule(b"\x08\x00\x15", 0, 3) == UNKNOWN_LENGTH
        assert rule(b"\x2b", 0, 1) == NEED_MORE


@pytest.mark.clause("A19")
def test_an_exception_has_two_bytes_and_three_where_it_repeats_the_mei_type() -> None:
    assert STANDARD.reply_length(b"\x83", 0, 1) == 2
    assert STANDARD.reply_length(b"\xab", 0, 1) == NEED_MORE
    assert STANDARD.reply_length(b"\xab\x02", 0, 2) == 2
    assert STANDARD.reply_length(b"\xab\x0e", 0, 2) == 3
    assert STANDARD.reply_length(b"\x00\xab\x0e\x02", 1, 4) == 3
