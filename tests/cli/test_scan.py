"""``busway scan`` on a paced line and at scripted TCP peers."""

import json
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from typing import Any

import pytest
from program import Busway
from whole_frames import line_of_whole_frames

import busway
from busway.framing.rtu import encode_rtu
from busway.testing.line import PacedLine

Run = Callable[..., Any]
VALUE, ABSENT = bytes.fromhex("03 02 0000"), bytes.fromhex("83 0b")


@pytest.fixture
def line() -> Iterator[PacedLine]:
    """A line with units 3, which has the register that is asked for, and 7, which has not. A pause of this process
    within a request spoils none.
    """
    units = {3: busway.Device(holding_registers=1), 7: busway.Device(coils=1)}
    with (
        line_of_whole_frames(ports=2, baud=38_400) as line,
        busway.serve_in_thread(f"rtu://{line.paths[0]}?baud=38400&gap_limit=5", units=units),
    ):
        yield line


def url(line: PacedLine) -> str:
    return f"rtu://{line.paths[1]}?baud=38400"


@pytest.fixture
def device() -> Iterator[Callable[..., str]]:
    """Makes a TCP device from a function of unit and PDU: replies, several if need be; None closes the connection."""
    with ExitStack() as stack:

        def make(answer: Callable[[int, bytes], list[tuple[int, bytes]] | None]) -> str:
            listener = socket.create_server(("127.0.0.1", 0))
            stack.callback(listener.close)
            transactions: dict[int, bytes] = {}

            def converse(connection: socket.socket) -> None:
                with connection, suppress(OSError):
                    while request := connection.recv(260):
                        transactions[request[6]] = request[:2]
                        replies = answer(request[6], request[7:])
                        if replies is None:
                            return
                        for unit, pdu in replies:
                            head = transactions[unit] + b"\0\0" + (len(pdu) + 1).to_bytes(2, "big")
                            connection.sendall(head + bytes((unit,)) + pdu)

            def accept() -> None:
                with suppress(OSError):
                    while True:
                        connection, _ = listener.accept()
                        threading.Thread(target=converse, args=(connection,), daemon=True).start()

            threading.Thread(target=accept, daemon=True).start()
            return f"tcp://127.0.0.1:{listener.getsockname()[1]}"

        yield make


def summary_of(result: Any) -> dict[str, Any]:
    *_, last = result.out.splitlines()
    found: dict[str, Any] = json.loads(last)
    assert found["kind"] == "summary"
    return found


@pytest.mark.real_time
def test_the_units_of_a_line_are_found_named_and_nothing_is_written(run: Run, line: PacedLine) -> None:
    result = run("scan", url(line), "--units", "2-4,7", "--timeout", "300ms", "--listen", "50ms")
    assert result.code == 0
    three, seven, count, times = result.out.splitlines()
    assert three.split()[:2] == ["unit", "3"]
    assert "answers  busway device" in three
    assert "answers with exception 02  busway device" in seven
    assert count == f"2 units answer on {url(line).partition('?')[0]}, 38400 8E1"
    assert "is safe" in times
    requests = {talk.data[1] for talk in line.transmissions() if talk.port == 1}
    assert requests == {0x03, 0x2B, 0x11}  # reads and questions for identity


@pytest.mark.real_time
def test_json_tells_each_unit_and_a_summary(run: Run, line: PacedLine) -> None:
    result = run("scan", url(line), "--units", "3,4", "--timeout", "1s", "--listen", "50ms", "--no-identify", "--json")
    (unit,) = [json.loads(each) for each in result.out.splitlines()[:-1]]
    assert (unit["unit"], unit["answer"], unit["line"]) == (3, "answers", "38400 8E1")
    assert unit["identification"] == {}
    summary = summary_of(result)
    assert summary["found"] == [3]
    assert summary["asked"] == 2
    assert summary["timeout"] < 1
    requests = {talk.data[1] for talk in line.transmissions() if talk.port == 1}
    assert requests == {0x03}


@pytest.mark.real_time
def test_several_rates_and_parities_are_tried_in_turn(run: Run, line: PacedLine) -> None:
    result = run(
        *("scan", url(line), "--units", "3", "--baud", "38400,57600", "--parity", "even, none"),
        *("--force", "--no-identify", "--json"),
    )
    lines = [json.loads(each)["line"] for each in result.out.splitlines()]
    # A pseudo-terminal has no rate, so that the unit is found with each of them.
    assert lines == [each for each in ("38400 8E1", "38400 8N2", "57600 8E1", "57600 8N2") for _ in ("unit", "summary")]


@pytest.mark.real_time
def test_a_busy_line_is_left_alone(line: PacedLine) -> None:
    with Busway("scan", url(line), "--listen", "20s") as scanning:
        scanning.wait_for("listening to")
        line.inject(encode_rtu(9, bytes.fromhex("03 0000 0001")))
        out, err = scanning.end()
    assert scanning.process.returncode == 2
    assert not out
    assert "the line is busy" in err
    assert "nothing was sent" in err
    assert {byte.port for byte in line.tap} == {-1}


@pytest.mark.real_time
def test_a_scan_that_is_forced_does_not_listen_first(run: Run, line: PacedLine) -> None:
    result = run("scan", url(line), "--units", "3", "--force", "--no-identify")
    assert result.code == 0
    assert "listening" not in result.err


