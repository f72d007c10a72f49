"""Fifty clients that ask without end: a priority host and all others are answered as if they were few.

Server, flood and what is behind a gateway are processes of their own; this one asks for the priority host and for
another, one request at a time each, and takes the time of every answer.

1. One good window is enough: a machine that does other things as well lengthens most, a server that lets a flood
   through lengthens all, and by seconds.
2. The time in which the machine itself stood still belongs to no answer.
"""

import math
import socket
import ssl
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest
from machine_pauses import MachinePauses, machine_pauses
from told_program import LIMIT

from busway.framing.rtu import encode_rtu
from busway.testing.certificates import CertificateFiles, CertificateStore

PROGRAMS = Path(__file__).parent / "programs"
FLOODERS = 50
PRIORITY, OTHER = "127.0.0.2", "127.0.0.3"
PRIORITY_BOUND, OTHER_BOUND = 0.020, 0.100
"""Seconds that 99 of 100 answers take at most."""
WINDOWS, WINDOW_SECONDS = 30, 0.5
BETWEEN = 0.003
"""Seconds between an answer and the next question of those who are measured."""


def adu(pdu: str) -> bytes:
    """A request of unit 1 on TCP."""
    body = bytes.fromhex(pdu)
    return struct.pack(">HHHB", 1, 0, len(body) + 1, 1) + body


READ = adu("03 0007 0001")
WRITE = adu("06 0000 0001")
WRITE_AND_READ = adu("17 0000 0001 0000 0001 02 0001")

Span = tuple[float, float]
Asker = Callable[[], Span]


@dataclass(frozen=True)
class Flood:
    """What is flooded with what.

    Attributes:
        asked: what the flood asks.
        access: as of programs/flooded.py; ``behind`` for the URL of another server.
        is_deaf: whether it never takes an answer.
        scheme: of the endpoint.
    """

    asked: bytes
    access: str = "everything"
    is_deaf: bool = False
    scheme: str = "tcp"


FLOODS = {
    "denied": Flood(WRITE, "read-only"),
    "permitted": Flood(READ),
    "without a plan": Flood(adu("03 0007 0000")),
    "deaf": Flood(adu("03 0000 007D"), is_deaf=True),
    "function 23": Flood(WRITE_AND_READ),
    "reads through a gateway": Flood(READ, "behind"),
    "function 23 through a gateway": Flood(WRITE_AND_READ, "behind"),
    "denied over TLS": Flood(WRITE, "read-only", scheme="tls"),
    "permitted over TLS": Flood(READ, scheme="tls"),
    "framed": Flood(encode_rtu(1, bytes.fromhex("06 0000 0001")), "read-only", scheme="rtu+tcp"),
}


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> CertificateStore:
    return CertificateStore(tmp_path_factory.mktemp("certificates"))


@pytest.mark.parametrize("transports", ["epoll", "loop"])
@pytest.mark.parametrize("kind", FLOODS)
def test_flood_of_any_kind_lets_a_priority_host_and_others_be_answered_in_time(
    kind: str, transports: str, store: CertificateStore
) -> None:
    flood = FLOODS[kind]
    with ExitStack() as stack:
        access = flood.access
        if access == "behind":
            behind = stack.enter_context(_server("tcp://127.0.0.1:0", "everything", "epoll"))
            access = f"tcp://127.0.0.1:{behind}?max_transactions=16"
        endpoint, files = f"{flood.scheme}://127.0.0.1:0", None
        if flood.scheme == "tls":
            files = store.client("client", role="Operator")
            endpoint += f"?{store.server().query()}"
        port = stack.enter_context(_server(endpoint, access, transports))
        priority, other = (
            stack.enter_context(_asker(port, source, files, is_framed=flood.scheme == "rtu+tcp"))
            for source in (PRIORITY, OTHER)
        )
        stack.enter_context(_flood(port, flood, files))
        pauses = stack.enter_context(machine_pauses())
        time.sleep(0.2)  # until it has begun to be one
        said = []
        for _ in range(WINDOWS):
            priority_delay, other_delay = _window(priority, other, pauses)
            said.append(f"{1e3 * priority_delay:.1f} ms and {1e3 * other_delay:.1f} ms")
            if priority_delay <= PRIORITY_BOUND and other_delay <= OTHER_BOUND:
                break
        print(f"p99 of a priority host and of another, {kind}, {transports}: {', '.join(said)}")
    assert priority_delay <= PRIORITY_BOUND, said
    assert other_delay <= OTHER_BOUND, said


