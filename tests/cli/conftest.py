"""What the tests of the command line share: running it in this process, and peers to run it against."""

import logging
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack

import pytest
from typer.testing import CliRunner

import busway
from busway.cli.program import app


class Result:
    """How a command ended."""

    def __init__(self, code: int, out: str, err: str) -> None:
        self.code = code
        self.out = out
        self.err = err


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Result]]:
    """Runs ``busway`` with arguments; what it prints is kept apart. An exception that is no exit fails the test.

    A command that shows its traffic shows that of the whole process: it ends with the test.
    """
    monkeypatch.setenv("BUSWAY_TRACEBACK", "1")
    trace = logging.getLogger("busway.trace")
    before = (trace.level, trace.propagate, trace.handlers[:])

    def run(*arguments: str, stdin: str | None = None) -> Result:
        result = CliRunner().invoke(app, list(arguments), input=stdin)
        if result.exception is not None and not isinstance(result.exception, SystemExit):
            raise result.exception
        assert "Traceback" not in result.stderr
        return Result(result.exit_code, result.stdout, result.stderr)

    yield run
    busway.TRACE.set(busway.TraceLevel.OFF)
    level, trace.propagate, trace.handlers[:] = before
    trace.setLevel(level)


@pytest.fixture
def device() -> busway.Device:
    """A device with 1000 registers and coils and 10 inputs."""
    return busway.Device(holding_registers=1000, coils=3000, input_registers=10, discrete_inputs=10)


@pytest.fixture
def url(device: busway.Device) -> Iterator[str]:
    """Where ``device`` is served, as unit 1."""
    with busway.serve_in_thread("tcp://127.0.0.1:0", units={1: device}) as server:
        yield server.endpoints[0]


@pytest.fixture
def peer() -> Iterator[Callable[..., str]]:
    """Makes a peer that answers each request with what a function gives: bytes, or nothing at all."""
    with ExitStack() as stack:

        def make(answer: Callable[[bytes], bytes]) -> str:
            listener = socket.create_server(("127.0.0.1", 0))
            stack.callback(listener.close)

            def converse() -> None:
                try:
                    connection, _ = listener.accept()
                except OSError:
                    return
                with connection:
                    while data := connection.recv(1024):
                        connection.sendall(answer(data))

            thread = threading.Thread(target=converse, daemon=True)
            thread.start()
            return f"tcp://127.0.0.1:{listener.getsockname()[1]}"

        yield make


@pytest.fixture
def closed_port() -> Iterator[str]:
    """The URL of a port that no program listens on; it is held, so that no other program takes it."""
    with socket.socket() as holder:
        holder.bind(("127.0.0.1", 0))
        yield f"tcp://127.0.0.1:{holder.getsockname()[1]}"
