"""`busway replay`: conversations of a capture file on stdout, and captures that cannot be read."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from captured import Talk, pcap

import busway
from busway.framing.received import Direction, SerialFrame
from busway.framing.rtu import encode_rtu
from busway.observe.capture import Capture
from busway.testing import simulated_device


@pytest.fixture
def talk() -> Talk:
    talk = Talk()
    talk.asks("0001 0000 0006 01 03 006b 0001")
    talk.answers("0001 0000 0005 01 03 02 022b", after=0.002)
    talk.asks("0002 0000 0006 01 06 0001 0002")
    talk.answers("0002 0000 0006 01 06 0001 0002", after=1.5)
    talk.asks("0003 0000 0006 01 03 0000 0002")
    talk.answers("0003 0000 0003 01 83 02")
    talk.asks("0004 0000 0006 02 04 0000 0001")
    talk.asks("0005 0000 0006 01 03 006c 0001", after=9.0)
    return talk


def written(tmp_path: Path, data: bytes) -> str:
    path = tmp_path / "site.pcap"
    path.write_bytes(data)
    return str(path)


def test_conversations_are_shown_with_counts_items_times_and_what_was_wrong(
    run: Callable[..., Any], tmp_path: Path, talk: Talk
) -> None:
    result = run("replay", written(tmp_path, pcap(talk.packets)))
    assert result.code == 0
    assert result.out.splitlines() == [
        "10.0.0.9 → 10.0.0.5:502, unit 1",
        "  1970-01-01 00:16:40.010000 UTC, 10.5 s",
        "  4 requests, 3 replies, 1 exception, 1 without a reply yet when the capture ended",
        "         3 × 3 (read holding registers): 4x1-4x2, 4x108-4x109",
        "         1 × 6 (write single register): 4x2",
        "  replies after 2.0 ms to 1.5 s (packet 6), 504.0 ms on average",
        "  ! 1 × slow reply: packet 6: after 1.500 s",
        "  ! 1 × exception: packet 8: 02, illegal data address: an item in the range does not exist or may not be"
        " written, to 3 (read holding registers), 2 from 4x1 on",
        "",
        "10.0.0.9 → 10.0.0.5:502, unit 2",
        "  1970-01-01 00:16:41.552000 UTC, 0.0 ms",
        "  1 request, 0 replies",
        "         1 × 4 (read input registers): 3x1",
        "  ! 1 × no reply: packet 9: to 4 (read input registers), 1 from 3x1 on",
    ]
    assert result.err == "busway: 2 conversations in 10 packets\n"


def test_json_has_one_object_for_each_conversation_and_a_summary(
    run: Callable[..., Any], tmp_path: Path, talk: Talk
) -> None:
    first, second, summary = map(
        json.loads, run("replay", written(tmp_path, pcap(talk.packets)), "--json", "--slow", "2s").out.splitlines()
    )
    assert first["requests"] == {"3": 3, "6": 1}
    assert first["exceptions"] == [{"function": 3, "exception": 2, "count": 1}]
    assert first["items"]["6"] == [{"table": "holding_registers", "first": 1, "count": 1}]
    assert [each["trouble"] for each in first["troubles"]] == ["exception"]
    assert second["troubles"][0]["packet"] == 9
    assert (summary["kind"], summary["packets"], summary["truncated_at"]) == ("summary", 10, None)


def line_capture(folder: Path) -> str:
    """A capture of a serial line that busway wrote: unit 7 is asked twice for one register."""
    path = folder / "line.pcapng"
    times = iter((100.0, 100.1, 101.0, 101.1))
    with Capture(path.open("wb")) as capture:
        line = capture.line("rtu:///dev/ttyS0")
        for _ in range(2):
            for pdu, direction in (("03 006b 0001", Direction.REQUEST), ("03 02 0005", Direction.REPLY)):
                data = bytes.fromhex(pdu)
                frame = SerialFrame(7, data, encode_rtu(7, data), direction, 0.0, 0.0)
                line.heard(frame, at=next(times))
    return str(path)


def test_a_capture_of_a_line_that_busway_wrote_is_read(run: Callable[..., Any], tmp_path: Path) -> None:
    result = run("replay", line_capture(tmp_path))
    assert result.out.splitlines()[0] == "rtu:///dev/ttyS0, unit 7"
    assert "  2 requests, 2 replies" in result.out


def test_a_capture_of_a_line_becomes_a_simulator_that_answers_as_its_unit_did(
    run: Callable[..., Any], tmp_path: Path
) -> None:
    plant = tmp_path / "plant.toml"
    assert run("replay", line_capture(tmp_path), "--simulate", str(plant)).code == 0
    with simulated_device(plant) as device, busway.connect(device.endpoints[0]) as link:
        assert link.unit(7).read_holding_registers(0x6B, count=1) == [5]
        with pytest.raises(busway.ExceptionReply) as refusal:
            link.unit(7).read_holding_registers(0x6C, count=1)
        assert refusal.value.code == 2


def test_what_stands_before_a_broken_place_is_shown_with_the_error(
    run: Callable[..., Any], tmp_path: Path, talk: Talk
) -> None:
    result = run("replay", written(tmp_path, pcap(talk.packets[:4]) + b"\xff" * 16))
    assert result.code == 2
    assert "1 request, 1 reply" in result.out
    assert "the capture is broken at offset" in result.err


def test_a_truncated_file_says_how_much_was_read(run: Callable[..., Any], tmp_path: Path, talk: Talk) -> None:
    result = run("replay", written(tmp_path, pcap(talk.packets[:4])[:-3]))
    assert result.code == 0
    assert "3 packets were read" in result.err


def test_a_truncated_file_of_one_packet_says_so_in_the_singular(
    run: Callable[..., Any], tmp_path: Path, talk: Talk
) -> None:
    result = run("replay", written(tmp_path, pcap(talk.packets[:2])[:-3]))
    assert "1 packet was read" in result.err


def test_standard_input_is_read(run: Callable[..., Any], talk: Talk) -> None:
    assert "unit 2" in run("replay", "-", stdin=pcap(talk.packets)).out


def test_a_simulation_file_is_written_once_and_says_whom_it_stands_for(
    run: Callable[..., Any], tmp_path: Path, talk: Talk
) -> None:
    capture, plant = written(tmp_path, pcap(talk.packets)), tmp_path / "plant.toml"
    result = run("replay", capture, "--simulate", str(plant), "--delays", "--values", "last", "--quiet")
    assert result.code == 0
    assert "left out, they did not answer: units 2" in result.err
    assert run("simulate", str(plant), "--check").out.splitlines() == [
        "unit 1: 2 points, 0 with a behaviour",
        "fault unit 1, typical delay: late, on; delay=0.01, units=1",
    ]
    again = run("replay", capture, "--simulate", str(plant))
    assert (again.code, again.out) == (2, "")
    assert "is there already; --force writes over it" in again.err
    forced = run("replay", capture, "--simulate", str(plant), "--force")
    assert forced.code == 0
    assert f"{plant} is written: 1 unit of 10.0.0.5:502: 1" in forced.err


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["missing.pcap"], "cannot be opened: no such file"),
        (["."], "cannot be opened: it is a directory"),
        (["site.pcap", "--reply-window", "x"], "--reply-window: a time such as"),
        (["site.pcap", "--port", "0"], "--port: a whole number 1…65535"),
        (["site.pcap", "--server", "10.0.0.5"], "--server: goes with --simulate only"),
        (["site.pcap", "--force"], "--force: goes with --simulate only"),
        (["site.pcap", "--simulate", "x.toml", "--values", "all"], "--values: first or last is needed"),
        (["site.pcap", "--simulate", "x.toml", "--server", "10.0.0.7"], "--server: no unit of 10.0.0.7 answered"),
        (["site.pcap", "--simulate", "no/x.toml"], "no/x.toml: cannot be written: no such file"),
        (["site.pcap", "--framing", "tls"], "--framing: one of mbap, rtu, ascii"),
    ],
)
def test_wrong_use_is_one_sentence(
    run: Callable[..., Any],
    tmp_path: Path,
    talk: Talk,
    monkeypatch: pytest.MonkeyPatch,
    arguments: list[str],
    sentence: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    written(tmp_path, pcap(talk.packets))
    result = run("replay", *arguments)
    assert sentence in result.err
    assert result.code == 2
