"""Requests and replies of functions that no table knows."""

import pytest

from busway.errors import InvalidRequest
from busway.pdu.malformed_pdu import MalformedPdu
from busway.pdu.message import UNKNOWN_LENGTH
from busway.pdu.unknown_functions import OpaqueReply, OpaqueRequest


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
