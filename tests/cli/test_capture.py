"""``--capture`` of the commands that talk to a device, and of ``serve``."""

import os
import re
import stat
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from capture_file import blocks
from program import Busway


def payloads(file: Path) -> list[bytes]:
    """What the TCP segments in a capture file carry."""
    return [
        body[60 : 20 + int.from_bytes(body[12:16], "little")] for kind, body in blocks(file.read_bytes()) if kind == 6
    ]


def test_what_a_read_sends_and_receives_is_captured(run: Callable[..., Any], url: str, tmp_path: Path) -> None:
    file = tmp_path / "read.pcapng"
    # The server of the test is in the same process, and captured with it.
    assert run("read", url, "4x1", "--unit", "1", "--capture", str(file)).code == 0
    asked, *_, answered = sorted(payloads(file), key=len, reverse=True)
    assert asked[7:] == bytes.fromhex("03 0000 0001")
    assert answered[7:] == bytes.fromhex("03 02 0000")


@pytest.mark.parametrize(
    ("command", "pdu"),
    [
        (["write", "4x1", "7"], "06 0000 0007"),
        (["write", "4x1", "--mask", "0xff00", "0x0001"], "16 0000 ff00 0001"),
        (["identify"], "11"),
        (["counters"], "08 000b 0000"),
    ],
)
def test_what_other_commands_send_is_captured_too(
    run: Callable[..., Any], url: str, tmp_path: Path, command: list[str], pdu: str
) -> None:
    file = tmp_path / "sent.pcapng"
    assert run(command[0], url, *command[1:], "--unit", "1", "--capture", str(file)).code == 0
    assert bytes.fromhex(pdu) in [payload[7:] for payload in payloads(file)]


def test_a_server_captures_each_connection_until_it_is_stopped(run: Callable[..., Any], tmp_path: Path) -> None:
    file = tmp_path / "served.pcapng"
    with Busway("serve", "--listen", "tcp://127.0.0.1:0", "--capture", str(file)) as server:
        assert server.process.stdout is not None
        url = server.process.stdout.readline().decode().strip()
        assert re.fullmatch(r"tcp://127\.0\.0\.1:\d+", url)
        for _ in range(2):
            assert run("read", url, "4x1").code == 0
        server.stop()
    assert [payload[7:].hex() for payload in payloads(file)] == ["0300000001", "03020000"] * 2


@pytest.mark.parametrize(
    "command",
    [
        ["read", "tcp://127.0.0.1:1", "4x1"],
        ["write", "tcp://127.0.0.1:1", "4x1", "1"],
        ["identify", "tcp://127.0.0.1:1"],
        ["counters", "tcp://127.0.0.1:1"],
        ["serve"],
    ],
)
def test_a_file_that_cannot_be_written_is_named_and_nothing_is_done(
    run: Callable[..., Any], command: list[str]
) -> None:
    result = run(*command, "--capture", "/there/is/no/such/folder")
    assert result.code == 2
    assert result.err == "/there/is/no/such/folder: cannot be opened: no such file or directory\n"


def test_a_capture_is_for_its_owner_alone_and_takes_the_place_of_an_old_one(
    run: Callable[..., Any], url: str, tmp_path: Path
) -> None:
    file = tmp_path / "read.pcapng"
    before = os.umask(0o000)
    try:
        for _ in range(2):
            assert run("read", url, "4x1", "--capture", str(file)).code == 0
    finally:
        os.umask(before)
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    assert len({payload[7:] for payload in payloads(file)}) == 2


def test_an_old_capture_that_others_can_read_is_for_its_owner_alone_afterwards(
    run: Callable[..., Any], url: str, tmp_path: Path
) -> None:
    file = tmp_path / "read.pcapng"
    assert run("read", url, "4x1", "--capture", str(file)).code == 0
    file.chmod(0o644)
    assert run("read", url, "4x1", "--capture", str(file)).code == 0
    assert stat.S_IMODE(file.stat().st_mode) == 0o600


@pytest.mark.parametrize("content", [b"notes", b"\n\r\r\n of another program", b"\xd4\xc3\xb2\xa1" + bytes(20)])
def test_a_file_that_is_no_capture_of_ours_is_not_overwritten(
    run: Callable[..., Any], url: str, tmp_path: Path, content: bytes
) -> None:
    file = tmp_path / "notes"
    file.write_bytes(content)
    result = run("read", url, "4x1", "--capture", str(file))
    assert (result.code, result.out) == (2, "")
    assert "is no capture of busway, so it is not overwritten" in result.err
    assert file.read_bytes() == content


def test_a_capture_is_not_written_through_a_link_of_another_user(
    run: Callable[..., Any], url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target, link = tmp_path / "precious", tmp_path / "read.pcapng"
    link.symlink_to(target)
    if os.geteuid() == 0:
        os.lchown(link, 12_345, 12_345)
    else:
        monkeypatch.setattr("os.geteuid", lambda: 12_345)
    result = run("read", url, "4x1", "--capture", str(link))
    assert result.code == 2
    assert "of another user" in result.err
    assert not target.exists()
