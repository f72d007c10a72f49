"""Every command where stdout is full, closed, a pipe without a reader, or plain ASCII: a sentence and an exit code."""

import asyncio
import io
import os
import stat
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from captured import Talk, pcap
from collected import at, filled
from control_sockets import short_directory

import busway
from busway.apps.control import Control
from busway.cli.program import COMMANDS, app

PROGRAM = [sys.executable, "-m", "busway"]
FILE = '[[unit]]\nunit = 1\nname = "Größe – größer"\n[[unit.point]]\nname = "a"\naddress = "4x1"\nvalue = 1\n'
POLICY = (
    '[policy]\ndefault = "deny"\n[[policy.rule]]\nname = "Größe"\nroles = ["operator\\u202E"]\nfunctions = ["write"]\n'
)


COLLECTOR = """
[collector]
store = "samples"
[poll_class]
all.period = 0.5
[[link]]
name = "a"
url = "tcp://127.0.0.1:9"
[[device]]
name = "meter"
link = "a"
unit = 1
profile = "meter"
"""


@dataclass
class Plant:
    """What the commands are run against, and files."""

    url: str
    status: str
    folder: Path


@pytest.fixture(scope="module")
def plant(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Plant]:
    """A device with umlauts in its name that tells its status, and files."""
    folder = tmp_path_factory.mktemp("plant")
    (folder / "plant.toml").write_text(FILE, "utf-8")
    (folder / "policy.toml").write_text(POLICY, "utf-8")
    (folder / "collect.toml").write_text(COLLECTOR, "utf-8")
    (folder / "map.csv").write_text("name,address,type\nlevel,4x1,uint16\n", "utf-8")
    talk = Talk()
    talk.asks("0001 0000 0006 01 03 006b 0001")
    (folder / "site.pcap").write_bytes(pcap(talk.packets))
    filled(folder / "data", 3).close(at(10))
    device = busway.Device(
        holding_registers=10, identification={0: "Größe AG", 1: "\N{SNOWMAN}", 2: "1"}, server_id=b"caf\xc3\xa9\xff"
    )
    ready, stop = threading.Event(), threading.Event()
    found: list[str] = []

    async def run() -> None:
        server = busway.serve("tcp://127.0.0.1:0", units={1: device, 255: device})
        async with server, Control(server, None, name="plant") as control:
            found[:] = [server.endpoints[0], str(control.address)]
            ready.set()
            await asyncio.to_thread(stop.wait)

    with short_directory() as home, pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_RUNTIME_DIR", str(home))
        thread = threading.Thread(target=asyncio.run, args=(run(),))
        thread.start()
        assert ready.wait(10)
        yield Plant(found[0], found[1], folder)
        stop.set()
        thread.join()


def runs(plant: Plant) -> dict[str, list[list[str]]]:
    """What each command prints on, by its name; each run ends by itself."""
    url, folder = plant.url, plant.folder
    return {
        "read": [[url, "4x1", *how] for how in ([], ["--json"], ["--csv"])],
        "write": [[url, "4x1", *how] for how in (["1"], ["1", "--json"], ["1", "--csv"], ["--mask", "1", "0"])],
        "identify": [[url, *how] for how in ([], ["--json"], ["--csv"])],
        "scan": [[url, "--units", "1-2", "--timeout", "200ms", *how] for how in ([], ["--json"])],
        "counters": [[url, "-u", "1", *how] for how in ([], ["--json"])],
        "check": [[url, "-u", "1", "--only", "A10", "--timeout", "10s"]],
        "simulate": [["--list-faults"], [str(folder / "plant.toml"), "--check"]],
        "gateway": [["tcp://127.0.0.1:0", url, "--systemd-unit"]],
        "status": [[plant.status], [plant.status, "--json"]],
        "sniff": [["rtu+udp://127.0.0.1:0", "--for", "10ms", *how] for how in ([], ["--json"])],
        "replay": [[str(folder / "site.pcap"), *how] for how in ([], ["--json"])],
        "decode": [["2b0e0101000001000547 72 c3b6 df".replace(" ", "")], ["03006b0003", "--json"]],
        "config": [["schema"], ["show", str(folder / "plant.toml")]],
        "policy": [["check", str(folder / "policy.toml")]],
        "query": [[str(folder / "data"), *how] for how in ([], ["--json"], ["--csv"], ["--list"], ["--bucket", "1s"])],
        "store": [["check", str(folder / "data")]],
        "collect": [["plan", str(folder / "collect.toml"), *how] for how in ([], ["--json"])],
        "fleet": [["status", "--coordinator", f"local:{folder / 'zone'}", *how] for how in ([], ["--json"])],
        "points": [["convert", str(folder / "map.csv")]],
        "certs": [[str(folder / "lab"), "--force"], ["show", str(folder / "lab" / "ca.pem")]],
    }


UNTIL_STOPPED = {"serve": [["--listen", "tcp://127.0.0.1:0"]], "demo": [["--port", "0", "--for", "1"]]}
"""Commands that go on where their output can be written."""


def test_every_command_is_run_here(plant: Plant) -> None:
    assert set(runs(plant)) | set(UNTIL_STOPPED) == set(COMMANDS)


