"""Registers wider than two bytes: what the request asks for, and which reply answers it."""

import pytest

from busway.errors import InvalidRequest
from busway.pdu.malformed_pdu import MalformedPdu
from busway.pdu.read_items import ReadHoldingRegisters, ReadInputRegisters
from busway.pdu.wide_registers import wide

KINDS = [ReadHoldingRegisters, ReadInputRegisters]
EIGHT = bytes.fromhex("08 00010002 00000003")  # byte count, two registers of four bytes


@pytest.mark.parametrize("kind", KINDS)
def test_a_width_of_two_bytes_is_the_ordinary_request_and_each_other_one_class(
    kind: type[ReadHoldingRegisters],
) -> None:
    assert wide(kind, 2) is kind
    assert wide(kind, 4) is wide(kind, 4)
    assert wide(kind, 4) is not wide(kind, 6)
    assert issubclass(wide(kind, 12), kind)


@pytest.mark.parametrize("kind", KINDS)
def test_the_request_is_that_of_the_function_and_the_reply_has_a_number_for_each_register(
    kind: type[ReadHoldingRegisters],
) -> None:
    request = wide(kind, 4)(0x006B, 2)
    code = bytes((kind.code,))
    assert request.prepare() == code + bytes.fromhex("006B 0002")
    reply = request.accept(code + EIGHT)
    assert isinstance(reply, kind.Reply)
    assert reply.registers == [0x0001_0002, 3]
    assert request.take(EIGHT[1:]) == reply
    assert reply.encode() == code + EIGHT


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("size", range(12))
def test_a_reply_of_another_length_does_not_answer_it(kind: type[ReadHoldingRegisters], size: int) -> None:
    request = wide(kind, 4)(0, 2)
    request.prepare()
    pdu = bytes((kind.code,)) + (EIGHT + bytes(3))[:size]
    if len(pdu) == 10:
        request.accept(pdu)
        return
    with pytest.raises(MalformedPdu):
        request.accept(pdu)


@pytest.mark.parametrize("kind", KINDS)
def test_an_ordinary_reply_does_not_answer_it(kind: type[ReadHoldingRegisters]) -> None:
    request = wide(kind, 4)(0, 2)
    request.prepare()
    with pytest.raises(MalformedPdu):
        request.accept(bytes((kind.code,)) + bytes.fromhex("04 0001 0002"))


@pytest.mark.parametrize(("width", "most"), [(4, 62), (6, 41), (8, 31), (10, 25), (12, 20)])
def test_as_many_registers_are_asked_for_as_a_reply_can_announce(width: int, most: int) -> None:
    kind = wide(ReadHoldingRegisters, width)
    request = kind(0, most)
    request.prepare()
    data = bytes((3, most * width)) + bytes(most * width)
    assert request.accept(data).registers == [0] * most  # type: ignore[attr-defined]
    with pytest.raises(InvalidRequest, match=f"1…{most}"):
        kind(0, most + 1)
