"""Golden frames are what the library says too, in both directions."""

import pytest

import busway
from busway.testing import GOLDEN_EXCEPTIONS, GOLDEN_EXCHANGES, GoldenExchange, golden_adu


@pytest.mark.parametrize("one", GOLDEN_EXCHANGES, ids=lambda one: one.name)
def test_golden_exchange_is_decoded_and_encoded_to_the_same_bytes(one: GoldenExchange) -> None:
    request = busway.STANDARD.decode_request(one.request)
    assert isinstance(request, busway.Request)
    assert request.encode() == one.request
    assert busway.STANDARD.decode_reply(one.reply).encode() == one.reply
    request.prepare()
    assert request.accept(one.reply).encode() == one.reply


def test_every_function_has_a_golden_exchange() -> None:
    assert {one.request[0] for one in GOLDEN_EXCHANGES} == set(busway.STANDARD.codes())


@pytest.mark.parametrize("one", GOLDEN_EXCEPTIONS, ids=lambda one: one.name)
def test_golden_exception_is_decoded(one: GoldenExchange) -> None:
    reply = busway.STANDARD.decode_reply(one.reply)
    assert reply.values() == {"function": one.request[0], "exception": one.reply[1]}


def test_golden_adu_is_header_and_pdu() -> None:
    assert golden_adu(b"\x07", transaction=0x0102, unit=3) == bytes.fromhex("0102 0000 0002 03 07")