@pytest.mark.real_time
def test_that_no_unit_answers_is_said(run: Run, line: PacedLine) -> None:
    result = run("scan", url(line), "--units", "9", "--timeout", "100ms", "--listen", "20ms")
    assert result.code == 3
    assert not result.out
    assert "no unit answered" in result.err


def test_a_gateway_that_speaks_for_an_absent_unit_is_not_that_unit(run: Run, device: Callable[..., str]) -> None:
    codes = {1: VALUE, 2: b"\x83\x0a", 3: ABSENT, 4: b"\x83\x04", 5: b"\x83\x99"}
    endpoint = device(lambda unit, pdu: [(unit, codes[unit])])
    result = run("scan", endpoint, "--units", "1-5", "--no-identify", "--json")
    assert summary_of(result)["found"] == [1, 4, 5]


def test_on_tcp_the_device_itself_is_asked_too(run: Run, device: Callable[..., str]) -> None:
    asked: list[int] = []

    def answer(unit: int, pdu: bytes) -> list[tuple[int, bytes]]:
        asked.append(unit)
        return [(unit, VALUE if unit == 255 else ABSENT)]

    assert summary_of(run("scan", device(answer), "--json", "--no-identify"))["found"] == [255]
    assert asked == [*range(1, 248), 255]


def test_units_that_were_given_too_little_time_are_asked_again(run: Run, device: Callable[..., str]) -> None:
    asked: list[int] = []

    def answer(unit: int, pdu: bytes) -> list[tuple[int, bytes]]:
        asked.append(unit)
        if unit == 2 and asked.count(2) == 1:
            return []  # it comes with the next one, when its time is over
        return [(2, VALUE), (3, VALUE)] if unit == 3 else [(unit, VALUE)]

    result = run("scan", device(answer), "--units", "1-3", "--timeout", "5s", "--no-identify", "--json")
    assert summary_of(result)["found"] == [1, 3, 2]
    assert summary_of(result)["timeout"] == 5.0
    assert asked == [1, 2, 3, 2]


def test_a_fixed_timeout_waits_the_whole_time(run: Run, device: Callable[..., str]) -> None:
    endpoint = device(lambda unit, pdu: [(unit, VALUE)] if unit == 1 else [])
    result = run("scan", endpoint, "--units", "1,2", "--timeout", "200ms", "--patient", "--no-identify", "--json")
    assert summary_of(result)["timeout"] == 0.2


def test_a_device_that_closes_for_an_unknown_unit_is_connected_to_again(run: Run, device: Callable[..., str]) -> None:
    endpoint = device(lambda unit, pdu: [(unit, VALUE)] if unit in (1, 4) else None)
    result = run("scan", endpoint, "--units", "1-4", "--no-identify", "--json")
    assert summary_of(result)["found"] == [1, 4]


def test_a_broken_reply_is_a_unit(run: Run, device: Callable[..., str]) -> None:
    endpoint = device(lambda unit, pdu: [(unit, b"\x03\x04\x00\x00\x00\x00")])
    result = run("scan", endpoint, "--units", "1", "--no-identify")
    assert "answers, but broken" in result.out


def test_a_device_that_ignores_the_unit_is_recognised(run: Run, device: Callable[..., str]) -> None:
    endpoint = device(lambda unit, pdu: [(unit, VALUE)])
    result = run("scan", endpoint, "--units", "1-10", "--no-identify")
    assert result.out.splitlines()[-1].startswith("all of them answer alike")


def test_a_device_that_is_not_there_ends_the_scan(run: Run, closed_port: str) -> None:
    result = run("scan", closed_port, "--units", "1-10")
    assert result.code == 5
    assert not result.out


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["rtu:///dev/null", "--units", "0"], "--units: a whole number 1…247"),
        (["rtu:///dev/null", "--units", "5-2"], "ends before it begins"),
        (["rtu:///dev/null", "--units", "1;2"], "--units"),
        (["rtu:///dev/null", "--baud", "fast"], "baud"),
        (["rtu:///dev/null", "--baud", "9600,12"], "baud: must be 50"),
        (["rtu:///dev/null", "--baud", ","], "--baud: a list"),
        (["rtu:///dev/null", "--parity", "mark"], "parity"),
        (["rtu:///dev/null", "--timeout", "0"], "--timeout"),
        (["rtu:///dev/null?colour=red"], "colour: unknown option"),
        (["tcp://127.0.0.1", "--baud", "9600"], "goes with a serial port"),
        (["tcp://127.0.0.1", "--units", "256"], "--units"),
    ],
)
def test_what_cannot_be_is_one_clear_sentence_and_nothing_is_sent(
    run: Run, arguments: list[str], complaint: str
) -> None:
    result = run("scan", *arguments)
    assert result.code == 2
    assert complaint in result.err
    assert len(result.err.strip().splitlines()) == 1
    assert not result.out


def test_a_quiet_scan_says_what_it_found_and_not_what_it_does(run: Run, device: Callable[..., str]) -> None:
    url = device(lambda unit, pdu: [(unit, VALUE)])
    told = run("scan", url, "--units", "1", "--timeout", "1s")
    quiet = run("scan", url, "--units", "1", "--timeout", "1s", "--quiet")
    assert "asking 1 unit of" in told.err
    assert quiet.err == ""
    assert quiet.out.split()[:2] == told.out.split()[:2] == ["unit", "1"]
    assert "asking 1 unit of" in run("scan", url, "--units", "1", "--timeout", "1s").err
