"""Frames out of nowhere: framing and direction found out, conversations paired, broken frames explained."""

import json
import time
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from busway.framing.crc import crc_bytes
from busway.framing.lrc import lrc
from busway.framing.mbap import encode_mbap
from busway.observe.dissect import Dissection, Dissector, Framing, MessageDirection

REQUEST = bytes.fromhex("03 00 6B 00 03")
REPLY = bytes.fromhex("03 06 02 2B 00 00 00 64")


def rtu(unit: int, pdu: bytes) -> bytes:
    content = bytes((unit,)) + pdu
    return content + crc_bytes(content)


def ascii_frame(unit: int, pdu: bytes) -> bytes:
    content = bytes((unit,)) + pdu
    return b":" + (content + bytes((lrc(content),))).hex().upper().encode() + b"\r\n"


def one(data: bytes, dissector: Dissector | None = None) -> Dissection:
    (found,) = (dissector or Dissector()).dissect(data)
    return found


@pytest.mark.parametrize(
    ("data", "framing", "title"),
    [
        (
            encode_mbap(1, 255, REQUEST),
            Framing.MBAP,
            "MBAP, transaction 1, unit 255: 3 (read holding registers), request",
        ),
        (rtu(17, REQUEST), Framing.RTU, "RTU, unit 17: 3 (read holding registers), request"),
        (ascii_frame(17, REQUEST), Framing.ASCII, "ASCII, unit 17: 3 (read holding registers), request"),
        (REQUEST, Framing.PDU, "PDU: 3 (read holding registers), request"),
    ],
)
def test_the_framing_is_found_out(data: bytes, framing: Framing, title: str) -> None:
    found = one(data)
    assert (found.framing, found.title, found.problems) == (framing, title, ())


def test_offsets_count_from_the_first_byte_of_the_frame() -> None:
    parts = {part.name: part.offset for part in one(encode_mbap(1, 255, REQUEST)).parts}
    assert parts == {"transaction": 0, "protocol": 2, "length": 4, "unit": 6, "function": 7, "address": 8, "count": 10}


def test_offsets_in_an_ascii_frame_count_characters() -> None:
    parts = {part.name: part.offset for part in one(ascii_frame(17, REQUEST)).parts}
    assert parts == {"start": 0, "unit": 1, "function": 3, "address": 5, "count": 9, "LRC": 13, "end": 15}


@pytest.mark.parametrize(
    "wrap", [lambda pdu: encode_mbap(7, 1, pdu), lambda pdu: rtu(1, pdu), lambda pdu: ascii_frame(1, pdu), bytes]
)
def test_a_reply_is_paired_with_the_request_before_it(wrap: object) -> None:
    assert callable(wrap)
    dissector = Dissector()
    asked, answered = one(wrap(REQUEST), dissector), one(wrap(REPLY), dissector)
    assert (asked.direction, asked.answers) == (MessageDirection.REQUEST, False)
    assert (answered.direction, answered.answers) == (MessageDirection.REPLY, True)


def test_an_echo_is_a_reply_only_behind_its_request() -> None:
    dissector = Dissector()
    write = bytes.fromhex("06 00 01 00 03")
    assert one(write, dissector).direction is MessageDirection.EITHER
    assert one(write, dissector).answers
    assert one(write, dissector).direction is MessageDirection.EITHER


def test_an_exception_answers_its_request() -> None:
    dissector = Dissector()
    one(REQUEST, dissector)
    assert one(b"\x83\x02", dissector).answers


def test_a_reply_of_another_length_than_was_asked_is_said_not_to_answer() -> None:
    dissector = Dissector()
    one(REQUEST, dissector)
    found = one(bytes.fromhex("03 02 00 01"), dissector)
    assert not found.answers
    assert "does not answer the request before it" in found.problems[0]


def test_a_reply_of_another_transaction_is_said_not_to_answer() -> None:
    dissector = Dissector()
    one(encode_mbap(1, 1, REQUEST), dissector)
    (problem,) = one(encode_mbap(2, 1, REPLY), dissector).problems
    assert "transaction 2 where 1 was asked" in problem


def test_frames_that_follow_each_other_on_tcp_are_taken_apart() -> None:
    first, second = Dissector().dissect(encode_mbap(1, 1, REQUEST) + encode_mbap(2, 1, REQUEST))
    assert "transaction 1" in first.title
    assert "transaction 2" in second.title
    assert first.problems == second.problems == ()


@pytest.mark.parametrize(
    ("data", "framing", "problem"),
    [
        (rtu(1, REQUEST)[:-1] + b"\x00", Framing.RTU, "CRC: is 74 00 where 74 17 fits"),
        (ascii_frame(1, REQUEST).replace(b"8E\r", b"8F\r"), Framing.ASCII, "LRC: is 8F where 8E fits"),
        (bytes.fromhex("0001 0000 0009 01") + REQUEST, Framing.MBAP, "length: announces 9 bytes, and 6 follow"),
        (bytes.fromhex("0001 0000 0FFF 01") + REQUEST, Framing.MBAP, "length: length field 4095, where 2…254 can be"),
        (b":01030G", Framing.ASCII, "content: character 6 is 'G', no hexadecimal digit"),
        (b":010", Framing.ASCII, "content: 3 characters, which is no whole number of bytes"),
        (b":01", Framing.ASCII, "content: 1 byte where unit, function and LRC are 3"),
        (rtu(1, bytes.fromhex("03 00 00 00 00")), Framing.RTU, "count: 0 where 1…125 can be"),
    ],
)
def test_what_is_wrong_is_said(data: bytes, framing: Framing, problem: str) -> None:
    found = one(data)
    assert found.framing is framing
    assert problem in found.problems


