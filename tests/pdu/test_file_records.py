"""Functions 20 and 21: groups, limits of lengths and counts, all groups or none."""

import pytest
from recording_device import FakeContext, RecordingModel

from busway.errors import InvalidRequest
from busway.pdu.device_interface import Refusal
from busway.pdu.file_records import FileContent, FileData, FileReference, ReadFileRecord, WriteFileRecord
from busway.pdu.functions import STANDARD
from busway.pdu.malformed_pdu import MalformedPdu
from busway.pdu.malformed_request import MalformedRequest


def model_with_files() -> RecordingModel:
    model = RecordingModel()
    model.files = {(4, 1): b"\x0d\xfe", (4, 2): b"\x00\x20", (3, 9): b"\x33\xcd", (3, 10): b"\x00\x40"}
    return model


@pytest.mark.clause("A15")
def test_several_groups_are_read_in_their_order() -> None:
    request = ReadFileRecord((FileReference(4, 1, 2), FileReference(3, 9, 2)))
    reply = request.apply(model_with_files(), FakeContext())
    assert reply.encode() == bytes.fromhex("14 0C 05 06 0DFE 0020 05 06 33CD 0040")
    assert isinstance(reply, ReadFileRecord.Reply)
    assert [one.registers for one in reply.contents] == [[0x0DFE, 0x0020], [0x33CD, 0x0040]]


@pytest.mark.clause("A15")
def test_a_request_has_1_to_35_groups_and_a_byte_count_of_07_to_f5() -> None:
    least, most = ReadFileRecord((FileReference(1, 0, 1),)), ReadFileRecord((FileReference(1, 0, 1),) * 35)
    assert least.encode()[1] == 0x07
    assert most.encode()[1] == 0xF5
    assert STANDARD.decode_request(most.encode()) == most
    with pytest.raises(InvalidRequest, match="groups must have 1…35 items, not 36"):
        ReadFileRecord((FileReference(1, 0, 1),) * 36)


@pytest.mark.clause("A15")
@pytest.mark.parametrize(
    "pdu",
    [
        "14 00",
        "14 06 06 0001 0000 00",  # a group cut off
        "14 08 06 0001 0000 0001 06",  # one and a bit
        "14 07 06 0001 0000 00",  # announced, not there
        "14 07 06 0001 0000 0001 00",  # a byte behind
        "14 FC" + "06 0001 0000 0001" * 36,  # 36 groups
    ],
)
def test_a_byte_count_that_does_not_fit_is_03(pdu: str) -> None:
    request = STANDARD.decode_request(bytes.fromhex(pdu))
    assert isinstance(request, MalformedRequest)
    assert request.code == 3


@pytest.mark.clause("A7")
@pytest.mark.parametrize(
    "pdu",
    [
        "14 07 05 0001 0000 0001",
        "14 0E 06 0001 0000 0001 07 0001 0000 0001",
        "15 09 05 0001 0000 0001 1234",
    ],
)
def test_a_wrong_reference_type_is_02_after_the_lengths_were_right(pdu: str) -> None:
    # figures of §6.14 and §6.15: byte count → 03, then reference type, file and record → 02
    request = STANDARD.decode_request(bytes.fromhex(pdu))
    assert isinstance(request, MalformedRequest)
    assert request.code == 2
    assert "where 6 is required" in request.reason


@pytest.mark.clause("A15")
def test_what_would_not_fit_one_reply_cannot_be_asked_for() -> None:
    # 2 + (2 + 2n) bytes: n = 124 gives 252
    assert ReadFileRecord((FileReference(1, 0, 124),)).reply_length() == 252
    with pytest.raises(InvalidRequest, match="the reply would have 254 bytes; at most 253 fit"):
        ReadFileRecord((FileReference(1, 0, 125),))
    with pytest.raises(InvalidRequest, match="the reply would have"):
        ReadFileRecord((FileReference(1, 0, 60), FileReference(1, 0, 64)))
    request = STANDARD.decode_request(bytes.fromhex("14 07 06 0001 0000 007D"))
    assert isinstance(request, MalformedRequest)
    assert request.code == 3


@pytest.mark.clause("A15")
@pytest.mark.parametrize(
    ("file", "record", "sentence"),
    [
        (0, 0, "file must be 1…65535, not 0"),
        (1, 10_000, "record must be 0…9999, not 10000"),
        (65_536, 0, "file must be .…65535, not 65536"),
        (1, -1, r"record must be 0…\d+, not -1"),
    ],
)
def test_a_record_that_cannot_be_is_refused_before_it_is_sent(file: int, record: int, sentence: str) -> None:
    with pytest.raises(InvalidRequest, match=sentence):
        ReadFileRecord.of([FileReference(file, record, 1)])
    with pytest.raises(InvalidRequest, match=sentence):
        WriteFileRecord.of(file, record, [1])


