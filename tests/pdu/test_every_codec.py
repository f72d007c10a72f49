"""Every class of messages: its bytes, whole, cut, with bytes behind and with each byte changed.

What a codec takes it gives back unchanged; what it does not take is `MalformedPdu` and nothing else.
"""

import copy
import pickle
from collections.abc import Iterator

import pytest
from examples import examples
from hypothesis import given, settings
from hypothesis import strategies as st
from message_strategies import ALL, REPLIES, REQUESTS, any_request, messages, name_of
from spec_frames import EXCHANGES, Exchange

from busway.codes import PDU_LIMIT
from busway.pdu.encapsulated import CanopenGeneralReference, ReadDeviceIdentification
from busway.pdu.exception_response import ExceptionResponse
from busway.pdu.functions import STANDARD
from busway.pdu.malformed_pdu import MalformedPdu
from busway.pdu.malformed_request import MalformedRequest
from busway.pdu.message import NEED_MORE, UNKNOWN_LENGTH, Message
from busway.pdu.unknown_functions import OpaqueReply, OpaqueRequest

FRAMES = [
    pytest.param(kind, bytes.fromhex(text), id=f"{kind.__qualname__} {text}")
    for exchange in EXCHANGES
    for kind, text in (
        (type(exchange.request), exchange.request_hex),
        (type(exchange.reply), exchange.reply_hex),
    )
] + [
    pytest.param(ExceptionResponse, b"\x83\x02", id="exception"),
    pytest.param(OpaqueRequest, b"\x41\x01\x02", id="opaque request"),
    pytest.param(OpaqueReply, b"\x41\x01\x02", id="opaque reply"),
]


def test_the_examples_show_every_class() -> None:
    assert {type(one.request) for one in EXCHANGES} == set(REQUESTS)
    assert {type(one.reply) for one in EXCHANGES} == set(REPLIES)


@pytest.mark.clause("A3")
@pytest.mark.parametrize("exchange", EXCHANGES, ids=lambda exchange: exchange.name)
def test_the_printed_bytes_both_ways(exchange: Exchange) -> None:
    for message, text in ((exchange.request, exchange.request_hex), (exchange.reply, exchange.reply_hex)):
        wire = bytes.fromhex(text)
        assert message.encode() == wire
        assert type(message).decode(wire) == message
    assert STANDARD.decode_request(bytes.fromhex(exchange.request_hex)) == exchange.request
    assert STANDARD.decode_reply(bytes.fromhex(exchange.reply_hex)) == exchange.reply


@pytest.mark.parametrize("exchange", EXCHANGES, ids=lambda exchange: exchange.name)
def test_a_reply_of_the_document_answers_its_request(exchange: Exchange) -> None:
    request, reply = exchange.request, bytes.fromhex(exchange.reply_hex)
    assert request.prepare() == bytes.fromhex(exchange.request_hex)
    assert request.accept(reply) == exchange.reply
    size, prefix = request.reply_shape()
    assert size in (len(reply), UNKNOWN_LENGTH)
    assert reply.startswith(prefix)
    if request.take is not None and size != UNKNOWN_LENGTH:
        assert request.take(reply[2:]) == exchange.reply


@pytest.mark.parametrize("kind", ALL, ids=name_of)
@given(data=st.data())
@settings(max_examples=examples(40))
def test_a_message_goes_to_bytes_and_back(kind: type[Message], data: st.DataObject) -> None:
    message = data.draw(messages(kind))
    wire = message.encode()
    again = kind.decode(wire)
    assert 1 <= len(wire) <= PDU_LIMIT
    assert again == message
    assert again.values() == message.values()
    assert hash(again) == hash(message)
    assert kind(**message.values()) == message
    assert all(f"{name}=" in repr(message) for name in message.values())
    assert pickle.loads(pickle.dumps(message)) == message
    assert copy.copy(message) == copy.deepcopy(message) == message


@given(any_request())
@settings(max_examples=examples(300))
def test_a_request_is_found_in_the_table_by_its_bytes(request: Message) -> None:
    assert STANDARD.decode_request(request.encode()) == request


@pytest.mark.parametrize(("kind", "wire"), FRAMES)
def test_every_prefix_is_malformed_or_a_message_of_just_these_bytes(kind: type[Message], wire: bytes) -> None:
    for size in range(len(wire)):
        expect_message_or_malformed(kind, wire[:size])
        if size:
            expect_no_other_error(wire[:size])