def test_a_framing_and_a_direction_can_be_given() -> None:
    dissector = Dissector(framing=Framing.RTU, direction=MessageDirection.REPLY)
    found = one(REPLY, dissector)
    assert (found.framing, found.direction) == (Framing.RTU, MessageDirection.REPLY)
    assert any("CRC" in problem for problem in found.problems)


@pytest.mark.parametrize("framing", [None, *Framing])
@given(data=st.binary(max_size=300))
def test_whatever_the_bytes_are_nothing_raises(framing: Framing | None, data: bytes) -> None:
    for start in (b"", b":", b"\x00\x01\x00\x00\x00\x06"):
        found = Dissector(framing=framing).dissect(start + data)
        assert found
        if framing is not Framing.ASCII and not (start + data).startswith(b":"):
            assert b"".join(part.data for each in found for part in each.parts) == start + data


def vectors() -> list[dict[str, str]]:
    """The published frames."""
    file = Path(__file__).parents[1] / "vectors" / "vectors.json"
    found: list[dict[str, str]] = json.loads(file.read_text(encoding="utf-8"))
    return found


@pytest.mark.parametrize("vector", vectors(), ids=lambda vector: f"{vector['id']} {vector['name']}")
def test_framing_and_direction_of_every_published_frame_are_found_out(vector: dict[str, str]) -> None:
    text = vector["hex"]
    found = one(text.encode("ascii") if text.startswith(":") else bytes.fromhex(text))
    assert found.framing.value == vector["framing"].replace("tcp", "mbap")
    assert found.direction.value in (vector["direction"].replace("response", "reply"), "request or reply")
    assert found.problems == ()


def test_a_frame_behind_one_of_an_unknown_function_is_taken_apart() -> None:
    dissector = Dissector()
    assert one(bytes.fromhex("64 01 02"), dissector).title.startswith("PDU: 100 (0x64), request")
    assert one(bytes.fromhex("03 00 01"), dissector).problems
    assert one(bytes.fromhex("64 01 02"), dissector).direction is not MessageDirection.REQUEST


def test_an_unknown_function_may_be_answered_by_its_reply_or_an_exception() -> None:
    for reply in ("64 09 09 09", "E4 01"):
        dissector = Dissector()
        one(bytes.fromhex("64 01 02"), dissector)
        assert one(bytes.fromhex(reply), dissector).answers


@pytest.mark.parametrize("code", [0x64, 0x03, 0x2B, 0x14, 0xE4])
@pytest.mark.parametrize("framing", [None, *Framing])
def test_a_frame_longer_than_any_frame_is_explained(framing: Framing | None, code: int) -> None:
    assert one(bytes((code,)) * 5_000, Dissector(framing=framing)).problems


def test_a_stream_is_cut_by_its_headers_also_around_functions_that_are_unknown() -> None:
    frames = [encode_mbap(1, 1, REQUEST), encode_mbap(2, 1, b"\x64\x01\x02"), encode_mbap(3, 1, REQUEST)]
    found = Dissector().dissect(b"".join(frames))
    assert [each.parts[0].text for each in found] == ["1", "2", "3"]


def streams() -> list[object]:
    """Bytes of any size, of each sort that `busway decode` is given."""
    pair = encode_mbap(1, 1, REQUEST) + encode_mbap(1, 1, b"\x03\xc8" + bytes(200))
    unknown = encode_mbap(1, 1, b"\x64" * 50)
    sorts = {
        "mbap": pair,
        "mbap of unknown functions": unknown,
        "rtu": rtu(1, REQUEST),
        "one unknown function": b"\x64",
        "objects": bytes.fromhex("2B 0E 01 01 00 00 03 00 01 41"),
        "zeros": b"\x00",
        "ascii": b":01",
    }
    return [pytest.param(unit, id=name) for name, unit in sorts.items()]


def dissect_time(unit: bytes, size: int) -> float:
    """Processor seconds for ``size`` bytes: the least of two runs, for a machine may do something else."""
    data = (unit * (size // len(unit) + 1))[:size]
    took = []
    for _ in range(2):
        began = time.process_time()
        for _ in Dissector().dissections(data):
            pass
        took.append(time.process_time() - began)
    return min(took)


@pytest.mark.real_time
@pytest.mark.parametrize("unit", streams())
def test_four_times_the_bytes_take_less_than_eight_times_the_time(unit: bytes) -> None:
    dissect_time(unit, 4_096)
    assert dissect_time(unit, 262_144) < 8 * dissect_time(unit, 65_536) + 0.01
