"""`busway serve`: as a process of its own, from its first line to its end by a signal."""

import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

import busway

PROGRAM = [sys.executable, "-m", "busway", "serve"]

FILE = """\
listen = ["tcp://127.0.0.1:0"]

[[unit]]
unit = 3

[[unit.point]]
name = "level"
address = "4x1"
type = "float32"
value = 2.5
"""


@contextmanager
def serving(*arguments: str, listeners: int = 1) -> Iterator[tuple["subprocess.Popen[str]", Sequence[str]]]:
    """The running process, and the endpoints that it printed."""
    process = subprocess.Popen([*PROGRAM, *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None
    with process:
        try:
            yield process, [process.stdout.readline().strip() for _ in range(listeners)]
        finally:
            process.kill()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_without_a_file_one_unit_has_1000_items_in_each_table(number: signal.Signals) -> None:
    with serving("--listen", "tcp://127.0.0.1:0", "--listen", "tcp://127.0.0.1:0", listeners=2) as (process, endpoints):
        for endpoint in endpoints:
            with busway.connect(endpoint) as link:
                for unit in (0, 1, 255):
                    assert link.unit(unit).read_holding_registers(999, count=1) == [0]
                with pytest.raises(busway.ExceptionReply, match="exception 0B"):
                    link.unit(2).read_holding_registers(0, count=1)
                with pytest.raises(busway.ExceptionReply, match="exception 02"):
                    link.unit(1).read_coils(1000, count=1)
                # A client is still connected.
                if endpoint is endpoints[-1]:
                    began = time.monotonic()
                    process.send_signal(number)
                    _, said = process.communicate(timeout=60)
                    assert time.monotonic() - began < 5  # the server stops within a second; a process may take longer
                    assert process.returncode == 0
                    assert "1000" in said
                    assert "Traceback" not in said


def test_a_file_is_served_as_it_declares(tmp_path: Path) -> None:
    file = tmp_path / "tank.toml"
    file.write_text(FILE)
    with serving(str(file)) as (_, (endpoint,)), busway.connect(endpoint) as link:
        assert link.unit(3).read("4x1", "float32") == 2.5


def test_a_file_that_does_not_say_its_unit_is_served_as_the_one_of_the_command_line(
    run: Callable[..., Any], tmp_path: Path
) -> None:
    file = tmp_path / "tank.toml"
    file.write_text(FILE)
    other = run("serve", str(file), "--unit", "7")
    assert (other.code, other.err) == (2, f"busway: --unit: {file} has the unit 3, not 7\n")
    file.write_text(FILE.replace("unit = 3\n", ""))
    without = run("serve", str(file))
    assert without.code == 2
    assert "unit[0].unit: is missing; or say it by --unit" in without.err
    with serving(str(file), "-u", "7") as (_, (endpoint,)), busway.connect(endpoint) as link:
        assert link.unit(7).read("4x1", "float32") == 2.5


def test_without_a_file_the_unit_is_that_of_the_command_line() -> None:
    with serving("--listen", "tcp://127.0.0.1:0", "--unit", "7") as (_, (endpoint,)), busway.connect(endpoint) as link:
        assert link.unit(7).read_holding_registers(999, count=1) == [0]
        with pytest.raises(busway.ExceptionReply, match="exception 0B"):
            link.unit(1).read_holding_registers(0, count=1)


def test_a_bad_file_is_refused_with_file_and_line(run: Callable[..., Any], tmp_path: Path) -> None:
    file = tmp_path / "tank.toml"
    file.write_text(FILE.replace("float32", "float31").replace("unit = 3", "unit = 300"))
    result = run("serve", str(file))
    assert result.code == 2
    assert result.out == ""
    first, second = result.err.splitlines()
    assert first.startswith(f"{file}:4: unit[0].unit: must be at most 255")
    assert second.startswith(f"{file}:9: unit[0].point[0].type: unknown type 'float31'")


def test_a_url_in_the_place_of_the_file_is_sent_to_its_option(run: Callable[..., Any]) -> None:
    result = run("serve", "tcp://127.0.0.1:0")
    assert (result.code, result.out) == (2, "")
    assert "--listen tcp://127.0.0.1:0" in result.err


def test_a_file_that_cannot_be_read_is_named(run: Callable[..., Any], tmp_path: Path) -> None:
    result = run("serve", str(tmp_path / "nothing.toml"))
    assert result.code == 2
    assert result.err.splitlines() == [f"{tmp_path / 'nothing.toml'}: cannot be read: no such file or directory"]


def test_a_file_that_is_no_text_is_refused_with_its_line(run: Callable[..., Any], tmp_path: Path) -> None:
    file = tmp_path / "tank.toml"
    file.write_bytes(b'listen = []\nname = "\xff"\n')
    result = run("serve", str(file))
    assert (result.code, result.err) == (2, f"{file}:2: byte 0xFF is no UTF-8\n")


def test_a_port_that_is_taken_ends_as_5(run: Callable[..., Any], url: str) -> None:
    result = run("serve", "--listen", url)
    assert result.code == 5
    assert result.out == ""
    (sentence,) = result.err.splitlines()
    assert url in sentence
    assert "the port is taken" in sentence
    assert "Errno" not in sentence


@pytest.mark.parametrize("listen", ["nowhere", "http://127.0.0.1:0", "tcp://127.0.0.1:70000"])
def test_an_endpoint_that_cannot_be_is_named(run: Callable[..., Any], listen: str) -> None:
    result = run("serve", "--listen", listen)
    assert result.code == 2
    (sentence,) = result.err.splitlines()
    assert listen in sentence
