"""Runs the code of a documentation page, as a reader would who copies it.

1. A ``python`` block that serves for ever is started as a program of its own; the URL it prints is where the rest of
   the page finds it. Without such a block a device of the test's own answers.
2. All other ``python`` blocks of a page are one program, from the first to the last.
3. ``tcp://127.0.0.1:5020`` stands for that device: the port is replaced by the real one.
4. What ``print(…)  # text`` says it prints is compared.
5. In ``console`` blocks the lines that begin with ``$ busway`` are run, and what stands below is compared.
"""

import re
import shlex
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest

import busway

ROOT = Path(__file__).resolve().parents[2]
WRITTEN_ENDPOINT = "tcp://127.0.0.1:5020"
WRITTEN_PORT = "port=5020"
FREE_PORT = "tcp://127.0.0.1:0"
SECONDS = 60
"""Far above what any page needs, so that only a program that hangs reaches it."""


@dataclass(frozen=True, slots=True)
class Page:
    """A documentation page and its code.

    Attributes:
        server: the program that serves for ever; empty if the page has none.
        program: all other Python of the page.
        expected: what its ``print`` calls say they print.
        commands: command lines, each with what it says it prints.
    """

    path: Path
    server: str
    program: str
    expected: list[str]
    commands: list[tuple[str, str]]


def read_page(path: Path) -> Page:
    """The code of a page."""
    text = path.read_text(encoding="utf-8")
    blocks = re.findall(r"^```python\n(.*?)^```$", text, re.DOTALL | re.MULTILINE)
    servers = [block for block in blocks if "serve_forever(" in block]
    assert len(servers) <= 1, f"{path.name}: two servers"
    program = "\n".join(block for block in blocks if block not in servers)
    expected = re.findall(r"^ *print\(.*\)  # (.+)$", program, re.MULTILINE)
    commands = []
    for block in re.findall(r"^```console\n(.*?)^```$", text, re.DOTALL | re.MULTILINE):
        for part in re.split(r"^\$ ", block, flags=re.MULTILINE):
            command, _, output = part.partition("\n")
            if command.startswith("busway "):
                commands.append((command, output.strip()))
    return Page(path, "".join(servers), program, expected, commands)


@contextmanager
def serving(page: Page, folder: Path) -> Iterator[str]:
    """The URL of the device that answers the page."""
    if page.server:
        program = page.server.replace(WRITTEN_ENDPOINT, FREE_PORT)
        child = subprocess.Popen(
            [sys.executable, "-u", "-c", program], cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        assert child.stdout is not None
        try:
            line = child.stdout.readline()
            found = re.search(r"tcp://\S+", line)
            if found is None:
                child.kill()
                pytest.fail(f"{page.path.name}: the server printed {line!r}; {child.communicate()[1]}")
            yield found[0]
        finally:
            child.kill()
            child.communicate()
    else:
        with busway.serve_in_thread(FREE_PORT, units={1: example_device()}) as server:
            yield server.endpoints[0]


def example_device() -> busway.Device:
    """The device that pages without a server of their own talk to."""
    device = busway.Device(holding_registers=2000, input_registers=2000, coils=200, discrete_inputs=200)
    device.write("4x101", 21.5, "float32", order="CDAB")
    device.holding_registers[0:4] = [7, 8, 9, 10]
    return device


RunPage = Callable[[Path], None]


@pytest.fixture
def run_page(tmp_path: Path) -> RunPage:
    """Runs a page; fails where its code fails or prints something else than it says."""

    def run(path: Path) -> None:
        page = read_page(path)
        with serving(page, tmp_path) as endpoint:
            if page.program:
                program = page.program.replace(WRITTEN_ENDPOINT, endpoint)
                program = program.replace(WRITTEN_PORT, f"port={endpoint.rpartition(':')[2]}")
                assert finished([sys.executable, "-W", "error", "-c", program], tmp_path) == page.expected
            for command, expected in page.commands:
                words = shlex.split(command.replace(WRITTEN_ENDPOINT, endpoint))
                printed = finished([sys.executable, "-m", "busway", *words[1:]], tmp_path)
                assert "\n".join(printed) == expected.replace(WRITTEN_ENDPOINT, endpoint), command

    return run


def finished(words: list[str], folder: Path) -> list[str]:
    """What a program printed; fails where the program does."""
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True, timeout=SECONDS, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()