def ended(arguments: list[str], monkeypatch: pytest.MonkeyPatch, out: Any) -> tuple[int, str]:
    """Exit code and stderr of a command whose stdout is ``out``."""
    monkeypatch.delenv("BUSWAY_TRACEBACK", raising=False)
    said = io.StringIO()
    with monkeypatch.context() as patch:
        patch.setattr(sys, "stdout", out)
        patch.setattr(sys, "stderr", said)
        with pytest.raises(SystemExit) as caught:
            app(arguments, prog_name="busway")
    assert "Traceback" not in said.getvalue()
    assert isinstance(caught.value.code, int)
    return caught.value.code, said.getvalue()


def broken_pipe() -> Any:
    """The writing end of a pipe whose reader has gone."""
    reader, writer = os.pipe()
    os.close(reader)
    return os.fdopen(writer, "w", encoding="utf-8")


FULL = os.makedev(1, 7)
"""The device that refuses every write for lack of space."""


@pytest.fixture
def full_disk(tmp_path: Path) -> str:
    """Path of a file that cannot be written for lack of space."""
    path = "/dev/full"
    if not os.path.exists(path) or os.stat(path).st_rdev != FULL:
        path = str(tmp_path / "full")
        os.mknod(path, 0o666 | stat.S_IFCHR, FULL)
    return path


@pytest.mark.parametrize("command", COMMANDS)
def test_a_full_disk_is_one_sentence_and_exit_code_8(
    plant: Plant, full_disk: str, command: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for arguments in [["--help"], *runs(plant).get(command, ()), *UNTIL_STOPPED.get(command, ())]:
        with open(full_disk, "w", encoding="utf-8") as full:
            code, said = ended([command, *arguments], monkeypatch, full)
        assert (code, said.splitlines()[-1]) == (
            8,
            "busway: the output cannot be written: no space left on device",
        ), arguments


@pytest.mark.parametrize("command", COMMANDS)
def test_a_reader_that_has_gone_is_no_error(plant: Plant, command: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for arguments in [["--help"], *runs(plant).get(command, ()), *UNTIL_STOPPED.get(command, ())]:
        with broken_pipe() as pipe:
            code, said = ended([command, *arguments], monkeypatch, pipe)
        assert code == 0, (arguments, said)


@pytest.mark.parametrize("command", COMMANDS)
def test_no_output_at_all_is_no_error(plant: Plant, command: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for arguments in [["--help"], *runs(plant).get(command, ())]:
        code, said = ended([command, *arguments], monkeypatch, None)
        assert code == 0, (arguments, said)


@pytest.mark.parametrize("command", COMMANDS)
def test_plain_ascii_loses_nothing(plant: Plant, command: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for arguments in [["--help"], *runs(plant).get(command, ())]:
        raw = io.BytesIO()
        code, said = ended(
            [command, *arguments], monkeypatch, io.TextIOWrapper(raw, encoding="ascii", write_through=True)
        )
        assert code == 0, (arguments, said)
        assert raw.getvalue()
        if "--help" not in arguments:  # the parser's own stream writes UTF-8 in the place of ASCII
            raw.getvalue().decode("ascii")


def test_json_stays_json_where_the_output_is_ascii(run: Callable[..., Any], plant: Plant) -> None:
    environment = {**os.environ, "PYTHONIOENCODING": "ascii"}
    done = subprocess.run(
        [*PROGRAM, "identify", plant.url, "--json"], capture_output=True, env=environment, timeout=30, check=True
    )
    assert rb'"value": "Gr\u00f6\u00dfe AG"' in done.stdout


@pytest.mark.parametrize(
    ("redirection", "code"),
    [
        ("> {full}", 8),
        (">&-", 0),
        ("2> {full}", 0),
        ("2>&-", 0),
        ("> {full} 2>&1", 8),
        ("<&-", 0),
        (">&- 2>&- <&-", 0),
    ],
)
def test_the_process_ends_with_its_code_and_without_a_traceback(
    plant: Plant, full_disk: str, redirection: str, code: int
) -> None:
    command = f'"$0" -m busway read {plant.url} 4x1 --csv {redirection.format(full=full_disk)}'
    done = subprocess.run(
        ["sh", "-c", command, sys.executable], capture_output=True, text=True, timeout=30, check=False
    )
    assert done.returncode == code
    assert "Traceback" not in done.stderr
    assert "Exception ignored" not in done.stderr
    assert len(done.stderr.splitlines()) <= 1


@pytest.mark.parametrize("stdin", [b"\xff\xfe\n", b"03 00 6b \xff 03\n", b"\x00\n"])
def test_what_is_no_text_on_standard_input_is_one_sentence(stdin: bytes) -> None:
    done = subprocess.run([*PROGRAM, "decode", "-"], input=stdin, capture_output=True, timeout=30, check=False)
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1


def test_a_defect_is_one_sentence_that_says_how_to_report_it(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> None:
        raise RuntimeError("it is broken\x1b[2J")

    monkeypatch.setattr("busway.cli.decode._bytes_of", broken)
    code, said = ended(["decode", "00"], monkeypatch, io.StringIO())
    assert code == 70
    assert said == (
        "busway: this is a defect of busway: RuntimeError: it is broken\\x1b[2J; "
        "please report it with what BUSWAY_TRACEBACK=1 shows\n"
    )
    monkeypatch.setenv("BUSWAY_TRACEBACK", "1")
    with pytest.raises(RuntimeError):
        app(["decode", "00"], prog_name="busway")
