"""Where control sockets are: addresses as they are written, and the directory that is the user's alone."""

import os
from pathlib import Path

import pytest

from busway.apps.control.addresses import (
    LoopbackAddress,
    UnixAddress,
    control_directories,
    control_directory,
    parse_control_address,
)
from busway.errors import ConfigError


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("/run/busway/plant.sock", UnixAddress(Path("/run/busway/plant.sock"))),
        ("plant.sock", UnixAddress(Path("plant.sock"))),
        ("1234", UnixAddress(Path("1234"))),
        ("./a:1", UnixAddress(Path("a:1"))),
        ("127.0.0.1:0", LoopbackAddress("127.0.0.1", 0)),
        ("127.9.9.9:80", LoopbackAddress("127.9.9.9", 80)),
        ("localhost:80", LoopbackAddress("127.0.0.1", 80)),
        ("[::1]:81", LoopbackAddress("::1", 81)),
        ("http://127.0.0.1:4711", LoopbackAddress("127.0.0.1", 4711)),
        ("http://[::1]:4711/", LoopbackAddress("::1", 4711)),
    ],
)
def test_an_address_is_a_path_or_loopback(text: str, expected: object) -> None:
    address = parse_control_address(text)
    assert address == expected
    assert isinstance(address, UnixAddress) or parse_control_address(str(address)) == address


@pytest.mark.parametrize("text", ["0.0.0.0:0", "10.0.0.1:80", "[::]:0", "example.org:80", "http://10.0.0.1:80"])
def test_an_address_that_others_reach_is_refused(text: str) -> None:
    with pytest.raises(ConfigError, match="only an address of this host's loopback"):
        parse_control_address(text)


@pytest.mark.parametrize("text", ["", "http://", "http://127.0.0.1", "127.0.0.1:99999"])
def test_what_is_no_address_is_refused(text: str) -> None:
    with pytest.raises(ConfigError, match="such as 127"):
        parse_control_address(text)


@pytest.mark.parametrize("text", ["tcp://127.0.0.1:502", "rtu:///dev/ttyUSB0", "https://127.0.0.1:80"])
def test_the_url_of_a_device_is_refused_with_the_commands_that_take_it(text: str) -> None:
    with pytest.raises(ConfigError, match=f"{text} is no control service.*busway read, identify or counters"):
        parse_control_address(text)


def test_the_directory_is_made_for_the_user_alone(tmp_path: Path) -> None:
    directory = control_directory({"XDG_RUNTIME_DIR": str(tmp_path)})
    assert directory == tmp_path / "busway"
    assert directory.stat().st_mode & 0o777 == 0o700
    assert control_directory({"XDG_RUNTIME_DIR": str(tmp_path)}) == directory


def test_without_a_runtime_directory_it_stands_among_the_temporary_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    assert control_directory({}) == tmp_path / f"busway-{os.getuid()}"
    assert control_directory({"XDG_RUNTIME_DIR": "not/absolute"}) == tmp_path / f"busway-{os.getuid()}"


def test_a_directory_that_others_may_read_is_refused(tmp_path: Path) -> None:
    (tmp_path / "busway").mkdir()
    (tmp_path / "busway").chmod(0o755)
    with pytest.raises(ConfigError, match="must be yours alone"):
        control_directory({"XDG_RUNTIME_DIR": str(tmp_path)})


def test_what_is_no_directory_is_refused(tmp_path: Path) -> None:
    (tmp_path / "real").mkdir(mode=0o700)
    (tmp_path / "busway").symlink_to(tmp_path / "real")
    with pytest.raises(ConfigError, match="is no directory"):
        control_directory({"XDG_RUNTIME_DIR": str(tmp_path)})


def test_a_runtime_directory_that_is_not_there_is_passed_over(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    assert control_directory({"XDG_RUNTIME_DIR": str(tmp_path / "gone")}).parent == tmp_path
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "gone"))
    with pytest.raises(ConfigError, match="cannot be made"):
        control_directory({})


def test_programs_of_a_shell_and_of_a_service_are_both_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    (tmp_path / "run").mkdir()
    shell = {"XDG_RUNTIME_DIR": str(tmp_path / "run")}
    assert control_directories(shell) == []
    both = [control_directory(shell), control_directory({})]
    assert control_directories(shell) == both
    both[1].chmod(0o777)
    assert control_directories(shell) == both[:1]
