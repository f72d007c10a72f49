"""Function 43: identification page by page, level by level and alone; CANopen as it is."""

import pytest
from recording_device import FakeContext, RecordingModel

from busway.errors import InvalidRequest
from busway.pdu.device_interface import Refusal
from busway.pdu.encapsulated import (
    BASIC,
    EXTENDED,
    INDIVIDUAL,
    MAX_OBJECT_SIZE,
    OBJECT_NAMES,
    REGULAR,
    CanopenGeneralReference,
    IdentificationObject,
    ReadDeviceIdentification,
)
from busway.pdu.functions import STANDARD
from busway.pdu.malformed_pdu import MalformedPdu
from busway.pdu.malformed_request import MalformedRequest

Reply = ReadDeviceIdentification.Reply


def ask(objects: dict[int, bytes], level: int, object_id: int = 0) -> Reply:
    model = RecordingModel()
    model.objects = objects
    reply = ReadDeviceIdentification(level, object_id).apply(model, FakeContext())
    assert isinstance(reply, Reply)
    # Whatever a device says goes over the wire unchanged.
    assert STANDARD.decode_reply(reply.encode()) == reply
    assert len(reply.encode()) <= 253
    return reply


def numbers(reply: Reply) -> list[int]:
    return [one.number for one in reply.objects]


BASIC_OBJECTS = {0: b"vendor", 1: b"code", 2: b"1.0"}
REGULAR_OBJECTS = {**BASIC_OBJECTS, 3: b"url", 6: b"app"}
EXTENDED_OBJECTS = {**REGULAR_OBJECTS, 0x80: b"private", 0xFF: b"last"}


@pytest.mark.clause("A19")
@pytest.mark.parametrize(
    ("objects", "conformity"), [(BASIC_OBJECTS, 0x81), (REGULAR_OBJECTS, 0x82), (EXTENDED_OBJECTS, 0x83)]
)
def test_conformity_says_how_far_the_objects_go_and_that_single_ones_can_be_read(
    objects: dict[int, bytes], conformity: int
) -> None:
    assert ask(objects, BASIC).conformity == conformity


@pytest.mark.clause("A19")
@pytest.mark.parametrize(
    ("level", "expected"), [(BASIC, [0, 1, 2]), (REGULAR, [0, 1, 2, 3, 6]), (EXTENDED, [0, 1, 2, 3, 6, 0x80, 0xFF])]
)
def test_a_level_holds_those_below_it(level: int, expected: list[int]) -> None:
    reply = ask(EXTENDED_OBJECTS, level)
    assert numbers(reply) == expected
    assert (reply.level, reply.more_follows, reply.next_object, reply.number_of_objects) == (level, 0, 0, len(expected))


@pytest.mark.clause("A19")
@pytest.mark.parametrize("level", [REGULAR, EXTENDED])
def test_a_level_above_the_devices_own_is_answered_with_what_it_has(level: int) -> None:
    reply = ask(BASIC_OBJECTS, level)
    assert numbers(reply) == [0, 1, 2]
    assert reply.conformity == 0x81


@pytest.mark.clause("A19")
def test_a_stream_goes_on_where_it_is_asked_to() -> None:
    assert numbers(ask(EXTENDED_OBJECTS, EXTENDED, 3)) == [3, 6, 0x80, 0xFF]
    assert numbers(ask(EXTENDED_OBJECTS, EXTENDED, 0xFF)) == [0xFF]


@pytest.mark.clause("A19")
@pytest.mark.parametrize(("level", "object_id"), [(EXTENDED, 4), (EXTENDED, 0x7F), (BASIC, 3), (REGULAR, 0x80)])
def test_a_stream_from_an_object_that_is_not_in_it_starts_at_0(level: int, object_id: int) -> None:
    assert numbers(ask(EXTENDED_OBJECTS, level, object_id))[0] == 0


