"""Runs the code of a documentation page, as a reader would who copies it.

1. A ``python`` block that serves for ever is started as a program of its own, and so is ``$ busway serve`` in a
   ``console`` block: what the page tells its reader to start, and nothing else, answers the page.
2. All other ``python`` blocks of a page are one program, from the first to the last.
3. ``tcp://127.0.0.1:5020`` stands for what was started: the port is replaced by the real one. A page whose code asks
   that endpoint and that starts nothing fails.
4. What ``print(…)  # text`` says it prints is compared.
5. In ``console`` blocks the lines that begin with ``$ busway`` are run, and what stands below is compared; what goes to
   stderr is not shown there.
6. A block whose first line is ``# NAME.toml`` (``.yaml``, ``.conf``) is the file of that name.
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
        server: the command that serves for ever, a program or ``busway serve``; empty if the page has none.
        program: all other Python of the page.
        expected: what its ``print`` calls say they print.
        commands: command lines, each with what it says it prints.
        files: the files that the page has its reader write.
    """

    path: Path
    server: list[str]
    program: str
    expected: list[str]
    commands: list[tuple[str, str]]
    files: dict[str, str]


def read_page(path: Path) -> Page:
    """The code of a page."""
    text = path.read_text(encoding="utf-8")
    blocks = re.findall(r"^```python\n(.*?)^```$", text, re.DOTALL | re.MULTILINE)
    programs = [block for block in blocks if "serve_forever(" in block]
    servers = [["-c", block.replace(WRITTEN_ENDPOINT, FREE_PORT)] for block in programs]
    program = "\n".join(block for block in blocks if block not in programs)
    expected = re.findall(r"^ *print\(.*\)  # (.+)$", program, re.MULTILINE)
    commands = []
    for block in re.findall(r"^```console\n(.*?)^```$", text, re.DOTALL | re.MULTILINE):
        for part in re.split(r"^\$ ", block, flags=re.MULTILINE):
            command, _, output = part.partition("\n")
            if command.startswith("busway serve"):
                servers.append(["-m", *shlex.split(command), "--listen", FREE_PORT])
            elif command.startswith("busway "):
                commands.append((command, output.strip()))
    assert len(servers) <= 1, f"{path.name}: two servers"
    files = dict(re.findall(r"^```\w+\n# ([\w-]+\.(?:toml|yaml|conf))\n(.*?)^```$", text, re.DOTALL | re.MULTILINE))
    return Page(path, servers[0] if servers else [], program, expected, commands, files)


@contextmanager
def serving(page: Page, folder: Path) -> Iterator[str]:
    """The URL of what the page starts; the written one where it starts nothing."""
    if not page.server:
        code = "\n".join([page.program, *(command for command, _ in page.commands)])
        assert WRITTEN_ENDPOINT not in code, f"{page.path.name} asks {WRITTEN_ENDPOINT} and starts nothing there"
        assert WRITTEN_PORT not in code, f"{page.path.name} asks {WRITTEN_PORT} and starts nothing there"
        yield WRITTEN_ENDPOINT
        return
    child = subprocess.Popen(
        [sys.executable, "-u", *page.server], cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
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


RunPage = Callable[[Path], None]


@pytest.fixture
def run_page(tmp_path: Path) -> RunPage:
    """Runs a page; fails where its code fails or prints something else than it says."""

    def run(path: Path) -> None:
        page = read_page(path)
        for name, text in page.files.items():
            (tmp_path / name).write_text(text, encoding="utf-8")
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
