"""`busway check`: its exit codes, its reports, and its own server, which passes every check on every transport."""

import contextlib
import json
import os
import socket
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from whole_frames import line_of_whole_frames

import busway
from busway.testing.certificates import CertificateStore

ALL = ["--level", "disruptive", "--scratch", "4x101:8,0x101:8", "--idle", "50ms", "--timeout", "10s"]


def new_device() -> busway.Device:
    return busway.Device(
        holding_registers=1000,
        coils=1000,
        input_registers=1000,
        discrete_inputs=1000,
        identification={0: "busway", 1: "checked", 2: "1.0"},
    )


def passes_all(result: Any) -> bool:
    """Whether a run ended with nothing but passed checks, and many of them."""
    assert len(result.out.splitlines()) == 1, result.out
    (last,) = result.out.splitlines()
    count, _, rest = last.partition(" checks: ")
    return result.code == 0 and int(count) >= 120 and rest == f"{count} pass"


@pytest.fixture
def checked() -> Iterator[str]:
    with busway.serve_in_thread("tcp://127.0.0.1:0", units={1: new_device()}) as server:
        yield server.endpoints[0]


def test_our_server_passes_every_check_over_tcp(run: Callable[..., Any], checked: str) -> None:
    assert passes_all(run("check", checked, "--unit", "1", *ALL))


def test_our_server_passes_every_check_over_tls(run: Callable[..., Any], tmp_path: Path) -> None:
    store = CertificateStore(tmp_path)
    given = {
        "expired": store.expired_client(role="operator"),
        "revoked": store.client("revoked", role="operator"),
        "denied": store.client("guest", role="guest"),
        "no-role": store.client("bare"),
    }
    files = ",".join(f"{word}={one.certificate}:{one.key}" for word, one in given.items())
    policy = busway.Policy.of(busway.Rule.of(roles=["operator"]))
    listen = f"tls://127.0.0.1:0?{store.server().query()}&revocation_list={store.revocation_list(given['revoked'])}"
    with busway.serve_in_thread(listen, units={1: new_device()}, policy=policy) as server:
        url = f"{server.endpoints[0].partition('?')[0]}?{store.client('me', role='operator').query()}"
        assert passes_all(run("check", url, "--unit", "1", "--certificates", files, *ALL))


@pytest.mark.parametrize(
    ("url", "given", "says"),
    [
        ("tcp://127.0.0.1:1", "expired=a:b", "certificates go with tls://"),
        ("tls://127.0.0.1:1", "stale=a:b", "expired, revoked, denied, no-role, each with =CERTIFICATE:KEY"),
        ("tls://127.0.0.1:1", "expired=a", "each with =CERTIFICATE:KEY"),
        ("tls://127.0.0.1:1", "expired=missing.pem:missing.key", "missing.pem"),
    ],
)
def test_certificates_that_cannot_be_used_are_refused_before_anything_is_sent(
    run: Callable[..., Any], url: str, given: str, says: str
) -> None:
    result = run("check", url, "--certificates", given)
    assert result.code == 2
    assert says in result.err


FRAMINGS = pytest.mark.parametrize("framing", ["rtu", "ascii"])


@pytest.mark.real_time
@FRAMINGS
def test_our_server_is_checked_over_a_serial_port(run: Callable[..., Any], framing: str) -> None:
    # Only what is answered: where silence is right, a busy machine may take it from between two frames.
    with on_a_line(framing) as ours:
        result = run("check", ours, *ALL, "--only", "A9,A10")
    assert result.code == 0
    assert "fail" not in result.out


@pytest.mark.soak
@pytest.mark.real_time
@FRAMINGS
def test_our_server_passes_every_check_over_a_serial_line(run: Callable[..., Any], framing: str) -> None:
    with on_a_line(framing) as ours:
        assert passes_all(run("check", ours, *ALL, "--timeout", "1s"))  # units that are not there are waited for


