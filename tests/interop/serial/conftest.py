"""What the interop tests on serial lines start: paced lines, foreign servers and clients on their ports, our server.

What a foreign client wrote is looked up in our device: a line has one master, so none of ours can ask beside it.
"""

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any

import foreign
import pytest
from serial_peers import CLIENTS, OPTIONS, UNIT, new_line, start_client, start_server

import busway
from busway.testing.line import PacedLine

# --- our client on foreign servers ------------------------------------------------------------------------------------


class ServedLines:
    """Lines with a foreign server at one end, started when a test first asks for one."""

    def __init__(self, programs: ExitStack) -> None:
        self._programs = programs
        self._urls: dict[str, str] = {}

    def url(self, kind: str) -> str:
        """Where a client of ours reaches the server: the URL of the other end."""
        if kind not in self._urls:
            line = self._programs.enter_context(new_line())
            self._programs.enter_context(start_server(kind, line.paths[1]))
            framing = kind.split("-")[1]
            data_bits = "&data_bits=8" if framing == "ascii" else ""  # pymodbus is told the same: it refuses 7 on a pty
            self._urls[kind] = f"{framing}://{line.paths[0]}?{OPTIONS}{data_bits}"
        return self._urls[kind]


@pytest.fixture(scope="session")
def served_lines() -> Iterator[ServedLines]:
    with ExitStack() as programs:
        yield ServedLines(programs)


# --- foreign clients on our server ------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class OurServer:
    """Our server at one end of a line.

    Attributes:
        device: what it serves as unit 1.
        line: the line; port 0 is free for a master.
        framing: ``rtu`` or ``ascii``.
    """

    device: busway.Device
    line: PacedLine
    framing: str

    @property
    def master_path(self) -> str:
        return self.line.paths[0]


def our_device() -> busway.Device:
    return busway.Device(
        **foreign.CONTENT, identification=foreign.IDENTITY, files={4: {7: [0, 0, 0]}}, fifos={40: [440, 4740]}
    )


def start_our_server(programs: ExitStack, framing: str, **options: Any) -> OurServer:  # Any: options of a server
    line = programs.enter_context(new_line())
    device = our_device()
    data_bits = "&data_bits=8" if framing == "ascii" else ""
    url = f"{framing}://{line.paths[1]}?{OPTIONS}{data_bits}"
    programs.enter_context(busway.serve_in_thread(url, units={UNIT: device}, **options))
    return OurServer(device, line, framing)


@dataclass(frozen=True, slots=True)
class Pair:
    """A foreign client and our server on one line.

    Attributes:
        library: of the client.
        framing: of the line.
        client: the program.
        device: what our server serves as unit 1.
    """

    library: str
    framing: str
    client: foreign.Program
    device: busway.Device

    def ask(self, command: str) -> dict[str, Any]:
        """What the client makes of a command."""
        return self.client.ask(command)


@pytest.fixture(params=CLIENTS, scope="module")
def pair(request: pytest.FixtureRequest) -> Iterator[Pair]:
    """Each foreign client in turn, on a line with our server."""
    library, framing = request.param.split("-")
    with ExitStack() as programs:
        server = start_our_server(programs, framing)
        client = programs.enter_context(start_client(request.param, server.master_path))
        yield Pair(library, framing, client, server.device)