@pytest.mark.parametrize(("kind", "wire"), FRAMES)
def test_bytes_behind_it_are_malformed_or_belong_to_the_message(kind: type[Message], wire: bytes) -> None:
    for trailing in (b"\x00", b"\xff", b"\x00\x00", b"\x55\xaa\x55", bytes(7), bytes(300)):
        expect_message_or_malformed(kind, wire + trailing)
    fixed = kind not in (CanopenGeneralReference, CanopenGeneralReference.Reply, OpaqueRequest, OpaqueReply)
    if fixed:  # a single byte never fits into a message whose length is told
        with pytest.raises(MalformedPdu):
            kind.decode(wire + b"\x00")


@pytest.mark.parametrize(("kind", "wire"), FRAMES)
def test_each_byte_changed_to_every_value(kind: type[Message], wire: bytes) -> None:
    for changed in changes(wire):
        expect_message_or_malformed(kind, changed)
        expect_no_other_error(changed)


@pytest.mark.clause("S8")
@pytest.mark.parametrize("exchange", EXCHANGES, ids=lambda exchange: exchange.name)
def test_the_length_rule_tells_the_length_as_soon_as_the_bytes_do(exchange: Exchange) -> None:
    for rule, text in (
        (STANDARD.request_length, exchange.request_hex),
        (STANDARD.reply_length, exchange.reply_hex),
    ):
        wire = bytes.fromhex(text)
        expect_length_rule(rule, wire)


@given(st.data())
@settings(max_examples=examples(300))
def test_the_length_rule_holds_for_messages_of_every_class(data: st.DataObject) -> None:
    kind = data.draw(st.sampled_from(STANDARD_CLASSES))
    wire = data.draw(messages(kind)).encode()
    rule = STANDARD.request_length if kind in REQUESTS else STANDARD.reply_length
    told = expect_length_rule(rule, wire)
    ends_by_silence = kind.__qualname__.split(".")[0] in ("ReturnQueryData", "CanopenGeneralReference")
    assert (told == UNKNOWN_LENGTH) == ends_by_silence


STANDARD_CLASSES = (*REQUESTS, *REPLIES)


def expect_length_rule(rule: object, wire: bytes) -> int:
    """Feed byte by byte: NEED_MORE, then one answer for good, whatever stands before and behind the message."""
    told = NEED_MORE
    for size in range(len(wire) + 1):
        now = rule(b"\xee" + wire[:size] + b"\x99", 1, 1 + size)  # type: ignore[operator]
        if told == NEED_MORE:
            assert now in (NEED_MORE, UNKNOWN_LENGTH, len(wire))
        else:
            assert now == told
        told = now
    assert told in (UNKNOWN_LENGTH, len(wire))
    assert rule(wire + b"\x01\x02", 0, len(wire) + 2) == told  # type: ignore[operator]
    return told


def changes(wire: bytes) -> Iterator[bytes]:
    """Each byte changed: to every other value in short messages, to the neighbours and inverses in long ones."""
    for at, byte in enumerate(wire):
        others = range(256) if len(wire) <= 16 else {0, 0xFF, byte ^ 0xFF, byte + 1 & 0xFF, byte - 1 & 0xFF}
        for other in others:
            if other != byte:
                yield wire[:at] + bytes((other,)) + wire[at + 1 :]


def expect_message_or_malformed(kind: type[Message], pdu: bytes) -> None:
    try:
        message = kind.decode(pdu)
    except MalformedPdu as error:
        expect_reason(error)
    else:
        assert message.encode() == pdu


def expect_reason(error: MalformedPdu) -> None:
    assert error.reason
    assert error.code in (0x02, 0x03)


def expect_no_other_error(pdu: bytes) -> None:
    """Through the table, as a server and a client see it."""
    if pdu[0] < 0x80:
        request = STANDARD.decode_request(pdu)
        assert request.encode() == pdu
        if isinstance(request, MalformedRequest):
            assert (request.function, request.data) == (pdu[0], pdu)
            assert request.reason
    try:
        reply = STANDARD.decode_reply(pdu)
    except MalformedPdu as error:
        expect_reason(error)
    else:
        long_form = pdu[0] == 0xAB and len(pdu) == 3
        assert reply.encode() == (pdu[:1] + pdu[2:] if long_form else pdu)


def test_an_identification_reply_may_be_refused_in_the_long_form_of_the_figure() -> None:
    assert ReadDeviceIdentification.code == 0x2B
    assert STANDARD.decode_reply(b"\xab\x0e\x02") == ExceptionResponse(0x2B, 2)
    assert STANDARD.decode_reply(b"\xab\x02") == ExceptionResponse(0x2B, 2)
    with pytest.raises(MalformedPdu):
        STANDARD.decode_reply(b"\x83\x0e\x02")
