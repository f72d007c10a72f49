"""`busway decode CAPTURE`: the frames of a capture file explained, and captures that cannot be read."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from captured import Talk, pcap

from busway.framing.rtu import encode_rtu

ASKED = "0001 0000 0006 01 03 006b 0001"
ANSWERED = "0001 0000 0005 01 03 02 022b"


@pytest.fixture
def talk() -> Talk:
    talk = Talk()
    talk.asks(ASKED)
    talk.asks("0002" + ASKED[4:])
    talk.answers("0002" + ANSWERED[4:])
    talk.answers(ANSWERED)
    return talk


def written(tmp_path: Path, data: bytes, name: str = "site.pcap") -> str:
    path = tmp_path / name
    path.write_bytes(data)
    return str(path)


def test_each_frame_is_explained_below_its_packet_time_and_addresses(
    run: Callable[..., Any], tmp_path: Path, talk: Talk
) -> None:
    result = run("decode", written(tmp_path, pcap(talk.packets)))
    assert result.code == 0
    parts = [part.splitlines() for part in result.out.split("\n\n")]
    assert [part[0] for part in parts] == [
        "packet 3, 1970-01-01 00:16:40.010000, 10.0.0.9:40000 → 10.0.0.5:502",
        "packet 4, 1970-01-01 00:16:40.020000, 10.0.0.9:40000 → 10.0.0.5:502",
        "packet 5, 1970-01-01 00:16:40.030000, 10.0.0.5:502 → 10.0.0.9:40000",
        "packet 6, 1970-01-01 00:16:40.040000, 10.0.0.5:502 → 10.0.0.9:40000",
    ]
    reply = "3 (read holding registers), reply, answers the request before it"
    assert parts[2][1] == f"MBAP, transaction 2, unit 1: {reply}"
    assert parts[3][-1] == "    9  02 2b  data         555"


def test_json_has_packet_time_and_addresses(run: Callable[..., Any], tmp_path: Path, talk: Talk) -> None:
    result = run("decode", written(tmp_path, pcap(talk.packets), "dump"), "--json")  # found by its first bytes
    first = json.loads(result.out.splitlines()[0])
    assert {key: first[key] for key in ("packet", "time", "from", "to", "direction")} == {
        "packet": 3,
        "time": 1000.01,
        "from": "10.0.0.9:40000",
        "to": "10.0.0.5:502",
        "direction": "request",
    }


def test_what_is_missing_is_said_in_its_place(run: Callable[..., Any], tmp_path: Path, talk: Talk) -> None:
    del talk.packets[2]
    result = run("decode", written(tmp_path, pcap(talk.packets)))
    assert result.code == 6
    assert result.out.splitlines()[0].endswith(": 12 bytes are missing in the capture")


def test_a_wrong_crc_of_a_line_is_explained(run: Callable[..., Any], tmp_path: Path) -> None:
    frame = encode_rtu(7, bytes.fromhex("03 006b 0001"))
    result = run("decode", written(tmp_path, pcap([(0, frame[:-1] + b"\0")], link=147)))
    assert result.code == 6
    assert result.out.splitlines()[0] == (
        "packet 1, 1970-01-01 00:00:00.000000, line 0: 8 damaged bytes: no frame whose check fits"
    )
    assert "! is" in result.out


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["missing.pcap"], "cannot be opened: no such file"),
        (["site.pcap", "--port", "70000"], "--port: a whole number 1…65535"),
        (["site.pcap", "--framing", "pdu"], "--framing: one of mbap, rtu, ascii"),
        (["site.pcap", "--direction", "reply"], "--direction: is for frames without addresses"),
        (["0103", "--port", "502"], "--port: goes with a capture file only"),
        (["site.pcap", "--port", "99"], "no Modbus on these ports, but 4 frames of port 502: --port 502"),
        (["none.pcap"], "no Modbus in 1 packet: 1 link type 127"),
        (["cut.pcap"], "the file ends inside a record at offset 24; 0 packets were read"),
        (["broken.pcap"], "the capture is broken at offset 24: a packet of 4294967295 bytes"),
        (["text.pcap"], "is no pcap and no pcapng"),
    ],
)
def test_what_cannot_be_read_is_one_sentence(
    run: Callable[..., Any],
    tmp_path: Path,
    talk: Talk,
    monkeypatch: pytest.MonkeyPatch,
    arguments: list[str],
    sentence: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    written(tmp_path, pcap(talk.packets))
    written(tmp_path, pcap([(0, b"x")], link=127), "none.pcap")
    written(tmp_path, pcap(talk.packets)[:50], "cut.pcap")
    written(tmp_path, pcap([]) + b"\xff" * 16, "broken.pcap")
    written(tmp_path, b"no capture", "text.pcap")
    result = run("decode", *arguments)
    assert sentence in result.err
    assert result.code in (0, 2)