def test_a_group_that_does_not_fit_its_bytes_cannot_be_built() -> None:
    with pytest.raises(InvalidRequest, match="count must be 0…65535, not 70000"):
        FileReference(1, 1, 70_000)
    with pytest.raises(InvalidRequest, match="data must be bytes, two for each register"):
        FileData(1, 1, b"\x00")
    with pytest.raises(InvalidRequest, match="data must be bytes, two for each register"):
        FileContent(5)  # type: ignore[arg-type]
    with pytest.raises(InvalidRequest, match="data must have at most 254 bytes, not 256"):
        FileContent(bytes(256))


@pytest.mark.clause("A15")
@pytest.mark.parametrize("pdu", ["14 07 06 0000 0000 0001", "14 07 06 0001 2710 0001", "14 07 06 0009 0000 0001"])
def test_a_file_or_record_that_does_not_exist_is_02(pdu: str) -> None:
    request = ReadFileRecord.decode(bytes.fromhex(pdu))
    with pytest.raises(Refusal) as caught:
        request.apply(model_with_files(), FakeContext())
    assert caught.value.code == 2


@pytest.mark.clause("A15")
def test_a_damaged_file_area_is_08() -> None:
    model = model_with_files()
    model.refuse["read_file"] = Refusal(8)
    with pytest.raises(Refusal) as caught:
        ReadFileRecord((FileReference(4, 1, 1),)).apply(model, FakeContext())
    assert caught.value.code == 8


@pytest.mark.clause("A16")
def test_a_write_comes_back_whole() -> None:
    model = model_with_files()
    request = WriteFileRecord((FileData(4, 1, b"\x11\x11\x22\x22"), FileData(3, 9, b"\x33\x33")))
    assert request.apply(model, FakeContext()).encode() == request.encode()
    assert model.files == {(4, 1): b"\x11\x11", (4, 2): b"\x22\x22", (3, 9): b"\x33\x33", (3, 10): b"\x00\x40"}


@pytest.mark.clause("A16")
@pytest.mark.parametrize(
    "bad",
    [
        FileData(9, 0, b"\x01\x01"),
        FileData(4, 2, b"\x01\x01\x02\x02"),
        FileData(0, 1, b"\x01\x01"),
        FileData(4, 10_000, b"\x01\x01"),
    ],
)
def test_all_groups_are_looked_at_before_any_is_written(bad: FileData) -> None:
    model = model_with_files()
    before = dict(model.files)
    with pytest.raises(Refusal) as caught:
        WriteFileRecord((FileData(4, 1, b"\xaa\xaa"), bad)).apply(model, FakeContext())
    assert caught.value.code == 2
    assert model.files == before
    assert all(call[-1] is True for call in model.calls)  # dry


@pytest.mark.clause("A16")
def test_a_write_has_a_byte_count_of_09_to_fb() -> None:
    assert WriteFileRecord.of(1, 0, [7]).encode()[1] == 0x09
    assert WriteFileRecord.of(1, 0, [7] * 122).encode()[1] == 0xFB
    with pytest.raises(InvalidRequest, match="the PDU would have 255 bytes; at most 253 fit"):
        WriteFileRecord.of(1, 0, [7] * 123)


@pytest.mark.clause("A16")
@pytest.mark.parametrize(
    "pdu",
    [
        "15 07 06 0001 0000 0000",  # below 09: a group without data
        "15 09 06 0001 0000 0002 1234",  # two registers announced, one there
        "15 0B 06 0001 0000 0001 1234 5678",  # one announced, two there
        "15 08 06 0001 0000 0001 12",
        "15 FC" + "06 0001 0000 0001 1234" * 28,
    ],
)
def test_a_write_whose_lengths_do_not_fit_is_03(pdu: str) -> None:
    request = STANDARD.decode_request(bytes.fromhex(pdu))
    assert isinstance(request, MalformedRequest)
    assert request.code == 3


@pytest.mark.parametrize(
    "pdu",
    [
        "14 04 04 06 0001",  # an even length: half a register
        "14 04 03 05 0001",  # another reference type
        "14 04 05 06 0001",  # longer than what follows
        "14 02 00 00",  # no reference type
    ],
)
def test_a_read_reply_with_a_broken_group_is_malformed(pdu: str) -> None:
    with pytest.raises(MalformedPdu):
        ReadFileRecord.Reply.decode(bytes.fromhex(pdu))


def test_groups_show_their_registers() -> None:
    assert FileData(1, 2, b"\x00\x01\x00\x02").registers == [1, 2]
    assert FileData(1, 2, b"\x00\x01\x00\x02").count == 2


@pytest.mark.clause("A15")
def test_a_request_without_registers_cannot_be_asked_for() -> None:
    with pytest.raises(InvalidRequest, match="values must have at least one register, not 0"):
        WriteFileRecord.of(1, 0, [])
    with pytest.raises(InvalidRequest, match="byte count must be 9…251, not 7"):
        WriteFileRecord((FileData(1, 0, b""),))
    with pytest.raises(InvalidRequest, match="count must be at least 1, not 0"):
        ReadFileRecord.of([FileReference(1, 0, 1), FileReference(1, 0, 0)])
    of_two = WriteFileRecord((FileData(1, 0, b""), FileData(1, 0, b"\x00\x01")))
    assert STANDARD.decode_request(of_two.encode()) == of_two
