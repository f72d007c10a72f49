"""Our capture files, read by tshark."""

import json
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import foreign
import pytest

from busway.framing.ascii import encode_ascii
from busway.framing.received import Damage, Damaged, Direction, SerialFrame
from busway.framing.rtu import encode_rtu
from busway.observe.capture import Capture

REQUEST, REPLY = Direction.REQUEST, Direction.REPLY


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "capture.pcapng"


def tshark(file: Path, *fields: str, preferences: Sequence[str] = ()) -> list[list[str]]:
    """The values of these fields, packet by packet."""
    program = shutil.which("tshark")
    if program is None:
        foreign.missing("no tshark (Debian: tshark)")
    command = [program, "-n", "-r", str(file), "-T", "json"]
    for preference in preferences:
        command += ["-o", preference]
    for field in fields:
        command += ["-e", field]
    finished = subprocess.run(
        command, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=foreign.LIMIT, check=False
    )
    assert finished.returncode == 0, finished.stderr
    packets: list[dict[str, Any]] = json.loads(finished.stdout)
    return [[",".join(packet["_source"]["layers"].get(field, [])) for field in fields] for packet in packets]


def frame(unit: int, pdu: str, direction: Direction, encode: Any = encode_rtu) -> SerialFrame:
    data = bytes.fromhex(pdu)
    return SerialFrame(unit, data, encode(unit, data), direction, 0.0, 0.1)


@pytest.mark.parametrize("host", ["10.0.0.5", "fe80::2"])
def test_a_conversation_over_tcp_is_decoded_however_its_bytes_were_cut(file: Path, host: str) -> None:
    with Capture(file.open("wb")) as capture:
        stream = capture.stream((host, 40_000), (host, 502))
        stream.sent(bytes.fromhex("0001 0000 0006 ff 03 006b 0003"))
        stream.received(bytes.fromhex("0001 0000 0009 ff 03 06 022b"))
        stream.received(bytes.fromhex("0000 0064"))
    wanted = ["mbtcp.trans_id", "modbus.func_code", "modbus.regnum16", "modbus.regval_uint16"]
    assert tshark(file, *wanted) == [
        ["1", "3", "", ""],
        ["", "", "", ""],
        ["1", "3", "107,108,109", "555,0,100"],  # the numbers of the registers come from the request
    ]


def test_checksums_fit(file: Path) -> None:
    with Capture(file.open("wb")) as capture:
        capture.stream(("10.0.0.1", 40_000), ("10.0.0.5", 502)).sent(bytes.fromhex("0001 0000 0002 ff 07"))
        capture.datagram(("::1", 40_000), ("::1", 502), bytes.fromhex("0001 0000 0002 ff 07"), is_outgoing=True)
    check = ["ip.check_checksum:TRUE", "tcp.check_checksum:TRUE", "udp.check_checksum:TRUE"]
    states = tshark(file, "ip.checksum.status", "tcp.checksum.status", "udp.checksum.status", preferences=check)
    assert states == [["1", "1", ""], ["", "", "1"]]  # 1: good


def test_another_port_is_decoded_where_the_preference_says_so(file: Path) -> None:
    with Capture(file.open("wb")) as capture:
        capture.stream(("::1", 5020, 0, 0), ("::1", 40_000, 0, 0)).received(bytes.fromhex("0001 0000 0002 ff 07"))
    assert tshark(file, "modbus.func_code") == [[""]]
    assert tshark(file, "modbus.func_code", preferences=["mbtcp.tcp.port:502,5020"]) == [["7"]]


@pytest.mark.parametrize("encode", [encode_rtu, encode_ascii])
def test_frames_of_a_line_are_decoded_without_any_preference(file: Path, encode: Any) -> None:
    with Capture(file.open("wb")) as capture:
        line = capture.line("rtu:///dev/ttyS0")
        line.heard(frame(7, "03 006b 0003", REQUEST, encode))
        line.heard(frame(9, "03 0000 0001", REQUEST, encode))
        line.heard(frame(7, "03 06 022b 0000 0064", REPLY, encode))
        line.heard(frame(9, "83 02", REPLY, encode))
    wanted = ["ip.src", "mbrtu.unit_id", "modbus.func_code", "modbus.regnum16", "modbus.exception_code"]
    # The addresses are tags, not packets: tshark shows them in its columns only.
    assert [packet[1:] for packet in tshark(file, *wanted)] == [
        ["7", "3", "", ""],
        ["9", "3", "", ""],
        ["7", "3", "107,108,109", ""],
        ["9", "3", "", "2"],
    ]


def test_functions_that_echo_are_told_apart_by_the_preference(file: Path) -> None:
    with Capture(file.open("wb")) as capture:
        line = capture.line("rtu:///dev/ttyS0")
        line.heard(frame(7, "06 0001 0003", REQUEST))
        line.heard(frame(7, "06 0001 0003", REPLY))
    (asked,), (answered,) = tshark(file, "_ws.col.Info", preferences=["mbrtu.tcp.port:1"])
    assert asked.strip().startswith("Query: Unit:   7, Func:   6")
    assert answered.strip().startswith("Response: Unit:   7, Func:   6")


def test_the_crc_is_the_one_of_the_line(file: Path) -> None:
    with Capture(file.open("wb")) as capture:
        line = capture.line("rtu:///dev/ttyS0")
        line.heard(frame(7, "03 006b 0003", REQUEST))
    assert tshark(file, "mbrtu.crc16.status", preferences=["mbrtu.crc_verification:TRUE"]) == [["1"]]


def test_what_tshark_cannot_decode_has_our_words_as_comment(file: Path) -> None:
    with Capture(file.open("wb")) as capture:
        line = capture.line("rtu:///dev/ttyS0")
        line.heard(frame(7, "07", REQUEST))
        line.heard(frame(0, "06 0001 0003", REQUEST))
        line.heard(Damaged(b"\x01\x02\x03", Damage.CHECKSUM, 3, 0.0, 0.1))
    comments = [comment for (comment,) in tshark(file, "frame.comment")]
    assert comments[0] == "unit 7: 7 (read exception status), request"
    assert comments[1].startswith("unit 0: 6 (write single register), request: ")
    assert comments[2] == "3 damaged bytes: no frame whose check fits"