@contextlib.contextmanager
def on_a_line(framing: str) -> Iterator[str]:
    """Our server at one end of a line with the pace of 115 200 baud; gives the URL of the other end."""
    with line_of_whole_frames(ports=2, baud=115_200, parity="none") as line:
        ours, device = (f"{framing}://{path}?baud=115200&parity=none&data_bits=8" for path in line.paths)
        with busway.serve_in_thread(device, units={1: new_device()}):
            yield ours


def test_reading_alone_is_the_default_and_says_what_it_does(run: Callable[..., Any], checked: str) -> None:
    result = run("check", checked, "--unit", "1", "--only", "A10")
    assert result.code == 0
    assert "unit 1, level read" in result.err
    assert result.out.endswith(" pass\n")


def test_a_must_that_does_not_hold_is_exit_code_1_until_a_baseline_has_it(
    run: Callable[..., Any], tmp_path: Path
) -> None:
    last, page = tmp_path / "last.json", tmp_path / "check.md"
    with busway.serve_in_thread("tcp://127.0.0.1:0", units={1: busway.Device(holding_registers=1)}) as server:
        asked = ["check", server.endpoints[0], "--unit", "2", "--only", "A10", "--report", f"json={last},md={page}"]
        first = run(*asked)
        again = run(*asked, "--baseline", str(last))
    assert (first.code, again.code) == (1, 0)
    assert "fail     A7   probe-readable: " in first.out
    assert json.loads(last.read_text())["counts"]["fail"] == 1
    assert page.read_text().startswith("# Check of tcp://")


def test_a_report_replaces_a_report_and_nothing_else_and_is_refused_before_the_checks(
    run: Callable[..., Any], tmp_path: Path
) -> None:
    notes, pipe = tmp_path / "notes", tmp_path / "pipe"
    notes.write_text("mine")
    os.mkfifo(pipe)
    refusals = [
        (f"json={notes}", f"{notes}: is there already and is no json report of busway check"),
        (f"md={tmp_path}", f"{tmp_path}: cannot be opened: it is a directory"),
        (f"html={pipe}", f"{pipe}: cannot be opened: it is a pipe"),
        (f"junit={tmp_path}/none/x", f"{tmp_path}/none/x: cannot be written: there is no such folder"),
        ("json=/proc/x.json", "/proc/x.json: cannot be written: "),  # also for root
    ]
    for report, words in refusals:
        result = run("check", "tcp://127.0.0.1:1", "--report", report)
        assert (result.code, words in result.err) == (2, True), result.err
    assert notes.read_text() == "mine"
    assert pipe.is_fifo()


def test_a_report_that_turns_out_not_to_be_writable_is_named_with_the_reason_and_the_others_are_written(
    run: Callable[..., Any], tmp_path: Path, checked: str
) -> None:
    long, page = tmp_path / ("x" * 250), tmp_path / "check.md"  # it gets a longer name while it is written
    report = f"json={long},junit={long}y,md={page}"
    result = run("check", checked, "--unit", "1", "--only", "A10", "--report", report)
    assert result.code == 2
    assert result.err.splitlines()[-2:] == [
        f"{long}: cannot be written: file name too long",
        f"{long}y: cannot be written: file name too long",
    ]
    assert page.read_text().startswith("# Check of tcp://")
    assert result.out.endswith(" pass\n")


def test_what_the_checks_send_and_receive_is_captured_and_shown(run: Callable[..., Any], tmp_path: Path) -> None:
    capture = tmp_path / "check.pcapng"
    with busway.serve_in_thread("tcp://127.0.0.1:0", units={1: new_device()}) as server:
        url = server.endpoints[0]
        port = url.rpartition(":")[2]
        result = run("check", url, "--unit", "1", "--only", "A10", "--capture", str(capture), "-vv")
    assert result.code == 0
    assert " > transaction " in result.err
    assert " < transaction " in result.err
    replayed = run("replay", str(capture), "--port", port, "--json")
    assert json.loads(replayed.out.splitlines()[0])["replies"] >= 16


