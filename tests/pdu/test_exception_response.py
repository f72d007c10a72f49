"""Exception replies: their bytes, and the longer form of function 43."""

import pytest

from busway.errors import InvalidRequest
from busway.pdu.exception_response import ExceptionResponse, decode_exception
from busway.pdu.malformed_pdu import MalformedPdu


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