@pytest.mark.clause("A19")
@pytest.mark.parametrize("size", [1, 20, 61, 62, 100, 120, 121, 122, 243, 244])
def test_pages_together_give_every_object_once_and_in_order(size: int) -> None:
    objects = {number: bytes((number,)) * size for number in (*range(7), *range(0x80, 0xC0))}
    collected: list[IdentificationObject] = []
    start, pages = 0, 0
    while True:
        reply = ask(objects, EXTENDED, start)
        collected += reply.objects
        pages += 1
        if not reply.more_follows:
            assert reply.next_object == 0
            break
        assert reply.more_follows == 0xFF
        assert reply.next_object == next(number for number in sorted(objects) if number > reply.objects[-1].number)
        start = reply.next_object
    assert {one.number: one.value for one in collected} == objects
    assert [one.number for one in collected] == sorted(objects)
    per_page = (253 - 7) // (2 + size)
    assert pages == -(-len(objects) // per_page)


@pytest.mark.clause("A19")
def test_an_object_is_read_alone() -> None:
    for number, value in EXTENDED_OBJECTS.items():
        reply = ask(EXTENDED_OBJECTS, INDIVIDUAL, number)
        assert reply.objects == (IdentificationObject(number, value),)
        assert (reply.level, reply.more_follows, reply.next_object) == (INDIVIDUAL, 0, 0)


@pytest.mark.clause("A19")
def test_an_object_that_does_not_exist_is_02_when_asked_for_alone() -> None:
    with pytest.raises(Refusal) as caught:
        ask(EXTENDED_OBJECTS, INDIVIDUAL, 4)
    assert caught.value.code == 2


@pytest.mark.clause("A19")
@pytest.mark.parametrize("level", [0, 5, 0xFF])
def test_an_illegal_level_is_03(level: int) -> None:
    request = STANDARD.decode_request(bytes((0x2B, 0x0E, level, 0)))
    assert isinstance(request, MalformedRequest)
    assert request.code == 3
    with pytest.raises(InvalidRequest, match=f"level must be 1…4, not {level}"):
        ReadDeviceIdentification(level)


def test_a_device_without_objects_gives_none() -> None:
    reply = ask({}, EXTENDED)
    assert (reply.objects, reply.conformity, reply.more_follows) == ((), 0x81, 0)


def test_the_largest_object_fills_a_reply() -> None:
    assert len(ask({0: bytes(MAX_OBJECT_SIZE)}, INDIVIDUAL).encode()) == 253
    with pytest.raises(InvalidRequest, match="value must be at most 244 bytes"):
        IdentificationObject(0, bytes(MAX_OBJECT_SIZE + 1))
    with pytest.raises(InvalidRequest, match="number must be 0…255, not 256"):
        IdentificationObject(256, b"")


@pytest.mark.parametrize(
    ("pdu", "reason"),
    [
        ("2B 0E 01 01 00 00 02 00 01 41", "1 objects where 2 are announced"),
        ("2B 0E 01 01 00 00 00 00 01 41", "1 objects where 0 are announced"),
        ("2B 0E 01 01 00 00 01 00 02 41", "the object is cut off"),
        ("2B 0E 01 01 00 00 01 00", "the object is cut off"),
        ("2B 0E 01 01 01 00 00", "more follows must be one of 0, 255, not 1"),
        ("2B 0E 01 01 00 00", "6 bytes where this function has at least 7"),
    ],
)
def test_a_reply_that_contradicts_itself_is_malformed(pdu: str, reason: str) -> None:
    with pytest.raises(MalformedPdu, match=reason):
        Reply.decode(bytes.fromhex(pdu))


@pytest.mark.clause("S8")
def test_the_length_of_a_reply_follows_from_its_objects() -> None:
    wire = ask(EXTENDED_OBJECTS, EXTENDED).encode()
    told = [Reply.wire_length(wire, 0, size) for size in range(len(wire) + 1)]
    assert set(told[:-1]) <= {0, len(wire)}
    assert told[-1] == len(wire)


@pytest.mark.clause("A22")
def test_canopen_goes_through_as_it_is() -> None:
    model = RecordingModel()
    reply = CanopenGeneralReference(b"\x01\x02\x03").apply(model, FakeContext())
    assert reply.encode() == bytes.fromhex("2B 0D 03 02 01")
    assert model.calls == [("canopen", b"\x01\x02\x03")]
    assert len(CanopenGeneralReference(bytes(251)).encode()) == 253
    with pytest.raises(InvalidRequest, match="data must have 0…251 bytes, not 252"):
        CanopenGeneralReference(bytes(252))


def test_the_objects_of_the_specification_have_names() -> None:
    assert OBJECT_NAMES[0] == "VendorName"
    assert sorted(OBJECT_NAMES) == list(range(7))
