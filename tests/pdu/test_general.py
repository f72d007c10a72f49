"""Exceptions and what no table knows."""

import pytest

from busway.errors import InvalidRequest
from busway.pdu.general import ExceptionResponse, OpaqueReply, OpaqueRequest, decode_exception
from busway.pdu.malformed import MalformedPdu
from busway.pdu.message import UNKNOWN_LENGTH


@pytest.mark.clause("A2")
def test_an_exception_travels_as_function_code_plus_0x80() -> None:
    exception = ExceptionResponse(3, 2)
    assert exception.encode() == b"\x83\x02"
    assert ExceptionResponse.decode(b"\x83\x02").values() == {"function": 3, "exception": 2}
    assert exception.meaning.startswith("illegal data address")
    assert ExceptionResponse(0, 1).encode() == b"\x80\x01"
    assert "outside the specification" in ExceptionResponse(3, 0x55).meaning


def test_a_positive_reply_is_no_exception() -> None:
    with pytest.raises(MalformedPdu, match="function 3 is no exception reply"):
        ExceptionResponse.decode(b"\x03\x02")


@pytest.mark.parametrize(("function", "exception"), [(128, 1), (-1, 1), (3, 256), (3, -1)])
def test_an_exception_that_does_not_fit_its_bytes_cannot_be_built(function: int, exception: int) -> None:
    with pytest.raises(InvalidRequest, match=r"must be 0…"):
        ExceptionResponse(function, exception)


@pytest.mark.clause("A19")
def test_only_43_is_refused_with_its_mei_type_between() -> None:
    assert decode_exception(b"\xab\x0e\x01") == ExceptionResponse(43, 1)
    assert decode_exception(b"\xab\x0d\x01") == ExceptionResponse(43, 1)
    for pdu in (b"\xab\x0f\x01", b"\x83\x0e\x01", b"\xab\x0e\x01\x00"):
        with pytest.raises(MalformedPdu):
            decode_exception(pdu)


def test_an_unknown_request_counts_as_a_write_and_takes_any_reply_of_its_function() -> None:
    request = OpaqueRequest(0x41, b"\x01")
    assert request.is_write
    assert request.spans() == ()
    assert request.reply_shape() == (UNKNOWN_LENGTH, b"\x41")
    assert request.accept(b"\x41\x09\x08") == OpaqueReply(0x41, b"\x09\x08")
    with pytest.raises(MalformedPdu, match="function 66 where 65 answers"):
        request.accept(b"\x42")


def test_an_unknown_request_has_at_most_253_bytes() -> None:
    assert len(OpaqueRequest(0x41, bytes(252)).encode()) == 253
    with pytest.raises(InvalidRequest, match="data must have 0…252 bytes, not 253"):
        OpaqueRequest(0x41, bytes(253))
    with pytest.raises(InvalidRequest, match="function must be 0…127, not 200"):
        OpaqueRequest(200, b"")
