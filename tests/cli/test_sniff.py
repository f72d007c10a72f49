"""``busway sniff`` on a paced line: a process that listens, stopped by signals."""

import json
import signal
import socket
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from capture_file import blocks
from program import Busway
from whole_frames import line_of_whole_frames

import busway
from busway.framing.rtu import encode_rtu
from busway.testing.line import PacedLine
from busway.transport.serial import BlockingSerialPort


@pytest.fixture
def line() -> Iterator[PacedLine]:
    with line_of_whole_frames(ports=2, baud=19_200) as line:
        yield line


@pytest.fixture
def talker(line: PacedLine) -> Iterator[Callable[..., None]]:
    """Puts frames on the line, one after the other, with silences between them."""
    with BlockingSerialPort(line.paths[0], line.settings) as port:

        def talk(*frames: str) -> None:
            for frame in frames:
                data = bytes.fromhex(frame)
                port.write(encode_rtu(data[0], data[1:]))
                port.drain()
                line.wait_quiet(0.02)

        yield talk


def url(line: PacedLine) -> str:
    return f"rtu://{line.paths[1]}?baud=19200"


@pytest.mark.alone
def test_a_conversation_is_explained_and_summed_up(line: PacedLine, talker: Callable[..., None]) -> None:
    with Busway("sniff", url(line)) as busway:
        busway.wait_for("listening to rtu://")
        talker("01 03 006b 0001", "01 03 02 022b", "00 06 0001 0003", "02 03 0000 0001", "01 01 0000 0003", "01 81 02")
        line.inject(b"\x01\x03\xff")
        line.wait_quiet(0.2)
        out, err = busway.stop()
    assert busway.process.returncode == 0, err
    lines = out.splitlines()
    assert "unit 1: 3 (read holding registers), request: address 107, holding register 4x108; count 1" in lines[0]
    assert "unit 1: 3 (read holding registers), reply: byte count 2; data 555 (after " in lines[1]
    assert "all units: 6 (write single register), request" in lines[2]
    assert "unit 2: 3 (read holding registers), request" in lines[3]
    assert "! unit 2: 3 (read holding registers), request was not answered within" in lines[4]
    assert "unit 1: 1 (read coils), exception: exception code 02" in lines[6]
    assert "! 3 damaged bytes" in lines[7]
    assert lines[7].endswith("01 03 ff")
    assert "6 frames in " in out
    assert "the line was busy" in out
    heading, first, second = (each.split() for each in lines[-3:])
    assert heading[:4] == ["unit", "requests", "replies", "exceptions"]
    assert first[:5] == ["1", "2", "2", "1", "0"]
    assert second[:5] == ["2", "1", "0", "0", "1"]
    assert {byte.port for byte in line.tap} <= {0, -1}  # the listener has sent nothing


@pytest.mark.alone
def test_a_master_and_a_server_of_ours_are_heard_by_a_third_port(run: Callable[..., Any]) -> None:
    device = busway.Device(holding_registers=10)
    with (
        line_of_whole_frames(ports=3, baud=19_200) as line,
        busway.serve_in_thread(f"rtu://{line.paths[0]}?baud=19200", units={1: device}),
        Busway("sniff", url(line), "--json") as listener,
    ):
        listener.wait_for("listening")
        with busway.connect(f"rtu://{line.paths[2]}?baud=19200", timeout=0.3, retries=0) as link:
            link.unit(1).write_single_register(2, 7)
            assert link.unit(1).read_holding_registers(0, count=10)[2] == 7
            with pytest.raises(busway.NoReply):
                link.unit(9).read_coils(0, count=1)
            with pytest.raises(busway.ExceptionReply):
                link.unit(1).read_coils(0, count=1)
        line.wait_quiet(0.05)
        out, _ = listener.stop()
    *events, statistics = map(json.loads, out.splitlines())
    assert [event["kind"] for event in events] == [
        *("request", "reply") * 2,
        *("request", "no reply"),
        *("request", "reply"),
    ]
    assert statistics["units"]["1"]["replies"] == statistics["units"]["1"]["requests"] == 3
    assert statistics["units"]["9"]["unanswered"] == 1
    assert not statistics["damaged"]


