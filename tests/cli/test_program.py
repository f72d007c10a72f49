"""The program around the commands: help, version, wrong commands, what is loaded, and how it ends in a pipe."""

import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import busway
from busway import __version__
from busway.cli.program import COMMANDS

PROGRAM = [sys.executable, "-m", "busway"]


def test_the_version(run: Callable[..., Any]) -> None:
    result = run("--version")
    assert (result.code, result.out) == (0, f"busway {__version__}\n")


@pytest.mark.parametrize("arguments", [[], ["--help"], ["-h"]])
def test_help_lists_all_commands(run: Callable[..., Any], arguments: list[str]) -> None:
    result = run(*arguments)
    assert result.code == 0
    for name, summary in COMMANDS.items():
        assert name in result.out
        assert summary in result.out


@pytest.mark.parametrize("name", COMMANDS)
def test_the_help_of_a_command_has_its_summary_and_examples(run: Callable[..., Any], name: str) -> None:
    result = run(name, "--help")
    assert result.code == 0
    assert f"Usage: busway {name} " in result.out
    assert f"\n    busway {name}" in result.out
    assert "--help" in result.out
    assert "\b" not in result.out


@pytest.mark.parametrize(
    ("arguments", "words"),
    [(["raed"], ["'raed'", "read"]), (["--nonsense"], ["--nonsense"]), (["read", "--unit"], ["--unit"])],
)
def test_wrong_use_costs_one_sentence(run: Callable[..., Any], arguments: list[str], words: list[str]) -> None:
    result = run(*arguments)
    assert result.code == 2
    assert result.out == ""
    (sentence,) = result.err.splitlines()
    assert sentence.startswith("busway: ")
    for word in words:
        assert word in sentence


def test_reading_loads_neither_pydantic_nor_rich_nor_an_event_loop(url: str) -> None:
    program = (
        "import json, sys\n"
        "from busway.cli import main\n"
        f"sys.argv = ['busway', 'read', {url!r}, '4x1']\n"
        "try:\n    main()\n"
        "except SystemExit as end:\n    assert end.code == 0\n"
        "heavy = ('pydantic', 'rich', 'asyncio', 'ssl', 'http', 'email', 'encodings.idna', 'busway.server',\n"
        "         'busway.apps', 'busway.config.files', 'busway.framing.rtu', 'busway.points')\n"
        "print(json.dumps([name for name in heavy if name in sys.modules]))\n"
    )
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=30, check=True)
    assert ended.stdout.splitlines()[0] == "4x1  0  0000"
    assert json.loads(ended.stdout.splitlines()[1]) == []


NOT_SERVED = (
    "busway.access.audit_log", "busway.apps.collector", "busway.apps.control.client", "busway.apps.gateway",
    "busway.apps.simulator", "busway.client.link", "busway.config.files.collector", "busway.config.files.gateway",
    "busway.config.files.simulation", "busway.config.profiles", "busway.faults", "busway.framing.ascii",
    "busway.framing.rtu", "busway.observe.capture", "busway.observe.http_connection", "busway.observe.metrics",
    "busway.points.decoder", "busway.server.serial_listener", "busway.server.udp", "busway.session.tcp_client",
    "busway.session.serial_server", "busway.transport.serial.connection", "busway.transport.tls", "cryptography",
    "ctypes", "html", "http.client", "http.server", "prometheus_client", "rich", "serialx",
)  # fmt: skip
"""What a server of a file over TCP does not use."""
NOT_WITHOUT_CONTROL = ("busway.apps.control.service", "busway.observe.http", "http", "socketserver")
"""What beside that a server without a control socket does not use."""


@pytest.mark.parametrize("control", [True, False])
def test_serving_loads_only_what_it_uses(tmp_path: Path, control: bool) -> None:
    (tmp_path / "plant.toml").write_text("[[unit]]\nunit = 1\nholding_registers = 10\n")
    arguments = ["serve", str(tmp_path / "plant.toml"), "--listen", "tcp://127.0.0.1:0"]
    arguments += ["--control", str(tmp_path / "control.sock") if control else "off"]
    unused = NOT_SERVED if control else (*NOT_SERVED, *NOT_WITHOUT_CONTROL)
    program = (
        "import sys\n"
        "from busway.cli import main\n"
        f"sys.argv = {['busway', *arguments]!r}\n"
        "try:\n    main()\n"
        "except SystemExit as end:\n    assert end.code == 0, end.code\n"
        f"print([name for name in {unused!r} if name in sys.modules])\n"
    )
    process = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    with process:
        url = process.stdout.readline().strip()
        assert url.startswith("tcp://127.0.0.1:")
        with busway.connect(url) as link:
            assert link.unit(1).read("4x1") == 0
        process.send_signal(signal.SIGTERM)
        told, _ = process.communicate(timeout=60)
    assert told == "[]\n"


def test_data_goes_to_stdout_and_diagnostics_to_stderr(url: str) -> None:
    ended = subprocess.run(
        [*PROGRAM, "read", url, "3x11", "4x1", "-v"], capture_output=True, text=True, timeout=30, check=False
    )
    assert ended.returncode == 4
    assert ended.stdout == "4x1  0  0000\n"
    assert "ReadInputRegisters" in ended.stderr
    assert "exception 02" in ended.stderr


def test_a_reader_that_goes_away_is_no_error(url: str) -> None:
    process = subprocess.Popen(
        [*PROGRAM, "read", url, "4x1", "--watch", "10ms"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stderr is not None
    with process:
        assert "4x1  0  0000" in process.stdout.readline()
        process.stdout.close()
        assert process.wait(60) == 0
        assert process.stderr.read() == ""


def test_watching_ends_quietly_with_an_interrupt(url: str) -> None:

    process = subprocess.Popen(
        [*PROGRAM, "read", url, "4x1", "--watch", "10ms", "--csv"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    with process:
        assert process.stdout.readline() == "time,address,value,quality,reason,type,raw\n"
        assert process.stdout.readline().endswith(",4x1,0,good,,uint16,0000\n")
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=60)
        assert process.returncode == 0
        assert said == ""


def test_an_interrupt_while_waiting_for_a_reply_ends_as_130(peer: Callable[..., str]) -> None:

    asked = threading.Event()

    def keep_silent(request: bytes) -> bytes:
        asked.set()
        return b""

    process = subprocess.Popen(
        [*PROGRAM, "read", peer(keep_silent), "4x1", "--timeout", "60s"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    with process:
        assert asked.wait(10)
        process.send_signal(signal.SIGINT)
        out, said = process.communicate(timeout=60)
        assert (process.returncode, out, said) == (130, "", "")


@pytest.mark.parametrize("seed", ["1", "2", "3"])
def test_help_names_its_options_in_one_order(seed: str) -> None:
    help_text = subprocess.run(
        [sys.executable, "-m", "busway", "read", "--help"],
        env={**os.environ, "PYTHONHASHSEED": seed}, capture_output=True, text=True, timeout=60, check=True,
    ).stdout  # fmt: skip
    assert "  -h, --help " in help_text


def test_misspelt_command_gets_the_nearest_one(run: Callable[..., Any]) -> None:
    result = run("raed")
    assert result.code == 2
    assert "there is no command 'raed'; is it read?" in result.err