@contextlib.contextmanager
def killed_by_protocol_1() -> Iterator[str]:
    """A device that answers each read with 0, and dies of a request with the protocol identifier 1."""
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def serve() -> None:
            with listener:
                while True:
                    connection, _ = listener.accept()
                    with connection:
                        while request := connection.recv(260):
                            if request[2:4] == b"\0\1":
                                return
                            connection.sendall(request[:4] + b"\0\5" + request[6:8] + b"\2\0\0")

        thread = threading.Thread(target=serve)
        thread.start()
        yield f"tcp://127.0.0.1:{listener.getsockname()[1]}"
        thread.join()


def test_a_device_that_dies_is_exit_code_6_and_what_killed_it_is_named(run: Callable[..., Any]) -> None:
    with killed_by_protocol_1() as url:
        result = run("check", url, "--level", "diag", "--only", "protocol-1", "--timeout", "10s")
    assert result.code == 6
    assert "protocol-1: " in result.out
    assert "no connection any more" in result.out


def test_no_connection_is_exit_code_5(run: Callable[..., Any]) -> None:
    with busway.serve_in_thread("tcp://127.0.0.1:0", units={1: new_device()}) as server:
        url = server.endpoints[0]
    assert run("check", url).code == 5


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--level", "all"], ["--level", "read, diag, write, disruptive"]),
        (["--scratch", "4x101"], ["--scratch", "4x101:8"]),
        (["--scratch", "3x1:8"], ["--scratch", "3x1:8"]),
        (["--scratch", "4x1:1"], ["--scratch", "2…123"]),
        (["--scratch", "4x1:8,4x101:8"], ["--scratch", "twice"]),
        (["--scratch", "4x65530:8"], ["--scratch", "beyond"]),
        (["--probe", "7"], ["7"]),
        (["--class", "basic"], ["--class", "tcp"]),
        (["--only", "A99"], ["--only", "A99"]),
        (["--report", "pdf=x"], ["--report", "html, junit, json, md"]),
        (["--report", "html"], ["--report"]),
        (["--unit", "256"], ["--unit", "0…255"]),
    ],
)
def test_wrong_use_is_one_sentence_and_nothing_is_sent(
    run: Callable[..., Any], arguments: list[str], words: list[str]
) -> None:
    result = run("check", "tcp://127.0.0.1:1", *arguments)
    assert result.code == 2
    (sentence,) = result.err.splitlines()
    for word in words:
        assert word in sentence


@pytest.mark.parametrize("text", ["{", "[" * 200_000], ids=["cut", "nested too deeply"])
def test_a_baseline_that_is_none_is_refused(run: Callable[..., Any], tmp_path: Path, text: str) -> None:
    wrong = tmp_path / "last.json"
    wrong.write_text(text)
    result = run("check", "tcp://127.0.0.1:1", "--baseline", str(wrong))
    assert result.code == 2
    assert f"--baseline: {wrong} is no JSON" in result.err


def test_udp_is_refused_with_what_can_be_checked(run: Callable[..., Any]) -> None:
    result = run("check", "udp://127.0.0.1:1")
    assert result.code == 2
    assert "TCP, TLS and serial ports" in result.err


def test_scratch_items_are_refused_at_a_level_that_writes_nothing(run: Callable[..., Any], checked: str) -> None:
    result = run("check", checked, "--unit", "1", "--scratch", "4x101:8")
    assert result.code == 2
    assert "--scratch: goes with --level write or disruptive; level read writes nothing" in result.err


def test_level_write_without_scratch_says_that_no_write_is_tried(run: Callable[..., Any], checked: str) -> None:
    result = run("check", checked, "--unit", "1", "--level", "write", "--only", "A10")
    assert "no check of writes is made: --scratch 4x101:8,0x1:8 would name" in result.err


def test_number_of_checks_is_the_same_before_and_after(run: Callable[..., Any], checked: str) -> None:
    result = run("check", checked, "--unit", "1", "--level", "write", "--scratch", "4x101:8", "--idle", "50ms")
    announced = result.err.split("busway: ")[1].split(" check")[0]
    assert result.out.splitlines()[-1].startswith(f"{announced} check")