def _window(priority: Asker, other: Asker, pauses: MachinePauses) -> tuple[float, float]:
    """The 99th percentiles of answers to both, in seconds, without pauses of the machine."""
    taken: dict[str, list[Span]] = {"priority": [], "other": []}
    until = time.perf_counter() + WINDOW_SECONDS

    def keep_asking(ask: Asker, times: list[Span]) -> None:
        while time.perf_counter() < until:
            times.append(ask())
            time.sleep(BETWEEN)

    beside = threading.Thread(target=keep_asking, args=(other, taken["other"]))
    beside.start()
    keep_asking(priority, taken["priority"])
    beside.join()
    priority_delay, other_delay = (
        [end - start - pauses.lost(start, end) for start, end in each] for each in taken.values()
    )
    return _p99(priority_delay), _p99(other_delay)


def _p99(times: list[float]) -> float:
    assert times, "no client was answered"
    return sorted(times)[math.ceil(0.99 * len(times)) - 1]


@contextmanager
def _asker(port: int, source: str, files: CertificateFiles | None, *, is_framed: bool) -> Iterator[Asker]:
    """A client whose call asks once and gives the moments of the question and of the answer."""
    link = socket.create_connection(("127.0.0.1", port), timeout=LIMIT, source_address=(source, 0))
    if files is not None:
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        context.load_verify_locations(files.authority)
        context.load_cert_chain(files.certificate, files.key)
        link = context.wrap_socket(link, server_hostname="localhost")
    question = encode_rtu(1, bytes.fromhex("03 0007 0001")) if is_framed else READ

    def received(size: int) -> bytes:
        data = b""
        while len(data) < size:
            more = link.recv(size - len(data))
            assert more, "the server closed the connection of one who asks once at a time"
            data += more
        return data

    def ask() -> Span:
        began = time.perf_counter()
        link.sendall(question)
        answer = received(5)  # the shortest there is in RTU
        if is_framed:
            received(7 - len(answer))
        else:
            answer += received(1)
            answer += received(answer[5])
            # An exception where the queue of a line is full; there are places for priority hosts.
            assert len(answer) == 11 or (len(answer) == 9 and source != PRIORITY)
        return began, time.perf_counter()

    with link:
        ask()
        yield ask


@contextmanager
def _server(endpoint: str, access: str, transports: str) -> Iterator[int]:
    """The port of a server in a process of its own."""
    with _program("flooded.py", endpoint, access, PRIORITY, transports) as said:
        yield int(said)


@contextmanager
def _flood(port: int, flood: Flood, files: CertificateFiles | None) -> Iterator[None]:
    """Fifty clients that ask without end, in a process of their own."""
    own = "" if files is None else f"{files.authority},{files.certificate},{files.key}"
    arguments = (str(port), str(FLOODERS), flood.asked.hex(), "deaf" if flood.is_deaf else "reads", own)
    with _program("flood.py", *arguments) as said:
        assert said == "ready"
        yield


@contextmanager
def _program(name: str, *arguments: str) -> Iterator[str]:
    """What a program of this folder says first; it ends with the block."""
    # A flood comes from other machines: here it takes what the servers leave, as if it had processors of its own.
    after_others = ["nice", "-n", "10"] if name == "flood.py" else []
    command = [*after_others, sys.executable, str(PROGRAMS / name), *arguments]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as program:
        try:
            assert program.stdout is not None
            yield program.stdout.readline().strip()
        finally:
            program.kill()