@pytest.mark.alone
def test_json_has_every_field_and_the_statistics_last(line: PacedLine, talker: Callable[..., None]) -> None:
    with Busway("sniff", url(line), "--json") as busway:
        busway.wait_for("listening")
        talker("01 03 006b 0001", "01 03 02 022b")
        out, _ = busway.stop(signal.SIGTERM)
    assert busway.process.returncode == 0
    asked, answered, statistics = (json.loads(each) for each in out.splitlines())
    assert (asked["kind"], asked["unit"], asked["function"]) == ("request", 1, 3)
    assert asked["gap"] is None
    fields: list[dict[str, Any]] = answered["fields"]
    assert {field["name"]: field["value"] for field in fields}["data"] == "555"
    assert 0 <= answered["response_time"] < 5
    assert answered["raw"] == encode_rtu(1, bytes.fromhex("03 02 022b")).hex()
    assert statistics["kind"] == "statistics"
    assert statistics["units"]["1"]["replies"] == 1
    assert statistics["units"]["1"]["response_time"]["mean"] == answered["response_time"]


@pytest.mark.alone
def test_what_was_heard_is_captured(line: PacedLine, talker: Callable[..., None], tmp_path: Path) -> None:
    file = tmp_path / "line.pcapng"
    with Busway("sniff", url(line), "--capture", str(file), "-x") as busway:
        busway.wait_for("listening")
        talker("01 03 006b 0001", "01 03 02 022b")
        out, _ = busway.stop()
    assert "01 03 00 6b 00 01" in out
    packets = [body for kind, body in blocks(file.read_bytes()) if kind == 6]
    assert [
        encode_rtu(1, bytes.fromhex(pdu)) in packet
        for pdu, packet in zip(("03006b0001", "0302022b"), packets, strict=True)
    ] == [True, True]


@pytest.mark.alone
def test_listening_ends_with_its_duration(run: Callable[..., Any], line: PacedLine) -> None:
    result = run("sniff", url(line), "--for", "50ms")
    assert result.code == 0
    assert "0 frames in 0.1 s, the line was busy 0.0 %" in result.out


@pytest.mark.alone
def test_a_port_that_vanishes_is_waited_for_and_heard_again(line: PacedLine, talker: Callable[..., None]) -> None:
    with Busway("sniff", url(line) + "&reopen_first=0.01&reopen_most=0.05") as busway:
        busway.wait_for("listening")
        talker("01 03 006b 0001", "01 03 02 022b")
        line.unplug(1)
        busway.wait_for("waiting for it")
        line.replug(1)
        busway.wait_for("it is back")
        talker("01 03 006b 0001", "01 03 02 022b")
        out, _ = busway.stop()
    assert busway.process.returncode == 0
    assert "4 frames in " in out


@pytest.mark.alone
def test_the_statistics_come_also_where_the_port_is_still_gone_at_the_end(
    line: PacedLine, talker: Callable[..., None]
) -> None:
    with Busway("sniff", url(line)) as busway:
        busway.wait_for("listening")
        talker("01 03 006b 0001", "01 03 02 022b")
        line.unplug(1)
        busway.wait_for("waiting for it")
        out, err = busway.stop()
    assert busway.process.returncode == 5
    assert "2 frames in " in out
    assert not err


def test_the_statistics_come_also_when_a_connection_ends() -> None:
    with (
        socket.create_server(("127.0.0.1", 0)) as listener,
        Busway("sniff", f"rtu+tcp://127.0.0.1:{listener.getsockname()[1]}") as busway,
    ):
        peer, _ = listener.accept()
        with peer:
            busway.wait_for("listening")
            peer.sendall(encode_rtu(1, bytes.fromhex("03 006b 0001")))
        out, err = busway.end()
    assert busway.process.returncode == 5
    assert "1 frame in " in out
    assert len(err.strip().splitlines()) == 1


@pytest.mark.parametrize(
    ("arguments", "code", "complaint"),
    [
        (["tcp://127.0.0.1"], 2, "only a line can be listened to"),
        (["rtu:///dev/there-is-none"], 5, "there-is-none"),
        (["rtu:///dev/null", "--for", "soon"], 2, "--for"),
        (["rtu:///dev/null", "--reply-window", "0"], 2, "--reply-window"),
        (["rtu:///dev/null", "--capture", "/there/is/no/such/folder"], 2, "cannot be opened"),
    ],
)
def test_what_cannot_be_is_one_clear_sentence(
    run: Callable[..., Any], arguments: list[str], code: int, complaint: str
) -> None:
    result = run("sniff", *arguments)
    assert result.code == code
    assert complaint in result.err
    assert len(result.err.strip().splitlines()) == 1
    assert not result.out
