"""`busway decode`: frames explained on stdout, and what is no frame refused by name."""

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest


def test_a_frame_is_explained_field_by_field(run: Callable[..., Any]) -> None:
    result = run("decode", "000100000006ff03006b0003")
    assert result.code == 0
    assert result.out.splitlines() == [
        "MBAP, transaction 1, unit 255: 3 (read holding registers), request",
        "    0  00 01  transaction  1",
        "    2  00 00  protocol     0",
        "    4  00 06  length       6",
        "    6  ff     unit         255",
        "    7  03     function     3 (read holding registers)",
        "    8  00 6b  address      107, holding register 4x108",
        "   10  00 03  count        3",
    ]


@pytest.mark.parametrize(
    "arguments",
    [
        ["0103006b00037417"],
        ["01 03 00 6B 00 03 74 17"],
        ["01", "03", "00", "6b", "00", "03", "74", "17"],
        ["0x01,", "0x03,", "0x00,", "0x6b,", "0x00,", "0x03,", "0x74,", "0x17"],
        ["01:03:00:6b:00:03:74:17"],
        [r"\x01\x03\x00\x6b\x00\x03\x74\x17"],
        ["[01-03-00-6B-00-03-74-17]"],
    ],
)
def test_bytes_are_taken_however_they_are_written(run: Callable[..., Any], arguments: list[str]) -> None:
    result = run("decode", *arguments)
    assert result.code == 0
    assert result.out.startswith("RTU, unit 1: 3 (read holding registers), request\n")


def test_frames_that_follow_each_other_are_paired(run: Callable[..., Any]) -> None:
    result = run("decode", "03006b0003", "0306022b00000064")
    blocks = result.out.split("\n\n")
    assert blocks[0].startswith("PDU: 3 (read holding registers), request\n")
    assert blocks[1].startswith("PDU: 3 (read holding registers), reply, answers the request before it\n")


@pytest.mark.parametrize("frame", [":0103006B00038E", ":0103006B00038E\\r\\n", ":0103006b00038e"])
def test_an_ascii_frame_begins_with_its_colon(run: Callable[..., Any], frame: str) -> None:
    result = run("decode", frame)
    assert result.code == 0
    assert result.out.startswith("ASCII, unit 1: 3 (read holding registers), request\n")


def test_a_frame_that_is_wrong_is_explained_and_ends_as_6(run: Callable[..., Any]) -> None:
    result = run("decode", "0103006b00037418")
    assert result.code == 6
    assert "CRC       ! is 74 18 where 74 17 fits" in result.out
    assert "107, holding register 4x108" in result.out


def test_long_data_goes_on_in_further_lines(run: Callable[..., Any]) -> None:
    result = run("decode", "0328" + "0001" * 20)
    assert [line.split()[0] for line in result.out.splitlines()[1:]] == ["0", "1", "2", "18", "34"]


def test_json_has_the_same(run: Callable[..., Any]) -> None:
    fields = json.loads(run("decode", "8302", "--json").out)
    assert (fields["framing"], fields["direction"], fields["problems"]) == ("pdu", "reply", [])
    assert fields["fields"][1]["bytes"] == "02"


def test_a_log_comes_from_standard_input(run: Callable[..., Any]) -> None:
    result = run("decode", "-", stdin="03 00 6b 00 03\n\n8302\n")
    assert result.code == 0
    assert len(result.out.split("\n\n")) == 2


def test_framing_and_direction_can_be_given(run: Callable[..., Any]) -> None:
    assert run("decode", "050001ff00", "--direction", "reply").out.startswith("PDU: 5 (write single coil), reply\n")
    assert run("decode", "03006b0003", "--framing", "rtu").code == 6


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["03zz"], ["03zz", "'z'"]),
        (["030"], ["030", "3 hexadecimal digits"]),
        ([""], ["no bytes"]),
        (["03", "--framing", "tcp"], ["--framing", "mbap", "'tcp'"]),
        (["03", "--direction", "up"], ["--direction", "'up'"]),
        ([], ["HEX"]),
    ],
)
def test_what_is_no_frame_is_refused_by_name(run: Callable[..., Any], arguments: list[str], words: list[str]) -> None:
    result = run("decode", *arguments)
    assert result.code == 2
    assert result.out == ""
    assert len(result.err.splitlines()) == 1
    for word in words:
        assert word in result.err


@pytest.mark.parametrize(
    "arguments",
    [
        ["0103", "006b", "0003", "7417"],
        ["0x0103", "0x006B", "0x0003", "0x7417"],
        ["0103,", "006b,", "0003,", "7417"],
        ["01", "03", "006b", "0003", "7417"],
    ],
)
def test_16_bit_groups_that_the_shell_has_split_are_one_frame(run: Callable[..., Any], arguments: list[str]) -> None:
    result = run("decode", *arguments)
    assert result.code == 0
    assert result.out.startswith("RTU, unit 1: 3 (read holding registers), request\n")


def test_groups_that_are_no_whole_bytes_are_not_joined_to_other_bytes(run: Callable[..., Any]) -> None:
    result = run("decode", "1", "3", "0", "6b")
    assert (result.code, result.out) == (2, "")


def test_a_frame_behind_an_unknown_function_is_explained(run: Callable[..., Any]) -> None:
    result = run("decode", "640102", "030001")
    assert result.code == 6
    assert result.out.startswith("PDU: 100 (0x64), request")
    assert "2 of 2 bytes are missing" in result.out


@pytest.mark.real_time
@pytest.mark.parametrize("frame", ["0001000000cb0103c8" + "00" * 200, "64"])
def test_a_megabyte_is_explained_in_seconds(run: Callable[..., Any], frame: str) -> None:
    began = time.process_time()
    result = run("decode", "-", "--json", stdin=frame * (1_000_000 // (len(frame) // 2)) + "\n")
    assert result.code in (0, 6)
    assert time.process_time() - began < 30  # it takes one on a machine of today


def test_file_that_is_not_there_is_said_with_what_else_is_taken(run: Callable[..., Any]) -> None:
    result = run("decode", "nofile")
    assert result.code == 2
    assert "nofile: there is no file of that name, and 'n' is no hexadecimal digit; what goes here: " in result.err


def test_empty_file_is_said_to_be_empty(run: Callable[..., Any], tmp_path: Path) -> None:
    empty = tmp_path / "empty.log"
    empty.touch()
    result = run("decode", str(empty))
    assert result.code == 2
    assert "the file is empty" in result.err
